"""Names, units and plausible ranges of signals and parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
        periodic: True for an angle that may turn by full turns: networks see its sine and cosine, and wrapped
            recordings are unwrapped.
        saturation: Smallest and largest value [unit] that the sensor can show, ``(-inf, upper)`` or ``(lower, inf)`` if
            it has one end. A sample at or beyond an end is censored: it only bounds the true value from one side.
            Default: the sensor shows every value.

    Raises:
        InputError: With all problems: a field of a wrong kind, an empty range, an empty sensor range, or a sensor range
            of a periodic signal.

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
            "a periodic signal cannot have a saturation, since its sensor restarts at a full turn. Leave one of them "
            "out. [HM-MACHINE-021]",
        )  # fmt: skip
        own.refuse()

    @property
    def label(self) -> str:
        """Name with unit, as plots and tables print it."""
        return f"{self.name} [{self.unit}]"


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
        varies: Whether the parameter differs between recordings (docs/tracking.md): True, False, or its standard
            deviation between recordings [unit]. Default: the recordings decide.

    Raises:
        InputError: With all problems: a field of a wrong kind, a value outside its bounds, or a standard deviation that
            is not positive.

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
    varies: bool | Number | None = None

    def __post_init__(self) -> None:
        own = Fields(self, f"parameter {self.label}")
        own.need(
            "value lower upper", lambda: self.lower <= self.value <= self.upper,
            f"value {self.value} is outside its bounds [{self.lower}, {self.upper}] [HM-MACHINE-022]",
        )  # fmt: skip
        own.need(
            "varies", lambda: self.varies is None or isinstance(self.varies, bool) or self.varies > 0,
            f"varies must be True, False or a positive standard deviation, got {self.varies} [HM-MACHINE-045]",
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
