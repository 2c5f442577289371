"""First linear models of a recording: lags for a first prior, time constants, and signs of a closed loop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import lfilter

from hybrid_mpc.identify.closed_loop import feedback

Array = NDArray[np.float64]
FEWEST = 20
"""Fewest samples of a usable recording."""
MOST, JUDGED = 4000, 20_000
"""Most samples to which a lag is fitted, and on which it is evaluated."""
MATTERS = 0.1
"""Share of an output's variance that its lag must explain, so that its time constant counts."""
STRIDES = (1, 4, 16)
"""Numbers of samples ahead of the predictions from which a growth rate is estimated."""
FINEST = (1, 2, 4)
"""Factors on ``STRIDES``, tried in turn."""
SHOWN = 10.0
"""Least ratio of the length of a recording to a time constant that it identifies: in a shorter one any input explains
the few slow motions."""
FAR = 5.0
"""Steady-state effect of all inputs over the output's span, above which a slow output counts as an integrator."""
LAGS = 4
"""Past samples from which outputs are predicted."""
CLOSED = 2.0
"""Feedback over its largest value by chance (:func:`~hybrid_mpc.identify.closed_loop.feedback`), above which a loop is
closed. Eight recordings of machines have at most 1.3 in open loop, and 2.2 to 34 in detectable closed loops."""
GROWS = 3.0
"""Least growth over the length of a recording, as an exponent; a smaller one may be a drift."""
PACE = 0.3
"""Least growth rate over the rate of the motion itself (rms speed over spread of the slowest output). A smaller one may
be a bias from friction or another nonlinearity; such biases reach 0.15."""
AGREE = 0.2
"""Least ratio of the smallest to the largest of several growth rates that agree."""


class Runs(NamedTuple):
    """Outputs ``(m, n_y)``, NaN where a sample is missing, and inputs ``(m, n_u)`` of one recording."""

    y: Array
    u: Array


@dataclass(frozen=True)
class Lag:
    """A first linear model of one output.

    ``states`` is 1 or 2: ``T y' = k u + c - y`` or ``T^2 y'' + 2 D T y' = k u + c - y``, with time constant ``seconds``
    (T) [s], ``damping`` (D), ``gains`` (k) and ``offset`` (c). ``share`` is the part of the output's variance that its
    free run explains. ``reach`` is the steady-state effect of all inputs over their ranges, over the output's span.
    ``driven``: an input affects the output.
    """

    states: int
    seconds: float
    damping: float
    gains: tuple[float, ...]
    offset: float
    share: float = 0.0
    reach: float = 1.0
    driven: bool = True

    @property
    def matters(self) -> float:
        """The time [s] that matters for control: the slowest time constant, or less if ``reach`` is above 1.

        If inputs move the output over its span in a fraction of the time constant, the output is an integrator for the
        controller. For an oscillation, the time is at most half a period, within which a controller damps it.
        """
        if self.states == 1:
            return self.seconds / max(self.reach, 1.0)
        if self.damping < 1:
            return self.seconds * min(1 / max(self.damping, 1e-9), math.pi) / math.sqrt(max(self.reach, 1.0))
        slow = self.seconds * (self.damping + math.sqrt(self.damping**2 - 1))
        reach = max(self.reach, 1.0)
        return max(slow / reach, self.seconds / math.sqrt(reach))

    def integrates(self, length: float) -> bool:
        """Whether the output integrates, as far as recordings of this length [s] show it.

        Then the slowest time constant is longer than a recording identifies, and inputs would move the output far
        beyond its span.
        """
        slow = self.seconds
        if self.states == 2:
            slow *= self.damping + math.sqrt(self.damping**2 - 1) if self.damping > 1 else 0.0
        return self.driven and self.share >= MATTERS and self.reach >= FAR and slow > length / SHOWN


