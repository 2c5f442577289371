"""Unmeasured disturbances of a machine as plain data: constants at inputs, rates of states or outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.records import Fields
from hybrid_mpc.rules import Name, NotNegative

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Disturbance:
    """One unmeasured disturbance, constant or slowly changing: a load, a leak, a sensor's offset.

    Args:
        at: Where it is added: to an ``"input"``, to the ``"rate"`` of a state, to an ``"output"``.
        signal: Name of that input, state or output.
        size: A large value of it [the signal's unit; for a rate, per second]. Default 0: the range of the input; for
            rates and outputs it is required.

    Raises:
        InputError: If the size is negative or not finite, or missing for a rate or an output.

    Example:
        >>> Disturbance("rate", "level", 1e-3).at
        'rate'
    """

    at: Literal["input", "rate", "output"]
    signal: Name
    size: NotNegative = 0.0

    def __post_init__(self) -> None:
        own = Fields(self, f"disturbance at the {self.at} {self.signal}")
        own.need(
            "at size", lambda: self.at == "input" or self.size > 0,
            f"size: must be positive, got {self.size}. Give a large value of the disturbance (not needed at an input, "
            "whose range is the default). [HM-MODEL-004]",
        )  # fmt: skip
        own.refuse()


def disturbance_matrices(
    chosen: Sequence[Disturbance] | None,
    inputs: Sequence[Signal],
    states: Sequence[Signal],
    outputs: Sequence[Signal],
    dt: float,
) -> tuple[Array, Array, Array]:
    """Effect of disturbances ``d`` ``(n_d,)``: matrices on inputs ``(n_u, n_d)``, on states over a period
    ``(n_x, n_d)``, on outputs ``(n_y, n_d)``. ``chosen`` None: one at each input.

    Raises:
        InputError: If there is no disturbance, a signal is unknown, or two disturbances are equal.
    """
    if chosen is None:
        chosen = [Disturbance("input", s.name) for s in inputs]
    if not chosen:
        raise InputError(
            "disturbance model: empty. Omit disturbance_model for one disturbance at each input, or name at least one "
            "(as many as outputs give offset-free control). Without a disturbance, the estimator explains every load "
            "as motion of the states. [HM-MODEL-005]"
        )
    places = {"input": (inputs, 1.0), "rate": (states, dt), "output": (outputs, 1.0)}
    if len({(d.at, d.signal) for d in chosen}) < len(chosen):
        raise InputError(
            f"disturbance model: disturbances must differ, got {[(d.at, d.signal) for d in chosen]} [HM-MODEL-006]"
        )
    found = {at: np.zeros((len(signals), len(chosen))) for at, (signals, _) in places.items()}
    for j, d in enumerate(chosen):
        signals, factor = places[d.at]
        names = [s.name for s in signals]
        if d.signal not in names:
            what = "state" if d.at == "rate" else d.at
            raise InputError(
                f"disturbance model: no {what} {d.signal!r}; known names: {', '.join(names)} [HM-MODEL-007]"
            )
        found[d.at][names.index(d.signal), j] = factor
    return found["input"], found["rate"], found["output"]
