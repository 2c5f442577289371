"""Extended Kalman filter over state, hidden state and input disturbance; and the estimator that gets the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.riccati import hidden_fixed_point, vector

Array = NDArray[np.float64]
START_LIMIT = 25
"""Most periods at rest that the first estimate runs the hidden state through: as many as training warms it up on.
Longer makes a loop's first step late. Closed loops with a network depend on it (docs/results/README.md)."""
LOST = 1e12
"""Growth of a variance that leaves few digits of a covariance: nothing is known any more."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of a machine's state at one instant.

    Args:
        t: Time [s].
        x: State ``(n_x,)`` [SI].
        h: Hidden state ``(n_h,)`` before ``(x, u)`` at ``t``.
        d: Input disturbance ``(n_u,)`` [input units]: the machine acts as if its input were ``u + d``.
        P: Covariance of ``(x, h, d)``, ``(n_x + n_h + n_u,) * 2``.
        innovation: Measured minus predicted outputs ``(n_y,)``; NaN where nothing was measured.
        nis: Normalised innovation squared [-], chi-square with n_y degrees of freedom if the filter's assumptions hold;
            NaN without a measurement.
    """

    t: float
    x: Array
    h: Array
    d: Array
    P: Array
    innovation: Array
    nis: float

    @property
    def finite(self) -> bool:
        """Whether all estimated values are finite."""
        return bool(np.all(np.isfinite(np.concatenate([self.x, self.h, self.d]))))


class Estimator(Protocol):
    """What a closed loop needs of an estimator. Both methods are pure."""

    @property
    def model(self) -> HybridModel:
        """The model whose ``(x, h)`` is estimated."""

    def start(self, y: Array, t: float = 0.0) -> Estimate:
        """First estimate from the first measurement."""

    def update(self, estimate: Estimate, y: Array, u_prev: Array) -> Estimate:
        """Estimate one period later, from ``y`` and the input held since."""


