"""The target calculator, and problems that weigh outputs, on machines whose rest is not zero."""

import casadi as ca
import machines
import numpy as np
import pytest
from control_parts import plan_of
from gated import gated, saturated
from machines import AMBIENT, HEAT, dc_motor, rest_levels, thermal, two_tanks
from scipy.optimize import minimize_scalar

from hybrid_mpc import (
    OCP,
    CondensedController,
    Disturbance,
    Estimate,
    HybridModel,
    InputError,
    IpoptController,
    SafeController,
    Signal,
    SoftBound,
    SQPController,
    Status,
    Targets,
    dare,
    linearize,
)
from hybrid_mpc.control import targets as targets_module
from hybrid_mpc.model.equilibrium import WAIT

TANKS = {"q": [0.0, 0.0], "r": [1e6], "r_delta": [1e6], "u_min": [5e-5], "u_max": [4e-4], "q_y": [1.0]}
HEATERS = {"q": [0.0] * 2, "r": [0.1] * 2, "r_delta": [0.1] * 2, "u_min": [0.0] * 2, "u_max": [20.0] * 2}
SOLVERS = (CondensedController, SQPController, IpoptController)


def estimate_at(model, x=None, d=None, w=None):
    d = np.zeros(model.n_d) if d is None else np.asarray(d, dtype=float)
    x = model.x0 if x is None else np.asarray(x, dtype=float)
    size = x.size + d.size
    w = model.w if w is None else np.asarray(w, dtype=float)
    return Estimate(0.0, x, np.zeros(0), d, np.eye(size), np.full(model.n_y, np.nan), np.nan, w=w)


def solved_by_ipopt(model, ocp, y_ref, d, w):
    """The steady state nearest to a set-point, by IPOPT on its definition; inputs near the operating point's."""
    on_u, on_x, on_y = model.disturbed
    x, scaled = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u)
    u = ocp.input_scale * scaled
    acting = u + on_u @ d
    x_next = model.step(x, [], acting, w, model.p)[0] + on_x @ d
    y = model.output(x, acting, w, model.p) + on_y @ d
    far = (u - model.u0) / ocp.input_scale
    cost = ca.dot(ocp.q_y, (y - y_ref) ** 2) + 1e-7 * ca.dot(far, far)
    nlp = {"x": ca.vertcat(x, scaled), "f": cost, "g": x_next - x}
    options = {"print_level": 0, "sb": "yes", "tol": 1e-12, "bound_relax_factor": 0.0}
    solver = ca.nlpsol("target", "ipopt", nlp, {"ipopt": options, "print_time": 0})
    low = [s.lower for s in model.states]
    high = [s.upper for s in model.states]
    size = ocp.input_scale
    answer = solver(
        x0=np.concatenate([model.x0, model.u0 / size]), lbg=0, ubg=0, lbx=[*low, *(ocp.u_min / size)],
        ubx=[*high, *(ocp.u_max / size)],
    )  # fmt: skip
    x, u = np.split(answer["x"].full().ravel(), [model.n_x])
    return x, u * size


@pytest.mark.parametrize(
    ("goal", "d", "inflow"),
    [(0.3, 0.0, 4e-5), (0.6, 2e-5, 4e-5), (0.1, -1e-5, 1e-4), (1.9, 0.0, 4e-5), (0.05, 0.0, 1e-4)],
)
def test_targets_are_those_of_a_solver_also_beyond_reach(goal, d, inflow):
    model, ocp = two_tanks(), OCP(5, **TANKS)
    found = Targets(model, ocp).at([goal], [d], [inflow])
    x, u = solved_by_ipopt(model, ocp, [goal], np.array([d]), np.array([inflow]))
    assert found.steady
    np.testing.assert_allclose(found.x, x, atol=2e-5)  # IPOPT's barrier holds it off a bound, here the pump's
    np.testing.assert_allclose(found.u, u, atol=1e-8)
    assert found.reached == (goal in (0.3, 0.6, 0.1))
    upper, lower = rest_levels(found.u[0] + d, inflow)
    np.testing.assert_allclose(found.x, [upper, lower], rtol=1e-6)


