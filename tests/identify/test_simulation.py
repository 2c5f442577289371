"""Free runs of all windows in one call: against torch and finite differences, and where a machine rests."""

import numpy as np
import pytest
import torch
from example_priors import TANKS, Arm, Swing, Tanks, TorchArm, TorchSwing, TorchTanks
from scipy.optimize._numdiff import approx_derivative
from simulated_pendulum import Pendulum
from torch.func import jacfwd

from hybrid_mpc import InputError, OperatingPoint, Prior, Signal
from hybrid_mpc.identify.simulation import (
    MAX_SUBSTEPS,
    Simulation,
    required_substeps,
    rest_of,
    substeps_for,
    with_unknown_rates,
)
from hybrid_mpc.identify.step import PriorEquations, rk4

SUBSTEPS, PERIODS, RUNS = 3, 20, 4
PERIOD = {
    Swing: 0.02,
    TorchSwing: 0.02,
    Arm: 0.02,
    TorchArm: 0.02,
    Tanks: 0.5,
    TorchTanks: 0.5,
    Pendulum: 0.02,
}
EVERY = [Swing, TorchSwing, Arm, TorchArm, Tanks, TorchTanks]


def given(prior, seed=0):
    """First states, inputs, disturbances of some runs, and parameters; tanks that never run dry."""
    rng = np.random.default_rng(seed)
    n_x, n_u, n_w = len(prior.states), len(prior.inputs), len(prior.disturbances)
    x0, u, w = (
        rng.uniform(0.5, 1.0, shape)
        for shape in ((RUNS, n_x), (RUNS, PERIODS + 1, n_u), (RUNS, PERIODS + 1, n_w))
    )
    return x0, u, w, prior.p * rng.uniform(0.9, 1.1, len(prior.p))


def torch_run(prior, x0, u, w, p, extra=0.0):
    """One run ``(PERIODS + 1, n_x)`` by the equations on tensors."""
    rates, states = PriorEquations(prior).xdot, [x0]
    for u_k, w_k in zip(u[:-1], w[:-1], strict=True):
        f = lambda x, held=(u_k, w_k): rates(x, *held, p) + extra  # noqa: E731
        states.append(rk4(f, states[-1], PERIOD[type(prior)], SUBSTEPS))
    return torch.stack(states)


