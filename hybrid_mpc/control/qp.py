"""The condensed QP over the inputs and the slacks of soft bounds, and the check of its answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP, Limits
from hybrid_mpc.control.problem import SoftRows, Status
from hybrid_mpc.model.buffered import BufferedFunction

Array = NDArray[np.float64]
Soft = tuple[Array, Array] | None

KKT_TOLERANCE = 1e-5
"""Relative to the gradient's size."""
PRIMAL_TOLERANCE = 1e-9
"""In DAQP's own scaling, which an ill-conditioned Hessian (weights of 1e4 on one instant) stretches: at the default of
1e-6 it returned bounds violated by 5e-5 of the range."""
SOFT_SIZES = (8, 16, 32, 64, 128, 256)
"""Numbers of soft bounds that QPs are built for, besides all of them."""
BOUND_TOLERANCE = 1e-6
"""Share of an input's or a soft bound's range; what is left of an input's is clipped away."""


@dataclass(frozen=True)
class Answer:
    """A QP's answer: the step of the inputs ``(N n_u,)``, and what it is worth."""

    step: Array
    status: Status
    kkt: float
    multipliers: Array


@dataclass(frozen=True)
class _Scaled:
    """``min 1/2 s'hs + g's`` with ``lower <= s <= upper`` and ``row_lower <= a s <= row_upper``."""

    h: Array
    g: Array
    a: Array
    lower: Array
    upper: Array
    row_lower: Array
    row_upper: Array


class _Sides:
    """The finite sides of soft bounds, each as ``sign (value - bound) / scale <= 0``."""

    def __init__(self, soft: SoftRows) -> None:
        above, below = np.flatnonzero(np.isfinite(soft.upper)), np.flatnonzero(np.isfinite(soft.lower))
        self.row = np.concatenate([above, below])
        self._sign = np.concatenate([np.ones(above.size), -np.ones(below.size)])
        self._bound = np.concatenate([soft.upper[above], soft.lower[below]])
        self.scale, self.linear, self.quadratic = (
            v[self.row] for v in (soft.scale, soft.linear, soft.quadratic)
        )

    def multipliers(self, chosen: NDArray[np.int64], of_sides: Array, rows: int) -> Array:
        """Multipliers ``(rows,)`` of the bounded values from those of ``chosen`` scaled sides."""
        of_rows = np.zeros(rows)
        np.add.at(of_rows, self.row[chosen], of_sides * self._sign[chosen] / self.scale[chosen])
        return of_rows

    def of(self, values: Array) -> Array:
        """Scaled violations of values ``(M,)``, or scaled rows of their derivatives ``(M, n)``."""
        if values.ndim == 1:
            return np.asarray(self._sign * (values[self.row] - self._bound) / self.scale)
        return np.asarray((self._sign / self.scale)[:, None] * values[self.row])


