"""Prior of the torque-driven pendulum: rigid rod, viscous and dry friction."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import MechanicalPrior, OperatingPoint, Parameter, Signal

FRICTION_SPEED = 0.1
"""Speed [rad/s] over which dry friction changes its sign, about the noise of the measured speed."""


class TorquePendulumPrior(MechanicalPrior):
    r"""``J phi_ddot = k_u u - mgl sin(phi + phi_0) - d phi_dot - F_c tanh(phi_dot / v_c)``; phi = 0 hangs down.

    Motion alone fixes only the ratios of ``J, mgl, d, F_c, k_u``, so ``J`` keeps its data-sheet value and
    the others are fitted relative to it. A fitted ``k_u`` below 1 holds the drive's losses and torque
    constant and the error of ``J``. Energy shaping commands ``u`` with the sign of the speed, which makes
    ``k_u`` and ``F_c`` hard to tell apart in one recording; fit runs of different torque together.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("phi", "rad", -40.0, 40.0, periodic=True),
        Signal("phi_dot", "rad/s", -40.0, 40.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("torque", "N m", -5.0, 5.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (states[0],)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("J", 0.15, "kg m^2", 0.15, 0.15, "inertia about the axis (fixed: only ratios show)"),
        Parameter("mgl", 2.98, "N m", 2.0, 4.0, "largest gravity torque"),
        Parameter("d", 0.005, "N m s/rad", 0.0, 0.1, "viscous friction"),
        Parameter("F_c", 0.19, "N m", 0.0, 0.5, "dry friction"),
        Parameter("phi_0", 0.0, "rad", -0.1, 0.1, "angle of the encoder's zero from hanging down"),
        Parameter("k_u", 1.0, "-", 0.5, 1.2, "true over commanded torque"),
    )
    operating_point: ClassVar[OperatingPoint | None] = OperatingPoint((0.0, 0.0), (0.0,))  # it hangs

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia about the axis J [kg m^2]."""
        return p.J

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the rod [J]."""
        return -p.mgl * ca.cos(q.phi + p.phi_0)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous and dry friction [N m]."""
        return p.d * v.phi_dot + p.F_c * ca.tanh(v.phi_dot / FRICTION_SPEED)

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Torque of the drive [N m]."""
        return p.k_u * u.torque
