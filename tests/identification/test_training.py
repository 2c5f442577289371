from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.checkpoint import load_checkpoint, save_checkpoint
from hybrid_mpc.identification.dataset import cut_windows, fitting_horizon
from hybrid_mpc.identification.objectives import OBJECTIVES, energy_objective, free_run, teacher_forced
from hybrid_mpc.identification.training import KINDS, TrainingSettings, train
from hybrid_mpc.identification.training_run import REPEATS, TrainingRun

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


RECORDED = {
    "rnn": ([4.467345636059029, 4.4967600663638185], 3.546185453038559, 0.4602601570250249),
    "pgrnn": ([0.8462809587132868, 0.8848871100683532], 1.6580522341213275, -0.26096452807369064),
    "mopgrnn": ([0.8127013276690178, 0.8423556541541719], 1.6486293874673361, -0.26694627526826575),
}
"""Validation and a print of ``w_hh`` and ``w_out`` before cells, forms and combinations could be chosen."""


@pytest.mark.parametrize("kind", KINDS)
def test_a_training_with_defaults_is_what_it_has_always_been(data, kind):
    validation, *prints = RECORDED[kind]
    trained = train(PRIOR, *data, replace(SMALL, kind=kind))
    weights = (trained.weights[name].ravel() for name in ("w_hh", "w_out"))
    # another machine rounds elsewhere in its last bit; 40 steps of Adam carry that no further than this
    np.testing.assert_allclose(trained.validation, validation, rtol=1e-9)
    np.testing.assert_allclose([(w * np.cos(np.arange(w.size))).sum() for w in weights], prints, rtol=1e-9)


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
    run = TrainingRun(PRIOR, *data, SMALL)
    for weight in run.weights.values():
        weight.grad = torch.ones_like(weight)
    run.weights["w_hh"].grad[0, 1, 2] = np.nan
    finite = run._clip()
    grads = [weight.grad for weight in run.weights.values()]
    assert finite.tolist() == [False, True]
    assert all((g[0] == 0).all() for g in grads)
    norm = sum(float(g[1].square().sum()) for g in grads) ** 0.5
    assert norm == pytest.approx(1.0, rel=1e-12)  # the other network's is clipped to one


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
SHORT = replace(SMALL, teacher_steps=15, free_run_steps=10, every=5)


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_option_trains_resumes_and_makes_a_model(data, options, tmp_path):
    def kill(done, total, error):
        if done == 10:
            raise Killed

    settings, file = replace(SHORT, **options), tmp_path / "training.safetensors"
    whole = train(PRIOR, *data, settings)
    assert (whole.validation < whole.curve["validation"][0]).all()
    assert not whole.faults
    with pytest.raises(Killed):
        train(PRIOR, *data, settings, checkpoint=file, on_progress=kill)
    same(whole, train(PRIOR, *data, settings, checkpoint=file))
    if options not in ({"energy": "one_step"}, {"fused": True}):
        assert not np.array_equal(whole.validation, train(PRIOR, *data, SHORT).validation)
    step = whole.step(PRIOR, DT)
    x_next, h_next = step(
        torch.zeros(2).double(), torch.zeros(step.network.n_h).double(), torch.ones(1).double()
    )
    assert torch.isfinite(torch.cat([x_next, h_next])).all()


def test_both_readings_of_the_energy_objective(data):
    for free in (False, True):
        losses = {}
        for energy in ("stage", "one_step", "free_run"):
            run = TrainingRun(PRIOR, *data, replace(SMALL, energy=energy))
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


def test_any_number_of_objectives(data, monkeypatch):
    def square(step, p):
        return (p.xdot_hat - p.xdot).square().sum(-1).mean(dim=(0, 2))

    monkeypatch.setitem(OBJECTIVES, "square", square)
    curve = train(PRIOR, *data, replace(SHORT, objectives=("error", "energy", "square"))).curve
    for name in ("error", "energy", "square"):
        assert (curve[f"loss_{name}"] > 0).all()
        assert (np.diff(curve[f"bound_{name}"][curve["free_run"][:, 0] == 0], axis=0) <= 0).all()
    two = train(PRIOR, *data, SHORT).curve
    assert not np.array_equal(curve["loss_error"][1:], two["loss_error"][1:])  # the third one counts


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
        replace(SMALL, **wrong)


def failing(monkeypatch, broken):
    """Make the energy of network 0 no number in the calls with gradient whose number ``broken`` accepts."""
    calls = iter(range(10_000))

    def energy(step, p):
        value = energy_objective(step, p)
        if torch.is_grad_enabled() and broken(next(calls)):
            value = value * value.new_tensor([np.nan, 1.0][: len(value)])
        return value

    monkeypatch.setitem(OBJECTIVES, "energy", energy)


def test_a_loss_that_is_no_number_again_and_again_stops_its_network_alone(data, monkeypatch, tmp_path):
    whole = train(PRIOR, *data, SMALL)
    failing(monkeypatch, lambda k: k >= 12)
    trained = train(PRIOR, *data, SMALL, checkpoint=tmp_path / "c")
    (fault,) = trained.faults
    assert (fault.network, fault.objective, fault.stopped) == (0, "energy", True)
    assert fault.step == 12 + REPEATS - 1
    assert trained.skipped.tolist() == [REPEATS, 0]
    assert all(np.isfinite(w).all() for w in trained.weights.values())
    for name, w in trained.weights.items():  # the other one has noticed nothing
        np.testing.assert_array_equal(w[1], whole.weights[name][1])
    # it rests at its best weights: nothing about it changes after the stop
    late = trained.curve["step"][:, 0] >= 20
    assert np.ptp(trained.curve["validation"][late, 0]) == 0.0
    assert trained.curve["validation"][-1, 0] == trained.validation[0]
    same(trained, train(PRIOR, *data, SMALL, checkpoint=tmp_path / "c"))
    assert train(PRIOR, *data, SMALL, checkpoint=tmp_path / "c").faults == trained.faults


def test_a_single_loss_that_is_no_number_is_named_and_training_goes_on(data, monkeypatch):
    failing(monkeypatch, lambda k: k in (3, 9))
    trained = train(PRIOR, *data, SMALL)
    (fault,) = trained.faults
    assert (fault.network, fault.objective, fault.step, fault.stopped) == (0, "energy", 9, False)
    assert trained.skipped.tolist() == [2, 0]
    assert trained.curve["step"][-1, 0] == 40


def test_a_training_without_a_network_left_ends(data, monkeypatch):
    failing(monkeypatch, lambda k: True)
    trained = train(PRIOR, *data, replace(SMALL, networks=1))
    assert trained.faults[0].stopped
    assert trained.curve["step"][-1, 0] == 10  # the evaluation after the stop is the last
    assert trained.validation[0] == trained.curve["validation"][0, 0]


def test_the_literal_form_wants_the_derivative(data):
    train_runs, valid = data
    xdot = train_runs[1].xdot.copy()
    xdot[40] = np.nan
    bad = [train_runs[0], replace(train_runs[1], xdot=xdot)]
    with pytest.raises(InputError, match=r"run1: xdot is not finite at 0\.8 s"):
        train(PRIOR, bad, valid, replace(SHORT, form="literal"))
    train(PRIOR, bad, valid, replace(SHORT, teacher_steps=1, free_run_steps=0))  # the hybrid does not


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
