"""The closed loop: measure, estimate, solve, monitor, hold."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.closed_loop.faults import Fault, check_channels, install
from hybrid_mpc.closed_loop.guard import Guard, GuardedLoop
from hybrid_mpc.closed_loop.machine import Machine, Preview, Previews, fitting
from hybrid_mpc.closed_loop.result import ClosedLoopResult
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.delays import filtered, sees_truth
from hybrid_mpc.estimation.kalman import Estimate, Estimator
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.problem import Controller
from hybrid_mpc.mpc.safeguard import Decision, SafeController
from hybrid_mpc.riccati import vector
from hybrid_mpc.scenario import Plant

Array = NDArray[np.float64]


class Reading(Protocol):
    """What a monitor says of one period."""

    @property
    def violation_w(self) -> float:
        """Energy violation [W]."""

    @property
    def level_w(self) -> float:
        """Level above which it counts [W]."""

    @property
    def alarm(self) -> bool:
        """True while the monitor alarms."""


class Monitor(Protocol):
    """Watches a loop; pure, its memory is the state it returns."""

    def initial(self) -> Any:
        """State before the first period."""

    def update(self, state: Any, y: Array, u_prev: Array, estimate: Estimate) -> tuple[Any, Reading]:
        """State and reading after the measurement ``y``, with ``u_prev`` held before it."""


@dataclass(frozen=True)
class Step:
    """One period as ``on_step`` sees it: number, time [s], truth, measurement, estimate, decision."""

    k: int
    t: float
    x: Array
    y: Array
    estimate: Estimate
    decision: Decision
    reading: Reading | None


def simulate(
    plant: Plant,
    estimator: Estimator,
    controller: SafeController | Controller,
    reference: Preview,
    *,
    dt: float,
    duration: float,
    x0: ArrayLike,
    seed: int,
    weight: Preview | None = None,
    horizon: int | None = None,
    monitor: Monitor | None = None,
    faults: Sequence[Fault] = (),
    stage_cost: OCP | None = None,
    on_step: Callable[[Step], None] | None = None,
    sensor_delay: int = 0,
    input_delay: int = 0,
    late: Callable[[float], bool] | None = None,
    guard: Guard | None = None,
) -> ClosedLoopResult:
    """Run a plant under control; deterministic except for the recorded durations.

    Before the first step the controller makes its first plan (:meth:`~hybrid_mpc.mpc.SafeController.initial`).
    At ``t_k``: measure ``y_k``; estimate with ``y_k`` and ``u_{k-1}``; solve ``u_k``; monitor; hold ``u_k``.
    No time passes between measuring and holding but the delays given. Input faults act behind the
    controller, which is not told.

    The preview reaches beyond the end of the run: reference and weight are asked for those times too. Where
    they are not finite there (a recording that ends), their last value within the run is held.

    With delays the estimate must be that of the instant at which the input will act: give
    :class:`~hybrid_mpc.estimation.DelayCompensation` as estimator. Before the start the machine has rested
    at ``x0`` with the first held input, and the sensor has measured it there.

    Args:
        plant: The machine.
        estimator: Filter, or :class:`~hybrid_mpc.estimation.TrueState`, which is handed the truth, undelayed.
        controller: A :class:`~hybrid_mpc.mpc.SafeController`; a bare controller is guarded without fallback.
        reference: ``t (n,) -> x_ref (n, n_x)``, previewed over the horizon; with ``n_p`` more columns where the
            economic stage cost has parameters (:meth:`~hybrid_mpc.mpc.Controller.solve`).
        dt: Period [s]; must be the models' own.
        duration: Length [s], rounded to whole periods.
        x0: Initial state ``(n_x,)``.
        seed: Seed of the plant and of the measurement noise.
        weight: Factors on ``q``, ``t (n,) -> (n, n_x)``, previewed alike; they count in the recorded cost.
            Default: 1.
        horizon: Periods of preview. Default: the controller's horizon.
        monitor: Default: none.
        faults: Default: none.
        stage_cost: Problem whose stage cost is recorded. Default: the controller's.
        on_step: Called after every period, e.g. to show progress.
        sensor_delay: Periods after which a measurement arrives; faults of a sensor act on arrival.
        input_delay: Periods after which an input reaches the plant: computing and transport.
        late: ``t [s] -> True`` where the solve misses its deadline. Default: never.
        guard: What to do on alarms of the monitor, which it needs. Default: nothing.

    Returns:
        The record of ``round(duration / dt)`` periods.

    Raises:
        InputError: If a period, shape or channel does not fit.

    Example: see ``tests/closed_loop``; with a scenario::

        result = simulate(plant, ekf, controller, task.reference, weight=task.weight, dt=0.02,
                          duration=task.duration, x0=task.x0, seed=0)
    """
    safe = controller if isinstance(controller, SafeController) else SafeController(controller)
    ocp, model = safe.controller.ocp, estimator.model
    check_models(model, safe.controller.model)
    n = _periods(dt, duration, model.dt, safe.controller.model.dt)
    plant, faults = install(plant, faults)
    check_channels(faults, model.n_y, ocp.n_u)
    cost = _checked_cost(ocp, ocp if stage_cost is None else stage_cost)
    previews = Previews(reference, weight, ocp, horizon, dt, n * dt)
    machine = Machine(
        plant, vector(x0, ocp.n_x, "x0"), seed, model.n_y, faults, dt, sensor_delay, input_delay
    )
    guarded = _guarded(guard, safe, monitor)
    control = safe if guarded is None else guarded
    estimate: Estimate | None = None
    decision: Decision | None = None
    memory = monitor.initial() if monitor is not None else None
    record = _Record(dt)
    for k in range(n):
        t = k * dt
        x = fitting(plant.truth(machine.state), ocp.n_x, "the plant's truth")
        y = machine.measure(t)
        seen = np.concatenate([x, plant.hidden(machine.state)]) if sees_truth(estimator) else y
        x_ref, factors = previews(t + input_delay * dt)
        if estimate is None or decision is None:  # the machine still rests: this is no part of a step
            estimate = estimator.start(seen, t)
            decision = control.initial(estimate, None, x_ref, factors)
            machine.rest(decision.u)
            clock = [perf_counter()]
        else:
            clock = [perf_counter()]
            estimate = estimator.update(estimate, seen, decision.u)
        if guarded is not None:
            guarded.measured(t, y, decision.u)
        clock.append(perf_counter())
        if late is not None and late(t):
            decision = control.late(decision, estimate, x_ref)
        else:
            decision = control.decide(decision, estimate, x_ref, factors)
        clock.append(perf_counter())
        reading = None
        if monitor is not None:
            memory, reading = monitor.update(memory, y, machine.held_at_measurement(), filtered(estimate))
            if guarded is not None:
                guarded.watched(t, reading)
        clock.append(perf_counter())
        u, u_prev = machine.command(decision.u)
        if input_delay:
            x_ref, factors = previews(t)
        now_factors = 1.0 if factors is None else factors[0]
        with np.errstate(over="ignore", invalid="ignore"):  # an absurd reference costs infinitely much
            stage = float(cost.stage_cost(x, u, x_ref[0, : x.size], u - u_prev, now_factors))
        step = Step(k, t, x, y, estimate, decision, reading)
        record.add(step, x_ref[0, : x.size], stage, np.diff(clock) * 1e3)
        if on_step is not None:
            on_step(step)
        machine.advance(t)
    return record.result(guarded)


def _guarded(guard: Guard | None, safe: SafeController, monitor: object | None) -> GuardedLoop | None:
    if guard is not None and monitor is None:
        raise InputError("a guard acts on a monitor's alarms; give monitor= as well")
    return None if guard is None else guard.begin(safe)


def _checked_cost(ocp: OCP, cost: OCP) -> OCP:
    if (cost.n_x, cost.n_u) != (ocp.n_x, ocp.n_u):
        raise InputError(
            f"stage_cost has {cost.n_x} states and {cost.n_u} inputs, needed: {ocp.n_x} and {ocp.n_u}"
        )
    return cost


def check_models(estimated: HybridModel, controlled: HybridModel) -> None:
    """Refuse an estimator and a controller whose models have other sizes.

    Raises:
        InputError: With both models' sizes.
    """
    sizes = [(m.n_x, m.n_h, m.n_u) for m in (estimated, controlled)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"the estimator's model {estimated.name} has (n_x, n_h, n_u) = {sizes[0]}, "
            f"the controller's model {controlled.name} {sizes[1]}; give both the same model"
        )


def _periods(dt: float, duration: float, *periods: float) -> int:
    if not (math.isfinite(duration) and math.isfinite(dt) and dt > 0):
        raise InputError(f"dt and duration must be finite and dt positive; got {dt} s and {duration} s")
    for period in periods:
        if not abs(dt - period) <= 1e-9 * period:
            raise InputError(f"dt = {dt} s given, a model's period is {period} s; they must agree")
    n = round(duration / dt)
    if n < 1:
        raise InputError(f"duration {duration} s is shorter than one period of {dt} s")
    return n


class _Record:
    """Collects the rows of one simulation."""

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._rows: list[tuple[Step, Array, float, Array]] = []

    def add(self, step: Step, reference: Array, stage: float, spent: Array) -> None:
        self._rows.append((step, reference, stage, spent))

    def result(self, guarded: GuardedLoop | None) -> ClosedLoopResult:
        steps = [row[0] for row in self._rows]
        readings = [step.reading for step in steps]
        spent = np.array([row[3] for row in self._rows])
        timing = {name: spent[:, i] for i, name in enumerate(("estimate", "solve", "monitor"))}
        return ClosedLoopResult(
            dt=self._dt,
            t=np.array([step.t for step in steps]),
            x=np.array([step.x for step in steps]),
            y=np.array([step.y for step in steps]),
            u=np.array([step.decision.u for step in steps]),
            x_hat=np.array([step.estimate.x for step in steps]),
            h=np.array([step.estimate.h for step in steps]),
            d=np.array([step.estimate.d for step in steps]),
            reference=np.array([row[1] for row in self._rows]),
            source=tuple(step.decision.source.name for step in steps),
            status=tuple(step.decision.status.name for step in steps),
            stage_cost=np.array([row[2] for row in self._rows]),
            timing_ms={**timing, "total": spent.sum(axis=1)},
            violation=np.array([np.nan if r is None else r.violation_w for r in readings]),
            level=np.array([np.nan if r is None else r.level_w for r in readings]),
            alarm=np.array([r is not None and bool(r.alarm) for r in readings]),
            judged=np.array([r is not None and not getattr(r, "verdict", 0) for r in readings]),
            switches=() if guarded is None else tuple(guarded.switches),
        )
