"""When problems are the same: numbers by value, expressions by the program that they state."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nn_export import ExportError, program_of

Array = NDArray[np.float64]


def fixed(array: Array) -> Array:
    """The array, which may not be written into any more."""
    array.flags.writeable = False
    return array


def number_content(holder: Any) -> tuple[Any, ...]:
    """All fields of a dataclass but expressions, by value, as something that can be hashed.

    Example:
        >>> from hybrid_mpc.mpc.limits import Limits
        >>> number_content(Limits([-1.0], [1.0]))
        (((1,), (-1.0,)), ((1,), (1.0,)))
    """
    return tuple(_content(getattr(holder, field.name)) for field in fields(holder))


def _content(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, tuple(value.ravel().tolist())
    if isinstance(value, tuple):
        return tuple(map(_content, value))
    return None if isinstance(value, ca.Function) else value


def same_expression(a: ca.Function | None, b: ca.Function | None) -> bool:
    """Whether two functions are one, or state the same program; what cannot be stated is the same as itself alone.

    Example:
        >>> x, y = ca.SX.sym("x"), ca.MX.sym("y")
        >>> same_expression(ca.Function("f", [x], [x**2], ["x"], ["c"]), ca.Function("g", [y], [y * y], ["x"], ["c"]))
        True
    """
    if a is None or b is None:
        return a is b
    if a.__hash__() == b.__hash__():  # one object of CasADi
        return True
    try:
        return program_of(a) == program_of(b)
    except ExportError:
        return False
