"""Moves of free length: their duration is that of the theory, their end lies within the target."""

import numpy as np
import pytest
from control_parts import estimate_of
from online_models import linear_model, pendulum_model

from hybrid_mpc import OCP, CondensedController, HardBound, InputError, IpoptController, shortest_move

DT = 0.05
MODEL = linear_model(np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.5 * DT**2], [DT]]), np.eye(2)[:1], dt=DT)


def problem(limit=1.0, **others):
    """Weights that hardly cost: time counts."""
    return OCP(10, [1e-3, 1e-3], [1e-3], [0.0], [-limit], [limit], **others)


def rest_at(goal, width=1e-3):
    return HardBound("x", np.array([goal, 0.0]) - width, np.array([goal, 0.0]) + width, at_end=True)


@pytest.mark.parametrize("distance", [0.5, 2.0])
def test_the_double_integrator_takes_twice_the_root_of_the_distance(distance):
    """Full thrust to the middle, full brake from there: T = 2 sqrt(d / a), the next whole period."""
    move = shortest_move(MODEL, problem(), estimate_of(MODEL, [0.0, 0.0]), rest_at(distance))
    least = 2 * np.sqrt(distance)
    # the target is 1 mm wide, and half of it at either end of the speed: a period at most is saved by that
    assert np.floor(least / DT) * DT - DT <= move.duration <= np.ceil(least / DT) * DT
    assert move.x[-1] == pytest.approx([distance, 0.0], abs=1.01e-3)
    assert np.max(np.abs(move.u)) <= 1.0
    assert move.t[-1] == pytest.approx(move.duration)
    n = len(move.u)
    assert move.tried[n]
    assert not move.tried[n - 1]


def test_a_bound_on_the_way_makes_it_longer_and_is_kept():
    slow = HardBound("x", [-np.inf, -0.5], [np.inf, 0.5])
    move = shortest_move(MODEL, problem(hard=[slow]), estimate_of(MODEL, [0.0, 0.0]), rest_at(2.0))
    # 0.5 s up to speed, 0.5 s down, 0.25 m in them; the rest at 0.5 m/s
    assert move.duration == pytest.approx(1.0 + 1.75 / 0.5, abs=2 * DT)
    assert np.max(np.abs(move.x[:, 1])) <= 0.5 + 1e-6


def test_a_second_that_costs_little_lets_the_move_be_gentle():
    ocp, start = OCP(10, [0.0, 0.0], [1.0], [0.0], [-1.0], [1.0], terminal=np.zeros((2, 2))), [0.0, 0.0]
    duration = {
        price: shortest_move(MODEL, ocp, estimate_of(MODEL, start), rest_at(1.0), price=price).duration
        for price in (0.05, 0.5, np.inf)
    }
    assert duration[0.05] > duration[0.5] > duration[np.inf]
    # least of price T + 12 d^2 / T^3, which is the cheapest move of duration T: T^4 = 36 d^2 / price
    for price in (0.05, 0.5):
        assert duration[price] == pytest.approx((36 / price) ** 0.25, rel=0.05)


@pytest.mark.parametrize("what", ["x", "y"])
def test_an_input_that_acts_late_takes_as_many_periods_more(what):
    """A chain of three delays and an integrator: in plans of up to three periods no input reaches the target."""
    late = linear_model(
        np.array([[1.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0]]), np.eye(4)[:, 3:], np.eye(4)[:1]
    )
    goal = np.array([2.0]) if what == "y" else np.array([2.0, 0.0, 0.0, 0.0])
    width = 1e-3 if what == "y" else np.array([1e-3, 2.0, 2.0, 2.0])
    ocp = OCP(10, np.full(4, 1e-3), [1e-3], [0.0], [-1.0], [1.0])
    move = shortest_move(
        late, ocp, estimate_of(late, np.zeros(4)), HardBound(what, goal - width, goal + width, at_end=True),
        reference=[2.0, 0.0, 0.0, 0.0],
    )  # fmt: skip
    # outputs are bounded before the last period, states after it; two periods at the limit move 2
    assert len(move.u) == (6 if what == "y" else 5)


def test_within_the_target_a_period_is_enough():
    move = shortest_move(MODEL, problem(), estimate_of(MODEL, [0.5, 0.0]), rest_at(0.5))
    assert len(move.u) == 1
    assert move.duration == DT


@pytest.mark.parametrize("solver", [lambda m, o: CondensedController(m, o, iterations=30), IpoptController])
def test_other_solvers_find_as_short_a_move(solver):
    start = estimate_of(MODEL, [0.0, 0.0])
    own = shortest_move(MODEL, problem(), start, rest_at(0.3, 1e-2))
    other = shortest_move(MODEL, problem(), start, rest_at(0.3, 1e-2), controller=solver)
    assert abs(len(own.u) - len(other.u)) <= 1


def test_a_nonlinear_machine_with_hidden_state():
    model = pendulum_model()
    ocp = OCP(10, [1e-2, 1e-3], [1e-3], [0.0], [-2.0], [2.0])
    target = HardBound("x", [0.95, -0.1], [1.05, 0.1], at_end=True)
    start = estimate_of(model, [0.0, 0.0])
    move = shortest_move(model, ocp, start, target, longest=200)
    assert 0.95 - 1e-6 <= move.x[-1, 0] <= 1.05 + 1e-6  # solvers keep bounds to 1e-7 of their size
    z, h = move.x[0], start.h
    for k, u in enumerate(move.u):  # the model itself, from the begin
        z, h = (np.array(v).ravel() for v in model.step(z, h, u, model.w, model.p))
        np.testing.assert_allclose(z, move.x[k + 1], atol=1e-5)


@pytest.mark.parametrize(
    ("target", "options", "words"),
    [
        (HardBound("x", [0.9, -0.1], [1.1, 0.1]), {}, "HM-CONTROL-004"),
        (HardBound("y", [0.9], [1.1], at_end=True), {}, "HM-CONTROL-005"),
        (
            rest_at(0.1, 1e-2),
            {"longest": 8},
            r"0\.4.*x0 by.*HM-CONTROL-006",
        ),
    ],
)
def test_what_cannot_be_is_refused(target, options, words):
    with pytest.raises(InputError, match=words):
        shortest_move(MODEL, problem(), estimate_of(MODEL, [0.0, 0.0]), target, **options)
