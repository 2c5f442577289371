"""What is doubtful about recordings: frozen and clipped sensors, and speeds beyond what is plausible.

A sensor is stuck where it repeats itself although the machine cannot stand still (docs/data.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.recording import Finding, Recording, gaps
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
SHORTEST = 5
"""Fewest equal samples in a row that count; fewer are a telegram that was lost."""
SPANS = (1, 2, 5)
"""Samples over which speeds are taken: steps of the sensor hide a slow motion in one, a fast one is over in five."""
ABRUPT = 3.0
"""A stop this many times sharper than any ordinary change of speed is a sensor's fault, not the machine's. In the
recordings of five machines whose sensors work it is 1.5 at most (docs/data.md)."""
ORDINARY = 0.99
"""Share of the changes of speed, and of the times between two changes of an output, that are ordinary."""
STEP = 0.1
"""Quantile of the changes of value that is taken for the sensor's step; the least one may be a rounding of the file."""
FEW = 20
"""Fewest changes of speed in full motion from which the ordinary ones follow."""
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
PATIENCE = 10.0
"""Times the longest ordinary time without a change that a driven machine may rest."""
LENGTHS = 5.0
"""Smoothing lengths of the DataSpec that it may rest in any case: in each of them a motion shows."""
LEAVE_OUT = "Leave such stretches out (windows in the DataSpec, or delete the rows: longer gaps are cut out), or record"


def findings_of(
    recordings: Sequence[Recording],
    motions: Sequence[tuple[Array, Array]],
    spec: DataSpec,
    *,
    outputs: Sequence[Signal],
    states: Sequence[Signal] = (),
) -> tuple[Finding, ...]:
    """All that is doubtful about the recordings of one run, file by file, with their own findings.

    ``motions`` are times ``(n,)`` [s] and states ``(n, n_x)`` of each recording, smoothed; ``n = 0`` where that could
    not be. Speeds are checked if ``states``, the prior's signals, are given.
    """
    spreads = (
        np.std(np.concatenate([recording.u for recording in recordings]), axis=0)
        if recordings
        else np.zeros(0)
    )
    patience = [_patience(recordings, j, spec) for j in range(len(outputs))]
    found: list[Finding] = []
    for recording, (t, x) in zip(recordings, motions, strict=True):
        found += recording.findings
        for j, (name, signal) in enumerate(zip(spec.outputs, outputs, strict=True)):
            known = np.isfinite(recording.y[:, j])
            column = _Column(
                recording.path.name,
                name,
                signal,
                recording.t[known],
                recording.y[known, j],
                recording.censored[known, j],
            )
            still = still_stretches(
                column.t,
                column.y,
                recording.u[known],
                max_gap=spec.max_gap,
                patience=patience[j],
                spreads=spreads,
            )
            found += _stuck(column, [one for one in still if column.censored[one.first] == 0])
        if len(t):
            for j, speed in enumerate(_speeds_of(states, outputs)):
                v = x[:, len(outputs) + j]
                known = np.isfinite(v)
                found += _too_fast(recording, spec.outputs[j], speed, t[known], v[known])
    return tuple(found)


def _speeds_of(states: Sequence[Signal], outputs: Sequence[Signal]) -> tuple[Signal, ...]:
    """Signals of the outputs' rates among the states ``[q, v, ...]``; none if their units are not those of rates."""
    rates = tuple(states[len(outputs) : 2 * len(outputs)])
    return rates if [s.unit for s in rates] == [f"{s.unit}/s" for s in outputs] else ()


def _patience(recordings: Sequence[Recording], j: int, spec: DataSpec) -> float:
    """Time [s] that a driven machine may rest, by the times between two changes of an output in all recordings."""
    waits = []
    for recording in recordings:
        known = np.isfinite(recording.y[:, j])
        t, changes = recording.t[known], np.flatnonzero(np.diff(recording.y[known, j])) + 1
        if len(changes):
            waits.append(np.diff(t[np.r_[0, changes, len(t) - 1]]))
    ordinary = float(np.quantile(np.concatenate(waits), ORDINARY)) if waits else 0.0
    return max(PATIENCE * ordinary, LENGTHS * spec.smoothing)


