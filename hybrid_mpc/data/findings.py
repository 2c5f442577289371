"""What is doubtful about the channels of recordings: codes, outliers, angles that jump, stuck sensors, absurd speeds.

A sensor is stuck where it repeats itself although the machine cannot stand still (docs/data-checks.md).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.machine.units import Conversion, conversion

if TYPE_CHECKING:
    from hybrid_mpc.data.recording import Recording

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
ABSURD = 1e100  # no machine has a value beyond: the square of its square must be finite
MIN_SCORED = 10  # fewest samples after the warm-up that make a piece worth a free run

# Codes for missing values, and outliers
FAR_OFF = 3.0
"""Times the span and the size of all other values by which a code for missing ones is away from them."""
_CODE = re.compile(
    r"999+(\.9+|\.25)?|9\.9+e\+\d\d+|9\.96921e\+36|32767|32768|65535|8388607|8388608|2147483647|2147483648|4294967295|"
    r"1e\+[1-3]\d|3\.402(82|823|823466)e\+38"
)
_NEVER = re.compile(r"9999+(\.9+|\.25)?|999\.25|9\.9.*e\+\d\d+|[13].*e\+[2-9]\d")
"""Codes that are no position of a switch, where they are negative or larger than ``LARGER``."""
LARGER = 1e15  # no number of a machine that switches is larger
SEVERAL = 4  # most codes that one column is looked at for
OUTLYING = 10.0  # spans of all other values by which an outlier is away from them
MOST_ODD = 5  # most outliers of a column, and at most one sample of a hundred: more are a motion

# Jumps
NEARLY = 0.25
"""Share of a full turn within which a jump is one: what the angle truly moves from one sample to the next is less."""
SPAN = 1.05
"""Turns that a wrapped angle spans at most: one, and some noise. An angle that counts on and turns fast spans more."""
HOLE = 1.5  # usual distances of the time stamps from which on samples are missing between two
UNSURE = 0.4
"""Share of a turn by which the way over missing samples may differ from that at the speeds before and after: at half a
turn another number of turns would fit as well."""
PARTS = (2, 3, 4, 6, 8)
"""Parts of a turn after which a sensor may begin anew: half turns of an arctangent, pole pairs."""
BITS = (8, 10, 12, 14, 16, 20, 24, 32)  # of counters that overflow
LIKE = 0.03  # share by which a jump, the motion around it taken off, may differ from such a part

# Stuck sensors
SHORTEST = 5  # fewest equal samples in a row that count; fewer are a telegram that was lost
SPANS = (1, 2, 5)
"""Samples over which speeds are taken: steps of the sensor hide a slow motion in one, a fast one is over in five."""
ABRUPT = 3.0
"""A stop this many times sharper than any ordinary change of speed is a sensor's fault, not the machine's. In the
recordings of five machines whose sensors work it is 1.5 at most (docs/results/data_checks.md)."""
ORDINARY = 0.99  # share of the changes of speed, and of the times between two changes, that are ordinary
STEP = 0.1  # quantile of the changes that is the sensor's step; the least one may be a rounding of the file
FEW = 20  # fewest changes of speed in full motion from which the ordinary ones follow
FEWER = 0.1  # share of all of them that these must be
WHITE = 0.6
"""Error of a cubic through four neighbours over that of a line through two, from which on these are noise: 1.1 for
white noise, (w dt)^2 / 3 for a motion of angular frequency w, which is below 0.06 from 15 samples a period on."""
FLICKER = 2.0  # noise, in steps of the sensor, from which on the sensor flickers at rest too
CHANCE = 1e-3  # probability with which such noise may repeat itself for so long anywhere in the recording
STIRRED = 0.5
"""Standard deviation of an input within a stretch, over that in all recordings, from which on the machine is driven."""
PATIENCE = 10.0  # times the longest ordinary time without a change that a driven machine may rest
LENGTHS = 5.0  # smoothing lengths that it may rest in any case: in each of them a motion shows
Kind = Literal["read", "clock", "wrapped", "frozen", "clipped", "speed", "missing", "outlier", "settings"]
LEAVE_OUT = "Leave such stretches out (windows in the DataSpec, or delete the rows: longer gaps are cut out), or record"


@dataclass(frozen=True)
class Finding:
    """What is doubtful about one channel of one recording; ``refused`` where nothing can be identified from it as is.

    ``start`` is the time [s] of the first sample concerned, in the recording's own time; ``count`` the samples
    concerned, of a wrapped angle its jumps. ``message`` says what was found, the likely cause, and what to do.
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


