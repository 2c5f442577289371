"""Prediction bands around free runs, calibrated on validation runs.

The variance of an error is a weighted sum of four parts: the sensor's noise, the variance between the networks, the
variance due to the covariance of the fitted parameters, and a part that grows with the time since the start. The
weights maximize the likelihood of validation runs. Then all widths are scaled so that the band holds the nominal share.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import norm
from scipy.stats import t as student

from hybrid_mpc.errors import InputError
from hybrid_mpc.kit.prediction import SHARE, Bands

Array = NDArray[np.float64]
Pair: TypeAlias = tuple[Array, Array]
"""Errors of an output in a run ``(n,)``, and the parts of their variance ``(n, m)``."""
FOLDS = 5
"""Groups of validation runs of the cross-validation that decides whether a band's width varies."""
FAR = 1e3
"""Limit of a part's standard deviation, in spreads of the output."""


@dataclass(frozen=True)
class RunParts:
    """A free run's errors and the parts of their variance, for one model.

    Args:
        error: Errors of the outputs ``(n, n_y)`` [output units]; NaN where nothing was measured.
        parts: Parts of their variance ``(n, n_y, m)`` [output units^2], each not negative: see :func:`run_variance`.
    """

    error: Array
    parts: Array


def run_variance(
    outputs: Array, parameters: Array, t: Array, sigma: Array, spread: Array, *, longest: float = math.inf
) -> Array:
    """Parts of the variance of a free run's errors ``(n, n_y, 4)``, from the runs of all networks.

    Args:
        outputs: Outputs of the runs of all networks ``(m, n, n_y)``; a single run for the prior.
        parameters: Variance due to the covariance of the fitted parameters ``(n, n_y)``, see
            :func:`~hybrid_mpc.identify.fit.parameter_variance`.
        t: Time since the start ``(n,)`` [s].
        sigma: Standard deviation of the sensors' noise ``(n_y,)``.
        spread: Spread of the outputs ``(n_y,)``.
        longest: Time [s] at which the growing part equals the squared spread; it grows further in a longer run.
            Default: the length of the run.
    """
    limit = np.square(FAR * spread)
    with np.errstate(over="ignore", invalid="ignore"):  # a diverging run has an infinite variance
        networks = np.nan_to_num(outputs.var(axis=0), nan=np.inf)
    networks, parameters = np.minimum(networks, limit), np.minimum(parameters, limit)
    growth = (np.asarray(t) / max(min(float(np.max(t)), longest), 1e-300))[:, None] * np.square(spread)
    noise = np.broadcast_to(np.square(sigma), networks.shape)
    return np.stack([noise, networks, parameters, growth], axis=-1)


def fit_bands(runs: Sequence[RunParts], share: float = SHARE) -> Bands:
    """Calibrate bands that hold a share of the measurements of validation runs.

    The scale is a quantile of the errors over their standard deviation (split conformal prediction), with equal weight
    of every run. Errors within a run are correlated, so a few runs estimate the quantile poorly: the scale is increased
    by the ratio of Student's quantile to the normal one. An output's width varies only if varying widths have a better
    :func:`interval_score` in a cross-validation; else it is constant.

    Raises:
        InputError: If there is no run, or the share is not between 0 and 1.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> parts = np.ones((400, 1, 1))
        >>> runs = [RunParts(rng.normal(0.0, 2.0, (400, 1)), parts) for _ in range(5)]
        >>> bands = fit_bands(runs)
        >>> inside = [np.mean(np.abs(r.error) <= bands.half_width(r.parts)) for r in runs]
        >>> round(float(np.mean(inside)), 2)  # a little more: five runs are few
        0.93

    Source: Lei, G'Sell, Rinaldo, Tibshirani, Wasserman, *Distribution-free predictive inference for regression*, JASA
    113 (2018), for locally weighted split conformal prediction.
    """
    if not runs:
        raise InputError(
            "bands: no validation run for their calibration; give longer recordings [HM-IDENTIFY-001]"
        )
    if not 0 < share < 1:
        raise InputError(f"bands: share must lie between 0 and 1, got {share} [HM-IDENTIFY-002]")
    weights, scale, constant = [], [], []
    for j in range(runs[0].error.shape[1]):
        seen = [np.isfinite(run.error[:, j]) for run in runs]
        pairs = [(run.error[s, j], run.parts[s, j]) for run, s in zip(runs, seen, strict=True) if np.any(s)]
        flat = np.eye(runs[0].parts.shape[2])[0]
        if not pairs:  # never measured in these runs: the band of the sensor's noise
            weights.append(tuple(flat.tolist()))
            scale.append(float(norm.ppf(0.5 * (1 + share))))
            constant.append(scale[-1])
            continue
        own = _weights(pairs) if _width_that_varies_is_better(pairs, flat, share) else flat
        weights.append(tuple(own.tolist()))
        scale.append(_scale(pairs, own, share))
        constant.append(_scale(pairs, flat, share))
    return Bands(tuple(weights), tuple(scale), tuple(constant), share)