@dataclass(frozen=True)
class Still:
    """Equal samples in a row, from index ``first`` to ``last``, that are no rest.

    ``"abrupt"``: it begins or ends in full motion; ``"noise"``: the sensor's noise stops, too; ``"driven"``: the
    inputs go on. ``amount`` is the speed right before or after [unit/s], the standard deviation of the noise [unit],
    the length [s].
    """

    first: int
    last: int
    why: Literal["abrupt", "noise", "driven"]
    amount: float


def still_stretches(
    t: Array, y: Array, u: Array, *, max_gap: float, patience: float, spreads: Array
) -> tuple[Still, ...]:
    """Stretches of equal samples that no rest of the machine explains; an encoder, however coarse, at rest is none.

    ``"abrupt"``: a machine comes to rest and starts from it with changes of speed that it also makes elsewhere, and
    this one is ``ABRUPT`` times as sharp. Steps of the sensor count as changes; where an input steps, a machine may
    start or stop as sharply as it likes. ``"noise"``: a sensor whose noise is larger than its steps flickers at
    rest, and here it does not; exact zeros, which speeds made from counts have at rest, do not count. ``"driven"``:
    the inputs go on for longer than ``patience``.
    """
    flat = np.r_[False, (np.diff(y) == 0) & ~gaps(t, max_gap), False]
    edges = np.flatnonzero(np.diff(flat.astype(np.int8)))
    first, last = edges[::2], edges[1::2]
    # in bursts of samples a sensor does not change either: they are to last as long as usual ones
    usual = np.diff(t)[~gaps(t, max_gap)]
    long = last - first + 1 >= SHORTEST
    long &= t[last] - t[first] >= (SHORTEST - 1.5) * (float(usual.mean()) if len(usual) else 0.0)
    first, last = first[long], last[long]
    if not len(first):
        return ()
    step = np.diff(y)
    ordinary = _elsewhere(len(step), first, last) & ~gaps(t, max_gap)
    resolution = float(np.quantile(np.abs(step[step != 0]), STEP)) if step.any() else math.inf
    at = _abrupt(t, y, first, last, ordinary, resolution, _stepped(u, spreads))
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


def _stepped(u: Array, spreads: Array) -> Indices:
    """Samples from which on an input is another one by half of its spread: the machine is free to start or stop."""
    moving = spreads > 0
    changes = np.abs(np.diff(u[:, moving], axis=0)) > STIRRED * spreads[moving]
    return np.flatnonzero(changes.any(axis=1)) + 1


def _abrupt(
    t: Array, y: Array, first: Indices, last: Indices, ordinary: Mask, resolution: float, stepped: Indices
) -> Array:
    """Speed right before or after each stretch if neither an ordinary change of speed nor a step of an input explains
    it, else zero.
    """

    def explained(at: Indices, span: int) -> Mask:  # by a step up to a span and two samples away
        near = np.searchsorted(stepped, at - span - 2), np.searchsorted(stepped, at + span + 3)
        return np.asarray(near[0] < near[1])

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
        if chosen.sum() < max(FEW, FEWER * moving.sum()):
            chosen = change > 0  # a sensor slower than its recording repeats itself always
        most = float(np.quantile(change[chosen], ORDINARY)) if chosen.any() else 0.0
        limit = ABRUPT * max(most, resolution / (span * period))
        begins = (first >= span) & ~explained(first, span)
        ends = (last + span < len(y)) & ~explained(last, span)
        before = np.where(begins, np.abs(speed[np.maximum(first - span, 0)]), 0.0)
        after = np.where(ends, np.abs(speed[np.minimum(last, len(speed) - 1)]), 0.0)
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


@dataclass(frozen=True)
class _Column:
    """The samples ``(m,)`` of one output that are not missing, and where they come from."""

    file: str
    name: str
    signal: Signal
    t: Array
    y: Array
    censored: NDArray[np.int8]


