"""Second derivatives of the cost: what Gauss-Newton leaves out, from the model and from the last steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from hybrid_mpc.mpc.condensing import condense_hessians
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.stages import Linearisation

Array = NDArray[np.float64]

SHIFT = 1e-5
"""Step of the difference of two Jacobians, in tolerated deviations (states) and half ranges (inputs)."""
FLOOR = 0.1
"""Least curvature along a direction, as a share of Gauss-Newton's: a step never gets more than ten times longer."""
MATTERS = 0.01
"""Share of Gauss-Newton's largest curvature below which second derivatives are not worth taking anew."""
# Iterations before secants are kept: where the second derivatives are right they have nothing to add.
EARLIEST = 6
MEMORY = 10


class StageCurvature:
    """Second derivatives of the dynamics by states and inputs, weighted with the multipliers of the dynamics.

    Of ``lambda' f(x, h, u)`` the block by ``(x, u)`` is taken, from differences of the model's exact
    Jacobians: ``n_x + n_u`` evaluations of them. The blocks by the hidden state would take ``n_h`` more, and
    a network's hidden state moves smoothly: what curves sharply is friction, and what states and inputs
    drive. Without a hidden state nothing is left out.

    Args:
        stages: The model's stages.
        ocp: The problem; its weights and limits give the length of the differences.
    """

    def __init__(self, stages: Linearisation, ocp: OCP) -> None:
        self._n_x, self._n_u = ocp.n_x, ocp.n_u
        half = 0.5 * (ocp.u_max - ocp.u_min)
        tolerated = 1 / np.sqrt(np.where(ocp.q > 0, ocp.q, 1.0))
        self._shift = SHIFT * np.concatenate([tolerated, np.where(np.isfinite(half), half, 1.0)])
        self._one, self._all = stages.slopes(1), stages.slopes(self._shift.size)

    def of(
        self, z: Array, u: Array, a_t: Array, b: Array, adjoint: Array, old: Array | None = None,
        chosen: Sequence[int] | None = None,
    ) -> Array:  # fmt: skip
        """Curvature ``(N, n_x + n_u, n_x + n_u)`` of every stage.

        Args:
            z: ``(N, n_z)``, where the Jacobians were taken.
            u: ``(N, n_u)``, what the model runs on there.
            a_t: Transposed ``A_k`` ``(N, n_z, n_z)``.
            b: ``B_k`` ``(N, n_z, n_u)``.
            adjoint: Multipliers ``(N, n_z)`` of the stages' results.
            old: Curvature to keep but for the ``chosen`` states and inputs. Default: all is taken.
            chosen: Their numbers, inputs after states.
        """
        n, size, n_x = len(b), self._shift.size, self._n_x
        columns = np.arange(size) if old is None or chosen is None else np.array(chosen, dtype=int)
        curvature = np.empty((n, size, size)) if old is None else old.copy()
        if columns.size:
            here = np.hstack([z[:, :n_x], u])
            moved = np.repeat(here[None], columns.size, axis=0)
            each = np.arange(columns.size)
            moved[each, :, columns] += self._shift[columns, None]
            taken = moved[each, :, columns] - here.T[columns]  # as rounded
            change = self._slopes(moved, z[:, n_x:])
            change -= np.concatenate([a_t[:, :n_x].transpose(0, 2, 1), b], axis=2)
            weighted = (adjoint[:, None, :] @ change)[:, :, 0]
            curvature[:, columns] = (weighted / taken[:, :, None]).transpose(1, 0, 2)
        for j in sorted(set(range(size)) - set(columns.tolist())):
            curvature[:, j, columns] = curvature[:, columns, j]
        return np.asarray(0.5 * (curvature + curvature.transpose(0, 2, 1)))

    def _slopes(self, points: Array, hidden: Array) -> Array:
        """Jacobians ``(m, N, n_z, n_x + n_u)`` at states and inputs ``(m, N, n_x + n_u)``."""
        m, n, size = points.shape
        n_x = self._n_x
        if m == size:
            flat = points.reshape(m * n, size)
            z = np.hstack([flat[:, :n_x], np.tile(hidden, (m, 1))])
            return self._all(z, flat[:, n_x:]).reshape(m, n, -1, size)
        return np.stack([self._one(np.hstack([p[:, :n_x], hidden]), p[:, n_x:]) for p in points])

    def that_matter(self, curvature: Array, from_u: Array, gauss_newton: Array) -> list[int]:
        """States and inputs without whose curvature the Hessian would differ by more than a hundredth."""
        least, size = MATTERS * float(np.max(np.diag(gauss_newton))), self._shift.size
        found = []
        for j in range(size):
            alone = np.zeros_like(curvature)
            alone[:, j], alone[:, :, j] = curvature[:, j], curvature[:, :, j]
            if np.max(np.abs(self.condensed(alone, from_u))) > least:
                found.append(j)
        return found

    def condensed(self, curvature: Array, from_u: Array) -> Array:
        """The stages' curvature as that of the inputs ``(N n_u, N n_u)``; ``from_u`` as in ``Prepared``."""
        return condense_hessians(curvature, from_u, self._n_x)


def convex(gauss_newton: Array, rest: Array) -> Array:
    """``gauss_newton + rest``, positive definite: where the sum curves down or hardly up, its size counts.

    Along every direction the result has at least the share 0.1 of Gauss-Newton's curvature; directions are
    the joint eigenvectors of the two.

    Example:
        >>> convex(np.eye(2), np.diag([1.0, -3.0]))
        array([[2., 0.],
               [0., 2.]])
    """
    whole = gauss_newton + rest
    try:
        np.linalg.cholesky(whole - FLOOR * gauss_newton)
    except np.linalg.LinAlgError:
        pass
    else:
        return np.asarray(whole)
    try:
        values, vectors = eigh(rest, gauss_newton)
    except (np.linalg.LinAlgError, ValueError):
        return gauss_newton
    changed = np.maximum(np.abs(1 + values), FLOOR)
    back = gauss_newton @ vectors
    whole = (back * changed) @ back.T
    return np.asarray(0.5 * (whole + whole.T))


class Secants:
    """What the last steps of one solve have shown of the curvature that is left out."""

    def __init__(self) -> None:
        self.pairs: list[tuple[Array, Array]] = []

    def see(self, step: Array, change: Array, iteration: int, on_soft_bounds: bool) -> None:
        """A step ``(N n_u,)`` and the change of the exact gradient along it."""
        if on_soft_bounds:
            self.pairs = []  # the kink of a penalty is no curvature
        elif iteration > EARLIEST:
            self.pairs = [*self.pairs, (step, change)][-MEMORY:]

    def corrected(self, hessian: Array) -> Array:
        """The Hessian after damped BFGS updates, the oldest first: positive definite as before.

        Source: Nocedal and Wright, *Numerical Optimization*, 2006, procedure 18.2.
        """
        b = hessian
        for s, y in self.pairs:
            bs = b @ s
            sbs, sy = float(s @ bs), float(s @ y)
            if not sbs > 1e-300:
                continue
            if sy < 0.2 * sbs:
                share = 0.8 * sbs / (sbs - sy)
                y = share * y + (1 - share) * bs
                sy = 0.2 * sbs
            b = b - np.outer(bs, bs / sbs) + np.outer(y, y / sy)
        return np.asarray(0.5 * (b + b.T)) if self.pairs else hessian
