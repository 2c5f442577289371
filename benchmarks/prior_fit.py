"""From how far off, and how exactly, does each fit of a prior find the parameters?

``python benchmarks/prior_fit.py [--grid 3] [--draws 4] [--out FILE.json]``. The paper's pendulum; measured are angle
and speed with noise of a hundredth of their spread. A fit has found the plant when l and d are within 2 %. Starts lie
on a grid over the prior's bounds. Seconds of processor time, and the ratio to the first fit; ``z`` is the error over
the stated standard error, over draws of the noise.
"""

from __future__ import annotations

from time import process_time

import numpy as np
import torch
from parts import arguments, report

from hybrid_mpc import Trajectory
from hybrid_mpc.identify.dataset import cut_windows
from hybrid_mpc.identify.fit import ParameterFit, cut_segments, multiple_shooting
from scenarios.pendulum.data import run
from scenarios.pendulum.plant import DampedPendulum
from scenarios.pendulum.prior import PendulumPrior

DT, NOISE, FOUND, RUNS = 0.01, 0.01, 0.02, 3


def measured(plant: DampedPendulum, seed: int) -> list[Trajectory]:
    """Training runs of 5 s with noisy states."""
    rng, out = np.random.default_rng(seed), []
    for number in range(1, RUNS + 1):
        t, u, x = (v[::10] for v in run(plant, "train", number, 0))
        x = x + NOISE * x.std(0) * rng.standard_normal(x.shape)
        out.append(Trajectory(f"run{number}", "train", DT, t, u[:, None], x[:, :1], x, np.zeros_like(x)))
    return out


def methods(fit: ParameterFit, runs: list[Trajectory]):
    """Fits ``start -> (theta, jacobian)`` by name."""

    def windows(length: float, overlap: int = 4):
        n = round(length / DT)
        cut = cut_windows(runs, 0, n, max(1, n // overlap))
        return cut.take(torch.linspace(0, len(cut) - 1, min(48, len(cut))).round().long())

    return {
        "equation error": lambda s: fit.output_error(s, windows(DT, 1), 40),
        "free runs of 0.5 s": lambda s: fit.output_error(s, windows(0.5), 20),
        "multiple shooting 0.5 s": lambda s: multiple_shooting(fit, s, cut_segments(runs, 50)),
    }


def basin(plant: DampedPendulum, grid: int) -> list[dict]:
    """Share of starts from which each fit finds the plant, and its time."""
    fit, runs, rows = ParameterFit(PendulumPrior, DT), measured(plant, 0), []
    truth = fit.scaled({"l": plant.parameters.l, "d": plant.parameters.d})
    share = (np.arange(grid) + 0.5) / grid  # even in the logarithm, not on the bounds
    axes = [low * (high / low) ** share for low, high in zip(fit.lower, fit.upper, strict=True)]
    starts = np.array([g.ravel() for g in np.meshgrid(*axes)]).T
    for method, solve in methods(fit, runs).items():
        begin = process_time()
        found = sum(bool(np.abs(solve(start)[0] / truth - 1).max() < FOUND) for start in starts)
        seconds = (process_time() - begin) / len(starts)
        first = rows[0]["s a fit"] if rows else seconds
        rows.append(
            {"fit": method, "found": found, "of": len(starts), "s a fit": seconds, "/ first": seconds / first}
        )
    return rows


def coverage(plant: DampedPendulum, draws: int) -> list[dict]:
    """Error and stated standard error of each fit from the published values over draws of the noise."""
    found: dict[str, list] = {}
    truth = np.array([plant.parameters.l, plant.parameters.d])
    for seed in range(draws):
        fit, runs = ParameterFit(PendulumPrior, DT), measured(plant, 100 + seed)
        for method, solve in methods(fit, runs).items():
            theta, jacobian = solve(fit.nominal)
            errors, values = fit.confidence(theta, jacobian)[0], fit.values(theta)
            error = np.array([values["l"], values["d"]]) - truth
            found.setdefault(method, []).append((error / truth, error / [errors["l"], errors["d"]]))
    rows = []
    for method, pairs in found.items():
        rms, z = (np.sqrt((np.array(values) ** 2).mean(0)) for values in zip(*pairs, strict=True))
        row = {
            "rms error l [%]": 100 * rms[0],
            "rms error d [%]": 100 * rms[1],
            "rms z of l": z[0],
            "rms z of d": z[1],
        }
        rows.append({"fit": method, "draws": draws, **{name: float(v) for name, v in row.items()}})
    return rows


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--grid", type=int, default=3, help="starts along each axis")
    parser.add_argument("--draws", type=int, default=4, help="draws of the noise")
    given = parser.parse_args()
    plant = DampedPendulum(noise=0.0)
    report(basin(plant, given.grid) + coverage(plant, given.draws), given.out)


if __name__ == "__main__":
    main()
