"""Loops in which something breaks, watched by the learned guard: how soon it is seen, and what it is taken for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.closed_loop import Fault
from hybrid_mpc.job.loops import MODEL, Bench, LoopSpec
from hybrid_mpc.monitor import MonitorTrace
from hybrid_mpc.monitor.calibration import alarm_intervals
from hybrid_mpc.pipeline.monitor_job import explained
from hybrid_mpc.pipeline.nominal_loops import CONTENDER, knows, nominal_tasks
from hybrid_mpc.records import plain
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
    bench: Bench, named: str, run_seed: int, causes: Mapping[str, tuple[str, ...]]
) -> tuple[list[dict[str, Any]], dict[str, Array]]:
    """A loop of each case on the first tracking task, in which something breaks from the middle on.

    Args:
        bench: The machine and its model, with the detector that the guard listens to.
        named: Name or path of the scenario.
        run_seed: Seed of the run.
        causes: What may break, by name.

    Returns:
        A row each: what breaks and when, ``delay_s`` to the alarm (None: never), what the diagnosis says, false alarms
        before, changes of the guard's mode; and the traces for the report, see :func:`read_trace`.
    """
    scenario, kit = bench.scenario, bench.kits[MODEL]
    dt = kit.models["hybrid"].dt
    task = nominal_tasks(scenario)[0]
    start = dt * round(0.5 * task.duration / dt)
    monitor = kit.monitor(kind="guard", task=task.name, diagnose=True)
    rows: list[dict[str, Any]] = []
    arrays: dict[str, Array] = {}
    for case in cases(scenario):
        fault = Fault(start, math.inf, case.target, case.value)
        spec = LoopSpec(
            named, MODEL, task.name, CONTENDER, monitor="guard", guard="rest", seed=SEED, run_seed=run_seed,
            faults=(fault,),
        )  # fmt: skip
        row, result = bench.run(spec, monitor=monitor)
        # The estimator is deterministic: over the record it says again what it said in the loop.
        samples = Samples(result.t, result.y, result.u)
        trace, alarms = explained(monitor, bench.parts(spec)[0], samples, causes, prior=kit.models["prior"])
        rows.append({**_told(case, task.name, start, trace, alarms), "switches": plain(row.switches)})
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
