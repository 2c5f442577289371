"""How far the pendulum's test runs lie from the first 3, 6, ... training runs.

``python docs/results/reproduction/coverage.py [--seed 0]`` prints a row an amount of data: the range of the speed in
training, the share of test samples ``(phi, phi_dot, u)`` with a coordinate outside the range of training, and their
distance to the nearest training sample, in standard deviations of all 15 training runs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hybrid_mpc import Trajectory
from scenarios.pendulum.experiment import SET, runs


def samples(trajectories: Sequence[Trajectory]) -> NDArray[np.float64]:
    """``(phi, phi_dot, u)`` of all periods, one below the other."""
    return np.vstack([np.column_stack([t.x[: len(t.u)], t.u]) for t in trajectories])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    found = runs(SET, parser.parse_args().seed, Path())
    training, test = ([t for t in found if t.role == role] for role in ("train", "test"))
    scale, judged = samples(training).std(axis=0), samples(test)
    print(f"speeds of the test runs: {judged[:, 1].min():.1f} to {judged[:, 1].max():.1f} rad/s\n")
    print("| sequences | trained speeds [rad/s] | outside [%] | distance: median | 95 % | largest |")
    print("| --- | --- | --- | --- | --- | --- |")
    for n in (3, 6, 9, 12, 15):
        known = samples(training[:n])
        low, high = known.min(axis=0), known.max(axis=0)
        outside = ((judged < low) | (judged > high)).any(axis=1).mean()
        distance, _ = cKDTree(known / scale).query(judged / scale)
        quantiles = " | ".join(f"{q:.2f}" for q in np.quantile(distance, [0.5, 0.95, 1.0]))
        print(f"| {n} | {low[1]:.1f} to {high[1]:.1f} | {100 * outside:.1f} | {quantiles} |")


if __name__ == "__main__":
    main()
