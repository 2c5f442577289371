"""Figures of the linear analysis of models: against a machine's response, in time, friction, sensitivities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import (
    FAINT,
    INK,
    Array,
    axis_label,
    checked,
    colour,
    line_style,
    name_of,
    new_figure,
    plain,
    plain_log,
    shared_legend,
    title_axes,
)
from hybrid_mpc.signals import Signal

_POINTS = {
    "rest": "tangent at rest",
    "working": "friction of working size",
    "moving": "tangent in motion",
    "driven": "mean of a driven run",
}


def measured_bode(
    responses: Mapping[str, Mapping[str, Array]],
    *,
    input_signal: Signal,
    output_signal: Signal,
    source: str,
) -> Figure:
    """Frequency responses estimated in the same way from a machine and from models.

    Args:
        responses: By name (``"measured"`` for the machine): ``omega`` [rad/s], complex ``response``, ``coherence``,
            ``deviation`` of the magnitude, each ``(n,)``.
        input_signal: The input.
        output_signal: The output.
        source: What was done, for the title.

    Raises:
        InputError: If there is no response.

    Example:
        >>> one = {"omega": np.array([1.0, 2.0]), "response": np.array([1 + 0j, -1j]),
        ...     "coherence": np.ones(2), "deviation": np.zeros(2)}
        >>> u, y = Signal("v", "m/s"), Signal("q", "m")
        >>> len(measured_bode({"measured": one}, input_signal=u, output_signal=y, source="a multisine").axes)
        3
    """
    if not responses:
        raise InputError("measured response: there is nothing to draw")
    figure, axes = new_figure(3, 1, sharex=True, size=(9, 7.2), heights=(3, 2, 1.2))
    upper, middle, lower = axes[:, 0]
    for name, one in responses.items():
        omega = np.asarray(one["omega"], dtype=float)
        g = np.asarray(one["response"])
        shown = np.isfinite(g)
        w, size = omega[shown], np.abs(g[shown])
        machine = name == "measured"
        style = line_style(name) | {"linewidth": 1.4}
        if machine:
            style |= {"linestyle": "none", "marker": "o", "markersize": 4, "markerfacecolor": "none"}
            spread = np.asarray(one["deviation"], dtype=float)[shown]
            band = np.maximum(size - 2 * spread, 1e-3 * size), size + 2 * spread
            upper.fill_between(w, *band, color=FAINT, alpha=0.25, linewidth=0)
        upper.loglog(w, size, **style)
        middle.semilogx(w, np.degrees(np.unwrap(np.angle(g[shown]))), **style)
        lower.semilogx(w, np.asarray(one["coherence"], dtype=float)[shown], **style)
    unit = "/".join(f"({s.unit})" if " " in s.unit else s.unit for s in (output_signal, input_signal))
    upper.set_ylabel(f"magnitude\n[{unit}]")
    middle.set_ylabel("phase [°]")
    middle.yaxis.set_major_locator(MultipleLocator(90))
    lower.set_ylabel("coherence [-]")
    lower.set_ylim(0, 1.05)
    lower.set_xlabel("angular frequency [rad/s]")
    every = np.concatenate([np.asarray(r["omega"], dtype=float) for r in responses.values()])
    plain_log(lower.xaxis, float(every.min()), float(every.max()))
    title_axes(upper, f"from {axis_label(input_signal)} to {axis_label(output_signal)}: {plain(source)}")
    figure.align_ylabels([upper, middle, lower])
    shared_legend(figure)
    return figure


def step_responses(
    curves: Mapping[str, Mapping[str, tuple[Array, Array]]], *, input_signal: Signal, output_signal: Signal
) -> Figure:
    """Unit step responses of linearisations, a panel a point of linearisation.

    Args:
        curves: By point (``"rest"``), then by model: times ``(n,)`` [s] and output per unit of the input ``(n,)``.
        input_signal: The input.
        output_signal: The output.

    Raises:
        InputError: If there is nothing to draw or lengths differ.

    Example:
        >>> t = np.linspace(0.0, 1.0, 5)
        >>> u, y = Signal("v", "m/s"), Signal("q", "m")
        >>> len(step_responses({"rest": {"prior": (t, t)}}, input_signal=u, output_signal=y).axes)
        1
    """
    if not curves:
        raise InputError("step responses: there is nothing to draw")
    figure, axes = new_figure(1, len(curves), size=(3.4 * len(curves) + 1, 3.6))
    for ax, (point, models) in zip(axes[0], curves.items(), strict=True):
        for name, (t, y) in models.items():
            ax.plot(t, checked(f"step response of {name}", y, len(t)), **line_style(name))
        ax.set_xlabel("time [s]")
        title_axes(ax, _POINTS.get(point, point))
    axes[0, 0].set_ylabel(f"{axis_label(output_signal)}\nper {input_signal.unit}")
    shared_legend(figure)
    return figure


def friction_damping(curves: Mapping[str, Mapping[str, Array]], *, working_speed: float, unit: str) -> Figure:
    """How much damping a motion of some size feels: slope at rest, chords, slope in motion.

    Args:
        curves: By model: ``speed``, ``secant``, ``harmonic``, ``moving`` ``(n,)`` and ``tangent``, a number [1/s].
        working_speed: Working speed, drawn as a line.
        unit: Unit of the speed.

    Raises:
        InputError: If there is nothing to draw.

    Example:
        >>> v = np.array([0.1, 1.0])
        >>> one = {"speed": v, "secant": 1 / v, "harmonic": 1.2 / v, "moving": 0 * v, "tangent": np.array(50.0)}
        >>> len(friction_damping({"prior": one}, working_speed=0.5, unit="rad/s").axes)
        1
    """
    if not curves:
        raise InputError("friction: there is nothing to draw")
    figure, axes = new_figure(1, len(curves), size=(5.0 * len(curves), 4.4), sharey=True)
    kinds = (
        ("secant", "--", "secant"),
        ("harmonic", "-", "describing function"),
        ("moving", ":", "tangent in motion"),
    )
    for ax, (name, one) in zip(axes[0], curves.items(), strict=True):
        speed = np.asarray(one["speed"], dtype=float)
        ax.axhline(float(one["tangent"]), color=INK, linestyle="-.", linewidth=1.0, label="tangent at rest")
        for key, dashes, label in kinds:
            values = checked(f"{key} of {name}", one[key], speed.size)
            ax.loglog(
                speed, np.where(values > 0, values, np.nan), color=colour(name), linestyle=dashes, label=label
            )
        ax.axvline(working_speed, color=FAINT, linewidth=0.9)
        ax.annotate(
            " working speed",
            (working_speed, 0.02),
            xycoords=("data", "axes fraction"),
            fontsize=8,
            color=FAINT,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
        )
        ax.set_xlabel(f"size of the speed [{unit}]")
        title_axes(ax, name_of(name))
        plain_log(ax.xaxis, float(speed.min()), float(speed.max()))
    low = min(float(np.nanmin(np.asarray(c["secant"], dtype=float))) for c in curves.values())
    axes[0, 0].set_ylim(bottom=0.1 * max(low, 1e-6))
    axes[0, 0].set_ylabel("damping: acceleration over speed [1/s]")
    _one_legend(figure)
    return figure


def _one_legend(figure: Figure) -> None:
    """The kinds of lines once, in ink: the panels' colours tell models apart, not kinds."""
    seen: dict[str, Any] = {}
    for ax in figure.axes:
        for line in ax.get_lines():
            label = str(line.get_label())
            if not label.startswith("_"):
                seen.setdefault(label, line.get_linestyle())
    handles = [Line2D([], [], color=INK, linestyle=dashes) for dashes in seen.values()]
    figure.legend(handles, list(seen), loc="outside lower center", ncols=len(seen), frameon=False, fontsize=9)


