"""Objectives of the training, and the predictions along windows that they judge.

Each objective judges a prediction: one period from every measured state (:func:`teacher_forced`) or the model's own
free run (:func:`free_run`). How several are made one number is in :mod:`hybrid_mpc.identify.objectives`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, cast

import torch
from torch import Tensor

from hybrid_mpc.identify.dataset import Windows
from hybrid_mpc.identify.networks import StackedNetwork
from hybrid_mpc.identify.step import RecurrentStep

# Several objectives as one number: bounds that never rise, and as ablations weighted sum and augmented Lagrangian.
#
# All of them take losses ``(networks, objectives)`` relative to those at the start of a stage, so that units and
# magnitudes do not decide. ``value`` is minimised on mini-batches; ``updated`` takes the losses on a *fixed* set of
# windows, a statistic that means the same from step to step (mini-batch losses do not).

CombinationName = Literal["smooth_maximum", "hard_maximum", "weighted_sum", "augmented_lagrangian"]
MOST = 10.0
"""Largest multiplier and penalty: a violation never gets to zero on noisy data, and without a limit the first
objective would be forgotten."""
ENOUGH = 0.9
"""A penalty grows unless its objective has fallen to this share since the last update."""


class Combination:
    """What every way to combine has.

    Args:
        bounds: Losses that count as one, ``(networks, objectives)``.
    """

    def __init__(self, bounds: Tensor) -> None:
        self.bounds = bounds

    def value(self, losses: Tensor) -> Tensor:
        """The number to minimise ``(networks,)`` for losses ``(networks, objectives)``."""
        raise NotImplementedError(f"{type(self).__name__} must define value(losses)")

    def updated(self, losses: Tensor) -> Combination:
        """The combination after losses on the fixed windows."""
        return self

    def tensors(self) -> dict[str, Tensor]:
        """All that :func:`combine` needs to make it again."""
        return {"bounds": self.bounds}


class VectorPerformanceIndex(Combination):
    """Bounds ("default values") c_j of several objectives that only fall (Kreisselmeier & Steinhauser 1979).

    ``value`` is the smooth maximum ``1/rho log sum exp(rho L_j / c_j)``. ``lower`` takes the objectives on a
    *fixed* set of windows, a statistic that means the same from step to step (mini-batch losses do not):
    where none exceeds its bound, every bound is lowered to its objective. So no step that improves one
    objective at another's cost ever moves a bound.

    Args:
        bounds: Start values ``(networks, objectives)``, e.g. the fitted prior's objectives.
        rho: Sharpness of the maximum; 10 keeps the value within log(2)/10 of the hard maximum of two.
        hard: The maximum itself; only the objective that is worst has a gradient then.

    Example:
        >>> index = VectorPerformanceIndex(torch.tensor([[1.0, 1.0]]))
        >>> index.lower(torch.tensor([[0.5, 0.8]])).bounds.tolist()
        [[0.5, 0.800000011920929]]
        >>> index.lower(torch.tensor([[0.5, 1.1]])).bounds.tolist()
        [[1.0, 1.0]]
    """

    def __init__(self, bounds: Tensor, rho: float = 10.0, *, hard: bool = False) -> None:
        super().__init__(bounds)
        self.rho, self.hard = rho, hard

    def value(self, losses: Tensor) -> Tensor:
        """Maximum of ``losses / bounds`` ``(networks,)`` for losses ``(networks, objectives)``."""
        if self.hard:
            return (losses / self.bounds).amax(dim=-1)
        return torch.logsumexp(self.rho * losses / self.bounds, dim=-1) / self.rho

    def lower(self, losses: Tensor) -> VectorPerformanceIndex:
        """The index with bounds lowered where all objectives of a network keep theirs."""
        keeps = (losses <= self.bounds).all(dim=-1, keepdim=True)
        bounds = torch.where(keeps, torch.minimum(losses, self.bounds), self.bounds)
        return VectorPerformanceIndex(bounds, self.rho, hard=self.hard)

    def updated(self, losses: Tensor) -> VectorPerformanceIndex:
        """:meth:`lower`."""
        return self.lower(losses)


class WeightedSum(Combination):
    """Fixed weights: the ablation in which one objective may be traded for another.

    Args:
        bounds: Losses that count as one, ``(networks, objectives)``; they stay.
        weights: One for each objective; default: equal, of sum one.

    Example:
        >>> both = WeightedSum(torch.tensor([[1.0, 4.0]]), (0.75, 0.25))
        >>> both.value(torch.tensor([[1.0, 2.0]])).tolist()
        [0.875]
    """

    def __init__(self, bounds: Tensor, weights: Sequence[float] = ()) -> None:
        super().__init__(bounds)
        n = bounds.shape[-1]
        self.weights = bounds.new_tensor(tuple(weights) or (1.0 / n,) * n)

    def value(self, losses: Tensor) -> Tensor:
        """Weighted sum of ``losses / bounds``."""
        return (losses / self.bounds * self.weights).sum(-1)


class AugmentedLagrangian(Combination):
    """The first objective under the constraints that all others vanish, each network with its own multipliers.

    ``value = L_1 + sum_j (lambda_j L_j + mu_j / 2 L_j^2)``, all relative to their bounds. At every update
    ``lambda_j`` grows by ``mu_j L_j``, and ``mu_j`` doubles unless ``L_j`` fell to ``ENOUGH`` of what it was;
    both stay below ``MOST``.

    Args:
        bounds: Losses that count as one, ``(networks, objectives)``; they stay.
        multipliers: lambda ``(networks, objectives - 1)``; default: zero.
        penalties: mu ``(networks, objectives - 1)``; default: one.
        last: Relative losses of the constraints at the last update; default: infinity.

    Source: Dener et al.: Training neural networks under physical constraints using a stochastic augmented
    Lagrangian approach (2020); the limits are this project's.

    Example:
        >>> both = AugmentedLagrangian(torch.tensor([[1.0, 1.0]]))
        >>> both.value(torch.tensor([[1.0, 2.0]])).tolist()
        [3.0]
        >>> both.updated(torch.tensor([[1.0, 2.0]])).value(torch.tensor([[1.0, 2.0]])).tolist()
        [7.0]
    """

    def __init__(
        self,
        bounds: Tensor,
        multipliers: Tensor | None = None,
        penalties: Tensor | None = None,
        last: Tensor | None = None,
    ) -> None:
        super().__init__(bounds)
        free = bounds[..., 1:]
        self.multipliers = torch.zeros_like(free) if multipliers is None else multipliers
        self.penalties = torch.ones_like(free) if penalties is None else penalties
        self.last = torch.full_like(free, torch.inf) if last is None else last

    def value(self, losses: Tensor) -> Tensor:
        """First objective, multipliers and penalties of the others."""
        relative = losses / self.bounds
        c = relative[..., 1:]
        return relative[..., 0] + (self.multipliers * c + 0.5 * self.penalties * c.square()).sum(-1)

    def updated(self, losses: Tensor) -> AugmentedLagrangian:
        """Multipliers and penalties after losses on the fixed windows; those that are no number change nothing."""
        c = (losses / self.bounds)[..., 1:]
        known = torch.isfinite(c)
        grown = torch.where(c > ENOUGH * self.last, 2.0 * self.penalties, self.penalties)
        return AugmentedLagrangian(
            self.bounds,
            torch.where(known, self.multipliers + self.penalties * c, self.multipliers).clamp_max(MOST),
            torch.where(known, grown, self.penalties).clamp_max(MOST),
            torch.where(known, c, self.last),
        )

    def tensors(self) -> dict[str, Tensor]:
        """All that :func:`combine` needs to make it again."""
        own = {"multipliers": self.multipliers, "penalties": self.penalties, "last": self.last}
        return super().tensors() | own


def combine(
    name: CombinationName, tensors: Mapping[str, Tensor], weights: Sequence[float] = ()
) -> Combination:
    """A combination by name.

    Args:
        name: ``"smooth_maximum"``, ``"hard_maximum"``, ``"weighted_sum"`` or ``"augmented_lagrangian"``.
        tensors: At least ``bounds``, the losses at the start; or what ``Combination.tensors`` gave.
        weights: Of the weighted sum; default: equal.

    Example:
        >>> combine("hard_maximum", {"bounds": torch.ones(1, 2)}).value(torch.tensor([[0.5, 0.8]])).tolist()
        [0.800000011920929]
    """
    if name == "weighted_sum":
        return WeightedSum(tensors["bounds"], weights)
    if name == "augmented_lagrangian":
        return AugmentedLagrangian(**tensors)
    return VectorPerformanceIndex(tensors["bounds"], hard=name == "hard_maximum")


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
