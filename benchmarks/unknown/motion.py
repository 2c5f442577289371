"""Six machines that move: what the user writes, and the plant that is recorded, most of them under a controller.

Sources: Franklin, Powell and Emami-Naeini, *Feedback Control of Dynamic Systems* (2015) for shaft, ball, magnet, cart;
Fossen, *Handbook of Marine Craft Hydrodynamics and Motion Control* (2011) for the ship; Merritt, *Hydraulic Control
Systems* (1967) for the cylinder.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from hybrid_mpc import DataSpec, MechanicalPrior, OperatingPoint, Parameter, Prior, Signal
from unknown.common import Array, Machine, drop_outs, levels, quantised
from unknown.plants import PLANTS, run

"""Measured disturbances of a machine without any."""

G = 9.81


class FlexibleShaft(Prior):
    """Motor and load on a soft shaft; both speeds measured, the twist is not."""

    states = (
        Signal("motor", "rad/s", -120, 120), Signal("load", "rad/s", -120, 120), Signal("twist", "rad", -1.5, 1.5),
    )  # fmt: skip
    inputs = (Signal("u", "V", -10, 10),)
    outputs = states[:2]
    parameters = (
        Parameter("J_m", 1.0e-3, "kg m^2", 1e-4, 1e-2),
        Parameter("J_l", 3.0e-3, "kg m^2", 3e-4, 3e-2),
        Parameter("c", 2.0, "N m/rad", 0.2, 20.0, "stiffness"),
        Parameter("d", 5.0e-3, "N m s/rad", 0.0, 0.1, "damping of the shaft"),
        Parameter("k", 0.05, "N m/V", 0.005, 0.5, "torque a volt"),
        Parameter("b", 4.0e-3, "N m s/rad", 0.0, 0.05, "damping of the motor"),
    )
    operating_point = OperatingPoint(x=(0.0, 0.0, 0.0), u=(0.0,))

    def xdot(self, x, u, w, p):
        """Torques of motor, shaft and damping."""
        shaft = p.c * x.twist + p.d * (x.motor - x.load)
        return (p.k * u.u - p.b * x.motor - shaft) / p.J_m, shaft / p.J_l, x.motor - x.load


def flexible_shaft(seed: int) -> Array:
    """A shaft that stiffens, dry friction on the load."""
    rng = np.random.default_rng([seed, 11])
    n, dt, plant = 3000, 0.002, PLANTS["flexible_shaft"]
    volts = levels(rng, n, -8, 8, 20, 200)

    t, u, y = run(plant, lambda k, y: volts[k : k + 1], dt, n, 2)
    y = drop_outs(quantised(y + 0.2 * rng.standard_normal(y.shape), 0.1), rng, 0.02)
    return np.column_stack([t, u, y])


class MagneticLevitation(Prior):
    """A ball below a magnet, unstable; the gap is measured, current by a lag of the voltage."""

    states = (
        Signal("gap", "mm", 0.0, 30.0),
        Signal("gap_dot", "mm/s", -500, 500),
        Signal("i", "A", 0.0, 4.0),
    )
    inputs = (Signal("u", "V", 0, 24),)
    outputs = (states[0], states[2])
    parameters = (
        Parameter("k", 1.4e6, "mm^3/(s^2 A^2)", 2e5, 1e7, "force over mass"),
        Parameter("x0", 3.0, "mm", 0.0, 20.0, "gap within the core"),
        Parameter("R", 8.0, "ohm", 2.0, 30.0),
        Parameter("L", 0.2, "H", 0.02, 1.0),
    )
    operating_point = OperatingPoint(x=(8.946, 0.0, 1.0), u=(8.0,))

    def xdot(self, x, u, w, p):
        """Weight against the magnet's pull."""
        return x.gap_dot, 9810.0 - p.k * (x.i / (x.gap + p.x0)) ** 2, (u.u - p.R * x.i) / p.L


