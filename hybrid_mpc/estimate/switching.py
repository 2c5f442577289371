"""Several Kalman filters side by side, and how probable each is: quick for a jump, quiet otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter

Array = NDArray[np.float64]
NEGLIGIBLE = 0.01
"""Share of a mode's past below which another mode is not mixed in: the wide covariance of an improbable jump would keep
the quiet filter from becoming quiet."""
SLIP = 10.0
"""Process noise over the quiet one while a machine slips: sticking friction that breaks, backlash, an impact."""
SWITCHES = ((0.9795, 0.02, 0.0005), (0.5, 0.4995, 0.0005), (0.45, 0.05, 0.5))
"""Probability per period to go from one of three modes (quiet, slip, jump) to another. At 50 Hz: a slip every second, a
load that comes or goes or a part that breaks every 40 s; each lasts a period or two."""


@dataclass(frozen=True)
class SwitchingEstimate(Estimate):
    """Estimates of several filters and the probability ``(m,)`` of each; its own fields are their weighted means."""

    modes: tuple[Estimate, ...]
    probability: Array


class SwitchingFilter:
    """Interacting multiple models: filters on one model that differ in the noise that they assume.

    One Kalman filter is either quiet or quick: the step that it allows a disturbance makes it follow a sudden load, and
    lets the sensor's noise through at all times. Here each filter assumes one mode of the noise, a Markov chain says
    how often modes change, and the measurements say which one is likely now. No method changes the object.

    Args:
        filters: The modes; same model.
        transition: Probability per period ``(m, m)`` to go from mode i (row) to mode j.

    Raises:
        InputError: If there are no filters, their models differ, or the rows of ``transition`` are no probabilities.

    Source: Blom and Bar-Shalom, *The interacting multiple model algorithm for systems with Markovian switching
    coefficients*, IEEE Trans. Automatic Control 33 (1988).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal; from hybrid_mpc.model.model import HybridModel
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> quiet, quick = (ExtendedKalmanFilter(model, sigma_y=[0.1], sigma_x=[0.01], sigma_x0=[0.1],
        ...     sigma_d=[s]) for s in (0.0, 1.0))
        >>> switching = SwitchingFilter([quiet, quick], [[0.99, 0.01], [0.5, 0.5]])
        >>> estimate = switching.start(np.zeros(1))
        >>> for y in (0.0, 0.0, 2.0, 4.0, 6.0):  # an unknown input of 2 from the second period on
        ...     estimate = switching.update(estimate, np.array([y]), np.zeros(1))
        >>> bool(abs(estimate.d[0] - 2.0) < 0.1)
        True
    """

    def __init__(self, filters: Sequence[ExtendedKalmanFilter], transition: ArrayLike) -> None:
        m, p = len(filters), np.array(transition, dtype=float)
        if not m or any(f.model is not filters[0].model for f in filters):
            raise InputError("a switching filter needs at least one filter, all on the same model")
        if p.shape != (m, m) or np.any(p < 0) or not np.allclose(p.sum(axis=1), 1.0, atol=1e-9):
            raise InputError(
                f"transition: probabilities of shape {(m, m)} whose rows sum to 1 needed, got {p.tolist()}"
            )
        self.model, self.filters, self.transition = filters[0].model, tuple(filters), p
        self.first_probability = _stationary(p)
        """Probability ``(m,)`` of each mode at the start."""

    def start(self, y: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None) -> SwitchingEstimate:
        """Estimate at rest at ``y`` ``(n_y,)``; see :meth:`ExtendedKalmanFilter.start`."""
        empty = np.full(self.model.n_y, np.nan)
        return _together(
            [f.start(y, t, w=w) for f in self.filters], self.first_probability, empty, float("nan")
        )

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def predict(self, estimate: Estimate, u: ArrayLike) -> SwitchingEstimate:
        """Estimate one period later with the input ``u`` ``(n_u,)`` held."""
        modes, probability = self._predicted(self._own(estimate), u)
        return _together(modes, probability, np.full(self.model.n_y, np.nan), float("nan"))

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def _predicted(self, before: SwitchingEstimate, u: ArrayLike) -> tuple[list[Estimate], Array]:
        """Estimate of each filter one period later, and the filters' probabilities ``(m,)``."""
        joint = before.probability[:, None] * self.transition
        after = joint.sum(axis=0)
        share = joint / np.where(after > 0, after, 1.0)
        share = np.where(share < NEGLIGIBLE, 0.0, share)
        share = share / share.sum(axis=0)
        modes = [
            f.predict(_mixed(before.modes, share[:, j]), u) if after[j] > 0 else f.predict(before.modes[j], u)
            for j, f in enumerate(self.filters)
        ]
        return modes, after

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> SwitchingEstimate:
        """Estimate after the measurement ``y`` ``(n_y,)``; see :meth:`ExtendedKalmanFilter.correct`."""
        return self.assess(estimate, y, u)[0]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def assess(
        self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None
    ) -> tuple[SwitchingEstimate, float]:
        """:meth:`correct`, and the log-likelihood of the measurement, without its constant."""
        before = self._own(estimate)
        if not np.any(np.isfinite(np.asarray(y, dtype=float))):
            return before, 0.0
        return self._assessed(before.modes, before.probability, y, u)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def _assessed(
        self, predicted: Sequence[Estimate], probability: Array, y: ArrayLike, u: ArrayLike | None
    ) -> tuple[SwitchingEstimate, float]:
        """Estimate after a measurement of which something is there, and its log-likelihood."""
        found = [f.assess(e, y, u) for f, e in zip(self.filters, predicted, strict=True)]
        likelihood = np.array([value for _, value in found])
        largest = float(np.max(np.where(np.isfinite(likelihood), likelihood, -np.inf)))
        weight = probability * np.exp(np.where(np.isfinite(likelihood), likelihood, -np.inf) - largest)
        if not np.sum(weight) > 0:  # absurd to every filter: it says nothing of the modes
            weight, largest = probability, -np.inf
        modes, share = [e for e, _ in found], weight / weight.sum()
        innovation = probability @ np.stack([e.innovation for e in modes])
        nis = float(share @ np.array([e.nis for e in modes]))
        return _together(modes, share, innovation, nis), largest + float(np.log(weight.sum()))

    def innovation_covariance(self, estimate: Estimate, u: ArrayLike | None = None) -> Array:
        """Covariance ``(n_y, n_y)`` that a predicted estimate gives its innovation; that of the mixture."""
        return self.filters[0].innovation_covariance(estimate, u)

    def update(
        self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike, *, w: ArrayLike | None = None
    ) -> SwitchingEstimate:
        """:meth:`predict` with the input ``u_prev`` held since, then :meth:`correct` with ``y``; ``w`` as
        :meth:`ExtendedKalmanFilter.update` takes it.

        A lost prediction is dropped: the estimate starts anew from ``y`` if any of it is finite.
        """
        modes, probability = self._predicted(self._own(estimate), u_prev)
        modes = [f.measuring(e, w) for f, e in zip(self.filters, modes, strict=True)]
        if not np.any(np.isfinite(np.asarray(y, dtype=float))):
            return _together(modes, probability, np.full(self.model.n_y, np.nan), float("nan"))
        if any(f.lost(e) for f, e in zip(self.filters, modes, strict=True)):
            return self.start(y, modes[0].t, w=modes[0].w)
        return self._assessed(modes, probability, y, u_prev)[0]

    def measuring(self, predicted: Estimate, w: ArrayLike | None) -> SwitchingEstimate:
        """The prediction with the disturbances ``w`` ``(n_w,)`` that were measured at its instant."""
        before = self._own(predicted)
        modes = [f.measuring(e, w) for f, e in zip(self.filters, before.modes, strict=True)]
        return _together(modes, before.probability, predicted.innovation, predicted.nis)

    def _own(self, estimate: Estimate) -> SwitchingEstimate:
        if not isinstance(estimate, SwitchingEstimate) or len(estimate.modes) != len(self.filters):
            raise InputError("SwitchingFilter goes on from its own estimates only; begin with start()")
        return estimate


