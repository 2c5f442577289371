"""What is doubtful about recordings: wrapped angles, frozen and clipped sensors, speeds beyond what is plausible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.stillness import Still, gaps, still_stretches
from hybrid_mpc.data_spec import DataSpec
from hybrid_mpc.signals import Signal

if TYPE_CHECKING:
    from hybrid_mpc.data.tables import Table
    from hybrid_mpc.data.trajectories import Trajectory

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Kind = Literal["wrapped", "frozen", "clipped", "speed"]

NEARLY = 0.25
"""Share of a full turn within which a jump is one: what the angle truly moves from one sample to the next is less."""
SPAN = 1.05
"""Turns that a wrapped angle spans at most: one, and some noise. An angle that counts on and turns fast spans more."""
ORDINARY = 0.99
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
