"""Input signals that excite a machine for identification. numpy only."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]


def sinusoid(
    t: Array,
    amplitude: float,
    frequency: float,
    *,
    phase: float = 0.0,
    offset: float = 0.0,
    lower: float = -math.inf,
    upper: float = math.inf,
) -> Array:
    """``offset + amplitude sin(2 pi frequency t + phase)``.

    Args:
        t: Times ``(n,)`` [s].
        amplitude: Amplitude [input unit].
        frequency: Frequency [Hz].
        phase: Phase [rad].
        offset: Mean [input unit].
        lower: Smallest input that the machine takes; default: none.
        upper: Largest input that the machine takes; default: none.

    Returns:
        Inputs ``(n,)``.

    Raises:
        InputError: If the signal would leave its bounds (clipping would change its spectrum).

    Example:
        >>> sinusoid(np.array([0.0, 0.25]), 2.0, 1.0).tolist()
        [0.0, 2.0]
    """
    _check_bounds("sinusoid", amplitude, offset, lower, upper)
    return offset + amplitude * np.sin(2 * np.pi * frequency * np.asarray(t, dtype=float) + phase)


def chirp(
    t: Array,
    amplitude: float,
    start_frequency: float,
    end_frequency: float,
    *,
    offset: float = 0.0,
    lower: float = -math.inf,
    upper: float = math.inf,
) -> Array:
    """Sine whose frequency moves linearly from the first to the last time; it starts at the offset.

    Args:
        t: Times ``(n,)`` [s].
        amplitude: Amplitude [input unit].
        start_frequency: Frequency [Hz] at ``t[0]``.
        end_frequency: Frequency [Hz] at ``t[-1]``.
        offset: Mean [input unit].
        lower: Smallest input that the machine takes; default: none.
        upper: Largest input that the machine takes; default: none.

    Returns:
        Inputs ``(n,)``.

    Raises:
        InputError: If the signal would leave its bounds, or ``t`` spans no time.

    Example:
        >>> u = chirp(np.linspace(0.0, 10.0, 1001), 1.0, 0.1, 2.0)
        >>> bool(abs(u).max() <= 1.0)
        True
    """
    _check_bounds("chirp", amplitude, offset, lower, upper)
    s = np.asarray(t, dtype=float) - t[0]
    if not s[-1] > 0:
        raise InputError("chirp: its times must span more than one instant")
    cycles = start_frequency * s + (end_frequency - start_frequency) * s**2 / (2 * s[-1])
    return offset + amplitude * np.sin(2 * np.pi * cycles)


def steps(
    t: Array, lower: float, upper: float, *, hold: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Random levels, uniform in ``[lower, upper]``, each held for a random time.

    Args:
        t: Times ``(n,)`` [s], increasing.
        lower: Smallest level [input unit].
        upper: Largest level [input unit].
        hold: Shortest and longest hold [s], uniform between them.
        rng: Source of the randomness; the same state gives the same signal.

    Returns:
        Inputs ``(n,)``.

    Raises:
        InputError: If a range is empty or the shortest hold is not positive.

    Example:
        >>> u = steps(np.arange(5.0), -1.0, 1.0, hold=(2.0, 2.0), rng=np.random.default_rng(0))
        >>> len(set(u.tolist()))
        3
    """
    shortest, longest = hold
    if not (lower <= upper and 0 < shortest <= longest):
        raise InputError(
            f"steps: need lower <= upper and 0 < shortest <= longest hold, got levels "
            f"{lower:g} to {upper:g} and holds {shortest:g} to {longest:g} s"
        )
    t = np.asarray(t, dtype=float)
    most = math.ceil((t[-1] - t[0]) / shortest) + 1
    switches = t[0] + np.cumsum(rng.uniform(shortest, longest, most))
    levels = rng.uniform(lower, upper, most + 1)
    return levels[np.searchsorted(switches, t, side="right")]


def _check_bounds(what: str, amplitude: float, offset: float, lower: float, upper: float) -> None:
    if offset - abs(amplitude) < lower or offset + abs(amplitude) > upper:
        raise InputError(
            f"{what}: {offset:g} +- {abs(amplitude):g} leaves the bounds {lower:g} to {upper:g}. "
            "Lower the amplitude."
        )
