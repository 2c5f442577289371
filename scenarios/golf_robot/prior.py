"""The golf robot's prior: the paper's equation of motion."""

from __future__ import annotations

from typing import Any

import casadi as ca

from hybrid_mpc import MechanicalPrior, OperatingPoint
from scenarios.golf_robot.nominal import GEAR, INPUTS, OUTPUTS, PARAMETERS, STATES


class GolfRobotPrior(MechanicalPrior):
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
    parameters = PARAMETERS
    operating_point = OperatingPoint((0.0, 0.0), (0.0,))  # it hangs

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia about the axis J [kg m^2]."""
        return p.J

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the club [J]."""
        return -p.m * p.g * p.a * ca.cos(q.phi)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous and dry friction ``d phi_dot + M_F`` [N m]."""
        load = ca.fabs(p.m * v.phi_dot * v.phi_dot * p.a + p.m * p.g * ca.cos(q.phi))
        return p.d * v.phi_dot + p.r * p.mu * ca.tanh(p.gamma * v.phi_dot) * load

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Motor torque at the club [N m]."""
        return GEAR * u.u
