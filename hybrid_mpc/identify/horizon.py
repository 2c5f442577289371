"""Most likely trajectory of states and unknown rates over a recording, by nonlinear least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solveh_banded

from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.simulation import stepped, with_unknown_rates
from hybrid_mpc.machine.prior import Equations
from nn_export.vectorised import OnArrays, vectorised

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
AT_ONCE = 256
"""Samples whose equations are evaluated together: arrays of this length stay in a processor's cache."""
STILL = 1e-4
"""Decrease of the cost per sample below which the iteration has converged: each estimate would change by about 1 % of
its standard deviation."""
DAMPED, MORE, LESS = 1.0, 30.0, 10.0
"""First damping (a step of one natural size costs 1), factor after a step that increased the cost, and divisor after a
step that reduced it."""
HELD = 1e15
"""Damping at which the iteration ends."""
PATIENCE = 4
"""Steps without a lower cost before the iteration returns to the best estimate, with more damping. (Almost exact
equations increase the cost of a step, and the next steps reduce it again.)"""
HUBER = 4.0
"""Residual of an output, in standard deviations, above which its loss is linear instead of quadratic; one of 16,000
normal residuals is larger."""
SUSPECT = 1e3
"""Mean square of the residuals above which the iteration is repeated from other starts. The expected value is 1; a
wrong prior gives some hundreds; more means that the iteration did not reach the equations."""
ELASTIC = (1e3, 30.0)
"""Factors on the process noise at first, after another start. With more process noise, a trajectory can pass from one
branch to another if a sensor is ambiguous (``|v|``, ``l sin q``)."""


@dataclass(frozen=True)
class Stretches:
    """Samples of ``b`` trajectories, one after the other.

    Args:
        y: Measured outputs ``(n, n_y)``; NaN for a missing sample.
        censored: +1 for a sample at the upper end of its sensor, -1 at the lower end, else 0, ``(n, n_y)``.
        u: Inputs ``(n, n_u)``.
        w: Disturbances ``(n, n_w)``.
        begins: Indices of the first samples ``(b,)``.
        first: Expected ``(x, d)`` at the first samples ``(b, n_z)``.
    """

    y: Array
    censored: Array
    u: Array
    w: Array
    begins: NDArray[np.intp]
    first: Array

    def of(self, which: Bools) -> tuple[Stretches, Bools]:
        """Select trajectories by a mask ``(b,)``; also return the mask of their samples ``(n,)``."""
        lengths = np.diff([*self.begins, len(self.y)])
        own = np.repeat(which, lengths)
        begins = np.concatenate([[0], np.cumsum(lengths[which])[:-1]]).astype(np.intp)
        y, censored, u, w = (v[own] for v in (self.y, self.censored, self.u, self.w))
        return Stretches(y, censored, u, w, begins, self.first[which]), own


