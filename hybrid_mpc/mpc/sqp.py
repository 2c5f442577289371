"""Sequential quadratic programming: the condensed iteration repeated to convergence, with damping."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.condensed import CondensedController
from hybrid_mpc.mpc.descent import Descent
from hybrid_mpc.mpc.landscape import Case, Landscape
from hybrid_mpc.mpc.limits import Limits
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.problem import Problem
from hybrid_mpc.mpc.solution import Solution, Status

Array = NDArray[np.float64]


class SQPController:
    """Nonlinear MPC by SQP to convergence with exact second derivatives, globalised by damping.

    Every iterate is a run of the model itself: the dynamics hold exactly, limits of inputs and changes are
    linear and kept by every QP, soft bounds are penalties within the cost. So the cost itself is the merit
    function, and a step is made when it lowers the cost by a share (1e-4) of what the QP's convex model
    promises. One that does not is corrected first by what states and soft bounds were found to bend along it
    (Fletcher's second-order correction: a stiff weight or penalty otherwise cuts every step short), then the QP
    is solved again with more curvature in all directions (Levenberg and Marquardt's damping), which carries
    over to the next iteration and falls where steps keep their promise.

    The QP's Hessian is Gauss-Newton's and the second derivatives of the dynamics and of soft bounds by states,
    inputs and hidden states, weighted with their multipliers: under a steep friction law or a trained network
    these outweigh Gauss-Newton's, which alone then converges slowly. They are differences of the exact
    Jacobians (``n_x + n_u + n_h`` evaluations), come along with a plan, shifted by a period, and are taken
    anew where the Hessian got more than a tenth of the residual wrong, those by the hidden state from the
    second time in a solve on. Where their sum with Gauss-Newton's is not convex it is made so, if possible in
    the inputs alone that lie on a bound. The plan is independent of the first guess but for the basin it lies
    in.

    Args:
        model: The deployed model; ``n_h`` may be 0. It must not be so unstable that a run over the horizon
            overflows: then no line search finds a finite cost.
        ocp: The problem.
        tolerance: Converged when the convex model promises to lower the cost by less than this share, and
            the KKT residual is at most 1e-6.
        iterations: Most linearisations; the plan then reached has the status STOPPED and may be applied.
        compiled: As in :class:`~hybrid_mpc.mpc.CondensedController`.

    Raises:
        InputError: As :class:`~hybrid_mpc.mpc.CondensedController`, or if an option is not positive.

    Source: Burke, *Descent methods for composite nondifferentiable optimization problems*, Math. Program.
    33 (1985); Fletcher, *Second order corrections for non-differentiable optimization*, Numerical Analysis,
    Lecture Notes in Mathematics 912 (1982).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.estimation import TrueState
        >>> from hybrid_mpc.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sine", 1.0, level, (Signal("u", "-"),), level,
        ...     x=x, u=u, x_next=x + ca.sin(u), xdot=u, y=x)
        >>> controller = SQPController(model, OCP(5, [1.0], [1.0], [0.0], [-1.5], [1.5]))
        >>> estimate = TrueState(model).start([2.0])
        >>> solution = controller.solve(controller.initial(estimate), estimate, np.zeros((6, 1)))
        >>> solution.status.name, solution.defect
        ('SOLVED', 0.0)
    """

    def __init__(
        self,
        model: HybridModel,
        ocp: OCP,
        *,
        tolerance: float = 1e-10,
        iterations: int = 100,
        compiled: bool = False,
    ) -> None:
        if not tolerance > 0 or iterations < 1:
            raise InputError(
                f"tolerance must be positive and iterations at least 1, got {tolerance} and {iterations}"
            )
        self._inner = CondensedController(model, ocp, compiled=compiled)
        self._tolerance, self._iterations = tolerance, iterations
        self._landscape = Landscape(self._inner)

    @property
    def model(self) -> HybridModel:
        """The model that predicts."""
        return self._inner.model

    @property
    def ocp(self) -> OCP:
        """The problem."""
        return self._inner.ocp

    @property
    def problem(self) -> Problem:
        """Problem and model made ready."""
        return self._inner.problem

    def initial(self, estimate: Estimate, u: Array | None = None) -> Solution:
        """A first plan: the model run freely from the estimate; see :meth:`Problem.initial`."""
        return self._inner.initial(estimate, u)

    @np.errstate(over="ignore", invalid="ignore")  # what overflows is looked at and refused
    def solve(
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None,
    ) -> Solution:  # fmt: skip
        """The plan from now on, converged; see :meth:`Controller.solve`.

        Its ``kkt`` is the residual of the nonlinear problem in the QP's scaling, with the multipliers of the
        last QP.
        """
        start = perf_counter()
        case = Case(estimate.d, previous.u[0], self.problem.target(reference, weight), limits)
        u = self._admissible(np.vstack([previous.u[1:], previous.u[-1:]]), case)
        run = self._landscape.run(np.concatenate([estimate.x, estimate.h]), u, case)
        at = self._landscape.at(run, case)
        search = Descent(self._landscape, case, at, self._shifted(previous), self._tolerance)
        if not (np.isfinite(run.cost) and np.all(np.isfinite(at.gradient)) and case.target.ok):
            search.status = Status.NOT_FINITE
            return replace(self._plan(search, estimate.d), timing=_spent(start))
        while search.count < self._iterations and not search.ended:
            search.iterate()
        return replace(self._plan(search, estimate.d), timing=_spent(start))

    def _shifted(self, previous: Solution) -> Array | None:
        """Second derivatives along the previous plan, a period later; None if it has none that fit."""
        given = previous.curvature
        if given is None or not self._landscape.stages.fits(given, self.ocp.horizon):
            return None
        return np.concatenate([given[1:], given[-1:]]) if np.all(np.isfinite(given)) else None

    def _admissible(self, u: Array, case: Case) -> Array:
        """``u`` held over its blocks and moved into the limits, one input after the other.

        The QPs keep what the first guess keeps.
        """
        u_prev = case.u_prev
        lower, upper = self.ocp.bounds(u_prev, case.limits)
        if self.ocp.du_max is None:
            return self.ocp.held(np.clip(u, lower, upper))
        rows = u.copy()
        for start in self.ocp.block_starts:
            u_prev = np.clip(self.ocp.saturate(u[start], u_prev), lower[start], upper[start])
            rows[start] = u_prev
        return self.ocp.held(rows)

    def _plan(self, search: Descent, d: Array) -> Solution:
        at, n_x = search.at.run, self.ocp.n_x
        excess = self.problem.soft.excess(at.soft[0])
        return Solution(
            at.u, at.z[:, :n_x], at.z[:, n_x:], d, at.cost, search.status, search.kkt, 0.0, {},
            float(np.max(excess, initial=0.0)), search.count, search.curvature,
        )  # fmt: skip


def _spent(start: float) -> dict[str, float]:
    return {"solve": (perf_counter() - start) * 1e3}
