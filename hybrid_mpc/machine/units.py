"""What two units have to do with each other: ``m`` and ``mm``, ``J`` and ``W``. One that is not known says nothing."""

from __future__ import annotations

import math
import re
from functools import cache

BASES = ("m", "kg", "s", "A", "K", "mol", "cd")
_N, _J, _W = (1.0, (1, 1, -2)), (1.0, (2, 1, -2)), (1.0, (2, 1, -3))
_KNOWN: dict[str, tuple[float, tuple[int, ...]]] = {
    "1": (1.0, ()), "-": (1.0, ()), "%": (1e-2, ()), "rad": (1.0, ()), "deg": (math.pi / 180, ()),
    "rev": (2 * math.pi, ()), "turn": (2 * math.pi, ()), "rpm": (2 * math.pi / 60, (0, 0, -1)),
    "m": (1.0, (1,)), "l": (1e-3, (3,)), "L": (1e-3, (3,)),
    "g": (1e-3, (0, 1)),
    "s": (1.0, (0, 0, 1)), "min": (60.0, (0, 0, 1)), "h": (3600.0, (0, 0, 1)), "Hz": (1.0, (0, 0, -1)),
    "A": (1.0, (0, 0, 0, 1)), "K": (1.0, (0, 0, 0, 0, 1)), "mol": (1.0, (0, 0, 0, 0, 0, 1)),
    "cd": (1.0, (0, 0, 0, 0, 0, 0, 1)),
    "N": _N, "J": _J, "W": _W, "Wh": (3600.0, (2, 1, -2)), "Pa": (1.0, (-1, 1, -2)), "bar": (1e5, (-1, 1, -2)),
    "C": (1.0, (0, 0, 1, 1)), "V": (1.0, (2, 1, -3, -1)), "ohm": (1.0, (2, 1, -3, -2)),
    "F": (1.0, (-2, -1, 4, 2)), "H": (1.0, (2, 1, -2, -2)), "Wb": (1.0, (2, 1, -2, -1)), "T": (1.0, (0, 1, -2, -1)),
}  # fmt: skip
"""Factor to SI and exponents of the bases, in their order; those that are left out are zero."""
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "h": 1e2, "k": 1e3, "M": 1e6}
_PREFIXED = ("m", "g", "l", "L", "s", "A", "K", "mol", "N", "J", "W", "Wh", "Pa", "bar", "C", "V", "ohm", "F", "H",
             "rad", "Hz")  # fmt: skip
_TERM = re.compile(r"([A-Za-z%]+|1|-)(?:\^?(-?\d+))?")
NEAR = 1e-9
"""Share by which factors that are equal may differ: rounding."""


@cache
def parsed(unit: str) -> tuple[float, tuple[int, ...]] | None:
    """Factor to SI and exponents of metre, kilogram, second, ampere, kelvin, mole, candela; None if it is not known.

    Factors stand side by side, or with ``*`` or ``·`` between them; what follows a ``/`` divides.

    Example:
        >>> parsed("N m"), parsed("mm/s"), parsed("furlong")
        ((1.0, (2, 1, -2, 0, 0, 0, 0)), (0.001, (1, 0, -1, 0, 0, 0, 0)), None)
    """
    text = unit.replace("µ", "u").replace("μ", "u").replace("°", "deg").replace("²", "^2").replace("³", "^3")
    factor, exponents = 1.0, [0] * len(BASES)
    for place, part in enumerate(text.replace("·", " ").replace("*", " ").split("/")):
        words = part.replace("(", " ").replace(")", " ").split()
        if not words:
            return None
        for word in words:
            found = _TERM.fullmatch(word)
            known = None if found is None else _named(found[1])
            if found is None or known is None:
                return None
            power = int(found[2] or 1) * (-1 if place else 1)
            factor *= known[0] ** power
            for i, exponent in enumerate(known[1]):
                exponents[i] += power * exponent
    return factor, tuple(exponents)


def _named(word: str) -> tuple[float, tuple[int, ...]] | None:
    if word in _KNOWN:
        return _KNOWN[word]
    if len(word) > 1 and word[0] in _PREFIXES and word[1:] in _PREFIXED:
        factor, exponents = _KNOWN[word[1:]]
        return _PREFIXES[word[0]] * factor, exponents
    return None


def differ(one: str, other: str) -> bool:
    """Whether two units are certainly not the same: both are known, and another quantity or of another size.

    Example:
        >>> differ("N m", "J"), differ("rad", "deg"), differ("m", "kg"), differ("m", "furlong")
        (False, True, True, False)
    """
    first, second = parsed(one), parsed(other)
    if first is None or second is None:
        return False
    return first[1] != second[1] or abs(first[0] - second[0]) > NEAR * abs(first[0])


def factor(one: str, other: str) -> float | None:
    """What a number in the first unit is multiplied by to be in the second; None if they are not known to be alike.

    Example:
        >>> factor("mm", "m"), factor("%", "-"), factor("m", "kg"), factor("degC", "K")
        (0.001, 0.01, None, None)
    """
    first, second = parsed(one), parsed(other)
    return first[0] / second[0] if first and second and first[1] == second[1] else None


def is_product(one: str, other: str, whole: str) -> bool:
    """Whether the product of two units may be a third; it certainly is not if all are known and it is another.

    Example:
        >>> is_product("N m", "rad/s", "W"), is_product("V", "rad/s", "W"), is_product("furlong", "1/s", "W")
        (True, False, True)
    """
    first, second, third = parsed(one), parsed(other), parsed(whole)
    if first is None or second is None or third is None:
        return True
    exponents = tuple(i + j for i, j in zip(first[1], second[1], strict=True))
    return exponents == third[1] and abs(first[0] * second[0] - third[0]) <= NEAR * third[0]


def alike(one: str, other: str) -> bool:
    """Whether two units may be of one quantity, whatever their size: the other way round, certainly of two.

    Example:
        >>> alike("mm", "m"), alike("mm", "kg"), alike("mm", "furlong")
        (True, False, True)
    """
    first, second = parsed(one), parsed(other)
    return first is None or second is None or first[1] == second[1]


def per_second(unit: str) -> str:
    """The unit of a rate of change, as it is written here.

    Example:
        >>> per_second("m"), per_second("J"), per_second("m/s"), per_second("-")
        ('m/s', 'W', 'm/s^2', '1/s')
    """
    written = {"J": "W", "C": "A", "-": "1/s", "1": "1/s", "N s": "N", "V s": "V"}
    if unit in written:
        return written[unit]
    base, power, count = unit.partition("/s^")
    if power and count.isdigit():
        return f"{base}/s^{int(count) + 1}"
    return f"{unit[:-2]}/s^2" if unit.endswith("/s") else f"{unit}/s"
