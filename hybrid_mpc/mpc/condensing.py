"""Condensing: from the stages' Jacobians to the states as functions of the inputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    milliseconds: float


def condense(a_t: Array, b: Array, n_x: int) -> Array:
    """Derivative of the states by the inputs ``((N + 1) n_x, N n_u)``.

    The products run transposed, on contiguous memory: rows of the scratch arrays are inputs. Of the hidden
    states only the last period's derivative is ever kept: neither cost nor bounds see them.

    Args:
        a_t: Transposed ``A_k`` ``(N, n_z, n_z)``.
        b: ``B_k`` ``(N, n_z, n_u)``.
        n_x: Number of states; they come first in z.

    Example:
        >>> condense(np.ones((2, 1, 1)), np.ones((2, 1, 1)), 1)
        array([[0., 0.],
               [1., 0.],
               [1., 1.]])
    """
    n, n_z, n_u = b.shape
    from_u = np.zeros(((n + 1) * n_x, n * n_u))
    now, after = np.empty((n * n_u, n_z)), np.empty((n * n_u, n_z))
    for k in range(n):
        end = k * n_u
        np.matmul(now[:end], a_t[k], out=after[:end])
        after[end : end + n_u] = b[k].T
        from_u[(k + 1) * n_x : (k + 2) * n_x, : end + n_u] = after[: end + n_u, :n_x].T
        now, after = after, now
    return from_u


def propagate(a_t: Array, drift: Array, dz0: Array) -> Array:
    """``dz_{k+1} = A_k dz_k + drift_k`` from ``dz0``: ``(N + 1, n_z)``.

    Example:
        >>> propagate(np.full((2, 1, 1), 0.5), np.ones((2, 1)), np.zeros(1)).ravel()
        array([0. , 1. , 1.5])
    """
    dz = np.empty((len(drift) + 1, dz0.size))
    dz[0] = now = dz0
    for a, add, after in zip(a_t, drift, dz[1:], strict=True):
        np.dot(now, a, out=after)
        after += add
        now = after
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
    n, n_z, _ = a_t.shape
    n_x = last.size
    multipliers = np.zeros((n, n_z))
    now = multipliers[-1]
    now[:n_x] = last
    for k in range(n - 1, 0, -1):
        before = multipliers[k - 1]
        np.dot(a_t[k], now, out=before)
        before[:n_x] += stages[k]
        now = before
    return multipliers
