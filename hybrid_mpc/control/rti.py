"""Gauss-Newton real-time iteration on the condensed multiple-shooting problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dgemm, dgemv

from hybrid_mpc.control.ocp import OCP, Limits
from hybrid_mpc.control.problem import (
    Problem,
    Solution,
    SplitController,
    Status,
    Target,
    weights_ok,
)
from hybrid_mpc.control.qp import InputQP
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.model.active_set import Active
from hybrid_mpc.model.equilibrium import Steady
from hybrid_mpc.model.limits import MOST_ITERATIONS, whole
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.stages import Derivatives, stages

Array = NDArray[np.float64]
NAN = float("nan")
GROUP = 10
"""Periods whose second derivatives are condensed in one matrix product."""
CORRECTIONS = 8
"""Most QPs of a feedback after the first, each with the bounds linearized at the plan of the one before."""
STRAIGHT = 1e-6
"""Violation of a curved bound beyond that of its linearization, over its size, up to which a plan is not corrected. A
hard bound that its linearization keeps has no such tolerance."""


@dataclass(frozen=True)
class Prepared:
    """The part of an iteration that needs neither estimate nor reference, linearized at ``u, z, d, w``.

    With ``dz = (x, h) - (x_bar, h_bar)`` the linearized prediction is ``dz_{k+1} = A_k dz_k + B_k (du_k + dd) +
    defect_k``; ``a_t`` holds the transposed ``A_k``. By the inputs' change, ``x`` has the derivative ``from_u``
    ``((N + 1) n_x, N n_u)``, and the cost the ``hessian``; ``weighted`` is it times the state weights, ``direct``
    the gradient of the costs of inputs and changes without targets. ``soft`` is the result of
    :meth:`BoundRows.condensed`, ``economic`` are the first derivatives ``(N, n_x + n_u)`` of the economic stage costs
    and their convexified second derivatives, or None. ``e`` are further arguments of the bounded values,
    ``multipliers`` those of the bounds.
    """

    u: Array
    z: Array
    d: Array
    u_prev: Array
    a_t: Array
    b: Array
    defects: Array
    from_u: Array
    weighted: Array
    direct: Array
    hessian: Array
    weight: Array
    soft: tuple[Array, Array, Array]
    economic: tuple[Array, Array] | None
    milliseconds: float
    w: Array
    e: Array
    steady: Steady | None = None
    active: Active | None = None
    multipliers: Array | None = None


class Condenser:
    """Derivatives of the states by the inputs, in its own scratch memory: not thread-safe.

    Each period's array is one product with the previous one; all cost ``N^2 n_u n_z^2`` operations. The states
    are the first ``n_x`` of z.
    """

    by_inputs: Array
    """Derivatives ``(N + 1, n_z, N n_u)`` of ``z_0 .. z_N`` by the inputs; the next call overwrites them."""

    def __init__(self, n: int, n_z: int, n_u: int, n_x: int) -> None:
        by_rows = np.zeros((n + 1, n * n_u, n_z))  # derivatives by later inputs are zero
        self.by_inputs = by_rows.transpose(0, 2, 1)
        self._newest = by_rows[1:].reshape(n, n, n_u, n_z)
        self._stages = np.arange(n)
        self._before = [self.by_inputs[k, :, : k * n_u] for k in range(1, n)]  # column by column in memory
        self._after = [self.by_inputs[k + 1, :, : k * n_u] for k in range(1, n)]
        self._states = self.by_inputs[:, :n_x]
        self._shape = (n + 1) * n_x, n * n_u

    def __call__(self, a_t: Array, b: Array) -> Array:
        """``((N + 1) n_x, N n_u)`` from transposed ``A_k`` ``(N, n_z, n_z)`` and ``B_k`` ``(N, n_z, n_u)``."""
        self._newest[self._stages, self._stages] = b.transpose(0, 2, 1)
        matrices, transposed = _columns(a_t)
        for matrix, before, after in zip(matrices[1:], self._before, self._after, strict=True):
            dgemm(1.0, matrix, before, 0.0, after, transposed, 0, 1)  # in place, as in propagate
        return np.array(self._states, order="C").reshape(self._shape)  # outlives the next call


def _columns(a_t: Array) -> tuple[list[Array], int]:
    """Matrices in column-major order, and whether they are transposed ``A_k`` (1) or ``A_k`` (0)."""
    if a_t.flags.c_contiguous:
        return list(a_t.transpose(0, 2, 1)), 0
    return list(a_t), 1


def propagate(a_t: Array, drift: Array, dz0: Array) -> Array:
    """``dz_{k+1} = A_k dz_k + drift_k`` from ``dz0``: ``(N + 1, n_z)``; transposed ``A_k`` ``(N, n_z, n_z)``."""
    dz = np.concatenate([dz0[None], drift])
    rows = list(dz)
    matrices, transposed = _columns(a_t)
    for matrix, before, after in zip(matrices, rows[:-1], rows[1:], strict=True):
        # in place, arguments by position: half the time of numpy's two calls, and of names
        dgemv(1.0, matrix, before, 1.0, after, 0, 1, 0, 1, transposed, 1)
    return dz


def adjoint(a_t: Array, last: Array, stages: Array) -> Array:
    """Multipliers ``(N, n_z)`` of the stages' results: derivative of the cost by ``z_1 .. z_N``.

    ``last`` ``(n_x,)`` is the derivative of the terminal cost, ``stages`` ``(N, n_x)`` are those of the stage costs.
    """
    n_x = last.size
    multipliers = np.zeros((len(a_t), a_t.shape[1]))
    multipliers[:-1, :n_x] = stages[1:]
    multipliers[-1, :n_x] = last
    matrices, transposed = _columns(a_t)
    backwards = matrices[:0:-1], multipliers[:0:-1], multipliers[-2::-1]
    for matrix, after, before in zip(*backwards, strict=True):
        dgemv(1.0, matrix, after, 1.0, before, 0, 1, 0, 1, 1 - transposed, 1)
    return multipliers


def condense_hessians(stages: Array, from_u: Array, n_x: int) -> Array:
    """Second derivatives by the stages' ``(x, u)`` ``(N, n_x + n_u, n_x + n_u)`` as those by the inputs."""
    n, size, _ = stages.shape
    n_u = size - n_x
    states = from_u[: n * n_x].reshape(n, n_x, n * n_u)
    by_state = (stages[:, :n_x, :n_x] @ states).reshape(n * n_x, n * n_u)
    by_input = (stages[:, n_x:, :n_x] @ states).reshape(n * n_u, n * n_u)
    total = from_u[: n * n_x].T @ by_state + by_input + by_input.T
    blocks = total.reshape(n, n_u, n, n_u)
    blocks[np.arange(n), :, np.arange(n)] += stages[:, n_x:, n_x:]
    return np.asarray(total)


