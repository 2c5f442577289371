from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, SMALL, TRUTH, Pendulum, killed_and_resumed, same_training

from hybrid_mpc import InputError, train
from hybrid_mpc.identify import train as training
from hybrid_mpc.identify.dataset import LONGEST, cut_windows, fitting_horizon, validation_horizon
from hybrid_mpc.identify.objectives import OBJECTIVES, objectives_of
from hybrid_mpc.identify.settings import KINDS
from hybrid_mpc.identify.train import REPEATS, TrainingRun

PRIOR = Pendulum(TRUTH)


@pytest.fixture(scope="module")
def whole(data):
    """What ``SMALL`` comes to when nothing goes wrong."""
    return train(PRIOR, *data, SMALL)


def test_validation_runs_are_as_long_as_a_usual_recording_allows(data):
    long, warm = data[1][0], 10
    two_thirds = 2 * (len(long.t) - warm - 1) // 3
    some = [cut(long, warm + 5), cut(long, warm + 9), long]  # most samples lie in the long one
    assert validation_horizon([long], warm) == validation_horizon(some, warm) == two_thirds < LONGEST
    for horizon in (5, 20):
        run = TrainingRun(PRIOR, data[0], some, replace(SMALL, horizon=horizon))
        assert run.valid.u.shape[1] == warm + two_thirds
    fixed = TrainingRun(PRIOR, data[0], some[-1:], replace(SMALL, validation_horizon=7))
    assert fixed.valid.u.shape[1] == warm + 7


def test_the_seed_matters(data, whole):
    other = train(PRIOR, *data, replace(SMALL, seed=4))
    assert not np.array_equal(whole.weights["w_hh"], other.weights["w_hh"])


@pytest.mark.parametrize("kind", ["pgrnn", "mopgrnn"])
def test_without_steps_the_model_is_the_prior(data, kind):
    untrained = train(PRIOR, *data, replace(SMALL, kind=kind, teacher_steps=0, free_run_steps=0))
    assert np.isfinite(untrained.validation).all()
    assert not untrained.weights["w_out"].any()
    assert not untrained.weights["b_out"].any()


RECORDED = {
    "rnn": ([1.2791536441755693, 1.4966904854425127], 3.5290088155354864, 0.4366571444961967),
    "pgrnn": ([0.30358809190488634, 0.2974081223462936], 1.61819340246503, -0.25068615876538997),
    "mopgrnn": ([0.2981887761575751, 0.28688658944771533], 1.5886658646863894, -0.26055417642671225),
}
"""Validation, and weighted sums of ``w_hh`` and ``w_out``."""


@pytest.mark.parametrize("kind", KINDS)
def test_a_training_gives_the_recorded_numbers(data, kind):
    validation, *prints = RECORDED[kind]
    trained = train(PRIOR, *data, replace(SMALL, kind=kind))
    weights = (trained.weights[name].ravel() for name in ("w_hh", "w_out"))
    # another machine rounds elsewhere in its last bit; 40 steps of Adam carry that no further than this
    np.testing.assert_allclose(trained.validation, validation, rtol=1e-9)
    np.testing.assert_allclose([(w * np.cos(np.arange(w.size))).sum() for w in weights], prints, rtol=1e-9)
    assert (trained.validation < trained.curve["validation"][0]).all()  # it learns
    assert trained.best == int(np.argmin(trained.validation))
    assert trained.step(PRIOR, DT).use_prior == (kind != "rnn")


@pytest.mark.parametrize("at", [10, 20, 30])  # within a stage, between the stages, within the second
def test_a_killed_training_resumes_to_the_same_bits(data, whole, tmp_path, at):
    resumed, seen = killed_and_resumed(at, tmp_path / "training.safetensors", PRIOR, *data, SMALL)
    assert seen[0] == at + 10  # it went on, it did not start anew
    same_training(resumed, whole)


