"""Several Kalman filters in parallel with probabilities: quick after a jump, quiet otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.limits import sampled
from hybrid_mpc.model.model import output_with_jacobian

Array = NDArray[np.float64]
NEGLIGIBLE = 0.01
"""Share of a mode's past below which another mode is not mixed in: the large covariance of an improbable jump would
keep the quiet filter from becoming quiet."""
SLIP = 10.0
"""Process noise, over the quiet one, while a machine slips: breakaway of friction, backlash, an impact."""
OUTLIER = 1000.0
"""Sensor noise, over the usual one, of an outlier. Samples count as outliers from 5.1 standard deviations on: there
``exp(-5.1^2 / 2) = 0.002 / 1000``. With 20 that would be 4.3, but a load would be found later, and gross outliers move
the estimate."""
SWITCHES = ((0.9795, 0.02, 0.0005), (0.5, 0.4995, 0.0005), (0.45, 0.05, 0.5))
"""Transition probabilities per period between three modes (quiet, slip, jump). At 50 Hz: a slip every second, a load
change or a fault every 40 s; each lasts one or two periods."""
OUTLIERS = 0.002
"""Probability of an outlier per period: at 50 Hz one every 10 s."""


def with_outliers(transition: ArrayLike) -> Array:
    """Transition probabilities ``(m + 1, m + 1)`` with a further mode, outlier, from those of ``m`` modes.

    No outlier follows another at once: a filter that may ignore several samples also ignores a kick to the machine.

    Example:
        >>> with_outliers([[1.0]]).tolist()
        [[0.998, 0.002], [1.0, 0.0]]
    """
    usual = np.asarray(transition, dtype=float)
    return np.block(
        [[(1.0 - OUTLIERS) * usual, np.full((len(usual), 1), OUTLIERS)], [usual[:1], np.zeros((1, 1))]]
    )


@dataclass(frozen=True)
class SwitchingEstimate(Estimate):
    """Estimates of several filters; the inherited fields are their weighted means.

    Args:
        z: ``(x, h, d)`` of each filter ``(m, n)``.
        covariances: Covariance of each ``(m, n, n)``.
        innovations: Innovation of each ``(m, n_y)``.
        nis_each: Normalised innovation squared of each ``(m,)``.
        probability: Probability of each ``(m,)``.
    """

    z: Array
    covariances: Array
    innovations: Array
    nis_each: Array
    probability: Array

    @property
    def modes(self) -> tuple[Estimate, ...]:
        """The estimate of each filter."""
        n_x, n_z = self.x.size, self.x.size + self.h.size
        each = zip(self.z, self.covariances, self.innovations, self.nis_each.tolist(), strict=True)
        return tuple(
            Estimate(self.t, z[:n_x], z[n_x:n_z], z[n_z:], p, y, nis, w=self.w) for z, p, y, nis in each
        )


class SwitchingFilter:
    """Interacting multiple models: filters on one model that assume different noise.

    A single Kalman filter is either quiet or quick: the step that it allows a disturbance lets it follow a sudden load,
    but also passes the sensor's noise at all times. Here each filter assumes one mode of the noise, a Markov chain
    describes the changes of modes, and the measurements determine the probability of each mode. The object has no
    state, but reuses its buffers: it is not thread-safe.

    Args:
        filters: One filter per mode, on the same model.
        transition: Probability per period ``(m, m)`` of a change from mode i (row) to mode j.

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
        if not m or any(
            f.model is not filters[0].model or type(f) is not ExtendedKalmanFilter for f in filters
        ):
            raise InputError(
                "switching filter: at least one ExtendedKalmanFilter is needed, all on the same model [HM-ESTIMATE-018]"
            )
        if p.shape != (m, m) or np.any(p < 0) or not np.allclose(p.sum(axis=1), 1.0, atol=1e-9):
            raise InputError(
                f"transition: must be probabilities of shape {(m, m)} with rows that sum to 1, got {p.tolist()}"
                " [HM-ESTIMATE-019]"
            )
        model = filters[0].model
        self.model, self.filters, self.transition = model, tuple(filters), p
        self.first_probability = _stationary(p)
        """Probability ``(m,)`` of each mode at the start."""
        n_z = model.n_x + model.n_h
        self._ends, self._on = (model.n_x, n_z), model.disturbed
        noises = [f.noise for f in filters]
        self._noise, self._noise_y = (np.stack(one) for one in zip(*noises, strict=True))
        self._most = np.array([f.most for f in filters])
        self._unit = np.tile(np.eye(n_z + model.n_d), (m, 1, 1))
        self._step, self._output = (
            BufferedFunction(f.map(m)) for f in (model.with_jacobian, output_with_jacobian(model))
        )
        self._step_at, self._output_at = (
            [given.reshape(m, -1) for given in f.inputs] for f in (self._step, self._output)
        )
        self._step_at[4][:] = model.p

    def start(self, y: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None) -> SwitchingEstimate:
        """Estimate at rest at ``y`` ``(n_y,)``; see :meth:`ExtendedKalmanFilter.start`."""
        found = [f.start(y, t, w=w) for f in self.filters]
        z = np.stack([np.concatenate([e.x, e.h, e.d]) for e in found])
        return self._together(
            found[0].t, found[0].w, z, np.stack([e.P for e in found]), self.first_probability
        )

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def predict(self, estimate: Estimate, u: ArrayLike) -> SwitchingEstimate:
        """Estimate one period later with the input ``u`` ``(n_u,)`` held."""
        before = self._own(estimate)
        w = self._w(before, None)
        return self._together(before.t + self.model.dt, w, *self._predicted(before, u))

    def _predicted(self, before: SwitchingEstimate, u: ArrayLike) -> tuple[Array, Array, Array]:
        """``(x, h, d)`` of each filter one period later, their covariances, the filters' probabilities ``(m,)``."""
        m, (n_x, n_z), (on_u, on_x, _) = len(self.filters), self._ends, self._on
        joint = before.probability[:, None] * self.transition
        after = joint.sum(axis=0)
        share = joint / np.where(after > 0, after, 1.0)
        share = np.where(share < NEGLIGIBLE, 0.0, share)
        # of mode i in the past of mode j, (j, i)
        share = np.where(after > 0, share / share.sum(axis=0), np.eye(m)).T
        mean = share @ before.z
        off = before.z - mean[:, None]
        p = (share @ before.covariances.reshape(m, -1)).reshape(before.covariances.shape)
        p = p + (off * share[:, :, None]).transpose(0, 2, 1) @ off
        x, h, v, w, _ = self._step_at
        d = mean[:, n_z:]
        x[:], h[:] = mean[:, :n_x], mean[:, n_x:n_z]
        v[:], w[:] = sampled(u, (self.model.n_u,), "u") + d @ on_u.T, self._w(before, None)
        self._step()
        x_next, h_next, a, b = (found.reshape(m, -1) for found in self._step.outputs)
        f = self._unit.copy()
        f[:, :n_z, :n_z] = a.reshape(m, n_z, n_z).transpose(0, 2, 1)
        f[:, :n_z, n_z:] = b.reshape(m, -1, n_z).transpose(0, 2, 1) @ on_u
        f[:, :n_x, n_z:] += on_x
        p = np.asarray(f @ p @ f.transpose(0, 2, 1))
        p.reshape(m, -1)[:, :: len(self._unit[0]) + 1] += self._noise
        return np.hstack([x_next + d @ on_x.T, h_next, d]), p, after

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> SwitchingEstimate:
        """Estimate after the measurement ``y`` ``(n_y,)``; see :meth:`ExtendedKalmanFilter.correct`."""
        return self.assess(estimate, y, u)[0]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def assess(
        self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None
    ) -> tuple[SwitchingEstimate, float]:
        """:meth:`correct`, and the log-likelihood of the measurement, without its constant."""
        before, y = self._own(estimate), sampled(y, (self.model.n_y,), "y")
        if not np.isfinite(y).any():
            return before, 0.0
        return self._assessed(before.t, before.w, before.z, before.covariances, before.probability, y, u)

    def _assessed(
        self, t: float, w: Array, z: Array, p: Array, probability: Array, y: Array, u: ArrayLike | None
    ) -> tuple[SwitchingEstimate, float]:
        """Estimate after a measurement with at least one finite output, and its log-likelihood."""
        y_hat, c = self._measured(z, u, w)
        y = self.filters[0].nearest(y, probability @ y_hat)  # one sample for all filters
        seen = np.isfinite(y)
        innovations = np.where(seen, y - y_hat, np.nan)
        step, nis, size = np.zeros(z.shape), np.zeros(len(z)), np.zeros(len(z))
        # sequential updates are exact, since the sensors' noises are independent
        for i in np.flatnonzero(seen):
            row, noise = c[:, i], self._noise_y[:, i]
            pc = np.einsum("mij,mj->mi", p, row)
            s = np.sum(row * pc, axis=1) + noise
            gain, error = pc / s[:, None], innovations[:, i] - np.sum(row * step, axis=1)
            i_kc = self._unit - gain[:, :, None] * row[:, None]
            p = i_kc @ p @ i_kc.transpose(0, 2, 1) + (noise[:, None] * gain)[:, :, None] * gain[:, None]
            step, nis, size = step + gain * error[:, None], nis + error / s * error, size + np.log(s)
        p = 0.5 * (p + p.transpose(0, 2, 1))
        likelihood = -0.5 * (nis + size)
        likelihood = np.where(np.isfinite(likelihood), likelihood, -np.inf)
        largest = float(np.max(likelihood))
        weight = probability * np.exp(likelihood - largest)
        if not np.sum(weight) > 0:  # impossible for every filter: no information about the modes
            weight, largest = probability, -np.inf
        share = weight / weight.sum()
        after = self._together(
            t, w, z + step, p, share, probability @ innovations, float(share @ nis), (innovations, nis)
        )
        return after, largest + float(np.log(weight.sum()))

    def _measured(self, z: Array, u: ArrayLike | None, w: Array) -> tuple[Array, Array]:
        """Outputs of each filter ``(m, n_y)`` and their Jacobians by ``(x, h, d)`` ``(m, n_y, n)``."""
        m, n_y, (n_x, n_z), (on_u, _, on_y) = len(z), self.model.n_y, self._ends, self._on
        x, v, held = self._output_at
        d = z[:, n_z:]
        x[:], held[:] = z[:, :n_x], w
        v[:] = (self.model.u0 if u is None else sampled(u, (self.model.n_u,), "u")) + d @ on_u.T
        self._output()
        y, by_x, by_u = self._output.outputs
        c = np.zeros((m, n_y, z.shape[1]))
        c[:, :, :n_x] = by_x.reshape(m, n_x, n_y).transpose(0, 2, 1)
        c[:, :, n_z:] = by_u.reshape(m, -1, n_y).transpose(0, 2, 1) @ on_u + on_y
        return y.reshape(m, n_y) + d @ on_y.T, c

    def innovation_covariance(self, estimate: Estimate, u: ArrayLike | None = None) -> Array:
        """Covariance ``(n_y, n_y)`` of a predicted estimate's innovation, for the mixture."""
        return self.filters[0].innovation_covariance(estimate, u)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what overflows is lost
    def update(
        self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike, *, w: ArrayLike | None = None
    ) -> SwitchingEstimate:
        """:meth:`predict` with the input ``u_prev`` held since, then :meth:`correct` with ``y``; ``w`` as for
        :meth:`ExtendedKalmanFilter.update`.

        A lost prediction is dropped: the estimate restarts from ``y`` if any element of it is finite.
        """
        before, y = self._own(estimate), sampled(y, (self.model.n_y,), "y")
        z, p, probability = self._predicted(before, u_prev)
        t, w = before.t + self.model.dt, self._w(before, w)
        if not np.isfinite(y).any():
            return self._together(t, w, z, p, probability)
        variances = np.diagonal(p, axis1=1, axis2=2)
        if not (np.isfinite(z).all() and np.isfinite(w).all() and (variances <= self._most).all()):
            return self.start(y, t, w=w)
        return self._assessed(t, w, z, p, probability, y, u_prev)[0]

    def measuring(self, predicted: Estimate, w: ArrayLike | None) -> SwitchingEstimate:
        """The prediction with the disturbances ``w`` ``(n_w,)`` measured at its time."""
        before = self._own(predicted)
        return before if w is None else replace(before, w=self._w(before, w))

    def _w(self, estimate: Estimate, w: ArrayLike | None) -> Array:
        return self.filters[0].known_w(estimate, w)

    def _own(self, estimate: Estimate) -> SwitchingEstimate:
        if not isinstance(estimate, SwitchingEstimate) or len(estimate.z) != len(self.filters):
            raise InputError(
                "SwitchingFilter: the estimate is of another filter. Begin with start() of this filter. "
                "[HM-ESTIMATE-020]"
            )
        return estimate

    def _together(
        self, t: float, w: Array, z: Array, p: Array, probability: Array, innovation: Array | None = None,
        nis: float = float("nan"), each: tuple[Array, Array] | None = None,
    ) -> SwitchingEstimate:  # fmt: skip
        """The filters' estimates, and one Gaussian with the mean and covariance of their mixture."""
        n_x, n_z = self._ends
        mean = probability @ z
        off = z - mean
        whole = (probability @ p.reshape(len(z), -1)).reshape(p.shape[1:]) + (
            off * probability[:, None]
        ).T @ off
        if innovation is None or each is None:
            innovation = np.full(self.model.n_y, np.nan)
            each = np.tile(innovation, (len(z), 1)), np.full(len(z), np.nan)
        return SwitchingEstimate(
            t, mean[:n_x], mean[n_x:n_z], mean[n_z:], whole, innovation, nis, z, p, *each, probability, w=w
        )


Filter: TypeAlias = ExtendedKalmanFilter | SwitchingFilter
"""A filter on one model: it predicts, corrects, and computes the likelihood of measurements."""


def _stationary(transition: Array) -> Array:
    """Stationary distribution ``(m,)`` of the Markov chain."""
    m = len(transition)
    rows = np.vstack([transition.T - np.eye(m), np.ones(m)])
    shares = np.linalg.lstsq(rows, np.append(np.zeros(m), 1.0), rcond=None)[0]
    return np.asarray(np.maximum(shares, 0.0) / np.maximum(shares, 0.0).sum())
