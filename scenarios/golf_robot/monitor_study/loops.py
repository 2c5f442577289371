"""A job of the study ``monitor``: its loops, and what is kept of them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.compare.loops import MODEL, Bench, LoopRow, LoopSpec
from hybrid_mpc.compare.study_run import ModelInput, local_folder
from hybrid_mpc.compare.tasks import selected_tasks
from hybrid_mpc.files import read_arrays, read_json, write_arrays
from hybrid_mpc.kit.artifact import Kit, load
from hybrid_mpc.records import record
from hybrid_mpc.scenario import Task, load_scenario
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.watch.monitor import Monitor, Reading, make_monitor
from hybrid_mpc.watch.replay import trace_of
from scenarios.golf_robot.monitor_study.detection import (
    METHODS,
    REST_SPEED,
    Detectors,
    Trace,
    learn_detectors,
)
from scenarios.golf_robot.monitor_study.plan import FAULT, GUARD, LEARN, LoopPlan, MonitorJob, MonitorStudy

Array = NDArray[np.float64]
DETECTORS, LEARNING = "detectors.json", "learning"
MOVING = 1.5
"""True speed, in rest speeds, above which time counts towards a delay."""
WITHIN_S = 1.0
"""Time in motion [s] within which the ROC counts a fault as found."""
CONTROLLER, PRIOR = "hybrid_observer", "prior_observer"


@dataclass(frozen=True)
class MonitorRunner:
    """Runs the study's jobs; sent to each worker once. Learning data go to ``folder``, what was learned is read
    there.
    """

    study: MonitorStudy
    model: ModelInput
    folder: str

    def __call__(self, job: MonitorJob) -> dict[str, Any]:
        """What is kept of the job's loops."""
        return _loops(self).run(job)


@lru_cache(maxsize=1)
def _loops(runner: MonitorRunner) -> _Loops:
    return _Loops(runner)


