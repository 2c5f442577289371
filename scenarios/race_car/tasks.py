"""Closed-loop tasks of the model race car: paths in time, known ahead."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import OCP, Fault, Task
from scenarios.common import moves, quintic

Array = NDArray[np.float64]
START = (0.0, 0.0, 0.0, 0.3, 0.0)
# 2 cm, 0.1 rad, 0.3 m/s, what a path needs is free, 0.1 rad and 0.2 m/s a period; a second ahead is four lags. An
# F1TENTH's wheels turn by 0.4 rad.
CONTROL = OCP(40, q=(2500.0, 2500.0, 100.0, 11.0, 0.0), r=(1e-3, 1e-3), r_delta=(100.0, 25.0), u_min=(-0.4, 0.0),
              u_max=(0.4, 2.0))  # fmt: skip


def states(along: Array, across: Array) -> Array:
    """States ``(n, 5)`` of a path; ``along`` and ``across`` ``(n, 2)`` are x and y with their rates."""
    heading = np.arctan2(across[:, 1], along[:, 1])
    speed = np.hypot(along[:, 1], across[:, 1])
    return np.column_stack([along[:, 0], across[:, 0], heading, speed, np.zeros_like(speed)])


def lanes(t: Array) -> Array:
    """0.3 m/s along x, 0.15 m to one side, then to the other, no faster than the recordings."""
    along = np.column_stack([0.3 * t, np.full_like(t, 0.3)])
    return states(along, moves(t, (0.0, 0.15, -0.15, 0.0), 5.5, 5.0))


def slalom(speed: float) -> Callable[[Array], Array]:
    """Along x from 0.3 m/s to ``speed`` [m/s] within 2 s, and 0.2 m to both sides every 3 m."""

    def path(t: Array) -> Array:
        ramp = np.clip(t, 0.0, 2.0)
        gained = speed - 0.3
        x = 0.3 * t + gained * (ramp**2 / 4 + t - ramp)
        rate = 0.3 + gained * ramp / 2
        turn = 2 * np.pi / 3.0
        fade, slope = quintic(x / 3.0)
        across = 0.2 * fade * np.sin(turn * x)
        by_x = 0.2 * (slope / 3.0 * np.sin(turn * x) + fade * turn * np.cos(turn * x))
        return states(np.column_stack([x, rate]), np.column_stack([across, by_x * rate]))

    return path


TASKS = (
    Task("lanes", "Change lanes no faster than the recordings", 20.0, START, lanes),
    Task("slalom", "Slalom at 0.8 m/s, twice as fast as the recordings", 8.0, START, slalom(0.8)),
    Task("fast_slalom", "Slalom at 1.5 m/s, where the tyres slip", 8.0, START, slalom(1.5)),
    Task("crooked", "Change lanes although the wheels do not point where they are told", 20.0, START, lanes,
         faults=(Fault(1.0, np.inf, "input_offset", 0.05, "steering_command"),)),
)  # fmt: skip
