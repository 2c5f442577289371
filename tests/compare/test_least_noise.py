"""The filters' process noise where tasks go beyond the recordings."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hybrid_mpc import Kit, LoopSettings, Provenance, find_noise, load_scenario
from hybrid_mpc.compare import controllers
from scenarios.golf_robot import scenario

OWN = {"prior": np.array([1e-3, 2e-2]), "hybrid": np.array([4e-4, 3e-2])}


@pytest.fixture
def noise(monkeypatch):
    """``noise_of`` on models that are known by their one-period errors alone."""
    monkeypatch.setattr(controllers, "process_noise", lambda model, recordings: OWN[model])
    monkeypatch.setattr(
        controllers,
        "tuned_noise",
        lambda model, scenario, base, recordings, observer, known: (2 if observer else 1) * base,
    )
    artifact = SimpleNamespace(models={"prior": "prior", "hybrid": "hybrid"})

    def found(beyond):
        machine = replace(scenario, oracle=None, beyond_recordings=beyond)
        return controllers.noise_of(machine, artifact, [])

    return found


def test_a_hybrid_is_as_sure_as_its_own_errors_on_recordings_make_it(noise):
    found = noise(False)
    np.testing.assert_array_equal(found["hybrid"], OWN["hybrid"])
    np.testing.assert_array_equal(found["hybrid_observer"], 2 * OWN["hybrid"])


def test_beyond_them_it_is_no_surer_than_the_prior_state_by_state(noise):
    found = noise(True)
    np.testing.assert_array_equal(found["hybrid"], [1e-3, 3e-2])
    np.testing.assert_array_equal(found["hybrid_observer"], [2e-3, 6e-2])
    np.testing.assert_array_equal(found["prior"], OWN["prior"])
    np.testing.assert_array_equal(found["prior_observer"], 2 * OWN["prior"])


def test_noise_of_an_artifact_is_raised_too():
    loop = LoopSettings(process_noise={name: tuple(value) for name, value in OWN.items()})
    artifact = Kit({"prior": SimpleNamespace(n_x=2)}, None, Provenance(), loop=loop)
    for beyond, expected in ((False, [4e-4, 3e-2]), (True, [1e-3, 3e-2])):
        machine = replace(scenario, beyond_recordings=beyond)
        found, _ = find_noise(machine, artifact, ("hybrid",), 0)
        np.testing.assert_array_equal(found["hybrid"], expected)


def test_the_disk_stands_where_no_recording_was():
    disk = load_scenario("unbalanced_disk")
    assert disk.beyond_recordings
    assert all(budget.prior_replay > 0 for budget in disk.budgets.values())
