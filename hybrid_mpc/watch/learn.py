"""Limits learned from nominal data: block maxima with a Gumbel tail."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.data.scales import noise_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.watch.detector import ChannelLimit, Detector, WatchLimits
from hybrid_mpc.watch.lengths import BLOCK_S, block_seconds, settling_samples
from hybrid_mpc.watch.monitor import Monitor
from hybrid_mpc.watch.readings import ENERGY, FROZEN_STEPS, Readings, Test
from hybrid_mpc.watch.replay import EstimatorLike, Trace, TrajectoryLike, replay, stretches

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MIN_BLOCKS = 30
"""Blocks that the two parameters of a tail need."""
MAX_EXTRAPOLATION = 20.0
"""Longest mean time between false alarms, in multiples of the nominal data's length."""
MARGIN = 1.5
"""Where nominal data are too short for a rate: threshold over the highest nominal level."""
ROUNDS = 5
"""Fits of a variance, each weighted by the one before."""
FLOOR = 1e-3
"""Smallest constant of a variance, as a share of its mean: a scale must not vanish where the data were quiet."""
BOOTSTRAPS = 200
"""Resamplings of the thresholds."""
NEIGHBOURS = 6
"""Blocks that are drawn together: half a minute of blocks of 5 s, longer than what one motion does to the next."""
ODD = 1e-4
"""A largest block less probable than this under the rest of its own kind is no nominal one."""
NEVER = 1e300
"""A threshold that no level passes."""


