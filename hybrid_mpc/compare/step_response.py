"""Step responses of closed loops: rise time, settling time, overshoot, offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal

Array = NDArray[np.float64]
AT_REST = 0.2
"""Last share of a loop over which the set-point must be constant, and over which the offset is averaged. Before a step,
the set-point must be constant for this share of the time after the step."""
RISE = (0.1, 0.9)
"""Shares of a step between which the rise time is measured, as in python-control's ``step_info``."""
CLEAR = 10.0
"""Smallest size of a step, in standard deviations of the signal at the end of the loop."""
LARGEST = 0.5
"""Smallest size of a step, as a share of the largest deviation after it: else a load moves the signal."""
STILL = 1e-9
"""Relative change of a reference that counts as rounding."""


@dataclass(frozen=True)
class StepResponse:
    """The response of a signal to its last set-point.

    Args:
        offset: Mean deviation over the last fifth [unit of the signal].
        rise: Rise time from 10 to 90 % of the step [s]; None without a clear step, or if 90 % is not reached.
        settling: Time until the signal stays within 5 % of the step [s]; None likewise.
        overshoot: Overshoot [% of the step]; None without a clear step.
    """

    offset: float
    rise: float | None = None
    settling: float | None = None
    overshoot: float | None = None


def step_response(t: ArrayLike, values: ArrayLike, reference: ArrayLike) -> StepResponse | None:
    """The response to the last set-point; None if the reference moves until the end.

    A step leads from one constant set-point to another. After a pulse or a moving reference, only the offset is given.

    Args:
        t: Times ``(n,)`` [s].
        values: The signal ``(n,)``; NaN for missing samples.
        reference: The reference ``(n,)``.

    Example:
        >>> t = np.linspace(0.0, 10.0, 1001)
        >>> found = step_response(t, 2.0 - 2.0 * np.exp(-t), np.full(1001, 2.0))
        >>> round(found.rise, 2), round(found.settling, 1), found.overshoot, round(found.offset, 4)
        (2.2, 3.0, 0.0, -0.0003)
        >>> step_response(t, np.sin(t), np.sin(t)) is None
        True
    """
    t, y, r = (np.asarray(v, dtype=np.float64) for v in (t, values, reference))
    there = np.isfinite(y) & np.isfinite(r)
    t, y, r = t[there], y[there], r[there]
    if len(t) < 10:
        return None
    late = t >= t[-1] - AT_REST * (t[-1] - t[0])
    scale = max(1.0, float(np.max(np.abs(r))))
    if np.ptp(r[late]) > STILL * scale:
        return None
    moved = np.flatnonzero(np.abs(r - r[-1]) > STILL * scale)
    begin = int(moved[-1]) + 1 if moved.size else 0
    offset = float(np.mean(y[late]) - r[-1])
    size = r[-1] - y[begin]
    jump = abs(r[begin] - r[begin - 1]) if begin else abs(size)
    least = max(CLEAR * float(np.std(y[late])), LARGEST * float(np.max(np.abs(y[begin:] - r[-1]))))
    since = int(np.searchsorted(t, t[begin] - AT_REST * (t[-1] - t[begin])))
    before = r[max(0, min(since, begin - 2)) : begin]
    stood = not begin or np.ptp(before) <= STILL * scale
    # smallest share of a step that the reference must make within one period; a slow ramp has no rise time
    if abs(size) <= least or jump < 0.5 * abs(size) or not stood:
        return StepResponse(offset)
    answer = (y[begin:] - y[begin]) * np.sign(size)
    if np.max(answer) < RISE[1] * abs(size):  # the signal never reaches 90 % of the step
        return StepResponse(offset, overshoot=0.0)
    share, times = answer / abs(size), t[begin:] - t[begin]
    low, high = (int(np.argmax(share >= level)) for level in RISE)
    # share of a step within which a signal has settled
    outside = np.flatnonzero(np.abs(share - 1.0) >= 0.05)
    settled = int(outside[-1]) + 1 if outside.size else 0
    return StepResponse(
        offset,
        float(times[high] - times[low]),
        float(times[settled]) if settled < len(times) else None,
        100.0 * max(0.0, float(share.max()) - 1.0),
    )


def step_responses(problem: OCP, machine: Prior, loop: Mapping[str, Array]) -> dict[Signal, StepResponse]:
    """Responses of all weighted signals of a loop that end at a set-point.

    For a speed whose position has a moving reference, only the offset is given.

    Args:
        problem: The control problem; it weights outputs or states.
        machine: Names the signals, and pairs speeds with positions.
        loop: Arrays :data:`~hybrid_mpc.compare.loops.DRAWN`.

    Example: ``step_responses(scenario.control, scenario.prior(), row.arrays)``
    """
    if problem.n_y:
        signals, weights, values, references = machine.outputs, problem.q_y, loop["y"], loop["y_ref"]
    else:
        signals, weights, values, references = machine.states, problem.q, loop["x"], loop["reference"]
    positions = {} if problem.n_y else {speed: position for position, speed in machine.kinematics}
    n, found = len(loop["t"]), {}
    for i, signal in enumerate(signals):
        if weights[i] > 0:
            answer = step_response(loop["t"], values[:n, i], references[:n, i])
            if answer is not None and i in positions and _moves(references[:n, positions[i]]):
                answer = StepResponse(answer.offset)
            if answer is not None:
                found[signal] = answer
    return found


def _moves(reference: Array) -> bool:
    """Whether a reference ``(n,)`` changes in two successive periods; a step changes in one period only."""
    changes = np.abs(np.diff(reference)) > STILL * max(1.0, float(np.nanmax(np.abs(reference), initial=0.0)))
    return bool(np.any(changes[1:] & changes[:-1]))
