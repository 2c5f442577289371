"""Stretches in which a sensor repeats itself although the machine cannot stand still."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

SHORTEST = 5
"""Fewest equal samples in a row that count; fewer are a telegram that was lost."""
SPANS = (1, 2, 5)
"""Samples over which speeds are taken: steps of the sensor hide a slow motion in one, a fast one is over in five."""
ABRUPT = 3.0
"""Times the largest ordinary change of speed that no machine makes to stop or to start. In the recordings of five
machines whose sensors work it is 1.5 at most (docs/data.md)."""
ORDINARY = 0.99
"""Share of the changes of speed that are ordinary."""
STEP = 0.1
"""Quantile of the changes of value that is taken for the sensor's step; the least one may be a rounding of the file."""
FEW = 20
"""Fewest changes of speed in full motion from which the ordinary ones are told."""
FEWER = 0.1
"""Share of all of them that these must be."""
WHITE = 0.6
"""Error of a cubic through four neighbours over that of a line through two, from which on these are noise: 1.1 for
white noise, (w dt)^2 / 3 for a motion of angular frequency w, which is below 0.06 from 15 samples a period on."""
FLICKER = 2.0
"""Standard deviation of noise, in steps of the sensor, from which on the sensor flickers at rest too."""
CHANCE = 1e-3
"""Probability with which such noise may repeat itself for so long anywhere in the recording."""
STIRRED = 0.5
"""Standard deviation of an input within a stretch, over that in all recordings, from which on the machine is driven."""


@dataclass(frozen=True)
class Still:
    """Equal samples in a row that are no rest.

    Args:
        first: Index of the first of them.
        last: Index of the last.
        why: ``"abrupt"``: it begins or ends in full motion; ``"noise"``: the sensor's noise stops, too; ``"driven"``:
            the inputs go on.
        amount: Speed right before or after [unit/s]; standard deviation of the noise [unit]; length [s].
    """

    first: int
    last: int
    why: Literal["abrupt", "noise", "driven"]
    amount: float


def rests(t: Array, y: Array, max_gap: float) -> tuple[Indices, Indices]:
    """First and last index of every stretch of equal neighbouring samples.

    Args:
        t: Time stamps ``(m,)`` [s].
        y: Samples ``(m,)``.
        max_gap: Distance [s] beyond which two samples are no neighbours.

    Example:
        >>> first, last = rests(np.arange(6.0), np.array([1.0, 2.0, 2.0, 2.0, 3.0, 3.0]), 1.0)
        >>> first.tolist(), last.tolist()
        ([1, 4], [3, 5])
    """
    flat = np.r_[False, (np.diff(y) == 0) & ~gaps(t, max_gap), False]
    edges = np.flatnonzero(np.diff(flat.astype(np.int8)))
    return edges[::2], edges[1::2]


def gaps(t: Array, max_gap: float) -> Mask:
    """Which of the steps ``(m - 1,)`` between time stamps are gaps."""
    return np.asarray(np.diff(t) > max_gap * (1 + 1e-6))


def still_stretches(
    t: Array, y: Array, u: Array, *, max_gap: float, patience: float, spreads: Array
) -> tuple[Still, ...]:
    """Stretches of equal samples that no rest of the machine explains; an encoder, however coarse, at rest is none.

    A machine comes to rest and starts from it with changes of speed that it also makes elsewhere: what stops or starts
    ``ABRUPT`` times as sharply is ``"abrupt"``. Steps of the sensor count as changes that it makes. A sensor whose
    noise is larger than its steps flickers at rest: where that stops it is ``"noise"``, but for exact zeros, which
    speeds made from counts have at rest. A sensor that stops at rest and never starts again is told by the inputs,
    ``"driven"``.

    Args:
        t: Time stamps ``(m,)`` [s].
        y: One output ``(m,)``.
        u: Inputs ``(m, n_u)``.
        max_gap: Distance [s] beyond which two samples are no neighbours.
        patience: Time [s] that a driven machine may rest, for all that is known of it.
        spreads: Standard deviation ``(n_u,)`` of the inputs over all recordings of the machine.

    Example:
        >>> t = 0.01 * np.arange(400)
        >>> y = np.sin(3 * t).round(2)  # a coarse sensor: rests at every turn of the motion are no fault
        >>> still_stretches(t, y, y[:, None], max_gap=0.05, patience=9.0, spreads=np.ones(1))
        ()
        >>> y[150:210] = y[150]
        >>> [(s.first, s.last, s.why) for s in still_stretches(
        ...     t, y, y[:, None], max_gap=0.05, patience=9.0, spreads=np.ones(1))]
        [(150, 209, 'abrupt')]
    """
    first, last = rests(t, y, max_gap)
    long = last - first + 1 >= SHORTEST
    first, last = first[long], last[long]
    if not len(first):
        return ()
    step = np.diff(y)
    ordinary = _elsewhere(len(step), first, last) & ~gaps(t, max_gap)
    resolution = float(np.quantile(np.abs(step[step != 0]), STEP)) if step.any() else math.inf
    at = _abrupt(t, y, first, last, ordinary, resolution)
    noise, longest = _noise(t, y, ordinary, resolution)
    found = []
    for a, b, speed in zip(first.tolist(), last.tolist(), at.tolist(), strict=True):
        if speed > 0:
            found.append(Still(a, b, "abrupt", speed))
        elif b - a + 1 >= longest and y[a] != 0:
            found.append(Still(a, b, "noise", noise))
        elif t[b] - t[a] > patience and _driven(u[a : b + 1], spreads):
            found.append(Still(a, b, "driven", float(t[b] - t[a])))
    return tuple(found)


