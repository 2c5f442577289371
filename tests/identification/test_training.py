from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc.errors import InputError
from hybrid_mpc.identification import training
from hybrid_mpc.identification.checkpoint import load_checkpoint, save_checkpoint
from hybrid_mpc.identification.training import KINDS, TrainingSettings, train

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
    assert one.settings == two.settings and one.scaling == two.scaling
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
    assert numbers == {"done": 3} and all(torch.equal(again[n], tensors[n]) for n in tensors)
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
    trained = train(PRIOR, *data, replace(SMALL, kind=kind, teacher_steps=60, free_run_steps=40))
    start = trained.curve["validation"][0]
    # a missing drag of 0.08 N m is a smooth function of the state: 100 steps remove a good part of it
    assert (trained.validation < 0.7 * start).all(), (start, trained.validation)
    step = trained.step(PRIOR, DT)
    assert step.use_prior == (kind != "rnn")
    assert trained.best == int(np.argmin(trained.validation))


def test_data_that_are_no_numbers_leave_the_weights_and_are_counted(data):
    train_runs, valid = data
    x = train_runs[0].x.copy()
    x[40] = np.nan
    trained = train(PRIOR, [replace(train_runs[0], x=x)], valid, replace(SMALL, batch=64))
    assert all(np.isfinite(w).all() for w in trained.weights.values())
    assert np.isfinite(trained.validation).all()
    assert (trained.skipped > 0).all()


def test_short_runs_give_windows_or_are_refused(data):
    train_runs, valid = data
    short = replace(train_runs[0], **{n: getattr(train_runs[0], n)[:11] for n in ("t", "u", "y", "x", "xdot")})
    with pytest.raises(InputError, match="long enough"):
        train(PRIOR, [short], valid, SMALL)
    assert training.NAMES == ("error", "energy")
