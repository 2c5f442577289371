"""Operators that move elements or make constants."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from nn_export.operators.value import Value, broadcast, concatenate, constant, lift, move, numbers

LONGEST = 2**31


def same(self: Value) -> Value:
    """The value itself."""
    return self


def slice_(
    self: Value, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1
) -> Value:
    """Part of an axis."""
    index: list[slice] = [slice(None)] * len(self.shape)
    index[dim] = slice(start, None if end is not None and end > LONGEST else end, step)
    return move(self, self.positions[tuple(index)])


def select(self: Value, dim: int, index: int) -> Value:
    """One entry of an axis, which disappears."""
    return move(self, np.asarray(self.positions.take(index, axis=dim)))


def unsqueeze(self: Value, dim: int) -> Value:
    """A new axis of size 1."""
    return move(self, np.expand_dims(self.positions, dim))


def squeeze(self: Value, dim: Sequence[int]) -> Value:
    """Drops those of the named axes that have size 1."""
    axes = tuple(d for d in dim if self.shape[d] == 1)
    return move(self, np.squeeze(self.positions, axis=axes))


def view(self: Value, size: Sequence[int]) -> Value:
    """The same elements in row-major order in another shape."""
    return move(self, self.positions.reshape(tuple(size)))


def permute(self: Value, dims: Sequence[int]) -> Value:
    """Axes in another order."""
    return move(self, self.positions.transpose(tuple(dims)))


def transpose(self: Value, dim0: int, dim1: int) -> Value:
    """Two axes exchanged."""
    return move(self, self.positions.swapaxes(dim0, dim1))


def t(self: Value) -> Value:
    """Transposed matrix."""
    return move(self, self.positions.T)


def expand(self: Value, size: Sequence[int]) -> Value:
    """Repeated along axes of size 1; -1 keeps an axis."""
    lead = len(size) - len(self.shape)
    return broadcast(self, tuple(self.shape[i - lead] if n == -1 else n for i, n in enumerate(size)))


def repeat(self: Value, repeats: Sequence[int]) -> Value:
    """Tiled."""
    return move(self, np.tile(self.positions, tuple(repeats)))


def flip(self: Value, dims: Sequence[int]) -> Value:
    """Axes turned round."""
    return move(self, np.flip(self.positions, tuple(dims)))


def diagonal(self: Value, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Value:
    """Diagonal of two axes."""
    return move(self, np.diagonal(self.positions, offset, dim1, dim2))


def index_select(self: Value, dim: int, index: Value) -> Value:
    """Entries of an axis by a constant list."""
    return move(self, self.positions.take(numbers(index).astype(int).reshape(-1), axis=dim))


def index(self: Value, indices: Sequence[Value | None]) -> Value:
    """Indexing by constant integer tensors."""
    key = tuple(slice(None) if i is None else numbers(i).astype(int) for i in indices)
    return move(self, self.positions[key])


def cat(tensors: Sequence[Value], dim: int = 0) -> Value:
    """Joined along an axis."""
    return concatenate(list(tensors), dim)


def stack(tensors: Sequence[Value], dim: int = 0) -> Value:
    """Joined along a new axis."""
    return concatenate([move(v, np.expand_dims(v.positions, dim)) for v in tensors], dim)


def split_with_sizes(self: Value, split_sizes: Sequence[int], dim: int = 0) -> tuple[Value, ...]:
    """Pieces of an axis."""
    return tuple(move(self, p) for p in np.split(self.positions, np.cumsum(split_sizes)[:-1], axis=dim))


def pad(self: Value, pad: Sequence[int], value: float = 0.0) -> Value:
    """A constant border; the pairs start from the last axis."""
    axes = list(zip(pad[::2], pad[1::2], strict=True))[::-1]
    widths = [(0, 0)] * (len(self.shape) - len(axes)) + axes
    if min(pad) < 0:
        raise ValueError(f"negative pad {list(pad)}")
    border = self.mx.numel()
    positions = np.pad(self.positions, widths, constant_values=border)
    flat = concatenate([view(self, [-1]), view(lift(value), [1])], 0)
    row_major = np.append(np.argsort(self.positions.reshape(-1)), border)
    return move(flat, row_major[positions])


def full(size: Sequence[int], fill_value: float, *, dtype: str = "float64") -> Value:
    """A constant tensor; a float32 one holds the number that float32 can."""
    number = float(np.float32(fill_value)) if dtype == "float32" else float(fill_value)
    return broadcast(constant(number), tuple(size))


def full_like(self: Value, fill_value: float, *, dtype: str = "float64") -> Value:
    """A constant tensor of another one's shape."""
    return full(self.shape, fill_value, dtype=dtype)


def scalar_tensor(s: float, *, dtype: str = "float64") -> Value:
    """A constant without axes."""
    return full((), s, dtype=dtype)


def arange(start: float, end: float, step: float = 1, *, dtype: str = "float64") -> Value:
    """Equally spaced numbers."""
    return constant(np.arange(start, end, step))


OPERATORS: dict[str, Callable[..., Value | tuple[Value, ...]]] = {
    "aten.alias.default": same, "aten.clone.default": same, "aten.detach.default": same,
    "aten.lift_fresh_copy.default": same, "aten.contiguous.default": same, "aten.slice.Tensor": slice_,
    "aten.select.int": select, "aten.unsqueeze.default": unsqueeze, "aten.squeeze.dims": squeeze,
    "aten.view.default": view, "aten.reshape.default": view, "aten._unsafe_view.default": view,
    "aten.permute.default": permute, "aten.transpose.int": transpose, "aten.t.default": t,
    "aten.expand.default": expand, "aten.repeat.default": repeat, "aten.flip.default": flip,
    "aten.diagonal.default": diagonal, "aten.index_select.default": index_select,
    "aten.index.Tensor": index, "aten.cat.default": cat, "aten.stack.default": stack,
    "aten.split_with_sizes.default": split_with_sizes, "aten.constant_pad_nd.default": pad,
    "aten.full.default": full, "aten.full_like.default": full_like,
    "aten.scalar_tensor.default": scalar_tensor, "aten.arange.start_step": arange,
}  # fmt: skip
