"""Stage residuals: the monitor of any machine, its limits learned from recordings, and tried on them and in loops."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.loops import MODEL, Bench, LoopSpec
from hybrid_mpc.job.monitor import begun, explained_residuals
from hybrid_mpc.job.stage import Absent, Stage
from hybrid_mpc.job.stages.compare import what_loops_read
from hybrid_mpc.job.stages.export import EXPORT, NOISE
from hybrid_mpc.job.stages.identify import DATA
from hybrid_mpc.job.stages.monitor import (
    FAULT_SEED,
    HELD,
    LEARNED_FROM,
    NO_PROBLEM,
    WITH_TRAINING,
    CleanAlarms,
    RecordedAlarm,
    clean_alarms,
    inside,
    rates,
)
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import energy_is_watched
from hybrid_mpc.kit.parts import ChannelLimits, read_parts, write_residuals
from hybrid_mpc.loop.faults import Fault
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.replay import along
from hybrid_mpc.monitor.residuals import (
    ResidualLimits,
    ResidualMonitor,
    ResidualTrace,
    limits_of,
    replay_residuals,
    with_alarms,
)

if TYPE_CHECKING:
    from hybrid_mpc.data.trajectories import Trajectory

WEAKER = 0.8
"""What is left of an actuator's force in them."""


@dataclass(frozen=True)
class ChannelAlarm(RecordedAlarm):
    """An alarm on a recording, and the channels that alarmed in it, in their order."""

    channels: tuple[str, ...]


@dataclass(frozen=True)
class FaultedChannel:
    """A loop in which an actuator weakens or a sensor freezes.

    Args:
        fault: The fault's target.
        channel: Name of the input or output.
        value: Its size.
        task: Name of the task.
        start_s: When it sets in [s].
        delay_s: Time to the first alarm that begins from then on [s]; None: never.
        channels: The channels of that alarm.
        diagnosis: What the diagnosis takes it for; empty where it says nothing.
        false_alarms: Alarms before it sets in.
    """

    fault: str
    channel: str
    value: float
    task: str
    start_s: float
    delay_s: float | None
    channels: tuple[str, ...]
    diagnosis: str
    false_alarms: int


@dataclass(frozen=True)
class ResidualsResult:
    """Limits of the monitor of residuals, and what it says of recordings and loops.

    Args:
        limits: Limits by model.
        source: What they were learned from, in words.
        alarms: Alarms of the recommended model on the recordings that were replayed.
        clean: Alarms where nothing disturbs the machine.
        faults: Loops in which something breaks; None where the energy is watched, or without a plant.
        of: Digests of the observers that they were learned with, by model.
        by_channel: Alarms of the recommended model's channels where nothing disturbs the machine.
        units: Units of these channels.
    """

    limits: Mapping[str, ResidualLimits]
    source: str
    alarms: tuple[ChannelAlarm, ...]
    clean: CleanAlarms
    faults: tuple[FaultedChannel, ...] | None = None
    of: Mapping[str, str] = field(default_factory=dict)
    by_channel: Mapping[str, CleanAlarms] = field(default_factory=dict)
    units: tuple[str, ...] = ()


def residuals_stage(context: Context) -> ResidualsResult | Absent:
    """Learn limits from undisturbed recordings, those that nothing was fitted to if they suffice; put them into the
    artifact.
    """
    scenario = context.scenario
    if scenario.control is None:
        return Absent(NO_PROBLEM)
    context.read(NOISE)
    kit, limits = context.kit, {}
    for name in dict.fromkeys(("hybrid", kit.recommended)):
        try:
            found, recordings, traces, source = _learned(context, kit, name)
        except InputError as none:
            return Absent(f"no limits of residuals could be learned: {none}")
        limits[name] = found
    folder = context.out / "model"
    parts = read_parts(folder)
    of = {model: parts.observer(model) for model in limits}
    write_residuals(folder, ChannelLimits(limits, of))
    monitor = ResidualMonitor(kit.models[name], limits=found)
    alarms, clean, by_channel = _on_recordings(context, monitor, recordings, traces)
    faults = None
    calm = [task for task in scenario.tasks if not task.faults]
    if scenario.plant is not None and calm and not energy_is_watched(kit.models["hybrid"]):
        faults = _faulted(context, context.kit, calm[0].name)
    return ResidualsResult(limits, source, alarms, clean, faults, of, by_channel, monitor.units)


def put_residuals(context: Context, found: ResidualsResult) -> str:
    """Write ``watch/residuals.json``."""
    write_residuals(context.out / "model", ChannelLimits(found.limits, found.of))
    return ""


