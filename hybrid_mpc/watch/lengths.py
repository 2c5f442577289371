"""Lengths of monitor, detector and guard in time constants of the machine, and the speed that counts as rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.data.scales import COARSEST, Outputs, noise_of, periods, speed_gain, speeds_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
WINDOW_S = 0.2
"""Window of the derivative: its delay is half the window, and its noise is proportional to length^-2.5."""
AVERAGE_S = 0.1
"""Time without a valid reading, beyond a window, that is no alarm: half a window."""
FREE_RUN_S = 0.6
"""Length of the model's free runs: three windows."""
SHORT_S, LONG_S = 0.3, 3.0
"""Lengths of the two averages of residuals: the short one reacts fast, the long one detects small lasting changes."""
SETTLING_S = 1.0
"""Settling time of the estimator at the beginning of a recording; these samples are not used for learning."""
BLOCK_S = 5.0
"""Length of the blocks whose maxima give the rate of false alarms: much longer than the correlation time."""
SHORTEST_S = 0.08
"""Shortest evaluated time of a free run."""
NOTHING_STICKS = 1e-12
"""Rest speed, in any unit, if none is known: nothing sticks."""
SHARE = 0.05
"""Share of the working speed below which friction may stick: at this speed the smoothed dry friction of the priors of
the recorded machines (0.002 m/s to 0.1 rad/s) has reached 99 %."""
QUANTILE = 0.99
"""Quantile of the speeds in motion that counts as working speed; it is robust to outliers and pushes by hand."""


def seconds(length: float, model: HybridModel) -> float:
    """A length of this module [time constants of the machine] in seconds."""
    return length * model.time_unit


def samples(length: float, model: HybridModel, fewest: int = 1) -> int:
    """A length of this module in periods of a model, at least ``fewest``."""
    return periods(seconds(length, model), model.dt, fewest)


def half_window(length: float, model: HybridModel) -> int:
    """Samples on each side of a window's centre: at least two, since a cubic needs five samples."""
    return samples(0.5 * length, model, 2)


def settling_samples(model: HybridModel) -> int:
    """Samples at the beginning of a recording that are not used for learning."""
    return periods(SETTLING_S * machine_second(model.dt, model.time_unit), model.dt)


def machine_second(dt: float, time_unit: float) -> float:
    """Time constant of the machine [s], at least ten periods.

    Example:
        >>> [machine_second(dt, 1.0) for dt in (0.02, 5.0)]
        [1.0, 50.0]
    """
    return max(time_unit, COARSEST * dt)


def block_seconds(dt: float, time_unit: float = 1.0) -> float:
    """Length [s] of a block: ``BLOCK_S`` time constants of the machine (:func:`machine_second`)."""
    return BLOCK_S * machine_second(dt, time_unit)


def rest_speeds(recordings: Sequence[Outputs], model: HybridModel) -> tuple[float, ...]:
    """Speeds below which friction may stick [unit of v], one for each degree of freedom.

    They are 5 % of the working speed (the 99 % quantile of the speeds in motion), but at least three standard
    deviations of a speed due to sensor noise and resolution. Speeds are slopes of cubics over the window.

    Args:
        recordings: Positions ``y`` ``(n, n_q)`` of fault-free recordings on the model's grid.
        model: The model; its period and time constant determine the window.

    Raises:
        InputError: If every recording is shorter than the window, or a position never moves.

    Example:
        ``rest_speeds(dataset.by_role("train"), artifact.models["hybrid"])``
    """
    half = half_window(WINDOW_S, model)
    long = [r for r in recordings if len(r.y) > 2 * half]
    if not long:
        raise InputError(
            f"rest speeds: every recording is shorter than the window of {2 * half + 1} samples "
            f"({(2 * half + 1) * model.dt:g} s). Give longer recordings [HM-WATCH-027]"
        )
    speeds = np.abs(np.concatenate([speeds_of(r, model.dt, half) for r in long]))
    # speeds within this many standard deviations of the sensor noise count as rest
    least = 3.0 * noise_of(long) * speed_gain(model.dt, half)
    found = []
    for v, noise in zip(speeds.T, least.tolist(), strict=True):
        moving = v[v > noise]
        found.append(max(SHARE * float(np.quantile(moving, QUANTILE)) if moving.size else 0.0, noise))
    if not min(found) > 0:
        names = [s.name for s, rest in zip(model.outputs, found, strict=True) if not rest > 0]
        raise InputError(
            f"rest speeds: {', '.join(names)} never moves in the recordings. Record the machine in motion "
            "[HM-WATCH-028]"
        )
    return tuple(found)


def checked_rest(rest_speed: ArrayLike, n_q: int, what: str) -> tuple[float, ...]:
    """Positive rest speeds of ``n_q`` degrees of freedom, from ``n_q`` values or from one for all."""
    values = np.asarray(rest_speed, dtype=float).ravel()
    if values.size not in (1, n_q) or not (np.all(np.isfinite(values)) and np.all(values > 0)):
        raise InputError(
            f"{what}: rest_speed must be {n_q} positive speeds, one for each degree of freedom, or one for all; got "
            f"{values.tolist()} [HM-WATCH-029]"
        )
    return tuple(np.broadcast_to(values, n_q).tolist())
