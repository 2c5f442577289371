"""Closed-loop tasks of the plate heat exchanger: a cold day, and a reservoir that sways, which is measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import OCP, Fault, Task

Array = NDArray[np.float64]
DAY = (53.2, 38.0)
"""Outlet and cold side [degC] of a day that is 3 K colder than the prior's operating point."""


def saw_tooth(t: Array) -> Array:
    """The reservoir ``(n, 1)`` [degC] under its thermostat: 240 s up from 75.5 to 78.2, 190 s down."""
    return np.interp(t, [0.0, 240.0, 430.0], [75.5, 78.2, 75.5], period=430.0)[:, None]


def heater_off(t: Array) -> Array:
    """The reservoir ``(n, 1)`` [degC] whose heater is off from 300 s on: it cools by a degree a minute."""
    return 77.0 - np.clip((t - 300.0) / 60.0, 0.0, 10.0)[:, None]


def temperatures(t: Array) -> Array:
    """Set-points of the outlet ``(n, 1)`` [degC]: up, then down, in 40 s each."""
    return np.interp(t, [300.0, 340.0, 900.0, 940.0], [53.2, 58.0, 58.0, 50.0])[:, None]


def held(t: Array) -> Array:
    """53.2 degC ``(n, 1)``."""
    return np.full((len(t), 1), DAY[0])


# 0.5 K, what a temperature needs is free, 0.2 of the valve a period; 160 s are four time constants
CONTROL = OCP(40, q=(0.0, 0.0), r=(1e-3,), r_delta=(25.0,), u_min=(0.0,), u_max=(2.2,), q_y=(4.0,))

TASKS = (
    Task("temperatures", "Change the outlet's temperature on a cold day", 1500.0, DAY, temperatures, w=saw_tooth),
    Task("saw_tooth", "Hold the outlet while the reservoir sways, which is measured", 1500.0, DAY, held,
         w=saw_tooth),
    Task("saw_tooth_ahead", "The same, the reservoir known ahead", 1500.0, DAY, held,
         control=CONTROL.changed(preview_w=True), w=saw_tooth),
    Task("heater_off", "Hold the outlet although the reservoir's heater fails", 1500.0, DAY, held, w=heater_off),
    Task("weak_valve", "Hold the outlet although the valve opens less", 1500.0, DAY, held, w=saw_tooth,
         faults=(Fault(500.0, np.inf, "input_offset", -0.1),)),
)  # fmt: skip
