"""The main job's pictures, drawn from the stages' checkpoints."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.identify.settings import KINDS
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.loops import summaries, tasks_of
from hybrid_mpc.job.stages.compare import kept
from hybrid_mpc.job.stages.guard import read_trace
from hybrid_mpc.job.stages.identify import trained_models as load_trained
from hybrid_mpc.job.stages.monitor import clean_windows, run_calibration
from hybrid_mpc.job.stages.results import MODELS, OBSERVERS, REPORTED, step_times
from hybrid_mpc.plots import analysis, animation, data, estimation, fit, loops, monitor
from hybrid_mpc.plots import fit as training
from hybrid_mpc.plots import loops as tasks
from hybrid_mpc.plots.monitor import overview
from hybrid_mpc.plots.style import save

Figures = dict[str, list[tuple[Path, str]]]
"""Figure files with their captions by section of the report."""
OBSERVER_TITLES = {
    "prior_observer": "Observer on the fitted prior",
    "hybrid_observer": "Observer on the hybrid",
}
SHOWN_RUNS = 2
SHOWN_RECORDINGS = 4


def draw_all(context: Context) -> Figures:
    """Draw every figure that the run's stages allow into ``figures/``."""
    judged = _estimation, _timing, _monitor, guard_figures, _analysis
    parts = (_data, _training, _free_runs, _overview, _loops, *judged)
    figures: Figures = {}
    for i, part in enumerate(parts):
        context.progress.update("figures", i, len(parts), part.__name__.strip("_"))
        for section, name, figure, caption in part(context):
            path = save(figure, context.out / "figures" / f"{name}.png")
            figures.setdefault(section, []).append((path, caption))
    figures.setdefault("control", [])[:0] = _moving(context)
    return figures


def _data(context: Context) -> Any:
    prior = context.scenario.prior()
    pieces = [t for t in context.dataset.trajectories if t.role != "nominal"]
    yield (
        "data", "recordings", data.recordings(pieces, prior.outputs, prior.inputs),
        "Recordings with what each part is used for.",
    )  # fmt: skip
    yield "data", "coverage", data.coverage(pieces, prior.states), "Where training and test data lie."


def _training(context: Context) -> Any:
    curves: dict[str, dict[str, Any]] = {}
    starts: dict[str, float] = {}
    for kind in reversed(KINDS):
        trained = load_trained(context, kind)
        names = ["loss_error", "validation"]
        if kind == "mopgrnn":
            names += ["loss_energy", "bound_error", "bound_energy"]
        best = trained.best
        curves[kind] = {"step": trained.curve["step"][:, best]}
        curves[kind] |= {name: trained.curve[name][:, best] for name in names}
        starts[kind] = float(trained.settings.teacher_steps)
    figure = training.curves(curves, free_run_start=starts, units=("mixed SI", "W", "mixed SI"))
    caption = (
        "Objectives and bounds of the deployed network of each kind, on a fixed set of training windows."
    )
    yield "training", "training", figure, caption


def _free_runs(context: Context) -> Any:
    arrays, prior = context.arrays("evaluation"), context.scenario.prior()
    for run in context.result("evaluation")["runs"][:SHOWN_RUNS]:
        own = {m: {k: arrays[f"{m}/{run}/{k}"] for k in ("x_hat", "energy_model_w")} for m in MODELS}
        shared = {k: arrays[f"mopgrnn/{run}/{k}"] for k in ("t", "x", "u", "energy_measured_w")}
        shown = ("phy_nominal", "phy", "rnn", "mopgrnn")
        figure = fit.free_run(
            shared["t"],
            shared["x"],
            {m: own[m]["x_hat"] for m in shown},
            shared["u"],
            states=prior.states,
            inputs=prior.inputs,
            energy_measured=shared["energy_measured_w"],
            energy_model=own["mopgrnn"]["energy_model_w"],
            title=f"Free run on {run}",
        )
        name = run.replace("#", "-")
        yield (
            "free_run",
            f"free_run_{name}",
            figure,
            f"Free run over the unseen piece {run}; the warm-up before it is left out.",
        )
    scores = context.result("evaluation")["scores"]
    keys = ("e_sim_s", "rmse_rad", "energy_violation_w")
    finite = {m: {k: _finite(scores[m]["best"][k]) for k in keys} for m in MODELS}
    spread: dict[str, dict[str, float]] = {
        m: {k: float(np.std([float(n[k]) for n in scores[m]["networks"]])) for k in keys}
        for m in KINDS
        if all(np.isfinite(float(n[k])) for n in scores[m]["networks"] for k in keys)
    }
    metrics = {**fit.METRICS, "rmse_rad": f"free-run RMSE [{context.scenario.prior().outputs[0].unit}]"}
    yield (
        "free_run", "errors", fit.errors_bar(finite, spread=spread, metrics=metrics),
        "Errors over all unseen pieces; whiskers: standard deviation over the networks of a kind.",
    )  # fmt: skip


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(float(value)) else None


