"""Input signals that excite a machine for identification: their levels, and what spectrum to expect of each."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.signal import max_len_seq

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

    Over ``T`` seconds its amplitude spectrum is flat at ``amplitude / sqrt(T |f1 - f0|)`` between its two frequencies,
    with ripples near them, and falls off outside. Its crest factor is that of a sine, 1.41.

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


def random_steps(
    t: Array, lower: float, upper: float, *, hold: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Random levels, uniform in ``[lower, upper]``, each held for a random time.

    Most power lies below ``0.44`` over the mean hold [Hz]; above, the amplitude falls with ``1 / f``. Levels between
    the bounds show what depends on the size of the input, as two levels do not.

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
        >>> u = random_steps(np.arange(5.0), -1.0, 1.0, hold=(2.0, 2.0), rng=np.random.default_rng(0))
        >>> len(set(u.tolist()))
        3
    """
    shortest, longest = hold
    if not (lower <= upper and 0 < shortest <= longest):
        raise InputError(
            f"random_steps: need lower <= upper and 0 < shortest <= longest hold, got levels "
            f"{lower:g} to {upper:g} and holds {shortest:g} to {longest:g} s"
        )
    t = np.asarray(t, dtype=float)
    most = math.ceil((t[-1] - t[0]) / shortest) + 1
    switches = t[0] + np.cumsum(rng.uniform(shortest, longest, most))
    levels = rng.uniform(lower, upper, most + 1)
    return levels[np.searchsorted(switches, t, side="right")]


def multisine(
    t: Array,
    amplitude: float,
    lower_frequency: float,
    upper_frequency: float,
    *,
    period: float | None = None,
    odd: bool = False,
    offset: float = 0.0,
    lower: float = -math.inf,
    upper: float = math.inf,
) -> Array:
    """Sum of cosines of one size at all multiples of ``1 / period`` in a band, with Schroeder's phases.

    Power lies at these lines alone, evenly; over whole periods an FFT shows them without leakage, and what it shows
    between them is noise and what the machine's nonlinearity makes. Phases ``-pi i (i - 1) / n`` keep the peaks low:
    :func:`~hybrid_mpc.data.crest_factor` is 1.6 to 2 for ten lines or more, where random phases mostly give above 2.3.

    Args:
        t: Times ``(n,)`` [s], evenly spaced.
        amplitude: Largest deviation from the offset [input unit].
        lower_frequency: Lower end of the band [Hz].
        upper_frequency: Upper end of the band [Hz], below half the sampling rate.
        period: Period [s]; the lines are ``1 / period`` apart. Default: the length of ``t``.
        odd: Odd multiples only: what appears at the even ones is nonlinear distortion of even order.
        offset: Mean [input unit].
        lower: Smallest input that the machine takes; default: none.
        upper: Largest input that the machine takes; default: none.

    Returns:
        Inputs ``(n,)``.

    Raises:
        InputError: If the signal would leave its bounds, no line lies in the band, or the band is not below half the
            sampling rate.

    Source: M. R. Schroeder, IEEE Transactions on Information Theory 16 (1970) 85.

    Example:
        >>> from hybrid_mpc.data import crest_factor
        >>> t = 0.01 * np.arange(1000)
        >>> u = multisine(t, 0.5, 0.2, 3.0)
        >>> round(float(abs(u).max()), 12), crest_factor(u) < 2.0
        (0.5, True)
    """
    _check_bounds("multisine", amplitude, offset, lower, upper)
    t = np.asarray(t, dtype=float)
    s, dt = t - t[0], _period_of("multisine", t)
    period = len(t) * dt if period is None else period
    if not (period > 0 and 0 < lower_frequency <= upper_frequency < 0.5 / dt):
        raise InputError(
            f"multisine: need a positive period and 0 < lower <= upper frequency < {0.5 / dt:g} Hz (half the sampling "
            f"rate), got {period:g} s and {lower_frequency:g} to {upper_frequency:g} Hz"
        )
    near = 1e-9  # a multiple on the band's edge belongs to it, rounded or not
    lines = np.arange(
        math.ceil(lower_frequency * period - near), math.floor(upper_frequency * period + near) + 1
    )
    lines = lines[lines % 2 == 1] if odd else lines
    if not len(lines):
        raise InputError(
            f"multisine: no line between {lower_frequency:g} and {upper_frequency:g} Hz; they are {1 / period:g} Hz "
            f"apart{' and odd multiples only' if odd else ''}. Lengthen the period or widen the band."
        )
    i = np.arange(1, len(lines) + 1)
    u = np.zeros(len(t))
    for line, phase in zip(lines, -np.pi * i * (i - 1) / len(lines), strict=True):
        u += np.cos(2 * np.pi * line / period * s + phase)
    return offset + amplitude * u / np.abs(u).max()


