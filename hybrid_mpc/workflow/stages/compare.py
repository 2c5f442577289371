"""Stage control: closed loops of every task under every controller, until cost differences are significant."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.compare.controllers import COMPARED, OBSERVERS, ORACLES
from hybrid_mpc.compare.loops import (
    DRAWN,
    MODEL,
    LoopRow,
    LoopSpec,
    arrays_of,
    read_rows,
    run_specs,
    write_rows,
)
from hybrid_mpc.compare.sequential import Comparison, compare_costs, hardest, looks
from hybrid_mpc.compare.summary import ClosedLoops, StepTimes, Summary, by_task, step_times, summaries
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.engine import WORKERS, run_jobs
from hybrid_mpc.files import digest
from hybrid_mpc.kit.parts import LoopSettings, loop_settings, read_parts
from hybrid_mpc.loop.loop import Loop
from hybrid_mpc.scenario import Budget, Scenario, Task
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import UNKNOWN, Absent, Stage, source_of, sources
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, observed

if TYPE_CHECKING:
    from hybrid_mpc.control.safeguard import SafeController
    from hybrid_mpc.data.trajectories import Trajectory
    from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
    from hybrid_mpc.estimate.switching import SwitchingFilter
    from hybrid_mpc.watch.monitor import Monitor

Array = NDArray[np.float64]
BASELINES = ("prior", "prior_observer")
REPORTED = {"prior": "prior_observer", "hybrid": "hybrid_observer", "oracle": "oracle"}
"""Controllers behind three short names: all with the same kind of estimator."""
TIMED = OBSERVERS
"""Controllers whose first seed runs alone on the machine, so that the durations of its steps count."""


@dataclass(frozen=True)
class Part:
    """Loops that run together and share one checkpoint: one task under one controller, with some seeds.

    A ``timed`` part runs alone on the machine, so that the durations of its steps count.
    """

    task: Task
    controller: str
    seeds: tuple[int, ...]
    timed: bool = False

    @property
    def stage(self) -> str:
        """Name of its checkpoint."""
        return f"loops/{self.task.name}-{self.controller}-{self.seeds[0]}"

    def specs(self, scenario: str, run_seed: int) -> list[LoopSpec]:
        """Its loops."""
        first = (*DRAWN, "step_ms", "plans") if self.timed else DRAWN
        return [
            LoopSpec(
                scenario, MODEL, self.task.name, self.controller, seed=seed, run_seed=run_seed,
                keep=first if seed == 0 else (),
            )
            for seed in self.seeds
        ]  # fmt: skip


def parts_of(scenario: Scenario, tasks: Sequence[Task], budget: Budget, seeds: range) -> list[Part]:
    """Loops of the tasks with some of a budget's seeds, in the order in which they run.

    First come the timed ones, then the slow ones.
    """
    parts = [Part(task, name, (0,), timed=True) for task in tasks for name in TIMED if 0 in seeds]
    for name in reversed(COMPARED):
        most = _seeds(name, scenario, budget.seeds, budget.oracle_seeds)
        own = range(max(seeds.start, 1 if name in TIMED else 0), min(seeds.stop, most))
        together = 1 if name in ORACLES else max(1, len(own))
        for task in tasks:
            parts += [Part(task, name, tuple(own[i : i + together])) for i in range(0, len(own), together)]
    return parts


@dataclass(frozen=True)
class ControlResult(ClosedLoops):
    """Closed loops on the scenario's plant. Without a plant, only steps are timed, on recordings: array ``step_ms``.

    Args:
        most_seeds: Most seeds of a task; its loops stop earlier once its comparison is decided.
        step_ms: Durations of the hybrid's steps.
        reason: Why there are no loops. Default: empty, there are loops.
    """

    most_seeds: int
    step_ms: StepTimes
    reason: str = ""

    @cached_property
    def means(self) -> dict[str, dict[str, Summary]]:
        """Means of the loops by task and controller; their intervals hold with early stopping."""
        return summaries(self.rows, self.most_seeds)

    @cached_property
    def comparisons(self) -> dict[str, dict[str, Comparison]]:
        """By task and baseline, the cost of the hybrid with observer over the baseline's."""
        return {task: comparisons(cells, self.most_seeds) for task, cells in by_task(self.rows).items()}

    @cached_property
    def gaps(self) -> dict[str, tuple[float | None, str]]:
        """By task the share of the gap that the hybrid closes, see :func:`gap_closed`."""
        return {task: gap_closed(cells) for task, cells in by_task(self.rows).items()}

    @property
    def gap(self) -> tuple[float | None, str]:
        """Mean of the gaps closed, or None and the reasons if no task has one."""
        known = [value for value, _ in self.gaps.values() if value is not None]
        if known:
            return float(np.mean(known)), ""
        return None, "; ".join(dict.fromkeys(reason for _, reason in self.gaps.values())) or self.reason

    @property
    def has_oracle(self) -> bool:
        """Whether an oracle ran."""
        return any(row.controller in ORACLES for row in self.rows)

    def cost(self, controller: str) -> float | None:
        """Sum over the tasks of a controller's mean costs; None without loops, or if one diverged."""
        own = [cells[controller].cost.mean for cells in self.means.values() if controller in cells]
        known = [cost for cost in own if cost is not None]
        return sum(known) if known and len(known) == len(own) else None

    def tracking(self, controller: str) -> dict[str, float]:
        """Root mean square tracking errors of a controller by signal, over its tasks, each with the same weight."""
        squares: dict[str, dict[str, list[float]]] = {}
        for row in self.rows:
            for signal, rmse in row.tracking_rmse.items() if row.controller == controller else ():
                squares.setdefault(signal, {}).setdefault(row.task, []).append(rmse**2)
        return {
            signal: math.sqrt(np.mean([np.mean(own) for own in by.values()]))
            for signal, by in squares.items()
        }

    @property
    def steps(self) -> dict[str, Array]:
        """Durations of whole steps [ms] of prior and hybrid, where they were timed."""
        if "step_ms" in self.arrays:
            return {"hybrid": self.arrays["step_ms"]}
        return _steps(self.drawn)


