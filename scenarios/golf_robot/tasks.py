"""Closed-loop tasks of the golf robot and the optimal control problems they share. No torch in here."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import OCP, ClosedLoopResult, Fault, Task
from scenarios.common import faded_sines, moves

Array = NDArray[np.float64]

# Bryson's rule: one over the square of the largest deviation that is tolerable: 10 mrad (7 mm at the head),
# 0.25 rad/s, 0.25 N m of change per period. Torque itself is no deviation where the reference needs it; its
# weight (5 N m) only keeps the problem regular. In a stroke effort counts: 0.5 N m. Limits: the
# drive's peak torque and slew, the angle the frame leaves free, a safe speed.
CONTROL = OCP(
    horizon=50,
    q=(1e4, 16.0),
    r=(0.04,),
    r_delta=(16.0,),
    u_min=(-0.5,),
    u_max=(0.5,),
    du_max=(0.25,),
    x_min=(-0.85, -2.5),
    x_max=(0.85, 2.5),
)
# Strokes look 1.6 s ahead, swing faster, in a narrower frame, and may pull the torque up in one period. The penalty of
# their limits must outweigh the impact's.
HARD_STROKE = CONTROL.changed(
    horizon=80, r=(4.0,), r_delta=(4.0,), du_max=None, x_min=(-0.8, -5.0), x_max=(0.8, 5.0),
    slack_linear=(1e6, 1e5),
)  # fmt: skip
# The fastest of the moves reaches 1.41 rad/s: the limit of a careful commissioning acts, and hardly costs.
SLOW = CONTROL.changed(x_min=(-0.85, -1.4), x_max=(0.85, 1.4))
# A drive that is spared: the torque of a load that comes at once takes more than a period to build up.
GENTLE = CONTROL.changed(du_max=(0.1,))
PUTT = HARD_STROKE.changed(u_min=(-0.2,), u_max=(0.2,))

IMPACT = 1.6
"""Time [s] of the impact: as long as the strokes' horizon, so that the first plan ends in it."""
FOLLOW_THROUGH = 0.4
LONG_FOLLOW_THROUGH = 0.5
"""Time [s] after the impact in which the club may swing out freely, before it is to come to rest. The long one is for
the fastest stroke of either kind: after 0.4 s the motor is far from having brought that club back, and what is asked
in vain costs every controller much the same and hides what tells them apart."""
PUTTS = (0.8, 1.1, 1.4, 1.65, 1.9)
HARD_STROKES = (3.0, 4.0)
STEPS = (0.0, 0.3, -0.2, 0.4, 0.0)
HEAVY_STEPS = (0.0, 0.3, -0.2, 0.5, 0.0)
STEP_TIME = 1.3
MOVE_TIME = 0.8
"""Time of a move [s], which the motor can follow at two thirds of its torque and more."""


def sine_reference(t: Array) -> Array:
    """``(n, 2)``: 0.5 rad at 0.35 Hz and 0.2 rad at 0.9 Hz, faded in over 1 s, and its exact derivative.

    The friction reverses about four times in a second, and the faster part is above the pendulum's own
    0.6 Hz: neither gravity nor a slow observer carries the club along.
    """
    return faded_sines(t, ((0.5, 0.35), (0.2, 0.9)))


def swing_reference(t: Array) -> Array:
    """``(n, 2)``: 0.3 rad at 0.35 Hz, faded in over 1 s: what disturbances are rejected on.

    A club that is merely held sticks, and what holding it costs is the same for all models.
    """
    return faded_sines(t, ((0.3, 0.35),))


