"""Prior of the pendulum on a servo: a direct-current motor, viscous and dry friction."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from hybrid_mpc import Parameter, Prior, Signal

FRICTION_SPEED = 0.1
"""Speed [rad/s] over which dry friction changes its sign."""


class Xl330PendulumPrior(Prior):
    """``J phi_ddot = e k_t / R (duty U - k_t phi_dot) - mgl sin(phi + phi_0) - d phi_dot - F_c tanh(phi_dot / v_c)``.

    ``e`` is 1 with the motor switched on and 0 without. The weight is known and sets the scale; ``k_t`` and ``R`` show
    by ``k_t / R`` and ``k_t^2 / R``. Friction that grows with the load is left to the network.

    Source: Duclusaud, Passault, Padois, Ly, *Extended friction models for the physics simulation of servo actuators*
    (ICRA 2025), whose fit gives the nominal values.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("phi", "rad", -20.0, 20.0, periodic=True),
        Signal("phi_dot", "rad/s", -60.0, 60.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (
        Signal("duty", "-", -1.0, 1.0),
        Signal("supply", "V", 0.0, 14.0),
        Signal("enabled", "-", 0.0, 1.0),
    )
    outputs: ClassVar[tuple[Signal, ...]] = (states[0],)
    parameters_spec: ClassVar[tuple[Parameter, ...]] = (
        Parameter("mgl", 0.4807, "N m", 0.4807, 0.4807, "largest gravity torque: 0.49 kg at 0.10 m (fixed)"),
        Parameter("J", 0.00671, "kg m^2", 0.004, 0.015, "inertia with the rotor's"),
        Parameter("k_t", 0.387, "N m/A", 0.1, 1.0, "torque constant at the output"),
        Parameter("R", 4.02, "ohm", 1.0, 12.0, "resistance"),
        Parameter("d", 0.00366, "N m s/rad", 0.0, 0.1, "viscous friction"),
        Parameter("F_c", 0.0128, "N m", 0.0, 0.3, "dry friction"),
        Parameter("phi_0", 0.0, "rad", -0.2, 0.2, "angle of the encoder's zero from hanging down"),
    )

    mgl: Tensor
    J: Tensor
    k_t: Tensor
    R: Tensor
    d: Tensor
    F_c: Tensor
    phi_0: Tensor

    def inertia(self, x: Tensor) -> Tensor:
        """Inertia about the axis J [kg m^2], shape ``()``."""
        return self.J

    def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
        """Angular acceleration ``(..., 1)`` [rad/s^2]."""
        phi, v = x[..., 0:1], x[..., 1:2]
        voltage = u[..., 0:1] * u[..., 1:2] - self.k_t * v
        motor = u[..., 2:3] * self.k_t / self.R * voltage
        friction = self.d * v + self.F_c * torch.tanh(v / FRICTION_SPEED)
        return (motor - self.mgl * torch.sin(phi + self.phi_0) - friction) / self.J
