"""Tensors of any rank held as dense CasADi matrices.

A tensor is stored without its axes of size 1: none left is a 1 x 1 matrix, one of n a column n x 1, two a
matrix r x c; of more, which inputs and outputs cannot have, the last are the columns. Every movement of
data (slicing, reshaping, broadcasting ...) is one selection of elements, found by doing the movement on an
array of positions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nn_export.errors import ShapeError

Shape = tuple[int, ...]
LARGEST = 2**24
"""Numbers that one operator may make, whatever its file says of its results."""
UNROLLED = 2**13
"""Steps in which an operator may go along an axis."""
HUGE = 2**62
"""Where products stop: more than any limit, and far from numbers of a million digits."""


def matrix_shape(shape: Shape) -> tuple[int, int]:
    """Rows and columns of the matrix that holds a tensor of this shape."""
    if sum(n != 1 for n in shape) > 2:
        raise ShapeError(
            f"shape {shape} has more than two axes longer than 1; export one sample, not a batch [NN-065]"
        )
    return layout(shape)


def layout(shape: Shape) -> tuple[int, int]:
    """As :func:`matrix_shape`, for tensors inside a graph, which may have more axes."""
    kept = [n for n in shape if n != 1]
    if len(kept) > 2:
        return math.prod(kept[:-1]), kept[-1]
    rows, columns = (*kept, 1, 1)[:2]
    return rows, columns


def size_of(shape: Iterable[int]) -> int:
    """Numbers of a tensor, up to ``HUGE``; an axis of length 0 counts as 1: CasADi stores the others' all the same.

    Example:
        >>> size_of((3, 0, 4))
        12
    """
    total = 1
    for n in shape:
        if n > 1:
            total *= n
            if total > HUGE:
                return HUGE
    return total


def room(*shape: int) -> None:
    """Refuse a result of this shape before it is made, where it is too large for any program.

    Raises:
        ValueError: If it has more than ``LARGEST`` numbers.
    """
    if (size := size_of(shape)) > LARGEST:
        raise ValueError(
            f"the operator would make {size:.3g} numbers, at most {LARGEST} can be exported [NN-066]"
        )


def unrolled(steps: int) -> None:
    """Refuse to go along an axis in too many steps.

    Raises:
        ValueError: If there are more than ``UNROLLED``.
    """
    if steps > UNROLLED:
        raise ValueError(
            f"the operator would need {steps} steps, at most {UNROLLED} can be exported [NN-067]"
        )


@dataclass(frozen=True)
class Value:
    """A tensor: its torch shape and the dense matrix that holds it, of ``layout(shape)``."""

    shape: Shape
    mx: ca.MX

    def __post_init__(self) -> None:
        if self.mx.shape != layout(self.shape):
            raise ShapeError(f"shape {self.shape} does not fit a {self.mx.shape} matrix [NN-068]")
        if not self.mx.is_dense():
            object.__setattr__(self, "mx", ca.densify(self.mx))

    @property
    def positions(self) -> np.ndarray:
        """Column-major position of every element in ``mx``, in the tensor's shape."""
        rows, columns = self.mx.shape
        return np.arange(rows * columns).reshape((rows, columns), order="F").reshape(self.shape)


def constant(array: Any) -> Value:
    """The array as a constant value."""
    data = np.asarray(array, dtype=np.float64)
    rows, columns = layout(data.shape)
    return Value(data.shape, ca.MX(ca.DM(data.reshape(rows, columns))))


def lift(value: Value | float) -> Value:
    """A number becomes a constant, a value stays."""
    if isinstance(value, Value):
        return value
    if not isinstance(value, bool | int | float):
        raise TypeError(f"expected a tensor or a number, got {value!r} [NN-069]")
    return constant(float(value))


def arrange(mx: ca.MX, positions: np.ndarray) -> ca.MX:
    """Matrix (R, C) of the elements of ``mx`` at column-major ``positions`` (R, C)."""
    rows, columns = positions.shape
    flat = positions.flatten(order="F")
    if flat.size == 0:
        return ca.MX.zeros(rows, columns)
    if flat.size == mx.numel():
        if np.array_equal(flat, np.arange(flat.size)):
            return mx if mx.shape == (rows, columns) else ca.reshape(mx, rows, columns)
        if mx.shape == (columns, rows) and np.array_equal(positions.flatten(), np.arange(flat.size)):
            return mx.T
    return ca.reshape(mx.nz[flat.tolist()], rows, columns)


def move(value: Value, positions: np.ndarray) -> Value:
    """The tensor of ``value``'s elements at ``positions``, which have the new shape."""
    return Value(positions.shape, arrange(value.mx, positions.reshape(layout(positions.shape))))


def matrix(value: Value, rows: int, columns: int) -> ca.MX:
    """The elements, in row-major order, as a matrix of exactly this size."""
    return arrange(value.mx, value.positions.reshape(rows, columns))


def from_matrix(mx: ca.MX, shape: Shape) -> Value:
    """A tensor of this shape from a matrix whose row-major order it has. Inverse of :func:`matrix`."""
    mx = mx if mx.is_dense() else ca.densify(mx)
    positions = np.arange(mx.numel()).reshape(mx.shape, order="F")
    return Value(shape, arrange(mx, positions.reshape(shape).reshape(layout(shape))))


def broadcast_shape(shapes: Sequence[Sequence[int]]) -> Shape:
    """The shape to which tensors are repeated together, by the rules of torch."""
    if all(shape == shapes[0] for shape in shapes[1:]):
        return tuple(shapes[0]) if shapes else ()
    result = [1] * max(map(len, shapes))
    for shape in shapes:
        for i in range(1, len(shape) + 1):
            if result[-i] == 1:
                result[-i] = shape[-i]
            elif shape[-i] not in (1, result[-i]):
                raise ValueError(f"shapes {[tuple(s) for s in shapes]} cannot be broadcast together [NN-070]")
    return tuple(result)


def broadcast(value: Value, shape: Shape) -> Value:
    """The value repeated to a shape by the rules of torch."""
    if value.shape == shape:
        return value
    room(*shape)
    if value.mx.numel() == 1:
        return Value(shape, ca.repmat(value.mx, *layout(shape)))
    return move(value, np.broadcast_to(value.positions, shape))


def concatenate(values: list[Value], axis: int) -> Value:
    """Values joined along an axis; empty 1-D ones are skipped, as torch does."""
    kept = [v for v in values if v.shape != (0,)] or values[:1]
    offsets = np.cumsum([0] + [v.mx.numel() for v in kept])
    joined = np.concatenate([v.positions + o for v, o in zip(kept, offsets, strict=False)], axis=axis)
    column = ca.vertcat(*[ca.vec(v.mx) for v in kept])
    return Value(joined.shape, arrange(column, joined.reshape(layout(joined.shape))))


def numbers(value: Value) -> np.ndarray:
    """The numbers of a constant value, in its shape."""
    if ca.symvar(value.mx):
        raise ValueError("an index or size depends on an input; only constant ones can be exported [NN-071]")
    return np.array(ca.evalf(value.mx)).flatten(order="F")[value.positions]
