"""Readings of a machine in each period: channels with a unit, and the predicted motion of sensors that repeat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
ENERGY, RESIDUALS = "energy", "residuals"
"""The kinds of readings: :class:`~hybrid_mpc.watch.energy.EnergyReadings`, for mechanical machines, and
:class:`~hybrid_mpc.watch.residuals.ResidualReadings`, for any."""
FROZEN_STEPS = 3.0
"""Predicted motion, in steps of the sensor, from which on repeated readings mean a frozen sensor."""


class Validity(IntEnum):
    """Whether a reading is valid, and if not, why."""

    VALID = 0
    """All required values are numbers."""
    WARM_UP = 1
    """The window is not full yet."""
    MISSING = 2
    """A measurement or input is missing."""
    NOT_FINITE = 3
    """Nothing is missing, but model or estimator gave a non-finite value."""


SECONDS: Mapping[Validity, str] = MappingProxyType(
    {
        Validity.VALID: "valid_s",
        Validity.WARM_UP: "warm_up_s",
        Validity.MISSING: "missing_s",
        Validity.NOT_FINITE: "not_finite_s",
    }
)
"""Names of the seconds of each validity in results."""


@dataclass(frozen=True)
class Channel:
    """A reading of the monitor: one number per period.

    Args:
        name: Its name.
        unit: Its unit.
        kind: Description. Default: none.
    """

    name: str
    unit: str
    kind: str = ""


@dataclass(frozen=True)
class Test:
    """Test of a channel, given by its index: ``length`` of the mean in samples (0: a cumulative sum with dead band
    ``drift`` [deviations]). ``may_be_zero``: the channel may be constant zero in nominal data.
    """

    channel: int
    length: int
    drift: float = 0.0
    may_be_zero: bool = False


@dataclass(frozen=True)
class Sample:
    """Readings of one period.

    Args:
        values: One number for each channel [its unit]; NaN if unknown.
        terms: Regressors of the variance of nominal values, for each channel; empty if it is constant.
        travel: Predicted motion of each output since its reading last changed ``(n_y,)`` [its unit].
        repeats: Number of samples since that change ``(n_y,)``.
        inside: Which outputs lie inside their sensors' ranges ``(n_y,)``.
        settled: Whether the values count: the estimator has settled.
        validity: Whether the values are valid, and if not, why.
    """

    values: Sequence[float] | Array
    terms: Sequence[Sequence[float]]
    travel: Sequence[float] | Array
    repeats: Sequence[int] | NDArray[np.int_]
    inside: Sequence[bool] | NDArray[np.bool_]
    settled: bool
    validity: Validity


class Readings(Protocol):
    """A kind of readings of a model's machine; a pure function of its state."""

    kind: str
    model: HybridModel
    channels: tuple[Channel, ...]
    patience: int
    """Largest number of successive samples without a valid reading that is no alarm."""
    n_terms: int
    """Number of regressors of a variance; 0 if values are not scaled."""
    tests: tuple[Test, ...]
    """Tests for which limits are learned."""

    def initial(self) -> Any:
        """State before the first sample."""

    def update(self, state: Any, y: Array, u_prev: Array, estimate: Any) -> tuple[Any, Sample]:
        """Next state and sample, from the measurement ``y`` ``(n_y,)``, the input ``(n_u,)`` applied over the period
        that just ended, and the estimate at this sample.
        """
