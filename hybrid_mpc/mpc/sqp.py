"""Sequential quadratic programming: the condensed iteration repeated to convergence, with a line search."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.condensed import CondensedController
from hybrid_mpc.mpc.condensing import Prepared
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.problem import Problem, Target
from hybrid_mpc.mpc.solution import Solution, Status

Array = NDArray[np.float64]
NAN = float("nan")
ARMIJO = 1e-4
KKT = 1e-6
HALVINGS = 25
# Iterations by Gauss-Newton alone: quick where the residuals are small, and steady far from the solution.
GAUSS_NEWTON = 10
MEMORY = 10


class SQPController:
    """Nonlinear MPC by Gauss-Newton SQP to convergence, globalised by a line search.

    Every iterate is a run of the model itself: the dynamics hold exactly, limits of inputs and changes are
    linear and kept by every QP, soft bounds are penalties within the cost. So the cost itself is the merit
    function, and a step along the QP's answer is accepted when it lowers the cost by a share (1e-4) of what
    the QP's convex model promises; the step is halved until it does (Burke's method for convex composite
    functions: near a solution whose residuals are small full steps are taken). Where ten iterations were not
    enough, the Gauss-Newton Hessian leaves out too much: from then on it is corrected by what the last steps
    have shown of the gradient (damped BFGS updates), unless a soft bound acts. Slower than the RTI by the
    number of iterations, and independent of the first guess but for the basin that it lies in.

    Args:
        model: The deployed model; ``n_h`` may be 0. It must not be so unstable that a run over the horizon
            overflows: then no line search finds a finite cost.
        ocp: The problem.
        tolerance: Converged when the QP promises to lower the cost by less than this share, and the KKT
            residual is at most 1e-6.
        iterations: Most linearisations; the plan then reached has the status STOPPED and may be applied.

    Raises:
        InputError: If problem and model do not fit, or an option is not positive.

    Source: Burke, *Descent methods for composite nondifferentiable optimization problems*, Math. Program.
    33 (1985).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.estimation import TrueState
        >>> from hybrid_mpc.signals import Signal
        >>> x, h, u, w = ca.MX.sym("x"), ca.MX.sym("h", 0), ca.MX.sym("u"), ca.MX.sym("w")
        >>> model = HybridModel("sine", 1.0, (Signal("x", "-"),), (Signal("u", "-"),), (Signal("x", "-"),),
        ...     ca.Function("f", [x, h, u], [x + ca.sin(u), h]), ca.Function("g", [x, h, u], [u]),
        ...     ca.Function("y", [x, u], [x]), ca.Function("e", [x, w, u], [w - u]))
        >>> controller = SQPController(model, OCP(5, [1.0], [1.0], [0.0], [-1.5], [1.5]))
        >>> estimate = TrueState(model).start([2.0])
        >>> solution = controller.solve(controller.initial(estimate), estimate, np.zeros((6, 1)))
        >>> solution.status.name, solution.defect
        ('SOLVED', 0.0)
    """

    def __init__(
        self, model: HybridModel, ocp: OCP, *, tolerance: float = 1e-10, iterations: int = 100
    ) -> None:
        if not tolerance > 0 or iterations < 1:
            raise InputError(
                f"tolerance must be positive and iterations at least 1, got {tolerance} and {iterations}"
            )
        self._inner = CondensedController(model, ocp)
        self._tolerance, self._iterations = tolerance, iterations

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
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None = None
    ) -> Solution:
        """The plan from now on, converged; see :meth:`Controller.solve`.

        Its ``kkt`` is the residual of the nonlinear problem in the QP's scaling, before the last step: the
        change that this step makes in the QP's gradient.
        """
        start = perf_counter()
        problem, u_prev = self.problem, previous.u[0]
        target = problem.target(reference, weight)
        u = self._admissible(np.vstack([previous.u[1:], previous.u[-1:]]), u_prev)
        z = problem.run(np.concatenate([estimate.x, estimate.h]), u + estimate.d)
        cost = problem.cost(z, u, u_prev, target)
        solution = self._plan(u, z, estimate.d, cost, Status.NOT_FINITE, NAN, 0)
        if not (np.isfinite(cost) and target.ok):
            return replace(solution, timing=_spent(start))
        memory = _Curvature()
        for i in range(1, self._iterations + 1):
            prepared = self._inner.linearise(u, z, estimate.d, u_prev, target.weight)
            memory.see(u, self._inner.gradient(prepared, target.x), i, self._on_soft_bounds(z, u))
            curved = replace(prepared, hessian=memory.corrected(prepared.hessian))
            full = self._inner.feedback(curved, estimate, reference)
            if not full.status.ok:
                solution = replace(solution, status=full.status if i == 1 else Status.STOPPED)
                break
            step = full.u - u
            more = step.ravel() @ (curved.hessian - prepared.hessian) @ step.ravel()
            promised = cost - full.cost - 0.5 * float(more)  # full.cost is the Gauss-Newton model's
            flat = promised <= self._tolerance * max(abs(cost), 1e-12)
            kkt = max(full.kkt, self._residual(curved, step))
            found = self._search(z[0], u, step, estimate.d, u_prev, target, cost, promised)
            stuck = found is None and not memory.pairs
            u, z, cost = found if found is not None else (u, z, cost)
            done = flat and (kkt <= KKT or stuck)  # stuck where it is flat: what is left is rounding
            status = Status.SOLVED if done else Status.STOPPED
            solution = self._plan(u, z, estimate.d, cost, status, kkt, i)
            if done or stuck:
                break
            if found is None:
                memory = _Curvature()
        return replace(solution, timing=_spent(start))

    def _on_soft_bounds(self, z: Array, u: Array) -> bool:
        """True if a soft bound acts or nearly does."""
        soft = self.problem.soft
        if not len(soft):
            return False
        values = soft.values(z[:, : self.ocp.n_x], u)
        return bool(np.max(np.maximum(values - soft.upper, soft.lower - values) / soft.scale) > -1e-4)

    def _admissible(self, u: Array, u_prev: Array) -> Array:
        """``u`` moved into the limits one input after the other: the QPs keep what the first guess keeps."""
        rows = []
        for row in u:
            u_prev = self.ocp.saturate(row, u_prev)
            rows.append(u_prev)
        return np.array(rows)

    def _search(
        self, z0: Array, u: Array, step: Array, d: Array, u_prev: Array, target: Target, cost: float,
        promised: float,
    ) -> tuple[Array, Array, float] | None:  # fmt: skip
        """Inputs, run and cost of the first halved step that lowers the cost enough, if there is one."""
        share = 1.0
        for _ in range(HALVINGS):
            trial = np.clip(u + share * step, self.ocp.u_min, self.ocp.u_max)
            z = self.problem.run(z0, trial + d)
            reached = self.problem.cost(z, trial, u_prev, target)
            if reached <= cost - ARMIJO * share * promised:
                return trial, z, reached
            share *= 0.5
        return None

    def _residual(self, prepared: Prepared, step: Array) -> float:
        scale, h = self._inner.qp.scale, prepared.hessian
        moved = scale * (h @ step.ravel())
        size = float(np.max(np.diag(h) * scale**2))
        return float(np.max(np.abs(moved))) / size

    def _plan(
        self, u: Array, z: Array, d: Array, cost: float, status: Status, kkt: float, i: int
    ) -> Solution:
        n_x, soft = self.ocp.n_x, self.problem.soft
        excess = soft.excess(soft.values(z[:, :n_x], u)) if len(soft) else np.zeros(0)
        return Solution(
            u, z[:, :n_x], z[:, n_x:], d, cost, status, kkt, 0.0, {},
            float(np.max(excess, initial=0.0)), i,
        )  # fmt: skip


class _Curvature:
    """What the last steps of one solve have shown of the curvature that Gauss-Newton leaves out."""

    def __init__(self) -> None:
        self.pairs: list[tuple[Array, Array]] = []
        self._before: tuple[Array, Array] | None = None

    def see(self, u: Array, gradient: Array, iteration: int, on_soft_bounds: bool) -> None:
        """A new iterate ``u`` ``(N, n_u)`` and the exact gradient there ``(N n_u,)``."""
        now = u.ravel(), gradient
        if on_soft_bounds:
            self.pairs = []  # the kink of a penalty is no curvature
        elif self._before is not None and iteration > GAUSS_NEWTON:
            self.pairs = [*self.pairs, (now[0] - self._before[0], now[1] - self._before[1])][-MEMORY:]
        self._before = now

    def corrected(self, hessian: Array) -> Array:
        """The Gauss-Newton Hessian after damped BFGS updates, the oldest first: positive definite as before.

        Source: Nocedal and Wright, *Numerical Optimization*, 2006, procedure 18.2.
        """
        b = hessian
        for s, y in self.pairs:
            bs = b @ s
            sbs, sy = float(s @ bs), float(s @ y)
            if not sbs > 1e-300:
                continue
            if sy < 0.2 * sbs:
                share = 0.8 * sbs / (sbs - sy)
                y = share * y + (1 - share) * bs
                sy = 0.2 * sbs
            b = b - np.outer(bs, bs / sbs) + np.outer(y, y / sy)
        return np.asarray(0.5 * (b + b.T)) if self.pairs else hessian


def _spent(start: float) -> dict[str, float]:
    return {"solve": (perf_counter() - start) * 1e3}