def coverage(run: RunParts, bands: Bands) -> float:
    """Share of the measurements of a run within its band."""
    inside = np.abs(run.error) <= bands.half_width(run.parts)
    return float(np.mean(inside[np.isfinite(run.error)]))


def interval_score(run: RunParts, bands: Bands) -> Array:
    """Mean interval score of a run's band, by output ``(n_y,)`` [output units]; lower is better.

    The score is the width of the band, plus ``2 / (1 - share)`` times the distance of a measurement outside the band.

    Source: Gneiting and Raftery, *Strictly proper scoring rules, prediction, and estimation*, JASA 102 (2007).
    """
    return np.asarray(np.nanmean(_score(run.error, bands.half_width(run.parts), bands.share), axis=0))


def _score(error: Array, half: Array, share: float) -> Array:
    return np.asarray(2 * half + 2 / (1 - share) * np.maximum(np.abs(error) - half, 0.0))


def _width_that_varies_is_better(pairs: Sequence[Pair], flat: Array, share: float) -> bool:
    """Whether bands of varying width score better in a cross-validation than bands of constant width."""
    folds, score = [pairs[k::FOLDS] for k in range(min(FOLDS, len(pairs)))], np.zeros(2)
    for k, them in enumerate(folds):
        others = [pair for i, fold in enumerate(folds) if i != k for pair in fold]
        if not others:
            return False
        for i, own in enumerate((_weights(others), flat)):
            scale = _scale(others, own, share)
            for error, parts in them:
                score[i] += np.mean(_score(error, scale * _deviations(parts, own), share))
    return bool(score[0] < score[1])


def _deviations(parts: Array, weights: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(parts @ weights, 1e-300)))


def _scale(pairs: Sequence[Pair], weights: Array, share: float) -> float:
    """Factor on the standard deviations so that the band holds the share."""
    ratios = np.concatenate([np.abs(error) / _deviations(parts, weights) for error, parts in pairs])
    each = np.concatenate([np.full(len(error), 1.0 / len(error)) for error, _ in pairs])
    return _quantile(ratios, each, share, len(pairs))


def _weights(pairs: Sequence[Pair]) -> Array:
    """Weights of the parts that maximize the normal likelihood of the runs' errors: minimum of log(v) + e^2 / v."""
    error, parts = (np.concatenate(v) for v in zip(*pairs, strict=True))
    size = np.maximum(parts.mean(axis=0), 1e-300)
    known = parts.max(axis=0) > 0
    scaled, squares = parts / size, np.square(error)
    level = max(float(np.mean(squares)), 1e-300)

    def cost(logs: Array) -> tuple[float, Array]:
        own = np.exp(logs) * known
        # minimum of a variance over the mean square, so that it is never zero
        variance = np.maximum(scaled @ own, 1e-6)
        ratio = squares / level / variance
        slope = scaled.T @ ((1.0 - ratio) / variance) * own
        return float(np.mean(np.log(variance) + ratio)), slope / len(squares)

    start = np.full(parts.shape[1], -math.log(max(int(known.sum()), 1)))
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(-20.0, 5.0)] * parts.shape[1])
    return np.asarray(np.exp(found.x) * known * level / size)


def _quantile(ratios: Array, weights: Array, share: float, runs: int) -> float:
    """Weighted quantile, increased for the small number of runs."""
    order, tail = np.argsort(ratios), 0.5 * (1 + share)
    total = np.cumsum(weights[order]) / float(weights.sum())
    own = float(ratios[order][min(int(np.searchsorted(total, share)), len(order) - 1)])
    # minimum number of independent errors that the validation runs stand for; beyond it, each run counts as one
    return own * float(student.ppf(tail, max(runs, 8)) / norm.ppf(tail))
