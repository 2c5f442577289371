from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.checkpoint import load_checkpoint, save_checkpoint
from hybrid_mpc.identification.dataset import cut_windows, fitting_horizon
from hybrid_mpc.identification.training import KINDS, TrainingSettings, _Run, train

SMALL = TrainingSettings("mopgrnn", 4, 2, 20, 20, seed=3, warm=10, horizon=20, batch=8, every=10)


def drag(phi, v):
    """A torque [N m] that the prior lacks."""
    return -0.08 * np.tanh(v / 0.5)


@pytest.fixture(scope="module")
def data():
    runs = [record(seed, seconds=3.0, extra=drag) for seed in range(3)]
    return [*runs[:2]], [replace(runs[2], role="valid")]


PRIOR = Pendulum(TRUTH)


def same(one, two):
    assert one.settings == two.settings
    assert one.scaling == two.scaling
    for name, weight in one.weights.items():
        np.testing.assert_array_equal(weight, two.weights[name])
    for name, column in one.curve.items():
        np.testing.assert_array_equal(column, two.curve[name])
    np.testing.assert_array_equal(one.validation, two.validation)


def test_training_is_deterministic_and_the_seed_matters(data):
    one = train(PRIOR, *data, SMALL)
    same(one, train(PRIOR, *data, SMALL))
    other = train(PRIOR, *data, replace(SMALL, seed=4))
    assert not np.array_equal(one.weights["w_hh"], other.weights["w_hh"])


class Killed(Exception):
    pass


@pytest.mark.parametrize("at", [10, 20, 30])  # within a stage, between the stages, within the second
def test_a_killed_training_resumes_to_the_same_bits(data, tmp_path, at):
    def kill(done, total, error):
        if done == at:
            raise Killed

    file = tmp_path / "training.safetensors"
    with pytest.raises(Killed):
        train(PRIOR, *data, SMALL, checkpoint=file, on_progress=kill)
    seen = []
    resumed = train(PRIOR, *data, SMALL, checkpoint=file, on_progress=lambda d, t, e: seen.append(d))
    assert seen[0] == at + 10  # it went on, it did not start anew
    same(resumed, train(PRIOR, *data, SMALL))


def test_a_damaged_or_foreign_checkpoint_is_refused(data, tmp_path):
    file = tmp_path / "training.safetensors"
    train(PRIOR, *data, SMALL, checkpoint=file)
    for changed in (replace(SMALL, seed=9), replace(SMALL, horizon=19)):
        with pytest.raises(InputError, match="other settings or data"):
            train(PRIOR, *data, changed, checkpoint=file)
    with pytest.raises(InputError, match="other settings or data"):
        train(PRIOR, data[1], data[0], SMALL, checkpoint=file)
    whole = file.read_bytes()
    for broken in (whole[: len(whole) // 2], b"", b"\x00" * 100):
        file.write_bytes(broken)
        with pytest.raises(InputError, match="delete it to train anew"):
            train(PRIOR, *data, SMALL, checkpoint=file)


def test_a_checkpoint_gives_back_what_it_got(tmp_path):
    tensors = {"a": torch.rand(3, 2).double(), "b": torch.arange(3)}
    save_checkpoint(tmp_path / "c", "key", tensors, {"done": 3})
    again, numbers = load_checkpoint(tmp_path / "c", "key")
    assert numbers == {"done": 3}
    assert all(torch.equal(again[n], tensors[n]) for n in tensors)
    assert [f.name for f in tmp_path.iterdir()] == ["c"]


def test_bounds_never_rise_within_a_stage(data):
    curve = train(PRIOR, *data, SMALL).curve
    for stage in (0.0, 1.0):
        rows = curve["free_run"][:, 0] == stage
        assert rows.sum() >= 2
        for name in ("bound_error", "bound_energy"):
            assert (np.diff(curve[name][rows], axis=0) <= 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_learns(data, kind):
    settings = replace(SMALL, kind=kind, teacher_steps=60, free_run_steps=60, decay=0.0)
    trained = train(PRIOR, *data, settings)
    start = trained.curve["validation"][0]
    # a missing drag is a smooth function of the state: so short a training removes a good part of its effect
    assert (trained.validation < 0.8 * start).all(), (start, trained.validation)
    step = trained.step(PRIOR, DT)
    assert step.use_prior == (kind != "rnn")
    assert trained.best == int(np.argmin(trained.validation))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["x", "u"])
def test_data_that_are_no_numbers_are_refused_by_name_and_time(data, name, value):
    train_runs, valid = data
    array = getattr(train_runs[1], name).copy()
    array[40] = value
    with pytest.raises(InputError, match=rf"run1: {name} is not finite at 0.8 s"):
        train(PRIOR, [train_runs[0], replace(train_runs[1], **{name: array})], valid, SMALL)


def test_a_gradient_that_is_no_number_is_skipped_and_counted_for_its_network_alone(data):
    run = _Run(PRIOR, *data, SMALL)
    for weight in run.weights.values():
        weight.grad = torch.ones_like(weight)
    run.weights["w_hh"].grad[0, 1, 2] = np.nan
    run._clip()
    grads = [weight.grad for weight in run.weights.values()]
    assert run.skipped.tolist() == [1, 0]
    assert all((g[0] == 0).all() for g in grads)
    norm = sum(float(g[1].square().sum()) for g in grads) ** 0.5
    assert norm == pytest.approx(1.0, rel=1e-12)  # the other network's is clipped to one


def cut(trajectory, n):
    """Its first ``n`` samples."""
    return replace(trajectory, **{k: getattr(trajectory, k)[:n] for k in ("t", "u", "y", "x", "xdot")})


def test_a_short_run_shortens_the_windows_and_too_short_ones_are_refused(data):
    long, warm = data[0][0], SMALL.warm
    assert fitting_horizon([long], warm, 20) == 20
    for n in (warm + 20, warm + 31):
        horizon = fitting_horizon([long, cut(long, n)], warm, 20)
        alone = cut_windows([cut(long, n)], warm, horizon, 1)
        assert 10 <= horizon <= 20
        assert len(alone) > 1  # it gives windows at several starts
    assert fitting_horizon([long, cut(long, warm + 2)], warm, 20) == 10  # it does not drag the others down
    with pytest.raises(InputError, match="long enough"):
        train(PRIOR, [cut(long, warm + 1)], data[1], SMALL)
