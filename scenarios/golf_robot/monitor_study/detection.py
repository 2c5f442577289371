"""The guard's detector, baselines on the filter's innovations, and a combination, all learned and evaluated alike."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.watch.detector import Detector, WatchLimits
from hybrid_mpc.watch.learn import MAX_EXTRAPOLATION, MIN_BLOCKS, block_maxima, gumbel, levels_of, limits_of
from hybrid_mpc.watch.lengths import AVERAGE_S, SETTLING_S, WINDOW_S, block_seconds
from hybrid_mpc.watch.readings import FROZEN_STEPS, Readings

Array = NDArray[np.float64]
REST_SPEED = 0.2
"""Speed of this robot [rad/s] below which its friction may stick, where no recording gave one."""
RELEASE = 0.5
METHODS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "guard": {"forces": 0.5, "power": 0.5, "freeze": 0.0},
        "guard_or_innovation": {"forces": 0.25, "power": 0.25, "freeze": 0.0, "innovation_rms": 0.5},
        "level": {"level": 1.0},
        "innovation_chi2": {"innovation_chi2": 1.0},
        "innovation_rms": {"innovation_rms": 1.0},
    }
)
"""By method the parts that alarm, each with its share of the wanted rate; 0 for one whose threshold is fixed.

``guard``: sums of scaled residual forces, power of the free runs, freeze test. ``level``: the averaged one-step
violation alone. ``innovation_chi2``: normalised innovation squared, averaged over the guard's window, what a
chi-square test looks at; its threshold is learned too, for the innovations of a switching filter are not white.
``innovation_rms``: root mean square of the output's residual over that window. ``guard_or_innovation``: either, each
at half the rate.
"""


@dataclass(frozen=True)
class Trace:
    """What detectors see of a loop of n periods.

    ``values`` ``(n, channels)`` and ``terms`` ``(n, channels, 4)`` are those of the energy's readings, ``travel`` that
    of the sensors ``(n, n_y)``, ``speed`` the largest true speed of the degrees of freedom. Innovations ``(n, n_y)``
    and their normalised squares ``nis`` ``(n,)`` are NaN in the first row.
    """

    values: Array
    terms: Array
    travel: Array
    innovation: Array
    nis: Array
    speed: Array

    @property
    def settled(self) -> NDArray[np.bool_]:
        """All values count."""
        return np.ones(len(self.values), dtype=bool)


@dataclass(frozen=True)
class Detectors:
    """All methods, learned from the same ``hours`` of nominal loops.

    ``limits`` have the scales of residual forces and power; their thresholds are set by the wanted rate. ``tails`` has
    by part location and scale of the Gumbel tail of its maxima in blocks (:attr:`block_s`); ``resolution`` the step
    of each sensor.
    """

    limits: WatchLimits
    tails: Mapping[str, tuple[float, float]]
    resolution: tuple[float, ...]
    hours: float = 0.0
    blocks: int = 0

    def __post_init__(self) -> None:
        known = {part for parts in METHODS.values() for part in parts} - {"freeze"}
        if not set(self.tails) <= known:
            raise InputError(
                f"detectors: tails of {sorted(self.tails)}, known are {sorted(known)} [HM-SCENARIOS-009]"
            )

    @property
    def block_s(self) -> float:
        """Length of a block [s]."""
        return block_seconds(self.limits.dt, self.limits.time_unit)

    @property
    def settling(self) -> int:
        """Samples at the beginning of a loop that do not count."""
        return round(SETTLING_S * self.limits.time_unit / self.limits.dt)

    def threshold(self, part: str, rate: float) -> float:
        """Level that a part passes at that rate [1/h] on nominal data; 1 for the freeze test, a share already."""
        if part == "freeze":
            return 1.0
        location, scale = self.tails[part]
        return max(location - scale * math.log(rate * self.block_s / 3600.0), 1e-12)

    def limits_at(self, rate: float) -> WatchLimits:
        """The limits with thresholds for that rate [1/h] in all, half of it for forces and half for the power."""
        force, power = (self.threshold(part, 0.5 * rate) for part in ("forces", "power"))
        tops = [force if one.length == 0 else power for one in self.limits.channels]
        channels = tuple(
            replace(one, threshold=top, release=RELEASE * top)
            for one, top in zip(self.limits.channels, tops, strict=True)
        )
        method = f"Gumbel tail of maxima in blocks of {self.block_s:g} s"
        return replace(self.limits, channels=channels, false_alarms_per_hour=rate, method=method)

    def levels(self, trace: Trace) -> dict[str, Array]:
        """Level ``(n,)`` of each part along a loop; zero where it says nothing, and while the estimator settles."""
        unit = self.limits.time_unit / self.limits.dt
        window, all_of_it = WINDOW_S * unit, [np.ones(len(trace.values), dtype=bool)]
        parts = levels_of(_detector(self.limits, math.inf), [cast(Any, trace)], all_of_it)
        of = [np.nan_to_num(runs[0]) for runs in parts]
        forces = np.max(
            [v for v, one in zip(of, self.limits.channels, strict=True) if one.length == 0], axis=0
        )
        power = np.max(
            [v for v, one in zip(of, self.limits.channels, strict=True) if one.length == 1], axis=0
        )
        travel = np.abs(trace.travel) / (FROZEN_STEPS * np.array(self.resolution))
        squares = (trace.innovation**2).sum(axis=1)
        found = {
            "forces": forces,
            "power": power,
            "freeze": travel.max(axis=1),
            "level": _averaged(trace.values[:, 0], AVERAGE_S * unit),
            "innovation_chi2": _averaged(trace.nis, window),
            "innovation_rms": np.sqrt(_averaged(squares, window)),
        }
        result = {name: np.nan_to_num(level) for name, level in found.items()}
        for level in result.values():
            level[: self.settling] = 0.0
        return result

    def score(self, levels: Mapping[str, Array], method: str, rate: float) -> Array:
        """Largest share ``(n,)`` of its threshold among a method's parts."""
        return np.asarray(
            np.max(
                [levels[p] / self.threshold(p, share * rate) for p, share in METHODS[method].items()], axis=0
            )
        )

    def alarm(self, levels: Mapping[str, Array], trace: Trace, method: str, rate: float) -> NDArray[np.bool_]:
        """Alarm ``(n,)`` of a method: each part's with its hysteresis, sums capped as online."""
        parts, on = METHODS[method], np.zeros(len(trace.values), dtype=bool)
        for part, share in parts.items():
            if part == "forces":
                on |= self._detected(trace, 2 * share * rate)
            elif part == "freeze":
                on |= levels[part] > 1.0
            elif part != "power":
                on |= with_hysteresis(levels[part], self.threshold(part, share * rate))
        on[: self.settling] = False
        return on

    def _detected(self, trace: Trace, rate: float) -> NDArray[np.bool_]:
        detector = _detector(self.limits_at(rate), 1.0)
        state, found = detector.initial(), []
        for values, terms in zip(trace.values.tolist(), trace.terms.tolist(), strict=True):
            state, _, _ = detector.update(state, values, terms, True)
            found.append(any(state.on))
        return np.array(found, dtype=bool)


