"""Frequency responses estimated from recordings, or from a machine driven by a multisine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import csd, welch

from hybrid_mpc.data.excitation import multisine
from hybrid_mpc.errors import InputError
from hybrid_mpc.loop.plant import Plant
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Run: TypeAlias = Callable[[Array], Array]
"""Function from inputs ``(n,)`` to outputs ``(n,)`` of one channel; each output is measured before its input acts."""
LARGEST = 1e60
"""Size of a sample above which a run has diverged: products of its powers would overflow."""


@dataclass(frozen=True)
class MeasuredResponse:
    """A frequency response ``(n,)`` from one input to one output, estimated from signals.

    For a nonlinear machine, the response is the best linear approximation, which depends on amplitude and band of the
    signals. Compare it with the same estimate of a model with the same inputs.

    Args:
        omega: Frequencies ``(n,)`` [rad/s].
        response: Complex response ``(n,)``.
        coherence: Share of the output's power that is linear in the input ``(n,)``; 1 without noise.
        deviation: Standard deviation of ``|response|`` ``(n,)``, from noise and nonlinear effects.
        averages: Number of independent averages of each value.
    """

    omega: Array
    response: Complex
    coherence: Array
    deviation: Array
    averages: float

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """Mask ``(n,)`` of the frequencies with significant coherence.

        The coherence of unrelated signals exceeds ``1 - 0.01^(1 / (averages - 1))`` at one frequency in a hundred: 0.99
        for 2 averages, 0.78 for 4, 0.22 for 20. A smaller coherence is not significant.

        Source: Carter, Knapp and Nuttall, *Estimation of the magnitude-squared coherence function via overlapped fast
        Fourier transform processing*, IEEE Trans. Audio Electroacoust. 21 (1973).
        """
        # significance level: share of the frequencies of unrelated signals whose coherence passes the test
        unrelated = 1.0 if self.averages <= 1 else 1.0 - 0.01 ** (1.0 / (self.averages - 1.0))
        return np.asarray(np.isfinite(self.response) & (self.coherence > unrelated))


def welch_response(
    pieces: Sequence[tuple[ArrayLike, ArrayLike]], dt: float, *, length: float
) -> MeasuredResponse:
    """H1 estimate ``S_uy / S_uu`` with its coherence, averaged over half-overlapping Hann windows of all pieces.

    Pieces are pairs of inputs and outputs ``(n,)``; pieces shorter than a window of ``length`` [s] are left out. Noise
    of the output does not bias H1. A window that is shorter than the decay of a resonance smears this resonance.

    Raises:
        InputError: If no piece is long enough, shapes differ, a signal diverges, or there are fewer than four windows
            (the coherence of a single window is always 1).

    Source: Welch, *The use of fast Fourier transform for the estimation of power spectra*, IEEE Trans. Audio
    Electroacoust. 15 (1967), also for the variance of overlapping windows; Bendat and Piersol, *Random Data*, 4th
    edition, section 9.2, for the deviation.
    """
    n = round(length / dt)
    total, count = np.zeros((3, n // 2 + 1), dtype=np.complex128), 0
    for given_u, given_y in pieces:
        u, y = np.asarray(given_u, dtype=float).ravel(), np.asarray(given_y, dtype=float).ravel()
        if u.shape != y.shape:
            raise InputError(
                f"frequency response: got {u.size} samples of the input and {y.size} of the output; give equally many"
                " [HM-ANALYZE-033]"
            )
        if n < 8 or u.size < n:
            continue
        _check_power(u, "input")
        _check_power(y, "output")
        windows = 1 + (u.size - n) // (n // 2)
        options = {"fs": 1.0 / dt, "nperseg": n, "noverlap": n - n // 2, "detrend": "linear"}
        total += windows * np.stack([welch(u, **options)[1], welch(y, **options)[1], csd(u, y, **options)[1]])
        count += windows
    if count < 4:
        raise InputError(
            f"frequency response: only {count} windows of {length:g} s in the recordings, but at least 4 are needed. "
            "Use shorter windows or more data [HM-ANALYZE-034]"
        )
    uu, yy, uy = total[0].real[1:-1], total[1].real[1:-1], total[2][1:-1]
    omega = np.asarray(2 * np.pi * np.arange(1, n // 2) / (n * dt), dtype=np.float64)
    averages = max(1.0, 9 / 11 * count)
    return _response(omega, uu[: omega.size], yy[: omega.size], uy[: omega.size], averages)


def multisine_response(
    run: Run, dt: float, *, amplitude: float, band: tuple[float, float], period: float = 10.0, periods: int = 4,
    settle: int = 1, bias: float = 0.0, odd: bool = True,
) -> MeasuredResponse:  # fmt: skip
    """Estimate the response of a machine or model at the frequencies of a multisine, without leakage.

    Args:
        run: The machine: a plant (:func:`run_plant`) or a model (:func:`run_model`).
        dt: Sampling period of the input [s].
        amplitude: Largest deviation of the input from its bias [input unit].
        band: Lowest and highest frequency [Hz].
        period: Period of the multisine [s].
        periods: Number of evaluated periods; their scatter gives the deviation.
        settle: Number of periods that are left out at the start.
        bias: Mean input. Default: zero.
        odd: True: only odd multiples of the base frequency; effects of even nonlinearities then fall between them.
            Default: True.

    Raises:
        InputError: If fewer than two periods are evaluated, the period is not a multiple of ``dt``, the band holds no
            frequency of the multisine, or the run diverges.

    Source: Pintelon and Schoukens, *System Identification: A Frequency Domain Approach*, 2nd edition, chapter 4.

    Example:
        >>> found = multisine_response(lambda u: np.append(0.0, u[:-1]), 0.1, amplitude=1.0, band=(0.1, 2.0))
        >>> bool(np.allclose(found.response, np.exp(-0.1j * found.omega)))
        True
    """
    n = round(period / dt)
    if periods < 2 or settle < 0 or abs(n * dt - period) > 1e-9 * period:
        raise InputError(
            f"multisine: give at least 2 periods of a multiple of {dt:g} s after settling, got {periods} of {period:g} "
            f"s, {settle} of them for settling [HM-ANALYZE-035]"
        )
    t = np.asarray(dt * np.arange((settle + periods) * n), dtype=np.float64)
    u = multisine(t, amplitude, *band, period=period, odd=odd, offset=bias)
    y = np.asarray(run(u), dtype=float).ravel()
    if y.shape != u.shape:
        raise InputError(f"multisine: the run returned {y.size} outputs for {u.size} inputs [HM-ANALYZE-036]")
    _check_power(y, "output")
    lines = np.arange(np.ceil(band[0] * period - 1e-9), np.floor(band[1] * period + 1e-9) + 1).astype(int)
    lines = lines[lines % 2 == 1] if odd else lines
    spectra = [np.fft.rfft(v[settle * n :].reshape(periods, n), axis=1)[:, lines] for v in (u, y)]
    mean_u, mean_y = (s.mean(axis=0) for s in spectra)
    uu, yy = np.abs(mean_u) ** 2, np.mean(np.abs(spectra[1]) ** 2, axis=0)
    return _response(2 * np.pi * lines / period, uu, yy, np.conj(mean_u) * mean_y, float(periods))


def run_plant(plant: Plant, x0: ArrayLike, dt: float) -> Run:
    """Wrap a simulated machine as a :data:`Run` from its input to its first output, with sensor noise of seed 0.

    Args:
        plant: The machine.
        x0: Initial state ``(n_x,)``.
        dt: Period over which each input is held [s].

    Example:
        ``multisine_response(run_plant(scenario.plant(), [0.0, 0.0], 0.02), 0.02, amplitude=0.2, band=(0.1, 3.0))``
    """

    def run(u: Array) -> Array:
        rng, state = np.random.default_rng(0), plant.reset(np.asarray(x0, dtype=float), 0)
        y = np.empty(u.size)
        for k, held in enumerate(u):
            y[k] = np.ravel(plant.measure(state, rng))[0]
            state = plant.step(state, np.array([held]), dt)
        return y

    return run


def run_model(model: HybridModel, x0: ArrayLike) -> Run:
    """Wrap a model's free run as a :data:`Run` from its input to its first output.

    Args:
        model: The model, with one input.
        x0: Initial state ``(n_x,)``; a hidden state starts at zero.

    Raises:
        InputError: If the model has several inputs.

    Example:
        ``welch_response([(u, run_model(model, x0)(u))], model.dt, length=5.0)``
    """
    if model.n_u != 1:
        raise InputError(
            f"model {model.name}: it has {model.n_u} inputs, but the response is only estimated for one "
            "[HM-ANALYZE-037]"
        )

    def run(u: Array) -> Array:
        x, h = np.asarray(x0, dtype=float), np.zeros(model.n_h)
        y = np.empty(u.size)
        for k, held in enumerate(u):
            y[k] = float(model.output(x, held, model.w, model.p)[0])
            x, h = model.step(x, h, held, model.w, model.p)
        return y

    return run


def _check_power(signal: Array, what: str) -> None:
    wrong = np.flatnonzero(~(np.abs(signal) <= LARGEST))
    if wrong.size:
        raise InputError(
            f"frequency response: the {what} diverges, sample {wrong[0]} is {signal[wrong[0]]:.3g}. Use shorter "
            "recordings, or leave this model out [HM-ANALYZE-038]"
        )


def _response(omega: Array, uu: Array, yy: Array, uy: Complex, averages: float) -> MeasuredResponse:
    """Response, coherence and standard deviation from (cross) power spectra.

    ``G = S_uy / S_uu``, ``c = |S_uy|^2 / (S_uu S_yy)``, ``std(|G|) = |G| sqrt((1 - c) / (2 averages c))`` (Bendat and
    Piersol, section 9.2).
    """
    floor = 1e-12 * float(uu.max(initial=0.0))
    used = uu > floor
    g, coherence = np.full(omega.size, np.nan + 0j), np.zeros(omega.size)
    g[used] = uy[used] / uu[used]
    coherence[used] = np.clip(np.abs(uy[used]) ** 2 / np.maximum(uu[used] * yy[used], 1e-300), 0.0, 1.0)
    safe = np.maximum(coherence, 1e-12)
    deviation = np.abs(g) * np.sqrt((1 - coherence) / (2 * averages * safe))
    return MeasuredResponse(omega, g, coherence, deviation, averages)
