"""The golf robot's rig: the machine in simulation, with effects the prior does not know. No torch in here."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil, pi

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from scenarios.golf_robot.nominal import GEAR

Array = NDArray[np.float64]

CHUNK = 40  # RK4 sub-steps in one compiled call


@dataclass(frozen=True)
class RigParameters:
    """What the rig is made of. Each default is argued from hardware of this size, before any training.

    Not in this form: belt compliance and backlash, transport delay, ball contact.

    Args:
        m: Club mass [kg]: +2 % (grip tape, screws) against the paper's 0.5241.
        a: Centre of mass [m]: -2 % (9 mm: a clamp's tolerance) against 0.4702.
        J: Inertia [kg m^2]: +4 % (pulley, rotor, clamp: a swing test misses some per cent) against 0.1445.
        g: Gravity [m/s^2].
        d: Viscous damping [N m s/rad]: +10 % (grease over 10 K) against 0.0132.
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
        counts: Encoder counts per turn.
        noise: Sensor noise [rad], one standard deviation.
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
    counts: int = 4096
    noise: float = 0.2e-3


def rhs(s: ca.SX, u: ca.SX, p: RigParameters) -> tuple[ca.SX, dict[str, ca.SX]]:
    """Derivative of the rig's state ``s = (phi, phi_dot, bristle, motor torque)`` and its torques.

    LuGre friction (Canudas de Wit, Olsson, Astrom, Lischinsky 1995); the bristle state is scaled to a
    friction coefficient, ``sigma0`` times its deflection, so it is of order one.

    Args:
        s: State ``(4,)`` in rad, rad/s, -, N m (at the motor).
        u: Commanded motor torque ``(1,)`` [N m].
        p: Parameters.

    Returns:
        The derivative ``(4,)`` and the torques on the club [N m] by name, signed as in J phi_ddot = sum.

    Example:
        >>> ds, torques = rhs(ca.SX.sym("s", 4), ca.SX.sym("u"), RigParameters())
        >>> ds.shape, sorted(torques)
        ((4, 1), ['cogging', 'drag', 'friction', 'gravity', 'motor', 'viscous'])
    """
    phi, v, b, motor = s[0], s[1], s[2], s[3]
    side = 1 + p.asymmetry * ca.tanh(v / p.v_d)
    level = side * (p.mu_c + (p.mu_s - p.mu_c) * ca.exp(-((v / p.v_s) ** 2)))
    b_dot = p.sigma0 * (v - ca.fabs(v) * b / level)
    load = ca.fabs(p.m * v * v * p.a + p.m * p.g * ca.cos(phi))
    damping = p.sigma1 * ca.exp(-((v / p.v_d) ** 2)) / p.sigma0
    order = GEAR * p.cogging_order
    torques = {
        "gravity": -p.m * p.g * p.a * ca.sin(phi),
        "viscous": -p.d * v,
        "friction": -p.r * load * (b + damping * b_dot),
        "cogging": GEAR * p.cogging * ca.sin(order * phi),
        "drag": -p.drag * ca.fabs(v) * v,
        "motor": GEAR * motor,
    }
    total = sum(torques.values(), ca.SX(0))
    return ca.vertcat(v, total / p.J, b_dot, (p.motor_gain * u - motor) / p.lag), torques


def rk4(f: ca.Function, s: ca.SX, u: ca.SX, h: ca.SX) -> ca.SX:
    """One classical Runge-Kutta step of ``s_dot = f(s, u)`` over ``h`` [s]; order 4."""
    k1 = f(s, u)
    k2 = f(s + h / 2 * k1, u)
    k3 = f(s + h / 2 * k2, u)
    k4 = f(s + h * k3, u)
    return s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def chain(p: RigParameters, steps: int) -> ca.Function:
    """Function ``(s, u, h) -> s`` of ``steps`` RK4 steps of length ``h`` [s] of the rig's equations."""
    s, u, h = ca.SX.sym("s", 4), ca.SX.sym("u"), ca.SX.sym("h")
    f = ca.Function("f", [s, u], [rhs(s, u, p)[0]])
    one = ca.Function("one", [s, u, h], [rk4(f, s, u, h)])
    return one.fold(steps)


@dataclass(frozen=True)
class Rig:
    """The golf robot in simulation (a :class:`hybrid_mpc.scenario.Plant`).

    Its state is an array ``(phi, phi_dot, bristle, motor torque)``. It is integrated by RK4 with
    sub-steps of at most ``sub_step``: the bristle relaxes at ``sigma0 |phi_dot| / mu``, about
    5000 1/s at 5 rad/s, which RK4 takes up to 0.5 ms.

    Args:
        parameters: What it is made of.
        sub_step: Largest integration step [s]. Default 0.25 ms.

    Raises:
        InputError: If ``sub_step`` is not positive.

    Example:
        >>> rig = Rig()
        >>> state = rig.reset(np.array([0.05, 0.0]), seed=0)
        >>> rig.truth(rig.step(state, np.zeros(1), 0.02)).shape
        (2,)
    """

    parameters: RigParameters = field(default_factory=RigParameters)
    sub_step: float = 0.25e-3
    _chunk: ca.Function = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.sub_step > 0:
            raise InputError(f"rig: sub_step must be positive, got {self.sub_step}; 0.25e-3 is the default")
        object.__setattr__(self, "_chunk", chain(self.parameters, CHUNK))

    def reset(self, x0: Array, seed: int) -> Array:
        """State ``(4,)`` at the model state ``x0`` ``(2,)``: bristle relaxed, motor without torque.

        The rig has nothing random inside, so ``seed`` changes nothing.
        """
        return np.array([x0[0], x0[1], 0.0, 0.0], dtype=np.float64)

    def step(self, state: Array, u: Array, dt: float) -> Array:
        """State ``(4,)`` after ``dt`` [s] with the motor torque ``u`` ``(1,)`` [N m] held."""
        chunks = max(1, ceil(dt / (CHUNK * self.sub_step) - 1e-9))
        s, h = ca.DM(state), dt / (CHUNK * chunks)
        for _ in range(chunks):
            s = self._chunk(s, float(np.ravel(u)[0]), h)
        return np.array(s, dtype=np.float64).ravel()

    def measure(self, state: Array, rng: np.random.Generator) -> Array:
        """Encoder angle ``(1,)`` [rad]: the noisy angle rounded to a count."""
        count = 2 * pi / self.parameters.counts
        noisy = state[0] + self.parameters.noise * rng.standard_normal()
        return np.array([count * np.round(noisy / count)])

    def truth(self, state: Array) -> Array:
        """True ``(phi, phi_dot)``."""
        return state[:2].copy()

    def hidden(self, state: Array) -> Array:
        """True ``(bristle [-], motor torque [N m])``, the oracle's hidden states."""
        return state[2:].copy()
