"""Faults of sensors and actuators, which need no knowledge of the plant, and of plants that know their own."""

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
        start: First instant [s].
        end: Instant from which it is gone [s]; ``inf`` for never.
        target: ``"measurement_offset"`` adds ``value`` to the measurement; ``"measurement_scale"`` multiplies
            it; ``"measurement_freeze"`` repeats the last one before the fault; ``"measurement_dropout"`` gives
            NaN; ``"input_gain"`` multiplies the input that reaches the plant by ``value``;
            ``"input_offset"`` adds ``value`` to it. ``"plant_..."`` is one of the plant's own, which says what
            it means; see :func:`install`.
        value: Size, in the units of the output or input, [-] for a factor. Freeze and dropout use none.
        channel: Name of the output or input concerned. Default: the only one; where there are several it is needed.
        ramp: Time [s] over which the size grows, in proportion, from nothing to ``value``. Default 0: at once.

    Raises:
        InputError: If the interval is empty, the target unknown, the value not finite, the channel no name, or the ramp
            negative.

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
        own.need("target", lambda: self.target in SIGNAL_TARGETS or self.on_plant, _unknown(self.target))
        own.need(
            "start end",
            lambda: self.start < self.end,
            f"the interval [{self.start}, {self.end}) s is empty [HM-LOOP-001]",
        )
        own.refuse()

    @property
    def on_input(self) -> bool:
        """True for a fault of an actuator."""
        return self.target.startswith("input_")

    @property
    def on_plant(self) -> bool:
        """True for a fault inside the machine, which only the plant can show."""
        return self.target.startswith("plant_")

    def active(self, t: float) -> bool:
        """True at ``t`` [s]; instants within a nanosecond of ``start`` and ``end`` count as these."""
        return self.start - 1e-9 <= t < self.end - 1e-9

    def value_at(self, t: float, neutral: float) -> float:
        """Size at ``t`` [s]: on its ramp from ``neutral`` (1 for a factor, 0 for a sum) to ``value``.

        Where ``neutral`` is infinite (a limit that is not there) the ramp is at its end from the start.
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
"""What a fault makes at ``t`` of a measured or commanded value; ``before`` is the measurement before it."""
SIGNAL_TARGETS = tuple(EFFECTS)


def _unknown(target: object) -> str:
    near = difflib.get_close_matches(str(target), SIGNAL_TARGETS, 1)
    meant = f"; did you mean {near[0]!r}? There are" if near else "; known"
    targets = ", ".join(SIGNAL_TARGETS)
    return f"fault target {target!r} is unknown{meant}: {targets}, and what a plant knows as plant_... [HM-LOOP-052]"


def check_channels(faults: Sequence[Fault], outputs: Sequence[str], inputs: Sequence[str]) -> None:
    """Refuse faults of channels that do not exist or are not named, and faults that only a plant can show.

    Args:
        faults: The faults.
        outputs: Names of the outputs.
        inputs: Names of the inputs.

    Raises:
        InputError: With the names that there are.

    Example:
        >>> check_channels([Fault(0.0, 1.0, "input_gain", 0.5, "power3")], ["level"], ["power1", "power2"])
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: fault input_gain: no input 'power3'; there are: power1, power2
    """
    for fault in faults:
        if fault.on_plant:
            raise InputError(
                f"fault {fault.target} lies in the plant: build it in with "
                "plant, faults = install(plant, faults) before simulating [HM-LOOP-002]"
            )
        kind, names = ("input", inputs) if fault.on_input else ("output", outputs)
        if not fault.channel and len(names) > 1:
            raise InputError(
                f"fault {fault.target}: which {kind}? Name one of {', '.join(names)}: "
                f'channel="{names[0]}", in a text {fault.target}:{names[0]} [HM-LOOP-003]'
            )
        if fault.channel and fault.channel not in names:
            raise InputError(
                f"fault {fault.target}: no {kind} {fault.channel!r}; there are: {', '.join(names)} [HM-LOOP-004]"
            )


def check_plant_faults(faults: Sequence[Fault], known: Sequence[str]) -> None:
    """Refuse, on a plant's behalf, faults that are not among those it ``known``.

    Raises:
        InputError: With the fault and what the plant knows.
    """
    for fault in faults:
        if fault.target not in known:
            raise InputError(
                f"this plant has no fault {fault.target!r}; it knows: {', '.join(known)} [HM-LOOP-005]"
            )


def install(plant: Any, faults: Sequence[Fault]) -> tuple[Any, tuple[Fault, ...]]:
    """Build the faults of the machine into a plant; what is left are those of sensors and actuators.

    If any fault is the plant's own, it has a method ``with_faults(faults) -> plant``.

    Returns:
        The plant to simulate, and the faults to hand to ``simulate``.

    Raises:
        InputError: If the plant takes no faults, or not one of these.
    """
    inside = tuple(fault for fault in faults if fault.on_plant)
    outside = tuple(fault for fault in faults if not fault.on_plant)
    if not inside:
        return plant, outside
    if not hasattr(plant, "with_faults"):
        raise InputError(
            f"fault {inside[0].target}: the plant {type(plant).__name__} takes no faults; it needs a method "
            "with_faults(faults) that returns the faulty plant [HM-LOOP-006]"
        )
    return plant.with_faults(inside), outside


def corrupt_measurement(
    faults: Sequence[Fault], t: float, y: Array, y_before: Array, outputs: Sequence[str] = ()
) -> Array:
    """Measurement ``(n_y,)`` that arrives at ``t``; ``y_before`` is the one that arrived before it.

    ``outputs`` are their names; needed where faults name one.
    """
    return _corrupted(faults, t, y, y_before, outputs, "measurement_")


def corrupt_input(faults: Sequence[Fault], t: float, u: Array, inputs: Sequence[str] = ()) -> Array:
    """Input ``(n_u,)`` that reaches the plant at ``t`` when ``u`` was commanded.

    ``inputs`` are their names; needed where faults name one.
    """
    return _corrupted(faults, t, u, u, inputs, "input_")


def _corrupted(
    faults: Sequence[Fault], t: float, now: Array, before: Array, names: Sequence[str], kind: str
) -> Array:
    values = now.copy()
    for fault in faults:
        if fault.target.startswith(kind) and fault.active(t):
            i = names.index(fault.channel) if fault.channel else 0
            values[i] = EFFECTS[fault.target](fault, t, values[i], before[i])
    return values


def fault_text(faults: Sequence[Fault], late: Sequence[tuple[float, float]] = ()) -> str:
    """Faults in the form in which the command line takes them; ``"none"`` for none.

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
        text: e.g. ``"input_gain=0.8@1.0"`` or ``"measurement_offset:level=0.1@5:9"``; start 0 by default, end never.
            The channel is the name of an output or input, needed where there are several. A sensor that freezes or
            drops out has no value, every other fault needs one.

    Raises:
        InputError: If it has another form, or there is no such fault.

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
            f"fault {text!r}: {error}; the form is TARGET:CHANNEL=VALUE@START:END, e.g. input_gain=0.8@1.0:2.5"
            " [HM-LOOP-007]"
        ) from error
    if math.isnan(numbers[0]) or math.isnan(numbers[1]):
        raise InputError(f"fault {text!r}: times must be numbers of seconds [HM-LOOP-008]")
    fault = Fault(numbers[0], numbers[1], target, numbers[2], channel)
    if not value and target not in ("measurement_freeze", "measurement_dropout"):
        raise InputError(
            f"fault {text!r} has no value; write how large it is, e.g. {target}=1.5@1.0 [HM-LOOP-009]"
        )
    return fault
