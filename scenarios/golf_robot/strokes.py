"""The figure of the golf robot's strokes: how fast and how punctual each controller meets the ball. No torch here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from hybrid_mpc import LoopRow

Array = NDArray[np.float64]
SPEED_TARGET = 1.0  # [%]
TIMING_TARGET = 10.0  # [ms]


def figures(rows: Sequence[LoopRow]) -> dict[str, tuple[Figure, str]]:
    """The figure of the strokes among ``rows`` with its caption; nothing where there is no stroke.

    Above the speed error [%], below the timing error [ms], over the target speed: every stroke small, the mean of a
    target speed large. The legend gives mean absolute errors, and how many strokes never came past the ball.
    """
    from hybrid_mpc.plots import colour, name_of, new_figure, shared_legend, title_axes

    data = _by_controller(rows)
    if not data:
        return {}
    figure, axes = new_figure(2, 1, sharex=True, size=(9, 6.0))
    panels = ("speed error [%]", SPEED_TARGET, "%"), ("timing error [ms]", TIMING_TARGET, "ms")
    speeds = np.unique(np.concatenate([strokes[:, 0] for strokes in data.values()]))
    for column, (ax, (label, target, unit)) in enumerate(zip(axes[:, 0], panels, strict=True), start=1):
        ax.axhspan(-target, target, color="#009E73", alpha=0.13, linewidth=0)
        ax.axhline(0.0, color=colour(""), linewidth=0.8)
        title_axes(ax, f"band: target, within {target:g} {unit}; large: mean of a target speed")
        ax.set_ylabel(label)
        for i, (name, strokes) in enumerate(data.items()):
            beside = 0.72 * ((i + 0.5) / len(data) - 0.5)
            for k, speed in enumerate(speeds):
                own = strokes[strokes[:, 0] == speed, column]
                own = own[np.isfinite(own)]
                ax.plot(np.full(len(own), k + beside), own, ".", color=colour(name), markersize=4, alpha=0.45)
                if len(own):
                    ax.plot(k + beside, own.mean(), "o", color=colour(name), markersize=7, zorder=4)
            ax.plot([], [], "o", color=colour(name), label=f"{name_of(name)}{_mean_errors(strokes)}")
        _scale(ax, np.concatenate([strokes[:, column] for strokes in data.values()]), target)
    axes[1, 0].set_xlabel("target speed of the club [rad/s]")
    axes[1, 0].set_xticks(range(len(speeds)), [f"{speed:g}" for speed in speeds])
    axes[1, 0].set_xlim(-0.5, len(speeds) - 0.5)
    shared_legend(figure, columns=2)
    figure.legends[0].set_title("mean absolute errors of the strokes that met the ball")
    return {"strokes": (figure, "Strokes at the true crossing; bands: 1 % and 10 ms.")}


def _by_controller(rows: Sequence[LoopRow]) -> Mapping[str, Array]:
    """Target speed [rad/s], speed error [%] and timing error [ms] ``(n, 3)`` of each controller's strokes."""
    keys = ("speed_rad_s", "speed_error_rel", "timing_error_s")
    found: dict[str, list[list[float]]] = {}
    for row in rows:
        if all(key in row.figures for key in keys):
            found.setdefault(row.controller, []).append([row.figures[key] for key in keys])
    return {name: np.array(strokes) * (1.0, 100.0, 1000.0) for name, strokes in found.items()}


def _mean_errors(strokes: Array) -> str:
    met = strokes[np.isfinite(strokes).all(axis=1)]
    missed = f", {len(strokes) - len(met)} of {len(strokes)} missed" if len(met) < len(strokes) else ""
    if not len(met):
        return f": all {len(strokes)} missed"
    speed, timing = np.abs(met[:, 1:]).mean(axis=0)
    return f": {speed:.3g} %, {timing:.3g} ms{missed}"


def _scale(ax: Axes, errors: Array, target: float) -> None:
    """Room for the band; beyond it the axis is logarithmic where the errors span more than ten bands."""
    top = max(1.5 * target, 1.15 * float(np.abs(errors[np.isfinite(errors)]).max(initial=0.0)))
    if top > 10 * target:
        ax.set_yscale("symlog", linthresh=target, linscale=1.0)
        decades = range(math.ceil(math.log10(top / target)))
        ticks = np.array([target * s * 10.0**k for k in decades for s in (1, 3)])
        ticks = ticks[ticks <= top]
        ticks = np.concatenate([-ticks[::-1], [0.0], ticks])
        ax.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
    ax.set_ylim(-top, top)
