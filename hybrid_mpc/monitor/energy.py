"""The energy monitor: how far the model's power balance lies from the measured one, online."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.calibrate import Calibration
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.energy_readings import Layout, check_model, reading_function
from hybrid_mpc.monitor.lengths import NOTHING_STICKS, checked_rest

Array = NDArray[np.float64]
QUIET = (False, False)
FROZEN_STEPS = 3.0
"""Steps of the sensor that the estimator must have predicted while the sensor repeated itself."""


class Validity(IntEnum):
    """Whether a reading is valid, and if not, why."""

    VALID = 0
    """It was: violation and residual force are numbers."""
    WARM_UP = 1
    """The window was not full yet."""
    MISSING = 2
    """A measurement or input in the window was missing."""
    NOT_FINITE = 3
    """All was there, and still a reading is no number: the model or the estimator is at fault."""


SECONDS: Mapping[Validity, str] = MappingProxyType(
    {
        Validity.VALID: "valid_s",
        Validity.WARM_UP: "warm_up_s",
        Validity.MISSING: "missing_s",
        Validity.NOT_FINITE: "not_finite_s",
    }
)
"""Names under which results count the seconds of each."""


@dataclass(frozen=True)
class MonitorState:
    """All that the monitor remembers, never changed in place; ``x`` and ``h`` are the latest estimate's.

    Args:
        memory: One vector, laid out as :class:`~hybrid_mpc.monitor.energy_readings.Layout` says; NaN until filled.
        alarms: True while the alarm on the violation, and the one on the residual force, is on.
        left: Periods left of each free run.
        frozen: True while the sensor is held for frozen.
        seen: Samples taken; ``whole``: since something was missing; both up to the window's.
        invalid: Samples in a row without a reading.
        w: Measured disturbances ``(n_w,)`` from that sample on.
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
    invalid: int = 0
    w: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class MonitorReading:
    """One reading, of the window's centre: ``EnergyMonitor.delay`` before this sample.

    Args:
        dE_model_w: Energy balance [W] with the model's acceleration.
        dE_measured_w: Energy balance [W] with the measured acceleration, at the same state.
        violation_w: ``|dE_model_w - dE_measured_w|`` [W].
        level_w: Mean violation [W] over the last ``average`` samples.
        residual: Force that the model does not explain ``(n_q,)`` [unit of force]; what sticking friction may hold is
            taken off near rest.
        residual_level: Length of the mean residual over the last ``average`` samples.
        alarm: True while any alarm is on, or the monitor is blind.
        energy_j: Energy [J] by which the model's own free run departs from the measurement, accumulated over
            ``energy_s``; NaN without free runs, and after a missing measurement until the next run.
        energy_s: Time [s] over which it was accumulated.
        frozen: True while the sensor repeats itself although the estimator predicts motion or the input asks for it.
        scores: What the detector compares with its thresholds, each as a share of its threshold: the sum of residual
            forces, the power of the free runs. Default: none.
        numbers: What a detector is learned from: both balances, violation, residual, travel, speed and input at the
            centre; with free runs energy, squared speed and squared input times time, and the time. Default: none.
        validity: Whether this reading is valid, and if not, why.
        blind: True while no reading has been valid for longer than its two windows together.
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
    validity: Validity = Validity.VALID
    blind: bool = False


class EnergyMonitor:
    """Compares the model's power balance with the measured one, causally.

    **Violation** [W]: a least-squares cubic through the last ``window`` samples of ``y`` gives position, velocity and
    acceleration at the window's centre. This acceleration is a weighted mean of the true one,
    ``sum_i w_i y_i = int K(s) a(s) ds`` with the Peano kernel ``K(s) = sum_{t_i > s} w_i (t_i - s)``. The model's
    acceleration is averaged with the same ``K``: one step from every estimate ``(x_hat_i, h_i)`` gives
    ``dv = int a ds`` and ``dp = int (t_{i+1} - s) a ds``, hence exactly ``int K a ds = K_{i+1} dv - K' dp`` in every
    period. So steps of the input raise no violation. The estimated disturbance ``d`` is left out, since it would hide
    the fault. Both balances take the state ``[q, v]`` of the cubic and the input averaged with ``K``; with one degree
    of freedom their difference is ``J |v| |a_model - a_measured|``.

    **Residual force**: at rest the violation is zero, whatever the forces do; ``M (a_measured - a_model)`` with the
    inertia ``M`` of the energy balance is not. Near rest dry friction may be anything up to half the jump of the
    model's force at zero speed. Only what exceeds this dead band counts there; it closes linearly up to twice
    ``rest_speed``. So a hand that holds the machine still shows, and sticking friction does not.

    **Energy of the free run** [J]: the one step starts from an estimate that has followed the measurements, and so has
    half forgotten what went wrong. With ``free_run`` the model also runs on its own under the applied inputs, and what
    its balance departs from the measured one adds up: noise averages out in it, a steady loss does not. Two runs, begun
    half a length apart, take turns; the reading is of the older one.

    **Frozen sensor**, with ``resolution``: the sensor repeats itself while the one-step predictions add up to more than
    three of its steps, those slower than ``rest_speed`` left out. Near rest the estimator takes a frozen sensor for a
    standing machine and the controller pulls harder: so what the input's change since the sensor's last step would have
    moved counts as well, once it is more than a quarter of the input's range. A blocked machine looks the same.

    A missing (NaN) measurement gives NaN readings until it has left the window. A level is the mean of the finite ones
    of the last ``average`` values, NaN (and no alarm) while fewer than half are finite. A monitor without a
    valid reading for longer than ``window`` and ``average`` together is ``blind``, and that is an alarm. Positions must
    count on through full turns. Not for several threads at once (it reuses its buffers).

    Args:
        model: Model whose outputs are its positions ``q`` (state ``[q, v]``).
        window: Samples in the local polynomial, odd, at least 5.
        average: Samples in the moving average of the level.
        calibration: Thresholds of the alarm. Default: none, then there is no alarm from the levels.
        rest_speed: Speeds ``(n_q,)`` [unit of v] below which friction may stick, or one for all; see
            :func:`~hybrid_mpc.monitor.lengths.rest_speeds`. Default: the detector's, else the calibration's, else
            nothing is known to stick.
        free_run: Length [s] of the model's free runs. Default 0: none.
        resolution: Step of each sensor ``(n_y,)``. Default: unknown, then there is no test for freezing.
        detector: Detector of scaled residuals. Default: none.
        input_range: Range ``(n_u,)`` of each input, largest less smallest, for the test for freezing near rest.
            Default: that of the model's signals; without bounds there is no such test.
        history: Time [s] over which a :class:`~hybrid_mpc.monitor.diagnose.Diagnoser` looks back. Default 0.

    Raises:
        InputError: If the window, the average or a rest speed is unfit, a free run is no longer than two windows, the
            outputs are not the positions, or the energy balance says nothing.

    Source: energy balance and violation of the paper (energy objective, powers in W); Savitzky and Golay
    (1964) for the polynomial; Peano kernel theorem for the weighting.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, rate = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("rate", 2)
        >>> model = HybridModel.of(
        ...     "cart", 0.1, (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
        ...     x=x, u=u, x_next=x + 0.1 * ca.vertcat(x[1] + 0.05 * u, u), xdot=ca.vertcat(x[1], u), y=x[0],
        ...     rate=rate, energy=(rate[1] - u) * x[1])
        >>> monitor = EnergyMonitor(model, window=5, average=2)
        >>> round(monitor.delay, 6)
        0.2
    """

    def __init__(
        self,
        model: HybridModel,
        *,
        window: int,
        average: int,
        calibration: Calibration | None = None,
        rest_speed: ArrayLike | None = None,
        free_run: float = 0.0,
        resolution: ArrayLike | None = None,
        detector: Detector | None = None,
        history: float = 0.0,
        input_range: ArrayLike | None = None,
    ) -> None:
        if window < 5 or window % 2 == 0:
            raise InputError(
                f"energy monitor: window must be an odd number of at least 5 samples, got {window}"
            )
        if average < 1:
            raise InputError(f"energy monitor: average must be at least 1 sample, got {average}")
        check_model(model)
        self.layout = Layout(model, window, average, round(free_run / model.dt), round(history / model.dt))
        if free_run and self.layout.length < 2 * window:
            raise InputError(
                f"energy monitor: a free run of {free_run} s given; two windows, {2 * window * model.dt:g} s, needed"
            )
        self.model, self.window, self.average = model, window, average
        self.calibration, self.detector = calibration, detector
        if rest_speed is None:
            stored = (part.rest_speed for part in (detector, calibration) if part is not None)
            rest_speed = next((rest for rest in stored if rest is not None), NOTHING_STICKS)
        self.rest_speed = checked_rest(rest_speed, model.n_x // 2, "energy monitor")
        self.resolution = _positive(resolution, model.n_y)
        """Step of each sensor ``(n_y,)``; empty: unknown."""
        if detector is not None:
            detector.check(model.n_y, bool(self.layout.length), model.dt, model.time_unit)
        self.input_range = _spans(model, input_range)
        """Range ``(n_u,)`` of each input, for the test for freezing near rest."""
        self._function = BufferedFunction(reading_function(self.layout, self.rest_speed, self.input_range))
        self._sizes = tuple(values.size for values in self._function.inputs[1:5])

    @property
    def delay(self) -> float:
        """Time [s] from the moment a violation speaks of to the sample at which it is read."""
        return 0.5 * (self.window - 1) * self.model.dt

    @property
    def cannot_alarm(self) -> str:
        """Why no reading could raise an alarm, and what would give it limits; empty if one could."""
        c = self.calibration
        if self.detector is not None or self.resolution or (c is not None and c.threshold_w is not None):
            return ""
        return (
            "it has no limits, so nothing alarms but missing readings; the run's stage monitor learns thresholds of "
            "the energy, its stage guard a detector, and kit.monitor() has them"
        )

    def initial(self) -> MonitorState:
        """State before the first sample."""
        empty = np.full(self.model.n_x, np.nan), np.full(self.model.n_h, np.nan)
        first = None if self.detector is None else self.detector.initial()
        memory, left = self.layout.initial()
        return MonitorState(memory, *empty, QUIET, left, first, w=self.model.w)

    def update(
        self, state: MonitorState, y: Array, u_prev: Array, estimate: Any
    ) -> tuple[MonitorState, MonitorReading]:
        """Take one sample; pure: the same arguments give the same result.

        Args:
            state: State after the previous sample, or :meth:`initial`.
            y: Measurement ``(n_y,)`` now; NaN where missing.
            u_prev: Input ``(n_u,)`` applied over the period that just ended.
            estimate: Estimate at this sample, of which ``x`` ``(n_x,)`` and ``h`` ``(n_h,)`` are read, and of a model
                with measured disturbances ``w`` ``(n_w,)``; where it has none they are the operating point's.

        Returns:
            The next state and the reading.
        """
        x, h = (np.array(values, dtype=np.float64).ravel() for values in (estimate.x, estimate.h))
        y, u_prev = (np.asarray(values, dtype=np.float64).ravel() for values in (y, u_prev))
        if (x.size, h.size, u_prev.size, y.size) != self._sizes:
            raise InputError(
                f"monitor of model {self.model.name}: x, h, u_prev, y have {(x.size, h.size, u_prev.size, y.size)} "
                f"entries, the model needs {self._sizes}"
            )
        ins, outs = self._function.inputs, self._function.outputs
        ins[0][:], ins[1][:], ins[2][:], ins[3][:], ins[4][:] = state.memory, state.x, state.h, u_prev, y
        ins[6][:] = state.w
        w = getattr(estimate, "w", self.model.w)
        w = np.array(w, dtype=np.float64) if np.size(w) == self.model.n_w else self.model.w
        left = state.left and self._free_runs(state)
        self._function()
        memory, numbers, n_q = outs[0].copy(), outs[1].tolist(), self.model.n_y
        level, residual_level = self._levels(memory)
        alarms = self.alarms(level, residual_level, state.alarms)
        travels = zip(numbers[3 + n_q : 3 + 2 * n_q], self.resolution, strict=False)
        frozen = any(abs(travel) > FROZEN_STEPS * step for travel, step in travels)
        energy, seconds = self._older(numbers, left) if left else (math.nan, 0.0)
        detector, detected = state.detector, False
        scores: tuple[float, ...] = ()
        if self.detector is not None:
            detector, scores, detected = self.detector.update(detector, numbers)
        seen = min(state.seen + 1, self.window)
        missing = not math.isfinite(sum(y.tolist()) + (sum(u_prev.tolist()) if state.seen else 0.0))
        whole = 0 if missing else min(state.whole + 1, self.window)
        validity = self._validity(numbers[2 : 3 + n_q], seen, whole)
        invalid = state.invalid + 1 if validity else 0
        blind = invalid > self.window + self.average
        following = MonitorState(memory, x, h, alarms, left, detector, frozen, seen, whole, invalid, w)
        reading = MonitorReading(
            dE_model_w=numbers[0],
            dE_measured_w=numbers[1],
            violation_w=numbers[2],
            level_w=level,
            residual=outs[1][3 : 3 + n_q].copy(),
            residual_level=residual_level,
            alarm=alarms[0] or alarms[1] or frozen or detected or blind,
            energy_j=energy,
            energy_s=seconds,
            frozen=frozen,
            scores=scores,
            numbers=tuple(numbers),
            validity=validity,
            blind=blind,
        )
        return following, reading

    def _levels(self, memory: Array) -> tuple[float, float]:
        """Means of the latest violations and residual forces."""
        first, n_q = self.layout.averaged, self.model.n_y
        middle, end = first + self.average, self.layout.runs
        level = _mean_of_finite(memory[first:middle])
        if n_q == 1:
            return level, abs(_mean_of_finite(memory[middle:end]))
        return level, _length_of_mean(memory[middle:end].reshape(self.average, n_q))

    def _validity(self, readings: Sequence[float], seen: int, whole: int) -> Validity:
        """Whether violation and residual force are numbers, and if not, why."""
        if math.isfinite(sum(readings)):
            return Validity.VALID
        if seen < self.window:
            return Validity.WARM_UP
        return Validity.MISSING if whole < self.window else Validity.NOT_FINITE

    def alarms(self, level: float, residual_level: float, were_on: tuple[bool, bool]) -> tuple[bool, bool]:
        """Whether power and residual alarm at these levels, after having been on or not."""
        c = self.calibration
        if c is None or c.threshold_w is None or c.release_w is None:
            return QUIET
        power = level > (c.release_w if were_on[0] else c.threshold_w)
        if c.residual_threshold is None or c.residual_release is None:
            return power, False
        return power, residual_level > (c.residual_release if were_on[1] else c.residual_threshold)

    def _free_runs(self, state: MonitorState) -> tuple[int, ...]:
        """Periods left of each free run, after beginning those anew that have ended; whose windows are full."""
        left = state.left
        if min(left) <= 1:
            left = self.layout.begin_runs(self._function.inputs[0], left, state.x, state.h)
        else:
            left = left[0] - 1, left[1] - 1
        youngest, full = self.layout.length - self.window + 2, self._function.inputs[5]
        full[0], full[1] = left[0] <= youngest, left[1] <= youngest
        return left

    def _older(self, numbers: list[float], left: tuple[int, ...]) -> tuple[float, float]:
        """Energy and time of the older free run; puts its sums and the time at the end of the numbers."""
        sums = (numbers[-6:-3], left[0]), (numbers[-3:], left[1])
        (older, periods), younger = sums if left[0] <= left[1] else sums[::-1]
        if older[0] != older[0]:  # NaN: not begun yet, or a measurement was missing
            older, periods = younger
        seconds = max(self.layout.length - self.window + 3 - periods, 0) * self.model.dt
        numbers[-6:] = *older, seconds
        return numbers[-4], seconds


def _mean_of_finite(values: Array) -> float:
    """Mean of the values that are no NaN; NaN where fewer than half are."""
    total = float(np.add.reduce(values))
    if math.isfinite(total):
        return total / values.size
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size and 2 * finite.size >= values.size else math.nan


def _length_of_mean(values: Array) -> float:
    """Length of the mean ``(n_q,)`` of the rows ``(average, n_q)`` without NaN; NaN where fewer than half are."""
    finite = values[np.isfinite(values).all(axis=1)]
    if not (len(finite) and 2 * len(finite) >= len(values)):
        return math.nan
    mean = finite.sum(axis=0) / len(finite)
    return math.sqrt(float(mean.dot(mean)))


def _positive(resolution: ArrayLike | None, n_y: int) -> tuple[float, ...]:
    if resolution is None:
        return ()
    steps = np.asarray(resolution, dtype=float).ravel()
    if steps.shape != (n_y,) or not (np.all(np.isfinite(steps)) and np.all(steps > 0)):
        raise InputError(f"energy monitor: resolution needs {n_y} positive steps of the sensors, got {steps}")
    return tuple(steps.tolist())


def _spans(model: HybridModel, given: ArrayLike | None) -> Array:
    if given is None:
        return np.array([s.upper - s.lower for s in model.inputs])
    spans = np.asarray(given, dtype=float).ravel()
    if spans.shape != (model.n_u,) or not np.all(spans > 0):
        raise InputError(f"energy monitor: input_range needs {model.n_u} positive ranges, got {spans}")
    return spans
