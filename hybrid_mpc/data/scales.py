"""A machine's own scales from its recordings: noise of the sensors, time scale, unit of time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FASTEST, SLOWEST = 0.25, 4.0
"""Machines with a time scale [s] in this range use 1 s as their unit of time. The library's lengths in seconds (free
runs of a fit, windows of the monitor, blocks of false alarms) were tested on machines of 0.5 to 2 s; the range adds a
factor of two on either side."""
COARSEST = 10
"""Fewest periods in a machine's unit of time: the shortest length, a tenth of the unit, is then one period."""
SHORTEST = 5  # half width [samples] of the first window for accelerations: ten periods
SHORTEST = 5  # half the samples of the first window in which accelerations are looked for: ten periods
NOISY = 0.02
"""Share of noise in the power of the acceleration above which the window is too short: the steps of a coarse sensor are
not white noise, and up to half of their power would count as motion."""


@dataclass(frozen=True)
class Sizes:
    """Natural sizes of a machine's signals, estimated from its recordings; they do not depend on units.

    Args:
        y: Spreads of the outputs ``(n_y,)``.
        noise: Standard deviations of their noise ``(n_y,)``.
        x: Deviation of each state that alone moves the outputs by their spread within the machine's unit of time
            ``(n_x,)``.
        rate: ``x`` over this time ``(n_x,)``.
    """

    y: tuple[float, ...]
    noise: tuple[float, ...]
    x: tuple[float, ...]
    rate: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class SmootherSettings:
    """What a smoother assumes about noise and unexplained rates: part of a fit, of a smoother, and of a kit.

    Args:
        sigma: Standard deviation of the measurement of each output ``(n_y,)`` [output units].
        walk: Standard deviation of the change of each unexplained rate in one period ``(n_d,)`` [units of the corrected
            rates].
        sizes: Natural sizes of the signals.
        fading: Factor by which an unexplained rate decays in one period without data [-]. Default: 1, no decay.
        substeps: Runge-Kutta sub-steps a period that the prior needs within the range of the recordings. Default 0: as
            many as it needs at rest.
    """

    sigma: tuple[float, ...]
    walk: tuple[float, ...]
    sizes: Sizes
    fading: float = 1.0
    substeps: int = 0

    @property
    def smoother_settings(self) -> dict[str, Any]:
        """These settings by name, to make another record that has them."""
        return {f.name: getattr(self, f.name) for f in fields(SmootherSettings)}


class Outputs(Protocol):
    """A recording on a uniform grid."""

    @property
    def y(self) -> Array:
        """Measured outputs ``(n, n_y)``, NaN where a sample is missing."""


def thin(recordings: Sequence[Outputs], i: int) -> tuple[list[Array], int]:
    """Samples ``(m,)`` of one output of each recording, and their distance in periods: one, or more for a sensor that
    is slower than the grid. Missing samples stay NaN.

    Example:
        >>> from types import SimpleNamespace
        >>> run = SimpleNamespace(y=np.where(np.arange(9) % 3 == 1, np.arange(9.0), np.nan)[:, None])
        >>> thin([run], 0)
        ([array([1., 4., 7.])], 3)
    """
    known = [np.flatnonzero(np.isfinite(r.y[:, i])) for r in recordings]
    steps = np.concatenate([np.diff(k) for k in known]) if known else np.zeros(0)
    step = int(np.median(steps)) if len(steps) else 1
    first = [int(np.argmax(np.bincount(k % step))) if len(k) else 0 for k in known]
    return [r.y[a::step, i] for r, a in zip(recordings, first, strict=True)], step


def noise_of(recordings: Sequence[Outputs]) -> Array:
    """Standard deviation ``(n_y,)`` of the sensors' noise and steps, from third differences [output units].

    Third differences of white noise have the standard deviation ``sqrt(1 + 9 + 9 + 1) = sqrt(20)`` times its own. The
    machine's motion within three samples counts as noise too, so the estimate is an upper bound. Zero if too few
    samples are known.
    """
    return np.array([_noise_of(thin(recordings, i)[0]) for i in range(recordings[0].y.shape[1])])


def _noise_of(pieces: Sequence[Array]) -> float:
    third = np.concatenate([np.diff(piece, 3) for piece in pieces])
    return robust_spread(third) / math.sqrt(20.0)


def trim_outliers(values: Array) -> Array:
    """Values ``(n,)`` without gross outliers: more than two ranges of the middle 80 % away from that range.

    Normally distributed values keep (nearly) all samples. Nothing is removed if the middle 80 % are equal.
    """
    low, high = np.percentile(values, (10, 90)) if len(values) else (0.0, 0.0)
    reach = 2 * (high - low) or math.inf
    return np.asarray(values[(values >= low - reach) & (values <= high + reach)])


def robust_spread(values: Array) -> float:
    """Standard deviation of the finite values ``(n,)`` without gross outliers; 0 without any.

    Example:
        >>> robust_spread(np.array([1.0, 3.0, np.nan, 1.0, 3.0, 1.0, 3.0, 1.0, 3.0, 1.0, 3.0, 1e6]))
        1.0
    """
    there = trim_outliers(values[np.isfinite(values)])
    return float(np.std(there)) if len(there) else 0.0


