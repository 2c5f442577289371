"""Bounds in the plan: no cost for a learned correction, no use of an invented one."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import (
    HybridModel,
    InputError,
    Plausibility,
    Signal,
    excess_bound,
    learn_plausibility,
    region_bound,
)
from hybrid_mpc.monitor.plausibility import plan_distance, reach_of
from hybrid_mpc.records import plain, record

PATH = Path(__file__).parents[2] / "benchmarks" / "guard_exploit.py"


def _load():
    spec = importlib.util.spec_from_file_location("guard_exploit", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


exploit = _load()
cart, driven, Data, DT, TRAINED = (
    exploit.cart,
    exploit.driven,
    exploit.Data,
    exploit.DT,
    exploit.TRAINED,
)


@pytest.fixture(scope="module")
def data():
    return exploit.training()


@pytest.fixture(scope="module")
def ordinary(data):
    return learn_plausibility(cart(4.0), [data], data_hash="abc")


def values(bound, x, u):
    return bound.expression.map(len(x))(x.T, u.T).full().T


def test_a_learned_correction_is_not_punished_where_it_was_learned(data, ordinary):
    rng = np.random.default_rng(1)
    x = np.column_stack([rng.uniform(-3, 3, 4000), rng.uniform(-2, 2, 4000)])
    u = rng.uniform(-TRAINED, TRAINED, (4000, 1))
    model = cart(4.0)
    share = np.abs(values(excess_bound(model, ordinary), x, u))
    # 1 % by the quantile; on other samples, and by 2,000 samples' own error, up to twice that
    assert 0.002 < np.mean(share > 1.0) < 0.02
    # one in a million by the tail, which the edge of uniform data ends sooner; none in 4,000 others
    assert np.max(share) < ordinary.reach
    assert np.max(values(region_bound(model, ordinary), x, u)) < 1.0
    assert np.max(plan_distance(ordinary, x, u)) < 1.0


def test_an_invented_one_is(ordinary):
    x, u = np.array([[0.0, 2.0], [0.0, -2.0]]), np.full((2, 1), 2.0)
    # 4 N at 2 m/s are 8 W; ordinary there is 0.4 W at most, and what the fit extrapolates in u
    bound = excess_bound(cart(4.0), ordinary)
    assert np.all(np.abs(values(bound, x, u)) > 10.0 * bound.upper)
    assert np.all(plan_distance(ordinary, np.array([[0.0, 6.0]]), np.zeros((1, 1))) > 1.0)


def test_a_plan_does_not_live_on_what_the_network_invented(ordinary):
    # It brakes late, for beyond the trained input the network promises three times the force; the cart hits the wall.
    model = cart(4.0)
    bounds = [excess_bound(model, ordinary), region_bound(model, ordinary)]
    free, kept = driven(model, []), driven(model, bounds)
    assert free.beyond > 0.1
    # Near rest power says nothing, and the region reaches beyond the data by half: some of it is left.
    # Half of it, by a solver that stops at 20 iterations; hence 0.6.
    assert kept.beyond < 0.6 * free.beyond


def test_a_right_model_pays_nothing_for_the_bounds(data):
    model = cart(0.0)
    known = learn_plausibility(model, [data])
    free = driven(model, [])
    kept = driven(model, [excess_bound(model, known), region_bound(model, known)])
    # slacks that are zero change nothing but the solver's last digits
    assert kept.cost == pytest.approx(free.cost, rel=1e-3)


def test_the_tail_is_drawn_on_to_one_in_a_million():
    # standard deviation of the mean of 100 exponential excesses, times the 9.2 scales from 1 % to 1e-6: 0.9 of 13.8
    ratio = np.random.default_rng(0).exponential(size=10_000)
    assert reach_of(ratio, 0.99) == pytest.approx(-np.log(1e-6), abs=2.7)
    # data that end at their quantile reach no farther
    assert reach_of(np.ones(1000), 0.99) == 1.0


def test_it_survives_json(ordinary):
    assert record(Plausibility, json.loads(json.dumps(plain(ordinary))), "") == ordinary


def test_a_hidden_state_is_settled(golf_artifact):
    from hybrid_mpc import load

    model = load(golf_artifact).models["hybrid"]
    rng = np.random.default_rng(0)
    found = learn_plausibility(model, [Data(rng.normal(size=(300, 2)), 0.1 * rng.normal(size=(300, 1)))])
    bound = excess_bound(model, found)
    assert bound.expression(np.zeros(2), np.zeros(1)).shape == (1, 1)


def test_bad_input_speaks(data, ordinary):
    with pytest.raises(InputError, match="at least 200"):
        learn_plausibility(cart(0.0), [Data(data.x[:10], data.u[:10])])
    with pytest.raises(InputError, match="within 0 to 1"):
        learn_plausibility(cart(0.0), [data], quantile=1.0)
    with pytest.raises(InputError, match="at least 1"):
        replace(ordinary, reach=0.5)
    x, u = ca.MX.sym("x", 4), ca.MX.sym("u")
    names = tuple(Signal(n, "-") for n in "abcd")
    other = HybridModel.of(
        "other", DT, names, (Signal("u", "-"),), names[:1], x=x, u=u, x_next=x, xdot=x, y=x[0], energy=x[0]
    )
    with pytest.raises(InputError, match="learned for 3"):
        excess_bound(other, ordinary)
