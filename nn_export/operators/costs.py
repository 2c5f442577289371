"""What each operator costs, from the shapes of its arguments alone: nothing is built to find out.

A rule takes the operator's own arguments, with a :class:`Tensor` for every value, and ``out``, the numbers in the
results that the program declares. Its :class:`Cost` is a bound from above. What one operator may allocate
(``elements``) never follows from ``out``: a damaged file may understate it, and a result of another shape is refused
only after it was made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from math import ceil
from typing import Any, NamedTuple

from nn_export.operators import elementwise, systems
from nn_export.operators.value import broadcast_shape

HUGE = 2**62
"""Where products stop: more than any limit, and far from numbers of a million digits."""
NUMBER = 8  # bytes
MOVE = 64
"""Work of one element that is moved: its position goes through a list of Python's."""
REPEATED = 200  # bytes of an element that a scalar is repeated to
STEP = 600
"""Nodes of one step of a recurrent cell of one sample: two functions are made for it."""


class Cost(NamedTuple):
    """What an operator or a program costs.

    Args:
        elements: Numbers in the largest array on the way.
        memory: Bytes that stay: constants, positions, results.
        work: Elements that are touched while the graph is made and evaluated once.
        nodes: Operations of CasADi's graph.
        cut: True if its results are symbols in the further graph: what is behind them is not visited from there.
        again: Values that are visited again with all that they are made from, and how often: expressions that are cut
            out as pieces, positions that are worked out.
    """

    elements: int
    memory: int
    work: int
    nodes: int
    cut: bool = False
    again: tuple[tuple[Tensor, int], ...] = ()


@dataclass(slots=True)
class Tensor:
    """What is known of a value before it is there.

    Args:
        shape: Its shape.
        size: Its numbers, an axis of length 0 counted as 1: CasADi stores the lengths of the others all the same.
        constant: True if it depends on no input.
        work: Work of everything that it is made from.
        nodes: Nodes of its expression, from the last cut on (the results of a cell are cuts).
    """

    shape: tuple[int, ...]
    size: int
    constant: bool
    work: int = 0
    nodes: int = 0


SCALAR = Tensor((), 1, True)
Rule = Callable[..., Cost]


def product(lengths: Iterable[int]) -> int:
    """Product of the lengths that are not 0, up to :data:`HUGE`."""
    total = 1
    for n in lengths:
        if n > 1:
            total *= n
            if total > HUGE:
                break
    return total


def _moved(out: int, given: int, nodes: int = 12, times: int = 1) -> Cost:
    """``out`` elements chosen among ``given``, some times."""
    return Cost(max(out, given), times * 2 * NUMBER * out, times * (2 * given + MOVE * out), nodes)


def _sum(*costs: Cost) -> Cost:
    elements, memory, work, nodes, cut, again = zip(*costs, strict=True)
    return Cost(
        max(elements), sum(memory), sum(work), sum(nodes), any(cut), tuple(chain.from_iterable(again))
    )


# Element by element


def _pointwise(nodes: int) -> Rule:
    def rule(out: int, *args: Any, **kwargs: Any) -> Cost:
        return _together([a for a in (*args, *kwargs.values()) if type(a) is Tensor], nodes)

    return rule


def _together(tensors: Sequence[Tensor], nodes: int) -> Cost:
    """Operations of tensors that are repeated to a common shape."""
    n = tensors[0].size if tensors else 1
    for t in tensors:
        if t.shape != tensors[0].shape:
            result = broadcast_shape([t.shape for t in tensors])
            n = product(result)
            own = Cost(n, NUMBER * n, n * nodes, nodes)
            return _sum(own, *[_spread(n, t) for t in tensors if t.shape != result])
    return Cost(n, NUMBER * n, n * nodes, nodes)


