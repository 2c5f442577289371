"""Loops in which something breaks, watched by the learned guard: how soon it is seen, and what it is taken for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import Kit
from hybrid_mpc.closed_loop import ClosedLoopResult, Fault, simulate
from hybrid_mpc.errors import InputError
from hybrid_mpc.monitor import Detector, MonitorTrace, guard_monitor
from hybrid_mpc.monitor.calibration import alarm_intervals
from hybrid_mpc.pipeline.contenders import build
from hybrid_mpc.pipeline.guards import make_resting_guard
from hybrid_mpc.pipeline.loops import freezing
from hybrid_mpc.pipeline.monitor_job import explained
from hybrid_mpc.pipeline.nominal_loops import CONTENDER, knows
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]
SEED = 600
"""Number of these loops, away from those that the detector is learned from."""
SHOWN = ("t", "violation_w", "level_w", "residual_level", "energy_j", "energy_s", "frozen", "scores", "alarm")
"""What of a trace is kept for the report."""


@dataclass(frozen=True)
class Case:
    """What breaks in a loop.

    Args:
        name: Short name.
        title: In words.
        target: Of the fault.
        value: Its size.
    """

    name: str
    title: str
    target: str
    value: float = 0.0


FRICTION = Case("friction", "friction doubles", "plant_friction", 2.0)
DRIVE = Case("drive", "the drive loses a fifth of its force", "input_gain", 0.8)
FREEZE = Case("freeze", "the sensor freezes", "measurement_freeze")


@dataclass(frozen=True)
class Samples:
    """What a loop recorded: ``t`` (n,), ``y`` (n, n_y), ``u`` (n, n_u)."""

    t: Array
    y: Array
    u: Array


def cases(scenario: Scenario) -> tuple[Case, ...]:
    """What is tried: friction twice as large, or a weaker drive where the plant knows no friction; a frozen sensor.

    Example:
        >>> from hybrid_mpc.scenario import load_scenario
        >>> [case.name for case in cases(load_scenario("golf_robot"))]
        ['friction', 'freeze']
    """
    return FRICTION if knows(scenario, FRICTION.target) else DRIVE, FREEZE


def faulted(
    scenario: Scenario, artifact: Kit, noise: Mapping[str, Array], detector: Detector, run_seed: int
) -> tuple[list[dict[str, Any]], dict[str, Array]]:
    """A loop of each case on the first tracking task, in which something breaks from the middle on.

    Args:
        scenario: The machine, with plant and tasks.
        artifact: Prior and hybrid.
        noise: Process noise by contender.
        detector: What the guard listens to.
        run_seed: Seed of the run.

    Returns:
        A row each: what breaks and when, ``delay_s`` to the alarm (None: never), what the diagnosis says, false alarms
        before, changes of the guard's mode; and the traces for the report, see :func:`read_trace`.
    """
    task = next((t for t in scenario.tasks if not t.faults and t.weight is None), scenario.tasks[0])
    control, model = task.control or scenario.control, artifact.models["hybrid"]
    assert scenario.plant is not None
    assert control is not None
    start = model.dt * round(0.5 * task.duration / model.dt)
    estimator, controller = build(CONTENDER, scenario, artifact, control, noise)
    diagnose = model.n_p > 0
    rows: list[dict[str, Any]] = []
    arrays: dict[str, Array] = {}
    for case in cases(scenario):
        monitor = guard_monitor(model, detector, **freezing(scenario, control), diagnose=diagnose)
        result = simulate(
            scenario.plant(), estimator, controller, task.reference, weight=task.weight, dt=model.dt,
            duration=task.duration, x0=np.array(task.x0), seed=run_seed * 1000 + SEED, monitor=monitor,
            guard=make_resting_guard(model), faults=(*task.faults, Fault(start, math.inf, case.target, case.value)),
        )  # fmt: skip
        # The estimator is deterministic: over the record it says again what it said in the loop.
        recording = Samples(result.t, result.y, result.u)
        trace, alarms = explained(
            monitor, estimator, recording, scenario.causes, prior=artifact.models["prior"]
        )
        rows.append({**_told(case, task.name, start, trace, alarms), "switches": switches(result)})
        arrays |= kept(case.name, trace, result.y)
    return rows, arrays


def _told(
    case: Case, task: str, start: float, trace: MonitorTrace, alarms: list[dict[str, Any]]
) -> dict[str, Any]:
    after = np.flatnonzero(trace.alarm & (trace.t >= start - 1e-9))
    seen = [alarm for alarm in alarms if alarm["end_s"] >= start - 1e-9]
    return {
        "fault": case.name,
        "title": case.title,
        "target": case.target,
        "value": case.value,
        "task": task,
        "start_s": start,
        "delay_s": float(trace.t[after[0]]) - start if after.size else None,
        "diagnosis": seen[0]["diagnosis"] if seen else "",
        "false_alarms": len(alarm_intervals(trace.alarm[trace.t < start - 1e-9], 1.0)),
    }


def switches(result: ClosedLoopResult) -> list[dict[str, Any]]:
    """Changes of the guard's mode in a loop, as plain data."""
    return [
        {"t_s": s.t, "before": s.before.name, "after": s.after.name, "why": s.why} for s in result.switches
    ]


def stored_detector(artifact: Kit, folder: Path | None = None) -> Detector:
    """The detector that the main job left in an artifact.

    Raises:
        InputError: If there is none.
    """
    found = None if artifact.calibration is None else artifact.calibration.detector
    if found is None:
        raise InputError(
            f"{folder or 'the artifact'} holds no detector for the guard: an earlier version made it, or its run had "
            "too little nominal data (its report says why); run the main job again"
        )
    return found


def kept(name: str, trace: MonitorTrace, y: Array) -> dict[str, Array]:
    """A trace's arrays and the first output of ``y`` ``(n, n_y)`` under a name, for the checkpoint.

    Example:
        >>> z = np.zeros(2)
        >>> trace = MonitorTrace(z, z, z, z, z, z, z > 0)
        >>> read_trace(kept("a", trace, np.zeros((2, 1))), "a").alarm.tolist()
        [False, False]
    """
    return {f"{name}/{key}": np.asarray(getattr(trace, key)) for key in SHOWN} | {f"{name}/y": y[:, 0]}


def read_trace(arrays: Mapping[str, Any], name: str) -> MonitorTrace:
    """The trace that :func:`kept` kept; the balances, which the report does not show, are NaN."""
    own = {key: arrays[f"{name}/{key}"] for key in SHOWN}
    none = np.full(len(own["t"]), np.nan)
    return MonitorTrace(dE_model_w=none, dE_measured_w=none, **own)
