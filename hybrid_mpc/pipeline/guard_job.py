"""Stage guard: detector and plausibility of the energy guard, learned, kept in the artifact, and tried out."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from hybrid_mpc.artifact import Kit, set_calibration
from hybrid_mpc.errors import InputError
from hybrid_mpc.job.loops import MODEL, Bench
from hybrid_mpc.model import HybridModel
from hybrid_mpc.monitor import Detector, guard_monitor, learn_detector, learn_plausibility
from hybrid_mpc.monitor.calibration import MAX_EXTRAPOLATION, MIN_BLOCKS
from hybrid_mpc.monitor.lengths import BLOCK_S, SETTLING_S, block_seconds, samples, seconds
from hybrid_mpc.monitor.replay import along, replay
from hybrid_mpc.monitor.rest import REST_SPEED
from hybrid_mpc.monitor.standard import DRIFT
from hybrid_mpc.pipeline.contest import is_kept, run_parts
from hybrid_mpc.pipeline.contest import kept as rows_of
from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.faulted_loops import faulted, kept
from hybrid_mpc.pipeline.judge import RATES, clean_windows, run_calibration
from hybrid_mpc.pipeline.monitor_job import explained
from hybrid_mpc.pipeline.nominal_loops import nominal_loops, stage_of
from hybrid_mpc.records import plain

Array = NDArray[np.float64]
HELD = ("valid", "nominal")
"""Roles that no parameter was fitted to. Test recordings are kept to try the detector on."""


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
    loops: tuple[dict[str, Any], ...] = field(default=())


def guard_stage(context: Context) -> None:
    """Learn detector and plausibility, put them into the artifact, and try them on faults and test recordings."""
    scenario, folder = context.scenario, context.out / "model"
    if scenario.control is None:
        reason = "the guard's estimator needs the scenario's control problem (input range, sensor noise)"
        context.save("guard", {"reason": reason}, {})
        return
    kit = context.kit
    model, calibration = kit.models["hybrid"], run_calibration(context)
    rest = calibration.rest_speed or (REST_SPEED,)
    data = _nominal_data(context, kit, rest)
    result: dict[str, Any] = {"source": data.source, "loops": data.loops}
    found: dict[str, Any] = {}
    try:
        found["detector"] = learned(
            data.runs, model.dt, model.n_y, data.data_hash, rest_speed=rest,
            time_unit=model.time_unit,
        )  # fmt: skip
    except InputError as none:
        result["reason"] = f"no detector could be learned from {data.source}: {none}"
    try:
        found["plausibility"] = learn_plausibility(
            model, context.smoothed("train"), data_hash=context.dataset.hash
        )
    except InputError as none:
        result["plausibility_reason"] = str(none)
    set_calibration(folder, replace(calibration, **found))
    result |= {name: plain(part) for name, part in found.items()}
    kit, detector = context.kit, found.get("detector")
    recorded, arrays = _recorded(context, kit, detector)
    result |= recorded
    if detector is not None and scenario.plant is not None and any(not t.faults for t in scenario.tasks):
        context.progress.update("faults", 0, 1, "loops in which something breaks")
        bench, s = Bench(scenario, {MODEL: kit}), context.settings
        result["faults"], more = faulted(bench, s.scenario, s.seed, scenario.causes)
        arrays |= more
    context.save("guard", result, arrays)


def learned(
    runs: Sequence[Array],
    dt: float,
    n_q: int,
    data_hash: str,
    *,
    rest_speed: ArrayLike = REST_SPEED,
    time_unit: float = 1.0,
) -> Detector:
    """The detector for the lowest of the rates 1, 2, 5 and 10 an hour that the data are long enough for.

    Of a machine with another second (:func:`~hybrid_mpc.data.time_unit`) they are 1, 2, 5 and 10 in 3600 of these.

    Args:
        runs: Reading numbers of nominal runs, each ``(n, columns)``.
        dt: Period [s].
        n_q: Degrees of freedom.
        data_hash: Hash of the data.
        rest_speed: That of the monitor which made the numbers. Default 0.2, as the monitor's.
        time_unit: The machine's second [s], the model's. Default 1.

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

    Args:
        rate: Wanted false alarms in 3600 of the machine's seconds, of which a block has five.

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
    monitor, estimator = guard_monitor(model, rest_speed=rest), kit.observer()
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

    runs, block_s = inside(HELD), block_seconds(model.dt, model.time_unit)
    source = "recordings that nothing was trained on"
    if _whole_blocks(runs, block_s, model.dt) < blocks_needed(RATES[-1]):
        runs = inside((*HELD, "train"))
        source = (
            "undisturbed recordings, also those of the training, which the model fits better than new ones"
        )
    return NominalData(runs, source, context.dataset.hash)