Filter: TypeAlias = ExtendedKalmanFilter | SwitchingFilter
"""A filter on one model: it predicts, corrects, and knows the likelihood of its measurements."""


def _mixed(modes: Sequence[Estimate], share: Array) -> Estimate:
    """One Gaussian with mean and covariance of a mixture."""
    first = modes[0]
    z = np.stack([np.concatenate([e.x, e.h, e.d]) for e in modes])
    mean = share @ z
    off = z - mean
    variances = np.stack([e.P for e in modes])
    p = (share @ variances.reshape(len(share), -1)).reshape(variances.shape[1:]) + (
        off * share[:, None]
    ).T @ off
    n_x, n_z = first.x.size, first.x.size + first.h.size
    empty = np.full(first.innovation.size, np.nan)
    return Estimate(first.t, mean[:n_x], mean[n_x:n_z], mean[n_z:], p, empty, float("nan"), w=first.w)


def _together(
    modes: Sequence[Estimate], probability: Array, innovation: Array, nis: float
) -> SwitchingEstimate:
    m = _mixed(modes, probability)
    return SwitchingEstimate(m.t, m.x, m.h, m.d, m.P, innovation, nis, tuple(modes), probability, w=m.w)


def _stationary(transition: Array) -> Array:
    """Shares ``(m,)`` of its time that the chain spends in each mode."""
    m = len(transition)
    rows = np.vstack([transition.T - np.eye(m), np.ones(m)])
    shares = np.linalg.lstsq(rows, np.append(np.zeros(m), 1.0), rcond=None)[0]
    return np.asarray(np.maximum(shares, 0.0) / np.maximum(shares, 0.0).sum())