@dataclass(frozen=True)
class Horizon:
    """Most likely ``z_k = (x_k, d_k)`` of all samples of a recording, as in a moving horizon estimator.

    Minimum of ``V(z) = |z_0 - first|^2 / spread^2 + sum_k h((y_k - g(x_k, u_k, w_k)) / sigma)
    + sum_k |z_{k+1} - F(z_k)|^2 / process^2`` with Huber's loss ``h``. ``F`` integrates the equations over a period
    with constant ``d_k``, then ``d`` decays by ``fading``.

    Levenberg-Marquardt steps: the normal equations are block tridiagonal and solved by a banded Cholesky factorization.
    Steps that do not reduce the cost are rejected, and states stay within bounds, so an estimate cannot diverge.

    Args:
        equations: Equations of the prior.
        corrected: Indices of the states whose rates have an unknown ``d`` added.
        p: Parameters ``(n_p,)``.
        dt: Period [s].
        substeps: Runge-Kutta sub-steps a period.
        fading: Decay factor of ``d`` in one period [-].
        sigma: Standard deviations of the sensors' noise ``(n_y,)``.
        process: Standard deviations of the process noise of ``z`` in one period ``(n_z,)``, all positive.
        spread: Standard deviations of the initial ``z`` ``(n_z,)``.
        size: Natural sizes of ``z`` ``(n_z,)``.
        lower: Lower bounds of ``z`` ``(n_z,)``.
        upper: Upper bounds of ``z`` ``(n_z,)``.

    Source: Rao, Rawlings, Mayne, *Constrained state estimation for nonlinear discrete-time systems* (2003); Bell, *The
    iterated Kalman smoother as a Gauss-Newton method* (1994); Sarkka, Svensson, *Levenberg-Marquardt and line-search
    extended Kalman smoothers* (2020); Nocedal, Wright, *Numerical Optimization*, section 10.3.
    """

    equations: Equations
    corrected: tuple[int, ...]
    p: Array
    dt: float
    substeps: int
    fading: float
    sigma: Array
    process: Array
    spread: Array
    size: Array
    lower: Array
    upper: Array

    def solve(self, stretches: Stretches, starts: Sequence[Array]) -> Array:
        """Compute the most likely ``z`` ``(n, n_z)``, from the start ``(n, n_z)`` with the lowest cost.

        If the residuals are then far above the assumed noise, the other starts are tried too, at first with more
        process noise; the result with the lowest cost is used.

        Raises:
            InputError: If the equations are not finite at any start of a trajectory.
        """
        starts = [np.clip(z, self.lower, self.upper) for z in starts]
        first = np.array([_Linearized.at(self, stretches, z, ELASTIC[-1]).cost for z in starts])
        if not np.isfinite(first.min(axis=0)).all():
            raise InputError(
                "prior: its equations are not finite at the start of the smoother. Check its square roots and "
                "logarithms [HM-IDENTIFY-020]"
            )
        lengths = np.diff([*stretches.begins, len(stretches.y)])
        order = np.repeat(np.argsort(first, axis=0, kind="stable"), lengths, axis=1)
        followed = [np.choose(rank[:, None], starts) for rank in order]
        z, cost = self._descend(stretches, followed[0], 1.0)
        expected = np.add.reduceat(np.isfinite(stretches.y).sum(axis=1), stretches.begins)
        suspect = cost > SUSPECT * expected
        if suspect.any():
            own, rows = stretches.of(suspect)
            for other in followed:
                tried = other[rows]
                for factor in ELASTIC:
                    tried = self._descend(own, tried, factor)[0]
                tried, after = self._descend(own, tried, 1.0)
                better = after < cost[suspect]
                z[rows] = np.where(np.repeat(better, lengths[suspect])[:, None], tried, z[rows])
                cost[suspect] = np.minimum(after, cost[suspect])
        return z

    def costs(self, stretches: Stretches, z: Array) -> Array:
        """``V`` of each trajectory ``(b,)`` for ``z`` ``(n, n_z)``; infinite if the equations are not finite."""
        return _Linearized.at(self, stretches, z, 1.0).cost

    def _descend(self, stretches: Stretches, z: Array, factor: float) -> tuple[Array, Array]:
        """Levenberg-Marquardt steps from ``z``, with a factor on the process noise; returns ``z`` and the costs."""
        best = _Linearized.at(self, stretches, z, factor)
        found, cost = z.copy(), best.cost.copy()
        left, own, now, damping = np.arange(len(cost)), stretches, best, np.zeros(len(cost))
        patience = np.zeros(len(cost), dtype=int)
        # maximum Levenberg-Marquardt steps; about a dozen are usual
        for _ in range(60):
            lengths = np.diff([*own.begins, len(own.y)])
            step, gain = now.step(damping)
            after = _Linearized.at(self, own, np.clip(now.z + step, self.lower, self.upper), factor)
            better = after.cost < best.cost
            done = gain < STILL * lengths
            best = best.mixed(after, better)
            patience = np.where(better, PATIENCE, patience - 1)
            on = better | ((patience > 0) & np.isfinite(after.cost))
            now = best.mixed(after, on)
            eased = np.where(damping > DAMPED, damping / LESS, 0.0)
            damping = np.where(better, eased, np.where(on, damping, np.maximum(MORE * damping, DAMPED)))
            patience = np.where(on, patience, PATIENCE)
            done |= damping > HELD
            if done.any():
                mine = stretches.of(np.isin(np.arange(len(cost)), left[done]))[1]
                found[mine], cost[left[done]] = best.z[np.repeat(done, lengths)], best.cost[done]
                if done.all():
                    return found, cost
                best, now, own = best.of(~done), now.of(~done), own.of(~done)[0]
                left, damping, patience = left[~done], damping[~done], patience[~done]
        mine = stretches.of(np.isin(np.arange(len(cost)), left))[1]
        found[mine], cost[left] = best.z, best.cost
        return found, cost


