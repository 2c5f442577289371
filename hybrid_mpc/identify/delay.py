"""Recordings of a machine whose input acts later: which input acts when, and which samples that costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError

NONE = 0.05
"""Share of a period below which a delay counts as none."""
TINY = 1e-9
"""Share of a period below which the part of a delay beyond whole periods counts as none."""


def delayed(trajectory: Trajectory, delay: float) -> Trajectory:
    """The trajectory with the inputs that act under a delay: identification then runs as without one.

    A delay of ``m`` periods and a share ``f`` gives ``(1 - f) u_{k-m} + f u_{k-m-1}``, the mean of what acts over the
    period. What acts before the first recorded input has arrived is not known: these samples are left out. ``delay``
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
    """Trajectories with the inputs that act; as they are without a delay."""
    return [delayed(t, delay) for t in trajectories] if delay else list(trajectories)


def lost_samples(delay: float, dt: float) -> int:
    """Samples at the start of a trajectory whose acting input is not known; none without a delay."""
    whole, rest = _split(delay, dt) if delay else (0, 0.0)
    return whole + (rest > 0)


def _split(delay: float, dt: float) -> tuple[int, float]:
    """Whole periods of a delay and what is left [s]."""
    if not (delay > 0 and math.isfinite(delay)):
        raise InputError(
            f"delay: give a positive number, got {delay} s; without a delay, use the prior itself [HM-IDENTIFY-008]"
        )
    whole = math.floor(delay / dt + TINY)
    rest = delay - whole * dt
    return whole, (rest if rest > TINY * dt else 0.0)
