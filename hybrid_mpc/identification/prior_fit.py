"""Fit of the prior's parameters to the training trajectories: the honest baseline ``phy``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor
from torch.func import functional_call

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.dataset import Windows, cut_windows
from hybrid_mpc.identification.step import required_substeps, rk4
from hybrid_mpc.physics import Prior

STAGES = ((0.5, 20), (2.0, 10), (5.0, 6))
"""Lengths [s] of the free runs that are fitted, from short (convex) to long (what is judged), each with
its most evaluations: the long ones start near their optimum."""
MAX_WINDOWS = 48


@dataclass(frozen=True)
class PriorFit:
    """Fitted parameters with their standard errors.

    Args:
        values: Fitted values [SI] by name, fixed ones included.
        standard_errors: Standard errors [SI] of the fitted ones, from the last fit's Jacobian (they hold
            for a model without structural error, so read them as lower bounds).
        warnings: Parameters at a bound, or ones the data do not tell apart.
        stages: One row per stage: its name and the validation error that chose the winner.
    """

    values: dict[str, float]
    standard_errors: dict[str, float]
    warnings: tuple[str, ...]
    stages: tuple[dict[str, Any], ...]

    @property
    def best(self) -> str:
        """Name of the stage that won."""
        return str(min(self.stages, key=lambda row: row["validation_error"])["stage"])


def fit_prior(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    *,
    dt: float,
    before: PriorFit | None = None,
    on_progress: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> PriorFit:
    """Fit by equation error, then by output error over longer and longer free runs; the best one wins.

    Residuals are the states' errors over their spread in the data, with exact derivatives (forward mode
    through the integrator). The winner has the lowest error on free runs of the validation trajectories.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training trajectories.
        valid: Validation trajectories (chosen by, not fitted to).
        dt: Model period [s].
        before: An earlier fit to the same recordings, smoothed otherwise: only the length of free run that
            was best then is fitted, from its parameters on. Default: all lengths, from the nominal ones.
        on_progress: ``(done, total, text)`` after every stage.

    Raises:
        InputError: If no trajectory is long enough, or the inputs leave every parameter undetermined.
    """
    fit = _Fit(make, dt)
    stages = [s for s in STAGES if _fits(train, s[0], dt)] or [(_shortest(train, dt), 20)]
    lengths = [s for s, _ in stages]
    judge = _sample(
        cut_windows(valid or train, 0, round(_longest(valid or train, lengths) / dt), round(0.5 / dt))
    )
    if before is None:
        candidates = [("nominal", fit.nominal, None)]
        theta, jacobian = fit.equation_error(_sample(cut_windows(train, 0, 1, 3), 4000))
        candidates.append(("equation error", theta, jacobian))
    else:
        candidates = [("the fit before", fit.scaled(before.values), None)]
        stages = [s for s in stages if before.best == f"output error {s[0]:g} s"] or stages[:1]
    for i, (length, evaluations) in enumerate(stages):
        on_progress(i, len(stages), f"output error over {length:g} s")
        windows = _sample(cut_windows(train, 0, round(length / dt), max(1, round(length / dt / 4))))
        start = min(candidates, key=lambda c: fit.judge(c[1], windows))[1]
        theta, jacobian = fit.output_error(start, windows, evaluations)
        candidates.append((f"output error {length:g} s", theta, jacobian))
    on_progress(len(stages), len(stages), "done")
    scores = [fit.judge(theta, judge) for _, theta, _ in candidates]
    if not np.isfinite(min(scores)):
        raise InputError("the prior diverges with every set of parameters tried; check its signs and units")
    best = int(np.argmin(scores))
    if best == 0 and before is not None:
        errors, warnings = dict(before.standard_errors), list(before.warnings)
    else:
        errors, warnings = fit.confidence(candidates[best][1], candidates[best][2])
    table = tuple({"stage": c[0], "validation_error": s} for c, s in zip(candidates, scores, strict=True))
    return PriorFit(fit.values(candidates[best][1]), errors, tuple(warnings), table)


class _Fit:
    """Least squares over the free parameters, each scaled by its nominal value."""

    def __init__(self, make: Callable[..., Prior], dt: float) -> None:
        self.make, self.prior, self.dt = make, make(), dt
        self.free = [p for p in self.prior.parameters_spec if not p.fixed]
        self.unit = np.array([abs(p.value) if p.value else (p.upper - p.lower) for p in self.free])
        self.nominal = np.array([p.value for p in self.free]) / self.unit
        self.lower = np.array([p.lower for p in self.free]) / self.unit
        self.upper = np.array([p.upper for p in self.free]) / self.unit

    def values(self, theta: NDArray[np.float64]) -> dict[str, float]:
        fitted = {p.name: float(v) for p, v in zip(self.free, theta * self.unit, strict=True)}
        return {**self.prior.values, **fitted}

    def scaled(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        return np.array([values[p.name] for p in self.free]) / self.unit

    def equation_error(self, windows: Windows) -> tuple[NDArray[np.float64], Any]:
        return self.output_error(self.nominal, windows, 40)

    def output_error(
        self, start: NDArray[np.float64], windows: Windows, evaluations: int
    ) -> tuple[NDArray[np.float64], Any]:
        run = self._residual_function(windows, start)
        derivative = torch.func.jacfwd(run)

        def residual(theta: NDArray[np.float64]) -> NDArray[np.float64]:
            return run(torch.tensor(theta)).numpy()

        def jacobian(theta: NDArray[np.float64]) -> NDArray[np.float64]:
            return derivative(torch.tensor(theta)).numpy()

        # a start exactly on a bound would stall a trust-region reflective search
        inside = np.clip(start, self.lower + 1e-6, self.upper - 1e-6)
        result = least_squares(
            residual,
            inside,
            jac=jacobian,
            bounds=(self.lower, self.upper),
            loss="soft_l1",
            max_nfev=evaluations,
        )
        return result.x, result.jac / np.sqrt(max(2 * result.cost / max(1, result.fun.size), 1e-30))

    def judge(self, theta: NDArray[np.float64], windows: Windows) -> float:
        residual = self._residual_function(windows, theta)(torch.tensor(theta))
        return float(residual.abs().mean()) if bool(torch.isfinite(residual).all()) else float("inf")

    def confidence(self, theta: NDArray[np.float64], jacobian: Any) -> tuple[dict[str, float], list[str]]:
        if jacobian is None:
            return {}, ["no fit improved on the nominal parameters"]
        warnings = []
        _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
        if singular[-1] < 1e-6 * singular[0]:
            names = [p.name for p, w in zip(self.free, np.abs(rows[-1]), strict=True) if w > 0.2]
            warnings.append(f"the data do not tell apart: {', '.join(names)}")
        covariance = (rows.T / np.maximum(singular, 1e-12 * singular[0]) ** 2) @ rows
        errors = np.sqrt(np.diag(covariance)) * self.unit
        for p, value, low, high in zip(self.free, theta, self.lower, self.upper, strict=True):
            if min(value - low, high - value) < 1e-3 * (high - low):
                warnings.append(f"{p.label} ends at a bound ({value * abs(p.value or 1):.4g})")
        return {p.name: float(e) for p, e in zip(self.free, errors, strict=True)}, warnings

    def _residual_function(self, windows: Windows, near: NDArray[np.float64]) -> Callable[[Tensor], Tensor]:
        spread = windows.x.reshape(-1, windows.x.shape[-1]).std(0).clamp_min(1e-9)
        unit, names = torch.tensor(self.unit), [p.name for p in self.free]
        inputs = windows.u.transpose(0, 1)
        substeps = required_substeps(self.make(self.values(near)), self.dt)

        def residual(theta: Tensor) -> Tensor:
            values = dict(zip(names, theta * unit, strict=True))
            x, states = windows.x[:, 0], []
            for u in inputs:
                x = rk4(lambda z, u=u: functional_call(self.prior, values, (z, u)), x, self.dt, substeps)  # type: ignore[misc]
                states.append(x)
            errors = (torch.stack(states, 1) - windows.x[:, 1:]) / spread
            return errors.clamp(-1e3, 1e3).reshape(-1)

        return residual


def _sample(windows: Windows, most: int = MAX_WINDOWS) -> Windows:
    """At most ``most`` windows, evenly spread."""
    return windows.take(torch.linspace(0, len(windows) - 1, min(most, len(windows))).round().long())


def _fits(trajectories: Sequence[Trajectory], seconds: float, dt: float) -> bool:
    return any(len(t.t) > round(seconds / dt) for t in trajectories)


def _shortest(trajectories: Sequence[Trajectory], dt: float) -> float:
    return max((len(t.t) - 1) * dt for t in trajectories) * 0.5


def _longest(trajectories: Sequence[Trajectory], lengths: Sequence[float]) -> float:
    dt = trajectories[0].dt
    fitting = [s for s in lengths if _fits(trajectories, s, dt)]
    return max(fitting) if fitting else _shortest(trajectories, dt)