@pytest.mark.parametrize("goal", [[45.0, 40.0], [100.0, 20.0], [30.0, 55.0], [20.0, 20.0]])
def test_two_inputs_and_two_outputs(goal):
    model, ocp = thermal(), OCP(5, **HEATERS, q_y=[1.0, 4.0])
    found = Targets(model, ocp).at(goal)
    x, u = solved_by_ipopt(model, ocp, goal, np.zeros(2), np.zeros(0))
    np.testing.assert_allclose(found.x, x, atol=1e-4)
    np.testing.assert_allclose(found.u, u, atol=1e-4)
    assert found.reached == bool(np.max(np.abs(x - goal)) < 1e-3)


def test_the_nearest_of_an_output_too_many_is_taken_and_reported():
    model = dc_motor()
    ocp = OCP(5, [0.0, 0.0], [0.1], [0.1], [-12.0], [12.0], q_y=[1.0, 1.0])
    found = Targets(model, ocp).at([0.7, 40.0])  # current and speed by one voltage
    x, _ = solved_by_ipopt(model, ocp, [0.7, 40.0], np.zeros(1), np.zeros(0))
    assert found.steady
    assert not found.reached
    np.testing.assert_allclose(found.x, x, rtol=1e-5)
    one = Targets(model, ocp.changed(q_y=[0.0, 1.0])).at([np.nan, 40.0])
    assert one.reached
    np.testing.assert_allclose(one.y[1], 40.0)


def test_of_several_inputs_the_nearest_to_the_operating_point_is_taken():
    """Two pumps fill one tank that leaks: any sum of the right size holds the level."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u", 2)
    level, pumps = (Signal("level", "m"),), (Signal("a", "-"), Signal("b", "-"))
    model = HybridModel.of(
        "two pumps", 1.0, level, pumps, level, x=x, u=u, y=x, x_next=0.5 * x + u[0] + u[1], xdot=-x + u[0] + u[1],
        nominal_x=[2.0], nominal_u=[0.6, 0.4],
    )  # fmt: skip
    ocp = OCP(5, [0.0], [1.0, 1.0], [0.0, 0.0], [0.0, 0.0], [2.0, 1.0], q_y=[1.0])
    free = Targets(model, ocp).at([3.0])
    # equal shares of what is missing in scales of half the ranges, 1 and 0.5: min (du_a)^2 + (2 du_b)^2, sum 0.5
    np.testing.assert_allclose(free.u, [0.6 + 0.4, 0.4 + 0.1], rtol=1e-6)
    full = Targets(model, ocp.changed(u_max=[0.7, 1.0])).at([3.0])
    assert full.reached
    np.testing.assert_allclose(full.u, [0.7, 0.8], atol=1e-5)


def test_bounds_of_outputs_hold_for_targets_too():
    model = two_tanks()
    found = Targets(model, OCP(5, **TANKS, y_max=[0.4])).at([0.6])
    assert found.steady
    assert not found.reached
    np.testing.assert_allclose(found.y, 0.4, rtol=1e-6)


def test_disturbances_of_rates_and_outputs_are_made_good():
    model = two_tanks(disturbance_model=(Disturbance("rate", "lower", 1e-3),))
    found = Targets(model, OCP(5, **TANKS)).at([0.3], [-5e-4])
    x_next = model.step(found.x, [], found.u, model.w, model.p)[0].full().ravel() + 5.0 * np.array(
        [0.0, -5e-4]
    )
    np.testing.assert_allclose(x_next, found.x, atol=1e-12)
    assert found.y == pytest.approx(0.3)
    sensor = two_tanks(disturbance_model=(Disturbance("output", "lower", 0.1),))
    assert Targets(sensor, OCP(5, **TANKS)).at([0.3], [0.05]).x[1] == pytest.approx(0.25)


def test_what_does_not_fit_is_refused():
    model = two_tanks()
    with pytest.raises(InputError, match="HM-CONTROL-054"):
        Targets(model, OCP(5, **{**TANKS, "q_y": [1.0, 1.0]}))
    with pytest.raises(InputError, match="HM-CONTROL-055"):
        Targets(model, OCP(5, **TANKS)).at([np.nan])
    with pytest.raises(InputError, match=r"y_min.*HM-CONTROL-036"):
        CondensedController(model, OCP(5, **{**TANKS, "q_y": ()}, y_max=[1.0, 1.0]))


@pytest.mark.parametrize("solver", SOLVERS)
def test_lq_is_the_lqr_around_the_operating_point(solver):
    """Weights on outputs, no limit active: the first input is the LQR's around the target, wherever it lies."""
    model = thermal()
    ocp = OCP(15, **HEATERS, q_y=[1.0, 2.0]).changed(r_delta=[0.0, 0.0])
    goal = model.x0 + np.array([1.0, -0.5])
    steady = Targets(model, ocp).at(goal)
    x = goal + np.array([0.4, 0.3])
    system = linearize(model, model.x0, model.u0)
    gain = dare(system.A, system.B, np.diag([1.0, 2.0]) * model.dt, np.diag(ocp.r) * model.dt)[1]
    plan = plan_of(solver(model, ocp), estimate_at(model, x), goal[None])
    assert plan.status is Status.SOLVED
    np.testing.assert_allclose(plan.u[0], steady.u - gain @ (x - goal), atol=1e-5)
    np.testing.assert_allclose(ocp.terminal_weight(model), dare(*ocp.linear_quadratic(model))[0])


