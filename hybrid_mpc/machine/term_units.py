"""Check whether a law's unit can be that of the quantity it adds to: units are propagated through its operations.

Numbers in a law may have any unit, so only a law that certainly does not fit is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from hybrid_mpc.machine.units import BASES, parse_unit

Unit = tuple[float, ...] | None
"""Exponents of the base units; None: any unit."""
NONE: tuple[float, ...] = (0.0,) * len(BASES)
_SECOND: tuple[float, ...] = tuple(1.0 if base == "s" else 0.0 for base in BASES)
_PURE = {
    ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_SINH, ca.OP_COSH, ca.OP_TANH,
    ca.OP_EXP, ca.OP_LOG, ca.OP_ERF, ca.OP_SIGN,
}  # fmt: skip
"""Functions with dimensionless results. The unit of their argument is not checked: a width of 1 leaves no trace."""
_SAME = {ca.OP_NEG, ca.OP_FABS, ca.OP_FLOOR, ca.OP_CEIL}
_ALIKE = {ca.OP_ADD, ca.OP_SUB, ca.OP_FMIN, ca.OP_FMAX}


def of(unit: str) -> Unit:
    """Exponents of a unit's base units; None if the unit is unknown.

    Example:
        >>> of("N m")
        (2.0, 1.0, -2.0, 0.0, 0.0, 0.0, 0.0)
    """
    found = parse_unit(unit)
    return None if found is None else tuple(float(e) for e in (*found[1], *NONE[len(found[1]) :]))


def per_second(unit: Unit) -> Unit:
    """The unit of a rate."""
    return None if unit is None else _sum(unit, _SECOND, -1.0)


def clash(value: Any, inputs: Sequence[tuple[Any, str]], wanted: Unit) -> str:
    """Why an expression cannot have the unit ``wanted``, as the end of a sentence; empty if it can.

    Args:
        value: The expression, a CasADi SX scalar.
        inputs: Symbols in it, with units; other symbols may have any unit.
        wanted: The required unit.

    Example:
        >>> v, d = ca.SX.sym("v"), ca.SX.sym("d")
        >>> clash(d * v, [(v, "m/s"), (d, "kg/s")], of("N")), clash(d * v, [(v, "m/s"), (d, "kg")], of("N"))
        ('', 'its unit is kg m/s where kg m/s^2 is needed')
    """
    f = ca.Function(
        "law", [ca.vertcat(*(symbol for symbol, _ in inputs))], [ca.SX(value)], {"allow_free": True}
    )
    units = [of(unit) for _, unit in inputs]
    work: dict[int, Unit] = {}
    found: Unit = None
    for k in range(f.n_instructions()):
        operation, given, made = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if operation == ca.OP_INPUT:
            work[made[0]] = units[given[1]]
        elif operation == ca.OP_OUTPUT:
            found = work[given[0]]
        elif operation in (ca.OP_CONST, ca.OP_PARAMETER):
            work[made[0]] = None
        else:
            result = _through(operation, [work[i] for i in given])
            if isinstance(result, str):
                return result
            work[made[0]] = result
    if found is not None and wanted is not None and not _equal(found, wanted):
        return f"its unit is {_text(found)} where {_text(wanted)} is needed"
    return ""


def _through(operation: int, given: list[Unit]) -> Unit | str:
    """The unit of a result; a text if the operands' units contradict each other."""
    first = given[0]
    if operation in _SAME:
        return first
    if operation in _ALIKE:
        second = given[1]
        if first is not None and second is not None and not _equal(first, second):
            return f"it adds {_text(first)} and {_text(second)}"
        return first if second is None else second
    if operation in _PURE:
        return NONE
    if operation == ca.OP_SQ:
        return None if first is None else _sum(first, first)
    if operation == ca.OP_SQRT:
        return None if first is None else tuple(0.5 * e for e in first)
    if operation == ca.OP_INV:
        return None if first is None else tuple(-e for e in first)
    if operation in (ca.OP_MUL, ca.OP_DIV) and len(given) == 2:
        second = given[1]
        if first is None or second is None:
            return None
        return _sum(first, second, 1.0 if operation == ca.OP_MUL else -1.0)
    return None  # powers and comparisons are not propagated


def _sum(one: tuple[float, ...], other: tuple[float, ...], sign: float = 1.0) -> tuple[float, ...]:
    return tuple(a + sign * b for a, b in zip(one, other, strict=True))


def _equal(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return all(abs(a - b) < 1e-9 for a, b in zip(one, other, strict=True))


def _text(unit: tuple[float, ...]) -> str:
    """A unit in base units."""
    order = sorted(zip(BASES, unit, strict=True))
    up, down = ([(b, s * e) for b, e in order if s * e > 0] for s in (1.0, -1.0))
    words = [[b if e == 1 else f"{b}^{e:g}" for b, e in part] for part in (up, down)]
    return "/".join([" ".join(words[0]) or "1", *words[1]]) if unit != NONE else "a pure number"