class _Loops:
    """The bench of a process."""

    def __init__(self, runner: MonitorRunner) -> None:
        self._study, self._folder = runner.study, Path(runner.folder)
        kit = load(local_folder(runner.model)).with_noise(dict(runner.model.noise))
        self._bench = Bench(load_scenario(runner.study.scenario), {MODEL: kit})
        self._kit = self._bench.kits[MODEL]
        self._task = replace(selected_tasks(self._bench.scenario, (runner.study.task,))[0], faults=())
        self._dt = self._kit.models["hybrid"].dt
        self._detectors: Detectors | None = None

    @property
    def detectors(self) -> Detectors:
        """What was learned, read when first needed."""
        if self._detectors is None:
            self._detectors = record(
                Detectors, read_json(self._folder / DETECTORS), str(self._folder / DETECTORS)
            )
        return self._detectors

    def run(self, job: MonitorJob) -> dict[str, Any]:
        if job.kind == FAULT:
            return self._fault(job.plans[0])
        if job.kind == GUARD:
            return self._guarded(job.plans[0], job.arm)
        traces = self._nominal(job.plans)
        if job.kind == LEARN:
            arrays = {f"{name}_{i}": value for i, t in enumerate(traces) for name, value in vars(t).items()}
            write_arrays(self._folder / LEARNING / f"{job.id}.npz", arrays)
            return {"loops": [{"seconds": plan.duration} for plan in job.plans]}
        shown = [nominal_figures(self._study, self.detectors, t) for t in traces]
        return {"loops": [{"case": p.case, **f} for p, f in zip(job.plans, shown, strict=True)]}

    def _spec(self, plan: LoopPlan, arm: str = "", horizon: int | None = None) -> LoopSpec:
        reaction = {"backup": "prior"}.get(arm, arm)
        return LoopSpec(
            self._study.scenario, MODEL, self._task.name, CONTROLLER, horizon=horizon,
            monitor="guard" if arm else "own",
            faults=plan.faults(self._dt), seed=plan.seed, guard=reaction,
        )  # fmt: skip

    def _follows(self, plan: LoopPlan) -> Task:
        return replace(
            self._task, reference=plan.reference(self._task.reference), duration=plan.duration,
            x0=(0.0,) * self._kit.models["hybrid"].n_x, figures=None,
        )  # fmt: skip

    def _monitor(self, limits: WatchLimits | None = None) -> Monitor:
        rest = rest_of(self._kit) if limits is None else None
        ranges = self._kit.problem(self._task.name).input_range
        return make_monitor(self._kit.models["hybrid"], limits, input_range=ranges, rest_speed=rest)

    def _traced(self, spec: LoopSpec, task: Task, monitor: Monitor) -> tuple[LoopRow, Trace]:
        """A loop's row, and what detectors see of it."""
        readings: list[Reading] = []
        row, result = self._bench.run(
            spec,
            task=task,
            monitor=monitor,
            on_step=lambda step: readings.append(step.reading),  # type: ignore[arg-type]
        )
        found = trace_of(monitor, result.t, readings)
        speed = np.abs(result.x[:, result.x.shape[1] // 2 :]).max(axis=1)
        return row, Trace(found.values, found.terms, found.travel, result.innovation, result.nis, speed)

    def _nominal(self, plans: tuple[LoopPlan, ...]) -> list[Trace]:
        monitor, traces = self._monitor(), []
        for plan in plans:
            spec, task = self._spec(plan, horizon=self._study.horizon), self._follows(plan)
            traces.append(self._traced(spec, task, monitor)[1])
        return traces

    def _fault(self, plan: LoopPlan) -> dict[str, Any]:
        row, trace = self._traced(self._spec(plan), self._follows(plan), self._monitor())
        onset = round(plan.onset(self._dt) / self._dt)
        found = fault_figures(self._study, self.detectors, trace, onset)
        return {**found, "cost": row.cost, "excess": dict(row.excess)}

    def _guarded(self, plan: LoopPlan, arm: str) -> dict[str, Any]:
        monitor = self._monitor(self.detectors.limits_at(self._study.rates[0]))
        row, _ = self._bench.run(self._spec(plan, arm), task=self._follows(plan), monitor=monitor)
        early = sum(switch.t_s < plan.onset(self._dt) for switch in row.switches)
        return {
            "cost": row.cost,
            "excess": dict(row.excess),
            "switches": len(row.switches),
            "early_switches": early,
        }


def nominal_figures(study: MonitorStudy, detectors: Detectors, trace: Trace) -> dict[str, Any]:
    """Of a nominal loop: false alarms by rate and method, and the largest scores of its blocks."""
    dt, levels = detectors.limits.dt, detectors.levels(trace)
    size = round(detectors.block_s / dt)
    counts: dict[str, dict[str, int]] = {}
    for rate in study.rates:
        alarms = {m: detectors.alarm(levels, trace, m, rate) for m in METHODS}
        counts[f"{rate:g}"] = {
            m: int(np.sum(np.diff(on.astype(int), prepend=0) == 1)) for m, on in alarms.items()
        }
    blocks = {}
    for method in METHODS:
        score = detectors.score(levels, method, study.rates[0])
        whole = len(score) // size * size
        blocks[method] = score[:whole].reshape(-1, size).max(axis=1).round(4).tolist()
    return {"seconds": len(trace.nis) * dt, "alarms": counts, "blocks": blocks}


def fault_figures(study: MonitorStudy, detectors: Detectors, trace: Trace, onset: int) -> dict[str, Any]:
    """Of a faulted loop: delays by rate and method, alarms before the fault, and the largest scores soon after."""
    dt, levels = detectors.limits.dt, detectors.levels(trace)
    moving = MOVING * max(detectors.limits.rest_speed)
    moved: Array = np.cumsum(trace.speed[onset:] > moving) * np.float64(dt)
    delays: dict[str, dict[str, float]] = {}
    early: dict[str, dict[str, bool]] = {}
    for rate in study.rates:
        alarms = {m: detectors.alarm(levels, trace, m, rate) for m in METHODS}
        key = f"{rate:g}"
        early[key] = {m: bool(on[:onset].any()) for m, on in alarms.items()}
        delays[key] = {m: _delay(on[onset:], moved) for m, on in alarms.items()}
    soon = moved <= WITHIN_S + 1e-9
    scores = {
        m: round(float(np.max(detectors.score(levels, m, study.rates[0])[onset:][soon], initial=0.0)), 4)
        for m in METHODS
    }
    return {"delays": delays, "early": early, "scores": scores}


def _delay(alarm: NDArray[np.bool_], moved: Array) -> float:
    """Time in motion [s] to the first alarm; infinite without one."""
    places = np.flatnonzero(alarm)
    return float(moved[places[0]]) if places.size else float("inf")


def learn(study: MonitorStudy, paths: list[Path], artifact: Kit) -> Detectors:
    """Thresholds of all methods from the nominal loops in these files."""
    traces, hashed = [], hashlib.sha256()
    for path in paths:
        arrays = read_arrays(path)
        for i in range(len(arrays) // len(Trace.__dataclass_fields__)):
            fields: Mapping[str, Any] = {name: arrays[f"{name}_{i}"] for name in Trace.__dataclass_fields__}
            traces.append(Trace(**fields))
            hashed.update(traces[-1].values.tobytes())
    readings = make_monitor(artifact.models["hybrid"], rest_speed=rest_of(artifact)).readings
    return learn_detectors(
        traces, readings, study.resolution, rate=min(study.rates), data_hash=hashed.hexdigest()
    )


def rest_of(kit: Kit) -> ArrayLike:
    """Speeds below which friction may stick: what recordings gave, or what is known of this robot."""
    return REST_SPEED if kit.rest_speed is None else kit.rest_speed
