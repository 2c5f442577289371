"""The monitor: reading, limits, alarm; the same for every kind of readings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel, positions_of
from hybrid_mpc.watch.detector import Detector, DetectorState, WatchLimits
from hybrid_mpc.watch.energy import EnergyReadings, check_model
from hybrid_mpc.watch.readings import ENERGY, FROZEN_STEPS, RESIDUALS, Readings, Validity
from hybrid_mpc.watch.residuals import ResidualReadings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MonitorState:
    """What a monitor remembers, never changed in place: of the readings, of the detector, and for how many samples in a
    row there has been no valid reading.
    """

    readings: Any
    detector: DetectorState | None
    invalid: int = 0


@dataclass(frozen=True)
class Reading:
    """What a monitor says of one period.

    Args:
        values: Value of each channel [its unit]; NaN where unknown.
        terms: What the variances of nominal values are linear in, for each channel.
        levels: Level of each limit [deviations, or the unit of the channel]; none without limits.
        share: The largest level over its threshold [-]; NaN without limits.
        on: Which limits are exceeded.
        channels: Names of the channels that alarm.
        frozen_outputs: Names of the outputs whose sensor repeats itself while motion is predicted.
        travel: How far each output was predicted to move since its sensor last moved ``(n_y,)`` [its unit].
        repeats: Samples since then ``(n_y,)``.
        inside: Which outputs lie inside their sensors' ranges ``(n_y,)``.
        settled: Whether the values count.
        alarm: True while a channel alarms, a sensor is frozen, or the monitor is blind.
        validity: Whether the values are valid, and if not, why.
        blind: True while no reading has been valid for longer than the readings' ``patience``.
        violation_w: Violation of the energy balance [W]; NaN where the energy is not read.
    """

    values: Sequence[float] | Array
    terms: Sequence[Sequence[float]]
    levels: Sequence[float]
    share: float
    on: tuple[bool, ...]
    channels: tuple[str, ...]
    frozen_outputs: tuple[str, ...]
    travel: Sequence[float] | Array
    repeats: Sequence[int] | NDArray[np.int_]
    inside: Sequence[bool] | NDArray[np.bool_]
    settled: bool
    alarm: bool
    validity: Validity
    blind: bool
    violation_w: float

    @property
    def frozen(self) -> bool:
        """Whether a sensor is frozen."""
        return bool(self.frozen_outputs)


class Monitor:
    """Watches a machine by the channels of its readings.

    Each channel is compared with its own limits; a sensor that repeats itself while its output is predicted to move
    beyond its limit is **frozen**; a monitor without a valid reading for longer than the readings' patience is
    **blind**. Each of the three is an alarm.

    Args:
        readings: What is read, see :func:`make_monitor`.
        limits: What the channels are compared with, of :func:`~hybrid_mpc.watch.learn.learn_limits`. Default: none,
            then nothing alarms but a frozen sensor with ``resolution``, and blindness.
        resolution: Step of each sensor ``(n_y,)`` [output units]: three of them are the least travel of a frozen
            sensor. Default: the limits' travel alone.

    Raises:
        InputError: If the limits are of other readings, or a step is not positive.

    Example: ``Monitor(EnergyReadings(model), limits)``
    """

    def __init__(
        self, readings: Readings, limits: WatchLimits | None = None, *, resolution: ArrayLike | None = None
    ) -> None:
        model = self.model = readings.model
        self.readings, self.limits = readings, limits
        self.channels = tuple(channel.name for channel in readings.channels)
        """Names of the channels."""
        self.detector = None
        """What compares the channels with their limits; None without limits."""
        n_y = model.n_y
        travel, repeats = np.full(n_y, math.inf), np.zeros(n_y, dtype=int)
        if limits is not None:
            limits.check(readings.kind, readings.channels, readings.n_terms, model.dt, model.time_unit)
            if len(limits.travel) != n_y:
                raise InputError(
                    f"limits: {len(limits.travel)} travels, model {model.name} has {n_y} outputs [HM-WATCH-030]"
                )
            self.detector = Detector(limits.channels, self.channels)
            travel, repeats = np.array(limits.travel), np.array(limits.repeats)
        if resolution is not None:
            steps = np.asarray(resolution, dtype=float).ravel()
            if steps.shape != (n_y,) or not (np.all(np.isfinite(steps)) and np.all(steps > 0)):
                raise InputError(
                    f"monitor: resolution needs {n_y} positive steps of the sensors, got {steps} [HM-WATCH-031]"
                )
            least = FROZEN_STEPS * steps
            travel = least if readings.kind == ENERGY or limits is None else np.maximum(travel, least)
        self.frozen_travel, self.frozen_repeats = travel, repeats
        """How far, and for how many samples, each sensor may repeat itself ``(n_y,)``."""
        self._outputs = [
            (s.name, far, often)
            for s, far, often in zip(model.outputs, travel.tolist(), repeats.tolist(), strict=True)
        ]
        self._of_limit = () if self.detector is None else tuple(one.channel for one in self.detector.limits)
        self._violation = self.channels.index("violation") if readings.kind == ENERGY else None

    @property
    def cannot_alarm(self) -> str:
        """Why no reading could raise an alarm, and what would give it limits; empty if one could."""
        if self.limits is not None or np.isfinite(self.frozen_travel).any():
            return ""
        return (
            "it has no limits, so nothing alarms but missing readings; the run's stage watch learns them, and "
            "kit.monitor() has them"
        )

    def initial(self) -> MonitorState:
        """State before the first sample."""
        return MonitorState(
            self.readings.initial(), None if self.detector is None else self.detector.initial()
        )

    def update(
        self, state: MonitorState, y: Array, u_prev: Array, estimate: Any
    ) -> tuple[MonitorState, Reading]:
        """Take one sample; pure: the same arguments give the same result.

        Args:
            state: State after the previous sample, or :meth:`initial`.
            y: Measurement ``(n_y,)`` now; NaN where missing.
            u_prev: Input ``(n_u,)`` applied over the period that just ended.
            estimate: Estimate at this sample, of which ``x``, ``h``, ``w`` and ``d`` are read where it has them.

        Returns:
            The next state and the reading.
        """
        memory, s = self.readings.update(state.readings, y, u_prev, estimate)
        detector: DetectorState | None = None
        levels: Sequence[float] = ()
        share, on = math.nan, tuple[bool, ...]()
        if self.detector is not None and state.detector is not None:
            detector, levels, share = self.detector.update(state.detector, s.values, s.terms, s.settled)
            on = detector.on
        stuck = self.frozen(s.travel, s.repeats, s.inside)
        invalid = state.invalid + 1 if s.validity else 0
        blind = invalid > self.readings.patience
        alarming = any(on)
        names = () if not alarming else tuple(
            dict.fromkeys(name for name, exceeds in zip(self._of_limit, on, strict=True) if exceeds)
        )  # fmt: skip
        violation = math.nan if self._violation is None else float(s.values[self._violation])
        return MonitorState(memory, detector, invalid), Reading(
            s.values, s.terms, levels, share, on, names, stuck, s.travel, s.repeats, s.inside, s.settled,
            alarming or bool(stuck) or blind, s.validity, blind, violation,
        )  # fmt: skip

    def frozen(self, travel: Any, repeats: Any, inside: Any) -> tuple[str, ...]:
        """Names of the outputs whose sensor is frozen, from how far and for how long each has repeated itself."""
        return tuple(
            name
            for (name, far, often), moved, count, within in zip(
                self._outputs, travel, repeats, inside, strict=True
            )
            if within and abs(moved) > far and count > often
        )


def reads_energy(model: HybridModel) -> bool:
    """Whether a model's energy can be read: a mechanical one whose outputs are its positions."""
    try:
        positions_of(model)
        check_model(model)
    except InputError:
        return False
    return True


