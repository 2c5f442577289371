"""The detector of small, lasting departures: residuals in units of their own scatter, summed up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.monitor.lengths import NOTHING_STICKS, SHORTEST_S, checked_rest
from hybrid_mpc.rules import Line

Array = NDArray[np.float64]
CAP = 1.5
"""Sums saturate at this multiple of the threshold, so that an alarm ends soon after its cause."""
TERMS = 4
"""Terms of a scale: constant, squared speed, squared input, and rest (force) or one over the time (energy)."""


@dataclass(frozen=True)
class DetectorState:
    """Sums of each force upwards, then downwards; whether the alarm on a force, and that on the energy, is on."""

    sums: tuple[float, ...]
    on: tuple[bool, bool]


@dataclass(frozen=True)
class Detector:
    """Cumulative sums of scaled residual forces, and a threshold on the scaled power of the free runs.

    A nominal residual grows with speed, with input and near rest: its variance is
    ``a_0 + a_1 |v|^2 + a_2 |u|^2 + a_3 / (1 + |v / rest_speed|^2)`` with coefficients that are not negative, and ``z``
    is the residual over its deviation. ``g = max(0, g + z - drift)``, and the same for ``-z``, rises under a lasting
    departure above ``drift`` and falls otherwise: the larger the departure, the sooner it passes its threshold. The
    power of a free run has ``a_3 / time`` as last term; it is an average already and is compared as it is.

    Args:
        dt: Period [s] it was learned at.
        force: Coefficients of each force's variance ``(n_q, 4)`` [N^2 m^2 or N^2, ...].
        energy: Coefficients of the power's variance ``(4,)`` [W^2, ...]; empty without free runs.
        drift: Departure [deviations] that counts as nothing.
        force_threshold: Sum [deviations] above which the force's alarm starts.
        energy_threshold: Scaled power above which the energy's alarm starts; infinite without free runs.
        release: Share of the threshold at which an alarm ends.
        rest_speed: Speeds ``(n_q,)`` [unit of v] below which friction may stick, or one for all. Default: nothing
            sticks.
        false_alarms_per_hour: Wanted rate on nominal data [1/h].
        hours: Duration of the nominal data [h].
        interval: 5 % and 95 % of a block bootstrap of the thresholds: ``(force low, high, energy low, high)``.
        method: How the thresholds were found.
        data_hash: Hash of the nominal data.
        time_unit: The machine's second [s] that the monitor's lengths were counted in. Default 1.

    Raises:
        InputError: If a number is not as said.

    Source: Page, *Continuous inspection schemes*, Biometrika 41 (1954).

    Example:
        >>> detector = Detector(0.02, ((0.01, 0.0, 0.0, 0.0),), (), 0.5, 4.0)
        >>> state, alarms = detector.initial(), []
        >>> for force in (0.0, 0.3, 0.3, 0.3):  # three deviations
        ...     numbers = [0.0, 0.0, 0.0, force, 0.0, 1.0, 0.0]
        ...     state, scores, alarm = detector.update(state, numbers)
        ...     alarms.append(alarm)
        >>> alarms
        [False, False, True, True]
    """

    dt: float
    force: tuple[tuple[float, ...], ...]
    energy: tuple[float, ...]
    drift: float
    force_threshold: float
    energy_threshold: float = math.inf
    release: float = 0.5
    rest_speed: tuple[float, ...] = (NOTHING_STICKS,)
    false_alarms_per_hour: float = math.nan
    hours: float = 0.0
    interval: tuple[float, ...] = ()
    method: Line = ""
    data_hash: Line = ""
    time_unit: float = 1.0

    def __post_init__(self) -> None:
        wrong = [row for row in (*self.force, self.energy or (1.0,) * TERMS) if not _fit(row)]
        if wrong or not self.force:
            raise InputError(
                f"detector: scales need {TERMS} numbers each, not negative, not all 0; got {wrong}"
            )
        rest = checked_rest(self.rest_speed, len(self.force), "detector")
        object.__setattr__(self, "rest_speed", rest)
        if not (self.dt > 0 and self.time_unit > 0 and 0 <= self.drift < math.inf and 0 < self.release <= 1):
            raise InputError(
                f"detector: dt {self.dt} and time_unit {self.time_unit} must be positive, drift {self.drift} not "
                f"negative, release {self.release} within 0 to 1"
            )
        if not (0 < self.force_threshold < math.inf and self.energy_threshold > 0):
            given = self.force_threshold, self.energy_threshold
            raise InputError(f"detector: thresholds must be positive, that of forces finite, got {given}")
        if bool(self.energy) != (self.energy_threshold < math.inf):
            raise InputError(
                f"detector: energy {self.energy} and energy_threshold {self.energy_threshold} do not fit: with "
                "coefficients of the energy a finite threshold is needed, without them there is none; learn it anew"
            )

    def initial(self) -> DetectorState:
        """State before the first sample."""
        return DetectorState((0.0,) * (2 * len(self.force)), (False, False))

    @property
    def shortest(self) -> float:
        """Accumulated time [s] of a free run from which on it counts."""
        return SHORTEST_S * self.time_unit

    def check(self, n_q: int, free_runs: bool, dt: float, time_unit: float) -> None:
        """Refuse a monitor of other forces, with free runs where none were learned or without, of another period."""
        if len(self.force) != n_q:
            raise InputError(f"detector: learned for {len(self.force)} forces, the model has {n_q}")
        if self.energy and not free_runs:
            raise InputError("detector: it reads free runs, the monitor has none; give free_run=0.8 [s], say")
        if free_runs and not self.energy:
            raise InputError(
                "detector: it was learned without free runs, the monitor has some; leave free_run out"
            )
        if abs(dt - self.dt) > 1e-9 * self.dt:
            raise InputError(
                f"detector: learned at a period of {self.dt} s, the model's is {dt} s; learn it anew"
            )
        if abs(time_unit - self.time_unit) > 1e-9 * self.time_unit:
            raise InputError(
                f"detector: its lengths count in a machine's second of {self.time_unit:g} s, the model's in "
                f"{time_unit:g} s; learn it anew"
            )

    def deviations(self, v2: Array, u2: Array) -> Array:
        """Standard deviations ``(n, n_q)`` of nominal residual forces; arguments as :func:`force_terms` has them."""
        squares = np.asarray(v2, dtype=np.float64).reshape(len(u2), len(self.force))
        return np.asarray(np.sqrt(force_terms(squares, u2, self.rest_speed) @ np.array(self.force).T))

    def update(
        self, state: DetectorState, numbers: Sequence[float]
    ) -> tuple[DetectorState, tuple[float, float], bool]:
        """One sample of :attr:`MonitorReading.numbers`; a departure that is not finite changes nothing.

        Returns:
            The next state; the largest sum and the scaled power as shares of their thresholds; whether an alarm is on.
        """
        n = len(self.force)
        end = 3 + 3 * n
        stop = len(numbers) - 4 if self.energy else len(numbers)
        v2 = u2 = slow = 0.0
        for v, rest in zip(numbers[3 + 2 * n : end], self.rest_speed, strict=True):
            v2 += v * v
            slow += v * v / (rest * rest)
        for u in numbers[end:stop]:
            u2 += u * u
        near = 1.0 / (1.0 + slow)
        most, drift, sums, largest = CAP * self.force_threshold, self.drift, list(state.sums), 0.0
        for i, (a0, a1, a2, a3) in enumerate(self.force):
            z = numbers[3 + i] / math.sqrt(a0 + a1 * v2 + a2 * u2 + a3 * near)
            if z == z:  # not NaN
                up, down = sums[i] + z - drift, sums[n + i] - z - drift
                sums[i] = 0.0 if up < 0.0 else min(up, most)
                sums[n + i] = 0.0 if down < 0.0 else min(down, most)
            largest = max(largest, sums[i], sums[n + i])
        force = largest / self.force_threshold
        power = self._power(numbers[-4:]) / self.energy_threshold if self.energy else 0.0
        was = state.on
        on = force > (self.release if was[0] else 1.0), power > (self.release if was[1] else 1.0)
        return DetectorState(tuple(sums), on), (force, power), on[0] or on[1]

    def _power(self, numbers: Sequence[float]) -> float:
        """Mean power of the older free run over its deviation, from energy, squared speed and input, and time."""
        energy, v2, u2, seconds = numbers
        if not (seconds >= self.shortest and energy == energy):
            return 0.0
        a0, a1, a2, a3 = self.energy
        v2, u2 = v2 / seconds, u2 / seconds
        return abs(energy) / seconds / math.sqrt(a0 + a1 * v2 + a2 * u2 + a3 / seconds)


def force_terms(v2: Array, u2: Array, rest_speed: Sequence[float]) -> Array:
    """What the variance of a nominal residual force is linear in, ``(n, 4)``.

    ``v2`` ``(n, n_q)`` are squared speeds, ``u2`` ``(n,)`` squared lengths of the inputs.
    """
    slow = (v2 / np.array(rest_speed) ** 2).sum(axis=1)
    return np.column_stack([np.ones(len(v2)), v2.sum(axis=1), u2, 1.0 / (1.0 + slow)])


def _fit(row: Sequence[float]) -> bool:
    return len(row) == TERMS and all(math.isfinite(a) and a >= 0 for a in row) and any(row)
