"""A detector learned from nominal data, and the monitor that a guard listens to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.calibrate import Calibration, block_maxima, calibrate, gumbel
from hybrid_mpc.monitor.detector import Detector, force_terms
from hybrid_mpc.monitor.energy import EnergyMonitor
from hybrid_mpc.monitor.lengths import (
    AVERAGE_S,
    BLOCK_S,
    FREE_RUN_S,
    HISTORY_S,
    NOTHING_STICKS,
    SETTLING_S,
    SHORTEST_S,
    WINDOW_S,
    block_seconds,
    checked_rest,
    half_window,
    rest_speeds,
    samples,
    seconds,
)
from hybrid_mpc.monitor.replay import EstimatorLike, TrajectoryLike, along, replay

Array = NDArray[np.float64]
DRIFT = 2.0
"""Dead band of the cumulative sums [deviations]. How soon faults are found with it: docs/energy-guard.md."""
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


def guard_monitor(
    model: HybridModel,
    calibration: Calibration | Detector | None = None,
    *,
    resolution: ArrayLike | None = None,
    input_range: ArrayLike | None = None,
    rest_speed: ArrayLike | None = None,
    diagnose: bool = False,
) -> EnergyMonitor:
    """The energy monitor with everything: short window, free runs, freeze test, detector, history.

    Its lengths count in the machine's second (``model.time_unit``): a window of 0.2, averages of 0.1, free runs of 0.6,
    a history of 2. Of a calibration only the detector is used: thresholds belong to the window they were found with.

    Args:
        model: Model whose outputs are its positions.
        calibration: With a detector, or the detector itself. Default: none, e.g. to learn one.
        resolution: Step of each sensor ``(n_y,)``. Default: unknown, no test for freezing.
        input_range: As in :class:`~hybrid_mpc.monitor.energy.EnergyMonitor`.
        rest_speed: As there; to learn a detector give what :func:`~hybrid_mpc.monitor.lengths.rest_speeds` finds.
        diagnose: Whether to keep a history for :class:`~hybrid_mpc.monitor.diagnose.Diagnoser`. Default: no.

    Raises:
        InputError: If the calibration has no detector, or one learned otherwise.

    Example: ``guard_monitor(artifact.models["hybrid"], detector, resolution=[2 * np.pi / 4096])``
    """
    detector = calibration.detector if isinstance(calibration, Calibration) else calibration
    if calibration is not None and detector is None:
        raise InputError(
            "guard monitor: the calibration holds no detector; learn one from nominal recordings: "
            "hybrid-mpc monitor MODEL NOMINAL.csv --learn 1"
        )
    half = half_window(WINDOW_S, model)
    length = max(seconds(FREE_RUN_S, model), 2 * (2 * half + 1) * model.dt)
    return EnergyMonitor(
        model,
        window=2 * half + 1,
        average=samples(AVERAGE_S, model),
        rest_speed=rest_speed,
        free_run=length,
        resolution=resolution,
        input_range=input_range,
        detector=detector,
        history=seconds(HISTORY_S, model) if diagnose else 0.0,
    )


def learn_from(
    model: HybridModel,
    estimator: EstimatorLike,
    recordings: Iterable[TrajectoryLike],
    *,
    false_alarms_per_hour: float = 1.0,
    rest_speed: ArrayLike | None = None,
    data_hash: str = "",
    report: Callable[[str, int, int, str], None] = lambda key, done, total, text: None,
) -> Detector:
    """The detector of :func:`guard_monitor` from nominal recordings.

    Args:
        model: The model.
        estimator: The one that the loop will use.
        recordings: On the model's grid, in which nothing is wrong; the first of the machine's seconds is left out.
        false_alarms_per_hour: Wanted rate [1/h]; default 1.
        rest_speed: Speeds ``(n_q,)`` below which friction may stick. Default: found in the recordings.
        data_hash: Hash of the recordings, kept in the result.
        report: Called with ``(key, done, total, text)`` as the replay goes on, in samples. Default: not at all.

    Raises:
        InputError: If a recording is on another grid, they are too short, nothing moves in them, or they hold an alarm.

    Example: ``learn_from(model, estimator, dataset.whole, data_hash=dataset.hash)``
    """
    given = list(recordings)
    monitor = guard_monitor(model, rest_speed=rest_speeds(given, model) if rest_speed is None else rest_speed)
    skipped = samples(SETTLING_S, model)
    runs: list[Array] = []
    for r, say in along(given, report):
        runs.append(replay(monitor, estimator, r, on_progress=say).numbers[skipped:])
    return learn_detector(
        runs, model.dt, model.n_y, drift=DRIFT, false_alarms_per_hour=false_alarms_per_hour,
        rest_speed=monitor.rest_speed, data_hash=data_hash, time_unit=model.time_unit,
    )  # fmt: skip


def learn_detector(
    runs: Sequence[Array],
    dt: float,
    n_q: int,
    *,
    free_runs: bool = True,
    drift: float = 1.0,
    false_alarms_per_hour: float = 1.0,
    rest_speed: ArrayLike = NOTHING_STICKS,
    data_hash: str = "",
    seed: int = 0,
    trusted: bool = False,
    time_unit: float = 1.0,
    block_s: float | None = None,
) -> Detector:
    """A detector from nominal readings, ``MonitorReading.numbers`` ``(n, columns)`` of each run.

    Scales come from weighted least squares of the squared residuals with coefficients that are not negative. Thresholds
    come from a Gumbel tail of the block maxima (:func:`~hybrid_mpc.monitor.calibrate.calibrate`), half of the wanted
    rate for either alarm. A block bootstrap of the same maxima, six neighbours at a time, gives their interval.

    ``rest_speed`` and ``time_unit`` are those of the monitor that made the numbers; by default nothing is
    taken to stick. Unless the data are ``trusted``,
    as simulated ones are, a block that stands out is refused. A block lasts ``block_s`` [s], by default 5 of the
    machine's seconds and 50 periods at least; shorter where there is little data, and a higher rate is enough.

    Raises:
        InputError: If there is too little data for the rate, no motion, or an alarm in what should be nominal.

    Source: Lawson and Hanson (1974) for the least squares; Künsch, *The jackknife and the bootstrap for general
    stationary observations*, Annals of Statistics 17 (1989).
    """
    if not runs or any(run.ndim != 2 for run in runs):
        raise InputError(
            "learn_detector: no nominal runs given; needed: arrays (n, columns) of reading numbers"
        )
    rows = np.concatenate([np.asarray(run, dtype=np.float64) for run in runs])
    end = rows.shape[1] - (4 if free_runs else 0)
    rest, block_s = checked_rest(rest_speed, n_q, "learn_detector"), block_s or block_seconds(dt, time_unit)
    v2, u2 = rows[:, 3 + 2 * n_q : 3 + 3 * n_q] ** 2, (rows[:, 3 + 3 * n_q : end] ** 2).sum(1)
    features = force_terms(v2, u2, rest)
    force = tuple(_scale(features, rows[:, 3 + i], f"force {i}") for i in range(n_q))
    energy: tuple[float, ...] = ()
    if free_runs:
        energy_j, v2, u2, seconds = rows[:, -4:].T
        long = seconds >= SHORTEST_S * time_unit
        time = np.where(long, seconds, np.inf)
        features = np.column_stack([np.ones(len(rows)), v2 / time, u2 / time, 1.0 / time])
        energy = _scale(features[long], (energy_j / time)[long], "power of the free runs")
    unlimited = Detector(
        dt,
        force,
        energy,
        drift,
        1e300,
        1e300 if free_runs else math.inf,
        rest_speed=rest,
        time_unit=time_unit,
    )
    levels = [detector_levels(unlimited, run) for run in runs]
    rate = false_alarms_per_hour / (2 if free_runs else 1)
    rng = np.random.default_rng(seed)
    checked = "" if trusted else "forces", "" if trusted else "power"
    sums = _threshold([a for a, _ in levels], dt, rate, rng, checked[0], block_s)
    power: tuple[float, tuple[float, ...]] = (math.inf, ())
    if free_runs:
        power = _threshold([b for _, b in levels], dt, rate, rng, checked[1], block_s)
    return replace(
        unlimited,
        force_threshold=sums[0],
        energy_threshold=power[0],
        false_alarms_per_hour=false_alarms_per_hour,
        hours=len(rows) * dt / 3600.0,
        interval=(*sums[1], *power[1]),
        method=f"Gumbel tail of maxima in blocks of {block_s:g} s, block bootstrap beside it",
        data_hash=data_hash,
    )


def detector_levels(detector: Detector, run: Array) -> tuple[Array, Array]:
    """Largest sum of the forces and scaled power ``(n,)`` along a run's numbers ``(n, columns)``.

    They are not shares of the thresholds, and no alarm limits the sums.
    """
    free = replace(detector, force_threshold=1e300, energy_threshold=1e300 if detector.energy else math.inf)
    state, scores = free.initial(), []
    for numbers in run.tolist():
        state, score, _ = free.update(state, numbers)
        scores.append(score)
    levels = np.array(scores).reshape(-1, 2) * 1e300
    return levels[:, 0], levels[:, 1] if detector.energy else np.zeros(len(levels))


def _scale(features: Array, values: Array, what: str) -> tuple[float, ...]:
    """Coefficients of the variance of ``values``, by least squares with weights from the fit before."""
    known = np.isfinite(values) & np.isfinite(features).all(axis=1)
    features, squares = features[known], values[known] ** 2
    if not squares.size or not np.mean(squares) > 0:
        raise InputError(
            f"learn_detector: the {what} is zero or missing throughout; record the machine in motion"
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


def _threshold(
    levels: Sequence[Array], dt: float, rate: float, rng: np.random.Generator, what: str, block_s: float
) -> tuple[float, tuple[float, float]]:
    """Threshold at the wanted rate, and its 5 % to 95 % over resampled blocks; without ``what`` nothing is checked."""
    fit = calibrate(levels, dt, false_alarms_per_hour=rate, block_s=block_s)
    maxima, _ = block_maxima(levels, max(round(block_s / dt), 1))
    if what:
        check_nominal(maxima, what, block_s)
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
    assert fit.threshold_w is not None
    return fit.threshold_w, (float(low), float(high))


def check_nominal(maxima: Array, what: str, block_s: float = BLOCK_S) -> None:
    """Refuse largest levels of blocks, in their order, of which one stands out so far that it can be no nominal one.

    Location and scale come from the quartiles, which a few odd blocks hardly move. The message names the places.
    """
    low, high = np.quantile(maxima, [0.25, 0.75])
    scale = max((high - low) / (-math.log(-math.log(0.75)) + math.log(-math.log(0.25))), 1e-12)
    location = low + scale * math.log(-math.log(0.25))
    limit = location - scale * math.log(-math.log1p(-ODD) / maxima.size)
    odd = np.flatnonzero(maxima > limit)
    if odd.size:
        places = ", ".join(f"{i * block_s:g}" for i in odd[:5])
        raise InputError(
            f"calibration data of the {what} hold an alarm: blocks of {block_s:g} s from {places} s stand out "
            f"(up to {maxima.max():.3g}, nominal blocks stay below {limit:.3g}); cut them out, or find what was wrong"
        )
