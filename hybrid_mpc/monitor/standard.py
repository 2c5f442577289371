"""The monitor that a guard listens to, and its detector from nominal recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel
from hybrid_mpc.monitor.calibration import Calibration
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.energy import EnergyMonitor
from hybrid_mpc.monitor.learning import learn_detector
from hybrid_mpc.monitor.lengths import (
    AVERAGE_S,
    FREE_RUN_S,
    HISTORY_S,
    SETTLING_S,
    WINDOW_S,
    half_window,
    samples,
    seconds,
)
from hybrid_mpc.monitor.replay import EstimatorLike, TrajectoryLike, along, replay
from hybrid_mpc.monitor.rest import rest_speeds

Array = NDArray[np.float64]
DRIFT = 2.0
"""Departure [deviations] that the detector's sums count as nothing. What that finds how soon: docs/energy-guard.md."""


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

    Its lengths count in the machine's second (``model.time_unit``): a window of 0.2, averages of 0.1, free runs of
    0.6, a history of 2. Thresholds of a calibration belong to the window that they were found with, so only its
    detector is used.

    Args:
        model: Model whose outputs are its positions.
        calibration: With a detector, or the detector itself. Default: none, e.g. to learn one.
        resolution: Step of each sensor ``(n_y,)``. Default: unknown, no test for freezing.
        input_range: Range ``(n_u,)`` of each input that the controller has, for the same test. Default: that of the
            model's signals.
        rest_speed: Speeds ``(n_q,)`` below which friction may stick. Default: the detector's, else 0.2, see
            :class:`~hybrid_mpc.monitor.EnergyMonitor`; to learn a detector give what :func:`rest_speeds` finds.
        diagnose: Whether to keep a history for :class:`~hybrid_mpc.monitor.Diagnoser`. Default: no.

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
        recordings: On the model's grid, in which nothing is wrong; the first of the machine's seconds of each is left
            out.
        false_alarms_per_hour: Wanted rate [1/h]; default 1.
        rest_speed: Speeds ``(n_q,)`` below which friction may stick, e.g. the artifact's. Default: those that
            :func:`rest_speeds` finds in the recordings.
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
