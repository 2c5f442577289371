"""Free runs over unseen recordings of a machine, beside the measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.plots.style import (
    INK,
    Array,
    axis_label,
    checked,
    colour,
    line_style,
    name_of,
    new_figure,
    shared_legend,
)
from hybrid_mpc.signals import Signal

SHOWN = 20.0
"""Length [s] of what is drawn sample by sample; of a longer run the rest is in the errors' course."""
COURSE = 200
"""Points of the course of the errors over the whole run."""


def benchmark_run(
    t: Array,
    y: Array,
    predictions: Mapping[str, Array],
    u: Array,
    *,
    output: Signal,
    inputs: Sequence[Signal],
    unit: str,
    scale: float,
    title: str = "",
    names: Mapping[str, str] | None = None,
) -> Figure:
    """A free run over a recording: output, errors, inputs, and the errors' course over the whole run.

    Args:
        t: Times ``(n,)`` [s].
        y: Measured output ``(n,)``.
        predictions: Output of each model's free run ``(n,)``.
        u: Inputs ``(n, n_u)``.
        output: Signal of ``y``.
        inputs: Signals of ``u``.
        unit: Unit of the errors.
        scale: Errors' units in an SI unit.
        title: Title. Default: none.
        names: How models are to be called in the legend, where not as everywhere. Default: none.

    Returns:
        The figure. The first 20 s of a longer run are drawn; the last row has all of it.

    Raises:
        InputError: If shapes do not fit.

    Example:
        >>> t, y = 0.1 * np.arange(50), np.zeros(50)
        >>> figure = benchmark_run(t, y, {"phy": y + 0.1}, y, output=Signal("q", "m"), inputs=(Signal("F", "N"),),
        ...                        unit="mm", scale=1e3)
        >>> len(figure.axes)
        4
    """
    t = np.asarray(t, dtype=float)
    y, u = checked("y", y, len(t)), checked("u", u, len(t), len(inputs))
    runs = {name: checked(f"free run of {name}", run, len(t)) for name, run in predictions.items()}
    heights = [1.8, 1.3, *[0.8] * len(inputs), 1.3]
    figure, axes = new_figure(
        len(heights), 1, heights=heights, title=title, size=(10, 0.8 + 1.3 * sum(heights))
    )
    column, near = axes[:, 0], t <= t[0] + SHOWN
    column[0].plot(t[near], y[near], **(line_style("measured") | {"linewidth": 2.2, "alpha": 0.85}))
    room = 0.3 * max(float(np.ptp(y[near])), 1e-9)
    for name, run in runs.items():
        label = (names or {}).get(name, name_of(name))
        column[0].plot(t[near], run[near], **(line_style(name) | {"label": label}))
        column[1].plot(t[near], scale * (run - y)[near], color=colour(name), linewidth=1.0, label=label)
        at, course = _course(t, scale * (run - y))
        column[-1].plot(at, course, color=colour(name), linewidth=1.4)
    column[0].set_ylim(y[near].min() - room, y[near].max() + room)  # a model that runs away flattens no other
    worst = [float(np.abs(scale * (run - y)[near]).max()) for run in runs.values()]
    best = min((value for value in worst if np.isfinite(value)), default=0.0)
    if best > 0:
        column[1].set_ylim(-1.5 * best, 1.5 * best)
    column[-1].set_yscale("log")
    column[0].set_ylabel(axis_label(output))
    column[1].set_ylabel(f"error [{unit}]")
    column[-1].set_ylabel(f"RMS error [{unit}]")
    for i, signal in enumerate(inputs):
        column[2 + i].plot(t[near], u[near, i], color=INK, linewidth=0.9, drawstyle="steps-post")
        column[2 + i].set_ylabel(axis_label(signal))
        size = max(float(np.abs(u[near, i]).max()), 1e-9)
        if np.ptp(u[near, i]) < 1e-6 * size:  # a constant input is drawn as one, not its rounding
            column[2 + i].set_ylim(float(u[near, i].mean()) - size, float(u[near, i].mean()) + size)
    for ax in column:
        ax.margins(x=0)
    column[-2].set_xlabel("time [s]")
    column[-1].set_xlabel("time [s], the whole run")
    figure.align_ylabels(list(column))
    shared_legend(figure, columns=6)
    return figure


def _course(t: Array, error: Array) -> tuple[Array, Array]:
    """Root mean square of the error over short parts of the run, at their middles."""
    parts = np.array_split(np.arange(len(t)), min(COURSE, max(1, len(t) // 5)))
    rms = np.array([np.sqrt(np.mean(error[part] ** 2)) for part in parts])
    return np.array([t[part].mean() for part in parts]), np.maximum(rms, 1e-12)
