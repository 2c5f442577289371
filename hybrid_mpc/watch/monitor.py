"""The monitor: compares readings with limits and raises alarms, for every kind of readings."""

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
from hybrid_mpc.watch.readings import ENERGY, FROZEN_STEPS, RESIDUALS, Readings, Sample
from hybrid_mpc.watch.residuals import ResidualReadings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MonitorState:
    """State of a monitor, never changed in place: of the readings, of the detector, and the number of successive
    samples without a valid reading.
    """

    readings: Any
    detector: DetectorState | None
    invalid: int = 0


@dataclass(frozen=True)
class Reading(Sample):
    """Reading of a monitor in one period: the sample of its readings, and what the limits make of it.

    Args:
        levels: Level of each limit [deviations, or the unit of the channel]; empty without limits.
        share: The largest level over its threshold [-]; NaN without limits.
        on: Which limits are exceeded.
        channels: Names of the channels that alarm.
        frozen_outputs: Names of the outputs with a frozen sensor.
        alarm: True while a channel alarms, a sensor is frozen, or the monitor is blind.
        blind: True while there has been no valid reading for longer than the readings' ``patience``.
        violation_w: Violation of the energy balance [W]; NaN if the energy is not read.
    """

    levels: Sequence[float]
    share: float
    on: tuple[bool, ...]
    channels: tuple[str, ...]
    frozen_outputs: tuple[str, ...]
    alarm: bool
    blind: bool
    violation_w: float

    @property
    def frozen(self) -> bool:
        """Whether a sensor is frozen."""
        return bool(self.frozen_outputs)


class Monitor:
    """Monitors a machine by the channels of its readings.

    Three conditions raise an alarm: a channel exceeds its limits; a sensor is **frozen** (its readings repeat although
    the predicted motion of its output exceeds its limit); the monitor is **blind** (no valid reading for longer than
    the readings' patience).

    Args:
        readings: The readings, see :func:`make_monitor`.
        limits: Limits of the channels, from :func:`~hybrid_mpc.watch.learn.learn_limits`. Default: none; then only a
            frozen sensor (with ``resolution``) and blindness raise alarms.
        resolution: Resolution of each sensor ``(n_y,)`` [output units]: three steps are the least travel of a frozen
            sensor. Default: only the limits' travel counts.

    Raises:
        InputError: If the limits belong to other readings, or a resolution is not positive.

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
        """Detector of the limits; None without limits."""
        n_y = model.n_y
        travel, repeats = np.full(n_y, math.inf), np.zeros(n_y, dtype=int)
        if limits is not None:
            limits.check(readings.kind, readings.channels, readings.n_terms, model.dt, model.time_unit)
            if len(limits.travel) != n_y:
                raise InputError(
                    f"limits: {len(limits.travel)} travels, but model {model.name} has {n_y} outputs. Learn the limits "
                    "again [HM-WATCH-030]"
                )
            self.detector = Detector(limits.channels, self.channels)
            travel, repeats = np.array(limits.travel), np.array(limits.repeats)
        if resolution is not None:
            steps = np.asarray(resolution, dtype=float).ravel()
            if steps.shape != (n_y,) or not (np.all(np.isfinite(steps)) and np.all(steps > 0)):
                raise InputError(
                    f"monitor: resolution must be {n_y} positive steps of the sensors, got {steps} [HM-WATCH-031]"
                )
            least = FROZEN_STEPS * steps
            travel = least if readings.kind == ENERGY or limits is None else np.maximum(travel, least)
        self.frozen_travel, self.frozen_repeats = travel, repeats
        """Largest predicted motion, and largest number of samples, with repeated readings ``(n_y,)``."""
        self._outputs = [
            (s.name, far, often)
            for s, far, often in zip(model.outputs, travel.tolist(), repeats.tolist(), strict=True)
        ]
        self._of_limit = () if self.detector is None else tuple(one.channel for one in self.detector.limits)
        self._violation = self.channels.index("violation") if readings.kind == ENERGY else None

    @property
    def cannot_alarm(self) -> str:
        """Why no reading can raise an alarm, and the remedy; empty if one can."""
        if self.limits is not None or np.isfinite(self.frozen_travel).any():
            return ""
        return (
            "the monitor has no limits, so only missing readings raise an alarm. Use kit.monitor(), which has the "
            "limits learned in stage watch of a run"
        )

    def initial(self) -> MonitorState:
        """State before the first sample."""
        return MonitorState(
            self.readings.initial(), None if self.detector is None else self.detector.initial()
        )

    def update(
        self, state: MonitorState, y: Array, u_prev: Array, estimate: Any
    ) -> tuple[MonitorState, Reading]:
        """Process one sample; a pure function of its arguments.

        Args:
            state: State after the previous sample, or :meth:`initial`.
            y: Present measurement ``(n_y,)``; NaN if missing.
            u_prev: Input ``(n_u,)`` applied over the period that just ended.
            estimate: Estimate at this sample; its fields ``x``, ``h``, ``w`` and ``d`` are used if present.

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
            **vars(s), levels=levels, share=share, on=on, channels=names, frozen_outputs=stuck,
            alarm=alarming or bool(stuck) or blind, blind=blind, violation_w=violation,
        )  # fmt: skip

    def frozen(self, travel: Any, repeats: Any, inside: Any) -> tuple[str, ...]:
        """Names of the outputs with a frozen sensor, from predicted motion and number of repeated readings."""
        return tuple(
            name
            for (name, far, often), moved, count, within in zip(
                self._outputs, travel, repeats, inside, strict=True
            )
            if within and abs(moved) > far and count > often
        )


def reads_energy(model: HybridModel) -> bool:
    """Whether a model's energy can be monitored: it is mechanical, and its outputs are its positions."""
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
    """Build the readings of a model's machine.

    Args:
        model: The model.
        kind: ``"energy"`` or ``"residuals"``. Default: the energy if :func:`reads_energy`.
        rest_speed: See :class:`~hybrid_mpc.watch.energy.EnergyReadings`; residuals do not use it.
        input_range: See :class:`~hybrid_mpc.watch.energy.EnergyReadings`; residuals do not use it.

    Raises:
        InputError: If the kind is unknown, or the model's energy cannot be monitored.
    """
    kind = kind or (ENERGY if reads_energy(model) else RESIDUALS)
    if kind == RESIDUALS:
        return ResidualReadings(model)
    if kind != ENERGY:
        raise InputError(
            f"readings: unknown kind {kind!r}; choose {ENERGY!r} or {RESIDUALS!r} [HM-WATCH-032]"
        )
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
    """Build a monitor of a model's machine.

    Args:
        model: The model that is compared with the machine.
        limits: See :class:`Monitor`. Default: none.
        kind: See :func:`make_readings`. Default: the limits' kind, else the energy if :func:`reads_energy`.
        resolution: See :class:`Monitor`. Default: none.
        rest_speed: See :func:`make_readings`. Default: that of the limits.
        input_range: See :func:`make_readings`. Default: that of the model's signals.

    Raises:
        InputError: As :class:`Monitor` and :func:`make_readings`.

    Example: ``make_monitor(kit.models["hybrid"], limits, resolution=[2 * np.pi / 4096])``
    """
    if limits is not None:
        kind = kind or limits.kind
        rest_speed = rest_speed if rest_speed is not None else limits.rest_speed or None
    readings = make_readings(model, kind, rest_speed=rest_speed, input_range=input_range)
    return Monitor(readings, limits, resolution=resolution)
