"""Figures of the recordings: signals over time, role of each part, covered states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    Array,
    axis_label,
    checked,
    colour,
    finish_column,
    name_of,
    new_column,
    new_figure,
    plain,
    shared_legend,
    title_axes,
)

ROLES = ("train", "valid", "test")


class Recording(Protocol):
    """Fields of a contiguous piece of a recording that a figure needs (``data.Trajectory`` has all of them)."""

    @property
    def name(self) -> str:
        """``"<file stem>"`` or ``"<file stem>#2"`` for a later piece."""

    @property
    def role(self) -> str:
        """``"train"``, ``"valid"`` or ``"test"``."""

    @property
    def t(self) -> Array:
        """Times ``(n,)`` [s]."""

    @property
    def u(self) -> Array:
        """Inputs ``(n, n_u)``."""

    @property
    def y(self) -> Array:
        """Measured outputs ``(n, n_y)``."""

    @property
    def w(self) -> Array:
        """Measured disturbances ``(n, n_w)``."""

    @property
    def x(self) -> Array:
        """Smoothed states ``(n, n_x)``."""


def recordings(
    trajectories: Sequence[Recording],
    outputs: Sequence[Signal],
    inputs: Sequence[Signal],
    *,
    disturbances: Sequence[Signal] = (),
    limit: int = 4,
) -> Figure:
    """Some recordings over time, one row for each file; the shade of a part is its role.

    Args:
        trajectories: Pieces of recordings; pieces of one file (same stem) share a row.
        outputs: Signals of ``y``.
        inputs: Signals of ``u``.
        disturbances: Signals of the trajectories' ``w`` (measured disturbances). Default: none drawn.
        limit: Maximum number of files; they are chosen so that every role appears. Default: 4.

    Raises:
        InputError: If there is no trajectory, or its shapes do not fit the signals.

    Example:
        >>> import numpy as np
        >>> from types import SimpleNamespace as Piece
        >>> t, y = np.array([0.0, 0.1]), np.zeros((2, 1))
        >>> piece = Piece(name="a", role="train", t=t, y=y, u=y, x=np.zeros((2, 2)))
        >>> len(recordings([piece], [Signal("q", "m")], [Signal("F", "N")]).axes)
        2
    """
    chosen = _choose(trajectories, limit)
    signals = (*outputs, *inputs, *disturbances)
    size = (max(10.0, 2.6 * len(signals)), 0.9 + 1.75 * len(chosen))
    figure, axes = new_figure(len(chosen), len(signals), sharey="col", size=size)
    for row, (stem, pieces) in zip(axes, chosen.items(), strict=True):
        for piece in pieces:
            y = checked(f"y of {piece.name}", piece.y, len(piece.t), len(outputs))
            u = checked(f"u of {piece.name}", piece.u, len(piece.t), len(inputs))
            columns = [*y.T, *u.T]
            if disturbances:
                columns += [*checked(f"w of {piece.name}", piece.w, len(piece.t), len(disturbances)).T]
            for i, (ax, values) in enumerate(zip(row, columns, strict=True)):
                shade = name_of(piece.role)
                ax.axvspan(piece.t[0], piece.t[-1], color=colour(piece.role), alpha=0.22, lw=0, label=shade)
                step = "steps-post" if i >= len(outputs) else "default"
                ax.plot(piece.t, values, color="black", linewidth=0.9, drawstyle=step)
        title_axes(row[0], plain(stem))
    for ax, signal in zip(axes.T, signals, strict=True):
        for one in ax:
            one.set_ylabel(axis_label(signal))
            one.margins(x=0)
        ax[-1].set_xlabel("time [s]")
    shared_legend(figure)
    return figure


def coverage(
    trajectories: Sequence[Recording], states: Sequence[Signal], pairs: Sequence[tuple[int, int]] = ()
) -> Figure:
    """States that the training data and the test data cover.

    Args:
        trajectories: Pieces of recordings.
        states: Signals of ``x``.
        pairs: Columns of ``x`` of each position and its speed: one phase portrait for each pair. Default: none; every
            state is then drawn over time.

    Raises:
        InputError: If there is no trajectory, or its shapes do not fit the signals.

    Example:
        >>> import numpy as np
        >>> from types import SimpleNamespace as Piece
        >>> piece = Piece(name="a", role="train", t=np.zeros(2), x=np.zeros((2, 2)))
        >>> states = [Signal("q", "m"), Signal("v", "m/s")]
        >>> len(coverage([piece], states, [(0, 1)]).axes), len(coverage([piece], states).axes)
        (1, 2)
    """
    if not trajectories:
        raise InputError("plot of the coverage: there is no recording to draw [HM-PLOTS-017]")
    shown = [piece for role in ("train", "test") for piece in trajectories if piece.role == role]
    if pairs:
        size = (6.8 if len(pairs) == 1 else 5.0 * len(pairs), 4.6)
        figure, axes = new_figure(1, len(pairs), size=size)
        panels = list(axes[0])
    else:
        figure, panels = new_column([1.4] * len(states))
    for piece in shown:
        x = checked(f"x of {piece.name}", piece.x, len(piece.t), len(states))
        look = {"color": colour(piece.role), "label": name_of(piece.role)}
        width = 2.4 if piece.role == "train" else 1.0
        for (q, v), ax in zip(pairs, panels, strict=False):
            position = _wrap(x[:, q], states[q].period / 2) if states[q].periodic else x[:, q]
            ax.plot(position, x[:, v], linewidth=width, **look)
        for values, ax in zip(() if pairs else x.T, panels, strict=False):
            ax.plot(piece.t, values, linewidth=1.2, **look)
    for (q, v), ax in zip(pairs, panels, strict=False):
        ax.set_xlabel(axis_label(states[q]))
        ax.set_ylabel(axis_label(states[v]))
    if pairs:
        shared_legend(figure)
        return figure
    for signal, ax in zip(states, panels, strict=True):
        ax.set_ylabel(axis_label(signal))
    finish_column(figure, panels)
    return figure


def _wrap(angle: Array, half: float) -> Array:
    """Wrap an angle to half a turn around zero; NaN where it jumps to the other side, so no line joins the two."""
    within = (angle + half) % (2.0 * half) - half
    jumps = np.abs(np.diff(within, append=within[-1:])) > half
    return np.where(jumps, np.nan, within)


def _choose(trajectories: Sequence[Recording], limit: int) -> dict[str, list[Recording]]:
    """Choose at most ``limit`` files, with every role among them; pieces by file stem."""
    if not trajectories:
        raise InputError("plot of the recordings: there is no recording to draw [HM-PLOTS-018]")
    files: dict[str, list[Recording]] = {}
    for piece in trajectories:
        files.setdefault(piece.name.split("#")[0], []).append(piece)
    picked: list[str] = []
    for role in ROLES:
        first = [stem for stem, pieces in files.items() if any(p.role == role for p in pieces)]
        picked += [stem for stem in first[:1] if stem not in picked]
    picked = picked[:limit]
    picked += [stem for stem in files if stem not in picked][: limit - len(picked)]
    return {stem: pieces for stem, pieces in files.items() if stem in picked}
