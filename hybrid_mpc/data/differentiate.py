"""Smoothing and differentiation of sampled signals, with known bandwidth, delay and noise gain.

Runs use :func:`local_polynomial`; :func:`differentiate` accepts any method.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.files import real_numbers
from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]
HALF_POWER = math.sqrt(0.5)
ROOM = math.sqrt(2.0) - 1.0  # ``1 / (1 + ROOM)`` is a gain of -3 dB
POINTS = 2**15  # points of the transform from which a bandwidth is read: steps of 3 mHz at 100 Hz
DECAYS = 28.0  # time constants after which a kernel is below 1e-12 of its peak: rounding
SLOWEST = 2e-4
"""Lowest cutoff of a smoothing spline over the sampling rate: below it, the spline's equations lose four digits."""


@dataclass(frozen=True)
class Derivatives:
    """A smoothed signal with its first two derivatives [1/s], [1/s^2], each of the signal's shape."""

    value: Array
    first: Array
    second: Array


class Differentiator(ABC):
    """A linear, time-invariant way to smooth and differentiate; implementations are frozen."""

    @abstractmethod
    def derivatives(self, y: Array, dt: float) -> Derivatives:
        """Value and derivatives of samples ``(n,)`` or ``(n, n_y)``; NaN where the past is too short."""

    @abstractmethod
    def reach(self, dt: float) -> int:
        """Samples before and after a row that can affect it (in recursions: more than rounding)."""

    def delay(self, dt: float) -> float:
        """Delay [s] of the estimate in a row behind the row's sample; 0 for all methods that look ahead."""
        return 0.0

    def kernel(self, dt: float, derivative: int = 0) -> Array:
        """Weights ``(2 reach + 1,)`` of the samples, newest first, away from the ends of the signal."""
        reach = self.reach(dt)
        impulse = np.zeros(4 * reach + 1)
        impulse[2 * reach] = 1.0
        d = self.derivatives(impulse, dt)
        return (d.value, d.first, d.second)[derivative][reach : 3 * reach + 1]

    def response(self, f: Array, dt: float, derivative: int = 0) -> NDArray[np.complex128]:
        """Response at ``f`` ``(m,)`` [Hz] over that of the exact derivative, delay removed; 1 at ``f = 0``."""
        s = 2 * np.pi * np.asarray(f, dtype=float)
        reach = self.reach(dt)
        phase = np.exp(-1j * np.outer(s, np.arange(-reach, reach + 1)) * dt)
        exact = np.where(s > 0, (1j * s) ** derivative, 1.0) * np.exp(-1j * s * self.delay(dt))
        return np.where(s > 0, phase @ self.kernel(dt, derivative) / exact, 1.0)

    def bandwidth(self, dt: float, derivative: int = 0) -> float:
        """Lowest frequency [Hz] at which the estimate has lost 3 dB (gain 1/sqrt(2)) against the exact derivative."""
        kernel = self.kernel(dt, derivative)
        n = max(POINTS, 2 ** math.ceil(math.log2(8 * len(kernel))))
        f = np.fft.rfftfreq(n, dt)[1:]
        gain = np.abs(np.fft.rfft(kernel, n)[1:]) / (2 * np.pi * f) ** derivative
        below = gain < HALF_POWER
        return float(f[np.argmax(below)]) if below.any() else float(f[-1])

    def noise_gain(self, dt: float, derivative: int = 0) -> float:
        """Standard deviation of an estimate per unit of white noise in the samples, away from the ends."""
        return float(np.linalg.norm(self.kernel(dt, derivative)))


