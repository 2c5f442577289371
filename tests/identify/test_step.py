import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, Pendulum, record

from hybrid_mpc import HybridStep, InputError, PriorStep, Scaling, load_scenario, n_features
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.step import LiteralStep, required_substeps, rk4
from hybrid_mpc.scenario import registered_scenarios

UNIT = Scaling(x=(1.0, 1.0), u=(1.0,), acceleration=(1.0,), correction=(1.0,))


@pytest.mark.parametrize("name", sorted(registered_scenarios()))
def test_energy_balance_of_every_prior_is_zero_along_its_own_flow(name):
    prior = load_scenario(name).prior()
    rng = np.random.default_rng(0)
    x = torch.tensor(rng.uniform(-3, 3, (200, len(prior.states))))
    u = torch.tensor(rng.uniform(-1, 1, (200, len(prior.inputs))))
    # rounding of a sum of a few terms of at most some 10 W
    np.testing.assert_allclose(prior.energy_balance(x, prior(x, u), u), 0.0, atol=1e-12)
    push = torch.cat([torch.zeros(prior.n_q), torch.ones(prior.n_q)])
    moved = prior.energy_balance(x, prior(x, u) + push, u)
    assert (moved.abs() > 1e-6).double().mean() > 0.95  # an unexplained acceleration has power


def test_rk4_is_of_order_four():
    prior, x0, u = Pendulum(), torch.tensor([2.0, 1.0]).double(), torch.tensor([0.3]).double()

    def end(substeps):
        return rk4(lambda x: prior(x, u), x0, 1.0, substeps)

    exact = end(2000)
    errors = [float((end(n) - exact).norm()) for n in (20, 40, 80)]
    orders = [math.log2(a / b) for a, b in pairwise(errors)]
    assert orders == pytest.approx([4.0, 4.0], abs=0.3)  # the next term of the error is of order 5


def test_prior_step_follows_the_true_pendulum():
    run = record(0, seconds=2.0)
    step = PriorStep(Pendulum({"J": 0.1, "mgl": 1.2, "d": 0.05}), DT)
    x, h = torch.tensor(run.x[0]), torch.zeros(0).double()
    for k in range(len(run.t) - 1):
        x, h = step(x, h, torch.tensor(run.u[k]))
    # RK4 at 20 ms on a 3.5 rad/s oscillation: (0.07)^5 / 120 a step, 100 steps
    np.testing.assert_allclose(x, run.x[-1], atol=2e-6)


def test_a_hybrid_with_a_zero_head_is_its_prior():
    prior = Pendulum()
    network = StackedGRU(2, n_features(prior, True), 4, 1, seed=0, zero_head=True)
    x, u = torch.tensor([[0.5, -1.0]]).double(), torch.tensor([[0.2]]).double()
    hybrid, _ = HybridStep(prior, network, UNIT, DT)(x.expand(2, 1, 2), network.initial(1), u.expand(2, 1, 1))
    own, _ = PriorStep(prior, DT)(x, x.new_zeros(0), u)
    assert torch.equal(hybrid[0], own)
    assert torch.equal(hybrid[1], own)


def test_a_correction_acts_as_acceleration_and_kinematics_stay_exact():
    prior = Pendulum()
    step = HybridStep(prior, StackedGRU(1, 5, 4, 1, seed=0), UNIT, DT)
    x, u = torch.tensor([0.5, -1.0]).double(), torch.tensor([0.2]).double()
    xdot = step.derivative(x, u, torch.tensor([3.0]).double())
    torch.testing.assert_close(xdot, prior(x, u) + torch.tensor([0.0, 3.0]).double(), rtol=0, atol=1e-14)


def test_a_prior_too_stiff_for_its_period_is_refused():
    stiff = Pendulum({"J": 0.02, "d": 0.5})
    assert required_substeps(stiff, 0.1) >= 3  # the rate d / J = 25 1/s asks for ceil(2.5) or more
    with pytest.raises(InputError, match="smaller dt"):
        required_substeps(stiff, 10.0)


class Copier(torch.nn.Module):
    """A network that hands on some of its features."""

    def __init__(self, keep):
        super().__init__()
        self.keep = keep

    def forward(self, s, h):
        return s[..., self.keep], h


LITERAL = Scaling(x=(2.0, 3.0), u=(0.5,), acceleration=(4.0, 5.0), correction=(4.0, 5.0))
X, U = torch.tensor([0.5, -1.0]).double(), torch.tensor([0.25]).double()
H = torch.zeros(0).double()


def test_the_literal_step_is_explicit_euler_of_what_the_network_says():
    prior = Pendulum()
    step = LiteralStep(prior, Copier(slice(3, 5)), LITERAL, DT)  # the prior's xdot, which is a feature
    torch.testing.assert_close(step.xdot(X, H, U), prior(X, U), rtol=1e-15, atol=0)
    torch.testing.assert_close(step(X, H, U)[0], X + DT * prior(X, U), rtol=1e-15, atol=0)
    free = LiteralStep(
        prior, Copier(slice(1, 3)), LITERAL, DT, use_prior=False
    )  # [v, u]: no exact kinematics
    torch.testing.assert_close(
        free.xdot(X, H, U), torch.tensor([-4.0 / 3.0, 2.5], dtype=torch.float64), rtol=1e-15, atol=0
    )


@pytest.mark.parametrize("use_prior", [False, True])
def test_features_of_both_forms_are_as_many_as_they_say(use_prior):
    prior = Pendulum()
    hybrid = HybridStep(prior, Copier(slice(0, 1)), UNIT, DT, use_prior=use_prior)
    literal = LiteralStep(prior, Copier(slice(0, 2)), LITERAL, DT, use_prior=use_prior)
    assert hybrid.features(X, U).shape == (n_features(prior, use_prior),)
    assert literal.features(X, U).shape == (n_features(prior, use_prior, literal=True),)


def test_literal_euler_feeds_energy_into_a_pendulum_and_the_hybrid_step_does_not():
    """The reason for the hybrid step: the same network, the paper's integrator and ours."""
    prior = Pendulum({"J": 0.1, "mgl": 1.2, "d": 0.0})
    literal = LiteralStep(prior, Copier(slice(3, 5)), LITERAL, DT)
    exact = PriorStep(prior, DT)
    energies = []
    for step in (literal, exact):
        x = torch.tensor([0.5, 0.0]).double()
        for _ in range(250):
            x, _ = step(x, H, torch.zeros(1).double())
        energies.append(float(0.05 * x[1] ** 2 + 1.2 * (1.0 - x[0].cos())))
    start = 1.2 * (1.0 - math.cos(0.5))
    assert energies[1] == pytest.approx(start, rel=1e-4)  # order 4 at 0.07 rad a step
    # each step of Euler multiplies the energy by 1 + (w dt)^2 = 1.0048: 3.3 in 250, less at large angles
    assert 2.0 < energies[0] / start < 4.0
