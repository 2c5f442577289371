"""Figures of a run's report, drawn from the results of its stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.compare.loop_figures import curves_of, loop_figure
from hybrid_mpc.compare.loops import ON_MODEL
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.identify.evaluate import Scores, input_correlation
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.plots import analysis, animation, data, estimation, explain, fit, loops, monitor
from hybrid_mpc.plots.interactive import over_time, write_interactive
from hybrid_mpc.plots.style import save
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.explain_page import bars_of
from hybrid_mpc.workflow.stage import Absent, Stage
from hybrid_mpc.workflow.stages.analyze import ANALYSIS
from hybrid_mpc.workflow.stages.choose import CHOICE
from hybrid_mpc.workflow.stages.compare import CONTROL, REPORTED
from hybrid_mpc.workflow.stages.estimate import ESTIMATION, OBSERVERS
from hybrid_mpc.workflow.stages.evaluate import EVALUATION, finite
from hybrid_mpc.workflow.stages.explain import EXPLAIN
from hybrid_mpc.workflow.stages.identify import PRIOR, TRAINING, trained_kinds, trained_models
from hybrid_mpc.workflow.stages.on_model import LOOPS_ON_MODEL
from hybrid_mpc.workflow.stages.watch import WATCH, clean_windows, read_trace

Figures = dict[str, list[tuple[Path, str]]]
"""Figure files with their captions by section of the report."""
OBSERVER_TITLES = {
    "prior_observer": "Observer on the fitted prior",
    "hybrid_observer": "Observer on the hybrid",
}
SHOWN_RUNS = 2
LAGS, FEWEST_LAGS = 50, 5
"""Largest lag of the correlation of errors with inputs [samples], and the smallest one that is worth a picture."""


def draw_all(context: Context) -> Figures:
    """Draw every figure that the run's stages allow into ``figures/``."""
    parts = (
        _data, _explain, _training, _free_runs, _overview, _loops, _on_model, _estimation, _timing, _watch,
        _analysis,
    )  # fmt: skip
    figures = _draw(context, parts)
    figures.setdefault("control", [])[:0] = _moving(context)
    return figures


def draw_first(context: Context) -> Figures:
    """Draw the figures of the finished stages up to the free runs."""
    there: dict[Callable[[Context], Any], Stage[Any]] = {
        _data: PRIOR, _explain: EXPLAIN, _training: TRAINING, _free_runs: EVALUATION,
    }  # fmt: skip
    return _draw(
        context, [part for part, stage in there.items() if not isinstance(context.find(stage), Absent)]
    )


def _draw(context: Context, parts: Sequence[Callable[[Context], Any]]) -> Figures:
    """Figures of some parts by section; figures that this process has already drawn are reused."""
    figures: Figures = {}
    for i, part in enumerate(parts):
        name_of_part = part.__name__.strip("_")
        context.progress.update("figures", i, len(parts), name_of_part)
        if name_of_part not in context.pictures:
            context.pictures[name_of_part] = [
                (section, _saved(figure, context.out / "figures" / f"{name}.png"), caption)
                for section, name, figure, caption in part(context)
            ]
        for section, path, caption in context.pictures[name_of_part]:
            figures.setdefault(section, []).append((path, caption))
    return figures


def _saved(figure: Figure, path: Path) -> Path:
    """Save a picture, and its interactive form beside it if its axis is time."""
    path.with_suffix(".json").unlink(missing_ok=True)  # it may belong to an older picture of this name
    save(figure, path)
    if over_time(figure):
        write_interactive(figure, path)
    return path


def _explain(context: Context) -> Any:
    found = context.find(EXPLAIN)
    if isinstance(found, Absent):
        return
    labels, errors = bars_of(found.explanation)
    figure = explain.error_steps(labels, errors, "held-out error, over the outputs' spreads [-]", found.floor)
    caption = "Held-out error of free runs, and its reduction by each found term."
    yield "explain", "explain_steps", figure, caption
    for number, step in enumerate(found.explanation.steps, 1):
        for k, picture in enumerate(step.pictures, 1):
            caption = f"{picture.ordinate.partition(' [')[0]} over its data."
            yield "explain", f"explain_{number}_{k}", explain.term_over_data(**vars(picture)), caption


