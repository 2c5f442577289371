"""Closed-loop tasks of the double pendulum: swing up and stand, with the torque at one joint or at the other."""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import OCP, ClosedLoopResult, Fault, Task

Array = NDArray[np.float64]
DT = 0.01
"""Period of model and controller [s]."""
DRIVEN, PASSIVE = 5.0, 0.5
"""Largest torques [N m] of the recorded swing-ups: of the joint that is driven, and of the other, which may do little
more than overcome its dry friction (0.24 and 0.16 N m). Links lifted straight up need 3.5 N m at the first joint, and
1.5 N m at the second."""
HANGING, UPRIGHT = (0.0, 0.0, 0.0, 0.0), (pi, 0.0, 0.0, 0.0)
UP_AT = 1.2
"""Time [s] from which a swing-up is to stand, as in the recordings, which take 1.2 to 1.4 s."""
PUSHED = 0.5
"""Size of a push [N m], as recorded (0.2 to 0.7)."""
# By Bryson's rule: 50 mrad, 1 rad/s, what a joint needs is free but for 10 and 1 N m, which keep the problem regular,
# 2 N m of change a period at the driven joint. 0.5 s ahead are four of the upright pendulum's time constants. The
# terminal cost is of a pendulum in motion: at rest the slope of dry friction would pass for strong damping.
PENDUBOT = OCP(
    50, q=(400.0, 400.0, 1.0, 1.0), r=(0.01, 1.0), r_delta=(0.25, 10.0), u_min=(-DRIVEN, -PASSIVE),
    u_max=(DRIVEN, PASSIVE), working_point=((pi, 0.0, 1.0, 1.0), (0.0, 0.0)),
)  # fmt: skip
ACROBOT = PENDUBOT.changed(
    r=(1.0, 0.01), r_delta=(10.0, 0.25), u_min=(-PASSIVE, -DRIVEN), u_max=(PASSIVE, DRIVEN)
)


def shoves() -> tuple[Array, ...]:
    """Torques ``(n, 2)`` from which a swing-up by the second joint is sought: full torque one way, back, then none."""
    t = DT * np.arange(round(UP_AT / DT))
    shove = DRIVEN * np.where(t < 0.2, 1.0, np.where(t < 0.35, -1.0, 0.0))
    return tuple(np.column_stack([0 * t, sign * shove]) for sign in (1.0, -1.0))


def swing(control: OCP, r: tuple[float, float], starts: tuple[Array, ...] = ()) -> OCP:
    """The problem of a swing-up: torque counts (5 and 0.5 N m), the horizon is the swing, moves of up to 50 ms."""
    blocks = (1,) * 10 + (2,) * 10 + (5,) * 18
    return control.changed(horizon=round(UP_AT / DT), r=r, starts=starts, blocks=blocks)


def upright(t: Array) -> Array:
    """``(n, 4)``: at rest at the top."""
    return np.tile(UPRIGHT, (len(t), 1))


def standing(t: Array) -> Array:
    """Weight factors ``(n, 4)`` of a swing-up: nothing counts before ``UP_AT``, everything from then on."""
    return np.where(t[:, None] > UP_AT - DT / 2, 1.0, 0.0) * np.ones(4)


def stood(result: ClosedLoopResult) -> dict[str, float]:
    """What a loop reached.

    ``up_at_s``: from when on both joints stay within 0.2 rad of the top (infinite: never); ``hold_rmse_rad``: root mean
    square of both over the last second.
    """
    off = np.abs(result.x[:, :2] - UPRIGHT[:2])
    away = np.flatnonzero(off.max(axis=1) > 0.2)
    first = 0 if not away.size else int(away[-1]) + 1
    last = result.t >= result.t[-1] - 1.0
    up_at = float(result.t[first]) if first < len(off) else np.inf
    return {"up_at_s": up_at, "hold_rmse_rad": float(np.sqrt(np.mean(off[last] ** 2)))}


def pushes(driven: str, other: str) -> tuple[Fault, ...]:
    """A push at either joint, as long as those recorded."""
    return (Fault(1.0, 1.3, "input_offset", PUSHED, other), Fault(2.5, 2.8, "input_offset", -PUSHED, driven))


TASKS = (
    Task("pendubot_swing_up", "Swing up by the first joint", 3.0, HANGING, upright, standing,
         swing(PENDUBOT, (0.04, 4.0)), figures=stood),
    Task("pendubot_push", "Stand by the first joint while pushes come", 4.0, UPRIGHT, upright, control=PENDUBOT,
         faults=pushes("tau1", "tau2"), figures=stood),
    Task("pendubot_load", "Stand by the first joint under a constant torque there", 4.0, UPRIGHT, upright,
         control=PENDUBOT, faults=(Fault(1.0, np.inf, "input_offset", 0.3, "tau1"),), figures=stood),
    Task("acrobot_swing_up", "Swing up by the second joint", 3.0, HANGING, upright, standing,
         swing(ACROBOT, (4.0, 0.04), shoves()), figures=stood),
    Task("acrobot_push", "Stand by the second joint while pushes come", 4.0, UPRIGHT, upright, control=ACROBOT,
         faults=pushes("tau2", "tau1"), figures=stood),
)  # fmt: skip
