from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import (
    Parameter,
    TrainingSettings,
    check_parity,
    free_runs,
    model_info,
    score,
    trace_model,
    train,
)
from hybrid_mpc.identify.step import HybridStep, Scaling, TrainedParameters
from hybrid_mpc.identify.train import TrainingRun
from hybrid_mpc.kit.artifact import build_model

SHORT = TrainingSettings(
    "pgrnn", 4, 2, 60, 40, seed=3, warm=10, horizon=20, batch=8, every=20, prior_parameters="trained"
)


@pytest.fixture(scope="module")
def data():
    runs = [record(seed, seconds=3.0) for seed in range(3)]
    return [*runs[:2]], [replace(runs[2], role="valid")]


@pytest.fixture(scope="module")
def trained(data):
    return train(Pendulum(), *data, SHORT)


def distances(values):
    """How far each parameter is from the truth, in units of how far the nominal one is."""
    nominal = Pendulum().values
    return [abs(values[n] - TRUTH[n]) / abs(nominal[n] - TRUTH[n]) for n in TRUTH]


def given(values):
    """The prior with other parameters."""
    return Pendulum({**Pendulum().values, **values})


def rates(prior, x, u):
    """``xdot`` of a prior at numpy or torch points ``(..., n)``, by CasADi."""
    x, u = (np.asarray(v) for v in (x, u))
    found = prior.equations.xdot(x.reshape(-1, 2).T, u.reshape(-1, 1).T, [], prior.p)
    return found.full().T.reshape(x.shape)


def test_each_network_s_own_prior_is_that_prior_with_its_values():
    trained, x, u = (
        TrainedParameters(Pendulum(), 3),
        torch.rand(4, 1, 5, 2).double(),
        torch.rand(4, 1, 5, 1).double(),
    )
    for way in trained.ways.values():
        torch.nn.init.uniform_(way, -0.1, 0.1, generator=torch.Generator().manual_seed(0))
    trained.project()
    scaling = Scaling((1.0, 1.0), (1.0,), (1.0,), (1.0,))
    step = HybridStep(Pendulum(), torch.nn.Identity(), scaling, DT, shift=trained)
    xdot = step.prior_rates(x, u, torch.zeros(4, 1, 5, 0).double())
    assert xdot.shape == (4, 3, 5, 2)
    values = trained.in_units({name: w.detach() for name, w in trained.weights().items()})
    for i in range(3):
        alone = given({name.removeprefix("prior."): v[i] for name, v in values.items()})
        # rounding
        np.testing.assert_allclose(
            xdot[:, i].detach(), rates(alone, x[:, 0], u[:, 0]), rtol=1e-13, atol=1e-13
        )
    xdot[:, 1].sum().backward()
    for way in trained.ways.values():  # each network's loss reaches its own parameters
        assert (way.grad[:, 0] != 0).tolist() == [False, True, False]


def test_wrong_parameters_move_to_the_truth(data, trained):
    fixed = train(Pendulum(), *data, replace(SHORT, prior_parameters="fixed"))
    for i in range(SHORT.networks):
        # the network can explain the same error: the parameters get most of it, since all runs need it alike
        assert max(distances(trained.prior_values(i))) < 0.5
    assert (trained.validation < 0.5 * fixed.validation).all()
    own = [list(trained.prior_values(i).values()) for i in range(2)]
    assert own[0] != own[1]
    np.testing.assert_allclose(list(trained.prior_values().values()), trained.shares @ own, rtol=1e-14)
    assert fixed.prior_values() == {}
    whole, start = trained.prior_values(), Pendulum().values
    half = trained.shrunk(Pendulum(), 0.5).prior_values()  # as far from where it began
    for name, value in half.items():
        assert value == pytest.approx(0.5 * (start[name] + whole[name]), rel=1e-12)


