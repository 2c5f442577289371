import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from example_priors import TANKS, Arm, Tanks
from simulated_pendulum import DT, Pendulum

from hybrid_mpc import HybridStep, PriorStep, Scaling, n_features
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.step import PriorEquations, rk4, shift_to

UNIT = Scaling(x=(1.0, 1.0), u=(1.0,), rate=(1.0,), correction=(1.0,))
NONE = torch.zeros(0).double()


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_rk4_is_of_order_four():
    prior, x0, u = Pendulum(), tensor(2.0, 1.0), tensor(0.3)
    rates, p = PriorEquations(prior).xdot, torch.tensor(prior.p)

    def end(substeps):
        return rk4(lambda x: rates(x, u, NONE, p), x0, 1.0, substeps)

    exact = end(2000)
    errors = [float((end(n) - exact).norm()) for n in (20, 40, 80)]
    orders = [math.log2(a / b) for a, b in pairwise(errors)]
    assert orders == pytest.approx([4.0, 4.0], abs=0.3)  # the next term of the error is of order 5


def test_disturbances_act_and_parameters_may_be_others():
    step, x, u, w = PriorStep(Tanks(), 2.0), tensor(0.5, 0.3), tensor(0.2), tensor(0.1)
    rates = Tanks(TANKS).equations.xdot(x.numpy(), u.numpy(), w.numpy(), Tanks(TANKS).p).full().ravel()
    p = torch.tensor(Tanks(TANKS).p)
    np.testing.assert_allclose(step.xdot(x, NONE, u, w, p), rates, rtol=1e-14)
    own, other = step(x, NONE, u, w)[0], PriorStep(Tanks(TANKS), 2.0)(x, NONE, u, w)[0]
    assert torch.equal(step(x, NONE, u, w, p)[0], other)
    assert (own - other).abs().min() > 1e-3
    dry, _ = step(x, NONE, u, torch.zeros_like(w))
    # the rain of 0.1 m^3/s over 2 s on 1.5 m^2, less what drains of it meanwhile: less than a fifth
    assert 0.8 < float(own[1] - dry[1]) / (0.1 * 2.0 / 1.5) < 1.0


def test_a_hybrid_with_a_zero_head_is_its_prior():
    prior = Pendulum()
    network = StackedGRU(2, n_features(prior, True), 4, 1, seed=0, zero_head=True)
    x, u, w = tensor(0.5, -1.0)[None], tensor(0.2)[None], torch.zeros(1, 0).double()
    step = HybridStep(prior, network, UNIT, DT)
    hybrid, _ = step(x.expand(2, 1, 2), network.initial(1), u.expand(2, 1, 1), w.expand(2, 1, 0))
    own, _ = PriorStep(prior, DT)(x, x.new_zeros(0), u, w)
    assert torch.equal(hybrid[0], own)
    assert torch.equal(hybrid[1], own)


def test_a_correction_acts_as_acceleration_and_kinematics_stay_exact():
    prior = Pendulum()
    step = HybridStep(prior, StackedGRU(1, 5, 4, 1, seed=0), UNIT, DT)
    x, u = tensor(0.5, -1.0), tensor(0.2)
    xdot = step.derivative(x, u, NONE, tensor(3.0))
    own = PriorStep(prior, DT).xdot(x, NONE, u, NONE)
    torch.testing.assert_close(xdot, own + tensor(0.0, 3.0), rtol=0, atol=1e-14)


class Elbow(Arm):
    corrects = ("v_2",)


class Ends(Arm):
    """Rows that are not next to each other."""

    corrects = ("q_1", "v_2")


@pytest.mark.parametrize(
    ("prior", "rows"),
    [(Pendulum, [1]), (Tanks, [0, 1]), (Arm, [2, 3]), (Elbow, [3]), (Ends, [0, 3])],
    ids=lambda p: str(p),
)
@pytest.mark.parametrize("use_prior", [True, False])
def test_corrections_go_to_the_states_that_the_prior_names(prior, rows, use_prior):
    made, rng = prior(), np.random.default_rng(0)
    n_x, n_u, n_w, n_c = len(made.states), len(made.inputs), len(made.disturbances), len(rows)
    scaling = Scaling((1.0,) * n_x, (1.0,) * n_u, (1.0,) * n_c, (1.0,) * n_c, (1.0,) * n_w)
    step = HybridStep(made, torch.nn.Identity(), scaling, 0.05, use_prior=use_prior)
    x, u, w, d = (torch.tensor(rng.uniform(0.2, 1.0, (5, n))) for n in (n_x, n_u, n_w, n_c))
    assert (step.features(x, u, w).shape[-1], n_c) == HybridStep.sizes(made, use_prior)
    own = PriorStep(made, 0.05).xdot(x, NONE, u, w)
    found = step.derivative(x, u, w, d)
    expected = own.clone()
    # a plain network gives the whole of its rows
    expected[:, rows] = d + (own[:, rows] if use_prior else 0.0)
    torch.testing.assert_close(found, expected, rtol=1e-14, atol=1e-14)
    after = step.integrate(x, u, w, d)
    exact = rk4(lambda z: step.derivative(z, u, w, d), x, 0.05, step.substeps)
    torch.testing.assert_close(after, exact, rtol=1e-14, atol=1e-14)
    rate = step.rate(x, u, w, d)
    torch.testing.assert_close(rate, (after - x) / 0.05, rtol=1e-12, atol=1e-12)


def test_features_know_the_disturbances_by_their_spread():
    scaling = Scaling((1.0, 1.0), (1.0,), (1.0, 1.0), (1.0, 1.0), (0.5,), centre_w=(0.1,))
    step = HybridStep(Tanks(), torch.nn.Identity(), scaling, 1.0)
    features = step.features(tensor(0.5, 0.3), tensor(0.2), tensor(0.35))
    # x, u, w, rates
    np.testing.assert_allclose(features[:4], [0.5, 0.3, 0.2, (0.35 - 0.1) / 0.5], rtol=1e-14)
    own = PriorStep(Tanks(), 1.0).xdot(tensor(0.5, 0.3), NONE, tensor(0.2), tensor(0.35))
    np.testing.assert_allclose(features[4:], own, rtol=1e-14)


def test_another_prior_is_one_with_a_shift():
    shift = shift_to(Tanks(), {"k_1": 0.25})
    np.testing.assert_allclose(shift, [0.0, 0.0, 0.1, 0.0], atol=1e-15)
