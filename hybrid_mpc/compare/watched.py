"""Work of a monitor that parallel processes share: replays over recordings, and loops with a simulated fault."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.compare.loops import LoopSpec, ModeChange, bench_of, kit_of
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.parts import LoopSettings
from hybrid_mpc.watch.explain import begun, explained
from hybrid_mpc.watch.monitor import Monitor, make_readings
from hybrid_mpc.watch.readings import Readings
from hybrid_mpc.watch.replay import Trace, TrajectoryLike, replays

Array = NDArray[np.float64]
Report = Callable[[int, int, str], None]


def traces_of(
    folder: Path, loop: LoopSettings, name: str, kinds: Sequence[str], rest: tuple[float, ...] | None,
    record: TrajectoryLike, report: Report,
) -> dict[str, Trace]:  # fmt: skip
    """Traces of a model's monitors without limits over a record, by kind of reading; one estimator serves all kinds.

    Args:
        folder: Folder of the artifact.
        loop: Settings of its loops.
        name: Name of the model.
        kinds: Kinds of readings, see :func:`~hybrid_mpc.watch.monitor.make_readings`.
        rest: Speeds below which friction may stick; None: unknown.
        record: See :func:`~hybrid_mpc.watch.replay.replay`.
        report: Called with ``(done, total, text)``, counted in samples.
    """
    kit = replace(kit_of(folder), loop=loop)
    text = f"samples, {getattr(record, 'name', '')}"
    monitors = [Monitor(readings_of(kit, name, kind, rest)) for kind in kinds]
    found = replays(
        monitors, kit.observer(name), record, on_progress=lambda done, total: report(done, total, text)
    )
    return dict(zip(kinds, found, strict=True))


def readings_of(kit: Kit, name: str, kind: str, rest: tuple[float, ...] | None) -> Readings:
    """The readings of a model's monitor, as :meth:`Kit.monitor` has them.

    Raises:
        InputError: If the model has no such readings.
    """
    span = kit.problem().input_range if kit.loop.control else None
    return make_readings(kit.models[name], kind, rest_speed=rest, input_range=span)


@dataclass(frozen=True)
class Faulted:
    """A loop with a fault, as a monitor of the hybrid sees it.

    Args:
        trace: The monitor's readings.
        y: Measurements of the loop ``(n, n_y)``.
        delay_s: Time from the begin of the fault to the first alarm after it; None: no alarm.
        channels: The channels of that alarm, in the order of their alarms.
        diagnosis: Diagnosis of that alarm; empty without one.
        false_alarms: Number of alarms before the fault begins.
        switches: Changes of the guard's mode.
    """

    trace: Trace
    y: Array
    delay_s: float | None
    channels: tuple[str, ...]
    diagnosis: str
    false_alarms: int
    switches: tuple[ModeChange, ...]


def faulted(scenario: str, folder: Path, spec: LoopSpec, start: float, report: Report) -> Faulted:
    """Run a loop whose fault begins at ``start`` [s], and diagnose the first alarm after it."""
    bench = bench_of(scenario, folder, learned=True)
    kit = bench.kit(spec)
    row, result = bench.run(spec)
    # the estimator is deterministic: a replay of the record repeats its estimates in the loop
    trace, alarms = explained(
        kit.monitor("hybrid", task=spec.task), bench.parts(spec)[0], result, lambda: kit.diagnoser("hybrid")
    )
    before, seen = begun(alarms, start)
    return Faulted(
        trace, result.y, delay_s=seen[0].start_s - start if seen else None,
        channels=seen[0].channels if seen else (), diagnosis=seen[0].diagnosis if seen else "",
        false_alarms=len(before), switches=tuple(row.switches),
    )  # fmt: skip
