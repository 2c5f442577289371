"""Estimates in loops with delays: filter arrived measurements, then predict to the time at which the input acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, Estimator, TrueState
from hybrid_mpc.model.limits import sampled, whole

Array = NDArray[np.float64]


class Predictor(Estimator, Protocol):
    """An estimator that can predict without a measurement and correct without a prediction."""

    def predict(self, estimate: Estimate, u: ArrayLike) -> Estimate:
        """Estimate one period later with ``u`` held."""

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> Estimate:
        """Estimate after a measurement at its instant."""


@dataclass(frozen=True)
class DelayedEstimate(Estimate):
    """An estimate at the time at which the next input acts, and its origin.

    ``filtered`` is the estimate at the time of the last measurement, ``inputs`` are the inputs since then, the oldest
    first. ``missing`` measurements taken before the start are still to arrive.
    """

    filtered: Estimate
    inputs: tuple[Array, ...]
    missing: int


class DelayCompensation:
    """An estimator for a loop with delays, around an estimator for the loop without.

    A measurement arrives ``sensor_delay`` periods after it was taken, an input acts ``input_delay`` periods after it
    was decided. The wrapped estimator processes measurements at their own times; its model then predicts
    ``sensor_delay + input_delay`` periods ahead with the inputs decided since. The object has no state of its own.

    Before the start the machine rests under the input of its operating point. The first measurement is used for the
    start; later ones are ignored until the sensor has caught up. Measured disturbances arrive with their measurement
    and are held from then on.

    Args:
        estimator: The estimator of the loop without delays.
        sensor_delay: Periods.
        input_delay: Periods.

    Raises:
        InputError: If a delay is not an integer number of periods, or negative.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal; from hybrid_mpc.model.model import HybridModel
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> ahead = DelayCompensation(TrueState(model), input_delay=1)
        >>> first = ahead.start(np.array([2.0]))
        >>> ahead.update(first, np.array([2.0]), np.array([0.5])).x  # 0.5 acts in the next period
        array([2.5])
    """

    def __init__(self, estimator: Predictor, *, sensor_delay: int = 0, input_delay: int = 0) -> None:
        self.estimator, self.model = estimator, estimator.model
        self._sensor = whole_periods(sensor_delay, "sensor_delay")
        self._input = whole_periods(input_delay, "input_delay")

    def start(self, y: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None) -> DelayedEstimate:
        """First estimate, at time ``t`` plus the input delay, from the first measurement."""
        resting = (self.model.u0,) * self._input
        first = self.estimator.start(y, t, **_given(w))
        return self._ahead(first, resting, self._sensor)

    def update(
        self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike, *, w: ArrayLike | None = None
    ) -> DelayedEstimate:
        """Estimate one period later, from the arrived measurement and the input decided since."""
        if not isinstance(estimate, DelayedEstimate):
            raise InputError(
                "DelayCompensation: the estimate is of another filter. Begin with start() of this filter. "
                "[HM-ESTIMATE-005]"
            )
        base, y = estimate.filtered, sampled(y, (None,), "y")
        inputs = (*estimate.inputs, sampled(u_prev, (None,), "u_prev"))
        if estimate.missing:
            missing = estimate.missing - 1
            if not missing:  # this measurement was taken at the start
                base = self.estimator.correct(base, y)
            return self._ahead(base, inputs, missing)
        return self._ahead(self.estimator.update(base, y, inputs[0], **_given(w)), inputs[1:], 0)

    def _ahead(self, base: Estimate, inputs: tuple[Array, ...], missing: int) -> DelayedEstimate:
        now = base
        for u in inputs:
            now = self.estimator.predict(now, u)
        return DelayedEstimate(
            now.t, now.x, now.h, now.d, now.P, base.innovation, base.nis, base, inputs, missing, w=now.w
        )


def _given(w: ArrayLike | None) -> dict[str, Array]:
    return {} if w is None else {"w": sampled(w, (None,), "w")}


MOST_PERIODS = 10**6
"""Most periods of a delay: each is stored."""


def whole_periods(delay: float, name: str) -> int:
    """A delay in periods, a nonnegative integer."""
    return whole(delay, f"{name} [periods]", 0, MOST_PERIODS)


def filtered(estimate: Estimate) -> Estimate:
    """The estimate at the time of the last measurement, from which a delayed estimate was predicted."""
    return estimate.filtered if isinstance(estimate, DelayedEstimate) else estimate


def sees_truth(estimator: Estimator) -> bool:
    """Whether an estimator is an oracle's, which receives the true state."""
    inner = estimator.estimator if isinstance(estimator, DelayCompensation) else estimator
    return isinstance(inner, TrueState)
