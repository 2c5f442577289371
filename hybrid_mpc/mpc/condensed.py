"""Gauss-Newton real-time iteration on the condensed multiple-shooting problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.buffered import BufferedFunction
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.qp import InputQP
from hybrid_mpc.mpc.solution import Solution, Status

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Prepared:
    """Everything of an iteration that needs neither the estimate nor the reference.

    With ``dz = (x, h) - (x_bar, h_bar)`` the linearised prediction is
    ``dz_k = from_start_k dz_0 + from_d_k dd + defect_k + from_u_k du``.

    Args:
        u: Linearisation inputs ``(N, n_u)``.
        z: Linearisation trajectory ``(N + 1, n_x + n_h)``.
        d: Linearisation disturbance ``(n_u,)``.
        u_prev: Input ``(n_u,)`` held before the plan.
        maps: ``(N + 1, n_z, n_z + n_u + 1 + N n_u)``: from_start, from_d, defect and from_u side by side.
        weighted: ``((N + 1) n_x, N n_u)``: state weights times the rows of from_u that belong to ``x``.
        hessian: Hessian of the cost by ``du`` ``(N n_u, N n_u)``.
        defect: Largest defect of the linearisation trajectory.
        milliseconds: Time the preparation took.
    """

    u: Array
    z: Array
    d: Array
    u_prev: Array
    maps: Array
    weighted: Array
    hessian: Array
    defect: float
    milliseconds: float


class CondensedController:
    """Nonlinear MPC by Gauss-Newton real-time iterations (RTI).

    A period's work is split: :meth:`prepare` shifts the previous plan, linearises the model along it in
    one mapped call and condenses states and hidden states away (their multiple-shooting trajectory and
    its defects are kept); :meth:`feedback` embeds the new estimate and solves the QP of ``N n_u``
    unknowns. The QP's answer is checked, whatever status its solver reports. Everything is built here;
    no method changes the object (apart from scratch buffers: not for several threads at once) or raises on
    the numbers of an estimate, a reference or a plan.

    Args:
        model: The deployed model; ``n_h`` may be 0.
        ocp: The problem.
        iterations: Linearisations per solve; 1 is the RTI, more converge to the NLP's solution.

    Raises:
        InputError: If problem and model do not fit, ``iterations < 1``, or the terminal weight cannot be
            found.

    Source: Diehl, Bock, Schlöder, *A real-time iteration scheme for nonlinear optimization in optimal
    feedback control*, SIAM J. Control Optim. 43 (2005).

    Example:
        >>> from hybrid_mpc.estimation import TrueState
        >>> from hybrid_mpc.signals import Signal
        >>> x, h, u, w = ca.MX.sym("x"), ca.MX.sym("h", 0), ca.MX.sym("u"), ca.MX.sym("w")
        >>> model = HybridModel("sum", 1.0, (Signal("x", "-"),), (Signal("u", "-"),), (Signal("x", "-"),),
        ...     ca.Function("f", [x, h, u], [x + u, h]), ca.Function("g", [x, h, u], [u]),
        ...     ca.Function("y", [x, u], [x]), ca.Function("e", [x, w, u], [w - u]))
        >>> controller = CondensedController(model, OCP(5, [1.0], [1.0], [0.0], [-9.0], [9.0]))
        >>> estimate = TrueState(model).start([1.0])
        >>> solution = controller.solve(controller.initial(estimate), estimate, np.zeros((6, 1)))
        >>> solution.status.name, solution.u[0].round(6)
        ('SOLVED', array([-0.618034]))
    """

    def __init__(self, model: HybridModel, ocp: OCP, *, iterations: int = 1) -> None:
        if (ocp.n_x, ocp.n_u) != (model.n_x, model.n_u):
            raise InputError(
                f"the problem has {ocp.n_x} states and {ocp.n_u} inputs, model {model.name} has "
                f"{model.n_x} and {model.n_u}"
            )
        if iterations < 1:
            raise InputError(f"iterations must be at least 1, got {iterations}")
        assert model.with_jacobian is not None
        self._model, self._ocp, self._iterations = model, ocp, iterations
        n, n_x, n_u = ocp.horizon, ocp.n_x, ocp.n_u
        self._stages = BufferedFunction(model.with_jacobian.map(n))
        self._rollout = _rollout(model, n)
        self._terminal = ocp.terminal_weight(model)
        self._difference = np.eye(n * n_u) - np.eye(n * n_u, k=-n_u)
        r, r_delta = np.tile(ocp.r, n) * model.dt, np.tile(ocp.r_delta, n) * model.dt
        self._input_hessian = 2 * (np.diag(r) + (self._difference.T * r_delta) @ self._difference)
        self._qp = InputQP(ocp)
        self._n_x = n_x
        self._evaluate_once()

    @property
    def model(self) -> HybridModel:
        """The model that predicts."""
        return self._model

    @property
    def ocp(self) -> OCP:
        """The problem."""
        return self._ocp

    def initial(self, estimate: Estimate, u: Array | None = None) -> Solution:
        """A first plan: the model run freely from the estimate.

        Args:
            estimate: Where the plan starts.
            u: Inputs ``(N, n_u)``; ``u[0]`` counts as the input held before the next solve. Default:
                zero, or the bound next to it.

        Returns:
            A plan of status INITIAL. Where the free run diverges, the state is held at the estimate.

        Raises:
            InputError: If ``u`` has another shape or is not finite.
        """
        n, ocp = self._ocp.horizon, self._ocp
        start = np.zeros((n, ocp.n_u)) if u is None else np.asarray(u, dtype=float)
        if start.shape != (n, ocp.n_u) or not np.all(np.isfinite(start)):
            raise InputError(f"u: finite values of shape {(n, ocp.n_u)} needed, got {start}")
        plan = np.clip(start, ocp.u_min, ocp.u_max)
        z0 = np.concatenate([estimate.x, estimate.h])
        z = np.vstack([z0, self._rollout(z0, (plan + estimate.d).T).full().T])
        if not np.all(np.isfinite(z)):
            z = np.tile(z0, (n + 1, 1))
        x, h = z[:, : self._n_x], z[:, self._n_x :]
        return Solution(plan, x, h, estimate.d, float("nan"), Status.INITIAL, float("nan"), float("nan"), {})

    def prepare(self, previous: Solution) -> Prepared:
        """Linearise and condense along the previous plan, shifted by one period.

        ``previous.u[0]`` is the input that is being held; the shifted plan repeats its last input.
        """
        u = np.vstack([previous.u[1:], previous.u[-1:]])
        z = np.hstack([previous.x, previous.h])
        z = np.vstack([z[1:], z[-1:]])
        return self._condense(u, z, previous.d, previous.u[0], shifted=True)

    @np.errstate(over="ignore", invalid="ignore")  # what overflows is looked at and refused
    def feedback(self, prepared: Prepared, estimate: Estimate, reference: Array) -> Solution:
        """Embed the estimate and the reference, solve the QP and check its answer.

        Args:
            prepared: What :meth:`prepare` returned.
            estimate: The state now; its ``d`` is assumed constant over the horizon.
            reference: ``(m, n_x)``, from now on in steps of ``dt``; if ``m < N + 1`` its last value holds.

        Returns:
            The plan. If its status is not ``ok`` the inputs are the shifted previous plan.

        Raises:
            InputError: If the reference has another shape.
        """
        start = perf_counter()
        reference = np.asarray(reference, dtype=float)
        if reference.ndim != 2 or len(reference) < 1 or reference.shape[1] != self._n_x:
            raise InputError(f"reference: shape {reference.shape} given, (m, {self._n_x}) with m > 0 needed")
        if not np.all(np.isfinite(reference)):
            return self._failed(prepared, Status.NOT_FINITE, start)
        x_ref = self._reference(reference)
        n_x, n_z = self._n_x, prepared.z.shape[1]
        n_u = self._ocp.n_u
        offset = np.concatenate([np.concatenate([estimate.x, estimate.h]) - prepared.z[0],
                                 estimate.d - prepared.d, [1.0]])  # fmt: skip
        free = prepared.maps[:, :, : n_z + n_u + 1] @ offset
        error = prepared.z[:, :n_x] + free[:, :n_x] - x_ref
        u_bar = prepared.u.ravel()
        gradient = 2 * prepared.weighted.T @ error.ravel() + self._input_gradient(u_bar, prepared.u_prev)
        if not (np.all(np.isfinite(gradient)) and np.all(np.isfinite(prepared.hessian))):
            return self._failed(prepared, Status.NOT_FINITE, start)
        step, status, kkt = self._qp.solve(prepared.hessian, gradient, prepared.u, prepared.u_prev)
        if not status.ok:
            return self._failed(prepared, status, start, kkt)
        u = (u_bar + step).reshape(prepared.u.shape)
        z = prepared.z + free + prepared.maps[:, :, n_z + n_u + 1 :] @ step
        cost = self._cost(z[:, :n_x], u, x_ref, prepared.u_prev)
        if not np.isfinite(cost):
            return self._failed(prepared, Status.NOT_FINITE, start, kkt)
        u = np.clip(u, self._ocp.u_min, self._ocp.u_max)  # the QP keeps them to its tolerance only
        return Solution(u, z[:, :n_x], z[:, n_x:], estimate.d, cost, status, kkt, prepared.defect,
                        self._timing(prepared, start))  # fmt: skip

    def solve(self, previous: Solution, estimate: Estimate, reference: Array) -> Solution:
        """:meth:`prepare` and :meth:`feedback`, linearised anew ``iterations`` times."""
        prepared = self.prepare(previous)
        solution = self.feedback(prepared, estimate, reference)
        for _ in range(self._iterations - 1):
            if not solution.status.ok:
                break
            spent = solution.timing
            z = np.hstack([solution.x, solution.h])
            again = self._condense(solution.u, z, solution.d, prepared.u_prev, shifted=False)
            solution = self.feedback(again, estimate, reference)
            total = {name: spent[name] + solution.timing[name] for name in spent}
            solution = replace(solution, timing=total)
        return solution

    @np.errstate(over="ignore", invalid="ignore")  # what overflows is looked at and refused
    def _condense(self, u: Array, z: Array, d: Array, u_prev: Array, *, shifted: bool) -> Prepared:
        start = perf_counter()
        n, n_x, n_u, n_z = self._ocp.horizon, self._n_x, self._ocp.n_u, z.shape[1]
        z_next, a, b = self._linearise(z[:-1], u + d)
        if shifted:  # the appended period has no trajectory yet: start it without a defect
            z = np.vstack([z[:-1], z_next[-1:]])
        defect = z_next - z[1:]
        first = n_z + n_u + 1
        maps = np.zeros((n + 1, n_z, first + n * n_u))
        maps[0, :, :n_z] = np.eye(n_z)
        for k in range(n):
            end = first + k * n_u
            maps[k + 1, :, :end] = a[k] @ maps[k, :, :end]
            maps[k + 1, :, n_z : n_z + n_u] += b[k]
            maps[k + 1, :, first - 1] += defect[k]
            maps[k + 1, :, end : end + n_u] = b[k]
        from_u = maps[:, :n_x, first:]
        weighted = from_u * (self._ocp.q * self._model.dt)[None, :, None]
        weighted[-1] = self._terminal @ from_u[-1]
        weighted = weighted.reshape((n + 1) * n_x, n * n_u)
        hessian = 2 * from_u.reshape((n + 1) * n_x, n * n_u).T @ weighted + self._input_hessian
        spent = (perf_counter() - start) * 1e3
        largest = float(np.max(np.abs(defect)))
        return Prepared(u, z, d, u_prev, maps, weighted, hessian, largest, spent)

    def _linearise(self, z: Array, u: Array) -> tuple[Array, Array, Array]:
        """Successors ``(N, n_z)``, and views of ``A`` ``(N, n_z, n_z)`` and ``B`` ``(N, n_z, n_u)``."""
        n, n_z, n_x = *z.shape, self._n_x
        into_x, into_h, into_u = self._stages.inputs
        into_x[:], into_h[:], into_u[:] = z[:, :n_x].ravel(), z[:, n_x:].ravel(), u.ravel()
        self._stages()
        x, h, a, b = (out.reshape(n, -1) for out in self._stages.outputs)
        return (
            np.hstack([x, h]),
            a.reshape(n, n_z, n_z).transpose(0, 2, 1),
            b.reshape(n, -1, n_z).transpose(0, 2, 1),
        )

    def _evaluate_once(self) -> None:
        """Solve once at zero, so that no later call is the first of a CasADi function, which is slow."""
        m = self._model
        x, h, d, p = np.zeros(m.n_x), np.zeros(m.n_h), np.zeros(m.n_u), np.zeros((0, 0))
        zero = Estimate(0.0, x, h, d, p, np.zeros(0), float("nan"))
        self.solve(self.initial(zero), zero, np.zeros((1, m.n_x)))

    def _input_gradient(self, u: Array, u_prev: Array) -> Array:
        """Gradient of the input costs at the plan ``u`` ``(N n_u,)``."""
        gradient: Array = self._input_hessian @ u
        gradient[: u_prev.size] -= 2 * self._model.dt * self._ocp.r_delta * u_prev
        return gradient

    def _reference(self, reference: Array) -> Array:
        rows = np.minimum(np.arange(self._ocp.horizon + 1), len(reference) - 1)
        return np.asarray(reference[rows])

    def _cost(self, x: Array, u: Array, x_ref: Array, u_prev: Array) -> float:
        du = np.diff(u, axis=0, prepend=u_prev[None])
        last = x[-1] - x_ref[-1]
        stages = self._ocp.stage_cost(x[:-1], u, x_ref[:-1], du)
        return float(np.sum(stages) * self._model.dt + last @ self._terminal @ last)

    def _failed(
        self, prepared: Prepared, status: Status, start: float, kkt: float = float("nan")
    ) -> Solution:
        x, h = prepared.z[:, : self._n_x], prepared.z[:, self._n_x :]
        return Solution(prepared.u, x, h, prepared.d, float("nan"), status, kkt, prepared.defect,
                        self._timing(prepared, start))  # fmt: skip

    def _timing(self, prepared: Prepared, start: float) -> dict[str, float]:
        return {"prepare": prepared.milliseconds, "feedback": (perf_counter() - start) * 1e3}


def _rollout(model: HybridModel, n: int) -> ca.Function:
    z, u = ca.MX.sym("z", model.n_x + model.n_h), ca.MX.sym("u", model.n_u)
    z_next = ca.vertcat(*model.step(z[: model.n_x], z[model.n_x :], u))
    return ca.Function("z_step", [z, u], [z_next]).mapaccum("rollout", n)