def _stuck(column: _Column, still: Sequence[Still]) -> list[Finding]:
    """Clipped at the largest and smallest value, and frozen anywhere else."""
    found: list[Finding] = []
    y = column.y
    largest, smallest = (y.max(), y.min()) if len(y) and np.ptp(y) > 0 else (np.inf, -np.inf)
    for word, value in (("largest", largest), ("smallest", smallest)):
        there = [s for s in still if y[s.first] == value]
        if there:
            found.append(_clipped(column, there[0], word))
    rest = [s for s in still if y[s.first] not in (largest, smallest)]
    if rest:
        found.append(_frozen(column, rest))
    return sorted(found, key=lambda finding: finding.start)


def _clipped(column: _Column, first: Still, word: str) -> Finding:
    t, y, signal = column.t, column.y, column.signal
    value, start = float(y[first.first]), float(t[first.first])
    count = int((y == value).sum())
    lower, upper = signal.saturation or (-math.inf, math.inf)
    ends = f"({lower:g}, {value:g})" if word == "largest" else f"({value:g}, {upper:g})"
    message = (
        f"column {column.name!r} stands at its {word} value, {value:.6g} {signal.unit}, for {count} samples, first "
        f"from {start:.6g} to {t[first.last]:.6g} s, {_why(first, signal)}. The sensor is clipped, or "
        f"the machine rests against a stop, which a prior does not know of. If the sensor ends there, declare "
        f"Signal(..., saturation={ends.replace('inf', 'math.inf')}) for {signal.name}: these samples then count as 'at "
        f"{'least' if word == 'largest' else 'most'}'. {LEAVE_OUT} within the sensor's range."
    )
    return Finding("clipped", column.file, column.name, start, count, message)


def _frozen(column: _Column, still: Sequence[Still]) -> Finding:
    t, y, signal = column.t, column.y, column.signal
    longest = max(still, key=lambda s: t[s.last] - t[s.first])
    count = sum(s.last - s.first + 1 for s in still)
    others = len(still) - 1
    more = f" ({others} more such stretch{'es' * (others > 1)}, {count} samples in all)" if others else ""
    message = (
        f"column {column.name!r} repeats {y[longest.first]:.6g} {signal.unit} from {t[longest.first]:.6g} to "
        f"{t[longest.last]:.6g} s, {longest.last - longest.first + 1} samples{more}, {_why(longest, signal)}. "
        f"The sensor is frozen, telegrams are lost, or the machine is blocked. {LEAVE_OUT} again."
    )
    return Finding("frozen", column.file, column.name, float(t[still[0].first]), count, message)


def _why(still: Still, signal: Signal) -> str:
    if still.why == "abrupt":
        return (
            f"although it moves at {still.amount:.3g} {signal.unit}/s right before or after, and changes its speed "
            "like that nowhere else"
        )
    if still.why == "noise":
        return f"although its noise is {still.amount:.2g} {signal.unit} elsewhere"
    return "while the inputs move as they do elsewhere"


def _too_fast(recording: Recording, name: str, speed: Signal, t: Array, v: Array) -> list[Finding]:
    """Speeds ``v`` ``(n,)`` out of their plausible range; refused where even the mean one (rms) is."""
    bad = np.flatnonzero((v < speed.lower) | (v > speed.upper))
    if not len(bad):
        return []
    worst = int(bad[np.argmax(np.abs(v[bad]))])
    mean = float(np.sqrt(np.mean(v**2)))
    absurd = mean > max(abs(speed.lower), abs(speed.upper))
    message = (
        f"column {name!r}, differentiated, reaches {v[worst]:.4g} {speed.unit} at {t[worst]:.6g} s; the plausible "
        f"range of {speed.name} is {speed.lower:g} to {speed.upper:g} {speed.unit} ({len(bad)} of {len(v)} samples are "
        f"beyond{f', and so is its mean, {mean:.4g} (rms)' if absurd else ''}). Mostly a unit is wrong (deg for "
        "rad, rpm, ms for s): name it in DataSpec.units. Else look for jumps of the sensor, or widen the range in the "
        "prior."
    )
    return [Finding("speed", recording.path.name, name, float(t[bad[0]]), len(bad), message, refused=absurd)]
