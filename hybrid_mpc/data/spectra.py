"""Spectra and crest factors of sampled signals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]


def crest_factor(u: Array) -> float:
    """Largest deviation from the mean over the standard deviation: 1 for two levels, 1.41 for a sine.

    The lower, the more power a signal has between given bounds.

    Args:
        u: Samples ``(n,)`` of whole periods.

    Raises:
        InputError: If the signal is constant.

    Example:
        >>> crest_factor(np.array([1.0, -1.0, 1.0, -1.0]))
        1.0
    """
    u = np.asarray(u, dtype=float)
    spread = float(u.std())
    if not spread > 0:
        raise InputError("crest_factor: the signal is constant")
    return float(np.abs(u - u.mean()).max()) / spread


def line_spectrum(u: Array, dt: float) -> tuple[Array, Array]:
    """Amplitude of each sine of which a whole number of periods fits the record.

    Args:
        u: Samples ``(n,)``.
        dt: Period [s].

    Returns:
        Frequencies ``(n // 2 + 1,)`` [Hz] from 0, and amplitudes [unit of u]; that at 0 is the mean's size.

    Example:
        >>> f, a = line_spectrum(3.0 * np.sin(2 * np.pi * 2.0 * 0.01 * np.arange(100)), 0.01)
        >>> float(f[2]), round(float(a[2]), 12), bool(a[[0, 1, 3]].max() < 1e-12)
        (2.0, 3.0, True)
    """
    u = np.asarray(u, dtype=float)
    size = np.abs(np.fft.rfft(u)) / len(u)
    size[1 : (len(u) + 1) // 2] *= 2
    return _frequencies(len(u), dt), size


def hann_spectrum(u: Array, dt: float) -> tuple[Array, Array]:
    """Amplitudes under a Hann window, for records of any length: a sine of amplitude 1 gives 0.85 to 1 at its peak.

    It fills the two bins to either side of its peak too; the mean is left out.

    Args:
        u: Samples ``(n,)``.
        dt: Period [s].

    Returns:
        Frequencies ``(n // 2 + 1,)`` [Hz] from 0, and amplitudes [unit of u]; 0 at 0.

    Example:
        >>> f, a = hann_spectrum(3.0 + np.sin(2 * np.pi * 2.0 * 0.01 * np.arange(100)), 0.01)
        >>> a[:5].round(6).tolist()
        [0.0, 0.5, 1.0, 0.5, 0.0]
    """
    n = len(u)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)
    mean = float((u * window).sum() / window.sum())
    amplitude: Array = 2 * np.abs(np.fft.rfft((u - mean) * window)) / window.sum()
    amplitude[0] = 0.0
    return _frequencies(n, dt), amplitude


def _frequencies(n: int, dt: float) -> Array:
    return np.asarray(np.fft.rfftfreq(n, dt), dtype=np.float64)
