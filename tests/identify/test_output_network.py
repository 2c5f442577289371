from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

import nn_export
from hybrid_mpc import (
    InputError,
    PriorStep,
    Signal,
    free_runs,
    load,
    model_info,
    save_artifact,
    score,
    trace_model,
    train_output,
    with_output,
)
from hybrid_mpc.identify.output_network import OutputSettings
from hybrid_mpc.model.model import step_symbols

OFFSET, ECCENTRIC, PHASE, NOISE = 0.1, 0.05, 0.7, 2e-4  # an encoder's, rad
QUICK = OutputSettings(networks=2, steps=600)
EMPTY = torch.zeros(0, dtype=torch.float64)


def encoder(phi):
    """What an encoder shows that is mounted off the axis and turned."""
    return phi + OFFSET + ECCENTRIC * np.sin(phi + PHASE)


def seen(run, sensor=encoder):
    noise = NOISE * np.random.default_rng(round(1e6 * abs(run.x[0, 0]))).standard_normal((len(run.t), 1))
    return replace(run, y=sensor(run.x[:, :1]) + noise)


@pytest.fixture(scope="module")
def runs():
    return [seen(record(seed, seconds=4.0)) for seed in range(5)]


@pytest.fixture(scope="module")
def trained(runs):
    return train_output(Pendulum(TRUTH), runs[:3], runs[3:4], QUICK)


def test_an_eccentric_encoder_is_found_where_states_are_measured(runs, trained):
    prior = Pendulum(TRUTH)
    output = trained.model(prior)
    free = free_runs(PriorStep(prior, DT), prior, runs[4:], 10, EMPTY)  # a run that nobody has seen
    without, with_g = (score(r).rmse_rad for r in (free, with_output(free, output)))
    assert without > 0.1  # the offset
    assert with_g < 0.01 * without  # 0.133 and 0.0006 rad; the noise is 0.0002
    assert (trained.validation < 0.02 * trained.without).all()
    phi = np.linspace(-0.8, 0.8, 33)  # where the runs have been: it is the encoder, not only their mean
    x = torch.tensor(np.column_stack([phi, 0 * phi]))
    shown = output(x, torch.zeros(33, 1).double())[:, 0].numpy()
    np.testing.assert_allclose(shown, encoder(phi), atol=2e-3)  # 5e-4, and noise


def test_it_is_the_prior_where_nothing_is_to_be_found(runs):
    prior = Pendulum(TRUTH)
    plain = [seen(run, lambda phi: phi) for run in runs]
    trained = train_output(prior, plain[:2], plain[3:4], replace(QUICK, steps=100))
    assert (trained.validation <= trained.without).all()  # it starts there, and validation keeps the best
    correction = (
        trained.model(prior)(torch.tensor(plain[4].x), torch.tensor(plain[4].u)).numpy() - plain[4].x[:, :1]
    )
    assert np.sqrt((correction**2).mean()) < NOISE


def damped(gravity):
    """Runs with much damping, with and without gravity, whose states nobody knows: all comes from the encoder."""

    def extra(phi, v):
        return -0.45 * v + (0.0 if gravity else TRUTH["mgl"] * np.sin(phi))

    made = []
    for seed in range(4):
        run = record(seed, seconds=6.0, extra=extra)
        y = run.x[:, :1] + OFFSET
        made.append(replace(run, y=y, x=np.column_stack([y, run.x[:, 1]])))
    return Pendulum({**TRUTH, "d": TRUTH["d"] + 0.45, "mgl": TRUTH["mgl"] if gravity else 0.0}), made


