"""How fast neighbouring free runs part: the largest Lyapunov exponent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.analysis.along import linearize_along
from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel

Array = NDArray[np.float64]
SETTLE = 0.2
"""Share of the run in which the tangent vector turns into its direction; it does not count."""
BLOCKS = 10


@dataclass(frozen=True)
class LyapunovExponent:
    """Mean rate at which the distance of neighbouring runs grows along a run.

    Args:
        value: Exponent [1/s]; negative: they come together.
        deviation: Standard deviation of its mean over ten stretches of the run [1/s].
        growth: Logarithm of the distance over the first one ``(n + 1,)``, for a plot.
    """

    value: float
    deviation: float
    growth: Array


def lyapunov_exponent(
    model: HybridModel, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None,
    *, part: Literal["all", "hidden"] = "all", seed: int = 0,
) -> LyapunovExponent:  # fmt: skip
    """Largest Lyapunov exponent along a free run (or along a measured trajectory), by its tangent map.

    With ``part="hidden"`` the states are given and only the hidden state's own map counts: negative means that along
    this trajectory the network forgets where its hidden state began. Unlike a certificate this speaks of one run.

    Args:
        model: The model.
        x: Start ``(n_x,)`` of a free run, or a trajectory ``(n, n_x)``.
        u: Inputs ``(n, n_u)``.
        h: Hidden state at the start ``(n_h,)``. Default: zero.
        part: ``"all"`` or ``"hidden"``.
        seed: Of the first tangent vector.

    Raises:
        InputError: If the run is shorter than 50 periods or not finite, a shape does not fit, or there is no hidden
            state.

    Source: Benettin, Galgani, Giorgilli, Strelcyn, *Lyapunov characteristic exponents*, Meccanica 15 (1980).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("lag", 0.1, level, (Signal("u", "-"),), level,
        ...     x=x, u=u, x_next=0.9 * x + u, xdot=u, y=x)
        >>> round(lyapunov_exponent(model, [1.0], np.zeros((100, 1))).value, 6)  # log(0.9) / 0.1
        -1.053605
    """
    along = linearize_along(model, x, u, h)
    maps = along.A
    if part == "hidden":
        if not model.n_h:
            raise InputError(f"model {model.name} has no hidden state")
        maps = maps[:, model.n_x :, model.n_x :]
    n = len(maps)
    if n < 50:
        raise InputError(f"Lyapunov exponent: {n} periods given, at least 50 needed for a mean over time")
    v: Array = np.asarray(np.random.default_rng(seed).normal(size=maps.shape[1]), dtype=np.float64)
    v = np.asarray(v / np.linalg.norm(v))
    steps = np.empty(n)
    for k, a in enumerate(maps):
        v = np.asarray(a @ v)
        size = float(np.linalg.norm(v))
        if not size > 0:
            raise InputError(
                "Lyapunov exponent: a step forgets everything at once; the exponent is minus infinity"
            )
        steps[k] = np.log(size)
        v = np.asarray(v / size)
    counted = steps[int(SETTLE * n) :]
    means = np.array([b.mean() for b in np.array_split(counted, BLOCKS)]) / model.dt
    deviation = float(means.std(ddof=1) / np.sqrt(BLOCKS))
    return LyapunovExponent(float(counted.mean()) / model.dt, deviation, np.append(0.0, np.cumsum(steps)))
