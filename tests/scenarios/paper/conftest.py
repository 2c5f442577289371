"""Tiny experiments on the pendulum, in scenario files as a user would write them."""

from pathlib import Path

import pytest

from hybrid_mpc.engine import Progress
from scenarios.paper import run as run_module
from scenarios.paper.run import reproduce
from scenarios.paper.settings import ReproductionSettings

EXACT = """
from dataclasses import replace
from scenarios.paper.experiment import Effort
from scenarios.pendulum import scenario
effort = Effort(2, (1, 2), steps=20, free_run_steps=5, valid=1, test=2, hidden=4, every=5, batch=4)
scenario = replace(scenario, experiment=replace(scenario.experiment, efforts={"full": effort}))
"""
MEASURED = """
from dataclasses import replace
from hybrid_mpc import load_trajectories
from scenarios.paper.experiment import Effort
from scenarios.pendulum import scenario
from scenarios.pendulum.data import make_data


def prior(values=None):
    from scenarios.pendulum.prior import PendulumPrior

    return PendulumPrior(values)


def runs(data_set, seed, folder):
    files = make_data(folder, seed, "quick")
    return load_trajectories(files, scenario.prior(), scenario.data).trajectories


effort = Effort(1, (2,), steps=4, free_run_steps=2, valid=1, test=1, hidden=4, every=2, batch=4)
own = replace(scenario.experiment, runs=runs, measured=True, most=6, efforts={"full": effort})
scenario = replace(scenario, prior=prior, experiment=own)
"""


@pytest.fixture(scope="session")
def exact(tmp_path_factory) -> str:
    """Scenario file of an experiment with exact states."""
    return _written(tmp_path_factory, "exact_machine.py", EXACT)


@pytest.fixture(scope="session")
def measured(tmp_path_factory) -> str:
    """Scenario file of one in which only the angle is measured."""
    return _written(tmp_path_factory, "measured_machine.py", MEASURED)


@pytest.fixture
def no_sindy(monkeypatch):
    """As where pysindy is not installed."""
    monkeypatch.setattr(run_module, "missing_for_sindy", lambda: "pysindy")


@pytest.fixture(scope="session")
def finished(exact, tmp_path_factory) -> Path:
    """Folder of a reproduction that nothing interrupted; in this process, without sindy."""
    out = tmp_path_factory.mktemp("finished") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_module, "missing_for_sindy", lambda: "pysindy")
        reproduce(ReproductionSettings(exact), out, workers=0)
    return out


class Interrupting(Progress):
    """Ctrl-C in the middle of one job."""

    def __init__(self, words: str, at: int) -> None:
        self.words, self.at = words, at

    def update(self, key: str, done: int, total: int, text: str) -> None:
        """Stop where it was asked."""
        if self.words in text and done >= self.at:
            raise KeyboardInterrupt


def _written(factory, name: str, text: str) -> str:
    path = factory.mktemp("machine") / name
    path.write_text(text)
    return str(path)
