"""Units that recordings come in, and what turns them into the signals' own."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.signals import Signal

TURN = 2 * math.pi
UNITS: Mapping[str, Mapping[str, float]] = {
    "s": {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "rad": {"deg": TURN / 360, "mrad": 1e-3, "rev": TURN},
    "rad/s": {"deg/s": TURN / 360, "rev/s": TURN, "rpm": TURN / 60, "mrad/s": 1e-3},
    "m": {"mm": 1e-3, "cm": 1e-2, "um": 1e-6},
    "m/s": {"mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6},
    "N m": {"mN m": 1e-3, "N cm": 1e-2, "N mm": 1e-3, "kN m": 1e3},
    "N": {"mN": 1e-3, "kN": 1e3},
    "V": {"mV": 1e-3},
    "A": {"mA": 1e-3},
    "Pa": {"kPa": 1e3, "mbar": 1e2, "bar": 1e5},
    "kg": {"g": 1e-3},
    "W": {"mW": 1e-3, "kW": 1e3},
}
"""For each unit of a signal the units a recording may have, as multiples of it."""
FILLED = 0.01
"""Share of a signal's range that a column would have to fill in another unit for that unit to be proposed."""
SHARE = 0.05
"""Share of the samples beyond the range from which on a unit is proposed: a wrong unit is wrong in all rows."""
BEYOND = 4.0
"""Times the range's limit that a column must reach for a wrong unit to be proposed: less may be a wrong range."""


def factor(column: str, unit: str | float, signal: Signal) -> float:
    """What a column's numbers are multiplied by to be in the signal's unit.

    Args:
        column: Name of the column, for messages.
        unit: The column's unit by name, or the factor itself, e.g. 35.15 N/V for a force recorded as a voltage.
        signal: What the column is.

    Raises:
        InputError: If the unit is none of the signal's quantity, or the factor is zero or not finite.

    Example:
        >>> factor("time_ms", "ms", Signal("time", "s"))
        0.001
    """
    if isinstance(unit, str):
        known = {signal.unit: 1.0, **UNITS.get(signal.unit, {})}
        if unit in known:
            return known[unit]
        raise InputError(
            f"data specification: unit {unit!r} of column {column!r} is none for {signal.label}; there are: "
            f"{', '.join(known)}. Or give the factor to {signal.unit} as a number."
        )
    if not math.isfinite(unit) or unit == 0:
        raise InputError(
            f"data specification: factor {unit} of column {column!r} to {signal.label} must be finite and not zero"
        )
    return float(unit)


def likely_unit(column: NDArray[np.float64], signal: Signal) -> str:
    """Unit in which a column that leaves its signal's plausible range would be plausible; empty if there is none.

    It speaks only of a column that is beyond the range in many rows, far beyond (``BEYOND``), and that, in the other
    unit, keeps to the range and fills a hundredth of it at least: a value of 1e300 is in no unit.

    Args:
        column: The numbers ``(m,)``; what is not finite is in no unit.
        signal: What the column is.

    Example:
        >>> phi = Signal("phi", "rad", -3.2, 3.2)
        >>> likely_unit(np.array([0.0, 90.0, -120.0]), phi), likely_unit(np.array([0.0, 1e307]), phi)
        ('deg', '')
    """
    limit = max(abs(signal.lower), abs(signal.upper))
    largest = float(np.abs(column).max(initial=0.0))
    beyond = float(((column < signal.lower) | (column > signal.upper)).mean())
    if beyond < SHARE or not BEYOND * limit < largest < math.inf:
        return ""
    for unit, size in UNITS.get(signal.unit, {}).items():
        low, high = size * float(column.min()), size * float(column.max())
        if size * largest >= FILLED * limit and signal.lower <= low and high <= signal.upper:
            return unit
    return ""


def turn_of(signal: Signal) -> float | None:
    """A full turn in the signal's unit; None if the signal is no angle.

    Example:
        >>> turn_of(Signal("phi", "deg")), turn_of(Signal("q", "m"))
        (360.0, None)
    """
    radians = {"rad": 1.0, **UNITS["rad"]}.get(signal.unit)
    return None if radians is None else TURN / radians
