"""Condensing: from the stages' Jacobians to the states as functions of the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dgemv

Array = NDArray[np.float64]
GROUP = 10
"""Periods whose second derivatives are condensed by one product."""


@dataclass(frozen=True)
class Prepared:
    """Everything of an iteration that needs neither the estimate nor the reference.

    With ``dz = (x, h) - (x_bar, h_bar)`` the linearised prediction is ``dz_{k+1} = A_k dz_k + B_k (du_k +
    dd) + defect_k``; of it, ``x`` depends on the inputs by ``from_u``.

    Args:
        u: Linearisation inputs ``(N, n_u)``.
        z: Linearisation trajectory ``(N + 1, n_x + n_h)``.
        d: Linearisation disturbance ``(n_u,)``.
        u_prev: Input ``(n_u,)`` held before the plan.
        a_t: Transposed ``A_k`` ``(N, n_z, n_z)``.
        b: ``B_k`` ``(N, n_z, n_u)``.
        defects: ``(N, n_z)``.
        from_u: Derivative of the states by the inputs ``((N + 1) n_x, N n_u)``.
        weighted: State weights times ``from_u``.
        hessian: Hessian of the cost by ``du`` ``(N n_u, N n_u)``.
        weight: Weight factors ``(N + 1, n_x)``.
        soft: Soft bounds' values ``(M,)``, their derivatives by their state ``(M, n_x)`` and by the inputs
            ``(M, N n_u)``.
        economic: First derivatives ``(N, n_x + n_u)`` of the economic stage costs and their convex second ones;
            None where there are none.
        milliseconds: Time the preparation took.
    """

    u: Array
    z: Array
    d: Array
    u_prev: Array
    a_t: Array
    b: Array
    defects: Array
    from_u: Array
    weighted: Array
    hessian: Array
    weight: Array
    soft: tuple[Array, Array, Array]
    economic: tuple[Array, Array] | None
    milliseconds: float


class Condenser:
    """Derivative of the states by the inputs, on scratch memory of its own: not for several threads at once.

    The products run transposed, on contiguous memory: rows of the scratch arrays are inputs, a period's
    array is written by one product from the one before. They are the condensing's whole arithmetic, ``N^2
    n_u n_z^2`` operations; of the hidden states' derivatives neither cost nor bounds see anything.

    Args:
        n: Periods N.
        n_z: Number of states and hidden states.
        n_u: Number of inputs.
        n_x: Number of states; they come first in z.

    Example:
        >>> Condenser(2, 1, 1, 1)(np.ones((2, 1, 1)), np.ones((2, 1, 1)))
        array([[0., 0.],
               [1., 0.],
               [1., 1.]])
    """

    def __init__(self, n: int, n_z: int, n_u: int, n_x: int) -> None:
        self._by_inputs = np.zeros((n + 1, n * n_u, n_z))  # of z_0 .. z_N; later inputs' rows stay zero
        self._newest = self._by_inputs[1:].reshape(n, n, n_u, n_z)
        self._stages = np.arange(n)
        self._before = [self._by_inputs[k, : k * n_u] for k in range(1, n)]
        self._after = [self._by_inputs[k + 1, : k * n_u] for k in range(1, n)]
        self._states = self._by_inputs[:, :, :n_x].transpose(0, 2, 1)
        self._shape = (n + 1) * n_x, n * n_u

    def __call__(self, a_t: Array, b: Array) -> Array:
        """``((N + 1) n_x, N n_u)`` from transposed ``A_k`` ``(N, n_z, n_z)`` and ``B_k`` ``(N, n_z, n_u)``."""
        self._newest[self._stages, self._stages] = b.transpose(0, 2, 1)
        for before, a, after in zip(self._before, a_t[1:], self._after, strict=True):
            np.dot(before, a, out=after)
        return np.array(self._states, order="C").reshape(
            self._shape
        )  # what is prepared outlives the next call

    @property
    def by_inputs(self) -> Array:
        """Derivatives ``(N + 1, N n_u, n_z)`` of ``z_0 .. z_N`` by the inputs; the next call overwrites them."""
        return self._by_inputs


def propagate(a: Sequence[Array], drift: Array, dz0: Array) -> Array:
    """``dz_{k+1} = A_k dz_k + drift_k`` from ``dz0``: ``(N + 1, n_z)``.

    Args:
        a: ``A_k`` ``(n_z, n_z)``; column by column in memory is fastest.
        drift: ``(N, n_z)``.
        dz0: ``(n_z,)``.

    Example:
        >>> propagate([np.array([[0.5]])] * 2, np.ones((2, 1)), np.zeros(1)).ravel()
        array([0. , 1. , 1.5])
    """
    dz = np.concatenate([dz0[None], drift])
    rows = list(dz)
    for matrix, before, after in zip(a, rows[:-1], rows[1:], strict=True):
        dgemv(1.0, matrix, before, 1.0, after, overwrite_y=1)  # in place: half the time of numpy's two calls
    return dz


def adjoint(a_t: Array, last: Array, stages: Array) -> Array:
    """Multipliers ``(N, n_z)`` of the stages' results: derivative of the cost by ``z_1 .. z_N``.

    Args:
        a_t: Transposed ``A_k`` ``(N, n_z, n_z)``.
        last: Derivative of the terminal cost by ``x_N`` ``(n_x,)``.
        stages: Derivatives of the stage costs by ``x_0 .. x_{N-1}`` ``(N, n_x)``.

    Example:
        >>> adjoint(np.full((2, 1, 1), 0.5), np.ones(1), np.full((2, 1), 3.0)).ravel()
        array([3.5, 1. ])
    """
    n_x = last.size
    multipliers = np.zeros((len(a_t), a_t.shape[1]))
    multipliers[:-1, :n_x] = stages[1:]
    multipliers[-1, :n_x] = last
    backwards = a_t.transpose(0, 2, 1)[:0:-1], multipliers[:0:-1], multipliers[-2::-1]
    for a, after, before in zip(*backwards, strict=True):
        dgemv(1.0, a, after, 1.0, before, trans=1, overwrite_y=1)
    return multipliers


def condense_hessians(stages: Array, from_u: Array, n_x: int) -> Array:
    """Second derivatives by the stages' ``(x, u)`` ``(N, n_x + n_u, n_x + n_u)`` as those by the inputs.

    Example:
        >>> condense_hessians(np.full((1, 2, 2), 3.0), np.array([[0.0], [5.0]]), 1)
        array([[3.]])
    """
    n, size, _ = stages.shape
    n_u = size - n_x
    states = from_u[: n * n_x].reshape(n, n_x, n * n_u)
    by_state = (stages[:, :n_x, :n_x] @ states).reshape(n * n_x, n * n_u)
    by_input = (stages[:, n_x:, :n_x] @ states).reshape(n * n_u, n * n_u)
    total = from_u[: n * n_x].T @ by_state + by_input + by_input.T
    blocks = total.reshape(n, n_u, n, n_u)
    blocks[np.arange(n), :, np.arange(n)] += stages[:, n_x:, n_x:]
    return np.asarray(total)


def condense_all(stages: Array, by_inputs: Array, n_x: int, n_u: int) -> Array:
    """Second derivatives by the stages' ``(x, u, h)`` ``(N, n, n)`` as those by the inputs ``(N n_u, N n_u)``.

    Args:
        stages: Second derivatives.
        by_inputs: Derivatives ``(N + 1, N n_u, n_z)`` of states and hidden states by the inputs.
        n_x: Number of states.
        n_u: Number of inputs.

    Example:
        >>> condense_all(np.full((1, 3, 3), 3.0), np.zeros((2, 1, 2)), 1, 1)
        array([[3.]])
    """
    n, few = len(stages), n_x + n_u
    z = np.r_[:n_x, few : stages.shape[1]]
    by_z, mixed = stages[:, z[:, None], z], stages[:, n_x:few][:, :, z]
    total, one_sided = np.zeros((n * n_u, n * n_u)), np.zeros((n * n_u, n * n_u))
    for first in range(1, n, GROUP):  # the first state knows no input, later ones only those before them
        last = min(first + GROUP, n)
        m = (last - 1) * n_u
        states = np.ascontiguousarray(by_inputs[first:last, :m].transpose(0, 2, 1))
        flat = states.reshape(-1, m)
        total[:m, :m] += flat.T @ (by_z[first:last] @ states).reshape(-1, m)
        one_sided[first * n_u : last * n_u, :m] = (mixed[first:last] @ states).reshape(-1, m)
    total += one_sided + one_sided.T
    total.reshape(n, n_u, n, n_u)[np.arange(n), :, np.arange(n)] += stages[:, n_x:few, n_x:few]
    return total
