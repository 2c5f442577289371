"""Free runs by one graph equal those of the step, and so do their derivatives."""

import numpy as np
import pytest
import torch
from example_priors import TANKS, Arm, Tanks
from simulated_pendulum import DT, Pendulum

from hybrid_mpc import HybridStep, PriorStep, Scaling, n_features
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.step import Step, TrainedParameters

NETWORKS, RUNS, PERIODS = 2, 3, 9
CASES = {
    "pendulum": (Pendulum(), DT),
    "pendulum in sub-steps": (Pendulum(), 30 * DT),
    "tanks": (Tanks(TANKS), 2.0),
    "arm": (Arm(), 0.02),
}


def scaling(prior):
    rng = np.random.default_rng(5)
    n_x, n_u, n_w, n_c = (len(z) for z in (prior.states, prior.inputs, prior.disturbances, prior.corrected))

    def some(n):
        return tuple(rng.uniform(0.5, 2.0, n).tolist())

    return Scaling(some(n_x), some(n_u), some(n_c), tuple(0.1 * v for v in some(n_c)), some(n_w),
                   some(n_x), some(n_u), some(n_w))  # fmt: skip


def make(case, **options):
    """A hybrid of random weights, and a point that it runs from."""
    prior, dt = CASES[case]
    rng = np.random.default_rng(3)
    n_in = n_features(prior, options.get("use_prior", True))
    stack = StackedGRU(NETWORKS, n_in, 5, len(prior.corrected), seed=1)
    step = HybridStep(prior, stack, scaling(prior), dt, **options)
    sizes = len(prior.states), 5, len(prior.inputs), len(prior.disturbances)
    shapes = (NETWORKS, RUNS), (NETWORKS, RUNS), (PERIODS, NETWORKS, RUNS), (PERIODS, NETWORKS, RUNS)
    # levels of tanks stay positive; angles and speeds of the others are of order one
    point = (torch.tensor(rng.uniform(0.2, 0.8, (*s, n))) for s, n in zip(shapes, sizes, strict=True))
    return step, tuple(point)


def both(step, point, weights):
    """States and derivatives of a run, by the graph and by torch alone."""
    found = []
    for run in (type(step).free_run, Step.free_run):
        x, h, u, w = (z.clone() for z in point)
        x.requires_grad_(), h.requires_grad_()
        states = run(step, x, h, u, w)
        weight = torch.tensor(np.random.default_rng(4).standard_normal(states.shape))
        found.append([states, *torch.autograd.grad((states * weight).sum(), [x, h, *weights])])
    return zip(*found, strict=True)


def close(one, other):
    # the same equations in another order: rounding through nine periods
    scale = float(other.detach().abs().max())
    assert scale > 0
    torch.testing.assert_close(one, other, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("options", [{}, {"use_prior": False}], ids=["hybrid", "rnn"])
@pytest.mark.parametrize("case", CASES)
def test_a_free_run_and_its_derivatives_are_those_of_the_step(case, options):
    step, point = make(case, **options)
    for one, other in both(step, point, list(step.network.parameters())):
        close(one, other)


@pytest.mark.parametrize("case", ["pendulum", "tanks"])
def test_parameters_that_are_trained_along_are_in_the_derivative(case):
    prior = CASES[case][0]
    along = TrainedParameters(prior, NETWORKS)
    for i, way in enumerate(along.ways.values()):
        torch.nn.init.constant_(way, 0.01 * (i + 1))
    step, point = make(case, shift=along)
    for one, other in both(step, point, [*step.network.parameters(), *along.ways.values()]):
        close(one, other)


def test_one_network_with_its_own_parameters_runs_as_its_step():
    stacked, (x, h, u, w) = make("tanks")
    prior = stacked.prior
    shift = 0.05 * torch.tensor(prior.p)
    step = HybridStep(prior, stacked.network.member(1), scaling(prior), stacked.dt, shift=shift)
    own = step.free_run(x[1], h[1], u[:, 1], w[:, 1])
    close(own, Step.free_run(step, x[1], h[1], u[:, 1], w[:, 1]).detach())
    alone = step.free_run(x[1, 0], h[1, 0], u[:, 1, 0], w[:, 1, 0])  # no leading axes
    close(alone, own[:, 0])


def test_the_prior_runs_as_its_step():
    prior, dt = CASES["tanks"]
    _, (x, _, u, w) = make("tanks")
    step, none = PriorStep(prior, dt), torch.zeros(NETWORKS, RUNS, 0).double()
    close(step.free_run(x, none, u, w), Step.free_run(step, x, none, u, w))
