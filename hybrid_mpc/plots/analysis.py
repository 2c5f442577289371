"""Figures of the linear analysis: poles, frequency and step responses, sensitivities, gain schedules, friction."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    COLOURS,
    FAINT,
    INK,
    MUTED,
    Array,
    axis_label,
    checked,
    colour,
    line_style,
    name_of,
    new_figure,
    plain,
    plain_log,
    ratio_unit,
    shared_legend,
    title_axes,
)
from hybrid_mpc.rules import counted

CHANNEL = "_from_"
"""Separates a figure's name from its channel, if there are several channels."""
_MARKERS = {"phy": "x", "prior": "x", "mopgrnn": "o", "hybrid": "o", "oracle": "s"}
_DAMPING = (0.1, 0.3, 0.5, 0.7, 0.9)
_COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73", "#E69F00", "#56B4E9")
_DASHES = ("-", "--", ":", "-.")
_POINTS = {
    "rest": "tangent at rest",
    "working": "friction of working size",
    "moving": "tangent in motion",
    "driven": "mean of a driven run",
}


def pole_map(poles: Mapping[str, Any], dt: float, *, zeros: Mapping[str, Any] | None = None) -> Figure:
    """Poles (and zeros) of the linearized models in the z-plane; the right panel enlarges the slow poles near z = 1.

    Args:
        poles: Eigenvalues ``(n,)``, complex, of each model's one-step map.
        dt: Model period [s]; sets the natural frequencies of the grid.
        zeros: Zeros ``(n,)``, complex, by model. Poles are then crosses and zeros circles, and the title counts the
            zeros outside the frame. Default: none; the markers separate the models.

    Raises:
        InputError: If there is no pole, or ``dt`` is not positive.

    Example:
        >>> len(pole_map({"phy": [0.9 + 0.1j, 0.9 - 0.1j]}, 0.02).axes)
        2
    """
    values = {m: np.ravel(np.asarray(p, dtype=complex)) for m, p in poles.items()}
    nulls = {m: np.ravel(np.asarray(z, dtype=complex)) for m, z in (zeros or {}).items()}
    if not dt > 0 or not any(len(p) for p in values.values()):
        raise InputError(
            f"pole map: at least one pole and a positive dt are needed, got dt = {dt} [HM-PLOTS-001]"
        )
    figure, axes = new_figure(1, 2, size=(10, 5.4))
    extent = max(1.08, *(1.05 * float(np.abs(p).max()) for p in values.values() if len(p)))
    near = np.concatenate([p[np.abs(p - 1.0) < 0.35] for p in values.values()])
    half = _half_width(near)
    whole, zoom = axes[0]
    grids = (whole, 0.1 * np.pi / dt, 0.6), (zoom, _round(half / dt / 5), 0.5 * half)
    for ax, spacing, reach in grids:
        _z_grid(ax, dt, spacing, reach)
        for model, p in values.items():
            if zeros is None:
                _points(ax, model, p, _MARKERS.get(model, "D"), name_of(model))
            else:
                _points(ax, model, p, "x", f"{name_of(model)}: poles")
                _points(ax, model, nulls.get(model, p[:0]), "o", f"{name_of(model)}: zeros")
        ax.set_aspect("equal")
        ax.set_xlabel("real part [-]")
        ax.set_ylabel("imaginary part [-]")
    whole.set_xlim(-extent, extent)
    whole.set_ylim(-extent, extent)
    zoom.set_xlim(1.0 - half, 1.0 + 0.35 * half)
    zoom.set_ylim(-0.675 * half, 0.675 * half)
    box = (1.0 - half, -0.675 * half), 1.35 * half, 1.35 * half
    whole.add_patch(Rectangle(*box, fill=False, edgecolor="black", linewidth=0.8, zorder=5))
    grid = "grid: damping ratio, natural frequency every {:.3g} rad/s"
    away = sum(int(np.sum(np.maximum(np.abs(z.real), np.abs(z.imag)) > extent)) for z in nulls.values())
    outside = f", {counted(away, 'zero')} outside of the frame" if away else ""
    title_axes(whole, f"z-plane, stable inside the circle{outside}\n" + grid.format(0.1 * np.pi / dt))
    title_axes(zoom, "enlarged: slow poles near z = 1\n" + grid.format(_round(half / dt / 5)))
    shared_legend(figure)
    return figure


