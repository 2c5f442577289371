"""The loop: the one place that knows what happens in a period, in which order, and what is remembered.

A period of :class:`Loop` is::

    step(y, w) estimate  from the sample, and the input that acted since the one before
              guard      the mode that the last period asked for begins; its estimator takes the sample too
              decide     the controller of that mode solves; the safeguards make an admissible input of it
    (the driver hands the input over)
    finish()  monitor    compares the model with the sample, the estimate and the input that acted
              guard      asks for the mode of the next period
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
from hybrid_mpc.loop.preview import Forecast, Preview, Previews, held
from hybrid_mpc.model.limits import check_function, check_part, sampled, whole
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
TIMED = ("estimate", "solve", "monitor", "prepare")
"""What of a period is timed: between the sample and the input, and after it."""
MOST_SKIPPED = 10**12
"""Most periods that are skipped at a time: the time [s] must stay a number."""
LONG = 250
"""Skipped periods after which the estimate starts anew: a filter knows little after as many without a sample."""


class Reading(Protocol):
    """What a monitor says of one period."""

    @property
    def violation_w(self) -> float:
        """Violation of the energy balance [W]; NaN where the energy is not read."""

    @property
    def share(self) -> float:
        """Largest level over its threshold [-]; NaN without limits."""

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
class LoopState:
    """All that a loop remembers; :meth:`Loop.restore` goes on from it.

    Args:
        k: Number of the period that the last step began.
        y: Its measurement ``(n_y,)``; NaN where there was none.
        estimate: None after a long break, until the next sample.
        decision: The input that is held, and the plan to go on from.
        guard: Modes and the backup's estimate.
        monitor: The monitor's memory; None without one.
        inputs: Inputs ``(n_u,)`` from the one that acted before the sample to the last one, the oldest first.
        mode: Who gives the input.
        finished: Whether the monitor has seen the period.
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
    """What was made ready for the step of period k: its previews, and the solver's part that needs no sample."""

    k: int
    decision: Decision
    previews: tuple[Array, Array | None]
    prepared: Any


