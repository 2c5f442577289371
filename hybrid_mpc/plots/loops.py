"""Figures of the closed loops: tracking, duration of a step, cost of each controller relative to the prior's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    FAINT,
    INK,
    MUTED,
    Array,
    axis_label,
    checked,
    colour,
    finish_column,
    line_style,
    name_of,
    new_column,
    new_figure,
    plain,
    plain_log,
    plot_inputs,
    shared_legend,
    title_axes,
)
from hybrid_mpc.rules import time_text

Limits: TypeAlias = tuple[Sequence[float] | Array, Sequence[float] | Array]
"""Lower and upper bounds, one a signal."""
FITS = 16
"""Maximum characters of a label beside an error panel; a longer label has its unit in a second line."""


@dataclass(frozen=True)
class Motion:
    """Signals of one closed loop for a figure.

    Args:
        t: Times ``(n,)`` [s].
        x: True states ``(n, n_x)``.
        u: Inputs ``(n, n_u)``, held between samples.
        y: Measured outputs ``(n, n_y)``; NaN for a dropout. Default: outputs that are not states are not drawn.
    """

    t: Array
    x: Array
    u: Array
    y: Array | None = None


@dataclass(frozen=True)
class _Panel:
    """A signal of the loops: field and column of its values, its reference ``(m,)`` or None, its bounds."""

    signal: Signal
    of: Literal["x", "y"]
    column: int
    reference: Array | None
    bounds: tuple[float, ...]


def closed_loops(
    title: str,
    t: Array,
    reference: Array | None,
    results: Mapping[str, Motion],
    *,
    states: Sequence[Signal],
    inputs: Sequence[Signal],
    limits: Limits | None = None,
    outputs: Sequence[Signal] = (),
    output_reference: Array | None = None,
    state_limits: Limits | None = None,
    output_limits: Limits | None = None,
    disturbances: Sequence[Signal] = (),
    w: Array | None = None,
) -> Figure:
    """The same task under each controller: outputs and states with references and bounds, tracking errors, inputs.

    Every output and every state has a panel. Every signal with a reference has a panel of its tracking error. An output
    that is also a state is drawn once, with its true value; other outputs are drawn as measured.

    Args:
        title: The task in one line.
        t: Times ``(m,)`` [s] of the references.
        reference: Reference states ``(m, n_x)``; None where only outputs have references.
        results: Closed loop by controller (``"prior"``, ``"hybrid"``, ``"oracle"``).
        states: Signals of ``x``.
        inputs: Signals of ``u``.
        limits: Lower and upper bounds of the inputs, drawn where finite. Default: none drawn.
        outputs: Signals of ``y``. Default: outputs that are not states are not drawn.
        output_reference: Reference outputs ``(m, n_y)``; NaN for an output that is not controlled. Default: none.
        state_limits: Bounds of the states. Default: none drawn.
        output_limits: Bounds of the outputs. Default: none drawn.
        disturbances: Signals of ``w``. Default: none.
        w: Measured disturbances ``(m, n_w)`` that acted. Default: none drawn.

    Raises:
        InputError: If there is no loop, or shapes do not fit.

    Example:
        >>> t, x, u = np.array([0.0, 0.1]), np.zeros((2, 2)), np.zeros((2, 1))
        >>> states, inputs = (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),)
        >>> figure = closed_loops("Rest", t, x, {"prior": Motion(t, x, u)}, states=states, inputs=inputs)
        >>> len(figure.axes)
        5
    """
    if not results:
        raise InputError(f"plot of the closed loops {title!r}: there is no controller to draw [HM-PLOTS-025]")
    t = np.asarray(t, dtype=float)
    measured = all(loop.y is not None for loop in results.values())
    x_ref = None if reference is None else checked("reference", reference, len(t), len(states))
    y_ref = output_reference
    y_ref = None if y_ref is None else checked("output_reference", y_ref, len(t), len(outputs))
    shown = _panels(states, x_ref, state_limits, outputs, y_ref, output_limits, measured)
    tracked = [panel for panel in shown if panel.reference is not None]
    around = (
        checked("w", w, len(t), len(disturbances))
        if disturbances and w is not None
        else np.zeros((len(t), 0))
    )
    heights = [1.6] * len(shown) + [1.1] * (len(tracked) + len(inputs) + around.shape[1])
    figure, panels = new_column(heights, height=1.15, title=title)
    errors = panels[len(shown) : len(shown) + len(tracked)]
    below = panels[len(shown) + len(tracked) :][: len(inputs)]
    for controller, loop in results.items():
        columns = {"x": checked(f"x of {controller}", loop.x, len(loop.t), len(states))}
        if measured and outputs:
            columns["y"] = checked(f"y of {controller}", loop.y, len(loop.t), len(outputs))
        u = checked(f"u of {controller}", loop.u, len(loop.t), len(inputs))
        line = line_style(controller)
        for ax, panel in zip(panels, shown, strict=False):
            ax.plot(loop.t, columns[panel.of][:, panel.column], **line)
        for ax, panel in zip(errors, tracked, strict=True):
            assert panel.reference is not None
            goal = np.interp(loop.t, t, panel.reference)
            ax.plot(loop.t, columns[panel.of][:, panel.column] - goal, **line)
        plot_inputs(below, loop.t, u, inputs, **line)
    for ax, panel in zip(panels, shown, strict=False):
        if panel.reference is not None:
            ax.plot(t, panel.reference, **(line_style("reference") | {"zorder": 4}))
        _bounds(ax, panel.bounds, "limits of outputs and states")
        ax.set_ylabel(axis_label(panel.signal))
    for ax, panel in zip(errors, tracked, strict=True):
        ax.axhline(0.0, color=FAINT, linewidth=0.8)
        name = axis_label(panel.signal)
        ax.set_ylabel("error of\n" + (name if len(name) <= FITS else name.replace(" [", "\n[")))
    for i, ax in enumerate(below):
        _bounds(ax, () if limits is None else (limits[0][i], limits[1][i]), "input limits")
    if around.shape[1]:
        plot_inputs(panels[len(heights) - around.shape[1] :], t, around, disturbances)
    finish_column(figure, panels)
    return figure


def _panels(
    states: Sequence[Signal],
    x_ref: Array | None,
    x_limits: Limits | None,
    outputs: Sequence[Signal],
    y_ref: Array | None,
    y_limits: Limits | None,
    measured: bool,
) -> list[_Panel]:
    """Panels of the outputs in their order, then of the states that are not outputs."""

    def bounds(limits: Limits | None, i: int) -> tuple[float, ...]:
        return () if limits is None or not len(limits[0]) else (float(limits[0][i]), float(limits[1][i]))

    place = {(signal.name, signal.unit): i for i, signal in enumerate(states)}
    shown, seen = [], set()
    for j, signal in enumerate(outputs):
        i = place.get((signal.name, signal.unit))
        goal = None if y_ref is None or not np.isfinite(y_ref[:, j]).any() else y_ref[:, j]
        if i is None:
            if measured:
                shown.append(_Panel(signal, "y", j, goal, bounds(y_limits, j)))
            continue
        seen.add(i)
        goal = x_ref[:, i] if goal is None and x_ref is not None else goal
        shown.append(_Panel(signal, "x", i, goal, (*bounds(x_limits, i), *bounds(y_limits, j))))
    for i, signal in enumerate(states):
        if i not in seen:
            shown.append(_Panel(signal, "x", i, None if x_ref is None else x_ref[:, i], bounds(x_limits, i)))
    return shown


def _bounds(ax: Axes, bounds: Sequence[float], label: str) -> None:
    for bound in dict.fromkeys(filter(math.isfinite, bounds)):
        ax.axhline(bound, color=INK, linestyle=":", linewidth=1.1, label=label)


def solve_times(times_ms: Mapping[str, Array], period_ms: float) -> Figure:
    """Duration of a controller step and the control period: distribution, and share of longer steps.

    Args:
        times_ms: Durations of all steps by controller, ``(n,)`` [ms].
        period_ms: Control period [ms], which is the deadline.

    Raises:
        InputError: If a controller has no positive durations, or the period is not positive.

    Example:
        >>> len(solve_times({"hybrid": np.array([2.0, 2.5, 4.0])}, 20.0).axes)
        2
    """
    if not times_ms or not period_ms > 0:
        raise InputError(
            "plot of the solve times: at least one controller and a positive period are needed [HM-PLOTS-026]"
        )
    data = {name: np.sort(np.ravel(np.asarray(v, dtype=float))) for name, v in times_ms.items()}
    for name, values in data.items():
        if len(values) == 0 or not values[0] > 0:
            raise InputError(
                f"plot of the solve times of {name}: all durations [ms] must be positive [HM-PLOTS-027]"
            )
    figure, axes = new_figure(1, 2, size=(10, 4.0))
    left, right = axes[0]
    low = min(v[0] for v in data.values())
    high = max(period_ms, *(v[-1] for v in data.values()))
    bins = np.geomspace(0.9 * low, 1.15 * high, 60)
    for name, v in data.items():
        note = f"{name_of(name)}: median {time_text(float(np.median(v)))}, p99 {time_text(float(np.quantile(v, 0.99)))}"
        weights = np.full(len(v), 100.0 / len(v))
        left.hist(v, bins, weights=weights, color=colour(name), alpha=0.3)
        left.hist(v, bins, weights=weights, color=colour(name), histtype="step", linewidth=1.3)
        longer = 100.0 * np.arange(len(v), 0, -1) / len(v)
        right.step(v, longer, where="post", color=colour(name), linewidth=1.6, label=note)
    for ax in (left, right):
        ax.axvline(period_ms, color="black", linewidth=1.6, label=f"deadline {time_text(period_ms)}")
        ax.set_xscale("log")
        ax.set_xlim(bins[0], bins[-1])
        ax.set_xlabel("duration of a controller step [ms]")
        plain_log(ax.xaxis, bins[0], bins[-1])
    left.set_ylabel("share of steps [%]")
    right.set_yscale("log")
    plain_log(right.yaxis, *right.get_ylim())
    right.axhline(1.0, color=FAINT, linestyle=":", label="1 % of the steps (p99)")
    right.set_ylabel("share of longer steps [%]")
    title_axes(left, "distribution")
    title_axes(right, "share of steps that took longer")
    shared_legend(figure, columns=2)
    return figure


# Name, role that sets the colour, marker, filled. A controller with a disturbance observer has a hollow marker.
CONTROLLERS: Mapping[str, tuple[str, str, str, bool]] = {
    "prior": (name_of("prior"), "prior", "o", True),
    "prior_observer": (name_of("prior_observer"), "prior", "s", False),
    "hybrid": (name_of("hybrid"), "hybrid", "o", True),
    "hybrid_observer": (name_of("hybrid_observer"), "hybrid", "s", False),
    "prior_tracking": (name_of("prior_tracking"), "prior_tracking", "s", False),
    "hybrid_tracking": (name_of("hybrid_tracking"), "hybrid_tracking", "s", False),
    "blended_observer": (name_of("blended_observer"), "blended_observer", "s", False),
    "oracle": ("oracle, measuring", "oracle", "D", True),
    "oracle_state": (name_of("oracle_state"), "oracle", "D", False),
}

Costs = Mapping[str, Mapping[str, tuple[float, float]]]
BASELINE = "prior_observer"
"""Controller that costs are relative to."""


def costs(table: Costs) -> Figure:
    """Closed-loop cost of every controller in every task, relative to the prior with observer.

    The table holds, by task and controller, the mean cost and the half width of its 95 % interval. Both are divided by
    the mean cost of :data:`BASELINE`, whose own interval shows the uncertainty of that mean. A missing controller or a
    mean that is not finite leaves a gap. An interval that is not finite (a single seed) is not drawn. A task without
    a cost of the baseline keeps its row, with a note. The axis is logarithmic where costs span more than a factor of 5.
    """
    relative = {task: _relative(row) for task, row in table.items()}
    points = [mean for row in relative.values() for mean, _ in row.values()]
    if not points:
        raise InputError(
            f"plot of the costs: none of the tasks {sorted(table)} has a positive cost of the controller {BASELINE!r}, "
            "to which costs are relative [HM-PLOTS-028]"
        )
    there = {name for row in relative.values() for name in row}
    present = [name for name in CONTROLLERS if name in there] + sorted(there - set(CONTROLLERS))
    height = 0.25 + 0.11 * len(present)
    figure, axes = new_figure(1, 1, size=(9, 1.5 + height * len(table)))
    ax = axes[0, 0]
    log = max(points) > 5 * min(points) > 0
    lowest = 0.8 * min(points)  # lower end of an interval that reaches zero, on a logarithmic axis
    ax.axvline(1.0, color=FAINT, linewidth=1.0, zorder=1)
    for k, row in enumerate(relative.values()):
        if k:
            ax.axhline(k - 0.5, color="#dddddd", linewidth=0.8, zorder=1)
        if not row:
            note, at = f"no cost of {name_of(BASELINE)}", ax.get_yaxis_transform()
            ax.text(0.98, k, note, transform=at, color=MUTED, fontsize=9, ha="right", va="center")
        for name, (mean, half) in row.items():
            at = k + 0.74 * ((present.index(name) + 0.5) / len(present) - 0.5)
            left = max(mean - half, lowest) if log else mean - half
            ax.plot([left, mean + half], [at, at], color=_style(name)["color"], linewidth=1.6, zorder=3)
            ax.plot(mean, at, linestyle="", zorder=4, **_style(name))
    if log:
        ax.set_xscale("log")
        plain_log(ax.xaxis, *ax.get_xlim())
    ax.set_yticks(range(len(table)), [plain(task.replace("_", " ")) for task in table])
    ax.set_ylim(len(table) - 0.5, -0.5)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel(f"cost relative to {name_of(BASELINE)}, with 95 % interval [-]")
    _legend(figure, ax, present)
    return figure


def _relative(row: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Finite means and half widths (0 where unknown), divided by the baseline's mean; empty without one."""
    scale = float(row.get(BASELINE, (math.nan, math.nan))[0])
    if not (math.isfinite(scale) and scale > 0):
        return {}
    finite = {name: value for name, value in row.items() if math.isfinite(value[0])}
    return {
        name: (mean / scale, half / scale if math.isfinite(half) else 0.0)
        for name, (mean, half) in finite.items()
    }


def _style(name: str) -> dict[str, Any]:
    _, role, marker, filled = CONTROLLERS.get(name, (name, name, "^", True))
    ink = colour(role)
    face = ink if filled else "white"
    return {"color": ink, "marker": marker, "markersize": 7, "markerfacecolor": face, "markeredgewidth": 1.5}


def _legend(figure: Figure, ax: Axes, present: Sequence[str]) -> None:
    """Add a legend in the order of the controllers, which does not depend on the tasks."""
    for name in present:
        label = CONTROLLERS[name][0] if name in CONTROLLERS else plain(name)
        ax.plot([], [], linestyle="", label=label, **_style(name))
    shared_legend(figure, columns=3)
