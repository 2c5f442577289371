"""Switching filters of many loops on one model at once, in one array: quicker than one by one.

The switching filter takes half the time of a loop, most of it in starting small operations. Here the filters of all
loops go through each operation together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.estimation.switching import NEGLIGIBLE, SwitchingEstimate, SwitchingFilter
from hybrid_mpc.mpc.stages import stages

Array = NDArray[np.float64]


class FilterBank:
    """Switching filters of several loops on one model whose outputs are its positions, step by step together.

    The same arithmetic as :class:`~hybrid_mpc.estimation.SwitchingFilter`, on arrays with a row a loop; sums are formed
    in another order, so that numbers agree to rounding. Unlike that filter it remembers.

    Args:
        switching: The filter.
        y: First measurements ``(b, n_y)``.

    Example: ``bank = FilterBank(switching, y); estimates = bank.update(y, u)``
    """

    def __init__(self, switching: SwitchingFilter, y: Array) -> None:
        model, self._switching = switching.model, switching
        self._n_x, self._n_z = model.n_x, model.n_x + model.n_h
        b, m, n = len(y), len(switching.filters), self._n_z + model.n_u
        self._stages = stages(model, b * m)
        self._transition = switching.transition
        self._noise = np.array([f.noise[0] for f in switching.filters])
        self._noise_y = np.array([f.noise[1] for f in switching.filters])
        self._z, self._p, self._share = np.zeros((b, m, n)), np.zeros((b, m, n, n)), np.zeros((b, m))
        self._f = np.tile(np.eye(n), (b * m, 1, 1))
        self._dt, self._t = model.dt, 0.0
        for i, first in enumerate(y):
            self._begin(i, first)

    def _begin(self, i: int, y: Array) -> SwitchingEstimate:
        start = self._switching.start(y, self._t)
        self._z[i] = [np.concatenate([e.x, e.h, e.d]) for e in start.modes]
        self._p[i], self._share[i] = [e.P for e in start.modes], start.probability
        return start

    def estimates(self, innovation: Array, nis: Array) -> list[Estimate]:
        """Means of all loops, weighted by probability; without covariance."""
        mean = (self._share[:, None, :] @ self._z)[:, 0]
        n_x, n_z, none = self._n_x, self._n_z, np.zeros((0, 0))
        return [
            Estimate(self._t, z[:n_x], z[n_x:n_z], z[n_z:], none, e, float(q))
            for z, e, q in zip(mean, innovation, nis, strict=True)
        ]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what is lost begins anew
    def update(self, y: Array, u: Array) -> list[Estimate]:
        """Estimates one period later, from ``y`` ``(b, n_y)`` and the inputs ``u`` ``(b, n_u)`` held since."""
        self._t += self._dt
        self._predict(u)
        lost = [i for i, known in enumerate(self._known()) if not known]
        innovation, nis = self._correct(y)
        for i in lost:
            self._begin(i, y[i])
            innovation[i], nis[i] = np.nan, np.nan
        return self.estimates(innovation, nis)

    def _predict(self, u: Array) -> None:
        (b, m, n), n_z = self._z.shape, self._n_z
        joint = self._share[:, :, None] * self._transition
        after = joint.sum(axis=1)
        share = joint / np.where(after > 0, after, 1.0)[:, None, :]
        share[share < NEGLIGIBLE] = 0.0
        weight = (share / share.sum(axis=1, keepdims=True)).transpose(0, 2, 1)
        z = weight @ self._z
        off = self._z[:, None] - z[:, :, None]
        p = (weight @ self._p.reshape(b, m, n * n)).reshape(b, m, n, n)
        p += (off * weight[..., None]).transpose(0, 1, 3, 2) @ off
        held = (u[:, None] + z[:, :, n_z:]).reshape(b * m, n - n_z)
        following, a_t, by_input = self._stages.at(
            np.ascontiguousarray(z[:, :, :n_z]).reshape(b * m, n_z), held
        )
        f = self._f
        f[:, :n_z, :n_z], f[:, :n_z, n_z:] = a_t.transpose(0, 2, 1), by_input
        p = (f @ p.reshape(b * m, n, n) @ f.transpose(0, 2, 1)).reshape(b, m, n, n)
        diagonal = np.arange(n)
        p[:, :, diagonal, diagonal] += self._noise
        z[:, :, :n_z] = following.reshape(b, m, n_z)
        self._z, self._p, self._share = z, p, after

    def _known(self) -> list[bool]:
        filters, ok = self._switching.filters, np.isfinite(self._z).all(axis=(1, 2))
        largest = np.einsum("bmii->bmi", self._p).max(axis=2)
        limits = np.array([f.limit for f in filters])
        return [bool(v) for v in ok & (largest <= limits).all(axis=1)]

    def _correct(self, y: Array) -> tuple[Array, Array]:
        """In Joseph form, one output after the other; a missing one changes nothing."""
        z, p, n_y = self._z, self._p, y.shape[1]
        innovation = y[:, None, :] - z[:, :, :n_y]
        step, nis, size = np.zeros_like(z), np.zeros(z.shape[:2]), np.zeros(z.shape[:2])
        for i in range(n_y):
            seen = np.isfinite(innovation[:, :, i])
            noise = self._noise_y[:, i]
            s = p[:, :, i, i] + noise
            gain = np.where(seen, 1.0 / s, 0.0)[..., None] * p[:, :, :, i]
            error = np.where(seen, innovation[:, :, i] - step[:, :, i], 0.0)
            p = p - gain[..., :, None] * p[:, :, None, i, :]
            column = (noise[:, None] * gain - p[:, :, :, i])[..., :, None]
            p = p + column * gain[..., None, :]
            step += gain * error[..., None]
            nis, size = nis + error**2 / s, size + np.where(seen, np.log(s), 0.0)
        before, likelihood = self._share, -0.5 * (nis + size)
        weight = before * np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
        self._share = weight / weight.sum(axis=1, keepdims=True)
        self._z, self._p = z + step, 0.5 * (p + p.transpose(0, 1, 3, 2))
        return (before[:, None, :] @ innovation)[:, 0], (self._share * nis).sum(axis=1)