def _learned(
    context: Context, kit: Kit, name: str
) -> tuple[ResidualLimits, list[Trajectory], list[ResidualTrace], str]:
    """Limits of a model, the recordings that were replayed for them with their traces, and where they come from."""
    model, estimator = kit.models[name], kit.observer(name)
    monitor, tried = ResidualMonitor(model), rates(model)
    held = [r for r in context.dataset.whole if inside(context, r, (*HELD, "test")).any()]
    recordings, traces = list(held), _replayed(context, monitor, estimator, held)

    def learned(roles: Sequence[str]) -> ResidualLimits:
        masks = [inside(context, r, tuple(roles)) for r in recordings]
        return limits_of(monitor, recordings, traces, false_alarms_per_hour=tried, nominal=masks)

    try:
        found = learned(HELD)
        if found.rated:
            return found, recordings, traces, LEARNED_FROM[HELD]
    except InputError:
        pass  # nothing of them is long enough; the others may be
    others = [r for r in context.dataset.whole if r not in held]
    recordings, traces = recordings + others, traces + _replayed(context, monitor, estimator, others)
    return learned(WITH_TRAINING), recordings, traces, LEARNED_FROM[WITH_TRAINING]


def _replayed(
    context: Context, monitor: ResidualMonitor, estimator: object, recordings: Sequence[Trajectory]
) -> list[ResidualTrace]:
    return [
        replay_residuals(monitor, estimator, recording, on_progress=say)  # type: ignore[arg-type]
        for recording, say in along(recordings, context.progress.update)
    ]


def _on_recordings(
    context: Context,
    monitor: ResidualMonitor,
    recordings: Sequence[Trajectory],
    traces: Sequence[ResidualTrace],
) -> tuple[tuple[ChannelAlarm, ...], CleanAlarms, dict[str, CleanAlarms]]:
    alarms: list[ChannelAlarm] = []
    on: list[NDArray[np.bool_]] = []
    by_channel: list[NDArray[np.bool_]] = []
    for recording, levels in zip(recordings, traces, strict=True):
        trace = with_alarms(monitor, levels, recording.y)
        alarms += [
            ChannelAlarm(recording.name, start, end, trace.named(start, end))
            for start, end in trace.intervals()
        ]
        on.append(trace.alarm)
        by_channel.append(trace.on)
    each = {
        channel: clean_alarms(context, recordings, [rows[:, i] for rows in by_channel])
        for i, channel in enumerate(monitor.channels)
    }
    return tuple(alarms), clean_alarms(context, recordings, on), each


def broken(model: HybridModel, start: float) -> list[Fault]:
    """What is tried from ``start`` [s] on: each actuator loses a fifth of its force, each sensor freezes."""
    weaker = [Fault(start, math.inf, "input_gain", WEAKER, s.name) for s in model.inputs]
    return weaker + [Fault(start, math.inf, "measurement_freeze", 0.0, s.name) for s in model.outputs]


def _faulted(context: Context, kit: Kit, task_name: str) -> tuple[FaultedChannel, ...]:
    """A loop of each fault, from the middle of a calm task on; nothing reacts, so that the machine shows it."""
    scenario, settings = context.scenario, context.settings
    bench, model = Bench(scenario, {MODEL: kit}), kit.models["hybrid"]
    base = LoopSpec(
        settings.scenario, MODEL, task_name, "hybrid_observer", monitor="residuals", seed=FAULT_SEED,
        run_seed=settings.seed,
    )  # fmt: skip
    start = model.dt * round(0.5 * bench.task(base).duration / model.dt)
    found, faults = [], broken(model, start)
    for i, fault in enumerate(faults):
        context.progress.update("faults", i, len(faults), f"{fault.target} of {fault.channel}")
        spec = replace(base, faults=(fault,))
        result = bench.run(spec)[1]
        monitor = bench.monitor(spec)
        assert isinstance(monitor, ResidualMonitor)
        # the estimator is deterministic: over the record it says again what it said in the loop
        _, alarms = explained_residuals(
            monitor, bench.parts(spec)[0], result, kit.models["prior"], kit.causes
        )
        before, seen = begun(alarms, start)
        found.append(
            FaultedChannel(
                fault.target, fault.channel, fault.value, task_name, start,
                seen[0].start_s - start if seen else None,
                seen[0].channels if seen else (), seen[0].diagnosis if seen else "", len(before),
            )
        )  # fmt: skip
    return tuple(found)


RESIDUALS = Stage(
    "residuals", "learning the monitor of residuals", ResidualsResult, residuals_stage,
    lambda context: {**what_loops_read(context), "causes": context.scenario.causes}, (DATA, EXPORT, NOISE),
    optional=True, restore=put_residuals,
)  # fmt: skip
