"""SQP, IPOPT and the best of several starts: the same problem, the same answer, one interface."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from control_parts import POINT, estimate_of, linear_problem, pendulum_problem, plan_of
from online_models import pendulum_model, random_linear, runaway

from hybrid_mpc import (
    OCP,
    BestOf,
    CondensedController,
    HybridModel,
    InputError,
    IpoptController,
    SafeController,
    Signal,
    SoftBound,
    SQPController,
    Status,
)
from hybrid_mpc.control import sqp

SOLVERS = [SQPController, IpoptController]


def compare(seed):
    """SQP and IPOPT from the same start on a random problem; True if a limit acts."""
    rng = np.random.default_rng(seed)
    model = pendulum_model(z=int(rng.integers(0, 4)), seed=seed, correction=rng.uniform(0.0, 1.0))
    bound = rng.uniform(1.0, 4.0)
    limits = {"x_max": [rng.uniform(0.1, 0.8), rng.uniform(1.0, 4.0)]} if rng.random() < 0.5 else {}
    ocp = OCP(
        25, 10 ** rng.uniform([0.0, -2.0], [2.0, 1.0]), [10 ** rng.uniform(-1.0, 0.5)],
        [10 ** rng.uniform(-2.0, 0.0)], [-bound], [bound], [0.4 * bound] if rng.random() < 0.5 else None,
        working_point=POINT, **limits,
    )  # fmt: skip
    e = estimate_of(model, rng.normal(size=2) * [0.6, 1.0], 0.1 * rng.normal())
    reference = np.column_stack([np.full(26, 0.5 * rng.normal()), np.zeros(26)])
    weight = rng.uniform(0.0, 2.0, size=(26, 2))
    sqp, ipopt = (plan_of(solver(model, ocp), e, reference, weight) for solver in SOLVERS)
    assert sqp.status is ipopt.status is Status.SOLVED
    assert sqp.cost <= ipopt.cost * (1 + 1e-6)  # the promise of the method's documentation
    assert sqp.kkt <= 1e-6
    assert sqp.defect == 0.0  # every iterate is a run of the model
    change = np.abs(np.diff(sqp.u, axis=0, prepend=0.0))
    acts = np.max(np.abs(sqp.u)) > 0.999 * ocp.u_max[0], np.any(sqp.x[1:] > ocp.x_max - 1e-6)
    return bool(any(acts) or (ocp.du_max is not None and np.max(change) > 0.999 * ocp.du_max[0]))


@pytest.mark.parametrize(("count", "acting"), [(8, 2), pytest.param(100, 30, marks=pytest.mark.full)])
def test_sqp_is_as_good_as_ipopt(count, acting):
    assert sum(compare(seed) for seed in range(count)) >= acting


def stroke(horizon=60, hit=40, speed=2.0):
    """From rest through zero at ``hit`` with a speed, then rest: nothing counts before the hit but effort."""
    reference, weight = np.zeros((horizon + 1, 2)), np.zeros((horizon + 1, 2))
    reference[: hit + 1, 1] = speed
    weight[hit], weight[hit + 1 :, 1], weight[-1] = 1e4, 1.0, 1.0
    model = pendulum_model(z=3)
    ocp = OCP(horizon, [400.0, 1.0], [4.0], [16.0], [-2.0], [2.0], working_point=POINT)
    return model, ocp, (estimate_of(model, [0.0, 0.0]), reference, weight)


def carried_out(controller, u, e, *goal):
    """Cost of inputs on a run of the model."""
    problem = controller.problem
    return problem.cost(
        problem.run(np.concatenate([e.x, e.h]), u), u, np.zeros(problem.ocp.n_u), problem.target(*goal)
    )


def test_a_stroke_from_rest_where_undamped_iterations_go_astray():
    model, ocp, given = stroke()
    plain = CondensedController(model, ocp)
    first = plan_of(plain, *given)
    got, want = (plan_of(solver(model, ocp), *given) for solver in SOLVERS)
    assert carried_out(plain, first.u, *given) > 100 * got.cost  # one linearization at rest is no plan
    assert got.cost <= want.cost * (1 + 1e-6)
    # An error of e at the hit costs 1e4 * dt * q e^2 = 200 e_speed^2; the effort it saves is of the plan's cost.
    assert np.abs(got.x[40, 1] - 2.0) < 0.02
    assert np.abs(got.x[40, 0]) < 1e-3
    assert np.min(got.x[:40, 0]) < -0.1  # it swings back first, unplanned


def test_ipopt_takes_expressions_and_limits_as_the_condensed_solvers_do():
    model = pendulum_model(z=2)
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    power = SoftBound(ca.Function("power", [x, u], [u * x[1]]), [-0.5], [0.6], [50.0], [10.0])
    ocp = pendulum_problem(25, du_max=[0.5], soft=[power], x_min=[-np.inf, -1.0], x_max=[np.inf, 1.5])
    e = estimate_of(model, [0.0, 0.0], 0.1)
    got, want = (plan_of(solver(model, ocp), e, np.array([[0.8, 0.0]])) for solver in SOLVERS)
    assert np.max(got.u[:, 0] * got.x[:-1, 1]) > 0.6 - 1e-6  # the expression's bound acts
    assert got.cost == pytest.approx(want.cost, rel=1e-6)
    np.testing.assert_allclose(got.u, want.u, atol=2e-4)  # the cost is flat: square root of its tolerance
    assert want.excess == pytest.approx(got.excess, abs=1e-4)


@pytest.mark.parametrize("solver", SOLVERS)
def test_linear_problems_are_solved_at_once(solver):
    model, *_ = random_linear(1, n_u=1)
    ocp = OCP(10, [1.0, 0.5, 2.0], [0.5], [0.1], [-0.3], [0.3], [0.2])
    e = estimate_of(model, [1.0, -0.5, 0.2], 0.1)
    plan, want = (plan_of(c(model, ocp), e, np.zeros((1, 3))) for c in (solver, CondensedController))
    np.testing.assert_allclose(plan.u, want.u, atol=1e-5)  # IPOPT's barrier leaves 1e-9 of the cost
    assert plan.cost == pytest.approx(want.cost, rel=1e-7)  # IPOPT relaxes bounds by 1e-8


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("bad", ["x", "h", "d", "reference", "weight", "plan", "far"])
def test_nothing_raises_on_numbers(solver, bad):
    model = pendulum_model(z=2)
    controller = solver(model, pendulum_problem(10, 1.0, du_max=[0.3], x_max=[0.4, 1.0]))
    changes = {"x": {"x": np.array([np.nan, 0.0])}, "h": {"h": np.array([np.inf, 0.0])},
               "d": {"d": np.array([np.nan])}, "far": {"x": np.array([1e200, 1e200])}}  # fmt: skip
    good = estimate_of(model, [0.1, 0.0])
    e = replace(good, **changes.get(bad, {}))
    reference = np.full((1, 2), np.nan) if bad == "reference" else np.zeros((1, 2))
    weight = -np.ones((1, 2)) if bad == "weight" else None
    start = controller.initial(good)
    if bad == "plan":
        start = replace(start, x=np.full((11, 2), np.nan), h=np.full((11, 2), np.inf))
    plan = controller.solve(start, e, reference, weight)
    if bad != "plan":  # the SQP needs no trajectory, only inputs
        assert not plan.status.ok
    safe = SafeController(controller, pendulum_model())
    decision = safe.decide(replace(safe.initial(good), solution=start), e, reference, weight)
    assert np.abs(decision.u[0]) <= 0.3  # du_max around the zero held


@pytest.mark.parametrize("solver", [CondensedController, *SOLVERS])
def test_a_reference_shorter_than_the_preview_holds_its_last_value(solver):
    model, *_ = random_linear(1, n_x=3, n_u=1)
    short = np.array([[0.1, 0.0, 0.0], [0.2, 0.3, 0.0], [0.5, 0.1, -0.2]])
    full = np.vstack([short, np.tile(short[-1], (8, 1))])
    c, e = solver(model, linear_problem(1, 10, bound=0.5)), estimate_of(model, [1.0, -1.0, 0.5])
    plans = [plan_of(c, e, reference).u for reference in (short, full, full[:1])]
    np.testing.assert_array_equal(plans[0], plans[1])
    assert np.max(np.abs(plans[0] - plans[2])) > 1e-3  # the reference counts


def test_an_iteration_limit_gives_a_plan_that_may_be_applied():
    model, ocp, given = stroke()
    few = SQPController(model, ocp, iterations=2)
    early, late = plan_of(few, *given), plan_of(SQPController(model, ocp), *given)
    assert early.status is Status.STOPPED
    assert early.status.ok
    assert early.iterations == 2
    assert early.cost > late.cost
    run = few.problem.run(np.concatenate([given[0].x, given[0].h]), early.u)
    np.testing.assert_array_equal(run[:, :2], early.x)


def test_a_first_plan_takes_half_the_iterations_of_runs_alone(monkeypatch):
    model, ocp, given = stroke()
    plan = plan_of(SQPController(model, ocp), *given)
    monkeypatch.setattr(sqp, "LIFTED", 0)
    alone = plan_of(SQPController(model, ocp), *given)
    assert plan.status is alone.status is Status.SOLVED
    assert plan.iterations <= 8 < 12 <= alone.iterations
    assert plan.cost == pytest.approx(alone.cost, rel=1e-8)


def test_sqp_repairs_a_start_beyond_the_limits_of_the_change():
    model = pendulum_model()
    controller = SQPController(model, pendulum_problem(10, 1.0, du_max=[0.1]))
    jumps = np.resize([1.0, -1.0], (10, 1))
    plan = plan_of(controller, estimate_of(model, [0.3, 0.0]), np.zeros((1, 2)), start=jumps)
    assert plan.status is Status.SOLVED
    assert np.max(np.abs(np.diff(plan.u, axis=0, prepend=1.0))) < 0.1 + 1e-8  # the QP's tolerance


def test_the_best_of_several_starts_is_the_cheapest_of_them():
    model, ocp, given = stroke()
    sqp = SQPController(model, ocp)
    best = BestOf(sqp, starts=[np.full((60, 1), 0.5), lambda estimate: np.full((60, 1), -0.5)])
    got = plan_of(best, *given)
    assert got.cost <= plan_of(sqp, *given).cost
    assert got.cost == carried_out(best, got.u, *given)


def test_of_many_guesses_only_the_cheapest_are_solved_from():
    model, ocp, given = stroke()
    solved_from = []

    class Counting(SQPController):
        def solve(self, previous, *given, **options):
            solved_from.append(float(previous.u[1, 0]))  # what the shifted plan begins with
            return super().solve(previous, *given, **options)

    counting = Counting(model, ocp)
    costs = {u: carried_out(counting, np.full((60, 1), u), *given) for u in (0.5, -0.5, 0.1)}
    plan_of(BestOf(counting, starts=[np.full((60, 1), u) for u in costs], most=1), *given)
    assert solved_from == [0.0, min(costs, key=costs.get)]


def even(shift=0.0):
    """A controller for which u = 0 is stationary: only somebody else's plan shows the way down."""
    x, u, one = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
    model = HybridModel.of(
        "even", 1.0, one, (Signal("u", "-"),), one, x=x, u=u, x_next=x - u**2 - shift * u, xdot=u, y=x
    )
    return SQPController(model, OCP(3, [1.0], [0.1], [0.0], [-1.0], [1.0], terminal=[[1.0]]))


