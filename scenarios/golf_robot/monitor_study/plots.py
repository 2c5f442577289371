"""Figures of detectors: how delays are distributed, and faults found against false alarms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import FAINT, INK, new_figure, plain, shared_legend, title_axes

COLUMNS = 3
LINES: Mapping[str, tuple[str, str, str]] = {
    "guard": ("guard (energy)", "#D55E00", "-"),
    "guard_or_innovation": ("guard or innovation", "#009E73", "-"),
    "level": ("one-step violation", "#E69F00", "--"),
    "innovation_chi2": ("innovation, chi-square", "#0072B2", "--"),
    "innovation_rms": ("innovation, rms", "#56B4E9", "--"),
}
"""Name, colour and dashes of each method."""


def method_name(method: str) -> str:
    """Human name of a method of detection; an unknown one stays as it is."""
    return LINES[method][0] if method in LINES else plain(method)


def delays(cases: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Share of faults detected within a delay, one panel for each fault; missed faults never count."""
    if not any(len(values) for row in cases.values() for values in row.values()):
        raise InputError("plot of delays: there is none [HM-SCENARIOS-014]")
    figure, panels = _panels(len(cases))
    for ax, (case, row) in zip(panels, cases.items(), strict=False):
        for method, values in row.items():
            finite = np.sort([d for d in values if math.isfinite(d)])
            if len(values):
                share = np.arange(1, len(finite) + 1) / len(values)
                times = np.concatenate([[1e-3], finite, [10.0]])
                shares = np.concatenate([[0.0], share, [share[-1] if len(finite) else 0.0]])
                ax.step(times, shares, where="post", **_line(method))
        ax.set_xscale("log")
        ax.set_xlim(0.015, 6.0)
        ax.set_ylim(-0.02, 1.02)
        ax.set_xticks([0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5], ["0.02", "", "0.1", "0.2", "0.5", "1", "2", "5"])
        ax.set_xticks([], minor=True)
        title_axes(ax, plain(case))
        ax.set_xlabel("delay in motion [s]")
        ax.set_ylabel("found [-]")
    shared_legend(figure, columns=5)
    return figure


def operating_curves(
    cases: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]], wanted: float
) -> Figure:
    """Share of faults found within a second against false alarms an hour, one panel a fault."""
    rates = [r for row in cases.values() for per_hour, _ in row.values() for r in per_hour if r > 0]
    if not rates:
        raise InputError("plot of operating curves: there is none [HM-SCENARIOS-015]")
    left = min(*rates, wanted) / 2
    figure, panels = _panels(len(cases))
    for ax, (case, row) in zip(panels, cases.items(), strict=False):
        ax.axvline(wanted, color=INK, linewidth=0.8, linestyle=":")
        for method, (per_hour, found) in row.items():
            ax.plot(np.maximum(per_hour, left), found, **_line(method))
        ax.set_xscale("log")
        ax.set_xlim(left, 720.0)
        ax.set_ylim(-0.02, 1.02)
        title_axes(ax, plain(case))
        ax.set_xlabel("false alarms [1/h]")
        ax.set_ylabel("found within 1 s [-]")
    shared_legend(figure, columns=5)
    return figure


def _line(method: str) -> dict[str, Any]:
    name, colour, dashes = LINES.get(method, (plain(method), FAINT, "-"))
    return {"label": name, "color": colour, "linestyle": dashes, "linewidth": 1.5}


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    columns = min(COLUMNS, max(1, count))
    rows = math.ceil(max(1, count) / columns)
    figure, axes = new_figure(rows, columns, size=(3.6 * columns, 2.7 * rows + 0.4))
    panels: list[Axes] = axes.ravel().tolist()
    for ax in panels[count:]:
        ax.set_visible(False)
    return figure, panels[:count]
