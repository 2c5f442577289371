"""The closed loops of a run: every task under every controller, several seeds each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.files import digest
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.controllers import CONTROLLERS, ORACLES
from hybrid_mpc.job.engine import WORKERS, run_jobs
from hybrid_mpc.job.loops import MODEL, Bench, LoopRow, LoopSpec, run_loops, tasks_of
from hybrid_mpc.kit.artifact import load, loop_settings, read_description
from hybrid_mpc.records import plain, record
from hybrid_mpc.scenario import Budget, Scenario, Task, load_scenario

Array = NDArray[np.float64]
TIMED = ("prior_observer", "hybrid_observer")
"""Controllers whose first seed runs alone on the machine, so that the durations of its steps count."""
SHOWN = ("t", "x", "u", "reference")
"""What is kept of the first seed, to be drawn."""


@dataclass(frozen=True)
class Part:
    """Loops that run and are kept together: one task under one controller.

    Args:
        task: The task.
        controller: The controller.
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

    def specs(self, scenario: str, run_seed: int) -> list[LoopSpec]:
        """Its loops."""
        first = (*SHOWN, "step_ms", "plans") if self.timed else SHOWN
        return [
            LoopSpec(
                scenario, MODEL, self.task.name, self.controller, seed=seed, run_seed=run_seed,
                keep=first if seed == 0 else (),
            )
            for seed in self.seeds
        ]  # fmt: skip


def parts_of(scenario: Scenario, budget: Budget) -> list[Part]:
    """All loops of a budget, in the order in which they run: the timed ones, then the slow ones first."""
    tasks, parts = tasks_of(scenario, budget.tasks), []
    for task in tasks:
        parts += [Part(task, name, (0,), timed=True) for name in TIMED]
    for name in reversed(list(CONTROLLERS)):
        seeds = range(1 if name in TIMED else 0, _seeds(name, scenario, budget.seeds, budget.oracle_seeds))
        together = 1 if name in ORACLES else max(1, len(seeds))
        for task in tasks:
            parts += [
                Part(task, name, tuple(seeds[i : i + together])) for i in range(0, len(seeds), together)
            ]
    return parts


def compare(context: Context) -> list[LoopRow]:
    """Run all loops on the run's model; the timed ones alone, the others side by side in processes.

    Every part is kept as it ends; what a run that was killed has kept is not run again.

    Args:
        context: The run; its artifact holds the filters' process noise.

    Returns:
        The rows by task, controller and seed; of the first seed with ``SHOWN``, of a timed one with ``step_ms`` and
        ``plans``.
    """
    parts, settings = parts_of(context.scenario, context.budget), context.settings
    common = settings.scenario, context.out / "model"
    specs = {part.stage: part.specs(settings.scenario, settings.seed) for part in parts}
    missing = [part for part in parts if not is_kept(context, part.stage, specs[part.stage])]
    timed = [part for part in missing if part.timed]
    for i, part in enumerate(timed):
        context.progress.update("timed loops", i, len(timed), f"{part.task.name}, {part.controller}")
        keep(context, part.stage, run_specs(*common, specs[part.stage]), specs[part.stage])
    run_parts(context, {part.stage: specs[part.stage] for part in missing if not part.timed})
    rows = [row for part in parts for row in kept(context, part.stage)]
    order = [task.name for task in tasks_of(context.scenario, context.budget.tasks)]
    return sorted(rows, key=lambda row: (order.index(row.task), row.controller, row.seed))


def _seeds(name: str, scenario: Scenario, seeds: int, oracle_seeds: int) -> int:
    if name not in ORACLES:
        return seeds
    # the oracle that sees the truth differs between seeds by nothing but its rivals' luck
    return 0 if scenario.oracle is None else (oracle_seeds if name == "oracle" else min(1, oracle_seeds // 2))


def run_specs(
    scenario: str,
    folder: Path,
    specs: list[LoopSpec],
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> list[LoopRow]:
    """Rows of loops on a run's own model.

    Args:
        scenario: Name or path of the scenario.
        folder: The artifact.
        specs: The loops.
        report: Called with ``(done, total, text)`` as the loops go on.
    """
    bench = _bench(scenario, folder, (folder / "model.json").stat().st_mtime_ns)
    return list(run_loops(bench, specs, report))


@lru_cache(maxsize=1)
def _bench(scenario: str, folder: Path, changed: int) -> Bench:
    """A bench with a run's model, as the folder was when it ``changed``."""
    return Bench(load_scenario(scenario), {MODEL: load(folder)})


def run_parts(context: Context, parts: Mapping[str, list[LoopSpec]]) -> None:
    """Run loops side by side in processes; each part is kept as it ends.

    Args:
        context: The run.
        parts: Loops by the checkpoint that keeps them.
    """
    common = context.settings.scenario, context.out / "model"
    jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        stage: (run_specs, (*common, specs)) for stage, specs in parts.items()
    }
    run_jobs(
        jobs, context.progress.update, WORKERS, lambda stage, rows: keep(context, stage, rows, parts[stage])
    )


def keep(context: Context, stage: str, rows: list[LoopRow], specs: Sequence[LoopSpec] = ()) -> None:
    """Write rows as a checkpoint, with what they are of.

    Args:
        context: The run.
        stage: Name of the checkpoint.
        rows: The loops.
        specs: Their specifications, to know them again. Default: unknown.
    """
    told = [row.plain() for row in rows]
    context.save(stage, {"rows": told, "of": identity(context, specs)}, arrays_of(rows))


def is_kept(context: Context, stage: str, specs: Sequence[LoopSpec]) -> bool:
    """Whether a checkpoint holds these loops of the run's present model, noise and control problem.

    Args:
        context: The run.
        stage: Name of the checkpoint.
        specs: The loops.
    """
    return context.done(stage) and context.result(stage).get("of") == identity(context, specs)


def identity(context: Context, specs: Sequence[LoopSpec]) -> str:
    """Digest of all that decides what loops of a run compute: their specifications, and the run's model.

    Args:
        context: The run.
        specs: The loops.
    """
    model = read_description(context.out / "model")
    rest = None if model.calibration is None else model.calibration.rest_speed
    of_monitor = rest if any(spec.monitor == "readings" for spec in specs) else None
    loop = loop_settings(context.scenario, model.loop.process_noise)
    return digest([[spec.id for spec in specs], model.programs_sha256, plain(loop), of_monitor])


def kept(context: Context, stage: str) -> list[LoopRow]:
    """Rows that :func:`keep` wrote.

    Args:
        context: The run.
        stage: Name of the checkpoint.

    Raises:
        InputError: If the checkpoint is damaged.
    """
    rows = [record(LoopRow, row, f"checkpoints/{stage}.json") for row in context.result(stage)["rows"]]
    arrays = context.arrays(stage)
    return [replace(row, arrays=_own(arrays, row)) for row in rows]


def arrays_of(rows: list[LoopRow]) -> dict[str, Array]:
    """The arrays of rows by ``task/controller/seed/name``."""
    return {f"{_place(row)}/{name}": values for row in rows for name, values in row.arrays.items()}


def _own(arrays: Mapping[str, Array], row: LoopRow) -> dict[str, Array]:
    start = f"{_place(row)}/"
    return {key.removeprefix(start): values for key, values in arrays.items() if key.startswith(start)}


def _place(row: LoopRow) -> str:
    return f"{row.task}/{row.controller}/{row.seed}"
