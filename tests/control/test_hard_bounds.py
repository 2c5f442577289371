"""Hard bounds: kept wherever they can be, by every solver alike; where they cannot, the record says which gave way."""

import casadi as ca
import numpy as np
import pytest
from control_parts import estimate_of, pendulum_problem, plan_of
from online_models import linear_model, pendulum_model
from scipy.optimize import linprog

from hybrid_mpc import (
    OCP,
    CondensedController,
    HardBound,
    InputError,
    IpoptController,
    SafeController,
    SoftBound,
    SQPController,
    Status,
)
from hybrid_mpc.model.delay import with_input_delay
from hybrid_mpc.records import plain, record

DT = 0.1
A, B = np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.5 * DT**2], [DT]])
MODEL = linear_model(A, B, np.eye(2)[:1], dt=DT)
GOAL = np.array([[1.0, 0.0]])
X, U, W, P, TWO = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("w", 0), ca.MX.sym("p"), ca.MX.sym("two", 2)
SOLVERS = [lambda m, o: CondensedController(m, o, iterations=30), SQPController, IpoptController]


def problem(*hard, horizon=25, **others):
    return OCP(horizon, [10.0, 0.1], [0.01], [0.0], [-3.0], [3.0], hard=hard, **others)


def test_whatever_it_costs_a_bound_that_can_be_kept_is_kept():
    """A reference so far beyond the bound that its multiplier is above any fixed penalty."""
    ocp = problem(HardBound("x", [-np.inf, -np.inf], [0.8, np.inf]))
    plan = plan_of(CondensedController(MODEL, ocp), estimate_of(MODEL, [0.0, 0.0]), np.array([[1e6, 0.0]]))
    assert plan.status is Status.SOLVED
    assert dict(plan.given_way) == {}
    assert np.max(plan.x[:, 0]) <= 0.8 + 1e-6


def reachable(z, horizon=25, limit=0.5):
    """Whether some plan keeps the position below the limit, by a linear program."""
    by_u, x0 = np.zeros((horizon, horizon)), []
    state = np.array(z)
    for k in range(horizon):
        state = A @ state
        x0.append(state[0])
        for j in range(k + 1):
            by_u[k, j] = (np.linalg.matrix_power(A, k - j) @ B)[0, 0]
    answer = linprog(np.zeros(horizon), A_ub=by_u, b_ub=limit - np.array(x0), bounds=[(-3, 3)] * horizon)
    return answer.status == 0


