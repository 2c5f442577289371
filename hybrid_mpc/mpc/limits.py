"""Bounds of the inputs that come and go from solve to solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """Bounds of the inputs for one solve, tighter than the problem's own: what a guard asks for.

    Args:
        u_min: Lower bounds ``(n_u,)``; ``-inf`` for the problem's own.
        u_max: Upper bounds ``(n_u,)``; ``inf`` for the problem's own.

    Raises:
        InputError: If shapes differ, bounds cross, or one is NaN.

    Example:
        >>> Limits([-0.2], [0.2]).u_max
        array([0.2])
    """

    u_min: Array
    u_max: Array

    def __init__(self, u_min: ArrayLike, u_max: ArrayLike) -> None:
        lower, upper = np.asarray(u_min, dtype=float).ravel(), np.asarray(u_max, dtype=float).ravel()
        if lower.shape != upper.shape or not np.all(lower <= upper):
            raise InputError(
                f"limits: u_min {lower}, u_max {upper} given; needed: a u_min <= u_max for each input"
            )
        object.__setattr__(self, "u_min", lower)
        object.__setattr__(self, "u_max", upper)
