"""Second derivatives of the cost that Gauss-Newton neglects, and convexified Hessians."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_triangular

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.problem import BoundRows
from hybrid_mpc.control.rti import condense_all, condense_hessians
from hybrid_mpc.model.stages import Linearization, Slopes

Array = NDArray[np.float64]

SHIFT = 1e-5
"""Step of the finite differences of Jacobians, in sizes of states and hidden states and scales of the inputs."""
FLOOR = 1e-3
"""Least curvature along any direction, over that of Gauss-Newton."""


class StageCurvature:
    """Second derivatives of the dynamics by ``(x, u, h)``, weighted with the multipliers of the dynamics.

    They are finite differences of the model's exact Jacobians: ``n_x + n_u`` evaluations for the block by states and
    inputs, where friction has large curvature, and ``n_h`` for the blocks by the hidden state. Second derivatives of
    bounds, weighted with their multipliers, are added. Steps are scaled by the states' sizes and inputs' limits.
    """

    def __init__(
        self, stages: Linearization, ocp: OCP, sizes: Array, hidden: Array, soft: BoundRows | None = None
    ) -> None:
        self._n_x, self._n_u, self._n_h = ocp.n_x, ocp.n_u, hidden.size
        n_h, self._hidden_shift = hidden.size, SHIFT * hidden
        self._soft = soft if soft is not None and soft.curved else None
        self._shift = SHIFT * np.concatenate([sizes, ocp.input_scale])
        self._stages = stages
        # more than 200 periods a call would not fit into a core's cache
        self._group = min(n_h, max(1, 200 // ocp.horizon))

    @cached_property
    def _by_few(self) -> Slopes:
        """Built with the first plan, so that loading a kit stays fast."""
        return self._stages.slopes(self._shift.size)

    @cached_property
    def _by_hidden(self) -> Slopes:
        return self._stages.slopes(self._group, hidden=True)

    @property
    def size(self) -> int:
        """Number of a stage's states, inputs and hidden states."""
        return self._shift.size + self._n_h

    def fits(self, curvature: Array, horizon: int) -> bool:
        """True for second derivatives that fit this model's stages."""
        return curvature.shape in [(horizon, size, size) for size in (self._shift.size, self.size)]

    def of(
        self, z: Array, u: tuple[Array, Array], a_t: Array, b: Array, adjoint: Array, soft: Array,
        old: Array | None = None, *, e: Array | None = None,
    ) -> Array:  # fmt: skip
        """Curvature ``(N, n, n)`` of every stage by ``(x, u, h)``, or by ``(x, u)`` alone where ``old`` has no more.

        ``u`` are the inputs ``(N, n_u)``, and all that the model runs on ``(N, n_v)``; the Jacobians ``a_t``
        (transposed) and ``b`` were taken at ``z``. ``adjoint`` and ``soft`` are the multipliers of the stages' results
        and of the soft bounds, ``e`` the disturbances that those know of. The hidden part of ``old`` is kept.
        """
        few = self._shift.size
        size = self.size if old is None else old.shape[1]
        curvature = np.empty((len(b), size, size)) if old is None else old.copy()
        curvature[:, :few, :few] = self._few(z[:-1], u[1], a_t, b, adjoint)
        if self._soft is not None and np.any(soft):
            curvature[:, :few, :few] += self._soft.curvature(z[:, : self._n_x], u[0], soft, e)
        if old is None and self._n_h:
            rows = self._hidden(z[:-1], u[1], a_t, b, adjoint)
            curvature[:, few:] = rows
            curvature[:, :few, few:] = rows[:, :, :few].transpose(0, 2, 1)
            curvature[:, few:, few:] = 0.5 * (rows[:, :, few:] + rows[:, :, few:].transpose(0, 2, 1))
        return curvature

    def _few(self, z: Array, v: Array, a_t: Array, b: Array, adjoint: Array) -> Array:
        n, n_x, m = len(b), self._n_x, self._shift.size
        here, more = np.hstack([z[:, :n_x], v[:, : self._n_u]]), v[:, self._n_u :]
        moved = np.repeat(here[None], m, axis=0)
        each = np.arange(m)
        moved[each, :, each] += self._shift[:, None]
        taken = moved[each, :, each] - here.T  # as rounded
        flat = moved.reshape(m * n, m)
        acting = np.hstack([flat[:, n_x:], np.tile(more, (m, 1))])
        slopes = self._by_few(np.hstack([flat[:, :n_x], np.tile(z[:, n_x:], (m, 1))]), acting)
        change = slopes.reshape(m, n, -1, m)
        change -= np.concatenate([a_t[:, :n_x].transpose(0, 2, 1), b], axis=2)
        weighted = (adjoint[:, None, :] @ change)[:, :, 0]
        curvature = (weighted / taken[:, :, None]).transpose(1, 0, 2)
        return np.asarray(0.5 * (curvature + curvature.transpose(0, 2, 1)))

    def _hidden(self, z: Array, u: Array, a_t: Array, b: Array, adjoint: Array) -> Array:
        """The rows of the hidden states ``(N, n_h, n_x + n_u + n_h)``."""
        n, n_x, m = len(b), self._n_x, self._group
        by_z = (a_t @ adjoint[:, :, None])[:, :, 0]
        here = np.hstack([by_z[:, :n_x], (adjoint[:, None, :] @ b)[:, 0], by_z[:, n_x:]])
        rows = np.empty((self._n_h, n, here.shape[1]))
        inputs, weights, each = np.tile(u, (m, 1)), np.tile(adjoint, (m, 1))[:, None, :], np.arange(m)
        for first in range(0, self._n_h, m):
            chosen = (first + each) % self._n_h  # the last group is filled with the first ones
            moved = np.repeat(z[None], m, axis=0)
            moved[each, :, n_x + chosen] += self._hidden_shift[chosen][:, None]
            taken = moved[each, :, n_x + chosen] - z.T[n_x + chosen]
            slopes = (weights @ self._by_hidden(moved.reshape(m * n, -1), inputs)).reshape(m, n, -1)
            rows[chosen] = (slopes - here) / taken[:, :, None]
        return rows.transpose(1, 0, 2)

    def condensed(self, curvature: Array, from_u: Array, by_inputs: Array) -> Array:
        """The stages' curvature as that of the inputs ``(N n_u, N n_u)``; ``by_inputs`` from the ``Condenser``."""
        if curvature.shape[1] > self._shift.size:
            return condense_all(curvature, by_inputs, self._n_x, self._n_u)
        return condense_hessians(curvature, from_u, self._n_x)

    def without_what_is_small(
        self, curvature: Array, gauss_newton: Array, from_u: Array, by_inputs: Array
    ) -> Array:
        """The curvature, without the hidden state's if it hardly affects the Hessian."""
        few = self._shift.size
        if curvature.shape[1] == few:
            return curvature
        small = curvature[:, :few, :few]
        hidden = self.condensed(curvature, from_u, by_inputs) - condense_hessians(small, from_u, self._n_x)
        # along every direction below 20 % of Gauss-Newton's: convergence stays linear, with about this rate
        return small.copy() if _share(gauss_newton, hidden) < 0.2 else curvature


