"""The one search for steady states: which of several it takes, bounds, what is held, and rounding."""

import casadi as ca
import numpy as np
import pytest
from machines import dc_motor, two_tanks

from hybrid_mpc import HybridModel, InputError, Signal, holding_input
from hybrid_mpc.model.equilibrium import (
    RESIDUAL,
    Descent,
    Range,
    RateEquations,
    SteadySearch,
    fixed_point,
    hidden_equilibrium,
    holding,
    rate_search,
    residual_of,
    rest_search,
)

EMPTY = np.zeros(0)


def rates(f, shown=None):
    """Equations of ``f(x, u)`` and ``shown(x, u)``, one state, one input."""
    x, u, w, p = (ca.SX.sym(name, n) for name, n in (("x", 1), ("u", 1), ("w", 0), ("p", 0)))
    output = None if shown is None else ca.Function("y", [x, u, w, p], [shown(x, u)])
    return RateEquations(ca.Function("xdot", [x, u, w, p], [f(x, u)]), EMPTY, EMPTY, output)


def search(equations, bounds=None, near=(0.0, 0.0)):
    one = np.ones(1)
    return SteadySearch(equations, np.ones(2), one, one, np.array(near), np.array([1]), bounds)


def test_a_set_point_beyond_the_inputs_is_met_as_nearly_as_they_allow():
    bounds = Range(np.array([-np.inf, -1.0]), np.array([np.inf, 1.0]), np.array([False, True]), -np.full(1, np.inf),
                   np.full(1, np.inf))  # fmt: skip
    found = search(rates(lambda x, u: u - x), bounds).descend(np.zeros(2), np.array([3.0]))
    np.testing.assert_allclose(found.v, [1.0, 1.0], atol=1e-9)
    assert (found.steady, found.reached, found.sure) == (True, False, True)
    assert found.off == pytest.approx(2.0)


def test_the_branch_of_the_operating_point_is_followed_where_newton_s_method_leaves_it():
    """x = sin(3 u) + 2 u bends to and fro: there are several inputs, one on the way from zero."""
    equations = rates(lambda x, u: ca.sin(3 * u) + 2 * u - x)
    one = search(equations)
    start = np.zeros(2)
    found = one.follow(start, np.zeros(1), np.array([1.7]))
    assert found is not None
    assert found.reached
    assert found.sure
    assert 0 < found.v[1] < 0.7  # the first maximum of the branch is at 0.7681
    assert one.follow(start, np.zeros(1), np.array([2.4])) is None  # beyond it the branch turns back


def test_no_rounding_changes_what_a_continuation_ends_at():
    equations = rates(lambda x, u: ca.sin(3 * u) + 2 * u - x)
    exact, rng = equations.rest, np.random.default_rng(0)
    wanted = search(equations).follow(np.zeros(2), np.zeros(1), np.array([1.5])).v

    def rounded(v):
        rest, slopes = exact(v)
        return rest + 1e-14 * rng.standard_normal(1), slopes * (1 + 1e-14 * rng.standard_normal(slopes.shape))

    equations.rest = rounded
    for _ in range(20):
        found = search(equations).follow(np.zeros(2), np.zeros(1), np.array([1.5]))
        np.testing.assert_allclose(found.v, wanted, atol=1e-8)


@pytest.mark.parametrize(
    "curve", [lambda x: x**2, lambda x: x**3, ca.exp, ca.sqrt], ids=["x^2", "x^3", "e^x", "root"]
)
@pytest.mark.parametrize(
    ("begun", "goal"), [(1.0, 1.05), (1.0, 2.0), (1.0, 5.0), (5.0, 1.0), (0.1, 1.0), (1.0, 0.1)]
)
def test_a_descent_follows_a_curved_branch_by_whole_steps(curve, begun, goal):
    """A step along the branch leaves it by its square, which no merit likes; the next one comes back to it."""
    one = search(rates(lambda x, u: u - curve(x)))
    taken, newton = [], one._newton
    one._newton = lambda *given: taken.append(given) or newton(*given)
    found = one.descend(np.array([begun, float(curve(begun))]), np.array([goal]))
    assert found.reached
    np.testing.assert_allclose(found.v, [goal, float(curve(goal))], rtol=1e-9)
    assert len(taken) == 3


