"""Figures of the training: both objectives, their bounds, and the validation metric."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import (
    FAINT,
    checked,
    colour,
    name_of,
    new_figure,
    plain_log,
    shared_legend,
    title_axes,
)

_ROWS = (
    ("loss_error", "bound_error", "error objective [-]"),
    ("loss_energy", "bound_energy", "energy objective [-]"),
    ("validation", None, "validation [-]"),
)


def curves(
    training: Mapping[str, Mapping[str, Any]],
    *,
    free_run_start: Mapping[str, float] | None = None,
    units: tuple[str, str, str] = ("-", "-", "-"),
) -> Figure:
    """Training curves of each model: two objectives with their never-rising bounds, and the validation.

    Args:
        training: By model, arrays of equal length: ``step``, ``loss_error`` and, where the model has
            them, ``loss_energy``, ``bound_error``, ``bound_energy``, ``validation``. NaN where a value
            was not taken at a step.
        free_run_start: Step at which a model's training turns from teacher forcing to free runs.
        units: Units of the error objective, the energy objective and the validation metric.

    Returns:
        The figure: one column a model, logarithmic axes up.

    Raises:
        InputError: If there is no model, ``step`` is missing, or lengths differ.

    Example:
        >>> data = {"step": [0, 1, 2], "loss_error": [3.0, 2.0, 1.0]}
        >>> len(curves({"rnn": data}).axes)
        3
    """
    if not training:
        raise InputError("plot of the training: there is no model to draw")
    figure, axes = new_figure(3, len(training), sharex="col", sharey="row", size=(10, 6.6))
    for column, (model, data) in zip(axes.T, training.items(), strict=True):
        if "step" not in data:
            raise InputError(f"plot of the training of {model}: no array 'step'; it has {', '.join(data)}")
        step = np.asarray(data["step"], dtype=float)
        for (
            ax,
            (loss, bound, _),
        ) in zip(column, _ROWS, strict=True):
            _curve(ax, model, step, data.get(loss), loss)
            if bound is not None and data.get(bound) is not None:
                values = checked(f"{bound} of {model}", data[bound], len(step))
                ax.plot(step, values, "k--", linewidth=1.2, drawstyle="steps-post", label="bound $c_j$")
            if free_run_start is not None and model in free_run_start:
                ax.axvline(free_run_start[model], color=FAINT, linestyle=":", label="free-run stage starts")
        title_axes(column[0], name_of(model))
        column[-1].set_xlabel("optimiser step [-]")
    for row, (_, _, label), unit in zip(axes, _ROWS, units, strict=True):
        row[0].set_ylabel(label.replace("[-]", f"[{unit}]"))
        if any(ax.get_yscale() == "log" for ax in row):
            plain_log(row[0].yaxis, *row[0].get_ylim())
    figure.align_ylabels(list(axes[:, 0]))
    shared_legend(figure)
    return figure


def _curve(ax: Axes, model: str, step: Any, values: Any, name: str) -> None:
    if values is None:
        ax.text(0.25, 0.5, "not used", transform=ax.transAxes, ha="center", color=FAINT, fontsize=9)
        return
    array = checked(f"{name} of {model}", values, len(step))
    taken = np.isfinite(array) & (array > 0)
    marker = "o" if name == "validation" else ""
    ax.plot(step[taken], array[taken], color=colour(model), lw=1.1, marker=marker, ms=3)
    if taken.any():
        ax.set_yscale("log")