@pytest.mark.parametrize("solver", SOLVERS)
def test_at_the_operating_point_nothing_is_to_do(solver):
    for model, ocp in ((two_tanks(), OCP(10, **TANKS)), (thermal(), OCP(10, **HEATERS, q_y=[1.0, 1.0]))):
        controller = solver(model, ocp)
        plan = plan_of(controller, estimate_at(model), controller.problem.standing())
        np.testing.assert_allclose(plan.u, np.tile(model.u0, (10, 1)), rtol=1e-4)
        states = ocp.changed(
            q_y=(), q=[1.0, 1.0]
        )  # references of states: the operating point's input is the target
        controller = solver(model, states)
        assert controller.problem.standing().tolist() == [model.x0.tolist()]
        plan = plan_of(controller, estimate_at(model), controller.problem.standing())
        np.testing.assert_allclose(plan.u, np.tile(model.u0, (10, 1)), rtol=1e-4)


@pytest.mark.parametrize("kind", [None, "rate"])
def test_all_solvers_agree_on_outputs_bounds_and_what_comes(kind):
    """Weights and bounds on outputs, expressions of w, unmeasured and previewed measured disturbances."""
    chosen = None if kind is None else (Disturbance(kind, "lower", 1e-3),)
    model = two_tanks(disturbance_model=chosen)
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    together = SoftBound(ca.Function("flows", [x, u, w], [1e4 * (u + w)]), [-np.inf], [4.0], [1e-4], [1e-4])
    ocp = OCP(20, **{**TANKS, "r": [1e4], "r_delta": [1e4]}, y_max=[0.36], soft=[together])
    inflow = np.where(np.arange(20) < 8, 4e-5, 1.6e-4)[:, None]
    given = estimate_at(model, [0.16, 0.17], [2e-5 if kind is None else -2e-4], inflow[0]), np.array([[0.34]])
    sqp, ipopt, rti = (
        plan_of(s, *given, w=inflow)
        for s in (
            SQPController(model, ocp),
            IpoptController(model, ocp),
            CondensedController(model, ocp, iterations=30),
        )
    )
    assert sqp.status is ipopt.status is rti.status is Status.SOLVED
    assert sqp.cost == pytest.approx(ipopt.cost, rel=1e-6)
    np.testing.assert_allclose(sqp.u, ipopt.u, atol=2e-7)
    np.testing.assert_allclose(rti.u, ipopt.u, atol=2e-7)
    np.testing.assert_array_equal(sqp.w, inflow)
    assert np.max(1e4 * (sqp.u + inflow)) > 3.9  # the bound on both flows acts
    held = plan_of(SQPController(model, ocp), *given)
    assert np.max(np.abs(held.u - sqp.u)) > 1e-6


