"""Moving horizon estimator: the likeliest trajectory over a window, with bounds and a robust loss.

Over a window of ``m`` periods the estimate is the trajectory ``z_0 .. z_m`` of ``z = (x, h, d)`` that minimizes::

    1/2 |z_0 - first|^2_{P_0^-1}  +  sum rho_w(Q^-1/2 (z_{k+1} - f(z_k, u_k)))  +  sum rho((y_k - g(z_k, u_k)) / sigma)

subject to ``lower <= x_k <= upper``. ``rho`` is Huber's loss, ``e^2 / 2`` up to ``huber`` and linear beyond: outliers.
``rho_w`` is quadratic for ``x`` and ``h``, and Huber's loss with ``jump`` for ``d``: loads that come and go. Components
with neither initial variance nor noise are equality constraints.

**Linearized problem.** One Gauss-Newton step linearizes ``f`` and ``g`` along the last trajectory. With standardized
unknowns ``xi`` (``z_0 = first + L xi_0``, noises ``sqrt(Q) xi_k``) the rows of outputs and bounds are ``X xi``, and the
dual problem has one unknown per row::

    min 1/2 l' (X X' + I) l - e' l    with  |l_i| <= huber for outputs,  l_i >= 0 for bounds (no I there),
                                            |(X' l)_j| <= jump for steps of d

since the conjugate of a quadratic loss with linear tails is the quadratic on an interval, and a bound is a row without
noise. Outliers, bounds and jumps are *one* quadratic program with bounds and rows, which the active-set method of the
controller solves exactly: no reweighting iterations. Then ``xi = X' l``, plus the rows' multipliers for steps of ``d``.

**Why the dual.** 20 periods with z = 32 are 672 unknowns, or 20 to 80 rows. A Riccati recursion costs 40 products of
32 x 32 matrices for each change of an outlier or bound; here the rows are propagated once backwards through the window
(20 small products), and each change costs a factorization of the size of the rows. Neither ``P_0`` nor ``Q`` is
inverted, so hidden states without noise and constant disturbances need no special case.

Sources: Rao, Rawlings, Mayne, *Constrained state estimation for nonlinear discrete-time systems*, IEEE Trans. Automatic
Control 48 (2003): problem and arrival cost; Kühl, Diehl, Kraus, Schlöder, Bock, *A real-time algorithm for moving
horizon state and parameter estimation*, Computers and Chemical Engineering 35 (2011): one step per period; Courtier,
*Dual formulation of four-dimensional variational assimilation*, Q. J. R. Meteorol. Soc. 123 (1997): unknowns in the
space of the measurements; Huber, *Robust estimation of a location parameter*, Ann. Math. Statist. 35 (1964).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter, Sigmas, absorbed
from hybrid_mpc.estimate.roots import root
from hybrid_mpc.model.active_set import Active, ActiveSet, RowQP
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.limits import MOST_ITERATIONS, numbers, sampled, whole
from hybrid_mpc.model.model import HybridModel, output_with_jacobian
from hybrid_mpc.model.stages import stages

Array = NDArray[np.float64]
Scalar = TypeVar("Scalar", bound=np.generic)
HUBER = 2.0
"""Residual, in the sensor's standard deviations, from which the loss is linear."""
JUMP = 3.0
"""Step of a disturbance per period, in its standard deviations, from which the loss is linear."""
MOST_PERIODS = 1000
"""Most periods of a window; its cost grows with their square."""
FARTHEST = 1e100
"""Largest residual, in standard deviations; a larger one has the same effect, and its square is finite."""
NOISE_OF_BOUND = 1e-13
"""Variance of a bound's row, over the variance without measurements: keeps dependent rows solvable."""
STRONGEST = 1e6
"""Largest multiplier of a bound, in its row's standard deviations: contradictory bounds are violated."""
FAR = 1e3
"""Largest residual, over the one from which a sample is an outlier whatever the others show."""
VIOLATED = 1e-9
"""Violation of a bound, in its row's standard deviations, from which its row is added."""
MOST_ADDED = 10
"""Most times that rows of bounds are added in a step."""
ALIKE = 3.0
"""Largest ratio of consecutive outliers on the same side that are no outliers. Of independent outliers, 2 % of the
samples and up to 50 standard deviations, these are fewer than one in 5000 samples."""
ROUNDING = 1e-9
"""Share of the largest multiplier within which it is reached."""
IMPOSSIBLE = 1e5
"""Standardized unknown of a window that its assumptions exclude: an absurd input, or a start at an absurd sample."""
CONVERGED = 1e-9
"""Largest step, in standard deviations of the estimate, of a trajectory that has converged."""


