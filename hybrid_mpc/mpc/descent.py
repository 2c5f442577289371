"""One solve of the SQP: runs of the model, their cost and derivatives, and the steps from one to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.mpc.condensed import CondensedController
from hybrid_mpc.mpc.condensing import Prepared, adjoint, condense_hessians
from hybrid_mpc.mpc.curvature import Secants, StageCurvature, convex
from hybrid_mpc.mpc.problem import Target
from hybrid_mpc.mpc.solution import Status
from hybrid_mpc.mpc.stages import Derivatives

Array = NDArray[np.float64]
NAN = float("nan")
ARMIJO = 1e-4
KKT = 1e-6
HALVINGS = 25
SLOW = 0.1
"""Share of the residual that is left after a step, above which second derivatives are taken anew."""


@dataclass(frozen=True)
class Case:
    """What one solve is given: disturbance, input held before, targets."""

    d: Array
    u_prev: Array
    target: Target


@dataclass(frozen=True)
class Point:
    """A run of the model on inputs.

    Args:
        u: Inputs ``(N, n_u)``.
        z: Run ``(N + 1, n_z)``.
        cost: Its cost, penalties of soft bounds included.
        derivatives: Successors, transposed ``A`` and ``B`` of the stages.
        multipliers: Derivative of the cost by ``z_1 .. z_N``, soft bounds left out ``(N, n_z)``.
        gradient: Of the cost by the inputs, soft bounds left out ``(N n_u,)``.
        on_soft: True if a soft bound acts or nearly does.
    """

    u: Array
    z: Array
    cost: float
    derivatives: Derivatives
    multipliers: Array
    gradient: Array
    on_soft: bool


class Landscape:
    """Cost and derivatives of a problem along runs of its model. Built once, for any number of cases."""

    def __init__(self, inner: CondensedController) -> None:
        self.inner, self.problem = inner, inner.problem
        self.stages = StageCurvature(inner.stages, inner.ocp)

    def at(self, z0: Array, u: Array, case: Case) -> Point:
        """The run from ``z0`` on ``u`` and what is known along it."""
        problem, n_x = self.problem, self.inner.ocp.n_x
        derivatives = self.inner.stages.run(z0, u + case.d)
        z = np.vstack([z0, derivatives[0]])
        cost = problem.cost(z, u, case.u_prev, case.target)
        stages, terminal = problem.state_weights(case.target.weight)
        error = z[:, :n_x] - case.target.x
        slopes, direct = 2 * stages * error[:-1], self.inner.input_gradient(u.ravel(), case.u_prev)
        if self.inner.ocp.economic is not None:
            economic = problem.economic.derivatives(z[:, :n_x], u)[0]
            slopes, direct = slopes + economic[:, :n_x], direct + economic[:, n_x:].ravel()
        multipliers = adjoint(derivatives[1], 2 * terminal @ error[-1], slopes)
        gradient = (multipliers[:, None, :] @ derivatives[2]).ravel() + direct
        return Point(u, z, cost, derivatives, multipliers, gradient, self._on_soft_bounds(z, u))

    def curvature(self, at: Point, case: Case, old: Array | None = None, chosen: Sequence[int] = ()) -> Array:
        """Second derivatives of the stages, weighted; see :meth:`StageCurvature.of`."""
        _, a_t, b = at.derivatives
        return self.stages.of(at.z[:-1], at.u + case.d, a_t, b, at.multipliers, old, chosen)

    def condensed(self, at: Point, case: Case) -> Prepared:
        """The Gauss-Newton model of the cost at a point."""
        weight = case.target.weight
        return self.inner.condense(
            at.u, at.z, case.d, case.u_prev, weight, at.derivatives, perf_counter()
        )  # fmt: skip

    def _on_soft_bounds(self, z: Array, u: Array) -> bool:
        soft = self.problem.soft
        if not len(soft):
            return False
        values = soft.values(z[:, : self.inner.ocp.n_x], u)
        return bool(np.max(np.maximum(values - soft.upper, soft.lower - values) / soft.scale) > -1e-4)


class Descent:
    """The steps of one solve, from a first point on.

    Args:
        landscape: Cost and derivatives.
        case: What the solve is given.
        at: The first run; its cost is finite.
        curvature: Second derivatives from the last solve, shifted. Default: taken at the first run.
        tolerance: See :class:`~hybrid_mpc.mpc.SQPController`.
    """

    def __init__(
        self, landscape: Landscape, case: Case, at: Point, curvature: Array | None, tolerance: float
    ) -> None:
        self._land, self._case, self._tolerance = landscape, case, tolerance
        self.at, self.curvature = at, curvature
        self.count, self.status, self.kkt, self.ended = 0, Status.STOPPED, NAN, False
        self._stale, self._fresh, self._plain = curvature is None, False, False
        # What the first refreshing may keep in part; any further one takes all.
        self._old = curvature
        self._secants = Secants()

    def iterate(self) -> None:
        """One linearisation, one QP, one line search."""
        self.count += 1
        at, qp, problem = self.at, self._land.inner.qp, self._land.problem
        prepared = self._land.condensed(at, self._case)
        hessian = self._hessian(prepared)
        value, _, slope = prepared.soft
        soft = (value, slope) if value.size else None
        step, status, kkt = qp.solve(hessian, at.gradient, at.u, self._case.u_prev, soft)
        if not status.ok:
            self._refused(status)
            return
        moved = hessian @ step
        promised = -float(step @ (at.gradient + 0.5 * moved))
        if soft is not None:
            kept = (problem.soft.penalty(problem.soft.excess(v)) for v in (value, value + slope @ step))
            promised += problem.model.dt * (next(kept) - next(kept))
        found, share = self._search(step.reshape(at.u.shape), promised)
        before = max(kkt, self._residual(hessian, moved))
        flat = promised <= self._enough
        if found is None:
            self._lost(flat, before)
            return
        smooth = share == 1.0 and not at.on_soft and not found.on_soft
        if smooth:  # the QP's multipliers hold on: what is left of the stationarity there
            left = found.gradient - at.gradient - moved
            after = max(kkt, self._residual(hessian, left))
            flat = after <= KKT and self._lowers_little(hessian, left)
            slow = after > SLOW * before
        else:
            after, slow = before, share < 1.0 or not before < SLOW * self.kkt
        self._secants.see((found.u - at.u).ravel(), found.gradient - at.gradient, self.count, not smooth)
        self.at, self.kkt, self._stale, self._fresh, self._plain = found, after, slow, False, False
        self.ended = flat and after <= KKT
        self.status = Status.SOLVED if self.ended else Status.STOPPED

    def _lowers_little(self, hessian: Array, left: Array) -> bool:
        """True if the convex model at the new point promises next to nothing (weak duality)."""
        qp = self._land.inner.qp
        left, hessian = qp.by_blocks(left), qp.blocked_hessian(hessian)
        return 0.5 * float(left @ np.linalg.solve(hessian, left)) <= self._enough

    def _residual(self, hessian: Array, slope: Array) -> float:
        """A gradient of the cost by the inputs in the QP's scaling."""
        qp = self._land.inner.qp
        size = np.max(np.diag(qp.blocked_hessian(hessian)) * qp.scale**2)
        return float(np.max(np.abs(qp.scale * qp.by_blocks(slope))) / size)

    @property
    def _enough(self) -> float:
        return self._tolerance * max(abs(self.at.cost), 1e-12)

    def _hessian(self, prepared: Prepared) -> Array:
        if self._plain:
            return prepared.hessian
        if self._stale or self.curvature is None:
            old, chosen, stages = self._old, [], self._land.stages
            if (
                old is not None
            ):  # from another period, or from before a step: mostly a few of them have changed
                chosen = stages.that_matter(old, prepared.from_u, prepared.hessian)
            self.curvature = self._land.curvature(self.at, self._case, old, chosen)
            self._stale, self._fresh, self._old = False, True, None
        if not np.all(np.isfinite(self.curvature)):
            return prepared.hessian
        rest = self._land.stages.condensed(self.curvature, prepared.from_u)
        if prepared.economic is not None:  # what curves down, which the convex model takes as flat
            at, economic = self.at, self._land.problem.economic
            down = economic.derivatives(at.z[:, : self._land.inner.ocp.n_x], at.u)[1] - prepared.economic[1]
            rest = rest + condense_hessians(down, prepared.from_u, self._land.inner.ocp.n_x)
        return self._secants.corrected(convex(prepared.hessian, rest))

    def _lost(self, flat: bool, kkt: float) -> None:
        """No share of the step lowers the cost: where it is flat what is left is rounding, else start anew."""
        self.kkt = kkt
        self.ended = (flat and kkt <= KKT) or self._plain
        self.status = Status.SOLVED if self.ended and flat else Status.STOPPED
        self._stale, self._plain, self._secants = not self._fresh, self._fresh, Secants()

    def _refused(self, status: Status) -> None:
        """The QP's answer is no good: Gauss-Newton's Hessian is better conditioned, then it is over."""
        self.ended = self._plain
        self._plain, self._secants = True, Secants()
        if self.ended:
            self.status = status if self.count <= 2 else Status.STOPPED

    def _search(self, step: Array, promised: float) -> tuple[Point | None, float]:
        """The run on the first halved step that lowers the cost enough, if there is one, and the share."""
        at, ocp, problem, case = self.at, self._land.inner.ocp, self._land.problem, self._case
        share = 1.0
        for _ in range(HALVINGS):
            trial = np.clip(at.u + share * step, ocp.u_min, ocp.u_max)
            if share == 1.0:
                found = self._land.at(at.z[0], trial, case)
                reached = found.cost
            else:
                z = problem.run(at.z[0], trial + case.d)
                reached = problem.cost(z, trial, case.u_prev, case.target)
            if reached <= at.cost - ARMIJO * share * promised:
                return (found if share == 1.0 else self._land.at(at.z[0], trial, case)), share
            share *= 0.5
        return None, 0.0
