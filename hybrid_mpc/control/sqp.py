"""Sequential quadratic programming: the condensed iteration repeated to convergence, with damping."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.curvature import StageCurvature, convex
from hybrid_mpc.control.ocp import OCP, Limits
from hybrid_mpc.control.problem import Controller, Solution, Status, Target
from hybrid_mpc.control.qp import Answer
from hybrid_mpc.control.rti import CondensedController, Prepared, adjoint, condense_hessians
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.model.active_set import PRIMAL_TOLERANCE, Active
from hybrid_mpc.model.limits import MOST_ITERATIONS, whole
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.stages import Derivatives

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """Arguments of one solve: disturbance, input held before, targets, and limits tighter than the problem's."""

    d: Array
    u_prev: Array
    target: Target
    limits: Limits | None = None


@dataclass(frozen=True)
class Rollout:
    """A run of the model on inputs ``(N, n_u)``; its cost includes the penalties of soft bounds.

    ``soft`` are the soft bounds' values ``(M,)`` and their derivatives by their state ``(M, n_x)`` and input.
    """

    u: Array
    z: Array
    soft: tuple[Array, Array, Array]
    cost: float


@dataclass(frozen=True)
class Point:
    """A run with its first derivatives; multipliers ``(N, n_z)`` and gradient ``(N n_u,)`` without soft bounds."""

    run: Rollout
    derivatives: Derivatives
    multipliers: Array
    gradient: Array


