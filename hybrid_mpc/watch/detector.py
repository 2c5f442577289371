"""Limits of channels, and the detector that compares every channel with its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.rules import Line, two_digits
from hybrid_mpc.watch.readings import Channel

Array = NDArray[np.float64]
CAP = 1.5
"""Saturation of the sums as a multiple of the threshold, so that an alarm ends soon after its cause."""


@dataclass(frozen=True)
class ChannelLimit:
    """Limit of one channel.

    The value is divided by its nominal deviation, the root of ``scale`` times the sample's terms, or by 1 without
    ``scale``. The **level** is then, by ``length``:

    - 0: a cumulative sum (CUSUM), ``g = max(0, g + z - drift)``, and the same for ``-z``; the larger of both. It rises
      while ``|z|`` exceeds ``drift`` and falls otherwise, so large changes are detected sooner.
    - 1: the value itself.
    - n: the mean of the latest n values; unknown if fewer than half of them are numbers.

    An alarm starts where the magnitude of the level exceeds ``threshold`` and ends below ``release``.

    Args:
        channel: Name of the channel.
        unit: Unit of the channel.
        length: Number of samples, see above.
        threshold: Alarm threshold [deviations, or the unit]; infinite if a measured disturbance was constant.
        release: Level at which an alarm ends; at most the threshold.
        scale: Coefficients of the variance [unit squared, over that of the terms]. Default: none.
        drift: Dead band of a cumulative sum [deviations]. Default: 0.
        interval: 5 % and 95 % quantiles of the threshold, by a block bootstrap. Default: unknown.

    Raises:
        InputError: If a number is out of its range.

    Source: Page, *Continuous inspection schemes*, Biometrika 41 (1954).
    """

    channel: Line
    unit: Line
    length: int
    threshold: float
    release: float
    scale: tuple[float, ...] = ()
    drift: float = 0.0
    interval: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.scale and not (all(math.isfinite(a) and a >= 0 for a in self.scale) and any(self.scale)):
            raise InputError(
                f"limit of {self.channel}: scale must be numbers of at least 0, not all of them 0; got {self.scale}"
                " [HM-WATCH-001]"
            )
        if not 0 < self.release <= self.threshold:
            raise InputError(
                f"limit of {self.channel}: give 0 < release <= threshold, got {self.release} and {self.threshold}"
                " [HM-WATCH-002]"
            )
        if not (self.length >= 0 and 0 <= self.drift < math.inf):
            raise InputError(
                f"limit of {self.channel}: length {self.length} and drift {self.drift} must not be negative"
                " [HM-WATCH-003]"
            )

    def words(self, dt: float) -> str:
        """Text with the threshold, its unit and the compared level.

        Example:
            >>> ChannelLimit("level", "m", 15, 0.2, 0.1).words(0.02)
            '0.2 m, mean over 0.3 s'
            >>> ChannelLimit("force of q", "N", 0, 20.0, 10.0, (1.0,)).words(0.02)
            '20 deviations, summed'
        """
        unit = "deviations" if self.scale else self.unit
        how = {0: ", summed", 1: ""}.get(self.length, f", mean over {self.length * dt:.3g} s")
        return f"{self.threshold:.3g} {unit}{how}"


@dataclass(frozen=True)
class WatchLimits:
    """Limits of all channels of one kind of readings, learned from fault-free recordings or loops.

    Args:
        kind: Kind of the readings, see :mod:`hybrid_mpc.watch.readings`.
        dt: Period [s] of the nominal data.
        channels: One or two limits for each channel that can alarm.
        travel: Frozen sensor: largest predicted motion of each output while its readings repeat ``(n_y,)`` [its unit].
        repeats: Frozen sensor: largest number of repeated readings while the output should move ``(n_y,)``.
        false_alarms_per_hour: Wanted rate [1/h] of all false alarms together. Default: unknown.
        hours: Duration of the nominal data [h]. Default: 0.
        method: How the thresholds were computed. Default: unknown.
        rated: Whether the thresholds correspond to the rate; False if the nominal data were too short, and thresholds
            are a margin above the highest nominal level. Default: True.
        rest_speed: Speeds ``(n_q,)`` [unit of v] below which friction may stick. Default: unknown.
        data_hash: Hash of the nominal data. Default: unknown.
        time_unit: Time constant of the machine [s], the unit of all lengths. Default: 1.

    Raises:
        InputError: If a number is out of its range.
    """

    kind: Line
    dt: float
    channels: tuple[ChannelLimit, ...]
    travel: tuple[float, ...]
    repeats: tuple[int, ...]
    false_alarms_per_hour: float = math.nan
    hours: float = 0.0
    method: Line = ""
    rated: bool = True
    rest_speed: tuple[float, ...] = ()
    data_hash: Line = ""
    time_unit: float = 1.0

    def __post_init__(self) -> None:
        if not (self.dt > 0 and self.time_unit > 0):
            raise InputError(
                f"limits: dt {self.dt} and time_unit {self.time_unit} must be positive [HM-WATCH-004]"
            )
        if len(self.travel) != len(self.repeats) or not all(far > 0 for far in self.travel):
            raise InputError(
                f"limits: give one positive travel for each output, got {self.travel} [HM-WATCH-005]"
            )

    @property
    def words(self) -> str:
        """The promised rate of false alarms; or that none is promised, and from how little data.

        Example:
            >>> WatchLimits("energy", 1.0, (), (), (), 10 / 360, hours=2.0).words
            'limits for 0.028 false alarms an hour, learned from 2 h of nominal data'
            >>> WatchLimits("energy", 1.0, (), (), (), 10.0, hours=0.1, rated=False).words
            'no rate of false alarms is promised: 0.1 h of nominal data are too few for 10 an hour'
        """
        hours, rate = two_digits(self.hours), two_digits(self.false_alarms_per_hour)
        if not self.rated:
            return f"no rate of false alarms is promised: {hours} h of nominal data are too few for {rate} an hour"
        return f"limits for {rate} false alarms an hour, learned from {hours} h of nominal data"

    def of(self, channel: str) -> tuple[ChannelLimit, ...]:
        """Limits of a channel, the shortest first."""
        return tuple(limit for limit in self.channels if limit.channel == channel)

    def check(
        self, kind: str, channels: Sequence[Channel], n_terms: int, dt: float, time_unit: float
    ) -> None:
        """Refuse readings with other channels, another period or another time unit."""
        known = {(c.name, c.unit) for c in channels}
        strange = [one.channel for one in self.channels if (one.channel, one.unit) not in known]
        if kind != self.kind or strange:
            raise InputError(
                f"limits: learned for {', '.join(strange) or self.kind}, but the readings are of {kind}: "
                f"{', '.join(c.name for c in channels)}. Learn the limits again with learn_limits [HM-WATCH-006]"
            )
        if wrong := [one.channel for one in self.channels if len(one.scale) not in (0, n_terms)]:
            raise InputError(
                f"limits: the scale of {wrong[0]} must have {n_terms} numbers. Learn the limits again [HM-WATCH-007]"
            )
        for what, own, given in (("a period", self.dt, dt), ("a time unit", self.time_unit, time_unit)):
            if abs(own - given) > 1e-9 * own:
                raise InputError(
                    f"limits: learned with {what} of {own:g} s, but the model has {given:g} s. Learn the limits again "
                    "[HM-WATCH-008]"
                )


@dataclass(frozen=True)
class DetectorState:
    """State of the detector: sums of each cumulative limit, upwards and downwards; exceeded limits; the latest values
    ``(longest, averaged channels)``; number of counted samples.
    """

    sums: tuple[float, ...]
    on: tuple[bool, ...]
    recent: Array
    counted: int = 0


class Detector:
    """Compares the values of channels with their limits, sample by sample; a pure function of its state.

    Example:
        >>> detector = Detector((ChannelLimit("force", "N", 0, 4.0, 2.0, (0.01,), 0.5),), ("force",))
        >>> state, alarms = detector.initial(), []
        >>> for force in (0.0, 0.3, 0.3, 0.3):  # three deviations
        ...     state, levels, share = detector.update(state, [force], [(1.0,)], True)
        ...     alarms.append(state.on[0])
        >>> alarms
        [False, False, True, True]
    """

    def __init__(self, limits: Sequence[ChannelLimit], channels: Sequence[str]) -> None:
        self.limits = tuple(limits)
        places = [list(channels).index(limit.channel) for limit in limits]
        self.channels = tuple(places)
        """Index of each limit's channel."""
        every = list(enumerate(zip(limits, places, strict=True)))
        self._sums = [
            (i, k, c, one.scale, one.drift, CAP * one.threshold)
            for k, (i, (one, c)) in enumerate((i, pair) for i, pair in every if not pair[0].length)
        ]
        self._values = [(i, c, one.scale) for i, (one, c) in every if one.length == 1]
        means = [(i, c, one) for i, (one, c) in every if one.length > 1]
        averaged = sorted({c for _, c, _ in means})
        self._averaged = np.array(averaged, dtype=int)
        self._means = [
            (length, [i for i, _, one in means if one.length == length],
             [averaged.index(c) for _, c, one in means if one.length == length])
            for length in sorted({one.length for _, _, one in means})
        ]  # fmt: skip
        self.longest = max((one.length for _, _, one in means), default=0)
        if any(one.scale for _, _, one in means):
            raise InputError(
                "detector: a limit with scale cannot be a mean. Give a length of 0 or 1 [HM-WATCH-009]"
            )
        self._bounds = [(one.threshold, one.release) for one in limits]

    def initial(self) -> DetectorState:
        """State before the first sample."""
        recent = np.full((self.longest, len(self._averaged)), np.nan)
        return DetectorState((0.0,) * (2 * len(self._sums)), (False,) * len(self.limits), recent)

    def begun(self, state: DetectorState) -> DetectorState:
        """The state with all sums reset to 0."""
        return DetectorState((0.0,) * len(state.sums), state.on, state.recent, state.counted)

    def update(
        self,
        state: DetectorState,
        values: Sequence[float] | Array,
        terms: Sequence[Sequence[float]],
        settled: bool,
    ) -> tuple[DetectorState, list[float], float]:
        """Process one sample of values and terms; a NaN value does not change its sum.

        Returns:
            The next state; the level of each limit; the largest ratio of a level to its threshold.
        """
        levels, sums = [0.0] * len(self.limits), list(state.sums)
        for i, k, c, scale, drift, most in self._sums:
            z = values[c] / _deviation(scale, terms, c)
            if z == z:  # not NaN
                up, down = sums[2 * k] + z - drift, sums[2 * k + 1] - z - drift
                sums[2 * k] = 0.0 if up < 0.0 else min(up, most)
                sums[2 * k + 1] = 0.0 if down < 0.0 else min(down, most)
            levels[i] = max(sums[2 * k], sums[2 * k + 1])
        for i, c, scale in self._values:
            z = values[c] / _deviation(scale, terms, c)
            if z == z:
                levels[i] = z
        recent, counted = state.recent, state.counted
        if self.longest:
            latest = np.asarray(values)[self._averaged] if settled else np.full(len(self._averaged), np.nan)
            recent, counted = np.vstack([recent[1:], latest]), min(counted + settled, self.longest)
            for length, rows, columns in self._means:
                means = _mean(recent[-length:]) if counted >= length else np.full(recent.shape[1], np.nan)
                for i, c in zip(rows, columns, strict=True):
                    levels[i] = means[c]
        on, share = [], 0.0
        for level, was, (threshold, release) in zip(levels, state.on, self._bounds, strict=True):
            size = abs(level) if level == level else 0.0
            on.append(size > (release if was else threshold))
            share = max(share, size / threshold)
        return DetectorState(tuple(sums), tuple(on), recent, counted), levels, share


def _deviation(scale: Sequence[float], terms: Sequence[Sequence[float]], channel: int) -> float:
    if not scale:
        return 1.0
    variance = 0.0
    for a, term in zip(scale, terms[channel], strict=True):
        variance += a * term
    return math.sqrt(variance)


def _mean(rows: Array) -> Array:
    """Mean of each column without NaN; NaN if fewer than half of its values are numbers."""
    finite = np.isfinite(rows)
    count = finite.sum(axis=0)
    total = np.where(finite, rows, 0.0).sum(axis=0)
    return np.where(2 * count >= len(rows), total / np.maximum(count, 1), np.nan)
