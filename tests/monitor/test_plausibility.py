"""Bounds in the plan: no cost for a learned correction, no use of an invented one."""

import json
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation import TrueState
from hybrid_mpc.model import HybridModel
from hybrid_mpc.monitor.plausibility import (
    Plausibility,
    excess_bound,
    learn_plausibility,
    plan_distance,
    region_bound,
)
from hybrid_mpc.mpc import OCP, SQPController
from hybrid_mpc.signals import Signal

DT, TRAINED = 0.05, 1.0  # s, m/s


def cart(invented: float) -> HybridModel:
    """1 kg, 0.3 N s/m; a correction of 0.2 sin(2 v) is right; beyond the trained speed one is invented."""
    x, h, u, w = ca.MX.sym("x", 2), ca.MX.sym("h", 0), ca.MX.sym("u"), ca.MX.sym("w", 2)

    def rhs(z):
        beyond = ca.fmax(0, ca.fabs(z[1]) - TRAINED)
        extra = 0.2 * ca.sin(2 * z[1]) + invented * ca.sign(z[1]) * beyond**2
        return ca.vertcat(z[1], u - 0.3 * z[1] + extra)

    z = x + DT * rhs(x + 0.5 * DT * rhs(x))
    return HybridModel(
        "cart", DT, (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
        step=ca.Function("f", [x, h, u], [z, h]),
        xdot=ca.Function("g", [x, h, u], [rhs(x)]),
        output=ca.Function("y", [x, u], [x[0]]),
        energy_balance=ca.Function("e", [x, w, u], [(w[1] + 0.3 * x[1] - u) * x[1]]),
    )  # fmt: skip


@dataclass(frozen=True)
class Data:
    x: np.ndarray
    u: np.ndarray


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    v = rng.uniform(-TRAINED, TRAINED, 3000)
    return Data(np.column_stack([rng.uniform(-3, 3, 3000), v]), rng.uniform(-1, 1, (3000, 1)))


@pytest.fixture(scope="module")
def ordinary(data):
    return learn_plausibility(cart(5.0), [data], data_hash="abc")


def values(bound, x, u):
    return bound.expression.map(len(x))(x.T, u.T).full().T


def test_a_learned_correction_is_not_punished_where_it_was_learned(data, ordinary):
    rng = np.random.default_rng(1)
    x = np.column_stack([rng.uniform(-3, 3, 4000), rng.uniform(-TRAINED, TRAINED, 4000)])
    u = rng.uniform(-1, 1, (4000, 1))
    model = cart(5.0)
    excess = values(excess_bound(model, ordinary), x, u)
    # 1 % by the quantile; on other samples, and by 2,000 samples' own error, up to twice that
    assert np.mean(excess.max(axis=1) > 0) < 0.02
    assert np.max(values(region_bound(model, ordinary), x, u)) < 1.0
    assert np.max(plan_distance(ordinary, x, u)) < 1.0


def test_an_invented_one_is(ordinary):
    x, u = np.array([[0.0, 2.0], [0.0, -2.0]]), np.zeros((2, 1))
    # 5 N at 2 m/s are 10 W; ordinary there is 0.2 v and what a parabola through the data extrapolates
    assert np.all(values(excess_bound(cart(5.0), ordinary), x, u).max(axis=1) > 5.0)
    assert np.all(plan_distance(ordinary, np.array([[0.0, 4.0]]), np.zeros((1, 1))) > 1.0)


def planned(model, soft):
    ocp = OCP(40, [1.0, 0.0], [0.5], [0.0], [-1.0], [1.0], terminal=np.diag([5.0, 5.0]), soft=soft)
    controller = SQPController(model, ocp, iterations=60)
    estimate = TrueState(model).start(np.array([-3.0, 0.0]))
    first = controller.initial(estimate, np.zeros((40, 1)))
    return controller.solve(first, estimate, np.zeros((41, 2)))


def driven(model, u):
    """Cost of inputs on a machine, and its largest speed."""
    x, cost, fastest = np.array([-3.0, 0.0]), 0.0, 0.0
    for value in u.ravel():
        cost += DT * (x[0] ** 2 + 0.5 * value**2)
        x = model.step(x, [], value)[0].full().ravel()
        fastest = max(fastest, abs(x[1]))
    return cost + 5 * x[0] ** 2 + 5 * x[1] ** 2, fastest


def test_a_plan_does_not_live_on_what_the_network_invented(ordinary):
    model, truth = cart(5.0), cart(0.0)
    bounds = [excess_bound(model, ordinary), region_bound(model, ordinary)]
    free, kept = planned(model, []), planned(model, bounds)
    assert free.status.ok
    assert kept.status.ok
    assert np.abs(free.x[:, 1]).max() > 1.3  # it goes where pushing is free of charge
    assert np.abs(kept.x[:, 1]).max() < np.abs(free.x[:, 1]).max() - 0.1
    # and the machine, which gives nothing for free, is better served by the plan that did not count on it
    assert driven(truth, kept.u)[0] < driven(truth, free.u)[0]
    error = [np.abs(p.x[-1, 0] - trajectory(truth, p.u)[-1, 0]) for p in (free, kept)]
    assert error[1] < 0.5 * error[0]


def trajectory(model, u):
    x = [np.array([-3.0, 0.0])]
    for value in u.ravel():
        x.append(model.step(x[-1], [], value)[0].full().ravel())
    return np.array(x)


def test_a_plan_within_the_region_is_the_same(ordinary):
    model = cart(0.0)
    slow = OCP(40, [1.0, 0.0], [4.0], [0.0], [-0.3], [0.3], terminal=np.diag([5.0, 5.0]))
    plans = []
    for soft in ([], [excess_bound(model, ordinary), region_bound(model, ordinary)]):
        ocp = OCP(40, slow.q, slow.r, slow.r_delta, slow.u_min, slow.u_max, terminal=slow.terminal, soft=soft)
        controller = SQPController(model, ocp, iterations=60)
        estimate = TrueState(model).start(np.array([-1.0, 0.0]))
        plans.append(
            controller.solve(controller.initial(estimate, np.zeros((40, 1))), estimate, np.zeros((41, 2)))
        )
    assert np.abs(plans[0].x[:, 1]).max() < TRAINED
    # Slacks that are zero change nothing; where 1 % of the ordinary exceeds its quantile they may, a little.
    assert plans[1].cost == pytest.approx(plans[0].cost, rel=0.02)


def test_it_survives_json(ordinary):
    assert Plausibility.from_dict(json.loads(json.dumps(ordinary.to_dict()))) == ordinary


def test_a_hidden_state_is_settled(golf_artifact):
    from hybrid_mpc.artifact import load_artifact

    model = load_artifact(golf_artifact).models["hybrid"]
    rng = np.random.default_rng(0)
    found = learn_plausibility(model, [Data(rng.normal(size=(300, 2)), 0.1 * rng.normal(size=(300, 1)))])
    bound = excess_bound(model, found)
    assert bound.expression(np.zeros(2), np.zeros(1)).shape == (2, 1)


def test_bad_input_speaks(data, ordinary):
    with pytest.raises(InputError, match="at least 200"):
        learn_plausibility(cart(0.0), [Data(data.x[:10], data.u[:10])])
    with pytest.raises(InputError, match="within 0 to 1"):
        learn_plausibility(cart(0.0), [data], quantile=1.0)
    with pytest.raises(InputError, match="it needs"):
        Plausibility.from_dict({"quantile": 0.9})
    x, u, h, w = ca.MX.sym("x", 4), ca.MX.sym("u"), ca.MX.sym("h", 0), ca.MX.sym("w", 4)
    names = tuple(Signal(n, "-") for n in "abcd")
    other = HybridModel(
        "other", DT, names, (Signal("u", "-"),), names[:1], ca.Function("f", [x, h, u], [x, h]),
        ca.Function("g", [x, h, u], [x]), ca.Function("y", [x, u], [x[0]]), ca.Function("e", [x, w, u], [x[0]]),
    )  # fmt: skip
    with pytest.raises(InputError, match="learned for 3"):
        excess_bound(other, ordinary)
