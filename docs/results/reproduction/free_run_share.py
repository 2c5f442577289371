"""How many of a training's steps should be made on free runs: a trial on another seed than the reported one.

``python docs/results/reproduction/free_run_share.py --out runs/share`` makes the golf robot's data set (b) with
``--seed 1``, fits the prior to 15 sequences, trains MOPGRNNs of 1500 steps of which 0, 200 and 500 are made on free
runs, and prints their E_sim on validation runs, which a share would be chosen by, and on test runs. Finished
trainings are kept in the folder.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybrid_mpc import load_scenario
from hybrid_mpc.engine import Progress
from hybrid_mpc.files import read_json
from scenarios.paper.jobs import ensemble_job, fit_job
from scenarios.paper.run import Work, record_stage
from scenarios.paper.settings import ReproductionSettings, case_key, experiment_of

DATA_SET, COUNT = "b", 15


def main() -> None:
    """Train, print a line a share."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--networks", type=int, default=8)
    parser.add_argument("--steps", type=int, nargs="+", default=[0, 200, 500])
    options = parser.parse_args()
    scenario = load_scenario("golf_robot")
    experiment = experiment_of(scenario)
    settings = ReproductionSettings(
        "golf_robot", networks=options.networks, sequences=(COUNT,), seed=options.seed
    )
    effort = settings.effort(experiment)
    work = Work(settings, scenario, experiment, effort, options.out, Progress(), workers=0)
    record_stage(work)
    key = case_key(DATA_SET, COUNT, "prior")
    if not work.done(key):
        train, valid = (
            work.trajectories(DATA_SET, role, n) for role, n in (("train", COUNT), ("valid", effort.valid))
        )
        fit_job("golf_robot", train, valid, effort.fit, work.folder / key, lambda *_: None)
    case = work.case(DATA_SET, COUNT)
    print(
        "| steps on free runs | validation E_sim [s] | test E_sim [s] | seconds |\n| --- | --- | --- | --- |"
    )
    for free in options.steps:
        key = case_key(DATA_SET, COUNT, f"free{free}")
        if not work.done(key):
            plain = work.training("mopgrnn")
            chosen = replace(plain, teacher_steps=effort.steps - free, free_run_steps=free)
            ensemble_job(case, COUNT, "mopgrnn", chosen, key, lambda *_: None)
        found = read_json(work.folder / f"{key}.json")
        networks = found["rows"][0]["networks"]
        columns = ([n["validation"] for n in networks], [n["figures"]["e_sim_s"] for n in networks])
        told = " | ".join(f"{np.mean(c):.4f} ± {np.std(c, ddof=1):.4f}" for c in columns)
        print(f"| {free} | {told} | {found['seconds']:.0f} |", flush=True)


if __name__ == "__main__":
    main()
