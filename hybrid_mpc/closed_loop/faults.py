"""Faults of sensors and actuators that need no knowledge of the plant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]
Target = Literal[
    "measurement_offset", "measurement_freeze", "measurement_dropout", "input_gain", "input_offset"
]


@dataclass(frozen=True)
class Fault:
    """A fault that acts for ``start <= t < end``.

    Args:
        start: First instant [s].
        end: Instant from which it is gone [s]; ``inf`` for never.
        target: ``"measurement_offset"`` adds ``value`` to the measurement; ``"measurement_freeze"`` repeats
            the last one before the fault; ``"measurement_dropout"`` gives NaN; ``"input_gain"`` multiplies
            the input that reaches the plant by ``value``; ``"input_offset"`` adds ``value`` to it.
        value: Size, in the units of the output or input [-] for a gain. Freeze and dropout use none.
        channel: Number of the output or input concerned.

    Raises:
        InputError: If the interval is empty, the target unknown, or the value not finite.

    Example:
        >>> corrupt_input([Fault(1.0, 2.0, "input_gain", 0.5)], 1.5, np.array([0.4]))
        array([0.2])
    """

    start: float
    end: float
    target: Target
    value: float = 0.0
    channel: int = 0

    def __post_init__(self) -> None:
        if self.target not in get_args(Target):
            raise InputError(f"fault target {self.target!r} is unknown; known: {', '.join(get_args(Target))}")
        if not self.start < self.end:
            raise InputError(f"fault {self.target}: the interval [{self.start}, {self.end}) s is empty")
        if not math.isfinite(self.value):
            raise InputError(f"fault {self.target}: value must be finite, got {self.value}")

    @property
    def on_input(self) -> bool:
        """True for a fault of an actuator."""
        return self.target.startswith("input")

    def active(self, t: float) -> bool:
        """True at ``t`` [s]; instants within a nanosecond of ``start`` and ``end`` count as these."""
        return self.start - 1e-9 <= t < self.end - 1e-9


def check_channels(faults: Sequence[Fault], n_y: int, n_u: int) -> None:
    """Refuse faults of channels that do not exist.

    Raises:
        InputError: With the fault and the number of channels there are.
    """
    for fault in faults:
        n = n_u if fault.on_input else n_y
        if not 0 <= fault.channel < n:
            raise InputError(f"fault {fault.target}: channel {fault.channel} given, there are {n} (from 0)")


def corrupt_measurement(faults: Sequence[Fault], t: float, y: Array, y_before: Array) -> Array:
    """Measurement ``(n_y,)`` that arrives at ``t``; ``y_before`` is the one that arrived before it."""
    y = y.copy()
    for fault in faults:
        if not fault.active(t) or fault.on_input:
            continue
        if fault.target == "measurement_offset":
            y[fault.channel] += fault.value
        elif fault.target == "measurement_freeze":
            y[fault.channel] = y_before[fault.channel]
        else:
            y[fault.channel] = np.nan
    return y


def corrupt_input(faults: Sequence[Fault], t: float, u: Array) -> Array:
    """Input ``(n_u,)`` that reaches the plant at ``t`` when ``u`` was commanded."""
    u = u.copy()
    for fault in faults:
        if fault.active(t) and fault.target == "input_gain":
            u[fault.channel] *= fault.value
        elif fault.active(t) and fault.target == "input_offset":
            u[fault.channel] += fault.value
    return u
