"""Parts of the benchmark of closed loops on true plants, with right values: rules, rivals, what counts as settled."""

import sys
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import OCP, DataSpec, HybridModel, Parameter, Prior, Scenario, Signal

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import unknown_loops as own
from unknown.loops import HOLDS, Made, Trial, ran, trials_of
from unknown.motion import MOTION
from unknown.plants import PLANTS, Plant
from unknown.processes import PROCESSES
from unknown.rivals import Point, Regulator, Simc, lags_of, simc_models


def chain(lags):
    """``A``, ``B``, ``C`` of lags in a row."""
    n = len(lags)
    a = np.diag([-1 / lag for lag in lags]) + np.diag([1 / lag for lag in lags[1:]], -1)
    return a, np.eye(n)[:, 0] / lags[0], np.eye(n)[-1]


def test_the_half_rule_has_skogestads_numbers():
    """Skogestad (2003), example E2: k (1 - 0.3 s)(1 + 0.08 s) over lags of 2, 1, 0.4, 0.2 and three of 0.05."""
    a, b, c = chain((2.0, 1.0, 0.4, 0.2, 0.0498, 0.0499, 0.04999))
    # zeros by outputs of the last states: (1 - 0.3 s)(1 + 0.08 s) = 1 - 0.22 s - 0.024 s^2
    row = c - 0.22 * c @ a - 0.024 * c @ a @ a
    found = lags_of(a, b, row, 1e-6)
    assert found is not None
    assert found.gain == pytest.approx(1.0, rel=1e-3)
    assert (found.slow, found.quick, found.delay) == pytest.approx((2.0, 1.2, 0.77), rel=0.01)


def test_an_integrator_is_kept_and_poles_with_little_damping_have_no_lags():
    a, b, c = np.array([[0.0, 1.0], [0.0, -2.0]]), np.array([0.0, 3.0]), np.array([1.0, 0.0])
    found = lags_of(a, b, c, 0.01)
    assert found is not None
    assert found == pytest.approx((1.5, np.inf, 0.5, 0.005))
    assert lags_of(np.array([[0.0, 1.0], [-1.0, -0.2]]), b, c, 0.01) is None


class Lag(Prior):
    """One lag, whose gain is to be fitted."""

    states = (Signal("x", "-", -10.0, 10.0),)
    inputs = (Signal("u", "-", -5.0, 5.0),)
    outputs = states
    parameters = (Parameter("gain", 1.0, "-", 0.1, 5.0),)

    def xdot(self, x, u, w, p):
        """First order."""
        return (p.gain * u.u - x.x,)


def made_of_lag():
    x, u, p = ca.MX.sym("x"), ca.MX.sym("u"), ca.MX.sym("p")
    pole, step = np.exp(-0.1), 1 - np.exp(-0.1)
    model = HybridModel.of(
        "prior", 0.1, Lag.states, Lag.inputs, Lag.outputs, x=x, u=u, p=p, y=x, x_next=pole * x + step * p * u,
        xdot=p * u - x, parameters=Lag.parameters,
    )  # fmt: skip
    control = OCP(20, [0.0], [0.0], [1.0], [-3.0], [3.0], q_y=[25.0], preview=False)
    scenario = Scenario(
        "lag", "lag", "", prior=Lag, data=DataSpec("t", ("u",), ("x",), 0.1, 0.5, 0.7, 1.0), control=control,
        sensor_sigma=(0.02,),
    )  # fmt: skip
    span = np.array([[-1.0], [1.0]])
    fit = SimpleNamespace(substeps=1)
    return Made(scenario, model, fit, (np.array([0.01]), np.array([0.01])), (0,), span, np.zeros(0))


LAG = Plant(lambda x, u, w, p: p.gain * u - x, lambda x: x, {"gain": 1.0}, (0.0,), (0.02,), (0.0,), 0.05)


def rivals(made):
    """The tool's loop, and both rivals."""
    point = Point(made.model, np.zeros(1), np.zeros(1), np.zeros(0))
    pairs, why = simc_models(point, [0], 2.0)
    assert why == ""
    control = made.control
    return {
        "own": made.loop(),
        "simc": Simc(point, pairs, [0], control.u_min, control.u_max, 9.0, False),
        "lqr": Regulator(
            point, control, [0], lambda goal: (goal, goal), np.array([0.01]), made.sigma, 0.6
        ),
    }  # fmt: skip


def test_all_controllers_hold_a_lag_of_another_gain_under_a_load():
    made = made_of_lag()
    (trial,) = trials_of("lag", LAG, made, 0, 1)
    assert trial.off == 0.2
    assert abs(trial.p.gain - 1.0) == pytest.approx(0.2)
    costs = {}
    for name, controller in rivals(made).items():
        loop = ran(LAG, made, trial, controller)
        assert loop.settled, name
        costs[name] = loop.cost
    assert costs["own"] < 1.3 * costs["lqr"]


def test_a_loop_that_is_off_by_more_than_the_noise_has_not_settled():
    made = made_of_lag()
    trial = Trial(0, np.zeros((HOLDS, 1)), np.array([0.5]), LAG.p, np.zeros(1), np.zeros(1), 0.2)
    still = SimpleNamespace(start=lambda y, w, goal: np.zeros(1), step=lambda y, w, goal: np.zeros(1))
    loop = ran(LAG, made, trial, still)
    assert not loop.settled
    np.testing.assert_allclose(loop.offset[-1], 0.5 / 0.02, rtol=0.01)
    assert loop.cost == pytest.approx(25.0 * 0.25, rel=0.02)  # the weight times the load's effect, squared


def test_every_textbook_machine_has_a_plant_that_rests_or_works():
    for machine in (*PROCESSES, *MOTION):
        plant = PLANTS[machine.name]
        assert len(plant.sigma) == len(plant.step) == len(machine.prior.outputs)
        assert plant.measure(np.array(plant.start)).shape == (len(machine.prior.outputs),)
    assert set(own.IN_VIEW) < set(PLANTS)
    assert len(own.IN_VIEW) == 6
