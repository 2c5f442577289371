"""Prior of the double pendulum: two rigid links, two geared motors, viscous and dry friction."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import MechanicalPrior, OperatingPoint, Parameter, Signal

GRAVITY = 9.81
LINK_1 = 0.2
"""Length of the first link [m]."""
GEAR = 6.0
"""Turns of a motor for one of its joint."""
FRICTION_SPEED = 0.05
"""Speed [rad/s] over which dry friction changes its sign: as sharp as a few Runge-Kutta steps a period can follow."""


class DoublePendulumPrior(MechanicalPrior):
    """``M(q) q_ddot + C(q, q_dot) q_dot + dV/dq + friction = torques``.

    q1 counts from hanging down, q2 from the first link.
    ``M_11 = I_1 + I_2 + m_2 l_1^2 + 2 l_1 mr_2 cos q_2 + (g^2 + 1) I_r``, ``M_12 = I_2 + l_1 mr_2 cos q_2 - g I_r``,
    ``M_22 = I_2 + g^2 I_r``. The mass of the second link and the rotors' inertia are those of the source: motion tells
    ``I_1 + m_2 l_1^2`` and ``mr_1 + m_2 l_1`` alone.

    Source: Wiebe, Kumar, Shala, Vyas, Javadi, Kirchner, *Open source dual-purpose acrobot and pendubot platform*, IEEE
    RAM (2023), design C.1.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("q1", "rad", -20.0, 20.0, periodic=True),
        Signal("q2", "rad", -20.0, 20.0, periodic=True),
        Signal("v1", "rad/s", -40.0, 40.0),
        Signal("v2", "rad/s", -60.0, 60.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (
        Signal("tau1", "N m", -8.0, 8.0),
        Signal("tau2", "N m", -8.0, 8.0),
    )
    outputs: ClassVar[tuple[Signal, ...]] = states
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("I_1", 0.0319, "kg m^2", 0.01, 0.06, "first link about its joint"),
        Parameter("I_2", 0.0509, "kg m^2", 0.02, 0.09, "second link about its joint"),
        Parameter("mr_1", 0.1047, "kg m", 0.05, 0.2, "first moment of the first link"),
        Parameter("mr_2", 0.16, "kg m", 0.08, 0.25, "first moment of the second link"),
        Parameter("m_2", 0.6256, "kg", 0.6256, 0.6256, "mass of the second link (fixed)"),
        Parameter("I_r", 6.29e-5, "kg m^2", 6.29e-5, 6.29e-5, "rotor of a motor (fixed)"),
        Parameter("b_1", 0.001, "N m s/rad", 0.0, 0.1, "viscous friction of the first joint"),
        Parameter("b_2", 0.001, "N m s/rad", 0.0, 0.1, "of the second joint"),
        Parameter("F_1", 0.2, "N m", 0.0, 0.4, "dry friction of the first joint"),
        Parameter("F_2", 0.15, "N m", 0.0, 0.4, "of the second joint"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint(x=(0.0, 0.0, 0.0, 0.0), u=(0.0, 0.0))

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertias of links and rotors [kg m^2]."""
        coupling = LINK_1 * p.mr_2 * ca.cos(q.q2)
        off = p.I_2 + coupling - GEAR * p.I_r
        first = p.I_1 + p.I_2 + p.m_2 * LINK_1**2 + 2 * coupling + (GEAR**2 + 1) * p.I_r
        return (first, off), (off, p.I_2 + GEAR**2 * p.I_r)

    def potential(self, q: Any, p: Any) -> Any:
        """Height of both links [J]."""
        first = (p.mr_1 + p.m_2 * LINK_1) * ca.cos(q.q1)
        return -GRAVITY * (first + p.mr_2 * ca.cos(q.q1 + q.q2))

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous and dry friction of both joints [N m]."""
        return (
            p.b_1 * v.v1 + p.F_1 * ca.tanh(v.v1 / FRICTION_SPEED),
            p.b_2 * v.v2 + p.F_2 * ca.tanh(v.v2 / FRICTION_SPEED),
        )
