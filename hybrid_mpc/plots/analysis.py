"""Figures of the linear analysis: poles in the z-plane, Bode plot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MultipleLocator

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import (
    FAINT,
    Array,
    axis_label,
    checked,
    colour,
    line_style,
    name_of,
    new_figure,
    shared_legend,
    title_axes,
)
from hybrid_mpc.signals import Signal

_MARKERS = {"phy": "x", "prior": "x", "mopgrnn": "o", "hybrid": "o", "oracle": "s"}
_DAMPING = (0.1, 0.3, 0.5, 0.7, 0.9)


def pole_map(poles: Mapping[str, Any], dt: float, *, zeros: Mapping[str, Any] | None = None) -> Figure:
    """Poles (and zeros) of the linearised models in the z-plane; right, the slow ones near z = 1 enlarged.

    Args:
        poles: Eigenvalues ``(n,)``, complex, of each model's one-step map.
        dt: Model period [s]; sets the natural frequencies of the grid.
        zeros: Zeros ``(n,)``, complex, by model: then poles are crosses and zeros circles, and the title counts zeros
            that lie outside of the frame. Default: none, and the markers tell the models apart.

    Returns:
        The figure: unit circle (stable inside), lines of constant damping and natural frequency.

    Raises:
        InputError: If there is no pole or ``dt`` is not positive.

    Example:
        >>> len(pole_map({"phy": [0.9 + 0.1j, 0.9 - 0.1j]}, 0.02).axes)
        2
    """
    values = {m: np.ravel(np.asarray(p, dtype=complex)) for m, p in poles.items()}
    nulls = {m: np.ravel(np.asarray(z, dtype=complex)) for m, z in (zeros or {}).items()}
    if not dt > 0 or not any(len(p) for p in values.values()):
        raise InputError(f"pole map: needs at least one pole and a positive dt, got dt = {dt}")
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
    outside = f", {away} zero{'s' * (away != 1)} outside of the frame" if away else ""
    title_axes(whole, f"z-plane, stable inside the circle{outside}\n" + grid.format(0.1 * np.pi / dt))
    title_axes(zoom, "the frame enlarged: slow poles near z = 1\n" + grid.format(_round(half / dt / 5)))
    shared_legend(figure)
    return figure


def _points(ax: Axes, model: str, z: Any, marker: str, label: str) -> None:
    ink: dict[str, Any] = {"facecolors": colour(model)}
    if marker != "x":
        ink = {"facecolors": "none", "edgecolors": colour(model)}
    ax.scatter(z.real, z.imag, s=52, marker=marker, linewidths=1.6, label=label, zorder=4, **ink)


def _half_width(near: Any) -> float:
    """Size of the enlarged frame [1 - h, 1 + 0.35 h] x [-0.675 h, 0.675 h] that holds all these poles."""
    if not len(near):
        return 0.3
    d = near - 1.0
    reach = np.maximum.reduce([-d.real, d.real / 0.35, np.abs(d.imag) / 0.675])
    return max(0.02, 1.2 * float(reach.max()))


def _round(value: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten below ``value``."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1.0, 2.0, 5.0) if step <= value / power + 1e-9) * power)


def _z_grid(ax: Axes, dt: float, spacing: float, reach: float) -> None:
    ax.grid(False)
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    ax.plot(np.cos(angle), np.sin(angle), color="black", linewidth=1.2)
    for damping in _DAMPING:
        omega = np.linspace(0.0, np.pi / np.sqrt(1.0 - damping**2), 2000)
        z = np.exp(omega * (-damping + 1j * np.sqrt(1.0 - damping**2)))
        for side in (z, z.conj()):
            ax.plot(side.real, side.imag, color="#c9c9c9", linewidth=0.7, zorder=1)
        at = int(np.argmin(np.abs(np.abs(z - 1.0) - reach)))
        ax.annotate(
            f"{damping:g}",
            (z[at].real, z[at].imag),
            fontsize=7,
            color=FAINT,
            ha="center",
            va="center",
            clip_on=True,
            annotation_clip=True,
        )
    turns = np.arange(spacing * dt, np.pi * 1.001, spacing * dt)
    for turn in turns[:40]:
        damping_angle = np.linspace(np.pi / 2, np.pi, 120)
        z = np.exp(turn * np.exp(1j * damping_angle))
        for side in (z, z.conj()):
            ax.plot(side.real, side.imag, color="#dedede", linewidth=0.7, zorder=1)


def bode(
    responses: Mapping[str, tuple[Array, Array, Array]],
    *,
    input_signal: Signal,
    output_signal: Signal,
    nyquist: float | None = None,
) -> Figure:
    """Frequency responses of the linearised models from one input to one output.

    Args:
        responses: By model: angular frequencies ``(n,)`` [rad/s], magnitude ``(n,)`` [output unit / input
            unit], phase ``(n,)`` [rad].
        input_signal: The input.
        output_signal: The output.
        nyquist: Highest meaningful frequency ``pi / dt`` [rad/s]; drawn as a line. Default: none.

    Returns:
        The figure: magnitude and phase over frequency.

    Raises:
        InputError: If there is no model or lengths differ.

    Example:
        >>> omega = np.array([0.1, 1.0, 10.0])
        >>> response = (omega, 1 / omega, np.full(3, -np.pi / 2))
        >>> u, y = Signal("v", "m/s"), Signal("q", "m")
        >>> len(bode({"phy": response}, input_signal=u, output_signal=y).axes)
        2
    """
    if not responses:
        raise InputError("Bode plot: there is no model to draw")
    figure, axes = new_figure(2, 1, sharex=True, size=(9, 5.4))
    magnitude_ax, phase_ax = axes[:, 0]
    lowest, phases = np.inf, []
    for model, (omega, magnitude, phase) in responses.items():
        omega = np.asarray(omega, dtype=float)
        line = line_style(model) | {"linewidth": 1.7}
        size = checked(f"magnitude of {model}", magnitude, len(omega))
        angle = np.degrees(checked(f"phase of {model}", phase, len(omega)))
        # at the Nyquist frequency itself a sampled response is real: its size may vanish, its phase jump
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
    unit = "/".join(f"({s.unit})" if " " in s.unit else s.unit for s in (output_signal, input_signal))
    magnitude_ax.set_ylabel(f"magnitude\n[{unit}]")
    phase_ax.set_ylabel("phase [°]")
    phase_ax.set_xlabel("angular frequency [rad/s]")
    title_axes(magnitude_ax, f"from {axis_label(input_signal)} to {axis_label(output_signal)}")
    phase_ax.yaxis.set_major_locator(MultipleLocator(45 if np.ptp(np.concatenate(phases)) < 270 else 90))
    figure.align_ylabels([magnitude_ax, phase_ax])
    shared_legend(figure)
    return figure