def prbs(
    t: Array, lower: float, upper: float, *, clock: float, bits: int | None = None, shift: int = 0
) -> Array:
    """Pseudo-random binary sequence of maximum length: two levels, which may change at every tick of the clock.

    It repeats after ``N = 2^bits - 1`` ticks. With ``a`` half the distance of the levels its mean is ``a / N`` off
    their middle, and at the lines ``k / (N clock)`` stands the amplitude ``2 a sqrt(N + 1) / N |sinc(k / N)|``: flat
    at low frequencies, -3 dB at ``0.44 / clock``, nothing at multiples of ``1 / clock``.

    Args:
        t: Times ``(n,)`` [s], increasing.
        lower: Lower level [input unit].
        upper: Upper level [input unit].
        clock: Time of a tick [s]: a multiple of the sampling time, about a third of the machine's time constant.
        bits: Length of the shift register, 2 to 32. Default: the shortest that does not repeat within ``t``.
        shift: Ticks by which the sequence is advanced, to give several inputs ones of their own.

    Returns:
        Inputs ``(n,)``, each ``lower`` or ``upper``.

    Raises:
        InputError: If the levels are not in order, the clock is shorter than the sampling time, or ``bits`` is out of
            range.

    Source: S. W. Golomb, Shift Register Sequences, 1967; W. D. T. Davies, System Identification for Self-Adaptive
    Control, 1970 (spectrum).

    Example:
        >>> u = prbs(0.1 * np.arange(14), -1.0, 1.0, clock=0.2, bits=3)
        >>> u[::2].tolist()
        [1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0]
    """
    t = np.asarray(t, dtype=float)
    dt = _period_of("prbs", t)
    if not (lower < upper and clock >= dt * (1 - 1e-6)):
        raise InputError(
            f"prbs: need lower < upper and a clock of at least the sampling time {dt:g} s, got levels {lower:g} to "
            f"{upper:g} and a clock of {clock:g} s"
        )
    ticks = np.floor((t - t[0]) / clock + 1e-6).astype(int)  # 1e-6: rounding of the times
    if bits is None:
        bits = max(2, math.ceil(math.log2(ticks[-1] + 2)))
    if not 2 <= bits <= 32:
        raise InputError(
            f"prbs: a shift register has 2 to 32 bits, got {bits}. Lengthen the clock or give bits."
        )
    length = 2**bits - 1
    first = shift % length
    sequence, _ = max_len_seq(bits, length=min(length, first + int(ticks[-1]) + 1))
    return np.where(sequence[(ticks + first) % length] > 0, float(upper), float(lower))


def _period_of(what: str, t: Array) -> float:
    if len(t) < 2 or not t[-1] > t[0]:
        raise InputError(f"{what}: its times must span more than one instant")
    return float(t[-1] - t[0]) / (len(t) - 1)


def _check_bounds(what: str, amplitude: float, offset: float, lower: float, upper: float) -> None:
    if offset - abs(amplitude) < lower or offset + abs(amplitude) > upper:
        raise InputError(
            f"{what}: {offset:g} +- {abs(amplitude):g} leaves the bounds {lower:g} to {upper:g}. "
            "Lower the amplitude."
        )
