"""Alarm thresholds from nominal data: block maxima with a Gumbel tail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.lengths import BLOCK_S
from hybrid_mpc.rules import Line

Array = NDArray[np.float64]
MIN_BLOCKS = 30
"""Blocks that the two parameters of a tail need."""
MAX_EXTRAPOLATION = 20.0
"""Longest mean time between false alarms, in multiples of the nominal data's length."""


@dataclass(frozen=True)
class Calibration:
    """Thresholds of the alarm and what they come from.

    Args:
        threshold_w: Level [W] above which the alarm starts; None where none was found: then no level alarms.
        release_w: Level [W] below which it ends; at most ``threshold_w``; None with it.
        false_alarms_per_hour: Wanted rate on nominal data [1/h].
        n_samples: Finite levels used.
        hours: Their duration [h].
        method: How the threshold was found, or why not.
        data_hash: Hash of the nominal data.
        residual_threshold: Residual level [unit of force] above which the alarm starts too. Default: never.
        residual_release: Residual level [unit of force] below which that ends.
        detector: Detector of scaled residuals, learned from nominal data. Default: none.
        rest_speed: Speeds ``(n_q,)`` [unit of v] below which friction may stick, or one for all, for every monitor of
            this model. Default: None, no recording gave them.

    Raises:
        InputError: If ``0 < release_w <= threshold_w`` does not hold, or not so for the residual.

    Example:
        >>> c = Calibration(0.2, 0.1, 1.0, 1000, 0.1, "by hand")
        >>> from hybrid_mpc.records import plain, record
        >>> record(Calibration, plain(c), "model.json") == c
        True
    """

    threshold_w: float | None
    release_w: float | None
    false_alarms_per_hour: float
    n_samples: int
    hours: float
    method: Line
    data_hash: Line = ""
    residual_threshold: float | None = None
    residual_release: float | None = None
    detector: Detector | None = None
    rest_speed: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.rest_speed is not None:
            rest = tuple(np.ravel(self.rest_speed).astype(float).tolist())
            object.__setattr__(self, "rest_speed", rest)
            if not min(rest, default=0.0) > 0:
                raise InputError(f"calibration: rest speeds must be positive, got {rest}")
        if not _ordered(self.residual_release, self.residual_threshold):
            raise InputError(
                "calibration: need 0 < residual_release <= residual_threshold, or neither; got "
                f"{self.residual_release} and {self.residual_threshold}"
            )
        if not _ordered(self.release_w, self.threshold_w):
            raise InputError(
                "calibration: need 0 < release_w <= threshold_w [W], or neither; "
                f"got {self.release_w} and {self.threshold_w}"
            )

    @classmethod
    def without(cls, reason: str, rest_speed: Sequence[float] | None = None) -> Calibration:
        """A calibration without thresholds; ``reason`` says why. The rest speeds may still be known."""
        rest = None if rest_speed is None else tuple(rest_speed)
        return cls(None, None, 0.0, 0, 0.0, reason, rest_speed=rest)


