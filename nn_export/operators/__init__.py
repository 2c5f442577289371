"""The table of operators: ATen overload name to a small function on :class:`Value`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from nn_export.operators import elementwise, linear, recurrent, reduce, shape, systems
from nn_export.operators.value import Value


def getitem(values: Sequence[Value], index: int) -> Value:
    """One of the results of an operator that has several."""
    return values[index]


OPERATORS: dict[str, Callable[..., Any]] = {
    "getitem": getitem,
    **elementwise.OPERATORS,
    **shape.OPERATORS,
    **linear.OPERATORS,
    **systems.OPERATORS,
    **reduce.OPERATORS,
    **recurrent.OPERATORS,
}
PLAIN: dict[str, Callable[..., Any]] = {**OPERATORS, **recurrent.PLAIN}
"""The table without functions that bring their own Jacobians."""

__all__ = ["OPERATORS", "PLAIN"]
