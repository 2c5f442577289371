"""How far friction of the EMPS drifts within its recording: fitted to one part, run freely over another.

    python benchmarks/emps_drift.py DATA_EMPS.mat

What no fit to one part tells about the next limits every model of force and start alone (docs/machines.md).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from hybrid_mpc import Trajectory
from hybrid_mpc.identify.output_error import OutputErrorFit, cut_runs
from hybrid_mpc.job.benchmark_runs import read_test
from scenarios.emps import scenario


def main(path: Path) -> None:
    """Print the table."""
    (whole,) = read_test(scenario, path)
    middle = len(whole.t) // 2
    parts = {
        "first half": part(whole, 0, middle),
        "second half": part(whole, middle, len(whole.t)),
        "all": whole,
    }
    runs = {name: cut_runs([t], len(t.t) - 1, 0, 1) for name, t in parts.items()}
    fit = OutputErrorFit(scenario.prior, whole.dt)
    names = [p.name for p in fit.free]
    print("fitted to   ", *(f"{name:>8}" for name in names), *(f"{name:>12}" for name in runs), "[mm]")
    for name, own in runs.items():
        theta, _ = fit.fit(fit.nominal, own, 15, robust=False)
        values = fit.values(theta)
        errors = [1e3 * fit.rmse(theta, other) for other in runs.values()]
        print(
            f"{name:12}", *(f"{values[n]:8.2f}" for n in names), *(f"{e:12.2f}" for e in errors), flush=True
        )


def part(whole: Trajectory, start: int, end: int) -> Trajectory:
    """Samples from ``start`` to ``end``."""
    index = np.arange(len(whole.t))
    return whole.part((index >= start) & (index < end), whole.name, whole.role)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