def speeds_of(recording: Outputs, dt: float, half: int) -> Array:
    """Speeds ``(m, n_y)``: derivatives at the centres of cubics fitted to ``2 half + 1`` samples each.

    Example:
        >>> from types import SimpleNamespace
        >>> run = SimpleNamespace(y=(0.1 * np.arange(30.0)[:, None]) ** 2)
        >>> speeds_of(run, 0.1, 3)[:2].ravel().round(6).tolist()  # of t^2 at 0.3 and 0.4 s
        [0.6, 0.8]
    """
    return _derivatives(recording.y, dt, half, 1)


def _derivatives(y: Array, dt: float, half: int, order: int) -> Array:
    window = 2 * half + 1
    if len(y) < window:
        return np.zeros((0, y.shape[1]))
    from scipy.signal import savgol_filter  # slow to import, and monitors import this module

    # "nearest" only affects the ends, which are cut off; polynomials at the ends would not accept NaN
    found = savgol_filter(y, window, 3, deriv=order, delta=dt, axis=0, mode="nearest")[half : len(y) - half]
    return np.asarray(found[np.isfinite(found).all(axis=1)])


def speed_gain(dt: float, half: int, order: int = 1) -> float:
    """Standard deviation of such a speed [1/s] (order 2: acceleration [1/s^2]) per unit of white noise in the samples.

    Example:
        >>> round(speed_gain(0.02, 5), 1)
        12.3
    """
    from scipy.signal import savgol_coeffs

    return float(np.linalg.norm(savgol_coeffs(2 * half + 1, 3, deriv=order, delta=dt)))


def time_scale(recordings: Sequence[Outputs], dt: float) -> float:
    """Time [s] of one swing of the machine, ``2 pi rms(v) / rms(a)``, with speed ``v`` and acceleration ``a``.

    For a sinusoid it is the period; for a drive that mostly cruises it is set by the ramps. The power of the noise,
    known from third differences, is subtracted; the window is doubled until the acceleration stands out of the noise.
    The fastest output decides.

    Source: the mean rate at which a Gaussian process crosses its mean; Rice, *Mathematical analysis of random noise*,
    Bell System Technical Journal 24 (1945).
    """
    if not recordings:
        return math.nan
    found = [_time_scale(recordings, dt, i, float(s)) for i, s in enumerate(noise_of(recordings))]
    return min((value for value in found if math.isfinite(value)), default=math.nan)


def _time_scale(recordings: Sequence[Outputs], dt: float, i: int, sigma: float) -> float:
    """Time scale of one output; NaN if its acceleration never stands out of the noise."""
    sparse, step = thin(recordings, i)
    pieces = [_bridged(piece) for piece in sparse]
    half, longest, dt = SHORTEST, max(map(len, pieces)), step * dt
    while 2 * half + 1 <= longest:
        speed, acceleration = (
            [_derivatives(piece[:, None], dt, half, order) for piece in pieces] for order in (1, 2)
        )
        v = np.concatenate([part - part.mean() for part in speed if len(part)] or [np.zeros((0, 1))])
        a = np.concatenate(acceleration)
        noise = [sigma * speed_gain(dt, half, order) for order in (1, 2)]
        power = float(np.mean(a**2)) if len(a) else 0.0
        if power > 0 and noise[1] ** 2 < NOISY * power:
            moved = max(float(np.mean(v**2)) - noise[0] ** 2, 0.0)
            return 2 * math.pi * math.sqrt(moved / (power - noise[1] ** 2))
        half *= 2
    return math.nan


def _bridged(y: Array) -> Array:
    """Samples ``(m,)`` with straight lines over missing ones, from the first known sample to the last."""
    there = np.flatnonzero(np.isfinite(y))
    return np.interp(np.arange(there[0], there[-1] + 1), there, y[there]) if len(there) else np.zeros(0)


def time_unit(recordings: Sequence[Outputs], dt: float) -> float:
    """The machine's unit of time [s], in which the library counts all of its lengths in seconds.

    1 s for a machine whose :func:`time_scale` lies between 0.25 and 4 s. Slower machines have a proportionally longer
    unit, faster ones a shorter one, rounded to two digits; at least 10 periods, so that no length has too few samples.
    """
    scale = time_scale(recordings, dt)
    unit = scale / min(max(scale, FASTEST), SLOWEST) if math.isfinite(scale) else 1.0
    return float(f"{max(unit, COARSEST * dt):.2g}")


def periods(seconds: float, dt: float, fewest: int = 1) -> int:
    """Whole periods in a length of time, at least ``fewest``."""
    return max(fewest, round(seconds / dt))


def evenly(n: int, most: int) -> list[int]:
    """At most ``most`` evenly spaced indices from 0 to n - 1, in order."""
    return list(dict.fromkeys(np.linspace(0, n - 1, min(most, n)).round().astype(int).tolist()))
