"""Options of a training: each trains, resumes and makes a model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, killed_and_resumed, same_training

from hybrid_mpc import TrainingSettings, train
from hybrid_mpc.identify.objectives import OBJECTIVES

SHORT = TrainingSettings("mopgrnn", 4, 2, 15, 10, seed=3, warm=10, horizon=20, batch=8, every=5)
PRIOR = Pendulum(TRUTH)


OPTIONS = ({"objectives": ("error",)}, {"prior_parameters": "trained"})


@pytest.fixture(scope="module")
def usual(data):
    """What ``SHORT`` comes to without any option."""
    return train(PRIOR, *data, SHORT)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_option_trains_resumes_and_makes_a_model(data, usual, options, tmp_path):
    settings, file = replace(SHORT, **options), tmp_path / "training.safetensors"
    whole = train(PRIOR, *data, settings)
    assert (whole.validation < whole.curve["validation"][0]).all()
    assert not whole.failures
    same_training(whole, killed_and_resumed(10, file, PRIOR, *data, settings)[0])
    assert not np.array_equal(whole.validation, usual.validation)
    step = whole.step(PRIOR, DT)
    x_next, h_next = step(
        *(torch.zeros(n).double() for n in (2, step.network.n_h)),
        torch.ones(1).double(),
        torch.zeros(0).double(),
    )
    assert torch.isfinite(torch.cat([x_next, h_next])).all()


def test_any_number_of_objectives(data, monkeypatch):
    def square(step, p):
        return (p.xdot_hat - p.xdot).square().sum(-1).mean(dim=(0, 2))

    monkeypatch.setitem(OBJECTIVES, "square", square)
    curve = train(PRIOR, *data, replace(SHORT, objectives=("error", "energy", "square"))).curve
    for name in ("error", "energy", "square"):
        assert (curve[f"loss_{name}"] > 0).all()
        assert (np.diff(curve[f"bound_{name}"][curve["free_run"][:, 0] == 0], axis=0) <= 0).all()
    two = train(PRIOR, *data, replace(SHORT, objectives=("error", "energy"))).curve
    assert not np.array_equal(curve["loss_error"][1:], two["loss_error"][1:])  # the third one counts


def test_teacher_forcing_takes_the_rates_where_free_runs_take_the_outputs(data):
    settings = replace(SHORT, kind="pgrnn", free_run_steps=0)
    rates, outputs = (
        train(PRIOR, *data, replace(settings, objectives=(name,))) for name in ("error", "output")
    )
    np.testing.assert_array_equal(rates.curve["loss_error"], outputs.curve["loss_output"])
    assert not np.array_equal(rates.curve["validation"], outputs.curve["validation"])  # each by its own
