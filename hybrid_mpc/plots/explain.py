"""Figures of a search for missing terms: error after each step, and each term over its data."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots.style import FAINT, GOOD, INK, colour, new_figure, number, plain, shared_legend

WORDS = 38
"""Maximum characters of a line of a label."""
WAVES = 6.0
"""A term is drawn as a line while its total variation is at most this many times its range. A term beyond that also
depends on another signal, and is drawn as points."""


def error_steps(
    labels: Sequence[str], errors: Sequence[float], what: str, floor: float | None = None
) -> Figure:
    """Error of each model as a bar, from the nominal prior on, with the part that each step removed as a pale bar.

    Args:
        labels: Labels of the bars: ``"nominal"``, ``"fitted"``, then the terms that were added or removed.
        errors: Errors, not negative; an error that is not finite has no bar.
        what: Name and unit of the errors.
        floor: Error due to the sensors' noise alone. Default: not drawn.

    Raises:
        InputError: If no error is finite.

    Example:
        >>> figure = error_steps(["nominal", "fitted", "+ drag"], [0.5, 0.3, 0.1], "error [-]")
        >>> len(figure.axes)
        1
    """
    finite = [v for v in errors if math.isfinite(v)]
    if not finite:
        raise InputError("plot of the steps: there is no finite error [HM-PLOTS-020]")
    figure, axes = new_figure(1, 1, size=(10.0, 1.3 + 0.42 * len(labels)))
    ax, top = axes[0, 0], max(finite)
    for k, (value, before) in enumerate(zip(errors, [math.inf, *errors], strict=False)):
        if not math.isfinite(value):
            ax.text(0.0, k, "  diverged", va="center", fontsize=9, color=INK)
            continue
        ink = colour("phy_nominal") if k == 0 else colour("phy") if k == 1 else GOOD
        ax.barh(k, value, color=ink, height=0.62)
        if math.isfinite(before) and before > value:  # the part of the error that the step removed
            ax.barh(k, before - value, left=value, color=ink, alpha=0.18, height=0.62)
        ax.text(max(value, before if math.isfinite(before) else 0.0) + 0.01 * top, k, number(value),
                va="center", fontsize=9, color=INK)  # fmt: skip
    ax.set_yticks(range(len(labels)), [_break_lines(plain(label)) for label in labels])
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.32 * top)
    ax.set_xlabel(plain(what))
    ax.grid(visible=False, axis="y")
    if floor is not None:
        ax.axvline(floor, color=INK, linestyle="--", linewidth=1.0, label="sensor noise")
        shared_legend(figure)
    return figure


def term_over_data(
    at: Sequence[float],
    term: Sequence[float],
    low: Sequence[float],
    high: Sequence[float],
    data: Sequence[float] = (),
    *,
    abscissa: str,
    ordinate: str,
) -> Figure:
    """A term over its data: the fitted law with two standard errors, and its values according to the recordings.

    Args:
        at: Points on the horizontal axis that the recordings cover, increasing ``(n,)``.
        term: Value of the term at each point ``(n,)``.
        low: Value of the term minus two standard errors ``(n,)``.
        high: Value of the term plus two standard errors ``(n,)``.
        data: Value of the missing term according to the recordings ``(n,)``. Default: not drawn.
        abscissa: Label of the horizontal axis.
        ordinate: Label of the vertical axis.

    Example:
        ``term_over_data(**vars(explanation.steps[0].pictures[0]))``
    """
    figure, axes = new_figure(1, 1, size=(8.0, 3.6))
    ax = axes[0, 0]
    if len(data):
        ax.plot(at, data, ".", color=FAINT, markersize=4, alpha=0.7, label="according to the recordings")
        reach = np.concatenate([low, high, np.quantile(data, [0.02, 0.98])])
        margin = 0.15 * (reach.max() - reach.min()) or 1.0
        ax.set_ylim(reach.min() - margin, reach.max() + margin)
    ax.fill_between(at, low, high, color=colour("phy"), alpha=0.25, linewidth=0, label="two standard errors")
    line = np.abs(np.diff(term)).sum() <= WAVES * np.ptp(term)
    ax.plot(
        at, term, "-" if line else ".", color=colour("phy"), linewidth=1.8, markersize=5, label="the term"
    )
    ax.set_xlabel(plain(abscissa))
    ax.set_ylabel(_break_lines(plain(ordinate)))
    shared_legend(figure)
    return figure


def _break_lines(text: str) -> str:
    """Break a long label into lines of at most ``WORDS`` characters."""
    if len(text) <= WORDS:
        return text
    words, lines = text.split(), [""]
    for word in words:
        if len(lines[-1]) + len(word) >= WORDS and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)
