"""What a study would take, found out by a few periods of each kind of run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from hybrid_mpc.job.loops import LoopSpec
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.studies.configuration import Study
from hybrid_mpc.studies.inputs import TIMING, load_inputs

PROBE_PERIODS = 20
Kind = tuple[object, ...]


@dataclass(frozen=True)
class Plan:
    """What a study would take.

    Args:
        runs: Number of runs.
        axes: How many of each thing.
        seconds: Expected time of all runs on the given workers [s]; without starting processes.
        kinds: By model, controller, solver and horizon: seconds a run, averaged over tasks.
    """

    runs: int
    axes: dict[str, int]
    seconds: float
    kinds: dict[Kind, float]


def dry_run(
    study: Study,
    *,
    workers: int = 2,
    say: Callable[[str], None] = lambda text: None,
) -> Plan:
    """Check a study as far as running it would, and expect its time from a few periods of each kind of run.

    Args:
        study: The study.
        workers: Processes that it is to run in.
        say: Told what is timed.

    Raises:
        InputError: As :func:`~hybrid_mpc.studies.run_study`.

    Example: ``dry_run(study, workers=2).seconds``
    """
    scenario = load_scenario(study.scenario)
    run, _ = load_inputs(study)
    dt, lengths = scenario.data.dt, {task.name: task.duration for task in scenario.tasks}
    tasks = list(dict.fromkeys(r.task for r in _first_runs(study)))
    period: dict[tuple[Kind, str], float] = {}
    for first in _first_runs(study):
        say(f"{first.controller}, {first.task}")
        probe = replace(first, duration=PROBE_PERIODS * dt)
        period[_kind(first), first.task] = run(probe)[f"{TIMING}run_s"] / PROBE_PERIODS
    kinds: dict[Kind, float] = {}
    for (kind, task), seconds in period.items():
        periods = min(lengths[task], study.duration or lengths[task]) / dt
        kinds[kind] = kinds.get(kind, 0.0) + seconds * periods / len(tasks)
    each = study.size / len(kinds)
    return Plan(study.size, study.axes, each * sum(kinds.values()) / workers, kinds)


def _kind(run: LoopSpec) -> Kind:
    return run.model, run.controller, run.solver, run.horizon


def _first_runs(study: Study) -> list[LoopSpec]:
    """One run of each kind and task."""
    small = replace(study, draws=1, seeds=study.loop_seeds[:1], faults=study.fault_sets[:1])
    kinds: dict[tuple[Kind, str], LoopSpec] = {}
    for run in small.runs():
        kinds.setdefault((_kind(run), run.task), run)
    return list(kinds.values())