@dataclass(frozen=True)
class WindowEstimate(Estimate):
    """An estimate with its window of ``m`` periods, the oldest first.

    Args:
        z: Trajectory ``(m + 1, n)`` of ``(x, h, d)``; the last is the estimate.
        ys: Measurements ``(m, n_y)`` of all but the first time; NaN where nothing was measured.
        us: Inputs ``(m, n_u)`` held over the periods.
        ws: Measured disturbances ``(m, n_w)`` from the beginning of each period on.
        outliers: Sign of the residuals of ``ys`` with the loss's linear part, 0 for others ``(m, n_y)``.
        first: Mean ``(n,)`` of the arrival cost at the first time, whose measurement it contains.
        first_p: Its covariance ``(n, n)``.
    """

    z: Array
    ys: Array
    us: Array
    ws: Array
    outliers: Active
    first: Array
    first_p: Array


class MovingHorizonEstimator(ExtendedKalmanFilter):
    """Moving horizon estimator over ``(x, h, d)``, for outliers, bounds and jumps of a load; start, noise and restarts
    are those of :class:`ExtendedKalmanFilter`.

    Each sample takes ``iterations`` Gauss-Newton steps on the window. The arrival cost is that of an extended Kalman
    filter linearized along the window's trajectory; a sample that leaves the window as an outlier keeps its bounded
    influence, and a jump its freedom. Bounds do not enter the arrival cost, which for a linear model makes it a lower
    bound of the true one (Rao et al.). For a linear model without bounds and with ``huber=jump=inf`` the estimate is
    the Kalman filter's, for any window.

    The covariance ``P`` is that of the extended Kalman filter along these estimates; a last sample that is an outlier
    does not reduce it. Likelihood, innovation and NIS are those of the prediction.

    Args:
        model: The deployed model. Tracked parameters are states of it
            (:class:`~hybrid_mpc.estimate.tracking.TrackingFilter`).
        periods: Longest window [periods]. Default: 20.
        lower: Lower bounds ``(n_x,)`` of the states; ``-inf`` for none. Default: the signals' ranges, except those of
            periodic signals.
        upper: Upper bounds, likewise.
        huber: Residual in standard deviations from which the loss is linear; ``inf``: no robust loss. Default: 2, with
            which clean samples lose 1 % of their information, and an outlier moves an estimate no further than an
            ordinary error of 2 standard deviations.
        jump: Step of a disturbance per period, in standard deviations, from which the loss is linear; ``inf``: a jump
            is as improbable as its standard deviation says. Default: 3.
        iterations: Most Gauss-Newton steps per sample. Default: 1, the real-time iteration.
        **sigmas: Standard deviations ``sigma_y`` to ``sigma_h0``, as for :class:`ExtendedKalmanFilter`.

    Raises:
        InputError: As :class:`ExtendedKalmanFilter`; if a lower bound is not below its upper bound, ``huber`` or
            ``jump`` is not positive, or ``periods`` or ``iterations`` is out of range.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "m", 0.0),)
        >>> tank = HybridModel.of("tank", 1.0, level, (Signal("u", "m/s"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> mhe = MovingHorizonEstimator(tank, sigma_y=[0.1], sigma_x=[0.1], sigma_x0=[0.1])
        >>> estimate = mhe.update(mhe.start(np.array([0.2])), y=np.array([-0.3]), u_prev=np.array([-0.2]))
        >>> float(estimate.x[0])
        0.0
    """

    def __init__(
        self,
        model: HybridModel,
        *,
        periods: int = 20,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        huber: float = HUBER,
        jump: float = JUMP,
        iterations: int = 1,
        **sigmas: Unpack[Sigmas],
    ) -> None:
        super().__init__(model, **sigmas)
        self.periods = whole(periods, "periods", 1, MOST_PERIODS)
        self.iterations = whole(iterations, "iterations", 1, MOST_ITERATIONS)
        self.huber, self.jump = (
            float(numbers([value], name)[0]) for name, value in (("huber", huber), ("jump", jump))
        )
        if not (self.huber > 0 and self.jump > 0):
            raise InputError(f"huber, jump: must be positive, got {huber} and {jump} [HM-ESTIMATE-028]")
        self.lower, self.upper = _bounds(model, lower, upper)
        self._sigma_y = np.sqrt(self._noise_y)
        self._noisy = np.flatnonzero(self._noise)
        self._sigma = np.sqrt(self._noise[self._noisy])
        jumping = (self._noisy >= model.n_x + model.n_h) & np.isfinite(self.jump)
        self._jumping = np.flatnonzero(jumping)
        self._stages = stages(model, self.periods)
        self._outputs = BufferedFunction(output_with_jacobian(model).map(self.periods))

    def same_on(self, model: HybridModel, **sigmas: Unpack[Sigmas]) -> MovingHorizonEstimator:
        """See :meth:`ExtendedKalmanFilter.same_on`; window, bounds and loss are the same."""
        return MovingHorizonEstimator(
            model, periods=self.periods, lower=self.lower, upper=self.upper, huber=self.huber, jump=self.jump,
            iterations=self.iterations, **sigmas,
        )  # fmt: skip

    def start(self, y: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None) -> WindowEstimate:
        """See :meth:`ExtendedKalmanFilter.start`; the state is moved into its bounds."""
        return self._alone(super().start(y, t, w=w))

    def _alone(self, estimate: Estimate) -> WindowEstimate:
        """The estimate, moved into the bounds, with an empty window, whose arrival cost it is."""
        x = np.clip(estimate.x, self.lower, self.upper)
        z = np.concatenate([x, estimate.h, estimate.d])
        ys, us, ws = (np.zeros((0, size)) for size in (self.model.n_y, self.model.n_u, self.model.n_w))
        return WindowEstimate(
            estimate.t, x, estimate.h, estimate.d, estimate.P, estimate.innovation, estimate.nis, z[None], ys, us, ws,
            ys.astype(np.int8), z, estimate.P, w=estimate.w,
        )  # fmt: skip

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # looked at in update
    def predict(self, estimate: Estimate, u: ArrayLike) -> WindowEstimate:
        """Estimate one period later with the input ``u`` ``(n_u,)`` held; the window contains it without a sample."""
        own = estimate if isinstance(estimate, WindowEstimate) else self._alone(estimate)
        ahead = super().predict(own, u)
        x = np.clip(ahead.x, self.lower, self.upper)
        first, first_p, gone = own.first, own.first_p, int(len(own.ys) >= self.periods)
        if gone:
            first, first_p = self._later(own)
        return WindowEstimate(
            ahead.t, x, ahead.h, ahead.d, ahead.P, ahead.innovation, ahead.nis,
            _and(own.z[gone:], np.concatenate([x, ahead.h, ahead.d])),
            _and(own.ys[gone:], ahead.innovation),  # NaN: nothing is measured yet
            _and(own.us[gone:], sampled(u, (self.model.n_u,), "u")), _and(own.ws[gone:], ahead.w),
            _and(own.outliers[gone:], np.zeros(self.model.n_y, dtype=np.int8)), first, first_p, w=ahead.w,
        )  # fmt: skip

    def _later(self, own: WindowEstimate) -> tuple[Array, Array]:
        """Arrival cost at the window's second time: one period of an extended Kalman filter along the trajectory."""
        w = own.ws[1] if len(own.ws) > 1 else own.w
        before, after = (self._at(own, z, w) for z, w in ((own.z[0], own.ws[0]), (own.z[1], w)))
        u, y = own.us[0], own.ys[0]
        f = self._transition(before, u)
        x, h, *_ = self._step.outputs  # of the next call
        moved = np.concatenate([x + self._on_x @ before.d, h, before.d])
        first = moved + f @ (own.first - own.z[0])
        p = f @ own.first_p @ f.T
        # a jump enters as by the quadratic loss of the same slope: its noise is larger by |step| / (jump sigma)
        noise, on_d = self._noise.copy(), slice(len(x) + len(h), None)
        step = np.abs(own.z[1] - own.z[0])[on_d]
        noise[on_d] = np.maximum(noise[on_d], np.sqrt(noise[on_d]) * step / self.jump)
        p.flat[:: p.shape[0] + 1] += noise
        y_hat, c = self._predicted(after, u)
        innovation, outlier = y - y_hat - c @ (first - own.z[1]), own.outliers[0]
        step, p, *_ = absorbed(p, c, innovation, self._noise_y, np.isfinite(y) & (outlier == 0))
        # gradient of the loss's linear part
        force = np.where(outlier != 0, outlier * self.huber / self._sigma_y, 0.0)
        return first + step + p @ (c.T @ force), p

    def _at(self, own: WindowEstimate, z: Array, w: Array) -> WindowEstimate:
        x, h, d = self._parts(z)
        return replace(own, x=x, h=h, d=d, w=w)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # without a solution it starts anew
    def assess(
        self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None
    ) -> tuple[WindowEstimate, float]:
        """Estimate after the measurement ``y`` ``(n_y,)``, and the log-likelihood of the measurement, without its
        constant. If the window has no solution, or one that its noise makes impossible, the estimate starts anew.
        """
        own = estimate if isinstance(estimate, WindowEstimate) else self._alone(estimate)
        y = sampled(y, (self.model.n_y,), "y")
        if not np.isfinite(y).any():
            return own, 0.0
        if self._turns_y:
            y = self.nearest(y, self._predicted(own, u)[0])
        filtered, likelihood = super().assess(own, y, u)
        if not len(own.ys):
            return self._alone(filtered), likelihood
        ys = own.ys.copy()
        ys[-1] = y
        z, outliers = self._solved(own, ys)
        if not np.isfinite(z).all():
            return self.start(y, own.t, w=own.w), likelihood
        last = outliers[-1] != 0
        p = super().assess(own, np.where(last, np.nan, y), u)[0].P if last.any() else filtered.P
        after = replace(
            self._at(own, z[-1], own.w), P=p, innovation=filtered.innovation, nis=filtered.nis, z=z, ys=ys,
            outliers=outliers,
        )  # fmt: skip
        return after, likelihood

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> WindowEstimate:
        """Estimate after the measurement ``y`` ``(n_y,)``; see :meth:`ExtendedKalmanFilter.correct`."""
        return self.assess(estimate, y, u)[0]

    def _solved(self, own: WindowEstimate, ys: Array) -> tuple[Array, Active]:
        """Trajectory ``(m + 1, n)`` of the window, and the outliers ``(m, n_y)``."""
        z, outliers, first_root = own.z, own.outliers, root(own.first_p)
        if not np.isfinite(first_root).all():
            return np.full_like(z, np.nan), outliers
        size = np.sqrt(np.maximum(np.diag(own.P), 0.0))
        for _ in range(self.iterations):
            last = z
            z, outliers = self._improved(own, ys, last, first_root)
            if not np.isfinite(z).all() or np.all(np.abs(z - last) <= CONVERGED * size):
                break
        return z, outliers

    def _improved(self, own: WindowEstimate, ys: Array, z: Array, first_root: Array) -> tuple[Array, Active]:
        """The linearized problem's solution, and the outliers ``(m, n_y)``."""
        f, defects, y_hat, c = self._linearized(own, z)
        n_x, start, seen = self._sizes[0], own.first - z[0], np.isfinite(ys)
        time, output = np.nonzero(seen)  # sorted by time
        free = _forward(f, defects, start)
        error = (ys - y_hat - (c @ free[1:, :, None])[..., 0]) / self._sigma_y
        e = np.clip(error[seen], -FARTHEST, FARTHEST)
        x = self._back(f, c[seen] / self._sigma_y[output][:, None], time + 1, first_root)
        noise = np.ones(e.size)
        # of two samples, none is known to be the outlier
        huber = np.inf if len(ys) == 1 < self.periods else self.huber
        multipliers, xi, high, e = self._robust(x, e, output, own.outliers[seen], huber)
        low, held = -high, np.zeros((len(z), n_x), dtype=bool)
        for _ in range(MOST_ADDED):
            if not np.abs(xi).max(initial=0.0) < IMPOSSIBLE:
                return np.full_like(z, np.nan), own.outliers
            moved = z + self._moved(f, defects, start, xi, first_root)
            below, above = moved[:, :n_x] < self.lower, moved[:, :n_x] > self.upper
            k, i = np.nonzero((below | above) & ~held)
            if not k.size:
                break
            rows = self._back(f, np.eye(z.shape[1])[i], k, first_root)
            deviation = np.sqrt(np.sum(rows**2, axis=1))
            limit = np.where(above[k, i], self.upper[i], self.lower[i])
            new = np.abs(moved[k, i] - limit) > VIOLATED * deviation
            new &= deviation > 0  # a known state cannot be moved
            if not new.any():
                break
            k, i, deviation, limit = k[new], i[new], deviation[new], limit[new]
            held[k, i] = True
            x = np.vstack([x, rows[new] / deviation[:, None]])
            e = np.append(e, (limit - z[k, i] - free[k, i]) / deviation)
            noise = np.append(noise, np.full(k.size, NOISE_OF_BOUND))
            low = np.append(low, np.where(above[k, i], -STRONGEST, 0.0))
            high = np.append(high, np.where(above[k, i], 0.0, STRONGEST))
            multipliers, xi = self._dual(x, noise, e, low, high)
        moved[:, :n_x] = np.clip(moved[:, :n_x], self.lower, self.upper)  # the QP keeps them within rounding
        outliers = np.zeros(ys.shape, dtype=np.int8)
        found = multipliers[: time.size]
        outliers[seen] = np.where(np.abs(found) >= high[: time.size] * (1 - ROUNDING), np.sign(found), 0.0)
        return moved, outliers

    def _robust(
        self, x: Array, e: Array, output: NDArray[np.int64], last: Active, huber: float
    ) -> tuple[Array, Array, Array, Array]:
        """Multipliers of the measurements without bounds, unknowns ``xi``, the multipliers' limits, and the residuals
        ``e`` without excess.

        The limit is ``huber``, the derivative of the loss's linear part. Where consecutive outliers are alike, the
        estimate is wrong and not the sensor (a first sample that was an outlier, an unknown jump): they have the
        quadratic loss.
        """
        noise, most = np.ones(e.size), np.full(e.size, huber)
        if not np.isfinite(huber):
            return *self._dual(x, noise, e, -most, most), most, e
        h = x @ x.T + np.diag(noise)
        # l_i is at its limit in any case if |e_i| > huber sum_j |h_ij|; larger numbers only cost digits
        far = FAR * huber * np.sum(np.abs(h), axis=1)
        e = np.clip(e, -far, far)
        found, xi = self._dual(x, noise, e, -most, most, last)
        outlier = np.abs(found) >= huber * (1 - ROUNDING)
        released, size = np.zeros(e.size, dtype=bool), np.where(outlier, e, 0.0) / np.sqrt(h.diagonal())
        for i in np.unique(output[outlier]):
            own = np.flatnonzero(output == i)
            released[own] = _in_run(size[own])
        if released.any():
            most[released] = np.inf
            active = np.where(released, 0, np.sign(found) * outlier).astype(np.int8)
            found, xi = self._dual(x, noise, e, -most, most, active)
        return found, xi, most, e

    def _dual(
        self, x: Array, noise: Array, e: Array, low: Array, high: Array, active: Active | None = None
    ) -> tuple[Array, Array]:
        """Solution ``l`` of the dual problem, and unknowns ``xi``; NaN without a finite solution."""
        m = (x.shape[1] - self._noise.size) // max(self._noisy.size, 1)
        columns = self._noise.size + (self._noisy.size * np.arange(m)[:, None] + self._jumping).ravel()
        rows, far = e.size + columns.size, np.full(columns.size, self.jump)
        qp = RowQP(
            x @ x.T + np.diag(noise), -e, x[:, columns].T, np.append(low, -far), np.append(high, far),
            np.full(rows, np.inf), np.zeros(rows),
        )  # fmt: skip
        warm = None if active is None else np.append(active, np.zeros(columns.size, dtype=np.int8))
        found = ActiveSet(qp).solve(warm)
        xi = found.s @ x
        xi[columns] += found.multipliers[e.size :]  # what a jump exceeds the quadratic part by
        return found.s, xi

    def _linearized(self, own: WindowEstimate, z: Array) -> tuple[Array, Array, Array, Array]:
        """Along a trajectory: slopes ``(m, n, n)`` and defects ``(m, n)`` of the periods, outputs ``(m, n_y)`` of all
        but the first time, and their slopes ``(m, n_y, n)``.
        """
        (n_x, n_h, n_d, n_y), m, n_u = self._sizes, len(own.us), self.model.n_u
        n_z, model = n_x + n_h, self.model
        # the functions have the longest window's size
        every = slice(None) if m == self.periods else np.minimum(np.arange(self.periods), m - 1)
        d = z[:-1, n_z:]
        v = [own.us + d @ self._on_u.T, own.ws]
        v += [d @ self._on_x.T] * (model.n_v > n_u + model.n_w)
        z_next, a_t, b = self._stages.at(z[:-1][every, :n_z], np.hstack(v)[every])
        f = np.zeros((m, n_z + n_d, n_z + n_d))
        f[:, :n_z, :n_z], f[:, :n_z, n_z:] = a_t[:m].transpose(0, 2, 1), b[:m] @ self._on_u
        f[:, :n_x, n_z:] += self._on_x
        f[:, n_z:, n_z:] = np.eye(n_d)
        defects = np.hstack([z_next[:m], d]) - z[1:]
        x, u, w = (given.reshape(self.periods, -1) for given in self._outputs.inputs)
        d, ws = z[1:, n_z:], _and(own.ws[1:], own.w)
        x[:], u[:], w[:] = z[1:][every, :n_x], (own.us + d @ self._on_u.T)[every], ws[every]
        self._outputs()
        y, by_x, by_u = self._outputs.outputs
        c = np.zeros((m, n_y, n_z + n_d))
        c[:, :, :n_x] = by_x.reshape(-1, n_x, n_y)[:m].transpose(0, 2, 1)
        c[:, :, n_z:] = by_u.reshape(-1, n_u, n_y)[:m].transpose(0, 2, 1) @ self._on_u + self._on_y
        return f, defects, y.reshape(-1, n_y)[:m] + d @ self._on_y.T, c

    def _back(self, f: Array, rows: Array, time: NDArray[np.int64], first_root: Array) -> Array:
        """Slopes ``(R, n + m n_noisy)`` by ``xi`` of rows ``(R, n)`` of ``z`` at times ``(R,)`` in ascending order."""
        m, count = len(f), len(rows)
        by_z = np.zeros((m + 1, *rows.shape))
        by_z[time, np.arange(count)] = rows
        from_time = np.searchsorted(time, np.arange(m + 1)).tolist()
        for k in range(m, 0, -1):
            later = from_time[k]
            np.matmul(by_z[k, later:], f[k - 1], out=by_z[k - 1, later:])
        noises = by_z[1:, :, self._noisy] * self._sigma
        return np.hstack([by_z[0] @ first_root, noises.transpose(1, 0, 2).reshape(count, -1)])

    def _moved(self, f: Array, defects: Array, first: Array, xi: Array, first_root: Array) -> Array:
        """Step ``(m + 1, n)`` of the trajectory for standardized unknowns."""
        n, noise = len(first), defects.copy()
        noise[:, self._noisy] += xi[n:].reshape(len(f), -1) * self._sigma
        return _forward(f, noise, first + first_root @ xi[:n])