def magnetic_levitation(seed: int) -> Array:
    """An inductance that depends on the gap, a weight of its own, held by PID with a current loop."""
    rng = np.random.default_rng([seed, 12])
    n, dt, plant = 6000, 0.001, PLANTS["magnetic_levitation"]
    goal, push = levels(rng, n, 9.0, 11.0, 300, 900), levels(rng, n, -2.0, 2.0, 8, 60)
    memory = np.array([10.0, 0.0, 0.0])

    def control(k: int, y: Array) -> Array:
        last, speed, total = memory
        speed += 0.3 * ((y[0] - last) / dt - speed)
        total = np.clip(total + (y[0] - goal[k]) * dt, -0.5, 0.5)
        memory[:] = y[0], speed, total
        want = 0.99 + 0.16 * (y[0] - goal[k]) + 0.004 * speed + 0.5 * total
        return np.array([np.clip(6.5 * want + 60.0 * (want - y[1]) + push[k], 0.0, 24.0)])

    noise = iter(rng.standard_normal((2 * n, 2)) * [0.005, 0.004])
    t, u, y = run(
        plant, control, dt, n, 2,
        measure=lambda x: quantised(plant.measure(x) + next(noise), np.array([0.005, 0.002])),
    )  # fmt: skip
    return np.column_stack([t, u, drop_outs(y, rng, 0.01)])


class CartPole(MechanicalPrior):
    """Inverted pendulum on a cart, angle from upright."""

    states = (
        Signal("s", "m", -1.5, 1.5), Signal("phi", "rad", -0.8, 0.8),
        Signal("s_dot", "m/s", -4, 4), Signal("phi_dot", "rad/s", -8, 8),
    )  # fmt: skip
    inputs = (Signal("F", "N", -30, 30),)
    outputs = states[:2]
    parameters = (
        Parameter("M", 1.0, "kg", 0.2, 5.0, "cart"),
        Parameter("m", 0.2, "kg", 0.05, 1.0, "pole"),
        Parameter("l", 0.3, "m", 0.1, 1.0, "to its centre"),
        Parameter("J", 0.006, "kg m^2", 0.0005, 0.05, "about its centre"),
        Parameter("b", 1.0, "N s/m", 0.0, 10.0),
    )
    operating_point = OperatingPoint(x=(0.0, 0.0, 0.0, 0.0), u=(0.0,))

    def mass_matrix(self, q, p):
        """Of cart and pole."""
        c = p.m * p.l * ca.cos(q.phi)
        return (p.M + p.m, c), (c, p.J + p.m * p.l**2)

    def potential(self, q, p):
        """Of the pole."""
        return p.m * G * p.l * ca.cos(q.phi)

    def friction(self, q, v, p):
        """Of the cart."""
        return p.b * v.s_dot, 0.0

    def force(self, q, v, u, w, p):
        """On the cart."""
        return u.F, 0.0


def cart_pole(seed: int) -> Array:
    """Another length and mass, dry friction, held by state feedback."""
    rng = np.random.default_rng([seed, 13])
    n, dt, plant = 2500, 0.01, PLANTS["inverted_pendulum"]
    goal, push = levels(rng, n, -0.5, 0.5, 200, 500), levels(rng, n, -2.0, 2.0, 10, 60)
    memory = np.zeros(4)

    def control(k: int, y: Array) -> Array:
        speed = memory[2:] + 0.4 * ((y - memory[:2]) / dt - memory[2:])
        memory[:] = np.concatenate([y, speed])
        u = 4.0 * (y[0] - goal[k]) + 45.0 * y[1] + 6.0 * speed[0] + 8.0 * speed[1] + push[k]
        return np.array([np.clip(u, -30, 30)])

    def measure(x: Array) -> Array:
        return quantised(
            x[:2] + np.array([3e-4, 5e-4]) * rng.standard_normal(2), np.array([5e-4, 2 * np.pi / 4096])
        )

    t, u, y = run(plant, control, dt, n, 4, start=(0.0, 0.03, 0.0, 0.0), measure=measure)
    return np.column_stack([t, u, drop_outs(y, rng, 0.01)])


