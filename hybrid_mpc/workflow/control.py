"""``hybrid-mpc control``: closed loops of a model, their results.json and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
from hybrid_mpc.compare.study_log import StudyNote
from hybrid_mpc.compare.study_run import StudyModel, job_note, load_models, make_note
from hybrid_mpc.compare.summary import ClosedLoops, StepTimes, by_task, step_times
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.engine import Progress
from hybrid_mpc.files import digest, write_json
from hybrid_mpc.folder import check_out, open_folder
from hybrid_mpc.kit.promises import Promise
from hybrid_mpc.loop.faults import fault_text
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.workflow.stage import read_as, sources

Array = NDArray[np.float64]
NOUN = "control"
SCHEMA_VERSION = 7


@dataclass(frozen=True)
class ControlResults:
    """``results.json`` of ``hybrid-mpc control``.

    Args:
        schema_version: Version of the file.
        note: Settings, model, noise of its observers, and versions, as the note of a study has them.
        step_ms: Durations of steps by controller.
        promises: What the kit promises.
        loops: Every loop. In Python: ``loops.means``, ``loops.plants``.
    """

    schema_version: int
    note: StudyNote
    step_ms: Mapping[str, StepTimes]
    promises: tuple[Promise, ...]
    loops: ClosedLoops


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
    models = dict.fromkeys(study.folders, model.note(study.controllers))
    note = make_note(study.identity(), models, study.size)
    with open_folder(out, job_note(note, NOUN), resume=resume):
        progress.start("closing the loop")
        rows = _rows(bench, study, model, out / "loops", progress)
        period = 1e3 * model.kit.models["prior"].dt
        times = {name: step_times(values, period) for name, values in _times(rows).items()}
        results = ControlResults(SCHEMA_VERSION, note, times, model.kit.promises, ClosedLoops(tuple(rows)))
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


def read_control(path: Path) -> ControlResults:
    """Read a ``results.json`` of ``hybrid-mpc control``, checked; arrays are empty.

    Raises:
        InputError: If the file is missing, damaged, or of another version.

    Example:
        ``read_control(Path("strokes/results.json")).loops.means["stroke_4"]["hybrid_observer"].cost``
    """
    return read_as(ControlResults, SCHEMA_VERSION, path, "hybrid-mpc control")


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
        stands = ClosedLoops(tuple(rows)).plants
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