def test_limits_hold_whatever_is_asked():
    rng = np.random.default_rng(0)
    model, ocp = thermal(), OCP(8, **HEATERS, du_max=[3.0, 3.0], q_y=[1.0, 1.0])
    safe = SafeController(CondensedController(model, ocp), model, safe_input=[0.0, 0.0])
    decision = safe.initial(estimate_at(model))
    np.testing.assert_array_equal(decision.u, HEAT)
    for _ in range(15):
        x, d = AMBIENT + rng.normal(size=2) * 60, rng.normal(size=2) * 10
        goal = rng.choice([rng.uniform(-200, 400), np.nan], p=[0.8, 0.2], size=2)
        before, decision = decision, safe.decide(decision, estimate_at(model, x, d), goal[None])
        assert np.all((decision.u >= 0) & (decision.u <= 20))
        assert np.all(np.abs(decision.u - before.u) <= 3.0 + 1e-12)


def test_a_fallback_holds_the_set_point():
    """The feedback that takes over leads to the target's steady state, given the estimated disturbance."""
    model, ocp = two_tanks(), OCP(10, **TANKS)
    safe = SafeController(CondensedController(model, ocp), model, max_age=0, safe_input=[5e-5])
    goal, load = np.array([[0.36]]), 1e-5
    x, decision = model.x0, safe.initial(estimate_at(model))
    for _ in range(400):
        decision = safe.late(decision, estimate_at(model, x, [load]), goal)
        assert decision.source.name == "FALLBACK"
        x = model.step(x, [], decision.u + load, model.w, model.p)[0].full().ravel()
    assert x[1] == pytest.approx(0.36, abs=1e-9)
    states = ocp.changed(q_y=(), q=[1.0, 1.0])
    safe = SafeController(CondensedController(model, states), model, max_age=0)
    for _ in range(400):
        decision = safe.late(decision, estimate_at(model, x, [load]), model.x0[None])
        x = model.step(x, [], decision.u + load, model.w, model.p)[0].full().ravel()
    np.testing.assert_allclose(x, model.x0, rtol=1e-6)


def test_a_moving_reference_of_outputs_has_targets_between_a_few_steady_states():
    model, ocp = two_tanks(), OCP(30, **TANKS)
    problem = CondensedController(model, ocp).problem
    course = 0.3 + 0.1 * np.sin(0.1 * np.arange(31))[:, None]
    target = problem.target(course, None, estimate_at(model))
    exact = [problem.targets.at(row) for row in course]
    np.testing.assert_allclose(target.y, course)
    np.testing.assert_allclose(target.x, [s.x for s in exact], atol=0.01)
    steps = problem.target(np.where(np.arange(31) < 12, 0.2, 0.4)[:, None], None, estimate_at(model))
    np.testing.assert_allclose(steps.x[:, 1], np.where(np.arange(31) < 12, 0.2, 0.4), rtol=1e-6)


def test_the_last_steady_state_needs_no_settling_of_the_hidden_state(monkeypatch):
    """A network's memory may take a thousand steps to settle, in every period of every loop."""
    model, ocp = two_tanks(dt=10.0), OCP(10, **TANKS)
    start, targets = Targets(model, ocp).at([0.25]), Targets(model, ocp)

    def settled(*_, **__):
        raise AssertionError("asked for")

    monkeypatch.setattr(targets_module, "hidden_fixed_point", settled)
    assert targets.at([0.26], start=start).reached


