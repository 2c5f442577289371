"""Stage costs that are no squares: any smooth expression of state and input."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.buffered import BufferedFunction
from hybrid_mpc.errors import InputError
from hybrid_mpc.mpc.ocp import OCP

Array = NDArray[np.float64]


class EconomicCost:
    """The economic stage cost along a trajectory, with first and second derivatives; zero where there is none.

    Args:
        ocp: The problem.
        dt: Model period [s].

    Raises:
        InputError: If the expression does not take the problem's ``(x, u)`` or ``(x, u, p)``.

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
        if (f.size_in(0), f.size_in(1)) != ((n_x, 1), (n_u, 1)) or (f.n_in() > 2 and f.size2_in(2) != 1):
            raise InputError(
                f"economic: {f} does not take (x, u) of {n_x} states and {n_u} inputs, nor these and a column p"
            )
        x, u, p = ca.MX.sym("x", n_x), ca.MX.sym("u", n_u), ca.MX.sym("p", ocp.n_p)
        value = ca.densify(f(x, u, p) if f.n_in() > 2 else f(x, u))
        slope = ca.horzcat(ca.jacobian(value, x), ca.jacobian(value, u)).T
        curvature = ca.horzcat(ca.jacobian(slope, x), ca.jacobian(slope, u))
        self._value = BufferedFunction(ca.Function("economic", [x, u, p], [value]).map(self._n))
        outs = [ca.densify(slope), ca.densify(curvature)]
        self._derivatives = BufferedFunction(ca.Function("economic_slopes", [x, u, p], outs).map(self._n))

    def value(self, x: Array, u: Array, p: Array | None = None) -> float:
        """Cost of states ``(N + 1, n_x)`` or longer and inputs ``(N, n_u)``; the last state has none.

        ``p`` ``(N + 1, n_p)`` or longer are the parameters' values. Default: the cost has none.
        """
        if self.function is None:
            return 0.0
        self._fill(self._value, x, u, p)
        self._value()
        return self._dt * float(np.sum(self._value.outputs[0]))

    def derivatives(self, x: Array, u: Array, p: Array | None = None) -> tuple[Array, Array]:
        """Derivatives of the stages' costs by ``(x, u)``: ``(N, n_x + n_u)`` and ``(N, n_x + n_u, n_x + n_u)``."""
        f, n = self._derivatives, self._n
        self._fill(f, x, u, p)
        f()
        slope = self._dt * f.outputs[0].reshape(n, -1)
        return slope, self._dt * f.outputs[1].reshape(n, slope.shape[1], -1)

    def convex(self, x: Array, u: Array, p: Array | None = None) -> tuple[Array, Array]:
        """The same, second derivatives made positive semi-definite: what curves down counts as flat.

        What is not finite is left as it is.
        """
        slope, curvature = self.derivatives(x, u, p)
        if not np.all(np.isfinite(curvature)):
            return slope, curvature
        values, vectors = np.linalg.eigh(curvature)
        flat = np.maximum(values, 0.0)[:, None, :]
        return slope, (vectors * flat) @ vectors.transpose(0, 2, 1)

    def _fill(self, f: BufferedFunction, x: Array, u: Array, p: Array | None) -> None:
        f.inputs[0][:], f.inputs[1][:] = x[: self._n].ravel(), u.ravel()
        if p is not None:
            f.inputs[2][:] = p[: self._n].ravel()


def output_cost(output: ca.Function, q_y: ArrayLike) -> ca.Function:
    """``(x, u, p) -> (y(x, u) - p)' diag(q_y) (y(x, u) - p)``: the economic stage cost that tracks outputs.

    References then have ``n_y`` more columns, the outputs'. For outputs that are no states: with those that are,
    ``q`` says the same and has a terminal weight.

    Args:
        output: ``(x, u) -> y``, a column; of a model's own outputs ``(x, u, w, p) -> y`` with its ``w`` and ``p``
            put in.
        q_y: Weights ``(n_y,)`` [cost/s/unit^2], not negative.

    Raises:
        InputError: If the function is another, or a weight is negative, not finite or missing.

    Example:
        >>> x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
        >>> tip = output_cost(ca.Function("tip", [x, u], [ca.sin(x[0])]), [4.0])
        >>> float(tip([0.0, 1.0], 0.0, 0.5))
        1.0
    """
    if (output.n_in(), output.n_out()) != (2, 1) or output.size2_out(0) != 1:
        raise InputError(f"output_cost: {output} given; needed: a function (x, u) -> column")
    n, weight = output.size1_out(0), np.asarray(q_y, dtype=float).ravel()
    if weight.shape != (n,) or not np.all(np.isfinite(weight) & (weight >= 0)):
        raise InputError(f"output_cost: q_y {weight} given; needed: {n} finite weights, none negative")
    x, u = (ca.MX.sym(name, output.size1_in(i)) for i, name in enumerate("xu"))
    p = ca.MX.sym("p", n)
    return ca.Function("output_cost", [x, u, p], [ca.dot(weight, (output(x, u) - p) ** 2)])
