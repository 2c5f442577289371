"""Closed-loop tasks of the unbalanced disk and the optimal control problems they share. No torch in here."""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import OCP, ClosedLoopResult, Fault, Task
from scenarios.common import faded_sines
from scenarios.unbalanced_disk.nominal import DT

Array = NDArray[np.float64]

PEAK = 3.0
"""Largest voltage [V]. It holds the disk up to 0.68 rad beside hanging, so it reaches the top by swinging only."""
# Bryson's rule: one over the square of the largest deviation that is tolerable: 50 mrad, 1 rad/s, 2 V of change per
# period. Voltage that a reference needs is no deviation; its weight (10 V) only keeps the problem regular. A second
# ahead is twelve of the upright disk's time constants (1 / w_0 = 86 ms).
CONTROL = OCP(horizon=40, q=(400.0, 1.0), r=(0.01,), r_delta=(0.25,), u_min=(-PEAK,), u_max=(PEAK,))
# At the top, at the tolerated speed: at rest the slope of dry friction would pass for strong damping.
UPRIGHT = CONTROL.changed(working_point=((pi, 1.0), (0.0,)))

UP_AT = 1.5
"""Time [s] from which the swing-up asks the disk to stand upright: as long as its horizon."""
PUSHES = (0.25, 0.4, 0.55)
BACK = (0.45, 0.65)


def pumps(horizon: int) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """Voltages ``(horizon, 1)`` from which a swing-up is sought: full voltage one way, then the other, then none.

    Which way first, for how long, and for how long back is what tells the ways up apart; a plan that begins with none
    of them sees only the slope from where the disk hangs.
    """
    t = DT * np.arange(horizon)
    plans = []
    for sign in (1.0, -1.0):
        for push in PUSHES:
            for back in BACK:
                u = sign * PEAK * np.where(t < push, 1.0, np.where(t < push + back, -1.0, 0.0))
                plans.append(tuple((float(value),) for value in u))
    return tuple(plans)


# In the swing voltage counts (3 V); the penalty of being elsewhere begins when the disk is to stand.
SWING = UPRIGHT.changed(horizon=round(UP_AT / DT), r=(0.11,), starts=pumps(round(UP_AT / DT)))


def upright(t: Array) -> Array:
    """``(n, 2)``: at rest at the top."""
    return np.tile([pi, 0.0], (len(t), 1))


def standing(t: Array) -> Array:
    """Weight factors ``(n, 2)`` of the swing-up: nothing counts before ``UP_AT``, everything from then on."""
    return np.where(t[:, None] > UP_AT - DT / 2, 1.0, 0.0) * np.ones(2)


def sway(t: Array) -> Array:
    """``(n, 2)``: 0.25 rad at 0.5 Hz and 0.1 rad at 1.1 Hz about the top, faded in over 1 s, and its derivative."""
    return faded_sines(t, ((0.25, 0.5), (0.1, 1.1))) + np.array([pi, 0.0])


def swing(t: Array) -> Array:
    """``(n, 2)``: 0.5 rad at 0.6 Hz and 0.3 rad at 1.5 Hz about hanging down, faded in over 1 s, and its derivative."""
    return faded_sines(t, ((0.5, 0.6), (0.3, 1.5)))


def stood(result: ClosedLoopResult) -> dict[str, float]:
    """What a swing-up reached.

    ``up_at_s``: from when on the disk stays within 0.2 rad of the top (infinite: never); ``hold_rmse_rad``: root mean
    square of its angle from the top over the last second.
    """
    off = np.abs(result.x[:, 0] - pi)
    away = np.flatnonzero(off > 0.2)
    first = 0 if not away.size else int(away[-1]) + 1
    last = result.t >= result.t[-1] - 1.0
    up_at = float(result.t[first]) if first < len(off) else np.inf
    return {"up_at_s": up_at, "hold_rmse_rad": float(np.sqrt(np.mean(off[last] ** 2)))}


TASKS = (
    Task("swing_up", f"Swing up from hanging down, stand from {UP_AT:g} s on", 4.0, (0.0, 0.0), upright, standing,
         SWING, figures=stood),
    Task("track_up", "Sway about the top: two sinusoids of 0.25 and 0.1 rad", 5.0, (pi, 0.0), sway, control=UPRIGHT),
    Task("track_down", "Follow two sinusoids of 0.5 and 0.3 rad about hanging down", 5.0, (0.0, 0.0), swing),
    Task("reject_load", "Stand upright against an unknown voltage of 0.4 V from 1.5 s on", 4.0, (pi, 0.0), upright,
         control=UPRIGHT, faults=(Fault(1.5, np.inf, "input_offset", 0.4),)),
)  # fmt: skip