@dataclass(frozen=True)
class Channel:
    """Samples ``(m,)`` of one channel, and where they come from."""

    file: str
    name: str
    signal: Signal
    t: Array
    y: Array

    def finding(self, kind: Kind, first: int, count: int, message: str, refused: bool = False) -> Finding:
        """A finding of ``count`` samples from the index ``first`` on."""
        told = f"column {self.name!r}{message}"
        return Finding(kind, self.file, self.name, float(self.t[first]), count, told, refused)

    def odd(self, there: Mask) -> list[Finding]:
        """Findings of outliers, and of rows without a number if the channel has numbers ``there`` ``(m,)`` alone."""
        found, y, t = list[Finding](), self.y, self.t
        if (far := outliers(y)) is not None:
            rest = np.delete(y, far)
            message = (
                f" is {y[far[0]]:.6g} {self.signal.unit} at {t[far[0]]:.6g} s: {len(far)} of {len(t)} samples are far "
                f"from all others, {np.nanmin(rest):.6g} to {np.nanmax(rest):.6g}. A code for a missing value, or a "
                "lost digit? Leave these cells blank, or delete the rows."
            )
            found.append(self.finding("outlier", far[0], len(far), message))
        if there.any() and not there.all():
            first, count = int(np.argmin(there)), int((~there).sum())
            longest = float(np.diff(np.r_[t[0], t[there], t[-1]]).max())
            message = (
                f" has no number in {count} of {len(t)} rows ({100 * count / len(t):.3g} %), first at "
                f"{t[first]:.6g} s; the longest time without one is {longest:.4g} s. These samples count as missing. "
                "If that is wrong, check the cells."
            )
            found.append(self.finding("missing", first, count, message))
        return found

    def jumps(self, raw: Array, max_gap: float) -> tuple[list[Finding], Unwrapped | None]:
        """Findings of turns, of parts of a turn, and of overflows of what was recorded, ``raw`` ``(m,)``;
        and the angle counted on, where it was wrapped and is periodic.
        """
        found, signal, angle, t = list[Finding](), self.signal, None, self.t
        again = "Record one that counts on, or unwrap it before: numpy.unwrap(..., period="
        if (turn := turn_of(signal)) is not None:
            angle = unwrapped(t, self.y, turn, max_gap, periodic=signal.periodic)
            if len(angle.jumps):
                told = "a wrapped angle, which no smooth motion explains. Declare Signal(..., periodic=True) for "
                told += (
                    f"{signal.name} in the prior, and it is made to count on; or record an angle that does."
                )
                if signal.periodic:
                    told = (
                        f"a wrapped angle. {signal.name} is periodic, so the turns were added up and the angle counts "
                        "on. An estimator or monitor that runs on the sensor itself needs an angle that counts on, too."
                    )
                if signal.periodic and len(angle.unclear):
                    told += (
                        f" Before {len(angle.unclear)} samples (first at {t[angle.unclear[0]]:.6g} s) too many "
                        "are missing to count its turns: the recording is cut there."
                    )
                found.append(_jumping(self, angle.jumps, "a full turn", 4, told, not signal.periodic))
            elif parted := folded(t, self.y, turn, max_gap):
                part = f"1/{parted[0]} of a turn"
                told = f"an angle that restarts after each {part}, or a wrong unit. {again}{turn / parted[0]:.6g})."
                found.append(_jumping(self, parted[1], f"{part} against its motion", 4, told, True))
        # whole numbers of b bits span less than 2^b
        if (raw == np.round(raw)).all() and (
            over := _anew(t, raw, [2.0**b for b in BITS], 1 - 1e-10, max_gap)
        ):
            bits = BITS[over[0]]
            told = f"a counter of {bits} bits that overflows. {again}{2**bits})."
            counts = Channel(self.file, self.name, signal, t, raw)
            found.append(_jumping(counts, over[1], f"{2**bits} against its motion", 10, told, True))
        return found, angle if angle is not None and len(angle.jumps) and signal.periodic else None


