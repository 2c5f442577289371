"""The golf robot's rig: the machine in simulation, with effects the prior does not know. No torch in here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import ceil, inf

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import BufferedFunction, Fault, InputError, check_plant_faults
from scenarios.golf_robot.dynamics import N_STATES, RigParameters
from scenarios.golf_robot.integration import steps

Array = NDArray[np.float64]

CHUNK = 10  # RK4 sub-steps in one compiled call
STIFF = 2.3  # sub-step times the bristle's rate: RK4 is stable up to 2.78
PLANT_FAULTS = {
    "plant_friction": 1.0, "plant_mass": 1.0, "plant_push": 0.0, "plant_belt": inf, "plant_delay": 0.0
}  # fmt: skip
"""What can go wrong inside the rig, with the value of a healthy one."""
SLOWEST_HIT = 0.05  # [rad/s]; slower, the club pushes the ball along and feels next to nothing


@dataclass(frozen=True)
class RigState:
    """State of the rig, ``t`` [s] after the reset; ``ball`` while a ball lies at the angle zero.

    ``z`` ``(6,)``: phi [rad], phi_dot [rad/s], bristle [-], motor torque [N m], belt twist [rad], motor speed / 4
    [rad/s]. ``past`` ``(n, 3)``: time, angle, speed at the ends of the last steps, oldest first, as far back as the
    sensor's delay can reach; the present is the last row.
    """

    z: Array
    t: float
    past: Array
    ball: bool


@dataclass(frozen=True)
class Rig:
    """The golf robot in simulation (a :class:`hybrid_mpc.loop.plant.Plant`).

    RK4 with sub-steps of at most ``sub_step``, less at high speed: the bristle relaxes at
    ``sigma0 |phi_dot| / mu``, 5600 1/s at 5 rad/s.

    Args:
        parameters: What it is made of.
        delay: Transport delay of the sensor [s]: 0, or one or two control periods.
        ball: True: a ball lies at the angle zero after a reset. The first forward pass faster than
            0.05 rad/s hits it, and the club loses the momentum that the ball takes.
        faults: Faults of the machine itself, see :func:`scenarios.golf_robot.faults.catalogue`.
        sub_step: Largest integration step [s]. Default 0.5 ms.
    """

    parameters: RigParameters = field(default_factory=RigParameters)
    delay: float = 0.0
    ball: bool = False
    faults: tuple[Fault, ...] = ()
    sub_step: float = 0.5e-3
    _chunk: BufferedFunction = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.sub_step > 0:
            raise InputError(
                f"rig: sub_step must be positive, got {self.sub_step}; 0.5e-3 is the default"
                " [HM-SCENARIOS-017]"
            )
        if not self.delay >= 0:
            raise InputError(
                f"rig: delay must be 0 s or more, got {self.delay}; 0.02 is one period [HM-SCENARIOS-018]"
            )
        check_plant_faults(self.faults, tuple(PLANT_FAULTS))
        for fault in self.faults:
            signed, zero = fault.target == "plant_push", fault.target != "plant_mass"
            if not (signed or fault.value > 0 or (zero and fault.value == 0)):
                raise InputError(
                    f"fault {fault.target}: value must be positive, got {fault.value} [HM-SCENARIOS-019]"
                )
        chunk = BufferedFunction(steps(self.parameters, CHUNK, faulty=self._faulty))
        object.__setattr__(self, "_chunk", chunk)

    def __reduce__(self) -> tuple[type[Rig], tuple[object, ...]]:
        """Copies and other processes build their own compiled steps."""
        return Rig, (self.parameters, self.delay, self.ball, self.faults, self.sub_step)

    @property
    def _faulty(self) -> bool:
        return any(fault.target != "plant_delay" for fault in self.faults)

    def with_faults(self, faults: Sequence[Fault]) -> Rig:
        """The same rig with ``faults`` beside those it has.

        Targets are ``"plant_friction"`` and ``"plant_mass"`` (factors on the bearing's friction and on the club's mass
        and inertia), ``"plant_push"`` (torque on the club [N m]), ``"plant_belt"`` (largest torque that the belt
        transmits, at the club [N m]) and ``"plant_delay"`` (of the sensor, beside the rig's own [s]).
        """
        return replace(self, faults=(*self.faults, *faults))

    def reset(self, x0: Array, seed: int) -> RigState:
        """State at the model state ``x0`` ``(2,)``: bristle and belt relaxed, motor without torque.

        The rig has nothing random inside, so ``seed`` changes nothing.
        """
        z = np.zeros(N_STATES)
        z[:2], z[5] = x0, x0[1]
        return RigState(z, 0.0, np.array([[0.0, z[0], z[1]]]), self.ball)

    def step(self, state: RigState, u: Array, dt: float) -> RigState:
        """State after ``dt`` [s] with the motor torque ``u`` ``(1,)`` [N m] held.

        Faults are taken as they are at the beginning of the step.
        """
        q, z, left, ball = self._held(state.t, u), state.z, dt, state.ball
        while left > 1e-12:
            length = left / ceil(left / (CHUNK * self._sub_step(z)) - 1e-9)
            after = self._advance(z, q, length)
            if ball and z[0] < 0.0 <= after[0] and after[1] > SLOWEST_HIT:
                length, after, ball = *self._impact(z, q, length), False
            z, left = after, left - length
        t = state.t + dt
        return RigState(z, t, self._remembered(state.past, t, z), ball)

    def measure(self, state: RigState, rng: np.random.Generator) -> Array:
        """Encoder angle ``(1,)`` [rad]: the noisy angle, ``delay`` ago, rounded to a count."""
        count = self.parameters.count
        noisy = self._delayed(state) + self.parameters.noise * rng.standard_normal()
        return np.array([count * np.round(noisy / count)])

    def truth(self, state: RigState) -> Array:
        """True ``(phi, phi_dot)`` of the club, not delayed."""
        return state.z[:2].copy()

    def hidden(self, state: RigState) -> Array:
        """True ``(bristle [-], motor torque [N m], belt twist [rad], motor speed / 4 [rad/s])``."""
        return state.z[2:].copy()

    def _sub_step(self, z: Array) -> float:
        """Largest sub-step [s] that the bristle takes at this speed, with what a block may add to it."""
        p = self.parameters
        rate = p.sigma0 * (abs(z[1]) + 0.5) / (p.mu_c * (1 - p.asymmetry))
        return min(self.sub_step, STIFF / rate)

    def _advance(self, z: Array, q: Array, length: float) -> Array:
        chunk = self._chunk
        chunk.inputs[0][:], chunk.inputs[1][:], chunk.inputs[2][:] = z, q, length / CHUNK
        chunk()
        return chunk.outputs[0].copy()

    def _held(self, t: float, u: Array) -> Array:
        """What is held over a step: torque and, if there are faults, the conditions."""
        torque = float(np.ravel(u)[0])
        if not self._faulty:
            return np.array([torque])
        p, now = self.parameters, self._conditions(t)
        limit = p.gap + now["plant_belt"] / p.belt_stiffness
        return np.array([torque, now["plant_friction"], now["plant_mass"], now["plant_push"], limit])

    def _conditions(self, t: float) -> dict[str, float]:
        """Factors multiply, pushes and delays add, of two weak belts the weaker counts."""
        now = dict(PLANT_FAULTS)
        for fault in self.faults:
            if not fault.active(t):
                continue
            value = fault.value_at(t, PLANT_FAULTS[fault.target])
            if fault.target in ("plant_friction", "plant_mass"):
                now[fault.target] *= value
            elif fault.target == "plant_belt":
                now[fault.target] = min(now[fault.target], value)
            else:
                now[fault.target] += value
        return now

    def _impact(self, z: Array, q: Array, length: float) -> tuple[float, Array]:
        """Time [s] until the club reaches the ball within a block, and the state after the impact.

        Of one body turning and one at rest: momentum is conserved about the axis and the speeds separate at
        ``restitution`` times the approach. The motor takes no part: its belt is soft over a millisecond.
        """
        p = self.parameters
        from scipy.optimize import brentq  # a quarter of a second to import

        time = brentq(lambda tau: self._advance(z, q, tau)[0], 0.0, length, xtol=1e-12)
        hit = self._advance(z, q, time)
        club = (q[2] if len(q) > 1 else 1.0) * (p.J - p.rotor)
        ball = p.ball_mass * p.ball_radius**2
        hit[:2] = max(hit[0], 0.0), hit[1] * (club - p.restitution * ball) / (club + ball)
        return time, hit

    def _remembered(self, past: Array, t: float, z: Array) -> Array:
        """The past with the present, without what no delay reaches."""
        now = np.array([[t, z[0], z[1]]])
        reach = self.delay + sum(fault.value for fault in self.faults if fault.target == "plant_delay")
        if reach == 0.0:
            return now
        past = np.vstack([past, now])
        return past[max(0, int(np.searchsorted(past[:, 0], t - reach, side="right")) - 1) :]

    def _delayed(self, state: RigState) -> float:
        """Angle [rad] that arrives now: cubic Hermite interpolation of the past; at first the oldest."""
        delay = self.delay + self._conditions(state.t)["plant_delay"]
        if delay <= 0.0:
            return float(state.z[0])
        t, phi, v = state.past.T
        if len(t) == 1 or state.t - delay <= t[0]:
            return float(phi[0])
        from scipy.interpolate import CubicHermiteSpline

        return float(CubicHermiteSpline(t, phi, v)(state.t - delay))
