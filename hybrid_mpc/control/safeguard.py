"""A controller that always returns an admissible input, with its source."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP, Limits
from hybrid_mpc.control.problem import Controller, Solution, SplitController, Status
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.model.equilibrium import equilibrium_input
from hybrid_mpc.model.limits import check_part, vector, whole
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.riccati import dare

Array = NDArray[np.float64]


class Source(Enum):
    """Source of an applied input; the value is the message."""

    MPC = "the checked solution of the MPC"
    PLAN = "the previous plan, shifted: the solve failed"
    FALLBACK = "the stabilising feedback on the prior: the solve failed and the plan is used up"
    SAFE = "the declared safe input: no other input was finite, or the sensor failed"
    HELD = "the last input, held: no other input was finite and no safe input is declared, or none was decided yet"
    MANUAL = "the operator"


@dataclass(frozen=True)
class Decision:
    """The input ``(n_u,)`` of one period, always within the bounds and the limit of its change.

    ``solution`` is the plan for the next solve; its ``u[0]`` is ``u``. ``status`` is the result of this period's solve,
    ``age`` is the number of periods since the last successful one.
    """

    u: Array
    source: Source
    solution: Solution
    status: Status
    age: int


class SafeController:
    """Guards a controller: it applies a checked solution, else the shifted plan, else a fallback, else the safe input.

    The safe input must be declared: zero may be an unsafe thrust or valve position. Without a safe input the last input
    is held.

    Every input is within ``[u_min, u_max]``, within ``du_max`` of the last one, and within the hard bounds on inputs
    alone (:meth:`~hybrid_mpc.control.problem.InputBounds.keep`), whatever solver, model and estimate return. The object
    has no state: the held input, the plan and its age are in the :class:`Decision`.

    Args:
        controller: The controller to guard.
        fallback: Model, usually the fitted prior, whose LQR at the problem's working point is applied around the
            steady state of the reference. Default: none; then the safe input follows.
        max_age: Most periods that a plan is followed without a successful solve.
        first: Controller that makes the first plan, before the loop starts, e.g. a converging
            :class:`~hybrid_mpc.control.sqp.SQPController`. Default: ``controller``.
        safe_input: Input ``(n_u,)`` within the limits for emergencies: nothing is finite, the sensor is lost, a run
            ends. Default: none.

    Raises:
        InputError: If the fallback does not fit the problem or is not stabilisable, or the safe input is outside the
            limits.

    Example:
        >>> from hybrid_mpc.estimate.kalman import TrueState
        >>> from hybrid_mpc.machine.signals import Signal
        >>> import casadi as ca
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> ocp = OCP(5, [1.0], [1.0], [0.0], [-9.0], [9.0], du_max=[0.5])
        >>> from hybrid_mpc.control.rti import CondensedController
        >>> safe = SafeController(CondensedController(model, ocp), fallback=model)
        >>> estimate = TrueState(model).start([2.0])
        >>> decision = safe.decide(safe.initial(estimate), estimate, np.full((6, 1), np.nan))
        >>> decision.source.name, decision.status.name
        ('PLAN', 'NOT_FINITE')
    """

    def __init__(
        self,
        controller: Controller,
        fallback: HybridModel | None = None,
        *,
        max_age: int = 5,
        first: Controller | None = None,
        safe_input: ArrayLike | None = None,
    ) -> None:
        max_age = whole(max_age, "max_age [periods]", 0, 10**9)
        check_part(controller, "controller", "a controller", "model", "ocp", "solve")
        if not isinstance(fallback, HybridModel | None):
            raise InputError(f"fallback: must be a model, got {type(fallback).__name__} [HM-CONTROL-039]")
        ocp, self._bounds = controller.ocp, controller.problem.soft.on_inputs
        self.controller, self.max_age, self.fallback = controller, max_age, fallback
        self.safe_input = None if safe_input is None else check_safe_input(safe_input, ocp)
        self._split = controller if isinstance(controller, SplitController) else None
        self._first = controller if first is None else first
        sizes = [(c.model.n_x, c.model.n_h, c.ocp.n_u, c.ocp.horizon) for c in (self._first, controller)]
        if sizes[0] != sizes[1]:
            raise InputError(
                f"first: (n_x, n_h, n_u, N) = {sizes[0]}, but the controller has {sizes[1]}. "
                "Give both the same model and problem. [HM-CONTROL-040]"
            )
        self._rest_input = None
        if fallback is not None:
            if (fallback.n_x, fallback.n_u) != (ocp.n_x, ocp.n_u):
                raise InputError(
                    f"fallback: model {fallback.name} has {fallback.n_x} states and {fallback.n_u} inputs, "
                    f"but the problem has {ocp.n_x} and {ocp.n_u} [HM-CONTROL-041]"
                )
            gain = dare(*ocp.linear_quadratic(fallback))[1]
            self._gain = gain[:, : ocp.n_x]
            self._late = gain[:, ocp.n_x : ocp.n_x + fallback.delay_states]
            self._rest_input = equilibrium_input(fallback, Sizes(fallback, ocp).states, ocp.input_scale)
            self._rest_input(fallback.x0, fallback.w)  # the first call of a CasADi function is slow

    def initial(
        self,
        estimate: Estimate,
        u: Array | None = None,
        reference: Array | None = None,
        weight: Array | None = None,
        w: Array | None = None,
    ) -> Decision:
        """The decision before the first period: a held input, and a plan to start from.

        A real-time iteration improves a plan only a little per period, and the first plan has no predecessor: make it
        here, while the machine rests and there is no deadline.

        Args:
            estimate: Start of the plan.
            u: Held input ``(n_u,)``. Default: that of the model's operating point.
            reference: As for :meth:`Controller.solve`, from the first period on; the plan is optimised for it.
                Default: none; the plan holds ``u``.
            weight: Factors on ``q`` ``(m, n_x)``, like the reference. Default: 1.
            w: Measured disturbances ``(m, n_w)``, like the reference. Default: those of the estimate, held.
        """
        ocp, rest = self.controller.ocp, self.controller.model.u0
        held = np.clip(rest if u is None else vector(u, ocp.n_u, "u"), ocp.u_min, ocp.u_max)
        plan = self.controller.initial(estimate, np.tile(held, (ocp.horizon, 1)))
        if reference is not None:
            solution = self._first.solve(plan, estimate, reference, weight, **_ahead(w))
            plan = solution.delayed(held) if solution.status.ok else plan
        return Decision(held, Source.HELD, plan, Status.INITIAL, 0)

    def decide(
        self, previous: Decision, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None, prepared: Any = None, w: Array | None = None,
    ) -> Decision:  # fmt: skip
        """The input to hold from now on; ``previous.u`` is being held.

        Args:
            previous: The last decision.
            estimate: The state now.
            reference: As for :meth:`Controller.solve`.
            weight: Factors on ``q`` ``(m, n_x)``, like the reference. Default: 1.
            limits: Bounds of the inputs for this period, as for :meth:`OCP.bounds`. Default: the problem's own.
            prepared: Result of :meth:`prepare` for ``previous`` and ``weight``. Default: computed now.
            w: Measured disturbances ``(m, n_w)`` from now on. Default: those of the estimate, held.
        """
        if prepared is not None and self._split is not None:
            solution = self._split.finish(prepared, estimate, reference, limits, **_ahead(w))
        else:
            last = previous.solution
            solution = self.controller.solve(last, estimate, reference, weight, limits=limits, **_ahead(w))
        if solution.status.ok:
            u, way = self._bounds.keep(solution.u[0], previous.u, limits)
            return Decision(u, Source.MPC, solution.beginning_with(u, way), solution.status, 0)
        return self._without(previous, estimate, reference, solution, limits)

    def prepare(self, previous: Decision, weight: Array | None = None) -> Any:
        """The linearization, condensed: the part of the next :meth:`decide` that needs no measurement.

        ``weight`` is that of the next period. None for a solver without preparation.
        """
        return None if self._split is None else self._split.prepare(previous.solution, weight)

    def late(
        self, previous: Decision, estimate: Estimate, reference: Array, *, limits: Limits | None = None
    ) -> Decision:
        """The input to hold if the solve is late: as after a failed solve, with status LATE."""
        failed = replace(previous.solution, u=previous.solution.following, status=Status.LATE)
        return self._without(previous, estimate, reference, failed, limits)

    def _without(
        self, previous: Decision, estimate: Estimate, reference: Array, solution: Solution,
        limits: Limits | None,
    ) -> Decision:  # fmt: skip
        """The decision if no solution may be applied; ``solution`` has the shifted plan and the reason."""
        held = previous.u
        u, source = self._instead(solution, estimate, reference, previous.age + 1, held)
        u, way = self._bounds.keep(u, held, limits)
        inputs = solution.beginning_with(u).u
        inputs = np.where(np.isfinite(inputs), inputs, u)
        plan = self.controller.initial(estimate, inputs) if estimate.finite else replace(solution, u=inputs)
        return Decision(u, source, plan.beginning_with(plan.u[0], way), solution.status, previous.age + 1)

    @np.errstate(over="ignore", invalid="ignore")  # an overflow is checked and refused
    def _instead(
        self, failed: Solution, estimate: Estimate, reference: Array, age: int, held: Array
    ) -> tuple[Array, Source]:
        if age <= self.max_age and np.all(np.isfinite(failed.u[0])):
            return failed.u[0], Source.PLAN
        if self._rest_input is not None and estimate.finite:
            goal, best = self._goal(estimate, reference, failed)
            u = best - self._gain @ (estimate.x - goal)
            if self._late.size:  # inputs that are still delayed
                u = u - self._late @ (
                    estimate.h[: self._late.shape[1]] - np.tile(best, self._late.shape[1] // u.size)
                )
            if np.all(np.isfinite(u)):
                return u, Source.FALLBACK
        return (held, Source.HELD) if self.safe_input is None else (self.safe_input, Source.SAFE)

    def _goal(self, estimate: Estimate, reference: Array, failed: Solution) -> tuple[Array, Array]:
        """State and input ``(n_x,)``, ``(n_u,)`` of the fallback: the reference's, else the operating point's."""
        problem, m = self.controller.problem, self.controller.model
        assert self._rest_input is not None
        target = problem.target(np.asarray(reference, dtype=float)[:1], None, estimate, None, failed.steady)
        goal = target.x[0]
        if problem.targets is not None and np.all(np.isfinite(goal)):
            return goal, target.u[0]
        goal = goal if np.all(np.isfinite(goal)) else m.x0
        best = self._rest_input(goal, target.w[0]).full().ravel()
        return goal, best - m.disturbed[0] @ estimate.d


def _ahead(w: Array | None) -> dict[str, Any]:
    return {} if w is None else {"w": w}


def check_safe_input(given: ArrayLike, ocp: OCP) -> Array:
    """The safe input ``(n_u,)`` of a problem, within its limits."""
    u = vector(given, ocp.n_u, "safe_input")
    if np.any(u < ocp.u_min) or np.any(u > ocp.u_max):
        raise InputError(f"safe_input: {u} is outside the limits {ocp.u_min} to {ocp.u_max} [HM-CONTROL-042]")
    return u
