"""The closed loop: measure, estimate, solve, monitor, hold."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.closed_loop.faults import Fault, check_channels, install
from hybrid_mpc.closed_loop.guard import Guard, Switch
from hybrid_mpc.closed_loop.loop import TIMED, Loop, Monitor, Reading, preview_of
from hybrid_mpc.closed_loop.machine import Machine, Preview, Previews, fitting
from hybrid_mpc.closed_loop.result import ClosedLoopResult
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate, Estimator
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.problem import Controller
from hybrid_mpc.mpc.safeguard import Decision, SafeController
from hybrid_mpc.riccati import vector
from hybrid_mpc.scenario import Plant

Array = NDArray[np.float64]


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
    reference: Preview | ArrayLike,
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

    It drives a :class:`~hybrid_mpc.closed_loop.Loop` on a virtual clock. No time passes between measuring and
    holding but the delays given. Input faults act behind the controller, which is not told.

    The preview reaches beyond the end of the run: reference and weight are asked for those times too. Where
    they are not finite there (a recording that ends), their last value within the run is held.

    With delays the estimate must be that of the instant at which the input will act: give
    :class:`~hybrid_mpc.estimation.DelayCompensation` as estimator. Before the start the machine has rested
    at ``x0`` with the first held input, and the sensor has measured it there.

    Args:
        plant: The machine.
        estimator: Filter, or :class:`~hybrid_mpc.estimation.TrueState`, which is handed the truth, undelayed.
        controller: A :class:`~hybrid_mpc.mpc.SafeController`; a bare controller is guarded without fallback.
        reference: ``t (n,) -> x_ref (n, n_x)`` or a set-point; see :class:`~hybrid_mpc.closed_loop.Loop`.
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
    loop = Loop(
        estimator, controller, monitor=monitor, reference=reference, weight=weight, guard=guard, horizon=horizon,
        end=_end(dt, duration, estimator.model.dt), input_delay=input_delay, sensor_delay=sensor_delay,
    )  # fmt: skip
    ocp, model, n = loop.ocp, loop.model, round(duration / dt)
    plant, faults = install(plant, faults)
    check_channels(faults, model.n_y, ocp.n_u)
    cost = _checked_cost(ocp, ocp if stage_cost is None else stage_cost)
    previews = Previews(preview_of(reference, ocp), weight, ocp, horizon, dt, n * dt)
    machine = Machine(
        plant, vector(x0, ocp.n_x, "x0"), seed, model.n_y, faults, dt, sensor_delay, input_delay
    )
    record = _Record(dt)
    for k in range(n):
        t = k * dt
        x = fitting(plant.truth(machine.state), ocp.n_x, "the plant's truth")
        y = machine.measure(t)
        truth = np.concatenate([x, plant.hidden(machine.state)])
        in_time = None if late is None else partial(_is_in_time, late, t)
        if k == 0:
            loop.start(y, truth=truth, in_time=in_time)
            machine.rest(loop.state.held[0])
        else:
            loop.step(y, truth=truth, in_time=in_time)
        u, u_prev = machine.command(loop.decision.u)
        loop.finish()
        x_ref, factors = previews(t) if input_delay else loop.previewed
        now_factors = 1.0 if factors is None else factors[0]
        with np.errstate(over="ignore", invalid="ignore"):  # an absurd reference costs infinitely much
            stage = float(cost.stage_cost(x, u, x_ref[0, : x.size], u - u_prev, now_factors))
        step = Step(k, t, x, y, loop.estimate, loop.decision, loop.reading)
        record.add(step, x_ref[0, : x.size], stage, loop.spent)
        if on_step is not None:
            on_step(step)
        machine.advance(t)
    return record.result(loop.switches)


def _is_in_time(late: Callable[[float], bool], t: float) -> bool:
    return not late(t)


def _checked_cost(ocp: OCP, cost: OCP) -> OCP:
    if (cost.n_x, cost.n_u) != (ocp.n_x, ocp.n_u):
        raise InputError(
            f"stage_cost has {cost.n_x} states and {cost.n_u} inputs, needed: {ocp.n_x} and {ocp.n_u}"
        )
    return cost


def _end(dt: float, duration: float, period: float) -> float:
    """End of the run [s].

    Raises:
        InputError: If a time is not finite, the period another than the models', or the run shorter than one.
    """
    if not (math.isfinite(duration) and math.isfinite(dt) and dt > 0):
        raise InputError(f"dt and duration must be finite and dt positive; got {dt} s and {duration} s")
    if not abs(dt - period) <= 1e-9 * period:
        raise InputError(f"dt = {dt} s given, a model's period is {period} s; they must agree")
    if round(duration / dt) < 1:
        raise InputError(f"duration {duration} s is shorter than one period of {dt} s")
    return round(duration / dt) * dt


class _Record:
    """Collects the rows of one simulation."""

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._rows: list[tuple[Step, Array, float, Mapping[str, float]]] = []

    def add(self, step: Step, reference: Array, stage: float, spent: Mapping[str, float]) -> None:
        self._rows.append((step, reference, stage, spent))

    def result(self, switches: tuple[Switch, ...]) -> ClosedLoopResult:
        steps = [row[0] for row in self._rows]
        readings = [step.reading for step in steps]
        timing = {name: 1e3 * np.array([row[3][name] for row in self._rows]) for name in TIMED}
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
            timing_ms={**timing, "total": np.sum(list(timing.values()), axis=0)},
            violation=np.array([np.nan if r is None else r.violation_w for r in readings]),
            level=np.array([np.nan if r is None else r.level_w for r in readings]),
            alarm=np.array([r is not None and bool(r.alarm) for r in readings]),
            judged=np.array([r is not None and not getattr(r, "verdict", 0) for r in readings]),
            switches=switches,
        )