def _settled(t: Array, start: float, end: float, model: HybridModel) -> NDArray[np.bool_]:
    """The samples of a stretch whose readings hold nothing from before it."""
    return np.asarray((t >= start + seconds(SETTLING_S, model)) & (t <= end))


def _from_loops(context: Context, model: HybridModel) -> NominalData:
    settings = context.settings
    wanted = nominal_loops(
        context.scenario, context.budget, model, named=settings.scenario, run_seed=settings.seed
    )
    parts = {stage_of(spec): [spec] for spec in wanted}
    run_parts(context, {stage: part for stage, part in parts.items() if not is_kept(context, stage, part)})
    content, runs = hashlib.sha256(), []
    told: list[dict[str, Any]] = []
    for spec in wanted:
        (row,) = rows_of(context, stage_of(spec))
        friction = spec.faults[0].value if spec.faults else 1.0
        told.append(
            {
                "task": row.task,
                "seed": row.seed,
                "friction": friction,
                "seconds": row.seconds,
                "cost": row.cost,
            }
        )
        runs.append(row.arrays["numbers"][samples(SETTLING_S, model) :])
        for name in ("y", "u"):
            content.update(np.ascontiguousarray(row.arrays[name], dtype="<f8").tobytes())
    minutes = sum(row["seconds"] for row in told) / 60
    source = f"{len(told)} loops of the simulated machine under the hybrid MPC, {minutes:.1f} min"
    return NominalData(runs, source, content.hexdigest(), tuple(told))


def _recorded(
    context: Context, kit: Kit, detector: Detector | None
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Recordings with test windows, watched by the guard's monitor, or without detector by that of the thresholds.

    Without either the readings are kept and nothing but a blind monitor alarms.
    """
    model = kit.models["hybrid"]
    monitor = kit.monitor(kind="energy" if detector is None else "guard", diagnose=True)
    estimator = kit.observer()
    tested = [r for r in context.dataset.whole if clean_windows(context, r, ("test",))]
    found: list[dict[str, Any]] = []
    arrays: dict[str, Array] = {}
    watched, starts = 0.0, 0
    for recording, say in along(tested, context.progress.update):
        trace, alarms = explained(
            monitor, estimator, recording, context.scenario.causes, say, prior=kit.models["prior"]
        )
        found += [{"file": recording.name, **alarm} for alarm in alarms]
        edges = np.diff(trace.alarm.astype(int), prepend=0) == 1
        for window in clean_windows(context, recording, ("test",)):
            inside = _settled(recording.t, *window, model)
            watched += float(inside.sum() * model.dt)
            starts += int((edges & inside).sum())
        if not arrays or (alarms and not arrays["recorded/alarm"].any()):  # one is shown, best with an alarm
            arrays = kept("recorded", trace, recording.y)
            shown = recording.name
    result: dict[str, Any] = {"test": {"seconds": watched, "alarms": starts, "list": found}}
    if watched > 0:
        result["test"]["at_most_per_hour"] = 0.5 * float(chi2.ppf(0.95, 2 * starts + 2)) / (watched / 3600)
    if arrays:
        result["shown"] = shown
    return result, arrays