@pytest.mark.parametrize("gravity", [True, False])
def test_a_constant_offset_is_seen_through_gravity_alone(gravity):
    prior, runs = damped(gravity)
    free = free_runs(PriorStep(prior, DT), prior, runs, 0, EMPTY)
    # 2 J / d = 0.4 s: where gravity acts, an error of the start is down to e^-7 of itself after 3 s
    trained = train_output(prior, free[:3], free[3:], QUICK, skip=150)
    x, u = torch.tensor(free[3].x_hat[150:]), torch.tensor(free[3].u[150:])
    correction = (trained.model(prior)(x, u) - prior.output(x, u)).numpy()
    if gravity:
        np.testing.assert_allclose(correction, OFFSET, atol=0.05 * OFFSET)
    else:  # the axis is the same at every angle: the free run starts at the wrong angle and stays there
        np.testing.assert_allclose(correction, 0.0, atol=0.01 * OFFSET)
        np.testing.assert_allclose(free[3].x_hat[150:, 0] - runs[3].x[150:-1, 0], 0.0, atol=1e-6)


def test_the_exported_model_carries_it_at_rounding(runs, trained, tmp_path):
    prior = Pendulum(TRUTH)
    step, output, info = PriorStep(prior, DT), trained.model(prior), model_info(prior, DT)
    save_artifact(tmp_path, {"g": trace_model(step, output), "plain": trace_model(step)}, info)
    models = load(tmp_path).models
    x, _, u, *_ = step_symbols(models["g"])
    held = {name: (model.w, model.p) for name, model in models.items()}
    function = ca.Function("output", [x, u], [models["g"].output(x, u, *held["g"])])
    report = nn_export.parity(output, function, (torch.zeros(2).double(), torch.zeros(1).double()), seed=0)
    assert report.value_rel < 1e-12
    assert report.jacobian_rel < 1e-12
    assert (
        float(models["plain"].output([0.3, 1.0], [0.1], *held["plain"])) == 0.3
    )  # the prior's output, as ever
    assert float(models["g"].output([0.3, 1.0], [0.1], *held["g"])) == pytest.approx(encoder(0.3), abs=5e-3)


def test_networks_of_a_stack_are_independent_and_training_is_deterministic(runs):
    prior, s = Pendulum(TRUTH), replace(QUICK, steps=60)
    two, again, three = (train_output(prior, runs[:2], runs[3:4], t) for t in (s, s, replace(s, networks=3)))
    for name, weight in two.weights.items():
        np.testing.assert_array_equal(weight, again.weights[name])
        np.testing.assert_allclose(
            weight, three.weights[name][:2], rtol=1e-9, atol=1e-12
        )  # other kernels' rounding
    assert not np.array_equal(two.weights["w_out"][0], two.weights["w_out"][1])


def test_an_angle_that_turns_is_corrected_alike_in_every_turn(trained):
    output = trained.model(Pendulum(TRUTH))
    x, turn = torch.tensor([0.3, 1.0]).double(), torch.tensor(np.array([2 * np.pi, 0.0]))
    here, there = (output(z, torch.zeros(1).double()) for z in (x, x + turn))
    assert float(there - here) == pytest.approx(2 * np.pi, abs=1e-12)

    class Line(Pendulum):
        states = (Signal("phi", "rad"), Signal("phi_dot", "rad/s"))
        outputs = (Signal("phi", "rad"),)

    assert Line().states[0].periodic is False
    sizes = [
        train_output(p, [seen(record(0, 1.0))], [seen(record(1, 1.0))], replace(QUICK, steps=1))
        for p in (Pendulum(), Line())
    ]
    assert [t.weights["w_first"].shape[1] for t in sizes] == [
        6,
        4,
    ]  # sine and cosine of phi and of y, or phi and y


def test_bad_input_is_refused_by_name(runs):
    prior, nan = Pendulum(TRUTH), runs[1].y.copy()
    nan[40] = np.nan
    for training, options, words in (
        ([], {}, "at least one of each"),
        ([runs[0], replace(runs[1], y=nan)], {}, r"run1: y is not finite at 0\.8 s"),
        ([replace(runs[0], u=np.hstack([runs[0].u] * 2))], {}, "run0: u has 2 columns, Pendulum has 1"),
        (runs[:1], {"skip": 4000}, "leaves none"),
    ):
        with pytest.raises(InputError, match=words):
            train_output(prior, training, runs[3:4], QUICK, **options)
    with pytest.raises(InputError, match="steps of an output network"):
        OutputSettings(steps=0)
