"""The temperature lab in simulation: heaters that radiate and lag their command, a room whose temperature sways."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scenarios.simulated.plant import SimulatedPlant

Array = NDArray[np.float64]
KELVIN = 273.15


@dataclass(frozen=True)
class TemperatureLabPlant(SimulatedPlant):
    """Two heaters that lose heat to the room by convection and by radiation, ``radiation (H^4 - ambient^4)``.

    About a third of the loss at room temperature is radiation, and more when it is hot; the prior's loss is in
    proportion to the temperature. The power follows its command with a lag. The room sways about ``room`` as a sine.
    Warming, losses, coupling and lags of the sensors are within 20 % of those fitted to the recordings.

    Args:
        warming1: Rate of heater 1 a per cent of power [K/s/%].
        warming2: Of heater 2.
        convection: Loss to the room over the heat capacity [1/s].
        radiation: [1/s/K^3].
        between: Exchange between the heaters over the capacity [1/s].
        lag1: Of sensor 1 [s].
        lag2: Of sensor 2 [s].
        lag_power: Of the power behind its command [s].
        room: Mean temperature of the room [degC].
        sway: Its amplitude [K].
        period: Of the sway [s].
    """

    warming1: float = 0.0128
    warming2: float = 0.0055
    convection: float = 0.0115
    radiation: float = 5.24e-11
    between: float = 0.0068
    lag1: float = 92.0
    lag2: float = 90.0
    lag_power: float = 12.0
    room: float = 24.0
    sway: float = 1.5
    period: float = 5400.0
    sigma: ClassVar[tuple[float, ...]] = (0.08, 0.08)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((30.0, 30.0), ())

    def start(self, x: Array) -> Array:
        """Heaters, sensors and room; powers [%]; what the room sways by a quarter of a period later [K]."""
        return np.concatenate([x, self.rest[0], [self.sway]])

    def shown(self, z: Array) -> Array:
        """Heaters, sensors and room."""
        return z[:5]

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of all states."""
        heater1, heater2, sensor1, sensor2, ambient, power1, power2, swing = z
        swapped, turn = p.between * (heater1 - heater2), 2 * pi / p.period

        def lost(t: Any) -> Any:
            radiated = p.radiation * ((t + KELVIN) ** 4 - (ambient + KELVIN) ** 4)
            return p.convection * (t - ambient) + radiated

        return (
            p.warming1 * power1 - lost(heater1) - swapped,
            p.warming2 * power2 - lost(heater2) + swapped,
            (heater1 - sensor1) / p.lag1,
            (heater2 - sensor2) / p.lag2,
            turn * swing,
            (u[0] - power1) / p.lag_power,
            (u[1] - power2) / p.lag_power,
            -turn * (ambient - p.room),
        )

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Both sensors' temperatures [degC]."""
        return z[2:4]
