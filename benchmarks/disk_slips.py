"""Where the recordings of the unbalanced disk slip: ``python benchmarks/disk_slips.py FILE.npz --model DIR``.

A recording's samples are taken for evenly spaced. Where one came late, the measured angle jumps, and a free run is off
from there on until the disk has forgotten. Such a jump is told from a model error by its size: the second difference
of a free run's error over the period squared is an acceleration, and one above 60 rad/s^2 (that of 2 V) within one
period is taken for none of the disk's. The model is that of ``hybrid-mpc benchmark
unbalanced_disk --data FILE.npz --out DIR``. Printed: slips in each part of the recording, and the errors of the free
runs over the validation and held-back pieces, as they are and without the 5 s after each slip.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from pathlib import Path

import numpy as np

from hybrid_mpc import load_scenario
from hybrid_mpc.job.benchmark import load_model
from hybrid_mpc.job.benchmark_runs import benchmark_of, read_training, run_freely

JUMP = 60.0
"""Acceleration [rad/s^2]."""
FORGOTTEN_S = 5.0


def slips(run, model: str, dt: float) -> list[float]:
    """Times [s] of the jumps in a free run's error, those within a second as one."""
    error = (run.y_hat[model] - run.y)[:, 0]
    places = np.flatnonzero(np.abs(np.diff(error, 2)) / dt**2 > JUMP)
    times: list[float] = []
    for t in run.t[places + 1]:
        if not times or t - times[-1] > 1.0:
            times.append(float(t))
    return times


def rms(runs, name: str, skip: dict[str, list[float]] | None = None) -> float:
    """Error [rad] over all runs, without what follows a slip where ``skip`` says so."""
    parts = []
    for run in runs:
        keep = np.ones(len(run.t), dtype=bool)
        for t in (skip or {}).get(run.name, ()):
            keep &= ~((run.t > t - 0.1) & (run.t < t + FORGOTTEN_S))
        parts.append((run.y_hat[name] - run.y)[keep, 0])
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def main() -> None:
    """Print slips and errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--model", type=Path, required=True, help="folder of the benchmark on this file")
    given = parser.parse_args()
    scenario = load_scenario("unbalanced_disk")
    spec, data = benchmark_of(scenario), read_training(scenario, (given.file,))
    model = load_model(given.model, scenario.name)
    prior, warm_up = scenario.prior(model.physics.fit.values), scenario.data.warm_up
    print("| part | slips at [s] | model | as it is [rad] | without 5 s after slips |")
    print("| --- | --- | --- | ---: | ---: |")
    for part, pieces in (("train", data.train), ("valid", data.valid), ("held back", data.held_back)):
        runs = run_freely(prior, model.physics, model.networks, pieces, warm_up=warm_up, length=spec.length)
        found = {run.name: slips(run, model.hybrid, model.dt) for run in runs}
        times = ", ".join(f"{t:.1f}" for run in runs for t in found[run.name]) or "none"
        for name in dict.fromkeys(["phy", model.hybrid]):
            print(f"| {part} | {times} | {name} | {rms(runs, name):.5f} | {rms(runs, name, found):.5f} |")


if __name__ == "__main__":
    main()
