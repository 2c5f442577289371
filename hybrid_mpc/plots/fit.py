"""Figures of the identification: training curves, free runs, errors by model, parity of the export."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    FAINT,
    INK,
    MUTED,
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
    plain,
    plain_log,
    plot_inputs,
    shared_legend,
    title_axes,
)

ABREAST = 4
"""Maximum number of error panels side by side."""
COURSE = 200
"""Points of the RMS error over the whole run."""


@dataclass(frozen=True)
class BalanceRun:
    """A balance along a free run: name, unit of its rate, and residuals ``(n,)`` of measurement and model."""

    name: str
    unit: str
    measured: Array
    model: Array


def free_run(
    t: Array,
    measured: Array,
    predictions: Mapping[str, Array],
    u: Array,
    *,
    signals: Sequence[Signal],
    inputs: Sequence[Signal],
    balances: Sequence[BalanceRun] = (),
    hybrid: str = "mopgrnn",
    title: str = "",
    band: Mapping[str, tuple[Array, Array]] | None = None,
) -> Figure:
    """A free run and the measurement, the errors of prior and hybrid, and the balances (the paper's Fig. 6).

    Args:
        t: Times ``(n,)`` [s].
        measured: Measured (smoothed) states, then outputs that are not states, ``(n, n_s)``; NaN where not measured.
        predictions: The same signals of each model's free run; NaN during the warm-up.
        u: Inputs ``(n, n_u)``, held between samples.
        signals: Signals of ``measured``.
        inputs: Signals of ``u``.
        balances: Balances of the measured system and of the hybrid. Default: none.
        hybrid: The model whose balances and band are drawn. Default: the MOPGRNN.
        title: Title. Default: none.
        band: Lower and upper end ``(n,)`` of the hybrid's band by the name of a signal. Default: none.

    Raises:
        InputError: If shapes do not fit.

    Example:
        >>> t, x, u, power = np.array([0.0, 0.1]), np.zeros((2, 2)), np.zeros((2, 1)), np.zeros(2)
        >>> states, inputs = (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),)
        >>> energy = BalanceRun("energy", "W", power, power)
        >>> figure = free_run(t, x, {"mopgrnn": x}, u, signals=states, inputs=inputs, balances=[energy])
        >>> len(figure.axes)
        7
    """
    t, n, ink = np.asarray(t, dtype=float), len(signals), colour(hybrid)
    states = checked("measured", measured, len(t), n)
    runs = {model: checked(f"free run of {model}", run, len(t), n) for model, run in predictions.items()}
    heights = [1.6, 0.8] * n + [0.9] * len(inputs) + [1.2, 0.9] * len(balances)
    figure, panels = new_column(heights, title=title)
    below = panels[2 * n :]
    for i, (ax, under, signal) in enumerate(
        zip(panels[: 2 * n : 2], panels[1 : 2 * n : 2], signals, strict=True)
    ):
        ax.plot(t, states[:, i], **(line_style("measured") | {"linewidth": 2.2, "alpha": 0.85}))
        under.axhline(0.0, color=FAINT, linewidth=0.8)
        for model, run in runs.items():
            ax.plot(t, run[:, i], **line_style(model))
        for model in dict.fromkeys(("phy", hybrid)):
            if model in runs:
                under.plot(t, runs[model][:, i] - states[:, i], **(line_style(model) | {"linewidth": 1.0}))
        low, high = np.nanmin(states[:, i]), np.nanmax(states[:, i])
        room = 0.6 * max(high - low, 1e-9)  # so a diverging model does not flatten the others
        bottom, top = ax.get_ylim()
        limits = max(bottom, low - room), min(top, high + room)
        if band and signal.name in band:
            least, most = (checked("band", end, len(t)) for end in band[signal.name])
            ax.fill_between(t, least, most, color=ink, alpha=0.2, linewidth=0, label="90 % band")
        ax.set_ylim(limits)
        ax.set_ylabel(axis_label(signal))
        under.set_ylabel(f"error\n[{signal.unit}]")
    plot_inputs(below[: len(inputs)], t, checked("u", u, len(t), len(inputs)), inputs)
    below = below[len(inputs) :]
    for balance, above, under in zip(balances, below[::2], below[1::2], strict=True):
        name = plain(balance.name)
        one, other = (checked(f"balance {name}", e, len(t)) for e in (balance.measured, balance.model))
        above.plot(t, one, **(line_style("measured") | {"linewidth": 1.0}))
        above.plot(t, other, **line_style(hybrid))
        above.set_ylabel(f"{name},\nresidual [{balance.unit}]")
        gap = np.abs(other - one)
        under.fill_between(t, gap, color=ink, alpha=0.35, linewidth=0)
        under.plot(t, gap, color=ink, linewidth=0.8)
        under.set_ylabel(f"violation\n[{balance.unit}]")
    finish_column(figure, panels, columns=6)
    return figure


def input_correlations(
    lags: Array, found: Mapping[str, Mapping[tuple[str, str], tuple[Array, float]]]
) -> Figure:
    """Correlation of free-run errors with each earlier input, one panel for each pair of input and output.

    Args:
        lags: Lags ``(m,)`` [s] of the error behind the input.
        found: By model and ``(input, output)``: correlations ``(m,)``, and half the width of the band of independent
            signals.

    Example:
        >>> lags = np.arange(3) * 0.1
        >>> len(input_correlations(lags, {"phy": {("u", "y"): (np.zeros(3), 0.1)}}).axes)
        1
    """
    pairs = list(dict.fromkeys(pair for own in found.values() for pair in own))
    figure, panels = new_column([1.2] * len(pairs))
    for ax, pair in zip(panels, pairs, strict=True):
        ax.axhline(0.0, color=FAINT, linewidth=0.8)
        for model, own in found.items():
            rho, band = own[pair]
            ax.plot(lags, rho, **line_style(model))
            for edge in (-band, band):
                ax.axhline(edge, color=colour(model), linestyle=":", linewidth=1.0)
        ax.set_ylabel(f"{plain(pair[1])} error\nwith {plain(pair[0])} [-]")
        ax.set_ylim(-1.0, 1.0)
    finish_column(figure, panels)
    panels[-1].set_xlabel("lag of the error behind the input [s]")
    return figure


def errors_bar(
    errors: Mapping[str, Mapping[str, float | None]],
    metrics: Mapping[str, str],
    *,
    spread: Mapping[str, Mapping[str, float]] | None = None,
) -> Figure:
    """Errors of the models, one panel for each metric, with a line at the error of the fitted prior.

    Args:
        errors: ``{model: {metric: value}}``; a missing value or None leaves a gap.
        metrics: Axis label with unit by metric name.
        spread: Standard deviation over the trained networks, in the same form. Default: not drawn.

    Returns:
        The figure. A bar over three times as high as the next one is cut and marked; its number stays.

    Raises:
        InputError: If no model has any of the metrics.

    Example:
        >>> values = {"phy": {"level": 0.2}, "mopgrnn": {"level": 0.1}}
        >>> len(errors_bar(values, {"level": "RMSE of level [m]"}).axes)
        1
    """
    shown = [m for m in metrics if any(values.get(m) is not None for values in errors.values())]
    if not shown:
        raise InputError(f"plot of the errors: no model has any of {', '.join(metrics)} [HM-PLOTS-021]")
    columns = min(len(shown), ABREAST)
    rows = math.ceil(len(shown) / columns)
    figure, axes = new_figure(rows, columns, size=(max(5.0, 3.4 * columns), 0.6 + 3.6 * rows))
    line = f"error of the {name_of('phy')}"
    panels: list[Axes] = axes.ravel().tolist()
    for ax in panels[len(shown) :]:
        ax.set_visible(False)
    for ax, metric in zip(panels, shown, strict=False):
        found = {model: v.get(metric) for model, v in errors.items()}
        values = {model: value for model, value in found.items() if value is not None}
        bars = {model: (spread or {}).get(model, {}).get(metric, 0.0) for model in values}
        _bars(ax, values, bars)
        if "phy" in values:
            ax.axhline(values["phy"], color=colour("phy"), linestyle="--", lw=1.1, zorder=4, label=line)
        ax.set_ylabel(metrics[metric])
        ax.set_xticks([])
        ax.grid(False, axis="x")
    shared_legend(figure, columns=2 * columns)
    return figure


def _bars(ax: Axes, values: Mapping[str, float], spread: Mapping[str, float]) -> None:
    ordered = sorted(values.values())
    second = ordered[-2] if len(ordered) > 1 else ordered[-1]
    cut = ordered[-1] > 3.0 * second > 0
    top = 1.25 * (1.6 * second if cut else max(v + spread[m] for m, v in values.items()))
    for i, (model, value) in enumerate(values.items()):
        height = min(value, 0.93 * top)
        error = spread[model] if spread[model] > 0 and value < top else None
        look: dict[str, Any] = {"color": colour(model), "edgecolor": "white", "linewidth": 0.0}
        hatch = "///" if line_style(model)["linestyle"] == "--" else None
        ax.bar(i, height, 0.72, yerr=error, capsize=3, hatch=hatch, label=name_of(model), **look)
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
    """Distribution of the differences between the trained and the exported model.

    Args:
        errors: Absolute differences by quantity, e.g. ``{"values": (m,), "Jacobians": (k,)}``.
        tolerances: Allowed difference by the same names; drawn as vertical lines.

    Returns:
        The figure. A difference of zero is drawn at 1e-18, below every float64 rounding error.

    Raises:
        InputError: If there is nothing to draw.

    Example:
        >>> len(parity({"values": np.array([0.0, 1e-16])}, {"values": 1e-12}).axes)
        1
    """
    if not errors:
        raise InputError("plot of the parity: there is no difference to draw [HM-PLOTS-022]")
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
    title_axes(ax, "passed: the curve lies left of its dashed line")
    ax.title.set_color(MUTED)
    shared_legend(figure)
    return figure


def benchmark_run(
    t: Array,
    y: Array,
    predictions: Mapping[str, Array],
    u: Array,
    *,
    outputs: Sequence[Signal],
    inputs: Sequence[Signal],
    units: Sequence[tuple[str, float]] | None = None,
    shown: float = math.inf,
    title: str = "",
    names: Mapping[str, str] | None = None,
) -> Figure:
    """A free run over a recording: outputs, errors and inputs at its start, and the RMS error over the whole run.

    Args:
        t: Times ``(n,)`` [s].
        y: Measured outputs ``(n, n_y)``; NaN where a sample is missing.
        predictions: Outputs ``(n, n_y)`` of each model.
        u: Inputs ``(n, n_u)``, held between samples.
        outputs: Signals of ``y``.
        inputs: Signals of ``u``.
        units: Unit of each output's error, and the number of these units in one unit of the output. Default: the unit
            of the output, and 1.
        shown: Length [s] of the start that is drawn sample by sample. Default: the whole run.
        title: Title. Default: none.
        names: Names of models in the legend. Default: the common names.

    Raises:
        InputError: If shapes do not fit.
    """
    t, n_y = np.asarray(t, dtype=float), len(outputs)
    y, u = checked("y", y, len(t), n_y), checked("u", u, len(t), len(inputs))
    runs = {name: checked(f"free run of {name}", run, len(t), n_y) for name, run in predictions.items()}
    heights = [1.8, 1.3] * n_y + [0.8] * len(inputs) + [1.3] * n_y
    figure, axes = new_figure(
        len(heights), 1, heights=heights, title=title, size=(10, 0.8 + 1.3 * sum(heights))
    )
    column, near = list(axes[:, 0]), t <= t[0] + shown
    above, between, below = column[: 2 * n_y], column[2 * n_y : -n_y], column[-n_y:]
    for j, (signal, (unit, scale)) in enumerate(
        zip(outputs, units or [(s.unit, 1.0) for s in outputs], strict=True)
    ):
        name = axis_label(signal).rpartition(" [")[0]
        of_one = {model: run[:, j] for model, run in runs.items()}
        _output(above[2 * j : 2 * j + 2], below[j], t, y[:, j], of_one, near, scale, names or {})
        above[2 * j].set_ylabel(axis_label(signal))
        above[2 * j + 1].set_ylabel(f"error of\n{name} [{unit}]")
        below[j].set_ylabel(f"RMS error of\n{name} [{unit}]")
    plot_inputs(between, t[near], u[near], inputs)
    for ax, values in zip(between, u[near].T, strict=True):
        size = max(float(np.abs(values).max()), 1e-9)
        if (
            np.ptp(values) < 1e-6 * size
        ):  # a constant input is a flat line; do not zoom into its rounding errors
            ax.set_ylim(float(values.mean()) - size, float(values.mean()) + size)
    for ax in column:
        ax.margins(x=0)
    column[-n_y - 1].set_xlabel("time [s]")
    column[-1].set_xlabel("time [s], the whole run")
    figure.align_ylabels(column)
    shared_legend(figure, columns=6)
    return figure


def _output(
    above: Sequence[Axes],
    below: Axes,
    t: Array,
    y: Array,
    runs: Mapping[str, Array],
    near: NDArray[np.bool_],
    scale: float,
    names: Mapping[str, str],
) -> None:
    """Draw one output of a benchmark's run: signal and error at the start, and the RMS error over the whole run."""
    signal, error = above
    signal.plot(t[near], y[near], **(line_style("measured") | {"linewidth": 2.2, "alpha": 0.85}))
    for name, run in runs.items():
        label = names.get(name, name_of(name))
        style = line_style(name) | {"label": label}
        signal.plot(t[near], run[near], **style)
        error.plot(t[near], scale * (run - y)[near], **(style | {"linewidth": 1.0}))
        at, course = _course(t, scale * (run - y))
        below.plot(at, course, **(style | {"linewidth": 1.4}))
    low, high = np.nanmin(y[near]), np.nanmax(y[near])
    room = 0.3 * max(float(high - low), 1e-9)
    signal.set_ylim(low - room, high + room)  # so a diverging model does not flatten the others
    with np.errstate(over="ignore", invalid="ignore"):
        worst = [float(np.abs(scale * (run - y))[near & np.isfinite(y)].max()) for run in runs.values()]
    best = min((value for value in worst if np.isfinite(value)), default=0.0)
    if best > 0:
        error.set_ylim(-1.5 * best, 1.5 * best)
    below.set_yscale("log")


