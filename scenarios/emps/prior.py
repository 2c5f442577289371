"""Prior of the EMPS: a mass with viscous and dry friction."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import MechanicalPrior, Parameter, Signal

FRICTION_SPEED = 2e-3
"""Speed [m/s] over which dry friction changes its sign, a twentieth of the slowest motion."""


class EmpsPrior(MechanicalPrior):
    """``M q_ddot = F - F_v q_dot - F_a |q_dot| - F_c tanh(q_dot / v_c) - offset``.

    ``F_a`` is viscous friction that differs by direction. A constant offset cannot stand for it: with it free runs over
    the recording's first half are fitted to 0.5 mm, without it to 1.7 mm, and the offset then nearly vanishes.

    Source: A. Janot, M. Gautier, M. Brunot, *Data Set and Reference Models of EMPS* (2019), with the nominal values.
    """

    states: ClassVar[tuple[Signal, ...]] = (Signal("q", "m", -1.0, 1.0), Signal("q_dot", "m/s", -5.0, 5.0))
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("force", "N", -1000.0, 1000.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (states[0],)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("M", 95.11, "kg", 50.0, 150.0, "inertia at the carriage"),
        Parameter("F_v", 203.5, "N s/m", 50.0, 400.0, "viscous friction"),
        Parameter("F_c", 20.39, "N", 0.0, 60.0, "dry friction"),
        Parameter("F_a", 0.0, "N s/m", -50.0, 50.0, "viscous friction forward more than backward"),
        Parameter("offset", -3.16, "N", -20.0, 20.0, "offset of the force"),
    )

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Mass M [kg]."""
        return p.M

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous and dry friction [N]."""
        speed = v.q_dot
        return p.F_v * speed + p.F_a * ca.fabs(speed) + p.F_c * ca.tanh(speed / FRICTION_SPEED)

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Force of the drive [N] less the offset."""
        return u.force - p.offset