class ExtendedKalmanFilter:
    """Extended Kalman filter over ``(x, h, d)`` with the model's exact Jacobian.

    The input disturbance ``d`` is a random walk. A network's hidden state has no noise of its own, it follows the
    state; hidden states that are parameters have (:func:`~hybrid_mpc.estimate.parameters.with_parameter_states`). On a
    linear model this is the Kalman filter. No method changes what the object gives; not for several threads at once (it
    reuses its buffers).

    A prediction is lost if it is not finite, or a deviation is a million times the largest one given here (an unstable
    model long without measurements, an absurd measurement). The next measurement then starts anew.

    Args:
        model: The deployed model.
        sigma_y: Standard deviations of the measurement noise ``(n_y,)``, positive [output units].
        sigma_x: Standard deviations of the process noise per period ``(n_x,)`` [state units].
        sigma_x0: Standard deviations of the first state ``(n_x,)``.
        sigma_d: Standard deviations of the step of ``d`` per period ``(n_u,)`` [input units]. Default: zero.
        sigma_d0: Standard deviations of the first disturbance ``(n_u,)``. Default: zero. Without both ``d`` stays
            exactly zero.
        sigma_h: Standard deviations of the step of the hidden states per period ``(n_h,)``. Default: zero.
        sigma_h0: Standard deviations of the first hidden states ``(n_h,)``. Default: zero.

    Raises:
        InputError: If a shape does not fit, a deviation is negative or not finite, or ``sigma_y`` is 0.

    Source: Simon, *Optimal State Estimation*, 2006, section 13.2; Joseph form of the correction.

    Example:
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
        n_x, n_h, n_u, n_y = model.n_x, model.n_h, model.n_u, model.n_y
        sigma_d = np.zeros(n_u) if sigma_d is None else sigma_d
        sigma_d0 = np.zeros(n_u) if sigma_d0 is None else sigma_d0
        hidden = _variance(np.zeros(n_h) if sigma_h is None else sigma_h, n_h, "sigma_h")
        hidden0 = _variance(np.zeros(n_h) if sigma_h0 is None else sigma_h0, n_h, "sigma_h0")
        variance_y = _variance(sigma_y, n_y, "sigma_y")
        if not np.all(variance_y > 0):
            raise InputError(f"sigma_y must be positive, got {np.asarray(sigma_y)}")
        self.model, self._sizes = model, (n_x, n_h, n_u, n_y)
        self._noise_y = variance_y
        self._noise = np.concatenate(
            [_variance(sigma_x, n_x, "sigma_x"), hidden, _variance(sigma_d, n_u, "sigma_d")]
        )
        self._first = np.concatenate(
            [_variance(sigma_x0, n_x, "sigma_x0"), hidden0, _variance(sigma_d0, n_u, "sigma_d0")]
        )
        self._lost = LOST * max(np.max(v) for v in (self._noise, self._first, self._noise_y))
        assert model.with_jacobian is not None
        self._step, self._output = map(BufferedFunction, (model.with_jacobian, output_with_jacobian(model)))
        self._step.inputs[3][:], self._step.inputs[4][:] = model.w, model.p

    @property
    def noise(self) -> tuple[Array, Array]:
        """Variances of the process noise of ``(x, h, d)`` a period ``(n,)``, and of the measurement ``(n_y,)``."""
        return self._noise.copy(), self._noise_y.copy()

    def lost(self, estimate: Estimate) -> bool:
        """Whether an estimate is not finite, or so uncertain that nothing is known any more."""
        return not (estimate.finite and np.max(np.diag(estimate.P)) <= self._lost)

    def start(self, y: ArrayLike, t: float = 0.0) -> Estimate:
        """Estimate at rest: the smallest state with the output ``y`` ``(n_y,)``, ``d`` zero.

        Elements of ``y`` that are not finite count as the output at the state zero.
        """
        model = self.model
        x, u = np.zeros(model.n_x), np.zeros(model.n_u)
        target = np.asarray(y, dtype=float).ravel()
        for _ in range(20):  # Newton; one step if the outputs are linear in the state
            y_hat, c_x, _ = self._measured(x, u)
            error = np.where(np.isfinite(target), target - y_hat, 0.0)
            if not np.all(np.isfinite(c_x)) or np.max(np.abs(error)) < 1e-12:
                break
            x = x + np.linalg.pinv(c_x) @ error
        h = hidden_fixed_point(model, x, u, limit=START_LIMIT)
        empty = np.full(model.n_y, np.nan)
        return Estimate(float(t), x, h, np.zeros(model.n_u), np.diag(self._first), empty, float("nan"))

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def predict(self, estimate: Estimate, u: ArrayLike) -> Estimate:
        """Estimate one period later with the input ``u`` ``(n_u,)`` held."""
        (n_x, n_h, n_u, n_y), step = self._sizes, self._step
        n_z = n_x + n_h
        step.inputs[0][:], step.inputs[1][:] = estimate.x, estimate.h
        step.inputs[2][:] = np.asarray(u, dtype=float).ravel() + estimate.d
        step()
        x, h, a, b = step.outputs  # of the next call; what is kept of them is copied
        f = np.eye(n_z + n_u)
        f[:n_z, :n_z], f[:n_z, n_z:] = a.reshape(n_z, n_z).T, b.reshape(n_u, n_z).T
        p = f @ estimate.P @ f.T
        p.flat[:: p.shape[0] + 1] += self._noise
        empty = np.full(n_y, np.nan)
        return Estimate(estimate.t + self.model.dt, x.copy(), h.copy(), estimate.d, p, empty, float("nan"))

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> Estimate:
        """Estimate after the measurement ``y`` ``(n_y,)``, in Joseph form; ``u`` is the input of the output equation.

        Elements of ``y`` that are not finite are left out; if all are, the estimate comes back as it is.
        """
        return self.assess(estimate, y, u)[0]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def assess(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> tuple[Estimate, float]:
        """:meth:`correct`, and the log-likelihood of the measurement, without its constant.

        Source: Schweppe, *Evaluation of likelihood functions for Gaussian signals*, IEEE T-IT 11 (1965).
        """
        n_x, n_h, _, n_y = self._sizes
        y = np.asarray(y, dtype=float).ravel()
        seen = np.isfinite(y)
        if not seen.any():
            return estimate, 0.0
        held = estimate.d if u is None else np.asarray(u, dtype=float).ravel() + estimate.d
        y_hat, c_x, c_u = self._measured(estimate.x, held)
        c = np.hstack([c_x, np.zeros((n_y, n_h)), c_u])
        innovation = np.where(seen, y - y_hat, np.nan)
        p, step, nis, size = estimate.P, np.zeros(c.shape[1]), 0.0, 0.0
        for i in np.flatnonzero(seen):  # one by one is exact, since the noises are independent
            pc = p @ c[i]
            s = float(c[i] @ pc) + self._noise_y[i]
            gain, error = pc / s, innovation[i] - c[i] @ step
            i_kc = np.eye(step.size) - np.outer(gain, c[i])
            p = i_kc @ p @ i_kc.T + self._noise_y[i] * np.outer(gain, gain)
            step, nis, size = step + gain * error, nis + float(error / s * error), size + float(np.log(s))
        n_z = n_x + n_h
        x, h, d = estimate.x + step[:n_x], estimate.h + step[n_x:n_z], estimate.d + step[n_z:]
        after = Estimate(estimate.t, x, h, d, 0.5 * (p + p.T), innovation, nis)
        return after, -0.5 * (nis + size)

    def innovation_covariance(self, estimate: Estimate, u: ArrayLike | None = None) -> Array:
        """Covariance ``(n_y, n_y)`` that a predicted estimate gives its innovation: ``C P C' + R``."""
        held = estimate.d if u is None else np.asarray(u, dtype=float).ravel() + estimate.d
        _, c_x, c_u = self._measured(estimate.x, held)
        c = np.hstack([c_x, np.zeros((self.model.n_y, self.model.n_h)), c_u])
        s: Array = c @ estimate.P @ c.T + np.diag(self._noise_y)
        return 0.5 * (s + s.T)

    def update(self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike) -> Estimate:
        """:meth:`predict` with the input ``u_prev`` held since, then :meth:`correct` with ``y``.

        A lost prediction is dropped: the estimate starts anew from ``y`` if any of it is finite.
        """
        predicted = self.predict(estimate, u_prev)
        if self.lost(predicted) and np.any(np.isfinite(np.asarray(y, dtype=float))):
            return self.start(y, predicted.t)
        return self.correct(predicted, y, u_prev)

    def _measured(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Output ``(n_y,)`` and its Jacobians by state and input, to be used before the next call."""
        (n_x, _, n_u, n_y), output = self._sizes, self._output
        output.inputs[0][:], output.inputs[1][:] = x, u
        output()
        y, c_x, c_u = output.outputs
        return y, c_x.reshape(n_x, n_y).T, c_u.reshape(n_u, n_y).T

    def run(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> list[Estimate]:
        """Estimates along a measured past, e.g. to warm up.

        Args:
            y: Outputs ``(n, n_y)`` on the model's grid.
            u: Inputs ``(n, n_u)``; ``u[k]`` is held from sample k to k + 1 (the last is not used).
            t: Time of the first sample [s].

        Returns:
            ``n`` estimates; number k has seen ``y[:k + 1]``.

        Raises:
            InputError: If the shapes do not fit.
        """
        ys, us = np.asarray(y, dtype=float), np.asarray(u, dtype=float)
        n = len(ys)
        if n == 0 or ys.shape != (n, self.model.n_y) or us.shape != (n, self.model.n_u):
            raise InputError(
                f"y {ys.shape} and u {us.shape} given; "
                f"needed: (n, {self.model.n_y}) and (n, {self.model.n_u}) with n > 0"
            )
        estimates = [self.start(ys[0], t)]
        for y_k, u_k in zip(ys[1:], us[:-1], strict=True):
            estimates.append(self.update(estimates[-1], y_k, u_k))
        return estimates


def _variance(sigma: ArrayLike, size: int, name: str) -> Array:
    values = vector(sigma, size, name)
    if np.any(values < 0):
        raise InputError(f"{name} must not be negative, got {values}")
    return values**2


def output_with_jacobian(model: HybridModel) -> ca.Function:
    """Output ``(n_y,)`` of a model at ``(x, u)`` and its dense Jacobians by ``x`` and by ``u``."""
    x, u = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u)
    y = model.output(x, u, model.w, model.p)
    return ca.Function(
        "output_with_jacobian", [x, u], [y, ca.densify(ca.jacobian(y, x)), ca.densify(ca.jacobian(y, u))]
    )


class TrueState:
    """The estimator of an oracle: its "measurement" is the plant's truth ``(x, hidden)``.

    :func:`~hybrid_mpc.loop.simulate.simulate` gives it the true states instead of the sensors' outputs.

    Args:
        model: The oracle model, whose hidden states are the plant's own (a prior has none).

    Example:
        >>> from types import SimpleNamespace
        >>> TrueState(SimpleNamespace(n_x=2, n_h=0, n_u=1, n_y=1)).start(np.array([0.1, 0.2])).x
        array([0.1, 0.2])
    """

    def __init__(self, model: HybridModel) -> None:
        self.model = model

    def start(self, y: ArrayLike, t: float = 0.0) -> Estimate:
        """Estimate that is the truth ``y = (x, hidden)``, ``(n_x + n_h,)`` or longer; ``d`` zero."""
        m, z = self.model, np.asarray(y, dtype=float).ravel()
        n_z = m.n_x + m.n_h
        if z.size < n_z:
            raise InputError(f"true state: the plant gives {z.size} states, the oracle model needs {n_z}")
        p, empty = np.zeros((n_z + m.n_u, n_z + m.n_u)), np.full(m.n_y, np.nan)
        return Estimate(float(t), z[: m.n_x], z[m.n_x : n_z], np.zeros(m.n_u), p, empty, float("nan"))

    def predict(self, estimate: Estimate, u: ArrayLike) -> Estimate:
        """The model's own step with ``u`` ``(n_u,)`` held."""
        m = self.model
        x, h = (
            v.full().ravel() for v in m.step(estimate.x, estimate.h, np.asarray(u, dtype=float), m.w, m.p)
        )
        return self.start(np.concatenate([x, h]), estimate.t + m.dt)

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> Estimate:
        """The truth ``y`` at the estimate's own instant."""
        return self.start(y, estimate.t)

    def update(self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike) -> Estimate:
        """The truth one period later; ``u_prev`` is not used."""
        return self.start(y, estimate.t + self.model.dt)
