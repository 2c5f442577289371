"""Extended Kalman filter over state, hidden state and unmeasured disturbances; and the oracle's estimator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol, Required, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import nearest_turn
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.limits import sampled, vector
from hybrid_mpc.model.model import HybridModel, output_with_jacobian

Array = NDArray[np.float64]
START_LIMIT = 25
"""Most periods at rest over which the first estimate settles the hidden state: as many as in training.
More would delay a loop's first step. Closed loops with a network depend on this number (docs/results/README.md)."""
FITS = 1e-6
"""Largest squared error of the first outputs, in the sensors' standard deviations, of a state that fits them."""
EXACT = 1e-9
"""Largest error of the first outputs, in the sensors' standard deviations, that is rounding."""
DEPENDENT = 1e-9
"""Singular values below this share of the largest belong to redundant sensors."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of a machine's state at one time.

    Args:
        t: Time [s].
        x: State ``(n_x,)`` [SI].
        h: Hidden state ``(n_h,)`` before ``(x, u)`` at ``t``.
        d: Unmeasured disturbances ``(n_d,)`` in the order of the model's ``disturbance_model``, by default at the
            inputs [input units]: the machine behaves as if its input were ``u + d``.
        P: Covariance of ``(x, h, d)``, ``(n_x + n_h + n_d,) * 2``.
        innovation: Measured minus predicted outputs ``(n_y,)``; NaN where nothing was measured.
        nis: Normalised innovation squared [-], chi-square with n_y degrees of freedom if the filter's assumptions hold;
            NaN without a measurement.
        w: Measured disturbances ``(n_w,)`` from ``t`` on; without a sample the last ones. Default: none.
    """

    t: float
    x: Array
    h: Array
    d: Array
    P: Array
    innovation: Array
    nis: float
    w: Array = field(default_factory=lambda: np.zeros(0), kw_only=True)

    @property
    def finite(self) -> bool:
        """Whether all estimated values are finite."""
        return bool(np.all(np.isfinite(np.concatenate([self.x, self.h, self.d, self.w]))))


class Estimator(Protocol):
    """The methods that a closed loop needs of an estimator; both are pure.

    ``w`` ``(n_w,)`` are the measured disturbances from the sample on, given if and only if the model has any.
    """

    @property
    def model(self) -> HybridModel:
        """The model whose ``(x, h)`` is estimated."""

    def start(self, y: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None) -> Estimate:
        """First estimate from the first measurement."""

    def update(
        self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike, *, w: ArrayLike | None = None
    ) -> Estimate:
        """Estimate one period later, from ``y`` and the input held since."""


class Sigmas(TypedDict, total=False):
    """Standard deviations of a filter: the arguments of :class:`ExtendedKalmanFilter`."""

    sigma_y: Required[ArrayLike]
    sigma_x: Required[ArrayLike]
    sigma_x0: Required[ArrayLike]
    sigma_d: ArrayLike | None
    sigma_d0: ArrayLike | None
    sigma_h: ArrayLike | None
    sigma_h0: ArrayLike | None