def _steps(rows: Sequence[LoopRow]) -> dict[str, Array]:
    own = {
        name: [r.arrays["step_ms"] for r in rows if r.controller == REPORTED[name] and "step_ms" in r.arrays]
        for name in ("prior", "hybrid")
    }
    return {name: np.concatenate(times) for name, times in own.items() if times}


def closed_loops(found: ControlResult | Absent) -> ControlResult | None:
    """The stage's result if it holds closed loops, else None."""
    return None if isinstance(found, Absent) or not found.rows else found


def control_stage(context: Context) -> ControlResult | Absent:
    """Simulate closed loops of every task with prior, hybrid and oracle; without a plant, only time the steps."""
    if context.scenario.control is None:
        return Absent(f"scenario {context.scenario.name} defines no control problem")
    context.read(NOISE)
    if context.scenario.plant is None:
        return _only_timing(context)
    rows = compare(context)
    return ControlResult(
        tuple(rows),
        context.budget.seeds,
        step_times(_steps(rows)["hybrid"], 1e3 * context.spec.dt),
        arrays=arrays_of(rows),
    )


def compare(context: Context) -> list[LoopRow]:
    """Run the loops on the run's model: timed loops one by one, the others in parallel processes.

    A task gets no more seeds once its comparison of hybrid and better baseline is decided
    (:mod:`hybrid_mpc.compare.sequential`). Every finished part is written, so an interrupted run does not repeat it.
    """
    scenario, budget, settings = context.scenario, context.budget, context.settings
    every = tasks_of(scenario, budget.tasks)
    tasks, rows, done = list(every), list[LoopRow](), 0
    for seeds in looks(budget.seeds):
        parts = parts_of(scenario, tasks, budget, range(done, seeds))
        specs = {part.stage: part.specs(settings.scenario, settings.seed) for part in parts}
        found = run_or_read(context, specs, alone=[part.stage for part in parts if part.timed])
        rows += [row for part in parts for row in found[part.stage]]
        own = by_task(rows)
        tasks, done = [task for task in tasks if not decided(own[task.name], budget.seeds)], seeds
    order = [task.name for task in every]
    return sorted(rows, key=lambda row: (order.index(row.task), row.controller, row.seed))


