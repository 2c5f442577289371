"""Inputs that act late: lag as a state, delay as a queue; against exact solutions and other integrators."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from energy_checks import check_energy_balance, random_values
from scipy.integrate import solve_ivp
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import (
    Coulomb,
    InputError,
    Parameter,
    Prior,
    PriorStep,
    Signal,
    fit_prior,
    with_friction,
    with_input_lag,
)
from hybrid_mpc.identify.delay import DelayedPriorStep, DelayedStep, delayed, lagged
from hybrid_mpc.identify.step import rk4
from scenarios.golf_robot.prior import GolfRobotPrior
from scenarios.pendulum.prior import PendulumPrior

LAG = Parameter("T_u", 0.03, "s", 0.005, 0.2)
NONE = torch.zeros(0, dtype=torch.float64)


class Lumped(Pendulum):
    """Its balance is made by the base class."""

    energy_balance = Prior.energy_balance

    def inertia(self, x):
        return self.J


COULOMB = Coulomb(Parameter("F", 0.1, "N m", 0.0, 1.0), Parameter("gamma_2", 20.0, "s/rad", 1.0, 50.0))


@pytest.mark.parametrize(
    "made",
    [
        with_input_lag(PendulumPrior, LAG),
        with_input_lag(GolfRobotPrior, LAG),
        with_input_lag(Lumped, LAG),
        with_input_lag(with_friction(PendulumPrior, COULOMB), LAG),
        with_input_lag(with_friction(Lumped, COULOMB), LAG),
        with_friction(with_input_lag(PendulumPrior, LAG), COULOMB),
        with_friction(with_input_lag(Lumped, LAG), COULOMB),
    ],
    ids=lambda made: made.__name__ + "/" + made.__mro__[2].__name__,
)
def test_energy_balance_is_zero_along_the_flow(made):
    check_energy_balance(made())
    check_energy_balance(made(random_values(made, np.random.default_rng(0))), 1)
    assert made().n_q == 1
    assert len(made().states) == 3


def test_the_lag_is_a_first_order_one():
    prior = with_input_lag(PendulumPrior, LAG)()
    x, u = torch.tensor([[0.3, -0.5, 2.0], [0.1, 0.4, -1.0]]).double(), torch.tensor([[5.0], [0.0]]).double()
    xdot = prior(x, u)
    acting = PendulumPrior()(x[:, :2], x[:, 2:])
    assert torch.equal(xdot[:, :2], acting)  # the machine feels z, not u
    np.testing.assert_allclose(xdot[:, 2], [(5.0 - 2.0) / 0.03, 1.0 / 0.03], rtol=1e-14)
    # a step of the input: z = 1 - exp(-t / T)
    step, state = PriorStep(prior, 0.005), torch.zeros(3, dtype=torch.float64)
    for k in range(1, 21):
        state, _ = step(state, NONE, torch.ones(1, dtype=torch.float64))
        # Runge-Kutta of order 4 at h / T = 1 / 6: (1 / 6)^5 / 120 a step
        assert float(state[2]) == pytest.approx(1 - np.exp(-0.005 * k / 0.03), abs=1.1e-6 * k)


def test_lagging_inputs_of_a_recording_are_the_prior_s_own():
    run = record(0, seconds=2.0)
    states = lagged(run, 0.05)
    assert states.x.shape == (len(run.t), 3)
    prior = with_input_lag(Pendulum, Parameter("T_u", 0.05, "s", 0.01, 0.2))()
    step = PriorStep(prior, DT, substeps=8)
    for k in (0, 19, 60):
        after, _ = step(torch.tensor(states.x[k]), NONE, torch.tensor(run.u[k]))
        assert float(after[2]) == pytest.approx(states.x[k + 1, 2], abs=1e-9)  # h / T = 0.05: 3e-9 a step
    np.testing.assert_allclose(states.xdot[:, 2], (run.u[:, 0] - states.x[:, 2]) / 0.05)


def simulate(delay, u, x0=(0.4, 0.0)):
    """The test pendulum's nominal prior under torques that act ``delay`` later, by scipy, from switch to switch."""
    p = Pendulum().values

    def f(t, x):
        k = int(np.floor((t - delay) / DT + 1e-9))
        torque = u[k] if k >= 0 else 0.0
        return [x[1], (torque - p["mgl"] * np.sin(x[0]) - p["d"] * x[1]) / p["J"]]

    grid = DT * np.arange(len(u) + 1)
    edges = np.unique(np.round(np.concatenate([grid, grid + delay]), 12))
    edges, x, states = edges[edges <= grid[-1] + 1e-12], np.array(x0), {0.0: np.array(x0)}
    for a, b in pairwise(edges):
        middle = (a + b) / 2
        x = solve_ivp(lambda t, z, m=middle: f(m, z), (a, b), x, method="DOP853", rtol=1e-11, atol=1e-13).y[
            :, -1
        ]
        states[round(b, 12)] = x
    return np.array([states[round(t, 12)] for t in grid])


