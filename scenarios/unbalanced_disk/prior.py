"""Prior of the unbalanced disk: a driven pendulum with viscous and dry friction, scaled by its inertia."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import MechanicalPrior, OperatingPoint, Parameter, Signal
from scenarios.unbalanced_disk.nominal import INPUTS, OUTPUTS, PARAMETERS, STATES

FRICTION_SPEED = 0.05
"""Speed [rad/s] over which dry friction changes its sign. The data ask for a sharper one (a fit ran to the smallest it
was given); this is what a few Runge-Kutta steps a period can follow."""


class UnbalancedDiskPrior(MechanicalPrior):
    r"""``phi_ddot = -w_0^2 sin(phi + phi_0) - gamma phi_dot - F_c tanh(phi_dot / v_c) + K_u u``; phi = 0 hangs down.

    ``u`` is the motor's voltage: ``gamma`` holds the back-EMF beside the bearing's friction. Motion tells accelerations
    only; ``J`` is fixed and turns them into torques, so that the energy balance is in watts.

    Source: structure and nominal values, GerbenBeintema/gym-unbalanced-disk; J from the first version of its simulator.
    """

    states: ClassVar[tuple[Signal, ...]] = STATES
    inputs: ClassVar[tuple[Signal, ...]] = INPUTS
    outputs: ClassVar[tuple[Signal, ...]] = OUTPUTS
    parameters: ClassVar[tuple[Parameter, ...]] = PARAMETERS
    operating_point: ClassVar[OperatingPoint | None] = OperatingPoint((0.0, 0.0), (0.0,))  # it hangs

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia about the axis J [kg m^2]."""
        return p.J

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the disk's weight [J]."""
        return -p.J * p.w_0 * p.w_0 * ca.cos(q.phi + p.phi_0)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction, the motor's back-EMF and dry friction [N m]."""
        return p.J * (p.gamma * v.phi_dot + p.F_c * ca.tanh(v.phi_dot / FRICTION_SPEED))

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Torque of the motor's voltage [N m]."""
        return p.J * p.K_u * u[0]