def calibrate(
    levels: Sequence[Array],
    dt: float,
    *,
    false_alarms_per_hour: float = 1.0,
    data_hash: str = "",
    block_s: float = BLOCK_S,
    rest_speed: ArrayLike | None = None,
) -> Calibration:
    """Threshold that nominal levels, ``(n,)`` [W] of each run, pass upwards at the wanted rate; NaN are left out.

    The largest level in a block follows a Gumbel distribution with location and scale from its first two L-moments. The
    threshold ``location - scale * log(rate * block)`` is passed at the wanted rate. The alarm is released at half of
    it, but not below the nominal 95 % quantile (or it would hang), nor above the threshold. A block of ``block_s``
    seconds must be much longer than levels are correlated (:func:`~hybrid_mpc.monitor.lengths.block_seconds`).

    Raises:
        InputError: If ``dt``, the block or the rate is not positive, more alarms are wanted than one in two blocks,
            there is too little data (30 blocks, and one twentieth of the mean time between alarms), or it is zero.

    Source: Coles (2001), An Introduction to Statistical Modeling of Extreme Values, ch. 3;
    Hosking (1990) for the L-moments.
    """
    if not dt > 0 or not false_alarms_per_hour > 0 or not block_s > 0:
        raise InputError(
            f"calibration: dt, rate and block must be positive, got {dt} s, {false_alarms_per_hour}/h, {block_s} s"
        )
    rate = false_alarms_per_hour * block_s / 3600.0
    if rate > 0.5:
        raise InputError(
            f"calibration: {false_alarms_per_hour}/h is too many; ask for at most {1800 / block_s:g}/h"
        )
    maxima, finite = block_maxima(levels, max(round(block_s / dt), 1))
    needed = max(MIN_BLOCKS, int(np.ceil(1.0 / (rate * MAX_EXTRAPOLATION))))
    if maxima.size < needed:
        raise InputError(
            f"calibration: {maxima.size * block_s / 60:.1f} min of nominal data "
            f"in whole blocks of {block_s:g} s; "
            f"{false_alarms_per_hour:.3g} false alarms an hour need {needed * block_s / 60:.1f} min. "
            "Record more, or ask for a higher rate."
        )
    location, scale = gumbel(maxima)
    threshold = location - scale * float(np.log(rate))
    if not threshold > 0:
        raise InputError(
            "calibration: the nominal levels are zero throughout, so nothing tells how large an ordinary one is; "
            "record the machine in motion"
        )
    release = min(max(0.5 * threshold, float(np.quantile(finite, 0.95))), threshold)
    hours = finite.size * dt / 3600.0
    method = f"Gumbel tail of maxima in blocks of {block_s:g} s (L-moments), {maxima.size} blocks"
    return Calibration(
        threshold, release, false_alarms_per_hour, finite.size, hours, method, data_hash,
        rest_speed=None if rest_speed is None else tuple(np.ravel(rest_speed).tolist()),
    )  # fmt: skip


def with_residual(power: Calibration, residual: Calibration) -> Calibration:
    """One calibration of both alarms; either may raise a false one, so their wanted rates add up."""
    return replace(
        power,
        false_alarms_per_hour=power.false_alarms_per_hour + residual.false_alarms_per_hour,
        residual_threshold=residual.threshold_w,
        residual_release=residual.release_w,
    )


def count_alarms(alarm: Array | NDArray[np.bool_], dt: float) -> tuple[int, float]:
    """Number of alarms (rising edges; one that is on at the start counts) and their rate [1/h].

    Example:
        >>> count_alarms(np.array([False, True, True, False]), 900.0)
        (1, 1.0)
    """
    n = len(alarm_intervals(alarm, dt))
    hours = len(alarm) * dt / 3600.0
    return n, n / hours if hours > 0 else 0.0


def alarm_intervals(alarm: Array | NDArray[np.bool_], dt: float) -> list[tuple[float, float]]:
    """Intervals ``(first, last)`` [s] in which the alarm is on; sample k lies at ``k dt``."""
    return [(float(a * dt), float(b * dt)) for a, b in zip(*stretches(alarm), strict=True)]


def stretches(on: ArrayLike) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """First and last samples of the stretches in which ``on`` ``(n,)`` is true."""
    edges = np.diff(np.concatenate([[0], np.asarray(on, dtype=bool), [0]]).astype(int))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1


def _ordered(release: float | None, threshold: float | None) -> bool:
    """Whether both are None, or ``0 < release <= threshold``."""
    if release is None or threshold is None:
        return release is threshold
    return 0 < release <= threshold


def block_maxima(levels: Sequence[Array], size: int) -> tuple[Array, Array]:
    """Largest finite level of each whole block of ``size`` samples, and all finite levels."""
    maxima, finite = [np.zeros(0)], [np.zeros(0)]
    for level in levels:
        values = np.asarray(level, dtype=np.float64).reshape(-1)
        values = values[np.isfinite(values)]
        finite.append(values)
        n = values.size // size
        maxima.append(values[: n * size].reshape(n, size).max(axis=1) if n else np.zeros(0))
    return np.concatenate(maxima), np.concatenate(finite)


def gumbel(maxima: Array) -> tuple[float, float]:
    """Location and scale from the first two L-moments."""
    ordered = np.sort(maxima)
    n = ordered.size
    l1 = float(ordered.mean())
    l2 = 2.0 * float(np.mean(np.arange(n) / (n - 1) * ordered)) - l1
    scale = max(l2, 0.0) / float(np.log(2.0))
    return l1 - float(np.euler_gamma) * scale, scale