def _course(t: Array, error: Array) -> tuple[Array, Array]:
    """Mean times and root mean square of the error of up to ``COURSE`` equal parts of the run."""
    parts = np.array_split(np.arange(len(t)), min(COURSE, max(1, len(t) // 5)))
    with np.errstate(over="ignore", invalid="ignore"):
        rms = np.array([np.sqrt(np.nanmean(error[part] ** 2)) for part in parts])
    return np.array([t[part].mean() for part in parts]), np.maximum(rms, 1e-12)


def prediction(
    t: Array,
    measured: Array,
    runs: Mapping[str, tuple[Array, Array]],
    *,
    outputs: Sequence[Signal],
    model: str,
    title: str = "",
) -> Figure:
    """Predictions of a recording: every output with its prediction and band, and below it the residuals.

    Args:
        t: Times ``(n,)`` [s].
        measured: Measured outputs ``(n, n_y)``; NaN where a sample is missing.
        runs: By name: prediction and half width of its band, ``(n, n_y)`` each. The first has the model's colour, and
            only its band is drawn.
        outputs: Signals of the outputs.
        model: Name of the model.
        title: Title over all panels. Default: none.

    Example:
        >>> t = np.linspace(0.0, 1.0, 5)
        >>> y, level = t[:, None] ** 2, Signal("level", "m")
        >>> figure = prediction(t, y, {"free run": (y + 0.1, 0.2 + 0 * y)}, outputs=[level], model="hybrid")
        >>> len(figure.axes)
        2
    """
    n, n_y = len(t), len(outputs)
    y = checked("measured", measured, n, n_y)
    figure, panels = new_column([1.4, 0.9] * n_y, title=title)
    for j, signal in enumerate(outputs):
        top, bottom = panels[2 * j : 2 * j + 2]
        top.plot(t, y[:, j], color=INK, linewidth=1.0, label="measured")
        for k, (name, (hat, half)) in enumerate(runs.items()):
            values, width = (checked(name, part, n, n_y)[:, j] for part in (hat, half))
            shade = colour(model) if k == 0 else FAINT
            for ax, centre in ((top, values), (bottom, y[:, j] - values)):
                ax.plot(t, centre, color=shade, linewidth=1.2 if k == 0 else 0.9, label=name, zorder=3 - k)
            ends = (top, values - width, values + width), (bottom, -width, width)
            for ax, low, high in ends if k == 0 else ():
                ax.fill_between(
                    t, low, high, color=shade, alpha=0.18, linewidth=0, label=f"band of the {name}"
                )
        bottom.axhline(0.0, color=FAINT, linewidth=0.8)
        top.set_ylabel(axis_label(signal))
        bottom.set_ylabel(f"residual\n[{plain(signal.unit)}]")
    finish_column(figure, panels)
    return figure


def curves(
    training: Mapping[str, Mapping[str, Any]],
    *,
    free_run_start: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
) -> Figure:
    """Training curves, one column for each model: each objective with its bound (never rising), and the validation.

    Args:
        training: By model, arrays of equal length: ``step``, ``loss_NAME`` of each objective, and optionally
            ``bound_NAME`` and ``validation``. NaN at a step without a value.
        free_run_start: By model: step at which the training switches from teacher forcing to free runs.
        units: Units by objective, and that of ``"validation"``. Default: no units.

    Raises:
        InputError: If there is no model, ``step`` is missing, or lengths differ.

    Example:
        >>> data = {"step": [0, 1, 2], "loss_error": [3.0, 2.0, 1.0]}
        >>> len(curves({"rnn": data}).axes)
        2
    """
    if not training:
        raise InputError("plot of the training: there is no model to draw [HM-PLOTS-023]")
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
            raise InputError(
                f"plot of the training of {model}: no array 'step'; it has {', '.join(data)} [HM-PLOTS-024]"
            )
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
        ax.text(0.25, 0.5, "not used", transform=ax.transAxes, ha="center", color=MUTED, fontsize=9)
        return
    array = checked(f"{name} of {model}", values, len(step))
    taken = np.isfinite(array) & (array > 0)
    marker = "o" if name == "validation" else ""
    look = line_style(model) | {"linewidth": 1.1, "label": "_"}
    ax.plot(step[taken], array[taken], marker=marker, markersize=3, **look)
    if taken.any():
        ax.set_yscale("log")