class ReducedCost:
    """Cost and derivatives as functions of the inputs only, by runs of the model. Built once for all cases."""

    def __init__(self, inner: CondensedController) -> None:
        self.inner, self.problem = inner, inner.problem
        sizes = inner.problem.sizes
        self.stages = StageCurvature(inner.stages, inner.ocp, sizes.states, sizes.hidden, inner.problem.soft)
        self.metric: Array = np.tile(inner.ocp.input_scale**-2.0, inner.ocp.horizon)

    def run(self, z0: Array, u: Array, case: Case) -> Rollout:
        """The run from ``z0`` on ``u``."""
        problem, n_x = self.problem, self.inner.ocp.n_x
        z = self.inner.stages.run(z0, self.acting(u, case))
        soft = problem.soft.linearize(z[:, :n_x], u, case.target.e)
        excess = problem.soft.excess(soft[0])
        return Rollout(u, z, soft, problem.cost(z, u, case.u_prev, case.target, excess))

    def acting(self, u: Array, case: Case) -> Array:
        """All inputs along a run ``(N, n_v)``."""
        return self.problem.model.acting(u, case.d, case.target.w)

    def at(self, run: Rollout, case: Case) -> Point:
        """First derivatives along a run."""
        problem, n_x = self.problem, self.inner.ocp.n_x
        derivatives = self.inner.stages.at(run.z[:-1], self.acting(run.u, case))
        stages, terminal = problem.state_weights(case.target.weight)
        error = run.z[:, :n_x] - case.target.x
        slopes = 2 * stages * error[:-1]
        direct = self.inner.input_gradient(run.u.ravel(), case.u_prev, case.target.u)
        if problem.economic.function is not None:
            economic = problem.economic.derivatives(run.z[:, :n_x], run.u, case.target.p)[0]
            slopes, direct = slopes + economic[:, :n_x], direct + economic[:, n_x:].ravel()
        multipliers = adjoint(derivatives[1], 2 * terminal @ error[-1], slopes)
        gradient = (multipliers[:, None, :] @ derivatives[2]).ravel() + direct
        return Point(run, derivatives, multipliers, gradient)

    def lagrangian(self, at: Point, soft: Array) -> tuple[Array, Array]:
        """Multipliers of the dynamics and gradient, including the soft bounds with multipliers ``soft``."""
        acting = np.flatnonzero(soft)
        if not acting.size:
            return at.multipliers, at.gradient
        _, by_x, by_u = at.run.soft
        n, stage = len(at.run.u), self.problem.soft.stage[acting]
        slopes, direct = np.zeros((n + 1, by_x.shape[1])), np.zeros((n + 1, by_u.shape[1]))
        np.add.at(slopes, stage, soft[acting, None] * by_x[acting])
        np.add.at(direct, stage, soft[acting, None] * by_u[acting])  # the last state has no input
        more = adjoint(at.derivatives[1], slopes[-1], slopes[:-1])
        gradient = at.gradient + (more[:, None, :] @ at.derivatives[2]).ravel() + direct[:-1].ravel()
        return at.multipliers + more, gradient

    def curvature(
        self, at: Point, case: Case, multipliers: Array, soft: Array, old: Array | None = None
    ) -> Array:
        """Weighted second derivatives of the stages; see :meth:`StageCurvature.of`."""
        _, a_t, b = at.derivatives
        inputs = at.run.u, self.acting(at.run.u, case)
        return self.stages.of(at.run.z, inputs, a_t, b, multipliers, soft, old, e=case.target.e)

    def condensed(self, at: Point, case: Case) -> Prepared:
        """The Gauss-Newton model of the cost at a point."""
        return self.inner.condense(
            at.run.u, at.run.z, case.d, case.u_prev, case.target.weight, at.derivatives, perf_counter(),
            case.target.p, w=case.target.w,
        )  # fmt: skip

    def rounding(self, values: Array) -> float:
        """Error of the penalties of values ``(M,)`` due to the QP's tolerance."""
        soft = self.problem.soft
        beyond = soft.excess(values) > 0
        return PRIMAL_TOLERANCE * self.problem.model.dt * float((soft.linear * soft.scale)[beyond].sum())

    def penalty(self, values: Array) -> float:
        """Cost of the soft bounds' values."""
        soft = self.problem.soft
        return self.problem.model.dt * soft.penalty(soft.excess(values))

    def gap(self, values: Array, multipliers: Array) -> float:
        """By how much the penalties of values ``(M,)`` may exceed those after the best change (Fenchel's inequality).

        Under the multipliers ``(M,)`` everything else is stationary.
        """
        soft, dt, acting = self.problem.soft, self.problem.model.dt, np.flatnonzero(multipliers)
        mu = multipliers[acting]
        bound = np.where(mu > 0, soft.upper[acting], soft.lower[acting])
        beyond = np.maximum(0.0, np.abs(mu) - dt * soft.linear[acting])
        proven = mu @ (values[acting] - bound) - np.sum(beyond**2 / (4 * dt * soft.quadratic[acting]))
        return self.penalty(values) - float(proven)

    def rest(self, prepared: Prepared, curvature: Array, case: Case) -> Array:
        """The exact Hessian minus that of ``prepared``; nothing may be condensed in between."""
        rest = self.stages.condensed(curvature, prepared.from_u, self.inner.condenser.by_inputs)
        if prepared.economic is not None:  # negative curvature, which the convex model replaces by zero
            n_x = self.inner.ocp.n_x
            exact = self.problem.economic.derivatives(prepared.z[:, :n_x], prepared.u, case.target.p)[1]
            rest = rest + condense_hessians(exact - prepared.economic[1], prepared.from_u, n_x)
        return rest


KKT = 1e-6
MORE = 4.0
"""Factor by which damping grows between attempts, and falls after a good step."""
POOR, GOOD = 0.25, 0.5
"""Ratios of actual to predicted decrease: below the first damping is raised, above the second it is lowered."""
CORRECTIONS = 2
"""Most second-order corrections of a step."""
LIFTED = 14
"""Most multiple-shooting linearizations of a first plan, before all iterates are runs."""


@dataclass(frozen=True)
class _Step:
    """Result of a search.

    ``run`` is None if no step lowers the cost; ``hessian`` is the damped Hessian of the QP's solution. ``promised`` is
    the decrease predicted by the undamped model for the step before its correction, ``own`` that model's curvature
    along the step, in the damping's metric.
    """

    run: Rollout | None
    answer: Answer
    hessian: Array
    promised: float
    own: float


