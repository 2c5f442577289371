"""The golf robot's rig as equations: what it is made of, its motion, its energy. No torch in here."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi

import casadi as ca

from scenarios.golf_robot.nominal import GEAR

N_STATES = 6  # phi, phi_dot, bristle, motor torque, twist, motor speed
LOSSES = ("friction", "viscous", "drag", "belt damping", "motor friction", "motor viscous")


@dataclass(frozen=True)
class RigParameters:
    """What the rig is made of. Each default is argued from hardware of this size, before any training.

    Motor side and belt are given as seen at the club (motor angle / 4) where no other place is named.

    Args:
        m: Club mass [kg]: +2 % (grip tape, screws) against the paper's 0.5241.
        a: Centre of mass [m]: -2 % (9 mm: a clamp's tolerance) against 0.4702.
        J: Inertia of club, pulleys and motor together [kg m^2]: +4 % (pulley, rotor, clamp: a swing test
            misses some per cent) against 0.1445.
        g: Gravity [m/s^2].
        d: Viscous damping of both shafts together [N m s/rad]: +10 % (grease over 10 K) against 0.0132.
        r: Friction radius [m], as the paper.
        mu_c: Coulomb coefficient: -5 % against the paper's 1.5136, which averages over static friction.
        mu_s: Static coefficient: 1.4 x Coulomb (dry or starved plain bearing: 1.2 to 1.6).
        v_s: Stribeck speed [rad/s]: 0.3 (7 mm/s at 24.5 mm; boundary lubrication ends at 1 to 10 mm/s).
        sigma0: Bristle stiffness [1/rad]: break-away after about 1.3 mrad (33 um at 24.5 mm).
        sigma1: Bristle damping [s/rad]: half of critical at the stuck club's own frequency (36 rad/s).
        v_d: Speed [rad/s] above which bristle damping fades (keeps LuGre passive).
        asymmetry: Friction is this share larger forwards, smaller backwards: 8 % (axial play, seal lip).
        lag: Motor torque time constant [s]: current loop of a small servo drive, 3 ms.
        motor_gain: Torque constant against its data sheet: -2 % (magnets at temperature; +-5 % is usual).
        cogging: Cogging amplitude at the motor [N m]: 1 % of the 0.5 N m peak torque.
        cogging_order: Cogging periods per motor turn: least common multiple of 12 slots and 8 poles.
        drag: Aerodynamic drag [N m s^2/rad^2]: shaft rho c_w D L^4/8 = 0.5e-3 (12 mm, 0.7 m), head 0.9e-3.
        motor_inertia: Rotor and pinion at the motor [kg m^2]: flat brushless motor for 0.5 N m peak, 45 to
            60 mm wide (rotors: 2e-5 to 12e-5), and a pinion of 24 teeth (0.5e-5). Part of ``J``.
        belt_stiffness: Both spans and the teeth [N m/rad]: glass-cord belt of 3 mm pitch, 9 mm wide. Cords:
            65 N working tension stretch it by 0.2 %, so EA = 3.2e4 N, spans of 0.2 m give 3.2e5 N/m; ten
            rubber teeth in mesh at the pinion 5e5 N/m; in series 1.95e5 N/m at 46 mm (96 teeth).
        belt_damping: [N m s/rad]: 5 % of critical for the motor on its belt (126 Hz); rubber has 3 to 10 %.
        gap: Half the backlash [rad]: 0.14 mm between the flanks of a rounded 3 mm profile, at 46 mm.
        flank: Twist [rad] over which the flanks come into contact: 14 um at 46 mm. The rubber is soft, teeth
            differ, so they touch one after the other; this also leaves some stiffness within the gap.
        motor_friction: Dry friction of motor bearings and belt flexing, at the motor [N m]: 3 mN m, 0.6 % of
            peak torque. The other dry friction is at the club's plain bearing, since it goes with the load.
        motor_share: Share of ``d`` that acts on the motor's shaft: a quarter (2e-4 N m s/rad at the motor:
            iron losses, bearing grease); the rest is the club's bearing.
        v_m: Speed [rad/s] at which motor friction turns: 0.05 (ball bearings do not stick as bushes do).
        counts: Encoder counts per turn, at the club.
        noise: Sensor noise [rad], one standard deviation.
        ball_mass: [kg]: a golf ball, 45.9 g by the rules.
        ball_radius: Distance of the ball's centre from the axis [m]: 0.6. A 0.12 kg shaft and a 0.35 kg head
            there have the inertia and, with a clamp on the axis, the centre of mass of the paper's club.
        restitution: Of the impact [-]: 0.75 (ball on a metal face at 1 m/s: 0.7 to 0.8).

    Example:
        >>> p = RigParameters()
        >>> round(p.rotor, 6), round((p.belt_stiffness / p.rotor) ** 0.5 / (2 * pi))
        (0.00064, 126)
    """

    m: float = 0.5346
    a: float = 0.4608
    J: float = 0.1503
    g: float = 9.81
    d: float = 0.0145
    r: float = 0.0245
    mu_c: float = 1.44
    mu_s: float = 2.016
    v_s: float = 0.3
    sigma0: float = 1500.0
    sigma1: float = 40.0
    v_d: float = 0.05
    asymmetry: float = 0.08
    lag: float = 0.003
    motor_gain: float = 0.98
    cogging: float = 0.005
    cogging_order: int = 24
    drag: float = 1.4e-3
    motor_inertia: float = 4e-5
    belt_stiffness: float = 400.0
    belt_damping: float = 0.05
    gap: float = 1.5e-3
    flank: float = 0.3e-3
    motor_friction: float = 3e-3
    motor_share: float = 0.25
    v_m: float = 0.05
    counts: int = 4096
    noise: float = 0.2e-3
    ball_mass: float = 0.0459
    ball_radius: float = 0.6
    restitution: float = 0.75

    @property
    def rotor(self) -> float:
        """Inertia of rotor and pinion as seen at the club [kg m^2]."""
        return GEAR**2 * self.motor_inertia

    @property
    def count(self) -> float:
        """One encoder count [rad]."""
        return 2 * pi / self.counts


@dataclass(frozen=True)
class Conditions:
    """What faults and ageing change in the rig while it runs; the defaults are a healthy rig.

    Args:
        friction: Factor on all dry friction of the club's bearing [-].
        mass: Factor on the club's mass, inertia included [-].
        push: Torque on the club from outside [N m].
        limit: Twist at which the belt slips [rad]; infinite: it never does.
    """

    friction: ca.SX | float = 1.0
    mass: ca.SX | float = 1.0
    push: ca.SX | float = 0.0
    limit: ca.SX | float = inf


HEALTHY = Conditions()


def rhs(s: ca.SX, u: ca.SX, p: RigParameters, c: Conditions = HEALTHY) -> tuple[ca.SX, dict[str, ca.SX]]:
    """Derivative of the rig's state and its torques.

    Two inertias on a belt with backlash. Friction of the club's bearing is LuGre (Canudas de Wit, Olsson,
    Astrom, Lischinsky 1995); the bristle state is scaled to a friction coefficient, ``sigma0`` times its
    deflection, so it is of order one. A slipping belt keeps its twist (and loses count of the motor's angle,
    on which only the phase of the cogging hangs).

    The state ``(6,)`` is phi [rad], phi_dot [rad/s], bristle [-], motor torque at the motor [N m], twist of the belt
    (motor angle / 4 minus phi) [rad], motor speed / 4 [rad/s]. Gives its derivative and the torques [N m, at the
    club] by name, each with the sign with which it drives its own inertia: motor, motor friction, motor viscous and
    cogging the motor's, the others the club's. The belt drives the club, and the motor backwards.
    """
    phi, v, b, motor, twist, w = (s[i] for i in range(N_STATES))
    side = 1 + p.asymmetry * ca.tanh(v / p.v_d)
    level = side * (p.mu_c + (p.mu_s - p.mu_c) * ca.exp(-((v / p.v_s) ** 2)))
    b_dot = p.sigma0 * (v - ca.fabs(v) * b / level)
    m = c.mass * p.m
    load = c.friction * ca.fabs(m * v * v * p.a + m * p.g * ca.cos(phi))
    damping = p.sigma1 * ca.exp(-((v / p.v_d) ** 2)) / p.sigma0
    twisting, slips = w - v, not (isinstance(c.limit, float) and c.limit == inf)
    if slips:
        out = ca.logic_or(ca.logic_and(twist >= c.limit, w > v), ca.logic_and(twist <= -c.limit, w < v))
        twisting, twist = ca.if_else(out, 0, twisting), ca.fmin(ca.fmax(twist, -c.limit), c.limit)
    belt, contact = elastic(twist, p)
    loss = 2 * p.belt_damping * (p.belt_stiffness * p.rotor) ** 0.5
    order = GEAR * p.cogging_order
    torques = {
        "gravity": -m * p.g * p.a * ca.sin(phi),
        "friction": -p.r * load * (b + damping * b_dot),
        "viscous": -(1 - p.motor_share) * p.d * v,
        "drag": -p.drag * ca.fabs(v) * v,
        "push": ca.SX(c.push),
        "belt": belt,
        "belt damping": loss * contact * twisting,
        "motor": GEAR * motor,
        "cogging": GEAR * p.cogging * ca.sin(order * (phi + twist)),
        "motor friction": -GEAR * p.motor_friction * ca.tanh(w / p.v_m),
        "motor viscous": -p.motor_share * p.d * w,
    }
    on_club = sum((torques[k] for k in ("gravity", "friction", "viscous", "drag", "push")), ca.SX(0))
    on_motor = sum((torques[k] for k in ("motor", "cogging", "motor friction", "motor viscous")), ca.SX(0))
    drive = torques["belt"] + torques["belt damping"]
    v_dot = (on_club + drive) / (c.mass * (p.J - p.rotor))
    w_dot = (on_motor - drive) / p.rotor
    return ca.vertcat(v, v_dot, b_dot, (p.motor_gain * u - motor) / p.lag, twisting, w_dot), torques


def elastic(twist: ca.SX, p: RigParameters) -> tuple[ca.SX, ca.SX]:
    """Belt torque [N m] at a twist [rad], and the share [-] of the full stiffness that acts there.

    Zero within the gap, ``belt_stiffness`` beyond it; the flanks come into contact over ``flank``.
    """
    above, below = twist - p.gap, twist + p.gap
    near, far = ca.sqrt(above**2 + p.flank**2), ca.sqrt(below**2 + p.flank**2)
    return p.belt_stiffness * (twist + (near - far) / 2), 1 + (above / near - below / far) / 2


def stored_energy(s: ca.SX, p: RigParameters) -> ca.SX:
    """Energy [J] of motion, height, belt and cogging; the bristles' counts as dissipated."""
    phi, v, twist, w = s[0], s[1], s[4], s[5]

    def area(x: ca.SX) -> ca.SX:
        return (x * ca.sqrt(x**2 + p.flank**2) + p.flank**2 * ca.asinh(x / p.flank)) / 2

    belt = p.belt_stiffness * (twist**2 + area(twist - p.gap) - area(twist + p.gap)) / 2
    motion = ((p.J - p.rotor) * v**2 + p.rotor * w**2) / 2
    order = GEAR * p.cogging_order
    cogging = GEAR * p.cogging / order * ca.cos(order * (phi + twist))
    return motion - p.m * p.g * p.a * ca.cos(phi) + belt + cogging


def powers(s: ca.SX, torques: dict[str, ca.SX]) -> dict[str, ca.SX]:
    """Power [W] that each of ``LOSSES`` dissipates, and that of the ``motor`` and the ``push``, both put in."""
    v, w = s[1], s[5]
    speed = {"belt damping": v - w, "motor friction": w, "motor viscous": w}
    lost = {name: -torques[name] * speed.get(name, v) for name in LOSSES}
    return lost | {"motor": torques["motor"] * w, "push": torques["push"] * v}