class Ship(Prior):
    """Steering after Nomoto with a lag of the rudder; heading measured."""

    states = (Signal("psi", "deg", -180, 180), Signal("r", "deg/s", -4, 4), Signal("rudder", "deg", -35, 35))
    inputs = (Signal("delta", "deg", -35, 35),)
    outputs = states[:1]
    parameters = (
        Parameter("T", 40.0, "s", 5.0, 200.0),
        Parameter("K", 0.08, "1/s", 0.01, 0.5),
        Parameter("T_r", 3.0, "s", 0.5, 15.0, "lag of the rudder"),
        Parameter("bias", 0.0, "deg", -5.0, 5.0, "rudder for a straight course"),
    )
    operating_point = OperatingPoint(x=(0.0, 0.0, 0.0), u=(0.0,))

    def xdot(self, x, u, w, p):
        """First order in the rate of turn."""
        return x.r, (p.K * (x.rudder - p.bias) - x.r) / p.T, (u.delta - x.rudder) / p.T_r


def ship(seed: int) -> Array:
    """A cubic damping, a rudder of limited speed, waves; an autopilot steers."""
    rng = np.random.default_rng([seed, 14])
    n, dt, plant = 1800, 1.0, PLANTS["ship"]
    goal, push = levels(rng, n, -40, 40, 100, 300), levels(rng, n, -6, 6, 15, 60)
    memory = [0.0, 0.0]
    waves = 0.02 * np.cumsum(rng.standard_normal(n)) * 0.05

    def control(k: int, y: Array) -> Array:
        memory[1] += 0.3 * ((y[0] - memory[0]) / dt - memory[1])
        memory[0] = y[0]
        return np.clip(np.atleast_1d(1.0 * (goal[k] - y[0]) - 18.0 * memory[1] + push[k]), -30, 30)

    t, u, y = run(
        plant, control, dt, n, 4, start=(0.0, 0.0, 0.0),
        measure=lambda x: quantised(x[:1] + 0.05 * rng.standard_normal(1), 0.1),
        w=lambda t: waves[min(int(t), n - 1)][None],
    )  # fmt: skip
    return np.column_stack([t, u, drop_outs(y, rng, 0.03)])


class BallAndBeam(Prior):
    """A ball on a beam whose angle follows its command with a lag; the position is measured."""

    states = (Signal("s", "m", -0.6, 0.6), Signal("s_dot", "m/s", -2, 2), Signal("beam", "rad", -0.4, 0.4))
    inputs = (Signal("command", "rad", -0.4, 0.4),)
    outputs = states[:1]
    parameters = (
        Parameter("k", 7.0, "m/s^2", 2.0, 20.0, "5/7 of gravity for a ball that rolls"),
        Parameter("T", 0.1, "s", 0.02, 0.5),
        Parameter("off", 0.0, "rad", -0.05, 0.05, "command of a level beam"),
    )
    operating_point = OperatingPoint(x=(0.0, 0.0, 0.0), u=(0.0,))

    def xdot(self, x, u, w, p):
        """The ball rolls; the beam's own motion is neglected."""
        return x.s_dot, -p.k * ca.sin(x.beam - p.off), (u.command - x.beam) / p.T


def ball_and_beam(seed: int) -> Array:
    """A beam of second order, rolling friction, centrifugal force; PD control."""
    rng = np.random.default_rng([seed, 15])
    n, dt, plant = 2500, 0.02, PLANTS["ball_and_beam"]
    goal, push = levels(rng, n, -0.25, 0.25, 100, 250), levels(rng, n, -0.05, 0.05, 10, 50)
    memory = [0.0, 0.0]

    def control(k: int, y: Array) -> Array:
        memory[1] += 0.3 * ((y[0] - memory[0]) / dt - memory[1])
        memory[0] = y[0]
        return np.clip(np.atleast_1d(0.35 * (y[0] - goal[k]) + 0.4 * memory[1] + push[k]), -0.35, 0.35)

    t, u, y = run(
        plant, control, dt, n, 4, start=(0.05, 0.0, 0.0, 0.0),
        measure=lambda x: quantised(x[:1] + 5e-4 * rng.standard_normal(1), 1e-3),
    )  # fmt: skip
    return np.column_stack([t, u, drop_outs(y, rng, 0.02)])


