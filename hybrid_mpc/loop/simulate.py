"""The loop in simulation: a plant in place of the machine, a virtual clock, and a record of all periods."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.problem import Controller
from hybrid_mpc.control.safeguard import Decision, SafeController
from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.estimate.delay import whole_periods
from hybrid_mpc.estimate.kalman import Estimate, Estimator
from hybrid_mpc.loop.faults import Fault, check_channels, install
from hybrid_mpc.loop.guard import Guard, Switch
from hybrid_mpc.loop.loop import TIMED, Loop, Monitor, Reading
from hybrid_mpc.loop.plant import Plant, SimulatedMachine
from hybrid_mpc.loop.preview import Preview, Previews, beyond_range, n_tracked, shortest_way
from hybrid_mpc.model.equilibrium import Steady
from hybrid_mpc.model.limits import check_function, check_part, sampled, vector, whole
from hybrid_mpc.model.model import HybridModel

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
UNITS = {"stage_cost": "1/s", "violation": "W", "share": "-"}


@dataclass(frozen=True)
class Step:
    """One period, as passed to ``on_step``: number, time [s], true state, measurement, estimate, decision, reading."""

    k: int
    t: float
    x: Array
    y: Array
    estimate: Estimate
    decision: Decision
    reading: Reading | None


MOST_PERIODS = 10**9
"""Largest number of periods of a simulation; each has a row in the result."""


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
    nearest_turn: bool = False,
    w: Preview | ArrayLike | None = None,
    monitor: Monitor | None = None,
    faults: Sequence[Fault] = (),
    stage_cost: OCP | None = None,
    on_step: Callable[[Step], None] | None = None,
    sensor_delay: int = 0,
    input_delay: int = 0,
    late: Callable[[float], bool] | None = None,
    guard: Guard | None = None,
    now: Callable[[], float] = perf_counter,
) -> ClosedLoopResult:
    """Simulate a plant under control; deterministic except for the recorded durations.

    It drives a :class:`~hybrid_mpc.loop.loop.Loop` on a virtual clock. Only the given delays lie between measurement
    and input. Input faults act after the controller, which does not know them.

    The preview extends beyond the end of the run, so reference and weight are evaluated at those times, too. Non-finite
    values there (e.g. after the end of a recording) are replaced by the last value within the run.

    With delays, the estimate must be that of the time at which the input will act: use
    :class:`~hybrid_mpc.estimate.delay.DelayCompensation` as estimator. Before the start, the machine is at rest at
    ``x0`` with the first held input.

    Args:
        plant: The machine.
        estimator: Filter, or :class:`~hybrid_mpc.estimate.kalman.TrueState`, which gets the truth without delay.
        controller: A :class:`~hybrid_mpc.control.safeguard.SafeController`; a bare controller has no fallback.
        reference: ``t (n,) -> x_ref (n, n_x)``, or ``y_ref (n, n_y)`` if the problem weights outputs, or a set-point;
            see :class:`~hybrid_mpc.loop.loop.Loop`.
        dt: Period [s]; it must be that of the models.
        duration: Length [s], rounded to whole periods.
        x0: Initial state ``(n_x,)``.
        seed: Seed of the plant and of the measurement noise.
        weight: Factors on ``q``, ``t (n,) -> (n, n_x)``, also previewed and part of the recorded cost. Default: 1.
        nearest_turn: Whether references of periodic signals are moved by whole periods, as in
            :class:`~hybrid_mpc.loop.loop.Loop`; record and cost have the moved ones. Default: False.
        w: Measured disturbances of the machine, ``t (n,) -> (n, n_w)`` or constant ones ``(n_w,)``: they act on the
            plant, the loop measures them, and previews them if the problem does. Default: those of the model's
            operating point.
        monitor: The monitor. Default: none.
        faults: Faults of sensors, actuators and plant. Default: none.
        stage_cost: Problem whose stage cost is recorded. Default: the controller's.
        on_step: Called after every period, e.g. to show progress. Default: nothing.
        sensor_delay: Periods after which a measurement arrives; faults of a sensor act on arrival. Default: 0.
        input_delay: Periods after which an input reaches the plant: computing and transport. Default: 0.
        late: ``t [s] -> True`` if the solve misses its deadline. Default: never.
        guard: Reaction to alarms of the monitor, which it needs. Default: none.
        now: Clock [s] of the recorded durations, e.g. ``time.thread_time``. Default: the computer's clock.

    Returns:
        The record of ``round(duration / dt)`` periods.

    Raises:
        InputError: If a period, shape or channel is wrong, or a set-point is outside the declared range of its signal.

    Example: see ``tests/loop``; with a scenario::

        result = simulate(plant, ekf, controller, task.reference, weight=task.weight, dt=0.02,
                          duration=task.duration, x0=task.x0, seed=0)
    """
    dt, duration = (float(sampled(value, (), name)) for value, name in ((dt, "dt"), (duration, "duration")))
    check_part(plant, "plant", "a plant", "reset", "step", "measure", "truth", "hidden")
    check_part(estimator, "estimator", "a filter", "model", "start", "update")
    for function, name in ((on_step, "on_step"), (late, "late")):
        if function is not None:
            check_function(function, name)
    if not isinstance(stage_cost, OCP | None):
        raise InputError(f"stage_cost: give an OCP, got {type(stage_cost).__name__} [HM-LOOP-043]")
    if not isinstance(faults, list | tuple) or not all(isinstance(fault, Fault) for fault in faults):
        raise InputError(f"faults: give a list of Fault, got {type(faults).__name__} [HM-LOOP-044]")
    seed = whole(seed, "seed", 0, 2**63 - 1)
    sensor_delay = whole_periods(sensor_delay, "sensor_delay")
    input_delay = whole_periods(input_delay, "input_delay")
    n_w = estimator.model.n_w - n_tracked(estimator)
    surroundings = _make_disturbances(w, estimator.model, n_w)
    loop = Loop(
        estimator, controller, monitor=monitor, reference=reference, weight=weight, nearest_turn=nearest_turn,
        guard=guard, w=surroundings, end=_end(dt, duration, estimator.model.dt), input_delay=input_delay,
        sensor_delay=sensor_delay, now=now,
    )  # fmt: skip
    ocp, model, periods = loop.ocp, loop.model, round(duration / dt)
    plant, faults = install(plant, faults)
    outputs, inputs = (tuple(s.name for s in signals) for signals in (model.outputs, model.inputs))
    check_channels(faults, outputs, inputs)
    cost = _check_cost(ocp, ocp if stage_cost is None else stage_cost)
    # the loop's preview begins when its input will act, but the cost needs the present reference
    acting = Previews(reference, weight, loop.problem, periods * dt) if input_delay else None
    machine = SimulatedMachine(
        plant, vector(x0, ocp.n_x, "x0"), seed, outputs, inputs, faults, dt, sensor_delay, input_delay
    )
    rows: list[dict[str, Any]] = []
    for k in range(periods):
        t = k * dt
        x = sampled(plant.truth(machine.state), (ocp.n_x,), "the plant's truth")
        y = machine.measure(t)
        truth = np.concatenate([x, plant.hidden(machine.state)])
        in_time = None if late is None else partial(_in_time, late, t)
        now_w = np.zeros(0)
        if surroundings is not None:
            now_w = sampled(surroundings(np.array([t])), (1, n_w), "what w returns for one instant")[0]
        if k == 0:
            loop.start(y, now_w, truth=truth, in_time=in_time)
            machine.rest(loop.state.inputs[0])
        else:
            loop.step(y, now_w, truth=truth, in_time=in_time)
        known_w = np.append(now_w, loop.estimate.w[n_w:]) if model.n_w else now_w
        u, u_prev = machine.command(loop.decision.u)
        loop.finish()
        reference_now, factors = loop.previewed if acting is None else acting(t)
        shown = model.output(x, u, known_w, model.p).full().ravel() if ocp.n_y or cost.n_y else x
        if acting is not None and loop.turn is not None:
            reference_now = shortest_way(reference_now, shown if ocp.n_y else x, loop.turn)
        goal = _goal(ocp, model, reference_now[0], loop.decision.solution.steady)
        with np.errstate(over="ignore", invalid="ignore"):  # a huge reference has an infinite cost
            weights = 1.0 if factors is None else factors[0]
            error = shown - goal.y if cost.n_y else None
            stage = float(cost.stage_cost(x, u, goal.x, u - u_prev, weights, u_ref=goal.u, y_error=error))
        step = Step(k, t, x, y, loop.estimate, loop.decision, loop.reading)
        if beyond_range(reference_now[:1], loop.problem):
            goal = goal._replace(reached=False)
        rows.append(_record(step, goal, known_w, stage, loop.spent))
        if on_step is not None:
            on_step(step)
        machine.advance(t, now_w if n_w else None)
    return _build_result(rows, dt, loop.switches)


def _make_disturbances(w: Preview | ArrayLike | None, model: HybridModel, n_w: int) -> Preview | None:
    """The first ``n_w`` disturbances, those measured, as a function of time; None if there are none.

    Raises:
        InputError: If the number of constant disturbances is wrong, or the model has none.
    """
    if not n_w and w is not None:
        raise InputError(f"w: model {model.name} has no measured disturbances; remove w [HM-LOOP-045]")
    if not n_w:
        return None
    if callable(w):
        check_function(w, "w")
        return w
    constant = model.w[:n_w] if w is None else vector(w, n_w, "w")
    return lambda t: np.tile(constant, (len(t), 1))


class _Goal(NamedTuple):
    """Goal of a period: states, inputs and outputs, and whether they can be reached."""

    x: Array
    u: Array
    y: Array
    reached: bool


def _goal(ocp: OCP, model: HybridModel, reference: Array, steady: Steady | None) -> _Goal:
    """The goal of a period from its row of the reference; for outputs with the steady state."""
    if not ocp.n_y:
        return _Goal(reference[: model.n_x].copy(), model.u0, np.full(model.n_y, np.nan), True)
    y = np.where(ocp.q_y > 0, reference[: model.n_y], 0.0)
    if steady is None or not steady.steady:
        return _Goal(model.x0, model.u0, y, False)
    return _Goal(steady.x, steady.u, y, steady.reached)


def _in_time(late: Callable[[float], bool], t: float) -> bool:
    return not late(t)


def _record(
    step: Step, goal: _Goal, w: Array, stage_cost: float, spent: Mapping[str, float]
) -> dict[str, Any]:
    """A period of the result by field, without plans and covariances, which would need too much memory."""
    e, d, reading = step.estimate, step.decision, step.reading
    return {
        "t": step.t, "x": step.x, "y": step.y, "u": d.u, "x_hat": e.x, "h": e.h, "d": e.d, "w": w,
        "innovation": e.innovation, "nis": e.nis, "source": d.source.name, "status": d.status.name,
        "reference": goal.x, "y_ref": goal.y, "reached": goal.reached, "stage_cost": stage_cost, "timing_ms": spent,
        "violation": np.nan if reading is None else reading.violation_w,
        "share": np.nan if reading is None else reading.share,
        "alarm": reading is not None and bool(reading.alarm),
        "valid": reading is not None and not getattr(reading, "validity", 0),
        "given_way": d.solution.given_way,
    }  # fmt: skip


def _build_result(
    rows: Sequence[Mapping[str, Any]], dt: float, switches: tuple[Switch, ...]
) -> ClosedLoopResult:
    columns: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
    seconds = columns.pop("timing_ms")
    timing = {name: 1e3 * np.array([spent[name] for spent in seconds]) for name in TIMED}
    for name, values in columns.items():
        columns[name] = tuple(values) if name in ("source", "status", "given_way") else np.array(values)
    columns["timing_ms"] = {**timing, "total": np.sum(list(timing.values()), axis=0)}
    return ClosedLoopResult(dt=dt, switches=switches, **columns)


def _check_cost(ocp: OCP, cost: OCP) -> OCP:
    if (cost.n_x, cost.n_u) != (ocp.n_x, ocp.n_u):
        raise InputError(
            f"stage_cost: it has {cost.n_x} states and {cost.n_u} inputs, but the controller has {ocp.n_x} and "
            f"{ocp.n_u}. Give a problem of the same sizes [HM-LOOP-046]"
        )
    return cost


def _end(dt: float, duration: float, period: float) -> float:
    """End of the run [s].

    Raises:
        InputError: If a time is not finite, the period is not that of the models, or the run is shorter than a period.
    """
    if not (math.isfinite(duration) and math.isfinite(dt) and dt > 0):
        raise InputError(
            f"dt and duration must be finite, and dt positive; got {dt} s and {duration} s [HM-LOOP-047]"
        )
    if not abs(dt - period) <= 1e-9 * period:
        raise InputError(
            f"dt: got {dt} s, but the model period is {period} s; give this period [HM-LOOP-048]"
        )
    if duration / dt > MOST_PERIODS:
        raise InputError(
            f"duration: {duration:g} s is too long; give at most {MOST_PERIODS:g} periods of {dt} s [HM-LOOP-049]"
        )
    if round(duration / dt) < 1:
        raise InputError(
            f"duration: {duration} s is too short; give at least one period of {dt} s [HM-LOOP-050]"
        )
    return round(duration / dt) * dt


@dataclass(frozen=True)
class ClosedLoopResult:
    """A closed loop of n periods; row k belongs to ``t_k = k dt``.

    Args:
        dt: Period [s].
        t: ``(n,)`` [s].
        x: True states ``(n, n_x)`` at ``t_k``.
        y: Measurements ``(n, n_y)`` as they arrived, faults and noise included; NaN for a dropout.
        u: Commanded inputs ``(n, n_u)``, held from ``t_k`` on; with an input delay, they act later by this delay.
        x_hat: Estimated states ``(n, n_x)``; with an input delay those of the time at which ``u`` will act.
        h: Estimated hidden states ``(n, n_h)``.
        d: Estimated unmeasured disturbances ``(n, n_d)``.
        reference: Reference of the states ``(n, n_x)`` at ``t_k``; if the problem weights outputs, the steady state of
            the set-point.
        source: Name of the :class:`~hybrid_mpc.control.safeguard.Source` of each input.
        status: Name of the :class:`~hybrid_mpc.control.problem.Status` of each solve.
        stage_cost: Stage cost ``(n,)`` per second of the true state and the applied input, with the weight factors at
            ``t_k`` and without penalties of soft bounds.
        timing_ms: Durations ``(n,)`` [ms] of ``estimate``, ``solve``, ``monitor``, ``prepare`` and ``total``. The only
            field in which two runs may differ.
        violation: Violation of the energy balance ``(n,)`` [W]; NaN if the monitor does not read it.
        share: Largest level of the monitor over its threshold ``(n,)`` [-]; NaN without limits.
        alarm: ``(n,)``, True while the monitor alarms.
        switches: Changes of the guard's mode, in their order. Default: none.
        valid: ``(n,)``, True if the monitor's reading was valid. Default: unknown.
        innovation: Innovations of the estimator ``(n, n_y)`` [output units]; NaN without a measurement. Default:
            unknown.
        nis: Normalised innovations squared ``(n,)`` [-]; NaN without a measurement. Default: unknown.
        w: Measured disturbances ``(n, n_w)`` that act from ``t_k`` on, and estimates of tracked parameters as the last
            columns. Default: none.
        y_ref: Reference of the outputs ``(n, n_y)`` at ``t_k``; NaN if the reference is one of states. Default:
            unknown.
        reached: ``(n,)``, False if the set-point cannot be reached, or is outside the declared range of its signal.
            Default: unknown.
        given_way: For each period the hard bounds that the plan violates: largest violation by name, as in
            :class:`~hybrid_mpc.control.problem.Solution`. Default: unknown.

    Example:
        >>> one = np.ones((2, 1))
        >>> result = ClosedLoopResult(0.1, np.array([0.0, 0.1]), one, one, one, one, one, one, 0 * one,
        ...     ("MPC",) * 2, ("SOLVED",) * 2, np.array([2.0, 4.0]), {},
        ...     one[:, 0], one[:, 0], np.zeros(2, bool))
        >>> round(result.cost, 6), result.tracking_rmse
        (0.6, array([1.]))
    """

    dt: float
    t: Array
    x: Array
    y: Array
    u: Array
    x_hat: Array
    h: Array
    d: Array
    reference: Array
    source: tuple[str, ...]
    status: tuple[str, ...]
    stage_cost: Array
    timing_ms: Mapping[str, Array]
    violation: Array
    share: Array
    alarm: NDArray[np.bool_]
    switches: tuple[Switch, ...] = ()
    valid: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    innovation: Array = field(default_factory=lambda: np.zeros((0, 0)))
    nis: Array = field(default_factory=lambda: np.zeros(0))
    w: Array = field(default_factory=lambda: np.zeros((0, 0)))
    y_ref: Array = field(default_factory=lambda: np.zeros((0, 0)))
    reached: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    given_way: tuple[Mapping[str, float], ...] = ()

    @property
    def tracks_outputs(self) -> bool:
        """Whether the reference is one of outputs."""
        return bool(self.y_ref.size) and bool(np.all(np.isfinite(self.y_ref)))

    @property
    def mode(self) -> tuple[str, ...]:
        """Name of the guard's mode in each period."""
        names = ["NORMAL"] * len(self.t)
        for switch in self.switches:
            first = int(np.searchsorted(self.t, switch.t - 0.5 * self.dt))
            names[first:] = [switch.after.name] * (len(names) - first)
        return tuple(names)

    @property
    def cost(self) -> float:
        """Closed-loop cost ``J = sum_k stage_cost_k dt`` on the true state."""
        return float(np.sum(self.stage_cost) * self.dt)

    @property
    def tracking_rmse(self) -> Array:
        """Root mean square deviations from the reference [units of the signals]: of the true states ``(n_x,)``, or of
        the measured outputs ``(n_y,)`` if the reference is one of outputs.
        """
        error = self.y - self.y_ref if self.tracks_outputs else self.x - self.reference
        return np.asarray(np.sqrt(np.nanmean(error**2, axis=0)))

    def to_pandas(self, model: HybridModel | None = None) -> pd.DataFrame:
        """Table with one row for each period. Needs pandas.

        Args:
            model: Names and units of the columns: ``"x phi [rad]"``, ``"y phi [rad]"``, ``"t [s]"``. Default: numbers
                without units, ``x_0``, ``x_1``, ``t``.

        Raises:
            InputError: If the numbers of the model's states, inputs or outputs are different.

        Example: ``result.to_pandas(model)["u torque [N m]"]``
        """
        with named_extra("the table"):
            import pandas as pd

        columns: dict[str, object] = {"t" if model is None else "t [s]": self.t}
        for name in ("x", "y", "u", "x_hat", "h", "d", "w", "reference", "y_ref"):
            values = getattr(self, name)
            if not values.size or (name == "y_ref" and not self.tracks_outputs):
                continue
            labels = _label_columns(name, values.shape[1], model)
            columns.update({label: values[:, i] for i, label in enumerate(labels)})
        for name in ("source", "status", "stage_cost", "violation", "share", "alarm"):
            unit = "" if model is None or name not in UNITS else f" [{UNITS[name]}]"
            columns[name + unit] = getattr(self, name)
        for name in sorted({name for period in self.given_way for name in period}):
            columns[f"given_way {name}"] = [period.get(name, 0.0) for period in self.given_way]
        unit = "_ms" if model is None else " [ms]"
        columns.update({f"{name}{unit}": values for name, values in self.timing_ms.items()})
        return pd.DataFrame(columns)


def _label_columns(name: str, n: int, model: HybridModel | None) -> list[str]:
    if model is None or name == "h":
        return [f"{name}_{i}" for i in range(n)]
    if name == "d" and model.disturbance_model is not None:
        return [f"d {d.at} {d.signal}" for d in model.disturbance_model]
    outputs, inputs = model.outputs, model.inputs
    groups = {"y": outputs, "y_ref": outputs, "u": inputs, "d": inputs, "w": model.disturbances}
    signals = groups.get(name, model.states)
    if len(signals) != n:
        raise InputError(
            f"to_pandas: the loop has {n} columns of {name}, but model {model.name} has {len(signals)}. Give the "
            "model of the loop [HM-LOOP-051]"
        )
    return [f"{name} {s.name} [{s.unit}]" for s in signals]