def test_a_bound_gives_way_only_where_a_linear_program_proves_that_it_must():
    ocp, rng, seen = (
        problem(HardBound("x", [-np.inf, -np.inf], [0.5, np.inf])),
        np.random.default_rng(0),
        set(),
    )
    controller = CondensedController(MODEL, ocp)
    for _ in range(60):
        z = rng.uniform([-0.5, 0.0], [0.52, 3.0])
        plan = plan_of(controller, estimate_of(MODEL, z), GOAL)
        assert plan.status is Status.SOLVED
        assert np.max(np.abs(plan.u)) <= 3.0
        assert (not plan.given_way) == reachable(z), z
        seen.add(bool(plan.given_way))
    assert seen == {True, False}


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_cannot_be_kept_is_exceeded_as_little_as_can_be(solver):
    """Full braking, while the bound is out of reach, and the record names it."""
    ocp = problem(HardBound("x", [-np.inf, -np.inf], [0.5, np.inf]))
    plan = plan_of(solver(MODEL, ocp), estimate_of(MODEL, [0.45, 1.0]), np.zeros((1, 2)))
    assert plan.status is Status.SOLVED
    brake = np.array([0.45, 1.0])
    for k in range(1, 4):
        brake = A @ brake + B @ [-3.0]
        np.testing.assert_allclose(plan.x[k], brake, atol=1e-5)
    # the violation is counted from 1e-7 of its size on
    assert plan.given_way == {"x0": pytest.approx(np.max(plan.x[:, 0]) - 0.5, abs=1e-6)}
    assert plan.excess == 0.0  # that of soft bounds


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("first", "second", "given"), [(0, 1, "x0"), (1, 0, "x1")])
def test_the_lower_priority_gives_way_first(solver, first, second, given):
    """Position and braking speed contradict each other: at 1 m/s towards the wall."""
    wall = HardBound("x", [-np.inf, -np.inf], [0.5, np.inf], priority=first)
    gentle = HardBound(ca.Function("x1", [X, U], [U]), [-1.0], [np.inf], priority=second)
    plan = plan_of(solver(MODEL, problem(wall, gentle)), estimate_of(MODEL, [0.2, 1.0]), np.zeros((1, 2)))
    assert plan.status is Status.SOLVED
    assert set(plan.given_way) == {given}
    assert plan.given_way[given] > 1e-2


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_obstacle_that_moves_is_seen_ahead(solver):
    """The bound is a column of the reference; the plan keeps below it before it comes."""
    expression = ca.Function("wall", [X, U, W, P], [X[0] - P])
    ocp = problem(HardBound(expression, [-np.inf], [0.0]), horizon=30)
    assert ocp.columns == 3
    wall = np.concatenate([np.full(15, 2.0), np.full(16, 0.4)])
    reference = np.column_stack([np.ones(31), np.zeros(31), wall])
    plan = plan_of(solver(MODEL, ocp), estimate_of(MODEL, [0.0, 0.0]), reference)
    assert plan.status is Status.SOLVED
    assert not plan.given_way
    assert np.all(plan.x[:-1, 0] <= wall[:-1] + 1e-6)
    assert np.max(plan.x[15:30, 0]) == pytest.approx(0.4, abs=1e-5)
    assert np.max(plan.x[:15, 0]) > 0.5  # while there is room it is used


@pytest.mark.parametrize("what", ["y", "expression", "product"])
def test_outputs_and_expressions_are_bounded_alike_by_all_solvers(what):
    model = pendulum_model(z=3)
    product = ca.Function("power", [X, U], [U * X[1]])
    bound = {
        "y": HardBound("y", [-np.inf], [0.3]),
        "expression": HardBound(ca.Function("angle", [X, U], [X[0]]), [-np.inf], [0.3]),
        "product": HardBound(product, [-np.inf], [0.6]),
    }[what]
    ocp = pendulum_problem(30, 2.0, 0.1, hard=[bound])
    plans = [plan_of(s(model, ocp), estimate_of(model, [-0.2, 0.0]), np.array([[0.5, 0.0]])) for s in SOLVERS]
    values = [p.x[:-1, 0] if what != "product" else p.u[:, 0] * p.x[:-1, 1] for p in plans]
    for plan, value in zip(plans, values, strict=True):
        assert plan.status is Status.SOLVED
        assert not plan.given_way
        assert np.max(value) == pytest.approx(0.6 if what == "product" else 0.3, abs=1e-5)
        # Gauss-Newton stops within 1e-5 of the cost where its steps stop to matter
        assert plan.cost == pytest.approx(plans[1].cost, rel=1e-4)


def test_the_first_stage_that_is_bounded_is_the_first_that_an_input_reaches():
    late = with_input_delay(MODEL, 0.3)
    ocp = problem(HardBound("x", [-np.inf, -np.inf], [0.5, np.inf]))
    rows = CondensedController(late, ocp).problem.soft
    bounded = rows.stage[rows.hard & np.isfinite(rows.upper)]
    assert bounded.min() == 4  # three periods on their way, and one to act
    plan = plan_of(CondensedController(late, ocp), estimate_of(late, [0.55, -1.0]), np.zeros((1, 2)))
    assert not plan.given_way  # beyond the bound while no input can help, then not
    power = HardBound(ca.Function("power", [X, U], [U * X[1]]), [-1.0], [1.0])
    rows = CondensedController(MODEL, problem(power)).problem.soft
    assert np.all(np.isfinite(rows.upper))  # the input itself is in it


