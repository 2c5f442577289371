import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from example_priors import Arm, Tanks
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_pendulum import DT, Pendulum, record

from hybrid_mpc import HybridStep, Prior, Scaling, Signal, n_features
from hybrid_mpc.identify.dataset import cut_windows
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.objectives import (
    Prediction,
    VectorPerformanceIndex,
    balance_objective,
    error_objective,
    free_run,
    objectives_of,
    output_objective,
    teacher_forced,
)

EVERY = objectives_of(Pendulum(), ("error", "output", "balances"))

losses = st.lists(st.lists(st.floats(1e-6, 1e6), min_size=2, max_size=2), min_size=1, max_size=8)


def hybrid(windows, networks=3):
    prior = Pendulum()
    scaling = HybridStep.scaling_of(prior, windows, DT, use_prior=True)
    return HybridStep(prior, StackedGRU(networks, n_features(prior, True), 4, 1, seed=0), scaling, DT)


def test_a_free_run_of_one_period_is_teacher_forcing():
    windows = cut_windows([record(0)], warm=5, horizon=1, stride=7)
    step = hybrid(windows)
    with torch.no_grad():
        free, forced = free_run(step, windows), teacher_forced(step, windows)
        for name in ("x_hat", "xdot", "xdot_hat"):
            a, b = torch.broadcast_tensors(getattr(free, name), getattr(forced, name))
            # rounding of states of order one divided by dt = 0.02
            torch.testing.assert_close(a, b, rtol=0, atol=1e-12)
        for objective in EVERY.values():
            one, two = objective(step, free), objective(step, forced)
            assert one.shape == two.shape == (3,)
            torch.testing.assert_close(one, two, rtol=1e-12, atol=0)


def test_objectives_of_a_known_error():
    windows = cut_windows([record(0)], warm=5, horizon=3, stride=7)
    step = hybrid(windows, networks=1)
    with torch.no_grad():
        p = teacher_forced(step, windows)
        wrong = replace(p, x_hat=p.x, xdot_hat=p.xdot + torch.tensor([0.0, 2.0]))
        # mean of (0, 2) over the rates' spreads, and mean |J v 2|: the energy objective is a speed-weighted error here
        spread = float(((windows.x[:, 1:, 1] - windows.x[:, :-1, 1]) / DT).std(correction=0))
        np.testing.assert_allclose(error_objective(step, wrong), 0.5 * 2.0 / spread, rtol=1e-12)
        speed = float(p.x[..., 1].abs().mean())
        energy = balance_objective("energy")(step, wrong)
        np.testing.assert_allclose(energy, 0.15 * 2.0 * speed, rtol=1e-12)


@settings(max_examples=100, deadline=None)
@given(losses)
def test_bounds_never_rise_and_no_objective_is_traded(sequence):
    index = VectorPerformanceIndex(torch.ones(1, 2).double())
    for values in sequence:
        now = torch.tensor([values], dtype=torch.float64)
        lowered = index.lower(now)
        assert (lowered.bounds <= index.bounds).all()
        if (now > index.bounds).any():
            assert torch.equal(lowered.bounds, index.bounds)
        else:
            assert torch.equal(lowered.bounds, now)
        index = lowered


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(1e-3, 1e3), min_size=2, max_size=2))
def test_the_index_is_within_log_2_by_rho_of_the_maximum(values):
    index = VectorPerformanceIndex(torch.tensor([[2.0, 0.5]]).double())
    ratio = max(values[0] / 2.0, values[1] / 0.5)
    excess = float(index.value(torch.tensor([values], dtype=torch.float64))) - ratio
    assert -1e-9 * ratio <= excess <= math.log(2) / 10 + 1e-9 * ratio


def test_a_loss_that_is_no_number_lowers_no_bound():
    index = VectorPerformanceIndex(torch.ones(2, 2).double())
    lowered = index.lower(torch.tensor([[math.nan, 0.5], [0.5, 0.5]]).double())
    assert lowered.bounds.tolist() == [[1.0, 1.0], [0.5, 0.5]]


def test_predictions_stay_on_their_device():
    """``meta`` computes nothing, but refuses a tensor made elsewhere."""
    windows = cut_windows([record(0)], warm=5, horizon=3, stride=7)
    there, step = windows.to(torch.device("meta")), hybrid(windows).to("meta")
    for predict in (teacher_forced, free_run):
        for objective in EVERY.values():
            assert objective(step, predict(step, there)).device.type == "meta"


