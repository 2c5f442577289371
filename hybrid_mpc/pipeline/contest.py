"""The closed loops of a scenario: every task under every contender, several seeds each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import Kit, load
from hybrid_mpc.closed_loop import ClosedLoopResult, simulate
from hybrid_mpc.closed_loop.simulate import Step
from hybrid_mpc.errors import InputError
from hybrid_mpc.input_limits import share_used
from hybrid_mpc.job.engine import WORKERS, run_jobs
from hybrid_mpc.mpc import OCP
from hybrid_mpc.pipeline.contenders import CONTENDERS, ORACLES, build
from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.loops import make_monitor
from hybrid_mpc.scenario import Budget, Scenario, Task, load_scenario

Array = NDArray[np.float64]
TIMED = ("prior_observer", "hybrid_observer")
"""Contenders whose first seed runs alone on the machine, so that the durations of its steps count."""
SHOWN = ("t", "x", "u", "reference")


def tasks_of(scenario: Scenario, names: tuple[str, ...] | None) -> tuple[Task, ...]:
    """The scenario's tasks of these names, all for None.

    Raises:
        InputError: If there is no task of a name.
    """
    if names is None:
        return scenario.tasks
    known = {task.name: task for task in scenario.tasks}
    missing = [name for name in names if name not in known]
    if missing:
        raise InputError(
            f"scenario {scenario.name}: no task {', '.join(missing)}; there are: {', '.join(known)}"
        )
    return tuple(known[name] for name in names)


@dataclass(frozen=True)
class Part:
    """Loops that run and are kept together: one task under one contender.

    Args:
        task: The task.
        controller: The contender.
        seeds: Numbers of the loops.
        timed: Whether it runs alone on the machine, so that the durations of its steps count.
    """

    task: Task
    controller: str
    seeds: tuple[int, ...]
    timed: bool = False

    @property
    def stage(self) -> str:
        """Name of its checkpoint."""
        return f"loops/{self.task.name}-{self.controller}-{self.seeds[0]}"


def parts_of(scenario: Scenario, budget: Budget) -> list[Part]:
    """All loops of a budget, in the order in which they run: the timed ones, then the slow ones first."""
    tasks, parts = tasks_of(scenario, budget.tasks), []
    for task in tasks:
        parts += [Part(task, name, (0,), timed=True) for name in TIMED]
    for name in reversed(list(CONTENDERS)):
        seeds = range(1 if name in TIMED else 0, _seeds(name, scenario, budget.seeds, budget.oracle_seeds))
        together = 1 if name in ORACLES else max(1, len(seeds))
        for task in tasks:
            parts += [
                Part(task, name, tuple(seeds[i : i + together])) for i in range(0, len(seeds), together)
            ]
    return parts


def contest(
    context: Context, artifact: Kit, control: OCP, noise: Mapping[str, Array]
) -> tuple[list[dict[str, Any]], dict[str, Array]]:
    """Run all loops; the timed ones alone, the others side by side in processes.

    Every part is kept as it ends; what a run that was killed has kept is not run again.

    Args:
        context: The run.
        artifact: Prior and hybrid.
        control: The scenario's control problem; a task may have its own.
        noise: Process noise by contender.

    Returns:
        One row a loop (task, controller, seed, cost, tracking error, share of solved steps, the task's own
        figures), and arrays: time series of the first seed, durations of the timed steps.
    """
    parts = parts_of(context.scenario, context.budget)
    common = context.settings.scenario, context.out / "model", dict(noise), context.settings.seed
    missing = [part for part in parts if not context.done(part.stage)]
    timed = [part for part in missing if part.timed]
    for i, part in enumerate(timed):
        context.progress.update("timed loops", i, len(timed), f"{part.task.name}, {part.controller}")
        context.save(part.stage, *_kept(*common, part.task.name, part.controller, part.seeds, True))
    jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        part.stage: (_kept, (*common, part.task.name, part.controller, part.seeds, False))
        for part in missing
        if not part.timed
    }
    run_jobs(jobs, context.progress.update, WORKERS, lambda stage, kept: context.save(stage, *kept))
    rows: list[dict[str, Any]] = []
    arrays: dict[str, Array] = {}
    for part in parts:
        rows += context.result(part.stage)["rows"]
        arrays |= context.arrays(part.stage)
    order = [task.name for task in tasks_of(context.scenario, context.budget.tasks)]
    return sorted(rows, key=lambda r: (order.index(r["task"]), r["controller"], r["seed"])), arrays


def _kept(
    scenario_name: str,
    folder: Path,
    noise: Mapping[str, Array],
    run_seed: int,
    task_name: str,
    name: str,
    seeds: tuple[int, ...],
    timed: bool,
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> tuple[dict[str, Any], dict[str, Array]]:
    """What is kept of the loops of a part: a row each, and time series of the first seed."""
    scenario = load_scenario(scenario_name)
    (task,) = tasks_of(scenario, (task_name,))
    control = task.control or scenario.control
    assert control is not None
    plans: list[Array] = []
    results = loops(
        scenario_name,
        folder,
        noise,
        run_seed,
        task_name,
        name,
        seeds,
        report,
        plans.append if timed else None,
    )
    rows = [_row(task, control, name, seed, r) for seed, r in zip(seeds, results, strict=True)]
    arrays: dict[str, Array] = {}
    if seeds[0] == 0:
        arrays |= {f"{task_name}/{name}/{key}": getattr(results[0], key) for key in SHOWN}
    if timed:
        arrays |= {
            f"{task_name}/{name}/step_ms": results[0].timing_ms["total"],
            f"{task_name}/{name}/plans": np.stack(plans),
        }
    return {"rows": rows}, arrays


def _seeds(name: str, scenario: Scenario, seeds: int, oracle_seeds: int) -> int:
    if name not in ORACLES:
        return seeds
    # the oracle that sees the truth differs between seeds by nothing but its rivals' luck
    return 0 if scenario.oracle is None else (oracle_seeds if name == "oracle" else min(1, oracle_seeds // 2))


def limits_used(control: OCP, r: ClosedLoopResult) -> dict[str, float]:
    """Largest share of the way from rest to each limit that a loop used: 1 is the limit, more a violation.

    Args:
        control: The problem with the limits.
        r: The loop; states are the plant's true ones.

    Returns:
        ``u``, and ``du`` and ``x[i]`` where there are such limits [-].
    """
    used = {"u": share_used(r.u, control.u_min, control.u_max)}
    if control.du_max is not None:
        du = np.diff(r.u, axis=0, prepend=control.rest_input[None])
        used["du"] = float(np.max(np.abs(du) / control.du_max))
    for i in np.flatnonzero(np.isfinite(control.x_min) | np.isfinite(control.x_max)):
        used[f"x[{i}]"] = share_used(r.x[:, i], control.x_min[i], control.x_max[i])
    return used


def _row(task: Task, control: OCP, name: str, seed: int, r: ClosedLoopResult) -> dict[str, Any]:
    return {
        "task": task.name,
        "controller": name,
        "seed": seed,
        "cost": r.cost,
        "tracking_rmse_rad": r.tracking_rmse,
        "solved": r.source.count("MPC") / len(r.source),
        "limits": limits_used(control, r),
        "figures": task.figures(r) if task.figures is not None else {},
    }


def loops(
    scenario_name: str,
    folder: Path,
    noise: Mapping[str, Array],
    run_seed: int,
    task_name: str,
    name: str,
    seeds: tuple[int, ...],
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
    on_plan: Callable[[Array], None] | None = None,
) -> list[ClosedLoopResult]:
    """Loops of one task and contender; all contenders share problem, period, horizon and safeguards.

    Args:
        scenario_name: Name or path of the scenario.
        folder: The artifact.
        noise: Process noise by contender.
        run_seed: Seed of the run.
        task_name: Task.
        name: Contender.
        seeds: Numbers of the loops; same number, same sensor noise for every contender.
        report: Called with ``(done, total, text)`` as the loops go on.
        on_plan: Called with the planned states ``(N + 1, n_x)`` of every period. Default: none.
    """
    scenario, artifact = load_scenario(scenario_name), load(folder)
    (task,) = tasks_of(scenario, (task_name,))
    assert scenario.plant is not None
    control = task.control or scenario.control
    assert control is not None
    estimator, controller = build(name, scenario, artifact, control, noise)
    dt = artifact.models["prior"].dt
    periods, results = round(task.duration / dt), []

    def on_step(step: Step, i: int) -> None:
        if on_plan is not None:
            on_plan(step.decision.solution.x)
        if step.k % 50 == 0:
            report(i * periods + step.k, len(seeds) * periods, "periods")

    for i, seed in enumerate(seeds):
        results.append(
            simulate(
                scenario.plant(), estimator, controller, task.reference, weight=task.weight,
                dt=dt, duration=task.duration, x0=np.array(task.x0), seed=run_seed * 1000 + seed,
                monitor=make_monitor(artifact.models["hybrid"], None) if CONTENDERS[name].model == "hybrid" else None,
                faults=task.faults,
                on_step=lambda step, i=i: on_step(step, i),  # type: ignore[misc]
            )
        )  # fmt: skip
    return results