def gaps(t: Array, max_gap: float) -> Mask:
    """Which of the steps ``(m - 1,)`` between time stamps ``(m,)`` are longer than ``max_gap`` [s]."""
    return np.asarray(np.diff(t) > max_gap * (1 + 1e-6))


# Codes for missing values, and outliers


def missing_code(column: Array) -> float | None:
    """A number that logging programs write for a missing value, as the file has it, be it once, far from all others.

    It is far where it is ``FAR_OFF`` spans of the others away, and as many of their sizes, or negative where all others
    are positive. None without.
    """
    others, found = column[np.abs(column) <= ABSURD], list[float]()
    while len(others) and len(found) < SEVERAL:
        ends = (float(others.min()), float(others.max()))
        code = next((end for end in ends if _spelled(_CODE, end)), None)
        if code is None:
            break
        found.append(code)
        others = others[others != code]
    if not len(others):
        return None
    span, size = float(np.ptp(others)), float(np.abs(others).max())
    for code in found:
        away = float(np.abs(others - code).min())
        far = away > FAR_OFF * size or code < 0 <= float(others.min())
        switch = span == 0 and not (_spelled(_NEVER, code) and (code < 0 or code > LARGER))
        if far and away > FAR_OFF * span and not switch:
            return code
    return None


def _spelled(pattern: re.Pattern[str], value: float) -> bool:
    """Whether a number, or the one of single precision that it was, is written so, whatever its sign."""
    return any(pattern.fullmatch(f"{abs(value):.{digits}g}") for digits in (10, 7))


def outliers(column: Array) -> Indices | None:
    """The few samples that are away from all others by ``OUTLYING`` times what these span; None without."""
    known = np.abs(column) <= ABSURD
    others, most = np.sort(column[known]), max(1, min(MOST_ODD, int(0.01 * known.sum())))
    best, count = None, len(others)
    for low, high in product(range(most + 1), repeat=2):
        rest = others[low : count - high]
        if not 0 < low + high <= most or len(rest) < MIN_SCORED or not (span := float(np.ptp(rest))) > 0:
            continue
        if (not low or rest[0] - others[low - 1] > OUTLYING * span) and (
            not high or others[count - high] - rest[-1] > OUTLYING * span
        ):
            best = np.flatnonzero(known & ((column < rest[0]) | (column > rest[-1])))
    return best


# Jumps


@dataclass(frozen=True)
class Unwrapped:
    """An angle ``(m,)`` that counts on, the samples before which it jumped by whole turns as it was recorded, and those
    before which so many were lost that nobody knows how many turns it made.
    """

    angle: Array
    jumps: Indices
    unclear: Indices


