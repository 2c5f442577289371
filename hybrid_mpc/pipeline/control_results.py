"""What ``hybrid-mpc control`` writes: results.json (docs/control.md) and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.closed_loop import ClosedLoopResult
from hybrid_mpc.closed_loop.timing import percentiles
from hybrid_mpc.files import check_folder, write_json
from hybrid_mpc.job.contenders import CONTENDERS
from hybrid_mpc.job.loops import LoopRow
from hybrid_mpc.job.table import summaries
from hybrid_mpc.pipeline.control_job import Job, run_loops
from hybrid_mpc.pipeline.deploy import versions
from hybrid_mpc.records import plain

if TYPE_CHECKING:
    from hybrid_mpc.pipeline.context import Progress

Array = NDArray[np.float64]
SCHEMA_VERSION = 2


def run_control(job: Job, out: Path, progress: Progress, *, gif: bool = True) -> dict[str, Any]:
    """Run a job and write its results and figures.

    Args:
        job: What to run.
        out: Folder to make; an existing one must be empty.
        progress: Where to report.
        gif: Whether a moving picture of each task is drawn, if the scenario draws. Default: yes.

    Returns:
        What ``results.json`` holds.

    Raises:
        InputError: If the folder is not empty, or nothing can be written in it.
    """
    check_folder(out)
    rows: list[LoopRow] = []
    steps: dict[str, list[Array]] = {}
    progress.start("closing the loop")
    firsts: dict[str, dict[str, tuple[ClosedLoopResult, Array]]] = {}
    for row, result in run_loops(job, progress.update):
        rows.append(row)
        steps.setdefault(row.controller, []).append(result.timing_ms["total"])
        if row.seed == 0:
            firsts.setdefault(row.task, {})[row.controller] = (result, row.arrays["plans"])
    times = {name: np.concatenate(parts) for name, parts in steps.items()}
    results = collected(job, rows, times)
    write_json(out / "results.json", results)
    progress.finish("")
    progress.start("drawing")
    figures(job, out / "figures", firsts, times, progress, gif)
    progress.finish("")
    return results


def collected(job: Job, rows: Sequence[LoopRow], times: Mapping[str, Array]) -> dict[str, Any]:
    """The content of results.json: what was run, every loop, and means with intervals."""
    settings, kit = job.settings, job.kit
    return {
        "schema": "hybrid-mpc control",
        "schema_version": SCHEMA_VERSION,
        "scenario": job.scenario.name,
        "solver": settings.solver,
        "controllers": list(settings.controllers),
        "tasks": [task.name for task in job.tasks],
        "seeds": settings.seeds,
        "seed": settings.seed,
        "faults": [
            {"target": f.target, "value": f.value, "start_s": f.start, "end_s": f.end}
            for f in settings.faults
        ],
        "guard": plain(kit.detector()) if settings.guard else None,
        "reaction": settings.guard,
        "model": {"provenance": kit.provenance},
        "noise": {
            "source": job.noise_source,
            "sigma_x": {n: kit.noise(n).tolist() for n in settings.controllers if not CONTENDERS[n].truth},
        },
        "versions": versions(),
        "period_ms": 1e3 * kit.models["prior"].dt,
        "step_ms": {name: percentiles(values) for name, values in times.items()},
        "summary": plain(summaries(rows)),
        "loops": [row.plain() for row in rows],
    }


def figures(
    job: Job,
    folder: Path,
    firsts: Mapping[str, Mapping[str, tuple[ClosedLoopResult, Array]]],
    times: Mapping[str, Array],
    progress: Progress,
    gif: bool,
) -> list[Path]:
    """Figures of the first loop of every task and controller, and the durations of steps."""
    from hybrid_mpc.plots import animation, loops, save

    model, scenario, written = job.kit.models["prior"], job.scenario, []
    for i, task in enumerate(job.tasks):
        progress.update("figures", i, len(job.tasks), task.name)
        control = task.control or scenario.control
        assert control is not None
        limits, first = (control.u_min, control.u_max), firsts[task.name]
        some = next(iter(first.values()))[0]
        drawn = {name: loops.Motion(r.t, r.x, r.u) for name, (r, _) in first.items()}
        figure = loops.closed_loops(
            task.title, some.t, some.reference, drawn, states=model.states, inputs=model.inputs, limits=limits
        )
        written.append(save(figure, folder / f"{task.name}.png"))
        name = next((n for n in ("hybrid_observer", "hybrid") if n in first), next(iter(first)))
        result, plans = first[name]
        if gif and scenario.draw is not None and np.all(np.isfinite(result.x)):
            path = folder / f"{task.name}.gif"
            animation.animate(
                path, result.t, result.x, plans, dt=result.dt, draw=scenario.draw, u=result.u,
                title=f"{task.title} ({name})", position=model.states[0], inputs=model.inputs, limits=limits,
            )  # fmt: skip
            written.append(path)
    written.append(save(loops.solve_times(times, 1e3 * model.dt), folder / "step_times.png"))
    return written
