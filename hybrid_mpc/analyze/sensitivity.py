"""Sensitivities of a free run to the parameters of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sensitivities:
    """A free run ``x`` ``(n + 1, n_x)`` and its derivatives ``by`` ``(n + 1, n_x, n_p)`` with respect to parameters."""

    names: tuple[str, ...]
    values: Array
    x: Array
    by: Array

    @property
    def relative(self) -> Array:
        """Change of the states per relative change of each parameter (1 is 100 %), ``(n + 1, n_x, n_p)``."""
        return self.by * self.values

    def apart(self, sigma: ArrayLike) -> Sensitivities:
        """Select the parameters that are identifiable together from this run, by a pivoted QR decomposition.

        Each step selects the parameter whose effect has the largest part that the selected ones do not explain. A
        parameter is left out if less than 5 % of its effect is independent of the selected ones.

        Args:
            sigma: Standard deviation of each state's error ``(n_x,)``; infinite for states that are not measured.
        """
        rows = self._rows(sigma)
        size = np.linalg.norm(rows, axis=0)
        some = np.flatnonzero(size > 0)
        _, r, order = qr(rows[:, some] / size[some], mode="economic", pivoting=True)
        keep = np.sort(some[order[: len(r)][np.abs(np.diag(r)) > 0.05]])
        return Sensitivities(
            tuple(self.names[i] for i in keep), self.values[keep], self.x, self.by[:, :, keep]
        )

    def _rows(self, sigma: ArrayLike) -> Array:
        return np.asarray(
            (self.relative / np.asarray(sigma, dtype=float)[None, :, None]).reshape(-1, len(self.names))
        )

    def correlation(self, sigma: ArrayLike) -> Array:
        """Correlation ``(n_p, n_p)`` of the parameters' errors in a least-squares fit of this run.

        Two parameters with a correlation near 1 or -1 are not identifiable one by one.

        Args:
            sigma: As in :meth:`apart`.

        Raises:
            InputError: If the parameters are not identifiable together from this run.
        """
        rows = self._rows(sigma)
        size = np.linalg.norm(rows, axis=0)
        scaled = rows / np.where(size > 0, size, 1.0)
        if np.any(size == 0) or np.linalg.cond(scaled) > 1e7:
            raise InputError(
                f"sensitivities: {', '.join(self.names)} are not identifiable together in this run. Leave some out "
                "(only the product of two parameters may be identifiable) [HM-ANALYZE-055]"
            )
        inverse = np.linalg.inv(scaled.T @ scaled)
        spread = np.sqrt(np.diag(inverse))
        return np.asarray(inverse / np.outer(spread, spread))


def parameter_sensitivities(
    model: HybridModel, x: ArrayLike, u: ArrayLike, *, names: Sequence[str] | None = None
) -> Sensitivities:
    """Compute exact derivatives of a free run with respect to the prior's parameters, for a prior or a hybrid.

    ``dz_{k+1}/dp = (df/dz) dz_k/dp + df/dp`` with ``z_{k+1} = f(z_k, u_k, p)``.

    Args:
        model: The model.
        x: Initial state ``(n_x,)``; a hidden state starts at zero.
        u: Inputs ``(n, n_u)``.
        names: Names of the parameters. Default: all parameters of the model.

    Raises:
        InputError: If the model has no such parameter, a shape does not fit, or the run is not finite.

    Source: forward sensitivities: Hairer, Norsett, Wanner, *Solving Ordinary Differential Equations I*, section I.14.

    Example:
        ``parameter_sensitivities(kit.models["prior"], [0.3, 0.0], np.zeros((200, 1))).relative``
    """
    there = [parameter.name for parameter in model.parameters]
    chosen = tuple(there if names is None else names)
    if not chosen or not set(chosen) <= set(there):
        raise InputError(
            f"sensitivities: model {model.name} does not have all of {list(chosen)}; choose from: "
            f"{', '.join(there) or 'none'} [HM-ANALYZE-056]"
        )
    n_x, n_h, n_u = model.n_x, model.n_h, model.n_u
    inputs, now = np.asarray(u, dtype=float), np.asarray(x, dtype=float).reshape(-1)
    if inputs.ndim != 2 or inputs.shape[1] != n_u or now.shape != (n_x,):
        raise InputError(
            f"sensitivities: got the shapes {now.shape} of x and {inputs.shape} of u; give ({n_x},) and (n, {n_u}) "
            "[HM-ANALYZE-057]"
        )
    columns = [there.index(name) for name in chosen]
    z, v, p = ca.MX.sym("z", n_x + n_h), ca.MX.sym("v", n_u), ca.MX.sym("p", model.n_p)
    after = ca.vertcat(*model.step(z[:n_x], z[n_x:], v, model.w, p))
    by_p = ca.densify(ca.jacobian(after, p))[:, columns]
    f = ca.Function("f", [z, v, p], [after, ca.densify(ca.jacobian(after, z)), by_p])
    state, slope = np.concatenate([now, np.zeros(n_h)]), np.zeros((n_x + n_h, len(chosen)))
    states, slopes = [state[:n_x]], [slope[:n_x]]
    for held in inputs:
        state, a, b = (m.full() for m in f(state, held, model.p))
        state, slope = state.ravel(), a @ slope + b
        states.append(state[:n_x])
        slopes.append(slope[:n_x])
    found = Sensitivities(chosen, model.p[columns], np.stack(states), np.stack(slopes))
    if not (np.all(np.isfinite(found.x)) and np.all(np.isfinite(found.by))):
        raise InputError(
            "sensitivities: the free run is not finite. Use a shorter run or other inputs [HM-ANALYZE-058]"
        )
    return found
