"""The simulated disk's equations of motion, in CasADi: another structure than the prior's. No torch in here."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import casadi as ca

from hybrid_mpc import InputError
from scenarios.common import repeated, rk4

N_STATES = 4
"""phi [rad], phi_dot [rad/s], motor current [A], deflection of the bristle [rad]."""


@dataclass(frozen=True)
class DiskParameters:
    """What the simulated disk is made of.

    Gravity, torque a volt, friction and delay are near what the prior's fit to the recording of 2024 says of the real
    one (docs/results/real_machines.md); what the recordings do not tell (inductance, bristle, Stribeck's effect,
    friction over a turn, cogging) has sizes that are usual for a small motor.

    Args:
        J: Inertia of disk and mass [kg m^2].
        weight: Largest torque of gravity [N m].
        phi_0: Angle of the encoder's zero from hanging down [rad].
        k: Torque a current, and back-EMF [N m/A = V s/rad].
        R: Resistance of the winding [ohm].
        L: Its inductance [H]: the current follows the voltage with L / R = 1.2 ms.
        d: Viscous friction [N m s/rad].
        coulomb: Dry friction at speed [N m].
        stiction: Dry friction just before it slips, over that at speed [-].
        stribeck: Speed over which it falls from one to the other [rad/s].
        eccentric: How much dry friction changes over a turn, as a share [-]: a shaft that is not quite round.
        bristle: Deflection at which it slips at speed [rad] (LuGre): it creeps and springs back before.
        cogging: Torque of the magnets on the winding's teeth [N m].
        teeth: How often that changes its sign twice in a turn.
        delay: Time from a command to the voltage [s], less than a period.
        count: Encoder step [rad].
        noise: Deviation of the angle before it is rounded [rad]: a tenth of a step.
    """

    J: float = 2.44e-4
    weight: float = 3.323e-2
    phi_0: float = -0.034
    k: float = 0.03
    R: float = 4.307
    L: float = 5e-3
    d: float = 6.3e-5
    coulomb: float = 1.42e-3
    stiction: float = 1.2
    stribeck: float = 0.5
    eccentric: float = 0.15
    bristle: float = 0.006
    cogging: float = 2.5e-4
    teeth: int = 7
    delay: float = 0.0235
    count: float = 0.0031416
    noise: float = 3e-4

    def __post_init__(self) -> None:
        positive = "J", "weight", "k", "R", "L", "coulomb", "stribeck", "bristle", "count"
        for name, value in vars(self).items():
            if (
                not isfinite(value)
                or (name in positive and not value > 0)
                or (name in ("delay", "noise") and value < 0)
            ):
                needed = "positive" if name in positive else "finite and not negative"
                raise InputError(f"disk: {name} must be {needed}, got {value} [HM-SCENARIOS-046]")
        if not (self.stiction >= 1 and abs(self.eccentric) < 1):
            raise InputError(
                f"disk: stiction must be 1 or more and eccentric below 1, got {self.stiction}, {self.eccentric}"
                " [HM-SCENARIOS-047]"
            )


def rhs(s: ca.SX, u: ca.SX, p: DiskParameters) -> ca.SX:
    """Rates ``(4,)`` of the state ``s`` ``(4,)`` under the voltage ``u`` that acts [V].

    The motor's winding with back-EMF, LuGre's friction whose level falls with speed (Stribeck) and changes over a
    turn, cogging. Source of the friction: Canudas de Wit, Olsson, Aastroem, Lischinsky, IEEE TAC 40 (1995), with
    neither damping of the bristle nor of its rate.
    """
    phi, v, i, z = s[0], s[1], s[2], s[3]
    level = 1 + (p.stiction - 1) * ca.exp(-((v / p.stribeck) ** 2))
    level = level * (1 + p.eccentric * ca.cos(phi - 0.6))
    friction = p.coulomb * z / p.bristle
    torque = (
        p.k * i - p.weight * ca.sin(phi + p.phi_0) - p.d * v - friction - p.cogging * ca.sin(p.teeth * phi)
    )
    current = (u - p.R * i - p.k * v) / p.L
    return ca.vertcat(v, torque / p.J, current, v - ca.fabs(v) * z / (p.bristle * level))


def steps(p: DiskParameters, n: int) -> ca.Function:
    """Function ``(s, u, h) -> s`` of ``n`` Runge-Kutta steps of ``h`` [s] each."""
    s, u, h = ca.SX.sym("s", N_STATES), ca.SX.sym("u"), ca.SX.sym("h")
    f = ca.Function("f", [s, u], [rhs(s, u, p)])
    return repeated(ca.Function("one", [s, u, h], [rk4(f, s, u, h)]), n)
