"""What is read of a machine each period: channels with a unit, the travel of sensors that repeat themselves."""

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
"""Steps of the sensor that must be predicted while it repeats itself."""


class Validity(IntEnum):
    """Whether a reading is valid, and if not, why."""

    VALID = 0
    """All values that a valid reading needs are numbers."""
    WARM_UP = 1
    """The window was not full yet."""
    MISSING = 2
    """A measurement or input was missing."""
    NOT_FINITE = 3
    """Nothing was missing, but model or estimator gave no finite number."""


SECONDS: Mapping[Validity, str] = MappingProxyType(
    {
        Validity.VALID: "valid_s",
        Validity.WARM_UP: "warm_up_s",
        Validity.MISSING: "missing_s",
        Validity.NOT_FINITE: "not_finite_s",
    }
)
"""Names under which results count the seconds of each."""


@dataclass(frozen=True)
class Channel:
    """A named reading: a number per period, with its unit. ``kind`` is what it reads, in words."""

    name: str
    unit: str
    kind: str = ""


@dataclass(frozen=True)
class Test:
    """How a channel, by its number, is compared: over how many samples (0: a cumulative sum of what exceeds ``drift``
    deviations). ``may_be_zero``: nominal data may not show how large the channel gets.
    """

    channel: int
    length: int
    drift: float = 0.0
    may_be_zero: bool = False


@dataclass(frozen=True)
class Sample:
    """What was read in one period.

    Args:
        values: One number for each channel [its unit]; NaN where unknown.
        terms: What the variances of nominal values are linear in, for each channel. Default: they are constant.
        travel: How far each output was predicted to move since its sensor last moved ``(n_y,)`` [its unit].
        repeats: Samples since then ``(n_y,)``.
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
    """A kind of readings of a model's machine; pure, the memory is the state that it returns."""

    kind: str
    model: HybridModel
    channels: tuple[Channel, ...]
    patience: int
    """Samples in a row without a valid reading that are no alarm."""
    n_terms: int
    """Terms of a variance; 0 where values are compared as they are."""
    tests: tuple[Test, ...]
    """What is learned a limit for."""

    def initial(self) -> Any:
        """State before the first sample."""

    def update(self, state: Any, y: Array, u_prev: Array, estimate: Any) -> tuple[Any, Sample]:
        """Next state and sample, from measurement ``y`` ``(n_y,)``, the input ``(n_u,)`` that acted over the period
        that just ended, and the estimate at this sample.
        """
