"""Closed-loop tasks of the golf robot and the optimal control problem they share. No torch in here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.scenario import ControlSpec, Task

Array = NDArray[np.float64]

STEPS = (0.0, 0.4, -0.4, 0.65, 0.1, -0.65)  # [rad], each held STEP_TIME
STEP_TIME = 1.6  # [s]


def sine_reference(t: Array) -> Array:
    """``(n, 2)``: 0.8 rad at 0.4 Hz, faded in over 2 s (smooth acceleration), and its exact derivative.

    The prior needs at most 0.31 N m for it; the friction reverses every 1.25 s.

    Example:
        >>> sine_reference(np.zeros(1)).tolist()
        [[0.0, 0.0]]
    """
    w, s = 2 * np.pi * 0.4, np.clip(t / 2.0, 0.0, 1.0)
    fade, slope = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / 2.0
    return 0.8 * np.column_stack([fade * np.sin(w * t), slope * np.sin(w * t) + fade * w * np.cos(w * t)])


def step_reference(t: Array) -> Array:
    """``(n, 2)``: hard steps in both directions up to 0.65 rad, of which holding takes 0.37 of 0.5 N m.

    Example:
        >>> step_reference(np.array([2.0])).tolist()
        [[0.4, 0.0]]
    """
    index = np.clip(np.floor(t / STEP_TIME + 1e-9).astype(int), 0, len(STEPS) - 1)
    return np.column_stack([np.array(STEPS)[index], np.zeros(len(t))])


TASKS = (
    Task("track_sine", "Follow a sinusoid of 0.8 rad at 0.4 Hz", 10.0, (0.0, 0.0), sine_reference),
    Task("track_step", "Follow steps of up to 0.65 rad", STEP_TIME * len(STEPS), (0.0, 0.0), step_reference),
)

# Bryson's rule: one over the square of the largest deviation that is tolerable: 0.05 rad, 1 rad/s,
# 0.5 N m of torque, 0.25 N m of change per period. The encoder's sigma: quantisation (0.44 mrad) and noise.
CONTROL = ControlSpec(
    horizon=50,
    q=(400.0, 1.0),
    r=(4.0,),
    r_delta=(16.0,),
    u_min=(-0.5,),
    u_max=(0.5,),
    estimator_sigma=(0.5e-3,),
)
