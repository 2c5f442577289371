"""Prior of the plate heat exchanger: a share of hot water that a valve sets, and one time constant."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import OperatingPoint, Parameter, Prior, Signal

COLD, DAY = 41.0, 86400.0
"""Temperature [degC] to which the cold side comes back, and in what time [s]: a state that no input moves and that
never comes back has no steady state that a controller could be asked for. Over 300 s it is 0.3 % of the way."""


class HeatExchangerPrior(Prior):
    """``tau outlet' = g(valve) reservoir + (1 - g(valve)) cold - outlet``.

    ``g = k (atan(slope (valve - middle)) / pi + 1/2)``: the valve is dead at one end and saturates at the other. The
    reservoir's temperature is measured, a saw-tooth of its thermostat. The cold side's is not, and differs from day to
    day: it is a state that all but keeps its value (``COLD``, ``DAY``). All that is not explained goes there, and stays
    in a free run: what an estimator adds to the outlet's own rate would be forgotten, and one of the two is all that a
    sensor tells of.

    Source: Ožbot, Lughofer, Škrjanc, *Evolving neuro-fuzzy systems-based design of experiments*, IEEE TFS 31 (2023).
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("outlet", "degC", 0.0, 100.0),
        Signal("cold", "degC", 35.0, 47.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("valve", "-", -0.5, 3.0),)
    disturbances: ClassVar[tuple[Signal, ...]] = (Signal("reservoir", "degC", 20.0, 100.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (states[0],)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("k", 0.66, "-", 0.2, 1.2, "share of hot water with the valve open"),
        Parameter("slope", 4.1, "-", 1.0, 15.0, "of the valve"),
        Parameter("middle", 0.98, "-", 0.4, 1.6, "command at which half of it flows"),
        Parameter("tau", 17.0, "s", 5.0, 60.0, "time constant of the plates"),
    )
    corrects: ClassVar[tuple[str, ...]] = ("cold",)
    operating_point: ClassVar[OperatingPoint] = OperatingPoint(x=(53.2, COLD), u=(0.98,), w=(78.0,))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of the outlet's and of the cold side's temperature [K/s]."""
        share = p.k * (ca.atan(p.slope * (u.valve - p.middle)) / ca.pi + 0.5)
        return (share * w.reservoir + (1 - share) * x.cold - x.outlet) / p.tau, (COLD - x.cold) / DAY
