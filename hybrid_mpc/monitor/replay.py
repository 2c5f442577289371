"""Run a monitor over a recording, as it would have run online."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.monitor.calibrate import alarm_intervals
from hybrid_mpc.monitor.energy import SECONDS, EnergyMonitor, MonitorReading, MonitorState

Array = NDArray[np.float64]
REPORTED = 500
"""Samples from one report of the progress to the next."""
COLUMNS = (
    "dE_model_w", "dE_measured_w", "violation_w", "level_w", "residual_level", "energy_j", "energy_s",
    "alarm", "frozen", "blind", "validity", "scores", "numbers",
)  # fmt: skip
"""Fields of a reading that a trace holds."""


class EstimatorLike(Protocol):
    """The estimator as the replay uses it; estimates have ``x`` (n_x,) and ``h`` (n_h,)."""

    def start(self, y: Array, t: float) -> Any:
        """Estimate at the first sample; with measured disturbances ``start(y, t, w=w)``."""

    def update(self, estimate: Any, y: Array, u_prev: Array) -> Any:
        """Estimate at the next sample, one period later; with measured disturbances ``update(..., w=w)``."""


class TrajectoryLike(Protocol):
    """A recording on the uniform grid: ``t`` (n,), ``y`` (n, n_y), ``u`` (n, n_u) held over [t_k, t_k+dt); and, where
    the model has measured disturbances, ``w`` (n, n_w).
    """

    @property
    def t(self) -> Array:
        """Time [s]."""

    @property
    def y(self) -> Array:
        """Measurements."""

    @property
    def u(self) -> Array:
        """Inputs."""


Recording = TypeVar("Recording", bound=TrajectoryLike)


@dataclass(frozen=True)
class MonitorTrace:
    """Readings over time, all ``(n,)``; see :class:`~hybrid_mpc.monitor.energy.MonitorReading`.

    ``scores`` are ``(n, 2)`` and ``numbers`` ``(n, columns)``; without a detector there are no scores. ``validity`` are
    the values of :class:`~hybrid_mpc.monitor.energy.Validity`. ``state`` is the monitor's after the last sample.
    """

    t: Array
    dE_model_w: Array
    dE_measured_w: Array
    violation_w: Array
    level_w: Array
    residual_level: Array
    alarm: NDArray[np.bool_]
    energy_j: Array = field(default_factory=lambda: np.zeros(0))
    energy_s: Array = field(default_factory=lambda: np.zeros(0))
    frozen: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    scores: Array = field(default_factory=lambda: np.zeros((0, 2)))
    numbers: Array = field(default_factory=lambda: np.zeros((0, 0)))
    state: MonitorState | None = None
    validity: NDArray[np.int_] = field(default_factory=lambda: np.zeros(0, dtype=int))
    blind: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def intervals(self) -> list[tuple[float, float]]:
        """Alarms as ``(first, last)`` [s] in the recording's own time."""
        return [(float(self.t[int(a)]), float(self.t[int(b)])) for a, b in alarm_intervals(self.alarm, 1.0)]

    def coverage(self, dt: float) -> dict[str, float]:
        """Seconds with a valid reading, and those without, by reason."""
        return {name: float(np.sum(self.validity == why)) * dt for why, name in SECONDS.items()}


def replay(
    monitor: EnergyMonitor,
    estimator: EstimatorLike,
    trajectory: TrajectoryLike,
    on_reading: Callable[[int, MonitorState, MonitorReading], None] | None = None,
    *,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> MonitorTrace:
    """Feed a recording to the estimator and the monitor, sample by sample.

    Args:
        monitor: The monitor.
        estimator: With ``start(y, t)`` and ``update(estimate, y, u_prev)``.
        trajectory: With ``t`` (n,), ``y`` (n, n_y), ``u`` (n, n_u) and, where the model has measured disturbances,
            ``w`` (n, n_w), on the model's grid.
        on_reading: Called with each sample's number, the state after it and its reading. Default: none.
        on_progress: Called with ``(done, total)`` samples every so often. Default: none.

    Raises:
        InputError: If the recording is empty, its lengths differ, or its period is not the model's.

    Example:
        ``trace = replay(monitor, estimator, trajectory); trace.intervals()``
    """
    t, y, u = (np.asarray(a, dtype=np.float64) for a in (trajectory.t, trajectory.y, trajectory.u))
    _check(t, y, u, monitor.model.dt)
    ws: Any = getattr(trajectory, "w", None)
    also: list[dict[str, Any]] = (
        [{"w": w} for w in ws] if monitor.model.n_w and ws is not None else [{}] * t.size
    )
    state, estimate = monitor.initial(), estimator.start(y[0], float(t[0]), **also[0])
    columns: dict[str, Any] = {}
    for k in range(t.size):
        if k % REPORTED == 0:
            on_progress(k, t.size)
        u_prev = u[k - 1] if k else np.full(monitor.model.n_u, np.nan)
        if k:
            estimate = estimator.update(estimate, y[k], u_prev, **also[k])
        state, reading = monitor.update(state, y[k], u_prev, estimate)
        for name in COLUMNS:
            value = np.asarray(getattr(reading, name))
            if not k:
                columns[name] = np.zeros((t.size, *value.shape), dtype=value.dtype)
            columns[name][k] = value
        if on_reading is not None:
            on_reading(k, state, reading)
    on_progress(t.size, t.size)
    return MonitorTrace(t, **columns, state=state)


def along(
    recordings: Sequence[Recording], report: Callable[[str, int, int, str], None]
) -> Iterator[tuple[Recording, Callable[[int, int], None]]]:
    """Recordings one after the other, each with the function that a replay reports its progress to.

    ``report`` takes ``(key, done, total, text)`` with the samples of all of them.
    """
    total, before = sum(len(r.t) for r in recordings), 0
    for r in recordings:
        name, start = getattr(r, "name", ""), before

        def say(done: int, own: int, name: str = name, start: int = start) -> None:
            report("recordings", start + done, total, f"samples, {name}")

        yield r, say
        before += len(r.t)


def with_alarms(monitor: EnergyMonitor, trace: MonitorTrace) -> MonitorTrace:
    """The trace with the alarms of another calibration: those of ``monitor``, of the replay's model and windows.

    Estimates and levels do not depend on the calibration, so nothing is replayed.
    """
    on, alarm = (False, False), []
    for level, residual in zip(trace.level_w, trace.residual_level, strict=True):
        on = monitor.alarms(float(level), float(residual), on)
        alarm.append(any(on))
    blind: Any = trace.blind if trace.blind.size else False
    return replace(trace, alarm=np.array(alarm, dtype=bool) | blind)


def _check(t: Array, y: Array, u: Array, dt: float) -> None:
    if not t.size or not t.size == len(y) == len(u):
        raise InputError(
            f"replay: t, y, u have {t.size}, {len(y)}, {len(u)} samples; need equally many, not 0"
        )
    off = float(np.max(np.abs(np.diff(t) - dt))) if t.size > 1 else 0.0
    if off > 1e-3 * dt:
        raise InputError(
            f"replay: the sampling period is off the model's {dt} s by up to {off:.3g} s; "
            "resample, or cut the recording at its gaps"
        )
