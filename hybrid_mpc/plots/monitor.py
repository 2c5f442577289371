"""Figure of a monitor: its channels, thresholds and alarms over a recording or loop."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
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
    from hybrid_mpc.watch.detector import WatchLimits
    from hybrid_mpc.watch.replay import Trace

LEVEL = COLOURS["hybrid"]
AVERAGES = (("short average", PALE, ":"), ("long average", LEVEL, "--"))
"""Label, colour and line style of a channel's moving averages, the shortest first."""
NOTES, WIDTH = 6, 130
"""Maximum notes below a title, and characters of a line."""
LINEAR = 2.0
"""Ratio to a threshold up to which its axis is linear."""


def channels(
    trace: Trace,
    y: Array,
    *,
    outputs: Sequence[Signal],
    limits: WatchLimits | None = None,
    windows: Sequence[tuple[float, float]] = (),
    notes: Sequence[tuple[float, str]] = (),
    marks: Sequence[tuple[float, str]] = (),
    title: str = "",
) -> Figure:
    """Channels of a monitor over a recording, the largest ratio to a threshold, and the measured outputs.

    A channel with thresholds for moving averages shows these averages and thresholds; any other channel shows its
    values. A channel's alarms are shaded in its own panel. All alarms are shaded in the last panels.

    Args:
        trace: Result of :func:`hybrid_mpc.watch.replay.replay`.
        y: Measured outputs ``(n, n_y)``.
        outputs: Signals of ``y``.
        limits: Thresholds of the channels. Default: none drawn.
        windows: Stretches [s] known to be undisturbed, drawn as bars. Default: none.
        notes: Times [s] and texts, such as a diagnosis; listed below the title. Default: none.
        marks: Times [s] and labels of vertical lines. Default: none.
        title: Title. Default: none.

    Returns:
        The figure.

    Raises:
        InputError: If lengths differ.

    Example:
        ``channels(replay(monitor, observer, recording), recording.y, outputs=model.outputs, limits=monitor.limits)``
    """
    t, n = trace.t, len(trace.channels)
    measured = checked("y", y, len(t), len(outputs))
    scored = bool(trace.levels.size)
    figure, panels = new_column([1.0] * (n + scored + len(outputs)), height=1.6)
    for i, (ax, channel) in enumerate(zip(panels, trace.channels, strict=False)):
        own = (
            []
            if limits is None
            else [k for k, one in enumerate(limits.channels) if one.channel == channel.name]
        )
        means = [k for k in own if limits is not None and limits.channels[k].length > 1]
        if not means:
            ax.plot(t, trace.values[:, i], color=LEVEL, linewidth=1.0)
        for k, (label, ink, dash) in zip(means, AVERAGES, strict=False):
            assert limits is not None
            ax.plot(t, trace.levels[:, k], color=ink, linewidth=1.2, label=label)
            if np.isfinite(top := limits.channels[k].threshold):
                style: Any = {"color": INK, "linestyle": dash, "linewidth": 0.9}
                ax.axhline(top, label=f"threshold, {label}", **style)
                ax.axhline(-top, **style)
        ax.axhline(0.0, color=INK, linewidth=0.4)
        kind, _, of = channel.name.rpartition(" of ")
        ax.set_ylabel(
            plain(f"{kind} of\n{of} [{channel.unit}]" if kind else f"{channel.name}\n[{channel.unit}]")
        )
        _shade(ax, intervals(t, trace.on[:, i]), "alarm of the channel", color=ALARM, alpha=0.3)
    if scored:
        _scores(panels[n], trace)
    for ax, values, signal, frozen in zip(
        panels[-len(outputs) :], measured.T, outputs, trace.frozen.T, strict=True
    ):
        ax.plot(t, values, color=INK, linewidth=1.0, label="measured")
        ax.set_ylabel(axis_label(signal))
        _shade(ax, intervals(t, frozen), "sensor frozen", color=INK, ymax=0.05)
    for ax in panels[n:]:
        _shade(ax, intervals(t, trace.alarm), "alarm", color=ALARM, alpha=0.3)
    for ax in panels:
        _shade(ax, windows, "undisturbed", color=GOOD, ymax=0.035, zorder=4)
        for (time, _), style in zip(marks, cycle(("-", ":", "-.")), strict=False):
            ax.axvline(time, color=INK, linestyle=style, linewidth=1.2)
    _marks(panels[-1], marks, 0.5 * float(t[0] + t[-1]))
    _write_head(panels[0], title, notes)
    finish_column(figure, panels)
    return figure


def _write_head(ax: Axes, title: str, notes: Sequence[tuple[float, str]]) -> None:
    """Write the title, below it the notes (too long for a panel), and each note's number at its time."""
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


def _scores(ax: Axes, trace: Trace) -> None:
    """Draw the largest ratio to a threshold, linear up to ``LINEAR`` and logarithmic beyond."""
    ax.plot(trace.t, trace.share, color=LEVEL, linewidth=1.2)
    ax.axhline(1.0, color="black", linestyle="--", linewidth=1.2, label="threshold")
    if np.any(trace.share > LINEAR):  # below, the ticks of a symlog axis are only its ends, e.g. 1.12068
        ax.set_yscale("symlog", linthresh=LINEAR, linscale=2.0)
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel("share of\nthreshold [-]")


def _marks(ax: Axes, marks: Sequence[tuple[float, str]], middle: float) -> None:
    """Write the labels of the vertical lines one below the other, on the side with more room."""
    for i, (time, text) in enumerate(marks):
        side = 1 if time < middle - 1e-9 else -1
        ax.annotate(
            plain(text), (time, 0.96), xycoords=("data", "axes fraction"), xytext=(4 * side, -12 * i), va="top",
            textcoords="offset points", ha="left" if side > 0 else "right", fontsize=8, color=INK,
        )  # fmt: skip