class ExtendedKalmanFilter:
    """Extended Kalman filter over ``(x, h, d)`` with the model's exact Jacobian.

    Unmeasured disturbances ``d`` are random walks that act as the model's ``disturbance_model`` says. Measured ones
    ``w`` come with each sample and are held over the period. A network's hidden state follows the state and has no
    noise of its own; hidden states that are parameters have noise
    (:func:`~hybrid_mpc.estimate.parameters.with_parameter_states`). For a linear model this is the Kalman filter. The
    object has no state, but reuses its buffers: it is not thread-safe.

    A sample of a periodic output may be wrapped: it is moved by whole periods to the one nearest to the prediction, so
    estimates have no jumps. A measured disturbance is moved to the last one likewise. The start is as measured.

    A prediction is lost if it is not finite, or a standard deviation is a million times its reference: the larger of
    its first value and its step per period, and for a directly measured state the sensor's deviation (after a long time
    without measurements of an unstable model, or an absurd measurement). The next measurement then restarts the filter.

    Args:
        model: The deployed model.
        sigma_y: Standard deviations of the measurement noise ``(n_y,)``, positive [output units].
        sigma_x: Standard deviations of the process noise per period ``(n_x,)`` [state units].
        sigma_x0: Standard deviations of the first state ``(n_x,)``.
        sigma_d: Standard deviations of the step of ``d`` per period ``(n_d,)`` [their units]. Default: zero.
        sigma_d0: Standard deviations of the first disturbances ``(n_d,)``. Default: zero. Without both, ``d`` stays
            exactly zero.
        sigma_h: Standard deviations of the step of the hidden states per period ``(n_h,)``. Default: zero.
        sigma_h0: Standard deviations of the first hidden states ``(n_h,)``. Default: zero.

    Raises:
        InputError: If a shape does not fit, a standard deviation is negative or not finite, or ``sigma_y`` is 0.

    Source: Simon, *Optimal State Estimation*, 2006, section 13.2; Joseph form of the correction.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> ekf = ExtendedKalmanFilter(model, sigma_y=[0.1], sigma_x=[0.1], sigma_x0=[0.1])
        >>> estimate = ekf.update(ekf.start(np.array([1.0])), y=np.array([1.3]), u_prev=np.zeros(1))
        >>> estimate.x.round(3)
        array([1.2])
    """

    def __init__(
        self,
        model: HybridModel,
        *,
        sigma_y: ArrayLike,
        sigma_x: ArrayLike,
        sigma_x0: ArrayLike,
        sigma_d: ArrayLike | None = None,
        sigma_d0: ArrayLike | None = None,
        sigma_h: ArrayLike | None = None,
        sigma_h0: ArrayLike | None = None,
    ) -> None:
        n_x, n_h, n_d, n_y = model.n_x, model.n_h, model.n_d, model.n_y
        sigma_d = np.zeros(n_d) if sigma_d is None else sigma_d
        sigma_d0 = np.zeros(n_d) if sigma_d0 is None else sigma_d0
        hidden = _variance(np.zeros(n_h) if sigma_h is None else sigma_h, n_h, "sigma_h")
        hidden0 = _variance(np.zeros(n_h) if sigma_h0 is None else sigma_h0, n_h, "sigma_h0")
        variance_y = _variance(sigma_y, n_y, "sigma_y")
        if not np.all(variance_y > 0):
            raise InputError(f"sigma_y: must be positive, got {np.asarray(sigma_y)} [HM-ESTIMATE-006]")
        self.model, self._sizes = model, (n_x, n_h, n_d, n_y)
        self._on_u, self._on_x, self._on_y = model.disturbed
        self._noise_y = variance_y
        self._turn_y = np.array([s.period for s in model.outputs])
        self._turn_w = np.array([s.period for s in model.disturbances])
        self._turns_y, self._turns_w = (
            bool(np.isfinite(turn).any()) for turn in (self._turn_y, self._turn_w)
        )
        self._noise = np.concatenate(
            [_variance(sigma_x, n_x, "sigma_x"), hidden, _variance(sigma_d, n_d, "sigma_d")]
        )
        self._first = np.concatenate(
            [_variance(sigma_x0, n_x, "sigma_x0"), hidden0, _variance(sigma_d0, n_d, "sigma_d0")]
        )
        self._step, self._output = map(BufferedFunction, (model.with_jacobian, output_with_jacobian(model)))
        self._step.inputs[4][:] = model.p
        self._lost = self._most_known()

    @property
    def noise(self) -> tuple[Array, Array]:
        """Variances of the process noise of ``(x, h, d)`` per period ``(n,)``, and of the measurement ``(n_y,)``."""
        return self._noise.copy(), self._noise_y.copy()

    @property
    def first(self) -> Array:
        """Variances of the first ``(x, h, d)`` ``(n,)``."""
        return self._first.copy()

    @property
    def most(self) -> Array:
        """Largest variances of ``(x, h, d)`` ``(n,)`` of an estimate that is not lost; the largest number without a
        limit.
        """
        return self._lost.copy()

    def _most_known(self) -> Array:
        """:attr:`most`, each in its own unit."""
        own = np.maximum(self._noise, self._first)
        by_x = self._measured(self.model.x0, self.model.u0, self.model.w)[1]
        for row, variance in zip(by_x, self._noise_y, strict=True):
            shown = np.flatnonzero(row)
            if shown.size == 1 and np.isfinite(row[shown[0]]):
                own[shown[0]] = max(own[shown[0]], variance / row[shown[0]] ** 2)
        # a variance that grows by 1e12 leaves few correct digits of its covariance: the estimate is lost
        return np.where(own > 0, 1e12 * own, np.finfo(np.float64).max)

    def lost(self, estimate: Estimate) -> bool:
        """Whether an estimate is not finite, or too uncertain to be useful."""
        return not (estimate.finite and np.all(np.diag(estimate.P) <= self._lost))

    def start(self, y: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None) -> Estimate:
        """Estimate at rest: the state closest to the operating point with the output ``y`` ``(n_y,)``; ``d`` is zero.
        Distances are scaled by ``sigma_x0``, so an exactly known state is kept; if all of it is zero, by 1.

        Elements of ``y`` that are not finite are ignored. If several states have the output (``l sin q``, the absolute
        value of a speed), or the output has no slope at the operating point, Newton's method also starts one
        ``sigma_x0`` away from it, and the closest fitting state is taken. The operating point alone determines the
        side; the filter cannot correct it.
        """
        model, u = self.model, self.model.u0
        w = self.known_w(None, w)
        target = sampled(y, (model.n_y,), "y")
        x = self._fitting(model.x0, target, u, w)
        h = hidden_fixed_point(model, x, u, w=w, limit=START_LIMIT)
        empty = np.full(model.n_y, np.nan)
        return Estimate(float(t), x, h, np.zeros(model.n_d), np.diag(self._first), empty, float("nan"), w=w)

    @property
    def nearness(self) -> Array:
        """Scale of distances between first states ``(n_x,)``: ``sigma_x0``; ones if all of it is zero."""
        size = np.sqrt(self._first[: self._sizes[0]])
        return size if np.any(size > 0) else np.ones(size.size)

    def _fitting(self, x0: Array, y: Array, u: Array, w: Array) -> Array:
        """The state ``(n_x,)`` closest to ``x0`` whose output is ``y`` where ``y`` is finite."""
        x, unlike, whole = self._newton(x0, y, u, w)
        if whole and unlike < FITS:
            return x
        spread = np.diag(np.sqrt(self._first[: x0.size]))
        found = [(unlike, x), *(self._newton(x0 + step, y, u, w)[1::-1] for step in (*spread, *-spread))]
        least = min(score for score, _ in found)
        fitting = [x for score, x in found if score <= max(least * (1 + EXACT), FITS)] or [x0]
        size = self.nearness
        return min(fitting, key=lambda x: float(np.sum(((x - x0) / np.where(size > 0, size, 1.0)) ** 2)))

    @np.errstate(over="ignore", invalid="ignore")  # no sensor value may cause a warning
    def _newton(self, x: Array, y: Array, u: Array, w: Array) -> tuple[Array, float, bool]:
        """A state whose output is ``y`` by Newton's method, its squared error in the sensors' standard deviations, and
        whether all steps were full. For outputs linear in the state this is one step.
        """
        seen, whole, size_x, sigma = np.isfinite(y), True, self.nearness, np.sqrt(self._noise_y)

        def lacks(at: Array) -> tuple[Array, Array, float]:
            y_hat, by_x, _ = self._measured(at, u, w)
            error = np.where(seen, y - y_hat, 0.0)
            return error, by_x, float(np.sum(error**2 / self._noise_y))

        error, by_x, size = lacks(x)
        for _ in range(20):
            if not np.all(np.isfinite(by_x)) or np.max(np.abs(error) / sigma) < EXACT:
                break
            rows = np.where(seen[:, None], by_x, 0.0) * size_x / sigma[:, None]
            step = size_x * (np.linalg.pinv(rows, rcond=DEPENDENT) @ (error / sigma))
            for halving in range(60):
                moved = x + step * 0.5**halving
                after = lacks(moved)
                if after[2] < size:
                    break
                if size < FITS:  # only rounding is left
                    return x, size, whole
                whole = False
            else:
                break
            x, (error, by_x, size) = moved, after
        return x, size if np.isfinite(size) else np.inf, whole

    def known_w(self, estimate: Estimate | None, w: ArrayLike | None) -> Array:
        """Measured disturbances ``(n_w,)``: the measured values, else the last ones, else the operating point's."""
        n_w = self.model.n_w
        last = estimate.w if estimate is not None and estimate.w.size == n_w else self.model.w
        if w is None or not n_w:
            return last
        given = sampled(w, (n_w,), "w")
        if self._turns_w and estimate is not None:
            given = nearest_turn(given, last, self._turn_w)
        return np.where(np.isfinite(given), given, last)

    def nearest(self, y: Array, y_hat: Array) -> Array:
        """The sample ``(n_y,)``, periodic outputs moved by whole periods to those nearest to the predicted ones."""
        return nearest_turn(y, y_hat, self._turn_y) if self._turns_y else y

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def predict(self, estimate: Estimate, u: ArrayLike) -> Estimate:
        """Estimate one period later with the input ``u`` ``(n_u,)`` held."""
        z, p = self._following(estimate, u)
        p.flat[:: p.shape[0] + 1] += self._noise
        empty, w = np.full(self.model.n_y, np.nan), self.known_w(estimate, None)
        return Estimate(estimate.t + self.model.dt, *self._parts(z), p, empty, float("nan"), w=w)

    def _following(self, estimate: Estimate, u: ArrayLike) -> tuple[Array, Array]:
        """The next ``(x, h, d)`` ``(n,)``, and its covariance without process noise."""
        f = self._transition(estimate, u)
        x, h, *_ = self._step.outputs  # of the next call
        return np.concatenate([x + self._on_x @ estimate.d, h, estimate.d]), f @ estimate.P @ f.T

    def _parts(self, z: Array) -> tuple[Array, Array, Array]:
        """``x``, ``h`` and ``d`` of a vector ``(x, h, d)``."""
        n_x, n_z = self._sizes[0], self._sizes[0] + self._sizes[1]
        return z[:n_x], z[n_x:n_z], z[n_z:]

    def tangent(self, estimate: Estimate, u: ArrayLike) -> tuple[Array, Array]:
        """Jacobians of the next ``(x, h, d)`` ``(n, n)`` and of the output ``(n_y, n)`` by ``(x, h, d)``."""
        return self._transition(estimate, u), self._predicted(estimate, u)[1]

    def _transition(self, estimate: Estimate, u: ArrayLike) -> Array:
        """Jacobian of the next ``(x, h, d)``; the next ``(x, h)`` without ``d`` is the step's output then."""
        (n_x, n_h, n_d, _), step = self._sizes, self._step
        n_z = n_x + n_h
        step.inputs[0][:], step.inputs[1][:] = estimate.x, estimate.h
        step.inputs[2][:] = sampled(u, (self.model.n_u,), "u") + self._on_u @ estimate.d
        step.inputs[3][:] = self.known_w(estimate, None)
        step()
        _, _, a, b = step.outputs
        f = np.eye(n_z + n_d)
        f[:n_z, :n_z], f[:n_z, n_z:] = a.reshape(n_z, n_z).T, b.reshape(-1, n_z).T @ self._on_u
        f[:n_x, n_z:] += self._on_x
        return f

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> Estimate:
        """Estimate after the measurement ``y`` ``(n_y,)``, in Joseph form; ``u`` is the input of the output equation,
        by default the operating point's.

        Elements of ``y`` that are not finite are left out; if all are, the estimate comes back as it is.
        """
        return self.assess(estimate, y, u)[0]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def assess(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> tuple[Estimate, float]:
        """:meth:`correct`, and the log-likelihood of the measurement, without its constant.

        Source: Schweppe, *Evaluation of likelihood functions for Gaussian signals*, IEEE T-IT 11 (1965).
        """
        y = sampled(y, (self.model.n_y,), "y")
        seen = np.isfinite(y)
        if not seen.any():
            return estimate, 0.0
        innovation, step, p, nis, size = self._corrected(estimate, y, u, seen)
        x, h, d = self._parts(step)
        now = estimate.t, estimate.x + x, estimate.h + h, estimate.d + d
        return Estimate(*now, p, innovation, nis, w=estimate.w), -0.5 * (nis + size)

    def _corrected(
        self, estimate: Estimate, y: Array, u: ArrayLike | None, seen: NDArray[np.bool_]
    ) -> tuple[Array, Array, Array, float, float]:
        """Innovation by the outputs that are ``seen``, and the results of :func:`absorbed`."""
        y_hat, c = self._predicted(estimate, u)
        innovation = np.where(seen, self.nearest(y, y_hat) - y_hat, np.nan)
        return innovation, *absorbed(estimate.P, c, innovation, self._noise_y, seen)

    def same_on(self, model: HybridModel, **sigmas: Unpack[Sigmas]) -> ExtendedKalmanFilter:
        """A filter of the same kind on another model with the same states and outputs.

        ``sigmas`` are the arguments of the constructor.
        """
        return type(self)(model, **sigmas)

    def innovation_covariance(self, estimate: Estimate, u: ArrayLike | None = None) -> Array:
        """Covariance ``(n_y, n_y)`` that a predicted estimate gives its innovation: ``C P C' + R``."""
        _, c = self._predicted(estimate, u)
        s: Array = c @ estimate.P @ c.T + np.diag(self._noise_y)
        return 0.5 * (s + s.T)

    def update(
        self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike, *, w: ArrayLike | None = None
    ) -> Estimate:
        """:meth:`predict` with the input ``u_prev`` held since, then :meth:`correct` with ``y``.

        ``w`` ``(n_w,)`` are the disturbances that were measured along with ``y``; NaN or None: the last ones stay. A
        lost prediction is dropped: the estimate starts anew from ``y`` if any of it is finite.
        """
        predicted = self.measuring(self.predict(estimate, u_prev), w)
        if self.lost(predicted) and np.any(np.isfinite(sampled(y, (self.model.n_y,), "y"))):
            return self.start(y, predicted.t, w=predicted.w)
        return self.correct(predicted, y, u_prev)

    def measuring(self, predicted: Estimate, w: ArrayLike | None) -> Estimate:
        """The prediction with the disturbances ``w`` ``(n_w,)`` that were measured at its instant."""
        return predicted if w is None else replace(predicted, w=self.known_w(predicted, w))

    def _predicted(self, estimate: Estimate, u: ArrayLike | None) -> tuple[Array, Array]:
        """Output ``(n_y,)`` of an estimate and its Jacobian by ``(x, h, d)``."""
        held = self.model.u0 if u is None else sampled(u, (self.model.n_u,), "u")
        y, c_x, c_u = self._measured(estimate.x, held + self._on_u @ estimate.d, self.known_w(estimate, None))
        on_d = c_u @ self._on_u + self._on_y
        return y + self._on_y @ estimate.d, np.hstack([c_x, np.zeros((y.size, self._sizes[1])), on_d])

    def _measured(self, x: Array, u: Array, w: Array) -> tuple[Array, Array, Array]:
        """Output ``(n_y,)`` and its Jacobians by state and input, to be used before the next call."""
        (n_x, _, _, n_y), output = self._sizes, self._output
        output.inputs[0][:], output.inputs[1][:], output.inputs[2][:] = x, u, w
        output()
        y, c_x, c_u = output.outputs
        return y, c_x.reshape(n_x, n_y).T, c_u.reshape(-1, n_y).T

    def run(
        self, y: ArrayLike, u: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None
    ) -> list[Estimate]:
        """Estimates along a measured past, e.g. to warm up.

        Args:
            y: Outputs ``(n, n_y)`` on the model's grid.
            u: Inputs ``(n, n_u)``; ``u[k]`` is held from sample k to k + 1 (the last is not used).
            t: Time of the first sample [s].
            w: Measured disturbances ``(n, n_w)``. Default: those of the operating point.

        Returns:
            ``n`` estimates; number k has seen ``y[:k + 1]``.

        Raises:
            InputError: If the shapes do not fit.
        """
        ys = sampled(y, (None, self.model.n_y), "y")
        n = len(ys)
        if not n:
            raise InputError("y has no samples [HM-ESTIMATE-007]")
        us = sampled(u, (n, self.model.n_u), "u")
        ws = np.tile(self.model.w, (n, 1)) if w is None else sampled(w, (n, self.model.n_w), "w")
        estimates = [self.start(ys[0], t, w=ws[0])]
        for y_k, u_k, w_k in zip(ys[1:], us[:-1], ws[1:], strict=True):
            estimates.append(self.update(estimates[-1], y_k, u_k, w=w_k))
        return estimates


def _variance(sigma: ArrayLike, size: int, name: str) -> Array:
    values = vector(sigma, size, name)
    if np.any(values < 0):
        raise InputError(f"{name} must not be negative, got {values} [HM-ESTIMATE-008]")
    return values**2


def absorbed(
    p: Array, c: Array, innovation: Array, noise: Array, seen: NDArray[np.bool_]
) -> tuple[Array, Array, float, float]:
    """Correction of a mean with the covariance ``p`` ``(n, n)`` by those outputs that are ``seen`` ``(n_y,)``.

    ``c`` ``(n_y, n)`` are the outputs' slopes, ``noise`` ``(n_y,)`` the sensors' variances.

    Returns:
        Step of the mean ``(n,)``, covariance after it (Joseph form), normalised innovation squared, and logarithm of
        the determinant of the innovations' covariance.
    """
    step, nis, size = np.zeros(c.shape[1]), 0.0, 0.0
    for i in np.flatnonzero(seen):  # one by one is exact, since the noises are independent
        pc = p @ c[i]
        s = float(c[i] @ pc) + noise[i]
        gain, error = pc / s, innovation[i] - c[i] @ step
        i_kc = np.eye(step.size) - np.outer(gain, c[i])
        p = i_kc @ p @ i_kc.T + noise[i] * np.outer(gain, gain)
        step, nis, size = step + gain * error, nis + float(error / s * error), size + float(np.log(s))
    return step, 0.5 * (p + p.T), nis, size


class TrueState:
    """The estimator of an oracle: its "measurement" is the plant's truth ``(x, hidden)``.

    :func:`~hybrid_mpc.loop.simulate.simulate` gives it the true states instead of the sensors' outputs.

    Args:
        model: The oracle model, whose hidden states are the plant's own (a prior has none).

    Example:
        >>> from types import SimpleNamespace
        >>> machine = SimpleNamespace(n_x=2, n_h=0, n_d=1, n_y=1, w=np.zeros(0))
        >>> TrueState(machine).start(np.array([0.1, 0.2])).x
        array([0.1, 0.2])
    """

    def __init__(self, model: HybridModel) -> None:
        self.model = model

    def start(self, y: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None) -> Estimate:
        """Estimate that is the truth ``y = (x, hidden)``, ``(n_x + n_h,)`` or longer; ``d`` zero."""
        m, z = self.model, sampled(y, (None,), "the true state")
        n_z = m.n_x + m.n_h
        if z.size < n_z:
            raise InputError(
                f"true state: the plant gives {z.size} states, the oracle model needs {n_z} [HM-ESTIMATE-009]"
            )
        p, empty = np.zeros((n_z + m.n_d, n_z + m.n_d)), np.full(m.n_y, np.nan)
        known = m.w if w is None else sampled(w, (m.n_w,), "w")
        return Estimate(
            float(t), z[: m.n_x], z[m.n_x : n_z], np.zeros(m.n_d), p, empty, float("nan"), w=known
        )

    def predict(self, estimate: Estimate, u: ArrayLike) -> Estimate:
        """The model's own step with ``u`` ``(n_u,)`` held."""
        m = self.model
        x, h = (
            v.full().ravel()
            for v in m.step(estimate.x, estimate.h, sampled(u, (m.n_u,), "u"), estimate.w, m.p)
        )
        return self.start(np.concatenate([x, h]), estimate.t + m.dt, w=estimate.w)

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> Estimate:
        """The truth ``y`` at the estimate's own instant."""
        return self.start(y, estimate.t, w=estimate.w)

    def update(
        self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike, *, w: ArrayLike | None = None
    ) -> Estimate:
        """The truth one period later; ``u_prev`` is not used."""
        return self.start(y, estimate.t + self.model.dt, w=estimate.w if w is None else w)