@pytest.mark.parametrize("kind", EVERY)
def test_values_and_derivatives_are_those_of_torch(kind):
    prior = kind()
    x0, u, w, p = given(prior)
    free = list(range(len(p)))[::-1]  # in an order of its own
    simulation = Simulation(prior.equations.xdot, PERIOD[kind], free)
    x, slopes = simulation.by_all(x0, u, w, p, SUBSTEPS)
    by_p, by_x = slopes[..., : len(free)], slopes[..., len(free) :]
    for i in range(RUNS):
        a, u_i, w_i, q = (torch.tensor(v) for v in (x0[i], u[i], w[i], p))
        # rounding of some hundred operations on numbers of order one
        np.testing.assert_allclose(x[i], torch_run(prior, a, u_i, w_i, q), rtol=0, atol=1e-12)

        def run(a, q, u_i=u_i, w_i=w_i):
            return torch_run(prior, a, u_i, w_i, q)

        want = jacfwd(run, argnums=(0, 1))(a, q)
        np.testing.assert_allclose(by_x[i], want[0], rtol=0, atol=1e-11)
        np.testing.assert_allclose(by_p[i], want[1][..., free], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(simulation.values(x0, u, w, p, SUBSTEPS), x)
    for one, other in zip(simulation.by_parameters(x0, u, w, p, SUBSTEPS), (x, by_p), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("kind", [Arm, Tanks])
def test_derivatives_are_those_of_finite_differences(kind):
    prior = kind()
    x0, u, w, p = given(prior, seed=1)
    simulation = Simulation(prior.equations.xdot, PERIOD[kind], [1, 0])
    _, slopes = simulation.by_all(x0, u, w, p, SUBSTEPS)

    def end(z):
        q = p.copy()
        q[[1, 0]] = z[:2]
        return simulation.values(z[None, 2:], u[:1], w[:1], q, SUBSTEPS)[0, -1]

    numeric = approx_derivative(end, np.concatenate([p[[1, 0]], x0[0]]), method="3-point")
    # three-point differences: rounding^(2/3) of states of the order of one
    np.testing.assert_allclose(numeric, slopes[0, -1], rtol=0, atol=1e-8)


def test_a_disturbance_acts_in_its_own_period():
    prior = Tanks(TANKS)
    x0, u, w, _ = given(prior)
    simulation = Simulation(prior.equations.xdot, 0.5)
    dry = w.copy()
    dry[:, 7] = 0.0
    one, two = (simulation.values(x0, u, v, prior.p, SUBSTEPS) for v in (w, dry))
    np.testing.assert_array_equal(one[:, :8], two[:, :8])
    assert (one[:, 8:, 1] > two[:, 8:, 1]).all()
    np.testing.assert_array_equal(one[..., 0], two[..., 0])  # it rains into the lower tank


def test_parameters_may_be_those_of_each_run():
    prior = Pendulum()
    x0, u, w, p = given(prior)
    simulation, rows = Simulation(prior.equations.xdot, 0.02), p * np.linspace(0.8, 1.2, RUNS)[:, None]
    together = simulation.values(x0, u, w, rows, SUBSTEPS)
    alone = [
        simulation.values(*(v[i : i + 1] for v in (x0, u, w)), rows[i], SUBSTEPS)[0] for i in range(RUNS)
    ]
    np.testing.assert_array_equal(together, alone)


@pytest.mark.parametrize(("kind", "rows"), [(Arm, (2, 3)), (Arm, (3,)), (Tanks, (0,)), (TorchTanks, (0, 1))])
def test_unknown_rates_act_on_the_states_that_are_corrected_and_stay(kind, rows):
    prior = kind()
    x0, u, w, p = given(prior)
    d = np.random.default_rng(1).normal(size=(RUNS, len(rows))) * 0.05
    extended = Simulation(with_unknown_rates(prior.equations.xdot, rows), PERIOD[kind])
    z, n_x = extended.values(np.hstack([x0, d]), u, w, p, SUBSTEPS), x0.shape[1]
    for i in range(RUNS):
        extra = torch.zeros(n_x).double()
        extra[list(rows)] = torch.tensor(d[i])
        want = torch_run(prior, *(torch.tensor(v) for v in (x0[i], u[i], w[i], p)), extra)
        np.testing.assert_allclose(z[i, :, :n_x], want, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(z[i, :, n_x:], np.tile(d[i], (PERIODS + 1, 1)))


def test_rest_is_the_operating_point_or_the_middle_of_the_ranges():
    class Resting(Tanks):
        operating_point = OperatingPoint(x=(0.5, 0.3), u=(0.1,), w=(0.05,))

    class Dry(Tanks):
        operating_point = OperatingPoint(x=(0.5, 0.3), u=(0.1,))

    class Positive(Tanks):
        states = (Signal("upper", "m", 0.2), Signal("lower", "m", upper=-0.1))

    def rest(kind):
        return [v.tolist() for v in rest_of(kind())]

    assert rest(Resting) == [[0.5, 0.3], [0.1], [0.05]]
    assert rest(Dry) == [[0.5, 0.3], [0.1], [0.1]]  # of the disturbance the middle
    assert rest(Tanks) == [[1.0, 1.0], [0.2], [0.1]]
    assert rest(Positive)[0] == [0.2, -0.1]  # without a middle what is nearest to zero
    assert rest(Pendulum) == [[0.0, 0.0], [0.0], []]


class Decay(Prior):
    states, inputs, outputs = (Signal("a", "-"),), (Signal("u", "-"),), (Signal("a", "-"),)
    rate = 1.0

    def xdot(self, x, u, w, p):
        return (-self.rate * x.a,)


@pytest.mark.parametrize(
    ("rate", "dt", "needed"), [(1.0, 0.5, 1), (1.0, 2.5, 3), (1e3, 0.02, 20), (1e-9, 1e6, 1)]
)
def test_sub_steps_follow_the_fastest_eigenvalue(rate, dt, needed):
    prior = Decay()
    prior.rate = rate
    assert required_substeps(prior, dt) == needed


def test_what_is_too_stiff_is_refused_with_its_name():
    prior = Decay()
    prior.rate = 1e3
    with pytest.raises(InputError, match=r"Decay: the prior.*smaller dt"):
        required_substeps(prior, 1.01 * MAX_SUBSTEPS / 1e3)
    prior.rate = float("nan")
    with pytest.raises(InputError, match="the thing"):
        substeps_for(prior.equations.xdot, [0.0], [0.0], [], [], 0.1, "the thing")
