"""From how far off, and how exactly, does each fit of a prior find the parameters? ``python benchmarks/prior_fit.py``.

The paper's pendulum. Measured: angle and speed with noise of a hundredth of their spread. A fit has found the plant
when l and d are within 2 %. The starts lie on a grid over the bounds of the prior.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from time import process_time

import numpy as np
import torch
from numpy.typing import NDArray

from hybrid_mpc import Trajectory
from hybrid_mpc.identify.dataset import cut_windows
from hybrid_mpc.identify.fit import STAGES, ParameterFit, cut_segments, multiple_shooting
from scenarios.paper.swarm import SwarmSettings, particle_swarm
from scenarios.pendulum.data import run
from scenarios.pendulum.plant import DampedPendulum
from scenarios.pendulum.prior import PendulumPrior

Array = NDArray[np.float64]
DT = 0.01
NOISE = 0.01
FOUND = 0.02
RUNS = 3
SWARMS = 2


def measured(plant: DampedPendulum, seed: int) -> list[Trajectory]:
    """Training runs of 5 s with noisy states."""
    rng, out = np.random.default_rng(seed), []
    for number in range(1, RUNS + 1):
        t, u, x = (v[::10] for v in run(plant, "train", number, 0))
        x = x + NOISE * x.std(0) * rng.standard_normal(x.shape)
        out.append(Trajectory(f"run{number}", "train", DT, t, u[:, None], x[:, :1], x, np.zeros_like(x)))
    return out


def methods(fit: ParameterFit, runs: list[Trajectory]) -> dict[str, Callable[[Array], tuple[Array, object]]]:
    """Fits ``start -> (theta, jacobian)`` by name."""

    def windows(length: float, overlap: int = 4):
        n = round(length / DT)
        cut = cut_windows(runs, 0, n, max(1, n // overlap))
        return cut.take(torch.linspace(0, len(cut) - 1, min(48, len(cut))).round().long())

    def staged(start: Array) -> tuple[Array, object]:
        jacobian: object = None
        for length, evaluations in STAGES:
            start, jacobian = fit.output_error(start, windows(min(length, 4.9)), evaluations)
        return start, jacobian

    return {
        "equation error": lambda s: fit.output_error(s, windows(DT, 1), 40),
        "free runs of 0.5 s": lambda s: fit.output_error(s, windows(0.5), 20),
        "free runs of 4.9 s": lambda s: fit.output_error(s, windows(4.9), 20),
        "free runs of 0.5, 2, 4.9 s": staged,
        "multiple shooting 0.5 s": lambda s: multiple_shooting(fit, s, cut_segments(runs, 50)),
    }


def starts(fit: ParameterFit, n: int) -> Array:
    """Grid of ``n x n`` starts between the bounds, even in the logarithm, not on the bounds."""
    share = (np.arange(n) + 0.5) / n
    axes = [low * (high / low) ** share for low, high in zip(fit.lower, fit.upper, strict=True)]
    return np.array([g.ravel() for g in np.meshgrid(*axes)]).T


def basin(plant: DampedPendulum, grid: int) -> None:
    """Share of starts from which each fit finds the plant, and its time."""
    fit, runs = ParameterFit(PendulumPrior, DT), measured(plant, 0)
    truth = fit.scaled({"l": plant.parameters.l, "d": plant.parameters.d})
    print(f"\nFound from so many of {grid * grid} starts\n\n| fit | found | s a fit |\n| --- | --- | --- |")
    for method, solve in methods(fit, runs).items():
        begin, found = process_time(), 0
        for start in starts(fit, grid):
            theta, _ = solve(start)
            found += bool(np.abs(theta / truth - 1).max() < FOUND)
        print(f"| {method} | {found} | {(process_time() - begin) / grid**2:.1f} |", flush=True)
    begin, found = process_time(), 0
    windows = cut_windows(runs, 0, round(2 / DT), round(1 / DT))
    for seed in range(SWARMS):
        theta = particle_swarm(fit, windows, SwarmSettings(seed=seed))
        found += bool(np.abs(theta / truth - 1).max() < FOUND)
    seconds = (process_time() - begin) / SWARMS
    print(f"| particle swarm (needs no start) | {found} of {SWARMS} seeds | {seconds:.1f} |", flush=True)


def coverage(plant: DampedPendulum, draws: int) -> None:
    """Error and stated standard error of each fit from the published values over draws of the noise."""
    print(f"{draws} draws of the noise; mean and rms of error over standard error\n")
    print(
        "| fit | rms error of l [%] | of d [%] | l: mean, rms z | d: mean, rms z |\n| --- | --- | --- | --- | --- |"
    )
    rows: dict[str, list[tuple[Array, Array]]] = {}
    for seed in range(draws):
        fit, runs = ParameterFit(PendulumPrior, DT), measured(plant, 100 + seed)
        for method, solve in methods(fit, runs).items():
            if method == "free runs of 4.9 s":
                continue
            theta, jacobian = solve(fit.nominal)
            errors, _ = fit.confidence(theta, jacobian)
            values, truth = fit.values(theta), plant.parameters
            error = np.array([values["l"] - truth.l, values["d"] - truth.d])
            z = error / np.array([errors["l"], errors["d"]])
            rows.setdefault(method, []).append((error / np.array([truth.l, truth.d]), z))
    for method, found in rows.items():
        error, z = (np.array([pair[i] for pair in found]) for i in (0, 1))
        rms, mean, size = np.sqrt((error**2).mean(0)), z.mean(0), np.sqrt((z**2).mean(0))
        cells = " | ".join(f"{mean[i]:+.1f}, {size[i]:.1f}" for i in (0, 1))
        print(f"| {method} | {100 * rms[0]:.3f} | {100 * rms[1]:.3f} | {cells} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grid", type=int, default=3, help="starts along each axis")
    parser.add_argument("--draws", type=int, default=4, help="draws of the noise")
    given = parser.parse_args()
    plant = DampedPendulum(noise=0.0)
    coverage(plant, given.draws)
    basin(plant, given.grid)


if __name__ == "__main__":
    main()