def _detector(limits: WatchLimits, factor: float) -> Detector:
    """The detector of limits, their thresholds times a factor; infinite: no alarm limits the sums."""
    channels = [
        replace(one, threshold=one.threshold * factor, release=one.release * factor)
        for one in limits.channels
    ]
    names = ["violation", *(one.channel for one in limits.channels)]
    return Detector(channels, names)


def learn_detectors(
    traces: Sequence[Trace],
    readings: Readings,
    resolution: Sequence[float],
    *,
    rate: float = 1.0,
    data_hash: str = "",
) -> Detectors:
    """All methods from nominal loops, for wanted rates of false alarms down to ``rate``.

    Thresholds are Gumbel tails of block maxima, as :func:`~hybrid_mpc.watch.learn.calibrate` makes them. The
    loops are known to be nominal, so a block that stands out is no reason to refuse them.
    """
    dt, time_unit = readings.model.dt, readings.model.time_unit
    skipped, block_s = round(SETTLING_S * time_unit / dt), block_seconds(dt, time_unit)
    runs = [trace.values[skipped:] for trace in traces]
    share = min(s for parts in METHODS.values() for s in parts.values() if s)
    needed = max(MIN_BLOCKS, math.ceil(3600.0 / (share * rate * block_s * MAX_EXTRAPOLATION)))
    size = round(block_s / dt)
    blocks = sum(len(run) // size for run in runs)
    if blocks < needed:
        raise InputError(
            f"learning: {blocks * block_s / 60:.1f} min of nominal loops in whole blocks of {block_s:g} s; a rate "
            f"of {rate:g}/h, of which a part gets {share:g}, needs {needed * block_s / 60:.1f} min [HM-SCENARIOS-010]"
        )
    limits = limits_of(
        readings, [trace.travel for trace in traces], [cast(Any, trace) for trace in traces],
        false_alarms_per_hour=rate, resolution=resolution, data_hash=data_hash, trusted=True,
    )  # fmt: skip
    hours = sum(len(run) for run in runs) * dt / 3600.0
    detectors = Detectors(limits, {}, tuple(resolution), hours, blocks)
    levels = [detectors.levels(trace) for trace in traces]
    tails = {}
    for part in levels[0]:
        if part != "freeze":
            maxima, _ = block_maxima([level[part][skipped:] for level in levels], size)
            tails[part] = gumbel(maxima)
    return replace(detectors, tails=tails)


def with_hysteresis(level: Array, threshold: float) -> NDArray[np.bool_]:
    """Alarm ``(n,)`` that begins above a threshold and ends below a share of it."""
    state = np.where(level > threshold, 1, np.where(level > RELEASE * threshold, 0, -1))
    places = np.maximum.accumulate(np.where(state != 0, np.arange(len(state)), -1))
    return np.asarray((places >= 0) & (state[np.maximum(places, 0)] == 1))


def _averaged(values: Array, window: float) -> Array:
    n = max(round(window), 1)
    return np.convolve(np.nan_to_num(values), np.ones(n) / n)[: len(values)]