class Descent:
    """The steps of one solve, from a first point with finite cost."""

    def __init__(
        self, cost: ReducedCost, case: Case, at: Point, curvature: Array | None, tolerance: float,
        active: Active | None = None,
    ) -> None:  # fmt: skip
        self._cost, self._case, self._tolerance = cost, case, tolerance
        self.at, self.curvature, self.active = at, curvature, active
        self.count, self.status, self.kkt, self.ended = 0, Status.STOPPED, np.nan, False
        self._stale, self._fresh, self._plain, self._taken = curvature is None, False, False, 0
        self._soft = np.zeros(at.run.soft[0].size)  # multipliers
        self._damping = 0.0

    def iterate(self) -> None:
        """One linearization, and QPs until the step of one lowers the cost."""
        self.count += 1
        prepared = self._cost.condensed(self.at, self._case)
        hessian = self._hessian(prepared)
        found = self._search(prepared, hessian)
        if not found.answer.status.ok:
            self._refused(found.answer.status)
        elif found.run is None:
            self._lost(found)
        else:
            self._go(hessian, found, found.run)

    def _go(self, hessian: Array, found: _Step, run: Rollout) -> None:
        """Make a step, and compute the residual there with the QP's multipliers."""
        answer, cost = found.answer, self._cost
        before = max(answer.kkt, self._residual(hessian, found.hessian @ answer.step))
        gained = self.at.run.cost - run.cost
        new = cost.at(run, self._case)
        change = cost.lagrangian(new, answer.multipliers)[1]
        change = change - cost.lagrangian(self.at, answer.multipliers)[1]
        wrong = self._residual(hessian, change - hessian @ answer.step)
        left = change - found.hessian @ answer.step
        after = max(answer.kkt, self._residual(hessian, left))
        self.at, self.kkt, self._soft, self.active = new, after, answer.multipliers, answer.active
        # a residual mispredicted by 10 % asks for new second derivatives
        self._stale, self._fresh, self._plain = wrong > 0.1 * before, False, False
        self.ended = after <= KKT and self._promise(hessian, left) <= self._enough
        self.status = Status.SOLVED if self.ended else Status.STOPPED
        if gained < POOR * found.promised:
            self._damping = max(2 * self._damping, 0.5 * found.own)
        elif gained > GOOD * found.promised:
            self._damping = self._damping / MORE if self._damping > 0.1 * found.own else 0.0

    def _search(self, prepared: Prepared, hessian: Array) -> _Step:
        """The first step, with growing damping, that lowers the cost enough, if any."""
        first = None
        # QPs of an iteration, each damped more than the one before
        for _ in range(15):
            damped = hessian
            if self._damping:
                damped = hessian + np.diag(self._damping * self._cost.metric)
            answer = self._answer(damped, self.at.gradient, prepared.soft[0], prepared.soft[2])
            step = answer.step
            own = float(step @ (hessian @ step)) / max(float(step**2 @ self._cost.metric), 1e-300)
            found = _Step(None, answer, damped, self._promised(prepared, hessian, step), own)
            first = first or found
            if not answer.status.ok:
                return found
            promised = self._promised(prepared, damped, step)
            run, answer = self._along(prepared, damped, answer, promised)
            if run is not None:
                return replace(found, run=run, answer=answer)
            if promised <= self._enough:
                break
            self._damping = max(MORE * self._damping, own)
        assert first is not None
        return first

    def _along(
        self, prepared: Prepared, damped: Array, answer: Answer, promised: float
    ) -> tuple[Rollout | None, Answer]:
        """The run of a step, or of the corrected step, if it lowers the cost enough."""
        start, bounds = self.at.run, self._cost.inner.ocp.bounds(self._case.u_prev, self._case.limits)
        # Armijo's condition on the decrease
        least, before = start.cost - 1e-4 * promised, np.inf
        for i in range(1 + CORRECTIONS):
            u = np.clip(start.u + answer.step.reshape(start.u.shape), *bounds)
            run = self._cost.run(start.z[0], u, self._case)
            if run.cost <= least:
                return run, answer
            if i == CORRECTIONS or not run.cost < before:
                break
            before, answer = run.cost, self._corrected(prepared, damped, answer, run)
            if not answer.status.ok:
                break
        return None, answer

    def _corrected(self, prepared: Prepared, damped: Array, answer: Answer, run: Rollout) -> Answer:
        """The QP again, with the curvature of states and soft bounds along the last step (second-order correction)."""
        old, n_x, (value, _, slope) = self.at.run, self._cost.inner.ocp.n_x, prepared.soft
        bend = (run.z[:, :n_x] - old.z[:, :n_x]).ravel() - prepared.from_u @ answer.step
        if len(slope):
            value = run.soft[0] - slope @ answer.step
        return self._answer(damped, self.at.gradient + 2 * bend @ prepared.weighted, value, slope)

    def _answer(self, hessian: Array, gradient: Array, value: Array, slope: Array) -> Answer:
        """The QP's solution clipped to the inputs' bounds; beyond them it predicts a decrease that no run achieves."""
        soft = (value, slope) if value.size else None
        case, u, inner = self._case, self.at.run.u, self._cost.inner
        found = inner.qp.solve(hessian, gradient, u, case.u_prev, soft, case.limits, self.active)
        within = np.clip(u + found.step.reshape(u.shape), *inner.ocp.bounds(case.u_prev, case.limits))
        return replace(found, step=(within - u).ravel())

    def _promised(self, prepared: Prepared, hessian: Array, step: Array) -> float:
        """Decrease of the convex model along a step."""
        value, _, slope = prepared.soft
        lowers = -float(step @ (self.at.gradient + 0.5 * (hessian @ step)))
        if value.size:
            lowers += self._cost.penalty(value) - self._cost.penalty(value + slope @ step)
        return lowers

    def _promise(self, hessian: Array, left: Array) -> float:
        """Upper bound of the decrease of the convex model (weak duality), with ``left`` of the stationarity."""
        qp = self._cost.inner.qp
        left, hessian = qp.by_blocks(left), qp.blocked_hessian(hessian)
        promise = 0.5 * float(left @ np.linalg.solve(hessian, left))
        return promise + self._cost.gap(self.at.run.soft[0], self._soft)

    def _residual(self, hessian: Array, slope: Array) -> float:
        """A gradient of the cost by the inputs in the QP's scaling."""
        qp = self._cost.inner.qp
        size = np.max(np.diag(qp.blocked_hessian(hessian)) * qp.scale**2)
        return float(np.max(np.abs(qp.scale * qp.by_blocks(slope))) / size)

    @property
    def _enough(self) -> float:
        return self._tolerance * max(abs(self.at.run.cost), 1e-12)

    def _hessian(self, prepared: Prepared) -> Array:
        if self._plain:
            return prepared.hessian
        multipliers, slope = self._cost.lagrangian(self.at, self._soft)
        if self._stale or self.curvature is None:
            self.curvature = self._taken_anew(prepared, multipliers)
        if not np.all(np.isfinite(self.curvature)):
            return prepared.hessian
        return convex(
            prepared.hessian, self._cost.rest(prepared, self.curvature, self._case), self._held(slope)
        )

    def _taken_anew(self, prepared: Prepared, multipliers: Array) -> Array:
        """Second derivatives here; those of the hidden state, which change slowly, from the second time on."""
        cost, old = self._cost, self.curvature
        small = old is not None and old.shape[1] < cost.stages.size
        # at these iterations a neglected curvature of the hidden state is checked again
        if old is not None and (self._taken in (1, 4, 16, 64) if small else self._taken > 0):
            old = None
        curvature = cost.curvature(self.at, self._case, multipliers, self._soft, old)
        if old is None:  # nothing was condensed since ``prepared``
            curvature = cost.stages.without_what_is_small(
                curvature, prepared.hessian, prepared.from_u, cost.inner.condenser.by_inputs
            )
        self._stale, self._fresh, self._taken = False, True, self._taken + 1
        return curvature

    def _held(self, slope: Array) -> NDArray[np.bool_] | None:
        """Inputs on a bound with a cost gradient that points outwards."""
        ocp, u = self._cost.inner.ocp, self.at.run.u
        if ocp.blocks is not None:
            return None
        s, near = slope.reshape(u.shape), 1e-6 * self._cost.inner.qp.scale.reshape(u.shape)
        lower, upper = ocp.bounds(self._case.u_prev, self._case.limits)
        return (((u <= lower + near) & (s > 0)) | ((u >= upper - near) & (s < 0))).ravel()

    def _lost(self, found: _Step) -> None:
        """No step lowers the cost: at a stationary point only rounding is left, else restart."""
        self.kkt = max(found.answer.kkt, self._residual(found.hessian, found.hessian @ found.answer.step))
        flat = found.promised <= self._enough + self._cost.rounding(self.at.run.soft[0])
        self.ended = (flat and self.kkt <= KKT) or self._plain
        self.status = Status.SOLVED if self.ended and flat else Status.STOPPED
        self._stale, self._plain, self._damping = not self._fresh, self._fresh, 0.0

    def _refused(self, status: Status) -> None:
        """The QP's solution is invalid: retry with the better conditioned Gauss-Newton Hessian, then stop."""
        self.ended = self._plain
        self._plain, self._damping = True, 0.0
        if self.ended:
            self.status = status if self.count <= 2 else Status.STOPPED


