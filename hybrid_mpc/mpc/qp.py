"""The condensed QP over the inputs and the slacks of soft bounds, and the check of its answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.mpc.buffered import BufferedFunction
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.soft import SoftRows
from hybrid_mpc.mpc.solution import Status

Array = NDArray[np.float64]

# Relative to the gradient's size.
KKT_TOLERANCE = 1e-5
# In DAQP's own scaling, which an ill-conditioned Hessian (weights of 1e4 on one instant) stretches: at the default
# of 1e-6 it returned bounds violated by 5e-5 of the range.
PRIMAL_TOLERANCE = 1e-9
# Share of an input's or a soft bound's range; what is left of an input's is clipped away.
BOUND_TOLERANCE = 1e-6


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


class InputQP:
    """``min 1/2 s'Hs + g's + penalties`` over input steps ``s`` within the limits of inputs and changes.

    Inputs are scaled by half their range, soft bounds by half theirs, and the Hessian by its diagonal. The
    solvers (DAQP, through ``casadi.conic``) are built once; :meth:`solve` checks their answer whatever
    status they report. Soft bounds cost only where they act: the QP is first solved without them, and an
    answer that keeps them all is the answer with them, since its penalty is zero. Else it is solved again
    with one slack a row, ``N n_u + M`` unknowns.

    Args:
        ocp: The problem whose bounds hold.

    Source: Arnström, Bemporad, Axehill, *A dual active-set solver for embedded quadratic programming
    using recursive LDL' updates*, IEEE TAC 67 (2022).

    Example:
        >>> qp = InputQP(OCP(1, [1.0], [1.0], [0.0], [-1.0], [1.0]))
        >>> step, status, kkt = qp.solve(np.eye(1), np.array([-3.0]), np.zeros((1, 1)), np.zeros(1))
        >>> step, status.name
        (array([1.]), 'SOLVED')
    """

    def __init__(self, ocp: OCP, soft: SoftRows | None = None, dt: float = 1.0) -> None:
        n, n_u = ocp.horizon * ocp.n_u, ocp.n_u
        half_range = 0.5 * (ocp.u_max - ocp.u_min)
        self._ocp, self._soft, self._dt, self._n = ocp, soft, dt, n
        self._scale = np.tile(np.where(np.isfinite(half_range), half_range, 1.0), ocp.horizon)
        rows = np.eye(n) - np.eye(n, k=-n_u) if ocp.du_max is not None else np.zeros((0, n))
        self._rows = rows * self._scale / self._scale[:, None] if len(rows) else rows
        self._solver = _daqp(n, len(rows))
        if soft is None or not len(soft):
            return
        self._above, self._below = np.isfinite(soft.upper), np.isfinite(soft.lower)
        wide = len(rows) + int(np.sum(self._above)) + int(np.sum(self._below))
        self._soft_solver = _daqp(n + len(soft), wide)

    @property
    def scale(self) -> Array:
        """What an input step of 1 means in the scaled QP ``(N n_u,)`` [input units]."""
        return self._scale

    def solve(
        self,
        hessian: Array,
        gradient: Array,
        u: Array,
        u_prev: Array,
        soft: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Status, float]:
        """Step from the plan ``u``, how the solve ended, and the relative KKT residual.

        Args:
            hessian: ``(N n_u, N n_u)``, symmetric positive definite.
            gradient: ``(N n_u,)``.
            u: Plan ``(N, n_u)`` the step starts from.
            u_prev: Input ``(n_u,)`` held before.
            soft: Values of the soft bounds ``(M,)`` without a step, and their derivatives by the step
                ``(M, N n_u)``. Default: none.
        """
        ocp, scale = self._ocp, self._scale
        lower, upper = ((bound - u).ravel() / scale for bound in (ocp.u_min, ocp.u_max))
        row_lower, row_upper = self._row_bounds(u, u_prev)
        h, g = hessian * scale * scale[:, None], gradient * scale
        size = float(np.max(np.diag(h)))
        hard = _Scaled(h / size, g / size, self._rows, lower, upper, row_lower, row_upper)
        s, status, kkt = _check(hard, *_solve(self._solver, hard), self._n)
        if soft is None or self._soft is None or not len(self._soft) or not status.ok:
            return s * scale, status, kkt
        value, slope = soft
        if np.max(self._soft.excess(value + slope @ (s * scale)), initial=0.0) == 0.0:
            return s * scale, status, kkt
        full = self._with_slacks(hard, size, value, slope)
        s, status, kkt = _check(full, *_solve(self._soft_solver, full), self._n)
        return s[: self._n] * scale, status, kkt

    def _with_slacks(self, hard: _Scaled, size: float, value: Array, slope: Array) -> _Scaled:
        soft, n, m = self._soft, self._n, value.size
        assert soft is not None
        h = np.zeros((n + m, n + m))
        h[:n, :n] = hard.h
        h.flat[n * (n + m + 1) :: n + m + 1] = 2 * self._dt * soft.quadratic * soft.scale**2 / size
        g = np.concatenate([hard.g, self._dt * soft.linear * soft.scale / size])
        by_u, eye = slope * self._scale / soft.scale[:, None], np.eye(m)
        above = np.hstack([by_u, -eye])[self._above]
        below = np.hstack([by_u, eye])[self._below]
        rows = np.hstack([hard.a, np.zeros((len(hard.a), m))])
        lower = ((soft.lower - value) / soft.scale)[self._below]
        upper = ((soft.upper - value) / soft.scale)[self._above]
        return _Scaled(
            h, g, np.vstack([rows, above, below]),
            np.concatenate([hard.lower, np.zeros(m)]), np.concatenate([hard.upper, np.full(m, np.inf)]),
            np.concatenate([hard.row_lower, np.full(upper.size, -np.inf), lower]),
            np.concatenate([hard.row_upper, upper, np.full(lower.size, np.inf)]),
        )  # fmt: skip

    def _row_bounds(self, u: Array, u_prev: Array) -> tuple[Array, Array]:
        if self._ocp.du_max is None:
            return np.zeros(0), np.zeros(0)
        du = np.diff(u, axis=0, prepend=u_prev[None])
        scale = self._scale
        return (-self._ocp.du_max - du).ravel() / scale, (self._ocp.du_max - du).ravel() / scale


def _daqp(n: int, rows: int) -> BufferedFunction:
    options: dict[str, Any] = {"error_on_fail": False, "daqp": {"primal_tol": PRIMAL_TOLERANCE}}
    sparsity = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    return BufferedFunction(ca.conic("input_qp", "daqp", sparsity, options))


def _solve(solver: BufferedFunction, qp: _Scaled) -> tuple[Array, Array, Array]:
    """Unknowns and the multipliers of their bounds and of the rows, as the solver leaves them.

    ``casadi.conic`` takes ``h, g, a, lba, uba, lbx, ubx`` and returns ``x, cost, lam_a, lam_x``. Its status is
    not asked for: it proves nothing that the check does not.
    """
    given = qp.h.ravel(), qp.g, qp.a.T.ravel(), qp.row_lower, qp.row_upper, qp.lower, qp.upper
    for buffer, values in zip(solver.inputs, given, strict=False):
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