def test_a_rivals_plan_is_a_start():
    single, rival = even(), even(shift=0.3)
    best, e = BestOf(single, rivals=[rival]), estimate_of(single.model, [1.0])
    alone, got, theirs = (plan_of(c, e, np.zeros((1, 1))) for c in (single, best, rival))
    assert alone.cost == pytest.approx(4.0)  # three periods and the end at the distance 1
    assert got.cost <= carried_out(best, theirs.u, e, np.zeros((1, 1))) < 3.0


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (lambda m, o: SQPController(m, o, tolerance=0.0), "tolerance"),
        (lambda m, o: SQPController(m, o, iterations=0), "iterations"),
        (lambda m, o: IpoptController(m, o, tolerance=-1.0), "tolerance"),
        (lambda m, o: BestOf(SQPController(m, o)), "HM-CONTROL-003"),
        (lambda m, o: BestOf(SQPController(m, o), starts=[np.zeros((2, 1))]), r"start.*10.*HM-CONTROL-024"),
        (lambda m, o: BestOf(SQPController(m, o), starts=[np.zeros((10, 1))], most=0), "HM-CONTROL-001"),
        (
            lambda m, o: BestOf(SQPController(m, o), rivals=[SQPController(m, o.changed(horizon=5))]),
            r"\(2, 1, 10\).*HM-CONTROL-002",
        ),
    ],
)
def test_bad_options_are_refused(use, words):
    with pytest.raises(InputError, match=words):
        use(pendulum_model(), pendulum_problem(10))


@pytest.mark.parametrize("solver", [CondensedController, *SOLVERS])
@pytest.mark.parametrize(("bound", "fine"), [(1.0, False), (1e3, True), (np.inf, True)])
def test_a_plan_far_outside_of_a_declared_range_is_not_applied(solver, bound, fine):
    model, ocp = runaway(bound), OCP(20, [1.0], [1.0], [0.0], [-0.1], [0.1])
    got = plan_of(solver(model, ocp), estimate_of(model, [0.9], 0.0), np.zeros((1, 1)))
    assert got.status.ok is fine
    assert (got.status is Status.DIVERGED) is not fine
