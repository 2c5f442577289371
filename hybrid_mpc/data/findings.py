"""Doubtful data in recordings: codes for missing values, outliers, wrapped angles, stuck sensors, absurd speeds.

A sensor is stuck if it repeats a value although the machine cannot stand still (docs/data-checks.md).
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
from hybrid_mpc.machine.units import turn_in
from hybrid_mpc.rules import counted

if TYPE_CHECKING:
    from hybrid_mpc.data.recording import Recording

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
ABSURD = 1e100  # largest absolute value of any signal: its fourth power is still finite
MIN_SCORED = 10  # fewest samples after the warm-up of a piece that is used

# Codes for missing values, and outliers
FAR_OFF = 3.0
"""Least distance of a code for missing values from all other values, in spans and in sizes of these."""
_CODE = re.compile(
    r"999+(\.9+|\.25)?|9\.9+e\+\d\d+|9\.96921e\+36|32767|32768|65535|8388607|8388608|2147483647|2147483648|4294967295|"
    r"1e\+[1-3]\d|3\.402(82|823|823466)e\+38"
)
_NEVER = re.compile(r"9999+(\.9+|\.25)?|999\.25|9\.9.*e\+\d\d+|[13].*e\+[2-9]\d")
"""Codes that cannot be the position of a switch if they are negative or larger than ``LARGER``."""
LARGER = 1e15  # largest number of a machine that switches
OUTLYING = 10.0  # least distance of an outlier from all other values, in spans of these

# Jumps
NEARLY = 0.25
"""Largest deviation of a jump from a full turn, in turns: the angle itself moves less than this between samples."""
SPAN = 1.05
"""Largest span of a wrapped angle in turns: one turn and some noise. An unwrapped angle usually spans more."""
UNSURE = 0.4
"""Largest deviation, in turns, of the motion over missing samples from the motion extrapolated by the speeds before and
after. At half a turn another number of turns would fit equally well."""
PARTS = (2, 3, 4, 6, 8)
"""Fractions of a turn at which a sensor may restart: half turns of an arctangent, pole pairs."""
BITS = (8, 10, 12, 14, 16, 20, 24, 32)  # of counters that overflow

# Stuck sensors
SHORTEST = 5  # fewest equal consecutive samples of a stuck sensor; fewer are a lost message
SPANS = (1, 2, 5)
"""Distances [samples] over which speeds are computed: a sensor's steps hide slow motions in one sample, and fast
motions end within five."""
ABRUPT = 3.0
"""Least sharpness of a stop, over any ordinary change of speed, that indicates a sensor fault. In recordings of five
machines with sound sensors it is 1.5 at most (docs/results/data_checks.md)."""
ORDINARY = 0.99  # quantile of the changes of speed, and of the times between two changes, that is ordinary
STEP = (
    0.1  # quantile of the changes that is the sensor's step; the smallest change may be rounding of the file
)
FEW = 20  # fewest changes of speed in full motion that define the ordinary ones
FEWER = 0.1  # their least share of all changes of speed
WHITE = 0.6
"""Error of a cubic through four neighbours over the error of a line through two, above which the errors are noise. The
ratio is 1.1 for white noise and ``(w dt)^2 / 3`` for a motion of angular frequency w: below 0.06 from 15 samples per
period on."""
FLICKER = 2.0  # noise, in steps of the sensor, above which the sensor flickers also at rest
CHANCE = 1e-3  # probability that such noise repeats a value for so long anywhere in the recording
STIRRED = 0.5
"""Standard deviation of an input within a stretch, over that in all recordings, above which the machine is driven."""
PATIENCE = 10.0  # longest standstill of a driven machine, in longest ordinary times without a change
LENGTHS = 5.0  # standstill that is always allowed, in smoothing lengths
Kind = Literal["read", "clock", "wrapped", "frozen", "clipped", "speed", "missing", "outlier", "settings"]
LEAVE_OUT = "Exclude these samples (by windows in the DataSpec, or by deleting the rows), or record"


@dataclass(frozen=True)
class Finding:
    """Doubtful data in one channel of one recording; ``refused`` if the recording cannot be used as it is.

    ``start`` is the time [s] of the first sample concerned, in the recording's own time; ``count`` is the number of
    samples concerned, for a wrapped angle the number of jumps. ``message`` names the finding, the likely cause and the
    remedy.
    """

    kind: Kind
    file: str
    channel: str
    start: float
    count: int
    message: str
    refused: bool = False

    @property
    def is_note(self) -> bool:
        """Whether the finding only reports an unambiguous conversion while reading, with nothing left to decide."""
        return self.kind == "read"

    def __str__(self) -> str:
        return f"{self.file}: {self.message}"


@dataclass(frozen=True)
class Channel:
    """Samples ``(m,)`` of one channel, with file, column name and signal."""

    file: str
    name: str
    signal: Signal
    t: Array
    y: Array

    def finding(self, kind: Kind, first: int, count: int, message: str, refused: bool = False) -> Finding:
        """A finding about ``count`` samples from index ``first`` on."""
        text = f"column {self.name!r}{message}"
        return Finding(kind, self.file, self.name, float(self.t[first]), count, text, refused)

    def odd(self, there: Mask) -> list[Finding]:
        """Findings of outliers and of rows without a number; ``there`` ``(m,)`` are the rows with a number."""
        found, y, t = list[Finding](), self.y, self.t
        if (far := outliers(y)) is not None:
            rest = np.delete(y, far)
            message = (
                f" is {y[far[0]]:.6g} {self.signal.unit} at {t[far[0]]:.6g} s; {len(far)} of {len(t)} samples are far "
                f"from all others ({np.nanmin(rest):.6g} to {np.nanmax(rest):.6g}). Likely causes: a code for a "
                "missing value, or a lost digit. Leave these cells blank, or delete the rows."
            )
            found.append(self.finding("outlier", far[0], len(far), message))
        if there.any() and not there.all():
            first, count = int(np.argmin(there)), int((~there).sum())
            longest = float(np.diff(np.r_[t[0], t[there], t[-1]]).max())
            message = (
                f" has no number in {count} of {len(t)} rows ({100 * count / len(t):.3g} %), first at {t[first]:.6g} "
                f"s; the longest gap is {longest:.4g} s. Rows without a number count as missing samples. If these "
                "samples were measured, check the cells."
            )
            found.append(self.finding("missing", first, count, message))
        return found

    def jumps(self, raw: Array, max_gap: float) -> tuple[list[Finding], Unwrapped | None]:
        """Findings of jumps by turns, by parts of a turn and by overflows in the recorded numbers ``raw`` ``(m,)``;
        and the unwrapped angle, if a periodic signal was wrapped.
        """
        found, signal, angle, t = list[Finding](), self.signal, None, self.t
        again = "Record an angle without jumps, or unwrap it first: numpy.unwrap(..., period="
        if (turn := turn_in(signal.unit)) is not None:
            angle = unwrap(t, self.y, turn, max_gap, periodic=signal.periodic)
            if len(angle.jumps):
                text = (
                    f"the angle is wrapped. To unwrap it, declare Signal(..., periodic=True) for {signal.name} in the "
                    "prior, or record an angle without jumps."
                )
                if signal.periodic:
                    text = f"the angle is wrapped. {signal.name} is declared periodic, so the angle was unwrapped."
                if signal.periodic and len(angle.unclear):
                    text += (
                        f" The recording is cut at {len(angle.unclear)} samples (first at {t[angle.unclear[0]]:.6g} "
                        "s): too many samples before them are missing, so the turns cannot be counted."
                    )
                found.append(_jumping(self, angle.jumps, "a full turn", 4, text, not signal.periodic))
            elif parted := find_folding(t, self.y, turn, max_gap):
                part = f"1/{parted[0]} of a turn"
                text = (
                    f"the angle restarts after {part}, or its unit is wrong. {again}{turn / parted[0]:.6g})."
                )
                found.append(
                    _jumping(self, parted[1], f"{part} against the direction of motion", 4, text, True)
                )
        # integers of b bits span less than 2^b
        if (raw == np.round(raw)).all() and (
            over := _find_restarts(t, raw, [2.0**b for b in BITS], 1 - 1e-10, max_gap)
        ):
            bits = BITS[over[0]]
            text = f"a counter of {bits} bits overflows. {again}{2**bits})."
            counts = Channel(self.file, self.name, signal, t, raw)
            found.append(
                _jumping(counts, over[1], f"{2**bits} against the direction of motion", 10, text, True)
            )
        return found, angle if angle is not None and len(angle.jumps) and signal.periodic else None


def gaps(t: Array, max_gap: float) -> Mask:
    """Which of the steps ``(m - 1,)`` between time stamps ``(m,)`` are longer than ``max_gap`` [s]."""
    return np.asarray(np.diff(t) > max_gap * (1 + 1e-6))


# Codes for missing values, and outliers


def missing_code(column: Array) -> float | None:
    """A code that logging programs write for missing values, as in the file; None without one. One sample suffices.

    The code must be away from all other values by ``FAR_OFF`` times their span, and either by ``FAR_OFF`` times their
    largest size or negative where all others are not.
    """
    others, found = column[np.abs(column) <= ABSURD], list[float]()
    # most codes that are looked for in one column
    while len(others) and len(found) < 4:
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
    """Whether a number, in double or single precision and without its sign, is written as the pattern says."""
    return any(pattern.fullmatch(f"{abs(value):.{digits}g}") for digits in (10, 7))


def outliers(column: Array) -> Indices | None:
    """The few samples that are away from all others by ``OUTLYING`` times their span; None without any."""
    known = np.abs(column) <= ABSURD
    # most outliers of a column, and at most one sample in a hundred: more are a motion
    others, most = np.sort(column[known]), max(1, min(5, int(0.01 * known.sum())))
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
    """An unwrapped angle ``(m,)``; the samples before which the recorded angle jumped by whole turns; and the samples
    before which so many are missing that the number of turns is unknown.
    """

    angle: Array
    jumps: Indices
    unclear: Indices


def unwrap(t: Array, angle: Array, turn: float, max_gap: float, *, periodic: bool = True) -> Unwrapped:
    """Unwrap an angle; missing samples are left out of ``angle``.

    An angle is wrapped if it stays within one turn and moves by more than half a turn between neighbouring samples; if
    the signal is not declared periodic, the jump must be about a full turn. Between neighbouring samples the true
    motion is assumed to be less than half a turn. Over missing samples it may be more: there the speeds before and
    after give the number of turns, if they agree.
    """
    step, none = np.diff(angle), np.zeros(0, dtype=np.intp)
    near = ~gaps(t, max_gap)
    large = near & (np.abs(step) > 0.5 * turn)
    full = large & (np.abs(np.abs(step) - turn) <= NEARLY * turn)
    if not (large if periodic else full).any() or np.ptp(angle) > SPAN * turn:
        return Unwrapped(angle, none, none)
    turns = np.where(near, -np.round(step / turn), 0.0)
    span, moved = np.diff(t), step + turn * turns
    # time step, in median steps, above which samples are missing between two stamps
    regular = near & (span <= 1.5 * float(np.median(span)))
    speed = np.where(regular, moved / span, np.nan)
    fastest, known, unclear = float(np.nanmax(np.abs(speed), initial=0.0)), np.flatnonzero(regular), []
    for k in np.flatnonzero(near & ~regular & (fastest * span > 0.5 * turn)):
        at = np.searchsorted(known, k)
        sides = (
            speed[known[max(at - 1, 0) : at + 1]] * span[k]
        )  # motion over the gap at the speed before and after
        turns[k] = np.round((sides.mean() - step[k]) / turn) if len(sides) else 0.0
        off = abs(step[k] + turn * turns[k] - sides.mean()) if len(sides) else math.inf
        if off + np.ptp(sides) > UNSURE * turn:
            unclear.append(int(k) + 1)
    counted = angle + turn * np.concatenate([[0.0], np.cumsum(turns)])
    return Unwrapped(counted, np.flatnonzero(turns) + 1, np.array(unclear, dtype=np.intp))


def _find_restarts(
    t: Array, x: Array, sizes: Sequence[float], most: float, max_gap: float
) -> tuple[int, Indices] | None:
    """Which of the ``sizes`` a signal ``(m,)`` jumps by against its motion, and the samples before which it jumps.

    A jump leads from one end of the range to the other while the motion before and after continues; the motion is
    subtracted from the jump. The signal spans at most ``most`` sizes. None without such jumps: the steps of a machine
    have the direction of its motion.
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
        # largest relative deviation of a jump, the motion around it subtracted, from such a fraction
        if (np.abs(jumps - size) <= 0.03 * size).all() and span <= most * size:
            return k, inner[on] + 1
    return None


