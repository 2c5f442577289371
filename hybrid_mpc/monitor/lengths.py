"""The lengths of monitor, detector and guard, all in the machine's own seconds (:func:`hybrid_mpc.data.time_unit`)."""

from __future__ import annotations

from hybrid_mpc.data.scales import COARSEST, periods
from hybrid_mpc.model import HybridModel

WINDOW_S = 0.2
"""Window of the guard's derivative: half of it is how late a reading is, and its noise grows with length^-2.5."""
AVERAGE_S = 0.1
FREE_RUN_S = 0.6
HISTORY_S = 2.0
LEVEL_S = 0.3
"""Window of the main job's monitor, for its derivative and for the average that makes its level."""
SETTLING_S = 1.0
"""Beginning of a recording that nothing is learned from: the estimator does not know the speed yet."""
BLOCK_S = 5.0
"""Blocks whose largest levels tell the rate of false alarms: much longer than what one sample does to the next."""
SHORTEST_S = 0.08
"""Accumulated times of a free run below this say little."""


def seconds(length: float, model: HybridModel) -> float:
    """A length of this module in seconds on the machine of a model.

    Args:
        length: In the machine's seconds.
        model: The model, which holds its ``time_unit``.
    """
    return length * model.time_unit


def samples(length: float, model: HybridModel, fewest: int = 1) -> int:
    """A length of this module in periods of a model, at least ``fewest``."""
    return periods(seconds(length, model), model.dt, fewest)


def half_window(length: float, model: HybridModel) -> int:
    """Samples to either side of the centre of a window of that length: two at least, for a cubic needs five."""
    return samples(0.5 * length, model, 2)


def block_seconds(dt: float, time_unit: float = 1.0) -> float:
    """Length [s] of a block: of ``BLOCK_S`` of the machine's seconds, which are no fewer than 10 periods.

    Args:
        dt: Period [s].
        time_unit: The machine's second [s]. Default 1.

    Example:
        >>> block_seconds(0.02), block_seconds(0.02, 10.0), block_seconds(2.0)
        (5.0, 50.0, 100.0)
    """
    return BLOCK_S * max(time_unit, COARSEST * dt)
