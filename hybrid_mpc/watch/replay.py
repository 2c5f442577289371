"""Replay of a monitor over a recording as it would run online, and the trace of its readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.watch.monitor import Monitor, Reading
from hybrid_mpc.watch.readings import SECONDS, Channel

Array = NDArray[np.float64]
REPORTED = 500
"""Samples between two progress reports."""


class EstimatorLike(Protocol):
    """Interface of the estimator in a replay; estimates have ``x`` (n_x,) and ``h`` (n_h,)."""

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
class Trace:
    """Readings of a monitor along ``n`` samples.

    Args:
        t: Time [s] ``(n,)``.
        channels: The channels of the monitor.
        outputs: Names of the outputs.
        values: Values of the channels ``(n, channels)`` [their units]; NaN where unknown.
        terms: Regressors of the variances of nominal values ``(n, channels, terms)``.
        levels: Levels of the limits ``(n, limits)``.
        share: Largest level over its threshold ``(n,)`` [-]; NaN without limits.
        on: Which channels alarm ``(n, channels)``.
        frozen: Which outputs are frozen ``(n, n_y)``.
        travel: Predicted motion of the outputs while their readings repeat ``(n, n_y)``.
        repeats: Number of repeated readings ``(n, n_y)``.
        inside: Which outputs lie inside their sensors' ranges ``(n, n_y)``.
        settled: Whether values count ``(n,)``.
        alarm: Any alarm ``(n,)``.
        validity: Values of :class:`~hybrid_mpc.watch.readings.Validity` ``(n,)``.
        blind: ``(n,)``, True while there has been no valid reading for too long.
    """

    t: Array
    channels: tuple[Channel, ...]
    outputs: tuple[str, ...]
    values: Array
    terms: Array
    levels: Array
    share: Array
    on: NDArray[np.bool_]
    frozen: NDArray[np.bool_]
    travel: Array
    repeats: NDArray[np.int_]
    inside: NDArray[np.bool_]
    settled: NDArray[np.bool_]
    alarm: NDArray[np.bool_]
    validity: NDArray[np.int_]
    blind: NDArray[np.bool_]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels, then of the frozen sensors."""
        return (*(c.name for c in self.channels), *(f"{name} frozen" for name in self.outputs))

    def of(self, channel: str) -> Array:
        """Values of a channel ``(n,)`` [its unit]."""
        return np.asarray(self.values[:, [c.name for c in self.channels].index(channel)])

    def intervals(self) -> list[tuple[float, float]]:
        """Alarms as ``(first, last)`` [s] in the recording's own time."""
        return self._times(self.alarm)

    def by_channel(self) -> dict[str, list[tuple[float, float]]]:
        """Alarms of each channel that had any, and of each frozen sensor as ``"NAME frozen"``."""
        every = np.hstack([self.on, self.frozen]).T
        return {name: self._times(on) for name, on in zip(self.names, every, strict=True) if on.any()}

    def named(self, start: float, end: float) -> tuple[str, ...]:
        """Channels that alarm between two times [s], in the order of their alarms, or ``"NAME frozen"``."""
        within = (self.t >= start - 1e-9) & (self.t <= end + 1e-9)
        on = np.hstack([self.on, self.frozen])[within]
        first = [int(np.argmax(column)) if column.any() else len(on) for column in on.T]
        return tuple(self.names[i] for i in np.argsort(first, kind="stable") if first[i] < len(on))

    def coverage(self, dt: float) -> dict[str, float]:
        """Seconds with a valid reading, and without one by reason."""
        return {name: float(np.sum(self.validity == why)) * dt for why, name in SECONDS.items()}

    def _times(self, on: NDArray[np.bool_]) -> list[tuple[float, float]]:
        return [(float(self.t[int(a)]), float(self.t[int(b)])) for a, b in alarm_intervals(on, 1.0)]


def trace_of(monitor: Monitor, t: ArrayLike, readings: Sequence[Reading]) -> Trace:
    """The trace of readings at instants ``t`` ``(n,)`` [s]."""
    n, channels = len(readings), monitor.readings.channels
    outputs = tuple(s.name for s in monitor.model.outputs)
    shape = (n, len(channels), monitor.readings.n_terms)
    terms = np.array([r.terms for r in readings]).reshape(shape) if shape[2] else np.zeros(shape)
    names = "values", "share", "travel", "repeats", "inside", "settled", "alarm", "validity", "blind"
    columns: dict[str, Any] = {name: np.array([getattr(r, name) for r in readings]) for name in names}
    return Trace(
        np.asarray(t, dtype=np.float64), channels, outputs, terms=terms,
        levels=np.array([r.levels for r in readings]).reshape(n, -1),
        on=np.array([[c.name in r.channels for c in channels] for r in readings]),
        frozen=np.array([[name in r.frozen_outputs for name in outputs] for r in readings]), **columns,
    )  # fmt: skip


