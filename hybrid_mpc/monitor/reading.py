"""What the energy monitor remembers and what it says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
QUIET = (False, False)


class Verdict(IntEnum):
    """Whether a sample was judged, and if not, why."""

    JUDGED = 0
    """It was: violation and residual force are numbers."""
    WARM_UP = 1
    """The window was not full yet."""
    MISSING = 2
    """A measurement or input in the window was missing."""
    NOT_FINITE = 3
    """All was there, and still a reading is no number: the model or the estimator is at fault."""


SECONDS: Mapping[Verdict, str] = MappingProxyType(
    {
        Verdict.JUDGED: "judged_s",
        Verdict.WARM_UP: "warm_up_s",
        Verdict.MISSING: "missing_s",
        Verdict.NOT_FINITE: "not_finite_s",
    }
)
"""Names under which results count the seconds of each."""


class EstimateLike(Protocol):
    """What the monitor reads of an estimate: ``x`` (n_x,) and ``h`` (n_h,). It ignores ``d``."""

    @property
    def x(self) -> Any:
        """Estimated state ``(n_x,)``."""

    @property
    def h(self) -> Any:
        """Hidden state ``(n_h,)`` before this sample's input."""


@dataclass(frozen=True)
class MonitorState:
    """All that the monitor remembers. Never changed in place.

    Args:
        memory: Past measurements, model increments and inputs of the window, the averaged readings, the model's free
            runs and the rows for :func:`~hybrid_mpc.monitor.diagnosis.diagnose`, in one vector; NaN until filled.
        x: Estimated state ``(n_x,)`` at the latest sample.
        h: Hidden state ``(n_h,)`` at the latest sample.
        alarms: True while the alarm on the violation, and the one on the residual force, is on.
        left: Periods left of each free run. Default: there are none.
        detector: What the detector of scaled residuals remembers. Default: nothing.
        frozen: True while the sensor is held for frozen.
        seen: Samples taken, up to the window's.
        whole: Samples since something was missing, up to the window's.
        dark: Samples in a row that were not judged.
    """

    memory: Array
    x: Array
    h: Array
    alarms: tuple[bool, bool]
    left: tuple[int, ...] = ()
    detector: Any = None
    frozen: bool = False
    seen: int = 0
    whole: int = 0
    dark: int = 0


@dataclass(frozen=True)
class MonitorReading:
    """One reading. It speaks of the window's centre, ``EnergyMonitor.delay`` before this sample.

    Args:
        dE_model_w: Energy balance [W] with the model's acceleration.
        dE_measured_w: Energy balance [W] with the measured acceleration, at the same state.
        violation_w: ``|dE_model_w - dE_measured_w|`` [W].
        level_w: Mean violation [W] over the last ``average`` samples.
        residual: Force that the model does not explain ``(n_q,)`` [N m for an angle, N for a length]; what
            sticking friction may hold is taken off near rest.
        residual_level: Length of the mean residual over the last ``average`` samples.
        alarm: True while any alarm is on, or the monitor is blind; without calibration, detector and freeze test
            there is no other.
        energy_j: Energy [J] by which the model's own free run departs from the measurement, accumulated over
            ``energy_s``; NaN without free runs, and after a missing measurement until the next run.
        energy_s: Time [s] over which it was accumulated.
        frozen: True while the sensor repeats itself although the estimator predicts motion or the input asks for it.
        scores: What the detector compares with its thresholds, each as a share of its threshold: the sum of residual
            forces, the power of the free runs. Default: none.
        numbers: What a detector is learned from: both balances, violation, residual, travel, speed and input at the
            centre; with free runs energy, squared speed and squared input times time, and the time. Default: none.
        verdict: Whether this sample was judged, and if not, why.
        blind: True while the monitor has judged nothing for longer than its windows, that of the derivative and that of
            the averages together: it cannot vouch for the model.
    """

    dE_model_w: float
    dE_measured_w: float
    violation_w: float
    level_w: float
    residual: Array
    residual_level: float
    alarm: bool
    energy_j: float = float("nan")
    energy_s: float = 0.0
    frozen: bool = False
    scores: tuple[float, ...] = ()
    numbers: tuple[float, ...] = ()
    verdict: Verdict = Verdict.JUDGED
    blind: bool = False
