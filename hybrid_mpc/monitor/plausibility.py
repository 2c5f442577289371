"""Plausibility in the plan: soft bounds that keep an optimiser from where the network was never trained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.soft import SoftBound
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.residuals import energy_balance

Array = NDArray[np.float64]
MOST = 2000
"""Samples that the quantile is fitted to, evenly chosen: the linear programme grows with them."""
FEWEST = 200
SMOOTH = 0.1
"""Smoothing of an absolute value, as a share of the training data's standard deviation."""
MARGIN = 1.5
"""How much farther than the training data's quantile the region reaches."""
RARE = 1e-6
"""Share of ordinary samples that a plan may be punished for: it looks at some 2,500 of them in a second."""
FEWEST_BEYOND = 10
"""Samples beyond the quantile that its tail is told from."""
SETTLED = 2
"""Periods that the hidden state is led through at ``(x, u)``, as a plan's ``(x, u)`` says nothing of the past. Each
costs time in the plan. In nominal loops of the golf robot two came closest to what the true hidden state says
(correlation 0.86; 0.70, 0.81, 0.84, 0.77, 0.71 for 0, 1, 3, 4, 5)."""
ROUNDING = 1e-6
"""Share of the power that moves the machine below which an ordinary excess is rounding."""
LEAST = 1e-3
"""Smallest ordinary size that an excess is measured by, as a share of the median one."""
STRENGTH = 10.0
"""Penalty of a bound's violation by its own tolerance, in multiples of what the tolerated deviation costs."""


class Samples(Protocol):
    """Training data: ``x`` (n, n_x) and ``u`` (n, n_u) on the model's grid."""

    @property
    def x(self) -> Array:
        """States."""

    @property
    def u(self) -> Array:
        """Inputs."""


@dataclass(frozen=True)
class Plausibility:
    """What is ordinary in the training data.

    Args:
        quantile: Share of the training data that the fitted quantile holds.
        terms: Coefficients ``(5,)``, not negative, of the quantile of ``|dE_model|`` [W]:
            ``1, |v|, |v|^2, |u|, |u|^2``, lengths smoothed near zero.
        smooth: Smoothing of ``|v|`` and of ``|u|``.
        mean: Mean of ``(x, u)``.
        precision: Inverse covariance of ``(x, u)``, its rows.
        limit: Squared Mahalanobis distance that the region reaches to.
        tolerance_w: Median of the quantile on the training data [W].
        samples: Training samples.
        data_hash: Hash of the training data.
        reach: How many times the quantile still counts as ordinary: its tail, drawn on to one sample in a million.
            Default 1: the quantile itself.

    Raises:
        InputError: If sizes do not fit, or a number is not as said.
    """

    quantile: float
    terms: tuple[float, ...]
    smooth: tuple[float, float]
    mean: tuple[float, ...]
    precision: tuple[tuple[float, ...], ...]
    limit: float
    tolerance_w: float
    samples: int = 0
    data_hash: str = ""
    reach: float = 1.0

    def __post_init__(self) -> None:
        n = len(self.mean)
        if (
            len(self.terms) != 5
            or min(self.terms) < 0
            or any(len(row) != n for row in (*self.precision, self.mean))
        ):
            raise InputError(f"plausibility: five terms that are not negative and {n} x {n} precision needed")
        if not (0 < self.quantile < 1 and self.limit > 0 and self.tolerance_w > 0 and min(self.smooth) > 0):
            raise InputError(
                "plausibility: quantile within 0 to 1, limit, tolerance and smoothing positive needed"
            )
        if not 1 <= self.reach < np.inf:
            raise InputError(f"plausibility: reach must be at least 1 and finite, got {self.reach}")


