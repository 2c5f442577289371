"""Switching filters of many loops on one model at once, in one array: quicker than one by one.

The switching filter takes half the time of a loop, most of it in starting small operations. Here the filters of all
loops go through each operation together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate, output_with_jacobian
from hybrid_mpc.estimation.switching import NEGLIGIBLE, SwitchingEstimate, SwitchingFilter
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.stages import stages

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
LOOKED_AT = 10.0 ** np.arange(-3, 5)
"""Sizes of the states and inputs at which a model's outputs are looked at."""


def measures_first_states(model: HybridModel) -> bool:
    """Whether a model's outputs are its first states, which is all that a :class:`FilterBank` can measure.

    Told by the output and its Jacobian at several points, to the last bit.

    Args:
        model: The model.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> models = [HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level,
        ...     x=x, u=u, x_next=x + u, xdot=u, y=y) for y in (x, 2 * x, x + u)]
        >>> [measures_first_states(model) for model in models]
        [True, False, False]
    """
    n_x, n_u, n_y = model.n_x, model.n_u, model.n_y
    if n_y > n_x:
        return False
    output, rng = output_with_jacobian(model), np.random.default_rng(0)
    for size in LOOKED_AT:
        x, u = size * rng.normal(size=n_x), size * rng.normal(size=n_u)
        y, c_x, c_u = (value.full() for value in output(x, u))
        if not (
            np.array_equal(y.ravel(), x[:n_y]) and np.array_equal(c_x, np.eye(n_y, n_x)) and not c_u.any()
        ):
            return False
    return True


class FilterBank:
    """Switching filters of several loops on one model whose outputs are its first states, step by step together.

    The same arithmetic as :class:`~hybrid_mpc.estimation.SwitchingFilter`, on arrays with a row a loop, and the same
    rules for samples that are missing or absurd and for predictions that are lost; sums are formed in another order,
    so that numbers agree to rounding. Unlike that filter it remembers.

    Args:
        switching: The filter.
        y: First measurements ``(b, n_y)``.

    Raises:
        InputError: If the model's outputs are not its first states; :func:`measures_first_states` tells.

    Example: ``bank = FilterBank(switching, y); estimates = bank.update(y, u)``
    """

    def __init__(self, switching: SwitchingFilter, y: Array) -> None:
        model, self._switching = switching.model, switching
        if not measures_first_states(model):
            raise InputError(
                f"a bank of filters needs a model whose outputs are its first {model.n_y} states; those of "
                f"{model.name} are not: update its SwitchingFilter loop by loop"
            )
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
        seen = np.isfinite(y)
        anew = np.flatnonzero(seen.any(axis=1) & ~self._known())
        innovation, nis = self._correct(y, seen)
        for i in anew.tolist():
            self._begin(i, y[i])
            innovation[i], nis[i] = np.nan, np.nan
        return self.estimates(innovation, nis)

    def _predict(self, u: Array) -> None:
        (b, m, n), n_z = self._z.shape, self._n_z
        joint = self._share[:, :, None] * self._transition
        after = joint.sum(axis=1)
        share = joint / np.where(after > 0, after, 1.0)[:, None, :]
        share[share < NEGLIGIBLE] = 0.0
        share = share / share.sum(axis=1, keepdims=True)
        mixed = np.where(after[:, None, :] > 0, share, np.eye(m))  # what is impossible goes on alone
        weight = mixed.transpose(0, 2, 1)
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

    def _known(self) -> Flags:
        """Whether the predictions of a loop ``(b,)`` are all of them finite and certain enough."""
        largest = np.einsum("bmii->bmi", self._p).max(axis=2)
        limits = np.array([f.limit for f in self._switching.filters])
        finite = np.isfinite(self._z).all(axis=(1, 2))
        return np.asarray(finite & (largest <= limits).all(axis=1))

    def _correct(self, y: Array, seen: Flags) -> tuple[Array, Array]:
        """In Joseph form, one output after the other; what is not ``seen`` changes nothing.

        Returns:
            Innovations ``(b, n_y)`` and normalised innovations squared ``(b,)``; NaN where nothing was measured.
        """
        z, p, n_y = self._z, self._p, y.shape[1]
        there: Flags = np.any(seen, axis=1)
        innovation = np.where(seen[:, None], y[:, None] - z[:, :, :n_y], np.nan)
        step, nis, size = np.zeros_like(z), np.zeros(z.shape[:2]), np.zeros(z.shape[:2])
        for i in range(n_y):
            now, noise = seen[:, i, None], self._noise_y[:, i]
            s = p[:, :, i, i] + noise
            gain = np.where(now, 1.0 / s, 0.0)[..., None] * p[:, :, :, i]
            error = np.where(now, innovation[:, :, i] - step[:, :, i], 0.0)
            p = p - gain[..., :, None] * p[:, :, None, i, :]
            column = (noise[:, None] * gain - p[:, :, :, i])[..., :, None]
            p = p + column * gain[..., None, :]
            step += gain * error[..., None]
            nis, size = nis + error / s * error, size + np.where(now, np.log(s), 0.0)
        before, likelihood = self._share, -0.5 * (nis + size)
        likelihood = np.where(np.isfinite(likelihood), likelihood, -np.inf)
        weight = before * np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
        told = (
            weight.sum(axis=1, keepdims=True) > 0
        )  # else absurd to every filter: it says nothing of the modes
        weight = np.where(told, weight, before)
        share = weight / weight.sum(axis=1, keepdims=True)
        self._share = np.where(there[:, None], share, before)
        self._z = np.where(there[:, None, None], z + step, z)
        self._p = np.where(there[:, None, None, None], 0.5 * (p + p.transpose(0, 1, 3, 2)), self._p)
        mean = (before[:, None, :] @ innovation)[:, 0]
        return mean, np.where(there, (share * nis).sum(axis=1), np.nan)