def convex(gauss_newton: Array, rest: Array, held: NDArray[np.bool_] | None = None) -> Array:
    """``gauss_newton + rest``, made positive definite: small or negative curvature is replaced by its absolute value.

    Along every direction the result has at least 0.001 of Gauss-Newton's curvature; directions are the generalised
    eigenvectors of the two. If the sum is convex with the ``held`` unknowns fixed, only their block is changed.
    """
    whole = gauss_newton + rest
    try:
        np.linalg.cholesky(whole - FLOOR * gauss_newton)
    except np.linalg.LinAlgError:
        pass
    else:
        return np.asarray(whole)
    try:
        if held is not None and np.any(held) and not np.all(held):
            return _convex_in_parts(gauss_newton, rest, held)
        return _upwards(gauss_newton, rest)
    except (np.linalg.LinAlgError, ValueError):
        return gauss_newton


def _upwards(gauss_newton: Array, rest: Array) -> Array:
    values, vectors = eigh(rest, gauss_newton)
    changed = np.maximum(np.abs(1 + values), FLOOR)
    back = gauss_newton @ vectors
    whole = (back * changed) @ back.T
    return np.asarray(0.5 * (whole + whole.T))


def _convex_in_parts(gauss_newton: Array, rest: Array, held: NDArray[np.bool_]) -> Array:
    """First the block of the free unknowns, then what of the held ones' is left when the free follow them."""
    free = ~held
    whole = gauss_newton + rest
    inner = convex(gauss_newton[np.ix_(free, free)], rest[np.ix_(free, free)])
    coupling = whole[np.ix_(free, held)]
    follow = coupling.T @ np.linalg.solve(inner, coupling)
    outer = gauss_newton[np.ix_(held, held)]
    left = whole[np.ix_(held, held)] - 0.5 * (follow + follow.T)
    whole[np.ix_(free, free)] = inner
    whole[np.ix_(held, held)] = _upwards(outer, left - outer) + 0.5 * (follow + follow.T)
    return whole


def _share(gauss_newton: Array, rest: Array) -> float:
    """Size of ``rest`` relative to ``gauss_newton``, at least that along any direction."""
    try:
        root = np.linalg.cholesky(gauss_newton)
    except np.linalg.LinAlgError:
        return np.inf
    half = solve_triangular(root, rest, lower=True, check_finite=False)
    return float(np.linalg.norm(solve_triangular(root, half.T, lower=True, check_finite=False)))
