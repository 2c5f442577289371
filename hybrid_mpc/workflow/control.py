"""``hybrid-mpc control``: closed loops of a model, their results.json (docs/control-results.md) and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.compare.controllers import CONTROLLERS, noise_name
from hybrid_mpc.compare.loops import (
    DRAWN,
    ON_MODEL,
    Bench,
    LoopRow,
    LoopSpec,
    read_rows,
    run_loops,
    write_rows,
)
from hybrid_mpc.compare.study import Study
from hybrid_mpc.compare.study_log import NoiseNote
from hybrid_mpc.compare.study_run import StudyModel, load_models
from hybrid_mpc.compare.summary import Summary, by_task, summaries
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.engine import Progress
from hybrid_mpc.files import digest, write_json
from hybrid_mpc.folder import JobNote, check_out, open_folder, versions
from hybrid_mpc.kit.parts import Provenance
from hybrid_mpc.kit.promises import Promise
from hybrid_mpc.loop.faults import fault_text
from hybrid_mpc.loop.realtime import percentiles
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.workflow.stage import sources

Array = NDArray[np.float64]
NOUN = "control"
SCHEMA_VERSION = 6


@dataclass(frozen=True)
class FaultNote:
    """A fault in all loops; ``channel`` is empty if there is only one channel."""

    target: str
    value: float
    channel: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class ControlResults:
    """Content of ``results.json`` of ``hybrid-mpc control`` (docs/control-results.md): settings, every loop, and means.

    ``guard`` are the limits of the monitor that triggers the guard, ``reaction`` is the guard's reaction; ``step_ms``
    are percentiles of step durations by controller, ``summary`` is by task and controller. For a scenario without plant
    ``on_model`` names the model that replaces the machine, by controller: then the figures say nothing about the
    machine, and controllers must not be compared, since their plants differ. ``promises`` are those of the model's
    folder.
    """

    schema: str
    schema_version: int
    scenario: str
    solver: str
    controllers: tuple[str, ...]
    tasks: tuple[str, ...]
    seeds: int
    seed: int
    faults: tuple[FaultNote, ...]
    guard: WatchLimits | None
    reaction: str
    model: Mapping[str, Provenance]
    noise: NoiseNote
    versions: Mapping[str, str]
    period_ms: float
    step_ms: Mapping[str, Mapping[str, float]]
    on_model: Mapping[str, str]
    summary: Mapping[str, Mapping[str, Summary]]
    loops: tuple[LoopRow, ...]
    promises: tuple[Promise, ...]


def run_control(
    study: Study, out: Path, progress: Progress, *, gif: bool = True, resume: bool = False
) -> ControlResults:
    """Run a study of one model, solver and set of faults in this process; write results and figures.

    Loops run one after the other, so that the durations of their steps count. Each row is written when its loop ends.

    Raises:
        InputError: If model, tasks or settings do not match, the folder belongs to another job, or it is not writable.
    """
    check_out(out, NOUN, resume=resume)
    progress.start("reading the model and the observers' noise")
    (model,) = load_models(study, plant=False).values()
    bench = Bench(load_scenario(study.scenario), dict.fromkeys(study.folders, model.kit))
    progress.finish(model.noise_source)
    settings = {key: value for key, value in study.identity().items() if key != "name"}
    note = JobNote(NOUN, settings | {"the content of the model": model.sha256})
    with open_folder(out, note, resume=resume):
        progress.start("closing the loop")
        rows = _rows(bench, study, model, out / "loops", progress)
        results = collected(study, bench, model, rows)
        write_json(out / "results.json", plain(results))
        progress.finish("")
        progress.start("drawing")
        figures(bench, rows, study, out / "figures", progress, gif)
        progress.finish("")
    return results


def _rows(bench: Bench, study: Study, model: StudyModel, folder: Path, progress: Progress) -> list[LoopRow]:
    first, specs = study.loop_seeds[0], dict[str, list[LoopSpec]]()
    for spec in study.runs():
        arrays = ("step_ms", *((*DRAWN, "plans", "alarm") if spec.seed == first else ()))
        specs.setdefault(spec.task, []).append(replace(spec, keep=arrays))
    rows: list[LoopRow] = []
    for task, own in specs.items():
        paths = {spec.id: folder / f"{task}-{spec.controller}-{spec.seed}.json" for spec in own}
        found = {spec.id: read_rows(paths[spec.id], _digest(spec, model)) for spec in own}
        missing = [spec for spec in own if found[spec.id] is None]
        report = partial(progress.update, task)
        for row, spec in zip(run_loops(bench, missing, report), missing, strict=True):
            write_rows(paths[spec.id], [row], _digest(spec, model))
            found[spec.id] = [row]
        rows += [row for spec in own for row in found[spec.id] or ()]
    return rows


def _digest(spec: LoopSpec, model: StudyModel) -> str:
    return digest([spec.id, spec.keep, model.sha256, sources(__name__)])


def collected(study: Study, bench: Bench, model: StudyModel, rows: Sequence[LoopRow]) -> ControlResults:
    """Results of finished loops."""
    kit = bench.kits[next(iter(study.folders))]
    (faults,) = study.fault_sets
    filters = dict.fromkeys(noise_name(name) for name in study.controllers if not CONTROLLERS[name].truth)
    return ControlResults(
        schema="hybrid-mpc control",
        schema_version=SCHEMA_VERSION,
        scenario=bench.scenario.name,
        solver=study.solvers[0],
        controllers=tuple(study.controllers),
        tasks=tuple(dict.fromkeys(row.task for row in rows)),
        seeds=len(study.loop_seeds),
        seed=study.run_seed,
        faults=tuple(FaultNote(f.target, f.value, f.channel, f.start, f.end) for f in faults),
        guard=kit.limits("hybrid") if study.guard else None,
        reaction=study.guard,
        model={"provenance": kit.provenance},
        noise=NoiseNote(model.noise_source, {name: tuple(kit.noise(name).tolist()) for name in filters}),
        versions=versions(),
        period_ms=1e3 * kit.models["prior"].dt,
        step_ms={name: percentiles(values) for name, values in _times(rows).items()},
        on_model={row.controller: row.on_model for row in rows if row.on_model},
        summary=summaries(rows),
        loops=tuple(rows),
        promises=kit.promises,
    )


def _times(rows: Sequence[LoopRow]) -> dict[str, Array]:
    """Durations of all steps [ms] by controller."""
    names = dict.fromkeys(row.controller for row in rows)
    return {n: np.concatenate([r.arrays["step_ms"] for r in rows if r.controller == n]) for n in names}


def figures(
    bench: Bench, rows: Sequence[LoopRow], study: Study, folder: Path, progress: Progress, gif: bool
) -> list[Path]:
    """Figures of the first loop of every task and controller, and the durations of steps."""
    # half a second to import: what is refused, is refused before
    from hybrid_mpc.compare.loop_figures import curves_of, loop_figure
    from hybrid_mpc.plots import animation, loops
    from hybrid_mpc.plots.style import save

    (kit,), (faults,) = bench.kits.values(), study.fault_sets
    model, scenario, written = kit.models["prior"], bench.scenario, []
    drawn = by_task([row for row in rows if "plans" in row.arrays])
    for i, task in enumerate(tasks_of(scenario, tuple(drawn))):
        progress.update("figures", i, len(drawn), task.name)
        first = {name: found[0].arrays for name, found in drawn[task.name].items()}
        control = kit.problem(task.name)
        stands = {row.controller: row.on_model for row in rows if row.on_model}
        if stands:  # each controller met another plant: no picture compares them
            for name, arrays in first.items():
                title = f"{task.title}, {name}, {ON_MODEL} ({stands[name]})"
                figure = loop_figure(title, control, model, {f"{name} on {stands[name]}": arrays})
                written.append(save(figure, folder / f"{task.name}_{name}.png"))
        else:
            figure = loop_figure(task.title, control, model, first)
            written.append(save(figure, folder / f"{task.name}.png"))
        name = next((n for n in ("hybrid_observer", "hybrid") if n in first), next(iter(first)))
        own, said = first[name], f", {ON_MODEL}" if stands else ""
        if gif and scenario.draw is not None and np.all(np.isfinite(own["x"])):
            path = folder / f"{task.name}.gif"
            animation.animate(
                path, own["t"], own["x"], own["plans"], dt=model.dt, draw=scenario.draw, u=own["u"],
                title=f"{task.title} ({name}{said})", curves=curves_of(model), inputs=model.inputs,
                limits=(control.u_min, control.u_max),
                alarm=own["alarm"] if study.guard else None,
                events=[(fault.start, fault_text([fault])) for fault in faults],
            )  # fmt: skip
            written.append(path)
    written.append(save(loops.solve_times(_times(rows), 1e3 * model.dt), folder / "step_times.png"))
    return written
