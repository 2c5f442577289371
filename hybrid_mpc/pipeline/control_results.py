"""What ``hybrid-mpc control`` writes: results.json (docs/control.md) and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.closed_loop import ClosedLoopResult
from hybrid_mpc.closed_loop.timing import percentiles
from hybrid_mpc.files import check_folder, write_json
from hybrid_mpc.monitor.calibration import alarm_intervals
from hybrid_mpc.mpc import Source
from hybrid_mpc.pipeline.control_job import Job, run_loops
from hybrid_mpc.pipeline.deploy import versions
from hybrid_mpc.pipeline.faulted_loops import stored_detector, switches
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import Task

if TYPE_CHECKING:
    from hybrid_mpc.pipeline.context import Progress

Array = NDArray[np.float64]
SCHEMA_VERSION = 1
TIMES = ("total", "solve", "estimate")


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
    rows: list[dict[str, Any]] = []
    steps: dict[str, list[Array]] = {}
    progress.start("closing the loop")
    firsts: dict[str, dict[str, tuple[ClosedLoopResult, Array]]] = {}
    for task, name, seed, result, plans in run_loops(job, progress.update):
        rows.append(row(task, name, seed, result, guarded=bool(job.settings.guard)))
        steps.setdefault(name, []).append(result.timing_ms["total"])
        if seed == 0:
            firsts.setdefault(task.name, {})[name] = (result, plans)
    times = {name: np.concatenate(parts) for name, parts in steps.items()}
    results = collected(job, rows, times)
    write_json(out / "results.json", results)
    progress.finish("")
    progress.start("drawing")
    figures(job, out / "figures", firsts, times, progress, gif)
    progress.finish("")
    return results


def row(
    task: Task, name: str, seed: int, result: ClosedLoopResult, *, guarded: bool = False
) -> dict[str, Any]:
    """Figures of one loop; with a guard its alarms and changes of mode too."""
    watched: dict[str, Any] = {}
    if guarded:
        alarms = alarm_intervals(result.alarm, result.dt)
        watched["guard"] = {
            "alarms": [{"start_s": a, "end_s": b} for a, b in alarms],
            "not_judged_s": float(np.sum(~result.judged)) * result.dt,
            "switches": switches(result),
        }
    return {
        "task": task.name,
        "controller": name,
        "seed": seed,
        "cost": result.cost,
        "tracking_rmse_rad": result.tracking_rmse,
        "largest_u": float(np.abs(result.u).max()),
        "sources": shares(result.source),
        "figures": dict(task.figures(result)) if task.figures is not None else {},
        "timing_ms": {key: percentiles(result.timing_ms[key]) for key in TIMES},
        **watched,
    }


def shares(sources: Sequence[str]) -> dict[str, float]:
    """Share of each source of inputs.

    Example:
        >>> shares(("MPC", "PLAN"))
        {'MPC': 0.5, 'PLAN': 0.5, 'FALLBACK': 0.0, 'ZERO': 0.0}
    """
    return {source.name: sources.count(source.name) / len(sources) for source in Source}


def interval(values: Sequence[float]) -> dict[str, float | None]:
    """Mean and half width of its 95 % interval (Student's t); None for the half width of a single value.

    Example:
        >>> interval([1.0])
        {'mean': 1.0, 'ci95': None}
    """
    from scipy.stats import t as student

    x, n = np.asarray(values, dtype=float), len(values)
    if not np.all(np.isfinite(x)):
        return {"mean": None, "ci95": None}
    half = float(student.ppf(0.975, n - 1) * x.std(ddof=1) / math.sqrt(n)) if n > 1 else None
    return {"mean": float(x.mean()), "ci95": half}


def collected(job: Job, rows: Sequence[dict[str, Any]], times: Mapping[str, Array]) -> dict[str, Any]:
    """The content of results.json: what was run, every loop, and means with intervals."""
    settings, summary = job.settings, {}
    for task in job.tasks:
        of_task = [r for r in rows if r["task"] == task.name]
        summary[task.name] = {
            name: _summed([r for r in of_task if r["controller"] == name]) for name in settings.controllers
        }
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
        **(
            {"guard": plain(stored_detector(job.artifact)), "reaction": settings.guard}
            if settings.guard
            else {}
        ),
        "model": {"provenance": job.artifact.provenance},
        "noise": {"source": job.noise_source, "sigma_x": {k: v.tolist() for k, v in job.noise.items()}},
        "versions": versions(),
        "period_ms": 1e3 * job.artifact.models["prior"].dt,
        "step_ms": {name: percentiles(values) for name, values in times.items()},
        "summary": summary,
        "loops": list(rows),
    }


def _summed(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    keys = rows[0]["figures"]
    return {
        "cost": interval([r["cost"] for r in rows]),
        "tracking_rmse_rad": interval([r["tracking_rmse_rad"] for r in rows]),
        "figures": {key: interval([r["figures"][key] for r in rows]) for key in keys},
        "mean_abs_figures": {key: interval([abs(r["figures"][key]) for r in rows]) for key in keys},
        "sources": {s.name: float(np.mean([r["sources"][s.name] for r in rows])) for s in Source},
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

    model, scenario, written = job.artifact.models["prior"], job.scenario, []
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
