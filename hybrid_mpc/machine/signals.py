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
        saturation: Smallest and largest value [unit] that the sensor can show, ``(-inf, upper)`` or ``(lower, inf)``
            if it has one end. A sample at or beyond an end is censored: it says only that the truth is at least, or at
            most, this. Default: the sensor shows every value.

    Raises:
        InputError: If the range is empty, the sensor's range is, or it is that of a periodic signal.

    Example:
        >>> Signal("phi", "rad").label
        'phi [rad]'
        >>> Signal("level", "V", 0.0, 12.0, saturation=(0.0, 10.0)).saturation
        (0.0, 10.0)
    """

    name: str
    unit: str
    lower: float = -math.inf
    upper: float = math.inf
    periodic: bool = False
    saturation: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise InputError(f"signal {self.label}: its range [{self.lower}, {self.upper}] is empty")
        if self.saturation is not None:
            self._check_saturation(tuple(self.saturation))

    def _check_saturation(self, ends: tuple[float, ...]) -> None:
        """Refuse a sensor's range that is none."""
        if len(ends) != 2 or not ends[0] < ends[1]:
            raise InputError(
                f"signal {self.label}: saturation must be (lower, upper) of the sensor with lower < upper, got {ends}"
            )
        if self.periodic:
            raise InputError(
                f"signal {self.label}: a periodic signal has no saturation; its sensor begins again at a full turn. "
                "Leave one of them out."
            )

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