def differentiate(y: Array, dt: float, method: Differentiator) -> Derivatives:
    """Smoothed signal with its first two derivatives.

    Args:
        y: Samples ``(n,)`` or ``(n, n_y)`` on a uniform grid, finite.
        dt: Period [s].
        method: :class:`LocalPolynomial`, :class:`SmoothingSpline`, :class:`ZeroPhaseFilter`, or
            :class:`CausalPolynomial`, which uses only past samples.

    Returns:
        Arrays of the shape of ``y``. Row ``k`` is the estimate at time ``k dt - method.delay(dt)``, NaN where the past
        of a causal method is too short.

    Raises:
        InputError: If ``y`` or ``dt`` is invalid, or the signal is too short for the method.

    Example:
        >>> t = 0.01 * np.arange(300)
        >>> d = differentiate(np.sin(t), 0.01, ZeroPhaseFilter(8.0))
        >>> bool(np.abs(d.first - np.cos(t))[50:-50].max() < 1e-3)
        True
    """
    y = real_numbers(y, "differentiate: samples")
    if not hasattr(method, "derivatives") or isinstance(method, type):
        raise InputError(
            f"differentiate: method must be one such as LocalPolynomial(0.2), got {method!r:.80} [HM-DATA-001]"
        )
    if y.ndim not in (1, 2) or not y.size:
        raise InputError(
            f"differentiate: samples must have shape (n,) or (n, n_y), got {y.shape} [HM-DATA-002]"
        )
    if not positive(dt):
        raise InputError(f"differentiate: period dt must be positive, got {dt} s [HM-DATA-003]")
    if not np.isfinite(y).all():
        row = int(np.argwhere(~np.isfinite(y))[0, 0])
        raise InputError(
            f"differentiate: sample {row} is not finite. Cut the signal there or correct the sample. [HM-DATA-004]"
        )
    return method.derivatives(y, dt)


def positive(value: object) -> bool:
    """Whether a value is a positive finite number."""
    if not isinstance(value, float | int | np.floating | np.integer) or isinstance(value, bool):
        return False
    return bool(0 < value < 1e300)