def _points(ax: Axes, model: str, z: Any, marker: str, label: str) -> None:
    ink: dict[str, Any] = {"facecolors": colour(model)}
    if marker != "x":
        ink = {"facecolors": "none", "edgecolors": colour(model)}
    ax.scatter(z.real, z.imag, s=52, marker=marker, linewidths=1.6, label=label, zorder=4, **ink)


def _half_width(near: Any) -> float:
    """Size h of the enlarged frame [1 - h, 1 + 0.35 h] x [-0.675 h, 0.675 h] that holds all these poles."""
    if not len(near):
        return 0.3
    d = near - 1.0
    reach = np.maximum.reduce([-d.real, d.real / 0.35, np.abs(d.imag) / 0.675])
    return max(0.02, 1.2 * float(reach.max()))


def _round(value: float) -> float:
    """Largest of 1, 2 or 5 times a power of ten that is at most ``value``."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1.0, 2.0, 5.0) if step <= value / power + 1e-9) * power)


def _z_grid(ax: Axes, dt: float, spacing: float, reach: float) -> None:
    """Draw the unit circle and lines of constant damping ratio and natural frequency ``spacing`` [rad/s].

    A pole ``s = omega_n (-zeta + i sqrt(1 - zeta^2))`` of a continuous system is ``z = exp(s dt)``. Each damping ratio
    is written at the distance ``reach`` from z = 1.
    """
    ax.grid(False)
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    ax.plot(np.cos(angle), np.sin(angle), color="black", linewidth=1.2)
    for damping in _DAMPING:  # omega = omega_n dt, up to a damped frequency of pi
        omega = np.linspace(0.0, np.pi / np.sqrt(1.0 - damping**2), 2000)
        z = np.exp(omega * (-damping + 1j * np.sqrt(1.0 - damping**2)))
        for side in (z, z.conj()):
            ax.plot(side.real, side.imag, color="#c9c9c9", linewidth=0.7, zorder=1)
        at = int(np.argmin(np.abs(np.abs(z - 1.0) - reach)))
        ax.annotate(
            f"{damping:g}", (z[at].real, z[at].imag), fontsize=7, color=MUTED, ha="center", va="center",
            clip_on=True, annotation_clip=True,
        )  # fmt: skip
    turns = np.arange(spacing * dt, np.pi * 1.001, spacing * dt)
    for turn in turns[:40]:
        damping_angle = np.linspace(np.pi / 2, np.pi, 120)
        z = np.exp(turn * np.exp(1j * damping_angle))
        for side in (z, z.conj()):
            ax.plot(side.real, side.imag, color="#dedede", linewidth=0.7, zorder=1)


def channel_words(inputs: Sequence[Signal], outputs: Sequence[Signal], i: int, j: int) -> tuple[str, str]:
    """Parts of a figure's name and caption that name output ``i`` and input ``j``; empty for a single channel."""
    if len(inputs) * len(outputs) == 1:
        return "", ""
    ends = f"{inputs[j].name}_to_{outputs[i].name}", f"{inputs[j].name} to {outputs[i].name}"
    return f"{CHANNEL}{ends[0]}", f", from {ends[1]}"


def bodes(
    responses: Mapping[str, tuple[Array, Array, Array]],
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
    dt: float,
) -> Iterator[tuple[str, str, Figure]]:
    """:func:`bode` of every channel, with the :func:`channel_words` before it.

    ``responses`` are frequencies ``(n,)``, magnitudes and phases ``(n_y, n_u, n)``, by model.
    """
    for i, j in product(range(len(outputs)), range(len(inputs))):
        own = {name: (omega, size[i, j], phase[i, j]) for name, (omega, size, phase) in responses.items()}
        figure = bode(own, input_signal=inputs[j], output_signal=outputs[i], nyquist=np.pi / dt)
        yield *channel_words(inputs, outputs, i, j), figure


