"""Make the small trained model of the notebooks: ``python notebooks/make_model.py`` writes notebooks/golf_robot.

The recipe is that of 01_from_csv_to_model.ipynb: fit the prior of the golf robot, smooth, train one small hybrid. The
folder is a kit, as a run of ``hybrid-mpc run`` leaves it, with the estimators' process noise and the control problem.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from hybrid_mpc import (
    LoopSettings,
    PriorStep,
    TrainingSettings,
    fit_prior,
    load,
    load_scenario,
    load_trajectories,
    model_info,
    process_noise,
    save_artifact,
    set_process_noise,
    trace_model,
)
from hybrid_mpc import train as train_network

MODEL = Path(__file__).parent / "golf_robot"
STEMS = ("train_01_sine", "train_02_step", "train_05_pulse", "valid_01_sine", "test_01_sine")
"""Recordings that are read: few, so that the training takes a minute."""


def main() -> None:
    """Replace the folder by a new one."""
    machine = load_scenario("golf_robot")
    assert machine.make_data is not None
    dt = machine.data.dt
    with tempfile.TemporaryDirectory() as folder:
        files = machine.make_data(Path(folder) / "recordings", 0, "quick")
        chosen = [f for f in files if f.stem in STEMS]
        dataset = load_trajectories(chosen, machine.prior(), machine.data)
        train, valid = list(dataset.by_role("train")), list(dataset.by_role("valid"))
        fit = fit_prior(machine.prior, train, valid, dt=dt)
        fitted = machine.prior(fit.values)
        smoother = fit.smoother(fitted, dt)
        train, valid = smoother.smooth(train), smoother.smooth(valid)
        settings = TrainingSettings(
            "mopgrnn", hidden=16, networks=1, teacher_steps=250, free_run_steps=30, seed=0, warm=25,
            learning_rates=(1e-2, 1e-3, 5e-3, 1e-4),
        )  # fmt: skip
        trained = train_network(fitted, train, valid, settings)
        steps = {"hybrid": trained.step(fitted, dt), "prior": PriorStep(fitted, dt)}
        shutil.rmtree(MODEL, ignore_errors=True)
        loop = LoopSettings(
            control={"": machine.control}, sensor_sigma=machine.sensor_sigma, first_sigma=machine.first_sigma
        )
        programs = {name: trace_model(step) for name, step in steps.items()}
        save_artifact(MODEL, programs, model_info(fitted, dt), loop=loop)
        noise = {name: process_noise(model, train).tolist() for name, model in load(MODEL).models.items()}
        set_process_noise(MODEL, noise | {f"{name}_observer": sigma for name, sigma in noise.items()})


if __name__ == "__main__":
    main()
