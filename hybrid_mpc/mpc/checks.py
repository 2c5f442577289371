"""What a control problem is given, checked when it is made."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.input_limits import numbers
from hybrid_mpc.riccati import vector

Array = NDArray[np.float64]


def whole(value: object) -> bool:
    """Whether a value is a whole number.

    Example:
        >>> whole(3), whole(3.0), whole(2.5), whole(float("nan")), whole("3")
        (True, True, False, False, False)
    """
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value)) and int(value) == value


def diagonal(values: ArrayLike, name: str) -> Array:
    """Weights as a vector; a matrix is refused."""
    array = numbers(values, name)
    shape = np.shape(values)
    if len(shape) > 1 and max(shape) < array.size:
        raise InputError(f"{name}: shape {shape} given; needed: the diagonal alone, a weight each")
    return array


def plans(values: Sequence[ArrayLike], horizon: int, n_u: int) -> tuple[Array, ...]:
    """Input plans, each a finite ``(horizon, n_u)``."""
    found = []
    for i, value in enumerate(values):
        array = numbers(value, f"starts[{i}]").reshape(np.shape(value))
        if array.shape != (horizon, n_u) or not np.all(np.isfinite(array)):
            raise InputError(
                f"starts[{i}]: shape {array.shape} given; needed: a finite plan of the inputs ({horizon}, {n_u})"
            )
        found.append(array)
    return tuple(found)


def point(value: object, n_x: int, n_u: int) -> tuple[Array, Array]:
    """A state ``(n_x,)`` and an input ``(n_u,)``, finite."""
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise InputError(f"working_point: {value!r} given; needed: (x, u), a state and an input")
    return vector(value[0], n_x, "working_point x"), vector(value[1], n_u, "working_point u")


def is_stage_cost(f: object) -> bool:
    """Whether ``f`` is a function ``(x, u) -> scalar`` or ``(x, u, p) -> scalar``."""
    return isinstance(f, ca.Function) and f.n_in() in (2, 3) and (f.n_out(), f.numel_out(0)) == (1, 1)


def block_lengths(blocks: Sequence[int], horizon: int) -> tuple[int, ...]:
    """Lengths of move blocks that fit the horizon."""
    lengths = tuple(int(length) for length in blocks if whole(length))
    if len(lengths) < len(blocks) or min(lengths, default=0) < 1 or sum(lengths) != horizon:
        raise InputError(
            f"blocks: {tuple(blocks)} given, {sum(blocks)} periods in all; needed: whole numbers of at least 1 "
            f"that sum to the horizon of {horizon}"
        )
    return lengths


def check_weights(weights: dict[str, Array]) -> None:
    """Refuse weights that are negative, not finite, or leave an input undetermined."""
    for name, value in weights.items():
        if value.size == 0 or not np.all(np.isfinite(value)) or np.any(value < 0):
            raise InputError(f"{name}: weights must be finite and not negative, got {value}")
    if not np.all(weights["r"] + weights["r_delta"] > 0):
        raise InputError(
            "every input needs a positive weight in r or r_delta, otherwise it is not determined"
        )


def terminal_matrix(value: ArrayLike, n_x: int) -> Array:
    """A finite, symmetric, positive semi-definite ``(n_x, n_x)`` matrix."""
    if isinstance(value, str):
        raise InputError(f"terminal: {value!r} given; needed: 'riccati' or an ({n_x}, {n_x}) matrix")
    matrix = numbers(value, "terminal").reshape(np.shape(value))
    if matrix.shape != (n_x, n_x) or not np.all(np.isfinite(matrix)) or not np.allclose(matrix, matrix.T):
        raise InputError(
            f"terminal: shape {matrix.shape} given; needed: a finite symmetric ({n_x}, {n_x}) matrix"
        )
    if np.min(np.linalg.eigvalsh(matrix)) < -1e-9 * max(1.0, float(np.max(np.abs(matrix)))):
        raise InputError("terminal: the matrix has a negative eigenvalue; needed: positive semi-definite")
    return matrix