def sensitivities(
    t: Array, relative: Mapping[str, Array], names: Sequence[str], *, output_signal: Signal
) -> Figure:
    """How a free run's output moves per relative change of the prior's parameters.

    Args:
        t: Times ``(n,)`` [s].
        relative: By model: change of the output per 100 % of each parameter ``(n, n_p)``.
        names: Parameters ``(n_p,)``.
        output_signal: The output.

    Raises:
        InputError: If there is nothing to draw or shapes differ.

    Example:
        >>> t = np.linspace(0.0, 1.0, 5)
        >>> len(sensitivities(t, {"prior": np.zeros((5, 2))}, ["J", "d"], output_signal=Signal("q", "m")).axes)
        2
    """
    if not relative or not names:
        raise InputError("sensitivities: there is nothing to draw")
    figure, axes = new_figure(
        (len(names) + 1) // 2, 2, sharex=True, size=(10, 1.7 * ((len(names) + 1) // 2) + 1)
    )
    for j, (ax, parameter) in enumerate(zip(axes.ravel(), names, strict=False)):
        for name, values in relative.items():
            ax.plot(
                t, checked(f"sensitivity of {name}", values, len(t), len(names))[:, j], **line_style(name)
            )
        title_axes(ax, f"by {plain(parameter)}")
    for ax in axes.ravel()[len(names) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    figure.supylabel(f"{axis_label(output_signal)} per 100 %", fontsize=10, color=INK)
    shared_legend(figure)
    return figure