def bode(
    responses: Mapping[str, tuple[Array, Array, Array]],
    *,
    input_signal: Signal,
    output_signal: Signal,
    nyquist: float | None = None,
) -> Figure:
    """Frequency responses of the linearized models from one input to one output: magnitude and phase.

    Args:
        responses: By model or any other name: angular frequencies ``(n,)`` [rad/s], magnitude ``(n,)`` [output
            unit / input unit], phase ``(n,)`` [rad].
        input_signal: The input.
        output_signal: The output.
        nyquist: Nyquist frequency ``pi / dt`` [rad/s]; drawn as a line. Default: none.

    Raises:
        InputError: If there is no model, or lengths differ.

    Example:
        >>> omega = np.array([0.1, 1.0, 10.0])
        >>> response = (omega, 1 / omega, np.full(3, -np.pi / 2))
        >>> u, y = Signal("v", "m/s"), Signal("q", "m")
        >>> len(bode({"phy": response}, input_signal=u, output_signal=y).axes)
        2
    """
    if not responses:
        raise InputError("Bode plot: there is no model to draw [HM-PLOTS-002]")
    figure, axes = new_figure(2, 1, sharex=True, size=(9, 5.4))
    magnitude_ax, phase_ax = axes[:, 0]
    lowest, phases = np.inf, []
    unknown = [name for name in responses if name.partition(",")[0] not in COLOURS]
    for model, (omega, magnitude, phase) in responses.items():
        omega = np.asarray(omega, dtype=float)
        line = line_style(model) | {"linewidth": 1.7}
        if model in unknown and len(unknown) > 1:
            line["color"] = _COLOURS[unknown.index(model) % len(_COLOURS)]
        size = checked(f"magnitude of {model}", magnitude, len(omega))
        angle = np.degrees(checked(f"phase of {model}", phase, len(omega)))
        # at the Nyquist frequency a sampled response is real: its magnitude may vanish and its phase may jump
        clear = omega < (np.inf if nyquist is None else 0.98 * nyquist)
        magnitude_ax.loglog(omega, size, **line)
        phase_ax.semilogx(omega[clear], angle[clear], **line)
        lowest = min(lowest, float(size[clear & (size > 0)].min(initial=np.inf)))
        phases.append(angle[clear])
    if nyquist is not None and np.isfinite(lowest):
        magnitude_ax.set_ylim(bottom=0.5 * lowest)
    for ax in (magnitude_ax, phase_ax):
        if nyquist is not None:
            ax.axvline(nyquist, color=FAINT, linestyle=":", label="Nyquist frequency")
        ax.grid(True, which="minor", color="#eeeeee", linewidth=0.4)
        ax.margins(x=0)
    magnitude_ax.set_ylabel(f"magnitude\n[{ratio_unit(output_signal, input_signal)}]")
    phase_ax.set_ylabel("phase [°]")
    phase_ax.set_xlabel("angular frequency [rad/s]")
    title_axes(magnitude_ax, f"from {axis_label(input_signal)} to {axis_label(output_signal)}")
    phase_ax.yaxis.set_major_locator(MultipleLocator(45 if np.ptp(np.concatenate(phases)) < 270 else 90))
    figure.align_ylabels([magnitude_ax, phase_ax])
    shared_legend(figure)
    return figure


def sensitivity_functions(loops: Mapping[str, Mapping[str, NDArray[Any]]]) -> Figure:
    """Sensitivity and complementary sensitivity of loops at the plant's input.

    Args:
        loops: By loop: ``omega`` ``(n,)`` [rad/s], complex ``S`` and ``T`` ``(n,)``. Names that differ only after their
            last comma (``"prior on prior, quiet"``) share a colour.

    Raises:
        InputError: If there is no loop, or lengths differ.

    Example:
        >>> one = {"omega": np.array([1.0, 2.0]), "S": np.array([0.5 + 0j, 1.0]), "T": np.array([0.5 + 0j, 0.0])}
        >>> len(sensitivity_functions({"hybrid": one}).axes)
        2
    """
    if not loops:
        raise InputError("sensitivity functions: there is no loop to draw [HM-PLOTS-003]")
    figure, axes = new_figure(1, 2, sharex=True, sharey=True, size=(10, 4.2))
    texts = ("S: remaining part of an input load", "T: part compensated by the input")
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
    """Line styles: the part of a name before its last comma (the loop) sets the colour, the rest sets the dashes."""
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


