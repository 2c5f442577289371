"""Operators that move elements or make constants."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import zip_longest

import numpy as np

from nn_export.operators.value import Value, broadcast, concatenate, constant, lift, move, numbers, room

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


def squeeze(self: Value, dim: int | Sequence[int]) -> Value:
    """Drops those of the named axes that have size 1."""
    axes = tuple(d for d in ([dim] if isinstance(dim, int) else dim) if self.shape[d] == 1)
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
    room(self.mx.numel(), *repeats)
    return move(self, np.tile(self.positions, tuple(repeats)))


def flip(self: Value, dims: Sequence[int]) -> Value:
    """Axes turned round."""
    return move(self, np.flip(self.positions, tuple(dims)))


def diagonal(self: Value, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Value:
    """Diagonal of two axes."""
    return move(self, np.diagonal(self.positions, offset, dim1, dim2))


def index_select(self: Value, dim: int, index: Value) -> Value:
    """Entries of an axis by a constant list."""
    room(index.mx.numel(), self.mx.numel() // max(self.shape[dim], 1))
    return move(self, self.positions.take(numbers(index).astype(int).reshape(-1), axis=dim))


def index(self: Value, indices: Sequence[Value | None]) -> Value:
    """Indexing by constant integer tensors."""
    return move(self, self.positions[_key(self, indices)])


def _key(self: Value, indices: Sequence[Value | None]) -> tuple[slice | np.ndarray, ...]:
    """Constant indices as NumPy takes them."""
    chosen = np.broadcast_shapes(*(i.shape for i in indices if i is not None))
    whole = [n for n, i in zip_longest(self.shape, indices) if n is not None and i is None]
    room(*chosen, *whole)
    return tuple(slice(None) if i is None else numbers(i).astype(int) for i in indices)


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
        raise ValueError(f"negative pad {list(pad)} [NN-059]")
    room(*(n + sum(width) for n, width in zip(self.shape, widths, strict=False)))
    border = self.mx.numel()
    positions = np.pad(self.positions, widths, constant_values=border)
    flat = concatenate([view(self, [-1]), view(lift(value), [1])], 0)
    row_major = np.append(np.argsort(self.positions.reshape(-1)), border)
    return move(flat, row_major[positions])


def unfold(self: Value, dimension: int, size: int, step: int) -> Value:
    """Windows of an axis, as a new last axis."""
    p = np.lib.stride_tricks.sliding_window_view(self.positions, size, axis=dimension)
    room(*p.shape)
    axis = dimension % len(self.shape)
    return move(self, p[(slice(None),) * axis + (slice(None, None, step),)])


def gather(self: Value, dim: int, index: Value) -> Value:
    """Entries of an axis by a constant tensor of positions."""
    chosen = numbers(index).astype(int)
    at: list[np.ndarray] = list(np.indices(chosen.shape))
    at[dim] = chosen
    return move(self, self.positions[tuple(at)])


def embedding(weight: Value, indices: Value, padding_idx: int = -1) -> Value:
    """Rows by constant positions."""
    room(*indices.shape, *weight.shape[1:])
    return move(weight, weight.positions[numbers(indices).astype(int)])


def _written(self: Value, where: np.ndarray, src: Value) -> Value:
    """``self`` with the elements marked by their flat positions in ``where`` taken from ``src``."""
    source = broadcast(src, where.shape)
    flat = concatenate([view(self, [-1]), view(source, [-1])], 0)
    chosen = np.arange(math.prod(self.shape))
    chosen[where.reshape(-1)] = chosen.size + np.arange(where.size)
    return move(flat, chosen.reshape(self.shape))


def _places(self: Value) -> np.ndarray:
    return np.arange(math.prod(self.shape)).reshape(self.shape)


def _each_once(where: np.ndarray) -> np.ndarray:
    if np.unique(where).size < where.size:
        raise ValueError("a position is written twice; the result would depend on the order [NN-060]")
    return where


def slice_scatter(
    self: Value, src: Value, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1
) -> Value:
    """A copy with part of an axis replaced."""
    key: list[slice] = [slice(None)] * len(self.shape)
    key[dim] = slice(start, None if end is not None and end > LONGEST else end, step)
    return _written(self, _places(self)[tuple(key)], src)


def select_scatter(self: Value, src: Value, dim: int, index: int) -> Value:
    """A copy with one entry of an axis replaced."""
    return _written(self, np.asarray(_places(self).take(index, axis=dim)), src)


def index_put(self: Value, indices: Sequence[Value | None], values: Value) -> Value:
    """A copy with elements at constant positions replaced, each at most once."""
    key = _key(self, indices)
    return _written(self, _each_once(_places(self)[key]), values)


def scatter(self: Value, dim: int, index: Value, src: Value) -> Value:
    """A copy with entries of an axis at constant positions replaced, each at most once."""
    chosen = numbers(index).astype(int)
    at: list[np.ndarray] = list(np.indices(chosen.shape))
    at[dim] = chosen
    where = _each_once(_places(self)[tuple(at)])
    cut = tuple(slice(n) for n in chosen.shape)
    return _written(self, where, move(src, src.positions[cut]))


def overwrite(self: Value, src: Value) -> Value:
    """``src`` in the shape of ``self``."""
    return broadcast(src, self.shape)


def empty(size: Sequence[int], *, dtype: str = "float64") -> Value:
    """Memory that was not written yet: NaN, so that what is never written shows."""
    return broadcast(constant(math.nan), tuple(size))


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
    """Equally spaced numbers; in float32 only those that float32 holds exactly."""
    room(max(0, math.ceil((end - start) / step)))
    values = np.arange(start, end, step)
    if dtype == "float32" and np.any(values.astype(np.float32) != values):
        raise ValueError("arange in float32; use dtype=torch.float64 there [NN-061]")
    return constant(values)


OPERATORS: dict[str, Callable[..., Value | tuple[Value, ...]]] = {
    "aten.alias.default": same, "aten.clone.default": same, "aten.detach.default": same,
    "aten.lift_fresh_copy.default": same, "aten.contiguous.default": same, "aten.slice.Tensor": slice_,
    "aten.select.int": select, "aten.unsqueeze.default": unsqueeze, "aten.squeeze.dims": squeeze,
    "aten.squeeze.dim": squeeze,
    "aten.view.default": view, "aten.reshape.default": view, "aten._unsafe_view.default": view,
    "aten.permute.default": permute, "aten.transpose.int": transpose, "aten.t.default": t,
    "aten.expand.default": expand, "aten.repeat.default": repeat, "aten.flip.default": flip,
    "aten.diagonal.default": diagonal, "aten.index_select.default": index_select,
    "aten.index.Tensor": index, "aten.cat.default": cat, "aten.stack.default": stack,
    "aten.split_with_sizes.default": split_with_sizes, "aten.constant_pad_nd.default": pad,
    "aten.full.default": full, "aten.full_like.default": full_like,
    "aten.scalar_tensor.default": scalar_tensor, "aten.arange.start_step": arange,
    "aten.unfold.default": unfold, "aten.gather.default": gather, "aten.embedding.default": embedding,
    "aten.slice_scatter.default": slice_scatter, "aten.select_scatter.default": select_scatter,
    "aten.index_put.default": index_put, "aten.scatter.src": scatter, "aten.copy.default": overwrite,
    "aten.empty.memory_format": empty,
}  # fmt: skip