def unwrapped(t: Array, angle: Array, turn: float, max_gap: float, *, periodic: bool = True) -> Unwrapped:
    """The samples that are there of an angle, counted on.

    An angle is wrapped if it keeps within one turn and moves by more than half a turn between neighbouring samples;
    one that is not declared periodic must jump by about a full one. From one sample to the next it is taken to move by
    less than half a turn. Where samples are missing it may move by more at the speeds that it has: there the speeds
    before and after say how many turns it makes, if they agree.
    """
    step, none = np.diff(angle), np.zeros(0, dtype=np.intp)
    near = ~gaps(t, max_gap)
    large = near & (np.abs(step) > 0.5 * turn)
    full = large & (np.abs(np.abs(step) - turn) <= NEARLY * turn)
    if not (large if periodic else full).any() or np.ptp(angle) > SPAN * turn:
        return Unwrapped(angle, none, none)
    turns = np.where(near, -np.round(step / turn), 0.0)
    span, moved = np.diff(t), step + turn * turns
    regular = near & (span <= HOLE * float(np.median(span)))
    speed = np.where(regular, moved / span, np.nan)
    fastest, known, unclear = float(np.nanmax(np.abs(speed), initial=0.0)), np.flatnonzero(regular), []
    for k in np.flatnonzero(near & ~regular & (fastest * span > 0.5 * turn)):
        at = np.searchsorted(known, k)
        sides = (
            speed[known[max(at - 1, 0) : at + 1]] * span[k]
        )  # the way at the speed before, and at that after
        turns[k] = np.round((sides.mean() - step[k]) / turn) if len(sides) else 0.0
        off = abs(step[k] + turn * turns[k] - sides.mean()) if len(sides) else math.inf
        if off + np.ptp(sides) > UNSURE * turn:
            unclear.append(int(k) + 1)
    counted = angle + turn * np.concatenate([[0.0], np.cumsum(turns)])
    return Unwrapped(counted, np.flatnonzero(turns) + 1, np.array(unclear, dtype=np.intp))


def _anew(
    t: Array, x: Array, sizes: Sequence[float], most: float, max_gap: float
) -> tuple[int, Indices] | None:
    """By which of the ``sizes`` a signal ``(m,)`` jumps back against its motion, and the samples before which it does.

    A jump leads from one end of the range to the other, the motion before and after goes on, and is taken off it. The
    signal spans ``most`` sizes at most. None where it does not jump so: a machine that steps goes with its motion.
    """
    step, span = np.diff(x), float(np.ptp(x)) if len(x) else 0.0
    if len(step) < 3 or not span > 0:
        return None
    near = ~gaps(t, max_gap)
    inner = np.flatnonzero(near[1:-1] & near[:-2] & near[2:] & (np.abs(step[1:-1]) > 0.5 * span)) + 1
    before, jump, after = step[inner - 1], step[inner], step[inner + 1]
    on = (before * jump < 0) & (after * jump < 0)
    on &= np.maximum(np.abs(before), np.abs(after)) < NEARLY * np.abs(jump)
    on &= np.abs(before - after) <= np.abs(before + after) / 2
    top, low = np.maximum(x[inner], x[inner + 1]), np.minimum(x[inner], x[inner + 1])
    on &= np.maximum(x.max() - top, low - x.min()) <= 0.75 * np.abs(before + after)  # from end to end
    if not on.any():
        return None
    jumps = np.abs(jump[on] - (before[on] + after[on]) / 2)
    for k, size in enumerate(sizes):
        if (np.abs(jumps - size) <= LIKE * size).all() and span <= most * size:
            return k, inner[on] + 1
    return None


def folded(t: Array, angle: Array, turn: float, max_gap: float) -> tuple[int, Indices] | None:
    """Into how many parts of a turn an angle is folded that begins anew after one, and the samples before which it
    jumps; None where it is not.
    """
    found = _anew(t, angle, [turn / parts for parts in PARTS], SPAN, max_gap)
    return found and (PARTS[found[0]], found[1])


def _jumping(channel: Channel, jumps: Indices, size: str, digits: int, told: str, refused: bool) -> Finding:
    """The finding of a channel that jumps, as it was recorded."""
    y, k, count, unit = channel.y, int(jumps[0]), len(jumps), f" {channel.signal.unit}" * (digits < 10)
    message = (
        f" jumps {count} time{'s' * (count > 1)} by about {size} (first from {y[k - 1]:.{digits}g} to "
        f"{y[k]:.{digits}g}{unit} at {channel.t[k]:.6g} s): {told}"
    )
    return channel.finding("wrapped", k, count, message, refused)


def turn_of(signal: Signal) -> float | None:
    """A full turn in the signal's unit; None if the unit is none of an angle."""
    found = conversion("rev", signal.unit)
    angle = isinstance(found, Conversion) and signal.unit not in ("-", "1", "%", "ppm")
    return found.factor if isinstance(found, Conversion) and angle else None


