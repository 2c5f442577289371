"""Prior of the pendulum on a servo: a direct-current motor, viscous and dry friction."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import MechanicalPrior, OperatingPoint, Parameter, Signal

FRICTION_SPEED = 0.1
"""Speed [rad/s] over which dry friction changes its sign."""


class Xl330PendulumPrior(MechanicalPrior):
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
    operating_point: ClassVar[OperatingPoint] = OperatingPoint(
        x=(0.0, 0.0), u=(0.0, 12.0, 1.0)
    )  # hangs, powered
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("mgl", 0.4807, "N m", 0.4807, 0.4807, "largest gravity torque: 0.49 kg at 0.10 m (fixed)"),
        Parameter("J", 0.00671, "kg m^2", 0.004, 0.015, "inertia with the rotor's"),
        Parameter("k_t", 0.387, "N m/A", 0.1, 1.0, "torque constant at the output"),
        Parameter("R", 4.02, "ohm", 1.0, 12.0, "resistance"),
        Parameter("d", 0.00366, "N m s/rad", 0.0, 0.1, "viscous friction"),
        Parameter("F_c", 0.0128, "N m", 0.0, 0.3, "dry friction"),
        Parameter("phi_0", 0.0, "rad", -0.2, 0.2, "angle of the encoder's zero from hanging down"),
    )

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia about the axis J [kg m^2]."""
        return p.J

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the weight [J]."""
        return -p.mgl * ca.cos(q.phi + p.phi_0)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous and dry friction [N m]."""
        return p.d * v.phi_dot + p.F_c * ca.tanh(v.phi_dot / FRICTION_SPEED)

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Torque of the motor [N m]."""
        voltage = u.duty * u.supply - p.k_t * v.phi_dot
        return u.enabled * p.k_t / p.R * voltage
