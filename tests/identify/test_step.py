import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, Pendulum, record

from hybrid_mpc import HybridStep, InputError, PriorStep, Scaling, n_features
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.step import required_substeps, rk4

UNIT = Scaling(x=(1.0, 1.0), u=(1.0,), acceleration=(1.0,), correction=(1.0,))


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


@pytest.mark.parametrize("use_prior", [False, True])
def test_features_are_as_many_as_a_form_says(use_prior):
    prior, x, u = Pendulum(), torch.tensor([0.5, -1.0]).double(), torch.tensor([0.25]).double()
    hybrid = HybridStep(prior, torch.nn.Identity(), UNIT, DT, use_prior=use_prior)
    assert (hybrid.features(x, u).numel(), prior.n_q) == HybridStep.sizes(prior, use_prior)
