"""Smoothing of measured positions with the prior's own equations: states that know where the input jumped."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from hybrid_mpc.data import scales
from hybrid_mpc.data.scales import evenly
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.simulation import with_acceleration
from hybrid_mpc.identify.step import required_substeps
from hybrid_mpc.machine.torch_prior import Prior

Array = NDArray[np.float64]
SWEEPS = 5
"""Linearizations along the smoothed trajectory; the last ones change it by far less than the noise."""
DECADES = (-2.0, 6.0)
"""Range searched for the ratio of walk to sigma [1/s^2, in the machine's seconds]: from a prior that is right to data
that jump."""
IGNORANCE = 1e4
"""Initial standard deviation, as a multiple of the sensor noise's effect over one period."""
SAMPLE = 12
"""At most so many trajectories decide the noise levels."""


@dataclass(frozen=True)
class Smoother:
    """Fixed-interval smoother over ``(q, v, d)``: ``d`` is the acceleration that the prior does not explain.

    ``x_{k+1} = f(x_k, u_k, d_k)`` is the prior integrated over a period with ``d_k`` held, ``d`` walks at
    random, ``y_k = q_k + noise``. A local polynomial smears the jump of a bang-bang input over its length,
    and a network would learn the smear; here the input's part of the motion is known.

    Args:
        prior: The fitted prior.
        dt: Period [s].
        sigma: Standard deviation of the measurement ``(n_q,)`` [output unit].
        walk: Standard deviation of d's change per period ``(n_q,)`` [output unit / s^2].

    Source: Rauch, Tung, Striebel, *Maximum likelihood estimates of linear dynamic systems* (1965); iterated
    linearization: Bell, *The iterated Kalman smoother as a Gauss-Newton method* (1994).
    """

    prior: Prior
    dt: float
    sigma: tuple[float, ...]
    walk: tuple[float, ...]

    def smooth(self, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
        """Every trajectory with ``x`` and ``xdot`` from all of its own samples and from nothing outside it."""
        smoothed: dict[int, Trajectory] = {}
        for group in _by_length(trajectories):
            z, _ = self._estimate(group)
            for i, t, zi in zip(group, group.values(), z, strict=True):
                smoothed[i] = self._with_states(t, zi)
        return [smoothed[i] for i in range(len(trajectories))]

    def innovations(self, trajectories: Sequence[Trajectory]) -> tuple[float, float]:
        """Squared innovations over their variances, and the logarithms of these variances, both summed."""
        sums = [self._estimate(group)[1] for group in _by_length(trajectories)]
        return sum(s[0] for s in sums), sum(s[1] for s in sums)

    def _with_states(self, trajectory: Trajectory, z: Array) -> Trajectory:
        n_x = len(self.prior.states)
        x, d = z[:, :n_x], z[:, n_x:]
        with torch.no_grad():
            a = self.prior.acceleration(torch.tensor(x), torch.tensor(trajectory.u)).numpy() + d
        return replace(trajectory, x=x, xdot=np.hstack([x[:, self.prior.n_q :], a]))

    def _estimate(self, group: dict[int, Trajectory]) -> tuple[Array, tuple[float, float]]:
        """Smoothed ``(q, v, d)`` ``(b, n, 3 n_q)`` of trajectories of one length, and their innovations."""
        y, u = (np.stack([getattr(t, key) for t in group.values()]) for key in ("y", "u"))
        z = np.concatenate([y, np.gradient(y, self.dt, axis=1), np.zeros_like(y)], axis=-1)
        sums = (0.0, 0.0)
        for _ in range(SWEEPS):
            predicted, slope = self._linearize(z[:, :-1], u[:, :-1])
            offset = predicted - (slope @ z[:, :-1, :, None])[..., 0]
            z, sums = self._sweep(offset, slope, y)
        return z, sums

    def _linearize(self, z: Array, u: Array) -> tuple[Array, Array]:
        """Next ``(q, v, d)`` from each ``z`` ``(b, n, 3 n_q)``, and its Jacobian."""
        n_z, p = z.shape[-1], np.array(list(self.prior.values.values()))
        every, _, slope = with_acceleration(self.prior, self.dt).by_all(
            z.reshape(-1, n_z), u.reshape(-1, 1, u.shape[-1]), p, required_substeps(self.prior, self.dt)
        )
        return every[:, 1].reshape(z.shape), slope[:, 1].reshape(*z.shape, n_z)

    def _sweep(self, offset: Array, slope: Array, y: Array) -> tuple[Array, tuple[float, float]]:
        """Kalman filter and Rauch-Tung-Striebel smoother of ``z_{k+1} = slope_k z_k + offset_k + w``."""
        (b, n, n_q), r = y.shape, np.square(self.sigma)
        noise = np.diag(np.concatenate([np.zeros(2 * n_q), np.square(self.walk)]))
        start = np.concatenate([r, r / self.dt**2, np.square(self.walk) + r / self.dt**2])
        z = np.concatenate([y[:, 0], np.zeros((b, 2 * n_q))], axis=-1)
        p = np.broadcast_to(np.diag(IGNORANCE**2 * start), (b, 3 * n_q, 3 * n_q))
        ahead = np.concatenate([z[..., None], p], axis=-1)
        to_next = np.concatenate([slope, np.zeros((b, 1, 3 * n_q, 3 * n_q))], axis=1)
        moved = np.concatenate([offset, np.zeros((b, 1, 3 * n_q))], axis=1)
        given = ahead, y[..., None], to_next, moved[..., None], np.broadcast_to(r[:, None], (b, n_q, 1))
        found = _filter(n_q, n).map(b)(*(_side_by_side(v) for v in given), np.tile(noise, (1, b)))
        later, now, seen = (_apart(v.full(), b, n) for v in found)
        before = np.concatenate([ahead[None], later[:-1]])
        means, covariances = (np.stack([v[..., part] for v in (before, now)]) for part in (0, slice(1, None)))
        errors, variances = seen[..., 0], seen[..., 1:]
        forward = slope.swapaxes(0, 1) @ covariances[1, :-1]
        back = np.linalg.solve(covariances[0, 1:], forward).swapaxes(-1, -2)
        smooth = means[1]
        for k in range(n - 2, -1, -1):
            smooth[k] += (back[k] @ (smooth[k + 1] - means[0, k + 1])[..., None])[..., 0]
        e, s = (
            errors[3:],
            variances[3:],
        )  # three samples end the ignorance of position, velocity and correction
        squares = float(np.sum(e[..., None, :] @ np.linalg.solve(s, e[..., None])))
        return smooth.swapaxes(0, 1), (squares, float(np.linalg.slogdet(s)[1].sum()))


def fit_smoother(
    prior: Prior, trajectories: Sequence[Trajectory], dt: float, *, time_unit: float | None = None
) -> Smoother:
    """Smoother whose noise and walk make the measurements most likely.

    The ratio of walk to noise is searched, the noise's scale follows in closed form. Several outputs keep
    the ratio of noises that their third differences show, and share one ratio of walk to noise.

    Args:
        prior: The fitted prior.
        trajectories: Recordings; at most ``SAMPLE`` of them, evenly chosen, are used.
        dt: Period [s].
        time_unit: The machine's second [s]. Default: that of the trajectories.
    """
    unit = scales.time_unit(trajectories, dt) if time_unit is None else time_unit
    sample = [trajectories[i] for i in evenly(len(trajectories), SAMPLE)]
    sigma = np.maximum(scales.noise_of(sample), 1e-12)
    count = sum((len(t.t) - 3) * t.y.shape[1] for t in sample)

    def at(ratio: float, scale: float = 1.0) -> Smoother:
        levels = scale * sigma, scale * 10.0**ratio * sigma
        return Smoother(prior, dt, *(tuple(float(v) for v in level) for level in levels))

    def cost(ratio: float) -> float:
        squares, logs = at(ratio).innovations(sample)
        return count * math.log(squares / count) + logs

    bounds = [decade - 2.0 * math.log10(unit) for decade in DECADES]
    best = float(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 0.05}).x)
    return at(best, math.sqrt(at(best).innovations(sample)[0] / count))


