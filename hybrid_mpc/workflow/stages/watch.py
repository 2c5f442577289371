"""Stage watch: learn the limits of all channels, write them to the kit, test them on recordings and faulted loops."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import poisson

from hybrid_mpc.compare.loops import MODEL, LoopSpec, ModeChange
from hybrid_mpc.compare.nominal import CONTROLLER, broken, nominal_loops, nominal_tasks, stage_of
from hybrid_mpc.compare.watched import Faulted, faulted, readings_of, traces_of
from hybrid_mpc.engine import WORKERS, run_jobs
from hybrid_mpc.errors import InputError
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import sensor_steps
from hybrid_mpc.kit.parts import WatchFile, read_parts, write_watch
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.records import beside
from hybrid_mpc.rules import counted, two_digits
from hybrid_mpc.scenario import Scenario
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.watch.diagnose import Diagnoser
from hybrid_mpc.watch.explain import Alarm, WatchedRecording, explained
from hybrid_mpc.watch.learn import limits_of
from hybrid_mpc.watch.lengths import rest_speeds
from hybrid_mpc.watch.monitor import reads_energy
from hybrid_mpc.watch.readings import ENERGY, RESIDUALS, Channel, Readings
from hybrid_mpc.watch.replay import Trace, TrajectoryLike, stretches, with_alarms
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent, Stage
from hybrid_mpc.workflow.stages.compare import run_or_read, what_loops_read
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE
from hybrid_mpc.workflow.stages.identify import DATA

if TYPE_CHECKING:
    from hybrid_mpc.data.trajectories import Trajectory

Array = NDArray[np.float64]
RATES = (1.0, 2.0, 5.0, 10.0)
"""Default rates of false alarms [per hour, over the machine's time unit in seconds], see :func:`rates`."""
NOMINAL = ("train", "valid", "nominal")
"""Roles of undisturbed parts of recordings."""
HELD: tuple[str, ...] = ("valid", "nominal")
WITH_TRAINING = (*HELD, "train")
"""Held-out roles, and these with the training data. Limits are tested on the test recordings."""
LEARNED_FROM: Mapping[tuple[str, ...], str] = {
    HELD: "held-out recordings",
    WITH_TRAINING: "undisturbed recordings including training data, which the model fits better than new data",
}
"""Data that limits are learned from, in words."""
FAULT_SEED = 600
"""Seed of the loops with a fault; loops that limits are learned from have other seeds."""
UNLIKELY = 0.05
"""Significance level of too many false alarms: probability of at least that many alarms at the rate of the limits."""
SHOWN_RECORDINGS = 4
"""Number of recordings that are drawn."""
KEPT = ("t", "values", "levels", "share", "on", "frozen", "alarm")
"""Fields of a trace that are kept for the report."""
NO_PROBLEM = "the scenario defines no control problem, which gives the monitor's estimator input range and sensor noise"


def rates(scenario: Scenario, model: HybridModel) -> tuple[float, ...]:
    """Wanted rates of false alarms [1/h], the least first: the scenario's, or :data:`RATES` on the model's machine.

    Example:
        >>> rates(SimpleNamespace(false_alarms_per_hour=()), SimpleNamespace(time_unit=10.0))
        (0.1, 0.2, 0.5, 1.0)
    """
    return scenario.false_alarms_per_hour or tuple(rate / model.time_unit for rate in RATES)


@dataclass(frozen=True)
class CleanAlarms:
    """False alarms in undisturbed data.

    Args:
        seconds: Undisturbed time [s].
        alarms: Alarms that begin in it.
        test_seconds: Undisturbed time of the test data alone [s].
        test_alarms: Alarms that begin in it.
    """

    seconds: float = 0.0
    alarms: int = 0
    test_seconds: float = 0.0
    test_alarms: int = 0

    def too_many(self, per_hour: float) -> bool:
        """Whether the alarms are significantly more than a rate [1/h] explains: P(N >= alarms) < 5 %, N Poisson.

        Example:
            >>> [CleanAlarms(300.0, alarms).too_many(10.0) for alarms in (0, 1, 3, 4)]
            [False, False, False, True]
        """
        return self.alarms > 0 and float(poisson.sf(self.alarms - 1, self.expected(per_hour))) < UNLIKELY

    def expected(self, per_hour: float) -> float:
        """Alarms expected in that time at a rate of false alarms [1/h]."""
        return per_hour * self.seconds / 3600.0

    def words(self, per_hour: float) -> str:
        """Text that compares the alarms with those expected at a rate of false alarms [1/h].

        Example:
            >>> CleanAlarms(300.0, 1).words(10.0)
            '1 in 300 s of undisturbed data; 0.83 are expected at 10 false alarms an hour'
        """
        return (
            f"{self.alarms} in {self.seconds:.0f} s of undisturbed data; {self.expected(per_hour):.2g} are expected "
            f"at {two_digits(per_hour)} false alarms an hour"
        )


@dataclass(frozen=True)
class NominalLoop:
    """A loop that limits were learned from.

    Args:
        task: Name of the task.
        seed: Seed of the loop.
        friction: Factor that friction drifts to.
        seconds: Length [s].
        cost: Closed-loop cost.
    """

    task: str
    seed: int
    friction: float
    seconds: float
    cost: float


@dataclass(frozen=True)
class FaultedLoop:
    """A closed loop with a simulated fault.

    Args:
        fault: Short name of the fault.
        title: Description of the fault.
        task: Name of the task.
        start_s: Begin of the fault [s].
        delay_s: Detection delay [s]: time from the begin of the fault to the first alarm after it; None: no alarm.
        channels: The channels of that alarm, in the order of their alarms.
        diagnosis: Diagnosis of that alarm; empty without a diagnosis.
        false_alarms: Number of alarms before the fault begins.
        switches: Changes of the guard's mode. Default: none.
    """

    fault: str
    title: str
    task: str
    start_s: float
    delay_s: float | None
    channels: tuple[str, ...]
    diagnosis: str
    false_alarms: int
    switches: tuple[ModeChange, ...] = ()


@dataclass(frozen=True)
class WatchResult:
    """Learned limits, and the results of the recommended model's monitor on recordings and loops.

    Args:
        watch: Limits in the kit, by model, the recommended model last.
        kind: Kind of the monitor's readings.
        sources: Description of the data that limits were learned from, by kind.
        reason: Why there are no limits. Default: limits were learned.
        loops: Loops that limits were learned from. Default: none, limits were learned from recordings.
        channels: The channels. Default: none.
        recordings: The whole recordings with their alarms.
        clean: False alarms.
        by_channel: False alarms of each channel and of each frozen-sensor check.
        faults: Loops with a fault; None if none were run.
        faults_reason: Why no loops with a fault were run. Default: empty, they were run.
        shown: Names of the recordings whose traces are kept.
        wanted: The least wanted rate of false alarms [1/h].
        arrays: Traces, see :func:`read_trace`.
    """

    watch: Mapping[str, WatchFile]
    kind: str
    sources: Mapping[str, str] = field(default_factory=dict)
    reason: str = ""
    loops: tuple[NominalLoop, ...] = ()
    channels: tuple[Channel, ...] = ()
    recordings: tuple[WatchedRecording, ...] = ()
    clean: CleanAlarms | None = None
    by_channel: Mapping[str, CleanAlarms] = field(default_factory=dict)
    faults: tuple[FaultedLoop, ...] | None = None
    faults_reason: str = ""
    shown: tuple[str, ...] = ()
    wanted: float = RATES[0]
    arrays: Mapping[str, Array] = beside()

    @property
    def alarms(self) -> tuple[tuple[str, Alarm], ...]:
        """Alarms on whole recordings, behind the name of the recording."""
        return tuple((row.recording, alarm) for row in self.recordings for alarm in row.alarms)

    @property
    def limits(self) -> WatchLimits | None:
        """Limits of the monitor that watches the machine; None if none were learned."""
        own = list(self.watch.values())
        return own[-1].limits.get(self.kind) if own else None


@dataclass(frozen=True)
class Data:
    """Data that limits are learned from: records, a mask of the counted samples of each, description, hash."""

    records: Sequence[TrajectoryLike]
    masks: Sequence[NDArray[np.bool_]]
    source: str
    data_hash: str
    loops: tuple[NominalLoop, ...] = ()


def watch_stage(context: Context) -> WatchResult | Absent:
    """Learn limits with hybrid and prior, write them to the kit, and test those of the recommended model.

    If no limits can be learned for the readings of the machine, the result holds the reason.
    """
    scenario = context.scenario
    if scenario.control is None:
        return Absent(NO_PROBLEM)
    context.read(NOISE)
    kit, parts = context.kit, read_parts(context.out / "model")
    loops = _loop_data(context) if scenario.plant is not None and _calm(context) else None
    energy = reads_energy(kit.models["hybrid"])
    rest: tuple[float, ...] = ()
    reasons = []
    if energy:
        try:
            nominal = [t for t in context.dataset.trajectories if t.role in NOMINAL]
            rest = rest_speeds(nominal, kit.models["hybrid"])
        except InputError as short:
            reasons.append(f"no rest speeds: {short}")
    kinds = (ENERGY, RESIDUALS) if energy else (RESIDUALS,)
    kind, replayed = kinds[0], Replays(context, rest or kit.known_rest)
    loops = loops if energy else None
    recorded = kinds if loops is None else (RESIDUALS,)
    names = (*(name for name in ("hybrid", "prior") if name != kit.recommended), kit.recommended)
    held = _recorded(context, HELD).records
    replayed.all(
        *((name, (ENERGY,), loops.records) for name in names if loops is not None),
        *((name, recorded, held) for name in names[:-1]),
        (names[-1], kinds, context.dataset.whole),
    )
    watch: dict[str, WatchFile] = {}
    sources: dict[str, str] = {}
    for name in names:
        limits: dict[str, WatchLimits] = {}
        missing = list(reasons)
        for one in kinds:
            try:
                limits[one], sources[one] = _learned(
                    context, replayed, name, one, loops if one == ENERGY else None
                )
            except InputError as none:
                missing.append(f"limits of {one} could not be learned: {none} [HM-WORKFLOW-044]")
        watch[name] = WatchFile(limits, "; ".join(missing), rest, parts.observer(name))
    write_watch(context.out / "model", watch)
    kit = context.kit
    wanted = rates(scenario, kit.models[kit.recommended])[0]
    used = () if loops is None else loops.loops
    found = WatchResult(watch, kind, sources, loops=used, wanted=wanted)
    if found.limits is None:
        return replace(found, reason=watch[kit.recommended].reason)
    found = _on_recordings(context, kit, found, replayed.of(kit.recommended, kind, context.dataset.whole))
    if scenario.plant is None:
        return replace(found, faults_reason=f"scenario {scenario.name} has no plant to simulate faults with")
    if not _calm(context):
        return replace(found, faults_reason=f"scenario {scenario.name} has no task without faults")
    if kind not in watch["hybrid"].limits:
        return replace(found, faults_reason=watch["hybrid"].reason)
    return _faulted(context, kit, found)


def put_limits(context: Context, found: WatchResult) -> str:
    """Write ``watch/NAME.json`` of each model."""
    write_watch(context.out / "model", found.watch)
    return ""


def _calm(context: Context) -> bool:
    return any(not task.faults for task in context.scenario.tasks)


class Replays:
    """Traces of the models' monitors without limits, each computed once, in parallel processes.

    Args:
        context: The run.
        rest: Speeds below which friction may stick; None: unknown.
    """

    def __init__(self, context: Context, rest: tuple[float, ...] | None) -> None:
        self._context, self._rest = context, rest
        self._kit = context.kit
        self._traces: dict[tuple[str, str, int], Trace] = {}
        self._kept: list[TrajectoryLike] = []  # so that no id is used twice

    def all(self, *wanted: tuple[str, Sequence[str], Sequence[TrajectoryLike]]) -> None:
        """Compute the missing traces of ``(model, kinds, records)``; a kind that a model cannot read is left out."""
        folder = (self._context.out / "model").resolve()
        jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {}
        of: dict[str, tuple[str, int]] = {}
        for name, kinds, records in wanted:
            readable = [kind for kind in kinds if self._readable(name, kind)]
            for record in records:
                own = [kind for kind in readable if (name, kind, id(record)) not in self._traces]
                if own:
                    job = f"{name}, {getattr(record, 'name', len(jobs))}"
                    of[job] = name, id(record)
                    jobs[job] = traces_of, (folder, self._kit.loop, name, own, self._rest, record)
                    self._kept.append(record)
        found = run_jobs(
            jobs, self._context.progress.update, WORKERS, fresh=False, cluster=self._context.cluster
        )
        for job, (name, record_id) in of.items():
            self._traces |= {(name, kind, record_id): trace for kind, trace in found[job].items()}

    def of(self, name: str, kind: str, records: Sequence[TrajectoryLike]) -> list[Trace]:
        """Traces of a model's readings of a kind; InputError if the model has no such readings."""
        self.readings(name, kind)
        self.all((name, (kind,), records))
        return [self._traces[name, kind, id(record)] for record in records]

    def readings(self, name: str, kind: str) -> Readings:
        """The readings of a kind; InputError if the model has none, or no estimator."""
        self._kit.observer(name)
        return readings_of(self._kit, name, kind, self._rest)

    def _readable(self, name: str, kind: str) -> bool:
        try:
            self.readings(name, kind)
        except InputError:
            return False
        return True


def _learned(
    context: Context, replayed: Replays, name: str, kind: str, data: Data | None
) -> tuple[WatchLimits, str]:
    """Limits of a model's readings, and a description of the data that they were learned from.

    Without ``data``, held-out recordings are used if they suffice, else all undisturbed recordings.
    """
    readings, kit = replayed.readings(name, kind), context.kit
    resolution = sensor_steps(kit.sensor_sigma) if kind == ENERGY else None

    def from_data(data: Data) -> tuple[WatchLimits, str]:
        limits = limits_of(
            readings, [r.y for r in data.records], replayed.of(name, kind, data.records),
            false_alarms_per_hour=rates(context.scenario, kit.models[name]), nominal=data.masks,
            resolution=resolution, data_hash=data.data_hash,
        )  # fmt: skip
        return limits, data.source

    if data is not None:
        return from_data(data)
    try:
        found, source = from_data(_recorded(context, HELD))
        if found.rated:
            return found, source
    except InputError:
        pass  # held-out recordings are too short; with the training data they may suffice
    return from_data(_recorded(context, WITH_TRAINING))


def _recorded(context: Context, roles: tuple[str, ...]) -> Data:
    """Undisturbed parts of recordings with these roles; recordings without such a part are left out."""
    masks = {r.name: inside(context, r, roles) for r in context.dataset.whole}
    records = [r for r in context.dataset.whole if masks[r.name].any()]
    return Data(records, [masks[r.name] for r in records], LEARNED_FROM[roles], context.dataset.hash)


def _loop_data(context: Context) -> Data:
    """Fault-free loops of the simulated machine, similar to the loops to be monitored."""
    settings, model = context.settings, context.kit.models["hybrid"]
    wanted = nominal_loops(
        context.scenario, context.budget, model, named=settings.scenario, run_seed=settings.seed
    )
    found = run_or_read(context, {stage_of(spec): [spec] for spec in wanted})
    content, records, loops = hashlib.sha256(), [], []
    for spec in wanted:
        (row,) = found[stage_of(spec)]
        friction = spec.faults[0].value if spec.faults else 1.0
        loops.append(NominalLoop(row.task, row.seed, friction, row.seconds, row.cost))
        records.append(SimpleNamespace(name=f"loop {row.seed}", **row.arrays))
        for name in ("y", "u"):
            content.update(np.ascontiguousarray(row.arrays[name], dtype="<f8").tobytes())
    minutes = sum(row.seconds for row in loops) / 60
    source = f"{counted(len(loops), 'loop')} of the simulated machine under the hybrid MPC, {minutes:.1f} min"
    masks = [np.ones(len(r.t), dtype=bool) for r in records]
    return Data(records, masks, source, content.hexdigest(), tuple(loops))


def _on_recordings(context: Context, kit: Kit, found: WatchResult, replayed: Sequence[Trace]) -> WatchResult:
    """Monitor whole recordings by their traces: all alarms, false alarms, and traces for the figures."""
    whole, monitor, estimator = context.dataset.whole, kit.monitor(), kit.observer()
    made: list[Diagnoser] = []

    def diagnoser() -> Diagnoser:
        made.extend([] if made else [kit.diagnoser()])
        return made[0]

    traces, rows = [], []
    for recording, plain in zip(whole, replayed, strict=True):
        trace, own = with_alarms(monitor, plain), tuple[Alarm, ...]()
        if trace.alarm.any():  # a diagnosis needs the estimates
            trace, own = explained(monitor, estimator, recording, diagnoser)
        traces.append(trace)
        seconds = len(recording.t) * recording.dt
        rows.append(WatchedRecording(recording.name, seconds, **trace.coverage(recording.dt), alarms=own))
    every = [np.hstack([t.on, t.frozen]) for t in traces]
    names = traces[0].names if traces else ()
    each = {name: clean_alarms(context, whole, [on[:, i] for on in every]) for i, name in enumerate(names)}
    alarmed, tested = (
        {row.recording for row in rows if row.alarms},
        {t.file for t in context.trajectories("test")},
    )
    ranked = sorted(
        zip(whole, traces, strict=True),
        key=lambda pair: (pair[0].name not in alarmed, pair[0].file not in tested),
    )[:SHOWN_RECORDINGS]
    arrays: dict[str, Array] = {}
    for recording, trace in ranked:
        arrays |= trace_arrays(recording.name, trace, recording.y)
    return replace(
        found, channels=monitor.readings.channels, recordings=tuple(rows), by_channel=each, arrays=arrays,
        clean=clean_alarms(context, whole, [t.alarm for t in traces]), shown=tuple(r.name for r, _ in ranked),
    )  # fmt: skip


def _faulted(context: Context, kit: Kit, found: WatchResult) -> WatchResult:
    """A loop for each fault, which begins in the middle of a fault-free task.

    If the scenario declares a safe input, a guard switches to it when a sensor freezes.
    """
    scenario, settings = context.scenario, context.settings
    model, task, folder = kit.models["hybrid"], nominal_tasks(scenario)[0], (context.out / "model").resolve()
    start = model.dt * round(0.5 * task.duration / model.dt)
    guard = "rest" if scenario.safe_input is not None else ""
    base = LoopSpec(
        settings.scenario, MODEL, task.name, CONTROLLER, monitor="guard", guard=guard, seed=FAULT_SEED,
        run_seed=settings.seed,
    )  # fmt: skip
    tried = broken(scenario, model, kit.problem(task.name), start)
    jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        case.name: (
            faulted, (context.scenario_path, folder, replace(base, faults=(case.fault,)), start)
        ) for case in tried
    }  # fmt: skip
    ran = run_jobs(jobs, context.progress.update, WORKERS, fresh=False, cluster=context.cluster)
    loops, arrays = [], dict(found.arrays)
    for case in tried:
        one: Faulted = ran[case.name]
        loops.append(
            FaultedLoop(
                case.name, case.title, task.name, start, one.delay_s, one.channels, one.diagnosis,
                one.false_alarms, one.switches,
            )
        )  # fmt: skip
        arrays |= trace_arrays(case.name, one.trace, one.y)
    return replace(found, faults=tuple(loops), arrays=arrays)


