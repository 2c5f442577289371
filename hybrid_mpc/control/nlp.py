"""The exact reference: direct multiple shooting solved by IPOPT with exact derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP, Limits
from hybrid_mpc.control.problem import Controller, Problem, Solution, Status, Target
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.model.limits import MOST_ITERATIONS, whole
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.stages import stage_step

Array = NDArray[np.float64]
FEASIBLE = 1e-6
"""Largest defect, and largest violation of a limit over its range, of an accepted solution."""


class Rows(NamedTuple):
    """Constraints ``lower <= value <= upper``, and the unit of their violation."""

    value: ca.MX
    lower: ArrayLike
    upper: ArrayLike
    scale: ArrayLike


class IpoptController(Controller):
    """Nonlinear MPC by IPOPT on the sparse multiple-shooting problem: the reference, slower than real time.

    Inputs are scaled by :attr:`OCP.input_scale`, states by :attr:`Problem.sizes`, soft bounds by half their range.
    Unknowns are the inputs, the states and hidden states of every period, and a slack for every soft bound. Second
    derivatives are exact. Whatever IPOPT reports, a solution is only accepted if it is finite and satisfies model and
    limits; its status is SOLVED if IPOPT converged or the KKT residual is small, else STOPPED.

    Args:
        model: The deployed model; ``n_h`` may be 0.
        ocp: The problem.
        tolerance: Tolerance of IPOPT, relative to its scaling.
        iterations: Most iterations of IPOPT.
        options: Further options of IPOPT by name. Default: adaptive barrier.

    Raises:
        InputError: If problem and model do not fit, an option is not positive, or IPOPT does not know it.

    Source: Wächter and Biegler, *On the implementation of an interior-point filter line-search algorithm
    for large-scale nonlinear programming*, Math. Program. 106 (2006).

    Example: as :class:`~hybrid_mpc.control.rti.CondensedController`, whose interface it shares.
    """

    def __init__(
        self,
        model: HybridModel,
        ocp: OCP,
        *,
        tolerance: float = 1e-9,
        iterations: int = 500,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        if not (isinstance(tolerance, int | float) and tolerance > 0):
            raise InputError(f"tolerance: must be positive, got {tolerance!r:.80} [HM-CONTROL-007]")
        iterations = whole(iterations, "iterations", 1, MOST_ITERATIONS)
        self.problem = Problem(model, ocp)
        self._bounds: dict[str, Array] = {}
        nlp = self._formulate()
        settings: dict[str, Any] = {"print_time": False, "error_on_fail": False, "calc_lam_p": False}
        settings["ipopt"] = {
            "print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": iterations,
            "mu_strategy": "adaptive",
            **(options or {}),
        }  # fmt: skip
        try:
            self._solver = ca.nlpsol("mpc", "ipopt", nlp, settings)
        except RuntimeError as error:
            raise InputError(
                f"options: IPOPT does not accept {dict(options or {})}: {error} [HM-CONTROL-008]"
            ) from error
        w, g = nlp["x"], nlp["g"]
        multipliers = ca.MX.sym("lam", g.shape[0])
        slope = ca.gradient(nlp["f"] + ca.dot(multipliers, g), w)
        self._slope = ca.Function("slope", [w, nlp["p"], multipliers], [slope, ca.gradient(nlp["f"], w), g])

    @np.errstate(over="ignore", invalid="ignore")  # an overflow is checked and refused
    def solve(
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None, w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """The plan from now on; see :meth:`Controller.solve`. The shifted previous plan is the initial guess."""
        start = perf_counter()
        problem, u_prev = self.problem, previous.u[0]
        target = problem.target(reference, weight, estimate, w, previous.steady)
        u = previous.following
        z = np.hstack([previous.x, previous.h])
        z = np.vstack([np.concatenate([estimate.x, estimate.h]), z[2:], z[-1:]])
        added = self.model.acting(np.zeros_like(u), estimate.d, target.w)
        rows = (added, target.x, target.weight, target.u)
        failed = self._plan(u, z, target, np.nan, Status.NOT_FINITE, np.nan, start, 0)
        if not (target.ok and all(np.all(np.isfinite(v)) for v in (*rows, z, u, u_prev))):
            return failed
        p = target.p[:, : problem.economic.n_p]
        given = np.concatenate([z[0], u_prev, *(v.ravel() for v in rows), target.e.ravel(), p.ravel()])
        slack = problem.soft.excess(problem.soft.values(z[:, : self.ocp.n_x], u, target.e))
        guess = np.concatenate([u.ravel(), z.ravel(), slack]) / self._scale
        count = 0
        for gives_way in (False, True) if np.any(problem.soft.hard) else (True,):
            bounds = self._limited(self.ocp.bounds(u_prev, limits), gives_way)
            answer = self._solver(x0=guess, p=given, **bounds)
            stats = self._solver.stats()
            found, lam_g, lam_x = (answer[key].full().ravel() for key in ("x", "lam_g", "lam_x"))
            count += stats["iter_count"]
            if not all(np.all(np.isfinite(v)) for v in (found, lam_g, lam_x)):
                return failed
            violated, kkt = self._check(found, given, lam_g, lam_x, bounds)
            if violated <= FEASIBLE:
                break
        if not violated <= FEASIBLE:
            return self._plan(u, z, target, np.nan, Status.NLP_FAILED, kkt, start, count)
        status = Status.SOLVED if stats["success"] or kkt <= FEASIBLE else Status.STOPPED
        found = found * self._scale
        u = np.clip(found[: u.size].reshape(u.shape), *self.ocp.bounds(u_prev, limits))
        z = found[u.size : u.size + z.size].reshape(z.shape)
        if problem.diverges(z[1:, : self.ocp.n_x]):
            status = Status.DIVERGED
        cost = problem.cost(z, u, u_prev, target)
        return self._plan(u, z, target, cost, status, kkt, start, count)

    def _limited(self, of_inputs: tuple[Array, Array], gives_way: bool) -> dict[str, Array]:
        """Bounds of unknowns and rows with those of the inputs; hard bounds only have slacks if they are relaxed."""
        lower, upper = self._bounds["lbx"].copy(), self._bounds["ubx"].copy()
        n = of_inputs[0].size
        lower[:n], upper[:n] = (bound.ravel() / self._scale[:n] for bound in of_inputs)
        if not gives_way:
            upper[upper.size - len(self.problem.soft) :][self.problem.soft.hard] = 0.0
        return {**self._bounds, "lbx": lower, "ubx": upper}

    def _check(
        self, w: Array, given: Array, lam_g: Array, lam_x: Array, bounds: dict[str, Array]
    ) -> tuple[float, float]:
        """Largest violation over its range, and the KKT residual relative to the objective's gradient."""
        slope, objective, g = (m.full().ravel() for m in self._slope(w, given, lam_g))
        kkt = float(np.max(np.abs(slope + lam_x)) / max(1.0, np.max(np.abs(objective))))
        beyond = np.maximum(bounds["lbg"] - g, g - bounds["ubg"])
        n = self.ocp.horizon * self.ocp.n_u
        outside = np.maximum(bounds["lbx"][:n] - w[:n], w[:n] - bounds["ubx"][:n])
        return max(float(np.max(beyond, initial=0.0)), float(np.max(outside))), kkt

    def _plan(
        self, u: Array, z: Array, target: Target, cost: float, status: Status, kkt: float, start: float, i: int
    ) -> Solution:  # fmt: skip
        n_x, soft, d = self.ocp.n_x, self.problem.soft, target.d
        excess = soft.excess(soft.values(z[:, :n_x], u, target.e)) if len(soft) else np.zeros(0)
        after = self._step(z[:-1].T, self.model.acting(u, d, target.w).T).full().T
        defect = float(np.max(np.abs(after - z[1:])))
        spent = {"solve": (perf_counter() - start) * 1e3}
        return Solution(
            u=u, x=z[:, :n_x], h=z[:, n_x:], d=d, cost=cost, status=status, kkt=kkt, defect=defect,
            timing=spent, excess=soft.largest(excess), iterations=i, w=target.w, steady=target.steady,
            given_way=soft.given_way(excess),
        )  # fmt: skip

    def _formulate(self) -> dict[str, ca.MX]:
        """Problem of ``nlpsol`` over ``(u, z, slacks)``; keeps the bounds of its unknowns and rows."""
        ocp, model, soft = self.ocp, self.model, self.problem.soft
        n, n_x, n_u = ocp.horizon, ocp.n_x, ocp.n_u
        n_z = n_x + model.n_h
        u, z, s = ca.MX.sym("u", n_u, n), ca.MX.sym("z", n_z, n + 1), ca.MX.sym("s", len(soft))
        z0, added, u_prev = ca.MX.sym("z0", n_z), ca.MX.sym("added", model.n_v, n), ca.MX.sym("u_prev", n_u)
        x_ref, weight = ca.MX.sym("x_ref", n_x, n + 1), ca.MX.sym("weight", n_x, n + 1)
        u_ref, e = ca.MX.sym("u_ref", n_u, n), ca.MX.sym("e", model.n_d + model.n_w + ocp.n_p, n)
        p = ca.MX.sym("p", self.problem.economic.n_p, n + 1)
        self._step = stage_step(model).map(n)
        z_next = self._step(z[:, :-1], ca.vertcat(u + added[:n_u, :], added[n_u:, :]))
        du = u - ca.horzcat(u_prev, u[:, :-1])
        u_scale, z_scale = (
            ocp.input_scale,
            np.concatenate([self.problem.sizes.states, self.problem.sizes.hidden]),
        )
        rows = [Rows(z[:, 0] - z0, 0.0, 0.0, z_scale), Rows(z[:, 1:] - z_next, 0.0, 0.0, np.tile(z_scale, n))]
        if ocp.du_max is not None:
            limit = np.tile(ocp.du_max, n)
            rows.append(Rows(du, -limit, limit, np.tile(u_scale, n)))
        inside = [int(k) for k in np.setdiff1d(np.arange(n), ocp.block_starts)]
        if inside:  # move blocks
            rows.append(Rows(du[:, inside], 0.0, 0.0, np.tile(u_scale, len(inside))))
        rows += self._soft_rows(u, z, s, e)
        free, g_scale = np.full(n_z * (n + 1), np.inf), _filled(rows, 3)
        self._scale = np.concatenate([np.tile(u_scale, n), np.tile(z_scale, n + 1), soft.scale])
        self._bounds = {
            "lbx": np.concatenate([np.tile(ocp.u_min, n), -free, np.zeros(len(soft))]) / self._scale,
            "ubx": np.concatenate([np.tile(ocp.u_max, n), free, np.full(len(soft), np.inf)]) / self._scale,
            "lbg": _filled(rows, 1) / g_scale, "ubg": _filled(rows, 2) / g_scale,
        }  # fmt: skip
        unknowns = ca.vertcat(ca.vec(u), ca.vec(z), s)
        given = ca.vertcat(z0, u_prev, *(ca.vec(v) for v in (added, x_ref, weight, u_ref, e, p)))
        cost = self._objective(u - u_ref, du, z[:n_x, :] - x_ref, weight, s)
        cost += self._economic(z[:n_x, :-1], u, p)
        constraints = ca.vertcat(*(ca.vec(row.value) for row in rows)) / g_scale
        problem = ca.Function("problem", [unknowns, given], [cost, constraints])
        scaled = ca.MX.sym("scaled", unknowns.numel())
        f, g = problem.call([self._scale * scaled, given], True, False)
        return {"x": scaled, "p": given, "f": f, "g": g}

    def _objective(self, u: ca.MX, du: ca.MX, error: ca.MX, weight: ca.MX, s: ca.MX) -> ca.MX:
        ocp, soft = self.ocp, self.problem.soft
        last = ca.sqrt(weight[:, -1]) * error[:, -1]
        stages = ca.sum2(weight[:, :-1] * error[:, :-1] ** 2), ca.sum2(u**2), ca.sum2(du**2)
        stage = sum(ca.dot(q, v) for q, v in zip((ocp.q, ocp.r, ocp.r_delta), stages, strict=True))
        penalty = ca.dot(soft.linear, s) + ca.dot(soft.quadratic, s**2)
        return self.model.dt * (stage + penalty) + last.T @ self.problem.terminal @ last

    def _economic(self, x: ca.MX, u: ca.MX, p: ca.MX) -> ca.MX:
        f = self.problem.economic.function
        if f is None:
            return ca.MX(0)
        given = (x, u, p[:, :-1]) if f.n_in() > 2 else (x, u)
        (stages,) = f.map(self.ocp.horizon).call(list(given))
        return self.model.dt * ca.sum2(stages)

    def _soft_rows(self, u: ca.MX, z: ca.MX, s: ca.MX, e: ca.MX) -> list[Rows]:
        """Constraints of the bounded values, in the order of the problem's rows."""
        ocp, soft, rows = self.ocp, self.problem.soft, []
        states = soft.states.tolist()
        values = [ca.vec(z[states, 1:])] if states else []
        values += [ca.vec(f.map(ocp.horizon)(z[: ocp.n_x, :-1], u, e)) for f in soft.functions]
        value = ca.vertcat(*values)
        for bound, sign in ((soft.upper, 1.0), (soft.lower, -1.0)):
            pick = np.flatnonzero(np.isfinite(bound)).tolist()
            if pick:
                gap = sign * (value[pick] - bound[pick]) - s[pick]
                rows.append(Rows(gap, -np.inf, 0.0, soft.scale[pick]))
        return rows


def _filled(rows: list[Rows], field: int) -> Array:
    """One field of all rows, a value an element."""
    return np.concatenate([np.broadcast_to(row[field], row.value.numel()) for row in rows])