class Observed(Prior):
    """Two outputs of any size: the product of both states, and the first with what is put in and comes along."""

    states, inputs, disturbances = Tanks.states, Tanks.inputs, Tanks.disturbances
    outputs = (Signal("product", "m^2"), Signal("sum", "m"))

    def xdot(self, x, u, w, p):
        return -x.upper, -x.lower

    def output(self, x, u, w, p):
        return x.upper * x.lower, 1e6 * (x.upper + u.inflow + w.rain)


def step_of(prior, networks=1):
    n_x, n_u, n_w, n_c = len(prior.states), len(prior.inputs), len(prior.disturbances), len(prior.corrected)
    scaling = Scaling((1.0,) * n_x, (1.0,) * n_u, (1.0,) * n_c, (1.0,) * n_c, (1.0,) * n_w)
    return HybridStep(prior, StackedGRU(networks, n_features(prior, True), 4, n_c, seed=0), scaling, 0.1)


def random_prediction(prior, networks=2, seed=0):
    """Of 5 periods and 3 windows."""
    rng = np.random.default_rng(seed)

    def draw(size, networks):
        return torch.tensor(rng.uniform(0.1, 1.0, (5, networks, 3, size)))

    n_x, n_u, n_w = len(prior.states), len(prior.inputs), len(prior.disturbances)
    shapes = ((n_x, 1), (n_x, networks), (n_u, 1), (n_w, 1), (n_x, 1), (n_x, networks))
    return Prediction(*(draw(*shape) for shape in shapes))


def test_the_output_objective_is_the_rms_error_a_period_later_over_the_spreads():
    step = step_of(Observed())
    p = random_prediction(step.prior)
    got = output_objective(step, p)

    def outputs(x, rate, u, w):
        a, b = (x + 0.1 * rate).numpy()[..., 0], (x + 0.1 * rate).numpy()[..., 1]
        return np.stack([a * b, 1e6 * (a + u.numpy()[..., 0] + w.numpy()[..., 0])], axis=-1)

    y, y_hat = outputs(p.x, p.xdot, p.u, p.w), outputs(p.x_hat, p.xdot_hat, p.u, p.w)
    spread = y.reshape(-1, 2).std(0)
    expected = np.sqrt((((y_hat - y) / spread) ** 2).sum(-1).mean((0, 2)))
    assert got.shape == (2,)
    np.testing.assert_allclose(got, expected, rtol=1e-12)  # units of one output a million times the other's
    same = replace(p, x_hat=p.x.expand_as(p.x_hat), xdot_hat=p.xdot.expand_as(p.xdot_hat))
    np.testing.assert_allclose(output_objective(step, same), 1e-12, rtol=1e-9)  # the floor under the root


@pytest.mark.parametrize("prior", [Tanks, Arm])
def test_a_balances_objective_is_the_difference_of_its_residuals(prior):
    step = step_of(prior())
    p = random_prediction(step.prior)
    (balance,) = step.prior.equations.balances
    got = objectives_of(step.prior, ("error", balance.name))[balance.name](step, p)

    def residual(x, rate, k, i, n):
        at = (x[k, i, n], rate[k, i, n], p.u[k, 0, n], p.w[k, 0, n])
        return float(balance.residual(*(v.numpy() for v in at), step.prior.p))

    for i in range(2):
        differences = [
            residual(p.x_hat, p.xdot_hat, k, i, n) - residual(p.x, p.xdot, k, 0, n)
            for k in range(5)
            for n in range(3)
        ]
        assert float(got[i]) == pytest.approx(np.mean(np.abs(differences)), rel=1e-12)


def test_balances_stands_for_all_of_the_prior():
    class Two(Tanks):
        def balances(self, x, u, w, p):
            (volume,) = super().balances(x, u, w, p)
            return volume, replace(volume, name="mass", unit="kg", rate_unit="kg/s")

    assert list(objectives_of(Two(), ("error", "balances"))) == ["error", "volume", "mass"]
    assert list(objectives_of(Two(), ("mass", "output"))) == ["mass", "output"]
    assert list(objectives_of(Observed(), ("error", "balances"))) == ["error"]  # it has none
