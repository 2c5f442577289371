"""The damped pendulum's prior: the paper's equation of motion (torch)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from hybrid_mpc import Parameter, Prior, Signal
from scenarios.pendulum.nominal import INPUTS, OUTPUTS, PARAMETERS, PUBLISHED, STATES


class PendulumPrior(Prior):
    """``phi_ddot = (-m g l sin phi - d phi_dot + u) / (m l^2)`` (Schön, Götte, Timmermann 2022, system 1).

    ``phi = 0`` hangs down, ``u`` is the torque on the axis [N m]. The known torque sets the scale: ``m l^2``,
    ``m g l`` and ``d`` show in the motion, and with m and g fixed a fit frees l and d.
    """

    states: ClassVar[tuple[Signal, ...]] = STATES
    inputs: ClassVar[tuple[Signal, ...]] = INPUTS
    outputs: ClassVar[tuple[Signal, ...]] = OUTPUTS
    parameters_spec: ClassVar[tuple[Parameter, ...]] = PARAMETERS

    m: Tensor
    g: Tensor
    l: Tensor  # noqa: E741  the paper's name
    d: Tensor

    def inertia(self, x: Tensor) -> Tensor:
        """Inertia about the axis ``m l^2`` [kg m^2], shape ``()``."""
        return self.m * self.l * self.l

    def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
        """Acceleration ``(..., 1)`` [rad/s^2] at ``x`` ``(..., 2)`` and ``u`` ``(..., 1)``."""
        phi, v = x[..., 0:1], x[..., 1:2]
        gravity = self.m * self.g * self.l * torch.sin(phi)
        return (u - gravity - self.d * v) / self.inertia(x)

    def energy_balance(self, x: Tensor, xdot: Tensor, u: Tensor) -> Tensor:
        """Energy balance [W], shape ``(...)``: m l^2 a v + m g l v sin phi + d v^2 - u v."""
        phi, v = x[..., 0], x[..., 1]
        gravity = self.m * self.g * self.l * torch.sin(phi)
        return v * (self.inertia(x) * xdot[..., 1] + gravity + self.d * v - u[..., 0])


class PublishedPendulumPrior(PendulumPrior):
    """The same with every parameter fixed at its published value: a fit leaves it alone, as the paper does.

    With l and d free a fit finds the plant itself, since nothing else is wrong: no network could add to that.
    """

    parameters_spec: ClassVar[tuple[Parameter, ...]] = PUBLISHED
