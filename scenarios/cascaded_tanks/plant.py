"""The cascaded tanks in simulation: sharp edges, outlets that are no ideal orifices, a pump that lags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from scenarios.simulated.plant import PlantState, SimulatedPlant

Array = NDArray[np.float64]
SENSOR_END = 10.0
"""Largest reading [V]."""


@dataclass(frozen=True)
class CascadedTanksPlant(SimulatedPlant):
    """Two tanks whose outlets go by ``level^exponent``; above an edge it is a weir that runs over.

    The prior's outlets go by the square root, and its edges are rounded. Outlets (at 5 V), inflow, edges, share and
    bend are within 20 % of those fitted to the recording.

    Args:
        k_1: Outlet of the upper tank [V^(1 - exponent)/s].
        k_2: Of the lower tank.
        k_p: Inflow a volt of the pump [1/s].
        exponent: Of both outlets [-].
        edge_1: Edge of the upper tank [V].
        edge_2: Of the lower tank.
        weir: What runs over an edge, over the height above it to the power of 1.5 [V^-0.5/s].
        share: Of what runs over the upper edge that falls into the lower tank [-].
        bend: Of the lower sensor [1/V].
        lag_pump: Of the pump behind its voltage [s].
    """

    k_1: float = 0.034
    k_2: float = 0.041
    k_p: float = 0.040
    exponent: float = 0.56
    edge_1: float = 8.6
    edge_2: float = 10.2
    weir: float = 0.4
    share: float = 0.8
    bend: float = 0.048
    lag_pump: float = 6.0
    sigma: ClassVar[tuple[float, ...]] = (0.02,)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((2.4,), ())

    def start(self, x: Array) -> Array:
        """Both levels, and the pump's voltage that acts."""
        return np.concatenate([x, self.rest[0]])

    def shown(self, z: Array) -> Array:
        """Both levels."""
        return z[:2]

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of levels and pump [V/s]."""
        upper, lower, pump = z
        outlets = [k * ca.fmax(h, 1e-4) ** p.exponent for k, h in ((p.k_1, upper), (p.k_2, lower))]
        spills = [p.weir * ca.fmax(h - e, 0.0) ** 1.5 for h, e in ((upper, p.edge_1), (lower, p.edge_2))]
        return (
            p.k_p * pump - outlets[0] - spills[0],
            outlets[0] + p.share * spills[0] - outlets[1] - spills[1],
            (u[0] - pump) / p.lag_pump,
        )

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """What the lower tank's sensor shows [V]."""
        return (ca.fmin(z[1] + p.bend * z[1] * (z[1] - SENSOR_END), SENSOR_END),)

    def measure(self, state: PlantState, rng: np.random.Generator) -> Array:
        """The reading with noise, which the sensor's end cuts off, too."""
        return np.minimum(super().measure(state, rng), SENSOR_END)
