"""Soft and hard bounds on states, outputs and expressions, as plain data that can be compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import Collected, InputError
from hybrid_mpc.model.limits import numbers
from hybrid_mpc.rules import LARGEST
from nn_export import ExportError, program_of

Array = NDArray[np.float64]
PENALTY = 1e3
"""Default penalty of a bound's violation, over the cost of the tolerated deviation ``1 / sqrt(q)``."""


EXPRESSION = "(x, u), (x, u, w) or (x, u, w, p) -> column"
MOST_PRIORITY = 10_000
"""Largest priority of a hard bound, which only determines an order."""
GIVES_WAY = 1e5
"""Penalty of a relaxed hard bound's violation by its size, over the cost of inputs over their whole range, or of states
off by that size: far above the multipliers of a feasible bound."""
HIGHER = 1e2
"""Factor between the penalties of successive priorities."""


@dataclass(frozen=True, eq=False)
class SoftBound:
    """``lower <= expression(x, u) <= upper`` (or of ``(x, u, w)`` or ``(x, u, w, p)``) in every period of the horizon,
    as a penalty on its violation.

    A violation ``s`` costs ``linear s + quadratic s^2`` per second. If ``linear`` exceeds the largest multiplier of the
    hard bound (cost per second and unit by which the bound is moved), the penalty is exact: a feasible bound acts like
    a hard one, an infeasible one is violated as little as the cost allows. A plan always exists.

    Two bounds are equal if their numbers are equal and their expressions are the same program.

    Args:
        expression: ``(x, u) -> e``, a column of ``n_e``; ``(x, u, w) -> e`` with measured disturbances,
            ``(x, u, w, p) -> e`` for a moving bound: ``p`` are further columns of the reference, as for an economic
            stage cost.
        lower: ``(n_e,)``; ``-inf`` for none.
        upper: ``(n_e,)``; ``inf`` for none.
        linear: Penalties ``(n_e,)`` [cost/s/unit], not negative.
        quadratic: Penalties ``(n_e,)`` [cost/s/unit^2], positive: they make the QP strictly convex.

    Raises:
        InputError: If shapes do not fit, bounds cross, or a penalty is out of range.

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
        own = Collected()
        fits = _is_expression(expression)
        if not fits:
            own.add(f"soft bound: must be a function {EXPRESSION}, got {expression} [HM-CONTROL-044]")
        n = int(expression.size1_out(0)) if fits else None
        arrays = own(_checked, "soft bound", n, lower, upper, linear, quadratic)
        own.refuse()
        assert arrays is not None
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


@dataclass(frozen=True, eq=False)
class HardBound:
    """``lower <= what <= upper`` in every period of the horizon that an input can affect, kept whenever feasible.

    States are bounded in ``x_1 .. x_N``, outputs and expressions in periods ``0 .. N-1``, from the first period in
    which an input affects them. If no plan keeps all hard bounds, those of the lowest priority are relaxed first and as
    little as possible; :attr:`~hybrid_mpc.control.problem.Solution.given_way` of the plan lists them. Limits of inputs
    and of their changes are never relaxed.

    Two bounds are equal if their numbers are equal and their expressions are the same program.

    Args:
        what: ``"x"`` for all states, ``"y"`` for all outputs, or an expression as in :class:`SoftBound`, e.g. of
            ``(x, u, w, p)`` for a moving obstacle.
        lower: ``(n,)``; ``-inf`` for none.
        upper: ``(n,)``; ``inf`` for none.
        priority: Bounds with a higher priority are relaxed later. Default: 0.
        at_end: Whether it only holds at the end of the plan: states in ``x_N``, outputs and expressions in the last
            period. For a target, or a set from which safety is guaranteed. Default: everywhere.

    Raises:
        InputError: If shapes do not fit, bounds cross, or ``priority`` or ``at_end`` is of a wrong kind.

    Example:
        >>> level = HardBound("x", [0.0, 0.0], [0.5, np.inf])
        >>> level.upper, level.priority
        (array([0.5,  inf]), 0)
    """

    what: str | ca.Function
    lower: Array
    upper: Array
    priority: int
    at_end: bool

    def __init__(
        self,
        what: str | ca.Function,
        lower: ArrayLike,
        upper: ArrayLike,
        priority: int = 0,
        at_end: bool = False,
    ) -> None:
        own = Collected()
        fits = what in ("x", "y") if isinstance(what, str) else _is_expression(what)
        if not fits:
            own.add(
                f"hard bound: must be on 'x', 'y', or a function {EXPRESSION}, got {what!r:.80} [HM-CONTROL-045]"
            )
        if not isinstance(priority, int) or isinstance(priority, bool) or abs(priority) > MOST_PRIORITY:
            own.add(
                f"hard bound: priority must be an integer of at most {MOST_PRIORITY} in size, got {priority!r:.80}"
                " [HM-CONTROL-046]"
            )
        if not isinstance(at_end, bool):
            own.add(f"hard bound: at_end must be True or False, got {at_end!r:.80} [HM-CONTROL-047]")
        n = int(what.size1_out(0)) if fits and isinstance(what, ca.Function) else None
        ends = own(_range, "hard bound", n, lower, upper)
        own.refuse()
        assert ends is not None
        low, up = ends
        values = what, fixed(low), fixed(up), priority, at_end
        for name, value in zip(self.__dataclass_fields__, values, strict=True):
            object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, HardBound):
            return NotImplemented
        mine, theirs = self.what, other.what
        if isinstance(mine, str) or isinstance(theirs, str):
            same = isinstance(mine, str) and isinstance(theirs, str) and mine == theirs
        else:
            same = same_expression(mine, theirs)
        return same and number_content(self) == number_content(other)

    def __hash__(self) -> int:
        return hash(number_content(self))


def _is_expression(f: object) -> bool:
    """Whether ``f`` is a function ``(x, u)``, ``(x, u, w)`` or ``(x, u, w, p)`` to a column."""
    return isinstance(f, ca.Function) and f.n_in() in (2, 3, 4) and f.n_out() == 1 and f.size2_out(0) == 1


def tightest(lower: Array, upper: Array, hard: Sequence[HardBound], what: str, n: int) -> tuple[Array, Array]:
    """Bounds ``(n,)`` of states or outputs: soft ones (which may be empty) and hard ones of all periods."""
    low = lower.copy() if lower.size else np.full(n, -np.inf)
    up = upper.copy() if upper.size else np.full(n, np.inf)
    for bound in hard:
        if isinstance(bound.what, str) and bound.what == what and not bound.at_end:
            low, up = np.maximum(low, bound.lower), np.minimum(up, bound.upper)
    return low, up


def state_bounds(
    weights: Array,
    x_min: ArrayLike | None,
    x_max: ArrayLike | None,
    linear: ArrayLike | None,
    quadratic: ArrayLike | None,
) -> tuple[Array, Array, Array, Array]:
    """Checked bounds on the states and their penalties ``(n_x,)`` each, with defaults from positive ``weights``."""
    n = weights.size
    return _checked(
        "state bounds", n,
        np.full(n, -np.inf) if x_min is None else x_min,
        np.full(n, np.inf) if x_max is None else x_max,
        PENALTY * np.sqrt(weights) if linear is None else linear,
        PENALTY * weights if quadratic is None else quadratic,
    )  # fmt: skip


def output_bounds(weights: Array, lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """Bounds on the outputs and their penalties ``(n_y,)`` each, from positive ``weights`` (none: 1); empty without
    bounds.
    """
    given = [numbers(v, name, most=LARGEST) for v, name in ((lower, "y_min"), (upper, "y_max"))]
    n = max(v.size for v in given)
    if not n:
        return tuple(np.zeros(0) for _ in range(4))  # type: ignore[return-value]
    if weights.size not in (0, n):
        raise InputError(
            f"output bounds: {n} values given, but q_y has {weights.size}. Give one for each output."
            " [HM-CONTROL-048]"
        )
    low, up = (v if v.size else np.full(n, side) for v, side in zip(given, (-np.inf, np.inf), strict=True))
    weight = weights if weights.size else np.ones(n)
    return _checked("output bounds", n, low, up, PENALTY * np.sqrt(weight), PENALTY * weight)


def _checked(
    what: str, n: int | None, lower: ArrayLike, upper: ArrayLike, linear: ArrayLike, quadratic: ArrayLike
) -> tuple[Array, Array, Array, Array]:
    """Bounds and penalties, ``(n,)`` each; ``n`` None: as many as lower bounds."""
    own = Collected()
    low, up = own(_range, what, n, lower, upper) or (None, None)
    lin, quad = (
        own(_sized, value, n if low is None else low.size, f"{what}: {name}")
        for name, value in (("linear", linear), ("quadratic", quadratic))
    )
    if lin is not None and not (np.all(np.isfinite(lin)) and np.all(lin >= 0)):
        own.add(f"{what}: linear penalties must be finite and not negative, got {lin} [HM-CONTROL-049]")
    if quad is not None and not (np.all(np.isfinite(quad)) and np.all(quad > 0)):
        own.add(f"{what}: quadratic penalties must be finite and positive, got {quad} [HM-CONTROL-050]")
    own.refuse()
    assert low is not None
    assert up is not None
    assert lin is not None
    assert quad is not None
    return low, up, lin, quad


def _range(what: str, n: int | None, lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array]:
    """Lower and upper bounds, ``(n,)`` each; ``n`` None as in :func:`_checked`."""
    own = Collected()
    low = own(_sized, lower, n, f"{what}: lower")
    up = own(_sized, upper, n if n is not None or low is None else low.size, f"{what}: upper")
    if low is not None and up is not None and low.shape == up.shape and not np.all(low < up):
        own.add(f"{what}: every lower must be below its upper, got lower {low}, upper {up} [HM-CONTROL-051]")
    own.refuse()
    assert low is not None
    assert up is not None
    return low, up


def _sized(values: ArrayLike, n: int | None, name: str) -> Array:
    """``values`` as a vector ``(n,)``, or of any size if ``n`` is None."""
    array = numbers(values, name, most=LARGEST)
    if n is not None and array.shape != (n,):
        raise InputError(f"{name}: must have {n} values, got {array.size} [HM-CONTROL-052]")
    return array


def fixed(array: Array) -> Array:
    """The array, made read-only."""
    array.flags.writeable = False
    return array


def number_content(holder: Any) -> tuple[Any, ...]:
    """All fields of a dataclass by value, without expressions; hashable."""
    return tuple(_content(getattr(holder, field.name)) for field in fields(holder))


def _content(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, tuple(value.ravel().tolist())
    if isinstance(value, tuple):
        return tuple(map(_content, value))
    return None if isinstance(value, ca.Function) else value


def same_expression(a: ca.Function | None, b: ca.Function | None) -> bool:
    """Whether two functions are the same object or program; one that cannot be traced only equals itself."""
    if a is None or b is None:
        return a is b
    if a.__hash__() == b.__hash__():  # the same CasADi object
        return True
    try:
        return program_of(a) == program_of(b)
    except ExportError:
        return False