def condense_all(stages: Array, by_inputs: Array, n_x: int, n_u: int) -> Array:
    """Second derivatives by the stages' ``(x, u, h)`` ``(N, n, n)`` as those by the inputs ``(N n_u, N n_u)``.

    ``by_inputs`` ``(N + 1, n_z, N n_u)`` are the derivatives of states and hidden states by the inputs.
    """
    n, few = len(stages), n_x + n_u
    z = np.r_[:n_x, few : stages.shape[1]]
    by_z, mixed = stages[:, z[:, None], z], stages[:, n_x:few][:, :, z]
    total, one_sided = np.zeros((n * n_u, n * n_u)), np.zeros((n * n_u, n * n_u))
    for first in range(1, n, GROUP):  # a state only depends on earlier inputs
        last = min(first + GROUP, n)
        m = (last - 1) * n_u
        states = np.ascontiguousarray(by_inputs[first:last, :, :m])
        flat = states.reshape(-1, m)
        total[:m, :m] += flat.T @ (by_z[first:last] @ states).reshape(-1, m)
        one_sided[first * n_u : last * n_u, :m] = (mixed[first:last] @ states).reshape(-1, m)
    total += one_sided + one_sided.T
    total.reshape(n, n_u, n, n_u)[np.arange(n), :, np.arange(n)] += stages[:, n_x:few, n_x:few]
    return total


