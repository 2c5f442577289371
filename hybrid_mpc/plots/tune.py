"""Figures of ``hybrid-mpc tune``: validation error over the trials, and over each setting."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import FAINT, INK, new_figure, plain, plain_log, shared_legend

STATES: Mapping[str, tuple[str, str, str]] = {
    "complete": ("o", "#0072B2", "finished"),
    "pruned": ("x", "#E69F00", "pruned: last error"),
    "diverged": ("v", "#CC79A7", "diverged (at the upper edge)"),
}
"""Marker, colour and legend of each state of a trial."""
LABEL = "validation E_sim, best network [-]"


class Trial(Protocol):
    """A training with its settings (``identify.tune.TrialRow``)."""

    @property
    def number(self) -> int:
        """Number of the trial: 0, 1, ..."""

    @property
    def state(self) -> str:
        """A key of :data:`STATES`."""

    @property
    def value(self) -> float:
        """Validation error; infinite where the training diverged."""

    @property
    def values(self) -> Mapping[str, float]:
        """The searched settings."""


def history(trials: Sequence[Trial], *, base: float | None = None) -> Figure:
    """Validation error over the number of the trial, with the best error so far.

    ``base`` is the validation error of the initial settings; by default it is not drawn.
    """
    figure, axes = new_figure(1, 1)
    ax = axes[0, 0]
    _points(ax, trials, [float(trial.number) for trial in trials])
    done = [trial for trial in trials if trial.state == "complete"]
    best = np.minimum.accumulate([trial.value for trial in done])
    ax.step([t.number for t in done], best, color=INK, linewidth=1.2, where="post", label="best so far")
    if base is not None:
        ax.axhline(base, color=FAINT, linestyle="--", linewidth=1.2, label="settings it started from")
    ax.set_xlabel("trial [-]")
    ax.set_ylabel(LABEL)
    ax.xaxis.get_major_locator().set_params(integer=True)
    shared_legend(figure)
    return figure


def settings(trials: Sequence[Trial], names: Sequence[str]) -> Figure:
    """Validation error over each searched setting, one panel for each setting."""
    if not names:
        raise InputError(
            "plot of a search: no setting to draw; pass the names of searched settings [HM-PLOTS-034]"
        )
    figure, axes = new_figure(1, len(names), sharey=True)
    for ax, name in zip(axes[0], names, strict=True):
        at = [float(trial.values[name]) for trial in trials]
        _points(ax, trials, at)
        ax.set_xscale("log")
        plain_log(ax.xaxis, min(at), max(at))
        ax.set_xlabel(f"{'hidden units z' if name == 'hidden' else plain(name.replace('_', ' '))} [-]")
    axes[0, 0].set_ylabel(LABEL)
    shared_legend(figure)
    return figure


def _points(ax: Axes, trials: Sequence[Trial], at: Sequence[float]) -> None:
    """Draw one point for each trial on a logarithmic axis; an infinite value lies at the upper edge."""
    finite = [trial.value for trial in trials if math.isfinite(trial.value) and trial.value > 0]
    if not finite:
        raise InputError(
            "plot of a search: no trial has a finite, positive validation error; there is nothing to draw"
            " [HM-PLOTS-035]"
        )
    low, high = min(finite) / 1.08, max(finite) * 1.08
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    plain_log(ax.yaxis, low, high)
    for state, (marker, ink, label) in STATES.items():
        points = [(x, min(t.value, high)) for x, t in zip(at, trials, strict=True) if t.state == state]
        if points:
            ax.plot(*zip(*points, strict=True), marker, color=ink, label=label, clip_on=False, zorder=3)