def nyquist(loops: Mapping[str, NDArray[np.complex128]], *, modulus: float | None = None) -> Figure:
    """Nyquist curves of loops near the point -1, for negative feedback.

    Args:
        loops: By loop: complex loop gain ``(n,)`` along increasing frequency; names as in
            :func:`sensitivity_functions`.
        modulus: Radius of a circle around -1, for example the required modulus margin. Default: none.

    Raises:
        InputError: If there is no loop.

    Example:
        >>> len(nyquist({"hybrid": np.array([1 - 1j, 0.1 - 0.5j])}, modulus=0.5).axes)
        1
    """
    if not loops:
        raise InputError("Nyquist plot: there is no loop to draw [HM-PLOTS-004]")
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
    input_signal: Signal,
) -> Figure:
    """LQR gains of the physical states over the position.

    Args:
        schedules: By model, then by point of linearization (``"rest"``, ``"working"``): positions ``(n,)`` and gains
            ``(n, n_x)``.
        position: The position.
        states: Signals of the states.
        input_signal: The input.

    Raises:
        InputError: If there is nothing to draw or shapes differ.

    Example:
        >>> q, x = Signal("q", "m"), (Signal("q", "m"), Signal("v", "m/s"))
        >>> curve = {"prior": {"rest": (np.array([0.0, 1.0]), np.ones((2, 2)))}}
        >>> len(gain_schedules(curve, position=q, states=x, input_signal=Signal("F", "N")).axes)
        2
    """
    if not schedules:
        raise InputError("gain schedule: there is nothing to draw [HM-PLOTS-005]")
    figure, axes = new_figure(1, len(states), sharex=True, size=(4.8 * len(states), 3.8))
    for name, points in schedules.items():
        for point, (q, gain) in points.items():
            values = checked(f"gains of {name}", gain, len(q), len(states))
            style: dict[str, Any] = {
                "color": colour(name), "linestyle": ":" if point == "rest" else "-", "marker": ".", "markersize": 4,
                "label": f"{name_of(name)}, {_POINTS.get(point, point)}",
            }  # fmt: skip
            for ax, column in zip(axes[0], values.T, strict=True):
                ax.plot(q, column, **style)
    for ax, signal in zip(axes[0], states, strict=True):
        ax.set_xlabel(axis_label(position))
        ax.set_ylabel(f"gain [{ratio_unit(input_signal, signal)}]")
        title_axes(ax, f"from {axis_label(signal)} to {axis_label(input_signal)}")
    shared_legend(figure, columns=2)
    return figure


def measured_bode(
    responses: Mapping[str, Mapping[str, Array]], *, input_signal: Signal, output_signal: Signal, source: str
) -> Figure:
    """Frequency responses of a machine and of models, all estimated with the same method.

    Frequencies without a significant coherence are drawn faint and without phase, because their phase is arbitrary.

    Args:
        responses: By name (``"measured"`` for the machine): ``omega`` [rad/s], complex ``response``, ``coherence``,
            standard ``deviation`` of the magnitude, and whether a frequency is ``trusted``, each ``(n,)``.
        input_signal: The input.
        output_signal: The output.
        source: Excitation and data, for the title.

    Raises:
        InputError: If there is no response.

    Example:
        >>> one = {"omega": np.array([1.0, 2.0]), "response": np.array([1 + 0j, -1j]),
        ...     "coherence": np.ones(2), "deviation": np.zeros(2), "trusted": np.ones(2, bool)}
        >>> u, y = Signal("v", "m/s"), Signal("q", "m")
        >>> len(measured_bode({"measured": one}, input_signal=u, output_signal=y, source="a multisine").axes)
        3
    """
    if not responses:
        raise InputError("measured response: there is nothing to draw [HM-PLOTS-006]")
    figure, axes = new_figure(3, 1, sharex=True, size=(9, 7.2), heights=(3, 2, 1.2))
    upper, middle, lower = axes[:, 0]
    doubtful = False
    for name, one in responses.items():
        omega = np.asarray(one["omega"], dtype=float)
        g = np.asarray(one["response"])
        shown = np.isfinite(g)
        w, size, there = omega[shown], np.abs(g[shown]), np.asarray(one["coherence"], dtype=float)[shown]
        sure = np.asarray(one["trusted"], dtype=bool)[shown]
        style = line_style(name) | {"linewidth": 1.4}
        if name == "measured":
            style |= {"linestyle": "none", "marker": "o", "markersize": 4, "markerfacecolor": "none"}
            spread = np.asarray(one["deviation"], dtype=float)[shown]
            band = np.maximum(size - 2 * spread, 1e-3 * size), size + 2 * spread
            upper.fill_between(w, *band, where=sure, color=FAINT, alpha=0.25, linewidth=0)
        if not sure.all():
            doubtful = True
            faint = style | {"alpha": 0.2, "zorder": 2.0, "label": "_"}
            upper.loglog(w, size, **faint)
            lower.semilogx(w, there, **faint)
        phase = np.full(w.shape, np.nan)
        phase[sure] = np.degrees(np.unwrap(np.angle(g[shown][sure])))
        upper.loglog(w, np.where(sure, size, np.nan), **style)
        middle.semilogx(w, phase, **style)
        lower.semilogx(w, np.where(sure, there, np.nan), **style)
    if doubtful:
        text = "faint, without phase: coherence not higher than that of unrelated signals"
        lower.plot([], [], color=INK, alpha=0.2, label=text)
    upper.set_ylabel(f"magnitude\n[{ratio_unit(output_signal, input_signal)}]")
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
    """Unit step responses of linearizations, one panel for each point of linearization.

    Args:
        curves: By point (``"rest"``), then by model: times ``(n,)`` [s] and output per unit of the input ``(n,)``.
        input_signal: The input.
        output_signal: The output.

    Raises:
        InputError: If there is nothing to draw, or lengths differ.

    Example:
        >>> t = np.linspace(0.0, 1.0, 5)
        >>> u, y = Signal("v", "m/s"), Signal("q", "m")
        >>> len(step_responses({"rest": {"prior": (t, t)}}, input_signal=u, output_signal=y).axes)
        1
    """
    if not curves:
        raise InputError("step responses: there is nothing to draw [HM-PLOTS-007]")
    figure, axes = new_figure(1, len(curves), size=(3.4 * len(curves) + 1, 3.6))
    for ax, (point, models) in zip(axes[0], curves.items(), strict=True):
        for name, (t, y) in models.items():
            ax.plot(t, checked(f"step response of {name}", y, len(t)), **line_style(name))
        ax.set_xlabel("time [s]")
        title_axes(ax, _POINTS.get(point, point))
    axes[0, 0].set_ylabel(f"{plain(output_signal.name)} [{ratio_unit(output_signal, input_signal)}]")
    shared_legend(figure)
    return figure


