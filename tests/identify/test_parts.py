"""Parts of the training data: each network leaves out its own, and what it says there judges the model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum

from hybrid_mpc import PriorStep, TrainingSettings, train
from hybrid_mpc.identify.dataset import in_parts
from hybrid_mpc.identify.evaluate import unseen_runs
from hybrid_mpc.identify.smooth import Smoother, sizes_of
from hybrid_mpc.identify.train import TrainingRun

PRIOR = Pendulum(TRUTH)
SETTINGS = TrainingSettings("pgrnn", 4, 2, 20, 20, seed=3, warm=10, horizon=20, batch=8, every=10, parts=2)


def recordings(run, *lengths):
    """Recordings of these lengths, each another file."""
    return [run.part(slice(0, n), f"file{i}") for i, n in enumerate(lengths)]


def test_many_recordings_stay_whole_and_parts_are_alike(data):
    runs = recordings(data[0][0], 100, 90, 50, 40, 30, 20, 10)
    pieces, part = in_parts(runs, 3, shortest=5)
    assert pieces == runs
    sizes = np.bincount(part, [len(t.t) for t in runs])
    assert sizes.sum() == 340
    assert np.ptp(sizes) <= 10  # no further apart than the smallest recording


def test_what_is_too_short_is_not_cut(data):
    (run,) = recordings(data[0][0], 100)
    assert in_parts([run], 4, shortest=60) == ([run], [-1])
    pieces, part = in_parts([run], 4, shortest=45)  # two of fifty
    assert ([len(p.t) for p in pieces], part) == ([50, 50], [0, 1])


def test_pieces_of_a_recording_are_cut_where_the_recording_is(data):
    run = data[0][0]
    first, second = run.part(slice(0, 70), "file#1"), run.part(slice(80, 110), "file#2")
    pieces, part = in_parts([first, second], 2, shortest=20)
    # the cut lies at sample 50 of 100; 20 samples of the first piece follow it
    assert [(p.name, len(p.t)) for p in pieces] == [("file#1", 50), ("file#1", 20), ("file#2", 30)]
    assert part == [0, 1, 1]


@pytest.mark.parametrize("free", [False, True])
def test_a_network_learns_nothing_from_the_part_that_it_leaves_out(data, free):
    run = TrainingRun(PRIOR, *data, SETTINGS)
    run.free = free
    weight = run.windows.weight
    assert weight.shape == (2, len(run.windows))
    assert set(weight.unique().tolist()) == {0.0, 1.0}
    before = run._losses(run.windows).detach()
    spoiled = run.windows.x.clone()
    spoiled[weight[0] == 0] += 1.0
    after = run._losses(replace(run.windows, x=spoiled)).detach()
    # the first objective of free runs is over the outputs' spread in all windows, which has changed for both
    share = after / before
    assert share[1, 0] > 2.0 * share[0, 0]
    if not free:
        assert torch.equal(after[0], before[0])


def test_what_judges_a_network_neither_trains_it_nor_chooses_its_weights(data):
    """A part that is left out is another one, and the network is the same to the bit."""
    train_runs, valid = data
    pieces, part = in_parts(train_runs, 2, SETTINGS.shortest)
    smoother = Smoother(PRIOR, DT, sigma=(1e-3,), walk=(0.1,), sizes=sizes_of(PRIOR, train_runs, DT, 1.0))
    judged = dict(unseen_runs(SETTINGS, train_runs, valid, smoother))
    assert {t.name for t in judged[0]} == {p.name for p, own in zip(pieces, part, strict=True) if own == 0}
    assert set(judged) == {0, 1}  # the validation chose the weights: it judges none
    run = TrainingRun(PRIOR, train_runs, valid, SETTINGS)
    assert run.valid.weight is None
    assert len(run.valid) == len(TrainingRun(PRIOR, train_runs, valid, replace(SETTINGS, parts=0)).valid)


def test_the_model_is_the_mean_of_its_networks(data):
    trained = train(PRIOR, *data, SETTINGS)
    model, alone = trained.step(PRIOR, DT), [trained.step(PRIOR, DT, i) for i in range(2)]
    assert model.n_h == 2 * SETTINGS.hidden
    x, u, w = torch.rand(3, 2).double(), torch.rand(3, 1).double(), torch.zeros(3, 0).double()
    h = [torch.rand(3, SETTINGS.hidden).double() for _ in alone]
    mean, after = model.correction(x, torch.cat(h, dim=1), u, w)
    each = [step.correction(x, own, u, w) for step, own in zip(alone, h, strict=True)]
    shares = np.square(1 / trained.validation) / np.sum(np.square(1 / trained.validation))
    assert shares[0] != pytest.approx(shares[1])
    want = sum(share * out for share, (out, _) in zip(shares, each, strict=True))
    np.testing.assert_allclose(mean, want, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(after, torch.cat([own for _, own in each], dim=1), rtol=1e-12, atol=1e-15)
    assert (each[0][0] - each[1][0]).abs().max() > 1e-6


def test_a_shrunk_model_has_that_share_of_the_correction(data):
    trained = train(PRIOR, *data, SETTINGS)
    x, u, w = torch.rand(3, 2).double(), torch.rand(3, 1).double(), torch.zeros(3, 0).double()
    h = torch.rand(3, 2 * SETTINGS.hidden).double()
    whole, after = trained.step(PRIOR, DT).correction(x, h, u, w)
    half, same = trained.shrunk(PRIOR, 0.5).step(PRIOR, DT).correction(x, h, u, w)
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-14)
    np.testing.assert_array_equal(same, after)
    assert whole.abs().max() > 1e-6
    none = trained.shrunk(PRIOR, 0.0).step(PRIOR, DT)(x, h, u, w)[0]
    plain = PriorStep(PRIOR, DT, trained.scaling.substeps)
    np.testing.assert_allclose(none, plain(x, plain.h0.expand(3, -1), u, w)[0], rtol=1e-13)
    assert trained.shrunk(PRIOR, 1.0) is trained


def test_a_network_without_finite_validation_is_left_out_of_the_mean(data):
    trained = train(PRIOR, *data, SETTINGS)
    one = replace(trained, validation=np.array([np.inf, trained.validation[1]]))
    np.testing.assert_array_equal(
        one.step(PRIOR, DT).network.head.weight, one.step(PRIOR, DT, 1).network.head.weight
    )
    none = replace(trained, validation=np.full(2, np.inf))
    assert none.step(PRIOR, DT).n_h == 2 * SETTINGS.hidden