@pytest.mark.parametrize("delay", [DT, 2 * DT, 0.4 * DT, 2.7 * DT])
def test_a_delayed_input_acts_when_it_arrives(delay):
    u = np.random.default_rng(0).uniform(-0.6, 0.6, 40)
    exact = simulate(delay, u)
    step = DelayedPriorStep(Pendulum(), DT, delay)
    x = torch.tensor([0.4, 0.0] + [0.0] * step.n_waiting, dtype=torch.float64)
    found = [x[:2].numpy()]
    for torque in u:
        x, _ = step(x, NONE, torch.tensor([torque]))
        found.append(x[:2].numpy())
    # Runge-Kutta of order 4 at 20 ms and 2.6 rad/s: (0.05)^5 / 120 a period
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-6)


def test_whole_periods_wait_before_any_step():
    own = PriorStep(Pendulum(), DT)
    late, exact = DelayedStep(own, n_x=2, n_u=1, periods=3), DelayedPriorStep(Pendulum(), DT, 3 * DT)
    assert late.n_waiting == exact.n_waiting == 3
    a = b = torch.tensor([[0.4, 0.0, 0.1, 0.2, 0.3]], dtype=torch.float64)
    for torque in (0.5, -0.4, 0.3, 0.2, 0.1):
        u = torch.tensor([[torque]], dtype=torch.float64)
        a, b = late(a, NONE, u)[0], exact(b, NONE, u)[0]
        assert torch.equal(a, b)
    assert a[0, 2:].tolist() == [0.3, 0.2, 0.1]
    assert torch.equal(late.xdot(a, NONE, u), Pendulum()(a[:, :2], a[:, 2:3]))


def test_energy_balance_of_a_delay_takes_the_input_that_acts():
    step = DelayedPriorStep(Pendulum(), DT, 2 * DT)
    rng = np.random.default_rng(0)
    x, u = torch.tensor(rng.uniform(-3, 3, (50, 4))), torch.tensor(rng.uniform(-1, 1, (50, 1)))
    flow = step.xdot(x, NONE, u)
    # rounding of terms of up to 10 W
    np.testing.assert_allclose(step.energy_balance(x, flow, u), 0.0, atol=1e-13)
    assert (
        float((Pendulum().energy_balance(x[:, :2], flow, u)).abs().max()) > 0.1
    )  # with the command it is not


def late_recording(seed):
    """A recording with the commanded torque, which acts 1.3 periods later."""
    run = record(seed, seconds=3.0)
    prior, x = Pendulum(TRUTH), [torch.tensor(run.x[0])]
    for k in range(len(run.u) - 1):
        older, younger = (torch.tensor(run.u[max(k - m, 0)]) for m in (2, 1))
        between = rk4(lambda z, u=older: prior(z, u), x[-1], 0.3 * DT, 2)
        x.append(rk4(lambda z, u=younger: prior(z, u), between, 0.7 * DT, 2))
    states = torch.stack(x).numpy()
    return replace(run, x=states, y=states[:, :1])


def test_a_prior_is_fitted_to_delayed_recordings():
    commanded = [late_recording(seed) for seed in range(2)]
    acting = [delayed(run, 1.3 * DT) for run in commanded]
    right, wrong = (
        fit_prior(Pendulum, runs, runs, dt=DT, methods=("equation_error",)) for runs in (acting, commanded)
    )
    for name, truth in TRUTH.items():
        # what acts is told by its mean over a period: that costs a part of the motion within one
        assert right.values[name] == pytest.approx(truth, rel=0.01)
    assert abs(wrong.values["d"] / TRUTH["d"] - 1) > 0.1


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="positive"):
        with_input_lag(PendulumPrior, Parameter("T_u", 0.0, "s", 0.0, 1.0))
    with pytest.raises(InputError, match="already"):
        with_input_lag(with_input_lag(PendulumPrior, LAG), Parameter("T_2", 0.1, "s", 0.01, 1.0))
    with pytest.raises(InputError, match="parameter d"):
        with_input_lag(PendulumPrior, Parameter("d", 0.1, "s", 0.01, 1.0))
    with pytest.raises(InputError, match="whole number"):
        DelayedStep(PriorStep(Pendulum(), DT), n_x=2, n_u=1, periods=0)
    for bad in (0.0, -1.0, float("inf")):
        with pytest.raises(InputError, match="delay must be positive"):
            DelayedPriorStep(Pendulum(), DT, bad)
    run = record(0, seconds=0.2)
    with pytest.raises(InputError, match="leaves nothing"):
        delayed(run, 1.0)
    with pytest.raises(InputError, match="time constant"):
        lagged(run, 0.0)


def test_odd_states_are_still_refused():
    class Odd(Prior):
        states = (Signal("a", "rad"), Signal("b", "rad"), Signal("c", "rad"))
        inputs = (Signal("u", "N m"),)
        outputs = states[:1]
        parameters_spec = (Parameter("k", 1.0, "N m", 0.5, 2.0),)

    with pytest.raises(InputError, match="in pairs, got 3"):
        Odd()
