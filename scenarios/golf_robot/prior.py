"""The golf robot's prior: the paper's equation of motion (torch)."""

from __future__ import annotations

import torch
from torch import Tensor

from hybrid_mpc import Prior
from scenarios.golf_robot.nominal import GEAR, INPUTS, OUTPUTS, PARAMETERS, STATES


class GolfRobotPrior(Prior):
    """Club on a belt drive with load-dependent dry friction (Schön, Götte, Timmermann 2022, system 2).

    ``phi_ddot = (-m g a sin phi - d phi_dot - M_F + 4 u) / J`` with
    ``M_F = r mu tanh(gamma phi_dot) |m phi_dot^2 a + m g cos phi|``; ``u`` is the motor torque [N m].

    What a fit may free: the known gain 4 u sets the scale, so ``J``, ``m g a``, ``d`` and ``r mu m``
    are identifiable, but not m, g, a one by one and not r and mu. Hence m, g, r are fixed and a, J, d,
    mu, gamma are free. The paper gives no gamma; 50 s/rad takes friction to 96 % at 0.04 rad/s.
    Bounds: ``r mu gamma m g / J`` stays below 192 1/s, so RK4 sub-steps of 10 ms are stable (1.92 < 2).
    """

    states = STATES
    inputs = INPUTS
    outputs = OUTPUTS
    parameters_spec = PARAMETERS

    m: Tensor
    g: Tensor
    r: Tensor
    a: Tensor
    J: Tensor
    d: Tensor
    mu: Tensor
    gamma: Tensor

    def friction(self, x: Tensor) -> Tensor:
        """Dry friction torque M_F [N m], shape ``(...)``."""
        phi, v = x[..., 0], x[..., 1]
        load = torch.abs(self.m * v * v * self.a + self.m * self.g * torch.cos(phi))
        return self.r * self.mu * torch.tanh(self.gamma * v) * load

    def inertia(self, x: Tensor) -> Tensor:
        """Inertia about the axis J [kg m^2], shape ``()``."""
        return self.J

    def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
        """Acceleration ``(..., 1)`` [rad/s^2] at ``x`` ``(..., 2)`` and ``u`` ``(..., 1)``."""
        phi, v = x[..., 0], x[..., 1]
        gravity = self.m * self.g * self.a * torch.sin(phi)
        torque = GEAR * u[..., 0] - gravity - self.d * v - self.friction(x)
        return (torque / self.J).unsqueeze(-1)

    def energy_balance(self, x: Tensor, xdot: Tensor, u: Tensor) -> Tensor:
        """Energy balance [W], shape ``(...)``: J a v + m g a v sin phi + d v^2 + M_F v - 4 u v."""
        phi, v = x[..., 0], x[..., 1]
        gravity = self.m * self.g * self.a * torch.sin(phi)
        return v * (self.J * xdot[..., 1] + gravity + self.d * v + self.friction(x) - GEAR * u[..., 0])
