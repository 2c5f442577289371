"""Unmeasured disturbances of a machine as plain data: constant values at inputs, rates of states or outputs."""

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
    """One unmeasured disturbance, constant but for slow steps: a load, a leak, a sensor's offset.

    Args:
        at: Where it is added: to an ``"input"``, to the ``"rate"`` of a state, to an ``"output"``.
        signal: Name of that input, state or output.
        size: A large value of it [the signal's unit; of a rate that per second]. Default 0: the range of the input;
            rates and outputs have none and need it.

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
            f"size {self.size} given; needed: how large it may be, a positive number (an input's may be left out: its "
            "range) [HM-MODEL-004]",
        )  # fmt: skip
        own.refuse()


def disturbance_matrices(
    chosen: Sequence[Disturbance] | None,
    inputs: Sequence[Signal],
    states: Sequence[Signal],
    outputs: Sequence[Signal],
    dt: float,
) -> tuple[Array, Array, Array]:
    """How disturbances ``d`` ``(n_d,)`` act: on inputs ``(n_u, n_d)``, on states over a period ``(n_x, n_d)``, on
    outputs ``(n_y, n_d)``. None: one at each input.

    Raises:
        InputError: If there is none, a signal is unknown, or two are the same.
    """
    if chosen is None:
        chosen = [Disturbance("input", s.name) for s in inputs]
    if not chosen:
        raise InputError(
            "disturbance model: none is given; leave disturbance_model out for one at each input, or name at least one "
            "(as many as there are outputs leave no offset): an estimator without would take every load for a motion"
            " [HM-MODEL-005]"
        )
    places = {"input": (inputs, 1.0), "rate": (states, dt), "output": (outputs, 1.0)}
    if len({(d.at, d.signal) for d in chosen}) < len(chosen):
        raise InputError(
            f"disturbance model: two are the same: {[(d.at, d.signal) for d in chosen]} [HM-MODEL-006]"
        )
    found = {at: np.zeros((len(signals), len(chosen))) for at, (signals, _) in places.items()}
    for j, d in enumerate(chosen):
        signals, factor = places[d.at]
        names = [s.name for s in signals]
        if d.signal not in names:
            what = "state" if d.at == "rate" else d.at
            raise InputError(
                f"disturbance model: no {what} {d.signal!r}; there are: {', '.join(names)} [HM-MODEL-007]"
            )
        found[d.at][names.index(d.signal), j] = factor
    return found["input"], found["rate"], found["output"]
