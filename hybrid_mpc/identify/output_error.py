"""Output error over long free runs: parameters and the input's delay together, derivatives by differences.

Errors are those of the measured outputs alone. All perturbed parameters are simulated at once, which makes runs of a
thousand periods affordable. :func:`~hybrid_mpc.identify.fit.fit_prior` is the fit to states, with exact derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from hybrid_mpc.data.scales import evenly
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.fit import ParameterFit, correlations, covariance_of
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.step import required_substeps
from hybrid_mpc.machine.torch_prior import Prior

Array = NDArray[np.float64]
STEP = 1e-5
"""Of the differences, in nominal sizes: far above rounding (1e-11 after a thousand periods), far below any bend."""
LARGEST = 30.0
"""Errors beyond this many spreads count as much: a run that diverges stays finite."""
AT_BOUND = 1e-3
"""Share of its range within which a parameter counts as at its bound."""


@dataclass(frozen=True)
class Runs:
    """Free runs to be fitted: first states ``x`` ``(n, n_x)``, measured outputs ``y`` ``(n, periods, n_y)`` after
    each period.

    The commanded inputs ``u`` ``(n, lead + periods, n_u)`` begin ``lead`` samples before the first state.
    """

    x: Tensor
    u: Tensor
    y: Tensor
    lead: int


def cut_runs(trajectories: Sequence[Trajectory], periods: int, lead: int, most: int) -> Runs:
    """At most ``most`` free runs of ``periods``, one after the other, evenly chosen."""
    # a run needs the sample after its last period
    starts = [(t, k) for t in trajectories for k in range(lead, len(t.t) - periods, periods)]
    if not starts:
        longest = max((len(t.t) for t in trajectories), default=0)
        raise InputError(
            f"no recording is long enough: the longest has {longest} samples, a free run of {periods} periods with "
            f"{lead} samples before it needs {periods + lead + 1}"
        )
    chosen = [starts[i] for i in evenly(len(starts), most)]
    x = np.stack([t.x[k] for t, k in chosen])
    u = np.stack([t.u[k - lead : k + periods] for t, k in chosen])
    y = np.stack([t.y[k + 1 : k + periods + 1] for t, k in chosen])
    return Runs(torch.tensor(x), torch.tensor(u), torch.tensor(y), lead)


class OutputErrorFit:
    """A prior's free parameters and its input's delay, over their nominal sizes, and their fit."""

    def __init__(self, make: Callable[..., Prior], dt: float, largest_delay: float = 0.0) -> None:
        self.make, self.dt, self.largest = make, dt, largest_delay
        own = ParameterFit(make, dt)
        self.prior, self.free, self._own = own.prior, own.free, own
        late = [1.0] if largest_delay else []
        self.unit = np.concatenate([own.unit, [dt * one for one in late]])
        self.nominal = np.concatenate([own.nominal, [0.5 * largest_delay / dt for _ in late]])
        self.lower = np.concatenate([own.lower, [0.0 for _ in late]])
        self.upper = np.concatenate([own.upper, [largest_delay / dt for _ in late]])

    @property
    def lead(self) -> int:
        """Samples before a run's first state that its delayed inputs may need."""
        return int(np.ceil(self.largest / self.dt)) + 1 if self.largest else 0

    def values(self, theta: Array) -> dict[str, float]:
        """Values [SI] of all parameters by name."""
        return self._own.values(theta[: len(self.free)])

    def delay(self, theta: Array) -> float:
        """Delay [s]."""
        return float(theta[-1] * self.dt) if self.largest else 0.0

    def errors(self, thetas: Array, runs: Runs) -> Array:
        """Errors of the outputs ``(m, n, periods, n_y)`` [output unit] of ``m`` sets of parameters."""
        m, (n, periods) = len(thetas), runs.y.shape[:2]
        substeps = required_substeps(self.make(self.values(thetas[0])), self.dt)
        delays = torch.tensor(thetas * self.unit)[:, -1]
        inputs = self._acting(delays, runs) if self.largest else runs.u[None, :, runs.lead :]
        u = inputs.expand(m, n, periods, -1)
        p = self._own.parameters(thetas[:, : len(self.free)])
        states = self._own.simulation.states(
            np.tile(runs.x.numpy(), (m, 1)),
            u.reshape(m * n, periods, -1).numpy(),
            np.repeat(p, n, axis=0),
            substeps,
        )[:, 1:]
        with torch.no_grad():
            error = self.prior.output(torch.tensor(states).reshape(m, n, periods, -1), u) - runs.y
        return np.nan_to_num(error.numpy(), nan=np.inf, posinf=np.inf, neginf=-np.inf)

    def rmse(self, theta: Array, runs: Runs) -> float:
        """Root mean square error of the outputs [output unit]."""
        return float(np.sqrt(np.mean(np.square(self.errors(theta[None], runs)))))

    def fit(self, start: Array, runs: Runs, evaluations: int, *, robust: bool) -> tuple[Array, Array]:
        """``theta`` fitted from ``start``, and the Jacobian of the residuals over their standard deviation.

        ``robust`` takes soft absolute values instead of squares, for runs from starts that are far off.
        """
        spread = runs.y.reshape(-1, runs.y.shape[-1]).std(0).clamp_min(1e-12).numpy()

        def residuals(thetas: Array) -> Array:
            scaled = np.clip(self.errors(thetas, runs) / spread, -LARGEST, LARGEST)
            return scaled.reshape(len(thetas), -1)

        def jacobian(theta: Array) -> Array:
            side = np.where(theta + STEP > self.upper, -STEP, STEP)
            every = residuals(np.vstack([theta[None], theta + np.diag(side)]))
            return ((every[1:] - every[0]) / side[:, None]).T

        result: Any = least_squares(
            lambda theta: residuals(theta[None])[0],
            np.clip(start, self.lower + 1e-6, self.upper - 1e-6),
            jac=jacobian,
            bounds=(self.lower, self.upper),
            loss="soft_l1" if robust else "linear",
            f_scale=0.1,
            max_nfev=evaluations,
        )
        noise = np.sqrt(max(float(np.mean(residuals(result.x[None]) ** 2)), 1e-30))
        return result.x, jacobian(result.x) / noise

    def result(self, theta: Array, slope: Array, stages: Sequence[dict[str, Any]]) -> PriorFit:
        """Values with standard errors; the delay counts among what is fitted, it is no parameter of the prior."""
        _, singular, rows = np.linalg.svd(slope, full_matrices=False)
        covariance = covariance_of(singular, rows)
        sizes = np.sqrt(np.diag(covariance))
        names = [p.name for p in self.free]
        near = np.minimum(theta - self.lower, self.upper - theta) < AT_BOUND * (self.upper - self.lower)
        warnings = tuple(f"{p.label} ends at a bound" for p, hit in zip(self.free, near, strict=False) if hit)
        errors = {name: float(sizes[i] * self.unit[i]) for i, name in enumerate(names)}
        return PriorFit(self.values(theta), errors, warnings, tuple(stages), correlations(names, covariance))

    def _acting(self, delays: Tensor, runs: Runs) -> Tensor:
        """Inputs ``(m, n, periods, n_u)`` that act under each delay, means over each period."""
        parts, n = [], runs.y.shape[1]
        for delay in (delays / self.dt).tolist():
            whole = int(np.floor(delay))
            share, first = delay - whole, runs.lead - whole
            younger, older = runs.u[:, first : first + n], runs.u[:, first - 1 : first - 1 + n]
            parts.append((1 - share) * younger + share * older)
        return torch.stack(parts)