def comparisons(cells: Mapping[str, Sequence[LoopRow]], most: int) -> dict[str, Comparison]:
    """The cost of a task's hybrid with observer over that of each baseline, by baseline, at most ``most`` seeds."""
    costs = {
        name: [row.cost for row in sorted(rows, key=lambda row: row.seed)] for name, rows in cells.items()
    }
    return {name: compare_costs(costs[REPORTED["hybrid"]], costs[name], most) for name in BASELINES}


def gap_closed(cells: Mapping[str, Sequence[LoopRow]]) -> tuple[float | None, str]:
    """Share of the distance from the better baseline to the measuring oracle that the hybrid covers in a task.

    The baselines are the fitted prior with and without disturbance observer; the hybrid has the observer. Returns None
    and a reason if the distance is below twice its standard error; one seed has no standard error.

    gap closed = (J_baseline - J_hybrid) / (J_baseline - J_oracle), with mean costs J over the seeds.
    """
    if "oracle" not in cells:
        return None, "no oracle ran"
    costs = {name: np.array([row.cost for row in rows]) for name, rows in cells.items()}
    baseline = min((costs[n] for n in BASELINES if n in costs), key=lambda c: float(c.mean()))
    hybrid, oracle = costs[REPORTED["hybrid"]], costs["oracle"]
    if min(len(baseline), len(oracle)) < 2:
        single = "the oracle ran" if len(oracle) < 2 else "the prior ran"
        return None, f"{single} with one seed only, which gives no standard error; use --budget full"
    if not all(np.all(np.isfinite(c)) for c in (baseline, hybrid, oracle)):
        return None, "a loop diverged"
    gap = float(baseline.mean() - oracle.mean())
    error = math.sqrt(sum(float(c.var(ddof=1)) / len(c) for c in (baseline, oracle)))
    if gap <= 2.0 * error:
        return None, (
            f"the costs of baseline {baseline.mean():.4g} and oracle {oracle.mean():.4g} do not differ significantly"
        )
    return float(baseline.mean() - hybrid.mean()) / gap, ""


def decided(cells: Mapping[str, Sequence[LoopRow]], most: int) -> bool:
    """Whether a task needs no more seeds: the comparison of its hybrid with the better baseline is decided."""
    found = comparisons(cells, most)
    return found[hardest(found)].decided