def _data(context: Context) -> Any:
    prior = context.scenario.prior()
    pieces = [t for t in context.dataset.trajectories if t.role != "nominal"]
    figure = data.recordings(pieces, prior.outputs, prior.inputs, disturbances=prior.disturbances)
    yield "data", "recordings", figure, "Recordings and the use of each part."
    parts = {role: context.smoothed(role) for role in ("train", "test")}  # includes unmeasured states
    smoothed = [t for part in parts.values() for t in part]
    caption = (
        "Training and test data in the state space." if prior.kinematics else "Estimated states over time."
    )
    yield "data", "coverage", data.coverage(smoothed, prior.states, prior.kinematics), caption


def _training(context: Context) -> Any:
    curves: dict[str, dict[str, Any]] = {}
    starts: dict[str, float] = {}
    for kind in reversed(kinds := trained_kinds(context)):
        trained = trained_models(context, kind)
        objectives = [name.removeprefix("loss_") for name in trained.curve if name.startswith("loss_")]
        names = ["validation", f"loss_{objectives[0]}"]
        if kind == "mopgrnn":
            names += [f"loss_{name}" for name in objectives[1:]] + [f"bound_{name}" for name in objectives]
        curves[kind] = {name: trained.curve[name][:, trained.best] for name in ["step", *names]}
        starts[kind] = float(trained.settings.teacher_steps)
    if not kinds:
        return
    units = {b.name: b.rate_unit for b in context.scenario.prior().equations.balances}
    figure = fit.curves(curves, free_run_start=starts, units=units)
    caption = "Objectives and bounds on fixed training windows, for the best network of each kind by validation error."
    yield "training", "training", figure, caption


def _free_runs(context: Context) -> Any:
    found, prior, deployed = context.read(EVALUATION), context.scenario.prior(), context.read(CHOICE).deployed
    arrays = found.arrays
    states = {s.name for s in prior.states}
    others = [j for j, s in enumerate(prior.outputs) if s.name not in states]
    signals = [*prior.states, *(prior.outputs[j] for j in others)]

    def drawn(run: str, end: str = "") -> Any:
        return np.hstack([arrays[f"{run}/x{end}"], arrays[f"{run}/y{end}"][:, others]])

    for run in found.runs[:SHOWN_RUNS]:
        own = {key: arrays[f"{deployed}/{run}/{key}"] for key in ("t", "u", "balances", "balances_hat")}
        balances = [
            fit.BalanceRun(b.name, b.rate_unit, own["balances"][:, i], own["balances_hat"][:, i])
            for i, b in enumerate(prior.equations.balances)
        ]
        shown = [m for m in ("phy_nominal", "phy", "rnn", deployed) if m in found.scores]
        figure = fit.free_run(
            own["t"], drawn(f"{deployed}/{run}"), {m: drawn(f"{m}/{run}", "_hat") for m in shown}, own["u"],
            signals=signals, inputs=prior.inputs, balances=balances, hybrid=deployed,
            title=f"Free run on {run}", band=_band(prior, arrays, f"{deployed}/{run}"),
        )  # fmt: skip
        caption = f"Free run over the test piece {run}, without the warm-up."
        yield "free_run", f"free_run_{run.replace('#', '-')}", figure, caption
    yield from _unexplained(context, deployed)
    metrics = metrics_of(prior)
    values = {m: _flat(scores.model) for m, scores in found.scores.items()}
    every = {str(m): [_flat(n) for n in found.scores[m].networks] for m in trained_kinds(context)}
    spread = {
        m: {k: float(np.std([n[k] for n in own])) for k in metrics}
        for m, own in every.items()
        if own and all(n[k] is not None for n in own for k in metrics)
    }
    caption = "Errors over all test pieces; whiskers: standard deviation over the networks of a kind."
    yield "free_run", "errors", fit.errors_bar(values, metrics, spread=spread), caption