class InputQP:
    """``min 1/2 s'Hs + g's + penalties`` over input steps ``s`` within the limits of inputs and changes.

    Where the problem has move blocks, the unknowns are the blocks' inputs; all that comes in and goes out is by
    period. Inputs are scaled by :attr:`OCP.input_scale`, soft bounds by half their range, the Hessian by its
    diagonal. The solvers (DAQP, through ``casadi.conic``) are built once; their answer is checked whatever status
    they report.

    Soft bounds cost time only where they act. The QP is first solved without them: an answer that keeps them all is
    the answer with them. Else it is solved with a slack for each of the few bounds that are violated most, and those
    that this answer violates are added, up to all.

    Source: Arnström, Bemporad, Axehill, *A dual active-set solver for embedded quadratic programming
    using recursive LDL' updates*, IEEE TAC 67 (2022).
    """

    def __init__(self, ocp: OCP, soft: SoftRows | None = None, dt: float = 1.0) -> None:
        self._starts, n_u = ocp.block_starts, ocp.n_u
        n = self._starts.size * n_u
        self._ocp, self._dt, self._n = ocp, dt, n
        self.scale: Array = np.tile(ocp.input_scale, self._starts.size)
        """What 1 means in the scaled QP, by the blocks' inputs ``(M n_u,)`` [input units]."""
        rows = np.eye(n) - np.eye(n, k=-n_u) if ocp.du_max is not None else np.zeros((0, n))
        self._rows = rows * self.scale / self.scale[:, None] if len(rows) else rows
        self._solver = _daqp(n, len(rows))
        self._sides = _Sides(soft) if soft is not None else None
        m = 0 if self._sides is None else self._sides.row.size
        sizes = sorted({min(size, m) for size in (*SOFT_SIZES, m)} - {0})
        self._soft_solvers = {size: _daqp(n + size, len(rows) + size) for size in sizes}

    def by_blocks(self, slopes: Array) -> Array:
        """Derivatives by the inputs, the last axis ``N n_u``, as those by the blocks' inputs ``M n_u``."""
        if self._ocp.blocks is None:
            return slopes
        each = slopes.reshape(*slopes.shape[:-1], self._ocp.horizon, self._ocp.n_u)
        return np.add.reduceat(each, self._starts, axis=-2).reshape(*slopes.shape[:-1], self._n)

    def blocked_hessian(self, hessian: Array) -> Array:
        """A Hessian by the inputs as that by the blocks' inputs."""
        return hessian if self._ocp.blocks is None else self.by_blocks(self.by_blocks(hessian).T)

    def solve(
        self, hessian: Array, gradient: Array, u: Array, u_prev: Array, soft: Soft = None,
        limits: Limits | None = None,
    ) -> Answer:  # fmt: skip
        """Solve from a plan ``u`` ``(N, n_u)``, with ``u_prev`` held before, and check the answer.

        The Hessian is symmetric positive definite. ``soft`` are the values of the soft bounds without a step ``(M,)``,
        and their derivatives by it ``(M, N n_u)``.
        """
        scale, u = self.scale, u[self._starts]
        bounds = (bound[self._starts] for bound in self._ocp.bounds(u_prev, limits))
        lower, upper = ((bound - u).ravel() / scale for bound in bounds)
        row_lower, row_upper = self._row_bounds(u, u_prev)
        h = self.blocked_hessian(hessian) * scale * scale[:, None]
        g, size = self.by_blocks(gradient) * scale, float(np.max(np.diag(h)))
        hard = _Scaled(h / size, g / size, self._rows, lower, upper, row_lower, row_upper)
        s, status, kkt = _check(hard, *_solve(self._solver, hard), self._n)
        multipliers = np.zeros(0 if soft is None else soft[0].size)
        if soft is not None and status.ok:
            s, status, kkt, multipliers = self._softly(hard, size, s, kkt, *soft)
        step = (s[: self._n] * scale).reshape(u.shape)
        if self._ocp.blocks is not None:
            step = np.repeat(step, self._ocp.blocks, axis=0)
        return Answer(step.ravel(), status, kkt, multipliers)

    def _softly(
        self, hard: _Scaled, size: float, s: Array, kkt: float, value: Array, slope: Array
    ) -> tuple[Array, Status, float, Array]:
        """Answer, what it is worth, and multipliers with soft bounds, from the answer ``s`` without."""
        sides, n, rows = self._sides, self._n, value.size
        assert sides is not None
        multipliers = np.zeros(rows)
        value, slope = sides.of(value), sides.of(self.by_blocks(slope)) * self.scale
        wanted = np.zeros(value.size, dtype=bool)
        for room, solver in self._soft_solvers.items():
            beyond = value + slope @ s[:n]
            wanted |= beyond > 0
            count = int(np.count_nonzero(wanted))
            if count == 0:
                break
            if count > room:
                continue
            # The nearest fill the room that is left: they are the likeliest to be violated next.
            nearest = np.argsort(np.where(wanted, -np.inf, -beyond), kind="stable")[:room]
            full = self._with_slacks(hard, size, value, slope, nearest)
            found = _solve(solver, full)
            s, status, kkt = _check(full, *found, n)
            multipliers = sides.multipliers(nearest, size * found[2][len(hard.a) :], rows)
            others = np.ones(value.size, dtype=bool)
            others[nearest] = False
            if not status.ok or not np.any((value + slope @ s[:n])[others] > 0):
                return s, status, kkt, multipliers
            wanted[nearest] = True
        return s, Status.SOLVED, kkt, multipliers

    def _with_slacks(
        self, hard: _Scaled, size: float, value: Array, slope: Array, chosen: NDArray[np.int64]
    ) -> _Scaled:
        """The scaled QP with a slack for each of the ``chosen`` sides of soft bounds."""
        sides, n, m = self._sides, self._n, chosen.size
        assert sides is not None
        scale = sides.scale[chosen]
        h = np.zeros((n + m, n + m))
        h[:n, :n] = hard.h
        h.flat[n * (n + m + 1) :: n + m + 1] = 2 * self._dt * sides.quadratic[chosen] * scale**2 / size
        g = np.concatenate([hard.g, self._dt * sides.linear[chosen] * scale / size])
        a = np.zeros((len(hard.a) + m, n + m))
        a[: len(hard.a), :n] = hard.a
        a[len(hard.a) :, :n] = slope[chosen]
        a[len(hard.a) :, n:] = -np.eye(m)
        none = np.full(m, np.inf)
        return _Scaled(
            h, g, a,
            np.concatenate([hard.lower, np.zeros(m)]), np.concatenate([hard.upper, none]),
            np.concatenate([hard.row_lower, -none]), np.concatenate([hard.row_upper, -value[chosen]]),
        )  # fmt: skip

    def _row_bounds(self, u: Array, u_prev: Array) -> tuple[Array, Array]:
        if self._ocp.du_max is None:
            return np.zeros(0), np.zeros(0)
        du = np.diff(u, axis=0, prepend=u_prev[None])
        scale = self.scale
        return (-self._ocp.du_max - du).ravel() / scale, (self._ocp.du_max - du).ravel() / scale


