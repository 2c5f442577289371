"""Stage monitor: the energy monitor calibrated on recordings, and tried on them and in a closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import poisson

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.loops import MODEL, Bench, LoopSpec
from hybrid_mpc.job.stage import Absent, Stage
from hybrid_mpc.job.stages.compare import what_loops_read
from hybrid_mpc.job.stages.export import EXPORT, NOISE
from hybrid_mpc.job.stages.identify import DATA
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import energy_is_watched, make_monitor
from hybrid_mpc.kit.parts import EnergyLimits, read_parts, write_energy
from hybrid_mpc.loop.faults import Fault
from hybrid_mpc.loop.simulate import ClosedLoopResult
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.calibrate import Calibration, alarm_intervals, calibrate, stretches, with_residual
from hybrid_mpc.monitor.lengths import block_seconds, rest_speeds
from hybrid_mpc.monitor.replay import along, replay, with_alarms

if TYPE_CHECKING:
    from hybrid_mpc.data.trajectories import Trajectory

Array = NDArray[np.float64]
RATES = (1.0, 2.0, 5.0, 10.0)
"""False alarms an hour (of the machine's seconds, see :func:`rates`) on nominal data: the first that the data are long
enough for."""
NOMINAL = ("train", "valid", "nominal")
"""Roles of what the monitor is calibrated on."""
HELD: tuple[str, ...] = ("valid", "nominal")
WITH_TRAINING = (*HELD, "train")
"""Those that no parameter was fitted to, and with them the training's. Test recordings are kept to try limits and
detector on."""
LEARNED_FROM: Mapping[tuple[str, ...], str] = {
    HELD: "recordings that nothing was trained on",
    WITH_TRAINING: "undisturbed recordings, also those of the training, which the model fits better than new ones",
}
"""What limits or a detector are learned from, in words."""
FAULT_SEED = 600
"""Number of the loops in which something breaks, away from those that a detector is learned from."""
UNLIKELY = 0.05
"""Alarms of which so many or more are less likely than this are more than the limits were learned for."""
LOAD_SHARE = 0.2
"""Unknown load of the demonstration, as a share of half the input's range."""
MARGIN = 1.5
"""Where nominal data are too short for a rate: threshold over the highest nominal level."""
NO_PROBLEM = "the monitor's estimator needs the scenario's control problem (input range, sensor noise)"
NO_ENERGY = (
    "the energy of {scenario} cannot be watched: its model is not mechanical, or other outputs than its positions are "
    "measured; its residuals are watched instead (stage residuals)"
)


def rates(model: HybridModel) -> tuple[float, ...]:
    """The rates of ``RATES`` on the machine of a model [1/h].

    Example:
        >>> from types import SimpleNamespace
        >>> rates(SimpleNamespace(time_unit=10.0))
        (0.1, 0.2, 0.5, 1.0)
    """
    return tuple(rate / model.time_unit for rate in RATES)


@dataclass(frozen=True)
class RecordedAlarm:
    """An alarm on a recording: its file, from and to [s]."""

    file: str
    start_s: float
    end_s: float

    def __post_init__(self) -> None:
        if not self.start_s <= self.end_s:
            raise InputError(
                f"an alarm on {self.file} ends at {self.end_s} s, before it starts at {self.start_s} s"
            )


@dataclass(frozen=True)
class CleanAlarms:
    """Alarms where nothing disturbs the machine: time known to be undisturbed [s] and the alarms that begin in it, then
    those of test data alone.
    """

    seconds: float = 0.0
    alarms: int = 0
    test_seconds: float = 0.0
    test_alarms: int = 0

    def too_many(self, per_hour: float) -> bool:
        """Whether these are more than a rate of false alarms [1/h] explains: so many or more have a probability below
        5 % (Poisson).

        Example:
            >>> [CleanAlarms(300.0, alarms).too_many(10.0) for alarms in (0, 1, 3, 4)]
            [False, False, False, True]
        """
        return self.alarms > 0 and float(poisson.sf(self.alarms - 1, self.expected(per_hour))) < UNLIKELY

    def expected(self, per_hour: float) -> float:
        """Alarms expected in that time at a rate of false alarms [1/h]."""
        return per_hour * self.seconds / 3600.0

    def words(self, per_hour: float) -> str:
        """The alarms beside those that the limits were learned for.

        Example:
            >>> CleanAlarms(300.0, 1).words(10.0)
            '1 in 300 s without a disturbance; at 10 false alarms an hour 0.83 are expected'
        """
        return (
            f"{self.alarms} in {self.seconds:.0f} s without a disturbance; at {per_hour:g} false alarms an hour "
            f"{self.expected(per_hour):.2g} are expected"
        )


@dataclass(frozen=True)
class UnknownLoad:
    """The closed loop in which an unknown load sets in.

    Args:
        task: Name of the task.
        load: The load [unit of the first input].
        start_s: When it sets in [s].
        delay_s: Time to the alarm [s]; None: never.
        false_alarms: Alarms before it.
    """

    task: str
    load: float
    start_s: float
    delay_s: float | None
    false_alarms: int


@dataclass(frozen=True)
class MonitorResult:
    """The calibrated monitor, and what it says of the recordings.

    Args:
        calibration: Its thresholds; none where nothing could be calibrated.
        recordings: Seconds that were monitored and that were not, by recording and reason.
        reason: Why nothing could be calibrated. Default: it could.
        alarms: Alarms on whole recordings.
        clean: Alarms where nothing disturbs the machine; None where nothing could be calibrated.
        load: The loop with an unknown load; None without a plant.
        arrays: ``"RECORDING/SIGNAL"``, and ``"load/SIGNAL"`` of the loop.
        of: Digest of the observer that it was calibrated with.
    """

    calibration: Calibration
    recordings: tuple[Mapping[str, float | str], ...]
    reason: str = ""
    alarms: tuple[RecordedAlarm, ...] = ()
    clean: CleanAlarms | None = None
    load: UnknownLoad | None = None
    arrays: Mapping[str, Array] = field(default_factory=dict)
    of: str = ""


def monitor_stage(context: Context) -> MonitorResult | Absent:
    """Calibrate on training and validation stretches, then replay the monitor over whole recordings.

    Where nothing can be calibrated the result holds the reason; the artifact then keeps the rest speeds alone.
    """
    if context.scenario.control is None:
        return Absent(NO_PROBLEM)
    context.read(NOISE)
    kit, whole = context.kit, context.dataset.whole
    of = read_parts(context.out / "model").observer("hybrid")
    model, reason, rest = kit.models["hybrid"], "", None
    if not energy_is_watched(model):
        return Absent(NO_ENERGY.format(scenario=context.scenario.name))
    try:
        rest = rest_speeds([t for t in context.dataset.trajectories if t.role in NOMINAL], model)
    except InputError as short:
        reason = f"the monitor could not be calibrated: {short}"
    power, residual, traces = [], [], []
    # the estimator of the closed loops; the monitor ignores its disturbance estimate
    watching, estimator = make_monitor(model, None, rest_speed=rest or kit.known_rest), kit.observer("hybrid")
    for recording, say in along(whole, context.progress.update):
        trace = replay(watching, estimator, recording, on_progress=say)
        traces.append(trace)
        nominal = inside(context, recording, NOMINAL)
        power.append(np.where(nominal, trace.level_w, np.nan))
        residual.append(np.where(nominal, trace.residual_level, np.nan))
    covered: tuple[Mapping[str, float | str], ...] = tuple(
        {"file": r.name, **t.coverage(model.dt)} for r, t in zip(whole, traces, strict=True)
    )
    try:
        calibration = with_residual(
            *(
                _calibrate(levels, model, context.dataset.hash, watching.rest_speed)
                for levels in (power, residual)
            )
        )
    except InputError as none:
        reason = reason or f"the monitor could not be calibrated: {none}"
    if reason:
        result = MonitorResult(Calibration.without(reason, rest), covered, reason, of=of)
        put_calibration(context, result)
        return result
    alarms, arrays, on = [], {}, []
    for recording, levels in zip(whole, traces, strict=True):
        trace = with_alarms(make_monitor(model, calibration), levels)
        alarms += [RecordedAlarm(recording.name, a, b) for a, b in trace.intervals()]
        for key in ("t", "violation_w", "level_w", "residual_level", "alarm"):
            arrays[f"{recording.name}/{key}"] = getattr(trace, key)
        arrays[f"{recording.name}/y"] = recording.y
        on.append(trace.alarm)
    clean = clean_alarms(context, whole, on)
    load = None
    if context.scenario.plant is not None and context.scenario.tasks:
        load, loop = _load_loop(context, replace(kit, calibration=calibration))
        arrays |= {f"load/{key}": getattr(loop, key) for key in ("t", "violation", "level", "alarm", "y")}
    result = MonitorResult(calibration, covered, "", tuple(alarms), clean, load, arrays, of)
    put_calibration(context, result)
    return result


def clean_alarms(
    context: Context, recordings: Sequence[Trajectory], on: Sequence[NDArray[np.bool_]]
) -> CleanAlarms:
    """Alarms that are ``on`` ``(n,)`` in the undisturbed parts of the recordings, which have any role.

    An alarm counts where it begins: it may reach in from a disturbed part.
    """
    seconds, counts = [0.0, 0.0], [0, 0]
    for recording, alarm in zip(recordings, on, strict=True):
        starts, _ = stretches(alarm)
        for i, roles in enumerate(((*NOMINAL, "test"), ("test",))):
            clean = inside(context, recording, roles)
            seconds[i] += float(clean.sum() * recording.dt)
            counts[i] += int(clean[starts].sum())
    return CleanAlarms(seconds[0], counts[0], seconds[1], counts[1])


def put_calibration(context: Context, found: MonitorResult) -> str:
    """Write ``watch/energy.json``."""
    write_energy(context.out / "model", EnergyLimits(found.calibration, found.of))
    return ""


def _load_loop(context: Context, kit: Kit) -> tuple[UnknownLoad, ClosedLoopResult]:
    """The first task with an unknown constant load from its middle on: does the monitor see it?"""
    task, settings = context.scenario.tasks[0], context.settings
    load = unknown_load(kit.problem(task.name), kit.models["hybrid"], task.duration)
    spec = LoopSpec(
        settings.scenario, MODEL, task.name, "hybrid_observer", monitor="energy", run_seed=settings.seed,
        faults=(load,),
    )  # fmt: skip
    calm = replace(task, faults=())
    result = Bench(context.scenario, {MODEL: kit}).run(spec, task=calm)[1]
    begins = np.array([begin for begin, _ in alarm_intervals(result.alarm, result.dt)])
    seen = begins[begins >= load.start - 1e-9]
    delay = float(seen[0] - load.start) if seen.size else None
    return UnknownLoad(task.name, load.value, load.start, delay, begins.size - seen.size), result


def unknown_load(control: OCP, model: HybridModel, duration: float) -> Fault:
    """Load of the demonstration at the first input, from the middle of a task of that ``duration`` [s] on.

    Example:
        >>> from types import SimpleNamespace as Some
        >>> arm = Some(inputs=[Some(name="tau_1"), Some(name="tau_2")])
        >>> ocp = OCP(9, [1.0], [1.0] * 2, [1.0] * 2, u_min=[-5.0, -1.0], u_max=[0.0, 1.0])
        >>> load = unknown_load(ocp, arm, 6.0)
        >>> load.start, load.value, load.channel
        (3.0, 0.5, 'tau_1')
    """
    size = LOAD_SHARE * float(0.5 * control.input_range[0])
    return Fault(0.5 * duration, duration, "input_offset", size, model.inputs[0].name)


def clean_windows(
    context: Context, recording: Trajectory, roles: tuple[str, ...]
) -> list[tuple[float, float]]:
    """Stretches of a recording whose role says that nothing disturbs the machine there, ``(start, end)`` [s]."""
    stem = recording.file
    if stem in context.spec.windows:
        return [(w.start, w.end) for w in context.spec.windows[stem] if w.role in roles]
    pieces = [t for t in context.dataset.trajectories if t.file == stem and t.role in roles]
    return [(float(t.t[0]), float(t.t[-1])) for t in pieces]


def inside(context: Context, recording: Trajectory, roles: tuple[str, ...]) -> NDArray[np.bool_]:
    """Which samples ``(n,)`` of a recording lie in stretches of such roles in which nothing disturbs the machine."""
    found = np.zeros(len(recording.t), dtype=bool)
    for start, end in clean_windows(context, recording, roles):
        found |= (recording.t >= start) & (recording.t <= end)
    return found


def _calibrate(
    levels: list[Array], model: HybridModel, data_hash: str, rest: tuple[float, ...]
) -> Calibration:
    """One of the two alarms: by extreme values for half the lowest of ``RATES`` that the data can carry; for
    none of them, by a margin.

    Raises:
        InputError: If no level is a number, or none is above zero.
    """
    block_s = block_seconds(model.dt, model.time_unit)
    for rate in rates(model):
        try:
            return calibrate(
                levels, model.dt, false_alarms_per_hour=0.5 * rate, data_hash=data_hash, block_s=block_s,
                rest_speed=rest,
            )  # fmt: skip
        except InputError as too_short:
            why = str(too_short)
    finite = np.concatenate(levels)
    finite = finite[np.isfinite(finite)]
    if not (finite.size and finite.max() > 0):
        nothing = "no level above zero" if finite.size else "no level that is a number"
        raise InputError(f"there is {nothing} in the undisturbed recordings; {why}")
    threshold = MARGIN * float(finite.max())
    release = min(max(0.5 * threshold, float(np.quantile(finite, 0.95))), threshold)
    method = f"{MARGIN} x the highest nominal level, for no rate can be told from so little data ({why})"
    hours, rate = finite.size * model.dt / 3600.0, 0.5 * rates(model)[-1]
    return Calibration(threshold, release, rate, finite.size, hours, method, data_hash, rest_speed=rest)


MONITOR = Stage(
    "monitor", "calibrating the energy monitor", MonitorResult, monitor_stage, what_loops_read,
    (DATA, EXPORT, NOISE), optional=True, restore=put_calibration,
)  # fmt: skip
