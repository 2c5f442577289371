"""Limits of inputs and states, of any sign, on one side or both."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]


def input_limits(u_min: ArrayLike, u_max: ArrayLike, n_u: int) -> tuple[Array, Array]:
    """Checked limits ``(n_u,)`` of the inputs; ``-inf`` and ``inf`` for none."""
    lower, upper = numbers(u_min, "u_min"), numbers(u_max, "u_max")
    if lower.shape != (n_u,) or upper.shape != (n_u,):
        raise InputError(f"u_min has {lower.size} and u_max {upper.size} values, {n_u} needed")
    if not np.all(lower < upper):
        raise InputError(
            f"input bounds cross: u_min {lower}, u_max {upper}; every u_min must be below its u_max"
        )
    return lower, upper


def numbers(values: ArrayLike, name: str) -> Array:
    """``values`` as a vector ``(n,)``, a copy; infinite ones and NaN too."""
    try:
        return np.array(values, dtype=float).ravel()
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: numbers needed, got {values!r}") from error


def share_used(values: ArrayLike, lower: ArrayLike, upper: ArrayLike, rest: ArrayLike = 0.0) -> float:
    """Largest share of the way from rest to a limit ``(n,)`` that values ``(m, n)`` use: 1 at the limit, more beyond.

    ``rest`` ``(n,)`` is the operating point's value; beyond a limit that limit stands for it. Where a limit is the
    rest value itself: 1 plus the violation over the whole range; infinite without a range.
    """
    value, low, high = (np.asarray(v, dtype=float) for v in (values, lower, upper))
    rest, span = np.clip(rest, low, high), high - low
    shares = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for way, room in ((value - rest, high - rest), (rest - value, rest - low)):
            beyond = np.where(way > 0, 1.0 + way / np.where(np.isfinite(span), span, 0.0), 0.0)
            shares.append(np.where(room > 0, way / room, beyond))
    return float(np.max(shares))
