"""Parameters of a prior that are trained along with the networks: each stacked network has its own."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.func import functional_call, vmap

from hybrid_mpc.errors import InputError
from hybrid_mpc.physics import Prior

PREFIX = "prior."
"""What the names of trained parameters begin with among a training's weights."""


class StackedPrior(nn.Module):
    """A prior with parameters of its own for each of several networks.

    What is trained is the way from the prior's value in units of the parameter's range, ``(networks, 1)``, zero at
    first: weight decay then pulls towards the prior, as it pulls a network's weights towards no correction.
    :meth:`project` keeps the values within their bounds.

    Args:
        prior: The fitted prior, where all of them start; it is not changed.
        networks: Number of networks.

    Raises:
        InputError: If the prior has no parameter that is free.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> stack = StackedPrior(PendulumPrior(), 2)
        >>> {name: value.tolist() for name, value in stack.values().items()}
        {'l': [0.05, 0.05], 'd': [2.0, 2.0]}
    """

    def __init__(self, prior: Prior, networks: int) -> None:
        super().__init__()
        free = [spec for spec in prior.parameters_spec if not spec.fixed]
        if not free:
            raise InputError(
                f"{type(prior).__name__} has no free parameter to train along (all have lower == upper); "
                "leave prior_parameters 'fixed' or give one of them bounds"
            )
        self.networks, start = networks, prior.values
        self._prior = (prior,)  # in a tuple: its parameters are no part of what is trained
        self._spec = {p.name: (start[p.name], p.lower, p.upper) for p in free}
        zeros = torch.zeros(networks, 1, dtype=torch.float64)
        self.ways = nn.ParameterDict({name: nn.Parameter(zeros.clone()) for name in self._spec})

    def values(self) -> dict[str, Tensor]:
        """Values [SI] of each free parameter, ``(networks,)``."""
        return {
            name: start + (upper - lower) * self.ways[name][:, 0]
            for name, (start, lower, upper) in self._spec.items()
        }

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        """Derivative ``(..., networks, batch, n_x)`` at ``x`` and ``u``, whose third axis from the end may be 1."""
        x, u = (z.expand(*z.shape[:-3], self.networks, *z.shape[-2:]) for z in (x, u))

        def one(values: dict[str, Tensor], x: Tensor, u: Tensor) -> Tensor:
            derivative: Tensor = functional_call(self._prior[0], values, (x, u))
            return derivative

        derivative: Tensor = vmap(one, in_dims=(0, -3, -3), out_dims=-3)(self.values(), x, u)
        return derivative

    def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
        """Accelerations ``(..., networks, batch, n_q)``."""
        n_q = self._prior[0].n_q
        return self.forward(x, u)[..., n_q : 2 * n_q]

    def project(self) -> None:
        """Put values that have left their bounds back onto them."""
        with torch.no_grad():
            for name, (start, lower, upper) in self._spec.items():
                span = upper - lower
                self.ways[name].clamp_((lower - start) / span, (upper - start) / span)

    def weights(self) -> dict[str, nn.Parameter]:
        """What is trained, by name."""
        return {f"{PREFIX}{name}": way for name, way in self.ways.items()}

    def in_si(self, weights: Mapping[str, Tensor]) -> dict[str, NDArray[np.float64]]:
        """Values [SI] ``(networks,)`` of weights named as those of :meth:`weights`, none beyond its bound."""
        out = {}
        for name, (start, lower, upper) in self._spec.items():
            way = weights[f"{PREFIX}{name}"][:, 0].cpu().numpy()
            out[f"{PREFIX}{name}"] = np.clip(start + (upper - lower) * way, lower, upper)
        return out


def with_values(prior: Prior, values: Mapping[str, float]) -> Prior:
    """A copy of a prior with other parameter values [SI].

    Raises:
        InputError: If the prior has no such parameter.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> with_values(PendulumPrior(), {"d": 2.1}).values["d"]
        2.1
    """
    unknown = set(values) - set(prior.values)
    if unknown:
        raise InputError(
            f"{type(prior).__name__} has no parameter {', '.join(sorted(unknown))}, which was trained along; "
            "give the prior of the training"
        )
    copied = copy.deepcopy(prior)
    with torch.no_grad():
        for name, value in values.items():
            getattr(copied, name).fill_(value)
    return copied
