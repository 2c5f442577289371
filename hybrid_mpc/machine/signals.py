"""Names, units and plausible ranges of signals and parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.machine.units import turn_in
from hybrid_mpc.records import Fields
from hybrid_mpc.rules import Bound, Line, Name, Number, Unit


@dataclass(frozen=True)
class Signal:
    """A physical signal: a state, an input or an output.

    Args:
        name: Short name, e.g. ``"phi"``: letters and digits of any alphabet, ``_ . [ ] -`` and blanks
            (:func:`~hybrid_mpc.rules.name_problem`).
        unit: SI unit, e.g. ``"rad"``; ``"-"`` for none (:func:`~hybrid_mpc.rules.unit_problem`).
        lower: Smallest plausible value [unit]; smaller data are refused, smaller speeds differentiated from data raise
            a warning. Default: no bound.
        upper: Largest plausible value [unit], likewise. Default: no bound.
        periodic: True for an angle that may turn by full turns, in a unit of angles (``rad``, ``deg``, ``rev``, ...):
            networks see its sine and cosine, wrapped recordings are unwrapped, and observers move a sample by whole
            turns to their prediction.
        saturation: Smallest and largest value [unit] that the sensor can show, ``(-inf, upper)`` or ``(lower, inf)`` if
            it has one end. A sample at or beyond an end is censored: it only bounds the true value from one side.
            Default: the sensor shows every value.

    Raises:
        InputError: With all problems: a field of a wrong kind, an empty range, an empty sensor range, a sensor range
            of a periodic signal, or a periodic signal whose unit is not one of an angle.

    Example:
        >>> Signal("phi", "rad").label
        'phi [rad]'
        >>> Signal("level", "V", 0.0, 12.0, saturation=(0.0, 10.0)).saturation
        (0.0, 10.0)
    """

    name: Name
    unit: Unit
    lower: Bound = -math.inf
    upper: Bound = math.inf
    periodic: bool = False
    saturation: tuple[Bound, Bound] | None = None

    def __post_init__(self) -> None:
        own, ends = Fields(self, f"signal {self.label}"), self.saturation
        own.need(
            "lower upper",
            lambda: self.lower < self.upper,
            f"range [{self.lower}, {self.upper}] is empty: lower must be below upper [HM-MACHINE-019]",
        )
        own.need(
            "saturation", lambda: self.saturation is None or self.saturation[0] < self.saturation[1],
            f"saturation must be (lower, upper) of the sensor with lower < upper, got {ends} [HM-MACHINE-020]",
        )  # fmt: skip
        own.need(
            "saturation periodic", lambda: self.saturation is None or not self.periodic,
            "a periodic signal cannot have a saturation, since its sensor restarts at a full turn. Remove one of the "
            "two. [HM-MACHINE-021]",
        )  # fmt: skip
        own.need(
            "unit periodic", lambda: not self.periodic or turn_in(self.unit) is not None,
            f"periodic=True needs a unit of angles, which gives the period (rad, deg, rev, turn), got {self.unit}. "
            "Give the unit, or omit periodic. [HM-MACHINE-047]",
        )  # fmt: skip
        own.refuse()

    @property
    def period(self) -> float:
        """A full turn of a periodic signal [unit]; infinite if the signal is not periodic.

        Example:
            >>> Signal("psi", "deg", periodic=True).period, Signal("psi", "deg").period
            (360.0, inf)
        """
        turn = turn_in(self.unit) if self.periodic else None
        return math.inf if turn is None else turn

    @property
    def radians(self) -> float:
        """Factor from a periodic signal's unit to radians, exactly 1 for ``rad``; 0 if the signal is not periodic."""
        return 2.0 * math.pi / self.period

    def outside(self, values: ArrayLike) -> NDArray[np.bool_]:
        """Which ``values`` [unit] lie outside the range, apart from rounding: 1e-9 of the range or of its one end.

        Example:
            >>> Signal("level", "m", 0.0, 0.3).outside([0.1 + 0.2, 0.301, -1e-17]).tolist()
            [False, True, False]
        """
        given, ends = np.asarray(values, dtype=np.float64), (self.lower, self.upper)
        size = self.upper - self.lower
        if not math.isfinite(size):
            size = max((abs(end) for end in ends if math.isfinite(end)), default=0.0)
        return np.asarray((given < self.lower - 1e-9 * size) | (given > self.upper + 1e-9 * size))

    @property
    def label(self) -> str:
        """Name with unit, as plots and tables print it."""
        return f"{self.name} [{self.unit}]"


def nearest_turn(values: ArrayLike, to: ArrayLike, period: ArrayLike) -> NDArray[np.float64]:
    """Values moved by whole periods to those nearest to other values; not finite ones stay, as with infinite periods.

    A value at most half a period away stays as it is.

    Args:
        values: Values ``(..., n)``.
        to: The other values, likewise.
        period: Period of each ``(n,)``, in the unit of its values (:attr:`Signal.period`).

    Example:
        >>> nearest_turn([1.0, 5.0], [359.0, 359.0], [360.0, math.inf]).tolist()
        [361.0, 5.0]
    """
    moved, near, whole = (np.asarray(v, dtype=np.float64) for v in (values, to, period))
    with np.errstate(over="ignore", invalid="ignore"):
        turns = np.rint((moved - near) / whole)
        return np.where(np.isfinite(turns) & (turns != 0.0), moved - turns * whole, moved)


@dataclass(frozen=True)
class Parameter:
    """A physical parameter of a prior with its published value and the bounds of its fit.

    Args:
        name: Attribute name on the prior, e.g. ``"J"``.
        value: Nominal (published or data-sheet) value [unit].
        unit: SI unit.
        lower: Lower bound of the fit [unit].
        upper: Upper bound of the fit [unit]. ``lower == upper`` keeps the parameter fixed.
        description: A few words, printed in tables.
        varies: Whether the parameter differs between recordings (docs/tracking.md): True, False, its standard
            deviation between recordings [unit], or ``(deviation, time)`` with the time constant [s] of its drift within
            them. Default: the recordings decide.

    Raises:
        InputError: With all problems: a field of a wrong kind, a value outside its bounds, or a standard deviation or
            time that is not positive.

    Example:
        >>> Parameter("m", 0.5, "kg", 0.1, 2.0).fixed
        False
    """

    name: Name
    value: Number
    unit: Unit
    lower: Bound
    upper: Bound
    description: Line = ""
    varies: bool | Number | tuple[Number, Number] | None = None

    def __post_init__(self) -> None:
        own = Fields(self, f"parameter {self.label}")
        own.need(
            "value lower upper", lambda: self.lower <= self.value <= self.upper,
            f"value {self.value} is outside its bounds [{self.lower}, {self.upper}] [HM-MACHINE-022]",
        )  # fmt: skip
        own.need(
            "varies", lambda: self.varies is None or isinstance(self.varies, bool) or np.min(self.varies) > 0,
            "varies must be True, False, a positive standard deviation, or that and a positive time, got "
            f"{self.varies} [HM-MACHINE-045]",
        )  # fmt: skip
        own.refuse()

    @property
    def fixed(self) -> bool:
        """True if the fit does not change this parameter."""
        return self.lower == self.upper

    @property
    def label(self) -> str:
        """Name with unit."""
        return f"{self.name} [{self.unit}]"
