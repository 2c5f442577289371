"""Motor torques of the golf robot's recordings. No torch in here."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import InputError, chirp, random_steps, sinusoid

Array = NDArray[np.float64]
Range = tuple[float, float]
Torque = Callable[[np.random.Generator, Array], Array]

PEAK = 0.5  # [N m] the motor's
ROUNDED = 0.2  # [s]


def excitation(kind: str, rng: np.random.Generator, t: Array) -> Array:
    """Motor torque ``(n,)`` [N m] of one of the kinds.

    Sines, steps and chirps are of the paper's size. A controller may use 0.5 N m and goes to 0.9 rad and 4 rad/s, so
    four further kinds have up to 0.5 N m and yet do not swing the club over the top.

    =============  ==========================================================================
    ``sine``       0.08 to 0.16 N m, 0.15 to 0.9 Hz
    ``step``       levels up to 0.25 N m, held 1 to 3 s
    ``chirp``      0.08 to 0.16 N m, 0.1 to 1.2 Hz, up or down
    ``stair``      levels up to 0.5 N m, each at most 0.2 N m from the last, held 0.4 to 1.6 s
    ``pulse``      0.25 to 0.5 N m of alternating sign, 0.2 to 0.4 s each
    ``fastsine``   0.3 to 0.5 N m, 1 to 2 Hz
    ``fastchirp``  0.3 to 0.5 N m, 1 to 2 Hz, up or down
    =============  ==========================================================================
    """
    if kind not in KINDS:
        raise InputError(
            f"golf_robot: no excitation {kind!r}; there are: {', '.join(KINDS)} [HM-SCENARIOS-006]"
        )
    return KINDS[kind](rng, t)


def _sines(sizes: Range, frequencies: Range) -> Torque:
    def torque(rng: np.random.Generator, t: Array) -> Array:
        amplitude, phase = rng.uniform(*sizes), rng.uniform(0.0, 2 * np.pi)
        return sinusoid(t, amplitude, rng.uniform(*frequencies), phase=phase)

    return torque


def _chirps(sizes: Range, low: Range, high: Range) -> Torque:
    def torque(rng: np.random.Generator, t: Array) -> Array:
        amplitude = rng.uniform(*sizes)
        f0, f1 = rng.permutation([rng.uniform(*low), rng.uniform(*high)])
        return chirp(t, amplitude, f0, f1)

    return torque


def _step(rng: np.random.Generator, t: Array) -> Array:
    return random_steps(t, -0.25, 0.25, hold=(1.0, 3.0), rng=rng)


def _stair(rng: np.random.Generator, t: Array) -> Array:
    starts, level, levels = np.cumsum(rng.uniform(0.4, 1.6, len(t))), 0.0, [0.0]
    for _ in starts:
        level = rng.uniform(max(-PEAK, level - 0.2), min(PEAK, level + 0.2))
        levels.append(level)
    return _rounded(np.array(levels)[np.searchsorted(starts, t - t[0], side="right")], t)


def _pulse(rng: np.random.Generator, t: Array) -> Array:
    starts = np.cumsum(rng.uniform(0.2, 0.4, len(t)))
    sizes = rng.uniform(0.25, PEAK, len(t) + 1) * np.where(np.arange(len(t) + 1) % 2, -1.0, 1.0)
    return _rounded(sizes[np.searchsorted(starts, t - t[0], side="right")], t)


def _rounded(levels: Array, t: Array) -> Array:
    """Levels with each jump turned into half a cosine that ends ``ROUNDED`` after it."""
    taps = np.sin(np.pi * np.arange(0.5, round(ROUNDED / (t[1] - t[0]))) / round(ROUNDED / (t[1] - t[0])))
    return np.convolve(levels, taps / taps.sum())[: len(levels)]


KINDS: Mapping[str, Torque] = {
    "sine": _sines((0.08, 0.16), (0.15, 0.9)),
    "step": _step,
    "chirp": _chirps((0.08, 0.16), (0.1, 0.3), (0.8, 1.2)),
    "stair": _stair,
    "pulse": _pulse,
    "fastsine": _sines((0.3, PEAK), (1.0, 2.0)),
    "fastchirp": _chirps((0.3, PEAK), (1.0, 1.3), (1.6, 2.0)),
}