@pytest.mark.full
def test_bounds_hold(data):
    class Narrow(Pendulum):
        parameters = (
            Parameter("J", 0.15, "kg m^2", 0.14, 0.5),
            Parameter("mgl", 1.0, "N m", 1.0, 1.0),
            Parameter("d", 0.01, "N m s/rad", 0.01, 0.5),
        )

    narrow = train(Narrow(), *data, SHORT)
    # the truth 0.1 lies beyond: it ends on the bound, not near it
    np.testing.assert_array_equal(narrow.weights["prior.J"], 0.14)
    assert (narrow.weights["prior.d"] >= 0.01).all()
    assert "prior.mgl" not in narrow.weights  # fixed
    run = TrainingRun(Narrow(), *data, SHORT)
    with torch.no_grad():
        run.parameters.ways["J"].fill_(7.0)
        run.parameters.ways["d"].fill_(-7.0)
    run.parameters.project()
    values = Narrow().p + run.parameters.shift()[:, 0].detach().numpy()
    np.testing.assert_allclose(values, 2 * [[0.5, 1.0, 0.01]], rtol=1e-15)


def test_the_step_made_of_it_is_the_one_that_was_trained(data):
    settings = replace(SHORT, teacher_steps=10, free_run_steps=5)
    run = TrainingRun(Pendulum(), *data, settings)
    while not run.over:
        if run.done in (0, 10):
            run.enter_stage()
        run.update()
    run.evaluate()
    run._load(run.best_weights)
    trained = run.result()
    x, u = torch.rand(2, 3, 2).double(), torch.rand(2, 3, 1).double()
    h, w = torch.rand(2, 3, 4).double(), torch.zeros(2, 3, 0).double()
    with torch.no_grad():
        stacked = run.step(x, h, u, w)
        for i in range(2):
            alone = trained.step(Pendulum(), DT, i)(x[i], h[i], u[i], w[i])
            for one, other in zip(stacked, alone, strict=True):
                torch.testing.assert_close(one[i], other, rtol=1e-13, atol=1e-13)  # rounding of a step


def test_the_exported_model_carries_the_values_and_the_fitted_priors_balance(data, trained):
    prior = Pendulum()
    step = trained.step(prior, DT)
    programs, info = trace_model(step), model_info(prior, DT)
    parity = check_parity(step, programs, info, data[1], seed=0)
    assert parity.max_abs_error < 1e-12
    assert parity.jacobian_max_abs_error < 1e-12
    model = build_model("m", {f"m/{name}": p for name, p in programs.items()}, info)
    x, u = torch.tensor([0.4, 1.5]).double(), torch.tensor([0.2]).double()
    for made, zero in ((prior, True), (given(trained.prior_values()), False)):
        rate = rates(made, x, u)
        balance = float(model.balances[0].residual(x.numpy(), rate, u.numpy(), model.w, model.p))
        assert (abs(balance) < 1e-12) == zero  # W, rounding of terms of 1 W
    # with other parameters those that were trained are moved as far as the fitted ones
    more = {p.name: 1.1 * p.value for p in model.parameters}
    moved = {n: v + more[n] - prior.values[n] for n, v in trained.prior_values().items()}
    h = torch.rand(step.network.n_h).double()
    before = [rates(given(values), x, u) for values in (trained.prior_values(), moved)]
    after = [model.xdot(x.numpy(), h.numpy(), u.numpy(), model.w, p) for p in (model.p, list(more.values()))]
    np.testing.assert_allclose(
        (after[1] - after[0]).full().ravel(), before[1] - before[0], rtol=1e-9, atol=1e-9
    )
    # without the values the network alone would be another model
    bare = replace(trained, weights={n: w for n, w in trained.weights.items() if "prior." not in n})
    h, w = torch.zeros(step.network.n_h).double(), torch.zeros(0).double()
    assert abs(bare.step(prior, DT).xdot(x, h, u, w) - step.xdot(x, h, u, w)).max() > 1.0
    ours, theirs = (score(free_runs(s, prior, data[1], 10, h), prior) for s in (step, bare.step(prior, DT)))
    assert ours.e_sim < theirs.e_sim
