"""Shared material of the tests."""

import gc
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings
from machine_runs import arguments, bare_tanks, finished, jobs_here, machine, run_folder

__all__ = ["arguments", "bare_tanks", "finished", "jobs_here", "machine", "run_folder"]  # fixtures

# the same cases in every run: what fails on one machine fails on all
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")

LONG = (
    "workflow/test_machines.py",
    "workflow/test_run.py",
    "workflow/test_on_model.py",
    "notebooks/test_notebooks.py",
    "nn_export/test_random_modules.py",
    "compare/study/test_study_runner.py",
    "compare/study/test_loops.py",
    "embedded/test_whole_loops.py",
    "embedded/test_export.py",
    "scenarios/test_simulated.py",
    "identify/test_linear.py",
    "workflow/test_control_command.py",
    "identify/test_prior_fit.py",
    "identify/test_training.py",
    "identify/test_simulation.py",
    "identify/test_prediction.py",
    "docs/test_examples.py",
    "test_engine.py",
    "check/test_check_planted.py",
    "scenarios/paper/test_reproduce.py",
    "workflow/test_stages.py",
    "check/test_preflight.py",
    "nn_export/test_budget.py",
    "loop/test_faulted_loops.py",
)
"""Modules that take longest. Processes that share the tests by whole modules must not end with one of them."""


def pytest_collection_modifyitems(items):
    """The long modules first, the others as they were."""
    rank = {Path(__file__).parent / path: i for i, path in enumerate(LONG)}
    items.sort(key=lambda item: rank.get(item.path, len(LONG)))


def pytest_collection_finish():
    """What is imported and collected by now stays: the garbage collector need not look through it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def call(monkeypatch, capsys):
    """Run ``hybrid-mpc`` with some words in this process: ``(exit code, stdout, stderr)``."""

    def run(*words):
        from hybrid_mpc.cli.main import main

        monkeypatch.setattr(sys, "argv", ["hybrid-mpc", *map(str, words)])
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        told = capsys.readouterr()
        return code, told.out, told.err.replace("\n", " ")

    return run


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Callable[[str, Callable[[Path], None]], Path]:
    """``shared(name, make)``: a folder that ``make`` fills once for all processes that share the tests."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root

    def folder(name: str, make: Callable[[Path], None]) -> Path:
        with FileLock(root / f"{name}.lock"):
            if not (root / f"{name}.made").exists():
                (root / name).mkdir()
                make(root / name)
                (root / f"{name}.made").touch()
        return root / name

    return folder


@pytest.fixture(scope="session")
def noisy_artifact(golf_artifact, tmp_path_factory) -> Path:
    """The same, with the process noise of its filters, as a run leaves it."""
    from hybrid_mpc import set_process_noise

    folder = shutil.copytree(golf_artifact, tmp_path_factory.mktemp("noisy") / "model")
    names = ("prior", "prior_observer", "hybrid", "hybrid_observer")
    set_process_noise(folder, dict.fromkeys(names, (1e-4, 1e-2)))
    return folder


@pytest.fixture(scope="session")
def golf_artifact(tmp_path_factory) -> Path:
    """An artifact of the golf robot: the nominal prior, and a small network with random weights.

    Its output layer is scaled down so that the hybrid stays near the prior.
    """
    import torch

    from hybrid_mpc import HybridStep, PriorStep, Scaling, model_info, n_features, save_artifact, trace_model
    from hybrid_mpc.identify.networks import StackedGRU
    from scenarios.golf_robot.prior import GolfRobotPrior

    prior = GolfRobotPrior()
    stack = StackedGRU(1, n_features(prior, True), 8, 1, seed=3)
    with torch.no_grad():
        stack.w_out.mul_(0.3)
    scaling = Scaling(x=(0.5, 1.5), u=(0.2,), rate=(5.0,), correction=(0.5,))
    steps = {"hybrid": HybridStep(prior, stack.member(0), scaling, 0.02), "prior": PriorStep(prior, 0.02)}
    folder = tmp_path_factory.mktemp("artifact") / "model"
    programs = {name: trace_model(step.requires_grad_(False)) for name, step in steps.items()}
    save_artifact(folder, programs, model_info(prior, 0.02))
    return folder
