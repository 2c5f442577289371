"""Objectives beside the error for the golf robot's networks: which one makes a model better on unseen recordings?

``python docs/results/reproduction/objectives.py --out runs/objectives [--seed 0] [--networks 16] [--cells b3 a9]
[--objectives pgrnn violation both]`` trains networks as ``hybrid-mpc reproduce golf_robot`` does, each time with other
objectives, and evaluates free runs over the test recordings, and over recordings with 1.5 times their torque and first
angle. References are the smoothed measurement and, as the robot is simulated, its true motion. The first line has the
figures of the true motion against the smoothed measurement. Finished trainings are kept in the folder.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from hybrid_mpc import Trajectory, load_scenario, load_trajectories
from hybrid_mpc.engine import Progress
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.identify import train as training
from hybrid_mpc.identify.evaluate import evaluation_trajectories, model_states
from hybrid_mpc.identify.objectives import Objective, Prediction, balance_objective, error_objective
from hybrid_mpc.identify.step import RecurrentStep
from hybrid_mpc.machine.prior import Prior
from scenarios.golf_robot import data as rig_data
from scenarios.golf_robot.experiment import DATA
from scenarios.golf_robot.prior import GolfRobotPrior
from scenarios.golf_robot.rig import Rig
from scenarios.paper.jobs import fit_job
from scenarios.paper.run import Work, record_stage
from scenarios.paper.settings import ReproductionSettings, case_key, experiment_of

MORE = 1.5
"""Torque and first angle beyond the training's, over those of the test recordings."""
FREE = 200
"""Steps on free runs, if the name ends with ``_free``."""
violation = balance_objective("energy")


def _difference(step: RecurrentStep, prediction: Prediction) -> torch.Tensor:
    """Residual of the energy balance of the model minus that of the measurement ``(T, networks, n)`` [W]."""
    residual, held = step.equations.residuals["energy"], (prediction.u, prediction.w, step.p)
    model = residual(prediction.x_hat, prediction.xdot_hat, *held)
    return (model - residual(prediction.x, prediction.xdot, *held)).sum(-1)


def integral(step: RecurrentStep, prediction: Prediction) -> torch.Tensor:
    """Mean of ``|integral of the difference of the residuals from the start of the window|`` [J]."""
    return (torch.cumsum(_difference(step, prediction), 0) * step.dt).abs().mean(dim=(0, 2))


def supplied(step: RecurrentStep, prediction: Prediction) -> torch.Tensor:
    """Violation, and mean power that the correction supplies at up to ``MORE`` times the states and inputs [W]."""
    x, u, w = (z[:, 0] for z in (prediction.x, prediction.u, prediction.w))
    generator = torch.Generator().manual_seed(0)
    size = 1.0 + (MORE - 1.0) * torch.rand(1, x.shape[1], 1, generator=generator, dtype=x.dtype)
    x, u = x * size, u * size
    out, _ = step.network.sequence(step.stacked_features(x, u, w), step.network.initial(x.shape[1]))
    x, u, w = (z.unsqueeze(1) for z in (x, u, w))
    residual, correction = step.equations.residuals["energy"], out * step.scale_correction
    power = residual(x, step.rate(x, u, w, correction), u, w, step.p) - residual(
        x, step.rate(x, u, w, 0.0 * correction), u, w, step.p
    )
    return violation(step, prediction) + torch.relu(power).sum(-1).mean(dim=(0, 2))


OBJECTIVES: dict[str, tuple[Objective, ...]] = {
    "pgrnn": (error_objective,),
    "violation": (error_objective, violation),
    "integral": (error_objective, integral),
    "both": (error_objective, violation, integral),
    "supplied": (error_objective, supplied),
    "pgrnn_free": (error_objective,),
    "violation_free": (error_objective, violation),
    "integral_free": (error_objective, integral),
}
"""Objectives by name; ``violation`` is the paper's MOPGRNN."""


def beyond(folder: Path, seed: int) -> list[Trajectory]:
    """Test recordings with ``MORE`` times the torque and first angle, without those beyond the robot's ranges."""
    rig, tables = Rig(), []
    for stem in rig_data.stems("full", "b"):
        role, number, kind = stem.split("_")
        if role != "test":
            continue
        key = (seed, rig_data.ROLES.index(role), int(number))
        table, states = rig_data.record(rig, kind, key)
        # the torque of the recording, which has been reduced where the club would go too far
        u = MORE * table[::2, 2]
        moved = rig_data.simulate(rig, MORE * states[0][:2] * np.array([1.0, 0.0]), u, table[:, 0])
        if max(abs(s.z[0]) for s in moved) <= 3.0 and np.abs(u).max() <= 0.6:
            rng = np.random.default_rng(key)
            phi = np.array([rig.measure(s, rng)[0] for s in moved])
            tables.append((stem, np.column_stack([table[:, 0], phi, np.repeat(u, 2)[: len(table)]])))
    files = rig_data.write_tables(folder / "beyond", iter(tables), rig_data.COLUMNS)
    others = sorted((folder / "data" / "b").glob("train_0*.csv"))[:2] + sorted(
        (folder / "data" / "b").glob("valid*.csv")
    )
    return load_trajectories([*others, *files], GolfRobotPrior, DATA).by_role("test")