def _and(rows: NDArray[Scalar], row: NDArray[Scalar]) -> NDArray[Scalar]:
    return np.concatenate([rows, row[None]])


def _forward(f: Array, added: Array, first: Array) -> Array:
    """``dz_{k+1} = F_k dz_k + added_k`` from ``first``: ``(m + 1, n)``."""
    dz = np.concatenate([first[None], added])
    for k in range(len(f)):
        dz[k + 1] += f[k] @ dz[k]
    return dz


def _in_run(e: Array) -> NDArray[np.bool_]:
    """Outliers ``(n,)`` of one output beside an outlier of the same side and size; ``e`` is 0 for other samples."""
    one, next_one = e[:-1], e[1:]
    small, large = np.sort(np.abs([one, next_one]), axis=0)
    pair = np.append(False, (np.sign(one) * np.sign(next_one) > 0) & (large <= ALIKE * small))
    return np.asarray(pair | np.append(pair[1:], False))


def _bounds(model: HybridModel, lower: ArrayLike | None, upper: ArrayLike | None) -> tuple[Array, Array]:
    """Bounds ``(n_x,)`` of the states: the given ones, else the ranges of signals that are not periodic."""
    found = []
    for name, given, none in (("lower", lower, -np.inf), ("upper", upper, np.inf)):
        own = [none if s.periodic else getattr(s, name) for s in model.states]
        values = numbers(own if given is None else given, name)
        if values.size != model.n_x:
            raise InputError(f"{name}: must have {model.n_x} values, got {values.size} [HM-ESTIMATE-029]")
        found.append(values)
    if not np.all(found[0] < found[1]):
        raise InputError(
            f"lower, upper: each lower bound must be below its upper bound, got {found[0]} and {found[1]} "
            "[HM-ESTIMATE-030]"
        )
    return found[0], found[1]
