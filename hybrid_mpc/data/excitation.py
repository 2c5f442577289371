"""Input signals that excite a machine, and a check whether recordings excite it enough to identify its parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.rules import counted

Array = NDArray[np.float64]
ROUNDING = 1e-12
"""Largest span of a constant signal, over its largest value: the rounding of conversion and interpolation. Any larger
span is a motion, however small beside the level or the range."""
WEAKEST = 0.1  # least amplitude of a spectral line over that of the strongest
LOBE = 2  # bins on either side of a line that its Hann window fills above WEAKEST


def sinusoid(
    t: Array, amplitude: float, frequency: float, *, phase: float = 0.0, offset: float = 0.0
) -> Array:
    """``offset + amplitude sin(2 pi frequency t + phase)``.

    Args:
        t: Times ``(n,)`` [s].
        amplitude: Amplitude [input unit].
        frequency: Frequency [Hz].
        phase: Phase [rad].
        offset: Mean [input unit].

    Example:
        >>> sinusoid(np.array([0.0, 0.25]), 2.0, 1.0).tolist()
        [0.0, 2.0]
    """
    return offset + amplitude * np.sin(2 * np.pi * frequency * np.asarray(t, dtype=float) + phase)


def chirp(
    t: Array, amplitude: float, start_frequency: float, end_frequency: float, *, offset: float = 0.0
) -> Array:
    """Sine whose frequency changes linearly from the first to the last time; it starts at the offset.

    Over ``T`` seconds its amplitude spectrum is flat at ``amplitude / sqrt(T |f1 - f0|)`` between its two frequencies,
    with ripples near them, and falls off outside. Its crest factor is that of a sine, 1.41.

    Args:
        t: Times ``(n,)`` [s].
        amplitude: Amplitude [input unit].
        start_frequency: Frequency [Hz] at ``t[0]``.
        end_frequency: Frequency [Hz] at ``t[-1]``.
        offset: Mean [input unit].

    Raises:
        InputError: If ``t`` spans no time.

    Example:
        >>> u = chirp(np.linspace(0.0, 10.0, 1001), 1.0, 0.1, 2.0)
        >>> bool(abs(u).max() <= 1.0)
        True
    """
    s = np.asarray(t, dtype=float) - t[0]
    if not s[-1] > 0:
        raise InputError("chirp: t must span more than one instant. Give increasing times. [HM-DATA-013]")
    cycles = start_frequency * s + (end_frequency - start_frequency) * s**2 / (2 * s[-1])
    return offset + amplitude * np.sin(2 * np.pi * cycles)


def random_steps(
    t: Array, lower: float, upper: float, *, hold: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Random levels, uniform in ``[lower, upper]``, each held for a random time.

    Most power lies below ``0.44`` over the mean hold [Hz]; above, the amplitude falls with ``1 / f``.

    Args:
        t: Times ``(n,)`` [s], increasing.
        lower: Smallest level [input unit].
        upper: Largest level [input unit].
        hold: Shortest and longest hold [s], uniform between them.
        rng: Random generator; equal states give equal signals.

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
            f"random_steps: lower <= upper and 0 < shortest <= longest hold must hold, got levels "
            f"{lower:g} to {upper:g} and holds {shortest:g} to {longest:g} s [HM-DATA-014]"
        )
    t = np.asarray(t, dtype=float)
    most = math.ceil((t[-1] - t[0]) / shortest) + 1
    switches = t[0] + np.cumsum(rng.uniform(shortest, longest, most))
    levels = rng.uniform(lower, upper, most + 1)
    return levels[np.searchsorted(switches, t, side="right")]


def multisine(
    t: Array, amplitude: float, lower_frequency: float, upper_frequency: float, *, period: float | None = None,
    odd: bool = False, offset: float = 0.0,
) -> Array:  # fmt: skip
    """Sum of cosines of equal amplitude at all multiples of ``1 / period`` in a band, with Schroeder phases.

    Power lies only at these lines, evenly. Between the lines, an FFT over whole periods shows noise and the distortion
    of the machine's nonlinearity. The phases ``-pi i (i - 1) / n`` keep the peaks low: the crest factor is 1.6 to 2
    for ten lines or more, with random phases mostly above 2.3.

    Args:
        t: Times ``(n,)`` [s], evenly spaced.
        amplitude: Largest deviation from the offset [input unit].
        lower_frequency: Lower end of the band [Hz].
        upper_frequency: Upper end of the band [Hz], below half the sampling rate.
        period: Period [s]; the lines are ``1 / period`` apart. Default: the length of ``t``.
        odd: Odd multiples only: lines at even ones then show nonlinear distortion of even order.
        offset: Mean [input unit].

    Raises:
        InputError: If no line lies in the band, or the band is not below half the sampling rate.

    Source: M. R. Schroeder, IEEE Transactions on Information Theory 16 (1970) 85.

    Example:
        >>> u = multisine(0.01 * np.arange(1000), 0.5, 0.2, 3.0)
        >>> round(float(abs(u).max()), 12), round(float(abs(u).max() / u.std()), 1)
        (0.5, 1.9)
    """
    t = np.asarray(t, dtype=float)
    s, dt = t - t[0], _period_of("multisine", t)
    period = len(t) * dt if period is None else period
    if not (period > 0 and 0 < lower_frequency <= upper_frequency < 0.5 / dt):
        raise InputError(
            f"multisine: a positive period and 0 < lower <= upper frequency < {0.5 / dt:g} Hz (half the sampling "
            f"rate) are needed, got {period:g} s and {lower_frequency:g} to {upper_frequency:g} Hz [HM-DATA-015]"
        )
    near = 1e-9  # tolerance: a multiple on the band's edge belongs to the band
    lines = np.arange(
        math.ceil(lower_frequency * period - near), math.floor(upper_frequency * period + near) + 1
    )
    lines = lines[lines % 2 == 1] if odd else lines
    if not len(lines):
        raise InputError(
            f"multisine: no line between {lower_frequency:g} and {upper_frequency:g} Hz; lines are {1 / period:g} Hz "
            f"apart{' and odd multiples only' if odd else ''}. Lengthen the period or widen the band. [HM-DATA-016]"
        )
    i = np.arange(1, len(lines) + 1)
    u = np.zeros(len(t))
    for line, phase in zip(lines, -np.pi * i * (i - 1) / len(lines), strict=True):
        u += np.cos(2 * np.pi * line / period * s + phase)
    return offset + amplitude * u / np.abs(u).max()


def prbs(
    t: Array, lower: float, upper: float, *, clock: float, bits: int | None = None, shift: int = 0
) -> Array:
    """Pseudo-random binary sequence of maximum length: two levels that may change at every tick of the clock.

    The sequence repeats after ``N = 2^bits - 1`` ticks. With ``a`` half the distance of the levels, its mean is
    ``a / N`` off their middle, and its lines ``k / (N clock)`` have the amplitude
    ``2 a sqrt(N + 1) / N |sinc(k / N)|``: flat at low frequencies, -3 dB at ``0.44 / clock``, zero at multiples of
    ``1 / clock``.

    Args:
        t: Times ``(n,)`` [s], increasing.
        lower: Lower level [input unit].
        upper: Upper level [input unit].
        clock: Duration of a tick [s]: a multiple of the sampling period, about a third of the machine's time constant.
        bits: Length of the shift register, 2 to 32. Default: the shortest that does not repeat within ``t``.
        shift: Ticks by which the sequence is advanced, to give several inputs different sequences.

    Raises:
        InputError: If the levels are not in order, the clock is shorter than the sampling period, or ``bits`` is out of
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
            f"prbs: lower < upper and a clock of at least the sampling period {dt:g} s are needed, got levels "
            f"{lower:g} to {upper:g} and a clock of {clock:g} s [HM-DATA-017]"
        )
    ticks = np.floor((t - t[0]) / clock + 1e-6).astype(int)  # 1e-6: rounding of the times
    if bits is None:
        bits = max(2, math.ceil(math.log2(ticks[-1] + 2)))
    if not 2 <= bits <= 32:
        raise InputError(
            f"prbs: bits must be 2 to 32, got {bits}. Lengthen the clock or give bits. [HM-DATA-018]"
        )
    length = 2**bits - 1
    first = shift % length
    from scipy.signal import max_len_seq

    sequence, _ = max_len_seq(bits, length=min(length, first + int(ticks[-1]) + 1))
    return np.where(sequence[(ticks + first) % length] > 0, float(upper), float(lower))


