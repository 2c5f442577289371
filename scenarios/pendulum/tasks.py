"""Closed-loop tasks of the paper's pendulum. No torch in here."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import OCP, Fault, Task
from scenarios.common import faded_sines, moves

Array = NDArray[np.float64]

# Bryson's rule: one over the square of the largest deviation that is tolerable: 10 mrad, 0.5 rad/s, 5 N m of change per
# period. Torque that a reference needs is no deviation; its weight (100 N m) only keeps the problem regular. Half a
# second ahead is five of the pendulum's time constants (2 m l^2 / d = 96 ms). 20 N m is what the data reach.
CONTROL = OCP(horizon=50, q=(1e4, 4.0), r=(1e-4,), r_delta=(0.04,), u_min=(-20.0,), u_max=(20.0,))

STEPS = (0.0, 0.5, -0.4, 0.6, 0.0)
STEP_TIME = 0.8
MOVE_TIME = 0.4
LOAD = -3.0
"""Unknown load [N m]: the torque that holds the pendulum at 0.14 rad."""


def sine_reference(t: Array) -> Array:
    """``(n, 2)``: 0.4 rad at 0.5 Hz and 0.15 rad at 1.2 Hz, faded in over 0.5 s, and its exact derivative."""
    return faded_sines(t, ((0.4, 0.5), (0.15, 1.2)), fade_s=0.5)


def swing_reference(t: Array) -> Array:
    """``(n, 2)``: 0.3 rad at 0.5 Hz, faded in over 0.5 s: what the load is rejected on."""
    return faded_sines(t, ((0.3, 0.5),), fade_s=0.5)


TASKS = (
    Task("track_sine", "Follow two sinusoids of 0.4 and 0.15 rad", 4.0, (0.0, 0.0), sine_reference),
    Task("track_step", "Follow moves of up to 1 rad in 0.4 s", 4.0, (0.0, 0.0),
         partial(moves, levels=STEPS, hold_s=STEP_TIME, move_s=MOVE_TIME)),
    Task("reject_load", "Swing on against an unknown constant load", 4.0, (0.0, 0.0), swing_reference,
         faults=(Fault(1.5, np.inf, "input_offset", LOAD),)),
)  # fmt: skip
