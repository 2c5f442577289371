"""A detector judged on recordings that it has not seen: learned from all others, one left out at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.learn import DRIFT, guard_monitor, learn_detector
from hybrid_mpc.monitor.lengths import SETTLING_S, rest_speeds
from hybrid_mpc.monitor.replay import EstimatorLike, MonitorTrace, TrajectoryLike, replay

Array = NDArray[np.float64]
TINY = 1e-6
"""Tolerance [s] of comparisons between times: far below a period, above rounding."""
Windows = Mapping[str, Sequence[tuple[float, float]]]


class NamedRecording(TrajectoryLike, Protocol):
    """A recording on the model's grid with a name; ``"file#2"`` is the second piece of ``file``."""

    @property
    def name(self) -> str:
        """Name; what stands before ``#`` has the windows."""


@dataclass(frozen=True)
class HeldOut:
    """A recording as the detector of all others judges it.

    Args:
        name: The recording's.
        detector: Learned from the clean windows of the others.
        trace: What the monitor said, sample by sample, with this detector's scores and alarms.
        clean: True within the recording's own clean windows ``(n,)``.

    Example:
        >>> z, on = np.zeros(4), np.array([False, True, True, False])
        >>> trace = MonitorTrace(np.arange(4.0), z, z, z, z, z, on)
        >>> found = HeldOut("a", Detector(0.02, ((1.0, 0, 0, 0),), (), 1.0, 9.0), trace, np.arange(4) > 1)
        >>> found.outside, found.inside, found.left_over
        ([(1.0, 2.0)], [], 1)
    """

    name: str
    detector: Detector
    trace: MonitorTrace
    clean: NDArray[np.bool_]

    @property
    def inside(self) -> list[tuple[float, float]]:
        """Alarms ``(first, last)`` [s] that begin in a clean window: false ones."""
        return [a for a in self.trace.intervals() if self._begins_clean(a)]

    @property
    def outside(self) -> list[tuple[float, float]]:
        """Alarms ``(first, last)`` [s] that begin outside."""
        return [a for a in self.trace.intervals() if not self._begins_clean(a)]

    @property
    def left_over(self) -> int:
        """Samples of clean windows in which an alarm that began outside is still on."""
        return int(np.sum(self.trace.alarm & self.clean)) - sum(
            int(np.sum(self.clean & (self.trace.t >= a) & (self.trace.t <= b))) for a, b in self.inside
        )

    @property
    def highest(self) -> tuple[float, float]:
        """Largest shares of the thresholds, forces and power, in clean windows but for their first second (the
        machine's).
        """
        settled = settled_windows(self.trace.t, self.clean, SETTLING_S * self.detector.time_unit)
        scores = self.trace.scores[settled]
        return (float(scores[:, 0].max()), float(scores[:, 1].max())) if len(scores) else (0.0, 0.0)

    def _begins_clean(self, interval: tuple[float, float]) -> bool:
        return bool(self.clean[int(np.argmin(np.abs(self.trace.t - interval[0])))])