def _spread(out: int, given: Tensor) -> Cost:
    """A tensor repeated to ``out`` elements."""
    if given.size > 1:
        return _moved(out, given.size, 4)
    return Cost(out, REPEATED * out, MOVE * out, 4 + out // 16)  # the graph has a branch for each element


# Moving elements, constants


def _same(out: int, self: Tensor) -> Cost:
    return Cost(self.size, 0, 0, 2)


def _part(out: int, self: Tensor, *args: Any, **kwargs: Any) -> Cost:
    return _moved(min(out, self.size), self.size)._replace(elements=self.size)


def _view(out: int, self: Tensor, size: Sequence[int]) -> Cost:
    n = max(self.size, product(size))  # of nothing there may be views of any shape
    return _moved(min(out, n), self.size)._replace(elements=n)


def _expand(out: int, self: Tensor, size: Sequence[int]) -> Cost:
    lead = len(size) - len(self.shape)
    return _spread(product(self.shape[i - lead] if n == -1 else n for i, n in enumerate(size)), self)


def _repeat(out: int, self: Tensor, repeats: Sequence[int]) -> Cost:
    return _moved(self.size * product(repeats), self.size)


def _rest(self: Tensor, dim: int) -> int:
    """Elements of one entry of an axis."""
    if not self.shape:
        return 1
    return product(self.shape) // max(self.shape[dim], 1)


def _constants(*values: Tensor | None) -> Cost:
    """Values that are worked out while the graph is made."""
    given = [v for v in values if v is not None]
    return Cost(0, 0, sum(8 * v.size for v in given), 0, False, tuple((v, 1) for v in given))


def _index_select(out: int, self: Tensor, dim: int, index: Tensor) -> Cost:
    return _sum(_moved(_rest(self, dim) * index.size, self.size), _constants(index))


def _indexed(self: Tensor, indices: Sequence[Tensor | None]) -> int:
    """Elements at the positions that index tensors give."""
    together = product(broadcast_shape([i.shape for i in indices if i is not None]))
    whole = [i is None for i in indices] + [True] * (len(self.shape) - len(indices))
    return together * product(n for n, kept in zip(self.shape, whole, strict=False) if kept)


def _index(out: int, self: Tensor, indices: Sequence[Tensor | None]) -> Cost:
    return _sum(_moved(_indexed(self, indices), self.size, 12 + len(indices)), _constants(*indices))


def _cat(out: int, tensors: Sequence[Tensor], dim: int = 0) -> Cost:
    total = sum(t.size for t in tensors)
    return _moved(total, total, 12 + 8 * len(tensors), times=2)


def _split(out: int, self: Tensor, split_sizes: Sequence[int], dim: int = 0) -> Cost:
    if min(split_sizes, default=0) < 0 or sum(split_sizes) != self.shape[dim]:
        raise ValueError(f"an axis of {self.shape[dim]} in pieces of {list(split_sizes)!s:.60}")
    # Empty pieces too have the other axes.
    return _moved(self.size + len(split_sizes) * _rest(self, dim), self.size, 12 * (1 + len(split_sizes)))


def _pad(out: int, self: Tensor, pad: Sequence[int], value: float = 0.0) -> Cost:
    widths = [a + b for a, b in zip(pad[::2], pad[1::2], strict=True)]
    lengths = [0] * (len(widths) - len(self.shape)) + list(self.shape)
    for i, width in enumerate(widths, 1):
        lengths[-i] += max(width, 0)
    return _sum(_moved(product(lengths), self.size), _moved(self.size + 1, self.size, 24, times=2))


def _unfold(out: int, self: Tensor, dimension: int, size: int, step: int) -> Cost:
    if size < 0 or step < 1:
        raise ValueError(f"windows of size {size} with step {step}")
    windows = max(self.shape[dimension] - size, 0) // step + 1
    return _moved(_rest(self, dimension) * windows * max(size, 1), self.size)


def _gathered(self: Tensor, index: Tensor) -> int:
    return index.size * product(self.shape[len(index.shape) :])


def _gather(out: int, self: Tensor, dim: int, index: Tensor) -> Cost:
    positions = index.size * max(len(index.shape), 1)  # one array an axis
    return _sum(
        _moved(_gathered(self, index), self.size), _constants(index), Cost(positions, 0, 2 * positions, 0)
    )


def _embedding(out: int, weight: Tensor, indices: Tensor, padding_idx: int = -1) -> Cost:
    return _sum(_moved(indices.size * product(weight.shape[1:]), weight.size), _constants(indices))


def _written(self: Tensor, places: int, src: Tensor) -> Cost:
    """``self`` with ``places`` taken from ``src``: both repeated, joined and chosen from."""
    whole = _moved(self.size + places, max(self.size, src.size), 48, times=3)
    return _sum(whole, _spread(places, src)) if src.size == 1 else whole


def _part_written(out: int, self: Tensor, src: Tensor, *args: Any, **kwargs: Any) -> Cost:
    return _written(self, self.size, src)


def _index_put(out: int, self: Tensor, indices: Sequence[Tensor | None], values: Tensor) -> Cost:
    return _sum(_written(self, _indexed(self, indices), values), _constants(*indices))


def _scatter(out: int, self: Tensor, dim: int, index: Tensor, src: Tensor) -> Cost:
    return _sum(_written(self, _gathered(self, index), src), _gather(out, self, dim, index), _part(out, src))


def _copy(out: int, self: Tensor, src: Tensor) -> Cost:
    return _spread(self.size, src)


def _full(out: int, size: Sequence[int], *args: Any, **kwargs: Any) -> Cost:
    return _spread(product(size), SCALAR)


def _full_like(out: int, self: Tensor, *args: Any, **kwargs: Any) -> Cost:
    return _spread(self.size, SCALAR)


def _scalar(out: int, s: float, **kwargs: Any) -> Cost:
    return _moved(1, 1)


def _arange(out: int, start: float, end: float, step: float = 1, **kwargs: Any) -> Cost:
    return _moved(max(ceil((end - start) / step), 0) + 1, 1)


# Reductions


def _axes(self: Tensor, dim: Any) -> int:
    """Elements that are reduced to one."""
    rank = len(self.shape)
    if not rank or dim is None or dim == []:
        return product(self.shape)
    return product(self.shape[d] for d in {d % rank for d in ([dim] if isinstance(dim, int) else dim)})


def _reduced(nodes: int, column: int = 0) -> Rule:
    """A reduction of ``nodes`` operations of all, and ``column`` of them for each element that is reduced."""

    def rule(out: int, self: Tensor, dim: Any = None, *args: Any, **kwargs: Any) -> Cost:
        count = _axes(self, dim) if column else 0
        inner = Cost(
            self.size, 6 * NUMBER * self.size, (nodes + 2 * column) * self.size, nodes + column * count
        )
        return _sum(_moved(self.size, self.size, times=2), inner)

    return rule


def _norm(out: int, self: Tensor, ord: float = 2, *args: Any, **kwargs: Any) -> Cost:
    return _reduced(24, 6)(out, self, *args, **kwargs)


def _dist(out: int, self: Tensor, other: Tensor, p: float = 2) -> Cost:
    difference = _together([self, other], 12)
    n = difference.elements
    return _sum(difference, _reduced(24, 6)(out, Tensor((n,), n, False)))


def _softmax(out: int, self: Tensor, dim: int, half_to_float: bool) -> Cost:
    moved = _moved(self.size, self.size, 24, times=4)
    return _sum(_reduced(48, 6)(out, self, dim), _reduced(12)(out, self), moved)


def _cumprod(out: int, self: Tensor, dim: int) -> Cost:
    count = self.shape[dim] if self.shape else 1
    parts = Cost(self.size, 0, 2 * count * self.size, 48 * count)
    return _sum(_moved(self.size, self.size, times=4), parts)


def _cumsum(out: int, self: Tensor, dim: int) -> Cost:
    n = self.shape[dim] if self.shape else 1
    triangle = Cost(n * n, NUMBER * n * n, 4 * n * n + 2 * n * self.size, 12)
    return _sum(_moved(self.size, self.size, 48, times=4), triangle)


# Products, linear layers, normalisations


def _multiplied(a: int, b: int, out: int, inner: int, stacks: int = 1) -> Cost:
    moved = _moved(a + b + out, max(a, b), 24 * (1 + stacks), times=2)
    return _sum(moved._replace(elements=max(a, b, out)), Cost(out, 0, 2 * out * inner, 0))


def _matmul(out: int, a: Tensor, b: Tensor) -> Cost:
    n = product(a.shape[:-1]) * product(b.shape[-1:])
    return _multiplied(a.size, b.size, n, a.shape[-1], product(a.shape[:-2]))


def _mv(out: int, self: Tensor, vec: Tensor) -> Cost:
    n = product(self.shape[:1]) * (vec.size // max(self.shape[-1], 1) + 1)
    return _multiplied(self.size, vec.size, n, self.shape[-1])


def _dot(out: int, self: Tensor, tensor: Tensor) -> Cost:
    return Cost(max(self.size, tensor.size), NUMBER, 2 * max(self.size, tensor.size), 12)


def _added(product_: Rule) -> Rule:
    def rule(out: int, self: Tensor, mat1: Tensor, mat2: Tensor, **kwargs: Any) -> Cost:
        multiplied = product_(out, mat1, mat2)
        result = Tensor((*mat1.shape[:-1], *mat2.shape[1:]), 0, False)
        return _sum(multiplied, _together([self, result], 36), _together([self], 12))

    return rule


def _linear(out: int, input: Tensor, weight: Tensor, bias: Tensor | None = None) -> Cost:
    n = product(input.shape[:-1]) * product(weight.shape[:1])
    multiplied = _multiplied(input.size, 0, n, product(weight.shape[1:]))
    held = Cost(weight.size, 0, 8 * weight.size, 0)  # a matrix as it is, but looked through
    result = Tensor((*input.shape[:-1], *weight.shape[:1]), 0, False)
    return _sum(multiplied, held, _together([result, *([] if bias is None else [bias])], 12))


def _layer_norm(
    out: int,
    input: Tensor,
    normalized_shape: Sequence[int],
    weight: Tensor | None = None,
    bias: Tensor | None = None,
    *args: Any,
    **kwargs: Any,
) -> Cost:
    scale = [t for t in (weight, bias) if t is not None]
    means = Tensor((1,), 1, False)  # repeated to the input
    return _sum(
        *[_reduced(24)(out, input)] * 2, _together([input, means, means, *scale], 48), _together([input], 12)
    )


def _batch_norm(out: int, input: Tensor, *args: Any, **kwargs: Any) -> Cost:
    given = [a.size for a in (*args, *kwargs.values()) if type(a) is Tensor]
    return _moved(input.size, max([input.size, *given]), 72, times=6)


def _group_norm(
    out: int,
    input: Tensor,
    weight: Tensor | None,
    bias: Tensor | None,
    N: int,
    C: int,
    HxW: int,
    group: int,
    eps: float,
) -> Cost:
    n = max(input.size, product([N, group, C // group * HxW]))
    return _sum(*[_reduced(24)(out, Tensor((n,), n, False))] * 4, _moved(n, n, 120, times=12))


def _trilinear(
    out: int,
    i1: Tensor,
    i2: Tensor,
    i3: Tensor,
    expand1: Sequence[int],
    expand2: Sequence[int],
    expand3: Sequence[int],
    sumdim: Sequence[int],
    unroll_dim: int = 1,
) -> Cost:
    shapes = []
    for value, axes in ((i1, expand1), (i2, expand2), (i3, expand3)):
        lengths = list(value.shape)
        for axis in sorted(axes):
            lengths.insert(axis if axis >= 0 else len(lengths) + 1 + axis, 1)
        shapes.append(lengths)
    n = product(broadcast_shape(shapes))
    whole = Tensor((n,), n, False)
    moved = _moved(n, max(i1.size, i2.size, i3.size), 48, times=6)
    return _sum(moved, _reduced(12)(out, whole))


# Systems of a few linear equations


def _system(out: int, a: Tensor, b: Tensor | bool | None = None, *args: Any, **kwargs: Any) -> Cost:
    """Elimination in scalars: ``n^2 (n + columns)`` of them, three times with the rows that may be swapped."""
    b = b if type(b) is Tensor else None
    n = max([1, *(t.shape[-1] for t in (a, b) if t is not None and t.shape)])
    if n > systems.MOST:
        raise ValueError(f"a matrix of {n} rows; at most {systems.MOST} can be exported")
    given = a.size + (0 if b is None else b.size)
    stacks, columns = product(a.shape[:-2]), given // n + n
    scalars = 3 * n * n * (n + columns) + 16
    whole = given + stacks * n * columns
    moved = _moved(whole, whole, 24 * (1 + stacks), times=4)
    return _sum(moved, Cost(whole, 4 * NUMBER * stacks * scalars, 4 * stacks * scalars, stacks * scalars))


# Recurrent layers and cells


def _steps(steps: int, batch: int, weights: Sequence[Tensor | None], expression: int = 0) -> Cost:
    """``steps`` of a cell; each looks at so many nodes that are not in the graph yet."""
    given = [w for w in weights if w is not None]
    held = sum(w.size for w in given)
    gates = sum(product(w.shape[:1]) for w in given)
    simple = batch == 1 and all(w.constant for w in given)
    return Cost(
        max(held, batch * gates),
        steps * NUMBER * (3 * held // 2 + 8 * batch * gates),
        steps * (2 * batch * held + 16 * held),
        steps * (STEP + expression if simple else STEP),
        simple,
        tuple((w, 8 * steps) for w in given),
    )


def _cell(
    out: int,
    input: Tensor,
    hx: Tensor | Sequence[Tensor],
    w_ih: Tensor,
    w_hh: Tensor,
    b_ih: Tensor | None = None,
    b_hh: Tensor | None = None,
) -> Cost:
    given = [input, hx] if isinstance(hx, Tensor) else [input, *hx]
    cell = _steps(1, product(input.shape[:-1]), (w_ih, w_hh, b_ih, b_hh))
    pieces = tuple((t, 1) for t in given if cell.cut)
    return _sum(cell, *[_moved(t.size, t.size, times=2) for t in given])._replace(again=cell.again + pieces)


def _layers(
    out: int,
    input: Tensor,
    hx: Tensor | Sequence[Tensor],
    params: Sequence[Tensor],
    has_biases: bool,
    num_layers: int,
    dropout: float,
    train: bool,
    bidirectional: bool,
    batch_first: bool,
) -> Cost:
    states = [hx] if isinstance(hx, Tensor) else hx
    directions = 2 if bidirectional else 1
    count, left = divmod(len(params), num_layers * directions)
    if left or not 2 <= count <= 5:
        raise ValueError(f"{len(params)} weights for {num_layers} layers of {directions} directions")
    steps, batch, *_ = (input.shape[1], input.shape[0]) if batch_first else input.shape
    given = max([input.size, *(s.size for s in states)])
    costs = [_moved(input.size, input.size, 48, times=4)]
    for k in range(num_layers * directions):
        weights = params[k * count : (k + 1) * count]
        # All layers but the first take what all steps of the layer before gave.
        costs.append(_steps(steps, batch, weights, 8 * steps * directions if k >= directions else 0))
        costs.append(_moved(steps * batch * product(weights[1].shape[1:]), given, 24 * steps, times=8))
    total = _sum(*costs)
    pieces = ((input, steps * directions), *((s, directions) for s in states)) if total.cut else ()
    return total._replace(again=total.again + pieces)


MOVEMENTS: dict[str, Rule] = {
    "aten.alias.default": _same, "aten.clone.default": _same, "aten.detach.default": _same,
    "aten.lift_fresh_copy.default": _same, "aten.contiguous.default": _same, "aten.slice.Tensor": _part,
    "aten.select.int": _part, "aten.unsqueeze.default": _part, "aten.squeeze.dims": _part, "aten.squeeze.dim": _part,
    "aten.view.default": _view, "aten.reshape.default": _view, "aten._unsafe_view.default": _view,
    "aten.permute.default": _part, "aten.transpose.int": _part, "aten.t.default": _part,
    "aten.expand.default": _expand, "aten.repeat.default": _repeat, "aten.flip.default": _part,
    "aten.diagonal.default": _part, "aten.index_select.default": _index_select,
    "aten.index.Tensor": _index, "aten.cat.default": _cat, "aten.stack.default": _cat,
    "aten.split_with_sizes.default": _split, "aten.constant_pad_nd.default": _pad,
    "aten.full.default": _full, "aten.full_like.default": _full_like,
    "aten.scalar_tensor.default": _scalar, "aten.arange.start_step": _arange,
    "aten.unfold.default": _unfold, "aten.gather.default": _gather, "aten.embedding.default": _embedding,
    "aten.slice_scatter.default": _part_written, "aten.select_scatter.default": _part_written,
    "aten.index_put.default": _index_put, "aten.scatter.src": _scatter, "aten.copy.default": _copy,
    "aten.empty.memory_format": _full,
}  # fmt: skip
PRODUCTS: dict[str, Rule] = {
    "aten.mm.default": _matmul, "aten.bmm.default": _matmul, "aten.mv.default": _mv, "aten.dot.default": _dot,
    "aten.addmm.default": _added(_matmul), "aten.addmv.default": _added(_mv), "aten.linear.default": _linear,
    "aten.layer_norm.default": _layer_norm, "aten._trilinear.default": _trilinear,
    "aten.native_group_norm.default": _group_norm,
    "aten._native_batch_norm_legit_no_training.default": _batch_norm,
}  # fmt: skip
REDUCTIONS: dict[str, Rule] = {
    "aten.sum.default": _reduced(12), "aten.sum.dim_IntList": _reduced(12), "aten.mean.dim": _reduced(12),
    "aten.mean.default": _reduced(12), "aten.var.correction": _reduced(24), "aten.std.correction": _reduced(36),
    "aten.amax.default": _reduced(24, 6), "aten.amin.default": _reduced(24, 6),
    "aten.max.default": _reduced(24, 6), "aten.min.default": _reduced(24, 6),
    "aten.prod.default": _reduced(12, 6), "aten.prod.dim_int": _reduced(12, 6),
    "aten.linalg_vector_norm.default": _norm, "aten.logsumexp.default": _reduced(24, 6),
    "aten._softmax.default": _softmax, "aten._log_softmax.default": _softmax, "aten.cumsum.default": _cumsum,
    "aten.cumprod.default": _cumprod, "aten.std.dim": _reduced(36), "aten.var_mean.correction": _reduced(48),
    "aten.std_mean.dim": _reduced(60), "aten.max.dim": _reduced(48, 36), "aten.min.dim": _reduced(48, 36),
    "aten.any.default": _reduced(12, 12), "aten.any.dim": _reduced(12, 12), "aten.any.dims": _reduced(12, 12),
    "aten.dist.default": _dist,
}  # fmt: skip
SYSTEMS: dict[str, Rule] = dict.fromkeys(systems.OPERATORS, _system)
RECURRENT: dict[str, Rule] = {
    **{f"aten.{kind}.input": _layers for kind in ("gru", "lstm", "rnn_tanh", "rnn_relu")},
    **{f"aten.{kind}_cell.default": _cell for kind in ("gru", "lstm", "rnn_tanh", "rnn_relu")},
}


_LONG = {
    "elu", "celu", "softplus", "round", "hardtanh", "gelu", "mish", "clamp", "clamp_min", "silu", "sigmoid",
    "log_sigmoid", "xlogy", "fmin", "fmax",
}  # fmt: skip
"""Operators element by element that are made of some ten operations and more."""


def _getitem(out: int, values: Sequence[Tensor], index: int) -> Cost:
    return Cost(0, 0, 0, 1)


COSTS: dict[str, Rule] = {
    "getitem": _getitem,
    **dict.fromkeys(elementwise.OPERATORS, _pointwise(12)),
    **{name: _pointwise(60) for name in elementwise.OPERATORS if name.split(".")[1] in _LONG},
    **MOVEMENTS,
    **REDUCTIONS,
    **PRODUCTS,
    **SYSTEMS,
    **RECURRENT,
}
"""The rule of each operator of :data:`nn_export.operators.OPERATORS`."""
