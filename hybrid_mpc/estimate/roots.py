"""Roots of covariances and products with their inverses, of which none raises an exception."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dsyevd

Array = NDArray[np.float64]


def root(p: Array) -> Array:
    """A matrix ``(n, n)`` whose product with its transpose is the covariance ``p``; NaN if ``p`` is not finite.

    Each component is scaled by its deviation, so small ones keep their digits beside large ones. A component without
    variance has a row of zeros.

    Example:
        >>> root(np.diag([4.0, 0.0]))
        array([[2., 0.],
               [0., 0.]])
    """
    deviation = np.sqrt(np.maximum(np.diag(p), 0.0))
    there = np.flatnonzero(deviation > 0)
    size, found = deviation[there], np.zeros_like(p)
    scaled = p[np.ix_(there, there)] / size / size[:, None]
    if not (np.isfinite(p).all() and np.isfinite(scaled).all()):
        return np.full_like(p, np.nan)
    factor, bad = dpotrf(scaled, 1)
    if bad:  # singular, e.g. two states that are known to be equal
        values, vectors, bad = dsyevd(scaled)
        factor = vectors * np.sqrt(np.maximum(values, 0.0)) if not bad else np.full_like(scaled, np.nan)
    found[np.ix_(there, there)] = factor * size[:, None]
    return found
