"""A job of the study ``monitor``: its loops, and what is kept of them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import Kit, load
from hybrid_mpc.assembly import make_adaptive_guard, make_resting_guard
from hybrid_mpc.closed_loop import ClosedLoopResult, Guard, simulate
from hybrid_mpc.closed_loop.guard import Mode
from hybrid_mpc.closed_loop.simulate import Step
from hybrid_mpc.estimation.switching import SwitchingFilter
from hybrid_mpc.files import read_arrays, read_json, write_arrays
from hybrid_mpc.job.contenders import build
from hybrid_mpc.monitor import METHODS, Detector, EnergyMonitor, Judges, guard_monitor, learn_judges
from hybrid_mpc.monitor.rest import REST_SPEED
from hybrid_mpc.mpc import OCP
from hybrid_mpc.pipeline.control_job import selected_tasks
from hybrid_mpc.pipeline.monitor_job import stored_rest
from hybrid_mpc.records import record
from hybrid_mpc.scenario import Task, load_scenario
from hybrid_mpc.studies.lockstep import NominalLoop, Trace, run_together
from hybrid_mpc.studies.loops import ModelInput
from hybrid_mpc.studies.monitor_plan import FAULT, GUARD, LEARN, LoopPlan, MonitorJob, MonitorStudy

Array = NDArray[np.float64]
JUDGES, LEARNING = "judges.json", "learning"
MOVING = 1.5
"""True speed, in rest speeds, above which time counts towards a delay."""
WITHIN_S = 1.0
"""Time in motion [s] within which the ROC counts a fault as found."""
CONTROLLER, PRIOR = "hybrid_observer", "prior_observer"


@dataclass(frozen=True)
class MonitorRunner:
    """Runs the study's jobs; sent to each worker once.

    Args:
        study: The study.
        model: Its model.
        folder: Folder of the study: learning data go there, what was learned is read there.

    Example: ``MonitorRunner(study, model, "studies/monitor")(job)["loops"]``
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
    """Models and controllers of a process."""

    def __init__(self, runner: MonitorRunner) -> None:
        self._study, self._folder = runner.study, Path(runner.folder)
        self._scenario = load_scenario(runner.study.scenario)
        self._artifact: Kit = load(Path(runner.model.folder))
        self._noise = {name: np.array(sigma) for name, sigma in runner.model.noise}
        (self._task,) = selected_tasks(self._scenario, (runner.study.task,))
        self._task = plain_task(self._task)
        self._model = self._artifact.models["hybrid"]
        self._judges: Judges | None = None
        self._made: dict[Any, Any] = {}

    @property
    def _control(self) -> OCP:
        control = self._task.control or self._scenario.control
        assert control is not None
        return control

    @property
    def judges(self) -> Judges:
        """What was learned, read when first needed."""
        if self._judges is None:
            self._judges = record(Judges, read_json(self._folder / JUDGES), str(self._folder / JUDGES))
        return self._judges

    def run(self, job: MonitorJob) -> dict[str, Any]:
        if job.kind == FAULT:
            return self._fault(job.plans[0])
        if job.kind == GUARD:
            return self._guarded(job.plans[0], job.arm)
        traces = self._nominal(job.plans)
        if job.kind == LEARN:
            write_learning(self._folder / LEARNING / f"{job.id}.npz", traces)
            return {"loops": [{"seconds": plan.duration} for plan in job.plans]}
        shown = [nominal_figures(self._study, self.judges, t) for t in traces]
        return {"loops": [{"case": p.case, **f} for p, f in zip(job.plans, shown, strict=True)]}

    def _parts(self, name: str, horizon: int | None = None) -> Any:
        if (name, horizon) not in self._made:
            control = self._control if horizon is None else self._control.changed(horizon=horizon)
            self._made[name, horizon] = build(name, self._scenario, self._artifact, control, self._noise)
        return self._made[name, horizon]

    def _monitor(
        self, detector: Detector | None = None, resolution: tuple[float, ...] | None = None
    ) -> EnergyMonitor:
        ranges = self._control.input_range
        rest = stored_rest(self._artifact) if detector is None else None
        return guard_monitor(
            self._model, detector, resolution=resolution, input_range=ranges, rest_speed=rest
        )

    def _nominal(self, plans: tuple[LoopPlan, ...]) -> list[Trace]:
        estimator, controller = self._parts(CONTROLLER, self._study.horizon)
        assert isinstance(estimator, SwitchingFilter)
        assert self._scenario.plant is not None
        dt = self._model.dt
        loops = [NominalLoop(p.reference(self._task.reference), p.seed, p.faults(dt)) for p in plans]
        return run_together(
            self._scenario.plant(), estimator, controller, self._monitor(), loops,
            round(plans[0].duration / dt),
        )  # fmt: skip

    def _simulated(
        self, plan: LoopPlan, monitor: EnergyMonitor, guard: Guard | None = None
    ) -> tuple[ClosedLoopResult, Trace]:
        estimator, controller = self._parts(CONTROLLER)
        assert self._scenario.plant is not None
        dt, rows, half = self._model.dt, [], self._model.n_x // 2

        def keep(step: Step) -> None:
            r, e, speed = step.reading, step.estimate, np.abs(step.x[half:]).max()
            rows.append(
                (getattr(r, "numbers", ()), step.reading and step.reading.level_w, e.innovation, e.nis, speed)
            )

        result = simulate(
            self._scenario.plant(), estimator, controller, plan.reference(self._task.reference), dt=dt,
            duration=plan.duration, x0=np.zeros(self._model.n_x), seed=plan.seed, monitor=monitor,
            faults=plan.faults(dt), guard=guard, on_step=keep,
        )  # fmt: skip
        return result, Trace(*(np.array(c, dtype=np.float64) for c in zip(*rows, strict=True)))

    def _fault(self, plan: LoopPlan) -> dict[str, Any]:
        result, trace = self._simulated(plan, self._monitor())
        found = fault_figures(
            self._study, self.judges, trace, round(plan.onset(self._model.dt) / self._model.dt)
        )
        return {**found, **loop_figures(result, self._control)}

    def _guarded(self, plan: LoopPlan, arm: str) -> dict[str, Any]:
        detector = self.judges.detector_at(self._study.rates[0])
        monitor = self._monitor(detector, self.judges.resolution)
        result, _ = self._simulated(plan, monitor, self._guard(arm))
        onset = plan.onset(self._model.dt)
        early = sum(switch.t < onset for switch in result.switches)
        return {
            **loop_figures(result, self._control),
            "switches": len(result.switches),
            "early_switches": early,
        }

    def _guard(self, arm: str) -> Guard:
        if arm == "rest":
            return make_resting_guard(self._model)
        if arm == "backup":
            estimator, controller = self._parts(PRIOR)
            return Guard(Mode.BACKUP, Mode.REST, backup=controller, backup_estimator=estimator)
        if arm not in self._made:
            prior, sigma_x = self._artifact.models["prior"], self._noise[CONTROLLER]
            self._made[arm] = make_adaptive_guard(self._model, prior, self._scenario, sigma_x, self._control)
        guard: Guard = self._made[arm]
        return guard


