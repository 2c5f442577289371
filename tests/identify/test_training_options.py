"""What a training can be told beside its defaults: each option trains, resumes and makes a model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Killed, Pendulum, dragged, same_training

from hybrid_mpc import InputError, TrainingSettings, train
from hybrid_mpc.identify.objectives import OBJECTIVES, energy_objective, free_run, teacher_forced
from hybrid_mpc.identify.train import TrainingRun

SHORT = TrainingSettings("mopgrnn", 4, 2, 15, 10, seed=3, warm=10, horizon=20, batch=8, every=5)
PRIOR = Pendulum(TRUTH)


@pytest.fixture(scope="module")
def data():
    return dragged()


OPTIONS = (
    {"cell": "gru_paper"},
    {"cell": "lstm"},
    {"cell": "feed_forward"},
    {"form": "literal"},
    {"form": "literal", "kind": "rnn", "cell": "gru_paper"},
    {"combination": "hard_maximum"},
    {"combination": "weighted_sum", "weights": (0.9, 0.1)},
    {"combination": "augmented_lagrangian"},
    {"energy": "one_step"},
    {"energy": "free_run"},
    {"objectives": ("error",)},
    {"fused": True},
    {"prior_parameters": "trained"},
    {"prior_parameters": "trained", "form": "literal"},
    {"prior_parameters": "trained", "fused": True},
)


@pytest.fixture(scope="module")
def usual(data):
    """What ``SHORT`` comes to without any option."""
    return train(PRIOR, *data, SHORT)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_option_trains_resumes_and_makes_a_model(data, usual, options, tmp_path):
    def kill(done, total, error):
        if done == 10:
            raise Killed

    settings, file = replace(SHORT, **options), tmp_path / "training.safetensors"
    whole = train(PRIOR, *data, settings)
    assert (whole.validation < whole.curve["validation"][0]).all()
    assert not whole.faults
    with pytest.raises(Killed):
        train(PRIOR, *data, settings, checkpoint=file, on_progress=kill)
    same_training(whole, train(PRIOR, *data, settings, checkpoint=file))
    if options not in ({"energy": "one_step"}, {"fused": True}):
        assert not np.array_equal(whole.validation, usual.validation)
    step = whole.step(PRIOR, DT)
    x_next, h_next = step(
        torch.zeros(2).double(), torch.zeros(step.network.n_h).double(), torch.ones(1).double()
    )
    assert torch.isfinite(torch.cat([x_next, h_next])).all()


def test_both_readings_of_the_energy_objective(data):
    for free in (False, True):
        losses = {}
        for energy in ("stage", "one_step", "free_run"):
            run = TrainingRun(PRIOR, *data, replace(SHORT, energy=energy))
            with torch.no_grad():
                run.weights["w_out"].fill_(0.5)  # off the prior, so that the readings differ
                run.free = free
                losses[energy] = run._losses(run.fixed)
                one, own = (
                    energy_objective(run.step, p(run.step, run.fixed)) for p in (teacher_forced, free_run)
                )
        assert torch.equal(losses["one_step"][:, 1], one)
        assert torch.equal(losses["free_run"][:, 1], own)
        assert torch.equal(losses["stage"], losses["free_run" if free else "one_step"])
        assert (losses["one_step"][:, 1] != losses["free_run"][:, 1]).all()
        assert torch.equal(losses["one_step"][:, 0], losses["free_run"][:, 0])  # the error keeps to its stage


def test_any_number_of_objectives(data, usual, monkeypatch):
    def square(step, p):
        return (p.xdot_hat - p.xdot).square().sum(-1).mean(dim=(0, 2))

    monkeypatch.setitem(OBJECTIVES, "square", square)
    curve = train(PRIOR, *data, replace(SHORT, objectives=("error", "energy", "square"))).curve
    for name in ("error", "energy", "square"):
        assert (curve[f"loss_{name}"] > 0).all()
        assert (np.diff(curve[f"bound_{name}"][curve["free_run"][:, 0] == 0], axis=0) <= 0).all()
    assert not np.array_equal(curve["loss_error"][1:], usual.curve["loss_error"][1:])  # the third one counts


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"kind": "gru"}, "mopgrnn"),
        ({"cell": "rnn"}, "gru_paper"),
        ({"objectives": ("error", "power")}, "error, energy"),
        ({"objectives": ()}, "at least one"),
        ({"combination": "sum"}, "weighted_sum"),
        ({"weights": (1.0,)}, "one for each"),
        ({"energy": "both"}, "one_step"),
        ({"form": "euler"}, "literal"),
    ],
)
def test_settings_that_are_none_are_refused_with_what_there_is(wrong, words):
    with pytest.raises(InputError, match=words):
        replace(SHORT, **wrong)


def test_the_literal_form_wants_the_derivative(data):
    train_runs, valid = data
    xdot = train_runs[1].xdot.copy()
    xdot[40] = np.nan
    bad = [train_runs[0], replace(train_runs[1], xdot=xdot)]
    with pytest.raises(InputError, match=r"run1: xdot is not finite at 0\.8 s"):
        train(PRIOR, bad, valid, replace(SHORT, form="literal"))
    train(PRIOR, bad, valid, replace(SHORT, teacher_steps=1, free_run_steps=0))  # the hybrid does not
