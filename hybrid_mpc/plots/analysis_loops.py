"""Figures of linearised loops: sensitivity functions, Nyquist curves, gain schedules."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import (
    FAINT,
    INK,
    Array,
    axis_label,
    checked,
    colour,
    name_of,
    new_figure,
    plain,
    plain_log,
    shared_legend,
    title_axes,
)
from hybrid_mpc.signals import Signal

_POINTS = {"rest": ", tangent at rest", "working": ", friction of working size"}
_COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73", "#E69F00", "#56B4E9")
_DASHES = ("-", "--", ":", "-.")


def sensitivity_functions(loops: Mapping[str, Mapping[str, Array]], *, title: str = "") -> Figure:
    """Sensitivity and complementary sensitivity of loops at the plant's input.

    Args:
        loops: By loop: ``omega`` ``(n,)`` [rad/s], complex ``S`` and ``T`` ``(n,)``. Names that differ after their last
            comma only (``"prior on prior, quiet"``) share a colour.
        title: Title over the figure. Default: none.

    Raises:
        InputError: If there is no loop or lengths differ.

    Example:
        >>> one = {"omega": np.array([1.0, 2.0]), "S": np.array([0.5 + 0j, 1.0]), "T": np.array([0.5 + 0j, 0.0])}
        >>> len(sensitivity_functions({"hybrid": one}).axes)
        2
    """
    if not loops:
        raise InputError("sensitivity functions: there is no loop to draw")
    figure, axes = new_figure(1, 2, sharex=True, sharey=True, size=(10, 4.2), title=title)
    texts = ("S: what is left of a load", "T: what the input takes of it")
    looks = _looks(loops)
    for ax, key, text in zip(axes[0], "ST", texts, strict=True):
        for name, one in loops.items():
            omega = np.asarray(one["omega"], dtype=float)
            size = checked(f"{key} of {name}", np.abs(one[key]), omega.size)
            ax.loglog(omega, size, **looks[name])
        ax.axhline(1.0, color=FAINT, linewidth=0.8)
        ax.set_xlabel("angular frequency [rad/s]")
        title_axes(ax, text)
        plain_log(ax.xaxis, float(omega.min()), float(omega.max()))
        ax.set_ylim(1e-2, 10)
        plain_log(ax.yaxis, 1e-2, 10.0)
    axes[0, 0].set_ylabel("magnitude [-]")
    shared_legend(figure, columns=3)
    return figure


def _looks(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Colours by what stands before the last comma of a name (the loop), dashes by what follows it (its filter)."""
    loops: list[str] = []
    variants: list[str] = []
    looks = {}
    for name in names:
        loop, _, variant = name.rpartition(", ")
        loop, variant = (loop, variant) if loop else (variant, "")
        loops += [loop] * (loop not in loops)
        variants += [variant] * (variant not in variants)
        looks[name] = {
            "color": _COLOURS[loops.index(loop) % len(_COLOURS)],
            "linestyle": _DASHES[variants.index(variant) % len(_DASHES)],
            "linewidth": 1.5,
            "label": plain(name),
        }
    return looks


def nyquist(loops: Mapping[str, Array], *, modulus: float | None = None) -> Figure:
    """Nyquist curves of loops in negative-feedback sign, around -1.

    Args:
        loops: By loop: complex loop gain ``(n,)`` along increasing frequency; names as in
            :func:`sensitivity_functions`.
        modulus: Radius of a circle around -1 to draw, e.g. the smallest distance wanted. Default: none.

    Raises:
        InputError: If there is no loop.

    Example:
        >>> len(nyquist({"hybrid": np.array([1 - 1j, 0.1 - 0.5j])}, modulus=0.5).axes)
        1
    """
    if not loops:
        raise InputError("Nyquist plot: there is no loop to draw")
    figure, axes = new_figure(1, 1, size=(6.4, 5.6))
    ax = axes[0, 0]
    angle = np.linspace(0, 2 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), color=FAINT, linewidth=0.8)
    if modulus is not None:
        ax.plot(-1 + modulus * np.cos(angle), modulus * np.sin(angle), color=FAINT, linewidth=0.8, linestyle="--",
                label=f"distance {modulus:g} from -1")  # fmt: skip
    looks = _looks(loops)
    for name, curve in loops.items():
        g = np.asarray(curve)
        ax.plot(g.real, g.imag, **looks[name])
    ax.plot([-1], [0], marker="+", color=INK, markersize=10)
    ax.set_xlim(-2.2, 1.2)
    ax.set_ylim(-1.9, 1.3)
    ax.set_aspect("equal")
    ax.set_xlabel("real part [-]")
    ax.set_ylabel("imaginary part [-]")
    title_axes(ax, "loop gain at the plant's input, negative feedback")
    shared_legend(figure, columns=2)
    return figure


def gain_schedules(
    schedules: Mapping[str, Mapping[str, tuple[Array, Array]]],
    *,
    position: Signal,
    states: tuple[Signal, ...],
) -> Figure:
    """LQR gains of the physical states over the position.

    Args:
        schedules: By model, then by point (``"rest"``, ``"working"``): positions ``(n,)`` and gains ``(n, n_x)``.
        position: The position.
        states: Signals of the states.

    Raises:
        InputError: If there is nothing to draw or shapes differ.

    Example:
        >>> q, x = Signal("q", "m"), (Signal("q", "m"), Signal("v", "m/s"))
        >>> curve = {"prior": {"rest": (np.array([0.0, 1.0]), np.ones((2, 2)))}}
        >>> len(gain_schedules(curve, position=q, states=x).axes)
        2
    """
    if not schedules:
        raise InputError("gain schedule: there is nothing to draw")
    figure, axes = new_figure(1, len(states), sharex=True, size=(4.8 * len(states), 3.8))
    for name, points in schedules.items():
        for point, (q, gain) in points.items():
            values = checked(f"gains of {name}", gain, len(q), len(states))
            style: dict[str, Any] = {
                "color": colour(name), "linestyle": ":" if point == "rest" else "-", "marker": ".", "markersize": 4,
                "label": name_of(name) + _POINTS.get(point, ""),
            }  # fmt: skip
            for ax, column in zip(axes[0], values.T, strict=True):
                ax.plot(q, column, **style)
    for ax, signal in zip(axes[0], states, strict=True):
        ax.set_xlabel(axis_label(position))
        title_axes(ax, f"gain of {axis_label(signal)}")
    axes[0, 0].set_ylabel("input per unit of state")
    shared_legend(figure, columns=2)
    return figure
