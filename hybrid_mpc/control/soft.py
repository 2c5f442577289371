"""Soft bounds on states and on expressions of state and input: plain data, and their rows along a trajectory."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.limits import numbers
from nn_export import ExportError, program_of

if TYPE_CHECKING:
    pass

if TYPE_CHECKING:
    from hybrid_mpc.control.ocp import OCP

Array = NDArray[np.float64]
PENALTY = 1e3
"""Default penalty of a bound's violation, in multiples of what the tolerated deviation ``1 / sqrt(q)`` costs."""


@dataclass(frozen=True, eq=False)
class SoftBound:
    """``lower <= expression(x, u) <= upper`` in every period of the horizon, as a penalty on its violation.

    A violation ``s`` costs ``linear s + quadratic s^2`` per second. With ``linear`` above the largest
    multiplier of the hard bound (cost per second and unit by which the bound is moved) the penalty is exact:
    where the bound can be kept, the plan is that of the hard bound; where it cannot, the plan violates it as
    little as the cost makes worth while, and there is always a plan.

    Two bounds are equal if their numbers are and their expressions state the same program, as
    :class:`~hybrid_mpc.control.ocp.OCP` says.

    Args:
        expression: ``(x, u) -> e``, a column of ``n_e``.
        lower: ``(n_e,)``; ``-inf`` for none.
        upper: ``(n_e,)``; ``inf`` for none.
        linear: Penalties ``(n_e,)`` [cost/s/unit], not negative.
        quadratic: Penalties ``(n_e,)`` [cost/s/unit^2], positive: they make the QP strictly convex.

    Raises:
        InputError: If shapes do not fit, bounds cross, or a penalty is not as said.

    Source: Nocedal and Wright, *Numerical Optimization*, 2006, theorem 17.3.

    Example:
        >>> x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
        >>> power = SoftBound(ca.Function("power", [x, u], [u * x[1]]), [-2.0], [5.0], [10.0], [1.0])
        >>> power.lower
        array([-2.])
    """

    expression: ca.Function
    lower: Array
    upper: Array
    linear: Array
    quadratic: Array

    def __init__(
        self,
        expression: ca.Function,
        lower: ArrayLike,
        upper: ArrayLike,
        linear: ArrayLike,
        quadratic: ArrayLike,
    ) -> None:
        if (
            not isinstance(expression, ca.Function)
            or (expression.n_in(), expression.n_out()) != (2, 1)
            or expression.size2_out(0) != 1
        ):
            raise InputError(f"soft bound: {expression} given; needed: a function (x, u) -> column")
        n = int(expression.size1_out(0))
        arrays = _checked("soft bound", n, lower, upper, linear, quadratic)
        object.__setattr__(self, "expression", expression)
        for name, value in zip(("lower", "upper", "linear", "quadratic"), arrays, strict=True):
            object.__setattr__(self, name, fixed(value))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SoftBound):
            return NotImplemented
        return number_content(self) == number_content(other) and same_expression(
            self.expression, other.expression
        )

    def __hash__(self) -> int:
        return hash(number_content(self))


def state_bounds(
    q: Array,
    x_min: ArrayLike | None,
    x_max: ArrayLike | None,
    linear: ArrayLike | None,
    quadratic: ArrayLike | None,
) -> tuple[Array, Array, Array, Array]:
    """Bounds on the states and their penalties with the defaults filled in, each ``(n_x,)``.

    Raises:
        InputError: If shapes do not fit, bounds cross, or a penalty is not as :class:`SoftBound` says.
    """
    weight = np.where(q > 0, q, 1.0)
    return _checked(
        "state bounds", q.size,
        np.full(q.size, -np.inf) if x_min is None else x_min,
        np.full(q.size, np.inf) if x_max is None else x_max,
        PENALTY * np.sqrt(weight) if linear is None else linear,
        PENALTY * weight if quadratic is None else quadratic,
    )  # fmt: skip