def window_samples(length: float, dt: float, order: int = 4) -> int:
    """Odd number of samples in a window of at most ``length`` [s] at the period ``dt`` [s].

    Example:
        >>> window_samples(0.2, 0.02)
        11
    """
    if not positive(length):
        raise InputError(f"smoothing: length must be positive [s], got {length!r:.80} [HM-DATA-005]")
    n = 2 * int(np.floor(length / (2 * dt) + 1e-6)) + 1
    if n <= order + 1:
        need = 2 * (order // 2 + 1) * dt
        raise InputError(
            f"smoothing of {length:g} s covers {n} samples at {dt:g} s, but a polynomial of order {order} needs "
            f"at least {need:g} s. Raise smoothing in the DataSpec or record faster. [HM-DATA-006]"
        )
    return n


def local_polynomial(y: Array, dt: float, length: float, order: int = 4) -> Derivatives:
    """Value, first and second derivative of a local polynomial fitted around each sample.

    Exact for polynomials up to ``order``. Within half a window of the ends the first or last whole window's polynomial
    is evaluated (noisier there).

    Source: A. Savitzky and M. J. E. Golay, Analytical Chemistry 36 (1964) 1627.
    """
    from scipy.signal import (
        savgol_filter,
    )  # takes half a second to import; commands such as scenarios do without

    n = window_samples(length, dt, order)
    if n > len(y):
        raise InputError(
            f"smoothing of {length:g} s needs {n} samples, but the signal has {len(y)}. Shorten smoothing or "
            "give a longer recording. [HM-DATA-007]"
        )
    value, first, second = (
        np.asarray(savgol_filter(y, n, order, deriv=i, delta=dt, axis=0, mode="interp"), dtype=float)
        for i in range(3)
    )
    return Derivatives(value, first, second)


@dataclass(frozen=True)
class LocalPolynomial(Differentiator):
    """Savitzky-Golay: a polynomial fitted around each sample (:func:`local_polynomial`).

    Exact for polynomials up to ``order``; an estimate depends only on samples in its window.

    Args:
        length: Length of the window [s], half of it ahead.
        order: Order of the polynomial, default 4.

    Example:
        >>> 8.0 < LocalPolynomial(0.2).bandwidth(0.01) < 9.0
        True
    """

    length: float
    order: int = 4

    def derivatives(self, y: Array, dt: float) -> Derivatives:
        """See :func:`local_polynomial`."""
        return local_polynomial(y, dt, self.length, self.order)

    def reach(self, dt: float) -> int:
        """Half the window."""
        return window_samples(self.length, dt, self.order) // 2


@dataclass(frozen=True)
class CausalPolynomial(Differentiator):
    """A polynomial fitted to the latest samples, for use in real time.

    Args:
        length: Length of the window [s].
        order: Order of the polynomial, default 2.
        lag: Time [s] before the newest sample at which the polynomial is evaluated, rounded to whole periods. A lag of
            0 needs order 3 and is much noisier. Default: half the window.

    Example:
        >>> d = differentiate(0.01 * np.arange(8.0) ** 2, 0.1, CausalPolynomial(0.4))
        >>> d.first.round(9).tolist()  # of t^2, at the window's centre 0.2 s before
        [nan, nan, nan, nan, 0.4, 0.6, 0.8, 1.0]
    """

    length: float
    order: int = 2
    lag: float | None = None

    def derivatives(self, y: Array, dt: float) -> Derivatives:
        """Estimates from the window that ends at each row."""
        from scipy.signal import savgol_coeffs

        n, back = self._samples(dt)
        if len(y) < n:
            raise InputError(_too_short(n, len(y)))
        past = np.lib.stride_tricks.sliding_window_view(y, n, axis=0)
        empty = np.full((n - 1, *y.shape[1:]), np.nan)
        value, first, second = (
            np.concatenate(
                [empty, past @ savgol_coeffs(n, self.order, deriv=i, delta=dt, pos=n - 1 - back, use="dot")]
            )
            for i in range(3)
        )
        return Derivatives(value, first, second)

    def reach(self, dt: float) -> int:
        """The whole window."""
        return self._samples(dt)[0] - 1

    def delay(self, dt: float) -> float:
        """The lag in whole periods."""
        return self._samples(dt)[1] * dt

    def _samples(self, dt: float) -> tuple[int, int]:
        n = window_samples(self.length, dt, self.order)
        back = n // 2 if self.lag is None else round(self.lag / dt)
        if not 0 <= back < n:
            raise InputError(
                f"causal polynomial: lag of {self.lag:g} s must lie within the window of {self.length:g} s. Shorten "
                "the lag or lengthen the window. [HM-DATA-008]"
            )
        return n, back


@dataclass(frozen=True)
class SmoothingSpline(Differentiator):
    """Cubic smoothing spline: least squares with a penalty on the second derivative.

    On a uniform grid, away from the ends, the samples' spline has the gain ``B / (B + lam D^2)`` with
    ``B = (4 + 2 cos w) / 6``, ``D = 2 - 2 cos w``, ``w = 2 pi f dt``; the penalty ``lam`` follows from the bandwidth.

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
                f"smoothing spline: a cutoff of {self.cutoff:g} Hz at {1 / dt:g} Hz is too low to compute. Raise it "
                f"to {SLOWEST / dt:g} Hz, use ZeroPhaseFilter, or keep fewer samples. [HM-DATA-009]"
            )
        k = np.arange(len(y), dtype=float)
        lam = ROOM * _spline_ratio(np.array(2 * np.pi * self.cutoff * dt)).item()
        from scipy.interpolate import make_smoothing_spline

        columns = [make_smoothing_spline(k, column, lam=lam) for column in y.reshape(len(y), -1).T]
        value, first, second = (
            np.column_stack([np.asarray(s.derivative(i)(k) if i else s(k)) for s in columns]).reshape(y.shape)
            / dt**i
            for i in range(3)
        )
        return Derivatives(value, first, second)

    def reach(self, dt: float) -> int:
        """The kernel decays by a factor of e in ``ROOM^(1/4) sqrt(2) / (2 pi cutoff)``."""
        return math.ceil(DECAYS * ROOM**0.25 * math.sqrt(2) / (2 * math.pi * self.cutoff * dt))


@dataclass(frozen=True)
class ZeroPhaseFilter(Differentiator):
    """Butterworth low-pass run forwards and backwards, then differentiated through a cubic spline.

    The spline interpolates: its derivatives at the samples are compact differences, of order 4 and 2 in ``dt``.
    At the ends the signal is continued by point reflection, over the filter's whole reach.

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
        from scipy.interpolate import CubicSpline
        from scipy.signal import butter, sosfiltfilt

        sos = butter(self.order, self._run(dt), output="sos")
        pad = min(len(y) - 1, self.reach(dt))  # the transient of the recursion's start has decayed by then
        spline = CubicSpline(dt * np.arange(len(y)), sosfiltfilt(sos, y, axis=0, padlen=pad))
        t = spline.x
        return Derivatives(spline(t), spline(t, 1), spline(t, 2))

    def reach(self, dt: float) -> int:
        """Until the slowest pole, or that of the interpolating spline (``sqrt(3) - 2``), has decayed."""
        from scipy.signal import butter

        _, poles, _ = butter(self.order, self._run(dt), output="zpk")
        slowest = max(float(np.abs(poles).max()), 2 - math.sqrt(3))
        return math.ceil(DECAYS / -math.log(slowest))

    def _run(self, dt: float) -> float:
        """Cutoff of one run over half the sampling rate.

        Each run has the gain ``1 / sqrt(1 + (W / W_d)^(2 order))`` in ``W = tan(pi f dt)``, both together its square.
        """
        warped = math.tan(math.pi * self.cutoff * dt) / ROOM ** (0.5 / self.order)
        return 2 / math.pi * math.atan(warped)


def gcv_cutoff(y: Array, dt: float) -> float:
    """Cutoff [Hz] of a smoothing spline by generalised cross-validation: for white noise of unknown variance.

    It minimises ``n |y - y_hat|^2 / (n - tr)^2``; the trace ``tr`` of the smoother is the sum of its gains at the
    frequencies ``k / (2 n dt)``. Quantisation of a slow signal is not white noise.

    Source: P. Craven and G. Wahba, Numerische Mathematik 31 (1979) 377.
    """
    y = np.asarray(y, dtype=float)
    n = len(y)
    if y.ndim != 1 or n < 16:
        raise InputError(
            f"gcv_cutoff: at least 16 samples (n,) of one signal are needed, got shape {y.shape} [HM-DATA-010]"
        )
    ratio = 1 / _spline_ratio(np.pi * np.arange(1, n) / n)

    def score(log_cutoff: float) -> float:
        cutoff = math.exp(log_cutoff)
        lam = ROOM * _spline_ratio(np.array(2 * np.pi * cutoff * dt)).item()
        trace = 1 + float(np.sum(1 / (1 + lam * ratio)))
        left = y - SmoothingSpline(cutoff).derivatives(y, dt).value
        return float(n * (left @ left) / (n - trace) ** 2)

    # the score may have several minima: search a grid, then refine between the neighbours of its best point
    grid = np.log(np.geomspace(max(2 / n, SLOWEST) / dt, 0.45 / dt, 40))
    scores = [score(point) for point in grid]
    k = min(max(int(np.argmin(scores)), 1), len(grid) - 2)
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(score, bounds=(grid[k - 1], grid[k + 1]), method="bounded")
    return math.exp(float(found.x))


def _spline_ratio(w: Array) -> Array:
    """``B / D^2`` of the smoothing spline's gain at ``w`` [rad per sample]."""
    return (4 + 2 * np.cos(w)) / 6 / (2 - 2 * np.cos(w)) ** 2


def _check_cutoff(cutoff: float, dt: float, n: int) -> None:
    if not positive(cutoff):
        raise InputError(f"cutoff: must be a positive frequency [Hz], got {cutoff!r:.80} [HM-DATA-011]")
    if not 0 < cutoff < 0.5 / dt:
        raise InputError(
            f"cutoff of {cutoff:g} Hz must be positive and below {0.5 / dt:g} Hz, half the sampling rate of "
            f"{1 / dt:g} Hz [HM-DATA-012]"
        )
    need = max(5, math.ceil(1 / (cutoff * dt)))
    if n < need:
        raise InputError(_too_short(need, n))


def _too_short(need: int, got: int) -> str:
    return (
        f"differentiate: the method needs {need} samples, but the signal has {got}. Give more samples or smooth less. "
        "[HM-DATA-115]"
    )
