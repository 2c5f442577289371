"""Objectives of the training and the vector performance index that never trades one for another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hybrid_mpc.identification.dataset import Windows
from hybrid_mpc.identification.step import HybridStep


@dataclass(frozen=True)
class Prediction:
    """What a model says along windows beside what was measured, both as mean rates over each period.

    Args:
        x: Measured states at the periods' starts ``(..., n_x)``.
        x_hat: States of the model there (the measured ones under teacher forcing).
        u: Inputs ``(..., n_u)``.
        xdot: Measured rates ``(x_{k+1} - x_k) / dt``, ``(..., n_x)``.
        xdot_hat: Rates of the model.
    """

    x: Tensor
    x_hat: Tensor
    u: Tensor
    xdot: Tensor
    xdot_hat: Tensor


def teacher_forced(step: HybridStep, windows: Windows) -> Prediction:
    """One-period predictions from the measured states; only h runs along (the paper's training).

    The rates are means over the period, so that an input that jumps at a sample is credited to the
    period it acts in.
    """
    x, u = windows.x[:, :-1].transpose(0, 1), windows.u.transpose(0, 1)
    features = step.features(x, u).unsqueeze(1)
    stack = step.network
    out, _ = stack.sequence(features, stack.initial(len(windows)))  # type: ignore[operator]
    correction = (out * step.scale_correction)[windows.warm :]
    x_k, u_k = x[windows.warm :].unsqueeze(1), u[windows.warm :].unsqueeze(1)
    x_next = windows.x[:, windows.warm + 1 :].transpose(0, 1).unsqueeze(1)
    predicted = step.integrate(x_k.expand(*correction.shape[:-1], -1), u_k, correction)
    return Prediction(x_k, x_k, u_k, (x_next - x_k) / step.dt, (predicted - x_k) / step.dt)


def warm_up(step: HybridStep, windows: Windows) -> Tensor:
    """Hidden states after the measured warm-up, ``(networks, n, z)``."""
    stack = step.network
    h = stack.initial(len(windows))  # type: ignore[operator]
    if windows.warm == 0:
        return h
    x, u = windows.x[:, : windows.warm].transpose(0, 1), windows.u[:, : windows.warm].transpose(0, 1)
    return stack.sequence(step.features(x, u).unsqueeze(1), h)[1]  # type: ignore[operator]


def free_run(step: HybridStep, windows: Windows) -> Prediction:
    """The model's own free run over the scored part, h warmed up on the measured past."""
    h = warm_up(step, windows)
    x = windows.x[:, windows.warm].unsqueeze(0).expand(h.shape[0], -1, -1)
    states = [x]
    for u in windows.u[:, windows.warm :].transpose(0, 1).unsqueeze(1).expand(-1, h.shape[0], -1, -1):
        x, h = step(x, h, u)
        states.append(x)
    x_hat = torch.stack(states)
    measured = windows.x[:, windows.warm :].transpose(0, 1).unsqueeze(1)
    u = windows.u[:, windows.warm :].transpose(0, 1).unsqueeze(1)
    rate = (measured[1:] - measured[:-1]) / step.dt
    return Prediction(measured[:-1], x_hat[:-1], u, rate, (x_hat[1:] - x_hat[:-1]) / step.dt)


def error_objective(step: HybridStep, prediction: Prediction) -> Tensor:
    """Mean absolute error of xdot [mixed SI], a value per network (paper: MAE, and E_sim on free runs)."""
    return _per_network((prediction.xdot_hat - prediction.xdot).abs().sum(-1))


def energy_objective(step: HybridStep, prediction: Prediction) -> Tensor:
    """Mean violation |ΔE_M - ΔE_S| [W], a value per network, with the prior's parameters for both.

    ΔE_M is taken at the model's own state: under teacher forcing it is J|v||a_M - a_S|, a speed-weighted
    error; on a free run it also weighs where the model has gone.
    """
    model = step.prior.energy_balance(prediction.x_hat, prediction.xdot_hat, prediction.u)
    measured = step.prior.energy_balance(prediction.x, prediction.xdot, prediction.u)
    return _per_network((model - measured).abs())


OBJECTIVES: dict[str, Callable[[HybridStep, Prediction], Tensor]] = {
    "error": error_objective,
    "energy": energy_objective,
}


def _per_network(values: Tensor) -> Tensor:
    """Mean over time and windows of ``(T, networks, n)``."""
    return values.mean(dim=(0, 2))


class VectorPerformanceIndex:
    """Bounds ("default values") c_j of several objectives that only fall (Kreisselmeier & Steinhauser 1979).

    ``value`` is the smooth maximum ``1/rho log sum exp(rho L_j / c_j)``. ``lower`` takes the objectives on a
    *fixed* set of windows, a statistic that means the same from step to step (mini-batch losses do not):
    where none exceeds its bound, every bound is lowered to its objective. So no step that improves one
    objective at another's cost ever moves a bound.

    Args:
        bounds: Start values ``(networks, objectives)``, e.g. the fitted prior's objectives.
        rho: Sharpness of the maximum; 10 keeps the value within log(2)/10 of the hard maximum of two.

    Example:
        >>> index = VectorPerformanceIndex(torch.tensor([[1.0, 1.0]]))
        >>> index.lower(torch.tensor([[0.5, 0.8]])).bounds.tolist()
        [[0.5, 0.800000011920929]]
        >>> index.lower(torch.tensor([[0.5, 1.1]])).bounds.tolist()
        [[1.0, 1.0]]
    """

    def __init__(self, bounds: Tensor, rho: float = 10.0) -> None:
        self.bounds, self.rho = bounds, rho

    def value(self, losses: Tensor) -> Tensor:
        """Smooth maximum of ``losses / bounds`` ``(networks,)`` for losses ``(networks, objectives)``."""
        return torch.logsumexp(self.rho * losses / self.bounds, dim=-1) / self.rho

    def lower(self, losses: Tensor) -> VectorPerformanceIndex:
        """The index with bounds lowered where all objectives of a network keep theirs."""
        keeps = (losses <= self.bounds).all(dim=-1, keepdim=True)
        return VectorPerformanceIndex(
            torch.where(keeps, torch.minimum(losses, self.bounds), self.bounds), self.rho
        )
