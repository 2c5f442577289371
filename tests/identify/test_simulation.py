"""Free runs of all windows in one call: against torch and finite differences, and where a machine rests."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from example_priors import TANKS, Arm, Swing, Tanks, TorchArm, TorchSwing, TorchTanks
from simulated_pendulum import Pendulum
from torch.func import jacfwd

from hybrid_mpc import InputError, OperatingPoint, Parameter, Prior, Signal, Trajectory, fit_prior
from hybrid_mpc.identify.export import trace_model
from hybrid_mpc.identify.prior_model import model_info
from hybrid_mpc.identify.simulation import Simulation, required_substeps, rest_of, visited, with_unknown_rates
from hybrid_mpc.identify.step import PriorEquations, PriorStep, rk4
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.model.model import step_symbols

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


ONE_OF_EACH = (TorchSwing, Tanks)


@pytest.mark.parametrize(
    "kind", [k if k in ONE_OF_EACH else pytest.param(k, marks=pytest.mark.full) for k in EVERY]
)
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


class Valve(Prior):
    """A level that runs out slowly through a slit, and five hundred times as fast above the weir at 0.5."""

    states, inputs = (Signal("level", "m", 0.0, 1.0),), (Signal("inflow", "m/s", 0.0, 60.0),)
    outputs = states
    parameters = (Parameter("slit", 0.2, "1/s", 0.02, 2.0), Parameter("weir", 100.0, "1/s", 20.0, 180.0))
    operating_point = OperatingPoint(x=(0.2,), u=(0.04,))

    def xdot(self, x, u, w, p):
        over = x.level - 0.5
        return (u.inflow - p.slit * x.level - p.weir * 0.5 * (over + ca.sqrt(over * over + 1e-4)),)


def valve_run(seed=0, dt=0.05, n=200, noise=1e-3):
    """Inflows that now and then fill the tank over its weir; the truth is integrated in steps of a millisecond."""
    rng, prior = np.random.default_rng(seed), Valve({"slit": 0.3, "weir": 80.0})
    u = np.repeat(rng.choice([0.02, 0.1, 0.2, 20.0], n // 10), 10)[:, None]
    fine = Simulation(prior.equations.xdot, dt)
    x = fine.values(np.array([[0.3]]), u[None], np.zeros((1, n, 0)), prior.p, 50)[0]
    y = x + noise * rng.standard_normal(x.shape)
    return Trajectory(f"run{seed}", "train", dt, dt * np.arange(n), u, y, np.full_like(x, np.nan), 0.0 * x), x


def test_a_prior_is_stiff_where_the_recordings_go():
    prior, dt = Valve(), 0.05
    assert required_substeps(prior, dt) == 1  # the slit alone, at the operating point
    run, x = valve_run()
    points = visited([replace(run, x=x)])
    assert [v.shape[1] for v in points] == [1, 1, 0]
    assert {x.max(), x.min()} <= set(points[0].ravel())
    assert required_substeps(prior, dt, points) == 6  # (100 + 0.2) / s times 0.05 s
    with pytest.raises(InputError, match=r"100.*HM-IDENTIFY-049"):
        required_substeps(prior, 0.25, points)
    assert required_substeps(prior, dt, visited([run])) == 1  # no state is known: rest decides


def test_a_prior_that_is_stiff_in_a_part_of_its_range_is_fitted_smoothed_and_deployed():
    runs = [valve_run(seed)[0] for seed in range(3)]
    fit = fit_prior(Valve, runs[:2], runs[2:], dt=0.05)
    assert fit.substeps == 5  # (80 + 0.3) / s times 0.05 s
    # in fewer sub-steps than the stiff part needs, Runge-Kutta is off by per cents there, and so is the weir
    assert abs(fit.values["weir"] - 80.0) < max(3 * fit.standard_errors["weir"], 0.8)
    assert abs(fit.values["slit"] - 0.3) < max(3 * fit.standard_errors["slit"], 0.003)
    fitted = Valve(fit.values)
    smoothed = fit.smoother(fitted, 0.05).smooth(runs[:1])[0]
    assert np.abs(smoothed.x - valve_run(0)[1]).max() < 5e-3  # five times the noise
    programs = trace_model(PriorStep(fitted, 0.05, fit.substeps))
    model = build_model("m", {f"m/{name}": p for name, p in programs.items()}, model_info(fitted, 0.05))
    symbols = step_symbols(model)[:4]
    online = ca.Function("online", [*symbols], [model.step(*symbols, model.p)[0]])(0.7, [], 20.0, [])
    assert float(online) == pytest.approx(filled(fitted, fit.substeps), rel=1e-12)
    assert abs(float(online) - filled(fitted, required_substeps(fitted, 0.05))) > 1e-3  # another model


def filled(prior, substeps):
    """The level a period after 0.7 m."""
    u, w = np.full((1, 2, 1), 20.0), np.zeros((1, 2, 0))
    return Simulation(prior.equations.xdot, 0.05).values(np.array([[0.7]]), u, w, prior.p, substeps)[0, 1, 0]