def trace_arrays(name: str, trace: Trace, y: Array) -> dict[str, Array]:
    """A trace's arrays and the outputs ``y`` ``(n, n_y)`` under a name, for the checkpoint."""
    return {f"{name}/{key}": np.asarray(getattr(trace, key)) for key in KEPT} | {f"{name}/y": y}


def read_trace(arrays: Mapping[str, Any], name: str, found: WatchResult, outputs: Sequence[str]) -> Trace:
    """The trace that :func:`trace_arrays` kept; fields that the report does not show are empty."""
    own, none = {key: arrays[f"{name}/{key}"] for key in KEPT}, np.zeros((0, 0))
    return Trace(
        channels=found.channels,
        outputs=tuple(outputs),
        terms=none,
        travel=none,
        repeats=none.astype(int),
        inside=none > 0,
        settled=none > 0,
        validity=none.astype(int),
        blind=none > 0,
        **own,
    )


def clean_alarms(
    context: Context, recordings: Sequence[Trajectory], on: Sequence[NDArray[np.bool_]]
) -> CleanAlarms:
    """False alarms: alarms ``on`` ``(n,)`` that begin in undisturbed parts of the recordings, whatever their role.

    An alarm that began in a disturbed part and lasts into an undisturbed part does not count.
    """
    seconds, counts = [0.0, 0.0], [0, 0]
    for recording, alarm in zip(recordings, on, strict=True):
        starts, _ = stretches(alarm)
        for i, roles in enumerate(((*NOMINAL, "test"), ("test",))):
            clean = inside(context, recording, roles)
            seconds[i] += float(clean.sum() * recording.dt)
            counts[i] += int(clean[starts].sum())
    return CleanAlarms(seconds[0], counts[0], seconds[1], counts[1])


