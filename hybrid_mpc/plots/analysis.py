"""Figures of the linear analysis: poles in the z-plane, Bode plot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import (
    FAINT,
    Array,
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


def pole_map(poles: Mapping[str, Any], dt: float) -> Figure:
    """Poles of the linearised models in the z-plane; right, the slow poles near z = 1 enlarged.

    Args:
        poles: Eigenvalues ``(n,)``, complex, of each model's one-step map.
        dt: Model period [s]; sets the natural frequencies of the grid.

    Returns:
        The figure: unit circle (stable inside), lines of constant damping and natural frequency.

    Raises:
        InputError: If there is no pole or ``dt`` is not positive.
    """
    values = {m: np.ravel(np.asarray(p, dtype=complex)) for m, p in poles.items()}
    if not dt > 0 or not any(len(p) for p in values.values()):
        raise InputError(f"pole map: needs at least one pole and a positive dt, got dt = {dt}")
    figure, axes = new_figure(1, 2, size=(10, 5.4))
    extent = max(1.08, *(1.05 * float(np.abs(p).max()) for p in values.values() if len(p)))
    near = np.concatenate([p[np.abs(p - 1.0) < 0.35] for p in values.values()])
    half = max(0.02, 1.3 * float(np.abs(near - 1.0).max())) if len(near) else 0.3
    whole, zoom = axes[0]
    for ax in (whole, zoom):
        _z_grid(ax, dt)
        for model, p in values.items():
            open_marker = _MARKERS.get(model, "D") != "x"
            ax.scatter(
                p.real,
                p.imag,
                s=52,
                marker=_MARKERS.get(model, "D"),
                linewidths=1.6,
                facecolors="none" if open_marker else colour(model),
                **({"edgecolors": colour(model)} if open_marker else {}),
                label=name_of(model),
                zorder=4,
            )
        ax.set_aspect("equal")
        ax.set_xlabel("real part [-]")
        ax.set_ylabel("imaginary part [-]")
    whole.set_xlim(-extent, extent)
    whole.set_ylim(-extent, extent)
    zoom.set_xlim(1.0 - half, 1.0 + 0.35 * half)
    zoom.set_ylim(-0.675 * half, 0.675 * half)
    box = (1.0 - half, -0.675 * half), 1.35 * half, 1.35 * half
    whole.add_patch(Rectangle(*box, fill=False, edgecolor="black", linewidth=0.8, zorder=5))
    title_axes(whole, "z-plane (stable inside the circle)")
    title_axes(zoom, "enlarged: slow poles near z = 1")
    shared_legend(figure)
    return figure


def _z_grid(ax: Axes, dt: float) -> None:
    ax.grid(False)
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    ax.plot(np.cos(angle), np.sin(angle), color="black", linewidth=1.2)
    for damping in _DAMPING:
        omega = np.linspace(0.0, np.pi / np.sqrt(1.0 - damping**2), 300)
        z = np.exp(omega * (-damping + 1j * np.sqrt(1.0 - damping**2)))
        for side in (z, z.conj()):
            ax.plot(side.real, side.imag, color="#c9c9c9", linewidth=0.7, zorder=1)
        at = 60
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
    for share in np.arange(0.1, 1.01, 0.1):
        damping_angle = np.linspace(np.pi / 2, np.pi, 120)
        z = np.exp(share * np.pi * np.exp(1j * damping_angle))
        for side in (z, z.conj()):
            ax.plot(side.real, side.imag, color="#dedede", linewidth=0.7, zorder=1)
    ax.text(
        0.02,
        0.02,
        f"grid: damping ratio [-] and every\n{0.1 * np.pi / dt:.3g} rad/s of natural frequency",
        transform=ax.transAxes,
        fontsize=7.5,
        color="#555555",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5},
        zorder=6,
    )


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
    """
    if not responses:
        raise InputError("Bode plot: there is no model to draw")
    figure, axes = new_figure(2, 1, sharex=True, size=(9, 5.4))
    magnitude_ax, phase_ax = axes[:, 0]
    for model, (omega, magnitude, phase) in responses.items():
        omega = np.asarray(omega, dtype=float)
        line = line_style(model) | {"linewidth": 1.7}
        magnitude_ax.loglog(omega, checked(f"magnitude of {model}", magnitude, len(omega)), **line)
        phase_ax.semilogx(omega, np.degrees(checked(f"phase of {model}", phase, len(omega))), **line)
    for ax in (magnitude_ax, phase_ax):
        if nyquist is not None:
            ax.axvline(nyquist, color=FAINT, linestyle=":", label="Nyquist frequency")
        ax.grid(True, which="minor", color="#eeeeee", linewidth=0.4)
        ax.margins(x=0)
    unit = f"({output_signal.unit})/({input_signal.unit})"
    magnitude_ax.set_ylabel(f"magnitude\n[{unit}]")
    phase_ax.set_ylabel("phase [°]")
    phase_ax.set_xlabel("angular frequency [rad/s]")
    title_axes(magnitude_ax, f"from {input_signal.label} to {output_signal.label}".replace("_", " "))
    figure.align_ylabels([magnitude_ax, phase_ax])
    shared_legend(figure)
    return figure
