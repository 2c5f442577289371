"""The loop: order of the computations in a period, and the state between periods.

A period of :class:`Loop` is::

    step(y, w) estimate  from the sample and the input applied since the previous sample
              guard      the mode wanted by the last period begins; its estimator gets the sample, too
              decide     the controller of that mode solves; the safeguards return an admissible input
    (the driver applies the input)
    finish()  monitor    compares the model with the sample, the estimate and the applied input
              guard      determines the mode of the next period
              prepare    the part of the next solve that needs no sample
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.problem import Controller, Status
from hybrid_mpc.control.safeguard import Decision, SafeController, Source
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.delay import filtered, sees_truth, whole_periods
from hybrid_mpc.estimate.kalman import Estimate, Estimator
from hybrid_mpc.loop.guard import Guard, GuardedController, GuardState, Switch
from hybrid_mpc.loop.preview import (
    Forecast,
    Preview,
    Previews,
    beyond_range,
    held,
    n_tracked,
    refuse_beyond,
    shortest_way,
    unreached,
    with_unknown,
)
from hybrid_mpc.machine.signals import nearest_turn as moved_by_turns
from hybrid_mpc.model.limits import check_function, check_part, floats, sampled, whole
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
TIMED = ("estimate", "solve", "monitor", "prepare")
"""Timed parts of a period: the first two before the input, the others after it."""
MOST_SKIPPED = 10**12
"""Largest number of periods that can be skipped at once, so that the time [s] stays finite."""


class Reading(Protocol):
    """Reading of a monitor in one period."""

    @property
    def violation_w(self) -> float:
        """Violation of the energy balance [W]; NaN if the energy is not read."""

    @property
    def share(self) -> float:
        """Largest level over its threshold [-]; NaN without limits."""

    @property
    def alarm(self) -> bool:
        """True while the monitor alarms."""


class Monitor(Protocol):
    """Interface of a monitor; a pure function of its state."""

    def initial(self) -> Any:
        """State before the first period."""

    def update(self, state: Any, y: Array, u_prev: Array, estimate: Estimate) -> tuple[Any, Reading]:
        """State and reading after the measurement ``y``, with ``u_prev`` held before it."""


@dataclass(frozen=True)
class LoopState:
    """Complete state of a loop; :meth:`Loop.restore` continues from it.

    Args:
        k: Number of the period that the last step began.
        y: Measurement of that period ``(n_y,)``; NaN if missing.
        estimate: The estimate; None after a long break, until the next sample.
        decision: The held input, and the plan for the next solve.
        guard: Modes, and the backup's estimate.
        monitor: The monitor's state; None without a monitor.
        inputs: Inputs ``(n_u,)`` from the one applied before the sample to the last one, the oldest first.
        mode: Source of the input: the controller (automatic) or an operator (manual).
        finished: Whether :meth:`Loop.finish` has run for this period.
    """

    k: int
    y: Array
    estimate: Estimate | None
    decision: Decision
    guard: GuardState
    monitor: Any
    inputs: tuple[Array, ...]
    mode: Literal["automatic", "manual"] = "automatic"
    finished: bool = False


@dataclass(frozen=True)
class _Ahead:
    """Prepared data of period k: its previews, and the part of its solve that needs no sample."""

    k: int
    decision: Decision
    previews: tuple[Array, Array | None]
    prepared: Any


class Loop:
    """Runs estimator, controller and monitor, one period at a time.

    A driver provides the clock: :func:`~hybrid_mpc.loop.simulate` a virtual clock,
    :class:`~hybrid_mpc.loop.realtime.Runner` a real clock, or your own code::

        loop = Loop(estimator, controller, monitor=monitor, reference=reference)
        u = loop.start(read())
        while running():
            write(u)
            loop.finish()  # monitor, and the next linearization, while the input acts
            wait()
            u = loop.step(read())

    ``finish`` may be omitted; the next step then calls it, with the same inputs. No sensor, model or reference value
    can raise an exception after the start, and an input is always within the limits.

    Args:
        estimator: Filter, or :class:`~hybrid_mpc.estimate.kalman.TrueState`, which needs the truth in each step.
        controller: A :class:`~hybrid_mpc.control.safeguard.SafeController`; a bare controller has no fallback.
        monitor: The monitor. Default: none.
        reference: ``t (n,) [s] -> (n, n_x)``, or ``(n, n_y)`` if the problem weights outputs, previewed over the
            horizon if the problem does so, with ``n_p`` more columns if the economic stage cost has parameters; or a
            set-point ``(n_x,)`` or ``(n_y,)``. Default: the operating point.
        nearest_turn: True: references of periodic signals are moved by whole periods, the present one to the nearest of
            the estimate, each later one to the nearest of the one before; a set-point is then reached the short way.
            Default: False; references count turns.
        weight: Factors on ``q``, ``t (n,) -> (n, n_x)``. Default: 1.
        guard: Reaction to alarms of the monitor, which it needs. Default: none.
        w: Forecast of the measured disturbances, ``t (n,) [s] -> (n, n_measured)``, for a problem that previews them.
            Default: none; the last measured values are held.
        end: Time [s] beyond which non-finite previews hold their last value. Default: never.
        input_delay: Periods after which an input acts, as in the estimator; shifts the preview. Default: 0.
        sensor_delay: Periods after which a measurement arrives; the monitor uses it to pair measurement and input.
            Default: 0.
        now: Clock [s] of the durations. Default: the computer's clock.

    Raises:
        InputError: If sizes, periods or delays do not match, a guard has no monitor, or a set-point is outside the
            declared range of its signal.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
        >>> from hybrid_mpc.control.ocp import OCP; from hybrid_mpc.control.rti import CondensedController
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, height = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "m"),)
        >>> model = HybridModel.of("tank", 1.0, height, (Signal("u", "m/s"),), height,
        ...     x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> ekf = ExtendedKalmanFilter(model, sigma_y=[0.01], sigma_x=[0.01], sigma_x0=[1.0])
        >>> loop = Loop(ekf, CondensedController(model, OCP(9, [1.0], [0.1], [0.1], [-1.0], [1.0])), reference=[0.5])
        >>> level, u = 0.0, loop.start([0.0])
        >>> for _ in range(9):
        ...     level += u[0]
        ...     u = loop.step([level])
        >>> round(float(level), 3)
        0.5
    """

    def __init__(
        self,
        estimator: Estimator,
        controller: SafeController | Controller,
        *,
        monitor: Monitor | None = None,
        reference: Preview | ArrayLike | None = None,
        weight: Preview | None = None,
        nearest_turn: bool = False,
        guard: Guard | None = None,
        w: Preview | None = None,
        end: float = math.inf,
        input_delay: int = 0,
        sensor_delay: int = 0,
        now: Callable[[], float] = perf_counter,
    ) -> None:
        check_part(estimator, "estimator", "a filter", "model", "start", "update")
        check_function(now, "now")
        if not isinstance(controller, SafeController):
            check_part(controller, "controller", "a controller", "model", "ocp", "solve")
        if monitor is not None:
            check_part(monitor, "monitor", "a monitor", "initial", "update")
        if not isinstance(guard, Guard | None):
            raise InputError(f"guard: give a Guard, got {type(guard).__name__} [HM-LOOP-018]")
        safe = controller if isinstance(controller, SafeController) else SafeController(controller)
        self.model, self.ocp = estimator.model, safe.controller.ocp
        self.problem = safe.controller.problem
        """Model and control problem, prepared."""
        _check_models(self.model, safe.controller.model)
        _check_monitor(monitor, self.model)
        if guard is not None and monitor is None:
            raise InputError("guard: a guard reacts to alarms of a monitor; give monitor=, too [HM-LOOP-019]")
        self._estimator, self._safe, self._monitor = estimator, safe, monitor
        self._control = GuardedController(safe, guard)
        self._delay = whole_periods(input_delay, "input_delay")
        self._n_inputs = self._delay + whole_periods(sensor_delay, "sensor_delay") + 1
        self._previews = Previews(reference, weight, self.problem, end)
        self._tracked = n_tracked(estimator)
        self._forecast = Forecast(w, self.ocp, self.n_measured, self.model.dt, self._tracked)
        self._truth, self._now = sees_truth(estimator), now
        followed = self.model.outputs if self.ocp.n_y else self.model.states
        self._turn_y = np.array([s.period for s in self.model.outputs])
        self._turns = bool(np.isfinite(self._turn_y).any())
        turn = np.array([s.period for s in followed])
        self.turn: Array | None = turn if nearest_turn and np.isfinite(turn).any() else None
        """Periods ``(n,)`` by whose multiples references are moved; None: they stay."""
        self._state: LoopState | None = None
        self._decide_late: Callable[[], tuple[Decision, GuardState]] | None = None
        self._ahead: _Ahead | None = None
        self.reading: Reading | None = None
        """The monitor's last reading; None without a monitor."""
        self.previewed: tuple[Array, Array | None] = np.zeros((0, self.ocp.n_x)), None
        """Reference ``(m, n_x)`` and factors on ``q`` (None for 1) of this period's decision."""
        self.spent = dict.fromkeys(TIMED, 0.0)
        """Durations [s] of this period, by the names of ``TIMED``."""

    @property
    def n_measured(self) -> int:
        """Number of measured disturbances, without the parameters that the estimator tracks."""
        return self.model.n_w - self._tracked

    def start(
        self,
        y: ArrayLike | None,
        w: ArrayLike | None = None,
        *,
        applied: ArrayLike | None = None,
        truth: ArrayLike | None = None,
        reference: ArrayLike | None = None,
        in_time: Callable[[], bool] | None = None,
    ) -> Array:
        """Start while the machine is at rest: first estimate, first plan (which may take longer), first input.

        The arguments are those of :meth:`step`; ``applied`` is the input applied until now, by default that of the
        operating point. Returns the input ``(n_u,)`` to hold from now on. Raises InputError also for a ``reference``
        outside the declared range of its signal.
        """
        if in_time is not None:
            check_function(in_time, "in_time")
        sample, measured = self._sample(y), self._check_disturbances(w)
        x_ref, factors = self._read_preview(0, reference)
        if reference is not None:
            refuse_beyond(x_ref, self.problem)
        estimate = self._estimator.start(
            self._choose_measurement(sample, truth), 0.0, **self._select_measured(measured)
        )
        x_ref = self._near(x_ref, estimate, self.model.u0)
        until = None if applied is None else sampled(applied, (self.ocp.n_u,), "applied")
        ahead = self._predict_disturbances(0, measured, estimate)
        first = self._safe.initial(estimate, until, x_ref, factors, ahead)
        self._state = self._first_state(sample, estimate, first)
        self._ahead, self.reading, self.spent = None, None, dict.fromkeys(TIMED, 0.0)
        return self._decide(first, x_ref, factors, in_time, measured)

    def step(
        self,
        y: ArrayLike | None,
        w: ArrayLike | None = None,
        *,
        applied: ArrayLike | None = None,
        reference: ArrayLike | None = None,
        truth: ArrayLike | None = None,
        in_time: Callable[[], bool] | None = None,
    ) -> Array:
        """Run one period: estimate and decide.

        Args:
            y: Sample ``(n_y,)``; None or NaN for missing values.
            w: Present measured disturbances ``(n_w,)``; NaN or None: the last values are held. ``(m, n_w)``, with a row
                for the present and each following period, is a forecast that replaces the loop's own. Default: None.
            applied: Input ``(n_u,)`` that was really applied since the last step, if the actuator reports it; in manual
                mode that of the operator. Default: the input that the last step returned.
            reference: A set-point or ``(m, columns)`` from now on in steps of ``dt``, which replaces the loop's own.
                Default: the loop's own.
            truth: The true ``(x, h)``, for an estimator that needs it. Default: none.
            in_time: Called before the solve: whether there is enough time for it. If not, the last plan is followed, as
                in :meth:`late`. Default: there is.

        Returns:
            The input ``(n_u,)`` to hold from now on, within the limits.

        Raises:
            InputError: If a shape is wrong. Values of numbers never raise.
        """
        if in_time is not None:
            check_function(in_time, "in_time")
        self.finish()
        sample, measured, state = self._sample(y), self._check_disturbances(w), self.state
        previous, inputs = state.decision, state.inputs
        if applied is not None:
            previous = _replace_input(previous, sampled(applied, (self.ocp.n_u,), "applied"))
            inputs = (*inputs[:-1], previous.u)
        begin, k = self._now(), state.k + 1
        x_ref, factors = self._read_preview(k, reference)
        seen = self._choose_measurement(sample, truth)
        also = self._select_measured(measured)
        if state.estimate is None:
            estimate = self._estimator.start(seen, k * self.model.dt, **also)
        else:
            estimate = self._estimator.update(state.estimate, seen, previous.u, **also)
        x_ref = self._near(x_ref, estimate, previous.u)
        if self._turns:
            sample = moved_by_turns(sample, self._outputs(estimate, previous.u), self._turn_y)
        self._state = replace(state, k=k, y=sample, estimate=estimate, inputs=inputs, finished=False)
        self.spent = {**dict.fromkeys(TIMED, 0.0), "estimate": self._now() - begin}
        return self._decide(previous, x_ref, factors, in_time, measured)

    def _decide(
        self, previous: Decision, x_ref: Array, factors: Array | None, in_time: Callable[[], bool] | None,
        measured: Array | None = None,
    ) -> Array:  # fmt: skip
        """The input of this period, by the controller of the guard's mode or by the operator."""
        state, estimate = self.state, self.estimate
        self.previewed = x_ref, factors
        w = self._predict_disturbances(state.k, measured, estimate)
        now = self._select_measured(measured).get("w")
        guard = self._control.measured(state.guard, self.t, state.y, previous.u, now)
        self._decide_late = partial(self._control.decide, guard, previous, estimate, x_ref, late=True)
        may_solve = in_time is None or in_time()
        begin = self._now()
        if state.mode == "manual":
            decision = self._follow_operator(previous, estimate)
        else:
            prepared = self._take_preparation(previous, factors)
            decision, guard = self._control.decide(
                guard, previous, estimate, x_ref, factors, prepared=prepared, late=not may_solve, w=w
            )
        self.spent["solve"] = self._now() - begin
        self._state = replace(state, decision=decision, guard=guard)
        return decision.u

    def late(self) -> Array:
        """The input of this period if the solve missed its deadline: that of the last plan, shifted by one period.

        Call it after :meth:`step`; it replaces the returned input.
        """
        if self._decide_late is not None and self.state.mode == "automatic":
            decision, guard = self._decide_late()
            self._state = replace(self.state, decision=decision, guard=guard)
        return self.state.decision.u

    def finish(self) -> None:
        """Computations after the input is applied: monitor, next mode of the guard, preparation of the next solve.

        The next :meth:`step` calls it if it was not called; a second call does nothing.
        """
        state = self.state
        if state.finished:
            return
        self._decide_late = None
        begin, guard, memory = self._now(), state.guard, state.monitor
        if self._monitor is not None:
            memory, self.reading = self._monitor.update(
                memory, state.y, state.inputs[0], filtered(self.estimate)
            )
            guard = self._control.watched(guard, self.t, self.reading)
        inputs = (*state.inputs[1:], state.decision.u)
        self._state = state = replace(state, guard=guard, monitor=memory, inputs=inputs, finished=True)
        middle = self._now()
        if state.mode == "automatic":
            previews = self._previews((state.k + 1 + self._delay) * self.model.dt)
            prepared = self._control.prepare(guard, state.decision, previews[1])
            self._ahead = _Ahead(state.k + 1, state.decision, previews, prepared)
        self.spent |= {"monitor": middle - begin, "prepare": self._now() - middle}

    def skip(self, n: int = 1) -> None:
        """Account for ``n`` periods without a step, e.g. because a step took too long; the input was held.

        The estimator predicts through them without samples; after more than 250 it restarts at the next sample.
        """
        n = whole(n, "skip [periods]", 0, MOST_SKIPPED)
        self.finish()
        state, missing = self.state, np.full(self.model.n_y, np.nan)
        estimate, guard, u = state.estimate, state.guard, state.decision.u
        # skipped periods after which the estimator restarts, since its prediction has become useless
        if n > 250:
            estimate = None
        elif estimate is not None:
            for i in range(1, n + 1):
                estimate = self._estimator.update(estimate, missing, u)
                guard = self._control.measured(guard, (state.k + i) * self.model.dt, missing, u)
        inputs = (*state.inputs, *([u] * min(n, self._n_inputs)))[-self._n_inputs :]
        self._state = replace(state, k=state.k + n, estimate=estimate, guard=guard, inputs=inputs)

    def warm_up(self) -> None:
        """Call every part once at the operating point and discard the results, since first calls are slow."""
        m = self.model
        trial, y = copy(self), m.output(m.x0, m.u0, m.w, m.p).full().ravel()
        truth = np.concatenate([m.x0, np.zeros(m.n_h)])
        x_ref, factors = self._read_preview(0, None)
        estimate = self._estimator.start(truth if self._truth else y, 0.0)
        first = self._safe.initial(estimate)
        trial._state, trial._ahead = self._first_state(y, estimate, first), None
        trial.spent = dict.fromkeys(TIMED, 0.0)
        trial._decide(first, x_ref, factors, None)
        trial.step(y, truth=truth)
        trial.late()
        trial.finish()

    def restore(self, state: LoopState) -> Array:
        """Continue from ``state``, the :attr:`state` of a loop with the same parts; returns the held input.

        Raises:
            InputError: If it is not a state, or that of a loop with another model or horizon.
        """
        _check_state(state, self.model, self.ocp, self._monitor)
        self._state, self._decide_late, self._ahead, self.reading = state, None, None, None
        return state.decision.u

    @property
    def mode(self) -> Literal["automatic", "manual"]:
        """Source of the input: the controller in ``"automatic"``; in ``"manual"`` an operator, who gives ``applied``.

        In manual mode the estimator uses the applied inputs, so there is no wind-up, and a step returns the operator's
        last input. Back in automatic mode, the controller starts from this input, within ``du_max``.
        """
        return self.state.mode

    @mode.setter
    def mode(self, mode: Literal["automatic", "manual"]) -> None:
        if not isinstance(mode, str) or mode not in ("automatic", "manual"):
            raise InputError(f"mode: give 'automatic' or 'manual', got {mode!r:.80} [HM-LOOP-020]")
        self._state = replace(self.state, mode=mode)

    @property
    def state(self) -> LoopState:
        """Complete state of the loop, after :meth:`start`."""
        if self._state is None:
            raise InputError("loop: not started; call start() with the first sample first [HM-LOOP-021]")
        return self._state

    @property
    def t(self) -> float:
        """Time [s] of this period, since the start."""
        return self.state.k * self.model.dt

    @property
    def estimate(self) -> Estimate:
        """The estimate of this period."""
        estimate = self.state.estimate
        assert estimate is not None  # every step makes one
        return estimate

    @property
    def decision(self) -> Decision:
        """The held input, and its source."""
        return self.state.decision

    @property
    def switches(self) -> tuple[Switch, ...]:
        """All changes of the guard's mode."""
        return self.state.guard.switches

    @property
    def standing(self) -> Array:
        """The operating point as reference ``(columns,)``: the default reference."""
        return self.problem.standing()[0]

    @property
    def beyond(self) -> str:
        """The first set-point of this period's preview outside its signal's declared range, as text; else empty.

        The loop follows such a set-point as far as the limits allow.
        """
        return beyond_range(self.previewed[0], self.problem)

    @property
    def unreached(self) -> str:
        """Why the target of this period's plan is not at the set-point of outputs, as text; else empty.

        Either no steady state was found, or it names outputs, the nearest values, and inputs at a limit.
        """
        return unreached(self.decision.solution.steady, self.problem)

    @property
    def safe_input(self) -> Array | None:
        """Input ``(n_u,)`` with which the machine may be left alone; None if not declared."""
        return None if self._safe.safe_input is None else self._safe.safe_input.copy()

    def _first_state(self, sample: Array, estimate: Estimate, first: Decision) -> LoopState:
        memory = None if self._monitor is None else self._monitor.initial()
        return LoopState(0, sample, estimate, first, GuardState(), memory, (first.u,) * self._n_inputs)

    def _sample(self, y: ArrayLike | None) -> Array:
        return (
            np.full(self.model.n_y, np.nan) if y is None else sampled(y, (self.model.n_y,), "the measurement")
        )

    def _check_disturbances(self, w: ArrayLike | None) -> Array | None:
        """Measured disturbances ``(m, n_w)``, a row for the present and each known period; None if not measured."""
        if w is None:
            return None
        name, n_w = "w, the measured disturbances and their forecast,", self.model.n_w
        given: ArrayLike = w
        if self._tracked:
            given = floats(w, name)
            n_w = n_w if given.shape[-1:] == (n_w,) else self.n_measured
        rows = sampled(given, (None, n_w), name)
        if not len(rows):
            raise InputError(
                "w: no rows; give the measured disturbances, or a row for each period ahead [HM-LOOP-022]"
            )
        return rows if n_w == self.model.n_w else with_unknown(rows, self._tracked)

    def _select_measured(self, measured: Array | None) -> dict[str, Array]:
        """Keyword argument ``w`` of the estimator; empty if the model has no measured disturbances."""
        if not self.model.n_w:
            return {}
        return {"w": np.full(self.model.n_w, np.nan) if measured is None else measured[0]}

    def _predict_disturbances(self, k: int, measured: Array | None, estimate: Estimate) -> Array | None:
        """Measured disturbances ``(m, n_w)`` in the solve of period k; None: those of the estimate."""
        if measured is not None and len(measured) > 1:
            return held(measured[self._delay :] if len(measured) > self._delay else measured[-1:], estimate.w)
        ahead = self._forecast((k + self._delay) * self.model.dt)
        if ahead is None:
            return None
        if not self._delay:
            ahead[0] = estimate.w
        return held(ahead, estimate.w)

    def _choose_measurement(self, sample: Array, truth: ArrayLike | None) -> Array:
        """Input of the estimator: the sample, or the truth."""
        if not self._truth:
            return sample
        if truth is None:
            raise InputError(
                "truth: this estimator needs the true state; give truth=, or use a filter [HM-LOOP-023]"
            )
        return sampled(truth, (None,), "the truth")

    def _read_preview(self, k: int, reference: ArrayLike | None) -> tuple[Array, Array | None]:
        """Reference and factors of period k, at the times at which its inputs act."""
        if self._ahead is not None and self._ahead.k == k:
            x_ref, factors = self._ahead.previews
        else:
            x_ref, factors = self._previews((k + self._delay) * self.model.dt)
        if reference is not None:
            x_ref = sampled(reference, (None, x_ref.shape[1]), self.problem.reference_name)
            if not len(x_ref):
                raise InputError(
                    "reference: no rows; give a set-point, or a row for each period ahead [HM-LOOP-024]"
                )
        return x_ref, factors

    def _outputs(self, estimate: Estimate, u: Array) -> Array:
        """Outputs ``(n_y,)`` of an estimate under the input ``u``."""
        m, (on_u, _, on_y) = self.model, self.model.disturbed
        y = m.output(estimate.x, u + on_u @ estimate.d, estimate.w if m.n_w else m.w, m.p).full().ravel()
        return np.asarray(y + on_y @ estimate.d)

    def _near(self, x_ref: Array, estimate: Estimate, u: Array) -> Array:
        """The reference with periodic signals moved by whole periods, if the loop has ``nearest_turn``."""
        if self.turn is None:
            return x_ref
        return shortest_way(x_ref, self._outputs(estimate, u) if self.ocp.n_y else estimate.x, self.turn)

    def _take_preparation(self, previous: Decision, weight: Array | None) -> Any:
        """The preparation of :meth:`finish`, if it belongs to this solve."""
        ahead = self._ahead
        if ahead is None or ahead.decision is not previous:
            return None
        used = ahead.previews[1]
        same = used is weight or (used is not None and weight is not None and np.array_equal(used, weight))
        return ahead.prepared if same else None

    def _follow_operator(self, previous: Decision, estimate: Estimate) -> Decision:
        """Decision in manual mode: the operator's input, and a plan from which automatic mode can start."""
        u, plan = previous.u, previous.solution
        if estimate.finite and np.all(np.isfinite(u)):
            plan = self._safe.controller.initial(estimate, np.tile(u, (self.ocp.horizon, 1)))
            plan = plan.beginning_with(u)
        return Decision(u, Source.MANUAL, plan, Status.INITIAL, 0)


def _replace_input(decision: Decision, u: Array) -> Decision:
    """The decision with the applied input ``u``; non-finite entries are those of the decision."""
    u = np.where(np.isfinite(u), u, decision.u)
    if np.array_equal(u, decision.u):
        return decision
    return replace(decision, u=u, solution=decision.solution.beginning_with(u))


def _check_models(estimated: HybridModel, controlled: HybridModel) -> None:
    sizes = [(m.n_x, m.n_h, m.n_u) for m in (estimated, controlled)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"estimator: its model {estimated.name} has (n_x, n_h, n_u) = {sizes[0]}, but the controller's model "
            f"{controlled.name} has {sizes[1]}. Give both the same model [HM-LOOP-025]"
        )
    if abs(controlled.dt - estimated.dt) > 1e-9 * estimated.dt:
        raise InputError(
            f"estimator: its period is {estimated.dt} s, but the controller's is {controlled.dt} s. Give both the same "
            "model"
            " [HM-LOOP-026]"
        )


def _check_monitor(monitor: Monitor | None, model: HybridModel) -> None:
    own: HybridModel | None = getattr(monitor, "model", None)
    if own is None:
        return
    sizes = [(m.n_x, m.n_h, m.n_u, m.n_y) for m in (own, model)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"monitor: its model {own.name} has (n_x, n_h, n_u, n_y) = {sizes[0]}, but the estimator's model "
            f"{model.name} has {sizes[1]}. Give both the same model, e.g. kit.monitor({model.name!r}) [HM-LOOP-027]"
        )


def _check_state(state: LoopState, model: HybridModel, ocp: OCP, monitor: Monitor | None) -> None:
    if not isinstance(state, LoopState):
        raise InputError(f"restore: give a value of Loop.state, got {type(state).__name__} [HM-LOOP-028]")
    plan, estimate = state.decision.solution, state.estimate
    sizes = [
        ("y", state.y, model.n_y),
        ("input", state.decision.u, model.n_u),
        ("plan", plan.u, ocp.horizon * ocp.n_u),
    ]
    if estimate is not None and model.n_w:
        sizes += [("measured disturbances", estimate.w, model.n_w)]
    if estimate is not None:
        sizes += [("estimate", estimate.x, model.n_x), ("hidden state", estimate.h, model.n_h)]
    wrong = [
        f"{name} has {np.size(value)} numbers instead of {n}"
        for name, value, n in sizes
        if np.size(value) != n
    ]
    if (state.monitor is None) != (monitor is None):
        wrong.append(
            f"the state is of a loop with {'no' if state.monitor is None else 'a'} monitor, this loop has "
            f"{'a' if monitor else 'no'} [HM-LOOP-029]"
        )
    if wrong:
        raise InputError(
            f"restore: the state belongs to a loop with other parts: {'; '.join(wrong)}. Build the loop with the same "
            "parts [HM-LOOP-030]"
        )