def replay(
    monitor: Monitor,
    estimator: EstimatorLike,
    recording: TrajectoryLike,
    *,
    on_sample: Callable[[int, Any], None] = lambda k, estimate: None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Trace:
    """Run estimator and monitor over a recording, sample by sample.

    Args:
        monitor: The monitor.
        estimator: The estimator of the loop.
        recording: With ``t`` (n,), ``y`` (n, n_y), ``u`` (n, n_u) and, if the model has measured disturbances, ``w``
            (n, n_w), on the model's grid.
        on_sample: Called with each sample's index and estimate. Default: nothing.
        on_progress: Called with ``(done, total)`` samples every 500 samples. Default: nothing.

    Raises:
        InputError: If the recording is empty, its lengths differ, or its period is not the model's.

    Example: ``replay(kit.monitor(), kit.observer(), recording).by_channel()``
    """
    return replays([monitor], estimator, recording, on_sample=on_sample, on_progress=on_progress)[0]


def replays(
    monitors: Sequence[Monitor],
    estimator: EstimatorLike,
    recording: TrajectoryLike,
    *,
    on_sample: Callable[[int, Any], None] = lambda k, estimate: None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Trace]:
    """:func:`replay` of several monitors of one model, which share the estimates."""
    model = monitors[0].model
    t, y, u = (np.asarray(a, dtype=np.float64) for a in (recording.t, recording.y, recording.u))
    _check(t, y, u, model.dt)
    ws: Any = getattr(recording, "w", None)
    known = model.n_w and ws is not None
    states, estimate = [monitor.initial() for monitor in monitors], None
    readings: list[list[Reading]] = [[] for _ in monitors]
    for k in range(t.size):
        if k % REPORTED == 0:
            on_progress(k, t.size)
        also: dict[str, Any] = {"w": ws[k]} if known else {}
        u_prev = u[k - 1] if k else np.full(model.n_u, np.nan)
        if estimate is None:
            estimate = estimator.start(y[k], float(t[0]), **also)
        else:
            estimate = estimator.update(estimate, y[k], u_prev, **also)
        for i, monitor in enumerate(monitors):
            states[i], reading = monitor.update(states[i], y[k], u_prev, estimate)
            readings[i].append(reading)
        on_sample(k, estimate)
    on_progress(t.size, t.size)
    return [trace_of(monitor, t, own) for monitor, own in zip(monitors, readings, strict=True)]


def along(
    recordings: Sequence[Recording], report: Callable[[str, int, int, str], None]
) -> Iterator[tuple[Recording, Callable[[int, int], None]]]:
    """Recordings one after the other, each with a progress function for :func:`replay`.

    ``report`` is called with ``(key, done, total, text)``, counted in samples of all recordings.
    """
    total, before = sum(len(r.t) for r in recordings), 0
    for r in recordings:
        name, start = getattr(r, "name", ""), before

        def say(done: int, own: int, name: str = name, start: int = start) -> None:
            report("recordings", start + done, total, f"samples, {name}")

        yield r, say
        before += len(r.t)


def with_alarms(monitor: Monitor, trace: Trace) -> Trace:
    """A trace with the levels and alarms of ``monitor``'s limits, without a replay: values do not depend on limits."""
    detector = monitor.detector
    assert detector is not None
    on, levels, shares, frozen = [], [], [], []
    state, outputs = detector.initial(), trace.outputs
    rows = zip(trace.values.tolist(), trace.terms.tolist(), trace.settled, trace.travel, trace.repeats, trace.inside,
               strict=True)  # fmt: skip
    for values, terms, settled, travel, repeats, inside in rows:
        state, level, share = detector.update(state, values, terms, bool(settled))
        levels.append(level)
        shares.append(share)
        alarming = {c for c, o in zip(detector.channels, state.on, strict=True) if o}
        on.append([c in alarming for c in range(len(trace.channels))])
        stuck = monitor.frozen(travel, repeats, inside)
        frozen.append([name in stuck for name in outputs])
    found, still = np.array(on), np.array(frozen)
    alarm = found.any(axis=1) | still.any(axis=1) | trace.blind
    return replace(
        trace, levels=np.array(levels), share=np.array(shares), on=found, frozen=still, alarm=alarm
    )


def count_alarms(alarm: Array | NDArray[np.bool_], dt: float) -> tuple[int, float]:
    """Number of alarms (rising edges; an alarm at the start counts) and their rate [1/h].

    Example:
        >>> count_alarms(np.array([False, True, True, False]), 900.0)
        (1, 1.0)
    """
    n = len(alarm_intervals(alarm, dt))
    hours = len(alarm) * dt / 3600.0
    return n, n / hours if hours > 0 else 0.0


def alarm_intervals(alarm: Array | NDArray[np.bool_], dt: float) -> list[tuple[float, float]]:
    """Intervals ``(first, last)`` [s] in which the alarm is on; sample k lies at ``k dt``."""
    return [(float(a * dt), float(b * dt)) for a, b in zip(*stretches(alarm), strict=True)]


def stretches(on: ArrayLike) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """First and last indices of the intervals in which ``on`` ``(n,)`` is true."""
    edges = np.diff(np.concatenate([[0], np.asarray(on, dtype=bool), [0]]).astype(int))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1


def _check(t: Array, y: Array, u: Array, dt: float) -> None:
    if not t.size or not t.size == len(y) == len(u):
        raise InputError(
            f"replay: t, y, u have {t.size}, {len(y)}, {len(u)} samples; give equally many, at least 1 [HM-WATCH-033]"
        )
    off = float(np.max(np.abs(np.diff(t) - dt))) if t.size > 1 else 0.0
    if off > 1e-3 * dt:
        raise InputError(
            f"replay: the sampling period is off the model's {dt} s by up to {off:.3g} s; "
            "resample, or cut the recording at its gaps [HM-WATCH-034]"
        )
