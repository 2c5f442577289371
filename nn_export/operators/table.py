"""The table of operators as a document: ``python -m nn_export.operators.table > docs/operators.md``."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from nn_export.operators import elementwise, linear, recurrent, reduce, shape, systems

GROUPS: dict[str, Mapping[str, Any]] = {
    "Element by element": elementwise.OPERATORS,
    "Moving elements, constants": shape.OPERATORS,
    "Products, linear layers, normalizations": linear.OPERATORS,
    "Systems of a few linear equations": systems.OPERATORS,
    "Reductions": reduce.OPERATORS,
    "Recurrent layers and cells": recurrent.OPERATORS,
}
HEAD = """# Operators

A torch module exports if `torch.export` reduces it to the operators below. An operator computes the same as in torch,
except for its limits. Other operators and other arguments are refused by name. One name stands for all overloads, e.g.
`add` for `add.Tensor` and `add.Scalar`.

This page is generated: `python -m nn_export.operators.table > docs/operators.md`.
"""
NOTES: dict[str, str] = {
    "_to_copy": "conversion to an integer type truncates",
    "atan2": "not finite at (0, 0)",
    "detach": "does not stop derivatives",
    "maximum minimum": "do not pass NaN on",
    "where": "NaN of the other branch is not passed on",
    "arange": "float32: only numbers that are exact in it",
    "constant_pad_nd": "no negative `pad`",
    "embedding gather index index_select": "positions must be constant",
    "index_put scatter": "positions must be constant and different",
    "empty": "NaN until written",
    "linalg_inv linalg_solve": "1 to 8 rows; singular: inf or NaN",
    "linalg_det linalg_cholesky cholesky_solve cholesky_inverse linalg_solve_triangular": "1 to 8 rows",
    "amax amin": "equal elements share the slope",
    "std": "slope 0 where the result is 0",
    "linalg_vector_norm": "`ord` 1, above 1, or ±infinity",
    "_softmax _log_softmax": "`half_to_float=False`",
    "gru lstm rnn_relu rnn_tanh": "no dropout in training mode",
    "_native_batch_norm_legit_no_training": "uses the stored statistics",
}
"""What an operator needs, or computes differently from torch."""


def document() -> str:
    """The page as Markdown: operators with the same limits share a row."""
    parts = [HEAD]
    for title, group in GROUPS.items():
        parts.append(f"## {title}\n\n| operators | limits |\n| --- | --- |")
        rows: dict[str, list[str]] = {}
        for name in sorted({short(name) for name in group}):
            rows.setdefault(_limits(name), []).append(f"`{name}`")
        parts += [f"| {', '.join(rows[limits])} | {limits or 'none'} |" for limits in sorted(rows)]
        parts.append("")
    return "\n".join(parts)


def short(name: str) -> str:
    """An operator's name as the page shows it, without its overload.

    Example:
        >>> short("aten.relu.default"), short("aten.add.Tensor")
        ('relu', 'add')
    """
    return name.removeprefix("aten.").partition(".")[0]


def _limits(name: str) -> str:
    return next((text for names, text in NOTES.items() if name in names.split()), "")


if __name__ == "__main__":
    sys.stdout.write(document())