def _unexplained(context: Context, deployed: str) -> Any:
    """Correlation of the errors with the inputs, for the fitted prior and the hybrid."""
    found, prior = context.read(EVALUATION), context.scenario.prior()
    arrays, runs = found.arrays, found.runs
    shortest = min((len(arrays[f"phy/{run}/t"]) for run in runs), default=0)
    lags = min(LAGS, shortest // 4)
    if lags < FEWEST_LAGS:
        return
    correlations: dict[str, dict[tuple[str, str], tuple[Any, float]]] = {}
    for model in ("phy", deployed):
        for (i, into), (j, output) in product(enumerate(prior.inputs), enumerate(prior.outputs)):
            errors = [arrays[f"{model}/{run}/y_hat"][:, j] - arrays[f"{model}/{run}/y"][:, j] for run in runs]
            inputs = [arrays[f"{model}/{run}/u"][:, i] for run in runs]
            pair = input_correlation(errors, inputs, lags)
            if np.isfinite(pair[1]):
                correlations.setdefault(model, {})[into.name, output.name] = pair
    if set(correlations) != {"phy", deployed} or len({frozenset(own) for own in correlations.values()}) > 1:
        return
    figure = fit.input_correlations(context.spec.dt * np.arange(lags + 1.0), correlations)
    caption = (
        "Correlation of the errors with earlier inputs. Outside the dotted lines (95 % interval of independent "
        "errors), the model lacks an effect of this input, or has a wrong gain or delay."
    )
    yield "free_run", "unexplained", figure, caption


def metrics_of(prior: Prior) -> dict[str, str]:
    """Titles of the error bars with units, by the names of :func:`_flat`."""
    rmse = {f"rmse {s.label}": f"RMSE of {s.label}" for s in prior.outputs}
    balances = [f"{b.name} [{b.rate_unit}]" for b in prior.equations.balances]
    violation = {f"violation {label}": f"violation of {label}" for label in balances}
    # with one output, error over spread and RMSE differ by a constant factor only
    over = {"error": "error over the spread [-]"} if len(prior.outputs) > 1 else {}
    return {**over, **rmse, "e_sim": "simulation error $E_{sim}$ [-]", **violation}


def _flat(scores: Scores) -> dict[str, Any]:
    every = {"error": scores.error, "e_sim": scores.e_sim}
    every |= {f"rmse {label}": value for label, value in scores.rmse.items()}
    every |= {f"violation {label}": value for label, value in scores.violation.items()}
    return {name: finite(value) for name, value in every.items()}


def _band(prior: Prior, arrays: Any, run: str) -> dict[str, tuple[Any, Any]]:
    y_hat, half = arrays[f"{run}/y_hat"], arrays[f"{run}/band"]
    return {s.name: (y_hat[:, j] - half[:, j], y_hat[:, j] + half[:, j]) for j, s in enumerate(prior.outputs)}


def _loops(context: Context) -> Any:
    scenario, found = context.scenario, context.find(CONTROL)
    if isinstance(found, Absent) or scenario.control is None:
        return
    prior, drawn = scenario.prior(), found.drawn
    if not drawn:
        return
    for task in tasks_of(scenario, context.budget.tasks):
        own = {row.controller: row.arrays for row in drawn if row.task == task.name}
        names = {short: n for short, n in REPORTED.items() if n in own}
        control = task.control or scenario.control
        figure = loop_figure(task.title, control, prior, {short: own[n] for short, n in names.items()})
        yield "control", f"loop_{task.name}", figure, f"{task.title}, first seed."


def _on_model(context: Context) -> Any:
    """One figure for each task and controller, since the plants differ."""
    found = context.find(LOOPS_ON_MODEL)
    if isinstance(found, Absent):
        return
    scenario = context.ready
    tasks = {task.name: task for task in scenario.tasks}
    for row in sorted(found.drawn, key=lambda row: OBSERVERS.index(row.controller)):
        task, name = tasks[row.task], row.controller
        control = task.control or scenario.control
        assert control is not None
        title = f"{task.title}, {name}, {ON_MODEL} ({row.on_model})"
        figure = loop_figure(title, control, scenario.prior(), {f"{name} on {row.on_model}": row.arrays})
        yield "on_model", f"on_model_{task.name}_{name}", figure, f"{title}; first seed."


def _overview(context: Context) -> Any:
    """Costs of all controllers, and the scenario's own figures."""
    scenario, found = context.scenario, context.find(CONTROL)
    if isinstance(found, Absent) or not found.rows:
        return
    table = {
        task: {name: (_number(cell.cost.mean), _number(cell.cost.ci95)) for name, cell in cells.items()}
        for task, cells in found.means.items()
    }
    if any(row.get(loops.BASELINE, (np.nan, np.nan))[0] > 0 for row in table.values()):
        text = (
            "Closed-loop cost of every controller over that of the prior with observer, with 95 % intervals."
        )
        yield "control", "costs", loops.costs(table), text
    if scenario.figures is not None:
        for name, (figure, caption) in scenario.figures(found.rows).items():
            yield "control", name, figure, caption


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _moving(context: Context) -> list[tuple[Path, str]]:
    """One loop of the hybrid as an animation, with its plan in every period."""
    scenario, found = context.scenario, context.find(CONTROL)
    if scenario.draw is None or scenario.control is None or isinstance(found, Absent) or not found.rows:
        return []
    run = tasks_of(scenario, context.budget.tasks)
    task = next((t for t in run if t.weight is not None), run[0])
    control, prior = task.control or scenario.control, scenario.prior()
    own = next(
        row.arrays
        for row in found.drawn
        if (row.task, row.controller) == (task.name, REPORTED["hybrid"]) and "plans" in row.arrays
    )
    path = animation.animate(
        context.out / "figures" / f"{task.name}.gif", own["t"], own["x"], own["plans"], dt=context.spec.dt,
        draw=scenario.draw, u=own["u"], title=task.title, curves=curves_of(prior), inputs=prior.inputs,
        limits=(control.u_min, control.u_max),
    )  # fmt: skip
    return [(path, f"{task.title}: the machine, and in outline the plan of the hybrid MPC.")]


def _estimation(context: Context) -> Any:
    found = context.find(ESTIMATION)
    if isinstance(found, Absent):
        return
    arrays = found.arrays
    for name in OBSERVERS:
        own = found.observers[name]
        if isinstance(own, Absent):
            continue
        figure = estimation.innovations(
            [arrays[f"{name}/nis/{i}"] for i in range(len(found.recordings))], arrays[f"{name}/autocorrelation"],
            dt=context.spec.dt, outputs=context.scenario.prior().outputs, mean_band=own.nis_band,
            correlation_band=own.correlation_band, title=OBSERVER_TITLES[name],
        )  # fmt: skip
        caption = f"{OBSERVER_TITLES[name]}: innovations on test recordings."
        yield "estimation", f"innovations_{name}", figure, caption


def _timing(context: Context) -> Any:
    found = context.find(CONTROL)
    if not isinstance(found, Absent):
        caption = (
            "Duration of controller steps: estimation, optimization and monitoring, including Python calls."
        )
        yield "timing", "step_times", loops.solve_times(found.steps, 1e3 * context.spec.dt), caption


def _watch(context: Context) -> Any:
    """The monitor over recordings, those with alarms first, and over loops with a fault."""
    found = context.find(WATCH)
    if isinstance(found, Absent) or found.limits is None:
        return
    outputs, limits = context.scenario.prior().outputs, found.limits
    names = [s.name for s in outputs]

    def drawn(name: str, **more: Any) -> Figure:
        trace = read_trace(found.arrays, name, found, names)
        return monitor.channels(trace, found.arrays[f"{name}/y"], outputs=outputs, limits=limits, **more)

    whole = {r.name: r for r in context.dataset.whole}
    for name in found.shown:
        windows = clean_windows(context, whole[name], ("train", "valid", "test", "nominal"))
        notes = [(a.start_s, a.diagnosis) for of, a in found.alarms if of == name and a.diagnosis]
        figure = drawn(name, windows=windows, notes=notes, title=name)
        caption = f"The monitor over the whole recording {name}."
        yield "watch", f"monitor_{name.replace('#', '-')}", figure, caption
    for row in found.faults or ():
        marks = [(row.start_s, row.title), *((s.t_s, f"guard: {s.after.lower()}") for s in row.switches)]
        seen = "no alarm" if row.delay_s is None else f"alarm after {row.delay_s:.2g} s"
        cause = f"; the diagnosis: {row.diagnosis}" if row.diagnosis else ""
        figure = drawn(row.fault, marks=marks, title=f"{row.task}: {row.title} at {row.start_s:g} s")
        yield "watch", f"fault_{row.fault}", figure, f"{row.title[0].upper()}{row.title[1:]}: {seen}{cause}."


def _analysis(context: Context) -> Any:
    found = context.find(ANALYSIS)
    if isinstance(found, Absent):
        return
    arrays = found.arrays
    poles = {n: [mode.pole for mode in found.models[n].points["rest"]] for n in ("prior", "hybrid")}
    figure = analysis.pole_map(poles, context.spec.dt)
    yield "analysis", "poles", figure, "Poles of the one-step maps at rest."
    prior = context.scenario.prior()
    friction = ", where the slope of dry friction dominates" if prior.kinematics else ""
    titles = {"rest": f"at rest{friction}", "moving": "at working speed"}
    for point in ("rest", "moving"):
        if any(point not in found.models[n].points for n in poles):
            continue  # a network that corrects every rate leaves no signal that is exactly a speed
        responses = {
            n: (arrays[f"{n}/{point}/omega"], arrays[f"{n}/{point}/magnitude"], arrays[f"{n}/{point}/phase"])
            for n in poles
        }
        for named, channel, figure in analysis.bodes(responses, prior.inputs, prior.outputs, context.spec.dt):
            caption = f"Bode plot of prior and hybrid {titles[point]}{channel}."
            yield "analysis", f"bode_{point}{named}", figure, caption
