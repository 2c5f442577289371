"""The coupled drives in simulation: drives that lose speed to the belt and the air, a belt that stiffens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from scenarios.simulated.plant import PlantState, SimulatedPlant

Array = NDArray[np.float64]
STEP = 0.005
"""Step of the reading [V], as recorded."""


@dataclass(frozen=True)
class CoupledDrivesPlant(SimulatedPlant):
    """Drives and a pulley on a belt whose pull holds the drives back, too.

    The prior's drives do not feel the belt and lose no speed to the air; its belt is linear, its damping grows with the
    speed, its counter with the speed and its square. Here the belt stiffens under its pull, damping grows with the
    square of the speed, the counter goes by a power, and an amplifier lags. Gain, lag, frequency, friction, window and
    damping at rest are within 20 % of those fitted to the recordings.

    Args:
        gain: Speed a volt, without losses [-].
        lag: Of the drives [s].
        F: Dry friction of the drives, as the speed that it costs [V].
        windage: What the air costs, over the square of the speed [1/V].
        share: Inertia of the pulley over that of the drives [-].
        w: Natural frequency of the belt when slack [rad/s].
        stiff: Pull at which the belt is twice as stiff [V/s].
        zeta: Its damping at rest [-].
        zeta_2: How that grows with the square of the speed [1/V^2].
        scale: Reading at a speed of 1 V [V].
        power: Exponent of the counter [-].
        window: Over which it averages [s].
        lag_amplifier: Of the voltage behind its command [s].
    """

    gain: float = 0.37
    lag: float = 0.22
    F: float = 0.09
    windage: float = 0.2
    share: float = 0.1
    w: float = 22.5
    stiff: float = 12.0
    zeta: float = 0.045
    zeta_2: float = 0.7
    scale: float = 5.1
    power: float = 1.6
    window: float = 0.03
    lag_amplifier: float = 0.01
    sigma: ClassVar[tuple[float, ...]] = (0.01,)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((1.0,), ())

    def start(self, x: Array) -> Array:
        """Drives, pulley, the belt's pull, the counter, and the voltage that acts."""
        motor, pulley, rate, counter = x
        damped = 2 * (self.zeta + self.zeta_2 * pulley**2) * self.w * (motor - pulley)
        return np.array([motor, pulley, rate - damped, counter, self.rest[0][0]])

    def shown(self, z: Array) -> Array:
        """Drives, pulley, its acceleration, the counter."""
        motor, pulley, pull, counter, _ = z
        damped = 2 * (self.zeta + self.zeta_2 * pulley**2) * self.w * (motor - pulley)
        return np.array([motor, pulley, pull + damped, counter])

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of all states."""
        motor, pulley, pull, counter, volts = z
        slip = motor - pulley
        rate = pull + 2 * (p.zeta + p.zeta_2 * pulley**2) * p.w * slip
        lost = motor + p.F * ca.tanh(motor / 0.02) + p.windage * motor * ca.fabs(motor)
        return (
            (p.gain * volts - lost) / p.lag - p.share * rate,
            rate,
            p.w**2 * (1 + (pull / p.stiff) ** 2) * slip,
            (p.scale * ca.fabs(pulley) ** p.power - counter) / p.window,
            (u[0] - volts) / p.lag_amplifier,
        )

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """What the counter shows [V]."""
        return (z[3],)

    def measure(self, state: PlantState, rng: np.random.Generator) -> Array:
        """The reading with noise, in steps."""
        return np.round(super().measure(state, rng) / STEP) * STEP