def _loops(context: Context) -> Any:
    scenario = context.scenario
    if "reason" in context.result("control") or scenario.control is None:
        return
    prior, drawn = scenario.prior(), [row for row in kept(context, "control") if row.arrays]
    for task in tasks_of(scenario, context.budget.tasks):
        own = {row.controller: row.arrays for row in drawn if row.task == task.name}
        names = {short: n for short, n in REPORTED.items() if n in own}
        control = task.control or scenario.control
        figure = loops.closed_loops(
            task.title,
            own[names["hybrid"]]["t"],
            own[names["hybrid"]]["reference"],
            {short: loops.Motion(*(own[n][key] for key in ("t", "x", "u"))) for short, n in names.items()},
            states=prior.states,
            inputs=prior.inputs,
            limits=(control.u_min, control.u_max),
        )
        yield "control", f"loop_{task.name}", figure, f"{task.title}, first seed."


def _overview(context: Context) -> Any:
    """Costs of all controllers, errors of the strokes."""
    if "reason" in context.result("control"):
        return
    rows = kept(context, "control")
    table = {
        task: {name: (cell.cost.mean, cell.cost.ci95) for name, cell in cells.items()}
        for task, cells in summaries(rows).items()
    }
    if any("oracle" in row for row in table.values()):
        finite = {
            task: {n: (_number(mean), _number(half)) for n, (mean, half) in row.items()}
            for task, row in table.items()
        }
        yield (
            "control",
            "costs",
            tasks.costs(finite),
            (
                "Closed-loop cost of every controller over the measuring oracle's, with 95 % intervals over the seeds."
            ),
        )
    strokes = [
        {"controller": row.controller, **{k: _finite(v) for k, v in row.figures.items()}}
        for row in rows
        if row.figures
    ]
    if strokes and all({"speed_error_rel", "timing_error_s"} <= set(row) for row in strokes):
        yield (
            "control",
            "strokes",
            tasks.strokes(strokes),
            "Strokes at the true crossing; bands: 1 % and 10 ms.",
        )


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _moving(context: Context) -> list[tuple[Path, str]]:
    """One loop of the hybrid as a moving picture, with what it planned at every instant."""
    scenario = context.scenario
    if scenario.draw is None or scenario.control is None or "reason" in context.result("control"):
        return []
    run = tasks_of(scenario, context.budget.tasks)
    task = next((t for t in run if t.weight is not None), run[0])
    control, prior = task.control or scenario.control, scenario.prior()
    own = next(
        row.arrays
        for row in kept(context, "control")
        if (row.task, row.controller) == (task.name, REPORTED["hybrid"]) and "plans" in row.arrays
    )
    path = animation.animate(
        context.out / "figures" / f"{task.name}.gif", own["t"], own["x"], own["plans"], dt=context.spec.dt,
        draw=scenario.draw, u=own["u"], title=task.title, position=prior.states[0], inputs=prior.inputs,
        limits=(control.u_min, control.u_max),
    )  # fmt: skip
    return [(path, f"{task.title}: the machine, and in outline what the hybrid MPC plans.")]


def _estimation(context: Context) -> Any:
    result, arrays = context.result("estimation"), context.arrays("estimation")
    for name in OBSERVERS:
        own = result.get(name)
        if own is None or "reason" in own:
            continue
        figure = estimation.innovations(
            [arrays[f"{name}/nis/{i}"] for i in range(len(result["recordings"]))],
            arrays[f"{name}/autocorrelation"],
            dt=context.spec.dt,
            outputs=context.scenario.prior().outputs,
            mean_band=(own["nis_low"], own["nis_high"]),
            correlation_band=own["correlation_band"],
            title=OBSERVER_TITLES[name],
        )
        caption = f"{OBSERVER_TITLES[name]}: how surprised it was by test recordings."
        yield "estimation", f"innovations_{name}", figure, caption


def _timing(context: Context) -> Any:
    times = step_times(context)
    if times:
        caption = (
            "Whole controller steps: estimation, optimisation and monitoring, the Python calls included."
        )
        yield "timing", "step_times", loops.solve_times(times, 1e3 * context.spec.dt), caption