# Stuck sensors, and speeds


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
    spreads = np.std(np.concatenate([r.u for r in recordings]), axis=0) if recordings else np.zeros(0)
    patience = [_patience(recordings, j, spec) for j in range(len(outputs))]
    rates = states[len(outputs) : 2 * len(outputs)]
    if [s.unit for s in rates] != [f"{s.unit}/s" for s in outputs]:  # the states are no [q, v, ...]
        rates = ()
    found: list[Finding] = []
    for recording, (t, x) in zip(recordings, motions, strict=True):
        found += recording.findings
        for j, (name, signal) in enumerate(zip(spec.outputs, outputs, strict=True)):
            known = np.isfinite(recording.y[:, j])
            channel = Channel(recording.path.name, name, signal, recording.t[known], recording.y[known, j])
            still = still_stretches(
                channel.t, channel.y, recording.u[known], max_gap=spec.max_gap, patience=patience[j], spreads=spreads
            )  # fmt: skip
            censored = recording.censored[known, j]
            found += _stuck(channel, [one for one in still if censored[one.first] == 0])
        for j, speed in enumerate(rates if len(t) else ()):
            v = x[:, len(outputs) + j]
            known = np.isfinite(v)
            found += _too_fast(Channel(recording.path.name, spec.outputs[j], speed, t[known], v[known]))
    return tuple(found)


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
    step, bridged = np.diff(y), ~gaps(t, max_gap)
    edges = np.flatnonzero(np.diff(np.r_[False, (step == 0) & bridged, False].astype(np.int8)))
    first, last = edges[::2], edges[1::2]
    # in bursts of samples a sensor does not change either: they are to last as long as usual ones
    usual = np.diff(t)[bridged]
    long = last - first + 1 >= SHORTEST
    long &= t[last] - t[first] >= (SHORTEST - 1.5) * (float(usual.mean()) if len(usual) else 0.0)
    first, last = first[long], last[long]
    if not len(first):
        return ()
    ordinary = _elsewhere(len(step), first, last) & bridged
    resolution = float(np.quantile(np.abs(step[step != 0]), STEP)) if step.any() else math.inf
    moving = spreads > 0
    # where an input becomes another one by half of its spread, the machine is free to start or stop
    stepped = (np.abs(np.diff(u[:, moving], axis=0)) > STIRRED * spreads[moving]).any(axis=1)
    at = _abrupt(t, y, first, last, ordinary, resolution, np.flatnonzero(stepped) + 1)
    noise, longest = _noise(t, y, ordinary, resolution)
    found = []
    for a, b, speed in zip(first.tolist(), last.tolist(), at.tolist(), strict=True):
        if speed > 0:
            found.append(Still(a, b, "abrupt", speed))
        elif b - a + 1 >= longest and y[a] != 0:
            found.append(Still(a, b, "noise", noise))
        elif t[b] - t[a] > patience and moving.any():
            stirred = np.std(u[a : b + 1], axis=0)[moving] >= STIRRED * spreads[moving]
            if stirred.all():  # all inputs that move in the recordings move here
                found.append(Still(a, b, "driven", float(t[b] - t[a])))
    return tuple(found)


def _abrupt(
    t: Array, y: Array, first: Indices, last: Indices, ordinary: Mask, resolution: float, stepped: Indices
) -> Array:
    """Speed right before or after each stretch if neither an ordinary change of speed nor a step of an input explains
    it, else zero.
    """

    def explained(at: Indices, span: int) -> Mask:  # by a step up to a span and two samples away
        near = np.searchsorted(stepped, at - span - 2), np.searchsorted(stepped, at + span + 3)
        return np.asarray(near[0] < near[1])

    found, period = np.zeros(len(first)), float(np.median(np.diff(t)))
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
    inner = ordinary[:0]
    if len(ordinary) > 3:
        inner = ordinary[:-3] & ordinary[1:-2] & ordinary[2:-1] & ordinary[3:]
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


