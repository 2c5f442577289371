"""The plate heat exchanger in simulation: a valve that lags, plates of two lumps, a cold side that sways."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from scenarios.simulated.plant import SimulatedPlant

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeatExchangerPlant(SimulatedPlant):
    """Hot and cold water mix in a share that a valve sets; plates and outlet follow one after the other.

    The prior has one lag, a valve that acts after a delay, and an arc tangent; here two lags, a valve that lags, a
    logistic curve, and a loss to the room. The cold side sways as a sine about its temperature at the start, which is
    that of the day. Share, slope, middle and time constants are within 20 % of those fitted to the recordings.

    Args:
        k: Share of hot water with the valve open [-].
        slope: Of the logistic curve [-].
        middle: Command at which half of it flows [-].
        lag_plates: Of the plates behind the mix [s].
        lag_outlet: Of the outlet behind the plates [s].
        lag_valve: Of the valve behind its command [s].
        loss: To the room of 22 degC, over the heat that flows through [-].
        sway: Amplitude of the cold side's temperature [K].
        period: Of the sway [s].
    """

    k: float = 0.66
    slope: float = 5.0
    middle: float = 1.02
    lag_plates: float = 28.0
    lag_outlet: float = 9.0
    lag_valve: float = 5.0
    loss: float = 0.03
    sway: float = 1.0
    period: float = 3000.0
    sigma: ClassVar[tuple[float, ...]] = (0.065,)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((0.98,), (78.0,))

    def start(self, x: Array) -> Array:
        """Outlet, cold side, plates, valve; the day's cold side, and what it sways by a quarter of a period later."""
        return np.array([*x, x[0], self.rest[0][0], x[1], self.sway])

    def shown(self, z: Array) -> Array:
        """Outlet and cold side."""
        return z[:2]

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of all states."""
        outlet, cold, plates, valve, day, swing = z
        share, turn = p.k / (1 + ca.exp(-p.slope * (valve - p.middle))), 2 * pi / p.period
        mix = share * w[0] + (1 - share) * cold
        return (
            (plates - outlet) / p.lag_outlet,
            turn * swing,
            (mix - plates - p.loss * (plates - 22.0)) / p.lag_plates,
            (u[0] - valve) / p.lag_valve,
            0.0,
            -turn * (cold - day),
        )

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """The outlet's temperature [degC]."""
        return (z[0],)
