"""The speed below which a machine counts as at rest, from its own recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.data.scales import Outputs, noise_of, speed_gain, speeds_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel
from hybrid_mpc.monitor.lengths import WINDOW_S, half_window

Array = NDArray[np.float64]
REST_SPEED = 0.2
"""What every machine had before rest speeds were learned [rad/s]: that of artifacts and detectors that hold none."""
SHARE = 0.05
"""Share of the speed at work. Below it a drive's friction is told by whether it sticks rather than by how fast it
moves: on the recorded machines the smoothed step of the priors' dry friction (0.002 m/s to 0.1 rad/s) has risen to 99
% there."""
QUANTILE = 0.99
"""Quantile of the speeds in motion that counts as speed at work: an outlier or a blow by hand moves it little."""
DEVIATIONS = 3.0
"""So many deviations of what the sensor's noise makes of a speed count as no motion."""


def rest_speeds(recordings: Sequence[Outputs], model: HybridModel) -> tuple[float, ...]:
    """Speeds, one for each degree of freedom, below which friction may stick [unit of v].

    The rule: a twentieth of the speed at work, which is the 99 % quantile of the speeds in motion; but no less than
    three deviations of what the sensor's noise and steps make of a speed over the guard's window. Speeds are those that
    the monitor sees: slopes of cubics over that window.

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
            "guard's window; give longer ones"
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
            f"rest speeds: {', '.join(names)} never moves in the recordings; give some in motion"
        )
    return tuple(found)


def checked_rest(rest_speed: ArrayLike, n_q: int, what: str) -> tuple[float, ...]:
    """Rest speeds of ``n_q`` degrees of freedom, from as many or from one for all.

    Raises:
        InputError: If there are not so many, or one is not positive.

    Example:
        >>> checked_rest(0.2, 2, "monitor")
        (0.2, 0.2)
    """
    values = np.asarray(rest_speed, dtype=float).ravel()
    if values.size not in (1, n_q) or not (np.all(np.isfinite(values)) and np.all(values > 0)):
        raise InputError(
            f"{what}: rest_speed must be {n_q} positive speeds, one a degree of freedom (or one for all); got "
            f"{values.tolist()}"
        )
    return tuple(np.broadcast_to(values, n_q).tolist())