def _stuck(channel: Channel, still: Sequence[Still]) -> list[Finding]:
    """Clipped at the largest and smallest value, and frozen anywhere else."""
    y, found, ends = channel.y, list[Finding](), list[float]()
    if len(y) and np.ptp(y) > 0:
        ends = [float(y.max()), float(y.min())]
    for upper, value in zip((True, False), ends, strict=False):
        if there := next((s for s in still if y[s.first] == value), None):
            found.append(_clipped(channel, there, upper))
    if rest := [s for s in still if y[s.first] not in ends]:
        found.append(_frozen(channel, rest))
    return sorted(found, key=lambda finding: finding.start)


def _clipped(channel: Channel, first: Still, upper: bool) -> Finding:
    t, y, signal = channel.t, channel.y, channel.signal
    value, count = float(y[first.first]), int((y == y[first.first]).sum())
    low, high = signal.saturation or (-math.inf, math.inf)
    ends = f"({low:g}, {value:g})" if upper else f"({value:g}, {high:g})"
    message = (
        f" stands at its {'largest' if upper else 'smallest'} value, {value:.6g} {signal.unit}, for {count} samples, "
        f"first from {t[first.first]:.6g} to {t[first.last]:.6g} s, {_why(first, signal)}. The sensor is clipped, or "
        f"the machine rests against a stop, which a prior does not know of. If the sensor ends there, declare "
        f"Signal(..., saturation={ends.replace('inf', 'math.inf')}) for {signal.name}: these samples then count as 'at "
        f"{'least' if upper else 'most'}'. {LEAVE_OUT} within the sensor's range."
    )
    return channel.finding("clipped", first.first, count, message)


def _frozen(channel: Channel, still: Sequence[Still]) -> Finding:
    t, signal, others = channel.t, channel.signal, len(still) - 1
    longest = max(still, key=lambda s: t[s.last] - t[s.first])
    count = sum(s.last - s.first + 1 for s in still)
    more = f" ({others} more such stretch{'es' * (others > 1)}, {count} samples in all)" if others else ""
    message = (
        f" repeats {channel.y[longest.first]:.6g} {signal.unit} from {t[longest.first]:.6g} to {t[longest.last]:.6g} s,"
        f" {longest.last - longest.first + 1} samples{more}, {_why(longest, signal)}. "
        f"The sensor is frozen, telegrams are lost, or the machine is blocked. {LEAVE_OUT} again."
    )
    return channel.finding("frozen", still[0].first, count, message)


def _why(still: Still, signal: Signal) -> str:
    if still.why == "abrupt":
        return (
            f"although it moves at {still.amount:.3g} {signal.unit}/s right before or after, and changes its speed "
            "like that nowhere else"
        )
    if still.why == "noise":
        return f"although its noise is {still.amount:.2g} {signal.unit} elsewhere"
    return "while the inputs move as they do elsewhere"


def _too_fast(channel: Channel) -> list[Finding]:
    """Speeds ``(n,)`` out of their plausible range; refused where even the mean one (rms) is."""
    v, speed = channel.y, channel.signal
    bad = np.flatnonzero((v < speed.lower) | (v > speed.upper))
    if not len(bad):
        return []
    worst, mean = int(bad[np.argmax(np.abs(v[bad]))]), float(np.sqrt(np.mean(v**2)))
    absurd = mean > max(abs(speed.lower), abs(speed.upper))
    message = (
        f", differentiated, reaches {v[worst]:.4g} {speed.unit} at {channel.t[worst]:.6g} s; the plausible range of "
        f"{speed.name} is {speed.lower:g} to {speed.upper:g} {speed.unit} ({len(bad)} of {len(v)} samples are beyond"
        f"{f', and so is its mean, {mean:.4g} (rms)' if absurd else ''}). Mostly a unit is wrong (deg for "
        "rad, rpm, ms for s): name it in DataSpec.units. Else look for jumps of the sensor, or widen the range in the "
        "prior."
    )
    return [channel.finding("speed", int(bad[0]), len(bad), message, refused=absurd)]