def clean_windows(
    context: Context, recording: Trajectory, roles: tuple[str, ...]
) -> list[tuple[float, float]]:
    """Intervals ``(start, end)`` [s] of a recording with one of these roles, all of them undisturbed."""
    stem = recording.file
    if stem in context.spec.windows:
        return [(w.start, w.end) for w in context.spec.windows[stem] if w.role in roles]
    pieces = [t for t in context.dataset.trajectories if t.file == stem and t.role in roles]
    return [(float(t.t[0]), float(t.t[-1])) for t in pieces]


def inside(context: Context, recording: Trajectory, roles: tuple[str, ...]) -> NDArray[np.bool_]:
    """Mask ``(n,)`` of the samples of a recording within the intervals of these roles."""
    found = np.zeros(len(recording.t), dtype=bool)
    for start, end in clean_windows(context, recording, roles):
        found |= (recording.t >= start) & (recording.t <= end)
    return found


WATCH = Stage(
    "watch", "learning the monitor's limits", WatchResult, watch_stage,
    lambda context: {
        **what_loops_read(context), "causes": context.scenario.causes,
        "wanted rates of false alarms": context.scenario.false_alarms_per_hour,
    },
    (DATA, EXPORT, NOISE),
    optional=True, restore=put_limits,
)  # fmt: skip
