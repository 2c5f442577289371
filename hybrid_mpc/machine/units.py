"""Relations between units, e.g. ``m`` and ``mm``, ``J`` and ``W``. Unknown units never cause an error.

One table serves columns of recordings, ``hybrid-mpc new`` and checks of a prior. The project has its own table because
units libraries treat radians as pure numbers and convert 1 Hz to 1 rad/s, which is wrong by a factor of 6.28.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cache

BASES = ("m", "kg", "s", "A", "K", "mol", "cd")
_N, _J, _W = (1.0, (1, 1, -2)), (1.0, (2, 1, -2)), (1.0, (2, 1, -3))
_KNOWN: dict[str, tuple[float, tuple[int, ...]]] = {
    "1": (1.0, ()), "-": (1.0, ()), "%": (1e-2, ()), "ppm": (1e-6, ()), "rad": (1.0, ()), "deg": (math.pi / 180, ()),
    "rev": (2 * math.pi, ()), "turn": (2 * math.pi, ()), "rpm": (2 * math.pi / 60, (0, 0, -1)),
    "rps": (2 * math.pi, (0, 0, -1)), "arcmin": (math.pi / 10800, ()), "arcsec": (math.pi / 648000, ()),
    "m": (1.0, (1,)), "l": (1e-3, (3,)), "L": (1e-3, (3,)), "cc": (1e-6, (3,)), "ccm": (1e-6, (3,)),
    "inch": (0.0254, (1,)), "in": (0.0254, (1,)), "ft": (0.3048, (1,)), "yd": (0.9144, (1,)), "mile": (1609.344, (1,)),
    "gal": (3.785411784e-3, (3,)), "lpm": (1e-3 / 60, (3, 0, -1)), "gpm": (3.785411784e-3 / 60, (3, 0, -1)),
    "kmh": (1 / 3.6, (1, 0, -1)), "kph": (1 / 3.6, (1, 0, -1)), "mph": (0.44704, (1, 0, -1)),
    "kn": (1852 / 3600, (1, 0, -1)),
    "g": (1e-3, (0, 1)), "t": (1e3, (0, 1)), "lb": (0.45359237, (0, 1)), "oz": (0.028349523125, (0, 1)),
    "lbf": (4.4482216152605, (1, 1, -2)), "kgf": (9.80665, (1, 1, -2)),
    "psi": (6894.757293168, (-1, 1, -2)), "atm": (101325.0, (-1, 1, -2)), "Torr": (101325 / 760, (-1, 1, -2)),
    "mmHg": (133.322387415, (-1, 1, -2)), "cal": (4.184, (2, 1, -2)), "BTU": (1055.05585262, (2, 1, -2)),
    "hp": (745.6998715822702, (2, 1, -3)), "Ah": (3600.0, (0, 0, 1, 1)), "VA": _W, "S": (1.0, (-2, -1, 3, 2)),
    "Nm": _J, "Ncm": (1e-2, (2, 1, -2)), "Nmm": (1e-3, (2, 1, -2)), "mNm": (1e-3, (2, 1, -2)), "kNm": (1e3, (2, 1, -2)),
    "degC": (1.0, (0, 0, 0, 0, 1)), "degF": (5 / 9, (0, 0, 0, 0, 1)), "degR": (5 / 9, (0, 0, 0, 0, 1)),
    "s": (1.0, (0, 0, 1)), "min": (60.0, (0, 0, 1)), "h": (3600.0, (0, 0, 1)), "Hz": (1.0, (0, 0, -1)),
    "A": (1.0, (0, 0, 0, 1)), "K": (1.0, (0, 0, 0, 0, 1)), "mol": (1.0, (0, 0, 0, 0, 0, 1)),
    "cd": (1.0, (0, 0, 0, 0, 0, 0, 1)),
    "N": _N, "J": _J, "W": _W, "Wh": (3600.0, (2, 1, -2)), "Pa": (1.0, (-1, 1, -2)), "bar": (1e5, (-1, 1, -2)),
    "C": (1.0, (0, 0, 1, 1)), "V": (1.0, (2, 1, -3, -1)), "ohm": (1.0, (2, 1, -3, -2)),
    "F": (1.0, (-2, -1, 4, 2)), "H": (1.0, (2, 1, -2, -2)), "Wb": (1.0, (2, 1, -2, -1)), "T": (1.0, (0, 1, -2, -1)),
}  # fmt: skip
"""Factor to SI and exponents of the base units, in their order; missing ones are zero."""
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "h": 1e2, "k": 1e3, "M": 1e6}
_PREFIXED = ("m", "g", "l", "L", "s", "A", "Ah", "K", "mol", "N", "J", "W", "Wh", "Pa", "bar", "C", "V", "VA", "ohm",
             "F", "H", "S", "T", "rad", "Hz", "cal")  # fmt: skip
_ALIASES = {
    "pct": "%", "percent": "%", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad",
    "turns": "turn", "revs": "rev", "revolutions": "rev", "U": "rev", "Ohm": "ohm", "Ω": "ohm", "volt": "V",
    "volts": "V", "amp": "A", "amps": "A", "ampere": "A", "amperes": "A", "watt": "W", "watts": "W",
    "newton": "N", "newtons": "N", "pascal": "Pa", "joule": "J", "joules": "J", "meter": "m", "meters": "m",
    "metre": "m", "metres": "m", "liter": "l", "liters": "l", "litre": "l", "litres": "l", "kelvin": "K",
    "celsius": "degC", "Celsius": "degC", "fahrenheit": "degF", "Fahrenheit": "degF", "gram": "g",
    "grams": "g", "hertz": "Hz", "upm": "rpm", "Upm": "rpm", "RPM": "rpm",
}  # fmt: skip
"""Other spellings of the same units."""
_ZEROS = {"K": 0.0, "degC": 273.15, "degF": 459.67 * 5 / 9, "degR": 0.0}
"""Zero of each temperature scale [K]."""
_TURNING = frozenset({"rad", "deg", "rev", "turn", "rpm", "rps", "arcmin", "arcsec", "mrad", "urad"})
"""Units of a rotation angle or its rate."""
_TERM = re.compile(r"([A-Za-z%]+|1|-)(?:\^?(-?\d+))?")
_TIMES = {
    1.0: "s sec secs second seconds", 1e-3: "ms msec msecs millis millisecond milliseconds",
    1e-6: "us usec usecs micros microsecond microseconds", 1e-9: "ns nsec nsecs nanos nanosecond nanoseconds",
    60.0: "min mins minute minutes", 3600.0: "h hr hrs hour hours", 86400.0: "d day days",
}  # fmt: skip
"""Spellings of the units of time, by their length [s]."""
NEAR = 1e-9
"""Relative deviation of equal factors: rounding."""


@cache
def parse_unit(unit: str) -> tuple[float, tuple[int, ...]] | None:
    """Factor to SI and exponents of metre, kilogram, second, ampere, kelvin, mole, candela; None if unknown.

    Factors are separated by blanks, ``*`` or ``·``; everything after a ``/`` divides.

    Example:
        >>> parse_unit("N m"), parse_unit("mm/s"), parse_unit("furlong")
        ((1.0, (2, 1, -2, 0, 0, 0, 0)), (0.001, (1, 0, -1, 0, 0, 0, 0)), None)
    """
    text = unit.replace("µ", "u").replace("μ", "u").replace("°", "deg").replace("²", "^2").replace("³", "^3")
    text = text.replace("⋅", " ").replace("⁻", "-").replace("−", "-").replace("¹", "1").replace("**", "^")
    text = re.sub(r"(?<=[A-Za-z])\.(?=[A-Za-z])", " ", text)
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
    word = _ALIASES.get(word, word)
    if word in _KNOWN:
        return _KNOWN[word]
    if seconds := next((size for size, names in _TIMES.items() if word in names.split()), None):
        return seconds, (0, 0, 1)
    if len(word) > 1 and word[0] in _PREFIXES and word[1:] in _PREFIXED:
        factor, exponents = _KNOWN[word[1:]]
        return _PREFIXES[word[0]] * factor, exponents
    return None


def differ(one: str, other: str) -> bool:
    """Whether two units certainly differ: both are known, and have different quantities or sizes.

    Example:
        >>> differ("N m", "J"), differ("rad", "deg"), differ("m", "kg"), differ("m", "furlong")
        (False, True, True, False)
    """
    first, second = parse_unit(one), parse_unit(other)
    if first is None or second is None:
        return False
    return first[1] != second[1] or abs(first[0] - second[0]) > NEAR * abs(first[0])


@dataclass(frozen=True)
class Conversion:
    """A conversion of units: ``factor * value + offset``."""

    factor: float
    offset: float = 0.0


def conversion(one: str, other: str) -> Conversion | str:
    """The conversion of numbers from the first unit to the second; or why there is none, as the end of a sentence.

    Temperature scales have their own zeros. Rotation and frequency are converted by turns: 1 Hz is 6.28 rad/s, 60 1/min
    are 1 Hz. ``1/s`` is ambiguous: it may be ``rad/s`` or turns per second.

    Example:
        >>> conversion("mm", "m"), conversion("degC", "K"), conversion("Hz", "rad/s").factor
        (Conversion(factor=0.001, offset=0.0), Conversion(factor=1.0, offset=273.15), 6.283185307179586)
        >>> conversion("1/s", "rad/s"), conversion("m", "kg"), conversion("furlong", "m")
        ('which is ambiguous: radians or turns', 'which is another quantity', 'which is not known')
    """
    if plain(one) == plain(other):
        return Conversion(1.0)
    first, second = parse_unit(one), parse_unit(other)
    if first is None or second is None:
        return "which is not known"
    if first[1] != second[1]:
        return "which is another quantity"
    size = first[0] / second[0]
    scales = [_ZEROS.get(_ALIASES.get(plain(unit), plain(unit))) for unit in (one, other)]
    if scales[0] is not None and scales[1] is not None:
        return Conversion(size, (scales[0] - scales[1]) / second[0])
    turning = [any(word in _TURNING for word in _words(unit)) for unit in (one, other)]
    if turning[0] != turning[1] and first[1][:3] in ((0, 0, -1), (0, 0, -2)) and not any(first[1][3:]):
        cycles = _words(one if turning[1] else other)
        if not {"Hz", "kHz", "MHz", "min", "h"} & set(cycles):
            return "which is ambiguous: radians or turns"
        size *= 2 * math.pi if turning[1] else 1 / (2 * math.pi)
    return Conversion(size)


def turn_in(unit: str) -> float | None:
    """A full turn in a unit of angles; None for every other unit.

    Example:
        >>> turn_in("rad") == 2 * math.pi, turn_in("deg"), turn_in("rev"), turn_in("m"), turn_in("-")
        (True, 360.0, 1.0, None, None)
    """
    found = conversion("rev", unit)
    angle = isinstance(found, Conversion) and any(word in _TURNING for word in _words(unit))
    return found.factor if isinstance(found, Conversion) and angle else None


def plain(unit: str) -> str:
    """A unit in one spelling.

    Example:
        >>> plain("N·m"), plain("°C"), plain("µs") == plain("μs")
        ('Nm', 'degC', True)
    """
    for mark, written in (("µ", "u"), ("μ", "u"), ("°", "deg"), ("²", "^2"), ("³", "^3")):
        unit = unit.replace(mark, written)
    return re.sub(r"[ ·⋅*]", "", unit)


def _words(unit: str) -> list[str]:
    """Names of units in a unit, in one spelling."""
    return [_ALIASES.get(word, word) for word in re.findall(r"[A-Za-z%]+", unit.replace("°", "deg"))]


def is_product(one: str, other: str, whole: str) -> bool:
    """Whether the product of two units may be a third: False only if all are known and the product differs.

    Example:
        >>> is_product("N m", "rad/s", "W"), is_product("V", "rad/s", "W"), is_product("furlong", "1/s", "W")
        (True, False, True)
    """
    first, second, third = parse_unit(one), parse_unit(other), parse_unit(whole)
    if first is None or second is None or third is None:
        return True
    exponents = tuple(i + j for i, j in zip(first[1], second[1], strict=True))
    return exponents == third[1] and abs(first[0] * second[0] - third[0]) <= NEAR * third[0]


def alike(one: str, other: str) -> bool:
    """Whether two units may measure the same quantity, whatever their size.

    Example:
        >>> alike("mm", "m"), alike("mm", "kg"), alike("mm", "furlong")
        (True, False, True)
    """
    first, second = parse_unit(one), parse_unit(other)
    return first is None or second is None or first[1] == second[1]


def per_second(unit: str) -> str:
    """The unit of a rate of change.

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


def time_factor(unit: str) -> float | None:
    """Seconds per unit; None if it is no unit of time.

    Example:
        >>> time_factor("msec"), time_factor("hr"), time_factor("V")
        (0.001, 3600.0, None)
    """
    plain = unit.strip().casefold().replace("µ", "u").replace("μ", "u").removesuffix(".")
    return next((factor for factor, names in _TIMES.items() if plain in names.split()), None)