class SQPController(Controller):
    """Nonlinear MPC by SQP to convergence with exact second derivatives, globalised by damping.

    Every iterate is a run of the model: the dynamics hold exactly, limits of inputs and changes are linear and kept by
    every QP, soft bounds are penalties in the cost. So the cost is the merit function: a step is accepted if it lowers
    the cost by at least 1e-4 of the decrease predicted by the QP's convex model. Otherwise it is first corrected for
    the curvature of states and soft bounds along it (Fletcher's second-order correction), then the QP is solved again
    with more damping (Levenberg and Marquardt). Damping carries over and falls after well-predicted steps.

    The QP's Hessian is that of Gauss-Newton plus second derivatives of dynamics and soft bounds, weighted with their
    multipliers: with steep friction or a trained network Gauss-Newton alone converges slowly. They are finite
    differences of the exact Jacobians, are shifted by a period with the plan, and are computed again if the Hessian
    mispredicted more than a tenth of the residual. If the sum is not convex it is convexified, if possible only in
    inputs on a bound. The plan depends on the initial guess only through the basin of attraction.

    Args:
        model: The deployed model; ``n_h`` may be 0. It must not be so unstable that a run over the horizon
            overflows: then no line search finds a finite cost.
        ocp: The problem.
        tolerance: Converged if the convex model predicts a relative decrease of the cost below this value, and
            the KKT residual is at most 1e-6.
        iterations: Most linearizations; a plan that ends there has status STOPPED and may be applied.
        compiled: As in :class:`~hybrid_mpc.control.rti.CondensedController`.
        inner: A real-time iteration of the same model and problem whose functions are reused, which halves the
            construction time. Default: a new one.

    Raises:
        InputError: As :class:`~hybrid_mpc.control.rti.CondensedController`, or if an option is not positive.

    Source: Burke, *Descent methods for composite nondifferentiable optimization problems*, Math. Program.
    33 (1985); Fletcher, *Second order corrections for non-differentiable optimization*, Numerical Analysis,
    Lecture Notes in Mathematics 912 (1982).

    Example: as :class:`~hybrid_mpc.control.rti.CondensedController`.
    """

    def __init__(
        self,
        model: HybridModel,
        ocp: OCP,
        *,
        tolerance: float = 1e-10,
        iterations: int = 100,
        compiled: bool = False,
        inner: CondensedController | None = None,
    ) -> None:
        if not (isinstance(tolerance, int | float) and tolerance > 0):
            raise InputError(f"tolerance: must be positive, got {tolerance!r:.80} [HM-CONTROL-053]")
        iterations = whole(iterations, "iterations", 1, MOST_ITERATIONS)
        inner = CondensedController(model, ocp, compiled=compiled) if inner is None else inner
        self.problem, self._cost = inner.problem, ReducedCost(inner)
        self._tolerance, self._iterations = tolerance, iterations

    @np.errstate(over="ignore", invalid="ignore")  # an overflow is checked and refused
    def solve(
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None, w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """The plan from now on, converged; see :meth:`Controller.solve`.

        Its ``kkt`` is the residual of the nonlinear problem in the QP's scaling, with the last QP's multipliers.
        """
        start = perf_counter()
        target = self.problem.target(reference, weight, estimate, w, previous.steady)
        case = Case(estimate.d, previous.u[0], target, limits)
        u = self._admissible(previous.following, case)
        run = self._cost.run(np.concatenate([estimate.x, estimate.h]), u, case)
        active, lifted = self._cost.inner.qp.later(previous.active), 0
        # a first plan, far from a good one; with few iterations the given guess is only improved
        if not np.isfinite(previous.cost) and case.target.ok and self._iterations > LIFTED:
            given = estimate, reference, weight, limits, w
            run, active, lifted = self._lifted(previous, run, case, given)
        at = self._cost.at(run, case)
        descent = Descent(self._cost, case, at, self._shifted(previous), self._tolerance, active)
        descent.count = lifted
        if not (np.isfinite(run.cost) and np.all(np.isfinite(at.gradient)) and case.target.ok):
            descent.status, descent.ended = Status.NOT_FINITE, True
        while descent.count < self._iterations and not descent.ended:
            descent.iterate()
        return self._plan(descent, case, start)

    def _lifted(
        self, previous: Solution, run: Rollout, case: Case,
        given: tuple[Estimate, Array, Array | None, Limits | None, Array | None],
    ) -> tuple[Rollout, Active | None, int]:  # fmt: skip
        """Start of the descent: the cheapest run among the plans of Gauss-Newton multiple shooting, and their number.

        Multiple shooting may violate the model's equations in between, so it finds e.g. a swing-up in a few steps that
        runs from rest would only approach slowly.
        """
        inner, (estimate, reference, weight, limits, w) = self._cost.inner, given
        best, active, count = run, None, 0
        prepared = inner.prepare(previous, weight)
        while count < LIFTED:
            count += 1
            plan = inner.feedback(prepared, estimate, reference, limits, w)
            if not plan.status.ok:
                break
            run = self._cost.run(run.z[0], self._admissible(plan.u, case), case)
            if run.cost < best.cost or not np.isfinite(best.cost):
                best, active = run, plan.active
            # 1 %: the QP predicts the cost of the run, so multiple shooting ends
            if abs(run.cost - plan.cost) <= 0.01 * abs(run.cost):
                break
            z = np.hstack([plan.x, plan.h])
            prepared = inner.linearize(
                plan.u, z, plan.d, prepared.u_prev, prepared.weight, plan.w, plan.steady, plan.active
            )
        return best, active, count

    def _shifted(self, previous: Solution) -> Array | None:
        """Second derivatives of the previous plan, shifted by a period; None if they do not fit."""
        given = previous.curvature
        if given is None or not self._cost.stages.fits(given, self.ocp.horizon):
            return None
        return np.concatenate([given[1:], given[-1:]]) if np.all(np.isfinite(given)) else None

    def _admissible(self, u: Array, case: Case) -> Array:
        """``u`` held over its blocks and clipped to the limits, one input after the other, as the QPs need it."""
        u_prev = case.u_prev
        lower, upper = self.ocp.bounds(u_prev, case.limits)
        if self.ocp.du_max is None:
            return self.ocp.held(np.clip(u, lower, upper))
        rows = u.copy()
        for start in self.ocp.block_starts:
            u_prev = np.clip(self.ocp.saturate(u[start], u_prev), lower[start], upper[start])
            rows[start] = u_prev
        return self.ocp.held(rows)

    def _plan(self, descent: Descent, case: Case, start: float) -> Solution:
        at, n_x = descent.at.run, self.ocp.n_x
        excess = self.problem.soft.excess(at.soft[0])
        diverges = descent.status.ok and self.problem.diverges(at.z[1:, :n_x])
        return Solution(
            u=at.u, x=at.z[:, :n_x], h=at.z[:, n_x:], d=case.d, cost=at.cost,
            status=Status.DIVERGED if diverges else descent.status, kkt=descent.kkt, defect=0.0,
            timing={"solve": (perf_counter() - start) * 1e3}, excess=self.problem.soft.largest(excess),
            iterations=descent.count, curvature=descent.curvature, w=case.target.w, steady=case.target.steady,
            active=descent.active, given_way=self.problem.soft.given_way(excess),
        )  # fmt: skip
