"""How long the prior of a machine takes to fit and to smooth its recordings by, as the main job does it.

    python benchmarks/fit_time.py golf_robot
    python benchmarks/fit_time.py torque_pendulum ../shared/data/torque_pendulum/energy_shaping_*.csv
    python benchmarks/fit_time.py all --data ../shared/data --out now.json --before before.json

Without files a simulated machine makes its own. Files are cut and given roles as by ``hybrid-mpc benchmark``. Printed
is a row of JSON: wall-clock and processor time [s], the error of free runs over held-out windows
(:mod:`unknown.independent`), the errors that chose, the fitted values and their standard errors. ``all`` fits the
repository's machines, and compares them with the file of another commit.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import numpy as np
from unknown.independent import Runs, cut, free_run_errors

from hybrid_mpc import Scenario, Trajectory, fit_prior, load_scenario, load_trajectories
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.simulation import required_substeps
from hybrid_mpc.workflow.benchmark_runs import read_training

RECORDINGS = {
    "golf_robot": (), "emps": ("*.mat",), "torque_pendulum": ("energy_shaping_*.csv",),
    "cascaded_tanks": ("estimation.csv",), "coupled_drives": ("uniform_*.csv",),
    "heat_exchanger": ("[rs]*.csv",), "unbalanced_disk": ("multisine_2024.npz",),
    "double_pendulum": ("*_swingup_01.csv", "sines_143339.csv", "sines_143524.csv"),
    "xl330_pendulum": ("kp100_*.csv", "kp800_*.csv"), "cart_pole": (), "two_link_arm": (),
    "temperature_lab": ("prbs.csv",),
}  # fmt: skip
"""Files of the repository's machines; without any a machine is simulated."""
HELD_OUT = 16
"""Windows of held-out recordings at most."""
Parts = tuple[Sequence[Trajectory], Sequence[Trajectory], Sequence[Trajectory], dict[str, Any]]


def simulated(scenario: Scenario) -> Parts:
    """Recordings of a simulated machine for training, validation and test, and options of the fit."""
    with tempfile.TemporaryDirectory() as folder:
        files = scenario.make_data(Path(folder), 0, "quick")
        data = load_trajectories(files, scenario.prior(), scenario.data)
    options = {"largest_delay": scenario.data.largest_delay}
    return data.by_role("train"), data.by_role("valid"), data.by_role("test"), options


def measured(scenario: Scenario, files: Sequence[Path]) -> Parts:
    """The same of files."""
    data, spec = read_training(scenario, files), scenario.benchmark
    options = {"length": spec.length or spec.piece, "largest_delay": scenario.data.largest_delay}
    return data.train, data.valid, data.held_back, options


def error_of(scenario: Scenario, fit: PriorFit, parts: Parts) -> float:
    """Error of free runs over held-out windows, in spreads of the outputs."""
    train, valid, test, options = parts
    prior, dt, held = scenario.prior(), scenario.data.dt, shifted(test or valid, fit.delay)
    length = options.get("length") or 5.0 * time_unit(train, dt)
    periods = min(round(length / dt), max(len(t.t) for t in held) - 1)
    substeps = max(2, 2 * required_substeps(prior, dt), fit.substeps)
    runs = Runs(prior, dt, np.nanstd(np.concatenate([t.y for t in held]), axis=0), substeps)
    return free_run_errors(runs, cut(prior, held, periods, HELD_OUT), [fit.values])[0]


def row_of(name: str, files: Sequence[Path]) -> dict[str, Any]:
    """Fit the prior of a machine once."""
    scenario = load_scenario(name)
    parts = measured(scenario, files) if files else simulated(scenario)
    train, valid, test, options = parts
    wall, cpu = time.perf_counter(), time.process_time()
    fit = fit_prior(scenario.prior, train, valid, dt=scenario.data.dt, **options)
    smoothed(scenario.prior, fit, [*train, *valid, *test], scenario.data.dt)
    return {
        "scenario": scenario.name,
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "error": error_of(scenario, fit, parts),
        "stages": fit.stages,
        "values": fit.values,
        "standard_errors": fit.standard_errors,
    }


def main() -> None:
    """Fit one prior, or all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario", help="a machine, or all")
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument(
        "--data", type=Path, default=Path("../shared/data"), help="folder of recordings (all)"
    )
    parser.add_argument("--out", type=Path, help="JSON file to write (all)")
    parser.add_argument("--before", type=Path, help="JSON file of another commit to compare with (all)")
    given = parser.parse_args()
    if given.scenario != "all":
        print(json.dumps(row_of(given.scenario, given.files), indent=1))
        return
    before = {r["scenario"]: r for r in json.loads(given.before.read_text())} if given.before else {}
    rows = []
    for name, patterns in RECORDINGS.items():
        rows.append(row_of(name, sorted(f for p in patterns for f in (given.data / name).glob(p))))
        old, new = before.get(name, rows[-1]), rows[-1]
        ratio = new["error"] / old["error"]
        print(f"| {name} | {ratio:.4f} | {old['cpu_s']:.1f}, {new['cpu_s']:.1f} |", flush=True)
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
