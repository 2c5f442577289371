"""Figures of a search of settings: what was found when, and what the error is over each setting."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import FAINT, INK, new_figure, plain, plain_log, shared_legend

STATES: Mapping[str, tuple[str, str, str]] = {
    "complete": ("o", "#0072B2", "finished"),
    "pruned": ("x", "#E69F00", "pruned: the error at its end"),
    "diverged": ("v", "#CC79A7", "diverged (at the upper edge)"),
}
"""Marker, colour and legend of each state of a trial."""
LABEL = "validation E_sim, best network [-]"
Row = Mapping[str, Any]


def history(rows: Sequence[Row], *, base: float | None = None) -> Figure:
    """Validation error over the number of the trial, with the best so far.

    Args:
        rows: Trials: ``number``, ``state`` (``"complete"``, ``"pruned"``, ``"diverged"``), ``value``, ``values``.
        base: Validation error of the settings that the search started from. Default: not drawn.

    Raises:
        InputError: If there is no trial with a finite value.

    Example:
        >>> row = {"number": 0, "state": "complete", "value": 0.2, "values": {"hidden": 8}}
        >>> len(history([row]).axes)
        1
    """
    figure, axes = new_figure(1, 1)
    ax = axes[0, 0]
    _points(ax, rows, [float(row["number"]) for row in rows])
    done = [row for row in rows if row["state"] == "complete"]
    best = np.minimum.accumulate([row["value"] for row in done])
    ax.step(
        [row["number"] for row in done], best, color=INK, linewidth=1.2, where="post", label="best so far"
    )
    if base is not None:
        ax.axhline(base, color=FAINT, linestyle="--", linewidth=1.2, label="settings it started from")
    ax.set_xlabel("trial [-]")
    ax.set_ylabel(LABEL)
    ax.xaxis.get_major_locator().set_params(integer=True)
    shared_legend(figure)
    return figure


def settings(rows: Sequence[Row], names: Sequence[str]) -> Figure:
    """Validation error over each searched setting, one panel a setting.

    Args:
        rows: Trials as :func:`history` takes them.
        names: Searched settings.

    Raises:
        InputError: If there is no trial with a finite value, or no setting.

    Example:
        >>> row = {"number": 0, "state": "complete", "value": 0.2, "values": {"hidden": 8}}
        >>> len(settings([row], ["hidden"]).axes)
        1
    """
    if not names:
        raise InputError("plot of a search: no setting to draw; give the searched ones")
    figure, axes = new_figure(1, len(names), sharey=True)
    for ax, name in zip(axes[0], names, strict=True):
        at = [float(row["values"][name]) for row in rows]
        _points(ax, rows, at)
        ax.set_xscale("log")
        plain_log(ax.xaxis, min(at), max(at))
        unit = "hidden units z" if name == "hidden" else plain(name.replace("_", " "))
        ax.set_xlabel(f"{unit} [-]")
    axes[0, 0].set_ylabel(LABEL)
    shared_legend(figure)
    return figure


def _points(ax: Axes, rows: Sequence[Row], at: Sequence[float]) -> None:
    """One point a trial on a logarithmic axis; what is infinite lies at its upper edge."""
    finite = [row["value"] for row in rows if math.isfinite(row["value"]) and row["value"] > 0]
    if not finite:
        raise InputError("plot of a search: no trial has a finite validation error; there is nothing to draw")
    low, high = min(finite) / 1.08, max(finite) * 1.08
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    plain_log(ax.yaxis, low, high)
    for state, (marker, colour, label) in STATES.items():
        points = [
            (x, min(row["value"], high)) for x, row in zip(at, rows, strict=True) if row["state"] == state
        ]
        if points:
            x, y = zip(*points, strict=True)
            ax.plot(x, y, marker, color=colour, label=label, clip_on=False, zorder=3)
