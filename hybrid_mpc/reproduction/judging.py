"""Free runs of all networks of an ensemble on the test runs: their figures, and which of them diverged (torch)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.reproduction.table import METRICS, Divergence, Network

if TYPE_CHECKING:
    from hybrid_mpc.identification.evaluation import FreeRun
    from hybrid_mpc.identification.trained import Trained

Array = NDArray[np.float64]
BEYOND = 10.0
"""An output beyond so many times the largest one measured in any test run counts as diverged."""
RULE = (
    f"A network has diverged if in any test run a state of its free run is not finite, or an output goes beyond "
    f"{BEYOND:g} times the largest one measured in all test runs. Diverged networks are counted; means and standard "
    "deviations are over the others, medians over all (a diverged one counting as infinite)."
)
NEAR = 1.1
"""A training has converged where its validation error is first within this factor of its best."""
SHOWN = ("t", "u", "x", "x_hat", "energy_measured_w", "energy_model_w")


def divergence(runs: Sequence[FreeRun]) -> Divergence | None:
    """Where the free runs of one network left all bounds (``RULE``); None if they did not.

    Args:
        runs: Free runs over all test runs.
    """
    largest = np.max([np.abs(run.y).max(0) for run in runs], axis=0)
    found: list[tuple[FreeRun, int]] = []
    for run in runs:
        with np.errstate(invalid="ignore"):
            bad = ~np.isfinite(run.x_hat).all(1) | (np.abs(run.y_hat) > BEYOND * largest).any(1)
        if bad.any():
            found.append((run, int(np.argmax(bad))))
    if not found:
        return None
    run, step = found[0]
    return Divergence(run.name, step, float(run.t[step] - run.t[0]), len(found))


def judged_network(
    runs: Sequence[FreeRun], validation: float | None = None, converged: int | None = None
) -> Network:
    """Figures of one network, or where it diverged.

    Args:
        runs: Its free runs over all test runs.
        validation: Its best validation error. Default: there was none.
        converged: Optimiser steps until it had converged. Default: not known.
    """
    from hybrid_mpc.identification.evaluation import score

    where = divergence(runs)
    figures = {} if where is not None else {k: v for k, v in asdict(score(runs)).items() if k in METRICS}
    known = validation if validation is not None and np.isfinite(validation) else None
    return Network(figures, known, converged if known is not None else None, where)


def converged_steps(trained: Trained) -> list[int]:
    """Optimiser steps after which each network's validation error was within ``NEAR`` of its best."""
    best = np.minimum.accumulate(trained.curve["validation"], axis=0)
    first = np.argmax(best <= NEAR * best[-1], axis=0)
    return [int(trained.curve["step"][row, i]) for i, row in enumerate(first)]


def shown_run(runs: Sequence[FreeRun], name: str) -> dict[str, Any]:
    """Arrays of the run that is drawn; of the first one if there is none of that name."""
    run = next((r for r in runs if r.name == name), runs[0])
    return {key: getattr(run, key) for key in SHOWN}
