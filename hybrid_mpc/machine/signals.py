"""Names, units and plausible ranges of signals and parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hybrid_mpc.errors import InputError


@dataclass(frozen=True)
class Signal:
    """A physical signal: a state, an input or an output.

    Args:
        name: Short name, e.g. ``"phi"``.
        unit: SI unit, e.g. ``"rad"``; ``"-"`` for none.
        lower: Smallest plausible value [unit]; data below it are refused, speeds
            differentiated from them raise a warning. Default: no bound.
        upper: Largest plausible value [unit], likewise. Default: no bound.
        periodic: True for an angle that may turn through: networks see its sine and cosine, and recordings that jump by
            full turns are made to count on.

    Raises:
        InputError: If the range is empty.

    Example:
        >>> Signal("phi", "rad").label
        'phi [rad]'
    """

    name: str
    unit: str
    lower: float = -math.inf
    upper: float = math.inf
    periodic: bool = False

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise InputError(f"signal {self.label}: its range [{self.lower}, {self.upper}] is empty")

    @property
    def label(self) -> str:
        """Name with unit, as plots and tables print it."""
        return f"{self.name} [{self.unit}]"


@dataclass(frozen=True)
class Parameter:
    """A physical parameter of a prior with its published value and the bounds its fit must keep.

    Args:
        name: Attribute name on the prior, e.g. ``"J"``.
        value: Nominal (published or data-sheet) value [unit].
        unit: SI unit.
        lower: Lower bound of the fit [unit].
        upper: Upper bound of the fit [unit]. ``lower == upper`` keeps the parameter fixed.
        description: A few words, printed in tables.

    Raises:
        InputError: If the value lies outside its bounds.

    Example:
        >>> Parameter("m", 0.5, "kg", 0.1, 2.0).fixed
        False
    """

    name: str
    value: float
    unit: str
    lower: float
    upper: float
    description: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.value) and self.lower <= self.value <= self.upper):
            raise InputError(
                f"parameter {self.name} [{self.unit}]: value {self.value} is not within its bounds "
                f"[{self.lower}, {self.upper}]"
            )

    @property
    def fixed(self) -> bool:
        """True if the fit leaves this parameter alone."""
        return self.lower == self.upper

    @property
    def label(self) -> str:
        """Name with unit."""
        return f"{self.name} [{self.unit}]"
