"""References that more than one machine's tasks are made of. No torch in here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def faded_sines(t: Array, waves: tuple[tuple[float, float], ...], fade_s: float = 1.0) -> Array:
    """Sum of sinusoids that is faded in, from rest and without a jump in the acceleration.

    Args:
        t: Times ``(n,)`` [s].
        waves: Amplitude [rad or m] and frequency [Hz] of each.
        fade_s: Time [s] over which they are faded in. Default 1.

    Returns:
        ``(n, 2)``: position and its exact derivative.

    Example:
        >>> faded_sines(np.array([0.0, 1.25]), ((0.5, 1.0),)).round(6).tolist()
        [[0.0, 0.0], [0.5, 0.0]]
    """
    fade, slope = quintic(t / fade_s)
    parts = [(a, 2 * np.pi * f) for a, f in waves]
    wave = sum((a * np.sin(w * t) for a, w in parts), np.zeros_like(t))
    rate = sum((a * w * np.cos(w * t) for a, w in parts), np.zeros_like(t))
    return np.column_stack([fade * wave, slope / fade_s * wave + fade * rate])


def quintic(s: Array) -> tuple[Array, Array]:
    """From 0 to 1 while ``s`` does, with slope and curvature zero at both ends; and its slope.

    Example:
        >>> quintic(np.array([0.5, 2.0]))
        (array([0.5, 1. ]), array([1.875, 0.   ]))
    """
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2