@dataclass(frozen=True)
class _Linearized:
    """The problem linearized along trajectories: costs, gradients, and the blocks of the normal equations (scaled)."""

    horizon: Horizon
    begins: NDArray[np.intp]
    z: Array
    cost: Array
    gradient: Array
    diagonal: Array
    below: Array
    free: Bools

    @classmethod
    def at(cls, horizon: Horizon, own: Stretches, z: Array, factor: float) -> _Linearized:
        """Linearize along ``z`` ``(n, n_z)``, with the process noise times ``factor``."""
        n, n_z = z.shape
        with np.errstate(over="ignore", invalid="ignore"):
            ahead, a, shown, c = horizon_values(horizon, z, own.u, own.w)
            size = horizon.size
            e = np.where(np.isfinite(own.y), (own.y - shown) / horizon.sigma, 0.0)
            used = np.isfinite(own.y) & ~((own.censored != 0) & (own.censored * e < 0))
            e = np.where(used, e, 0.0)
            large = np.abs(e) > HUBER
            weight = np.where(large, HUBER / np.maximum(np.abs(e), HUBER), 1.0)
            loss = np.where(large, HUBER * (2.0 * np.abs(e) - HUBER), e * e).sum(axis=1)
            c = np.where(used[..., None], c * size / horizon.sigma[:, None], 0.0)
            q = factor * horizon.process
            link = np.ones(n, dtype=bool)
            link[own.begins[1:] - 1] = link[-1] = False
            defect = np.zeros((n, n_z))
            defect[:-1] = (z[1:] - ahead[:-1]) / q
            defect[~link] = 0.0
            first = (z[own.begins] - own.first) / horizon.spread
            each = loss + np.square(defect).sum(axis=1)
            each[own.begins] += np.square(first).sum(axis=1)
            cost = np.add.reduceat(each, own.begins)
            cost = np.where(np.isfinite(cost), cost, np.inf)
            flow = np.where(link[:, None, None], a * size / q[:, None], 0.0)
            gradient = -np.einsum("nji,nj->ni", c, weight * e) - np.einsum("nji,nj->ni", flow, defect)
            gradient[1:] += defect[:-1] * (size / q)
            gradient[own.begins] += first * size / horizon.spread
            diagonal = np.swapaxes(c * weight[..., None], 1, 2) @ c + np.swapaxes(flow, 1, 2) @ flow
            ends = np.zeros((n, n_z))
            ends[1:] = np.square(size / q)
            ends[own.begins] = np.square(size / horizon.spread)
            diagonal[:, np.arange(n_z), np.arange(n_z)] += ends
            below = -(size / q)[:, None] * flow
            out = ((z <= horizon.lower) & (gradient > 0)) | ((z >= horizon.upper) & (gradient < 0))
        return cls(horizon, own.begins, z, cost, gradient, diagonal, below, ~out)

    def step(self, damping: Array) -> tuple[Array, Array]:
        """Step ``(n, n_z)`` for a damping ``(b,)``, and the predicted decrease of the costs ``(b,)``."""
        n, n_z = self.gradient.shape
        lengths = np.diff([*self.begins, n])
        every = np.repeat(damping, lengths)
        both = self.free[:, :, None] & self.free[:, None, :]
        diagonal = np.where(both, self.diagonal, 0.0)
        diagonal[:, np.arange(n_z), np.arange(n_z)] += np.where(self.free, every[:, None], 1.0)
        below = self.below.copy()
        below[:-1] *= self.free[1:, :, None] & self.free[:-1, None, :]
        right = np.where(self.free, -self.gradient, 0.0)
        banded = np.zeros((2 * n_z, n, n_z))
        for i in range(n_z):
            for j in range(n_z):
                if i >= j:
                    banded[i - j, :, j] = diagonal[:, i, j]
                banded[n_z + i - j, :, j] = below[:, i, j]
        banded = banded.reshape(2 * n_z, -1)
        scale = 1.0 / np.sqrt(banded[0])  # equilibrate: the diagonal spans many orders of magnitude
        for k in range(2 * n_z):
            banded[k, : n * n_z - k] *= scale[k:] * scale[: n * n_z - k]
        banded[0] += np.finfo(float).eps * 4 * n_z  # rounding may leave a pivot below zero
        try:
            found = solveh_banded(
                banded, right.ravel() * scale, lower=True, overwrite_ab=True, check_finite=False
            )
        except LinAlgError:  # indefinite by rounding: no step now, and more damping in the next one
            return np.full((n, n_z), np.nan), np.full(len(lengths), np.inf)
        step = (found * scale).reshape(n, n_z)
        gain = np.add.reduceat((step * right).sum(axis=1), self.begins)
        return step * self.horizon.size, gain

    def mixed(self, other: _Linearized, which: Bools) -> _Linearized:
        """Replace the trajectories of a mask ``(b,)`` by those of ``other``."""
        if which.all():
            return other
        lengths = np.diff([*self.begins, len(self.z)])
        rows = np.repeat(which, lengths)
        blocks = (
            np.where(rows.reshape(-1, *[1] * (own.ndim - 1)), new, own)
            for own, new in zip(self._blocks, other._blocks, strict=True)
        )
        return self._of(self.begins, np.where(which, other.cost, self.cost), *blocks)

    def of(self, which: Bools) -> _Linearized:
        """Select trajectories by a mask ``(b,)``."""
        lengths = np.diff([*self.begins, len(self.z)])
        begins = np.concatenate([[0], np.cumsum(lengths[which])[:-1]]).astype(np.intp)
        own = np.repeat(which, lengths)
        return self._of(begins, self.cost[which], *(v[own] for v in self._blocks))

    def _of(self, begins: NDArray[np.intp], cost: Array, *blocks: Any) -> _Linearized:
        z, *others = blocks
        return _Linearized(self.horizon, begins, z, cost, *others)

    @property
    def _blocks(self) -> tuple[Array, Array, Array, Array, Bools]:
        return self.z, self.gradient, self.diagonal, self.below, self.free


