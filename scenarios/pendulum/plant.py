"""The damped pendulum in simulation, with books on its energy. No torch in here."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil, cos, isfinite, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import InputError

Array = NDArray[np.float64]
Values = tuple[float, float, float, float]


@dataclass(frozen=True)
class PendulumParameters:
    """The paper's system S. Its table prints l in cm; only metres make its experiment meaningful.

    In metres it swings at 14.8 rad/s, damped at 0.7 of critical; in centimetres it would be damped at 700 times that
    and creep.

    Args:
        m: Mass [kg].
        l: Distance of the mass from the axis [m]; the prior has 0.05.
        d: Viscous damping [N m s/rad]; the prior has 2.
        g: Gravity [m/s^2].
    """

    m: float = 50.0
    l: float = 0.045  # noqa: E741  the paper's name
    d: float = 2.1
    g: float = 9.81

    @property
    def inertia(self) -> float:
        """Inertia about the axis [kg m^2]."""
        return self.m * self.l**2

    @property
    def gravity(self) -> float:
        """Largest gravity torque m g l [N m]."""
        return self.m * self.g * self.l

    @property
    def frequency(self) -> float:
        """Own angular frequency of small swings, undamped [rad/s]."""
        return sqrt(self.gravity / self.inertia)

    @property
    def damping(self) -> float:
        """Damping over critical damping [-]."""
        return self.d / (2 * self.inertia * self.frequency)


@dataclass(frozen=True)
class PendulumState:
    """State of the plant ``z``: phi [rad], phi_dot [rad/s]; work of the torque and heat of the damping since the
    reset [J].
    """

    z: Values


@dataclass(frozen=True)
class DampedPendulum:
    """The paper's pendulum (a :class:`hybrid_mpc.loop.plant.Plant`).

    Classical Runge-Kutta of order 4 with equal sub-steps of at most ``sub_step``. At the default a run of 5 s stays
    within 1e-9 rad of a solution of tolerance 1e-12, and the energy's books close within 1e-8 J; both are tested.

    Args:
        parameters: What it is made of.
        noise: Standard deviation of the measured angle [rad]. Default 0.1 mrad; the paper measures without noise.
        sub_step: Largest integration step [s]. Default 0.5 ms.
    """

    parameters: PendulumParameters = field(default_factory=PendulumParameters)
    noise: float = 1e-4
    sub_step: float = 0.5e-3

    def __post_init__(self) -> None:
        if not (self.sub_step > 0 and isfinite(self.sub_step)):
            raise InputError(
                f"pendulum: sub_step must be positive, got {self.sub_step}; 0.5e-3 is the default [HM-SCENARIOS-044]"
            )
        if not self.noise >= 0:
            raise InputError(
                f"pendulum: noise must be 0 rad or more, got {self.noise}; 1e-4 is the default"
                " [HM-SCENARIOS-045]"
            )

    def reset(self, x0: Array, seed: int) -> PendulumState:
        """State at ``x0`` ``(2,)`` with new books. Nothing inside is random, so ``seed`` changes nothing."""
        return PendulumState((float(x0[0]), float(x0[1]), 0.0, 0.0))

    def step(self, state: PendulumState, u: Array, dt: float) -> PendulumState:
        """State after ``dt`` [s] with the torque ``u`` ``(1,)`` [N m] held."""
        n = max(1, ceil(dt / self.sub_step - 1e-9))
        h, torque, z = dt / n, float(np.ravel(u)[0]), state.z
        for _ in range(n):
            k1 = self._rates(z, torque)
            k2 = self._rates(_ahead(z, k1, h / 2), torque)
            k3 = self._rates(_ahead(z, k2, h / 2), torque)
            k4 = self._rates(_ahead(z, k3, h), torque)
            mean = tuple((a + 2 * (b + c) + e) / 6 for a, b, c, e in zip(k1, k2, k3, k4, strict=True))
            z = _ahead(z, mean, h)
        return PendulumState(z)

    def measure(self, state: PendulumState, rng: np.random.Generator) -> Array:
        """Measured angle ``(1,)`` [rad]."""
        return np.array([state.z[0] + self.noise * rng.standard_normal()])

    def truth(self, state: PendulumState) -> Array:
        """True ``(phi, phi_dot)``."""
        return np.array(state.z[:2])

    def hidden(self, state: PendulumState) -> Array:
        """Nothing: the model's states are all there is."""
        return np.zeros(0)

    def acceleration(self, x: Array, u: Array) -> Array:
        """Acceleration ``(...)`` [rad/s^2] at ``x`` ``(..., 2)`` and torque ``u`` ``(...)`` [N m]."""
        p = self.parameters
        return np.asarray((u - p.gravity * np.sin(x[..., 0]) - p.d * x[..., 1]) / p.inertia)

    def stored_energy(self, state: PendulumState) -> float:
        """Energy of motion and height [J], zero at rest hanging down.

        Its change since the reset is the torque's work less the damping's heat, ``z[2] - z[3]``.
        """
        p, (phi, v, _, _) = self.parameters, state.z
        return p.inertia * v * v / 2 + p.gravity * (1 - cos(phi))

    def _rates(self, z: tuple[float, ...], torque: float) -> Values:
        p, phi, v = self.parameters, z[0], z[1]
        lost = p.d * v
        return v, (torque - p.gravity * sin(phi) - lost) / p.inertia, torque * v, lost * v


def _ahead(z: tuple[float, ...], rates: tuple[float, ...], h: float) -> Values:
    return z[0] + h * rates[0], z[1] + h * rates[1], z[2] + h * rates[2], z[3] + h * rates[3]
