"""The guard's detector, baselines on the filter's innovations, and a combination, all learned and evaluated alike."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.monitor.calibrate import MAX_EXTRAPOLATION, MIN_BLOCKS, block_maxima, gumbel
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.energy import FROZEN_STEPS
from hybrid_mpc.monitor.learn import DRIFT, detector_levels, learn_detector
from hybrid_mpc.monitor.lengths import SETTLING_S, WINDOW_S, block_seconds

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

    ``numbers`` are ``MonitorReading.numbers``, ``level_w`` the averaged one-step violation [W], ``speed`` the largest
    true speed of the degrees of freedom. Innovations ``(n, n_y)`` and their normalised squares ``nis`` ``(n,)`` are
    NaN in the first row.
    """

    numbers: Array
    level_w: Array
    innovation: Array
    nis: Array
    speed: Array


@dataclass(frozen=True)
class Detectors:
    """All methods, learned from the same ``hours`` of nominal loops.

    ``detector`` has the scales of residual forces and power; its thresholds are set by the wanted rate. ``tails`` has
    by part location and scale of the Gumbel tail of its maxima in blocks (:attr:`block_s`); ``resolution`` the step
    of each sensor.
    """

    detector: Detector
    tails: Mapping[str, tuple[float, float]]
    resolution: tuple[float, ...]
    hours: float = 0.0
    blocks: int = 0

    def __post_init__(self) -> None:
        known = {part for parts in METHODS.values() for part in parts} - {"freeze"}
        if not set(self.tails) <= known:
            raise InputError(f"detectors: tails of {sorted(self.tails)}, known are {sorted(known)}")

    @property
    def block_s(self) -> float:
        """Length of a block [s]."""
        return block_seconds(self.detector.dt, self.detector.time_unit)

    @property
    def settling(self) -> int:
        """Samples at the beginning of a loop that do not count."""
        return round(SETTLING_S * self.detector.time_unit / self.detector.dt)

    def threshold(self, part: str, rate: float) -> float:
        """Level that a part passes at that rate [1/h] on nominal data; 1 for the freeze test, a share already."""
        if part == "freeze":
            return 1.0
        location, scale = self.tails[part]
        return max(location - scale * math.log(rate * self.block_s / 3600.0), 1e-12)

    def detector_at(self, rate: float) -> Detector:
        """The detector with thresholds for that rate [1/h] in all, half of it for each alarm."""
        force, power = (self.threshold(part, 0.5 * rate) for part in ("forces", "power"))
        return replace(
            self.detector, force_threshold=force, energy_threshold=power, false_alarms_per_hour=rate,
            method=f"Gumbel tail of maxima in blocks of {self.block_s:g} s",
        )  # fmt: skip

    def levels(self, trace: Trace) -> dict[str, Array]:
        """Level ``(n,)`` of each part along a loop; zero where it says nothing, and while the estimator settles."""
        n_q, window = len(self.resolution), WINDOW_S * self.detector.time_unit / self.detector.dt
        forces, power = detector_levels(self.detector, trace.numbers)
        travel = np.abs(trace.numbers[:, 3 + n_q : 3 + 2 * n_q]) / (FROZEN_STEPS * np.array(self.resolution))
        squares = (trace.innovation**2).sum(axis=1)
        found = {
            "forces": forces,
            "power": power,
            "freeze": travel.max(axis=1),
            "level": trace.level_w,
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
        parts, on = METHODS[method], np.zeros(len(trace.level_w), dtype=bool)
        for part, share in parts.items():
            if part == "forces":
                on |= self._detected(trace.numbers, 2 * share * rate)
            elif part == "freeze":
                on |= levels[part] > 1.0
            elif part != "power":
                on |= with_hysteresis(levels[part], self.threshold(part, share * rate))
        on[: self.settling] = False
        return on

    def _detected(self, numbers: Array, rate: float) -> NDArray[np.bool_]:
        detector = self.detector_at(rate)
        state, found = detector.initial(), []
        for row in numbers.tolist():
            state, _, alarm = detector.update(state, row)
            found.append(alarm)
        return np.array(found, dtype=bool)


def learn_detectors(
    traces: Sequence[Trace],
    dt: float,
    resolution: Sequence[float],
    *,
    rate: float = 1.0,
    rest_speed: ArrayLike = REST_SPEED,
    time_unit: float = 1.0,
    data_hash: str = "",
) -> Detectors:
    """All methods from nominal loops, for wanted rates of false alarms down to ``rate``.

    Thresholds are Gumbel tails of block maxima, as :func:`~hybrid_mpc.monitor.calibrate.calibrate` makes them. The
    loops are known to be nominal, so a block that stands out is no reason to refuse them.
    """
    skipped, block_s = round(SETTLING_S * time_unit / dt), block_seconds(dt, time_unit)
    runs = [trace.numbers[skipped:] for trace in traces]
    share = min(s for parts in METHODS.values() for s in parts.values() if s)
    needed = max(MIN_BLOCKS, math.ceil(3600.0 / (share * rate * block_s * MAX_EXTRAPOLATION)))
    size = round(block_s / dt)
    blocks = sum(len(run) // size for run in runs)
    if blocks < needed:
        raise InputError(
            f"learning: {blocks * block_s / 60:.1f} min of nominal loops in whole blocks of {block_s:g} s; a rate "
            f"of {rate:g}/h, of which a part gets {share:g}, needs {needed * block_s / 60:.1f} min"
        )
    detector = learn_detector(
        runs, dt, len(resolution), drift=DRIFT, false_alarms_per_hour=rate, rest_speed=rest_speed,
        data_hash=data_hash, trusted=True, time_unit=time_unit,
    )  # fmt: skip
    hours = sum(len(run) for run in runs) * dt / 3600.0
    detectors = Detectors(detector, {}, tuple(resolution), hours, blocks)
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
