"""Priors that tests share, each written in CasADi and in torch: two tanks, a pendulum, an arm of two links."""

import casadi as ca
import torch

from hybrid_mpc import Balance, MechanicalPrior, Parameter, Prior, Signal, TorchPrior

SHALLOW = 1e-4
"""Level [m] below which a tank's outflow keeps to a finite slope."""


class _Tanks:
    """One tank that drains into another; the first one's level has no sensor, rain falls into the second."""

    states = (Signal("upper", "m", 0.0, 2.0), Signal("lower", "m", 0.0, 2.0))
    inputs = (Signal("inflow", "m^3/s", 0.0, 0.4),)
    outputs = (Signal("lower", "m"),)
    disturbances = (Signal("rain", "m^3/s", 0.0, 0.2),)
    parameters = (
        Parameter("a_1", 1.0, "m^2", 1.0, 1.0),  # an outlet that is not seen tells k_1^2 / a_1 alone
        Parameter("a_2", 1.5, "m^2", 0.3, 3.0),
        Parameter("k_1", 0.15, "m^2.5/s", 0.05, 0.6),
        Parameter("k_2", 0.3, "m^2.5/s", 0.05, 0.6),
    )

    def flows(self, x, p):
        raise NotImplementedError

    def xdot(self, x, u, w, p):
        out_1, out_2 = self.flows(x, p)
        return (u.inflow - out_1) / p.a_1, (out_1 + w.rain - out_2) / p.a_2

    def balances(self, x, u, w, p):
        volume = p.a_1 * x.upper + p.a_2 * x.lower
        return (Balance("volume", volume, u.inflow + w.rain, self.flows(x, p)[1], "m^3", "m^3/s"),)


class Tanks(_Tanks, Prior):
    def flows(self, x, p):
        return p.k_1 * ca.sqrt(ca.fmax(x.upper, SHALLOW)), p.k_2 * ca.sqrt(ca.fmax(x.lower, SHALLOW))


class TorchTanks(_Tanks, TorchPrior):
    def flows(self, x, p):
        return tuple(k * level.clamp_min(SHALLOW).sqrt() for k, level in ((p.k_1, x.upper), (p.k_2, x.lower)))


TANKS = {"a_1": 1.0, "a_2": 1.2, "k_1": 0.2, "k_2": 0.22}
"""What the tanks of these tests are."""


class _Swing:
    states = (Signal("phi", "rad", periodic=True), Signal("phi_dot", "rad/s"))
    inputs = (Signal("torque", "N m"),)
    outputs = (Signal("phi", "rad"),)
    parameters = (
        Parameter("J", 0.15, "kg m^2", 0.02, 0.5),
        Parameter("mgl", 1.0, "N m", 0.2, 5.0),
        Parameter("d", 0.01, "N m s/rad", 0.0, 0.5),
    )

    def mass_matrix(self, q, p):
        return p.J

    def friction(self, q, v, p):
        return p.d * v.phi_dot


class Swing(_Swing, MechanicalPrior):
    def potential(self, q, p):
        return -p.mgl * ca.cos(q.phi)


class TorchSwing(_Swing, TorchPrior, MechanicalPrior):
    def potential(self, q, p):
        return -p.mgl * torch.cos(q.phi)


class _Arm:
    """Two links that turn freely, a motor at each joint; the mass matrix is full and changes with the elbow's angle."""

    states = (
        Signal("q_1", "rad", periodic=True), Signal("q_2", "rad", periodic=True),
        Signal("v_1", "rad/s", -4.0, 4.0), Signal("v_2", "rad/s", -4.0, 4.0),
    )  # fmt: skip
    inputs = (Signal("tau_1", "N m", -5.0, 5.0), Signal("tau_2", "N m", -5.0, 5.0))
    outputs = (Signal("q_1", "rad"), Signal("q_2", "rad"))
    parameters = (
        Parameter("a", 3.0, "kg m^2", 2.5, 4.0),
        Parameter("b", 0.5, "kg m^2", 0.3, 0.7),
        Parameter("c", 0.6, "kg m^2", 0.4, 0.8),
        Parameter("g_1", 20.0, "N m", 10.0, 30.0),
        Parameter("g_2", 6.0, "N m", 3.0, 9.0),
        Parameter("d", 0.3, "N m s/rad", 0.0, 1.0),
    )

    def friction(self, q, v, p):
        return p.d * v.v_1, 2.0 * p.d * v.v_2


class Arm(_Arm, MechanicalPrior):
    def mass_matrix(self, q, p):
        bend = p.b * ca.cos(q.q_2)
        return (p.a + 2 * bend, p.c + bend), (p.c + bend, p.c)

    def potential(self, q, p):
        return p.g_1 * ca.sin(q.q_1) + p.g_2 * ca.sin(q.q_1 + q.q_2)


class TorchArm(_Arm, TorchPrior, MechanicalPrior):
    def mass_matrix(self, q, p):
        bend = p.b * torch.cos(q.q_2)
        return (p.a + 2 * bend, p.c + bend), (p.c + bend, p.c)

    def potential(self, q, p):
        return p.g_1 * torch.sin(q.q_1) + p.g_2 * torch.sin(q.q_1 + q.q_2)


PAIRS = ((Tanks, TorchTanks), (Swing, TorchSwing), (Arm, TorchArm))
"""The same machine in CasADi and in torch."""