def plain_task(task: Task) -> Task:
    """The task without disturbances of its own."""
    return replace(task, faults=())


def nominal_figures(study: MonitorStudy, judges: Judges, trace: Trace) -> dict[str, Any]:
    """Of a nominal loop: false alarms by rate and method, and the largest scores of its blocks.

    Args:
        study: The study.
        judges: What was learned.
        trace: The loop.
    """
    dt, levels = judges.detector.dt, judges.levels(trace)
    size = round(judges.block_s / dt)
    counts: dict[str, dict[str, int]] = {}
    for rate in study.rates:
        alarms = {m: judges.alarm(levels, trace, m, rate) for m in METHODS}
        counts[f"{rate:g}"] = {
            m: int(np.sum(np.diff(on.astype(int), prepend=0) == 1)) for m, on in alarms.items()
        }
    blocks = {}
    for method in METHODS:
        score = judges.score(levels, method, study.rates[0])
        whole = len(score) // size * size
        blocks[method] = score[:whole].reshape(-1, size).max(axis=1).round(4).tolist()
    return {"seconds": len(trace.nis) * dt, "alarms": counts, "blocks": blocks}


def fault_figures(study: MonitorStudy, judges: Judges, trace: Trace, onset: int) -> dict[str, Any]:
    """Of a faulted loop: delays by rate and method, alarms before the fault, and the largest scores soon after.

    Args:
        study: The study.
        judges: What was learned.
        trace: The loop.
        onset: First sample of the fault.
    """
    dt, levels = judges.detector.dt, judges.levels(trace)
    moving = MOVING * max(judges.detector.rest_speed)
    moved: Array = np.cumsum(trace.speed[onset:] > moving) * np.float64(dt)
    delays: dict[str, dict[str, float]] = {}
    early: dict[str, dict[str, bool]] = {}
    for rate in study.rates:
        alarms = {m: judges.alarm(levels, trace, m, rate) for m in METHODS}
        key = f"{rate:g}"
        early[key] = {m: bool(on[:onset].any()) for m, on in alarms.items()}
        delays[key] = {m: _delay(on[onset:], moved) for m, on in alarms.items()}
    soon = moved <= WITHIN_S + 1e-9
    scores = {
        m: round(float(np.max(judges.score(levels, m, study.rates[0])[onset:][soon], initial=0.0)), 4)
        for m in METHODS
    }
    return {"delays": delays, "early": early, "scores": scores}


