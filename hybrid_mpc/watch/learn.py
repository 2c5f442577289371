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
from hybrid_mpc.watch.replay import EstimatorLike, Trace, TrajectoryLike, along, replay, stretches

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MIN_BLOCKS = 30
"""Smallest number of blocks to fit the two parameters of a Gumbel distribution."""
MAX_EXTRAPOLATION = 20.0
"""Longest mean time between false alarms, in multiples of the nominal data's length."""
MARGIN = 1.5
"""Threshold over the highest nominal level if nominal data are too short for the rate."""
BOOTSTRAPS = 200
"""Number of bootstrap samples of the thresholds."""
NEIGHBOURS = 6
"""Successive blocks that are resampled together (half a minute with blocks of 5 s), longer than their correlation."""
NEVER = 1e300
"""A threshold that is never exceeded."""


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
    """Learn the limits of a monitor's channels from fault-free recordings.

    Args:
        readings: The monitor's readings (:func:`~hybrid_mpc.watch.monitor.make_readings`).
        estimator: The estimator of the loop.
        recordings: With ``t``, ``y``, ``u`` and, if the model has disturbances, ``w``, on the model's grid.
        false_alarms_per_hour: Wanted rate [1/h] of all alarms together; or several rates in rising order, of which the
            first is used that the recordings are long enough for. Default: 1.
        nominal: Mask of the counted samples of each recording, ``(n,)`` each. Default: all.
        resolution: Resolution of each sensor ``(n_y,)``, to detect frozen sensors. Default: estimated from the
            recordings for residuals; unknown for the energy, which then detects no frozen sensors.
        data_hash: Hash of the recordings, stored in the result. Default: none.
        on_progress: Called with ``(done, total)`` samples. Default: nothing.

    Raises:
        InputError: If the recordings are too short, contain an alarm, or a channel is zero throughout.

    Example: ``learn_limits(make_readings(model), observer, dataset.whole, data_hash=dataset.hash)``
    """
    monitor, given = Monitor(readings), list(recordings)
    traces = [
        replay(monitor, estimator, recording, on_progress=say)
        for recording, say in along(given, lambda key, done, total, text: on_progress(done, total))
    ]
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

    The first time unit in each nominal interval does not count, because the estimator settles. The
    variance of a channel with terms is fitted by weighted nonnegative least squares to its squared values. Each limit
    gets an equal share of the wanted rate. Its threshold is the level that nominal levels exceed at that rate (extreme
    values of blocks). If the data are too short, it is 1.5 times the highest nominal level, and ``method`` says so. A
    block bootstrap of six neighbouring blocks gives the interval of a threshold. Unless the data are ``trusted``, such
    as simulated data, a block of scaled levels that stands out is refused. The length of a block ``block_s`` [s] is 5
    time constants of the machine by default, at least 50 periods.

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
            f"limits: every nominal interval is shorter than the estimator's settling time of "
            f"{settling_samples(model) * model.dt:g} s. Give longer nominal data [HM-WATCH-018]"
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
    method = f"{MARGIN} x the highest nominal level ({short})" if short else (
        f"extreme values of blocks of {block_s:g} s"
    )  # fmt: skip
    rest = tuple(getattr(readings, "rest_speed", ()))
    return WatchLimits(
        kind=readings.kind, dt=model.dt, channels=tuple(found), travel=travel, repeats=repeats,
        false_alarms_per_hour=rate, hours=seconds / 3600, method=method, rated=not short, rest_speed=rest,
        data_hash=data_hash, time_unit=model.time_unit,
    )  # fmt: skip


def settled(mask: ArrayLike, first: int) -> Mask:
    """A mask ``(n,)`` without the first samples of each of its intervals.

    Example:
        >>> settled([True, True, True, False, True], 1).tolist()
        [False, True, True, False, False]
    """
    found = np.array(mask, dtype=bool)
    for start in stretches(found)[0].tolist():
        found[start : start + first] = False
    return found


