"""How long the prior of a machine takes to fit and to smooth its recordings by, as the main job does it.

    python benchmarks/fit_time.py golf_robot
    python benchmarks/fit_time.py torque_pendulum ../shared/data/torque_pendulum/*.csv

Without files a simulated machine makes its own. Printed is a row of JSON: wall-clock and processor time [s], and
the fitted values. Run it by turns on two commits to compare them.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

from hybrid_mpc import fit_prior, load_scenario, load_trajectories
from hybrid_mpc.identify.fit import smoothed


def main() -> None:
    """Fit the prior once."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario")
    parser.add_argument("files", nargs="*", type=Path)
    given = parser.parse_args()
    scenario = load_scenario(given.scenario)
    prior = scenario.prior()
    with tempfile.TemporaryDirectory() as folder:
        files = given.files or scenario.make_data(Path(folder), 0, "quick")
        data = load_trajectories(files, prior, scenario.data)
    train, valid = data.by_role("train"), data.by_role("valid")
    wall, cpu = time.perf_counter(), time.process_time()
    fit = fit_prior(scenario.prior, train, valid, dt=scenario.data.dt)
    smoothed(scenario.prior, fit, [*train, *valid, *data.by_role("test")], scenario.data.dt)
    row = {
        "scenario": scenario.name,
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
    }
    print(json.dumps({**row, "values": fit.values}, indent=1))


if __name__ == "__main__":
    main()
