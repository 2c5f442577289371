"""Prior of the unbalanced disk: a driven pendulum with viscous and dry friction, scaled by its inertia."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from hybrid_mpc import Parameter, Prior, Signal
from scenarios.unbalanced_disk.nominal import INPUTS, OUTPUTS, PARAMETERS, STATES

FRICTION_SPEED = 0.05
"""Speed [rad/s] over which dry friction changes its sign. The data ask for a sharper one (a fit ran to the smallest it
was given); this is what a few Runge-Kutta steps a period can follow."""


class UnbalancedDiskPrior(Prior):
    r"""``phi_ddot = -w_0^2 sin(phi + phi_0) - gamma phi_dot - F_c tanh(phi_dot / v_c) + K_u u``; phi = 0 hangs down.

    ``u`` is the motor's voltage: ``gamma`` holds the back-EMF beside the bearing's friction. Motion tells accelerations
    only; ``J`` is fixed and turns them into torques, so that the energy balance is in watts.

    Source: structure and nominal values, GerbenBeintema/gym-unbalanced-disk; J from the first version of its simulator.
    """

    states: ClassVar[tuple[Signal, ...]] = STATES
    inputs: ClassVar[tuple[Signal, ...]] = INPUTS
    outputs: ClassVar[tuple[Signal, ...]] = OUTPUTS
    parameters_spec: ClassVar[tuple[Parameter, ...]] = PARAMETERS

    J: Tensor
    w_0: Tensor
    gamma: Tensor
    F_c: Tensor
    K_u: Tensor
    phi_0: Tensor

    def inertia(self, x: Tensor) -> Tensor:
        """Inertia about the axis J [kg m^2], shape ``()``."""
        return self.J

    def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
        """Angular acceleration ``(..., 1)`` [rad/s^2]."""
        phi, v = x[..., 0:1], x[..., 1:2]
        friction = self.gamma * v + self.F_c * torch.tanh(v / FRICTION_SPEED)
        return self.K_u * u - self.w_0 * self.w_0 * torch.sin(phi + self.phi_0) - friction
