"""Prior of the temperature lab: heat balances of two heaters, lags of two sensors, an ambient that is not measured."""

from __future__ import annotations

from typing import Any, ClassVar

from hybrid_mpc import Balance, OperatingPoint, Parameter, Prior, Signal

ROOM, DAY = 24.0, 86400.0
"""Temperature [degC] to which the room comes back, and in what time [s]: a state that no input moves and that never
comes back has no steady state that a controller could be asked for. Over a run of 600 s it is 0.7 % of the way."""


class TemperatureLabPrior(Prior):
    r"""``H_i' = (P_i Q_i + (ambient - H_i)) / tau + (H_j - H_i) / tau_12``, ``T_i' = (H_i - T_i) / lag_i``.

    Two transistors heat and lose heat to the room and to each other; thermistors follow them with a lag. Measured are
    the thermistors. The room's temperature is not measured and drifts, so it is a state: it all but keeps its value
    (``ROOM``, ``DAY``), and networks may correct its rate as little as that of the sensors.

    Source: the simulator of the package ``tclab`` (Apache-2.0): P 0.70 and 0.35 K/%, tau 20, tau_12 100, lag 140 s.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("heater1", "degC", 0.0, 150.0),
        Signal("heater2", "degC", 0.0, 150.0),
        Signal("temperature1", "degC", 0.0, 120.0),
        Signal("temperature2", "degC", 0.0, 120.0),
        Signal("ambient", "degC", 10.0, 40.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (
        Signal("power1", "%", 0.0, 100.0),
        Signal("power2", "%", 0.0, 100.0),
    )
    outputs: ClassVar[tuple[Signal, ...]] = (states[2], states[3])
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("P1", 0.70, "K/%", 0.3, 1.4, "warming of heater 1 over the room a per cent"),
        Parameter("P2", 0.35, "K/%", 0.15, 0.9, "of heater 2"),
        Parameter("tau", 20.0, "s", 5.0, 200.0, "time constant of a heater against the room"),
        Parameter("tau_12", 100.0, "s", 20.0, 1000.0, "of a heater against the other"),
        Parameter("lag1", 140.0, "s", 20.0, 300.0, "of sensor 1"),
        Parameter("lag2", 140.0, "s", 20.0, 300.0, "of sensor 2"),
    )
    corrects: ClassVar[tuple[str, ...]] = ("heater1", "heater2")
    operating_point: ClassVar[OperatingPoint] = OperatingPoint(
        x=(43.5, 36.0, 43.5, 36.0, ROOM), u=(30.0, 30.0)
    )

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of the temperatures [K/s]."""
        between = (x.heater2 - x.heater1) / p.tau_12
        return (
            (p.P1 * u.power1 + x.ambient - x.heater1) / p.tau + between,
            (p.P2 * u.power2 + x.ambient - x.heater2) / p.tau - between,
            (x.heater1 - x.temperature1) / p.lag1,
            (x.heater2 - x.temperature2) / p.lag2,
            (ROOM - x.ambient) / DAY,
        )

    def balances(self, x: Any, u: Any, w: Any, p: Any) -> tuple[Balance, ...]:
        """Heat of both heaters over the capacity of one, which nothing tells: what they swap is no part of it."""
        heated = p.P1 * u.power1 + p.P2 * u.power2
        lost = x.heater1 + x.heater2 - 2 * x.ambient  # negative where the room heats them, so it is a supply
        return (Balance("heat", x.heater1 + x.heater2, (heated - lost) / p.tau, 0.0, "K", "K/s"),)
