"""Stage guard: the detector of the energy guard, learned, kept in the artifact, and tried out."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from hybrid_mpc.errors import InputError
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.loops import MODEL, Bench, LoopSpec, ModeChange
from hybrid_mpc.job.monitor import begun, explained
from hybrid_mpc.job.stage import Absent, Stage
from hybrid_mpc.job.stages.compare import run_or_read, what_loops_read
from hybrid_mpc.job.stages.export import EXPORT, NOISE
from hybrid_mpc.job.stages.identify import DATA
from hybrid_mpc.job.stages.monitor import (
    FAULT_SEED,
    HELD,
    LEARNED_FROM,
    MONITOR,
    NO_ENERGY,
    RATES,
    WITH_TRAINING,
    RecordedAlarm,
    clean_windows,
)
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import energy_is_watched
from hybrid_mpc.kit.parts import GuardLimits, read_parts, write_guard
from hybrid_mpc.loop.faults import Fault, install
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.calibrate import MAX_EXTRAPOLATION, MIN_BLOCKS, Calibration, stretches
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.energy import EnergyMonitor
from hybrid_mpc.monitor.learn import DRIFT, guard_monitor, learn_detector
from hybrid_mpc.monitor.lengths import BLOCK_S, NOTHING_STICKS, SETTLING_S, block_seconds, samples, seconds
from hybrid_mpc.monitor.replay import MonitorTrace, along, replay
from hybrid_mpc.scenario import Budget, Scenario, Task

# Nominal loops that the energy guard is learned from: the tasks, over and over, under the hybrid MPC.

CONTROLLER = "hybrid_observer"
"""The controller that the guard is for."""
BLOCKS = 9
"""Whole blocks (of five of the machine's seconds) in a loop. Four such loops suffice for a threshold of two false
alarms an hour, eight for one."""
FEWEST, MOST = 4, 16
"""Loops: one for each seed of the budget, within these."""
FIRST_SEED = 500
"""Their numbers begin here, away from those of the compared loops."""
SMALLEST = 0.6
"""Every time round, the reference is scaled by a factor drawn from here to 1: no two rounds are alike."""
AGEING, DRIFT_S = (1.0, 1.1, 0.9), 30.0
"""Where the plant knows it, friction drifts to these shares, in turn, within so many of the machine's seconds:
ageing, of which the guard is to say nothing."""


def nominal_tasks(scenario: Scenario) -> list[Task]:
    """Tracking tasks in which nothing goes wrong; if there are none, other tasks without faults.

    Raises:
        InputError: If something goes wrong in every task.
    """
    calm = [task for task in scenario.tasks if not task.faults]
    tasks = [task for task in calm if task.weight is None] or calm
    if not tasks:
        raise InputError(
            f"scenario {scenario.name}: every task brings a fault; the guard is learned from one without"
        )
    return tasks


def nominal_loops(
    scenario: Scenario, budget: Budget, model: HybridModel, *, named: str = "", run_seed: int = 0
) -> list[LoopSpec]:
    """The loops of a budget: calm tasks in turn, each round of them scaled by its own share.

    Raises:
        InputError: If something goes wrong in every task.

    Example:
        >>> from types import SimpleNamespace
        >>> from hybrid_mpc.scenario import load_scenario
        >>> golf, model = load_scenario("golf_robot"), SimpleNamespace(dt=0.02, time_unit=1.0)
        >>> loops = nominal_loops(golf, golf.budgets["quick"], model)
        >>> [(loop.task, [fault.value for fault in loop.faults]) for loop in loops]  # doctest: +NORMALIZE_WHITESPACE
        [('track_sine', []), ('track_step', [1.1]), ('track_sine', [0.9]), ('track_step', []), ('track_sine', [1.1]),
         ('track_step', [0.9])]
    """
    tasks, unit = nominal_tasks(scenario), model.time_unit
    ages = AGEING if knows(scenario, "plant_friction") else AGEING[:1]
    blocks = BLOCKS * max(round(block_seconds(model.dt, unit) / model.dt), 1)
    seconds, found = (samples(SETTLING_S, model) + blocks) * model.dt, []
    for i in range(min(max(budget.seeds, FEWEST), MOST)):
        task, friction, seed = tasks[i % len(tasks)], ages[i % len(ages)], FIRST_SEED + i
        drift = Fault(0.0, math.inf, "plant_friction", friction, ramp=DRIFT_S * unit)
        shares = np.random.default_rng([run_seed, seed]).uniform(
            SMALLEST, 1.0, math.ceil(seconds / task.duration)
        )
        found.append(
            LoopSpec(
                named or scenario.name, MODEL, task.name, CONTROLLER, monitor="readings", seed=seed, duration=seconds,
                faults=() if friction == 1.0 else (drift,), run_seed=run_seed, rounds=tuple(shares.tolist()),
                keep=("numbers", "y", "u"),
            )
        )  # fmt: skip
    return found


def stage_of(spec: LoopSpec) -> str:
    """Name of a nominal loop's file in ``checkpoints``."""
    return f"guard/{spec.task}-{spec.seed}"


def knows(scenario: Scenario, target: str) -> bool:
    """Whether the scenario's plant can show a fault of its own."""
    if scenario.plant is None:
        return False
    try:
        install(scenario.plant(), (Fault(0.0, 1.0, target, 1.0),))
    except InputError:
        return False
    return True


# Loops in which something breaks, watched by the learned guard: how soon it is seen, and what it is taken for.

Array = NDArray[np.float64]
SHOWN = ("t", "violation_w", "level_w", "residual_level", "energy_j", "energy_s", "frozen", "scores", "alarm")
"""What of a trace is kept for the report."""


@dataclass(frozen=True)
class Case:
    """What breaks in a loop: a short name, the same in words, the fault's target and its size."""

    name: str
    title: str
    target: str
    value: float = 0.0


FRICTION = Case("friction", "friction doubles", "plant_friction", 2.0)
DRIVE = Case("drive", "the drive loses a fifth of its force", "input_gain", 0.8)
FREEZE = Case("freeze", "the sensor freezes", "measurement_freeze")


def cases(scenario: Scenario) -> tuple[Case, ...]:
    """What is tried: friction twice as large, or a weaker drive where the plant knows no friction; a frozen sensor.

    Example:
        >>> from hybrid_mpc.scenario import load_scenario
        >>> [case.name for case in cases(load_scenario("golf_robot"))]
        ['friction', 'freeze']
    """
    return FRICTION if knows(scenario, FRICTION.target) else DRIVE, FREEZE


@dataclass(frozen=True)
class FaultedLoop:
    """A loop in which something breaks, watched by the learned guard.

    Args:
        fault: Short name of what breaks.
        title: In words.
        target: Of the fault.
        value: Its size.
        task: Name of the task.
        start_s: When it breaks [s].
        delay_s: Time to the first alarm that begins from then on [s]; None: never.
        diagnosis: What the diagnosis takes it for; empty where it says nothing.
        false_alarms: Alarms before it breaks.
        switches: Changes of the guard's mode.
    """

    fault: str
    title: str
    target: str
    value: float
    task: str
    start_s: float
    delay_s: float | None
    diagnosis: str
    false_alarms: int
    switches: tuple[ModeChange, ...] = ()


def faulted(
    bench: Bench, named: str, run_seed: int, causes: Mapping[str, tuple[str, ...]]
) -> tuple[tuple[FaultedLoop, ...], dict[str, Array]]:
    """A loop of each case on the first tracking task, in which something breaks from the middle on."""
    scenario, kit = bench.scenario, bench.kits[MODEL]
    dt = kit.models["hybrid"].dt
    task = nominal_tasks(scenario)[0]
    start = dt * round(0.5 * task.duration / dt)
    monitor = kit.monitor("hybrid", kind="guard", task=task.name, diagnose=True)
    assert isinstance(monitor, EnergyMonitor)
    loops: list[FaultedLoop] = []
    arrays: dict[str, Array] = {}
    for case in cases(scenario):
        hybrid = kit.models["hybrid"]
        signals = hybrid.inputs if case.target.startswith("input_") else hybrid.outputs
        channel = "" if case.target.startswith("plant_") else signals[0].name
        title = f"{case.title} ({channel})" if channel and len(signals) > 1 else case.title
        fault = Fault(start, math.inf, case.target, case.value, channel)
        spec = LoopSpec(
            named, MODEL, task.name, CONTROLLER, monitor="guard", guard="rest", seed=FAULT_SEED, run_seed=run_seed,
            faults=(fault,),
        )  # fmt: skip
        row, result = bench.run(spec, monitor=monitor)
        # The estimator is deterministic: over the record it says again what it said in the loop.
        trace, alarms = explained(monitor, bench.parts(spec)[0], result, causes, prior=kit.models["prior"])
        before, seen = begun(alarms, start)
        loops.append(
            FaultedLoop(
                case.name, title, case.target, case.value, task.name, start,
                seen[0].start_s - start if seen else None,
                seen[0].diagnosis if seen else "",
                len(before),
                tuple(row.switches),
            )
        )  # fmt: skip
        arrays |= trace_arrays(case.name, trace, result.y)
    return tuple(loops), arrays


def trace_arrays(name: str, trace: MonitorTrace, y: Array) -> dict[str, Array]:
    """A trace's arrays and the first output of ``y`` ``(n, n_y)`` under a name, for the checkpoint.

    Example:
        >>> z = np.zeros(2)
        >>> trace = MonitorTrace(z, z, z, z, z, z, z > 0)
        >>> read_trace(trace_arrays("a", trace, np.zeros((2, 1))), "a").alarm.tolist()
        [False, False]
    """
    return {f"{name}/{key}": np.asarray(getattr(trace, key)) for key in SHOWN} | {f"{name}/y": y}


def read_trace(arrays: Mapping[str, Any], name: str) -> MonitorTrace:
    """The trace that :func:`trace_arrays` made; the balances, which the report does not show, are NaN."""
    own = {key: arrays[f"{name}/{key}"] for key in SHOWN}
    none = np.full(len(own["t"]), np.nan)
    return MonitorTrace(dE_model_w=none, dE_measured_w=none, **own)


@dataclass(frozen=True)
class NominalLoop:
    """A loop that the detector was learned from: its task and number, the share to which friction drifts, its length
    [s] and its cost.
    """

    task: str
    seed: int
    friction: float
    seconds: float
    cost: float


@dataclass(frozen=True)
class NominalData:
    """What the detector is learned from.

    Args:
        runs: Reading numbers, each ``(n, columns)``.
        source: Where they come from, in words.
        data_hash: Hash of the data.
        loops: What was run for it. Default: nothing.
    """

    runs: Sequence[Array]
    source: str
    data_hash: str
    loops: tuple[NominalLoop, ...] = ()


@dataclass(frozen=True)
class ExplainedAlarm(RecordedAlarm):
    """An alarm on a recording with test data, and what the diagnosis takes it for."""

    diagnosis: str


@dataclass(frozen=True)
class GuardTest:
    """The guard's monitor on test recordings.

    Args:
        seconds: Time that was monitored [s].
        alarms: Alarms that begin in it.
        list: Alarms over the recordings that hold test data, all of each.
        at_most_per_hour: Rate [1/h] that the alarms stay below, at 95 %; None where nothing was monitored.
    """

    seconds: float
    alarms: int
    list: tuple[ExplainedAlarm, ...]
    at_most_per_hour: float | None = None


@dataclass(frozen=True)
class GuardResult:
    """The learned guard, and what it says of recordings and of loops in which something breaks.

    Args:
        source: What it was learned from, in words.
        loops: Loops that it was learned from; none for recordings.
        test: What it says of test recordings.
        detector: The detector; None where none could be learned.
        reason: Why none. Default: there is one.
        faults: Loops in which something breaks; None without a plant or without a calm task.
        shown: Name of the recording whose trace is kept; empty for none.
        arrays: Traces, see :func:`read_trace`.
        of: Digest of the observer that it was learned with.
    """

    source: str
    loops: tuple[NominalLoop, ...]
    test: GuardTest
    detector: Detector | None = None
    reason: str = ""
    faults: tuple[FaultedLoop, ...] | None = None
    shown: str = ""
    arrays: Mapping[str, Array] = field(default_factory=dict)
    of: str = ""


def guard_stage(context: Context) -> GuardResult | Absent:
    """Learn the detector, put it into the artifact, and try it on faults and test recordings."""
    scenario = context.scenario
    if scenario.control is None:
        return Absent(
            "the guard's estimator needs the scenario's control problem (input range, sensor noise)"
        )
    context.read(NOISE)
    kit = context.kit
    model, monitor = kit.models["hybrid"], context.find(MONITOR)
    if not energy_is_watched(model):
        return Absent(NO_ENERGY.format(scenario=scenario.name))
    calibration = Calibration.without(monitor.reason) if isinstance(monitor, Absent) else monitor.calibration
    rest = calibration.rest_speed or kit.known_rest or (NOTHING_STICKS,)
    data = _nominal_data(context, kit, rest)
    detector, reason, faults = None, "", None
    try:
        detector = learned(
            data.runs, model.dt, model.n_y, data.data_hash, rest_speed=rest,
            time_unit=model.time_unit,
        )  # fmt: skip
    except InputError as none:
        reason = f"no detector could be learned from {data.source}: {none}"
    folder = context.out / "model"
    of = read_parts(folder).observer("hybrid")
    write_guard(folder, GuardLimits(detector, reason, of))
    kit = context.kit
    test, shown, arrays = _recorded(context, kit, detector)
    if detector is not None and scenario.plant is not None and any(not t.faults for t in scenario.tasks):
        context.progress.update("faults", 0, 1, "loops in which something breaks")
        bench, s = Bench(scenario, {MODEL: kit}), context.settings
        faults, more = faulted(bench, s.scenario, s.seed, scenario.causes)
        arrays |= more
    return GuardResult(data.source, data.loops, test, detector, reason, faults, shown, arrays, of)


def put_detector(context: Context, found: GuardResult) -> str:
    """Write ``guard.json``."""
    write_guard(context.out / "model", GuardLimits(found.detector, found.reason, found.of))
    return ""


def learned(
    runs: Sequence[Array],
    dt: float,
    n_q: int,
    data_hash: str,
    *,
    rest_speed: ArrayLike = NOTHING_STICKS,
    time_unit: float = 1.0,
) -> Detector:
    """The detector for the lowest of the rates 1, 2, 5 and 10 an hour that the data are long enough for.

    Of a machine with another second (:func:`~hybrid_mpc.data.scales.time_unit`) they are 1, 2, 5 and 10 in 3600 of
    these.

    Raises:
        InputError: If they are too short for any of them (it says how much is needed), or hold an alarm.

    Example:
        >>> learned([np.zeros((3000, 11))], 0.02, 1, "")
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: 1.0 min in whole blocks of 5 s are too little: 10 false alarms an hour need ...
    """
    block_s = block_seconds(dt, time_unit)
    blocks = _whole_blocks(runs, block_s, dt)
    for rate in RATES:
        if blocks >= blocks_needed(rate):
            return learn_detector(
                runs, dt, n_q, drift=DRIFT, false_alarms_per_hour=rate / time_unit, rest_speed=rest_speed,
                data_hash=data_hash, time_unit=time_unit,
            )  # fmt: skip
    least, most = (blocks_needed(rate) * block_s / 60 for rate in (RATES[-1], RATES[0]))
    raise InputError(
        f"{blocks * block_s / 60:.1f} min in whole blocks of {block_s:g} s are too little: {RATES[-1] / time_unit:g} "
        f"false alarms an hour need {least:g} min, {RATES[0] / time_unit:g} an hour {most:g} min; record the machine "
        "for longer and learn with hybrid-mpc monitor MODEL NOMINAL.csv --learn RATE"
    )


def blocks_needed(rate: float) -> int:
    """Blocks that a rate of false alarms needs, half of it for either of the detector's two alarms.

    Example:
        >>> [blocks_needed(rate) for rate in (1.0, 2.0, 10.0)]
        [72, 36, 30]
    """
    return max(MIN_BLOCKS, int(np.ceil(3600.0 / (0.5 * rate * BLOCK_S * MAX_EXTRAPOLATION) - 1e-9)))


def _whole_blocks(runs: Sequence[Array], block_s: float, dt: float) -> int:
    """Whole blocks of ``block_s`` [s] in all runs."""
    size = max(round(block_s / dt), 1)
    return sum(len(run) // size for run in runs)


def _nominal_data(context: Context, kit: Kit, rest: tuple[float, ...]) -> NominalData:
    """Loops of the simulated machine, like those that the guard will watch; else undisturbed recordings."""
    scenario, model = context.scenario, kit.models["hybrid"]
    if scenario.plant is not None and any(not task.faults for task in scenario.tasks):
        return _from_loops(context, model)
    monitor, estimator = guard_monitor(model, rest_speed=rest), kit.observer("hybrid")
    whole = context.dataset.whole
    numbers = [
        replay(monitor, estimator, recording, on_progress=say).numbers
        for recording, say in along(whole, context.progress.update)
    ]

    def inside(roles: tuple[str, ...]) -> list[Array]:
        return [
            rows[_settled(recording.t, start, end, model)]
            for recording, rows in zip(whole, numbers, strict=True)
            for start, end in clean_windows(context, recording, roles)
        ]

    roles, block_s = HELD, block_seconds(model.dt, model.time_unit)
    runs = inside(roles)
    if _whole_blocks(runs, block_s, model.dt) < blocks_needed(RATES[-1]):
        roles = WITH_TRAINING
        runs = inside(roles)
    return NominalData(runs, LEARNED_FROM[roles], context.dataset.hash)


def _settled(t: Array, start: float, end: float, model: HybridModel) -> NDArray[np.bool_]:
    """The samples of a stretch whose readings hold nothing from before it."""
    return np.asarray((t >= start + seconds(SETTLING_S, model)) & (t <= end))


def _from_loops(context: Context, model: HybridModel) -> NominalData:
    settings = context.settings
    wanted = nominal_loops(
        context.scenario, context.budget, model, named=settings.scenario, run_seed=settings.seed
    )
    found = run_or_read(context, {stage_of(spec): [spec] for spec in wanted})
    content, runs = hashlib.sha256(), []
    loops: list[NominalLoop] = []
    for spec in wanted:
        (row,) = found[stage_of(spec)]
        friction = spec.faults[0].value if spec.faults else 1.0
        loops.append(NominalLoop(row.task, row.seed, friction, row.seconds, row.cost))
        runs.append(row.arrays["numbers"][samples(SETTLING_S, model) :])
        for name in ("y", "u"):
            content.update(np.ascontiguousarray(row.arrays[name], dtype="<f8").tobytes())
    minutes = sum(row.seconds for row in loops) / 60
    source = f"{len(loops)} loops of the simulated machine under the hybrid MPC, {minutes:.1f} min"
    return NominalData(runs, source, content.hexdigest(), tuple(loops))


def _recorded(
    context: Context, kit: Kit, detector: Detector | None
) -> tuple[GuardTest, str, dict[str, Array]]:
    """Recordings with test windows, watched by the guard's monitor, or without detector by that of the thresholds.

    Without either the readings are kept and nothing but a blind monitor alarms.
    """
    model = kit.models["hybrid"]
    thresholds = kit.calibration is not None and kit.calibration.threshold_w is not None
    kind = "guard" if detector is not None else "energy" if thresholds else "own"
    monitor = kit.monitor("hybrid", kind=kind, diagnose=True)
    assert isinstance(monitor, EnergyMonitor)
    estimator = kit.observer("hybrid")
    tested = [r for r in context.dataset.whole if clean_windows(context, r, ("test",))]
    found: list[ExplainedAlarm] = []
    arrays: dict[str, Array] = {}
    watched, starts, shown = 0.0, 0, ""
    for recording, say in along(tested, context.progress.update):
        trace, alarms = explained(
            monitor, estimator, recording, context.scenario.causes, say, prior=kit.models["prior"]
        )
        found += [ExplainedAlarm(recording.name, a.start_s, a.end_s, a.diagnosis) for a in alarms]
        begins, _ = stretches(trace.alarm)
        for window in clean_windows(context, recording, ("test",)):
            inside = _settled(recording.t, *window, model)
            watched += float(inside.sum() * model.dt)
            starts += int(inside[begins].sum())
        if not arrays or (alarms and not arrays["recorded/alarm"].any()):  # one is shown, best with an alarm
            arrays = trace_arrays("recorded", trace, recording.y)
            shown = recording.name
    most = 0.5 * float(chi2.ppf(0.95, 2 * starts + 2)) / (watched / 3600) if watched > 0 else None
    return GuardTest(watched, starts, tuple(found), most), shown, arrays


GUARD = Stage(
    "guard", "learning the energy guard", GuardResult, guard_stage,
    lambda context: {**what_loops_read(context), "causes": context.scenario.causes}, (DATA, EXPORT, NOISE, MONITOR),
    optional=True, restore=put_detector,
)  # fmt: skip
