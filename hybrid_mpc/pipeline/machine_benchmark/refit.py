"""A machine that has changed: the prior's parameters again, from a few seconds of its motion, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.prior_long_runs import OutputErrorFit, cut_runs
from hybrid_mpc.physics import Prior
from hybrid_mpc.pipeline.machine_benchmark.physics import Physics, shifted

LENGTHS = (0.5, 1.0)
"""Free runs [s] that are fitted, the short ones first: from parameters that are far off a long one leads nowhere."""
EVALUATIONS = 15
FEWEST = 3
"""Free runs at least: one alone would be fitted by any parameters."""


def refitted(
    make: Callable[..., Prior], physics: Physics, trajectory: Trajectory, *, seconds: float, dt: float
) -> tuple[Physics, Trajectory]:
    """Fit the parameters to the first seconds of a recording, starting from those of the machine as it was.

    The delay stays what it is. The free runs start from states that the old prior smooths, then from those of the new
    one: its noise is fitted to what it did not know, so a wrong prior costs little there.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        physics: The prior as it was fitted.
        trajectory: Recording of the changed machine, with the commanded inputs.
        seconds: Length [s] of what is fitted.
        dt: Model period [s].

    Returns:
        The prior with its new parameters, and the rest of the recording.

    Raises:
        InputError: If the recording is no longer than what is to be fitted, or that is too short.
    """
    n = round(seconds / dt)
    if n >= len(trajectory.t) - 1 or seconds < FEWEST * LENGTHS[0]:
        raise InputError(
            f"{trajectory.name}: {seconds:g} s are to be fitted; that takes at least {FEWEST * LENGTHS[0]:g} s and a "
            f"recording that is longer than it ({len(trajectory.t) * dt:g} s)"
        )
    index = np.arange(len(trajectory.t))
    first = trajectory.part(index < n, trajectory.name, trajectory.role)
    rest = trajectory.part(index >= n, trajectory.name, trajectory.role)
    fit = OutputErrorFit(make, dt)
    values = physics.fit.values
    theta, slope = np.array([values[p.name] for p in fit.free]) / fit.unit, np.zeros((0, 0))
    stages = []
    for length in LENGTHS:
        smoother = physics.smoother(make(values), dt)
        known = smoother.smooth(shifted([first], physics.delay))
        runs = cut_runs(known, round(length / dt), 0, len(first.t))
        theta, slope = fit.fit(theta, runs, EVALUATIONS, robust=True)
        values = fit.values(theta)
        stages.append({"stage": f"free runs of {length:g} s", "validation_error": fit.rmse(theta, runs)})
    return replace(physics, fit=fit.result(theta, slope, stages)), rest