def test_a_loop_never_raises_and_keeps_the_inputs_limits():
    ocp = problem(HardBound("x", [-0.2, -0.4], [0.5, 0.4]), du_max=[0.5])
    safe = SafeController(CondensedController(MODEL, ocp), MODEL)
    rng, z, ways = np.random.default_rng(1), np.array([0.0, 0.0]), 0
    decision = safe.initial(estimate_of(MODEL, z))
    for k in range(120):
        held = decision.u
        decision = safe.decide(
            decision, estimate_of(MODEL, z + 0.02 * rng.normal(size=2)), GOAL * (-1) ** (k // 40)
        )
        assert decision.status.ok
        assert np.abs(decision.u) <= 3.0
        assert np.abs(decision.u - held) <= 0.5 + 1e-9
        ways += bool(decision.solution.given_way)
        z = A @ z + B @ decision.u + (k == 60) * np.array([0.0, 1.0])  # a push
    assert 0 < ways < 60  # noise of 0.02 at bounds, and the push


def test_a_problem_with_hard_bounds_is_plain_data():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 0), ca.SX.sym("p")
    expression = ca.Function("wall", [x, u, w, p], [x[0] - p])
    ocp = problem(HardBound("x", [-1.0, -np.inf], [1.0, 2.0], 3), HardBound(expression, [-np.inf], [0.0]))
    again = record(OCP, plain(ocp), "ocp.json")
    assert again == ocp
    assert hash(again) == hash(ocp)
    assert again.hard[0].priority == 3
    assert again != ocp.changed(hard=[HardBound("x", [-1.0, -np.inf], [1.0, 2.0], 2), ocp.hard[1]])
    assert again != ocp.changed(hard=[HardBound("x", [-1.0, -np.inf], [1.0, 2.0], 3)])
    reference = np.array([[1.0, 0.0, 0.7]])
    plans = [
        plan_of(CondensedController(MODEL, o), estimate_of(MODEL, [0.0, 0.0]), reference).u
        for o in (ocp, again)
    ]
    np.testing.assert_array_equal(*plans)


def test_ranges_are_the_tighter_of_soft_and_hard_bounds():
    ocp = problem(HardBound("x", [-1.0, -2.0], [np.inf, 2.0]), x_min=[-3.0, -1.0], x_max=[0.5, 3.0])
    np.testing.assert_array_equal(ocp.state_range, [[-1.0, -1.0], [0.5, 2.0]])
    np.testing.assert_array_equal(problem(HardBound("y", [-1.0], [2.0])).output_range(1), [[-1.0], [2.0]])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: HardBound("z", [0.0], [1.0]), "HM-CONTROL-045"),
        (lambda: HardBound(ca.Function("f", [X], [X]), [0.0] * 2, [1.0] * 2), "HM-CONTROL-045"),
        (lambda: HardBound("x", [1.0, 1.0], [0.0, 2.0]), "HM-CONTROL-051"),
        (lambda: HardBound("x", [1.0], [2.0, 2.0]), "HM-CONTROL-052"),
        (lambda: HardBound("x", [0.0], [1.0], 0.5), "HM-CONTROL-046"),
        (lambda: problem(HardBound("x", [0.0], [1.0])), "HM-CONTROL-015"),
        (lambda: problem("x"), r"HardBound\(what"),
        (lambda: CondensedController(MODEL, problem(HardBound("y", [0.0] * 2, [1.0] * 2))), "HM-CONTROL-037"),
        (
            lambda: CondensedController(
                MODEL, problem(HardBound(ca.Function("none", [X, U], [ca.MX(1.0)]), [0.0], [2.0]))
            ),
            r"none.*HM-CONTROL-030",
        ),
        (
            lambda: CondensedController(
                with_input_delay(MODEL, 3.0), problem(HardBound("x", [-1.0, -np.inf], [1.0, np.inf]))
            ),
            r"x0.*HM-CONTROL-030",
        ),
        (
            lambda: problem(
                HardBound(ca.Function("a", [X, U, W, P], [P]), [0.0], [2.0]),
                soft=[SoftBound(ca.Function("b", [X, U, W, TWO], [X[0]]), [0.0], [2.0], [1.0], [1.0])],
            ),
            "HM-CONTROL-016",
        ),
    ],
)  # fmt: skip
def test_bad_hard_bounds_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
