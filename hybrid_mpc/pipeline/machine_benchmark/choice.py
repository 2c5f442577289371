"""Which model a benchmark recommends, from free runs that no test file enters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identification.trained import Trained
from hybrid_mpc.pipeline.machine_benchmark.free_runs import figures_of, run_freely
from hybrid_mpc.pipeline.machine_benchmark.physics import Physics
from hybrid_mpc.pipeline.machine_benchmark.recordings import benchmark_of
from hybrid_mpc.scenario import Scenario

IN_MOTION = 0.1
"""Least length [s] that is given of a validation piece: it begins in motion, while a recording that gives less (EMPS,
20 ms) begins at rest, and two samples tell no speed beside an unknown acceleration."""
CANDIDATES = ("phy", "pgrnn", "mopgrnn", "pgrnn mean", "mopgrnn mean")
"""What may be recommended."""


def candidate_errors(
    scenario: Scenario,
    physics: Physics,
    networks: Mapping[str, Trained],
    trajectories: Sequence[Trajectory],
    warm_up: float,
) -> dict[str, float]:
    """Error of every candidate's free runs, in the benchmark's unit.

    Args:
        scenario: The machine.
        physics: The fitted prior.
        networks: Trained networks by kind.
        trajectories: Recordings with the commanded inputs.
        warm_up: Length [s] of what is given of each.
    """
    spec, prior = benchmark_of(scenario), scenario.prior(physics.fit.values)
    runs = run_freely(prior, physics, networks, trajectories, warm_up=warm_up, length=spec.length)
    return {name: figures_of(runs, name, unit=spec.unit, scale=spec.scale)["rmse"] for name in runs[0].y_hat}


def recommended(validation: Mapping[str, float], long: Mapping[str, float]) -> str:
    """The candidate whose larger error, over the prior's, is least: on validation pieces and on runs of full length.

    Validation pieces are what nothing was trained on, but they may be shorter than the runs that judge, and then say
    nothing of a drift.

    Args:
        validation: Errors on the validation pieces.
        long: Errors on :attr:`Recordings.long`; may be empty.

    Example:
        >>> short = {"phy": 2.0, "pgrnn": 1.0, "mopgrnn": 1.5, "pgrnn mean": 1.2, "mopgrnn mean": 1.6}
        >>> recommended(short, {}), recommended(short, {**short, "pgrnn": 3.0, "pgrnn mean": 2.1})
        ('pgrnn', 'mopgrnn')
    """

    def worse(name: str) -> float:
        over_prior = [
            1.0 if name == "phy" else part[name] / part["phy"] for part in (validation, long) if part
        ]
        return max(math.inf if math.isnan(v) else v for v in over_prior)  # NaN: both have diverged

    return min(CANDIDATES, key=worse)
