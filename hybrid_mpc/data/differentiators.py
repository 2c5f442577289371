"""Ways to smooth and differentiate a sampled signal behind one interface; each says its bandwidth, delay and noise."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs

from hybrid_mpc.data.differentiation import Derivatives, local_polynomial, window_samples
from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]
HALF_POWER = math.sqrt(0.5)
POINTS = 2**15
"""Points of the transform in which a bandwidth is looked for: steps of 3 mHz at 100 Hz."""


class Differentiator(ABC):
    """A linear, time-invariant way to smooth and differentiate; implementations are frozen.

    ``delay`` is what lies between the instant that an estimate belongs to and its row, and zero for all methods
    that look ahead.
    """

    @abstractmethod
    def derivatives(self, y: Array, dt: float) -> Derivatives:
        """Value and derivatives of samples ``(n,)`` or ``(n, n_y)``; NaN where too little past is known.

        Raises:
            InputError: If the signal is too short or the method does not fit ``dt`` [s].
        """

    @abstractmethod
    def reach(self, dt: float) -> int:
        """Samples before and after a row beyond which nothing acts on it (for recursions: but rounding)."""

    def delay(self, dt: float) -> float:
        """Time [s] from the instant that an estimate speaks of to the sample in whose row it stands."""
        return 0.0

    def kernel(self, dt: float, derivative: int = 0) -> Array:
        """Weights ``(2 reach + 1,)`` of the samples, newest first, away from the ends of the signal."""
        reach = self.reach(dt)
        impulse = np.zeros(4 * reach + 1)
        impulse[2 * reach] = 1.0
        d = self.derivatives(impulse, dt)
        return (d.value, d.first, d.second)[derivative][reach : 3 * reach + 1]

    def response(self, f: Array, dt: float, derivative: int = 0) -> NDArray[np.complex128]:
        """Gain and phase at ``f`` ``(m,)`` [Hz] over those of the exact derivative, delay taken off; 1 at ``f = 0``.

        Args:
            f: Frequencies [Hz].
            dt: Period [s].
            derivative: 0, 1 or 2.
        """
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
        method: :class:`LocalPolynomial`, :class:`~hybrid_mpc.data.SmoothingSpline`,
            :class:`~hybrid_mpc.data.ZeroPhaseFilter`, or :class:`CausalPolynomial` for what can be known at each
            sample.

    Returns:
        Arrays of the shape of ``y``. Row ``k`` belongs to the instant ``k dt - method.delay(dt)``; where a causal
        method has too little past it is NaN.

    Raises:
        InputError: If ``y`` is no such array, ``dt`` is not positive, or the signal is too short for the method.

    Example:
        >>> from hybrid_mpc.data import SmoothingSpline, ZeroPhaseFilter
        >>> t = 0.01 * np.arange(300)
        >>> for method in LocalPolynomial(0.2), SmoothingSpline(8.0), ZeroPhaseFilter(8.0):
        ...     d = differentiate(np.sin(t), 0.01, method)
        ...     print(bool(np.abs(d.first - np.cos(t))[50:-50].max() < 1e-3))
        True
        True
        True
    """
    y = np.asarray(y, dtype=float)
    if y.ndim not in (1, 2) or not y.size:
        raise InputError(f"differentiate: needs samples (n,) or (n, n_y), got an array of shape {y.shape}")
    if not (math.isfinite(dt) and dt > 0):
        raise InputError(f"differentiate: the period must be positive, got {dt} s")
    if not np.isfinite(y).all():
        row = int(np.argwhere(~np.isfinite(y))[0, 0])
        raise InputError(f"differentiate: sample {row} is not finite; cut the signal there or repair it")
    return method.derivatives(y, dt)


@dataclass(frozen=True)
class LocalPolynomial(Differentiator):
    """Savitzky-Golay: a polynomial fitted around each sample (:func:`~hybrid_mpc.data.local_polynomial`).

    Exact for polynomials up to ``order``; nothing outside its window acts on an estimate. What the main job uses.

    Args:
        length: Length of the window [s]; it looks ahead by half of it.
        order: Order of the polynomial, default 4.

    Example:
        >>> 8.0 < LocalPolynomial(0.2).bandwidth(0.01) < 9.0
        True
    """

    length: float
    order: int = 4

    def derivatives(self, y: Array, dt: float) -> Derivatives:
        """See :func:`~hybrid_mpc.data.local_polynomial`."""
        return local_polynomial(y, dt, self.length, self.order)

    def reach(self, dt: float) -> int:
        """Half the window."""
        return window_samples(self.length, dt, self.order) // 2


@dataclass(frozen=True)
class CausalPolynomial(Differentiator):
    """A polynomial through the last samples: for use while they come in, and to see what that costs.

    With the default lag and order this is :func:`~hybrid_mpc.data.causal_derivatives` over the last window.

    Args:
        length: Length of the window [s].
        order: Order of the polynomial, default 2.
        lag: Time [s] before the newest sample at which the polynomial is evaluated, rounded to whole periods; 0 is
            now: take order 3 then (a quadratic's second derivative is the same everywhere), and expect much more
            noise. Default: half the window.

    Example:
        >>> d = differentiate(0.01 * np.arange(8.0) ** 2, 0.1, CausalPolynomial(0.4))
        >>> d.first.round(9).tolist()  # of t^2, at the window's centre 0.2 s before
        [nan, nan, nan, nan, 0.4, 0.6, 0.8, 1.0]
    """

    length: float
    order: int = 2
    lag: float | None = None

    def derivatives(self, y: Array, dt: float) -> Derivatives:
        """Estimates from the window that ends with each row."""
        n, back = self._samples(dt)
        if len(y) < n:
            raise InputError(too_short(n, len(y)))
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
        """The window."""
        return self._samples(dt)[0] - 1

    def delay(self, dt: float) -> float:
        """The lag in whole periods."""
        return self._samples(dt)[1] * dt

    def _samples(self, dt: float) -> tuple[int, int]:
        n = window_samples(self.length, dt, self.order)
        back = n // 2 if self.lag is None else round(self.lag / dt)
        if not 0 <= back < n:
            raise InputError(
                f"causal polynomial: its lag of {self.lag:g} s must be within the {self.length:g} s window"
            )
        return n, back


def too_short(need: int, got: int) -> str:
    """What is said of a signal that is shorter than a method needs."""
    return f"differentiate: the method needs {need} samples, the signal has {got}. Give more or smooth less."