def first_lag(runs: Sequence[Runs], output: int, dt: float, inputs: int) -> Lag:
    """The lag of one or two states whose free runs are closest to an output.

    Candidates are fitted one step ahead at several strides: noise hides a slow motion in a short stride, and a fast
    motion ends within a long one. Free runs at the sampling period select the best candidate.

    Args:
        runs: Recordings, of any lengths.
        output: Index of the output.
        dt: Sampling period [s].
        inputs: Number of inputs, the first columns of ``u``; the other columns are disturbances.
    """
    tables = [np.column_stack([run.y[:, output], run.u]) for run in runs]
    every = np.concatenate(tables)
    with np.errstate(over="ignore"):
        middle, size = np.nanmean(every, axis=0), np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
    span, spans = float(size[0]), size[1:]
    # a gain of zero would make the input ineffective
    slight = 0.1 * span / spans
    default = Lag(
        1,
        max(20 * dt, pace_of(runs, output, dt)),
        1.0,
        tuple(slight.tolist()),
        float(middle[0] - slight @ middle[1:]),
    )
    if not (np.isfinite(middle).all() and np.isfinite(size).all()):
        return default
    # centred and scaled by the spans: independent of levels and units
    tables = [(table - middle) / size for table in tables]
    judged = _middles_of(tables, 1, JUDGED)
    variance = float(np.nanvar(np.concatenate([table[:, 0] for table in judged])))
    best: dict[int, tuple[float, Lag]] = {}
    stride = 1
    while sum(len(table) // stride for table in tables) >= FEWEST:
        blocks = _middles_of(tables, stride, MOST)
        for order in (1, 2):
            lag = _fitted(blocks, order, stride * dt)
            if lag is None:
                continue
            error = _free_run_error(judged, lag, dt)
            if order not in best or error < best[order][0]:
                share = 1.0 - error**2 / variance if variance > 0 else 0.0
                best[order] = error, replace(lag, share=share, reach=float(np.abs(lag.gains[:inputs]).sum()))
        stride *= 3
    if not best:
        return default
    error, lag = best.get(1, best.get(2, (0.0, default)))
    # two states are used if their error is less than this share of that of one state
    if 2 in best and best[2][0] < 0.8 * error:
        lag = best[2][1]
    gains = span / spans * np.array(lag.gains)
    offset = float(middle[0] + span * lag.offset - gains @ middle[1:])
    if not (np.isfinite(gains).all() and (gains != 0).all() and math.isfinite(offset)):
        return default
    return replace(lag, gains=tuple(gains.tolist()), offset=offset)


def pace_of(runs: Sequence[Runs], output: int, dt: float) -> float:
    """Spread of an output over its rms speed [s]: the duration of a motion."""
    y = np.concatenate([run.y[:, output] for run in runs])
    steps = np.concatenate([np.diff(run.y[:, output]) for run in runs])
    speed = float(np.sqrt(np.nanmean(np.square(steps)))) if np.isfinite(steps).any() else 0.0
    return dt * float(np.nanstd(y)) / speed if speed > 0 else 0.0


def _middles_of(tables: Sequence[Array], stride: int, most: int) -> list[Array]:
    """Outputs (column 0) at every ``stride``-th sample and the inputs' means until the next, ``most`` rows in all."""
    found = []
    for table in tables:
        rows = min(max(most // len(tables), 4), len(table) // stride)
        if rows <= 2:
            continue
        first = (len(table) - stride * rows) // 2
        part = table[first : first + stride * rows].reshape(rows, stride, -1)
        found.append(np.column_stack([part[:, 0, :1], part[:, :, 1:].mean(axis=1)]))
    return found


def _fitted(tables: Sequence[Array], order: int, dt: float) -> Lag | None:
    """A lag from least squares one row ahead; None if it is unstable, or decays within a row."""
    rows, future = [], []
    for table in tables:
        past = [table[order - 1 - i : len(table) - 1 - i, 0] for i in range(order)]
        rows.append(np.column_stack([*past, table[order - 1 : -1, 1:], np.ones(len(table) - order)]))
        future.append(table[order:, 0])
    if not rows:
        return None
    every, then = np.concatenate(rows), np.concatenate(future)
    known = np.isfinite(every).all(axis=1) & np.isfinite(then)
    if known.sum() < every.shape[1] + 5:
        return None
    theta = np.linalg.lstsq(every[known], then[known], rcond=None)[0]
    poles = np.roots(np.concatenate([[1.0], -theta[:order]]))
    if not (np.isfinite(theta).all() and (np.abs(poles) < 1).all() and (np.abs(poles) > 0.05).all()):
        return None
    if order == 1 and not poles[0].real > 0:
        return None
    # discrete poles z = exp(s dt); of two poles s: s1 s2 = 1 / T^2, s1 + s2 = -2 D / T
    rates = np.log(poles.astype(complex)) / dt
    speed = float(np.sqrt(np.abs(np.prod(rates)))) if order == 2 else float(np.abs(rates[0]))
    damping = float(-rates.real.sum() / (2 * speed)) if order == 2 else 1.0
    still = 1.0 - theta[:order].sum()
    if not (still > 0 and 0 < speed < math.inf and damping > 0):
        return None
    gains = theta[order:-1] / still
    return Lag(order, 1 / speed, damping, tuple(gains.tolist()), float(theta[-1] / still))


def _free_run_error(tables: Sequence[Array], lag: Lag, dt: float) -> float:
    """Root mean square error of free runs that start at rest at each recording's first output."""
    if lag.states == 1:
        pole = math.exp(-dt / lag.seconds)
        b, a = np.array([0.0, 1 - pole]), np.array([1.0, -pole])
    else:
        system = np.zeros((3, 3))
        system[:2, :2] = [[0.0, 1.0], [-1.0, -2 * lag.damping]]
        system[1, 2] = 1.0
        step = expm(system * dt / lag.seconds)
        trace, det = np.trace(step[:2, :2]), np.linalg.det(step[:2, :2])
        b = np.array([0.0, step[0, 2], step[0, 1] * step[1, 2] - step[1, 1] * step[0, 2]])
        a = np.array([1.0, -trace, det])
    errors = []
    for table in tables:
        known = np.flatnonzero(np.isfinite(table[:, 0]))
        if not len(known):
            continue
        start = table[known[0], 0]
        drive = np.nan_to_num(table[:, 1:]) @ np.array(lag.gains) + lag.offset - start
        errors.append(start + lfilter(b, a, drive)[known] - table[known, 0])
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(np.square(np.concatenate(errors))))) if errors else math.inf


def slowest(lags: Sequence[Lag], length: float) -> tuple[float, int]:
    """The slowest time constant [s] that matters, and the output's index.

    A time constant counts if its lag explains the share ``MATTERS`` of the output's variance, and the recording is
    ``SHOWN`` times longer. If none counts, the result is at most the length of the recording over ``SHOWN``. Outputs
    that no input affects count only if there are no others.
    """
    longest = length / SHOWN
    driven = [i for i, lag in enumerate(lags) if lag.driven] or list(range(len(lags)))
    good = [i for i in driven if lags[i].share >= MATTERS and lags[i].matters <= longest]
    best = max(good or driven, key=lambda i: lags[i].matters)
    return min(lags[best].matters, longest), best


def feedback_of(runs: Sequence[Runs]) -> float:
    """Feedback from outputs to inputs, over its largest value by chance; zero if the recordings are too short."""
    parts = _middles(runs, 1)
    fitted = _predictor(parts)
    if fitted is None:
        return 0.0
    errors = [
        np.vstack([np.full((LAGS, run.y.shape[1]), np.nan), run.y[LAGS:] - _rows(run) @ fitted])
        for run in parts
    ]
    return feedback([run.u for run in parts], errors)


def growth_of(runs: Sequence[Runs], dt: float) -> float:
    """Rate [1/s] at which the machine diverges from its steady state by itself; zero if the data do not show it.

    The rate follows from the largest pole of predictions over several strides, fitted to whole recordings and to each
    half of them. The data show it if all rates agree. Feedback biases one-step predictions little, unless the noise
    exceeds the motion within a sample; then strides two or four times as long may agree.
    """
    length = dt * max(len(run.y) for run in runs)
    pace = 1 / max(1e-300, *(pace_of(runs, i, dt) for i in range(runs[0].y.shape[1])))
    for finest in FINEST:
        found = [rate for stride in STRIDES for rate in _growths(runs, finest * stride, dt)]
        if found and min(found) > max(AGREE * max(found), GROWS / length, PACE * pace):
            return float(np.median(found))
    return 0.0


def _growths(runs: Sequence[Runs], stride: int, dt: float) -> list[float]:
    """Growth rates [1/s] of predictions over a stride, from whole recordings and from each half of them; minus infinity
    for too few samples.
    """
    parts, found = _middles(runs, stride), []
    halves = [
        [Runs(*(a[: len(a) // 2] for a in run)) for run in parts],
        [Runs(*(a[len(a) // 2 :] for a in run)) for run in parts],
    ]
    for part in (parts, *halves):
        fitted = _predictor(part)
        if fitted is None:
            return [-math.inf]
        n = runs[0].y.shape[1]
        matrix = np.eye(LAGS * n, k=-n)
        matrix[:n] = fitted[: LAGS * n].T
        # companion matrix of the predictor: its largest eigenvalue z gives the rate ln|z| / (stride dt)
        largest = float(np.abs(np.linalg.eigvals(matrix)).max())
        found.append(math.log(largest) / (stride * dt) if largest > 0 else -math.inf)
    return found


def _middles(runs: Sequence[Runs], stride: int) -> list[Runs]:
    """The middle of each recording, standardised: outputs at every ``stride``-th row, inputs' means until the next."""
    y, u = (np.concatenate([run[i] for run in runs]) for i in (0, 1))
    middle, size = [np.nanmean(z, axis=0) for z in (y, u)], [np.nanstd(z, axis=0) for z in (y, u)]
    parts = []
    for run in runs:
        # most samples of a recording to which these predictions are fitted
        rows = min(10_000, len(run.y) // stride)
        first = (len(run.y) - stride * rows) // 2
        y0, u0 = (z[first : first + stride * rows] for z in run)
        # inputs are averaged over the stride in which they act
        blocks = y0[::stride], u0.reshape(rows, stride, -1).mean(axis=1)
        parts.append(
            Runs(*((z - m) / np.where(s > 0, s, 1.0) for z, m, s in zip(blocks, middle, size, strict=True)))
        )
    return [run for run in parts if len(run.y) > 3 * LAGS]


def _rows(run: Runs) -> Array:
    """Past outputs and inputs of each row from ``LAGS`` on, and a column of ones."""
    n = len(run.y)
    past = [z[LAGS - 1 - i : n - 1 - i] for z in run for i in range(LAGS)]
    return np.column_stack([*past, np.ones(n - LAGS)])


def _predictor(runs: Sequence[Runs]) -> Array | None:
    """Coefficients of one-row-ahead predictions; None if there are too few rows."""
    runs = [run for run in runs if len(run.y) > 3 * LAGS]
    if not runs:
        return None
    rows, future = (
        np.concatenate([_rows(run) for run in runs]),
        np.concatenate([run.y[LAGS:] for run in runs]),
    )
    known = np.isfinite(rows).all(axis=1) & np.isfinite(future).all(axis=1)
    if known.sum() < 5 * rows.shape[1]:
        return None
    return np.asarray(np.linalg.lstsq(rows[known], future[known], rcond=1e-9)[0])
