"""Figures of the identification: training curves, free runs, errors by model, parity of the export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    FAINT,
    INK,
    Array,
    axis_label,
    checked,
    colour,
    finish_column,
    line_style,
    name_of,
    new_column,
    new_figure,
    number,
    plain_log,
    plot_inputs,
    shared_legend,
    title_axes,
)

METRICS: Mapping[str, str] = {
    "e_sim_s": "simulation error $E_{sim}$ [s]",
    "rmse_rad": "free-run RMSE [unit of the output]",
    "energy_violation_w": "mean violation [W]",
}
"""Axis labels by metric; a caller that knows the output puts its unit into that of the RMSE."""
ENERGY = "mopgrnn"
"""The model whose energy balance is drawn."""
SHOWN = 20.0
"""Length [s] of a benchmark's run that is drawn sample by sample; the rest is in the errors' course."""
COURSE = 200
"""Points of the course of the errors over the whole run."""


def free_run(
    t: Array,
    x: Array,
    predictions: Mapping[str, Array],
    u: Array,
    *,
    states: Sequence[Signal],
    inputs: Sequence[Signal],
    energy_measured: Array,
    energy_model: Array,
    title: str = "",
    band: Mapping[str, tuple[Array, Array]] | None = None,
) -> Figure:
    """A free run and the measurement, with the energy balances (the paper's Fig. 6).

    Args:
        t: Times ``(n,)`` [s].
        x: Measured (smoothed) states ``(n, n_x)``.
        predictions: States ``(n, n_x)`` of each model's free run; NaN during the warm-up.
        u: Inputs ``(n, n_u)``, held between samples.
        states: Signals of ``x``.
        inputs: Signals of ``u``.
        energy_measured: Energy balance of the measured system, ``(n,)`` [W].
        energy_model: Energy balance of the MOPGRNN, ``(n,)`` [W].
        title: Title. Default: none.
        band: Lower and upper end ``(n,)`` of the hybrid's band by the name of a state. Default: none.

    Raises:
        InputError: If shapes do not fit.

    Example:
        >>> t, x, u, power = np.array([0.0, 0.1]), np.zeros((2, 2)), np.zeros((2, 1)), np.zeros(2)
        >>> states, inputs = (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),)
        >>> figure = free_run(t, x, {"mopgrnn": x}, u, states=states, inputs=inputs,
        ...                   energy_measured=power, energy_model=power)
        >>> len(figure.axes)
        5
    """
    t = np.asarray(t, dtype=float)
    balances = [checked("energy balance", e, len(t)) for e in (energy_measured, energy_model)]
    gap = np.abs(balances[1] - balances[0])
    heights = [1.6] * len(states) + [0.9] * len(inputs) + [1.2, 0.9]
    figure, panels = new_column(heights, title=title)
    _states(panels, t, x, predictions, states)
    for ax, signal in zip(panels, states, strict=False):
        if band and signal.name in band:
            low, high = (checked("band", end, len(t)) for end in band[signal.name])
            limits = ax.get_ylim()
            ax.fill_between(t, low, high, color=colour(ENERGY), alpha=0.2, linewidth=0, label="90 % band")
            ax.set_ylim(limits)
    plot_inputs(panels[len(states) : -2], t, checked("u", u, len(t), len(inputs)), inputs)
    panels[-2].plot(t, balances[0], **(line_style("measured") | {"linewidth": 1.0}))
    panels[-2].plot(t, balances[1], **line_style(ENERGY))
    panels[-2].set_ylabel("balance\n" r"$\Delta E$ [W]")
    panels[-1].fill_between(t, gap, color=colour(ENERGY), alpha=0.35, linewidth=0)
    panels[-1].plot(t, gap, color=colour(ENERGY), linewidth=0.8)
    panels[-1].set_ylabel("violation\n" r"$\Delta$ [W]")
    finish_column(figure, panels, columns=6)
    return figure


def _states(
    panels: Sequence[Axes], t: Array, x: Array, predictions: Mapping[str, Array], states: Sequence[Signal]
) -> None:
    measured = checked("x", x, len(t), len(states))
    runs = {m: checked(f"free run of {m}", values, len(t), len(states)) for m, values in predictions.items()}
    for i, (ax, signal) in enumerate(zip(panels, states, strict=False)):
        ax.plot(t, measured[:, i], **(line_style("measured") | {"linewidth": 2.2, "alpha": 0.85}))
        for model, run in runs.items():
            ax.plot(t, run[:, i], **line_style(model))
        low, high = measured[:, i].min(), measured[:, i].max()
        room = 0.6 * max(high - low, 1e-9)  # a model that runs away must not flatten the others
        bottom, top = ax.get_ylim()
        ax.set_ylim(max(bottom, low - room), min(top, high + room))
        ax.set_ylabel(axis_label(signal))


def errors_bar(
    errors: Mapping[str, Mapping[str, float | None]],
    *,
    spread: Mapping[str, Mapping[str, float]] | None = None,
    metrics: Mapping[str, str] = METRICS,
) -> Figure:
    """Errors of the models, one panel a metric, with the fitted prior as the line to beat.

    Args:
        errors: ``{model: {metric: value}}``; a missing value or None leaves a gap.
        spread: Standard deviation over the trained networks in the same form. Default: none drawn.
        metrics: Axis label with unit by metric name. Default: the three of ``results.json``.

    Returns:
        The figure. A bar far above all others is cut and marked; its number stays.

    Raises:
        InputError: If no model has any of the metrics.

    Example:
        >>> len(errors_bar({"phy": {"e_sim_s": 0.2}, "mopgrnn": {"e_sim_s": 0.1}}).axes)
        1
    """
    shown = [m for m in metrics if any(values.get(m) is not None for values in errors.values())]
    if not shown:
        raise InputError(f"plot of the errors: no model has any of {', '.join(metrics)}")
    figure, axes = new_figure(1, len(shown), size=(max(5.0, 3.4 * len(shown)), 4.2))
    line = f"{name_of('phy')}: the line to beat"
    for ax, metric in zip(axes[0], shown, strict=True):
        found = {model: v.get(metric) for model, v in errors.items()}
        values = {model: value for model, value in found.items() if value is not None}
        bars = {model: (spread or {}).get(model, {}).get(metric, 0.0) for model in values}
        _bars(ax, values, bars)
        if "phy" in values:
            ax.axhline(values["phy"], color=colour("phy"), linestyle="--", lw=1.1, zorder=4, label=line)
        ax.set_ylabel(metrics[metric])
        ax.set_xticks([])
        ax.grid(False, axis="x")
    shared_legend(figure, columns=6)
    return figure


def _bars(ax: Axes, values: Mapping[str, float], spread: Mapping[str, float]) -> None:
    ordered = sorted(values.values())
    second = ordered[-2] if len(ordered) > 1 else ordered[-1]
    cut = ordered[-1] > 3.0 * second > 0
    top = 1.25 * (1.6 * second if cut else max(v + spread[m] for m, v in values.items()))
    for i, (model, value) in enumerate(values.items()):
        height = min(value, 0.93 * top)
        error = spread[model] if spread[model] > 0 and value < top else None
        ax.bar(i, height, 0.72, color=colour(model), label=name_of(model), yerr=error, capsize=3)
        ax.annotate(
            number(value) + (" ▲" if height < value else ""),
            (i, height + (error or 0.0)),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8.5,
            color=INK,
            zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 0.6},
        )
    ax.set_ylim(0, top if top > 0 else 1.0)


def parity(errors: Mapping[str, Array], tolerances: Mapping[str, float]) -> Figure:
    """Differences between the trained and the exported model, as shares of all compared numbers.

    Args:
        errors: Absolute differences by what is compared, e.g. ``{"values": (m,), "Jacobians": (k,)}``.
        tolerances: Allowed difference by the same names; drawn as vertical lines.

    Returns:
        The figure. Exact agreement (0) is drawn at 1e-18, left of every float64 rounding error.

    Raises:
        InputError: If there is nothing to draw.

    Example:
        >>> len(parity({"values": np.array([0.0, 1e-16])}, {"values": 1e-12}).axes)
        1
    """
    if not errors:
        raise InputError("plot of the parity: there is no difference to draw")
    figure, axes = new_figure(1, 1, size=(8, 3.6))
    ax = axes[0, 0]
    palette = ("#0072B2", "#D55E00", "#009E73", "#E69F00")
    for (name, values), ink in zip(errors.items(), palette, strict=False):
        ordered = np.sort(np.maximum(np.abs(np.ravel(values)), 1e-18))
        share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
        ax.step(ordered, share, where="post", color=ink, linewidth=1.8, label=name)
        if name in tolerances:
            ax.axvline(tolerances[name], color=ink, linestyle="--", label=f"{name}, allowed")
    ax.set_xscale("log")
    ax.set_ylim(0, 103)
    ax.set_xlabel("absolute difference, trained against exported [SI]")
    ax.set_ylabel("share of numbers below [%]")
    title_axes(ax, "left of its dashed line: passed")
    ax.title.set_color(FAINT)
    shared_legend(figure)
    return figure


def benchmark_run(
    t: Array,
    y: Array,
    predictions: Mapping[str, Array],
    u: Array,
    *,
    output: Signal,
    inputs: Sequence[Signal],
    unit: str,
    scale: float,
    title: str = "",
    names: Mapping[str, str] | None = None,
) -> Figure:
    """A free run over a recording: output, errors, inputs, and the errors' course over the whole run.

    ``y`` and each model's run are ``(n,)``; ``scale`` errors of ``unit`` are an SI unit. ``names`` says how models are
    to be called in the legend, where not as everywhere. The first 20 s of a longer run are drawn; the last row has all
    of it.
    """
    t = np.asarray(t, dtype=float)
    y, u = checked("y", y, len(t)), checked("u", u, len(t), len(inputs))
    runs = {name: checked(f"free run of {name}", run, len(t)) for name, run in predictions.items()}
    heights = [1.8, 1.3, *[0.8] * len(inputs), 1.3]
    figure, axes = new_figure(
        len(heights), 1, heights=heights, title=title, size=(10, 0.8 + 1.3 * sum(heights))
    )
    column, near = list(axes[:, 0]), t <= t[0] + SHOWN
    column[0].plot(t[near], y[near], **(line_style("measured") | {"linewidth": 2.2, "alpha": 0.85}))
    room = 0.3 * max(float(np.ptp(y[near])), 1e-9)
    for name, run in runs.items():
        label = (names or {}).get(name, name_of(name))
        column[0].plot(t[near], run[near], **(line_style(name) | {"label": label}))
        column[1].plot(t[near], scale * (run - y)[near], color=colour(name), linewidth=1.0, label=label)
        at, course = _course(t, scale * (run - y))
        column[-1].plot(at, course, color=colour(name), linewidth=1.4)
    column[0].set_ylim(y[near].min() - room, y[near].max() + room)  # a model that runs away flattens no other
    worst = [float(np.abs(scale * (run - y)[near]).max()) for run in runs.values()]
    best = min((value for value in worst if np.isfinite(value)), default=0.0)
    if best > 0:
        column[1].set_ylim(-1.5 * best, 1.5 * best)
    column[-1].set_yscale("log")
    column[0].set_ylabel(axis_label(output))
    column[1].set_ylabel(f"error [{unit}]")
    column[-1].set_ylabel(f"RMS error [{unit}]")
    plot_inputs(column[2:-1], t[near], u[near], inputs)
    for ax, values in zip(column[2:-1], u[near].T, strict=True):
        size = max(float(np.abs(values).max()), 1e-9)
        if np.ptp(values) < 1e-6 * size:  # a constant input is drawn as one, not its rounding
            ax.set_ylim(float(values.mean()) - size, float(values.mean()) + size)
    for ax in column:
        ax.margins(x=0)
    column[-2].set_xlabel("time [s]")
    column[-1].set_xlabel("time [s], the whole run")
    figure.align_ylabels(column)
    shared_legend(figure, columns=6)
    return figure


def _course(t: Array, error: Array) -> tuple[Array, Array]:
    """Root mean square of the error over short parts of the run, at their middles."""
    parts = np.array_split(np.arange(len(t)), min(COURSE, max(1, len(t) // 5)))
    rms = np.array([np.sqrt(np.mean(error[part] ** 2)) for part in parts])
    return np.array([t[part].mean() for part in parts]), np.maximum(rms, 1e-12)


def curves(
    training: Mapping[str, Mapping[str, Any]],
    *,
    free_run_start: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
) -> Figure:
    """Training curves, a column a model: each objective with its never-rising bound, and the validation.

    Args:
        training: By model, arrays of equal length: ``step``, ``loss_`` and the name of an objective and, where the
            model has them, ``bound_`` and that name, and ``validation``. NaN where a value was not taken at a step.
        free_run_start: Step at which a model's training turns from teacher forcing to free runs.
        units: Units by objective, and that of the ``"validation"``. Default: none has one.

    Raises:
        InputError: If there is no model, ``step`` is missing, or lengths differ.

    Example:
        >>> data = {"step": [0, 1, 2], "loss_error": [3.0, 2.0, 1.0]}
        >>> len(curves({"rnn": data}).axes)
        2
    """
    if not training:
        raise InputError("plot of the training: there is no model to draw")
    every = dict.fromkeys(
        k.removeprefix("loss_") for data in training.values() for k in data if k.startswith("loss_")
    )
    rows = [(f"loss_{name}", f"bound_{name}", f"{name} objective", name) for name in every]
    rows.append(("validation", "", "validation", "validation"))
    figure, axes = new_figure(
        len(rows), len(training), sharex="col", sharey="row", size=(10, 2.2 * len(rows))
    )
    for column, (model, data) in zip(axes.T, training.items(), strict=True):
        if "step" not in data:
            raise InputError(f"plot of the training of {model}: no array 'step'; it has {', '.join(data)}")
        step = np.asarray(data["step"], dtype=float)
        for ax, (loss, bound, _, _) in zip(column, rows, strict=True):
            _curve(ax, model, step, data.get(loss), loss)
            if data.get(bound) is not None:
                values = checked(f"{bound} of {model}", data[bound], len(step))
                ax.plot(step, values, "k--", linewidth=1.2, drawstyle="steps-post", label="bound $c_j$")
            if free_run_start is not None and model in free_run_start:
                ax.axvline(free_run_start[model], color=FAINT, linestyle=":", label="free-run stage starts")
        title_axes(column[0], name_of(model))
        column[-1].set_xlabel("optimiser step [-]")
    for row, (_, _, label, name) in zip(axes, rows, strict=True):
        row[0].set_ylabel(f"{label} [{(units or {}).get(name, '-')}]")
        if any(ax.get_yscale() == "log" for ax in row):
            plain_log(row[0].yaxis, *row[0].get_ylim())
    figure.align_ylabels(list(axes[:, 0]))
    shared_legend(figure)
    return figure


def _curve(ax: Axes, model: str, step: Any, values: Any, name: str) -> None:
    if values is None:
        ax.text(0.25, 0.5, "not used", transform=ax.transAxes, ha="center", color=FAINT, fontsize=9)
        return
    array = checked(f"{name} of {model}", values, len(step))
    taken = np.isfinite(array) & (array > 0)
    marker = "o" if name == "validation" else ""
    ax.plot(step[taken], array[taken], color=colour(model), lw=1.1, marker=marker, ms=3)
    if taken.any():
        ax.set_yscale("log")