class HydraulicCylinder(Prior):
    """A symmetric cylinder behind a servo valve; position measured, load pressure not."""

    states = (Signal("s", "m", -0.3, 0.3), Signal("s_dot", "m/s", -1, 1), Signal("p_L", "bar", -70, 70))
    inputs = (Signal("u", "V", -10, 10),)
    outputs = states[:1]
    parameters = (
        Parameter("m", 200.0, "kg", 50.0, 800.0),
        Parameter("b", 2000.0, "N s/m", 100.0, 20000.0),
        Parameter("k_q", 5.0e-6, "m^3/(s V sqrt(bar))", 5e-7, 5e-5, "valve"),
        Parameter("C", 150.0, "bar/l", 30.0, 1500.0, "oil's stiffness over volume"),
        Parameter("A", 1.0e-3, "m^2", 1e-3, 1e-3), Parameter("p_s", 70.0, "bar", 70.0, 70.0),
    )  # fmt: skip
    operating_point = OperatingPoint(x=(0.0, 0.0, 0.0), u=(0.0,))

    def xdot(self, x, u, w, p):
        """Flow through the valve by the root of its pressure drop."""
        drop = p.p_s - ca.tanh(u.u / 0.05) * x.p_L
        flow = p.k_q * u.u * ca.sqrt(ca.fmax(drop, 1e-3))
        return (x.s_dot, (1e5 * p.A * x.p_L - p.b * x.s_dot) / p.m, 1000 * p.C * (flow - p.A * x.s_dot))


def hydraulic_cylinder(seed: int) -> Array:
    """Leakage, dry friction, a valve with a lag; position control."""
    rng = np.random.default_rng([seed, 16])
    n, dt, plant = 3000, 0.005, PLANTS["hydraulic_cylinder"]
    goal, push = levels(rng, n, -0.15, 0.15, 150, 500), levels(rng, n, -1.5, 1.5, 10, 60)

    def control(k: int, y: Array) -> Array:
        return np.clip(np.atleast_1d(40.0 * (goal[k] - y[0]) + push[k]), -10, 10)

    t, u, y = run(
        plant, control, dt, n, 10, start=(0.0, 0.0, 0.0, 0.0),
        measure=lambda x: quantised(x[:1] + 5e-5 * rng.standard_normal(1), 1e-4),
    )  # fmt: skip
    return np.column_stack([t, u, drop_outs(y, rng, 0.01)])


MOTION = (
    Machine(
        "flexible_shaft", FlexibleShaft, DataSpec("t", ("u",), ("motor", "load"), 0.002, 0.02, 0.02, 0.1),
        flexible_shaft, "t,u,motor,load", 1.0,
        {"J_m": 7e-4, "J_l": 4.2e-3, "c": 1.5, "d": 6e-3, "k": 0.04, "b": 2.8e-3}, True,
    ),
    Machine(
        "magnetic_levitation", MagneticLevitation, DataSpec("t", ("u",), ("gap", "i"), 0.002, 0.02, 0.02, 0.1),
        magnetic_levitation, "t,u,gap,i", 0.1, {"k": 2.1e6, "x0": 4.5, "R": 6.5, "L": 0.148}, True, True,
    ),
    Machine(
        "inverted_pendulum", CartPole, DataSpec("t", ("F",), ("s", "phi"), 0.01, 0.05, 0.06, 0.3),
        cart_pole, "t,F,s,phi", 0.6, {"M": 0.7, "m": 0.28, "l": 0.25, "J": 0.0075, "b": 1.6}, True, True,
    ),
    Machine(
        "ship", Ship, DataSpec("t", ("delta",), ("psi",), 1.0, 10.0, 10.0, 30.0),
        ship, "t,delta,psi", 200.0, {"T": 28.0, "K": 0.055, "T_r": 1.5, "bias": 1.2}, True, True,
    ),
    Machine(
        "ball_and_beam", BallAndBeam, DataSpec("t", ("command",), ("s",), 0.02, 0.2, 0.2, 0.5),
        ball_and_beam, "t,command,s", 2.0, {"k": 7.0, "T": 0.11, "off": 0.012}, False, True,
    ),
    Machine(
        "hydraulic_cylinder", HydraulicCylinder, DataSpec("t", ("u",), ("s",), 0.005, 0.03, 0.05, 0.2),
        hydraulic_cylinder, "t,u,s", 1.0, {"m": 140.0, "b": 2900.0, "k_q": 3.6e-6, "C": 220.0}, False, True,
    ),
)  # fmt: skip
