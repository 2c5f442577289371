"""Stages monitor and analysis: online plausibility on recordings, and the linearized models."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.loops import MODEL, Bench, LoopSpec
from hybrid_mpc.kit.artifact import Kit, set_calibration
from hybrid_mpc.kit.assembly import make_monitor, working_point
from hybrid_mpc.loop.faults import Fault
from hybrid_mpc.loop.simulate import ClosedLoopResult
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.riccati import hidden_fixed_point
from hybrid_mpc.monitor.calibrate import Calibration, alarm_intervals, calibrate, with_residual
from hybrid_mpc.monitor.lengths import block_seconds, rest_speeds
from hybrid_mpc.monitor.replay import along, replay, with_alarms
from hybrid_mpc.records import plain, record

if TYPE_CHECKING:
    from hybrid_mpc.data.trajectories import Trajectory

Array = NDArray[np.float64]
RATES = (1.0, 2.0, 5.0, 10.0)
"""False alarms an hour (of the machine's seconds, see :func:`rates`) on nominal data: the first that the data are long
enough for."""
NOMINAL = ("train", "valid", "nominal")
"""Roles of what the monitor is calibrated on."""
LOAD_SHARE = 0.2
"""Unknown load of the demonstration, as a share of half the input's range."""
MARGIN = 1.5
"""Where nominal data are too short for a rate: threshold over the highest nominal level."""


def rates(model: HybridModel) -> tuple[float, ...]:
    """The rates of ``RATES`` on the machine of a model [1/h].

    Example:
        >>> from types import SimpleNamespace
        >>> rates(SimpleNamespace(time_unit=10.0))
        (0.1, 0.2, 0.5, 1.0)
    """
    return tuple(rate / model.time_unit for rate in RATES)


def monitor_stage(context: Context) -> None:
    """Calibrate on training and validation stretches, then replay the monitor over whole recordings.

    Where nothing can be calibrated the result holds the reason and no calibration; the artifact then keeps the rest
    speeds alone.
    """
    if context.scenario.control is None:
        reason = "the monitor's estimator needs the scenario's control problem (input range, sensor noise)"
        context.save("monitor", {"reason": reason}, {})
        return
    kit = context.kit
    model = kit.models["hybrid"]
    whole = context.dataset.whole
    known: dict[str, Any] = {}  # the rest speeds, and what hinders the calibration
    try:
        known["rest_speed"] = nominal_rest(context, model)
    except InputError as short:
        known["reason"] = f"the monitor could not be calibrated: {short}"
    rest = known.get("rest_speed")
    power, residual, traces = [], [], []
    # the estimator of the closed loops; the monitor ignores its disturbance estimate
    watching, estimator = make_monitor(model, None, rest_speed=rest), kit.observer()
    for recording, say in along(whole, context.progress.update):
        trace = replay(watching, estimator, recording, on_progress=say)
        traces.append(trace)
        nominal = _inside(context, recording, NOMINAL)
        power.append(np.where(nominal, trace.level_w, np.nan))
        residual.append(np.where(nominal, trace.residual_level, np.nan))
    covered = [{"file": r.name, **t.coverage(model.dt)} for r, t in zip(whole, traces, strict=True)]
    try:
        calibration = with_residual(
            *(
                _calibrate(levels, model, context.dataset.hash, watching.rest_speed)
                for levels in (power, residual)
            )
        )
    except InputError as none:
        known.setdefault("reason", f"the monitor could not be calibrated: {none}")
    if "reason" in known:
        set_calibration(context.out / "model", Calibration.without(known["reason"], rest))
        context.save("monitor", {**known, "recordings": covered}, {})
        return
    set_calibration(context.out / "model", calibration)
    alarms, arrays, clean = [], {}, {"seconds": 0.0, "alarms": 0, "test_seconds": 0.0, "test_alarms": 0}
    for recording, levels in zip(whole, traces, strict=True):
        trace = with_alarms(make_monitor(model, calibration), levels)
        alarms += [{"file": recording.name, "start_s": a, "end_s": b} for a, b in trace.intervals()]
        for key in ("t", "violation_w", "level_w", "residual_level", "alarm"):
            arrays[f"{recording.name}/{key}"] = getattr(trace, key)
        arrays[f"{recording.name}/y"] = recording.y[:, 0]
        for prefix, roles in (("", ("train", "valid", "nominal", "test")), ("test_", ("test",))):
            inside = _inside(context, recording, roles)
            clean[f"{prefix}seconds"] += float(inside.sum() * model.dt)
            # one that a disturbance raised before the stretch may end in it: what counts is where it starts
            starts = np.diff(trace.alarm.astype(int), prepend=0) == 1
            clean[f"{prefix}alarms"] += int((starts & inside).sum())
    result = {
        "calibration": plain(calibration), "alarms": alarms, "clean": clean, "recordings": covered,
    }  # fmt: skip
    if context.scenario.plant is not None and context.scenario.tasks:
        result["load"], loop = _load_loop(context, replace(kit, calibration=calibration))
        arrays |= {
            f"load/{key}": getattr(loop, key) for key in ("t", "violation", "level", "alarm", "x", "u")
        }
    context.save("monitor", result, arrays)


def nominal_rest(context: Context, model: HybridModel) -> tuple[float, ...]:
    """Rest speeds of a run's machine, from its undisturbed training and validation recordings."""
    return rest_speeds([t for t in context.dataset.trajectories if t.role in NOMINAL], model)


def run_calibration(context: Context) -> Calibration:
    """What stage monitor found: thresholds and rest speeds, or rest speeds alone, with the reason."""
    found = context.result("monitor")
    if "calibration" in found:
        return record(Calibration, found["calibration"], "checkpoints/monitor.json")
    return Calibration.without(found["reason"], found.get("rest_speed"))


def _load_loop(context: Context, kit: Kit) -> tuple[dict[str, Any], ClosedLoopResult]:
    """The first task with an unknown constant load from its middle on: does the monitor see it?"""
    task, settings = context.scenario.tasks[0], context.settings
    start, added = 0.5 * task.duration, unknown_load(kit.problem(task.name))
    spec = LoopSpec(
        settings.scenario, MODEL, task.name, "hybrid_observer", monitor="energy", run_seed=settings.seed,
        faults=(Fault(start, task.duration, "input_offset", added),),
    )  # fmt: skip
    calm = replace(task, faults=())
    result = Bench(context.scenario, {MODEL: kit}).run(spec, task=calm)[1]
    before, after = result.alarm[result.t < start], np.flatnonzero(result.alarm & (result.t >= start))
    delay = float(result.t[after[0]] - start) if after.size else None
    return {
        "task": task.name, "load": added, "start_s": start, "delay_s": delay,
        "false_alarms": len(alarm_intervals(before, result.dt)),
    }, result  # fmt: skip


def unknown_load(control: OCP) -> float:
    """Load of the demonstration at the first input [input unit].

    Example:
        >>> unknown_load(OCP(9, [1.0], [1.0], [1.0], u_min=[-5.0], u_max=[0.0]))
        0.5
    """
    return LOAD_SHARE * float(0.5 * control.input_range[0])


def clean_windows(
    context: Context, recording: Trajectory, roles: tuple[str, ...]
) -> list[tuple[float, float]]:
    """Stretches of a recording whose role says that nothing disturbs the machine there, ``(start, end)`` [s]."""
    stem = recording.name.split("#")[0]
    if stem in context.spec.windows:
        return [(w.start, w.end) for w in context.spec.windows[stem] if w.role in roles]
    pieces = [t for t in context.dataset.trajectories if t.name.split("#")[0] == stem and t.role in roles]
    return [(float(t.t[0]), float(t.t[-1])) for t in pieces]


def _inside(context: Context, recording: Trajectory, roles: tuple[str, ...]) -> NDArray[np.bool_]:
    inside = np.zeros(len(recording.t), dtype=bool)
    for start, end in clean_windows(context, recording, roles):
        inside |= (recording.t >= start) & (recording.t <= end)
    return inside


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


def analysis_stage(context: Context) -> None:
    """Linearize prior and hybrid at rest and at working speed; poles, PBH tests, frequency responses."""
    from hybrid_mpc.analyze.linearize import fixed_point, linearize
    from hybrid_mpc.analyze.properties import analyze, frequency_response

    artifact = context.kit
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    for i, (name, model) in enumerate(artifact.models.items()):
        context.progress.update("models", i, len(artifact.models), name)
        control = context.scenario.control
        u = np.zeros(model.n_u) if control is None else control.rest_input
        x = np.zeros(model.n_x)
        result[name] = {}
        try:
            x, h = fixed_point(model, u, x)
            result[name]["fixed_point"] = x.tolist()
        except InputError as none:  # a learned correction may leave no point of rest near zero
            h = hidden_fixed_point(model, x, u)
            result[name]["fixed_point_reason"] = f"linearized at x = 0 instead: {none}"
        systems = {"rest": linearize(model, x, u, h)}
        if context.scenario.control is not None:
            moving = x + working_point(model, context.scenario.control)[0]
            systems["moving"] = linearize(model, moving, u, hidden_fixed_point(model, moving, u))
            result["working_speed"] = moving[model.n_x // 2 :].tolist()
        for point, system in systems.items():
            omega = np.geomspace(0.1 / model.time_unit, np.pi / model.dt, 300)
            response = frequency_response(system, omega)
            arrays[f"{name}/{point}/omega"] = omega
            arrays[f"{name}/{point}/magnitude"] = response.magnitude[0, 0]
            arrays[f"{name}/{point}/phase"] = response.phase[0, 0]
            result[name][point] = analyze(system).to_dict()
    context.save("analysis", result, arrays)
