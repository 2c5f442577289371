"""What comes out of a training, and the models made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from hybrid_mpc.identification.cells import make_stack
from hybrid_mpc.identification.networks import StackedNetwork
from hybrid_mpc.identification.prior_stack import PREFIX, StackedPrior, with_values
from hybrid_mpc.identification.settings import TrainingSettings
from hybrid_mpc.identification.step import HybridStep, LiteralStep, RecurrentStep, Scaling, n_features
from hybrid_mpc.physics import Prior


@dataclass(frozen=True)
class Fault:
    """Updates of one network that were skipped because a number was not finite.

    Args:
        network: Its index.
        objective: The objective whose loss was not finite; ``"gradient"`` where all losses were finite.
        step: The last such update.
        stopped: Whether the network was stopped there, since too many came in a row; it then keeps its best
            weights by validation.
    """

    network: int
    objective: str
    step: int
    stopped: bool


@dataclass(frozen=True)
class Trained:
    """Result of a training: plain arrays, so that it travels between processes and into files.

    Args:
        settings: What it was trained with.
        scaling: Magnitudes inside the model.
        weights: Best weights of each network by its validation, stacked; parameters of the prior that were trained
            along are among them as ``prior.<name>`` ``(networks,)`` [SI].
        validation: Best validation error of each network ``(networks,)``.
        curve: ``step, free_run``, ``loss_`` and ``bound_`` with each objective's name, ``validation``; one row
            an evaluation, a column a network.
        skipped: Updates skipped for a loss that was not finite, per network.
        faults: Which objective they were skipped for, one entry a network that has any.
    """

    settings: TrainingSettings
    scaling: Scaling
    weights: Mapping[str, NDArray[np.float64]]
    validation: NDArray[np.float64]
    curve: Mapping[str, NDArray[np.float64]]
    skipped: NDArray[np.int64]
    faults: tuple[Fault, ...] = ()

    @property
    def best(self) -> int:
        """The network with the lowest validation error."""
        return int(np.argmin(self.validation))

    def step(self, prior: Prior, dt: float, i: int | None = None) -> RecurrentStep:
        """The step of network ``i`` (default: the best), around the prior's parameters that were trained with it.

        ``prior`` is the fitted one: it starts the parameters, and its energy balance and output are the step's.
        """
        i = self.best if i is None else i
        values = self.prior_values(i)
        dynamics = with_values(prior, values) if values else None
        stack = stack_for(prior, self.settings)
        own = {name: torch.tensor(w) for name, w in self.weights.items() if not name.startswith(PREFIX)}
        stack.load_state_dict(own)
        step = step_for(prior, stack.member(i), self.scaling, dt, self.settings, dynamics)
        return step.requires_grad_(False)

    def prior_values(self, i: int | None = None) -> dict[str, float]:
        """Values [SI] of the parameters trained along with network ``i`` (default: the best); empty if none were."""
        i = self.best if i is None else i
        return {n.removeprefix(PREFIX): float(w[i]) for n, w in self.weights.items() if n.startswith(PREFIX)}


def stack_for(prior: Prior, s: TrainingSettings) -> StackedNetwork:
    """The untrained stack of a training."""
    literal = s.form == "literal"
    n_in = n_features(prior, s.use_prior, literal=literal)
    n_out = len(prior.states) if literal else prior.n_q
    # a hybrid starts as its prior; the literal form has no such start
    zero_head = s.use_prior and not literal
    return make_stack(
        s.cell, s.networks, n_in, s.hidden, n_out, seed=s.seed, zero_head=zero_head, fused=s.fused
    )


def step_for(
    prior: Prior,
    network: nn.Module,
    scaling: Scaling,
    dt: float,
    s: TrainingSettings,
    dynamics: Prior | StackedPrior | None = None,
) -> RecurrentStep:
    """The step of a training around a network or a stack; ``dynamics`` has the parameters trained along."""
    form = LiteralStep if s.form == "literal" else HybridStep
    return form(prior, network, scaling, dt, use_prior=s.use_prior, dynamics=dynamics)