def test_of_equally_good_answers_the_nearest_to_the_operating_point_counts():
    one = search(rates(lambda x, u: u - x))

    def ended(x, off, sure=True, steady=True):
        return Descent(np.array([x, x]), np.array([x]), off, np.ones((1, 1)), steady, sure and steady)

    far, near = ended(2.0, 0.0), ended(-1.0, 1e-9)
    assert one.best([far, near]) is near  # both reach the set-point
    assert one.best([far, ended(-1.0, 0.5)]) is far
    assert (
        one.best([ended(0.1, 0.0, sure=False), far]) is far
    )  # an answer of chance only where there is no other
    assert one.best([ended(0.1, 0.0, steady=False)]) is None


def test_what_is_held_stays():
    equations = rates(lambda x, u: u - x**3)
    one = rate_search(equations, np.ones(2), np.array([1.0, 8.0]), np.zeros(1), free=np.array([0]))
    found = one.descend(np.array([1.0, 8.0]), np.zeros(1))
    assert found.steady
    assert found.v[1] == 8.0
    assert found.v[0] == pytest.approx(2.0, abs=1e-12)


def test_a_rest_is_as_exact_in_slow_machines_as_in_quick_ones():
    for slow in (1e-9, 1.0, 1e9):
        one = rate_search(rates(lambda x, u, slow=slow: slow * (u - x**3)), np.ones(2), np.array([1.0, 8.0]),
                          np.zeros(1), free=np.array([0]))  # fmt: skip
        found = one.descend(np.array([1.0, 8.0]), np.zeros(1))
        assert found.steady
        assert found.v[0] == pytest.approx(2.0, abs=1e-9)


@pytest.mark.parametrize("make", [two_tanks, dc_motor])
def test_the_fixed_point_of_a_machine_is_one(make):
    model = make()
    x, h = fixed_point(model, model.u0, model.x0 * 1.05 + 0.01)
    after = model.step(x, h, model.u0, model.w, model.p)[0].full().ravel()
    assert np.max(np.abs(after - x)) <= RESIDUAL


def test_a_hidden_state_that_swings_for_ever_is_refused():
    x, h, u = ca.SX.sym("x"), ca.SX.sym("h"), ca.SX.sym("u")
    level = (Signal("x", "m"),)
    model = HybridModel.of(
        "restless", 1.0, level, (Signal("u", "-"),), level, x=x, h=h, u=u, x_next=x, h_next=ca.sqrt(h**2 + 1), xdot=u,
        y=x,
    )  # fmt: skip
    with pytest.raises(InputError):
        hidden_equilibrium(model, [0.0], [0.0])


def test_an_input_is_found_beyond_the_friction_that_holds():
    """Within 0.2 of zero the drive feels no input: Newton's method stands still there."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    felt = ca.if_else(ca.fabs(u) < 0.2, 0.0, u - 0.2 * ca.sign(u))
    model = HybridModel.of(
        "stuck", 0.1, (Signal("q", "rad"), Signal("v", "rad/s")), (Signal("u", "N m"),), (Signal("q", "rad"),),
        x=x, u=u, x_next=ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (felt - x[0])), y=x[0],
        xdot=ca.vertcat(x[1], felt - x[0]),
    )  # fmt: skip
    assert holding_input(model, [0.5])[0] == pytest.approx(0.7, abs=1e-9)


def test_states_are_searched_in_their_own_sizes():
    model = two_tanks()
    one = rest_search(model)
    v = np.concatenate([model.x0 * 1.1, np.zeros(model.n_h), model.u0])
    found = one.descend(v, np.zeros(model.n_y))
    assert found.steady
    assert found.sure
    assert residual_of(one, found.v) <= RESIDUAL


def test_the_best_input_is_finite_if_two_inputs_have_the_same_effect():
    """A room that a heater warms and a second one, too: no rate tells them apart."""
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u", 2)
    rates = ca.vertcat((u[0] + u[1] - x[0]) / 500.0, (x[0] - x[1]) / 5000.0)
    best = holding(rates, u, np.array([0.5, 0.0]), np.array([50.0, 40.0]), np.array([100.0, 100.0]))
    found = ca.Function("best", [x], [best])([2.0, 2.0]).full().ravel()
    # the step from the operating point's input is the shortest one; a condition of 1e10 leaves six digits
    np.testing.assert_allclose(found, [1.25, 0.75], atol=1e-5)
