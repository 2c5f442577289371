"""Free runs of all windows in one call, against torch: values, derivatives, and whose equations they are."""

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, Pendulum
from torch.func import functional_call, jacfwd

from hybrid_mpc import Parameter, Prior, Signal
from hybrid_mpc.identify.simulation import Simulation, traced, with_acceleration
from hybrid_mpc.identify.step import rk4

SUBSTEPS, PERIODS, RUNS = 3, 20, 4


class Arms(Prior):
    """Two coupled axes and a gain that no parameter is."""

    states = tuple(
        Signal(name, unit)
        for name, unit in zip(("q1", "q2", "v1", "v2"), 2 * ["rad"] + 2 * ["rad/s"], strict=True)
    )
    inputs = (Signal("tau1", "N m"), Signal("tau2", "N m"))
    outputs = states[:2]
    parameters_spec = (Parameter("k", 2.0, "N m", 0.1, 9.0), Parameter("d", 0.3, "N m s", 0.0, 2.0))
    gain = 1.0

    def acceleration(self, x, u):
        q, v = x[..., :2], x[..., 2:]
        apart = q[..., :1] - q[..., 1:]
        spring = self.k * torch.sin(torch.cat([apart, -apart], -1))
        return float(self.gain) * u - spring - self.d * torch.tanh(v)

    def inertia(self, x):
        return 1.0


def with_gain(gain):
    prior = Arms()
    prior.gain = gain
    return prior


def given(prior, seed=0):
    rng = np.random.default_rng(seed)
    x0, u = rng.normal(size=(RUNS, len(prior.states))), rng.normal(size=(RUNS, PERIODS, len(prior.inputs)))
    return x0, u, np.array(list(prior.values.values()))


def torch_run(prior, x0, u, p, extra=0.0):
    names, states = list(prior.values), [x0]
    values = dict(zip(names, p, strict=True))
    for held in u:
        f = lambda x, held=held: functional_call(prior, values, (x, held)) + extra  # noqa: E731
        states.append(rk4(f, states[-1], DT, SUBSTEPS))
    return torch.stack(states)


@pytest.mark.parametrize(
    "prior", [Pendulum(), Arms(), with_gain(1.7)], ids=["one axis", "two", "another gain"]
)
def test_values_and_derivatives_are_those_of_torch(prior):
    x0, u, p = given(prior)
    free = list(range(len(p)))[::-1]  # in an order of its own
    x, by_p, by_x = Simulation(traced(prior), DT, free).by_all(x0, u, p, SUBSTEPS)
    for i in range(RUNS):
        a, held, q = (torch.tensor(v) for v in (x0[i], u[i], p))
        # rounding of some hundred operations on numbers of order one
        np.testing.assert_allclose(x[i], torch_run(prior, a, held, q), rtol=0, atol=1e-12)
        slopes = jacfwd(lambda a, q, held=held: torch_run(prior, a, held, q), argnums=(0, 1))(a, q)
        np.testing.assert_allclose(by_x[i], slopes[0], rtol=0, atol=1e-11)
        np.testing.assert_allclose(by_p[i], slopes[1][..., free], rtol=0, atol=1e-11)


def test_parameters_may_be_those_of_each_run():
    prior = Pendulum()
    x0, u, p = given(prior)
    simulation, rows = Simulation(traced(prior), DT), p * np.linspace(0.8, 1.2, RUNS)[:, None]
    together = simulation.states(x0, u, rows, SUBSTEPS)
    alone = [simulation.states(x0[i : i + 1], u[i : i + 1], rows[i], SUBSTEPS)[0] for i in range(RUNS)]
    np.testing.assert_array_equal(together, alone)


def test_the_unknown_acceleration_acts_on_the_speeds_and_stays():
    prior = Arms()
    x0, u, p = given(prior)
    d = np.random.default_rng(1).normal(size=(RUNS, 2))
    z = with_acceleration(prior, DT).states(np.hstack([x0, d]), u, p, SUBSTEPS)
    for i in range(RUNS):
        extra = torch.tensor(np.concatenate([[0.0, 0.0], d[i]]))
        want = torch_run(prior, *(torch.tensor(v) for v in (x0[i], u[i], p)), extra)
        np.testing.assert_allclose(z[i, :, :4], want, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(z[i, :, 4:], np.tile(d[i], (PERIODS + 1, 1)))


def test_equations_are_traced_once_for_one_class_and_anew_for_another_attribute():
    assert traced(Pendulum()) is traced(Pendulum({"J": 0.2}))
    assert traced(Arms()) is not traced(with_gain(1.7))
    shared = with_gain(np.float32(1))  # no number: nobody knows whether another's is the same
    assert traced(shared) is traced(shared)
    assert traced(shared) is not traced(with_gain(np.float32(1)))
