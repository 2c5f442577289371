"""Products, linear layers and normalisations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from nn_export.operators.elementwise import add, apply
from nn_export.operators.reduce import mean, sum_, var
from nn_export.operators.value import Value, arrange, concatenate, from_matrix, matrix, move, room


def matmul(a: Value, b: Value) -> Value:
    """Product of two matrices, or of two equally long stacks of matrices."""
    if a.shape[:-2] != b.shape[:-2] or a.shape[-1] != b.shape[-2]:
        raise ValueError(f"product of shapes {a.shape} and {b.shape} [NN-053]")
    room(*a.shape[:-1], b.shape[-1])
    stacks = []
    for value in (a, b):
        positions = value.positions.reshape(-1, *value.shape[-2:])
        stacks.append([arrange(value.mx, p) for p in positions])
    products = [
        from_matrix(ca.mtimes(x, y), (1, x.shape[0], y.shape[1])) for x, y in zip(*stacks, strict=True)
    ]
    joined = concatenate(products, 0)
    return move(joined, joined.positions.reshape((*a.shape[:-1], b.shape[-1])))


def mm(self: Value, mat2: Value) -> Value:
    """Matrix product."""
    return matmul(self, mat2)


def mv(self: Value, vec: Value) -> Value:
    """Matrix times vector."""
    return from_matrix(ca.mtimes(matrix(self, *self.shape), vec.mx), self.shape[:1])


def dot(self: Value, tensor: Value) -> Value:
    """Inner product of two vectors."""
    return from_matrix(ca.dot(self.mx, tensor.mx), ())


def addmm(self: Value, mat1: Value, mat2: Value, *, beta: float = 1, alpha: float = 1) -> Value:
    """``beta self + alpha mat1 mat2``."""
    return add(apply(lambda x: beta * x, self), matmul(mat1, mat2), alpha=alpha)


def addmv(self: Value, mat: Value, vec: Value, *, beta: float = 1, alpha: float = 1) -> Value:
    """``beta self + alpha mat vec``."""
    return add(apply(lambda x: beta * x, self), mv(mat, vec), alpha=alpha)


def linear(input: Value, weight: Value, bias: Value | None = None) -> Value:
    """``input weight' + bias`` on the last axis; one sample is kept as a column."""
    out, n = weight.shape
    rows = math.prod(input.shape[:-1])
    room(rows, out)
    w = matrix(weight, out, n)
    if rows == 1:
        result = from_matrix(ca.mtimes(w, matrix(input, n, 1)), (*input.shape[:-1], out))
    else:
        result = from_matrix(ca.mtimes(matrix(input, rows, n), w.T), (*input.shape[:-1], out))
    return result if bias is None else add(result, bias)


def layer_norm(
    input: Value,
    normalized_shape: Sequence[int],
    weight: Value | None = None,
    bias: Value | None = None,
    eps: float = 1e-5,
    cudnn_enable: bool = True,
) -> Value:
    """Last axes to mean 0 and variance 1, then scaled and shifted."""
    axes = list(range(-len(normalized_shape), 0))
    centred = add(input, mean(input, axes, True), alpha=-1)
    variance = mean(apply(lambda x: x * x, centred), axes, True)
    result = apply(lambda x, v: x / ca.sqrt(v + eps), centred, variance)
    result = result if weight is None else apply(lambda x, w: x * w, result, weight)
    return result if bias is None else add(result, bias)


def batch_norm(
    input: Value,
    weight: Value | None,
    bias: Value | None,
    running_mean: Value,
    running_var: Value,
    momentum: float,
    eps: float,
) -> tuple[Value, ...]:
    """Normalisation of axis 1 by stored statistics."""

    def channels(value: Value) -> Value:
        shape = (1, input.shape[1], *(1 for _ in input.shape[2:]))
        return Value(shape, value.mx)

    result = apply(
        lambda x, m, v: (x - m) / ca.sqrt(v + eps), input, channels(running_mean), channels(running_var)
    )
    result = result if weight is None else apply(lambda x, w: x * w, result, channels(weight))
    result = result if bias is None else add(result, channels(bias))
    empty = Value((0,), ca.MX.zeros(0, 1))
    return result, empty, empty


def trilinear(
    i1: Value,
    i2: Value,
    i3: Value,
    expand1: Sequence[int],
    expand2: Sequence[int],
    expand3: Sequence[int],
    sumdim: Sequence[int],
    unroll_dim: int = 1,
) -> Value:
    """Product of three tensors with new axes, summed over some: what ``nn.Bilinear`` is made of."""
    parts = []
    for value, axes in ((i1, expand1), (i2, expand2), (i3, expand3)):
        positions = value.positions
        for axis in sorted(axes):
            positions = np.expand_dims(positions, axis)
        parts.append(move(value, positions))
    return sum_(apply(lambda a, b, c: a * b * c, *parts), sumdim)


def group_norm(
    input: Value, weight: Value | None, bias: Value | None, N: int, C: int, HxW: int, group: int, eps: float
) -> tuple[Value, ...]:
    """Groups of channels to mean 0 and variance 1, then scaled and shifted by channel."""
    parts = move(input, input.positions.reshape(N, group, C // group * HxW))
    normed = layer_norm(parts, parts.shape[-1:], eps=eps)
    result = move(normed, normed.positions.reshape(input.shape))
    channels = (1, C, *(1 for _ in input.shape[2:]))
    if weight is not None:
        result = apply(lambda x, w: x * w, result, Value(channels, weight.mx))
    if bias is not None:
        result = add(result, Value(channels, bias.mx))
    centre, spread = mean(parts, [2]), var(parts, [2], correction=0)
    return result, centre, apply(lambda v: 1 / ca.sqrt(v + eps), spread)


OPERATORS: dict[str, Callable[..., Value | tuple[Value, ...]]] = {
    "aten.mm.default": mm, "aten.bmm.default": mm, "aten.mv.default": mv, "aten.dot.default": dot,
    "aten.addmm.default": addmm, "aten.addmv.default": addmv, "aten.linear.default": linear,
    "aten.layer_norm.default": layer_norm, "aten._trilinear.default": trilinear,
    "aten.native_group_norm.default": group_norm,
    "aten._native_batch_norm_legit_no_training.default": batch_norm,
}  # fmt: skip
