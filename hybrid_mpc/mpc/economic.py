"""Stage costs that are no squares: any smooth expression of state and input."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.mpc.buffered import BufferedFunction
from hybrid_mpc.mpc.ocp import OCP

Array = NDArray[np.float64]


class EconomicCost:
    """The economic stage cost along a trajectory, with first and second derivatives; zero where there is none.

    Args:
        ocp: The problem.
        dt: Model period [s].

    Raises:
        InputError: If the expression does not take the problem's ``(x, u)``.

    Example:
        >>> x, u = ca.MX.sym("x"), ca.MX.sym("u")
        >>> power = ca.Function("power", [x, u], [x * u])
        >>> cost = EconomicCost(OCP(2, [1.0], [1.0], [0.0], [-1.0], [1.0], economic=power), 0.1)
        >>> round(cost.value(np.array([[1.0], [2.0], [9.0]]), np.ones((2, 1))), 6)
        0.3
    """

    def __init__(self, ocp: OCP, dt: float) -> None:
        self.function, self._dt, self._n = ocp.economic, dt, ocp.horizon
        f, n_x, n_u = ocp.economic, ocp.n_x, ocp.n_u
        if f is None:
            return
        if (f.size_in(0), f.size_in(1)) != ((n_x, 1), (n_u, 1)):
            raise InputError(f"economic: {f} does not take (x, u) of {n_x} states and {n_u} inputs")
        x, u = ca.MX.sym("x", n_x), ca.MX.sym("u", n_u)
        value = ca.densify(f(x, u))
        slope = ca.horzcat(ca.jacobian(value, x), ca.jacobian(value, u)).T
        curvature = ca.horzcat(ca.jacobian(slope, x), ca.jacobian(slope, u))
        self._value = BufferedFunction(ca.Function("economic", [x, u], [value]).map(self._n))
        outs = [ca.densify(slope), ca.densify(curvature)]
        self._derivatives = BufferedFunction(ca.Function("economic_slopes", [x, u], outs).map(self._n))

    def value(self, x: Array, u: Array) -> float:
        """Cost of states ``(N + 1, n_x)`` or longer and inputs ``(N, n_u)``; the last state has none."""
        if self.function is None:
            return 0.0
        self._value.inputs[0][:], self._value.inputs[1][:] = x[: self._n].ravel(), u.ravel()
        self._value()
        return self._dt * float(np.sum(self._value.outputs[0]))

    def derivatives(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Derivatives of the stages' costs by ``(x, u)``: ``(N, n_x + n_u)`` and ``(N, n_x + n_u, n_x + n_u)``."""
        f, n = self._derivatives, self._n
        f.inputs[0][:], f.inputs[1][:] = x[:n].ravel(), u.ravel()
        f()
        slope = self._dt * f.outputs[0].reshape(n, -1)
        return slope, self._dt * f.outputs[1].reshape(n, slope.shape[1], -1)

    def convex(self, x: Array, u: Array) -> tuple[Array, Array]:
        """The same, second derivatives made positive semi-definite: what curves down counts as flat.

        What is not finite is left as it is.
        """
        slope, curvature = self.derivatives(x, u)
        if not np.all(np.isfinite(curvature)):
            return slope, curvature
        values, vectors = np.linalg.eigh(curvature)
        flat = np.maximum(values, 0.0)[:, None, :]
        return slope, (vectors * flat) @ vectors.transpose(0, 2, 1)