def pumped(rate):
    """A level that rises with ``rate(u)``, a pump within +-1."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    level = (Signal("x", "m"),)
    model = HybridModel.of("level", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, y=x, x_next=x + rate(u),
                           xdot=rate(u))  # fmt: skip
    return Targets(model, OCP(5, [0.0], [1.0], [0.0], [-1.0], [1.0], q_y=[1.0]))


def test_newton_begins_beside_the_operating_point_where_it_stops_there():
    """At 0.05 the rate has its least magnitude near rest, as with a machine that sticks; only -0.12 holds the level."""
    found = pumped(lambda u: u**3 - 0.0075 * u + 7.2e-4).at([0.0])
    assert found.reached
    assert found.u**3 - 0.0075 * found.u == pytest.approx(-7.2e-4)


def test_a_set_point_leaves_a_standstill_where_the_sensor_shows_no_slope():
    """The size alone shows of what pump and leak make together: with the leak, more of the pump seems to be less."""
    x, u, shown = ca.SX.sym("x"), ca.SX.sym("u"), (Signal("shown", "m"),)
    rate = ca.sqrt(u**2 + 0.0025) - 0.05 - x
    model = HybridModel.of(
        "counting", 1.0, shown, (Signal("u", "-"),), shown, x=x, u=u, x_next=x + 0.1 * rate, xdot=rate, y=x,
        nominal_x=[1.0], nominal_u=[1.05], disturbance_model=(Disturbance("input", "u", 2.0),),
    )  # fmt: skip
    targets = Targets(model, OCP(5, [0.0], [1.0], [0.1], [0.0], [3.0], q_y=[1.0]))
    standing = targets.at([0.0], start=targets.at([1.0]))
    assert standing.reached
    going = targets.at([1.0], d=[-0.3], start=standing)
    assert going.reached
    assert going.u == pytest.approx([np.sqrt(1.05**2 - 0.0025) + 0.3], abs=1e-6)
    far = targets.at([4.0], start=standing)  # beyond the input's limit
    assert (far.u.round(6), far.reached) == (3.0, False)


def test_a_search_for_what_does_not_exist_ends_soon():
    targets, points = pumped(lambda u: (u - 0.3) ** 2 + 0.01), []
    evaluated = targets._equations.rest
    targets._equations.rest = lambda v: points.append(v) or evaluated(v)
    assert not targets.at([0.0]).steady
    assert len(points) < 200  # of 240 steps that four descents may make, each with a dozen points


def test_a_period_searches_widely_once(monkeypatch):
    targets_at, wide = Targets.at, []

    def at(self, *args, **options):
        wide.append(options["wide"])
        return targets_at(self, *args, **options)

    monkeypatch.setattr(Targets, "at", at)
    model = pumped(lambda u: (u - 0.3) ** 2 + 0.01).model
    problem = CondensedController(model, OCP(9, [0.0], [1.0], [0.1], [-1.0], [1.0], q_y=[1.0])).problem
    wide.clear()
    problem.target(np.arange(10.0)[:, None])
    assert wide == [True] + [False] * 7


@pytest.mark.parametrize("seed", range(3))
def test_a_network_s_memory_is_brought_to_rest_on_the_way(seed):
    model = saturated(seed, 24)
    ocp = OCP(10, [0.0, 0.0], [0.1, 0.1], [0.1, 0.1], [-3.0, -3.0], [3.0, 3.0], q_y=[100.0, 100.0])
    targets = Targets(model, ocp)
    for goal in ([0.5, 0.5], [0.8, 0.3], [0.3, 0.9]):
        steady = targets.at(goal)
        assert steady.steady, goal
        assert steady.reached, goal
        moved = model.step(steady.x, steady.h, steady.u, model.w, model.p)
        np.testing.assert_allclose(moved[0].full().ravel(), steady.x, atol=1e-8)
        np.testing.assert_allclose(moved[1].full().ravel(), steady.h, atol=1e-6)


def found_one_by_one(targets, goals):
    """Whether steady states of set-points are found, each from the last; those that are found rest. One beyond what the
    memory ever reaches is none: its gates are shut, and it rests anywhere.
    """
    m, last, found = targets.model, None, []
    for goal in goals:
        last = targets.at([goal], start=last)
        found.append(last.steady and last.reached and bool(np.abs(last.h).max() <= 1.0))
        if last.steady:
            moved = m.step(last.x, last.h, last.u, m.w, m.p)
            np.testing.assert_allclose(moved[0].full().ravel(), last.x, atol=1e-8)
            np.testing.assert_allclose(moved[1].full().ravel(), last.h, atol=1e-5)
    return found


GATED = OCP(10, [0.0, 0.0], [0.0], [0.1], [-3.0], [3.0], q_y=[100.0])


@pytest.mark.parametrize("seed", [2, *(pytest.param(k, marks=pytest.mark.full) for k in (3, 6))])
def test_the_model_s_own_run_ends_where_a_search_may_begin(seed):
    targets = Targets(gated(seed), GATED)
    assert found_one_by_one(targets, (0.5, 0.9, 1.2)) == [True] * 3
    without = Targets(gated(seed), GATED)
    without.__dict__["run_out"] = []
    assert not all(found_one_by_one(without, (0.5, 0.9, 1.2)))


@pytest.mark.parametrize("seed", [4, *(pytest.param(k, marks=pytest.mark.full) for k in (5, 11))])
def test_set_points_on_the_way_lead_to_far_ones(seed):
    assert all(found_one_by_one(Targets(gated(seed), GATED), (0.5, 0.9, -0.8)))


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in (2, 5, 11))])
def test_rounding_does_not_choose_among_several_steady_states(seed):
    """From the operating point alone; a far set-point by a single step ends wherever rounding leads it."""

    def spread():
        targets = Targets(gated(seed), GATED)
        found = [targets.at([goal * (1 + k * 1e-14)]) for goal in (0.3, 0.75) for k in range(4)]
        assert all(one.steady for one in found)
        x = np.array([one.x for one in found]).reshape(2, 4, -1)
        return np.ptp(x, axis=1).max()

    assert spread() < 1e-9


@pytest.mark.parametrize("w", [(18.2, 278.0), (18.2, 362.0), (20.0, 400.0)])
def test_an_actuator_that_saturates_gives_all_it_can(w):
    """Steps along the curved branch of its steady states are short at first."""
    targets = Targets(machines.ventilated(), OCP(30, [0.0, 0.0], [1e-6], [1e-2], [0.0], [100.0], q_y=[4.0]))
    found = targets.at([18.0], w=w)
    exchange = 0.55 + 4.3 / np.sqrt(1.0 + 17.0)
    assert found.steady
    assert not found.reached
    np.testing.assert_allclose([*found.y, *found.u], [w[0] + 0.015 * w[1] / exchange, 100.0], rtol=1e-6)


HEATED = OCP(20, [0.0, 0.0], [1e-5, 1e-2], [2.5e-3, 2.5e-3], [0.0, 0.0], [100.0, 100.0], q_y=[4.0])


def test_a_set_point_beyond_the_vent_opens_it_where_it_cools_most():
    """Half open; next, from there, second derivatives converge at once, and nothing else is searched."""
    targets = Targets(machines.heated(), HEATED)
    found, steps = targets.at([20.0], w=[25.0, 600.0]), []
    newton = targets._search._newton
    targets._search._newton = lambda *given: steps.append(given) or newton(*given)
    for w in ((25.5, 640.0), (24.0, 500.0), (26.0, 700.0)):
        steps.clear()
        found = targets.at([20.0], w=w, start=found)
        assert (found.steady, found.reached) == (True, False)
        np.testing.assert_allclose(found.y, w[0] + 0.015 * w[1] / 2.05, rtol=1e-9)
        # the operating point attracts an input to which the output does not respond, with a weight of 1e-6
        np.testing.assert_allclose(found.u, [0.0, 50.0], atol=1e-4)
        assert len(steps) < 6


@pytest.mark.parametrize("goal", [12.0, 14.0, 20.0])
def test_of_the_inputs_along_a_curve_the_nearest_to_the_operating_point_is_taken(goal):
    """The vent's best position by a scalar search; the heater follows from the heat balance."""
    model = machines.heated()
    found = Targets(model, HEATED).at([goal])

    def heater(vent):
        return ((0.55 + 0.06 * vent * (1.0 - 0.01 * vent)) * (goal - 10.0) - 1.5) / 0.12

    def distance(vent):
        return (heater(vent) - model.u0[0]) ** 2 + (vent - model.u0[1]) ** 2

    best = minimize_scalar(distance, bounds=(0.0, 50.0), method="bounded", options={"xatol": 1e-9}).x
    assert found.reached
    np.testing.assert_allclose(found.u, [heater(best), best], atol=1e-5)  # the search's own tolerance
    slope = (distance(found.u[1] + 1e-4) - distance(found.u[1] - 1e-4)) / 2e-4
    assert abs(slope) < 1e-5 or found.u[1] < 1e-9


def test_a_wide_search_without_success_is_repeated_after_a_while(monkeypatch):
    targets, calls, last = pumped(lambda u: (u - 0.3) ** 2 + 0.01), [], None
    monkeypatch.setattr(targets, "_followed", lambda *given, **options: calls.append(given))
    for _ in range(WAIT):
        last = targets.at([0.0], start=last)
    once = len(calls)
    assert once <= 2  # one search: the way to the set-point, and any steady states on it
    last = targets.at([0.0], start=last)
    assert len(calls) == 2 * once
    targets.at([0.1], start=last)
    assert len(calls) == 3 * once
