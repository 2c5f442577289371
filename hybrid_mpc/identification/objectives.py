"""Objectives of the training, and the predictions along windows that they judge.

Each objective judges a prediction: one period from every measured state (:func:`teacher_forced`) or the model's own
free run (:func:`free_run`). How several are made one number is in :mod:`hybrid_mpc.identification.combination`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from hybrid_mpc.identification.dataset import Windows
from hybrid_mpc.identification.networks import StackedNetwork
from hybrid_mpc.identification.step import RecurrentStep


@dataclass(frozen=True)
class Prediction:
    """What a model says along windows beside what was measured.

    The hybrid step gives mean rates over each period, the literal form derivatives at the samples.

    Args:
        x: Measured states at the periods' starts ``(..., n_x)``.
        x_hat: States of the model there (the measured ones under teacher forcing).
        u: Inputs ``(..., n_u)``.
        xdot: Measured rates ``(x_{k+1} - x_k) / dt``, ``(..., n_x)``; literal form: recorded derivatives.
        xdot_hat: Rates of the model.
    """

    x: Tensor
    x_hat: Tensor
    u: Tensor
    xdot: Tensor
    xdot_hat: Tensor


def teacher_forced(step: RecurrentStep, windows: Windows) -> Prediction:
    """One-period predictions from the measured states; only h runs along (the paper's training).

    The rates are means over the period, so that an input that jumps at a sample is credited to the
    period it acts in.
    """
    x, u = windows.x[:, :-1].transpose(0, 1), windows.u.transpose(0, 1)
    features = step.stacked_features(x, u)
    stack = cast(StackedNetwork, step.network)
    out, _ = stack.sequence(features, stack.initial(len(windows)))
    correction = (out * step.scale_correction)[windows.warm :]
    x_k, u_k = x[windows.warm :].unsqueeze(1), u[windows.warm :].unsqueeze(1)
    x_next = windows.x[:, windows.warm + 1 :].transpose(0, 1).unsqueeze(1)
    measured = step.measured_rate(x_k, x_next, _scored_xdot(windows))
    return Prediction(x_k, x_k, u_k, measured, step.rate(x_k, u_k, correction))


def warm_up(step: RecurrentStep, windows: Windows) -> Tensor:
    """Hidden states after the measured warm-up, ``(networks, n, z)``."""
    stack = cast(StackedNetwork, step.network)
    h = stack.initial(len(windows))
    if windows.warm == 0:
        return h
    x, u = windows.x[:, : windows.warm].transpose(0, 1), windows.u[:, : windows.warm].transpose(0, 1)
    return stack.sequence(step.stacked_features(x, u), h)[1]


def free_run(step: RecurrentStep, windows: Windows) -> Prediction:
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
    rate = step.measured_rate(measured[:-1], measured[1:], _scored_xdot(windows))
    return Prediction(measured[:-1], x_hat[:-1], u, rate, (x_hat[1:] - x_hat[:-1]) / step.dt)


def error_objective(step: RecurrentStep, prediction: Prediction) -> Tensor:
    """Mean absolute error of xdot [mixed SI], a value per network (paper: MAE, and E_sim on free runs)."""
    return _per_network((prediction.xdot_hat - prediction.xdot).abs().sum(-1))


def energy_objective(step: RecurrentStep, prediction: Prediction) -> Tensor:
    """Mean violation |ΔE_M - ΔE_S| [W], a value per network, with the prior's parameters for both.

    The paper leaves open at which state ΔE_M is taken. Both readings are this function, of two predictions:
    one-step at the measured state (:func:`teacher_forced`), where it is J|v||a_M - a_S|, a speed-weighted
    error; and the model's own free run (:func:`free_run`), where it also weighs where the model has gone.
    ``TrainingSettings.energy`` chooses. The velocity is that of the state in both, never the network's first
    output in the literal form.
    """
    model = step.prior.energy_balance(prediction.x_hat, prediction.xdot_hat, prediction.u)
    measured = step.prior.energy_balance(prediction.x, prediction.xdot, prediction.u)
    return _per_network((model - measured).abs())


def position_objective(step: RecurrentStep, prediction: Prediction) -> Tensor:
    """Root mean square error of the positions a period later [SI], a value per network.

    On free runs it is the figure by which simulations are judged, while the mean absolute error of xdot weighs what a
    period changes and so mostly accelerations.
    """
    n_q = step.prior.n_q
    gap = (prediction.x_hat - prediction.x) + step.dt * (prediction.xdot_hat - prediction.xdot)
    return _per_network(gap[..., :n_q].square().sum(-1)).clamp_min(1e-24).sqrt()


OBJECTIVES: dict[str, Callable[[RecurrentStep, Prediction], Tensor]] = {
    "error": error_objective,
    "energy": energy_objective,
    "position": position_objective,
}
"""All objectives by name; one more is an entry here, named in ``TrainingSettings.objectives``."""


def _per_network(values: Tensor) -> Tensor:
    """Mean over time and windows of ``(T, networks, n)``."""
    return values.mean(dim=(0, 2))


def _scored_xdot(windows: Windows) -> Tensor:
    return windows.xdot[:, windows.warm :].transpose(0, 1).unsqueeze(1)