def horizon_values(horizon: Horizon, z: Array, u: Array, w: Array) -> tuple[Array, Array, Array, Array]:
    """``F(z)``, ``dF/dz``, ``g(x)`` and ``dg/dz`` at all samples ``(n, ...)``."""
    n, n_z = z.shape
    function = _period(
        horizon.equations, horizon.corrected, horizon.dt, horizon.substeps, horizon.fading, AT_ONCE
    )
    given = np.hstack([z, u, w])
    blocks = -(-n // AT_ONCE)
    padded = np.vstack([given, np.repeat(given[-1:], blocks * AT_ONCE - n, axis=0)])
    inputs = np.empty((given.shape[1], AT_ONCE))
    constants = np.repeat(np.asarray(horizon.p, dtype=float)[:, None], AT_ONCE, axis=1)
    found = np.empty((function.size2_out(0), AT_ONCE))
    evaluate = OnArrays(function, [inputs, constants], [found])
    every = np.empty((blocks * AT_ONCE, len(found)))
    for k in range(blocks):
        part = slice(k * AT_ONCE, (k + 1) * AT_ONCE)
        inputs[...] = padded[part].T
        evaluate()
        every[part] = found.T
    n_y = len(horizon.sigma)
    ends = np.cumsum([n_z, n_z * n_z, n_y])
    ahead, a, shown, c = np.split(every[:n], ends, axis=1)
    slopes = (np.swapaxes(v.reshape(n, n_z, -1), 1, 2) for v in (a, c))  # elements come column by column
    a, c = slopes
    return ahead, a, shown, c


@lru_cache(maxsize=32)
def _period(
    equations: Equations, corrected: tuple[int, ...], dt: float, substeps: int, fading: float, n: int
) -> ca.Function:
    """``([z, u, w], p) -> [F, dF/dz, g, dg/dz]`` at ``n`` samples, each a row."""
    xdot = with_unknown_rates(equations.xdot, corrected)
    n_x = equations.xdot.size1_in(0)
    z, u, w, p = (ca.SX.sym(xdot.name_in(i), xdot.size1_in(i)) for i in range(4))
    ahead = stepped(xdot, z, u, w, p, dt, substeps)
    ahead[n_x:] *= fading
    y = equations.output(z[:n_x], u, w, p)
    values = [ahead, ca.jacobian(ahead, z), y, ca.jacobian(y, z)]
    found = ca.vertcat(*(ca.vec(ca.densify(v)) for v in values))
    return vectorised(ca.Function("period", [ca.vertcat(z, u, w), p], ca.cse([found])), n)
