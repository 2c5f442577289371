"""Limits of inputs and states, of any sign, one-sided or two-sided; checks of numbers."""

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
    """Checked limits ``(n_u,)`` of the inputs; ``-inf`` and ``inf`` mean no limit."""
    lower, upper = (numbers(v, name, most=LARGEST) for v, name in ((u_min, "u_min"), (u_max, "u_max")))
    if lower.shape != (n_u,) or upper.shape != (n_u,):
        raise InputError(
            f"u_min, u_max: must have {n_u} values, got {lower.size} and {upper.size} [HM-MODEL-012]"
        )
    if not np.all(lower < upper):
        raise InputError(
            f"u_min, u_max: every u_min must be below its u_max, got {lower} and {upper} [HM-MODEL-013]"
        )
    return lower, upper


def numbers(values: ArrayLike, name: str, *, most: float = np.inf) -> Array:
    """``values`` as a new vector ``(n,)``; infinities and NaN are allowed, texts and flags are not.

    Raises:
        InputError: If a value is not a number, or is finite and larger than ``most`` in size.
    """
    try:
        given = np.array(values)
        array = np.array(values, dtype=float).ravel() if given.dtype.kind in "iufO" else None
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(
            f"{name}: must be numbers, got {type(values).__name__} {values!r:.80} [HM-MODEL-014]"
        ) from error
    if array is None or _not_numbers(values):
        raise InputError(f"{name}: must be numbers, got {values!r:.80} [HM-MODEL-015]")
    if np.any(np.isfinite(array) & (np.abs(array) > most)):
        raise InputError(
            f"{name}: numbers must be at most {most:g} in size, got {values!r:.80} [HM-MODEL-016]"
        )
    return array


def vector(value: ArrayLike, size: int, name: str) -> Array:
    """``value`` as a finite float vector ``(size,)``."""
    array = numbers(value, name)
    if array.shape != (size,):
        raise InputError(f"{name}: must have {size} values, got {array.size} [HM-MODEL-017]")
    if not np.all(np.isfinite(array)):
        raise InputError(f"{name}: values must be finite, got {array} [HM-MODEL-018]")
    return array


def _not_numbers(values: object) -> bool:
    """Whether a nested list contains a flag, a text or None, which numpy would convert to numbers."""
    if isinstance(values, list | tuple):
        return any(map(_not_numbers, values))
    return isinstance(values, bool | np.bool_ | str | bytes) or values is None


def sampled(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """A value of a sensor, an actuator or a reference as a new float array; NaN and infinities are allowed.

    Args:
        values: Numbers. A number beyond double precision (``10**400``) becomes infinite, a masked element NaN.
        shape: Accepted shape, None for any length. A number fits ``(1,)``, a row ``(n,)`` fits ``(None, n)``.
        name: Its name, for messages.

    Raises:
        InputError: If it is not real numbers, or has another shape.

    Example:
        >>> sampled([1, float("nan")], (2,), "y"), sampled(10**400, (), "y")
        (array([ 1., nan]), array(inf))
    """
    plain = type(values) is np.ndarray and values.dtype == np.float64  # fast path for every period of a loop
    array = np.array(values) if plain else floats(values, name)
    if array.ndim < len(shape) and shape[: len(shape) - array.ndim] in ((1,), (None,), (1, 1), (None, 1)):
        array = array.reshape((1,) * (len(shape) - array.ndim) + array.shape)
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        needed = f"({', '.join('m' if n is None else str(n) for n in shape)}{',' * (len(shape) == 1)})"
        raise InputError(f"{name}: must have shape {needed}, got {np.shape(array)} [HM-MODEL-019]")
    return array


def floats(values: ArrayLike, name: str) -> Array:
    """Real numbers of any type as a float array."""
    try:
        if isinstance(values, np.ma.MaskedArray):
            return np.array(np.ma.filled(values.astype(np.float64), np.nan))
        given = np.asarray(values)
        if given.dtype.kind in "biuf":
            return np.array(given, dtype=np.float64)
        if given.dtype.kind == "O" and all(isinstance(v, Real) for v in given.flat):
            return np.array([_float(v) for v in given.flat], dtype=np.float64).reshape(given.shape)
    except Exception as error:  # numpy passes on any exception of a user's object
        raise InputError(
            f"{name}: must be numbers, got {type(values).__name__} ({error}) [HM-MODEL-020]"
        ) from error
    raise InputError(f"{name}: must be numbers, got {type(values).__name__} {values!r:.80} [HM-MODEL-021]")


def _float(value: Real) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer or a fraction beyond the range of a float
        return -math.inf if str(value).startswith("-") else math.inf


def share_used(values: ArrayLike, lower: ArrayLike, upper: ArrayLike, rest: ArrayLike = 0.0) -> float:
    """Largest used share of the way from rest to a limit ``(n,)`` by values ``(m, n)``: 1 at the limit, more beyond.

    ``rest`` ``(n,)`` is the operating point's value, clipped to the limits. If the limit equals the rest value: 1 plus
    the violation over the whole range; infinite without a range.
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
    """Refuse an object that is no part of a loop: it lacks a required attribute.

    Raises:
        InputError: With the argument and what is needed.

    Example:
        >>> check_part(3.0, "monitor", "a monitor", "update")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: monitor: must be a monitor, got float, which has no 'update'
    """
    lacking = [attribute for attribute in needed if not hasattr(value, attribute)]
    if lacking or isinstance(value, type):
        got = value.__name__ if isinstance(value, type) else type(value).__name__
        why = f"which has no {lacking[0]!r}" if lacking else "a class"
        raise InputError(f"{name}: must be {what}, got {got}, {why} [HM-MODEL-044]")


def check_function(value: object, name: str) -> None:
    """Refuse an object that is not callable, and a class, whose instances would be taken for values.

    Raises:
        InputError: With the argument.

    Example:
        >>> check_function(float, "weight")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: weight: must be a function, got the class float
    """
    if isinstance(value, type):
        raise InputError(f"{name}: must be a function, got the class {value.__name__} [HM-MODEL-022]")
    if not callable(value):
        raise InputError(f"{name}: must be a function, got {type(value).__name__} [HM-MODEL-023]")


def check_flag(value: object, name: str) -> bool:
    """The value; anything but True and False is refused.

    Raises:
        InputError: With the argument.
    """
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name}: must be True or False, got {type(value).__name__} [HM-MODEL-024]")
    return bool(value)


def whole(value: object, name: str, least: int, most: int) -> int:
    """An integer from ``least`` to ``most``, also given as a float.

    Raises:
        InputError: If it is not an integer, or out of range.

    Example:
        >>> whole(3.0, "skip", 0, 10)
        3
    """
    kind = isinstance(value, int | float | np.integer | np.floating) and not isinstance(
        value, bool | np.bool_
    )
    if not kind or not least <= value <= most or value != int(value):  # type: ignore[operator, call-overload]
        raise InputError(
            f"{name}: must be an integer from {least} to {most:g}, got {_shortly(value)} [HM-MODEL-025]"
        )
    return int(value)  # type: ignore[call-overload]


def _shortly(value: object) -> str:
    if isinstance(value, int) and abs(value) > LARGEST:
        return "a larger one"
    return f"{value!r:.80}" if isinstance(value, int | float) else type(value).__name__