def _delay(alarm: NDArray[np.bool_], moved: Array) -> float:
    """Time in motion [s] to the first alarm; infinite without one."""
    places = np.flatnonzero(alarm)
    return float(moved[places[0]]) if places.size else float("inf")


def loop_figures(result: ClosedLoopResult, control: OCP) -> dict[str, Any]:
    """Cost of a loop, and by how much it left its limits.

    Args:
        result: The loop.
        control: Its limits.
    """
    over = {"u": np.maximum(result.u - control.u_max, control.u_min - result.u)}
    if np.any(np.isfinite([control.x_min, control.x_max])):
        beyond = np.maximum(result.x - control.x_max, control.x_min - result.x)
        over |= {f"x{i}": column for i, column in enumerate(beyond.T)}
    if control.du_max is not None:
        over["du"] = np.abs(np.diff(result.u, axis=0)) - control.du_max
    excess = {name: max(0.0, float(values.max())) for name, values in over.items()}
    return {"cost": result.cost, "excess": excess}


def write_learning(path: Path, traces: list[Trace]) -> None:
    """Keep what is learned from."""
    arrays = {f"{name}_{i}": value for i, t in enumerate(traces) for name, value in vars(t).items()}
    write_arrays(path, arrays)


def learn(study: MonitorStudy, paths: list[Path], artifact: Kit) -> Judges:
    """Thresholds of all methods from the nominal loops in these files.

    Args:
        study: The study.
        paths: Files of :func:`write_learning`.
        artifact: The models that ran in them.

    Raises:
        InputError: If a file is missing, or there is too little data.
    """
    traces, hashed = [], hashlib.sha256()
    for path in paths:
        arrays = read_arrays(path)
        for i in range(len(arrays) // len(Trace.__dataclass_fields__)):
            fields: Mapping[str, Any] = {name: arrays[f"{name}_{i}"] for name in Trace.__dataclass_fields__}
            traces.append(Trace(**fields))
            hashed.update(traces[-1].numbers.tobytes())
    model, rest = artifact.models["hybrid"], stored_rest(artifact)
    return learn_judges(
        traces, model.dt, study.resolution, rate=min(study.rates), rest_speed=REST_SPEED if rest is None else rest,
        time_unit=model.time_unit, data_hash=hashed.hexdigest(),
    )  # fmt: skip
