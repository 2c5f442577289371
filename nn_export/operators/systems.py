"""Systems of a few linear equations, as mass matrices give them: solutions, inverses, determinants, factors."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import casadi as ca

from nn_export.operators.shape import transpose
from nn_export.operators.value import Value, arrange, concatenate, from_matrix, move

MOST = 8
"""Rows of a matrix at most. Elimination is written out in scalars, some n^3 of them, whose derivatives are exact."""


def stacks(value: Value) -> list[ca.MX]:
    """The matrices of the last two axes, one after the other."""
    return [arrange(value.mx, p) for p in value.positions.reshape(-1, *value.shape[-2:])]


def each(f: Callable[..., Any], *values: Value) -> Value:
    """A function of matrices, applied to each of equally long stacks of them."""
    lead = values[0].shape[:-2]
    if any(v.shape[:-2] != lead for v in values):
        raise ValueError(
            f"matrices of shapes {[v.shape for v in values]}: equal numbers of matrices are needed [NN-062]"
        )
    found = [f(*parts) for parts in zip(*map(stacks, values), strict=True)]
    joined = concatenate([from_matrix(m, (1, *m.shape)) for m in found], 0)
    return move(joined, joined.positions.reshape((*lead, *found[0].shape)))


def _rows(value: Value) -> int:
    n = value.shape[-1]
    if len(value.shape) < 2 or value.shape[-2] != n:
        raise ValueError(f"a square matrix is needed, got one of shape {value.shape} [NN-063]")
    if not 0 < n <= MOST:
        raise ValueError(f"a matrix of {n} rows; 1 to {MOST} can be exported [NN-064]")
    return n


@lru_cache(maxsize=64)
def elimination(n: int, columns: int) -> ca.Function:
    """Solution ``(n, columns)`` and determinant of ``A x = b``, by elimination with row pivots."""
    a, b = ca.SX.sym("a", n, n), ca.SX.sym("b", n, columns)
    rows, det = [list(ca.horzsplit(ca.horzcat(a, b)[i, :])) for i in range(n)], ca.SX(1)
    for k in range(n):
        for i in range(k + 1, n):  # the row with the largest element comes up, as it is found
            swap = ca.fabs(rows[i][k]) > ca.fabs(rows[k][k])
            both = list(zip(rows[k], rows[i], strict=True))
            rows[k] = [ca.if_else(swap, below, above) for above, below in both]
            rows[i] = [ca.if_else(swap, above, below) for above, below in both]
            det *= ca.if_else(swap, -1, 1)
        det *= rows[k][k]
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [y - factor * x for x, y in zip(rows[k], rows[i], strict=True)]
    upper = ca.vertcat(*[ca.horzcat(*row) for row in rows])
    x = _substituted(upper[:, :n], upper[:, n:], upper=True, unit=False)
    return ca.Function(f"elimination_{n}_{columns}", [a, b], [x, det], ["a", "b"], ["x", "det"])


def _substituted(a: ca.SX, b: ca.SX, *, upper: bool, unit: bool) -> ca.SX:
    """Solution of a triangular system."""
    n, found = a.shape[0], dict[int, ca.SX]()
    for i in reversed(range(n)) if upper else range(n):
        rest = b[i, :]
        for j, x in found.items():
            rest -= a[i, j] * x
        found[i] = rest if unit else rest / a[i, i]
    return ca.densify(ca.vertcat(*[found[i] for i in range(n)]))


@lru_cache(maxsize=64)
def substitution(n: int, columns: int, upper: bool, unit: bool) -> ca.Function:
    """Solution of a triangular system."""
    a, b = ca.SX.sym("a", n, n), ca.SX.sym("b", n, columns)
    x = _substituted(a, b, upper=upper, unit=unit)
    return ca.Function(f"substitution_{n}_{columns}", [a, b], [x], ["a", "b"], ["x"])


@lru_cache(maxsize=64)
def factorization(n: int) -> ca.Function:
    """Lower Cholesky factor of a symmetric matrix; its derivatives are those of the symmetric part, as in torch."""
    given, l = ca.SX.sym("a", n, n), [[ca.SX(0)] * n for _ in range(n)]  # noqa: E741
    a = (given + given.T) / 2
    for j in range(n):
        l[j][j] = ca.sqrt(a[j, j] - sum((v**2 for v in l[j][:j]), ca.SX(0)))
        for i in range(j + 1, n):
            l[i][j] = (a[i, j] - sum((x * y for x, y in zip(l[i][:j], l[j][:j], strict=True)), ca.SX(0))) / l[
                j
            ][j]
    factor = ca.densify(ca.vertcat(*[ca.horzcat(*row) for row in l]))
    return ca.Function(f"cholesky_{n}", [given], [factor], ["a"], ["l"])


def solve(A: Value, B: Value, *, left: bool = True) -> Value:
    """Solution of ``A x = B``, or of ``x A = B``; of a singular matrix infinite or no number."""
    n = _rows(A)
    if not left:
        turned = solve(transpose(A, -2, -1), transpose(B, -2, -1))
        return transpose(turned, -2, -1)
    if B.shape == A.shape[:-1]:  # vectors
        columns = solve(A, move(B, B.positions[..., None]))
        return move(columns, columns.positions[..., 0])
    return each(lambda a, b: elimination(n, b.shape[1])(a, b)[0], A, B)


def inv(A: Value) -> Value:
    """Inverse of a square matrix; of a singular one infinite or no number."""
    n = _rows(A)
    return each(lambda a: elimination(n, n)(a, ca.MX.eye(n))[0], A)


def det(A: Value) -> Value:
    """Determinant."""
    n = _rows(A)
    found = each(lambda a: elimination(n, 0)(a, ca.MX(n, 0))[1], A)
    return move(found, found.positions.reshape(A.shape[:-2]))


def cholesky(self: Value, *, upper: bool = False) -> Value:
    """Cholesky factor of a symmetric positive definite matrix, lower or upper."""
    n = _rows(self)
    return each(lambda a: factorization(n)(a).T if upper else factorization(n)(a), self)


def cholesky_solve(self: Value, input2: Value, upper: bool = False) -> Value:
    """Solution of ``A x = self``, given the Cholesky factor ``input2`` of ``A``."""
    n = _rows(input2)

    def one(b: ca.MX, factor: ca.MX) -> Any:
        lower = factor.T if upper else factor
        return substitution(n, b.shape[1], True, False)(
            lower.T, substitution(n, b.shape[1], False, False)(lower, b)
        )

    return each(one, self, input2)


def cholesky_inverse(self: Value, upper: bool = False) -> Value:
    """Inverse of ``A``, given its Cholesky factor."""
    n = _rows(self)

    def one(factor: ca.MX) -> Any:
        lower = factor.T if upper else factor
        half = substitution(n, n, False, False)(lower, ca.MX.eye(n))
        return half.T @ half

    return each(one, self)


def solve_triangular(
    self: Value, B: Value, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> Value:
    """Solution of ``A x = B``, or of ``x A = B``, with a triangular ``A``."""
    n = _rows(self)
    if not left:
        turned = solve_triangular(
            transpose(self, -2, -1), transpose(B, -2, -1), upper=not upper, unitriangular=unitriangular
        )
        return transpose(turned, -2, -1)
    return each(lambda a, b: substitution(n, b.shape[1], upper, unitriangular)(a, b), self, B)


OPERATORS: dict[str, Callable[..., Value]] = {
    "aten.linalg_solve.default": solve, "aten.linalg_inv.default": inv, "aten.linalg_det.default": det,
    "aten.linalg_cholesky.default": cholesky, "aten.cholesky_solve.default": cholesky_solve,
    "aten.cholesky_inverse.default": cholesky_inverse, "aten.linalg_solve_triangular.default": solve_triangular,
}  # fmt: skip