def learn_plausibility(
    model: HybridModel, data: Sequence[Samples], *, quantile: float = 0.99, data_hash: str = ""
) -> Plausibility:
    """What is ordinary, from the data that the model was trained on.

    The balance that the model's correction makes, ``dE_model``, is zero where it says what the prior says. A linear
    quantile regression on speed and input tells how large it ordinarily is.

    Args:
        model: The model.
        data: Trajectories with states and inputs, e.g. the training ones.
        quantile: Share of the samples that counts as ordinary. Default 0.99.
        data_hash: Hash of the data, kept in the result.

    Raises:
        InputError: If there are too few samples, or the quantile is not within 0 to 1.

    Source: Koenker and Bassett, *Regression quantiles*, Econometrica 46 (1978);
    Coles (2001), *An Introduction to Statistical Modeling of Extreme Values*, ch. 4, for the tail.

    Example: ``learn_plausibility(artifact.models["hybrid"], dataset.by_role("train"), data_hash=dataset.hash)``
    """
    if not 0 < quantile < 1:
        raise InputError(f"plausibility: quantile must be within 0 to 1, got {quantile}")
    x, u = (
        np.concatenate([getattr(d, name) for d in data]) if data else np.zeros((0, 1)) for name in ("x", "u")
    )
    if len(x) < FEWEST:
        raise InputError(f"plausibility: {len(x)} samples given, at least {FEWEST} needed")
    z, n_q = np.hstack([x, u]), model.n_x // 2
    covariance = np.cov(z.T) + 1e-9 * np.diag(z.var(axis=0) + 1e-12)
    precision = np.linalg.inv(covariance)
    off = z - z.mean(axis=0)
    distance = np.einsum("ni,ij,nj->n", off, precision, off)
    v = x[:, n_q : 2 * n_q]
    deviations = [float(np.sqrt(np.mean(np.sum(s**2, axis=1)))) for s in (v, u)]
    smooth = (SMOOTH * deviations[0] or 1.0, SMOOTH * deviations[1] or 1.0)
    size = np.abs(balance_function(model).map(len(z))(x.T, u.T).full().ravel())
    features = np.column_stack([np.ones(len(z)), _numbers(v, smooth[0]), _numbers(u, smooth[1])])
    chosen = np.unique(np.linspace(0, len(z) - 1, min(MOST, len(z))).round().astype(int))
    terms = _quantile_regression(features[chosen], size[chosen], quantile)
    usual = features @ terms
    tolerance = max(float(np.median(usual)), ROUNDING * _moving_power(model, x, u))
    reach = reach_of(size / np.maximum(usual, LEAST * tolerance), quantile)
    return Plausibility(
        quantile, tuple(map(float, terms)), smooth, tuple(map(float, z.mean(axis=0))),
        tuple(tuple(map(float, row)) for row in precision), float(MARGIN**2 * np.quantile(distance, quantile)),
        tolerance, len(z), data_hash, reach,
    )  # fmt: skip


def balance_function(model: HybridModel) -> ca.Function:
    """``(x, u) -> dE_model`` [W]: the prior's balance with the model's acceleration, the hidden state settled."""
    x, u = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u)
    h = ca.MX.zeros(model.n_h)
    for _ in range(SETTLED if model.n_h else 0):
        h = model.step(x, h, u, model.w, model.p)[1]
    rate = model.xdot(x, h, u, model.w, model.p)
    return ca.Function("balance", [x, u], [ca.densify(energy_balance(model, x, rate, u))])


def excess_bound(model: HybridModel, ordinary: Plausibility, *, strength: float = STRENGTH) -> SoftBound:
    """Soft bound on what ``|dE_model|`` exceeds its ordinary size by; nothing within it.

    Ordinary is ``reach`` times the quantile that was fitted: the quantile itself would punish every plan of 50 periods
    for a sample or two that are as ordinary as the rest.

    Args:
        model: The model that plans.
        ordinary: What :func:`learn_plausibility` found for it.
        strength: Penalty of an excess as large as the quantile there [cost/s]. Default 10.

    Raises:
        InputError: If the model has other states or inputs.

    Example: ``OCP(..., soft=[excess_bound(model, ordinary), region_bound(model, ordinary)])``
    """
    x, u = _symbols(model, ordinary)
    a0, a1, a2, a3, a4 = ordinary.terms
    n_q = model.n_x // 2
    v2, u2 = ca.dot(x[n_q : 2 * n_q], x[n_q : 2 * n_q]), ca.dot(u, u)
    speed, size = (ca.sqrt(s + e**2) for s, e in zip((v2, u2), ordinary.smooth, strict=True))
    usual = a0 + a1 * speed + a2 * v2 + a3 * size + a4 * u2
    share = balance_function(model)(x, u) / ca.fmax(usual, LEAST * ordinary.tolerance_w)
    bound = _scalar(ca.Function("excess", [x, u], [share]))
    return SoftBound(bound, [-ordinary.reach], [ordinary.reach], [strength], [strength])


