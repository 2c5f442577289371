"""What a closed loop's answer to a set-point is like: rise, settling, overshoot, offset."""

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
"""Share of a loop at its end over which a set-point must be held, and over which the offset is a mean. The set-point
before a step must have been held for that share of the time after it."""
SETTLED = 0.05
"""Share of a step within which a signal has settled."""
RISE = (0.1, 0.9)
"""Shares of a step between which a signal rises, as python-control's ``step_info`` counts it."""
CLEAR = 10.0
"""Size of a step, in standard deviations of the signal at the end, from which it tells of a rise."""
LARGEST = 0.5
"""Share of the largest deviation behind it that a step must have: else a load moves the signal, not the set-point."""
STILL = 1e-9
"""Share of a reference's size by which rounding may move it."""
JUMP = 0.5
"""Share of a step that the reference must make at once: one that came there slowly asks for no rise."""


@dataclass(frozen=True)
class StepResponse:
    """The answer of a signal to its last set-point.

    Args:
        offset: Mean deviation over the last fifth [the signal's unit].
        rise: Time from 10 to 90 % of the step [s]; None where there is no clear step, or it is not reached.
        settling: Time until it stays within 5 % of the step [s]; None likewise.
        overshoot: By how much it goes beyond, in per cent of the step; None where there is no clear step.
    """

    offset: float
    rise: float | None = None
    settling: float | None = None
    overshoot: float | None = None


def step_response(t: ArrayLike, values: ArrayLike, reference: ArrayLike) -> StepResponse | None:
    """The answer to the last set-point; None where the reference moves until the end.

    A step leads from one set-point that is held to another. A pulse that comes back, or the end of a moving reference,
    asks for no rise: then there is the offset alone.

    Args:
        t: Instants ``(n,)`` [s].
        values: The signal ``(n,)``; NaN where it was not measured.
        reference: Its reference ``(n,)``.

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
    if abs(size) <= least or jump < JUMP * abs(size) or not stood:
        return StepResponse(offset)
    answer = (y[begin:] - y[begin]) * np.sign(size)
    if np.max(answer) < RISE[1] * abs(size):  # it never arrives
        return StepResponse(offset, overshoot=0.0)
    share, times = answer / abs(size), t[begin:] - t[begin]
    low, high = (int(np.argmax(share >= level)) for level in RISE)
    outside = np.flatnonzero(np.abs(share - 1.0) >= SETTLED)
    settled = int(outside[-1]) + 1 if outside.size else 0
    return StepResponse(
        offset,
        float(times[high] - times[low]),
        float(times[settled]) if settled < len(times) else None,
        100.0 * max(0.0, float(share.max()) - 1.0),
    )


def step_responses(problem: OCP, machine: Prior, loop: Mapping[str, Array]) -> dict[Signal, StepResponse]:
    """Answers of all signals of a loop that the problem weighs and that end at a set-point.

    Of a speed whose position has a moving reference the offset alone counts: its jumps belong to that motion.

    Args:
        problem: The control problem: outputs where it weighs those, else states.
        machine: Names the signals, and says which are speeds of which.
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
    """Whether a reference ``(n,)`` changes over two periods in a row: a step changes over one."""
    changes = np.abs(np.diff(reference)) > STILL * max(1.0, float(np.nanmax(np.abs(reference), initial=0.0)))
    return bool(np.any(changes[1:] & changes[:-1]))
