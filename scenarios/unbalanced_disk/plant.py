"""The unbalanced disk in simulation. No torch in here."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import BufferedFunction, InputError
from scenarios.unbalanced_disk.dynamics import N_STATES, DiskParameters, steps

Array = NDArray[np.float64]
CHUNK = 10
"""Runge-Kutta steps in one call."""


@dataclass(frozen=True)
class DiskState:
    """State of the plant: ``z`` ``(4,)`` is phi [rad], phi_dot [rad/s], motor current [A], bristle [rad].

    ``acting`` is the voltage that acts [V]; ``waiting`` are commands on their way, time until each acts [s] and its
    voltage [V], the oldest first.
    """

    z: Array
    acting: float = 0.0
    waiting: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class DiskPlant:
    """A disk like the real one (a :class:`hybrid_mpc.loop.plant.Plant`), of another structure than the prior.

    The prior is a driven pendulum with viscous friction, dry friction ``tanh(phi_dot / v_c)`` of one size, a torque
    that follows the voltage at once, and a delay of any length in front. This plant has

    - a motor with inductance and back-EMF: the current is a state, torque lags the voltage by 1.2 ms;
    - LuGre's dry friction: a bristle is a state, so the disk creeps and springs back before it slips; the friction is
      larger at rest than at speed (Stribeck) and differs over a turn;
    - cogging, seven times a turn;
    - a command that acts 23.5 ms after it was given, in the midst of a period;
    - an encoder of 0.0031416 rad a step, and nothing else that is measured.

    Runge-Kutta of order 4 with sub-steps of at most ``sub_step``.

    Args:
        parameters: What it is made of.
        sub_step: Largest integration step [s]. Default 0.4 ms: the bristle relaxes at 4200 1/s at 25 rad/s, faster than
            any swing over the top, and order 4 is stable up to 2.78 over that.
    """

    parameters: DiskParameters = field(default_factory=DiskParameters)
    sub_step: float = 0.4e-3
    _chunk: BufferedFunction = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.sub_step > 0:
            raise InputError(
                f"disk: sub_step must be positive, got {self.sub_step}; 0.4e-3 is the default"
                " [HM-SCENARIOS-048]"
            )
        object.__setattr__(self, "_chunk", BufferedFunction(steps(self.parameters, CHUNK)))

    def __reduce__(self) -> tuple[type[DiskPlant], tuple[object, ...]]:
        """Copies and other processes build their own steps."""
        return DiskPlant, (self.parameters, self.sub_step)

    def reset(self, x0: Array, seed: int) -> DiskState:
        """State at ``x0`` ``(2,)``, no voltage on it or under way, bristle relaxed. ``seed`` changes nothing."""
        z = np.zeros(N_STATES)
        z[:2] = x0
        return DiskState(z)

    def step(self, state: DiskState, u: Array, dt: float) -> DiskState:
        """State after ``dt`` [s] in which the voltage ``u`` ``(1,)`` [V] is commanded."""
        z, acting = state.z, state.acting
        coming = [*state.waiting, (self.parameters.delay, float(np.ravel(u)[0]))]
        passed = 0.0
        while coming and coming[0][0] < dt:
            at, voltage = coming.pop(0)
            z, passed, acting = self._advance(z, acting, at - passed), at, voltage
        z = self._advance(z, acting, dt - passed)
        return DiskState(z, acting, tuple((at - dt, voltage) for at, voltage in coming))

    def measure(self, state: DiskState, rng: np.random.Generator) -> Array:
        """Encoder angle ``(1,)`` [rad]: the angle with a little noise, rounded to a step."""
        p = self.parameters
        noisy = state.z[0] + p.noise * rng.standard_normal()
        return np.array([p.count * np.round(noisy / p.count)])

    def truth(self, state: DiskState) -> Array:
        """True ``(phi, phi_dot)``."""
        return state.z[:2].copy()

    def hidden(self, state: DiskState) -> Array:
        """``(3,)``: the command before [V], motor current [A], bristle [rad].

        The command before is under way or acts, whichever is the case after less than a period.
        """
        last = state.waiting[-1][1] if state.waiting else state.acting
        return np.array([last, *state.z[2:]])

    def _advance(self, z: Array, voltage: float, seconds: float) -> Array:
        if seconds <= 1e-12:
            return z
        n, chunk = ceil(seconds / (CHUNK * self.sub_step) - 1e-9), self._chunk
        for _ in range(n):
            chunk.inputs[0][:], chunk.inputs[1][:], chunk.inputs[2][:] = z, voltage, seconds / n / CHUNK
            chunk()
            z = chunk.outputs[0].copy()
        return z