def region_bound(model: HybridModel, ordinary: Plausibility, *, strength: float = STRENGTH) -> SoftBound:
    """Soft bound on the squared Mahalanobis distance of ``(x, u)`` to the training data, over its limit.

    Args:
        model: The model that plans.
        ordinary: What :func:`learn_plausibility` found for it.
        strength: Penalty of twice the limit [cost/s]. Default 10.

    Raises:
        InputError: If the model has other states or inputs.
    """
    x, u = _symbols(model, ordinary)
    off = ca.vertcat(x, u) - ca.DM(list(ordinary.mean))
    distance = ca.dot(off, ca.DM(np.array(ordinary.precision)) @ off) / ordinary.limit
    return SoftBound(ca.Function("region", [x, u], [distance]), [-np.inf], [1.0], [strength], [strength])


def plan_distance(ordinary: Plausibility, x: Array, u: Array) -> Array:
    """Distance ``(N,)`` of a plan's ``x`` ``(N, n_x)`` and ``u`` ``(N, n_u)`` over the region's: 1 at its border.

    Example:
        >>> unit = Plausibility(0.99, (1.0,) * 5, (0.1, 0.1), (0.0, 0.0), ((1.0, 0.0), (0.0, 1.0)), 4.0, 1.0)
        >>> plan_distance(unit, np.array([[3.0]]), np.array([[0.0]])).tolist()
        [1.5]
    """
    off = np.hstack([np.asarray(x), np.asarray(u)]) - np.array(ordinary.mean)
    squares = np.einsum("ni,ij,nj->n", off, np.array(ordinary.precision), off)
    return np.asarray(np.sqrt(squares / ordinary.limit))


def _symbols(model: HybridModel, ordinary: Plausibility) -> tuple[ca.MX, ca.MX]:
    if model.n_x + model.n_u != len(ordinary.mean):
        raise InputError(
            f"plausibility: learned for {len(ordinary.mean)} states and inputs, model {model.name} has "
            f"{model.n_x} and {model.n_u}"
        )
    return ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u)


def _moving_power(model: HybridModel, x: Array, u: Array) -> float:
    """Root mean square of ``v' M a`` [W], what the model's own acceleration takes; at least the smallest number."""
    state, held, h = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u), ca.MX.zeros(model.n_h)
    rate = model.xdot(state, h, held, model.w, model.p)
    standing = ca.vertcat(rate[: model.n_x // 2], ca.MX.zeros(model.n_x - model.n_x // 2))
    power = energy_balance(model, state, rate, held) - energy_balance(model, state, standing, held)
    found = ca.Function("power", [state, held], [ca.densify(power)]).map(len(x))(x.T, u.T).full()
    return float(np.sqrt(np.mean(found**2))) or float(np.finfo(float).tiny)


def _scalar(f: ca.Function) -> ca.Function:
    """``f`` as scalar code, whose Jacobian takes half the time; as it is where it cannot be."""
    try:
        return f.expand()
    except RuntimeError:
        return f


def _numbers(values: Array, smooth: float) -> Array:
    squares = np.sum(values**2, axis=1)
    return np.column_stack([np.sqrt(squares + smooth**2), squares])


def reach_of(ratio: Array, quantile: float) -> float:
    """Ratio to the fitted quantile that one sample in a million exceeds, by the exponential tail beyond the quantile.

    At least 1. The tail is told from the samples beyond the quantile, or from the ten largest if they are fewer.

    Args:
        ratio: Sizes over the quantile that was fitted to them ``(n,)``.
        quantile: The quantile.

    Example:
        >>> round(reach_of(np.linspace(0.0, 1.01, 1001), 0.99), 2)
        1.05
    """
    beyond = max(round((1.0 - quantile) * ratio.size), min(FEWEST_BEYOND, ratio.size // 2))
    ordered = np.sort(ratio)
    edge, scale = ordered[-beyond - 1], float(np.mean(ordered[-beyond:] - ordered[-beyond - 1]))
    return max(1.0, float(edge + scale * np.log(max(beyond / (ratio.size * RARE), 1.0))))


def _quantile_regression(features: Array, values: Array, quantile: float) -> Array:
    """Coefficients that are not negative, of the linear quantile of ``values``."""
    n, m = features.shape
    cost = np.concatenate([np.zeros(m), np.full(n, quantile), np.full(n, 1.0 - quantile)])
    equality = np.hstack([features, np.eye(n), -np.eye(n)])
    from scipy.optimize import linprog  # slow to import, and a running monitor does without

    found = linprog(cost, A_eq=equality, b_eq=values, bounds=(0, None), method="highs")
    if not found.success:
        raise InputError(f"plausibility: the quantile could not be fitted: {found.message}")
    return np.asarray(found.x[:m])
