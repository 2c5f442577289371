"""What is doubtful about recordings: wrapped angles, frozen and clipped sensors, speeds beyond what is plausible."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec

if TYPE_CHECKING:
    from hybrid_mpc.data.tables import Table
    from hybrid_mpc.data.trajectories import Trajectory


# Stretches in which a sensor repeats itself although the machine cannot stand still.

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


Kind = Literal["wrapped", "frozen", "clipped", "speed"]

NEARLY = 0.25
"""Share of a full turn within which a jump is one: what the angle truly moves from one sample to the next is less."""
SPAN = 1.05
"""Turns that a wrapped angle spans at most: one, and some noise. An angle that counts on and turns fast spans more."""
"""Share of the times between two changes of an output that are ordinary."""
PATIENCE = 10.0
"""Times the longest ordinary time without a change that a driven machine may rest."""
LENGTHS = 5.0
"""Smoothing lengths of the DataSpec that it may rest in any case: in each of them a motion shows."""


@dataclass(frozen=True)
class Finding:
    """What is doubtful about one channel of one recording.

    Args:
        kind: ``"wrapped"``, ``"frozen"``, ``"clipped"`` or ``"speed"``.
        file: Name of the file.
        channel: Column.
        start: Time of the first sample concerned [s], in the recording's own time.
        count: Samples concerned; of a wrapped angle, its jumps.
        message: What was found, what is the likely cause, and what to do.
        refused: Whether nothing can be identified from the recording as it is. Default: no.

    Example:
        >>> print(Finding("frozen", "monday.csv", "phi", 3.0, 200, "column 'phi' repeats itself"))
        monday.csv: column 'phi' repeats itself
    """

    kind: Kind
    file: str
    channel: str
    start: float
    count: int
    message: str
    refused: bool = False

    def __str__(self) -> str:
        return f"{self.file}: {self.message}"


def doubts_of(
    tables: Sequence[Table],
    segments: Sequence[Sequence[Trajectory]],
    spec: DataSpec,
    *,
    outputs: Sequence[Signal],
    states: Sequence[Signal] = (),
) -> tuple[Finding, ...]:
    """All that is doubtful about the recordings of one run, file by file.

    Args:
        tables: The recordings as they were read.
        segments: What each of them was smoothed and differentiated to, between its gaps.
        spec: Columns, ``max_gap`` and ``smoothing`` [s].
        outputs: Signals of the outputs.
        states: Signals of the prior's states ``[q, v, ...]``, for the plausible ranges of the speeds. Default: speeds
            are not checked.

    Returns:
        The findings; those of reading (``Table.findings``) are among them.
    """
    speeds = speeds_of(states, outputs)
    spreads = np.std(np.concatenate([table.u for table in tables]), axis=0) if tables else np.zeros(0)
    patience = [_patience(tables, j, spec) for j in range(len(outputs))]
    found: list[Finding] = []
    for table, own in zip(tables, segments, strict=True):
        found += table.findings
        for j, (name, signal) in enumerate(zip(spec.outputs, outputs, strict=True)):
            y = table.y[:, j]
            still = still_stretches(
                table.t, y, table.u, max_gap=spec.max_gap, patience=patience[j], spreads=spreads
            )
            found += _stuck(table, name, signal, y, still)
        for j, speed in enumerate(speeds):
            found += _too_fast(table, spec.outputs[j], speed, own, len(outputs) + j)
    return tuple(found)


def speeds_of(states: Sequence[Signal], outputs: Sequence[Signal]) -> tuple[Signal, ...]:
    """Signals of the outputs' rates among the states ``[q, v, ...]``; none if their units are not those of rates.

    Example:
        >>> phi, phi_dot = Signal("phi", "rad"), Signal("phi_dot", "rad/s", -40, 40)
        >>> [speed.name for speed in speeds_of([phi, phi_dot], [phi])], speeds_of([phi], [phi])
        (['phi_dot'], ())
    """
    rates = tuple(states[len(outputs) : 2 * len(outputs)])
    units = [f"{signal.unit}/s" for signal in outputs]
    return rates if [signal.unit for signal in rates] == units else ()


def unwrapped(t: Array, angle: Array, turn: float, max_gap: float) -> tuple[Array, Indices]:
    """An angle that counts on, and the places where it jumped by about a full turn.

    An angle is wrapped if it keeps within one turn and jumps by about one between neighbouring samples.

    Args:
        t: Time stamps ``(m,)`` [s].
        angle: The angle ``(m,)``.
        turn: A full turn in its unit.
        max_gap: Distance [s] beyond which two samples are no neighbours.

    Returns:
        The angle ``(m,)``, equal to the given one but for whole turns, and the indices of the samples after a jump.

    Example:
        >>> angle = np.array([2.0, 2.6, 3.1, -2.7, -2.2, -2.8, 3.0])
        >>> angle, jumps = unwrapped(np.arange(7.0), angle, 2 * np.pi, 1.5)
        >>> angle.round(2).tolist(), jumps.tolist()
        ([2.0, 2.6, 3.1, 3.58, 4.08, 3.48, 3.0], [3, 6])
    """
    step = np.diff(angle)
    jumps = ~gaps(t, max_gap) & (np.abs(np.abs(step) - turn) <= NEARLY * turn)
    if not jumps.any() or np.ptp(angle) > SPAN * turn:
        return angle, np.zeros(0, dtype=np.intp)
    turns = np.cumsum(np.r_[0.0, np.where(jumps, np.sign(step), 0.0)])
    return angle - turn * turns, np.flatnonzero(jumps) + 1


def wrapped(file: str, name: str, signal: Signal, t: Array, raw: Array, jumps: Indices) -> Finding:
    """What is told of an angle that jumps.

    Args:
        file: Name of the file.
        name: Column.
        signal: What the column is; that of a ``periodic`` one is taken unwrapped.
        t: Time stamps ``(m,)`` [s].
        raw: The angle as it was recorded ``(m,)``.
        jumps: Indices of the samples after a jump.
    """
    k = int(jumps[0])
    count = len(jumps)
    what = (
        f"column {name!r} jumps {count} time{'s' * (count > 1)} by about a full turn (first from {raw[k - 1]:.4g} to "
        f"{raw[k]:.4g} {signal.unit} at {t[k]:.6g} s): a wrapped angle"
    )
    remedy = (
        f". {signal.name} is periodic, so the turns were added up and the angle counts on. An estimator or monitor "
        "that runs on the sensor itself needs an angle that counts on, too."
        if signal.periodic
        else f", which no smooth motion explains. Declare Signal(..., periodic=True) for {signal.name} in the prior, "
        "and it is made to count on; or record an angle that does."
    )
    return Finding("wrapped", file, name, float(t[k]), count, what + remedy, refused=not signal.periodic)


def _patience(tables: Sequence[Table], j: int, spec: DataSpec) -> float:
    """Time [s] that a driven machine may rest, by the times between two changes of an output in all recordings."""
    waits = []
    for table in tables:
        changes = np.flatnonzero(np.diff(table.y[:, j])) + 1
        if len(changes):
            waits.append(np.diff(table.t[np.r_[0, changes, len(table.t) - 1]]))
    ordinary = float(np.quantile(np.concatenate(waits), ORDINARY)) if waits else 0.0
    return max(PATIENCE * ordinary, LENGTHS * spec.smoothing)


def _stuck(table: Table, name: str, signal: Signal, y: Array, still: Sequence[Still]) -> list[Finding]:
    """Clipped at the largest and smallest value, and frozen anywhere else."""
    found: list[Finding] = []
    largest, smallest = (y.max(), y.min()) if np.ptp(y) > 0 else (np.inf, -np.inf)
    for word, value in (("largest", largest), ("smallest", smallest)):
        there = [s for s in still if y[s.first] == value]
        if there:
            found.append(_clipped(table, name, signal, y, there, word))
    rest = [s for s in still if y[s.first] not in (largest, smallest)]
    if rest:
        found.append(_frozen(table, name, signal, y, rest))
    return sorted(found, key=lambda finding: finding.start)


def _clipped(table: Table, name: str, signal: Signal, y: Array, still: Sequence[Still], word: str) -> Finding:
    first, value = still[0], y[still[0].first]
    count = int((y == value).sum())
    message = (
        f"column {name!r} stands at its {word} value, {value:.6g} {signal.unit}, for {count} samples, first from "
        f"{table.t[first.first]:.6g} to {table.t[first.last]:.6g} s, {_why(first, signal)}. The sensor is clipped, or "
        "the machine rests against a stop, which a prior does not know of. Leave such stretches out (windows in the "
        "DataSpec, or delete the rows: longer gaps are cut out), or record within the sensor's range."
    )
    return Finding("clipped", table.path.name, name, float(table.t[first.first]), count, message)


def _frozen(table: Table, name: str, signal: Signal, y: Array, still: Sequence[Still]) -> Finding:
    first = max(still, key=lambda s: table.t[s.last] - table.t[s.first])
    count = sum(s.last - s.first + 1 for s in still)
    others = len(still) - 1
    more = f" ({others} more such stretch{'es' * (others > 1)}, {count} samples in all)" if others else ""
    message = (
        f"column {name!r} repeats {y[first.first]:.6g} {signal.unit} from {table.t[first.first]:.6g} to "
        f"{table.t[first.last]:.6g} s, {first.last - first.first + 1} samples{more}, {_why(first, signal)}. The "
        "sensor is frozen, telegrams are lost, or the machine is blocked. Leave such stretches out (windows in the "
        "DataSpec, or delete the rows: longer gaps are cut out), or record again."
    )
    return Finding("frozen", table.path.name, name, float(table.t[still[0].first]), count, message)


def _why(still: Still, signal: Signal) -> str:
    if still.why == "abrupt":
        return (
            f"although it moves at {still.amount:.3g} {signal.unit}/s right before or after, and changes its speed "
            "like that nowhere else"
        )
    if still.why == "noise":
        return f"although its noise is {still.amount:.2g} {signal.unit} elsewhere"
    return "while the inputs move as they do elsewhere"


def _too_fast(
    table: Table, name: str, speed: Signal, segments: Sequence[Trajectory], column: int
) -> list[Finding]:
    """Speeds out of their plausible range; refused where even the mean one (rms) is."""
    if not segments:
        return []
    t = np.concatenate([segment.t for segment in segments])
    v = np.concatenate([segment.x[:, column] for segment in segments])
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
    return [Finding("speed", table.path.name, name, float(t[bad[0]]), len(bad), message, refused=absurd)]