def _checked(
    what: str, n: int, lower: ArrayLike, upper: ArrayLike, linear: ArrayLike, quadratic: ArrayLike
) -> tuple[Array, Array, Array, Array]:
    given = {"lower": lower, "upper": upper, "linear": linear, "quadratic": quadratic}
    arrays = {name: numbers(value, f"{what}: {name}") for name, value in given.items()}
    low, up, lin, quad = arrays.values()
    for name, value in arrays.items():
        if value.shape != (n,):
            raise InputError(f"{what}: {name} has {value.size} values, {n} needed")
    if not np.all(low < up):
        raise InputError(f"{what} cross: lower {low}, upper {up}; every lower must be below its upper")
    if not (np.all(np.isfinite(lin)) and np.all(lin >= 0)):
        raise InputError(f"{what}: linear penalties must be finite and not negative, got {lin}")
    if not (np.all(np.isfinite(quad)) and np.all(quad > 0)):
        raise InputError(f"{what}: quadratic penalties must be finite and positive, got {quad}")
    return low, up, lin, quad


class SoftRows:
    """The M soft bounds of a problem along a trajectory, one row a bound and period.

    Bounds on states hold for ``x_1 .. x_N`` (``x_0`` is given), expressions for ``(x_0, u_0) ..
    (x_{N-1}, u_{N-1})``.

    Args:
        ocp: The problem.

    Raises:
        InputError: If an expression does not take the problem's ``(x, u)``.

    Example:
        >>> from hybrid_mpc.control.ocp import OCP
        >>> rows = SoftRows(OCP(2, [1.0], [1.0], [0.0], [-9.0], [9.0], x_max=[0.5]))
        >>> rows.excess(rows.values(np.array([[7.0], [0.6], [0.2]]), np.zeros((2, 1)))).round(6)
        array([0.1, 0. ])
    """

    stage: NDArray[np.int64]
    """State ``(M,)`` of the trajectory that a row looks at."""

    def __init__(self, ocp: OCP) -> None:
        n = ocp.horizon
        self._n_x, self._n_u, self._horizon = ocp.n_x, ocp.n_u, n
        self._states = np.flatnonzero(np.isfinite(ocp.x_min) | np.isfinite(ocp.x_max))
        chosen = self._states
        self._functions = [_expression(bound, ocp.n_x, ocp.n_u).map(n) for bound in ocp.soft]
        self._buffered = [BufferedFunction(f) for f in self._functions]
        parts = [(ocp.x_min, ocp.x_max, *ocp.penalties)]
        columns = [[np.tile(v[chosen], n) for v in parts[0]]]
        columns += [[np.tile(v, n) for v in (b.lower, b.upper, b.linear, b.quadratic)] for b in ocp.soft]
        self.lower, self.upper, self.linear, self.quadratic = (
            np.concatenate([c[i] for c in columns]) for i in range(4)
        )
        stages = [np.repeat(np.arange(1, n + 1), chosen.size)]
        stages += [np.repeat(np.arange(n), b.lower.size) for b in ocp.soft]
        self.stage = np.concatenate(stages)
        half = 0.5 * (self.upper - self.lower)
        # One-sided bounds have no range: the violation that costs as much quadratically as linearly, or 1.
        other = np.where(self.linear > 0, self.linear / self.quadratic, 1.0)
        self.scale: Array = np.where(np.isfinite(half), half, other)

    def __len__(self) -> int:
        return int(self.stage.size)

    def values(self, x: Array, u: Array) -> Array:
        """Bounded values ``(M,)`` along states ``(N + 1, n_x)`` and inputs ``(N, n_u)``."""
        return self.linearize(x, u)[0]

    def linearize(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Values ``(M,)`` and their derivatives by the row's state ``(M, n_x)`` and input ``(M, n_u)``."""
        n = self._horizon
        by_x = np.tile(np.eye(self._n_x)[self._states], (n, 1))
        rows = [(x[1:, self._states].ravel(), by_x, np.zeros((by_x.shape[0], self._n_u)))]
        for f in self._buffered:
            f.inputs[0][:], f.inputs[1][:] = x[:-1].ravel(), u.ravel()
            f()
            e, e_x, e_u = (out.copy() for out in f.outputs)
            each = e.size // n
            e_x = e_x.reshape(n, self._n_x, each).transpose(0, 2, 1).reshape(e.size, self._n_x)
            e_u = e_u.reshape(n, self._n_u, each).transpose(0, 2, 1).reshape(e.size, self._n_u)
            rows.append((e, e_x, e_u))
        return (
            np.concatenate([r[0] for r in rows]),
            np.vstack([r[1] for r in rows]),
            np.vstack([r[2] for r in rows]),
        )

    def condensed(self, x: Array, u: Array, from_u: Array) -> tuple[Array, Array, Array]:
        """Values ``(M,)`` and their derivatives by the row's state ``(M, n_x)`` and by all inputs ``(M, N n_u)``.

        Args:
            x: States ``(N + 1, n_x)``.
            u: Inputs ``(N, n_u)``.
            from_u: Derivatives of the states by the inputs ``((N + 1) n_x, N n_u)``.
        """
        if not len(self):
            return np.zeros(0), np.zeros((0, self._n_x)), np.zeros((0, u.size))
        value, by_x, by_u = self.linearize(x, u)
        states = from_u.reshape(len(x), self._n_x, u.size)[self.stage]
        slope = (by_x[:, None, :] @ states)[:, 0, :]
        direct = np.flatnonzero(np.any(by_u != 0, axis=1))
        for j in range(self._n_u):
            slope[direct, self.stage[direct] * self._n_u + j] += by_u[direct, j]
        return value, by_x, slope

    def excess(self, values: Array) -> Array:
        """Violations ``(M,)``, zero where a bound is kept."""
        return np.asarray(np.maximum(0.0, np.maximum(values - self.upper, self.lower - values)))

    def penalty(self, excess: Array) -> float:
        """Cost per second of violations ``(M,)``, summed."""
        return float(self.linear @ excess + self.quadratic @ excess**2)


def _expression(bound: SoftBound, n_x: int, n_u: int) -> ca.Function:
    f = bound.expression
    if (f.size_in(0), f.size_in(1)) != ((n_x, 1), (n_u, 1)):
        raise InputError(f"soft bound: expression {f} does not take (x, u) of {n_x} states and {n_u} inputs")
    # One Jacobian by both, in scalar code where the expression is some: two would run through its calls twice.
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    z, x, u = kind.sym("z", n_x + n_u), ca.MX.sym("x", n_x), ca.MX.sym("u", n_u)
    e = f(z[:n_x], z[n_x:])
    both = ca.Function("both", [z], [ca.densify(e), ca.densify(ca.jacobian(e, z))], {"cse": True})
    value, slope = both(ca.vertcat(x, u))
    return ca.Function("soft", [x, u], [value, slope[:, :n_x], slope[:, n_x:]])


def fixed(array: Array) -> Array:
    """The array, which may not be written into any more."""
    array.flags.writeable = False
    return array


def number_content(holder: Any) -> tuple[Any, ...]:
    """All fields of a dataclass but expressions, by value, as something that can be hashed.

    Example:
        >>> from hybrid_mpc.control.ocp import Limits
        >>> number_content(Limits([-1.0], [1.0]))
        (((1,), (-1.0,)), ((1,), (1.0,)))
    """
    return tuple(_content(getattr(holder, field.name)) for field in fields(holder))


def _content(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, tuple(value.ravel().tolist())
    if isinstance(value, tuple):
        return tuple(map(_content, value))
    return None if isinstance(value, ca.Function) else value


def same_expression(a: ca.Function | None, b: ca.Function | None) -> bool:
    """Whether two functions are one, or state the same program; what cannot be stated is the same as itself alone.

    Example:
        >>> x, y = ca.SX.sym("x"), ca.MX.sym("y")
        >>> same_expression(ca.Function("f", [x], [x**2], ["x"], ["c"]), ca.Function("g", [y], [y * y], ["x"], ["c"]))
        True
    """
    if a is None or b is None:
        return a is b
    if a.__hash__() == b.__hash__():  # one object of CasADi
        return True
    try:
        return program_of(a) == program_of(b)
    except ExportError:
        return False
