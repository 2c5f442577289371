"""Smoothing and differentiation by a bandwidth: smoothing spline and zero-phase low-pass filter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_smoothing_spline
from scipy.optimize import minimize_scalar
from scipy.signal import butter, sosfiltfilt

from hybrid_mpc.data.differentiation import Derivatives
from hybrid_mpc.data.differentiators import Differentiator, too_short
from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]
ROOM = math.sqrt(2.0) - 1.0
"""``1 / (1 + ROOM)`` is a gain of -3 dB."""
DECAYS = 28.0
"""Time constants after which a kernel is below 1e-12 of its peak: rounding."""
SLOWEST = 2e-4
"""Lowest cutoff of a smoothing spline over the sampling rate: below it the spline's equations lose four digits."""


@dataclass(frozen=True)
class SmoothingSpline(Differentiator):
    """Cubic smoothing spline: least squares with a penalty on the second derivative.

    On a uniform grid, away from the ends, the samples' spline has the gain ``B / (B + lam D^2)`` with
    ``B = (4 + 2 cos w) / 6``, ``D = 2 - 2 cos w``, ``w = 2 pi f dt``: the penalty follows from the bandwidth.

    Args:
        cutoff: Frequency [Hz] at which the smoothed value has lost 3 dB; :func:`gcv_cutoff` proposes one.

    Source: C. H. Reinsch, Numerische Mathematik 10 (1967) 177; the gain: M. Unser et al., IEEE Transactions on Signal
    Processing 41 (1993) 834.

    Example:
        >>> round(SmoothingSpline(5.0).bandwidth(0.01), 2)
        5.0
    """

    cutoff: float

    def derivatives(self, y: Array, dt: float) -> Derivatives:
        """The spline and its derivatives at the samples."""
        _check_cutoff(self.cutoff, dt, len(y))
        if self.cutoff * dt < SLOWEST:
            raise InputError(
                f"smoothing spline: cutoff of {self.cutoff:g} Hz at {1 / dt:g} Hz is too low to be computed. Raise it "
                f"to {SLOWEST / dt:g} Hz, take ZeroPhaseFilter, or keep fewer samples."
            )
        k = np.arange(len(y), dtype=float)
        lam = ROOM * _spline_ratio(np.array(2 * np.pi * self.cutoff * dt)).item()
        columns = [make_smoothing_spline(k, column, lam=lam) for column in y.reshape(len(y), -1).T]
        value, first, second = (
            np.column_stack([np.asarray(s.derivative(i)(k) if i else s(k)) for s in columns]).reshape(y.shape)
            / dt**i
            for i in range(3)
        )
        return Derivatives(value, first, second)

    def reach(self, dt: float) -> int:
        """The kernel falls by e in ``ROOM^(1/4) sqrt(2) / (2 pi cutoff)``."""
        return math.ceil(DECAYS * ROOM**0.25 * math.sqrt(2) / (2 * math.pi * self.cutoff * dt))


