"""Limits of inputs and states, of any sign, on one side or both."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.rules import LARGEST

Array = NDArray[np.float64]


MOST_ITERATIONS = 10**6
"""Most iterations of a solver."""


def input_limits(u_min: ArrayLike, u_max: ArrayLike, n_u: int) -> tuple[Array, Array]:
    """Checked limits ``(n_u,)`` of the inputs; ``-inf`` and ``inf`` for none."""
    lower, upper = (numbers(v, name, most=LARGEST) for v, name in ((u_min, "u_min"), (u_max, "u_max")))
    if lower.shape != (n_u,) or upper.shape != (n_u,):
        raise InputError(f"u_min has {lower.size} and u_max {upper.size} values, {n_u} needed [HM-MODEL-012]")
    if not np.all(lower < upper):
        raise InputError(
            f"input bounds cross: u_min {lower}, u_max {upper}; every u_min must be below its u_max [HM-MODEL-013]"
        )
    return lower, upper


def numbers(values: ArrayLike, name: str, *, most: float = np.inf) -> Array:
    """``values`` as a vector ``(n,)``, a copy; infinite ones and NaN too. Texts and flags are no numbers.

    Raises:
        InputError: If one is none, or finite and larger than ``most`` in size.
    """
    try:
        given = np.array(values)
        array = np.array(values, dtype=float).ravel() if given.dtype.kind in "iufO" else None
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(
            f"{name}: numbers needed, got {type(values).__name__} {values!r:.80} [HM-MODEL-014]"
        ) from error
    if array is None or _not_numbers(values):
        raise InputError(f"{name}: numbers needed, got {values!r:.80} [HM-MODEL-015]")
    if np.any(np.isfinite(array) & (np.abs(array) > most)):
        raise InputError(
            f"{name}: numbers of at most {most:g} in size are needed, got {values!r:.80} [HM-MODEL-016]"
        )
    return array


def vector(value: ArrayLike, size: int, name: str) -> Array:
    """``value`` as a finite float vector ``(size,)``."""
    array = numbers(value, name)
    if array.shape != (size,):
        raise InputError(f"{name}: {array.size} values given, {size} needed [HM-MODEL-017]")
    if not np.all(np.isfinite(array)):
        raise InputError(f"{name}: values must be finite, got {array} [HM-MODEL-018]")
    return array


def _not_numbers(values: object) -> bool:
    """Whether a flag, a text or None stands in lists, which numpy would make numbers of."""
    if isinstance(values, list | tuple):
        return any(map(_not_numbers, values))
    return isinstance(values, bool | np.bool_ | str | bytes) or values is None


def sampled(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """What a sensor, an actuator or a reference gives as a new float array; NaN and infinite numbers are values.

    Args:
        values: Numbers. What does not fit into double precision (``10**400``) is infinite; masked elements are NaN.
        shape: Shapes that fit, None for any length. A number fits ``(1,)``, a row ``(n,)`` ``(None, n)``.
        name: What it is, for messages.

    Raises:
        InputError: If it is something else than real numbers, or of another shape.

    Example:
        >>> sampled([1, float("nan")], (2,), "y"), sampled(10**400, (), "y")
        (array([ 1., nan]), array(inf))
    """
    plain = type(values) is np.ndarray and values.dtype == np.float64  # a loop's every period
    array = np.array(values) if plain else floats(values, name)
    if array.ndim < len(shape) and shape[: len(shape) - array.ndim] in ((1,), (None,), (1, 1), (None, 1)):
        array = array.reshape((1,) * (len(shape) - array.ndim) + array.shape)
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        needed = f"({', '.join('m' if n is None else str(n) for n in shape)}{',' * (len(shape) == 1)})"
        raise InputError(f"{name} has shape {np.shape(array)}, needed is {needed} [HM-MODEL-019]")
    return array


def floats(values: ArrayLike, name: str) -> Array:
    """Real numbers of any kind as a float array."""
    try:
        if isinstance(values, np.ma.MaskedArray):
            return np.array(np.ma.filled(values.astype(np.float64), np.nan))
        given = np.asarray(values)
        if given.dtype.kind in "biuf":
            return np.array(given, dtype=np.float64)
        if given.dtype.kind == "O" and all(isinstance(v, Real) for v in given.flat):
            return np.array([_float(v) for v in given.flat], dtype=np.float64).reshape(given.shape)
    except Exception as error:  # whatever an object of anybody's raises where it is asked for its numbers
        raise InputError(
            f"{name}: numbers needed, got {type(values).__name__} ({error}) [HM-MODEL-020]"
        ) from error
    raise InputError(f"{name}: numbers needed, got {type(values).__name__} {values!r:.80} [HM-MODEL-021]")


def _float(value: Real) -> float:
    try:
        return float(value)
    except OverflowError:  # an int or a fraction beyond a float's range
        return -math.inf if str(value).startswith("-") else math.inf


def share_used(values: ArrayLike, lower: ArrayLike, upper: ArrayLike, rest: ArrayLike = 0.0) -> float:
    """Largest share of the way from rest to a limit ``(n,)`` that values ``(m, n)`` use: 1 at the limit, more beyond.

    ``rest`` ``(n,)`` is the operating point's value; beyond a limit that limit stands for it. Where a limit is the
    rest value itself: 1 plus the violation over the whole range; infinite without a range.
    """
    value, low, high = (np.asarray(v, dtype=float) for v in (values, lower, upper))
    rest, span = np.clip(rest, low, high), high - low
    shares = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for way, room in ((value - rest, high - rest), (rest - value, rest - low)):
            beyond = np.where(way > 0, 1.0 + way / np.where(np.isfinite(span), span, 0.0), 0.0)
            shares.append(np.where(room > 0, way / room, beyond))
    return float(np.max(shares))


def check_part(value: object, name: str, what: str, *needed: str) -> None:
    """Refuse what is no part of a loop: it lacks an attribute that it needs.

    Raises:
        InputError: Naming the argument and what is needed.

    Example:
        >>> check_part(3.0, "monitor", "a monitor", "update")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: monitor: a monitor is needed, got float, which has no 'update'
    """
    lacking = [attribute for attribute in needed if not hasattr(value, attribute)]
    if lacking or isinstance(value, type):
        got = value.__name__ if isinstance(value, type) else type(value).__name__
        why = f"which has no {lacking[0]!r}" if lacking else "a class"
        raise InputError(f"{name}: {what} is needed, got {got}, {why} [HM-MODEL-044]")


def check_function(value: object, name: str) -> None:
    """Refuse what cannot be called, and a class, whose instances would be taken for values.

    Raises:
        InputError: Naming the argument.

    Example:
        >>> check_function(float, "weight")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: weight: a function is needed, got the class float
    """
    if isinstance(value, type):
        raise InputError(f"{name}: a function is needed, got the class {value.__name__} [HM-MODEL-022]")
    if not callable(value):
        raise InputError(f"{name}: a function is needed, got {type(value).__name__} [HM-MODEL-023]")


def check_flag(value: object, name: str) -> None:
    """Refuse what is neither True nor False.

    Raises:
        InputError: Naming the argument.
    """
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name}: True or False is needed, got {type(value).__name__} [HM-MODEL-024]")


def whole(value: object, name: str, least: int, most: int) -> int:
    """A whole number from ``least`` to ``most``, a float of that value, too.

    Raises:
        InputError: If it is another one, or none.

    Example:
        >>> whole(3.0, "skip", 0, 10)
        3
    """
    kind = isinstance(value, int | float | np.integer | np.floating) and not isinstance(
        value, bool | np.bool_
    )
    if not kind or not least <= value <= most or value != int(value):  # type: ignore[operator, call-overload]
        raise InputError(
            f"{name}: a whole number from {least} to {most:g} is needed, got {_shortly(value)} [HM-MODEL-025]"
        )
    return int(value)  # type: ignore[call-overload]


def _shortly(value: object) -> str:
    huge = isinstance(value, int) and abs(value) > LARGEST
    return (
        "one that is larger"
        if huge
        else f"{value!r:.80}"
        if isinstance(value, int | float)
        else type(value).__name__
    )
