"""The lengths of monitor, detector and guard in the machine's own seconds, and the speed below which it is at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.data.scales import COARSEST, Outputs, noise_of, periods, speed_gain, speeds_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
WINDOW_S = 0.2
"""Window of the guard's derivative: half of it is how late a reading is, and its noise grows with length^-2.5."""
AVERAGE_S = 0.1
"""Beyond a window, so long may a monitor be without a valid reading: half a window."""
FREE_RUN_S = 0.6
"""Length of the model's free runs: three windows."""
SHORT_S, LONG_S = 0.3, 3.0
"""Lengths of the two averages of residuals: one is soon there, one shows what is small and lasts."""
SETTLING_S = 1.0
"""Beginning of a recording that nothing is learned from: the estimator does not know the speed yet."""
BLOCK_S = 5.0
"""Blocks whose largest levels tell the rate of false alarms: much longer than what one sample does to the next."""
SHORTEST_S = 0.08
"""A free run counts from this accumulated time on."""
NOTHING_STICKS = 1e-12
"""Rest speed, in any unit, where none was found in recordings and none is given: nothing is known to stick."""
SHARE = 0.05
"""Share of the speed at work below which friction may stick: on the recorded machines the smoothed step of the priors'
dry friction (0.002 m/s to 0.1 rad/s) has risen to 99 % there."""
QUANTILE = 0.99
"""Quantile of the speeds in motion that counts as speed at work: an outlier or a blow by hand moves it little."""
DEVIATIONS = 3.0
"""Speeds within so many deviations of the sensor's noise count as no motion."""


def seconds(length: float, model: HybridModel) -> float:
    """A length of this module [the machine's seconds] in seconds."""
    return length * model.time_unit


def samples(length: float, model: HybridModel, fewest: int = 1) -> int:
    """A length of this module in periods of a model, at least ``fewest``."""
    return periods(seconds(length, model), model.dt, fewest)


def half_window(length: float, model: HybridModel) -> int:
    """Samples to either side of the centre of a window of that length: two at least, for a cubic needs five."""
    return samples(0.5 * length, model, 2)


def settling_samples(model: HybridModel) -> int:
    """Samples at the beginning of a recording that nothing is learned from."""
    return periods(SETTLING_S * machine_second(model.dt, model.time_unit), model.dt)


def machine_second(dt: float, time_unit: float) -> float:
    """The machine's second [s] where it must hold samples: no shorter than ten periods.

    Example:
        >>> [machine_second(dt, 1.0) for dt in (0.02, 5.0)]
        [1.0, 50.0]
    """
    return max(time_unit, COARSEST * dt)


def block_seconds(dt: float, time_unit: float = 1.0) -> float:
    """Length [s] of a block: of ``BLOCK_S`` of the machine's seconds (:func:`machine_second`)."""
    return BLOCK_S * machine_second(dt, time_unit)


def rest_speeds(recordings: Sequence[Outputs], model: HybridModel) -> tuple[float, ...]:
    """Speeds, one for each degree of freedom, below which friction may stick [unit of v].

    A twentieth of the speed at work (the 99 % quantile of the speeds in motion), but no less than three deviations of
    what the sensor's noise and steps make of a speed. Speeds are slopes of cubics over the guard's window.

    Args:
        recordings: Positions ``y`` ``(n, n_q)`` on the model's grid, in which nothing is wrong: the training ones.
        model: Whose period and unit of time make the window.

    Raises:
        InputError: If there is no recording as long as the window, or nothing moves in them.

    Example:
        ``rest_speeds(dataset.by_role("train"), artifact.models["hybrid"])``
    """
    half = half_window(WINDOW_S, model)
    long = [r for r in recordings if len(r.y) > 2 * half]
    if not long:
        raise InputError(
            f"rest speeds: no recording has the {2 * half + 1} samples ({(2 * half + 1) * model.dt:g} s) of the "
            "guard's window; give longer ones [HM-WATCH-027]"
        )
    speeds = np.abs(np.concatenate([speeds_of(r, model.dt, half) for r in long]))
    least = DEVIATIONS * noise_of(long) * speed_gain(model.dt, half)
    found = []
    for v, noise in zip(speeds.T, least.tolist(), strict=True):
        moving = v[v > noise]
        found.append(max(SHARE * float(np.quantile(moving, QUANTILE)) if moving.size else 0.0, noise))
    if not min(found) > 0:
        names = [s.name for s, rest in zip(model.outputs, found, strict=True) if not rest > 0]
        raise InputError(
            f"rest speeds: {', '.join(names)} never moves in the recordings; give some in motion [HM-WATCH-028]"
        )
    return tuple(found)


def checked_rest(rest_speed: ArrayLike, n_q: int, what: str) -> tuple[float, ...]:
    """Rest speeds of ``n_q`` degrees of freedom, from as many or from one for all; positive."""
    values = np.asarray(rest_speed, dtype=float).ravel()
    if values.size not in (1, n_q) or not (np.all(np.isfinite(values)) and np.all(values > 0)):
        raise InputError(
            f"{what}: rest_speed must be {n_q} positive speeds, one a degree of freedom (or one for all); got "
            f"{values.tolist()} [HM-WATCH-029]"
        )
    return tuple(np.broadcast_to(values, n_q).tolist())
