"""How long the prior of a machine takes to fit and to smooth its recordings by, as the main job does it.

    python benchmarks/fit_time.py golf_robot
    python benchmarks/fit_time.py torque_pendulum ../shared/data/torque_pendulum/energy_shaping_*.csv

Without files a simulated machine makes its own. Files are cut and given roles as by ``hybrid-mpc benchmark``. Printed
is a row of JSON: wall-clock and processor time [s], the errors that chose, the fitted values and their standard errors.
Run it by turns on two commits to compare them.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hybrid_mpc import Scenario, Trajectory, fit_prior, load_scenario, load_trajectories
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.workflow.benchmark_runs import read_training

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


def main() -> None:
    """Fit the prior once."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario")
    parser.add_argument("files", nargs="*", type=Path)
    given = parser.parse_args()
    scenario = load_scenario(given.scenario)
    train, valid, test, options = measured(scenario, given.files) if given.files else simulated(scenario)
    wall, cpu = time.perf_counter(), time.process_time()
    fit = fit_prior(scenario.prior, train, valid, dt=scenario.data.dt, **options)
    smoothed(scenario.prior, fit, [*train, *valid, *test], scenario.data.dt)
    row = {
        "scenario": scenario.name,
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "stages": fit.stages,
        "values": fit.values,
        "standard_errors": fit.standard_errors,
    }
    print(json.dumps(row, indent=1))


if __name__ == "__main__":
    main()