def levels_of(detector: Detector, traces: Sequence[Trace], masks: Sequence[Mask]) -> list[list[Array]]:
    """Magnitudes of each limit's levels along the traces, ``(n,)`` each; NaN for samples that do not count.

    Sums are reset at the begin of each counted interval.
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
    """Threshold that nominal levels, ``(n,)`` of each run, exceed at the wanted rate, and the level of release.

    Block maxima follow a Gumbel distribution, whose location and scale are estimated by the first two L-moments. The
    threshold is ``location - scale * log(rate * block)``. The release is half the threshold, but at least the nominal
    95 % quantile (else an alarm might not end), and at most the threshold. The block length ``block_s`` [s] must be
    much longer than the correlation time of the levels (:func:`~hybrid_mpc.watch.lengths.block_seconds`). NaN are
    ignored.

    Raises:
        InputError: If ``dt``, block or rate are not positive, the rate exceeds one alarm in two blocks, the data are
            too short (30 blocks, and one twentieth of the mean time between alarms), or all levels are zero.

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
            f"calibration: a rate of {false_alarms_per_hour}/h is too high; give at most {1800 / block_s:g}/h "
            "[HM-WATCH-020]"
        )
    maxima, finite = block_maxima(levels, max(round(block_s / dt), 1))
    needed = max(MIN_BLOCKS, int(np.ceil(1.0 / (rate * MAX_EXTRAPOLATION) - 1e-9)))
    if maxima.size < needed:
        raise InputError(
            f"nominal data too short: {maxima.size * block_s / 60:.1f} min in whole blocks of {block_s:g} s; "
            f"{false_alarms_per_hour:.3g} false alarms an hour need {needed * block_s / 60:.1f} min. "
            "Record more, or allow a higher rate [HM-WATCH-021]"
        )
    location, scale = gumbel(maxima)
    threshold = location - scale * float(np.log(rate))
    if not threshold > 0:
        raise InputError(
            "calibration: all nominal levels are zero, so no threshold can be estimated. Record the machine in motion "
            "[HM-WATCH-022]"
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
    """Refuse block maxima, in their order, if one of them is improbably large; the message names the times.

    Location and scale of the Gumbel distribution are estimated by the quartiles, which are robust to a few outliers.
    """
    if maxima.size < MIN_BLOCKS:
        return
    low, high = np.quantile(maxima, [0.25, 0.75])
    scale = max((high - low) / (-math.log(-math.log(0.75)) + math.log(-math.log(0.25))), 1e-12)
    location = low + scale * math.log(-math.log(0.25))
    # probability of the largest block maximum below which a block does not count as nominal
    limit = location - scale * math.log(-math.log1p(-1e-4) / maxima.size)
    odd = np.flatnonzero(maxima > limit)
    if odd.size:
        places = ", ".join(f"{i * block_s:g}" for i in odd[:5])
        raise InputError(
            f"nominal data of {what} contain an alarm. Blocks of {block_s:g} s from {places} s stand out (up to "
            f"{maxima.max():.3g}, nominal blocks stay below {limit:.3g}). Remove these blocks, or find the cause "
            "[HM-WATCH-023]"
        )


def _thresholds(
    tests: Sequence[Test], limits: Sequence[ChannelLimit], levels: Sequence[Sequence[Array]], dt: float, rate: float,
    block_s: float,
) -> tuple[list[ChannelLimit], str]:  # fmt: skip
    """Limits with thresholds for a rate of each, and why block maxima do not suffice for all of them."""
    found, short = [], ""
    for test, limit, runs in zip(tests, limits, levels, strict=True):
        every = np.concatenate(list(runs))
        finite = every[np.isfinite(every)]
        if not (finite.size and finite.max() > 0):
            if not test.may_be_zero:
                raise InputError(
                    f"limits: {limit.channel} is zero or missing throughout the nominal data. Record the machine in "
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
    """Coefficients of a channel's variance, by iteratively reweighted least squares."""
    values = np.concatenate([t.values[m, channel] for t, m in zip(traces, masks, strict=True)])
    features = np.concatenate([t.terms[m, channel] for t, m in zip(traces, masks, strict=True)])
    known = np.isfinite(values) & np.isfinite(features).all(axis=1)
    features, squares = features[known], values[known] ** 2
    if not squares.size or not np.mean(squares) > 0:
        raise InputError(
            f"limits: {names[channel]} is zero or missing throughout the nominal data. Record the machine in motion"
            " [HM-WATCH-025]"
        )
    from scipy.optimize import nnls  # slow to import, and a running monitor does without

    # smallest constant term of a variance over its mean, so that the scale is positive in quiet data
    floor = 1e-3 * float(np.mean(squares))
    spread = np.full(squares.size, float(np.mean(squares)))
    found = np.zeros(features.shape[1])
    # number of reweighted least-squares fits of a variance
    for _ in range(5):
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
    """Largest predicted motion of outputs, and largest number of samples, while a sensor repeats its reading.

    For the energy, which accounts for friction: three steps of the sensor. For residuals: above that in nominal data,
    and at least three steps. The step is ``sqrt(12)`` times the sensor noise, at least the smallest recorded change.
    Repetitions with a predicted motion below a step mean a machine at rest.
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
            raise InputError(
                f"limits: {signal.name} never changes in the nominal data. Record the machine in motion [HM-WATCH-026]"
            )
        step, moved = max(math.sqrt(12.0) * noise[i], float(changes.min())), travel[:, i]
        if resolution is not None:
            step = max(step, float(np.ravel(resolution)[i]))
        far.append(max(MARGIN * float(moved.max()), FROZEN_STEPS * step))
        often.append(math.ceil(MARGIN * int(np.max(repeats[moved > step, i], initial=0))))
    return tuple(far), tuple(often)