class Loop:
    """Estimator, controller and monitor, a period at a time.

    Its driver has the clock: :func:`~hybrid_mpc.loop.simulate` a virtual one,
    :class:`~hybrid_mpc.loop.realtime.Runner` a real one, or a loop of your own::

        loop = Loop(estimator, controller, monitor=monitor, reference=reference)
        u = loop.start(read())
        while running():
            write(u)
            loop.finish()  # monitor, and the next linearization, while the input acts
            wait()
            u = loop.step(read())

    The inputs are the same whether ``finish`` is called or left to the next step. Numbers never raise: an input is
    within the limits whatever sample, model or solver say.

    Args:
        estimator: Filter, or :class:`~hybrid_mpc.estimate.kalman.TrueState`, which each step has to be given the truth.
        controller: A :class:`~hybrid_mpc.control.safeguard.SafeController`; a bare controller is guarded without
            fallback.
        monitor: Default: none.
        reference: ``t (n,) [s] -> (n, n_x)``, or ``(n, n_y)`` where the problem weighs outputs, previewed over the
            horizon if the problem says so, with ``n_p`` more columns where the economic stage cost has parameters; or a
            set-point ``(n_x,)`` or ``(n_y,)``. Default: the operating point.
        weight: Factors on ``q``, ``t (n,) -> (n, n_x)``. Default: 1.
        guard: What to do on alarms of the monitor, which it needs. Default: nothing.
        w: Forecast of the measured disturbances, ``t (n,) [s] -> (n, n_w)``, for a problem that previews them. Default:
            none; those measured last are held.
        end: Time [s] beyond which previews that are not finite hold their last value. Default: never.
        input_delay: Periods after which an input acts, as the estimator knows it; shifts the preview.
        sensor_delay: Periods after which a measurement arrives; pairs it with its input for the monitor.
        now: Clock [s] of the durations. Default: the computer's.

    Raises:
        InputError: If sizes, periods or delays do not fit, or a guard has no monitor.

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
            raise InputError(f"guard: a Guard is needed, got {type(guard).__name__} [HM-LOOP-018]")
        safe = controller if isinstance(controller, SafeController) else SafeController(controller)
        self.model, self.ocp = estimator.model, safe.controller.ocp
        _check_models(self.model, safe.controller.model)
        _check_monitor(monitor, self.model)
        if guard is not None and monitor is None:
            raise InputError("a guard acts on a monitor's alarms; give monitor= as well [HM-LOOP-019]")
        self._estimator, self._safe, self._monitor = estimator, safe, monitor
        self._control = GuardedController(safe, guard)
        self._delay = whole_periods(input_delay, "input_delay")
        self._n_inputs = self._delay + whole_periods(sensor_delay, "sensor_delay") + 1
        self._previews = Previews(reference, weight, self.ocp, self.model.dt, end, self.standing)
        self._forecast = Forecast(w, self.ocp, self.model.n_w, self.model.dt)
        self._truth, self._now = sees_truth(estimator), now
        self._state: LoopState | None = None
        self._decide_late: Callable[[], tuple[Decision, GuardState]] | None = None
        self._ahead: _Ahead | None = None
        self.reading: Reading | None = None
        """What the monitor said last; None without one."""
        self.previewed: tuple[Array, Array | None] = np.zeros((0, self.ocp.n_x)), None
        """Reference ``(m, n_x)`` and factors on ``q`` (None for 1) of this period's decision."""
        self.spent = dict.fromkeys(TIMED, 0.0)
        """Durations [s] of this period, by the names of ``TIMED``."""

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
        """Begin, while the machine rests: the first estimate, the first plan, which may take its time, the first input.

        Arguments are those of :meth:`step`; ``applied`` is the input that has acted until now, by default that of the
        operating point. Returned is the input ``(n_u,)`` to hold from now on.
        """
        if in_time is not None:
            check_function(in_time, "in_time")
        sample, measured = self._sample(y), self._disturbed(w)
        x_ref, factors = self._preview(0, reference)
        estimate = self._estimator.start(self._seen(sample, truth), 0.0, **self._now_measured(measured))
        until = None if applied is None else sampled(applied, (self.ocp.n_u,), "applied")
        ahead = self._w_ahead(0, measured, estimate)
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
        """One period: estimate and decide.

        Args:
            y: Sample ``(n_y,)``; None or NaN: missing, also single ones.
            w: Measured disturbances ``(n_w,)`` from now on; NaN or None: the last ones stay. ``(m, n_w)`` with a row
                each for now and the periods ahead is a forecast in place of the loop's own.
            applied: Input ``(n_u,)`` that really acted since the last step, where the actuator says so; an operator's,
                in manual mode. Default: the one that the last step returned.
            reference: A set-point or ``(m, columns)`` from now on in steps of ``dt``, in place of the loop's own.
            truth: The true ``(x, h)``, for an estimator that needs it.
            in_time: Asked before the solve: may it begin? If not, the last plan is followed, as :meth:`late` does.
                Default: it may.

        Returns:
            The input ``(n_u,)`` to hold from now on, within the limits.

        Raises:
            InputError: If a shape does not fit. No number raises.
        """
        if in_time is not None:
            check_function(in_time, "in_time")
        self.finish()
        sample, measured, state = self._sample(y), self._disturbed(w), self.state
        previous, inputs = state.decision, state.inputs
        if applied is not None:
            previous = _with_input(previous, sampled(applied, (self.ocp.n_u,), "applied"))
            inputs = (*inputs[:-1], previous.u)
        begin, k = self._now(), state.k + 1
        x_ref, factors = self._preview(k, reference)
        seen = self._seen(sample, truth)
        also = self._now_measured(measured)
        if state.estimate is None:
            estimate = self._estimator.start(seen, k * self.model.dt, **also)
        else:
            estimate = self._estimator.update(state.estimate, seen, previous.u, **also)
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
        w = self._w_ahead(state.k, measured, estimate)
        now = self._now_measured(measured).get("w")
        guard = self._control.measured(state.guard, self.t, state.y, previous.u, now)
        self._decide_late = partial(self._control.decide, guard, previous, estimate, x_ref, late=True)
        may_solve = in_time is None or in_time()
        begin = self._now()
        if state.mode == "manual":
            decision = self._operated(previous, estimate)
        else:
            prepared = self._prepared(previous, factors)
            decision, guard = self._control.decide(
                guard, previous, estimate, x_ref, factors, prepared=prepared, late=not may_solve, w=w
            )
        self.spent["solve"] = self._now() - begin
        self._state = replace(state, decision=decision, guard=guard)
        return decision.u

    def late(self) -> Array:
        """The input of this period where the solve has missed its deadline: the last plan, shifted.

        To be called after :meth:`step`, in place of the input that it returned.
        """
        if self._decide_late is not None and self.state.mode == "automatic":
            decision, guard = self._decide_late()
            self._state = replace(self.state, decision=decision, guard=guard)
        return self.state.decision.u

    def finish(self) -> None:
        """What can wait until the input is out: the monitor, the guard's next mode, the next solve's preparation.

        The next :meth:`step` calls it if nobody did; a second call does nothing.
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
        """Periods that passed without a step, e.g. since one before them took too long; the input was held.

        The estimator is led through them without a sample; after 250 it starts anew at the next one.
        """
        n = whole(n, "skip [periods]", 0, MOST_SKIPPED)
        self.finish()
        state, missing = self.state, np.full(self.model.n_y, np.nan)
        estimate, guard, u = state.estimate, state.guard, state.decision.u
        if n > LONG:
            estimate = None
        elif estimate is not None:
            for i in range(1, n + 1):
                estimate = self._estimator.update(estimate, missing, u)
                guard = self._control.measured(guard, (state.k + i) * self.model.dt, missing, u)
        inputs = (*state.inputs, *([u] * min(n, self._n_inputs)))[-self._n_inputs :]
        self._state = replace(state, k=state.k + n, estimate=estimate, guard=guard, inputs=inputs)

    def warm_up(self) -> None:
        """Call every part once, at the operating point, and forget it: first calls are slow."""
        m = self.model
        trial, y = copy(self), m.output(m.x0, m.u0, m.w, m.p).full().ravel()
        truth = np.concatenate([m.x0, np.zeros(m.n_h)])
        x_ref, factors = self._preview(0, None)
        estimate = self._estimator.start(truth if self._truth else y, 0.0)
        first = self._safe.initial(estimate)
        trial._state, trial._ahead = self._first_state(y, estimate, first), None
        trial.spent = dict.fromkeys(TIMED, 0.0)
        trial._decide(first, x_ref, factors, None)
        trial.step(y, truth=truth)
        trial.late()
        trial.finish()

    def restore(self, state: LoopState) -> Array:
        """Go on from ``state``, what :attr:`state` of a loop of the same parts was; returns the input that is held.

        Raises:
            InputError: If it is no state, or that of a loop of another model or horizon.
        """
        _check_state(state, self.model, self.ocp, self._monitor)
        self._state, self._decide_late, self._ahead, self.reading = state, None, None, None
        return state.decision.u

    @property
    def mode(self) -> Literal["automatic", "manual"]:
        """Who gives the input: the controller, or in ``"manual"`` an operator, whose inputs are ``applied``.

        While manual, the estimator goes on with the inputs that really act, so that nothing winds up, and the input
        that a step returns is the operator's last one. Back in automatic the controller begins from it, within
        ``du_max``.
        """
        return self.state.mode

    @mode.setter
    def mode(self, mode: Literal["automatic", "manual"]) -> None:
        if not isinstance(mode, str) or mode not in ("automatic", "manual"):
            raise InputError(f"mode: 'automatic' or 'manual' needed, got {mode!r:.80} [HM-LOOP-020]")
        self._state = replace(self.state, mode=mode)

    @property
    def state(self) -> LoopState:
        """All that the loop remembers, from :meth:`start` on."""
        if self._state is None:
            raise InputError("the loop has not begun; call start() with the first sample [HM-LOOP-021]")
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
        """The input that is held, and where it came from."""
        return self.state.decision

    @property
    def switches(self) -> tuple[Switch, ...]:
        """Changes of the guard's mode until now."""
        return self.state.guard.switches

    @property
    def standing(self) -> Array:
        """The reference ``(columns,)`` that is the operating point: that of a loop to which none is given."""
        return self._safe.controller.problem.standing()[0]

    @property
    def safe_input(self) -> Array | None:
        """Input ``(n_u,)`` that the machine is left with where nothing is known; None: none is declared."""
        return None if self._safe.safe_input is None else self._safe.safe_input.copy()

    def _first_state(self, sample: Array, estimate: Estimate, first: Decision) -> LoopState:
        memory = None if self._monitor is None else self._monitor.initial()
        return LoopState(0, sample, estimate, first, GuardState(), memory, (first.u,) * self._n_inputs)

    def _sample(self, y: ArrayLike | None) -> Array:
        return (
            np.full(self.model.n_y, np.nan) if y is None else sampled(y, (self.model.n_y,), "the measurement")
        )

    def _disturbed(self, w: ArrayLike | None) -> Array | None:
        """Measured disturbances ``(m, n_w)``, a row for now and each known ahead; None: nothing was measured."""
        if w is None:
            return None
        rows = sampled(w, (None, self.model.n_w), "w, the measured disturbances and their forecast,")
        if not len(rows):
            raise InputError(
                "w has no rows; give the measured disturbances, or a row for each period ahead [HM-LOOP-022]"
            )
        return rows

    def _now_measured(self, measured: Array | None) -> dict[str, Array]:
        """What an estimator is told of them; nothing where the model has none."""
        if not self.model.n_w:
            return {}
        return {"w": np.full(self.model.n_w, np.nan) if measured is None else measured[0]}

    def _w_ahead(self, k: int, measured: Array | None, estimate: Estimate) -> Array | None:
        """Measured disturbances ``(m, n_w)`` that the solve of period k counts on; None: those of the estimate."""
        if measured is not None and len(measured) > 1:
            return held(measured[self._delay :] if len(measured) > self._delay else measured[-1:], estimate.w)
        ahead = self._forecast((k + self._delay) * self.model.dt)
        if ahead is None:
            return None
        if not self._delay:
            ahead[0] = estimate.w
        return held(ahead, estimate.w)

    def _seen(self, sample: Array, truth: ArrayLike | None) -> Array:
        """What the estimator takes: the sample, or the truth."""
        if not self._truth:
            return sample
        if truth is None:
            raise InputError(
                "this estimator takes the true state; give truth=, or take a filter [HM-LOOP-023]"
            )
        return sampled(truth, (None,), "the truth")

    def _preview(self, k: int, reference: ArrayLike | None) -> tuple[Array, Array | None]:
        """Reference and factors of period k, at the instants at which its input acts."""
        if self._ahead is not None and self._ahead.k == k:
            x_ref, factors = self._ahead.previews
        else:
            x_ref, factors = self._previews((k + self._delay) * self.model.dt)
        if reference is not None:
            x_ref = sampled(reference, (None, x_ref.shape[1]), "the reference")
            if not len(x_ref):
                raise InputError(
                    "the reference has no rows; give a set-point, or a row for each period ahead [HM-LOOP-024]"
                )
        return x_ref, factors

    def _prepared(self, previous: Decision, weight: Array | None) -> Any:
        """What :meth:`finish` has prepared, if it is for this solve."""
        ahead = self._ahead
        if ahead is None or ahead.decision is not previous:
            return None
        used = ahead.previews[1]
        same = used is weight or (used is not None and weight is not None and np.array_equal(used, weight))
        return ahead.prepared if same else None

    def _operated(self, previous: Decision, estimate: Estimate) -> Decision:
        """The operator's input goes on, and so does the plan that automatic would begin from."""
        u, plan = previous.u, previous.solution
        if estimate.finite and np.all(np.isfinite(u)):
            plan = self._safe.controller.initial(estimate, np.tile(u, (self.ocp.horizon, 1)))
            plan = plan.beginning_with(u)
        return Decision(u, Source.MANUAL, plan, Status.INITIAL, 0)


