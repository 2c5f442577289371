"""The table of operators as a document: ``python -m nn_export.operators.table > docs/operators.md``."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from typing import Any

from nn_export.operators import OPERATORS, elementwise, linear, recurrent, reduce, shape, systems

GROUPS: dict[str, Mapping[str, Any]] = {
    "Element by element": elementwise.OPERATORS,
    "Moving elements, constants": shape.OPERATORS,
    "Products, linear layers, normalizations": linear.OPERATORS,
    "Systems of a few linear equations": systems.OPERATORS,
    "Reductions": reduce.OPERATORS,
    "Recurrent layers and cells": recurrent.OPERATORS,
}
HEAD = """# Operators

A torch module exports if `torch.export` reduces it to the operators below. Each computes the same as in torch, except
as noted. Other operators and other arguments are refused by name. *Further arguments* follow the first argument;
*same* means the shape of the first argument.

This page is generated: `python -m nn_export.operators.table > docs/operators.md`.
"""
SAME = "same"
SHAPES: dict[str, str] = {
    "_unsafe_view reshape view full empty.memory_format": "`size`",
    "expand": "`size`; -1 keeps an axis",
    "scalar_tensor dot dist max min prod sum": "`()`",
    "arange.start_step": "`(n,)`",
    "cat": "sizes of `dim` added",
    "stack": "new axis `dim`",
    "constant_pad_nd": "axes grow by `pad`, the last axis first",
    "diagonal": "the other axes, then the diagonal",
    "embedding": "`indices.shape + weight.shape[1:]`",
    "gather": "shape of `index`",
    "index.Tensor": "as in NumPy",
    "index_select": "`dim` as long as `index`",
    "permute t transpose.int": "axes reordered",
    "repeat": "each axis times its `repeats`",
    "select.int": "without `dim`",
    "slice.Tensor": "`dim` shorter",
    "split_with_sizes": "one result for each of `split_sizes`",
    "squeeze.dim squeeze.dims": "without axes of size 1 in `dim`",
    "unfold": "windows on `dimension`, new last axis `size`",
    "unsqueeze": "new axis of size 1",
    "addmm mm": "`(n, m)`",
    "bmm": "`(batch, n, m)`",
    "addmv mv": "`(n,)`",
    "linear": "`(..., out)`",
    "_trilinear": "broadcast, without `sumdim`",
    "linalg_solve linalg_solve_triangular": "shape of `B`",
    "linalg_det": "without the last two axes",
    "any any.dim any.dims mean mean.dim prod.dim_int sum.dim_IntList amax amin linalg_vector_norm": "without `dim`",
    "logsumexp std.correction std.dim var.correction": "without `dim`",
    "std_mean.dim var_mean.correction max.dim min.dim": "two results without `dim`",
    "gru_cell lstm_cell rnn_relu_cell rnn_tanh_cell": "shape of `hx`",
    "gru.input lstm.input rnn_relu.input rnn_tanh.input": "all outputs; last states like `hx`",
}
"""Shape of the result by operators. Those that are not here keep the shape, or broadcast two arguments."""
NOTES: dict[str, str] = {
    "_to_copy": "integer types cut the fraction off",
    "atan2": "not finite at (0, 0)",
    "detach": "derivatives pass",
    "maximum minimum": "do not pass NaN on",
    "where.self": "NaN of the other branch is not passed on",
    "arange.start_step": "as float32 only numbers that it holds exactly",
    "constant_pad_nd": "no negative `pad`",
    "embedding gather index.Tensor index_select": "constant positions",
    "index_put scatter.src": "constant positions, each once",
    "empty.memory_format": "NaN until written",
    "linalg_inv linalg_solve": "1 to 8 rows; singular: inf or NaN",
    "linalg_det linalg_cholesky cholesky_solve cholesky_inverse linalg_solve_triangular": "1 to 8 rows",
    "amax amin": "equal elements share the slope",
    "std.correction std.dim": "slope 0 where it is 0",
    "linalg_vector_norm": "`ord` 1, above 1, or ±infinity",
    "_softmax _log_softmax": "`half_to_float=False`",
    "gru.input lstm.input rnn_relu.input rnn_tanh.input": "no dropout in training mode",
    "_native_batch_norm_legit_no_training": "stored statistics",
}
"""What an operator needs, or computes differently from torch."""


def document() -> str:
    """The table as Markdown: operators of the same arguments, shape and limits share a row."""
    parts = [HEAD]
    for title, group in GROUPS.items():
        parts.append(f"## {title}\n\n| operator | further arguments | shape; limits |\n| --- | --- | --- |")
        rows: dict[tuple[str, ...], list[str]] = {}
        for name in sorted(group):
            rows.setdefault(_cells(name), []).append(f"`{short(name)}`")
        parts += [f"| {', '.join(names)} | {' | '.join(cells)} |" for cells, names in rows.items()]
        parts.append("")
    return "\n".join(parts)


def short(name: str) -> str:
    """An operator's name as the page shows it.

    Example:
        >>> short("aten.relu.default"), short("aten.add.Tensor")
        ('relu', 'add.Tensor')
    """
    return name.removeprefix("aten.").removesuffix(".default")


def _cells(name: str) -> tuple[str, str]:
    parameters = list(inspect.signature(OPERATORS[name]).parameters)
    both = {"other", "min", "condition"} & set(parameters)
    size = _of(SHAPES, name) or ("broadcast" if both else SAME)
    return ", ".join(parameters[1:]), "; ".join(filter(None, (size, _of(NOTES, name))))


def _of(table: Mapping[str, str], name: str) -> str:
    return next((text for names, text in table.items() if short(name) in names.split()), "")


if __name__ == "__main__":
    sys.stdout.write(document())
