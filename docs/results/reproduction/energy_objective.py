"""Where the energy objective helps and where it costs: the golf robot's E_sim by speed, PGRNN beside MOPGRNN.

``python docs/results/reproduction/energy_objective.py RUN_FOLDER [--sequences 15]`` takes the weights that
``hybrid-mpc reproduce golf_robot`` left in its folder, repeats the free runs of all networks over the test runs and
splits the mean error of the rates by the measured speed. A row a range of speed, a column a model: means over networks,
beside the share of time and of the energy violation that falls into the range.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from hybrid_mpc import Scaling, load_scenario
from hybrid_mpc.engine import Progress
from hybrid_mpc.files import read_arrays, read_json
from hybrid_mpc.identify.evaluate import stacked_free_runs
from hybrid_mpc.identify.train import Trained
from scenarios.paper.jobs import Case, step_class
from scenarios.paper.run import Work
from scenarios.paper.settings import ReproductionSettings, case_key, experiment_of

EDGES = (0.0, 0.05, 0.5, 2.0, np.inf)
MODELS = ("pgrnn", "mopgrnn")


def samples(work: Work, case: Case, count: int, model: str) -> list[np.ndarray]:
    """``(speed, error of the rates, energy violation)`` of all test samples, one array a network."""
    key = case_key(case.data_set, count, model)
    details = read_json(work.folder / f"{key}.json")["details"]
    arrays = read_arrays(work.folder / f"{key}.npz")
    weights = {
        name.removeprefix("weights."): value for name, value in arrays.items() if name.startswith("weights.")
    }
    scaling = Scaling(**{name: tuple(value) for name, value in details["scaling"].items()})
    none = np.zeros(0)
    form, skipped = step_class(case.form), np.zeros(0, dtype=np.int64)
    trained = Trained(work.training(model), scaling, weights, none, {}, skipped, form=form)
    make, evaluation = load_scenario(case.scenario).prior, case.evaluation
    networks = stacked_free_runs(
        trained, make(case.values), case.dt, make(evaluation.values), evaluation.test, evaluation.warm
    )
    found = []
    for runs in networks:
        columns = [
            np.column_stack(
                [
                    np.abs(run.x[:, -1]),
                    np.abs(run.xdot_hat - run.xdot).sum(1),
                    np.abs(run.balances_hat - run.balances)[:, 0],
                ]
            )
            for run in runs
        ]
        found.append(np.vstack(columns))
    return found


def main() -> None:
    """Print a table a data set."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sequences", type=int, default=15)
    options = parser.parse_args()
    plain = read_json(options.folder / "run.json")["settings"]
    settings = ReproductionSettings(
        plain["scenario"],
        plain["budget"],
        plain["networks"],
        tuple(plain["sequences"]),
        plain["seed"],
        plain["form"],
    )
    scenario = load_scenario(settings.scenario)
    experiment = experiment_of(scenario)
    work = Work(
        settings, scenario, experiment, settings.effort(experiment), options.folder, Progress(), workers=0
    )
    for data_set in experiment.data_sets:
        case = work.case(data_set, options.sequences)
        tables = [np.stack(samples(work, case, options.sequences, model)) for model in MODELS]
        print(f"\n({data_set}), {options.sequences} sequences\n")
        print(
            "| speed [rad/s] | time [%] | violation [%] | pgrnn [s] | mopgrnn [s] | change [%] |\n"
            + "| --- " * 6
            + "|"
        )
        speed = tables[0][0, :, 0]
        for low, high in pairwise(EDGES):
            inside = (speed >= low) & (speed < high)
            errors = [table[:, inside, 1].mean() for table in tables]
            share = tables[0][:, inside, 2].sum() / tables[0][..., 2].sum()
            change = 100 * (errors[1] / errors[0] - 1)
            cells = f"{100 * inside.mean():.0f} | {100 * share:.0f} | {errors[0]:.4f} | {errors[1]:.4f} | {change:+.0f}"
            print(f"| {low:g} to {high:g} | {cells} |")


if __name__ == "__main__":
    main()
