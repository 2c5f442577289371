"""Operators that reduce axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from itertools import accumulate

import casadi as ca
import numpy as np

from nn_export.operators.elementwise import add, apply
from nn_export.operators.value import Value, arrange, concatenate, from_matrix, move, room, unrolled


def reduced(f: Callable[[ca.MX], ca.MX], self: Value, dim: Sequence[int] | None, keepdim: bool) -> Value:
    """``f`` maps a matrix (kept, reduced) to a column (kept); no axes named means all."""
    rank = len(self.shape)
    axes = sorted({d % rank for d in dim}) if dim and rank else list(range(rank))
    kept = [i for i in range(rank) if i not in axes]
    count = math.prod(self.shape[i] for i in axes)
    rows = math.prod(self.shape[i] for i in kept)
    column = f(arrange(self.mx, self.positions.transpose(kept + axes).reshape(rows, count)))
    shape = tuple(1 if i in axes else n for i, n in enumerate(self.shape))
    return from_matrix(column, shape if keepdim else tuple(self.shape[i] for i in kept))


def _columns(x: ca.MX) -> list[ca.MX]:
    unrolled(x.shape[1])
    return ca.horzsplit(x) if x.shape[1] > 1 else [x]


def _largest(x: ca.MX) -> ca.MX:
    return reduce(ca.fmax, _columns(x))


def _smallest(x: ca.MX) -> ca.MX:
    return reduce(ca.fmin, _columns(x))


def _shared(x: ca.MX, best: ca.MX) -> ca.MX:
    """``best`` of the rows of ``x``, written as the mean of the elements that equal it."""
    if x.shape[1] == 1:
        return x
    mask = x == ca.repmat(best, 1, x.shape[1])
    count = ca.sum2(mask)
    return ca.sum2(ca.if_else(mask, x, 0.0)) / count


def _product(x: ca.MX) -> ca.MX:
    return reduce(lambda a, b: a * b, _columns(x))


def _root(x: ca.MX) -> ca.MX:  # square root with slope 0 at 0, as torch's norms have
    return ca.if_else(x > 0, ca.sqrt(ca.if_else(x > 0, x, 1.0)), 0.0)


def _power(x: ca.MX, e: float) -> ca.MX:  # slope 0 at 0
    return ca.if_else(x > 0, ca.if_else(x > 0, x, 1.0) ** e, 0.0)


def sum_(self: Value, dim: Sequence[int] | None = None, keepdim: bool = False) -> Value:
    """Sum over axes."""
    return reduced(ca.sum2, self, dim, keepdim)


def sum_all(self: Value) -> Value:
    """Sum over all axes."""
    return sum_(self)


def mean(self: Value, dim: Sequence[int] | None = None, keepdim: bool = False) -> Value:
    """Mean over axes."""
    return reduced(lambda x: ca.sum2(x) / x.shape[1], self, dim, keepdim)


def var(
    self: Value, dim: Sequence[int] | None = None, *, correction: float = 1, keepdim: bool = False
) -> Value:
    """Variance over axes with ``n - correction`` in the denominator."""

    def f(x: ca.MX) -> ca.MX:
        n = x.shape[1]
        d = x - ca.repmat(ca.sum2(x) / n, 1, n)
        return ca.sum2(d * d) / (n - correction)

    return reduced(f, self, dim, keepdim)


def std(
    self: Value, dim: Sequence[int] | None = None, *, correction: float = 1, keepdim: bool = False
) -> Value:
    """Standard deviation over axes, with slope 0 where it is 0, as in torch."""
    return apply(_root, var(self, dim, correction=correction, keepdim=keepdim))


def amax(self: Value, dim: Sequence[int] = (), keepdim: bool = False) -> Value:
    """Largest over axes; equal ones share the slope, as in torch."""
    return reduced(lambda x: _shared(x, _largest(x)), self, dim, keepdim)


def amin(self: Value, dim: Sequence[int] = (), keepdim: bool = False) -> Value:
    """Smallest over axes; equal ones share the slope, as in torch."""
    return reduced(lambda x: _shared(x, _smallest(x)), self, dim, keepdim)


def max_all(self: Value) -> Value:
    """Largest of all."""
    return amax(self)


def min_all(self: Value) -> Value:
    """Smallest of all."""
    return amin(self)


def prod(self: Value) -> Value:
    """Product of all."""
    return reduced(_product, self, None, False)


def prod_dim(self: Value, dim: int, keepdim: bool = False) -> Value:
    """Product over one axis."""
    return reduced(_product, self, [dim], keepdim)


def norm(self: Value, ord: float = 2, dim: Sequence[int] | None = None, keepdim: bool = False) -> Value:
    """Vector norm of order 1 or above, infinity, or minus infinity."""
    if ord == 2:
        return reduced(lambda x: _root(ca.sum2(x * x)), self, dim, keepdim)
    if ord == 1:
        return reduced(lambda x: ca.sum2(ca.fabs(x)), self, dim, keepdim)
    if ord == math.inf:
        return reduced(lambda x: _largest(ca.fabs(x)), self, dim, keepdim)
    if ord == -math.inf:
        return reduced(lambda x: _smallest(ca.fabs(x)), self, dim, keepdim)
    if ord > 1:
        return reduced(lambda x: _power(ca.sum2(ca.fabs(x) ** ord), 1 / ord), self, dim, keepdim)
    raise ValueError(f"norm of order {ord}; supported are -infinity, 1, and numbers above 1 [NN-056]")


def std_dim(self: Value, dim: Sequence[int] | None, unbiased: bool = True, keepdim: bool = False) -> Value:
    """Standard deviation over axes."""
    return std(self, dim, correction=1 if unbiased else 0, keepdim=keepdim)


def var_mean(
    self: Value, dim: Sequence[int] | None = None, *, correction: float = 1, keepdim: bool = False
) -> tuple[Value, Value]:
    """Variance and mean over axes."""
    return var(self, dim, correction=correction, keepdim=keepdim), mean(self, dim, keepdim)


def std_mean(
    self: Value, dim: Sequence[int] | None, unbiased: bool = True, keepdim: bool = False
) -> tuple[Value, Value]:
    """Standard deviation and mean over axes."""
    return std_dim(self, dim, unbiased, keepdim), mean(self, dim, keepdim)


def _first(better: Callable[[ca.MX, ca.MX], ca.MX]) -> Callable[..., tuple[Value, Value]]:
    def operator(self: Value, dim: int, keepdim: bool = False) -> tuple[Value, Value]:
        def f(x: ca.MX, position: bool) -> ca.MX:
            parts = _columns(x)
            best, at = parts[0], ca.MX.zeros(x.shape[0], 1)
            for k, part in enumerate(parts[1:], 1):
                taken = better(part, best)
                best, at = ca.if_else(taken, part, best), ca.if_else(taken, float(k), at)
            return at if position else best

        values = reduced(lambda x: f(x, False), self, [dim], keepdim)
        return values, reduced(lambda x: f(x, True), self, [dim], keepdim)

    return operator


def any_(self: Value, dim: Sequence[int] | int | None = None, keepdim: bool = False) -> Value:
    """True where one is not zero."""
    axes = [dim] if isinstance(dim, int) else dim
    return reduced(lambda x: reduce(ca.logic_or, [c != 0 for c in _columns(x)]), self, axes, keepdim)


def dist(self: Value, other: Value, p: float = 2) -> Value:
    """Norm of a difference."""
    return norm(add(self, other, alpha=-1), p)


def logsumexp(self: Value, dim: Sequence[int], keepdim: bool = False) -> Value:
    """``log sum exp`` without overflow."""

    def f(x: ca.MX) -> ca.MX:
        top = _largest(x)
        return top + ca.log(ca.sum2(ca.exp(x - ca.repmat(top, 1, x.shape[1]))))

    return reduced(f, self, dim, keepdim)


def log_softmax(self: Value, dim: int, half_to_float: bool) -> Value:
    """Logarithm of the softmax of an axis."""
    if half_to_float:
        raise ValueError("half_to_float=True [NN-057]")
    return apply(lambda x, s: x - s, self, logsumexp(self, [dim], True))


def softmax(self: Value, dim: int, half_to_float: bool) -> Value:
    """Softmax of an axis."""
    top = amax(self, [dim], True)
    e = apply(lambda x, m: ca.exp(x - m), self, top)
    if half_to_float:
        raise ValueError("half_to_float=True [NN-058]")
    return apply(lambda a, s: a / s, e, sum_(e, [dim], True))


def cumprod(self: Value, dim: int) -> Value:
    """Running product along an axis."""
    if not self.shape:
        return self
    unrolled(self.shape[dim])
    parts = [move(self, self.positions.take([k], axis=dim)) for k in range(self.shape[dim])]
    return concatenate(list(accumulate(parts, lambda a, b: apply(lambda x, y: x * y, a, b))), dim)


def cumsum(self: Value, dim: int) -> Value:
    """Running sum along an axis."""
    if not self.shape:
        return self
    last = np.moveaxis(self.positions, dim, -1)
    n = last.shape[-1]
    room(n, n)
    x = arrange(self.mx, last.reshape(-1, n))
    sums = from_matrix(ca.mtimes(x, ca.MX(ca.DM(np.triu(np.ones((n, n)))))), last.shape)
    return Value(self.shape, arrange(sums.mx, _back(sums, dim, self.mx.shape)))


def _back(value: Value, dim: int, size: tuple[int, int]) -> np.ndarray:
    return np.moveaxis(value.positions, -1, dim).reshape(size)


OPERATORS: dict[str, Callable[..., Value | tuple[Value, ...]]] = {
    "aten.sum.default": sum_all, "aten.sum.dim_IntList": sum_, "aten.mean.dim": mean,
    "aten.mean.default": mean, "aten.var.correction": var, "aten.std.correction": std,
    "aten.amax.default": amax,
    "aten.amin.default": amin, "aten.max.default": max_all, "aten.min.default": min_all,
    "aten.prod.default": prod, "aten.prod.dim_int": prod_dim, "aten.linalg_vector_norm.default": norm,
    "aten.logsumexp.default": logsumexp, "aten._softmax.default": softmax,
    "aten._log_softmax.default": log_softmax, "aten.cumsum.default": cumsum,
    "aten.cumprod.default": cumprod, "aten.std.dim": std_dim, "aten.var_mean.correction": var_mean,
    "aten.std_mean.dim": std_mean,
    "aten.max.dim": _first(lambda a, b: a > b), "aten.min.dim": _first(lambda a, b: a < b),
    "aten.any.default": any_, "aten.any.dim": any_, "aten.any.dims": any_, "aten.dist.default": dist,
}  # fmt: skip
