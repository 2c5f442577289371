"""The condensed QP over the inputs, and the check of its solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP, Limits
from hybrid_mpc.control.problem import BoundRows, Status
from hybrid_mpc.model.active_set import Active, ActiveSet, RowQP

Array = NDArray[np.float64]
Soft = tuple[Array, Array] | None

KKT_TOLERANCE = 1e-5
"""Largest KKT residual, relative to the gradient's size."""
BOUND_TOLERANCE = 1e-6
"""Largest violation of an input bound, over its range; the input is then clipped."""


@dataclass(frozen=True)
class Answer:
    """A QP's solution: the step of the inputs ``(N n_u,)``, and the result of its check.

    ``multipliers`` ``(M,)`` are those of the soft bounds, ``active`` the active rows, for the next warm start.
    """

    step: Array
    status: Status
    kkt: float
    multipliers: Array
    active: Active


class InputQP:
    """``min 1/2 s'Hs + g's + penalties`` over input steps ``s`` within the limits of inputs and changes.

    For a problem with move blocks the unknowns are the blocks' inputs; arguments and results are by period. Inputs are
    scaled by :attr:`OCP.input_scale`, soft bounds by :attr:`BoundRows.scale`. Inactive bounds only cost their check
    (:class:`~hybrid_mpc.model.active_set.ActiveSet`, warm-started from the last plan). Every solution is checked.
    """

    def __init__(self, ocp: OCP, soft: BoundRows | None = None, dt: float = 1.0) -> None:
        self._starts, n_u = ocp.block_starts, ocp.n_u
        n = self._starts.size * n_u
        self._ocp, self._n = ocp, n
        self._own_bounds = ocp.bounds(ocp.u_min)  # without limits of a solve they do not depend on the input
        self.scale: Array = np.tile(ocp.input_scale, self._starts.size)
        """Unit of the scaled QP's unknowns, the blocks' inputs ``(M n_u,)`` [input units]."""
        rows = np.eye(n) - np.eye(n, k=-n_u) if ocp.du_max is not None else np.zeros((0, n))
        self._changes = rows * self.scale / self.scale[:, None] if len(rows) else rows
        self._products = self.scale * self.scale[:, None]
        hard = self._hard = n + len(rows)
        own = np.arange(n)
        later = own if ocp.blocks is not None else np.where(own < n - n_u, own + n_u, own)
        later = np.concatenate([later, later + n]) if len(rows) else later
        self._later, self._after, self._before = later, np.arange(hard), np.arange(hard)
        self._linear, self._give = np.full(hard, np.inf), np.zeros(hard)
        self._gives_way = np.zeros(0, dtype=np.int64)
        if soft is not None and len(soft):
            scale, before = soft.scale, np.arange(len(soft))
            moved = np.flatnonzero(soft.later != before)
            before[soft.later[moved]] = moved
            self._later = np.concatenate([self._later, hard + soft.later])
            self._after = np.concatenate([self._after, hard + soft.later])
            self._before = np.concatenate([self._before, hard + before])
            self._linear = np.concatenate([self._linear, dt * soft.linear * scale])
            self._give = np.concatenate([self._give, 0.5 / (dt * soft.quadratic * scale**2)])
            self._soft_products = self.scale / scale[:, None]
            self._gives_way = hard + np.flatnonzero(soft.hard)
            self._soft_scale, self._lower, self._upper = scale, soft.lower / scale, soft.upper / scale

    def by_blocks(self, slopes: Array) -> Array:
        """Derivatives by the inputs (last axis ``N n_u``) as derivatives by the blocks' inputs ``M n_u``."""
        if self._ocp.blocks is None:
            return slopes
        each = slopes.reshape(*slopes.shape[:-1], self._ocp.horizon, self._ocp.n_u)
        return np.add.reduceat(each, self._starts, axis=-2).reshape(*slopes.shape[:-1], self._n)

    def blocked_hessian(self, hessian: Array) -> Array:
        """A Hessian by the inputs as one by the blocks' inputs."""
        return hessian if self._ocp.blocks is None else self.by_blocks(self.by_blocks(hessian).T)

    def later(self, active: Active | None) -> Active | None:
        """Active rows shifted by one period; None if they belong to another problem."""
        return None if active is None or active.size != self._later.size else active[self._later]

    def solve(
        self, hessian: Array, gradient: Array, u: Array, u_prev: Array, soft: Soft = None,
        limits: Limits | None = None, active: Active | None = None, *, strict: bool = False,
    ) -> Answer:  # fmt: skip
        """Solve from a plan ``u`` ``(N, n_u)``, with ``u_prev`` held before, and check the solution.

        The Hessian is symmetric positive definite. ``soft`` are the values of the soft bounds without a step ``(M,)``
        and their derivatives by it ``(M, N n_u)``. ``active`` are rows for a warm start. Default: none. ``strict``:
        hard bounds are only relaxed if they are infeasible, whatever they cost.
        """
        scale, hard = self.scale, self._hard
        own = self._own_bounds if limits is None else self._ocp.bounds(u_prev, limits)
        if self._ocp.blocks is not None:
            own, u = (own[0][self._starts], own[1][self._starts]), u[self._starts]
        lower, upper = (own[0] - u).ravel() / scale, (own[1] - u).ravel() / scale
        h = self.blocked_hessian(hessian) * self._products
        size, a = float(h.diagonal().max()), self._changes
        h /= size
        linear, give = self._linear[:hard], self._give[:hard]
        if self._ocp.du_max is not None:
            du = np.diff(u, axis=0, prepend=u_prev[None])
            lower = np.concatenate([lower, (-self._ocp.du_max - du).ravel() / scale])
            upper = np.concatenate([upper, (self._ocp.du_max - du).ravel() / scale])
        if soft is not None:
            value, slope = soft[0] / self._soft_scale, self.by_blocks(soft[1]) * self._soft_products
            a = np.vstack([a, slope]) if len(a) else slope
            lower = np.concatenate([lower, self._lower - value])
            upper = np.concatenate([upper, self._upper - value])
            linear, give = self._linear / size, self._give * size
        rows = lower.size
        qp = RowQP(h, self.by_blocks(gradient) * scale / size, a, lower, upper, linear, give)
        s, multipliers, active = ActiveSet(qp, self._after[:rows], self._before[:rows]).solve(active)
        status, kkt = self._check(qp, s, multipliers)
        ways = self._gives_way
        if strict and ways.size and (np.abs(active[ways]) == 2).any():
            never = qp.linear.copy(), qp.give.copy()
            never[0][ways], never[1][ways] = np.inf, 0.0
            kept = replace(qp, linear=never[0], give=never[1])
            found = ActiveSet(kept, self._after, self._before).solve(np.sign(active) * (np.abs(active) == 1))
            if (checked := self._check(kept, *found[:2]))[0].ok:
                (s, multipliers, active), (status, kkt) = found, checked
        step = (s * scale).reshape(u.shape)
        if self._ocp.blocks is not None:
            step = np.repeat(step, self._ocp.blocks, axis=0)
        of_soft = np.zeros(0) if soft is None else size * multipliers[hard:] / self._soft_scale
        return Answer(step.ravel(), status, kkt, of_soft, active)

    def _check(self, qp: RowQP, s: Array, multipliers: Array) -> tuple[Status, float]:
        """The status of a solution, and its KKT residual relative to the inputs' gradient."""
        slope, wrong, violation = qp.residuals(s, multipliers)
        kkt = max(slope, wrong) / max(1.0, float(np.abs(qp.g).max()))
        if not all(map(isfinite, (slope, wrong, violation))):
            return Status.NOT_FINITE, float("nan")
        if violation > BOUND_TOLERANCE:
            return Status.INFEASIBLE, kkt
        return (Status.SOLVED if kkt <= KKT_TOLERANCE else Status.INACCURATE), kkt
