"""Process noise of a filter by maximum likelihood on recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.estimation.kalman import ExtendedKalmanFilter

Array = NDArray[np.float64]


class Recording(Protocol):
    """A recording on the model's grid."""

    @property
    def u(self) -> Array:
        """Inputs ``(n, n_u)``, each held over the period that it begins."""

    @property
    def y(self) -> Array:
        """Measurements ``(n, n_y)``."""


def log_likelihood(estimator: ExtendedKalmanFilter, recording: Recording, skip: int = 25) -> float:
    """Log-likelihood of the measured outputs under a filter's own innovations and their variances.

    Args:
        estimator: The filter; its model's outputs are its positions.
        recording: Inputs and measurements.
        skip: Samples at the start that only end the filter's ignorance. Default 25.

    Returns:
        The sum over samples, without the constant; minus infinity where the filter is lost.

    Source: Schweppe, *Evaluation of likelihood functions for Gaussian signals*, IEEE T-IT 11 (1965).
    """
    n_y, estimate, total = estimator.model.n_y, estimator.start(recording.y[0]), 0.0
    for k in range(1, len(recording.y)):
        ahead = estimator.predict(estimate, recording.u[k - 1])
        s = ahead.P[:n_y, :n_y] + np.diag(estimator.noise_y)
        estimate = estimator.correct(ahead, recording.y[k])
        if k >= skip and np.isfinite(estimate.nis):
            total -= 0.5 * (estimate.nis + float(np.linalg.slogdet(s)[1]))
        if not np.all(np.isfinite(estimate.x)):
            return -math.inf
    return total


def most_likely(
    make: Callable[[float], ExtendedKalmanFilter], recordings: Sequence[Recording], scales: Sequence[float]
) -> float:
    """The one of ``scales`` whose filter ``make(scale)`` makes the recordings most likely.

    Args:
        make: Builds the filter for a scale of its process noise.
        recordings: Undisturbed recordings that nothing is judged on.
        scales: Scales to try.

    Example:
        ``scale = most_likely(lambda s: ExtendedKalmanFilter(model, sigma_x=s * base, ...), runs, (0.1, 1.0))``
    """
    values = [sum(log_likelihood(make(s), r) for r in recordings) for s in scales]
    return float(scales[int(np.argmax(values))])
