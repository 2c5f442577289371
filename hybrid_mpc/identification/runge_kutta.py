"""Runge-Kutta of order 4 in torch, and the sub-steps that a model's stiffness asks for."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from hybrid_mpc.errors import InputError
from hybrid_mpc.physics import Prior

MAX_SUBSTEPS = 20
"""A prior stiffer than this many Runge-Kutta sub-steps a period can follow needs another dt."""


def rk4(f: Callable[[Tensor], Tensor], x: Tensor, dt: float, substeps: int) -> Tensor:
    """Classical Runge-Kutta of order 4 for ``xdot = f(x)`` over ``dt`` in equal sub-steps.

    Example:
        >>> x = rk4(lambda x: -x, torch.ones(1, dtype=torch.float64), 0.1, 2)
        >>> abs(x.item() - math.exp(-0.1)) < 1e-8
        True
    """
    s = dt / substeps
    for _ in range(substeps):
        k1 = f(x)
        k2 = f(x + 0.5 * s * k1)
        k3 = f(x + 0.5 * s * k2)
        k4 = f(x + s * k3)
        x = x + (s / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
    return x


def required_substeps(prior: Prior, dt: float) -> int:
    """Sub-steps a period that keep every eigenvalue of the prior at rest within 1 / sub-step.

    Friction is steepest at rest; Runge-Kutta of order 4 is stable up to 2.8 and accurate to per cents
    of the fast mode at 1.

    Raises:
        InputError: If more than ``MAX_SUBSTEPS`` would be needed.
    """
    return substeps_for(prior, len(prior.states), len(prior.inputs), dt, f"{type(prior).__name__}: the prior")


def substeps_for(f: Callable[[Tensor, Tensor], Tensor], n_x: int, n_u: int, dt: float, name: str) -> int:
    """:func:`required_substeps` of any ``xdot = f(x, u)``; ``name`` says in the error what is too stiff.

    Raises:
        InputError: If more than ``MAX_SUBSTEPS`` would be needed.
    """
    zeros = torch.zeros(n_x, dtype=torch.float64)
    u = torch.zeros(n_u, dtype=torch.float64)
    slope = torch.func.jacrev(lambda x: f(x, u))(zeros)
    rate = float(torch.linalg.eigvals(slope).abs().max())
    substeps = max(1, math.ceil(rate * dt))
    if not math.isfinite(rate) or substeps > MAX_SUBSTEPS:
        raise InputError(
            f"{name}'s fastest mode at rest is {rate:.3g} 1/s; a period of {dt} s "
            f"would need {substeps} sub-steps (at most {MAX_SUBSTEPS}). Smooth its friction (lower the slope "
            f"at zero speed) or take a smaller dt."
        )
    return substeps