def _daqp(n: int, rows: int) -> BufferedFunction:
    options: dict[str, Any] = {"error_on_fail": False, "daqp": {"primal_tol": PRIMAL_TOLERANCE}}
    sparsity = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    return BufferedFunction(ca.conic("input_qp", "daqp", sparsity, options))


def _solve(solver: BufferedFunction, qp: _Scaled) -> tuple[Array, Array, Array]:
    """Unknowns and the multipliers of their bounds and of the rows; the solver's status proves nothing."""
    given = qp.h.ravel(), qp.g, qp.a.T.ravel(), qp.row_lower, qp.row_upper, qp.lower, qp.upper
    for buffer, values in zip(
        solver.inputs, given, strict=False
    ):  # casadi.conic: h, g, a, lba, uba, lbx, ubx, ..
        buffer[:] = values
    solver()
    s, _, lam_a, lam_x = solver.outputs
    return s.copy(), lam_x, lam_a


def _check(qp: _Scaled, s: Array, lam_x: Array, lam_a: Array, n: int) -> tuple[Array, Status, float]:
    """The answer, what it is worth, and its KKT residual; the first ``n`` unknowns are inputs.

    The residual of inputs is relative to the inputs' gradient, that of slacks to theirs: a large penalty
    does not hide an error of the inputs.
    """
    value, lower, upper, multiplier = s, qp.lower, qp.upper, lam_x
    stationarity = qp.h @ s + qp.g + lam_x
    if len(qp.a):
        value = np.concatenate([s, qp.a @ s])
        lower, upper = np.concatenate([lower, qp.row_lower]), np.concatenate([upper, qp.row_upper])
        multiplier = np.concatenate([lam_x, lam_a])
        stationarity += qp.a.T @ lam_a
    violation = float(np.max(np.maximum(lower - value, value - upper), initial=0.0))
    # Complementarity; a positive multiplier belongs to the upper bound.
    distance = np.where(multiplier > 0, upper - value, value - lower)
    slackness = np.max(np.minimum(np.abs(multiplier), np.abs(distance)))
    residual, size = np.abs(stationarity), max(1.0, float(np.max(np.abs(qp.g[:n]))))
    kkt = float(np.maximum(np.max(residual[:n]), slackness)) / size
    if s.size > n:
        slacks = float(np.max(residual[n:])) / max(1.0, float(np.max(np.abs(qp.g[n:]))))
        kkt = float(np.maximum(kkt, slacks))
    if not (np.isfinite(kkt) and np.isfinite(violation)):  # a NaN anywhere ends up in one of the two
        return s, Status.NOT_FINITE, float("nan")
    if violation > BOUND_TOLERANCE:
        return s, Status.INFEASIBLE, kkt
    return s, (Status.SOLVED if kkt <= KKT_TOLERANCE else Status.INACCURATE), kkt
