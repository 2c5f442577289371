"""Alarms of a recording or loop with their diagnoses, and the trace as a table."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.watch.diagnose import BLIND, Diagnoser
from hybrid_mpc.watch.monitor import Monitor
from hybrid_mpc.watch.readings import Validity
from hybrid_mpc.watch.replay import EstimatorLike, Trace, TrajectoryLike, replay

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Alarm:
    """An alarm.

    Args:
        start_s: First sample [s] in the recording's own time.
        end_s: Last sample [s].
        diagnosis: Its cause; empty without a diagnosis.
        channels: Channels in the order of their alarms.
    """

    start_s: float
    end_s: float
    diagnosis: str
    channels: tuple[str, ...] = ()


@dataclass(frozen=True)
class WatchedRecording:
    """A recording that was monitored.

    Args:
        recording: Its name.
        seconds: Its length [s].
        valid_s: Time with a valid reading [s].
        warm_up_s: Time until all windows were full [s].
        missing_s: Time with missing samples [s].
        not_finite_s: Time with a non-finite value of model or estimator [s].
        alarms: Its alarms.
    """

    recording: str
    seconds: float
    valid_s: float
    warm_up_s: float
    missing_s: float
    not_finite_s: float
    alarms: tuple[Alarm, ...]


def explained(
    monitor: Monitor,
    estimator: EstimatorLike,
    recording: TrajectoryLike,
    diagnoser: Callable[[], Diagnoser] | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Trace, tuple[Alarm, ...]]:
    """Replay a monitor with the closed loops' estimator, and diagnose each alarm.

    Args:
        monitor: The monitor.
        estimator: The estimator of the loop.
        recording: See :func:`~hybrid_mpc.watch.replay.replay`.
        diagnoser: Builds the diagnoser; called once, and only if there is an alarm. Default: only missing readings are
            diagnosed.
        on_progress: Called with ``(done, total)`` samples every 500 samples. Default: nothing.
    """
    estimates: list[Any] = []
    trace = replay(
        monitor, estimator, recording, on_sample=lambda k, estimate: estimates.append(estimate),
        on_progress=on_progress,
    )  # fmt: skip
    alarms, made = [], None
    for start, end in trace.intervals():
        k, channels = int(np.searchsorted(trace.t, start - 1e-9)), trace.named(start, end)
        text = BLIND.get(Validity(int(trace.validity[k])), "")
        if channels and diagnoser is not None:
            made = made or diagnoser()
            text = made.of_alarm(k, trace, recording, estimates)
        alarms.append(Alarm(start, end, text if channels or trace.blind[k] else "", channels))
    return trace, tuple(alarms)


def begun(alarms: Sequence[Alarm], start: float) -> tuple[list[Alarm], list[Alarm]]:
    """Alarms that begin before ``start`` [s], and those that begin from then on.

    An alarm that is already on when a fault begins is not a detection of the fault.

    Example:
        >>> before, seen = begun((Alarm(1.0, 9.0, ""), Alarm(5.0, 6.0, "pump")), 4.0)
        >>> len(before), seen[0].diagnosis
        (1, 'pump')
    """
    before = [alarm for alarm in alarms if alarm.start_s < start - 1e-9]
    return before, [alarm for alarm in alarms if alarm not in before]


def table(trace: Trace, y: Array, outputs: Sequence[Signal], monitor: Monitor) -> str:
    """The trace as CSV, one row for each sample: measurements ``y`` ``(n, n_y)``, values of the channels with units,
    levels of their limits, alarms.
    """
    columns: dict[str, Any] = {"t_s": trace.t}
    columns |= {f"{s.name}_{s.unit}": y[:, i] for i, s in enumerate(outputs)}
    limits = () if monitor.limits is None else monitor.limits.channels
    for i, channel in enumerate(trace.channels):
        label = channel.name.replace(" ", "_")
        columns[f"{label}_value_{channel.unit}"] = trace.values[:, i]
        for j, limit in enumerate(limits):
            if limit.channel == channel.name:
                how = {0: "sum", 1: "value"}.get(limit.length, f"mean_{limit.length}")
                columns[f"{label}_{how}_{'deviations' if limit.scale else limit.unit}"] = trace.levels[:, j]
        columns[f"{label}_alarm"] = trace.on[:, i]
    columns |= {f"{name}_frozen": trace.frozen[:, i] for i, name in enumerate(trace.outputs)}
    columns |= {"share": trace.share, "valid": trace.validity == Validity.VALID, "alarm": trace.alarm}
    text = io.StringIO()
    rows, header = np.column_stack([*columns.values()]), ",".join(columns)
    np.savetxt(text, rows, fmt="%.9g", delimiter=",", header=header, comments="")
    return text.getvalue()
