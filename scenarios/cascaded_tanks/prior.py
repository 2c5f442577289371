"""Prior of the cascaded tanks: two mass balances with overflow."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import Balance, OperatingPoint, Parameter, Prior, Signal

ROOT_WIDTH = 0.1
"""Level [V] below which a root is smoothed: 1 % less than the root at five times this, a straight line at zero."""
EDGE_WIDTH = 0.2
"""Levels [V] over which water begins to run over an edge."""
SPILL = 0.5
"""What runs over an edge for each volt above it [1/s]: fast beside the outlets, slow enough for a period of 4 s."""

SENSOR_END = 10.0
"""Largest reading [V]."""


def root(level: Any) -> Any:
    """``sqrt(level)`` [V^0.5] with a finite slope at an empty tank, odd below it."""
    return level / (level * level + ROOT_WIDTH**2) ** 0.25


def above(level: Any, edge: Any) -> Any:
    """``max(level - edge, 0)`` [V], smooth over ``EDGE_WIDTH`` and never negative."""
    height = level - edge
    return 0.5 * (height + ca.sqrt(height * height + EDGE_WIDTH**2))


class CascadedTanksPrior(Prior):
    """Two tanks above each other, each with an outlet and an edge that it can run over.

    ``upper' = k_p u - k_1 sqrt(upper) - spill_1``, ``lower' = k_1 sqrt(upper) - k_2 sqrt(lower) + s spill_1 -
    spill_2``.

    The sensor shows ``lower + bend lower (lower - 10)``: it is uncalibrated, and 10 V, where it ends, is the level's
    unit. Without ``bend`` free runs over the record's first half are off by 0.42 V, with it by 0.19 V. Nothing tells
    the upper tank's own scale: its level is the volume in the same volts, so one balance holds for both. A share ``s``
    of what runs over the upper edge falls into the lower tank.

    Source: Schoukens, Mattsson, Wigren, Noël, *Cascaded tanks benchmark combining soft and hard nonlinearities* (2016).
    """

    states: ClassVar[tuple[Signal, ...]] = (Signal("upper", "V", 0.0, 16.0), Signal("lower", "V", 0.0, 12.0))
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("pump", "V", 0.0, 10.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (
        Signal("level", "V", 0.0, 12.0, saturation=(-ca.inf, SENSOR_END)),
    )
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("k_1", 0.054, "V^0.5/s", 0.01, 0.2, "outlet of the upper tank"),
        Parameter("k_2", 0.067, "V^0.5/s", 0.01, 0.2, "outlet of the lower tank"),
        Parameter("k_p", 0.056, "1/s", 0.01, 0.2, "inflow a volt of the pump"),
        Parameter("edge_1", 10.0, "V", 5.0, 15.0, "edge of the upper tank"),
        Parameter("edge_2", 10.0, "V", 9.5, 12.0, "edge of the lower tank"),
        Parameter(
            "share", 0.5, "-", 0.0, 1.0, "of what runs over the upper edge that falls into the lower tank"
        ),
        Parameter("bend", 0.0, "1/V", -0.05, 0.09, "of the lower sensor; below 0.1 it shows more for more"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint(x=(6.0, 4.0), u=(2.4,))

    def flows(self, x: Any, p: Any) -> tuple[Any, Any, Any, Any]:
        """Outlet and overflow of the upper tank, and of the lower one [V/s]."""
        return (
            p.k_1 * root(x.upper), SPILL * above(x.upper, p.edge_1),
            p.k_2 * root(x.lower), SPILL * above(x.lower, p.edge_2),
        )  # fmt: skip

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of both levels [V/s]."""
        outlet_1, spill_1, outlet_2, spill_2 = self.flows(x, p)
        return p.k_p * u.pump - outlet_1 - spill_1, outlet_1 + p.share * spill_1 - outlet_2 - spill_2

    def output(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """What the lower tank's sensor shows [V], before it ends."""
        return (x.lower + p.bend * x.lower * (x.lower - SENSOR_END),)

    def balances(self, x: Any, u: Any, w: Any, p: Any) -> tuple[Balance, ...]:
        """Volume of water in both tanks, in volts of the lower one."""
        _, spill_1, outlet_2, spill_2 = self.flows(x, p)
        lost = outlet_2 + (1 - p.share) * spill_1 + spill_2
        return (Balance("volume", x.upper + x.lower, p.k_p * u.pump, lost, "V", "V/s"),)