@dataclass(frozen=True)
class ZeroPhaseFilter(Differentiator):
    """Butterworth low-pass run forwards and backwards, then differentiated through a cubic spline.

    The spline interpolates: its derivatives at the samples are compact differences, of order 4 and 2 in ``dt``.
    At the ends the signal is continued by its point reflection, as far as the filter reaches.

    Args:
        cutoff: Frequency [Hz] at which both runs together have lost 3 dB.
        order: Order of each run, default 4.

    Source: F. Gustafsson, IEEE Transactions on Signal Processing 44 (1996) 988 (its start is scipy's ``odd``).

    Example:
        >>> round(ZeroPhaseFilter(5.0).bandwidth(0.01), 2)
        5.0
    """

    cutoff: float
    order: int = 4

    def derivatives(self, y: Array, dt: float) -> Derivatives:
        """Filtered signal with its spline's derivatives."""
        _check_cutoff(self.cutoff, dt, len(y))
        sos = butter(self.order, self._run(dt), output="sos")
        pad = min(len(y) - 1, self.reach(dt))  # so far that the recursion's start has died away
        spline = CubicSpline(dt * np.arange(len(y)), sosfiltfilt(sos, y, axis=0, padlen=pad))
        t = spline.x
        return Derivatives(spline(t), spline(t, 1), spline(t, 2))

    def reach(self, dt: float) -> int:
        """Until the slowest pole has died away, or the interpolating spline's, ``sqrt(3) - 2``."""
        _, poles, _ = butter(self.order, self._run(dt), output="zpk")
        slowest = max(float(np.abs(poles).max()), 2 - math.sqrt(3))
        return math.ceil(DECAYS / -math.log(slowest))

    def _run(self, dt: float) -> float:
        """Cutoff of one run over half the sampling rate.

        Each run alone has the gain ``1 / sqrt(1 + (W / W_d)^(2 order))`` in ``W = tan(pi f dt)``, both its square.
        """
        warped = math.tan(math.pi * self.cutoff * dt) / ROOM ** (0.5 / self.order)
        return 2 / math.pi * math.atan(warped)


def gcv_cutoff(y: Array, dt: float) -> float:
    """Cutoff [Hz] of a smoothing spline by generalised cross-validation: for white noise of unknown size.

    It minimises ``n |y - y_hat|^2 / (n - tr)^2``, where the trace of the smoother is the sum of its gains over the
    frequencies ``k / (2 n dt)``. Quantisation is no white noise where the signal is slow: look at the result.

    Args:
        y: Samples ``(n,)``.
        dt: Period [s].

    Raises:
        InputError: If there are fewer than 16 samples.

    Source: P. Craven and G. Wahba, Numerische Mathematik 31 (1979) 377.

    Example:
        >>> t = 0.01 * np.arange(1000)
        >>> noise = np.random.default_rng(0).standard_normal(1000)
        >>> rough, fine = (gcv_cutoff(np.sin(5 * t) + s * noise, 0.01) for s in (0.5, 0.001))
        >>> 0.8 < rough < fine
        True
    """
    y = np.asarray(y, dtype=float)
    n = len(y)
    if y.ndim != 1 or n < 16:
        raise InputError(
            f"gcv_cutoff: needs at least 16 samples of one signal, got an array of shape {y.shape}"
        )
    ratio = 1 / _spline_ratio(np.pi * np.arange(1, n) / n)

    def score(log_cutoff: float) -> float:
        cutoff = math.exp(log_cutoff)
        lam = ROOM * _spline_ratio(np.array(2 * np.pi * cutoff * dt)).item()
        trace = 1 + float(np.sum(1 / (1 + lam * ratio)))
        left = y - SmoothingSpline(cutoff).derivatives(y, dt).value
        return float(n * (left @ left) / (n - trace) ** 2)

    # the score may have several minima: the best point of a grid, refined between its neighbours
    grid = np.log(np.geomspace(max(2 / n, SLOWEST) / dt, 0.45 / dt, 40))
    scores = [score(point) for point in grid]
    k = min(max(int(np.argmin(scores)), 1), len(grid) - 2)
    found = minimize_scalar(score, bounds=(grid[k - 1], grid[k + 1]), method="bounded")
    return math.exp(float(found.x))


def _spline_ratio(w: Array) -> Array:
    """``B / D^2`` of the smoothing spline's gain at ``w`` [rad per sample]."""
    return (4 + 2 * np.cos(w)) / 6 / (2 - 2 * np.cos(w)) ** 2


def _check_cutoff(cutoff: float, dt: float, n: int) -> None:
    if not 0 < cutoff < 0.5 / dt:
        raise InputError(
            f"cutoff of {cutoff:g} Hz must be positive and below {0.5 / dt:g} Hz, half the sampling rate of "
            f"{1 / dt:g} Hz"
        )
    need = max(5, math.ceil(1 / (cutoff * dt)))
    if n < need:
        raise InputError(too_short(need, n))
