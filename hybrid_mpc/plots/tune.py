"""Figures of ``hybrid-mpc tune``: validation error over the trials, and over each setting."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import FAINT, INK, new_figure, plain, plain_log, shared_legend

STATES: Mapping[str, tuple[str, str, str]] = {
    "complete": ("o", "#0072B2", "finished"),
    "pruned": ("x", "#E69F00", "pruned: last error"),
    "diverged": ("v", "#CC79A7", "diverged (at the upper edge)"),
}
"""Marker, colour and legend of each state of a trial."""
LABEL = "validation E_sim, best network [-]"


def history(states: Sequence[str], values: Sequence[float], *, base: float | None = None) -> Figure:
    """Validation error over the number of the trial, with the best error so far.

    Args:
        states: State of each trial ``(n,)``, keys of :data:`STATES`.
        values: Validation errors ``(n,)``; infinite where the training diverged.
        base: Validation error of the initial settings. Default: not drawn.
    """
    figure, axes = new_figure(1, 1)
    ax = axes[0, 0]
    _points(ax, range(len(values)), states, values)
    done = [number for number, state in enumerate(states) if state == "complete"]
    best = np.minimum.accumulate([values[number] for number in done])
    ax.step(done, best, color=INK, linewidth=1.2, where="post", label="best so far")
    if base is not None:
        ax.axhline(base, color=FAINT, linestyle="--", linewidth=1.2, label="initial settings")
    ax.set_xlabel("trial [-]")
    ax.set_ylabel(LABEL)
    ax.xaxis.get_major_locator().set_params(integer=True)
    shared_legend(figure)
    return figure


def settings(
    searched: Mapping[str, Sequence[float]], states: Sequence[str], values: Sequence[float]
) -> Figure:
    """Validation error over each ``searched`` setting ``(n,)``, one panel each; the rest as in :func:`history`."""
    if not searched:
        raise InputError(
            "plot of a search: no setting to draw; pass the names of searched settings [HM-PLOTS-034]"
        )
    figure, axes = new_figure(1, len(searched), sharey=True)
    for ax, (name, at) in zip(axes[0], searched.items(), strict=True):
        _points(ax, at, states, values)
        ax.set_xscale("log")
        plain_log(ax.xaxis, min(at), max(at))
        ax.set_xlabel(f"{'hidden units z' if name == 'hidden' else plain(name.replace('_', ' '))} [-]")
    axes[0, 0].set_ylabel(LABEL)
    shared_legend(figure)
    return figure


def _points(ax: Axes, at: Sequence[float], states: Sequence[str], values: Sequence[float]) -> None:
    """Draw one point for each trial on a logarithmic axis; an infinite value lies at the upper edge."""
    finite = [value for value in values if math.isfinite(value) and value > 0]
    if not finite:
        raise InputError(
            "plot of a search: no trial has a finite, positive validation error; there is nothing to draw"
            " [HM-PLOTS-035]"
        )
    low, high = min(finite) / 1.08, max(finite) * 1.08
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    plain_log(ax.yaxis, low, high)
    for state, (marker, ink, label) in STATES.items():
        points = [(x, min(v, high)) for x, s, v in zip(at, states, values, strict=True) if s == state]
        if points:
            ax.plot(*zip(*points, strict=True), marker, color=ink, label=label, clip_on=False, zorder=3)
