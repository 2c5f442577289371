"""Everything the energy monitor says of a recording, one above the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from hybrid_mpc.monitor.replay import MonitorTrace
from hybrid_mpc.plots.monitor import intervals
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