def make_readings(
    model: HybridModel,
    kind: str = "",
    *,
    rest_speed: ArrayLike | None = None,
    input_range: ArrayLike | None = None,
) -> EnergyReadings | ResidualReadings:
    """Readings of a model's machine.

    Args:
        model: The model.
        kind: ``"energy"`` or ``"residuals"``. Default: the energy where it can be read (:func:`reads_energy`).
        rest_speed: See :class:`~hybrid_mpc.watch.energy.EnergyReadings`; residuals know of none.
        input_range: Likewise.

    Raises:
        InputError: If there is no such kind, or the energy of the model cannot be read.
    """
    kind = kind or (ENERGY if reads_energy(model) else RESIDUALS)
    if kind == RESIDUALS:
        return ResidualReadings(model)
    if kind != ENERGY:
        raise InputError(f"readings: no kind {kind!r}; there are {ENERGY!r} and {RESIDUALS!r} [HM-WATCH-032]")
    return EnergyReadings(model, rest_speed=rest_speed, input_range=input_range)


def make_monitor(
    model: HybridModel,
    limits: WatchLimits | None = None,
    *,
    kind: str = "",
    resolution: ArrayLike | None = None,
    rest_speed: ArrayLike | None = None,
    input_range: ArrayLike | None = None,
) -> Monitor:
    """A monitor of a model's machine.

    Args:
        model: The model that is compared with the machine.
        limits: See :class:`Monitor`. Default: none.
        kind: See :func:`make_readings`. Default: the limits' kind, else the energy where it can be read.
        resolution: See :class:`Monitor`.
        rest_speed: See :func:`make_readings`. Default: the limits' own.
        input_range: See :func:`make_readings`.

    Raises:
        InputError: As these.

    Example: ``make_monitor(kit.models["hybrid"], limits, resolution=[2 * np.pi / 4096])``
    """
    if limits is not None:
        kind = kind or limits.kind
        rest_speed = rest_speed if rest_speed is not None else limits.rest_speed or None
    readings = make_readings(model, kind, rest_speed=rest_speed, input_range=input_range)
    return Monitor(readings, limits, resolution=resolution)
