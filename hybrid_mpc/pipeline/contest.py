"""The closed loops of a scenario: every task under every contender, several seeds each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import Artifact, load_artifact
from hybrid_mpc.closed_loop import ClosedLoopResult, simulate
from hybrid_mpc.closed_loop.simulate import Step
from hybrid_mpc.errors import InputError
from hybrid_mpc.pipeline.contenders import CONTENDERS, ORACLES, build
from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.loops import make_monitor
from hybrid_mpc.pipeline.parallel import WORKERS, run_jobs
from hybrid_mpc.scenario import ControlSpec, Scenario, Task, load_scenario

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


def contest(
    context: Context, artifact: Artifact, control: ControlSpec, noise: Mapping[str, Array]
) -> tuple[list[dict[str, Any]], dict[str, Array]]:
    """Run all loops; the timed ones alone, the others side by side in processes.

    Args:
        context: The run.
        artifact: Prior and hybrid.
        control: The scenario's control problem; a task may have its own.
        noise: Process noise by contender.

    Returns:
        One row a loop (task, controller, seed, cost, tracking error, share of solved steps, the task's own
        figures), and arrays: time series of the first seed, durations of the timed steps.
    """
    scenario, budget = context.scenario, context.budget
    tasks = tasks_of(scenario, budget.tasks)
    names = [n for n in CONTENDERS if _seeds(n, scenario, budget.seeds, budget.oracle_seeds)]
    common = context.settings.scenario, context.out / "model", dict(noise), context.settings.seed
    results: dict[tuple[str, str, int], ClosedLoopResult] = {}
    arrays: dict[str, Array] = {}
    for i, task in enumerate(tasks):
        for name in TIMED:
            context.progress.update("timed loops", i, len(tasks), f"{task.name}, {name}")
            plans: list[Array] = []
            (results[task.name, name, 0],) = loops(*common, task.name, name, (0,), on_plan=plans.append)
            arrays[f"{task.name}/{name}/plans"] = np.stack(plans)
    jobs: dict[str, Any] = {}
    for name in reversed(names):  # the slow ones first
        count = _seeds(name, scenario, budget.seeds, budget.oracle_seeds)
        seeds = tuple(range(1 if name in TIMED else 0, count))
        for task in tasks if seeds else ():
            jobs[f"{task.name}, {name}"] = (loops, (*common, task.name, name, seeds))
    done = run_jobs(jobs, context.progress.update, WORKERS)
    for key, (_, arguments) in jobs.items():
        task_name, name, seeds = arguments[-3:]
        results |= {(task_name, name, s): r for s, r in zip(seeds, done[key], strict=True)}
    rows: list[dict[str, Any]] = []
    for task in tasks:
        for (_, name, seed), r in sorted((k, r) for k, r in results.items() if k[0] == task.name):
            rows.append(_row(task, name, seed, r))
            if seed == 0:
                arrays |= {f"{task.name}/{name}/{key}": getattr(r, key) for key in SHOWN}
                if name in TIMED:
                    arrays[f"{task.name}/{name}/step_ms"] = r.timing_ms["total"]
    return rows, arrays


def _seeds(name: str, scenario: Scenario, seeds: int, oracle_seeds: int) -> int:
    if name not in ORACLES:
        return seeds
    # the oracle that sees the truth differs between seeds by nothing but its rivals' luck
    return 0 if scenario.oracle is None else (oracle_seeds if name == "oracle" else oracle_seeds // 2)


def _row(task: Task, name: str, seed: int, r: ClosedLoopResult) -> dict[str, Any]:
    return {
        "task": task.name,
        "controller": name,
        "seed": seed,
        "cost": r.cost,
        "tracking_rmse_rad": r.tracking_rmse,
        "solved": r.source.count("MPC") / len(r.source),
        "largest_u": float(np.abs(r.u).max()),
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
    on_plan: Callable[[Array], None] = lambda x: None,
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
        on_plan: Called with the planned states ``(N + 1, n_x)`` of every period.
    """
    scenario, artifact = load_scenario(scenario_name), load_artifact(folder)
    (task,) = tasks_of(scenario, (task_name,))
    assert scenario.plant is not None
    control = task.control or scenario.control
    assert control is not None
    estimator, controller = build(name, scenario, artifact, control, noise)
    dt = artifact.models["prior"].dt
    periods, results = round(task.duration / dt), []

    def on_step(step: Step, i: int) -> None:
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
