"""Figures of the reproduced experiments: errors over the amount of training data (Fig. 3, 5), a free run (Fig. 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    INK,
    axis_label,
    checked,
    colour,
    new_figure,
    plain_log,
    shared_legend,
    title_axes,
)

LOOKS: Mapping[str, tuple[str, str, str, str]] = {
    "phy_nominal": ("#7f7f7f", "--", "", "prior, nominal"),
    "phy": ("#0072B2", "-", "", "prior (phy)"),
    "rnn": ("#E69F00", "-", "s", "RNN"),
    "pgrnn": ("#009E73", "-", "^", "PGRNN"),
    "mopgrnn": ("#D55E00", "-", "o", "MOPGRNN"),
    "hybrid": ("#CC79A7", "-", "D", "MOPGRNN, trained on free runs too"),
    "sindy": ("#56B4E9", ":", "v", "SINDY with control"),
}
"""Colour, dashes, marker and name of each model."""
DODGE = 0.16
"""Distance [sequences] between the markers of two models."""


def errors_over_sequences(panels: Mapping[str, Mapping[str, Mapping[str, Any]]], label: str) -> Figure:
    """An error over the number of training sequences, linear as in the paper and logarithmic, a column a data set.

    By title and model: ``sequences``, ``mean`` (NaN if all networks diverged), ``std``, ``diverged`` and
    ``networks``, one entry an amount of data. The linear axis ends where all but the nominal prior do.
    """
    if not panels or not all(panels.values()):
        raise InputError("plot of errors: there is no data set, or one without a model [HM-SCENARIOS-020]")
    figure, axes = new_figure(2, len(panels), sharex=True, sharey="row", size=(4.2 + 3.4 * len(panels), 6.4))
    tops, lows = [], []
    for column, (title, curves) in zip(axes.T, panels.items(), strict=True):
        title_axes(column[0], title)
        for ax in column:
            for i, (model, curve) in enumerate(curves.items()):
                _curve(ax, model, curve, DODGE * (i - len(curves) / 2), upper=ax is column[0])
        column[1].set_yscale("log")
        column[1].set_xlabel("training sequences [-]")
        column[1].set_xticks(sorted({n for curve in curves.values() for n in curve["sequences"]}))
        for model, curve in curves.items():
            mean, std = np.asarray(curve["mean"], float), np.asarray(curve["std"], float)
            mean, std = mean[np.isfinite(mean)], std[np.isfinite(mean)]
            if len(mean) and (model != "phy_nominal" or len(curves) == 1):
                tops.append(float((mean + std).max()))
            if len(mean) and mean.min() > 0:
                lows.append(float(mean.min()))
    if tops:
        axes[0, 0].set_ylim(0.0, 1.08 * max(tops))
    if lows:
        axes[1, 0].set_ylim(0.7 * min(lows), None)
        plain_log(axes[1, 0].yaxis, *axes[1, 0].get_ylim())
    for row in axes:
        row[0].set_ylabel(label)
    figure.align_ylabels(list(axes[:, 0]))
    shared_legend(figure, columns=4)
    return figure


def _curve(ax: Axes, model: str, curve: Mapping[str, Any], shift: float, *, upper: bool) -> None:
    """Means with standard deviations; how many networks diverged stands next to them in the upper row."""
    tint, dashes, marker, name = LOOKS.get(model, (colour(model), "-", "o", model))
    n = len(curve["sequences"])
    x = np.asarray(curve["sequences"], float) + (shift if marker else 0.0)
    mean, std = checked(f"mean of {model}", curve["mean"], n), checked(f"std of {model}", curve["std"], n)
    ax.plot(x, mean, color=tint, linestyle=dashes, marker=marker, markersize=4, linewidth=1.3, label=name)
    bars = (std > 0) & np.isfinite(mean)
    if bars.any():
        low = np.minimum(std, 0.8 * mean)  # a logarithmic axis has no zero
        spread = [low[bars], std[bars]]
        ax.errorbar(x[bars], mean[bars], yerr=spread, fmt="none", ecolor=tint, elinewidth=1.0, capsize=2.5)
    for k in np.flatnonzero(np.asarray(curve["diverged"])) if upper else ():
        text = f"{curve['diverged'][k]} of {curve['networks'][k]} diverged"
        known = bool(np.isfinite(mean[k]))
        ax.annotate(
            text,
            (x[k], mean[k] if known else 0.97),
            xycoords="data" if known else ("data", "axes fraction"),
            xytext=(3, 4 if known else 0),
            textcoords="offset points",
            fontsize=7,
            color=tint,
            rotation=90,
            va="bottom" if known else "top",
        )


def shown_free_run(
    runs: Mapping[str, Mapping[str, Any]],
    states: Sequence[Signal],
    inputs: Sequence[Signal],
    *,
    model: str = "mopgrnn",
    title: str = "",
) -> Figure:
    """A test free run with input, energy balances and violation (the paper's Fig. 6, whose joules are watts)."""
    if model not in runs:
        raise InputError(
            f"plot of a free run: there is none of {model}; there are: {', '.join(runs)} [HM-SCENARIOS-021]"
        )
    own = runs[model]
    t, rows = np.asarray(own["t"], float), len(states) + len(inputs) + 1
    figure, axes = new_figure(rows, 1, sharex=True, title=title, size=(10, 2.0 * rows))
    column = axes[:, 0]
    measured = checked("x", own["x"], len(t), len(states))
    for i, (ax, signal) in enumerate(zip(column, states, strict=False)):
        ax.plot(t, measured[:, i], color="#000000", linewidth=2.2, alpha=0.85, label="measured")
        for name, run in runs.items():
            tint, dashes, _, words = LOOKS.get(name, (colour(name), "-", "", name))
            x_hat = checked(f"free run of {name}", run["x_hat"], len(t), len(states))[:, i]
            ax.plot(t, x_hat, color=tint, linestyle=dashes, linewidth=1.3, label=words)
        # one that runs away must not flatten the rest
        reach = 1.6 * max(float(np.abs(measured[:, i]).max()), 1e-9)
        bottom, top = ax.get_ylim()
        ax.set_ylim(max(bottom, -reach), min(top, reach))
        ax.set_ylabel(axis_label(signal))
    for i, (ax, signal) in enumerate(zip(column[len(states) :], inputs, strict=False)):
        u = checked("u", own["u"], len(t), len(inputs))[:, i]
        ax.plot(t, u, color=INK, linewidth=1.0, drawstyle="steps-post")
        ax.set_ylabel(axis_label(signal))
    _balances(column[-1], t, own, model)
    column[-1].set_xlabel("time [s]")
    for ax in column:
        ax.margins(x=0)
    figure.align_ylabels(list(column))
    shared_legend(figure, columns=6)
    return figure


def _balances(ax: Axes, t: Any, run: Mapping[str, Any], model: str) -> None:
    """Energy balances of the measured system and of the model, and their distance."""
    of_system, of_model = (
        checked("energy balance", run[key][:, 0], len(t)) for key in ("balances", "balances_hat")
    )
    tint, _, _, name = LOOKS.get(model, (colour(model), "-", "", model))
    ax.plot(t, of_system, color="#000000", linewidth=1.0, label=r"$\Delta E_S$, measured")
    ax.plot(t, of_model, color=tint, linewidth=1.0, label=rf"$\Delta E_M$, {name}")
    ax.fill_between(
        t, np.abs(of_model - of_system), color="#56B4E9", alpha=0.6, lw=0, label=r"violation $\Delta$"
    )
    ax.set_ylabel("power [W]")