def learn_limits(
    readings: Readings,
    estimator: EstimatorLike,
    recordings: Iterable[TrajectoryLike],
    *,
    false_alarms_per_hour: float | Sequence[float] = 1.0,
    nominal: Sequence[Mask] | None = None,
    resolution: ArrayLike | None = None,
    data_hash: str = "",
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> WatchLimits:
    """Limits of a monitor's channels from recordings in which nothing is wrong.

    Args:
        readings: What the monitor reads (:func:`~hybrid_mpc.watch.monitor.make_readings`).
        estimator: The one that the loop will use.
        recordings: With ``t``, ``y``, ``u`` and, where the model has disturbances, ``w``, on the model's grid.
        false_alarms_per_hour: Wanted rate [1/h] of all alarms together; of several, in rising order, the first that the
            recordings are long enough for in every channel. Default 1.
        nominal: Which samples of each recording count, ``(n,)`` each. Default: all.
        resolution: Step of each sensor ``(n_y,)``, for frozen sensors. Default: found in the recordings for residuals,
            unknown for the energy, where frozen sensors are not found then.
        data_hash: Hash of the recordings, kept in the result.
        on_progress: Called with ``(done, total)`` samples as the replays go on. Default: not at all.

    Raises:
        InputError: If the recordings leave nothing behind their beginning, hold an alarm, or a channel is zero in them.

    Example: ``learn_limits(make_readings(model), observer, dataset.whole, data_hash=dataset.hash)``
    """
    monitor, given = Monitor(readings), list(recordings)
    total, before, traces = sum(len(r.t) for r in given), 0, []
    for recording in given:
        start = before

        def say(done: int, own: int, start: int = start) -> None:
            on_progress(start + done, total)

        traces.append(replay(monitor, estimator, recording, on_progress=say))
        before += len(recording.t)
    return limits_of(
        readings, [r.y for r in given], traces, false_alarms_per_hour=false_alarms_per_hour, nominal=nominal,
        resolution=resolution, data_hash=data_hash,
    )  # fmt: skip


def limits_of(
    readings: Readings,
    ys: Sequence[Array],
    traces: Sequence[Trace],
    *,
    false_alarms_per_hour: float | Sequence[float] = 1.0,
    nominal: Sequence[Mask] | None = None,
    resolution: ArrayLike | None = None,
    data_hash: str = "",
    trusted: bool = False,
    block_s: float | None = None,
    seed: int = 0,
) -> WatchLimits:
    """The limits of :func:`learn_limits` from the ``traces`` of a monitor without limits, and the measurements ``ys``.

    The first of the machine's seconds of each nominal stretch does not count: the estimator settles in it. The variance
    of a channel with terms comes from weighted least squares of its squares, with coefficients that are not negative.
    Each limit has its share of the wanted rate. Its threshold is the level that nominal ones pass so often (extreme
    values of blocks); where the data are too short for that, half as much again as the highest of them, and ``method``
    says so. A block bootstrap, six neighbours at a time, gives the thresholds' interval. Unless the data are
    ``trusted``, as simulated ones are, a block of scaled levels that stands out is refused. A block lasts ``block_s``
    [s], by default 5 of the machine's seconds and 50 periods at least.

    Source: Coles (2001), An Introduction to Statistical Modeling of Extreme Values, ch. 3; Lawson and Hanson (1974) for
    the least squares; Künsch, Annals of Statistics 17 (1989), for the bootstrap.
    """
    model, names = readings.model, [c.name for c in readings.channels]
    block_s = block_s or block_seconds(model.dt, model.time_unit)
    masks = [
        settled(
            np.ones(len(t.values), dtype=bool) if nominal is None else nominal[i], settling_samples(model)
        )
        & t.settled
        for i, t in enumerate(traces)
    ]
    seconds = float(sum(mask.sum() for mask in masks)) * model.dt
    if not seconds:
        raise InputError(
            f"limits: no nominal stretch is longer than the {settling_samples(model) * model.dt:g} s that the "
            "estimator settles in [HM-WATCH-018]"
        )
    tests = [
        ChannelLimit(
            names[test.channel], readings.channels[test.channel].unit, test.length, NEVER, NEVER,
            _scale_of(test.channel, traces, masks, names) if readings.n_terms else (), test.drift,
        )
        for test in readings.tests
    ]  # fmt: skip
    levels = levels_of(Detector(tests, names), traces, masks)
    rng, each, found, short = np.random.default_rng(seed), 0.0, tests, ""
    for rate in np.atleast_1d(false_alarms_per_hour).tolist():
        each = rate / len(tests)
        found, short = _thresholds(readings.tests, tests, levels, model.dt, each, block_s)
        if not short:
            break
    if readings.n_terms and not trusted:
        for limit, runs in zip(found, levels, strict=True):
            check_nominal(block_maxima(runs, max(round(block_s / model.dt), 1))[0], limit.channel, block_s)
    if not short:
        found = [
            replace(one, interval=_interval(runs, model.dt, each, block_s, rng))
            if one.threshold < math.inf
            else one
            for one, runs in zip(found, levels, strict=True)
        ]
    travel, repeats = _freezing(readings, ys, traces, masks, resolution)
    method = (
        f"{MARGIN} x the highest nominal level ({short})"
        if short
        else f"extreme values of blocks of {block_s:g} s"
    )
    rest = tuple(getattr(readings, "rest_speed", ()))
    return WatchLimits(
        kind=readings.kind,
        dt=model.dt,
        channels=tuple(found),
        travel=travel,
        repeats=repeats,
        false_alarms_per_hour=rate,
        hours=seconds / 3600,
        method=method,
        rated=not short,
        rest_speed=rest,
        data_hash=data_hash,
        time_unit=model.time_unit,
    )


def settled(mask: ArrayLike, first: int) -> Mask:
    """A mask ``(n,)`` without the first samples of each of its stretches.

    Example:
        >>> settled([True, True, True, False, True], 1).tolist()
        [False, True, True, False, False]
    """
    found = np.array(mask, dtype=bool)
    for start in stretches(found)[0].tolist():
        found[start : start + first] = False
    return found


def levels_of(detector: Detector, traces: Sequence[Trace], masks: Sequence[Mask]) -> list[list[Array]]:
    """Magnitudes of each limit's levels along the traces, ``(n,)`` each; NaN where they do not count.

    Sums begin anew with each stretch that counts; no alarm limits them.
    """
    found: list[list[Array]] = [[] for _ in detector.limits]
    for trace, mask in zip(traces, masks, strict=True):
        rows, state, before = [], detector.initial(), False
        for values, terms, counts, ready in zip(
            trace.values.tolist(), trace.terms.tolist(), mask.tolist(), trace.settled.tolist(), strict=True
        ):
            if counts and not before:
                state = detector.begun(state)
            state, level, _ = detector.update(state, values, terms, ready)
            rows.append(level if counts else [math.nan] * len(level))
            before = counts
        for i, column in enumerate(np.abs(np.array(rows)).T):
            found[i].append(column)
    return found


def calibrate(
    levels: Sequence[Array], dt: float, *, false_alarms_per_hour: float = 1.0, block_s: float = BLOCK_S
) -> tuple[float, float]:
    """Threshold that nominal levels, ``(n,)`` of each run, pass upwards at the wanted rate, and the level of release.

    The largest level in a block follows a Gumbel distribution with location and scale from its first two L-moments. The
    threshold ``location - scale * log(rate * block)`` is passed at the wanted rate. The alarm is released at half of
    it, but not below the nominal 95 % quantile (or it would hang), nor above the threshold. A block of ``block_s``
    seconds must be much longer than levels are correlated (:func:`~hybrid_mpc.watch.lengths.block_seconds`). NaN are
    left out.

    Raises:
        InputError: If ``dt``, the block or the rate is not positive, more alarms are wanted than one in two blocks,
            there is too little data (30 blocks, and one twentieth of the mean time between alarms), or it is zero.

    Source: Hosking (1990) for the L-moments.
    """
    if not dt > 0 or not false_alarms_per_hour > 0 or not block_s > 0:
        raise InputError(
            f"calibration: dt, rate and block must be positive, got {dt} s, {false_alarms_per_hour}/h, {block_s} s"
            " [HM-WATCH-019]"
        )
    rate = false_alarms_per_hour * block_s / 3600.0
    if rate > 0.5:
        raise InputError(
            f"calibration: {false_alarms_per_hour}/h is too many; ask for at most {1800 / block_s:g}/h [HM-WATCH-020]"
        )
    maxima, finite = block_maxima(levels, max(round(block_s / dt), 1))
    needed = max(MIN_BLOCKS, int(np.ceil(1.0 / (rate * MAX_EXTRAPOLATION) - 1e-9)))
    if maxima.size < needed:
        raise InputError(
            f"{maxima.size * block_s / 60:.1f} min of nominal data in whole blocks of {block_s:g} s; "
            f"{false_alarms_per_hour:.3g} false alarms an hour need {needed * block_s / 60:.1f} min. "
            "Record more, or ask for a higher rate. [HM-WATCH-021]"
        )
    location, scale = gumbel(maxima)
    threshold = location - scale * float(np.log(rate))
    if not threshold > 0:
        raise InputError(
            "calibration: the nominal levels are zero throughout, so nothing tells how large an ordinary one is; "
            "record the machine in motion [HM-WATCH-022]"
        )
    return threshold, _release(threshold, finite)


def block_maxima(levels: Sequence[Array], size: int) -> tuple[Array, Array]:
    """Largest finite level of each whole block of ``size`` samples, and all finite levels."""
    maxima, finite = [np.zeros(0)], [np.zeros(0)]
    for level in levels:
        values = np.asarray(level, dtype=np.float64).reshape(-1)
        values = values[np.isfinite(values)]
        finite.append(values)
        n = values.size // size
        maxima.append(values[: n * size].reshape(n, size).max(axis=1) if n else np.zeros(0))
    return np.concatenate(maxima), np.concatenate(finite)


def gumbel(maxima: Array) -> tuple[float, float]:
    """Location and scale from the first two L-moments."""
    ordered = np.sort(maxima)
    n = ordered.size
    l1 = float(ordered.mean())
    l2 = 2.0 * float(np.mean(np.arange(n) / (n - 1) * ordered)) - l1
    scale = max(l2, 0.0) / float(np.log(2.0))
    return l1 - float(np.euler_gamma) * scale, scale


def check_nominal(maxima: Array, what: str, block_s: float = BLOCK_S) -> None:
    """Refuse largest levels of blocks, in their order, of which one stands out so far that it can be no nominal one.

    Location and scale come from the quartiles, which a few odd blocks hardly move. The message names the places.
    """
    if maxima.size < MIN_BLOCKS:
        return
    low, high = np.quantile(maxima, [0.25, 0.75])
    scale = max((high - low) / (-math.log(-math.log(0.75)) + math.log(-math.log(0.25))), 1e-12)
    location = low + scale * math.log(-math.log(0.25))
    limit = location - scale * math.log(-math.log1p(-ODD) / maxima.size)
    odd = np.flatnonzero(maxima > limit)
    if odd.size:
        places = ", ".join(f"{i * block_s:g}" for i in odd[:5])
        raise InputError(
            f"nominal data of {what} hold an alarm: blocks of {block_s:g} s from {places} s stand out "
            f"(up to {maxima.max():.3g}, nominal blocks stay below {limit:.3g}); cut them out, or find the cause"
            " [HM-WATCH-023]"
        )


def _thresholds(
    tests: Sequence[Test], limits: Sequence[ChannelLimit], levels: Sequence[Sequence[Array]], dt: float, rate: float,
    block_s: float,
) -> tuple[list[ChannelLimit], str]:  # fmt: skip
    """Limits with thresholds for a rate each, and why extreme values do not tell them all."""
    found, short = [], ""
    for test, limit, runs in zip(tests, limits, levels, strict=True):
        every = np.concatenate(list(runs))
        finite = every[np.isfinite(every)]
        if not (finite.size and finite.max() > 0):
            if not test.may_be_zero:
                raise InputError(
                    f"limits: {limit.channel} is zero or missing throughout the nominal data; record the machine in "
                    "motion [HM-WATCH-024]"
                )
            threshold, release = math.inf, math.inf
        else:
            try:
                threshold, release = calibrate(runs, dt, false_alarms_per_hour=rate, block_s=block_s)
            except InputError as error:
                short = str(error)
                threshold = MARGIN * float(finite.max())
                release = _release(threshold, finite)
        found.append(replace(limit, threshold=threshold, release=release))
    return found, short


def _release(threshold: float, finite: Array) -> float:
    return min(max(0.5 * threshold, float(np.quantile(finite, 0.95))), threshold)


def _scale_of(
    channel: int, traces: Sequence[Trace], masks: Sequence[Mask], names: Sequence[str]
) -> tuple[float, ...]:
    """Coefficients of a channel's variance, by least squares with weights from the fit before."""
    values = np.concatenate([t.values[m, channel] for t, m in zip(traces, masks, strict=True)])
    features = np.concatenate([t.terms[m, channel] for t, m in zip(traces, masks, strict=True)])
    known = np.isfinite(values) & np.isfinite(features).all(axis=1)
    features, squares = features[known], values[known] ** 2
    if not squares.size or not np.mean(squares) > 0:
        raise InputError(
            f"limits: {names[channel]} is zero or missing throughout the nominal data; record the machine in motion"
            " [HM-WATCH-025]"
        )
    from scipy.optimize import nnls  # slow to import, and a running monitor does without

    floor = FLOOR * float(np.mean(squares))
    spread = np.full(squares.size, float(np.mean(squares)))
    found = np.zeros(features.shape[1])
    for _ in range(ROUNDS):
        found, _ = nnls(features / spread[:, None], squares / spread)
        found[0] = max(found[0], floor)
        spread = features @ found
    return tuple(float(a) for a in found)


def _interval(
    levels: Sequence[Array], dt: float, rate: float, block_s: float, rng: np.random.Generator
) -> tuple[float, float]:
    """5 % and 95 % of the threshold over resampled blocks."""
    maxima, _ = block_maxima(levels, max(round(block_s / dt), 1))
    log_rate = math.log(rate * block_s / 3600.0)
    groups = math.ceil(maxima.size / NEIGHBOURS)
    starts = rng.integers(0, max(maxima.size - NEIGHBOURS, 0) + 1, size=(BOOTSTRAPS, groups))
    drawn = maxima[np.minimum(starts[:, :, None] + np.arange(NEIGHBOURS), maxima.size - 1)].reshape(
        BOOTSTRAPS, -1
    )
    found = []
    for sample in drawn:
        location, scale = gumbel(sample)
        found.append(location - scale * log_rate)
    low, high = np.quantile(found, [0.05, 0.95])
    return float(low), float(high)


def _freezing(
    readings: Readings, ys: Sequence[Array], traces: Sequence[Trace], masks: Sequence[Mask],
    resolution: ArrayLike | None,
) -> tuple[tuple[float, ...], tuple[int, ...]]:  # fmt: skip
    """How far outputs may be predicted to move, and for how many samples, while their sensor repeats itself.

    Readings of the energy know friction: three of the sensor's steps. Residuals: beyond what nominal data have, and
    three steps; the step is that of an even error as large as the sensor's noise, and no less than the smallest change
    recorded. Repetitions of what is not predicted to move by a step are those of a machine at rest.
    """
    model = readings.model
    if readings.kind == ENERGY:
        steps = [math.inf] * model.n_y if resolution is None else np.ravel(resolution).tolist()
        return tuple(FROZEN_STEPS * step for step in steps), (0,) * model.n_y
    travel = np.concatenate([np.abs(t.travel[m]) for t, m in zip(traces, masks, strict=True)])
    repeats = np.concatenate([t.repeats[m] for t, m in zip(traces, masks, strict=True)])
    noise, far, often = noise_of([SimpleNamespace(y=y) for y in ys]).tolist(), [], []
    for i, signal in enumerate(model.outputs):
        changes = np.concatenate([np.abs(np.diff(y[:, i])) for y in ys])
        changes = changes[changes > 0]
        if not changes.size:
            raise InputError(f"limits: {signal.name} never changes in the nominal data [HM-WATCH-026]")
        step, moved = max(math.sqrt(12.0) * noise[i], float(changes.min())), travel[:, i]
        if resolution is not None:
            step = max(step, float(np.ravel(resolution)[i]))
        far.append(max(MARGIN * float(moved.max()), FROZEN_STEPS * step))
        often.append(math.ceil(MARGIN * int(np.max(repeats[moved > step, i], initial=0))))
    return tuple(far), tuple(often)
