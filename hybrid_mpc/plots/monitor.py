"""Figures of the energy monitor: violation, residual force, scores and alarms over a recording or loop."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    ALARM,
    COLOURS,
    GOOD,
    INK,
    PALE,
    Array,
    axis_label,
    checked,
    finish_column,
    new_column,
    plain,
    title_axes,
)

if TYPE_CHECKING:
    from hybrid_mpc.monitor.replay import MonitorTrace
    from hybrid_mpc.monitor.residuals import ResidualTrace

LEVEL, POWER = COLOURS["hybrid"], COLOURS["prior"]
NOTES, WIDTH = 6, 130
"""Most notes that stand below a title, and characters of one line."""


def trace(
    t: Array,
    violation: Array,
    level: Array,
    threshold: float,
    alarm: Any,
    y: Array,
    *,
    outputs: Sequence[Signal],
    windows: Sequence[tuple[float, float]] = (),
    residual: tuple[Array, float, str] | None = None,
    title: str = "",
) -> Figure:
    """The monitor over a whole recording: violation, residual force, alarms, and the measured outputs beneath.

    ``y`` is ``(n, n_y)``, other arrays are ``(n,)``. ``level`` is what is compared with the threshold, the averaged
    violation [W]; NaN where the monitor has no valid reading. ``windows`` are stretches [s] known to be clean,
    ``residual`` is the level of the residual force, its threshold and its unit.
    """
    t = np.asarray(t, dtype=float)
    raw, averaged = checked("violation", violation, len(t)), checked("level", level, len(t))
    measured, active = checked("y", y, len(t), len(outputs)), checked("alarm", alarm, len(t)) > 0.5
    figure, panels = new_column([1.5] + [1.0] * ((residual is not None) + len(outputs)), height=2.6)
    _violation(panels[0], t, raw, averaged, threshold)
    positive = raw[np.isfinite(raw) & (raw > 0)]
    if len(positive) and positive.max() > 30 * threshold:
        panels[0].set_yscale("log")
        panels[0].set_ylim(bottom=max(positive.min(), 1e-3 * threshold))
    if residual is not None:
        force, limit, unit = residual
        _residual(panels[1], t, checked("residual", force, len(t)), limit, unit)
    _outputs(panels[-len(outputs) :], t, measured, outputs)
    for ax in panels:
        _shade(ax, intervals(t, active), "alarm", color=ALARM, alpha=0.35)
        _shade(ax, windows, "clean window", color=GOOD, ymax=0.035, zorder=4)
    if title:
        title_axes(panels[0], plain(title))
    finish_column(figure, panels)
    return figure


def overview(
    trace: MonitorTrace,
    y: Array,
    *,
    outputs: Sequence[Signal],
    force_unit: str,
    thresholds: Mapping[str, float] | None = None,
    notes: Sequence[tuple[float, str]] = (),
    marks: Sequence[tuple[float, str]] = (),
    title: str = "",
) -> Figure:
    """Violation, residual force, energy of the free runs, scores, measured outputs; alarms shaded throughout.

    Args:
        trace: What :func:`hybrid_mpc.monitor.replay` returned.
        y: Measured outputs ``(n, n_y)``.
        outputs: Their signals.
        force_unit: Unit of the residual force.
        thresholds: ``"violation"`` [W] and ``"residual"``, where the monitor has them. Default: none.
        notes: Times [s] and what to write there, e.g. a diagnosis. Default: none.
        marks: Times [s] of vertical lines, and what is written beside them. Default: none.
        title: Title. Default: none.

    Returns:
        The figure. Rows without any value (no free runs, no detector) are left out.

    Raises:
        InputError: If lengths differ.

    Example:
        >>> from hybrid_mpc.monitor.replay import MonitorTrace
        >>> t, zero = np.array([0.0, 0.1]), np.zeros(2)
        >>> trace = MonitorTrace(t, zero, zero, zero, zero, zero, zero > 0)
        >>> len(overview(trace, zero, outputs=[Signal("phi", "rad")], force_unit="J/rad").axes)
        3
    """
    t, limits = trace.t, thresholds or {}
    measured = checked("y", y, len(t), len(outputs))
    energy, scores = bool(np.isfinite(trace.energy_j).any()), bool(trace.scores.size)
    figure, panels = new_column([1.0] * (2 + energy + scores + len(outputs)), height=2.0)
    _violation(panels[0], t, trace.violation_w, trace.level_w, limits.get("violation"))
    _residual(panels[1], t, trace.residual_level, limits.get("residual"), force_unit)
    if energy:
        panels[2].plot(t, trace.energy_j, color=POWER, linewidth=1.2)
        panels[2].axhline(0.0, color=INK, linewidth=0.6)
        panels[2].set_ylabel("energy of the\nfree run [J]")
    if scores:
        _scores(panels[-len(outputs) - 1], trace)
    _outputs(panels[-len(outputs) :], t, measured, outputs)
    for ax in panels:
        _shade(ax, intervals(t, trace.alarm), "alarm", color=ALARM, alpha=0.3)
        _shade(
            ax, intervals(t, trace.frozen) if trace.frozen.size else (), "sensor frozen", color=INK, ymax=0.05
        )
        for (time, _), style in zip(marks, cycle(("-", ":", "-.")), strict=False):
            ax.axvline(time, color=INK, linestyle=style, linewidth=1.2)
    _marks(panels[-1], marks, 0.5 * float(t[0] + t[-1]))
    _headed(panels[0], title, notes)
    finish_column(figure, panels)
    return figure


def channels(
    trace: ResidualTrace,
    units: Sequence[str],
    thresholds: Sequence[tuple[float, float]] | None = None,
    *,
    notes: Sequence[tuple[float, str]] = (),
    title: str = "",
) -> Figure:
    """Levels of every residual over a recording, a panel each, with thresholds and alarms of the channel.

    Args:
        trace: What :func:`~hybrid_mpc.monitor.residuals.replay_residuals` returned.
        units: Unit of each channel.
        thresholds: Of the short and the long average of each channel. Default: none.
        notes: Times [s] and what to write there, e.g. a diagnosis. Default: none.
        title: Title. Default: none.

    Returns:
        The figure.

    Example:
        ``channels(replay_residuals(monitor, observer, recording), monitor.units, monitor.limits.threshold)``
    """
    t, n = trace.t, len(trace.channels)
    figure, panels = new_column([1.0] * n, height=1.4)
    for i, (ax, name, unit) in enumerate(zip(panels, trace.channels, units, strict=True)):
        for j, (label, ink) in enumerate((("short average", PALE), ("long average", LEVEL))):
            ax.plot(t, trace.level[:, i, j], color=ink, linewidth=1.2, label=label)
            limit = None if thresholds is None else thresholds[i][j]
            if limit is not None and np.isfinite(limit):
                style: Any = {"color": INK, "linestyle": ":" if j == 0 else "--", "linewidth": 0.9}
                ax.axhline(limit, label=f"threshold, {label}", **style)
                ax.axhline(-limit, **style)
        ax.axhline(0.0, color=INK, linewidth=0.4)
        kind, _, of = name.rpartition(" of ")
        ax.set_ylabel(plain(f"{kind} of\n{of} [{unit}]" if kind else f"{name}\n[{unit}]"))
        _shade(ax, intervals(t, trace.on[:, i]), "alarm of the channel", color=ALARM, alpha=0.3)
        frozen = trace.frozen[:, i] if i < len(trace.outputs) else np.zeros(len(t), dtype=bool)
        _shade(ax, intervals(t, frozen), "sensor frozen", color=INK, ymax=0.05)
    _headed(panels[0], title, notes)
    finish_column(figure, panels)
    return figure


def _headed(ax: Axes, title: str, notes: Sequence[tuple[float, str]]) -> None:
    """Title, and below it the notes, each with the number that marks its time: their texts are longer than a panel."""
    for number, (time, _) in enumerate(notes, 1):
        place: Any = {
            "xycoords": ("data", "axes fraction"),
            "ha": "center",
            "va": "top",
            "annotation_clip": True,
        }
        ax.annotate(str(number), (time, 1.0), fontsize=9, fontweight="bold", color=INK, **place)
    lines = [f"{number}: {text}" for number, (_, text) in enumerate(notes[:NOTES], 1)]
    lines += [f"and {len(notes) - NOTES} more"] * (len(notes) > NOTES)
    wrapped = [part for line in lines for part in textwrap.wrap(line, WIDTH, subsequent_indent="    ")]
    if title or wrapped:
        title_axes(ax, plain("\n".join([title] * bool(title) + wrapped)))


def intervals(t: Array, active: Any) -> list[tuple[float, float]]:
    """Start and end [s] of the stretches in which ``active`` ``(n,)`` is true.

    An interval ends at the first sample that is false again, or at the last sample.
    """
    edges = np.diff(np.concatenate([[0], np.asarray(active, dtype=int), [0]]))
    starts = np.flatnonzero(edges == 1)
    ends = np.minimum(np.flatnonzero(edges == -1), len(t) - 1)
    return [(float(a), float(b)) for a, b in zip(t[starts], t[ends], strict=True)]


def _shade(ax: Axes, spans: Sequence[tuple[float, float]], label: str, **style: Any) -> None:
    for start, end in spans:
        ax.axvspan(start, end, linewidth=0, label=label, **style)


def _limit(ax: Axes, value: float | None, label: str | None = None) -> None:
    if value is not None:
        ax.axhline(value, color="black", linestyle="--", linewidth=1.2, label=label)


def _violation(ax: Axes, t: Array, raw: Array, level: Array, threshold: float | None) -> None:
    ax.plot(t, raw, color=PALE, linewidth=0.7, label="violation")
    ax.plot(t, level, color=LEVEL, linewidth=1.4, label="level (averaged)")
    _limit(ax, threshold, "threshold")
    ax.set_ylabel("violation\n" r"$\Delta$ [W]")


def _residual(ax: Axes, t: Array, level: Array, threshold: float | None, unit: str) -> None:
    ax.plot(t, level, color=LEVEL, linewidth=1.4)
    _limit(ax, threshold)
    ax.set_ylabel(f"residual\n[{unit}]")


def _scores(ax: Axes, trace: MonitorTrace) -> None:
    """Shares of the thresholds, on a scale that shows what is far beyond them too."""
    for i, (name, ink) in enumerate((("sum of the forces", LEVEL), ("power of the free run", POWER))):
        ax.plot(trace.t, trace.scores[:, i], color=ink, linewidth=1.2, label=name)
    _limit(ax, 1.0, "threshold")
    ax.set_yscale("symlog", linthresh=2.0, linscale=2.0)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel("share of\nthreshold [-]")


def _outputs(panels: Sequence[Axes], t: Array, y: Array, outputs: Sequence[Signal]) -> None:
    for ax, values, signal in zip(panels, y.T, outputs, strict=True):
        ax.plot(t, values, color=INK, linewidth=1.0, label="measured")
        ax.set_ylabel(axis_label(signal))


def _marks(ax: Axes, marks: Sequence[tuple[float, str]], middle: float) -> None:
    """What the vertical lines are, one below the other, on the side with more room."""
    for i, (time, text) in enumerate(marks):
        side = 1 if time < middle - 1e-9 else -1
        ax.annotate(
            plain(text), (time, 0.96), xycoords=("data", "axes fraction"), xytext=(4 * side, -12 * i), va="top",
            textcoords="offset points", ha="left" if side > 0 else "right", fontsize=8, color=INK,
        )  # fmt: skip
