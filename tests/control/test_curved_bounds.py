"""Bounds on curved functions: what real-time iterations keep, what they report, and what is applied."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import (
    OCP,
    CondensedController,
    ExtendedKalmanFilter,
    HardBound,
    HybridModel,
    Limits,
    Loop,
    SafeController,
    Signal,
    SoftBound,
    SQPController,
    TrueState,
    make_controller,
)
from hybrid_mpc.control.problem import Problem, Status
from hybrid_mpc.control.safeguard import Source
from hybrid_mpc.records import plain, record

X, U = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
PLACE = tuple(Signal(name, "m", -20.0, 20.0) for name in "ab")
SPEED = tuple(Signal(name, "m/s", -1.0, 1.0) for name in ("va", "vb"))
PLANE = HybridModel.of("plane", 0.05, PLACE, SPEED, PLACE, x=X, u=U, x_next=X + 0.05 * U, xdot=U, y=X)
FREE = OCP(20, [1.0, 1.0], [0.0, 0.0], [1e-4, 1e-4], [-1.0, -1.0], [1.0, 1.0])
CIRCLE = ca.Function("speed", [X, U], [ca.sumsqr(U)])
INSIDE = HardBound(CIRCLE, [-np.inf], [1.0])
SOFT = SoftBound(CIRCLE, [-np.inf], [1.0], linear=[1e3], quadratic=[1e3])
GOAL = np.array([[5.0, 3.0]])


def loop_of(controller):
    observer = ExtendedKalmanFilter(PLANE, sigma_y=[1e-3] * 2, sigma_x=[1e-4] * 2, sigma_x0=[0.1] * 2)
    return Loop(
        observer, SafeController(controller, fallback=PLANE, safe_input=[0.0, 0.0]), reference=[0.0, 0.0]
    )


@pytest.mark.parametrize("solver", ["rti", "native"])
@pytest.mark.parametrize(
    "ocp", [FREE.changed(hard=[INSIDE]), FREE.changed(soft=[SOFT])], ids=["hard", "soft"]
)
def test_a_circle_of_speeds_is_kept_from_the_first_step_on(solver, ocp):
    """At rest the slope of the circle is zero: its linearization knows of no bound."""
    controller = make_controller(PLANE, PLANE, ocp, solver=solver, safe_input=[0.0, 0.0]).controller
    loop, x = loop_of(controller), np.zeros(2)
    u = loop.start(x)
    for k in range(40):
        x = x + 0.05 * u
        loop.finish()
        u = loop.step(x, reference=[0.0, 0.0] if k < 3 else GOAL[0])
        plan = loop.decision.solution
        # 1e-6: the tolerance of soft bounds; before there were plans at 2
        assert np.max(np.sum(plan.u**2, axis=1)) < 1 + 1e-5, k
        assert not plan.given_way, k
        if k > 4:
            assert np.hypot(*u) == pytest.approx(1.0, abs=1e-3), k


@pytest.mark.parametrize(
    "ocp", [FREE.changed(hard=[INSIDE]), FREE.changed(soft=[SOFT])], ids=["hard", "soft"]
)
def test_the_plan_is_that_of_sqp(ocp):
    estimate = TrueState(PLANE).start([0.3, -0.2])
    rti, sqp = CondensedController(PLANE, ocp), SQPController(PLANE, ocp)
    plan = rti.initial(estimate)
    for _ in range(3):
        plan = rti.solve(plan, estimate, GOAL).delayed(np.zeros(2))
    last = rti.solve(plan, estimate, GOAL)
    wanted = sqp.solve(sqp.initial(estimate), estimate, GOAL)
    # both are optimal to the tolerance of their checks
    assert last.cost == pytest.approx(wanted.cost, rel=1e-5)


def report(ocp, plan, e=None):
    """``excess`` and ``given_way`` by the bounded values along the plan."""
    rows = Problem(PLANE, ocp).soft
    excess = rows.excess(rows.values(plan.x, plan.u))
    return rows.largest(excess), rows.given_way(excess)


@pytest.mark.parametrize("solver", ["rti", "native"])
def test_excess_and_given_way_are_those_of_the_functions_along_the_plan(solver):
    """From random states with old plans: some violate curved bounds, which no linearization shows."""
    far = HardBound(
        ca.Function("far", [X, U], [ca.sumsqr(X) + 0.1 * ca.sumsqr(U)]), [-np.inf], [4.0], priority=1
    )
    near = SoftBound(
        ca.Function("near", [X, U], [ca.vertcat(X[0] * U[1], ca.sumsqr(X))]),
        [-0.2, -np.inf], [0.2, 1.0], [0.1, 0.1], [0.1, 0.1],
    )  # fmt: skip
    ocp = FREE.changed(hard=[INSIDE, far], soft=[near], q=[1.0, 4.0])
    controller = make_controller(PLANE, PLANE, ocp, solver=solver, safe_input=[0.0, 0.0]).controller
    rng, seen = np.random.default_rng(3), {"excess": 0, "speed": 0, "far": 0, "kept": 0}
    plan = controller.initial(TrueState(PLANE).start([0.0, 0.0]))
    for _ in range(40):
        estimate = TrueState(PLANE).start(rng.uniform(-2.0, 2.0, 2))
        plan = controller.solve(plan, estimate, rng.uniform(-2.0, 2.0, (1, 2)))
        assert plan.status is Status.SOLVED
        excess, way = report(ocp, plan)
        assert plan.excess == pytest.approx(excess, abs=1e-9)
        assert dict(plan.given_way) == {name: pytest.approx(v, abs=1e-9) for name, v in way.items()}
        for name in way:
            seen[name] += 1
        seen["excess"] += excess > 1e-3
        seen["kept"] += not way
    assert min(seen["excess"], seen["far"], seen["kept"]) > 0, seen


def test_affine_bounds_need_no_further_evaluation():
    plane = HardBound(ca.Function("sum", [X, U], [U[0] + U[1]]), [-np.inf], [1.0])
    assert not Problem(PLANE, FREE.changed(hard=[plane])).soft.curved
    moved = ca.Function("moved", [X, U, ca.SX.sym("w", 0), p := ca.SX.sym("p")], [p**2 * X[0] - U[0]])
    assert not Problem(PLANE, FREE.changed(hard=[HardBound(moved, [-np.inf], [1.0])])).soft.curved
    assert Problem(PLANE, FREE.changed(hard=[INSIDE])).soft.curved


@pytest.mark.parametrize(
    ("u", "held", "limits", "applied"),
    [
        ([0.6, 0.6], [0.0, 0.0], None, [0.6, 0.6]),
        ([1.0, 1.0], [0.0, 0.0], None, [0.5**0.5, 0.5**0.5]),
        ([1.0, 1.0], [1.0, 0.0], None, [1.0, 0.0]),  # the whole way back
        ([1.0, 1.0], [0.9, 0.9], None, [0.5**0.5, 0.5**0.5]),  # the held input violates the bound too
        ([9.0, 9.0], [0.0, 0.0], Limits([-1.0, -1.0], [0.8, 0.8]), [0.5**0.5, 0.5**0.5]),
    ],
)
def test_an_input_beyond_a_bound_of_inputs_moves_back(u, held, limits, applied):
    bounds = Problem(PLANE, FREE.changed(hard=[INSIDE])).soft.on_inputs
    got, way = bounds.keep(np.array(u), np.array(held), limits)
    np.testing.assert_allclose(got, applied, atol=4e-4)  # along the circle, 3e-4 exceeds it by 1e-7
    assert np.sum(got**2) <= 1 + 1e-6
    assert set(way) == (set() if applied == u else {"speed"})


def test_only_hard_bounds_of_inputs_alone_move_inputs():
    mixed = HardBound(
        ca.Function("mixed", [X, U], [ca.vertcat(U[0] + X[0], U[1] ** 2)]), [-1.0, -1.0], [9.0, 0.25]
    )
    ocp = FREE.changed(hard=[mixed, HardBound(CIRCLE, [-1.0], [0.1], at_end=True)], soft=[SOFT])
    bounds = Problem(PLANE, ocp).soft.on_inputs
    assert bounds.names == ("mixed[1]",)
    assert bounds.given_way(np.array([1.0, 1.0])) == {"mixed[1]": pytest.approx(0.75, abs=1e-6)}


@pytest.mark.parametrize(
    "hard", [INSIDE, HardBound(ca.Function("sum", [X, U], [U[0] + U[1]]), [-1.0], [1.0])]
)
def test_the_fallback_keeps_bounds_of_inputs_and_says_so(hard):
    safe = SafeController(
        CondensedController(PLANE, FREE.changed(hard=[hard])),
        fallback=PLANE,
        max_age=0,
        safe_input=[0.0, 0.0],
    )
    estimate = TrueState(PLANE).start([-9.0, -9.0])
    decision = safe.decide(safe.initial(estimate), estimate, np.full((1, 2), np.nan))
    assert decision.source is Source.FALLBACK
    name = hard.what.name()
    assert float(hard.what(np.zeros(2), decision.u)) == pytest.approx(1.0, abs=1e-6)
    assert decision.solution.given_way == {name: pytest.approx(1.0, abs=1e-6)}  # two at the corner of the box


def test_an_old_plan_keeps_them_too():
    safe = SafeController(CondensedController(PLANE, FREE.changed(hard=[INSIDE])), safe_input=[0.0, 0.0])
    estimate = TrueState(PLANE).start([0.0, 0.0])
    first = safe.initial(estimate)
    beyond = replace(first, solution=replace(first.solution, u=np.ones((20, 2))))
    decision = safe.late(beyond, estimate, GOAL)
    assert decision.source is Source.PLAN
    assert np.hypot(*decision.u) == pytest.approx(1.0, abs=1e-6)
    assert decision.solution.given_way == {"speed": pytest.approx(1.0, abs=1e-6)}


def test_a_stored_bound_keeps_its_name():
    ocp = FREE.changed(hard=[INSIDE])
    again = record(OCP, plain(ocp), "ocp.json")
    assert again == ocp
    assert again.hard[0].what.name() == "speed"
    data = plain(ocp)
    data["hard"][0]["what"]["metadata"]["name"] = "no name"
    assert record(OCP, data, "ocp.json").hard[0].what.name() == "program"
