"""Smooth and differentiate a sampled signal by local polynomials (Savitzky-Golay)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs, savgol_filter

from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Derivatives:
    """A smoothed signal with its first two derivatives, each of the signal's shape.

    Args:
        value: Smoothed signal.
        first: First derivative [1/s].
        second: Second derivative [1/s^2].
    """

    value: Array
    first: Array
    second: Array


def window_samples(length: float, dt: float, order: int = 4) -> int:
    """Odd number of samples in a window of at most ``length`` [s] at the period ``dt`` [s].

    Raises:
        InputError: If the window holds no more than ``order + 1`` samples: the polynomial would go
            through every sample and smooth nothing.

    Example:
        >>> window_samples(0.2, 0.02)
        11
    """
    n = 2 * int(np.floor(length / (2 * dt) + 1e-6)) + 1
    if n <= order + 1:
        need = 2 * (order // 2 + 1) * dt
        raise InputError(
            f"smoothing of {length:g} s holds {n} samples at {dt:g} s; a polynomial of order {order} needs "
            f"at least {need:g} s. Raise smoothing in the DataSpec or record faster."
        )
    return n


def local_polynomial(y: Array, dt: float, length: float, order: int = 4) -> Derivatives:
    """Value, first and second derivative of a local polynomial fitted around each sample.

    Exact for polynomials up to ``order``. It looks ahead by half of ``length`` at most; within half a
    window of the ends the first or last whole window's polynomial is evaluated (noisier there).

    Args:
        y: Samples ``(n,)`` or ``(n, n_y)`` on a uniform grid.
        dt: Period [s].
        length: Length of the window [s].
        order: Order of the polynomial, default 4.

    Returns:
        Arrays of the shape of ``y``.

    Raises:
        InputError: If the window holds too few samples or is longer than the signal.

    Example:
        >>> t = 0.01 * np.arange(50)
        >>> d = local_polynomial(t**3, 0.01, length=0.1)
        >>> bool(np.allclose(d.second, 6 * t))
        True

    Source: A. Savitzky and M. J. E. Golay, Analytical Chemistry 36 (1964) 1627.
    """
    n = window_samples(length, dt, order)
    if n > len(y):
        raise InputError(
            f"smoothing of {length:g} s needs {n} samples, the signal has {len(y)}. Shorten smoothing or "
            "give a longer recording."
        )
    value, first, second = (
        np.asarray(savgol_filter(y, n, order, deriv=i, delta=dt, axis=0, mode="interp"), dtype=float)
        for i in range(3)
    )
    return Derivatives(value, first, second)


def noise_gain(dt: float, length: float, order: int = 4, derivative: int = 0) -> float:
    """Standard deviation of a (derivative's) estimate per unit of white noise in the samples.

    It is the Euclidean norm of the filter's coefficients, away from the ends.

    Args:
        dt: Period [s].
        length: Length of the window [s].
        order: Order of the polynomial, default 4.
        derivative: 0, 1 or 2.

    Example:
        >>> round(noise_gain(0.005, 0.2, derivative=2))
        351
    """
    n = window_samples(length, dt, order)
    return float(np.linalg.norm(savgol_coeffs(n, order, deriv=derivative, delta=dt)))


def bandwidth(dt: float, length: float, order: int = 4) -> float:
    """Frequency [Hz] at which the smoothed value has lost 3 dB (gain 1/sqrt(2)).

    Args:
        dt: Period [s].
        length: Length of the window [s].
        order: Order of the polynomial, default 4.

    Example:
        >>> 7.0 < bandwidth(0.005, 0.2) < 10.0
        True
    """
    n = window_samples(length, dt, order)
    f = np.linspace(0.0, 0.5 / dt, 20001)
    below = frequency_gain(f, dt, n, order) < np.sqrt(0.5)
    return float(f[np.argmax(below)]) if below.any() else float(f[-1])


def frequency_gain(f: Array, dt: float, n: int, order: int = 4, derivative: int = 0) -> Array:
    """Response of the filter at ``f`` [Hz] over that of the exact derivative ``(2 pi f j)^derivative``.

    The response is real: the window is symmetric. At ``f = 0`` it is 1.

    Example:
        >>> frequency_gain(np.array([0.0]), 0.01, 11).round(12).tolist()
        [1.0]
    """
    c = savgol_coeffs(n, order, deriv=derivative, delta=dt, use="dot")
    s = 2 * np.pi * np.asarray(f, dtype=float)
    phase = np.exp(1j * np.outer(s, np.arange(n) - n // 2) * dt)
    exact = np.where(s > 0, (1j * s) ** derivative, 1.0)
    gain = np.real(phase @ c / exact)
    return np.where(s > 0, gain, 1.0)


def causal_derivatives(y: Array, dt: float) -> Derivatives:
    """Local quadratic over the last samples, evaluated at the window's centre: for online use.

    The estimate belongs to the instant ``(n - 1) / 2 * dt`` before the last sample: that is its delay.

    Args:
        y: The last ``n >= 3`` samples ``(n,)`` or ``(n, n_y)``, oldest first; ``n`` odd.
        dt: Period [s].

    Returns:
        Scalars or arrays ``(n_y,)`` at the centre of the window.

    Raises:
        InputError: If ``n`` is even or below 3.

    Example:
        >>> d = causal_derivatives(np.array([0.0, 0.01, 0.04, 0.09, 0.16]), 0.1)
        >>> round(float(d.first), 9), round(float(d.second), 9)
        (0.4, 2.0)
    """
    y = np.asarray(y, dtype=float)
    n = len(y)
    if n < 3 or n % 2 == 0:
        raise InputError(f"causal derivatives need an odd number of samples, at least 3; got {n}")
    value, first, second = (
        np.asarray(savgol_coeffs(n, 2, deriv=i, delta=dt, use="dot") @ y) for i in range(3)
    )
    return Derivatives(value, first, second)
