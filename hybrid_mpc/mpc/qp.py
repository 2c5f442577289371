"""The condensed QP over the inputs, and the check of its answer."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.solution import Status

Array = NDArray[np.float64]

# Relative to the gradient's size; DAQP works to 1e-6 in its own scaling by default.
KKT_TOLERANCE = 1e-5
# Share of an input's range; what is left is clipped away.
BOUND_TOLERANCE = 1e-6


class InputQP:
    """``min 1/2 s'Hs + g's`` over input steps ``s`` within the bounds and the limits of the change.

    Inputs are scaled by half their range and the Hessian by its diagonal. The solver (DAQP, through
    ``casadi.conic``) is built once; :meth:`solve` checks its answer whatever status it reports.

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

    def __init__(self, ocp: OCP) -> None:
        n, n_u = ocp.horizon * ocp.n_u, ocp.n_u
        half_range = 0.5 * (ocp.u_max - ocp.u_min)
        self._ocp = ocp
        self._scale = np.tile(np.where(np.isfinite(half_range), half_range, 1.0), ocp.horizon)
        rows = np.eye(n) - np.eye(n, k=-n_u) if ocp.du_max is not None else np.zeros((0, n))
        self._rows = rows * self._scale / self._scale[:, None] if len(rows) else rows
        self._a = ca.DM(ca.sparsify(ca.DM(self._rows)))
        options = {"error_on_fail": False}
        sparsity = {"h": ca.Sparsity.dense(n, n), "a": self._a.sparsity()}
        self._solver = ca.conic("input_qp", "daqp", sparsity, options)

    def solve(self, hessian: Array, gradient: Array, u: Array, u_prev: Array) -> tuple[Array, Status, float]:
        """Step from the plan ``u``, how the solve ended, and the relative KKT residual.

        Args:
            hessian: ``(N n_u, N n_u)``, symmetric positive definite.
            gradient: ``(N n_u,)``.
            u: Plan ``(N, n_u)`` the step starts from.
            u_prev: Input ``(n_u,)`` held before.
        """
        ocp, scale = self._ocp, self._scale
        lower, upper = ((bound - u).ravel() / scale for bound in (ocp.u_min, ocp.u_max))
        row_lower, row_upper = self._row_bounds(u, u_prev)
        h, g = hessian * scale * scale[:, None], gradient * scale
        size = float(np.max(np.diag(h)))
        h, g = h / size, g / size
        answer = self._solver(h=h, g=g, a=self._a, lbx=lower, ubx=upper, lba=row_lower, uba=row_upper)
        s, lam_x, lam_a = (answer[key].full().ravel() for key in ("x", "lam_x", "lam_a"))
        step = s * scale
        if not (np.all(np.isfinite(s)) and np.all(np.isfinite(lam_x)) and np.all(np.isfinite(lam_a))):
            return step, Status.NOT_FINITE, float("nan")
        if not self._solver.stats()["success"]:
            return step, Status.QP_FAILED, float("nan")
        rows = self._rows @ s
        violation = _violation(s, lower, upper), _violation(rows, row_lower, row_upper)
        stationarity = h @ s + g + lam_x + self._rows.T @ lam_a
        size = max(1.0, float(np.max(np.abs(g))))
        slack = _slackness(s, lower, upper, lam_x), _slackness(rows, row_lower, row_upper, lam_a)
        kkt = max(float(np.max(np.abs(stationarity))), *slack) / size
        if max(violation) > BOUND_TOLERANCE:
            return step, Status.INFEASIBLE, kkt
        return step, (Status.SOLVED if kkt <= KKT_TOLERANCE else Status.INACCURATE), kkt

    def _row_bounds(self, u: Array, u_prev: Array) -> tuple[Array, Array]:
        if self._ocp.du_max is None:
            return np.zeros(0), np.zeros(0)
        du = np.diff(u, axis=0, prepend=u_prev[None])
        scale = self._scale
        return (-self._ocp.du_max - du).ravel() / scale, (self._ocp.du_max - du).ravel() / scale


def _violation(value: Array, lower: Array, upper: Array) -> float:
    return float(max(np.max(lower - value, initial=0.0), np.max(value - upper, initial=0.0)))


def _slackness(value: Array, lower: Array, upper: Array, multiplier: Array) -> float:
    """Largest complementarity error; a positive multiplier belongs to the upper bound."""
    distance = np.where(multiplier > 0, upper - value, value - lower)
    return float(np.max(np.minimum(np.abs(multiplier), np.abs(distance)), initial=0.0))