def stroke(
    speed: float, follow_through: float = FOLLOW_THROUGH
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Reference and weight factors of a stroke: pass ``phi = 0`` at ``IMPACT`` with ``speed`` [rad/s], then rest.

    No swing is planned beforehand: up to the impact only effort counts, at it a miss by 5 mrad or by 10 mrad/s
    costs 1, then nothing for ``follow_through`` [s], then rest at 0 counts as in every task.
    """
    dt, half = 0.02, 0.01
    met = 1.0 / (np.array(CONTROL.q) * dt * np.array([5e-3, 1e-2]) ** 2)

    def reference(t: Array) -> Array:
        return np.column_stack([np.zeros(len(t)), np.where(np.abs(t - IMPACT) < half, speed, 0.0)])

    def weight(t: Array) -> Array:
        hit, rest = np.abs(t - IMPACT) < half, t > IMPACT + follow_through + half
        return np.where(hit[:, None], met, np.where(rest[:, None], np.ones(2), np.zeros(2)))

    return reference, weight


def impact(result: ClosedLoopResult, speed: float) -> dict[str, float]:
    """What a stroke reached, at the true crossing of ``phi = 0`` next to ``IMPACT`` (cubic between samples).

    ``speed_rad_s`` wanted, ``speed_error_rel``, ``timing_error_s``, ``effort_nm2s`` (integral of u^2 up to the impact).
    Errors are infinite where the club never crosses forwards.
    """
    t, x, u = result.t, result.x, result.u
    effort = float(np.sum(u[t < IMPACT] ** 2) * (t[1] - t[0]))
    crossings = np.flatnonzero((x[:-1, 0] < 0) & (x[1:, 0] >= 0))
    times = [_crossing(t[k : k + 2], x[k : k + 2]) for k in crossings]
    at, reached = min(times, key=lambda c: abs(c[0] - IMPACT), default=(np.inf, np.inf))
    error = {"speed_error_rel": reached / speed - 1.0, "timing_error_s": at - IMPACT}
    return {"speed_rad_s": speed, **error, "effort_nm2s": effort}


def _crossing(t: Array, x: Array) -> tuple[float, float]:
    """Time and speed of the zero of the cubic through two samples ``x (2, 2)`` of angle and speed."""
    h = float(t[1] - t[0])
    p0, v0, p1, v1 = x.ravel().tolist()
    cubic = np.polynomial.Polynomial(
        [p0, h * v0, 3 * (p1 - p0) - h * (2 * v0 + v1), 2 * (p0 - p1) + h * (v0 + v1)]
    )
    root = min(
        (complex(r) for r in cubic.roots()), key=lambda r: abs(r.imag) + max(-r.real, r.real - 1.0, 0.0)
    ).real
    return float(t[0] + h * root), float(cubic.deriv()(root)) / h


def _stroke_task(speed: float, control: OCP) -> Task:
    fastest = speed in (max(PUTTS), max(HARD_STROKES))
    reference, weight = stroke(speed, LONG_FOLLOW_THROUGH if fastest else FOLLOW_THROUGH)
    kind = "Putt" if control is PUTT else "Hard stroke"
    return Task(
        f"stroke_{speed:g}", f"{kind}: pass 0 at {IMPACT:g} s with {speed:g} rad/s, then rest", 3.0, (0.0, 0.0),
        reference, weight, control, figures=lambda result: impact(result, speed),
    )  # fmt: skip


TASKS = (
    Task("track_sine", "Follow two sinusoids of 0.5 and 0.2 rad", 6.0, (0.0, 0.0), sine_reference),
    Task("track_step", "Follow moves of up to 0.6 rad in 0.8 s", STEP_TIME * len(STEPS), (0.0, 0.0),
         partial(moves, levels=STEPS, hold_s=STEP_TIME, move_s=MOVE_TIME),
         control=SLOW),
    *(_stroke_task(speed, PUTT) for speed in PUTTS),
    *(_stroke_task(speed, HARD_STROKE) for speed in HARD_STROKES),
    Task("reject_push", "Swing on while a hand pushes for a second", 5.0, (0.0, 0.0), swing_reference,
         faults=(Fault(2.5, 3.5, "plant_push", 0.4),)),
    Task("reject_load", "Swing on against an unknown constant load", 5.0, (0.0, 0.0), swing_reference,
         control=GENTLE, faults=(Fault(2.0, np.inf, "input_offset", -0.08),)),
    Task("reject_heavy", "Follow moves with a club 20 % heavier", STEP_TIME * len(HEAVY_STEPS),
         (0.0, 0.0), partial(moves, levels=HEAVY_STEPS, hold_s=STEP_TIME, move_s=MOVE_TIME),
         faults=(Fault(0.0, np.inf, "plant_mass", 1.2),)),
)  # fmt: skip

QUICK_TASKS = ("track_sine", "stroke_1.4", "reject_load")
"""Tasks of the quick budget."""