def _only_timing(context: Context) -> ControlResult:
    kit, whole = context.kit, context.dataset.whole
    # periods timed on recordings if the scenario has no plant; enough for a 99th percentile
    most = max(2, 1000 // len(whole))
    controller, estimator, durations = kit.controller(), kit.observer(), []
    for i, recording in enumerate(whole):
        context.progress.update("recordings", i, len(whole), f"timing on {recording.name}")
        durations.append(time_on_recording(controller, estimator, kit.monitor(kind="own"), recording, most))
    reason = f"scenario {context.scenario.name} has no plant to close the loop with"
    times = np.concatenate(durations)
    timed = step_times(times, 1e3 * context.spec.dt)
    return ControlResult((), context.budget.seeds, timed, reason, arrays={"step_ms": times})


def time_on_recording(
    controller: SafeController,
    estimator: ExtendedKalmanFilter | SwitchingFilter,
    monitor: Monitor,
    trajectory: Trajectory,
    most: int,
) -> Array:
    """Durations [ms] of a loop's steps on at most ``most`` recorded samples, without a plant.

    The reference is the operating point, whatever the state of the recording. The loop gets the recorded input as the
    applied one.
    """
    loop = Loop(estimator, controller, monitor=monitor)
    loop.start(trajectory.y[0])
    durations = []
    for k in range(1, min(most, len(trajectory.t))):
        loop.finish()
        loop.step(trajectory.y[k], applied=trajectory.u[k - 1])
        loop.finish()
        durations.append(1e3 * sum(loop.spent.values()))
    return np.array(durations)


def _seeds(name: str, scenario: Scenario, seeds: int, oracle_seeds: int) -> int:
    if name not in ORACLES:
        return seeds
    # an oracle with the true state uses no measurement, so seeds only change the rival plans of BestOf
    return 0 if scenario.oracle is None else (oracle_seeds if name == "oracle" else min(1, oracle_seeds // 2))


def run_or_read(
    context: Context, parts: Mapping[str, Sequence[LoopSpec]], *, alone: Collection[str] = ()
) -> dict[str, list[LoopRow]]:
    """Rows of loops on the run's model: those that ``checkpoints`` holds are read, the others run.

    A part is written when it ends, so an interrupted run continues from there. A checkpoint is read only if it belongs
    to the present model, noise, machine and control problem. Parts named in ``alone`` run one by one in this process,
    so that the durations of their steps count; the others run in parallel processes.
    """
    of = {part: identity(context, specs) for part, specs in parts.items()}
    found = {part: read_rows(context.path(part), of[part]) for part in parts}
    rows = {part: held for part, held in found.items() if held is not None}

    def write(part: str, made: list[LoopRow]) -> None:
        write_rows(context.path(part), made, of[part])
        rows[part] = made

    common = context.scenario_path, (context.out / "model").resolve()
    missing = [part for part in parts if part not in rows]
    timed = [part for part in missing if part in alone]
    for i, part in enumerate(timed):
        spec = parts[part][0]
        context.progress.update("timed loops", i, len(timed), f"{spec.task}, {spec.controller}")
        write(part, run_specs(*common, parts[part]))
    jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        part: (run_specs, (*common, parts[part])) for part in missing if part not in alone
    }
    run_jobs(jobs, context.progress.update, WORKERS, write, fresh=False, cluster=context.cluster)
    return rows


def identity(context: Context, specs: Sequence[LoopSpec]) -> str:
    """Digest of everything that the loops of a run depend on: specifications, machine, tasks, model and program."""
    parts = read_parts(context.out / "model")
    model = parts.description
    scenario = context.ready
    tasks = {task.name: task for task in scenario.tasks}
    loop = loop_settings(scenario, parts.loop.process_noise)
    oracle = source_of(scenario.oracle) if any(spec.controller in ORACLES for spec in specs) else None
    contents = [task_content(tasks[spec.task], context.spec.dt, loop) for spec in specs]
    read = contents, source_of(scenario.plant), oracle
    if any(value is UNKNOWN for value in (*contents, *read[1:])):
        return f"unknown {time.monotonic_ns()}"
    loops, estimators = [(spec.id, spec.keep) for spec in specs], replace(loop, control={})
    made_by = sources(__name__), context.versions
    return digest([loops, model.programs_sha256, model.model, estimators, read, made_by])


def task_content(task: Task, dt: float, loop: LoopSettings) -> object:
    """Everything of a task that its loops depend on: references sampled on the grid, control problem, faults.

    ``UNKNOWN`` if the source of its figures cannot be read.
    """
    figures = source_of(task.figures)
    if figures is UNKNOWN:
        return UNKNOWN
    problem = loop.control.get(task.name, loop.control.get(""))
    horizon = 0 if problem is None else problem.horizon
    t = np.arange(round(task.duration / dt) + horizon + 1, dtype=np.float64) * dt
    return {
        "name": task.name,
        "duration": task.duration,
        "x0": task.x0,
        "faults": task.faults,
        "reference": np.asarray(task.reference(t)),
        "weight": None if task.weight is None else np.asarray(task.weight(t)),
        "measured disturbances": None if task.w is None else np.asarray(task.w(t)),
        "control problem": problem,
        "figures": figures,
    }


def what_loops_read(context: Context) -> dict[str, object]:
    """The machine, its tasks, and how many loops there are."""
    scenario, budget = context.scenario, context.budget
    loop = loop_settings(scenario)
    read: dict[str, object] = {
        **observed(context),
        "control problem": scenario.control,
        "plant": source_of(scenario.plant),
        "seed": context.settings.seed,
        "number of loops": (looks(budget.seeds), budget.oracle_seeds, budget.tasks),
        "safe input": scenario.safe_input,
    }
    for task in tasks_of(scenario, budget.tasks) if scenario.plant is not None else ():
        read[f"task {task.name}"] = task_content(task, context.spec.dt, loop)
    return read


CONTROL = Stage(
    "control", "closing the loop", ControlResult, control_stage,
    lambda context: {**what_loops_read(context), "what is drawn": DRAWN}, (EXPORT, NOISE), optional=True,
)  # fmt: skip
