"""The damped pendulum's prior: the paper's equation of motion (torch)."""

from __future__ import annotations

from typing import Any, ClassVar

import torch

from hybrid_mpc import MechanicalPrior, OperatingPoint, Parameter, Signal, TorchPrior
from scenarios.pendulum.nominal import INPUTS, OUTPUTS, PARAMETERS, PUBLISHED, STATES


class PendulumPrior(TorchPrior, MechanicalPrior):
    """``phi_ddot = (-m g l sin phi - d phi_dot + u) / (m l^2)`` (Schön, Götte, Timmermann 2022, system 1).

    ``phi = 0`` hangs down, ``u`` is the torque on the axis [N m]. The known torque sets the scale: ``m l^2``,
    ``m g l`` and ``d`` show in the motion, and with m and g fixed a fit frees l and d.
    """

    states: ClassVar[tuple[Signal, ...]] = STATES
    inputs: ClassVar[tuple[Signal, ...]] = INPUTS
    outputs: ClassVar[tuple[Signal, ...]] = OUTPUTS
    parameters: ClassVar[tuple[Parameter, ...]] = PARAMETERS
    operating_point: ClassVar[OperatingPoint | None] = OperatingPoint((0.0, 0.0), (0.0,))  # it hangs

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia about the axis ``m l^2`` [kg m^2]."""
        return p.m * p.l * p.l

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the weight [J]."""
        return -p.m * p.g * p.l * torch.cos(q.phi)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction [N m]."""
        return p.d * v.phi_dot


class PublishedPendulumPrior(PendulumPrior):
    """The same with every parameter fixed at its published value: a fit leaves it alone, as the paper does.

    With l and d free a fit finds the plant itself, since nothing else is wrong: no network could add to that.
    """

    parameters: ClassVar[tuple[Parameter, ...]] = PUBLISHED
