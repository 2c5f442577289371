"""Everything the energy monitor says of a recording, one above the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.monitor.replay import MonitorTrace
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

# Figures of the energy monitor.

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


_RAW = "#9a9a9a"
_FORCES, _POWER = COLOURS["hybrid"], COLOURS["prior"]


def overview(
    trace: MonitorTrace,
    y: Array,
    *,
    output: Signal,
    force_unit: str = "N m",
    thresholds: Mapping[str, float] | None = None,
    notes: Sequence[tuple[float, str]] = (),
    marks: Sequence[tuple[float, str]] = (),
    title: str = "",
) -> Figure:
    """Violation, residual force, energy of the free runs, scores, position; alarms shaded throughout.

    Args:
        trace: What :func:`hybrid_mpc.monitor.replay` returned.
        y: Measured position ``(n,)``.
        output: Its signal.
        force_unit: Unit of the residual force.
        thresholds: ``"violation"`` [W] and ``"residual"``, where the monitor has them. Default: none.
        notes: Times [s] and what to write there, e.g. what a diagnosis says. Default: none.
        marks: Times [s] of vertical lines, and what is written beside them. Default: none.
        title: Title. Default: none.

    Returns:
        The figure. Rows without any value (no free runs, no detector) are left out.

    Raises:
        InputError: If lengths differ.

    Example:
        >>> t, zero = np.array([0.0, 0.1]), np.zeros(2)
        >>> trace = MonitorTrace(t, zero, zero, zero, zero, zero, zero > 0)
        >>> len(overview(trace, zero, output=Signal("phi", "rad")).axes)
        3
    """
    n, limits = len(trace.t), thresholds or {}
    position = checked("y", y, n)
    rows = ["violation", "residual"]
    rows += ["energy"] if np.isfinite(trace.energy_j).any() else []
    rows += ["scores"] if trace.scores.size else []
    rows.append("position")
    figure, axes = new_figure(len(rows), 1, sharex=True, size=(10, 1.9 * len(rows) + 0.6))
    by_name: dict[str, Axes] = dict(zip(rows, axes[:, 0], strict=True))
    _violation(by_name["violation"], trace, limits.get("violation"))
    by_name["residual"].plot(trace.t, trace.residual_level, color=_FORCES, linewidth=1.2)
    by_name["residual"].set_ylabel(f"residual\n[{force_unit}]")
    if "residual" in limits:
        by_name["residual"].axhline(limits["residual"], color="black", linestyle="--", linewidth=1.2)
    if "energy" in by_name:
        by_name["energy"].plot(trace.t, trace.energy_j, color=_POWER, linewidth=1.2)
        by_name["energy"].axhline(0.0, color=INK, linewidth=0.6)
        by_name["energy"].set_ylabel("energy of the\nfree run [J]")
    if "scores" in by_name:
        _scores(by_name["scores"], trace)
    by_name["position"].plot(trace.t, position, color=INK, linewidth=1.0, label="measured")
    by_name["position"].set_ylabel(axis_label(output))
    by_name["position"].set_xlabel("time [s]")
    for ax in by_name.values():
        for start, end in intervals(trace.t, trace.alarm):
            ax.axvspan(start, end, color=ALARM, alpha=0.3, linewidth=0, label="alarm")
        for start, end in intervals(trace.t, trace.frozen) if trace.frozen.size else ():
            ax.axvspan(start, end, ymax=0.05, color=INK, linewidth=0, label="sensor frozen")
        for (time, _), style in zip(marks, cycle(("-", ":", "-.")), strict=False):
            ax.axvline(time, color=INK, linestyle=style, linewidth=1.2)
        ax.set_xlim(trace.t[0], trace.t[-1])
    _marks(by_name["position"], marks, 0.5 * float(trace.t[0] + trace.t[-1]))
    for time, text in notes:
        by_name["violation"].annotate(
            plain(text), (time, 1.0), xycoords=("data", "axes fraction"), va="top", fontsize=8, color=INK
        )
    if title:
        title_axes(by_name["violation"], plain(title))
    shared_legend(figure)
    return figure


def _marks(ax: Axes, marks: Sequence[tuple[float, str]], middle: float) -> None:
    """What the vertical lines are, one below the other, on the side with more room."""
    for i, (time, text) in enumerate(marks):
        side = 1 if time < middle - 1e-9 else -1
        ax.annotate(
            plain(text), (time, 0.96), xycoords=("data", "axes fraction"), xytext=(4 * side, -12 * i), va="top",
            textcoords="offset points", ha="left" if side > 0 else "right", fontsize=8, color=INK,
        )  # fmt: skip


def _violation(ax: Axes, trace: MonitorTrace, threshold: float | None) -> None:
    ax.plot(trace.t, trace.violation_w, color=_RAW, linewidth=0.7, label="violation")
    ax.plot(trace.t, trace.level_w, color=_FORCES, linewidth=1.2, label="averaged")
    if threshold is not None:
        ax.axhline(threshold, color="black", linestyle="--", linewidth=1.2, label="threshold")
    ax.set_ylabel("violation\n" r"$\Delta$ [W]")


def _scores(ax: Axes, trace: MonitorTrace) -> None:
    """Shares of the thresholds, on a scale that shows what is far beyond them too."""
    for i, (name, colour) in enumerate((("sum of the forces", _FORCES), ("power of the free run", _POWER))):
        ax.plot(trace.t, trace.scores[:, i], color=colour, linewidth=1.2, label=name)
    ax.axhline(1.0, color="black", linestyle="--", linewidth=1.2, label="threshold")
    ax.set_yscale("symlog", linthresh=2.0, linscale=2.0)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel("share of\nthreshold [-]")
