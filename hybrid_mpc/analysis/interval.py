"""Bounds of a function over a box, by interval arithmetic along its instructions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]
Interval = tuple[float, float]


def interval_bounds(f: ca.Function, lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array]:
    """Lower and upper bounds of a function's first output over a box of its first input.

    Never too small but for rounding (about 1e-15 of the values), mostly too large: a variable that appears twice
    counts as two.

    Args:
        f: One input ``(n,)``, one output ``(m,)``; arithmetic, powers of two, tanh, exp, roots, sine, cosine.
        lower: Lower bounds of the input ``(n,)``.
        upper: Upper bounds of the input ``(n,)``.

    Returns:
        Bounds ``(m,)`` each.

    Raises:
        InputError: If a bound is missing or not finite, or the function has an operation that is not known here.

    Source: Moore, Kearfott, Cloud, *Introduction to Interval Analysis*, 2009, chapter 2 and section 5.

    Example:
        >>> x = ca.SX.sym("x", 2)
        >>> low, high = interval_bounds(ca.Function("f", [x], [x[0] * x[1] + ca.cos(x[0])]), [-1.0, 0.0], [1.0, 2.0])
        >>> low.round(6), high.round(6)
        (array([-1.459698]), array([3.]))
    """
    low, high = (np.asarray(v, dtype=float).reshape(-1) for v in (lower, upper))
    if low.size != f.numel_in(0) or high.size != low.size or not np.all(np.isfinite([low, high])):
        raise InputError(f"interval: {f.numel_in(0)} finite lower and upper bounds needed")
    if np.any(low > high):
        raise InputError(f"interval: lower bounds {low.tolist()} lie above upper ones {high.tolist()}")
    scalar = f if f.is_a("SXFunction") else f.expand()
    work: list[Interval] = [(0.0, 0.0)] * scalar.sz_w()
    result = np.zeros((2, scalar.numel_out(0)))
    for k in range(scalar.n_instructions()):
        op, into, at = scalar.instruction_id(k), scalar.instruction_output(k), scalar.instruction_input(k)
        if op == ca.OP_INPUT:
            work[into[0]] = float(low[at[1]]), float(high[at[1]])
        elif op == ca.OP_CONST:
            value = float(scalar.instruction_constant(k))
            work[into[0]] = value, value
        elif op == ca.OP_OUTPUT:
            result[:, into[1]] = work[at[0]]
        elif op in _RULES:
            work[into[0]] = _RULES[op](*(work[i] for i in at))
        else:
            raise InputError(f"interval: operation {op} of CasADi (casadi.OP_...) is not known here")
    return result[0], result[1]


def _times(a: Interval, b: Interval) -> Interval:
    ends = [p * q for p in a for q in b]
    return min(ends), max(ends)


def _inverse(a: Interval) -> Interval:
    if a[0] <= 0 <= a[1]:
        raise InputError(f"interval: division by a range {a} that holds zero; take a smaller box")
    return 1 / a[1], 1 / a[0]


def _square(a: Interval) -> Interval:
    ends = a[0] ** 2, a[1] ** 2
    return (0.0 if a[0] <= 0 <= a[1] else min(ends)), max(ends)


def _size(a: Interval) -> Interval:
    ends = abs(a[0]), abs(a[1])
    return (0.0 if a[0] <= 0 <= a[1] else min(ends)), max(ends)


def _cosine(a: Interval) -> Interval:
    low, high = min(np.cos(a)), max(np.cos(a))
    if np.floor(a[1] / (2 * np.pi)) > np.floor(a[0] / (2 * np.pi)) or a[0] == 0:
        high = 1.0
    if np.floor((a[1] - np.pi) / (2 * np.pi)) > np.floor((a[0] - np.pi) / (2 * np.pi)):
        low = -1.0
    return float(low), float(high)


def _rising(f: Callable[[float], float]) -> Callable[[Interval], Interval]:
    return lambda a: (float(f(a[0])), float(f(a[1])))


_RULES: Mapping[int, Callable[..., Interval]] = MappingProxyType(
    {
        ca.OP_ASSIGN: lambda a: a,
        ca.OP_ADD: lambda a, b: (a[0] + b[0], a[1] + b[1]),
        ca.OP_SUB: lambda a, b: (a[0] - b[1], a[1] - b[0]),
        ca.OP_NEG: lambda a: (-a[1], -a[0]),
        ca.OP_MUL: _times,
        ca.OP_DIV: lambda a, b: _times(a, _inverse(b)),
        ca.OP_INV: _inverse,
        ca.OP_TWICE: lambda a: (2 * a[0], 2 * a[1]),
        ca.OP_SQ: _square,
        ca.OP_FABS: _size,
        ca.OP_COS: _cosine,
        ca.OP_SIN: lambda a: _cosine((a[0] - np.pi / 2, a[1] - np.pi / 2)),
        ca.OP_TANH: _rising(np.tanh),
        ca.OP_EXP: _rising(np.exp),
        ca.OP_SQRT: _rising(np.sqrt),
        ca.OP_ATAN: _rising(np.arctan),
        ca.OP_FMAX: lambda a, b: (max(a[0], b[0]), max(a[1], b[1])),
        ca.OP_FMIN: lambda a, b: (min(a[0], b[0]), min(a[1], b[1])),
    }
)
