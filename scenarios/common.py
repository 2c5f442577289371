"""What more than one machine's scenario is made of. No torch in here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import InputError, Role, Window, write_csv

if TYPE_CHECKING:
    from hybrid_mpc import Prior

Array = NDArray[np.float64]
ROLES: tuple[Role, ...] = ("train", "valid", "test")
"""Roles of simulated recordings; their order enters the seeds."""


@dataclass(frozen=True)
class LazyPrior:
    """A scenario's prior that is imported, and torch with it, when it is made."""

    module: str
    name: str

    def __call__(self, values: Mapping[str, float] | None = None) -> Prior:
        """The prior with the given parameter values."""
        prior: Prior = getattr(import_module(self.module), self.name)(values)
        return prior


def whole_windows(stems: Iterable[str], seconds: float) -> dict[str, tuple[Window, ...]]:
    """Windows of recordings each of which has one role, with which its stem begins."""
    return {stem: (Window(0.0, seconds, role),) for role in ROLES for stem in stems if stem.startswith(role)}


def sizes_of(machine: str, budget: str, sizes: Mapping[str, Mapping[Role, int]]) -> Mapping[Role, int]:
    """Recordings of each role in a budget."""
    if budget not in sizes:
        raise InputError(f"{machine}: no budget {budget!r}; it has: {', '.join(sizes)} [HM-SCENARIOS-001]")
    return sizes[budget]


def write_tables(folder: Path, tables: Iterable[tuple[str, Array]], columns: Sequence[str]) -> list[Path]:
    """Tables ``(n, columns)`` by stem as CSV files with six decimals; the files."""
    return [
        write_csv(folder / f"{stem}.csv", dict(zip(columns, table.T, strict=True)), decimals=6)
        for stem, table in tables
    ]


def faded_sines(t: Array, waves: tuple[tuple[float, float], ...], fade_s: float = 1.0) -> Array:
    """Sum of sinusoids that is faded in, from rest and without a jump in the acceleration.

    Example:
        >>> faded_sines(np.array([0.0, 1.25]), ((0.5, 1.0),)).round(6).tolist()
        [[0.0, 0.0], [0.5, 0.0]]
    """
    fade, slope = quintic(t / fade_s)
    parts = [(a, 2 * np.pi * f) for a, f in waves]
    wave = sum((a * np.sin(w * t) for a, w in parts), np.zeros_like(t))
    rate = sum((a * w * np.cos(w * t) for a, w in parts), np.zeros_like(t))
    return np.column_stack([fade * wave, slope / fade_s * wave + fade * rate])


def quintic(s: Array) -> tuple[Array, Array]:
    """From 0 to 1 while ``s`` does, with slope and curvature zero at both ends; and its slope."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2


def moves(t: Array, levels: Sequence[float], hold_s: float, move_s: float) -> Array:
    """From level to level, each for ``hold_s``, along a quintic of ``move_s``.

    A bare jump cannot be followed by anyone, and what it costs hides all differences. Gives position and exact
    derivative ``(n, 2)``; ``hold_s`` [s] is the time from the begin of a move to that of the next.

    Example:
        >>> moves(np.array([0.0, 1.3, 1.7, 2.2]), (0.0, 0.4), 1.3, 0.8).round(2).tolist()
        [[0.0, 0.0], [0.0, 0.0], [0.2, 0.94], [0.4, 0.0]]
    """
    index = np.clip(np.floor(t / hold_s + 1e-9).astype(int), 0, len(levels) - 1)
    before = np.array(levels)[np.maximum(index - 1, 0)]
    rise = np.array(levels)[index] - before
    share, slope = quintic((t - index * hold_s) / move_s)
    return np.column_stack([before + rise * share, rise * (slope / move_s)])


def rk4(f: ca.Function, s: ca.SX, u: ca.SX, h: ca.SX | float) -> ca.SX:
    """One classical Runge-Kutta step of ``s_dot = f(s, u)`` over ``h`` [s]; order 4."""
    k1 = f(s, u)
    k2 = f(s + h / 2 * k1, u)
    k3 = f(s + h / 2 * k2, u)
    k4 = f(s + h * k3, u)
    return s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def repeated(one: ca.Function, n: int) -> ca.Function:
    """Function ``(s, u, h) -> s`` of ``n`` times ``one`` with the same ``u`` and ``h``."""
    s, u, h = (ca.MX.sym(label, one.size1_in(i)) for i, label in enumerate("suh"))
    return ca.Function("steps", [s, u, h], [one.fold(n)(s, ca.repmat(u, 1, n), ca.repmat(h, 1, n))])
