"""The monitor that a guard listens to, and its detector from nominal recordings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel
from hybrid_mpc.monitor.calibration import Calibration
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.energy import EnergyMonitor
from hybrid_mpc.monitor.learning import learn_detector
from hybrid_mpc.monitor.replay import EstimatorLike, TrajectoryLike, replay

Array = NDArray[np.float64]
WINDOW_S = 0.2
"""Window [s] of the derivative: half of it is how late a reading is, and its noise grows with length^-2.5."""
AVERAGE_S = 0.1
FREE_RUN_S = 0.6
HISTORY_S = 2.0
DRIFT = 2.0
"""Departure [deviations] that the detector's sums count as nothing. What that finds how soon: docs/energy-guard.md."""
SETTLING_S = 1.0
"""Beginning [s] of a recording that nothing is learned from: the estimator does not know the speed yet."""


def guard_monitor(
    model: HybridModel,
    calibration: Calibration | Detector | None = None,
    *,
    resolution: ArrayLike | None = None,
    input_range: ArrayLike | None = None,
    diagnose: bool = False,
) -> EnergyMonitor:
    """The energy monitor with everything: short window, free runs, freeze test, detector, history.

    Thresholds of a calibration belong to the window that they were found with, so only its detector is used.

    Args:
        model: Model whose outputs are its positions.
        calibration: With a detector, or the detector itself. Default: none, e.g. to learn one.
        resolution: Step of each sensor ``(n_y,)``. Default: unknown, no test for freezing.
        input_range: Range ``(n_u,)`` of each input that the controller has, for the same test. Default: that of the
            model's signals.
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
    half = max(2, round(0.5 * WINDOW_S / model.dt))
    length = max(FREE_RUN_S, 2 * (2 * half + 1) * model.dt)
    return EnergyMonitor(
        model,
        window=2 * half + 1,
        average=max(1, round(AVERAGE_S / model.dt)),
        free_run=length,
        resolution=resolution,
        input_range=input_range,
        detector=detector,
        history=HISTORY_S if diagnose else 0.0,
    )


def learn_from(
    model: HybridModel,
    estimator: EstimatorLike,
    recordings: Iterable[TrajectoryLike],
    *,
    false_alarms_per_hour: float = 1.0,
    data_hash: str = "",
) -> Detector:
    """The detector of :func:`guard_monitor` from nominal recordings.

    Args:
        model: The model.
        estimator: The one that the loop will use.
        recordings: On the model's grid, in which nothing is wrong; the first second of each is left out.
        false_alarms_per_hour: Wanted rate [1/h]; default 1.
        data_hash: Hash of the recordings, kept in the result.

    Raises:
        InputError: If a recording is on another grid, they are too short, or hold an alarm.

    Example: ``learn_from(model, estimator, dataset.whole, data_hash=dataset.hash)``
    """
    monitor = guard_monitor(model)
    skipped = round(SETTLING_S / model.dt)
    runs: Sequence[Array] = [replay(monitor, estimator, r).numbers[skipped:] for r in recordings]
    return learn_detector(
        runs, model.dt, model.n_y, drift=DRIFT, false_alarms_per_hour=false_alarms_per_hour,
        rest_speed=monitor.rest_speed, data_hash=data_hash,
    )  # fmt: skip