def true_motion(tests: Sequence[Trajectory], seed: int) -> list[Trajectory]:
    """The test trajectories with the true states."""
    truth = {stem: (table, states) for stem, table, states in rig_data.recordings(seed, "full", "b")}
    return [
        replace(t, x=np.column_stack([np.interp(t.t, table[:, 0], states[:, i]) for i in (0, 1)]))
        for t in tests
        for table, states in [truth[t.name]]
    ]


def figures(prior: Prior, tests: Sequence[Trajectory], states: Sequence[np.ndarray], warm: int) -> np.ndarray:
    """Mean ``E_sim`` [s], RMS of the angle [rad] and energy violation [W] of runs: ``states`` ``(n, 2)`` each."""
    rows = []
    for t, x_hat in zip(tests, states, strict=True):
        x, u = t.x[warm:], t.u[warm : warm + len(x_hat) - 1]
        x_hat = x_hat[: len(x)]
        rates = [np.diff(one, axis=0) / t.dt for one in (x, x_hat)]
        balance = prior.equations.balances[0]
        residuals = [
            balance.residual(one[:-1].T, rate.T, u[: len(rate)].T, np.zeros((0, len(rate))), prior.p)
            .full()
            .ravel()
            for one, rate in zip((x, x_hat), rates, strict=True)
        ]
        rows.append([
            np.abs(rates[1] - rates[0]).sum(1).mean(),
            np.square(x_hat[:-1, 0] - t.y[warm:-1, 0]).mean(),
            np.abs(residuals[1] - residuals[0]).mean(),
        ])  # fmt: skip
    found = np.mean(rows, axis=0)
    found[1] = np.sqrt(found[1])
    return found


def main() -> None:
    """Train and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--networks", type=int, default=16)
    parser.add_argument("--cells", nargs="+", default=["a3", "b3", "a9", "b9"], help="data set and sequences")
    parser.add_argument("--objectives", nargs="+", default=["pgrnn", "violation", "both"], choices=OBJECTIVES)
    given = parser.parse_args()
    scenario = load_scenario("golf_robot")
    experiment = experiment_of(scenario)
    cells = [(cell[0], int(cell[1:])) for cell in given.cells]
    counts = tuple(sorted({count for _, count in cells}))
    settings = ReproductionSettings("golf_robot", networks=given.networks, sequences=counts, seed=given.seed)
    effort = settings.effort(experiment)
    work = Work(settings, scenario, experiment, effort, given.out, Progress(), workers=0)
    record_stage(work)
    for data_set, count in {*cells, (experiment.reference, counts[-1])}:
        key = case_key(data_set, count, "prior")
        if not work.done(key):
            train, valid = (
                work.trajectories(data_set, role, n)
                for role, n in (("train", count), ("valid", effort.valid))
            )
            fit_job("golf_robot", train, valid, work.folder / key, lambda *_: None)
    evaluation, warm = work.evaluation, work.warm
    judge, fit = scenario.prior(evaluation.values), work.fit(experiment.reference, counts[-1])
    assert fit is not None
    smoother = fit.smoother(judge, DATA.dt)
    tests = list(evaluation.test)
    true = true_motion(tests, given.seed)
    far = evaluation_trajectories(smoother.smooth(beyond(given.out, given.seed)), smoother, warm)
    sets = {"test": (tests, tests), "true": (tests, true), "beyond": (far, far)}
    exact = figures(judge, tests, [t.x[warm:] for t in true], warm)
    print(
        "true motion against the smoothed measurement: E_sim {:.4f} s, angle {:.4f} rad, {:.4f} W".format(
            *exact
        )
    )
    head = [f"{name}, {what}" for name in sets for what in ("E_sim", "angle", "violation")]
    print("| cell | objectives |", " | ".join(head), "|\n| --- | --- |", " ---: |" * len(head), sep="")
    for data_set, count in cells:
        case = work.case(data_set, count)
        for name in given.objectives:
            note = work.folder / f"{case_key(data_set, count, name)}.json"
            if not note.is_file():
                objectives = {f.__name__: f for f in OBJECTIVES[name]}
                free = FREE if name.endswith("_free") else 0
                plain = replace(
                    work.training("mopgrnn"), kind="pgrnn" if name.startswith("pgrnn") else "mopgrnn",
                    teacher_steps=effort.steps - free, free_run_steps=free,
                )  # fmt: skip
                training.objectives_of = lambda *_, own=objectives: own  # type: ignore[assignment]
                trained = training.train(scenario.prior(case.values), case.training, case.validation, plain)
                step = trained.stacked_step(scenario.prior(case.values), case.dt)
                found = {
                    key: [figures(judge, reference, x, warm).tolist() for x in model_states(step, runs, warm)]
                    for key, (runs, reference) in sets.items()
                }
                write_json(note, found)
            means = {key: np.mean(rows, axis=0) for key, rows in read_json(note).items()}
            if name == given.objectives[0]:
                base = means
            ratios = [f"{r:.2f}" for key in sets for r in means[key] / base[key]]
            print(f"| {data_set}{count} | {name} | {' | '.join(ratios)} |", flush=True)


if __name__ == "__main__":
    main()
