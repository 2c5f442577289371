"""Objectives of the training, the predictions that they evaluate, and the combination of several objectives.

An objective evaluates one-step predictions from measured states (:func:`teacher_forced`) or a free run
(:func:`free_run`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, cast

import torch
from torch import Tensor

from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.dataset import Windows
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.step import RecurrentStep
from hybrid_mpc.machine.prior import Prior


class VectorPerformanceIndex:
    """Combination of several objectives L_j with bounds c_j that never rise (Kreisselmeier & Steinhauser 1979).

    :meth:`value`, a smooth maximum of L_j / c_j, is minimized on mini-batches. :meth:`lower` evaluates the objectives
    on a *fixed* set of windows, so values of different steps are comparable. A step that improves one objective at the
    expense of another does not change a bound. ``bounds`` are ``(networks, objectives)``. ``rho`` is the sharpness of
    the maximum: with 10, the value of two objectives differs from the maximum by at most log(2)/10.
    """

    def __init__(self, bounds: Tensor, rho: float = 10.0) -> None:
        self.bounds, self.rho = bounds, rho

    def value(self, losses: Tensor) -> Tensor:
        """``1/rho log sum exp(rho L_j / c_j)`` ``(networks,)`` for losses ``(networks, objectives)``."""
        return torch.logsumexp(self.rho * losses / self.bounds, dim=-1) / self.rho

    def lower(self, losses: Tensor) -> VectorPerformanceIndex:
        """Lower every bound to its loss, for the networks in which no loss exceeds its bound."""
        keeps = (losses <= self.bounds).all(dim=-1, keepdim=True)
        bounds = torch.where(keeps, torch.minimum(losses, self.bounds), self.bounds)
        return VectorPerformanceIndex(bounds, self.rho)


@dataclass(frozen=True)
class Prediction:
    """A model's prediction along windows, and the measurement, at the start of each period.

    Args:
        x: Measured states ``(..., n_x)``.
        x_hat: Predicted states ``(..., n_x)``; the measured states under teacher forcing.
        u: Inputs ``(..., n_u)``.
        w: Disturbances ``(..., n_w)``.
        xdot: Measured rates ``(..., n_x)`` in the model's form (hybrid: means over the period).
        xdot_hat: Predicted rates ``(..., n_x)`` in the same form.
        weight: Weight of each window for each network ``(networks, n)``. Default: equal weights.
    """

    x: Tensor
    x_hat: Tensor
    u: Tensor
    w: Tensor
    xdot: Tensor
    xdot_hat: Tensor
    weight: Tensor | None = None


Objective: TypeAlias = Callable[[RecurrentStep, Prediction], Tensor]


def teacher_forced(step: RecurrentStep, windows: Windows) -> Prediction:
    """One-step predictions from the measured states; only h is propagated (the paper's training)."""
    x, u, w = (z.transpose(0, 1) for z in (windows.x[:, :-1], windows.u, windows.w))
    features = step.stacked_features(x, u, w)
    stack = cast(StackedGRU, step.network)
    out, _ = stack.sequence(features, stack.initial(len(windows)))
    correction = (out * step.scale_correction)[windows.warm :]
    x_k, u_k, w_k = (z[windows.warm :].unsqueeze(1) for z in (x, u, w))
    x_next = windows.x[:, windows.warm + 1 :].transpose(0, 1).unsqueeze(1)
    measured = step.measured_rate(x_k, x_next, _scored_xdot(windows))
    rate = step.rate(x_k, u_k, w_k, correction)
    return Prediction(x_k, x_k, u_k, w_k, measured, rate, windows.weight)


def warm_up(step: RecurrentStep, windows: Windows) -> Tensor:
    """Hidden states after the measured warm-up, ``(networks, n, z)``."""
    stack = cast(StackedGRU, step.network)
    h = stack.initial(len(windows))
    if windows.warm == 0:
        return h
    past = (z[:, : windows.warm].transpose(0, 1) for z in (windows.x, windows.u, windows.w))
    return stack.sequence(step.stacked_features(*past), h)[1]


def free_run(step: RecurrentStep, windows: Windows) -> Prediction:
    """Free run over the evaluated part of each window; the measured warm-up sets h."""
    h = warm_up(step, windows)
    x = windows.x[:, windows.warm].unsqueeze(0).expand(h.shape[0], -1, -1)
    u, w = (z[:, windows.warm :].transpose(0, 1).unsqueeze(1) for z in (windows.u, windows.w))
    x_hat = step.free_run(x, h, *(z.expand(-1, h.shape[0], -1, -1) for z in (u, w)))
    measured = windows.x[:, windows.warm :].transpose(0, 1).unsqueeze(1)
    rate = step.measured_rate(measured[:-1], measured[1:], _scored_xdot(windows))
    own = (x_hat[1:] - x_hat[:-1]) / step.dt
    return Prediction(measured[:-1], x_hat[:-1], u, w, rate, own, windows.weight)


def error_objective(step: RecurrentStep, prediction: Prediction) -> Tensor:
    """Mean absolute error of xdot, each rate over its spread; one value per network.

    The paper adds rates of different units without scaling (MAE, and E_sim on free runs).
    """
    error = (prediction.xdot_hat - prediction.xdot).abs() / step.scale_xdot
    return _per_network(error.mean(-1), prediction.weight)


def balance_objective(name: str) -> Objective:
    """Objective of a balance: mean violation |residual of the model - residual of the measurement| [its rate_unit].

    One value per network; both residuals use the prior's parameters (paper: |ΔE_M - ΔE_S|). At a measured state
    (:func:`teacher_forced`), the violation of a mechanical machine's energy is M |v| |a_M - a_S|, a speed-weighted
    error. Along a free run (:func:`free_run`), the error of the states contributes too.
    """

    def violation(step: RecurrentStep, prediction: Prediction) -> Tensor:
        residual, held = step.equations.residuals[name], (prediction.u, prediction.w, step.p)
        model = residual(prediction.x_hat, prediction.xdot_hat, *held)
        measured = residual(prediction.x, prediction.xdot, *held)
        return _per_network((model - measured).abs().sum(-1), prediction.weight)

    return violation


def output_objective(step: RecurrentStep, prediction: Prediction) -> Tensor:
    """Root mean square error of the outputs one period later, each over its spread; one value per network.

    On free runs, this is the usual error of a simulation; the mean absolute error of xdot mainly weights fast states.
    """
    held = prediction.u, prediction.w, step.p
    y = step.equations.output(prediction.x + step.dt * prediction.xdot, *held)
    y_hat = step.equations.output(prediction.x_hat + step.dt * prediction.xdot_hat, *held)
    size = y.flatten(0, -2).std(0, correction=0).clamp_min(1e-12)
    error = ((y_hat - y) / size).square().sum(-1)
    return _per_network(error, prediction.weight).clamp_min(1e-24).sqrt()


OBJECTIVES: dict[str, Objective] = {"error": error_objective, "output": output_objective}
"""Objectives of any machine by name; each balance of the prior is another objective, by its name."""
BALANCES = "balances"
"""Name for all balances of the prior, if any."""


def objectives_of(prior: Prior, names: Sequence[str]) -> dict[str, Objective]:
    """Objectives by name; each balance has its own.

    Raises:
        InputError: If a name is not an objective or a balance of the prior, or no objective results.
    """
    balances = [b.name for b in prior.equations.balances]
    wanted = [one for name in names for one in (balances if name == BALANCES else [name])]
    unknown = [name for name in wanted if name not in OBJECTIVES and name not in balances]
    if unknown or not wanted:
        raise InputError(
            f"objectives: unknown or missing ({', '.join(unknown) or 'none given'}); choose from: "
            f"{', '.join([*OBJECTIVES, BALANCES])}, and the balances of {type(prior).__name__}: "
            f"{', '.join(balances) or 'it has none'} [HM-IDENTIFY-040]"
        )
    return {name: OBJECTIVES.get(name) or balance_objective(name) for name in wanted}


def _per_network(values: Tensor, weight: Tensor | None) -> Tensor:
    """Mean of ``(T, networks, n)`` over time and weighted windows."""
    if weight is None:
        return values.mean(dim=(0, 2))
    counted = torch.where(weight > 0, values.mean(dim=0), 0.0)
    return (counted * weight).sum(-1) / weight.sum(-1).clamp_min(1e-300)


def _scored_xdot(windows: Windows) -> Tensor:
    return windows.xdot[:, windows.warm :].transpose(0, 1).unsqueeze(1)