def find_folding(t: Array, angle: Array, turn: float, max_gap: float) -> tuple[int, Indices] | None:
    """Number of parts of a turn after each of which an angle restarts, and the samples before which it jumps; None if
    it never restarts.
    """
    found = _find_restarts(t, angle, [turn / parts for parts in PARTS], SPAN, max_gap)
    return found and (PARTS[found[0]], found[1])


def _jumping(channel: Channel, jumps: Indices, size: str, digits: int, text: str, refused: bool) -> Finding:
    """The finding about a channel with jumps, from its recorded numbers."""
    y, k, count, unit = channel.y, int(jumps[0]), len(jumps), f" {channel.signal.unit}" * (digits < 10)
    message = (
        f" jumps {counted(count, 'time')} by about {size} (first from {y[k - 1]:.{digits}g} to "
        f"{y[k]:.{digits}g}{unit} at {channel.t[k]:.6g} s): {text}"
    )
    return channel.finding("wrapped", k, count, message, refused)


# Stuck sensors, and speeds


def findings_of(
    recordings: Sequence[Recording],
    motions: Sequence[tuple[Array, Array]],
    spec: DataSpec,
    *,
    outputs: Sequence[Signal],
    states: Sequence[Signal] = (),
) -> tuple[Finding, ...]:
    """All findings about the recordings of a run, file by file, including those of the recordings themselves.

    ``motions`` are smoothed times ``(n,)`` [s] and states ``(n, n_x)`` of each recording; ``n = 0`` if smoothing was
    impossible. Speeds are checked if ``states``, the prior's signals, are given.
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
    """Longest standstill [s] of a driven machine, from the times between two changes of an output in all recordings."""
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
    """Equal consecutive samples, from index ``first`` to ``last``, that a standstill of the machine does not explain.

    ``"abrupt"``: the stretch begins or ends in full motion; ``"noise"``: the sensor's noise stops as well;
    ``"driven"``: the inputs keep moving. ``amount`` is the speed just before or after [unit/s], the standard deviation
    of the noise [unit], or the length [s].
    """

    first: int
    last: int
    why: Literal["abrupt", "noise", "driven"]
    amount: float


def still_stretches(
    t: Array, y: Array, u: Array, *, max_gap: float, patience: float, spreads: Array
) -> tuple[Still, ...]:
    """Intervals of equal samples that a standstill of the machine does not explain (as it does for a coarse encoder).

    ``"abrupt"``: the change of speed at the stretch is ``ABRUPT`` times sharper than any ordinary one. Steps of the
    sensor count as ordinary changes; next to a step of an input any change is allowed. ``"noise"``: a sensor whose
    noise exceeds its steps flickers even at rest, and here it does not; exact zeros are exempt, since speeds computed
    from counts are exactly zero at rest. ``"driven"``: the inputs keep moving for longer than ``patience``.
    """
    step, bridged = np.diff(y), ~gaps(t, max_gap)
    edges = np.flatnonzero(np.diff(np.r_[False, (step == 0) & bridged, False].astype(np.int8)))
    first, last = edges[::2], edges[1::2]
    # bursts of samples repeat a value, too: a stretch must last as long as samples at the usual rate
    usual = np.diff(t)[bridged]
    long = last - first + 1 >= SHORTEST
    long &= t[last] - t[first] >= (SHORTEST - 1.5) * (float(usual.mean()) if len(usual) else 0.0)
    first, last = first[long], last[long]
    if not len(first):
        return ()
    ordinary = _elsewhere(len(step), first, last) & bridged
    resolution = float(np.quantile(np.abs(step[step != 0]), STEP)) if step.any() else math.inf
    moving = spreads > 0
    # after an input's step of at least half its spread the machine may start or stop sharply
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
    """Speed just before or after each stretch, if neither an ordinary change of speed nor a step of an input explains
    the stop; else zero.
    """

    def explained(at: Indices, span: int) -> Mask:  # a step of an input at most a span and two samples away
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
            chosen = change > 0  # a sensor slower than its recording repeats values all the time
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
    """Standard deviation of the noise, and the fewest equal samples it practically never produces (else infinity)."""
    inner = ordinary[:0]
    if len(ordinary) > 3:
        inner = ordinary[:-3] & ordinary[1:-2] & ordinary[2:-1] & ordinary[3:]
    if inner.sum() < FEW:
        return 0.0, math.inf
    line = float(np.median(np.abs(_misfit(t, y, (-1, 1))[inner])))
    cubic = float(np.median(np.abs(_misfit(t, y, (-2, -1, 1, 2))[inner])))
    # median of |e| of a Gaussian: 0.6745 sigma_e; sigma_e^2 = (1 + 2 / 4) sigma^2 for a sample less the mean of two
    sigma = line / (0.6745 * math.sqrt(1.5))
    if cubic < WHITE * line or sigma < FLICKER * resolution:
        return 0.0, math.inf
    repeated = float((np.diff(y)[ordinary] == 0).mean())
    # a run of n equal samples at one of m places: m p^n = CHANCE with p the share of repeated values
    least = math.log(CHANCE / len(y)) / math.log(repeated) if repeated else 0.0
    return sigma, max(SHORTEST, least)


def _misfit(t: Array, y: Array, places: tuple[int, ...]) -> Array:
    """Samples minus the Lagrange polynomial through their neighbours at ``places``; ``(m - 4,)``, from sample 2 on."""

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
    """Findings of stuck stretches: clipped at the largest and smallest value, frozen anywhere else."""
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
        f" stays at its {'largest' if upper else 'smallest'} value, {value:.6g} {signal.unit}, for {count} samples, "
        f"first from {t[first.first]:.6g} to {t[first.last]:.6g} s, {_why(first, signal)}. The sensor is clipped, or "
        "the machine stands at a mechanical stop that the prior does not model. If the sensor's range ends at this "
        f"value, declare Signal(..., saturation={ends.replace('inf', 'math.inf')}) for {signal.name}: these samples "
        f"then count as censored (true value at {'least' if upper else 'most'} {value:.6g}). {LEAVE_OUT} within the "
        "sensor's range."
    )
    return channel.finding("clipped", first.first, count, message)


def _frozen(channel: Channel, still: Sequence[Still]) -> Finding:
    t, signal, others = channel.t, channel.signal, len(still) - 1
    longest = max(still, key=lambda s: t[s.last] - t[s.first])
    count = sum(s.last - s.first + 1 for s in still)
    more = f" ({others} more such interval{'s' * (others > 1)}, {count} samples in all)" if others else ""
    message = (
        f" repeats {channel.y[longest.first]:.6g} {signal.unit} from {t[longest.first]:.6g} to {t[longest.last]:.6g} "
        f"s, {longest.last - longest.first + 1} samples{more}, {_why(longest, signal)}. The sensor is frozen, messages "
        f"are lost, or the machine is blocked. {LEAVE_OUT} again."
    )
    return channel.finding("frozen", still[0].first, count, message)


def _why(still: Still, signal: Signal) -> str:
    if still.why == "abrupt":
        return (
            f"although the speed just before or after is {still.amount:.3g} {signal.unit}/s, and no other change of "
            "speed is as sharp"
        )
    if still.why == "noise":
        return f"although the noise of the sensor is {still.amount:.2g} {signal.unit} at other times"
    return "while the inputs keep moving"


def _too_fast(channel: Channel) -> list[Finding]:
    """Speeds ``(n,)`` outside their plausible range; refused if even their mean (rms) is outside."""
    v, speed = channel.y, channel.signal
    bad = np.flatnonzero((v < speed.lower) | (v > speed.upper))
    if not len(bad):
        return []
    worst, mean = int(bad[np.argmax(np.abs(v[bad]))]), float(np.sqrt(np.mean(v**2)))
    absurd = mean > max(abs(speed.lower), abs(speed.upper))
    message = (
        f": its derivative {speed.name} reaches {v[worst]:.4g} {speed.unit} at {channel.t[worst]:.6g} s, outside the "
        f"plausible range {speed.lower:g} to {speed.upper:g} {speed.unit} ({len(bad)} of {len(v)} "
        f"samples{f'; the rms, {mean:.4g}, is outside, too' if absurd else ''}). The usual cause is a wrong unit (deg "
        "for rad, rpm, ms for s): name the unit in DataSpec.units. Otherwise look for jumps of the sensor, or widen "
        "the range in the prior."
    )
    return [channel.finding("speed", int(bad[0]), len(bad), message, refused=absurd)]