def test_a_damaged_or_foreign_checkpoint_is_refused(data, tmp_path):
    file = tmp_path / "training.safetensors"
    train(PRIOR, *data, SMALL, checkpoint=file)
    for changed in (replace(SMALL, seed=9), replace(SMALL, horizon=19)):
        with pytest.raises(InputError, match="HM-IDENTIFY-055"):
            train(PRIOR, *data, changed, checkpoint=file)
    with pytest.raises(InputError, match="HM-IDENTIFY-055"):
        train(PRIOR, data[1], data[0], SMALL, checkpoint=file)
    whole = file.read_bytes()
    for broken in (whole[: len(whole) // 2], b"", b"\x00" * 100):
        file.write_bytes(broken)
        with pytest.raises(InputError, match="HM-IDENTIFY-053"):
            train(PRIOR, *data, SMALL, checkpoint=file)


def test_bounds_never_rise_within_a_stage(whole):
    curve = whole.curve
    for stage in (0.0, 1.0):
        rows = curve["free_run"][:, 0] == stage
        assert rows.sum() >= 2
        for name in ("bound_output", "bound_energy"):
            assert (np.diff(curve[name][rows], axis=0) <= 0).all()


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


def failing(monkeypatch, broken):
    """Make the energy of network 0 no number in the calls with gradient whose number ``broken`` accepts."""
    calls = iter(range(10_000))

    def objectives(prior, names):
        made = objectives_of(prior, names)
        own = made["energy"]
        return {**made, "energy": lambda step, p: energy(own, step, p)}

    def energy(own, step, p):
        value = own(step, p)
        if torch.is_grad_enabled() and broken(next(calls)):
            value = value * value.new_tensor([np.nan, 1.0][: len(value)])
        return value

    monkeypatch.setattr(training, "objectives_of", objectives)


def test_a_loss_that_is_no_number_again_and_again_stops_its_network_alone(data, whole, monkeypatch, tmp_path):
    failing(monkeypatch, lambda k: k >= 12)
    trained = train(PRIOR, *data, SMALL, checkpoint=tmp_path / "c")
    (failure,) = trained.failures
    assert (failure.network, failure.objective, failure.stopped) == (0, "energy", True)
    assert failure.step == 12 + REPEATS - 1
    assert trained.skipped.tolist() == [REPEATS, 0]
    assert all(np.isfinite(w).all() for w in trained.weights.values())
    for name, w in trained.weights.items():  # the other one has noticed nothing
        np.testing.assert_array_equal(w[1], whole.weights[name][1])
    # it rests at its best weights: nothing about it changes after the stop
    late = trained.curve["step"][:, 0] >= 20
    assert np.ptp(trained.curve["validation"][late, 0]) == 0.0
    assert trained.curve["validation"][-1, 0] == trained.validation[0]
    same_training(trained, train(PRIOR, *data, SMALL, checkpoint=tmp_path / "c"))
    assert train(PRIOR, *data, SMALL, checkpoint=tmp_path / "c").failures == trained.failures


def test_a_single_loss_that_is_no_number_is_named_and_training_goes_on(data, monkeypatch):
    failing(monkeypatch, lambda k: k in (3, 9))
    trained = train(PRIOR, *data, SMALL)
    (failure,) = trained.failures
    assert (failure.network, failure.objective, failure.step, failure.stopped) == (0, "energy", 9, False)
    assert trained.skipped.tolist() == [2, 0]
    assert trained.curve["step"][-1, 0] == 40


def test_a_training_without_a_network_left_ends(data, monkeypatch):
    failing(monkeypatch, lambda k: True)
    trained = train(PRIOR, *data, replace(SMALL, networks=1))
    assert trained.failures[0].stopped
    assert trained.curve["step"][-1, 0] == 10  # the evaluation after the stop is the last
    assert trained.validation[0] == trained.curve["validation"][0, 0]


def cut(trajectory, n):
    """Its first ``n`` samples."""
    return replace(trajectory, **{k: getattr(trajectory, k)[:n] for k in ("t", "u", "y", "x", "xdot", "w")})


def test_a_short_run_shortens_the_windows_and_too_short_ones_are_refused(data):
    long, warm = data[0][0], SMALL.warm
    assert fitting_horizon([long], warm, 20) == 20
    for n in (warm + 20, warm + 31):
        horizon = fitting_horizon([long, cut(long, n)], warm, 20)
        alone = cut_windows([cut(long, n)], warm, horizon, 1)
        assert 10 <= horizon <= 20
        assert len(alone) > 1  # it gives windows at several starts
    assert fitting_horizon([long, cut(long, warm + 2)], warm, 20) == 10  # it does not drag the others down
    with pytest.raises(InputError, match="HM-IDENTIFY-005"):
        train(PRIOR, [cut(long, warm + 1)], data[1], SMALL)


# options


@pytest.mark.parametrize("options", [{"objectives": ("error",)}, {"prior_parameters": "trained"}], ids=str)
def test_every_option_trains_resumes_and_makes_a_model(data, whole, options, tmp_path):
    settings, file = replace(SMALL, **options), tmp_path / "training.safetensors"
    trained = train(PRIOR, *data, settings)
    assert (trained.validation < trained.curve["validation"][0]).all()
    assert not trained.failures
    same_training(trained, killed_and_resumed(10, file, PRIOR, *data, settings)[0])
    assert not np.array_equal(trained.validation, whole.validation)
    step = trained.step(PRIOR, DT)
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
    curve = train(PRIOR, *data, replace(SMALL, objectives=("error", "energy", "square"))).curve
    for name in ("error", "energy", "square"):
        assert (curve[f"loss_{name}"] > 0).all()
        assert (np.diff(curve[f"bound_{name}"][curve["free_run"][:, 0] == 0], axis=0) <= 0).all()
    two = train(PRIOR, *data, replace(SMALL, objectives=("error", "energy"))).curve
    assert not np.array_equal(curve["loss_error"][1:], two["loss_error"][1:])  # the third one counts


def test_teacher_forcing_takes_the_rates_where_free_runs_take_the_outputs(data):
    settings = replace(SMALL, kind="pgrnn", free_run_steps=0)
    rates, outputs = (
        train(PRIOR, *data, replace(settings, objectives=(name,))) for name in ("error", "output")
    )
    np.testing.assert_array_equal(rates.curve["loss_error"], outputs.curve["loss_output"])
    assert not np.array_equal(rates.curve["validation"], outputs.curve["validation"])  # each by its own
