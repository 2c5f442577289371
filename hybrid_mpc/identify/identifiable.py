"""Covariance of fitted parameters, and the combinations of parameters that the recordings do not identify."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.identify.output_fit import LOOSE, OutputFit
from hybrid_mpc.identify.prior_result import Combination

Array = NDArray[np.float64]
UNIDENTIFIED = 1.0
"""Standard error, in half ranges, above which a combination of parameters counts as not identifiable."""
CLUSTERS = 48
"""Minimum number of parts of the windows whose scatter gives the standard errors."""
ROUNDED = 1e-11
"""Ratio of singular values of the slopes below which they are rounding errors."""


@dataclass(frozen=True)
class Fitted:
    """Result of a fit to windows: ``theta``, its covariance, and the combinations that are not identifiable."""

    theta: Array
    covariance: Array
    unidentified: tuple[Combination, ...]


def covariance(
    fit: OutputFit,
    theta: Array,
    slopes: Array,
    error: Array,
    falling: Array,
    counted: float,
    taken: float,
    outputs: int,
) -> tuple[Array, tuple[Combination, ...]]:
    """Covariance ``(k, k)`` of ``theta``, and the combinations of parameters that are not identifiable.

    The covariance is the sandwich ``H^-1 M H^-1``: ``H`` is the information (with the pull towards the nominal values),
    and ``M`` the scatter of the gradients over at least ``CLUSTERS`` parts of the windows, because errors within a
    window are correlated. Few parts estimate ``M`` roughly, so variances are at least those for white noise. They are
    at most those of a half range.

    Args:
        fit: Names, units and bounds of the parameters.
        theta: The fitted parameters ``(k,)``.
        slopes: Jacobian ``(n, m, k)`` of the errors with respect to ``theta``, with initial states eliminated, over the
            errors' scales, times the root of the robust weights.
        error: The errors ``(n, m)``, scaled and weighted in the same way.
        falling: Derivative of the robust influence function over its weight ``(n, m)``.
        counted: Number of counted errors.
        taken: Degrees of freedom of the initial states.
        outputs: Number of outputs; ``m`` is a multiple of it.

    Source: Liang and Zeger, *Longitudinal data analysis using generalized linear models* (1986), of clusters; Huber
    and Ronchetti, *Robust Statistics* (2009), section 7.6, of the robust loss.
    """
    n, k = len(slopes), slopes.shape[-1]
    if not k:
        return np.zeros((0, 0)), ()
    half = fit.half
    rows = (slopes * np.sqrt(falling)[..., None]).reshape(-1, k) * half
    _, values, directions = np.linalg.svd(np.linalg.qr(rows, mode="r"))
    known = np.zeros(k)
    known[: len(values)] = np.where(values > ROUNDED * values[0], values, 0.0)
    # theta = back @ c, with coordinates c whose information is diag(known^2)
    back = directions.T * half[:, None]
    scores = (slopes * error[..., None]).reshape(n, -1, outputs, k).sum(axis=2)
    parts = min(math.ceil(CLUSTERS / n), scores.shape[1])
    begins = np.arange(parts) * scores.shape[1] // parts
    scores = np.add.reduceat(scores, begins, axis=1).reshape(-1, k)
    left = max(counted - k - taken, 0.5 * counted)  # degrees of freedom
    scores = scores @ back * (known > 0)
    middle = scores.T @ scores * (counted / max(left, 1.0)) * len(scores) / max(len(scores) - 1, 1)
    inverse = 1.0 / (np.square(known) + LOOSE**-2)
    found = back @ ((middle + LOOSE**-2 * np.eye(k)) * np.outer(inverse, inverse)) @ back.T
    found = 0.5 * (found + found.T)
    white = float(np.square(error).sum()) / max(left, 1.0)  # variance of weighted errors if they were white
    least = np.square(back) @ (inverse * inverse * (white * np.square(known) + LOOSE**-2))
    short = np.sqrt(np.maximum(least / np.maximum(np.diag(found), 1e-300), 1.0))
    found = found * np.outer(short, short)
    values, directions = np.linalg.eigh(found / np.outer(half, half))
    unidentified = directions[:, values >= UNIDENTIFIED**2].T
    unknown = tuple(_combination(fit, theta, found, one) for one in unidentified)
    bounded = directions * np.minimum(values, 1.0) @ directions.T * np.outer(half, half)
    return bounded, tuple({one.parameters: one for one in unknown}.values())


def _combination(fit: OutputFit, theta: Array, covariance: Array, direction: Array) -> Combination:
    """Parameters of an unidentifiable direction [half ranges], and the best known combination of these parameters."""
    # share of the largest weight above which a parameter is a part of a combination
    among = np.flatnonzero(np.abs(direction) > 0.2 * np.abs(direction).max())
    names = tuple(fit.names[i] for i in among)
    if len(among) == 1:
        return Combination(names)
    sizes = fit.unit[among]

    def known(size: Array) -> tuple[Array, float]:
        """Weights of the parameters in the best known combination, and its standard error; parameters over ``size``."""
        own = covariance[np.ix_(among, among)] * np.outer(sizes, sizes) / np.outer(size, size)
        values, directions = np.linalg.eigh(own)
        weights = directions[:, 0] / size
        return weights, math.sqrt(max(float(values[0]), 0.0))

    weights, error = known(fit.half[among] * sizes)
    ratio = np.abs(weights / np.abs(weights).max())
    units = {fit.free[i].unit if i < len(fit.free) else "s" for i in among}
    value = theta[among] * sizes
    sign = np.sign(theta[among])
    one_sign = (sign * np.where(sign > 0, fit.lower[among], fit.upper[among]) >= 0).all() and sign.all()
    # ratio of the smallest to the largest weight above which parameters of one unit form a sum instead of a product
    product = bool(one_sign) and not (len(units) == 1 and ratio.min() > 0.8)
    if product:
        weights, error = known(value)
        weights = weights * value
    largest = float(weights[np.abs(weights).argmax()])
    return Combination(names, tuple((weights / largest).tolist()), product, error / abs(largest))


def standard_errors(fit: OutputFit, chosen: Fitted) -> dict[str, float]:
    """Standard errors of the fitted parameters."""
    if not len(chosen.covariance):
        return {}
    sizes = np.sqrt(np.maximum(np.diag(chosen.covariance), 0.0)) * fit.unit
    return {p.name: float(e) for p, e in zip(fit.free, sizes, strict=False) if math.isfinite(e)}


def correlations(fit: OutputFit, chosen: Fitted) -> dict[str, float]:
    """Correlation of the errors of every two fitted parameters, by ``"a, b"``."""
    c = chosen.covariance
    sigma = np.sqrt(np.maximum(np.diag(c), 1e-300)) if len(c) else np.zeros(0)
    finite = [i for i in range(min(len(c), len(fit.free))) if math.isfinite(sigma[i])]
    return {
        f"{fit.names[i]}, {fit.names[j]}": float(c[i, j] / (sigma[i] * sigma[j]))
        for k, i in enumerate(finite)
        for j in finite[k + 1 :]
    }