def leave_one_out(
    model: HybridModel,
    estimator: EstimatorLike,
    recordings: Sequence[NamedRecording],
    windows: Windows,
    *,
    false_alarms_per_hour: float = 1.0,
    resolution: ArrayLike | None = None,
    rest_speed: ArrayLike | None = None,
    block_s: float | None = None,
    data_hash: str = "",
) -> list[HeldOut]:
    """Judge each recording with a detector learned from the clean windows of all others.

    Every recording is replayed as a whole, as it would have run online: what happens between the windows is in the
    monitor's memory when the next one begins. Nothing is learned from the first of the machine's seconds of a window.

    Args:
        model: The model. What it was trained on it has seen, whatever the detector has.
        estimator: The one that the loop would use.
        recordings: At least two, on the model's grid.
        windows: Where nothing but the input acted on the machine, ``(start, end)`` [s] by name.
        false_alarms_per_hour: Wanted rate [1/h]; default 1. Little data ask for more.
        resolution: Step of each sensor ``(n_y,)``. Default: unknown, no test for freezing.
        rest_speed: Speeds ``(n_q,)`` below which friction may stick. Default: what
            :func:`~hybrid_mpc.monitor.lengths.rest_speeds` finds in all clean windows.
        block_s: Length of a block [s] of the extreme values; see :func:`~hybrid_mpc.monitor.learn.learn_detector`.
        data_hash: Hash of the recordings, kept in the detectors.

    Raises:
        InputError: If there are fewer than two files, one has no windows, or the others are too short for the rate.

    Example: ``leave_one_out(model, estimator, dataset.whole, {"day1": [(0, 60)], "day2": [(5, 70)]})``
    """
    if len({_stem(r) for r in recordings}) < 2:
        raise InputError(f"leave_one_out: {len(recordings)} recordings given, at least two files are needed")
    if unknown := sorted({_stem(r) for r in recordings} - set(windows)):
        raise InputError(
            f"leave_one_out: no clean windows given for {unknown}; name them, or leave these out"
        )
    clean = [clean_samples(np.asarray(r.t, dtype=np.float64), windows[_stem(r)]) for r in recordings]
    if rest_speed is None:
        undisturbed = [
            _Outputs(y) for r, c in zip(recordings, clean, strict=True) for y in _stretches(r.y, c)
        ]
        rest_speed = rest_speeds(undisturbed, model)
    monitor = guard_monitor(model, resolution=resolution, rest_speed=rest_speed)
    traces = [replay(monitor, estimator, r) for r in recordings]
    settled = [
        settled_windows(trace.t, c, SETTLING_S * model.time_unit)
        for trace, c in zip(traces, clean, strict=True)
    ]
    found = []
    for r, trace, inside in zip(recordings, traces, clean, strict=True):
        others = [i for i, other in enumerate(recordings) if _stem(other) != _stem(r)]
        detector = learn_detector(
            [run for i in others for run in _stretches(traces[i].numbers, settled[i])], model.dt, model.n_y,
            drift=DRIFT, false_alarms_per_hour=false_alarms_per_hour, rest_speed=monitor.rest_speed,
            data_hash=data_hash, time_unit=model.time_unit, block_s=block_s,
        )  # fmt: skip
        found.append(HeldOut(r.name, detector, judged(detector, trace), inside))
    return found


def judged(detector: Detector, trace: MonitorTrace) -> MonitorTrace:
    """The trace with the scores and alarms of a detector, which may not have been there when it was made.

    Args:
        detector: The detector.
        trace: What a monitor with free runs said; its frozen sensors, and where it was blind, remain alarms.
    """
    state, scores, alarm = detector.initial(), [], []
    for numbers in trace.numbers.tolist():
        state, score, detected = detector.update(state, numbers)
        scores.append(score)
        alarm.append(detected)
    on = np.array(alarm, dtype=bool)
    for own in (trace.frozen, trace.blind):
        if own.size:
            on |= own
    return replace(trace, scores=np.array(scores), alarm=on)


def clean_samples(t: Array, windows: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """True where ``t`` ``(n,)`` lies in one of the windows; a window's end is no longer in it.

    Example:
        >>> clean_samples(np.arange(4.0), [(1.0, 3.0)]).tolist()
        [False, True, True, False]
    """
    inside = np.zeros(len(t), dtype=bool)
    for start, end in windows:
        inside |= (t >= start - TINY) & (t < end - TINY)
    return inside


def settled_windows(t: Array, clean: NDArray[np.bool_], settling: float = SETTLING_S) -> NDArray[np.bool_]:
    """The clean samples but for the beginning of each window, in which the monitor remembers what was before it.

    Args:
        t: Times ``(n,)`` [s].
        clean: True within the windows ``(n,)``.
        settling: Length [s] of what is left out. Default 1; of a machine with another second, one of these.

    Example:
        >>> settled_windows(np.array([0.0, 0.5, 1.0, 1.5]), np.array([True, True, True, False])).tolist()
        [False, False, True, False]
    """
    begun, settled = float("nan"), np.zeros(len(t), dtype=bool)
    for k, inside in enumerate(clean):
        begun = float("nan") if not inside else t[k] if begun != begun else begun
        settled[k] = inside and t[k] >= begun + settling - TINY
    return settled


@dataclass(frozen=True)
class _Outputs:
    """Positions ``y`` of a stretch."""

    y: Array


def _stretches(rows: Array, kept: NDArray[np.bool_]) -> list[Array]:
    """The rows of each stretch that is kept."""
    cuts = np.flatnonzero(np.diff(kept.astype(int))) + 1
    pieces = zip(np.split(rows, cuts), np.split(kept, cuts), strict=True)
    return [part for part, inside in pieces if inside.any()]


def _stem(recording: NamedRecording) -> str:
    return recording.name.split("#")[0]