def _with_input(decision: Decision, u: Array) -> Decision:
    """The decision as if ``u`` had been decided; where a part of it is not known, that of the decision."""
    u = np.where(np.isfinite(u), u, decision.u)
    if np.array_equal(u, decision.u):
        return decision
    return replace(decision, u=u, solution=decision.solution.beginning_with(u))


def _check_models(estimated: HybridModel, controlled: HybridModel) -> None:
    sizes = [(m.n_x, m.n_h, m.n_u) for m in (estimated, controlled)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"the estimator's model {estimated.name} has (n_x, n_h, n_u) = {sizes[0]}, "
            f"the controller's model {controlled.name} {sizes[1]}; give both the same model [HM-LOOP-025]"
        )
    if abs(controlled.dt - estimated.dt) > 1e-9 * estimated.dt:
        raise InputError(
            f"the estimator's period is {estimated.dt} s, the controller's {controlled.dt} s; they must agree"
            " [HM-LOOP-026]"
        )


def _check_monitor(monitor: Monitor | None, model: HybridModel) -> None:
    own: HybridModel | None = getattr(monitor, "model", None)
    if own is None:
        return
    sizes = [(m.n_x, m.n_h, m.n_u, m.n_y) for m in (own, model)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"the monitor's model {own.name} has (n_x, n_h, n_u, n_y) = {sizes[0]}, the estimator's model {model.name} "
            f"{sizes[1]}; give both the same model, e.g. kit.monitor({model.name!r}) [HM-LOOP-027]"
        )


def _check_state(state: LoopState, model: HybridModel, ocp: OCP, monitor: Monitor | None) -> None:
    if not isinstance(state, LoopState):
        raise InputError(f"restore: what Loop.state was is needed, got {type(state).__name__} [HM-LOOP-028]")
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
        f"{name} has {np.size(value)} numbers, needed are {n}"
        for name, value, n in sizes
        if np.size(value) != n
    ]
    if (state.monitor is None) != (monitor is None):
        wrong.append(
            f"its loop had {'no' if state.monitor is None else 'a'} monitor, this one has {'a' if monitor else 'no'}"
            " [HM-LOOP-029]"
        )
    if wrong:
        raise InputError(f"restore: the state is of a loop of other parts: {'; '.join(wrong)} [HM-LOOP-030]")