def _period_of(what: str, t: Array) -> float:
    if len(t) < 2 or not t[-1] > t[0]:
        raise InputError(f"{what}: t must span more than one instant. Give increasing times. [HM-DATA-019]")
    return float(t[-1] - t[0]) / (len(t) - 1)


@dataclass(frozen=True)
class Excitation:
    """Motion of one input over a set of trajectories: its standard deviation [input unit] and its spectral lines.

    ``lines`` are the increasing frequencies [Hz] of the sines that the recordings resolve, without the mean. Each sine
    determines two numbers of a linear machine's response, gain and phase.
    """

    name: str
    spread: float
    lines: tuple[float, ...]


def excitation_of(
    trajectories: Sequence[Trajectory], inputs: Sequence[Signal] = ()
) -> tuple[Excitation, ...]:
    """Spread and spectral lines of each input.

    Each trajectory's spectrum uses a Hann window. Lines are counted from the strongest on, each with the two bins on
    either side that it fills, down to a tenth of the strongest of all trajectories. Lines of several trajectories
    closer than these bins count once. So the count is a lower bound.

    Args:
        trajectories: At least one.
        inputs: Signals of the inputs, for their names. Default: ``input 1`` and so on.

    Raises:
        InputError: If there is no trajectory.

    Example:
        >>> t = 0.02 * np.arange(500)
        >>> u = np.sin(2 * np.pi * 0.5 * t) + 0.5 * np.sin(2 * np.pi * 2.0 * t)
        >>> zero = np.zeros((500, 1))
        >>> run = Trajectory("run", "train", 0.02, t, u[:, None], zero, zero, zero)
        >>> [round(f, 3) for f in excitation_of([run])[0].lines]
        [0.5, 2.0]
    """
    if not trajectories:
        raise InputError("excitation: no trajectories given. Give at least one. [HM-DATA-020]")
    found = []
    for j in range(trajectories[0].u.shape[1]):
        name = inputs[j].name if j < len(inputs) else f"input {j + 1}"
        every = np.concatenate([piece.u[:, j] for piece in trajectories])
        found.append(Excitation(name, float(every.std()), _lines([(p.u[:, j], p.dt) for p in trajectories])))
    return tuple(found)


