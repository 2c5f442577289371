"""Cost and derivatives of a problem along runs of its model."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.mpc.condensed import CondensedController
from hybrid_mpc.mpc.condensing import Prepared, adjoint, condense_hessians
from hybrid_mpc.mpc.curvature import StageCurvature
from hybrid_mpc.mpc.limits import Limits
from hybrid_mpc.mpc.problem import Target
from hybrid_mpc.mpc.stages import Derivatives

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """What one solve is given: disturbance, input held before, targets, and limits tighter than the problem's."""

    d: Array
    u_prev: Array
    target: Target
    limits: Limits | None = None


@dataclass(frozen=True)
class Run:
    """A run of the model on inputs.

    Args:
        u: Inputs ``(N, n_u)``.
        z: Trajectory ``(N + 1, n_z)``.
        soft: Values of the soft bounds ``(M,)``, their derivatives by their state ``(M, n_x)`` and input.
        cost: Penalties of soft bounds included.
    """

    u: Array
    z: Array
    soft: tuple[Array, Array, Array]
    cost: float


@dataclass(frozen=True)
class Point:
    """A run with its first derivatives.

    Args:
        run: The run.
        derivatives: Successors, transposed ``A`` and ``B`` of the stages.
        multipliers: Derivative of the cost by ``z_1 .. z_N``, soft bounds left out ``(N, n_z)``.
        gradient: Of the cost by the inputs, soft bounds left out ``(N n_u,)``.
    """

    run: Run
    derivatives: Derivatives
    multipliers: Array
    gradient: Array


class Landscape:
    """Cost and derivatives of a problem along runs of its model. Built once, for any number of cases."""

    def __init__(self, inner: CondensedController) -> None:
        self.inner, self.problem = inner, inner.problem
        self.stages = StageCurvature(inner.stages, inner.ocp, inner.model.n_h, inner.problem.soft)
        self.metric: Array = np.tile(inner.ocp.input_scale**-2.0, inner.ocp.horizon)

    def run(self, z0: Array, u: Array, case: Case) -> Run:
        """The run from ``z0`` on ``u``."""
        problem, n_x = self.problem, self.inner.ocp.n_x
        z = self.inner.stages.run(z0, u + case.d)
        soft = problem.soft.linearise(z[:, :n_x], u)
        excess = problem.soft.excess(soft[0])
        return Run(u, z, soft, problem.cost(z, u, case.u_prev, case.target, excess))

    def at(self, run: Run, case: Case) -> Point:
        """What is known along a run."""
        problem, n_x = self.problem, self.inner.ocp.n_x
        derivatives = self.inner.stages.at(run.z[:-1], run.u + case.d)
        stages, terminal = problem.state_weights(case.target.weight)
        error = run.z[:, :n_x] - case.target.x
        slopes, direct = 2 * stages * error[:-1], self.inner.input_gradient(run.u.ravel(), case.u_prev)
        if self.inner.ocp.economic is not None:
            economic = problem.economic.derivatives(run.z[:, :n_x], run.u, case.target.p)[0]
            slopes, direct = slopes + economic[:, :n_x], direct + economic[:, n_x:].ravel()
        multipliers = adjoint(derivatives[1], 2 * terminal @ error[-1], slopes)
        gradient = (multipliers[:, None, :] @ derivatives[2]).ravel() + direct
        return Point(run, derivatives, multipliers, gradient)

    def lagrangian(self, at: Point, soft: Array) -> tuple[Array, Array]:
        """Multipliers of the dynamics and gradient with the soft bounds in, whose multipliers are ``soft``."""
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
        """Second derivatives of the stages, weighted; see :meth:`StageCurvature.of`."""
        _, a_t, b = at.derivatives
        inputs = np.stack([at.run.u, at.run.u + case.d])
        return self.stages.of(at.run.z, inputs, a_t, b, multipliers, soft, old)

    def condensed(self, at: Point, case: Case) -> Prepared:
        """The Gauss-Newton model of the cost at a point."""
        return self.inner.condense(
            at.run.u, at.run.z, case.d, case.u_prev, case.target.weight, at.derivatives, perf_counter(),
            case.target.p,
        )  # fmt: skip

    def without_what_is_small(self, prepared: Prepared, curvature: Array) -> Array:
        """See :meth:`StageCurvature.without_what_is_small`; nothing was condensed since ``prepared``."""
        by_inputs = self.inner.condenser.by_inputs
        return self.stages.without_what_is_small(curvature, prepared.hessian, prepared.from_u, by_inputs)

    def penalty(self, values: Array) -> float:
        """What values of the soft bounds cost."""
        soft = self.problem.soft
        return self.problem.model.dt * soft.penalty(soft.excess(values))

    def gap(self, values: Array, multipliers: Array) -> float:
        """By how much the penalties of values may exceed those after the best change (Fenchel's inequality).

        Args:
            values: Of the soft bounds ``(M,)``.
            multipliers: Under which everything else is stationary ``(M,)``.
        """
        soft, dt, acting = self.problem.soft, self.problem.model.dt, np.flatnonzero(multipliers)
        mu = multipliers[acting]
        bound = np.where(mu > 0, soft.upper[acting], soft.lower[acting])
        beyond = np.maximum(0.0, np.abs(mu) - dt * soft.linear[acting])
        proven = mu @ (values[acting] - bound) - np.sum(beyond**2 / (4 * dt * soft.quadratic[acting]))
        return self.penalty(values) - float(proven)

    def rest(self, prepared: Prepared, curvature: Array, case: Case) -> Array:
        """What the exact Hessian has besides ``prepared``'s; nothing was condensed since."""
        rest = self.stages.condensed(curvature, prepared.from_u, self.inner.condenser.by_inputs)
        if prepared.economic is not None:  # what curves down, which the convex model takes as flat
            n_x = self.inner.ocp.n_x
            exact = self.problem.economic.derivatives(prepared.z[:, :n_x], prepared.u, case.target.p)[1]
            rest = rest + condense_hessians(exact - prepared.economic[1], prepared.from_u, n_x)
        return rest