def _by_length(trajectories: Iterable[Trajectory]) -> list[dict[int, Trajectory]]:
    """Trajectories of equal length together, each under its place in the order given."""
    groups: dict[int, dict[int, Trajectory]] = {}
    for i, trajectory in enumerate(trajectories):
        groups.setdefault(len(trajectory.t), {})[i] = trajectory
    return list(groups.values())


@lru_cache(maxsize=16)
def _filter(n_q: int, n: int) -> ca.Function:
    """Kalman filter over ``n`` samples: what is expected ``[z, P]``, and ``y``, transition, offset, ``r``, noise.

    Gives what is expected of the next sample, the estimates ``[z, P]`` and the innovations ``[e, S]``.
    """
    n_z = 3 * n_q
    ahead, y, at = ca.SX.sym("ahead", n_z, 1 + n_z), ca.SX.sym("y", n_q), ca.SX.sym("at", n_z, n_z)
    offset, r, noise = ca.SX.sym("offset", n_z), ca.SX.sym("r", n_q), ca.SX.sym("noise", n_z, n_z)
    z, p = ahead[:, 0], ahead[:, 1:]
    s, e = p[:n_q, :n_q] + ca.diag(r), y - z[:n_q]
    gain = p[:, :n_q] @ ca.inv(s)
    z, p = z + gain @ e, p - gain @ p[:n_q, :]
    p = 0.5 * (p + p.T)
    later = ca.horzcat(at @ z + offset, at @ p @ at.T + noise)
    period = ca.Function(
        "period",
        [ahead, y, at, offset, r, noise],
        [ca.densify(v) for v in (later, ca.horzcat(z, p), ca.horzcat(e, s))],
    )
    held = [
        ca.MX.sym(f"a{i}", period.size1_in(i), period.size2_in(i) * (n if 0 < i < 4 else 1)) for i in range(6)
    ]
    over = period.mapaccum(n)(*held[:4], ca.repmat(held[4], 1, n), ca.repmat(held[5], 1, n))
    return ca.Function("filter", held, list(over))


def _side_by_side(blocks: Array) -> Array:
    """Matrices ``(..., rows, columns)`` in one row."""
    return np.moveaxis(blocks, -2, 0).reshape(blocks.shape[-2], -1)


def _apart(row: Array, b: int, n: int) -> Array:
    """The matrices ``(n, b, rows, columns)`` of ``b`` trajectories' ``n`` samples in one row."""
    return np.moveaxis(row.reshape(len(row), b, n, -1), (2, 1), (0, 1))