def friction_damping(curves: Mapping[str, Mapping[str, Array]], *, working_speed: float, unit: str) -> Figure:
    """Equivalent damping of the friction over the speed: tangent at rest, secant, describing function, tangent.

    Args:
        curves: By model: ``speed`` ``(n,)``; ``secant``, ``harmonic`` (describing function) and ``moving`` (tangent in
            motion) ``(n,)`` [1/s]; ``tangent`` at rest, a number [1/s].
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
        raise InputError("friction: there is nothing to draw [HM-PLOTS-008]")
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
            color=MUTED,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
        )
        ax.set_xlabel(f"amplitude of the speed [{unit}]")
        title_axes(ax, name_of(name))
        plain_log(ax.xaxis, float(speed.min()), float(speed.max()))
    low = min(float(np.nanmin(np.asarray(c["secant"], dtype=float))) for c in curves.values())
    axes[0, 0].set_ylim(bottom=0.1 * max(low, 1e-6))
    axes[0, 0].set_ylabel("damping: acceleration over speed [1/s]")
    shared_legend(figure, ink=True)  # a panel's colour is its model's; dashes separate the kinds of damping
    return figure


def sensitivities(
    t: Array, relative: Mapping[str, Array], names: Sequence[str], *, output_signal: Signal
) -> Figure:
    """Relative sensitivities of a free run's output to the prior's parameters.

    Args:
        t: Times ``(n,)`` [s].
        relative: By model: change of the output per 100 % change of each parameter ``(n, n_p)``.
        names: Names of the parameters ``(n_p,)``.
        output_signal: The output.

    Raises:
        InputError: If there is nothing to draw, or shapes differ.

    Example:
        >>> t = np.linspace(0.0, 1.0, 5)
        >>> len(sensitivities(t, {"prior": np.zeros((5, 2))}, ["J", "d"], output_signal=Signal("q", "m")).axes)
        2
    """
    if not relative or not names:
        raise InputError("sensitivities: there is nothing to draw [HM-PLOTS-009]")
    figure, axes = new_figure(
        (len(names) + 1) // 2, 2, sharex=True, size=(10, 1.7 * ((len(names) + 1) // 2) + 1)
    )
    for j, (ax, parameter) in enumerate(zip(axes.ravel(), names, strict=False)):
        for name, values in relative.items():
            ax.plot(
                t, checked(f"sensitivity of {name}", values, len(t), len(names))[:, j], **line_style(name)
            )
        title_axes(ax, f"sensitivity to {plain(parameter)}")
    for ax in axes.ravel()[len(names) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    figure.supylabel(f"{axis_label(output_signal)} per 100 % change", fontsize=10, color=INK)
    shared_legend(figure)
    return figure
