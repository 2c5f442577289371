"""Corrections fade where nothing was measured."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import TRUTH, Killed, Pendulum, dragged, same_training

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.anchors import COUNTED, FOLLOWED, anchor_penalty, make_anchors
from hybrid_mpc.identification.training import TrainingSettings, train
from hybrid_mpc.identification.training_run import TrainingRun

SMALL = TrainingSettings("pgrnn", 4, 2, 20, 20, seed=3, warm=10, horizon=20, batch=8, every=10, anchors=10.0)
PRIOR = Pendulum(TRUTH)


@pytest.fixture(scope="module")
def data():
    return dragged()


@pytest.fixture(scope="module")
def anchors(data):
    return make_anchors(PRIOR, data[0], seed=0)


def test_they_are_the_priors_own_motion_under_recorded_inputs(data, anchors):
    from hybrid_mpc.identification.step import PriorStep

    step = PriorStep(PRIOR, data[0][0].dt)
    x, _ = step(anchors.x[:-1], torch.zeros(*anchors.x.shape[:-1], 0)[:-1], anchors.u[:-1])
    torch.testing.assert_close(x, anchors.x[1:], rtol=0, atol=1e-12)
    recorded = np.unique(np.concatenate([t.u for t in data[0]]))
    assert np.isin(anchors.u.numpy(), recorded).all()
    assert anchors.x.shape[0] == FOLLOWED + COUNTED


def test_what_was_measured_has_no_weight_and_what_lies_far_off_has(data, anchors):
    measured = np.concatenate([t.x for t in data[0]])
    weight, x = anchors.weight.numpy(), anchors.x.numpy()
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
    one, two = (make_anchors(PRIOR, part, seed=0).weight for part in (data[0], shifted))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-9)


def test_corrections_fade_there_and_still_explain_the_data(data, anchors):
    def trained(weight):
        settings = replace(SMALL, teacher_steps=100, free_run_steps=0, anchors=weight)
        run = TrainingRun(PRIOR, *data, settings)
        run.enter_stage()
        before = run.index.bounds[:, 0].clone()  # the errors of networks that correct next to nothing yet
        for _ in range(settings.teacher_steps):
            run.update()
        with torch.no_grad():
            return anchor_penalty(run.step, anchors).sqrt(), run._losses(run.fixed)[:, 0] / before

    without, anchored = trained(0.0), trained(1.0)
    assert (anchored[0] < 0.7 * without[0]).all()
    # six seconds of motion are thin; a correction that must vanish a tenth beside them cannot explain all of them
    assert (anchored[1] < 0.6).all()


def test_an_anchored_training_resumes_to_the_same_bits(data, tmp_path):
    def kill(done, total, error):
        if done == 30:
            raise Killed

    whole, file = train(PRIOR, *data, SMALL), tmp_path / "training.safetensors"
    with pytest.raises(Killed):
        train(PRIOR, *data, SMALL, checkpoint=file, on_progress=kill)
    same_training(train(PRIOR, *data, SMALL, checkpoint=file), whole)
    with pytest.raises(InputError, match="other settings or data"):
        train(PRIOR, *data, replace(SMALL, anchors=5.0), checkpoint=file)


def test_an_rnn_has_nothing_to_fall_back_on(data):
    settings = replace(SMALL, kind="rnn")
    one, two = train(PRIOR, *data, settings), train(PRIOR, *data, replace(settings, anchors=0.0))
    for name, weights in one.weights.items():
        np.testing.assert_array_equal(weights, two.weights[name])


def test_runs_of_the_prior_that_leave_all_bounds_are_left_out():
    class Bursting(Pendulum):
        def acceleration(self, x, u):
            return 1e6 * x[..., 1:2] ** 3 + super().acceleration(x, u)

    t = 0.02 * np.arange(50.0)
    x = np.column_stack([np.sin(t), np.cos(t)])
    anchors = make_anchors(
        Bursting(TRUTH), [Trajectory("run", "train", 0.02, t, 0 * x[:, :1], x[:, :1], x, 0 * x)], seed=0
    )
    assert torch.isfinite(anchors.x).all()


@pytest.mark.parametrize("weight", [-1.0, float("nan"), float("inf")])
def test_a_weight_that_is_none_is_refused(weight):
    with pytest.raises(InputError, match="anchors must be a weight of 0 or more"):
        replace(SMALL, anchors=weight)


def test_the_literal_form_cannot_be_anchored():
    with pytest.raises(InputError, match="leave anchors 0"):
        replace(SMALL, form="literal")