def check_excitation(
    trajectories: Sequence[Trajectory],
    *,
    inputs: Sequence[Signal] = (),
    outputs: Sequence[Signal] = (),
    parameters: int = 0,
) -> tuple[str, ...]:
    """Refuse inputs without excitation; warn of inputs with too little excitation for a number of parameters.

    Args:
        trajectories: All data of a fit; an input may be constant in some of them.
        inputs: Signals of the inputs, for their names. Default: unnamed.
        outputs: Signals of the outputs, likewise.
        parameters: Number of parameters to fit. A linear model needs one sine per two parameters; a nonlinear one may
            need fewer, so this is only a warning. Default: not checked.

    Raises:
        InputError: If there is no trajectory, an input is constant over all of them, or an output is.

    Source: L. Ljung, System Identification, 2nd edition, section 13.2: a sum of n sines is persistently exciting of
    order 2 n.

    Example:
        >>> t = 0.02 * np.arange(500)
        >>> u = np.sin(2 * np.pi * 0.5 * t)[:, None]
        >>> run = Trajectory("run", "train", 0.02, t, u, u, np.hstack([u, u]), np.hstack([u, u]))
        >>> check_excitation([run], parameters=2)
        ()
        >>> print(check_excitation([run], parameters=5)[0])
        input 1 excites 1 frequency (0.5 Hz); 5 parameters of a linear model need 3. Add a multisine, a chirp or steps.
    """
    found, problems = excitation_of(trajectories, inputs), []
    names = ", ".join(dict.fromkeys(piece.file for piece in trajectories))
    for j, one in enumerate(found):
        if is_constant(np.concatenate([piece.u[:, j] for piece in trajectories])):
            level = trajectories[0].u[0, j]
            problems.append(
                f"{names}: the input {one.name} is constant at {level:.10g}, so its effect cannot be identified. Add a "
                "recording in which the input varies, or check that the DataSpec names the right column. [HM-DATA-021]"
            )
    for j in range(trajectories[0].y.shape[1]):
        every = np.concatenate([piece.y[:, j] for piece in trajectories])
        every = every[np.isfinite(every)]
        if not len(every):
            continue  # not measured in these trajectories
        if is_constant(every):
            name = outputs[j].name if j < len(outputs) else f"output {j + 1}"
            problems.append(
                f"{names}: the output {name} is constant at {every[0]:.10g}: the machine never moved. Excite the "
                "machine with more than its static friction, or check that the DataSpec names the right column. "
                "[HM-DATA-022]"
            )
    refuse(problems)
    need = -(-parameters // 2)
    return tuple(_too_few(one, parameters, need) for one in found if len(one.lines) < need)


def is_constant(values: Array) -> bool:
    """Whether numbers ``(m,)`` are equal up to rounding.

    Example:
        >>> is_constant(np.array([0.1 + 0.2, 0.3])), is_constant(1e6 + np.array([0.0, 1e-3]))
        (True, False)
    """
    return bool(np.ptp(values) <= ROUNDING * np.abs(values).max(initial=0.0))


def _too_few(one: Excitation, parameters: int, need: int) -> str:
    count = len(one.lines)
    frequencies = ", ".join(f"{f:.3g}" for f in one.lines)
    lines = f"{counted(count, 'frequency', 'frequencies')} ({frequencies} Hz)" if count else "no frequency"
    return (
        f"{one.name} excites {lines}; {parameters} parameters of a linear model need {need}. Add a multisine, a chirp "
        "or steps."
    )


def _lines(pieces: Sequence[tuple[Array, float]]) -> tuple[float, ...]:
    """Frequencies of distinct lines of one input over all pieces."""
    spectra = [_hann_spectrum(u, dt) for u, dt in pieces if len(u) > 2 * LOBE]
    strongest = max((float(a.max()) for _, a in spectra), default=0.0)
    if strongest <= ROUNDING * max(float(np.abs(u).max()) for u, _ in pieces):
        return ()  # constants, up to rounding
    found: list[tuple[float, float]] = []
    for f, amplitude in spectra:
        left = amplitude.copy()
        while left.max() >= WEAKEST * strongest:
            k = int(np.argmax(left))
            found.append((float(f[k]), LOBE * float(f[1])))
            left[max(k - LOBE, 0) : k + LOBE + 1] = 0.0
    distinct: list[tuple[float, float]] = []
    for line, width in sorted(found):
        if not distinct or line - distinct[-1][0] > max(width, distinct[-1][1]):
            distinct.append((line, width))
    return tuple(line for line, _ in distinct)


def _hann_spectrum(u: Array, dt: float) -> tuple[Array, Array]:
    """Frequencies ``(n // 2 + 1,)`` [Hz] and amplitudes under a Hann window of samples ``(n,)`` with period ``dt`` [s].

    A sine of amplitude 1 gives 0.85 to 1 at its peak and fills the two bins on either side; the mean is subtracted.
    """
    n = len(u)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)
    mean = float((u * window).sum() / window.sum())
    amplitude: Array = 2 * np.abs(np.fft.rfft((u - mean) * window)) / window.sum()
    amplitude[0] = 0.0
    return np.asarray(np.fft.rfftfreq(n, dt), dtype=np.float64), amplitude


def short_runs(spec: DataSpec, test: Sequence[Trajectory]) -> tuple[str, ...]:
    """A warning if no test recording is as long as the requested free runs; else the empty tuple.

    Example:
        >>> spec = DataSpec("t", ("u",), ("y",), dt=1, max_gap=2, smoothing=5, warm_up=10, free_run=100)
        >>> short_runs(spec, ())
        ()
    """
    longest = max((len(t.t) * spec.dt - spec.warm_up for t in test), default=0.0)
    if not spec.free_run or not test or longest >= 0.95 * spec.free_run:
        return ()
    return (
        f"DataSpec.free_run is {spec.free_run:g} s, but the longest piece of test data leaves {max(longest, 0.0):.4g} "
        f"s after its warm-up of {spec.warm_up:g} s, so models are evaluated on shorter runs. Give longer recordings, "
        "or name windows in the DataSpec",
    )
