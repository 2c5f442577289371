"""What all fits of a prior share: scaled parameters, residuals of free runs with exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor
from torch.func import functional_call

from hybrid_mpc.identify.dataset import Windows
from hybrid_mpc.identify.step import required_substeps, rk4
from hybrid_mpc.machine.torch_prior import Prior

Array = NDArray[np.float64]


LARGEST = 1e3
"""Residuals beyond this many spreads of the data count as much: a free run that diverges stays finite."""


class ParameterFit:
    """A prior's free parameters ``theta``, each over its nominal size, and the residuals that are fitted.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        dt: Model period [s].
    """

    def __init__(self, make: Callable[..., Prior], dt: float) -> None:
        self.make, self.prior, self.dt = make, make(), dt
        self.free = [p for p in self.prior.parameters_spec if not p.fixed]
        self.unit = np.array([abs(p.value) if p.value else (p.upper - p.lower) for p in self.free])
        self.nominal = np.array([p.value for p in self.free]) / self.unit
        self.lower = np.array([p.lower for p in self.free]) / self.unit
        self.upper = np.array([p.upper for p in self.free]) / self.unit

    def values(self, theta: Array) -> dict[str, float]:
        """Values [SI] of all parameters by name, fixed ones included."""
        fitted = {p.name: float(v) for p, v in zip(self.free, theta * self.unit, strict=True)}
        return {**self.prior.values, **fitted}

    def scaled(self, values: Mapping[str, float]) -> Array:
        """The free ones of ``values`` [SI] as ``theta``."""
        return np.array([values[p.name] for p in self.free]) / self.unit

    def inside(self, theta: Array) -> Array:
        """``theta`` just within its bounds: a start on one would stall a trust-region reflective search."""
        return np.clip(theta, self.lower + 1e-6, self.upper - 1e-6)

    def equation_error(self, windows: Windows) -> tuple[Array, Any]:
        """Fit from the nominal values to windows of one period: the state a period later is all there is."""
        return self.output_error(self.nominal, windows, 40)

    def output_error(self, start: Array, windows: Windows, evaluations: int) -> tuple[Array, Any]:
        """Fit from ``start`` to free runs over the windows, each from its first measured state.

        Returns:
            ``theta`` and the Jacobian of the residuals over their standard deviation.
        """
        run = self.residual_function(windows, start)
        derivative = torch.func.jacfwd(run)

        def residual(theta: Array) -> Array:
            return run(torch.tensor(theta)).numpy()

        def jacobian(theta: Array) -> Array:
            return derivative(torch.tensor(theta)).numpy()

        result = least_squares(
            residual,
            self.inside(start),
            jac=jacobian,
            bounds=(self.lower, self.upper),
            loss="soft_l1",
            max_nfev=evaluations,
        )
        return result.x, result.jac / np.sqrt(max(2 * result.cost / max(1, result.fun.size), 1e-30))

    def jacobian(self, theta: Array, windows: Windows) -> Array:
        """Jacobian at ``theta`` of the residuals over their standard deviation, for :meth:`confidence`."""
        run = self.residual_function(windows, theta)
        residual = run(torch.tensor(theta))
        slope = torch.func.jacfwd(run)(torch.tensor(theta)).numpy()
        return np.asarray(slope / max(float(residual.square().mean().sqrt()), 1e-15))

    def judge(self, theta: Array, windows: Windows) -> float:
        """Mean absolute error of free runs over the windows [spreads of the data]; infinite if one diverges."""
        residual = self.residual_function(windows, theta)(torch.tensor(theta))
        return float(residual.abs().mean()) if bool(torch.isfinite(residual).all()) else float("inf")

    def confidence(self, theta: Array, jacobian: Any) -> tuple[dict[str, float], list[str]]:
        """Standard errors [SI] by name and what the data do not tell, from a Jacobian as the fits return it."""
        if jacobian is None:
            return {}, ["no fit improved on the nominal parameters"]
        warnings = []
        _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
        if singular[-1] < 1e-6 * singular[0]:
            names = [p.name for p, w in zip(self.free, np.abs(rows[-1]), strict=True) if w > 0.2]
            warnings.append(f"the data do not tell apart: {', '.join(names)}")
        errors = np.sqrt(np.diag(_covariance(singular, rows))) * self.unit
        for p, value, low, high in zip(self.free, theta, self.lower, self.upper, strict=True):
            if min(value - low, high - value) < 1e-3 * (high - low):
                warnings.append(f"{p.label} ends at a bound ({value * abs(p.value or 1):.4g})")
        return {p.name: float(e) for p, e in zip(self.free, errors, strict=True)}, warnings

    def correlations(self, jacobian: Any) -> dict[str, float]:
        """Correlation of the errors of every two fitted parameters, by ``"a, b"``."""
        if jacobian is None:
            return {}
        _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
        covariance = _covariance(singular, rows)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        names = [p.name for p in self.free]
        return {
            f"{names[i]}, {names[j]}": float(covariance[i, j] / (sigma[i] * sigma[j]))
            for i in range(len(names))
            for j in range(i + 1, len(names))
        }

    def residual_function(self, windows: Windows, near: Array, most: int = 0) -> Callable[[Tensor], Tensor]:
        """``theta -> `` errors of all states of all free runs over the states' spread, as one vector.

        Args:
            windows: Free runs from their first states.
            near: Parameters whose stiffness decides the sub-steps.
            most: Sub-steps instead, if not zero.
        """
        spread = spread_of(windows)
        unit, names = torch.tensor(self.unit), [p.name for p in self.free]
        inputs = windows.u.transpose(0, 1)
        substeps = most or required_substeps(self.make(self.values(near)), self.dt)

        def residual(theta: Tensor) -> Tensor:
            values = dict(zip(names, theta * unit, strict=True))
            x, states = windows.x[:, 0], []
            for u in inputs:
                x = rk4(lambda z, u=u: functional_call(self.prior, values, (z, u)), x, self.dt, substeps)  # type: ignore[misc]
                states.append(x)
            errors = (torch.stack(states, 1) - windows.x[:, 1:]) / spread
            return errors.clamp(-LARGEST, LARGEST).reshape(-1)

        return residual


def spread_of(windows: Windows) -> Tensor:
    """Standard deviation of each state over all windows ``(n_x,)`` [SI]: the unit of all residuals."""
    return windows.x.reshape(-1, windows.x.shape[-1]).std(0).clamp_min(1e-9)


def _covariance(singular: Array, rows: Array) -> Array:
    return np.asarray((rows.T / np.maximum(singular, 1e-12 * singular[0]) ** 2) @ rows)