def _monitor(context: Context) -> Any:
    result = context.result("monitor")
    if "reason" in result:
        return
    arrays, output = context.arrays("monitor"), context.scenario.prior().outputs[0]
    unit = "N m" if output.unit == "rad" else "N"
    for recording in _worth_showing(context):
        keys = ("t", "violation_w", "level_w", "residual_level", "alarm", "y")
        own = {k: arrays[f"{recording.name}/{k}"] for k in keys}
        figure = monitor.trace(
            own["t"],
            own["violation_w"],
            own["level_w"],
            result["calibration"]["threshold_w"],
            own["alarm"],
            own["y"],
            output=output,
            windows=clean_windows(context, recording, ("train", "valid", "test", "nominal")),
            residual=(own["residual_level"], result["calibration"]["residual_threshold"], unit),
            title=recording.name,
        )
        name = recording.name.replace("#", "-")
        yield "monitor", f"monitor_{name}", figure, f"The monitor over the whole recording {recording.name}."
    if "load" in result:
        load = result["load"]
        own = {k: arrays[f"load/{k}"] for k in ("t", "violation", "level", "alarm", "x")}
        figure = monitor.trace(
            own["t"],
            own["violation"],
            own["level"],
            result["calibration"]["threshold_w"],
            own["alarm"],
            own["x"][:, 0],
            output=output,
            windows=((0.0, load["start_s"]),),
            title=f"closed loop, {load['task']}: an unknown load from {load['start_s']:g} s on",
        )
        unit = context.scenario.prior().inputs[0].unit
        caption = (
            f"The monitor inside the loop: a constant load of {load['load']:g} {unit} at the input sets in."
        )
        yield "monitor", "monitor_load", figure, caption


def _worth_showing(context: Context) -> list[Any]:
    """Recordings with alarms first, then test recordings, a few in all."""
    alarmed = {alarm["file"] for alarm in context.result("monitor")["alarms"]}
    tested = {t.name.split("#")[0] for t in context.trajectories("test")}
    ranked = sorted(
        context.dataset.whole, key=lambda r: (r.name not in alarmed, r.name.split("#")[0] not in tested)
    )
    return ranked[:SHOWN_RECORDINGS]


def _analysis(context: Context) -> Any:
    result, arrays = context.result("analysis"), context.arrays("analysis")
    if "reason" in result:
        return
    colours = {"prior": "phy", "hybrid": "mopgrnn"}
    poles = {c: np.array([complex(*z) for z in result[n]["rest"]["poles"]]) for n, c in colours.items()}
    yield (
        "analysis",
        "poles",
        analysis.pole_map(poles, context.spec.dt),
        "Poles of the one-step maps at rest.",
    )
    prior = context.scenario.prior()
    titles = {"rest": "at rest, where the slope of dry friction dominates", "moving": "at working speed"}
    for point in ("rest", "moving"):
        if point not in result["prior"]:
            continue
        responses = {
            c: tuple(arrays[f"{n}/{point}/{key}"] for key in ("omega", "magnitude", "phase"))
            for n, c in colours.items()
        }
        figure = analysis.bode(
            responses,
            input_signal=prior.inputs[0],
            output_signal=prior.outputs[0],
            nyquist=np.pi / context.spec.dt,
        )
        yield "analysis", f"bode_{point}", figure, f"Bode plot of prior and hybrid {titles[point]}."


def guard_figures(context: Context) -> Iterator[tuple[str, str, Figure, str]]:
    """Each loop in which something breaks; of a machine without plant a recording with test data."""
    found = context.result("guard")
    if "faults" not in found and "shown" not in found:
        return
    arrays, output = context.arrays("guard"), context.scenario.prior().outputs[0]
    unit = "N m" if output.unit == "rad" else "N"
    for row in found.get("faults", ()):
        start, name = row["start_s"], row["fault"]
        marks = [
            (start, row["title"]),
            *((s["t_s"], f"guard: {s['after'].lower()}") for s in row["switches"]),
        ]
        figure = overview(
            read_trace(arrays, name), arrays[f"{name}/y"], output=output, force_unit=unit, marks=marks,
            title=f"{row['task']}: {row['title']} at {start:g} s",
        )  # fmt: skip
        seen = "without an alarm" if row["delay_s"] is None else f"alarm after {row['delay_s']:.2f} s"
        told = f"; the diagnosis: {row['diagnosis']}" if row["diagnosis"] else ""
        yield "guard", f"guard_{name}", figure, f"{row['title'].capitalize()}: {seen}{told}."
    if "faults" not in found:
        shown, limits = found["shown"], {}
        if "detector" not in found:
            stored = run_calibration(context)
            known = {"violation": stored.threshold_w, "residual": stored.residual_threshold}
            limits = {name: limit for name, limit in known.items() if limit is not None}
        figure = overview(
            read_trace(arrays, "recorded"), arrays["recorded/y"], output=output, force_unit=unit,
            thresholds=limits, title=shown,
        )  # fmt: skip
        by = "learned detector" if "detector" in found else "thresholds of the section before"
        if not (limits or "detector" in found):
            by = "monitor, which has no thresholds to judge by"
        yield (
            "guard",
            "guard_recorded",
            figure,
            f"The recording {shown}, of which test data come, by the {by}.",
        )
