"""Figures of studies: distributions of a cost, paired differences, cost against solve time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import (
    FAINT,
    INK,
    Array,
    colour,
    name_of,
    new_figure,
    plain,
    plain_log,
    shared_legend,
    title_axes,
)

COLUMNS = 3
WIDE = 3.6
Values = Mapping[str, Mapping[str, Array]]


def distributions(values: Values, label: str) -> Figure:
    """Distribution of values over all runs: median, quartiles, and 5 to 95 %, one panel for each group.

    Args:
        values: By group (a task) and level (a controller): values ``(n,)``; values that are not finite are left out.
        label: Name and unit of the axis.

    Returns:
        The figure; an axis is logarithmic where positive values span more than a factor of 20.

    Raises:
        InputError: If there is no finite value.

    Example:
        >>> figure = distributions({"track_sine": {"prior": np.array([1.0, 2.0]), "hybrid": np.ones(3)}}, "cost [-]")
        >>> len(figure.axes)
        1
    """
    figure, panels = _panels(values, 0.5)
    for ax, (group, row) in zip(panels, values.items(), strict=False):
        finite = {level: _finite(v) for level, v in row.items() if _finite(v).size}
        for k, (level, v) in enumerate(finite.items()):
            low, first, middle, third, high = np.quantile(v, [0.05, 0.25, 0.5, 0.75, 0.95])
            ax.plot([low, high], [k, k], color=colour(level), linewidth=1.2)
            ax.plot(
                [first, third], [k, k], color=colour(level), linewidth=7.0, alpha=0.5, solid_capstyle="butt"
            )
            ax.plot(middle, k, "o", color=colour(level), markersize=5)
        every = np.concatenate(list(finite.values())) if finite else np.ones(1)
        if every.min() > 0 and every.max() > 20 * every.min():
            ax.set_xscale("log")
            plain_log(ax.xaxis, *ax.get_xlim())
        _rows(ax, [name_of(level) for level in finite])
        title_axes(ax, plain(group))
    if not any(_finite(v).size for row in values.values() for v in row.values()):
        raise InputError(f"plot of {label}: there is no finite value [HM-PLOTS-029]")
    figure.supxlabel(f"{label}: median, quartiles, 5 to 95 %", fontsize=10)
    return figure


def differences(rows: Mapping[str, Mapping[str, tuple[float, float, float]]], label: str) -> Figure:
    """Paired differences with their intervals, one panel for each group, with a line at zero.

    Args:
        rows: By group and level: difference, lower and upper end of its interval (NaN: not drawn).
        label: Name and unit of the axis.

    Raises:
        InputError: If there is no finite difference.

    Example:
        >>> figure = differences({"track_sine": {"hybrid": (-0.4, -0.5, -0.3)}}, "difference of cost [%]")
        >>> len(figure.axes)
        1
    """
    if not any(math.isfinite(v[0]) for row in rows.values() for v in row.values()):
        raise InputError(f"plot of {label}: there is no finite value [HM-PLOTS-030]")
    figure, panels = _panels(rows, 0.45)
    for ax, (group, row) in zip(panels, rows.items(), strict=False):
        ax.axvline(0.0, color=INK, linewidth=0.8)
        for k, (level, (middle, low, high)) in enumerate(row.items()):
            if math.isfinite(low) and math.isfinite(high):
                ax.plot([low, high], [k, k], color=colour(level), linewidth=1.8)
            ax.plot(middle, k, "o", color=colour(level), markersize=5)
        _rows(ax, [name_of(level) for level in row])
        title_axes(ax, plain(group))
    figure.supxlabel(f"{label}, with 95 % interval", fontsize=10)
    return figure


def pareto(points: Mapping[str, Mapping[str, tuple[float, float]]], cost: str) -> Figure:
    """Mean cost against the duration of a step, one panel for each group; a line joins the Pareto-optimal points.

    Args:
        points: By group and level: median duration of a step [ms], mean cost.
        cost: Name and unit of the cost.

    Raises:
        InputError: If there is no finite point.

    Example:
        >>> figure = pareto({"track_sine": {"prior": (0.5, 2.0), "hybrid": (2.0, 1.0)}}, "cost [-]")
        >>> len(figure.axes)
        1
    """
    finite = {
        group: {level: p for level, p in row.items() if np.all(np.isfinite(p)) and p[0] > 0}
        for group, row in points.items()
    }
    if not any(finite.values()):
        raise InputError(f"plot of {cost} against time: there is no finite point [HM-PLOTS-031]")
    figure, panels = _panels(finite, 0.0, least=2.8)
    for ax, (group, row) in zip(panels, finite.items(), strict=False):
        front = _front(list(row.values()))
        if len(front) > 1:
            ax.step(*zip(*front, strict=True), where="post", color=FAINT, linewidth=1.0)
        for level, (time, value) in row.items():
            known = colour(level) != FAINT
            ax.plot(time, value, "o", color=colour(level), label=name_of(level) if known else None)
            if not known:
                ax.annotate(
                    plain(level), (time, value), xytext=(4, 3), textcoords="offset points", fontsize=7
                )
        times = [time for time, _ in row.values()] or [1.0]
        if max(times) > 8 * min(times):
            ax.set_xscale("log")
            plain_log(ax.xaxis, *ax.get_xlim())
        title_axes(ax, plain(group))
        ax.set_xlabel("median step [ms]")
        ax.set_ylabel(cost)
    if any(ax.get_legend_handles_labels()[0] for ax in panels):
        shared_legend(figure)
    return figure


def _front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Pareto-optimal points (no other point is better in both coordinates), sorted by the first coordinate."""
    front: list[tuple[float, float]] = []
    for point in sorted(points):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return front


def _panels(
    groups: Mapping[str, Mapping[str, object]], a_row: float, least: float = 1.4
) -> tuple[Figure, list[Axes]]:
    """Create one panel for each group, with ``a_row`` inches for each level; hide unused panels."""
    columns = min(COLUMNS, max(1, len(groups)))
    rows = math.ceil(max(1, len(groups)) / columns)
    most = max((len(row) for row in groups.values()), default=1)
    size = max(5.0, WIDE * columns), max(2.4, rows * max(least, 0.7 + a_row * most))
    figure, axes = new_figure(rows, columns, size=size)
    panels: list[Axes] = axes.ravel().tolist()
    for ax in panels[len(groups) :]:
        ax.set_visible(False)
    return figure, panels


def _rows(ax: Axes, names: Sequence[str]) -> None:
    ax.set_yticks(range(len(names)), [plain(name) for name in names], fontsize=8)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.grid(False, axis="y")


def _finite(values: Array) -> Array:
    numbers = np.asarray(values, dtype=float)
    return np.asarray(numbers[np.isfinite(numbers)])
