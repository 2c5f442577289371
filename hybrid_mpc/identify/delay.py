"""Recordings of a machine with delayed inputs: the inputs that act in each period, and the samples without them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.delay import TINY

NONE = 0.05
"""Delay over the period below which the delay is set to zero."""


def delayed(trajectory: Trajectory, delay: float) -> Trajectory:
    """Replace the inputs of a trajectory by the inputs that act under a delay, so that no delay remains to identify.

    A delay of ``m + f`` periods, with ``0 <= f < 1``, gives ``(1 - f) u_{k-m} + f u_{k-m-1}``: the mean of the acting
    input over the period. The acting inputs of the first samples are unknown, so these samples are left out. ``delay``
    [s] is positive.
    """
    whole, rest = _split(delay, trajectory.dt)
    share, first = rest / trajectory.dt, lost_samples(delay, trajectory.dt)
    n = len(trajectory.t)
    if n <= first + 1:
        raise InputError(
            f"{trajectory.name}: too short for a delay of {delay:g} s, with only {n} samples. Give a longer recording "
            "[HM-IDENTIFY-007]"
        )
    younger = trajectory.u[first - whole : n - whole]
    older = trajectory.u[first - whole - 1 : n - whole - 1] if share > 0 else younger
    rest_of = trajectory.part(slice(first, None))
    return replace(rest_of, u=(1 - share) * younger + share * older)


def shifted(trajectories: Sequence[Trajectory], delay: float) -> list[Trajectory]:
    """Trajectories with the inputs that act; unchanged without a delay."""
    return [delayed(t, delay) for t in trajectories] if delay else list(trajectories)


def lost_samples(delay: float, dt: float) -> int:
    """Number of samples at the start of a trajectory whose acting input is unknown; 0 without a delay."""
    whole, rest = _split(delay, dt) if delay else (0, 0.0)
    return whole + (rest > 0)


def _split(delay: float, dt: float) -> tuple[int, float]:
    """Whole periods of a delay, and the remaining time [s]."""
    if not (delay > 0 and math.isfinite(delay)):
        raise InputError(
            f"delay: give a positive number, got {delay} s; without a delay, use the prior itself [HM-IDENTIFY-008]"
        )
    whole = math.floor(delay / dt + TINY)
    rest = delay - whole * dt
    return whole, (rest if rest > TINY * dt else 0.0)
