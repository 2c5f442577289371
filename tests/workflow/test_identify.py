"""What a training leaves in the run's folder is read back whole."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_mpc import InputError, Scaling, TrainingSettings
from hybrid_mpc.identify.train import Trained, TrainingFailure
from hybrid_mpc.workflow.stages.identify import is_trained, load_trained, save_trained


@pytest.mark.parametrize("failures", [(), (TrainingFailure(1, "energy", 30, True),)])
def test_a_training_is_read_back_as_it_was(failures, tmp_path):
    settings = TrainingSettings("mopgrnn", 4, 2, 10, 5, seed=3, warm=2)
    trained = Trained(
        settings, Scaling((1.0, 2.0), (3.0,), (4.0,), (5.0,)), {"w": np.eye(2)}, np.array([0.1, np.inf]),
        {"step": np.zeros((1, 2))}, np.array([0, 5]), failures,
    )  # fmt: skip
    save_trained(tmp_path, trained)
    found = load_trained(tmp_path, "mopgrnn")
    assert (found.settings, found.scaling, found.failures) == (settings, trained.scaling, failures)
    np.testing.assert_equal(found.weights["w"], trained.weights["w"])
    np.testing.assert_equal(found.validation, trained.validation)
    np.testing.assert_equal(found.skipped, trained.skipped)


@pytest.fixture
def kept(tmp_path):
    """Networks of one kind in a folder."""
    settings = TrainingSettings("pgrnn", 4, 2, 10, 5, seed=3, warm=2, prior_replay=2.0)
    one = Trained(
        settings, Scaling((1.0,), (1.0,), (1.0,), (1.0,)), {"w": np.eye(2)}, np.ones(2), {}, np.zeros(2)
    )
    save_trained(tmp_path, one)
    return tmp_path, settings


def test_finished_networks_are_taken_for_their_own_settings_only(kept):
    folder, settings = kept
    assert is_trained(folder, settings)
    assert not is_trained(folder, replace(settings, kind="mopgrnn"))
    with pytest.raises(InputError, match=r"prior_replay 2\.0 instead of 5\.0.*HM-WORKFLOW-039"):
        is_trained(folder, replace(settings, prior_replay=5.0))