class CondensedController(SplitController):
    """Nonlinear MPC by Gauss-Newton real-time iterations (RTI).

    :meth:`prepare` shifts the previous plan, linearizes the model along it in one call and condenses states and
    hidden states away; their multiple-shooting trajectory and its defects are kept. :meth:`feedback` embeds the
    estimate, solves the QP of ``N n_u`` unknowns (and a slack for every soft bound and period where one acts) and
    checks its solution. The scratch buffers are not thread-safe.

    Args:
        model: The deployed model; ``n_h`` may be 0.
        ocp: The problem.
        iterations: Linearizations per solve: 1 is the RTI, more converge to the solution of the NLP.
        compiled: Whether functions evaluated period by period are compiled as C, cached as
            :func:`nn_export.compile_function` says: the runs of a model with a ``side_by_side``, else its
            Jacobians too. Default: no.

    Raises:
        InputError: If problem and model do not fit, ``iterations < 1``, the terminal weight cannot be computed,
            or compilation fails.

    Source: Diehl, Bock, Schlöder, *A real-time iteration scheme for nonlinear optimization in optimal
    feedback control*, SIAM J. Control Optim. 43 (2005).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.estimate.kalman import TrueState
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> controller = CondensedController(model, OCP(5, [1.0], [1.0], [0.0], [-9.0], [9.0]))
        >>> estimate = TrueState(model).start([1.0])
        >>> solution = controller.solve(controller.initial(estimate), estimate, np.zeros((6, 1)))
        >>> solution.status.name, solution.u[0].round(6)
        ('SOLVED', array([-0.618034]))
    """

    converges = False

    def __init__(self, model: HybridModel, ocp: OCP, *, iterations: int = 1, compiled: bool = False) -> None:
        iterations = whole(iterations, "iterations", 1, MOST_ITERATIONS)
        self.problem = Problem(model, ocp)
        self.iterations, self._n_x = iterations, ocp.n_x
        n, n_u = ocp.horizon, ocp.n_u
        self.stages = stages(model, n, compiled=compiled)
        difference = np.eye(n * n_u) - np.eye(n * n_u, k=-n_u)
        r, r_delta = np.tile(ocp.r, n) * model.dt, np.tile(ocp.r_delta, n) * model.dt
        self._by_input, self._by_change = 2 * model.dt * ocp.r, 2 * model.dt * ocp.r_delta
        self._on_u, self._on_x, _ = model.disturbed
        self._moves, self._own_bounds = bool(np.any(self._on_x)), ocp.bounds(ocp.u_min)
        self._input_hessian = 2 * (np.diag(r) + (difference.T * r_delta) @ difference)
        self.qp = InputQP(ocp, self.problem.soft, model.dt)
        self.condenser = Condenser(n, ocp.n_x + model.n_h, n_u, ocp.n_x)
        self._evaluate_once()

    @np.errstate(over="ignore", invalid="ignore")  # an overflow is checked and refused
    def prepare(self, previous: Solution, weight: Array | None = None) -> Prepared:
        """Linearize and condense along the previous plan, shifted by one period; its last input is repeated.

        ``previous.u[0]`` is the input that is being held; ``weight`` as :meth:`Controller.solve` takes it.
        """
        start = perf_counter()
        u, d = self.ocp.held(previous.following), previous.d
        z = np.hstack([previous.x[1:], previous.h[1:]])
        w = (
            np.vstack([previous.w[1:], previous.w[-1:]])
            if previous.w.size
            else self.problem.forecast(None, None)
        )
        derivatives = self.stages.at(z, self.model.acting(u, d, w))
        z = np.vstack([z, derivatives[0][-1:]])  # the appended period starts without a defect
        weight = self.problem.weights(weight)
        return self.condense(
            u, z, d, previous.u[0], weight, derivatives, start, w=w, steady=previous.steady,
            active=self.qp.later(previous.active),
            multipliers=None if previous.multipliers is None else previous.multipliers[self.problem.soft.later],
        )  # fmt: skip

    @np.errstate(over="ignore", invalid="ignore")
    def linearize(
        self, u: Array, z: Array, d: Array, u_prev: Array, weight: Array, w: Array | None = None,
        steady: Steady | None = None, active: Active | None = None, multipliers: Array | None = None,
    ) -> Prepared:  # fmt: skip
        """Linearize and condense along a trajectory as it is: ``u`` ``(N, n_u)``, ``z`` ``(N + 1, n_z)``, ``w`` ``(N,
        n_w)``.
        """
        start, w = perf_counter(), self.problem.forecast(w, None)
        derivatives = self.stages.at(z[:-1], self.model.acting(u, d, w))
        return self.condense(
            u, z, d, u_prev, weight, derivatives, start, w=w, steady=steady, active=active, multipliers=multipliers
        )  # fmt: skip

    @np.errstate(over="ignore", invalid="ignore")  # an overflow is checked and refused
    def feedback(
        self, prepared: Prepared, estimate: Estimate, reference: Array, limits: Limits | None = None,
        w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """Embed the estimate and the reference, solve the QP and check its solution.

        Arguments as :meth:`Controller.solve` takes them. If the plan's status is not ``ok`` its inputs are the shifted
        previous plan. Where measured disturbances are others than those that were prepared for, it linearizes anew.
        """
        start = perf_counter()
        target = self.problem.target(reference, prepared.weight, estimate, w, prepared.steady)
        if target.w is not prepared.w and not np.array_equal(target.w, prepared.w):
            prepared = self.linearize(
                prepared.u, prepared.z, prepared.d, prepared.u_prev, prepared.weight, target.w, prepared.steady,
                prepared.active, prepared.multipliers,
            )  # fmt: skip
        hessian, economic = self._at_parameters(prepared, target)
        n_x = self._n_x
        dz0 = np.concatenate([estimate.x, estimate.h]) - prepared.z[0]
        drift = prepared.defects + self._of_inputs(prepared.b, self._on_u @ (estimate.d - prepared.d))
        if self._moves:
            drift[:, :n_x] += self._on_x @ (estimate.d - prepared.d)
        free = propagate(prepared.a_t, drift, dz0)
        error = prepared.z[:, :n_x] + free[:, :n_x] - target.x
        gradient = 2 * error.ravel() @ prepared.weighted + prepared.direct - self._of_targets(target.u)
        if economic is not None:
            slope, curvature = economic
            slope = slope + (curvature[:, :, :n_x] @ free[:-1, :n_x, None])[:, :, 0]
            gradient += self._by_inputs(prepared, slope)
        soft = self._soft_rows(prepared, free, target)
        if not (np.isfinite(gradient).all() and (soft is None or np.isfinite(soft[0]).all())):
            return self._failed(prepared, Status.NOT_FINITE, start)
        return self._solved(
            prepared, target, estimate, (hessian, gradient), soft, (free, drift), limits, start
        )

    def _solved(
        self, prepared: Prepared, target: Target, estimate: Estimate, quadratic: tuple[Array, Array],
        soft: tuple[Array, Array] | None, run: tuple[Array, Array], limits: Limits | None, start: float,
    ) -> Solution:  # fmt: skip
        """Solve the QP of Hessian and gradient ``quadratic`` around the run ``(free, drift)``, and check its solution.

        The Hessian also has the curvature of convex bounds (:attr:`~hybrid_mpc.control.problem.BoundRows.convex`),
        weighted with their multipliers (sequential convex quadratic programming). If the plan then violates such a
        bound more than its linearization, the bounds alone are linearized again at the plan and the QP is solved again,
        at most :data:`CORRECTIONS` times; the cheapest plan counts.

        Source: Verschueren, van Duijkeren, Quirynen, Diehl, *Exploiting convexity in direct optimal control: a
        sequential convex quadratic programming method*, CDC 2016.
        """
        rows, n_x, best = self.problem.soft, self._n_x, None
        free, drift = run
        lower, upper = self.ocp.bounds(prepared.u_prev, limits) if limits is not None else self._own_bounds
        point = prepared.z[:, :n_x], prepared.u
        # from there to the plan without a step
        ahead = np.hstack([free[:-1, :n_x], np.zeros_like(prepared.u)])
        multipliers, active = prepared.multipliers, prepared.active
        left = CORRECTIONS
        while True:
            hessian, gradient = quadratic
            if weighted := multipliers is not None and bool(multipliers.any()):
                curvature = rows.curvature(*point, multipliers, target.e)
                curvature[~np.isfinite(curvature).all(axis=(1, 2))] = 0.0
                hessian = hessian + condense_hessians(curvature, prepared.from_u, n_x)
                gradient = gradient + self._by_inputs(prepared, (curvature @ ahead[:, :, None])[:, :, 0])
            answer = self.qp.solve(
                hessian, gradient, prepared.u, prepared.u_prev, soft, limits, active, strict=True
            )
            if not answer.status.ok and best is None and weighted:
                multipliers = None  # those of the last plan may not fit any more
                continue
            if not answer.status.ok:
                return best or self._failed(prepared, answer.status, start, answer.kkt)
            step, inputs = answer.step, answer.step.reshape(prepared.u.shape)
            z = prepared.z + propagate(prepared.a_t, drift + self._of_inputs(prepared.b, inputs), free[0])
            # the QP only keeps the limits within its tolerance
            u = np.minimum(np.maximum(prepared.u + inputs, lower), upper)
            point, excess, largest, given_way, beyond = (z[:, :n_x], u), None, 0.0, {}, 0.0
            if soft is not None:
                excess = straight = rows.excess(soft[0] + soft[1] @ step)
                if rows.curved:
                    excess = rows.excess(rows.values(*point, target.e))
                    # a hard bound that the QP keeps is kept to the tolerance
                    allowed = np.where(rows.hard & (straight == 0), 0.0, STRAIGHT)
                    own = (excess - straight) / rows.scale - allowed
                    beyond = float(np.max(own, initial=0.0, where=rows.convex))
                largest, given_way = rows.largest(excess), rows.given_way(excess)
            cost = self.problem.cost(z, prepared.u + inputs, prepared.u_prev, target, excess)
            if not np.isfinite(cost):
                return best or self._failed(prepared, Status.NOT_FINITE, start, answer.kkt)
            multipliers = answer.multipliers * rows.convex if rows.convex.any() else None
            active = answer.active
            if best is None or cost < best.cost:
                best = Solution(
                    u=u, x=z[:, :n_x], h=z[:, n_x:], d=estimate.d, cost=cost, status=answer.status, kkt=answer.kkt,
                    defect=_largest(prepared.defects), timing=self._timing(prepared, start), excess=largest,
                    w=target.w, steady=target.steady, active=active, given_way=given_way, multipliers=multipliers,
                )  # fmt: skip
            if not beyond > 0 or not left:
                break
            value, _, slope = rows.condensed(*point, prepared.from_u, target.e)
            if not np.isfinite(slope).all():
                break
            soft, left = (value - slope @ step, slope), left - 1
            ahead = -np.hstack([(prepared.from_u[: n_x * len(u)] @ step).reshape(-1, n_x), inputs])
        return replace(best, timing=self._timing(prepared, start))

    def _by_inputs(self, prepared: Prepared, slope: Array) -> Array:
        """Derivatives by the stages' ``(x, u)`` ``(N, n_x + n_u)`` as those by the inputs ``(N n_u,)``."""
        n_x = self._n_x
        return slope[:, :n_x].ravel() @ prepared.from_u[: slope.shape[0] * n_x] + slope[:, n_x:].ravel()

    def finish(
        self, prepared: Prepared, estimate: Estimate, reference: Array, limits: Limits | None = None,
        w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """:meth:`feedback`, then further iterations up to ``iterations``; same arguments.

        A plan that diverges (:meth:`~hybrid_mpc.control.problem.Problem.diverges`) has status DIVERGED and the inputs
        of the shifted previous plan.
        """
        start = perf_counter()
        solution = self.feedback(prepared, estimate, reference, limits, w)
        for i in range(1, self.iterations):
            if not solution.status.ok:
                break
            spent = solution.timing
            z = np.hstack([solution.x, solution.h])
            again = self.linearize(
                solution.u, z, solution.d, prepared.u_prev, prepared.weight, solution.w, solution.steady,
                solution.active, solution.multipliers,
            )  # fmt: skip
            solution = self.feedback(again, estimate, reference, limits, w)
            total = {name: spent[name] + solution.timing[name] for name in spent}
            solution = replace(solution, timing=total, iterations=i + 1)
        if solution.status.ok and self.problem.diverges(solution.x[1:]):
            return self._failed(prepared, Status.DIVERGED, start, solution.kkt)
        return solution

    def condense(
        self, u: Array, z: Array, d: Array, u_prev: Array, weight: Array,
        derivatives: Derivatives, start: float, p: Array | None = None, *, w: Array | None = None,
        steady: Steady | None = None, active: Active | None = None, multipliers: Array | None = None,
    ) -> Prepared:  # fmt: skip
        """Condense derivatives ``(z_next, A_t, B)`` that are known; ``start`` is when the work began.

        ``p`` ``(N + 1, n_p)`` are the values of the stage cost's parameters. Default: none are known yet; where the
        cost has some it is left to the feedback. ``w`` ``(N, n_w)`` are the measured disturbances. Default: the usual
        ones.
        """
        n, n_x = self.ocp.horizon, self._n_x
        z_next, a_t, b = derivatives
        from_u = self.condenser(a_t, b)
        if self.problem.is_even(weight) or weights_ok(weight):
            by_stage, terminal = self.problem.state_weights(weight)
            weighted = np.empty_like(from_u)
            np.multiply(from_u[: n * n_x], by_stage.reshape(-1, 1), out=weighted[: n * n_x])
            np.matmul(terminal, from_u[n * n_x :], out=weighted[n * n_x :])
        else:
            weighted = np.full_like(from_u, np.nan)
        hessian = 2 * from_u.T @ weighted + self._input_hessian
        w = self.problem.forecast(None, None) if w is None else w
        e = self.problem.around(d, w, None if p is None else p[:, : self.ocp.n_p])
        soft = self.problem.soft.condensed(z[:, :n_x], u, from_u, e)
        known = self.problem.economic.function is not None and (
            p is not None or not self.problem.economic.n_p
        )
        economic = self.problem.economic.convex(z[:, :n_x], u, p) if known else None
        if economic is not None:
            hessian += condense_hessians(economic[1], from_u, n_x)
        spent = (perf_counter() - start) * 1e3
        return Prepared(
            u, z, d, u_prev, a_t, b, z_next - z[1:], from_u, weighted, self._direct(u.ravel(), u_prev), hessian, weight,
            soft, economic, spent, w, e, steady, active, multipliers,
        )  # fmt: skip

    def _of_inputs(self, b: Array, u: Array) -> Array:
        """Effect of inputs ``(n_u,)`` (constant) or ``(N, n_u)`` on the next states ``(N, n_z)``."""
        if b.shape[2] == 1:
            return np.asarray(b[:, :, 0] * u)
        return np.asarray(np.einsum("kij,j->ki" if u.ndim == 1 else "kij,kj->ki", b, u))

    def _at_parameters(self, prepared: Prepared, target: Target) -> tuple[Array, tuple[Array, Array] | None]:
        """Hessian and economic derivatives, including those that depend on the parameters' values."""
        if not self.problem.economic.n_p:
            return prepared.hessian, prepared.economic
        if not target.ok:
            return prepared.hessian, None
        economic = self.problem.economic.convex(prepared.z[:, : self._n_x], prepared.u, target.p)
        return prepared.hessian + condense_hessians(economic[1], prepared.from_u, self._n_x), economic

    def _soft_rows(self, prepared: Prepared, free: Array, target: Target) -> tuple[Array, Array] | None:
        """Values of the soft bounds before a step, and their derivatives by it."""
        value, by_x, slope = prepared.soft
        if self.problem.soft.parametric and not np.array_equal(target.e, prepared.e):
            x = prepared.z[:, : self._n_x]
            value, by_x, slope = self.problem.soft.condensed(x, prepared.u, prepared.from_u, target.e)
        if not value.size:
            return None
        moved = np.einsum("ij,ij->i", by_x, free[:, : self._n_x][self.problem.soft.stage])
        return value + moved, slope

    def _evaluate_once(self) -> None:
        """Solve once at the operating point, since the first call of a CasADi function is slow."""
        m = self.model
        x, h, d, p = m.x0, np.zeros(m.n_h), np.zeros(m.n_d), np.zeros((0, 0))
        rest = Estimate(0.0, x, h, d, p, np.zeros(0), NAN, w=m.w)
        self.solve(self.initial(rest), rest, self.problem.standing())

    def input_gradient(self, u: Array, u_prev: Array, u_ref: Array) -> Array:
        """Gradient of the input costs at the plan ``u`` ``(N n_u,)`` with the target inputs ``u_ref`` ``(N, n_u)``."""
        return self._direct(u, u_prev) - self._of_targets(u_ref)

    def _direct(self, u: Array, u_prev: Array) -> Array:
        gradient: Array = self._input_hessian @ u
        gradient[: u_prev.size] -= self._by_change * u_prev
        return gradient

    def _of_targets(self, u_ref: Array) -> Array:
        return np.asarray((u_ref * self._by_input).ravel())

    def _failed(self, prepared: Prepared, status: Status, start: float, kkt: float = NAN) -> Solution:
        x, h = prepared.z[:, : self._n_x], prepared.z[:, self._n_x :]
        defect, spent = _largest(prepared.defects), self._timing(prepared, start)
        return Solution(
            u=prepared.u, x=x, h=h, d=prepared.d, cost=NAN, status=status, kkt=kkt, defect=defect, timing=spent,
            excess=NAN, w=prepared.w, steady=prepared.steady,
        )  # fmt: skip

    def _timing(self, prepared: Prepared, start: float) -> dict[str, float]:
        return {"prepare": prepared.milliseconds, "feedback": (perf_counter() - start) * 1e3}


def _largest(defects: Array) -> float:
    return float(np.abs(defects).max())
