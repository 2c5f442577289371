"""Corrections fade where nothing was measured."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import TRUTH, Pendulum, killed_and_resumed, same_training

from hybrid_mpc import InputError, TrainingSettings, train
from hybrid_mpc.identify.prior_replay import COUNTED, FOLLOWED, RUNS, make_prior_replay, prior_replay_penalty
from hybrid_mpc.identify.train import TrainingRun

SMALL = TrainingSettings(
    "pgrnn", 4, 2, 20, 20, seed=3, warm=10, horizon=20, batch=8, every=10, prior_replay=10.0
)
PRIOR = Pendulum(TRUTH)


@pytest.fixture(scope="module")
def prior_replay(data):
    return make_prior_replay(PRIOR, data[0], seed=0)


def test_they_are_the_priors_own_motion_under_recorded_inputs(data, prior_replay):
    from hybrid_mpc import PriorStep

    step = PriorStep(PRIOR, data[0][0].dt)
    none = torch.zeros(*prior_replay.w.shape[:-1], 0).double()[:-1]
    x, _ = step(prior_replay.x[:-1], none, prior_replay.u[:-1], prior_replay.w[:-1])
    torch.testing.assert_close(x, prior_replay.x[1:], rtol=0, atol=1e-12)
    recorded = np.unique(np.concatenate([t.u for t in data[0]]))
    assert np.isin(prior_replay.u.numpy(), recorded).all()
    assert prior_replay.x.shape[:2] == (FOLLOWED + COUNTED, RUNS)


def test_what_was_measured_has_no_weight_and_what_lies_far_off_has(data, prior_replay):
    measured = np.concatenate([t.x for t in data[0]])
    weight, x = prior_replay.weight.numpy(), prior_replay.x.numpy()
    assert ((weight >= 0) & (weight <= 1)).all()
    # a window's distance from its nearest sample, in the units that the module's text names
    places = [np.column_stack([np.sin(a[:, 0]), np.cos(a[:, 0]), a[:, 1] / np.sqrt(np.mean(measured[:, 1] ** 2))])
              for a in (x.reshape(-1, 2), measured)]  # fmt: skip
    some = np.random.default_rng(0).choice(len(places[0]), 300, replace=False)
    distance = np.array([np.linalg.norm(places[1] - p, axis=1).min() for p in places[0][some]])
    inside = (x[..., 1] >= measured[:, 1].min()) & (x[..., 1] <= measured[:, 1].max())
    expected = np.where(inside.ravel()[some], 1 - np.exp(-((distance / 0.1) ** 2)), 0.0)
    np.testing.assert_allclose(weight.ravel()[some], expected, atol=1e-9)
    assert (weight > 0.9).any()
    assert (weight < 0.1).any()


def test_an_angle_counts_all_the_way_round_and_a_full_turn_is_no_distance(data):
    shifted = [replace(t, x=t.x + np.array([2 * np.pi, 0.0])) for t in data[0]]
    one, two = (make_prior_replay(PRIOR, part, seed=0).weight for part in (data[0], shifted))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-9)


@pytest.mark.full
def test_corrections_fade_there_and_still_explain_the_data(data, prior_replay):
    """Of networks as ``train`` hands them over: the best by validation, which does not know of prior replay."""

    def trained(weight):
        settings = replace(
            SMALL, teacher_steps=150, free_run_steps=0, prior_replay=weight, objectives=("error", "energy")
        )
        run = TrainingRun(PRIOR, *data, settings)
        best = train(PRIOR, *data, settings)
        run._load({name: torch.tensor(value) for name, value in best.weights.items()})
        with torch.no_grad():
            return prior_replay_penalty(run.step, prior_replay).sqrt(), best

    (without, plain), (replayed, faded) = trained(0.0), trained(10.0)
    assert (replayed < 0.4 * without).all()
    # six seconds of motion are thin, so replay next to them costs; networks that correct nothing have the first
    # error
    assert (plain.validation < faded.validation).all()
    assert (faded.validation < 0.9 * faded.curve["validation"][0].min()).all()


@pytest.mark.full
@pytest.mark.parametrize("changed", [{"prior_parameters": "trained"}], ids=str)
def test_it_goes_with_other_options(data, changed):
    one, two = (train(PRIOR, *data, replace(SMALL, prior_replay=w, **changed)) for w in (0.0, 10.0))
    assert np.isfinite(two.validation).all()
    assert two.skipped.sum() == 0
    assert any(not np.array_equal(one.weights[name], two.weights[name]) for name in one.weights)


@pytest.mark.full
def test_a_training_with_prior_replay_resumes_to_the_same_bits(data, tmp_path):
    whole, file = train(PRIOR, *data, SMALL), tmp_path / "training.safetensors"
    same_training(killed_and_resumed(30, file, PRIOR, *data, SMALL)[0], whole)
    with pytest.raises(InputError, match="HM-IDENTIFY-055"):
        train(PRIOR, *data, replace(SMALL, prior_replay=5.0), checkpoint=file)


def test_an_rnn_has_nothing_to_fall_back_on(data):
    settings = replace(SMALL, kind="rnn")
    one, two = train(PRIOR, *data, settings), train(PRIOR, *data, replace(settings, prior_replay=0.0))
    for name, weights in one.weights.items():
        np.testing.assert_array_equal(weights, two.weights[name])


@pytest.mark.parametrize("strength", [0.1, 1.0, 1e6])
def test_a_prior_that_runs_away_costs_no_update(data, strength):
    class Bursting(Pendulum):
        def force(self, q, v, u, w, p):
            return strength * p.J * v.phi_dot**3 + u.torque

    prior_replay = make_prior_replay(Bursting(TRUTH), data[0], seed=0)
    v = np.concatenate([t.x[:, 1] for t in data[0]])
    span = v.max() - v.min()
    assert torch.isfinite(prior_replay.x).all()
    assert (
        v.min() - 10 * span
        <= prior_replay.x[..., 1].min()
        <= prior_replay.x[..., 1].max()
        <= v.max() + 10 * span
    )
    assert (prior_replay.weight > 0.9).any()
    run = TrainingRun(Bursting(TRUTH), *data, replace(SMALL, prior_replay=10.0))
    penalty = prior_replay_penalty(run.step, run.prior_replay)
    penalty.sum().backward()
    assert all(w.grad is None or torch.isfinite(w.grad).all() for w in run.weights.values())
