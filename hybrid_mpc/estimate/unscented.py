"""Unscented Kalman filter: the model at points spread like the covariance, in place of its slopes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf, dpotrs

from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter, Sigmas
from hybrid_mpc.estimate.roots import root
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.limits import sampled
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]


class UnscentedKalmanFilter(ExtendedKalmanFilter):
    """Unscented Kalman filter over ``(x, h, d)`` by the cubature rule; start, noise and restarts are those of
    :class:`ExtendedKalmanFilter`.

    ``2 n`` points of equal weight lie at ``sqrt(n)`` standard deviations along the columns of a root of the covariance.
    This is the scaled unscented transform with ``alpha = 1, beta = kappa = 0``, and the only one of its kind without a
    point at the mean. Other choices are worse here: ``kappa = 3 - n`` gives the mean a negative weight for ``n > 3``,
    and ``alpha = 1e-3`` weights of a million that cancel; both can make a covariance indefinite. Covariances are sums
    of squares of deviations, so rounding makes none indefinite.

    A prediction evaluates the model at all points in one call, without slopes.

    Args and errors: as for :class:`ExtendedKalmanFilter`.

    Source: Arasaratnam and Haykin, *Cubature Kalman filters*, IEEE Trans. Automatic Control 54 (2009); Wan and van der
    Merwe, *The unscented Kalman filter for nonlinear estimation*, AS-SPCC 2000.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> ukf = UnscentedKalmanFilter(model, sigma_y=[0.1], sigma_x=[0.1], sigma_x0=[0.1])
        >>> estimate = ukf.update(ukf.start(np.array([1.0])), y=np.array([1.3]), u_prev=np.zeros(1))
        >>> estimate.x.round(3)
        array([1.2])
    """

    def __init__(self, model: HybridModel, **sigmas: Unpack[Sigmas]) -> None:
        super().__init__(model, **sigmas)
        many = 2 * self._noise.size
        self._steps = _many_steps(model, many)
        self._outputs = BufferedFunction(model.output.map(many))
        self._outputs.inputs[3].reshape(many, -1)[:] = model.p

    def _following(self, estimate: Estimate, u: ArrayLike) -> tuple[Array, Array]:
        n_x, n_h, _, _ = self._sizes
        w, points = self.known_w(estimate, None), self._points(estimate)
        d = points[:, n_x + n_h :]
        x, h = self._steps(points, sampled(u, (self.model.n_u,), "u") + d @ self._on_u.T, w)
        mean, off = _spread(np.hstack([x + d @ self._on_x.T, h, d]))
        return mean, off.T @ off

    def _corrected(
        self, estimate: Estimate, y: Array, u: ArrayLike | None, seen: NDArray[np.bool_]
    ) -> tuple[Array, Array, Array, float, float]:
        y_hat, of_z, of_y = self._shown(estimate, u)
        of_y, noise = of_y[:, seen], self._noise_y[seen]
        factor, _ = dpotrf(of_y.T @ of_y + np.diag(noise), 1)
        innovation = np.where(seen, self.nearest(y, y_hat) - y_hat, np.nan)
        e = innovation[seen]
        gain = dpotrs(factor, of_y.T @ of_z, 1)[0].T  # K = P_zy S^-1
        rest = of_z - of_y @ gain.T
        p = rest.T @ rest + (gain * noise) @ gain.T  # equal to P - K S K', and never indefinite
        nis = float(e @ dpotrs(factor, e, 1)[0])
        size = 2 * float(np.sum(np.log(np.diag(factor))))
        return innovation, gain @ e, 0.5 * (p + p.T), nis, size

    def innovation_covariance(self, estimate: Estimate, u: ArrayLike | None = None) -> Array:
        """Covariance ``(n_y, n_y)`` of a predicted estimate's innovation."""
        of_y = self._shown(estimate, u)[2]
        return np.asarray(of_y.T @ of_y + np.diag(self._noise_y))

    def _points(self, estimate: Estimate) -> Array:
        """Points ``(2 n, n)``: mean plus and minus ``sqrt(n)`` columns of the covariance's root (equation 37)."""
        own = root(estimate.P).T
        own *= np.sqrt(len(own))
        return np.concatenate([estimate.x, estimate.h, estimate.d]) + np.vstack([own, -own])

    def _shown(self, estimate: Estimate, u: ArrayLike | None) -> tuple[Array, Array, Array]:
        """Mean output ``(n_y,)``; scaled deviations ``(2 n, n)`` of the points and ``(2 n, n_y)`` of their outputs."""
        n_x, n_h, _, n_y = self._sizes
        points, output = self._points(estimate), self._outputs
        many, d = len(points), points[:, n_x + n_h :]
        held = self.model.u0 if u is None else sampled(u, (self.model.n_u,), "u")
        x, v, w, _ = (given.reshape(many, -1) for given in output.inputs)
        x[:], v[:], w[:] = points[:, :n_x], held + d @ self._on_u.T, self.known_w(estimate, None)
        output()
        y_hat, of_y = _spread(output.outputs[0].reshape(many, n_y) + d @ self._on_y.T)
        return y_hat, _spread(points)[1], of_y


def _spread(points: Array) -> tuple[Array, Array]:
    """Mean of points of equal weight, and deviations whose sum of squares is the covariance."""
    mean = points.mean(axis=0)
    return mean, (points - mean) / np.sqrt(len(points))


def _many_steps(model: HybridModel, many: int) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
    """The model's step at many points ``(many, n)``, with inputs ``(many, n_u)`` and disturbances ``(n_w,)``."""
    n_x, n_z = model.n_x, model.n_x + model.n_h
    if model.side_by_side is not None:
        own, p = model.side_by_side(many, {}), np.tile(model.p, (many, 1))

        def together(points: Array, u: Array, w: Array) -> tuple[Array, Array]:
            x, h = own(points[:, :n_x], points[:, n_x:n_z], u, np.tile(w, (many, 1)), p)[:2]
            return x, h

        return together
    step = BufferedFunction(model.step.map(many))
    given = [values.reshape(many, -1) for values in step.inputs]
    given[4][:] = model.p

    def one_by_one(points: Array, u: Array, w: Array) -> tuple[Array, Array]:
        given[0][:], given[1][:], given[2][:], given[3][:] = points[:, :n_x], points[:, n_x:n_z], u, w
        step()
        x, h = (values.reshape(many, -1) for values in step.outputs)
        return x, h

    return one_by_one