def _abrupt(t: Array, y: Array, first: Indices, last: Indices, ordinary: Mask, resolution: float) -> Array:
    """Speed right before or after each stretch if no ordinary change of speed explains it, else zero."""
    found = np.zeros(len(first))
    period = float(np.median(np.diff(t)))
    near = np.r_[0, np.cumsum(~ordinary)]  # steps that are not ordinary, up to each sample
    for span in SPANS:
        if len(y) <= 2 * span:
            break
        speed = (y[span:] - y[:-span]) / (t[span:] - t[:-span])  # from each sample to the one a span later
        change = np.abs(speed[span:] - speed[:-span])
        moving = (speed[span:] != 0) & (speed[:-span] != 0)
        chosen = moving & (near[2 * span :] == near[: -2 * span])
        if chosen.sum() < max(
            FEW, FEWER * moving.sum()
        ):  # a sensor slower than its recording repeats itself always
            chosen = change > 0
        most = float(np.quantile(change[chosen], ORDINARY)) if chosen.any() else 0.0
        limit = ABRUPT * max(most, resolution / (span * period))
        before = np.where(first >= span, np.abs(speed[np.maximum(first - span, 0)]), 0.0)
        after = np.where(last + span < len(y), np.abs(speed[np.minimum(last, len(speed) - 1)]), 0.0)
        there = np.maximum(before, after)
        found = np.maximum(found, np.where(there > limit, there, 0.0))
    return found


def _elsewhere(n: int, first: Indices, last: Indices) -> Mask:
    """Which of ``n`` steps lie two and more samples away from all stretches."""
    edge = np.zeros(n + 1, dtype=np.int64)
    np.add.at(edge, np.maximum(first - 2, 0), 1)
    np.add.at(edge, np.minimum(last + 2, n), -1)
    return np.asarray(np.cumsum(edge[:n]) == 0)


def _noise(t: Array, y: Array, ordinary: Mask, resolution: float) -> tuple[float, float]:
    """Standard deviation of the noise, and fewest equal samples in a row that it never makes; infinite without."""
    inner = (
        ordinary[:-3] & ordinary[1:-2] & ordinary[2:-1] & ordinary[3:] if len(ordinary) > 3 else ordinary[:0]
    )
    if inner.sum() < FEW:
        return 0.0, math.inf
    line = float(np.median(np.abs(_misfit(t, y, (-1, 1))[inner])))
    cubic = float(np.median(np.abs(_misfit(t, y, (-2, -1, 1, 2))[inner])))
    sigma = line / (0.6745 * math.sqrt(1.5))  # median of a Gaussian; variances of a sample and of two halves
    if cubic < WHITE * line or sigma < FLICKER * resolution:
        return 0.0, math.inf
    repeated = float((np.diff(y)[ordinary] == 0).mean())
    least = math.log(CHANCE / len(y)) / math.log(repeated) if repeated else 0.0
    return sigma, max(SHORTEST, least)


def _misfit(t: Array, y: Array, places: tuple[int, ...]) -> Array:
    """Samples less the polynomial through their neighbours at ``places``; ``(m - 4,)``, from the third sample on."""

    def at(z: Array, place: int) -> Array:
        return z[2 + place : len(z) - 2 + place]

    misfit = at(y, 0).copy()
    for i in places:
        weight = np.ones(len(misfit))
        for j in places:
            if j != i:
                weight *= (at(t, 0) - at(t, j)) / (at(t, i) - at(t, j))
        misfit -= weight * at(y, i)
    return misfit


def _driven(u: Array, spreads: Array) -> bool:
    """Whether all inputs that move in the recordings move here."""
    moving = spreads > 0
    return bool(moving.any() and (np.std(u, axis=0)[moving] >= STIRRED * spreads[moving]).all())
