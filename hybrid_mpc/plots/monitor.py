"""Figures of the energy monitor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.plots.style import (
    ALARM,
    COLOURS,
    INK,
    Array,
    axis_label,
    checked,
    new_figure,
    plain,
    shared_legend,
    title_axes,
)
from hybrid_mpc.signals import Signal

_CLEAN = "#009E73"


def trace(
    t: Array,
    violation: Array,
    level: Array,
    threshold: float,
    alarm: Any,
    y: Array,
    *,
    output: Signal,
    windows: Sequence[tuple[float, float]] = (),
    residual: tuple[Array, float, str] | None = None,
    title: str = "",
) -> Figure:
    """The monitor over a whole recording: violation, residual force, alarms, and the position beneath.

    Args:
        t: Times ``(n,)`` [s].
        violation: Violation of the energy balance, ``(n,)`` [W].
        level: What is compared with the threshold (the averaged violation), ``(n,)`` [W]; NaN where
            the monitor does not judge yet.
        threshold: Alarm threshold [W].
        alarm: True where the monitor alarms, ``(n,)``.
        y: Measured position, ``(n,)``.
        output: Signal of ``y``.
        windows: Start and end [s] of the stretches known to be clean. Default: none.
        residual: Level of the residual force ``(n,)``, its threshold and its unit. Default: no such row.
        title: Title. Default: none.

    Returns:
        The figure.

    Raises:
        InputError: If lengths differ.

    Example:
        >>> t, zero = np.array([0.0, 0.1]), np.zeros(2)
        >>> figure = trace(t, zero, zero, 0.1, [False, False], zero, output=Signal("phi", "rad"))
        >>> len(figure.axes)
        2
    """
    t = np.asarray(t, dtype=float)
    raw, averaged = checked("violation", violation, len(t)), checked("level", level, len(t))
    position, active = checked("y", y, len(t)), checked("alarm", alarm, len(t)) > 0.5
    heights = (1.5, 1.0) if residual is None else (1.5, 1.0, 1.0)
    figure, axes = new_figure(len(heights), 1, sharex=True, heights=heights, size=(10, 2.6 * len(heights)))
    top, bottom = axes[0, 0], axes[-1, 0]
    top.plot(t, raw, color="#9a9a9a", linewidth=0.7, label="violation")
    top.plot(t, averaged, color=COLOURS["hybrid"], linewidth=1.4, label="level (averaged)")
    top.axhline(threshold, color="black", linestyle="--", linewidth=1.2, label="threshold")
    top.set_ylabel(r"violation $\Delta$ [W]")
    positive = raw[np.isfinite(raw) & (raw > 0)]
    if len(positive) and positive.max() > 30 * threshold:
        top.set_yscale("log")
        top.set_ylim(bottom=max(positive.min(), 1e-3 * threshold))
    if residual is not None:
        force, limit, unit = residual
        axes[1, 0].plot(t, checked("residual", force, len(t)), color=COLOURS["hybrid"], linewidth=1.4)
        axes[1, 0].axhline(limit, color="black", linestyle="--", linewidth=1.2)
        axes[1, 0].set_ylabel(f"residual\n[{unit}]")
    bottom.plot(t, position, color=INK, linewidth=1.0, label="measured")
    bottom.set_ylabel(axis_label(output))
    bottom.set_xlabel("time [s]")
    for ax in axes[:, 0]:
        for start, end in intervals(t, active):
            ax.axvspan(start, end, color=ALARM, alpha=0.35, linewidth=0, label="alarm")
        for start, end in windows:
            ax.axvspan(
                start, end, ymin=0.0, ymax=0.035, color=_CLEAN, linewidth=0, label="clean window", zorder=4
            )
        ax.set_xlim(t[0], t[-1])
    if title:
        title_axes(top, plain(title))
    shared_legend(figure)
    return figure


def intervals(t: Array, active: Any) -> list[tuple[float, float]]:
    """Start and end [s] of the stretches in which ``active`` ``(n,)`` is true.

    An interval ends at the first sample that is false again, or at the last sample.

    Example:
        >>> intervals(np.array([0.0, 1.0, 2.0, 3.0]), [False, True, True, False])
        [(1.0, 3.0)]
    """
    edges = np.diff(np.concatenate([[0], np.asarray(active, dtype=int), [0]]))
    starts = np.flatnonzero(edges == 1)
    ends = np.minimum(np.flatnonzero(edges == -1), len(t) - 1)
    return [(float(a), float(b)) for a, b in zip(t[starts], t[ends], strict=True)]
