"""Simulated faults of sensors and actuators, for any plant, and faults that a plant implements itself."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.records import Fields
from hybrid_mpc.rules import Bound, Duration, Name, NameOrNone, Number

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fault:
    """A fault that acts for ``start <= t < end``.

    Args:
        start: Begin [s].
        end: End [s]; ``inf`` for never.
        target: ``"measurement_offset"`` adds ``value`` to the measurement; ``"measurement_scale"`` multiplies
            it; ``"measurement_freeze"`` repeats the last one before the fault; ``"measurement_dropout"`` gives
            NaN; ``"input_gain"`` multiplies the input that reaches the plant by ``value``;
            ``"input_offset"`` adds ``value`` to it. ``"plant_..."`` is a fault that the plant implements; see
            :func:`install`.
        value: Size, in the unit of the output or input, [-] for a factor. Freeze and dropout use none. Default: 0.
        channel: Name of the output or input; needed if there are several. Default: the only one.
        ramp: Time [s] over which the size grows linearly to ``value``. Default: 0, at once.

    Raises:
        InputError: If the interval is empty, the target unknown, the value not finite, the channel not a name, or the
            ramp negative.

    Example:
        >>> corrupt_input([Fault(1.0, 2.0, "input_gain", 0.5)], 1.5, np.array([0.4]))
        array([0.2])
        >>> cold = Fault(1.0, 2.0, "measurement_offset", -5.0, "temperature2")
        >>> corrupt_measurement([cold], 1.5, np.array([40.0, 30.0]), np.zeros(2), ("temperature1", "temperature2"))
        array([40., 25.])
        >>> corrupt_input([Fault(1.0, 9.0, "input_offset", 0.2, ramp=2.0)], 2.0, np.array([0.4]))
        array([0.5])
    """

    start: Bound
    end: Bound
    target: Name
    value: Number = 0.0
    channel: NameOrNone = ""
    ramp: Duration = 0.0

    def __post_init__(self) -> None:
        own = Fields(self, f"fault {self.target}")
        own.need(
            "target", lambda: self.target in SIGNAL_TARGETS or self.on_plant, _explain_unknown(self.target)
        )
        own.need(
            "start end",
            lambda: self.start < self.end,
            f"the interval [{self.start}, {self.end}) s is empty; give start < end [HM-LOOP-001]",
        )
        own.refuse()

    @property
    def on_input(self) -> bool:
        """True for a fault of an actuator."""
        return self.target.startswith("input_")

    @property
    def on_plant(self) -> bool:
        """True for a fault inside the machine, which the plant implements."""
        return self.target.startswith("plant_")

    def active(self, t: float) -> bool:
        """Whether the fault acts at ``t`` [s], with a tolerance of a nanosecond."""
        return self.start - 1e-9 <= t < self.end - 1e-9

    def value_at(self, t: float, neutral: float) -> float:
        """Size at ``t`` [s] on the ramp from ``neutral`` (1 for a factor, 0 for a sum) to ``value``.

        With an infinite ``neutral`` (no limit) there is no ramp.
        """
        if self.ramp == 0 or not math.isfinite(neutral):
            return self.value
        share = min(max((t - self.start) / self.ramp, 0.0), 1.0)
        return neutral + share * (self.value - neutral)


EFFECTS: Mapping[str, Callable[[Fault, float, float, float], float]] = {
    "measurement_offset": lambda fault, t, value, before: value + fault.value_at(t, 0.0),
    "measurement_scale": lambda fault, t, value, before: value * fault.value_at(t, 1.0),
    "measurement_freeze": lambda fault, t, value, before: before,
    "measurement_dropout": lambda fault, t, value, before: math.nan,
    "input_gain": lambda fault, t, value, before: value * fault.value_at(t, 1.0),
    "input_offset": lambda fault, t, value, before: value + fault.value_at(t, 0.0),
}
"""Faulty value at ``t``, from the measured or commanded value and the measurement before it, by target."""
SIGNAL_TARGETS = tuple(EFFECTS)


def _explain_unknown(target: object) -> str:
    near = difflib.get_close_matches(str(target), SIGNAL_TARGETS, 1)
    meant = f"; did you mean {near[0]!r}? There are" if near else "; known"
    targets = ", ".join(SIGNAL_TARGETS)
    return (
        f"fault target {target!r} is unknown{meant}: {targets}, and the plant's own plant_... [HM-LOOP-052]"
    )


def check_channels(faults: Sequence[Fault], outputs: Sequence[str], inputs: Sequence[str]) -> None:
    """Refuse faults of unknown or missing channels, and faults that only a plant can simulate.

    Args:
        faults: The faults.
        outputs: Names of the outputs.
        inputs: Names of the inputs.

    Raises:
        InputError: The message lists the valid names.

    Example:
        >>> check_channels([Fault(0.0, 1.0, "input_gain", 0.5, "power3")], ["level"], ["power1", "power2"])
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: fault input_gain: no input 'power3'; there are: power1, power2
    """
    for fault in faults:
        if fault.on_plant:
            raise InputError(
                f"fault {fault.target}: only the plant can simulate it. Call plant, faults = install(plant, faults) "
                "before the simulation [HM-LOOP-002]"
            )
        kind, names = ("input", inputs) if fault.on_input else ("output", outputs)
        if not fault.channel and len(names) > 1:
            raise InputError(
                f"fault {fault.target}: the {kind} is missing. Give one of {', '.join(names)}: "
                f'channel="{names[0]}", or {fault.target}:{names[0]} in a text [HM-LOOP-003]'
            )
        if fault.channel and fault.channel not in names:
            raise InputError(
                f"fault {fault.target}: no {kind} {fault.channel!r}; there are: {', '.join(names)} [HM-LOOP-004]"
            )


def check_plant_faults(faults: Sequence[Fault], known: Sequence[str]) -> None:
    """Refuse faults that are not among the ``known`` faults of a plant.

    Raises:
        InputError: The message names the fault and the plant's faults.
    """
    for fault in faults:
        if fault.target not in known:
            raise InputError(
                f"fault {fault.target!r}: this plant does not have it; choose from: {', '.join(known)} [HM-LOOP-005]"
            )


def install(plant: Any, faults: Sequence[Fault]) -> tuple[Any, tuple[Fault, ...]]:
    """Build faults of the machine into a plant; faults of sensors and actuators remain.

    A plant with faults of its own has a method ``with_faults(faults) -> plant``.

    Returns:
        The faulty plant, and the remaining faults for ``simulate``.

    Raises:
        InputError: If the plant does not support one of these faults.
    """
    inside = tuple(fault for fault in faults if fault.on_plant)
    outside = tuple(fault for fault in faults if not fault.on_plant)
    if not inside:
        return plant, outside
    if not hasattr(plant, "with_faults"):
        raise InputError(
            f"fault {inside[0].target}: plant {type(plant).__name__} does not support faults. Write its method "
            "with_faults(faults), which returns the faulty plant [HM-LOOP-006]"
        )
    return plant.with_faults(inside), outside


def corrupt_measurement(
    faults: Sequence[Fault], t: float, y: Array, y_before: Array, outputs: Sequence[str] = ()
) -> Array:
    """Faulty measurement ``(n_y,)`` at ``t``; ``y_before`` is the measurement before it.

    ``outputs`` are the names of the outputs, needed if a fault names one.
    """
    return _corrupt(faults, t, y, y_before, outputs, "measurement_")


def corrupt_input(faults: Sequence[Fault], t: float, u: Array, inputs: Sequence[str] = ()) -> Array:
    """Faulty input ``(n_u,)`` that reaches the plant at ``t`` for the commanded input ``u``.

    ``inputs`` are the names of the inputs, needed if a fault names one.
    """
    return _corrupt(faults, t, u, u, inputs, "input_")


def _corrupt(
    faults: Sequence[Fault], t: float, now: Array, before: Array, names: Sequence[str], kind: str
) -> Array:
    values = now.copy()
    for fault in faults:
        if fault.target.startswith(kind) and fault.active(t):
            i = names.index(fault.channel) if fault.channel else 0
            values[i] = EFFECTS[fault.target](fault, t, values[i], before[i])
    return values


def fault_text(faults: Sequence[Fault], late: Sequence[tuple[float, float]] = ()) -> str:
    """Faults in the form of the command line; ``"none"`` for none.

    Example:
        >>> fault_text([Fault(1.5, np.inf, "plant_friction", 2.0)], late=((1.0, 1.2),))
        'plant_friction=2@1.5 + late@1:1.2'
    """
    parts = []
    for f in faults:
        end = "" if np.isinf(f.end) else f":{f.end:g}"
        more = f" ramp {f.ramp:g}" if f.ramp else ""
        target = f.target + (f":{f.channel}" if f.channel else "")
        parts.append(f"{target}={f.value:g}@{f.start:g}{end}{more}")
    parts += [f"late@{a:g}" + ("" if np.isinf(b) else f":{b:g}") for a, b in late]
    return " + ".join(parts) or "none"


def parsed_fault(text: str) -> Fault:
    """A fault from ``TARGET[:CHANNEL][=VALUE][@START[:END]]``, times in seconds.

    Args:
        text: e.g. ``"input_gain=0.8@1.0"`` or ``"measurement_offset:level=0.1@5:9"``. Default of start: 0; of end:
            never. The channel is the name of an output or input, needed if there are several. Freeze and dropout have
            no value, all other faults need one.

    Raises:
        InputError: If the text has another form, or the fault is unknown.

    Example:
        >>> fault = parsed_fault("plant_friction=2@1:2.5")
        >>> fault.target, fault.value, fault.start, fault.end
        ('plant_friction', 2.0, 1.0, 2.5)
        >>> parsed_fault("measurement_freeze:temperature1@3").channel
        'temperature1'
    """
    head, _, when = text.partition("@")
    name, _, value = head.partition("=")
    target, _, channel = name.partition(":")
    start, _, end = when.partition(":")
    try:
        numbers = [float(v) if v else d for v, d in ((start, 0.0), (end, math.inf), (value, 0.0))]
    except ValueError as error:
        raise InputError(
            f"fault {text!r}: {error}. Write TARGET:CHANNEL=VALUE@START:END, e.g. input_gain=0.8@1.0:2.5"
            " [HM-LOOP-007]"
        ) from error
    if math.isnan(numbers[0]) or math.isnan(numbers[1]):
        raise InputError(f"fault {text!r}: times must be numbers of seconds [HM-LOOP-008]")
    fault = Fault(numbers[0], numbers[1], target, numbers[2], channel)
    if not value and target not in ("measurement_freeze", "measurement_dropout"):
        raise InputError(
            f"fault {text!r}: the value is missing; write its size, e.g. {target}=1.5@1.0 [HM-LOOP-009]"
        )
    return fault
