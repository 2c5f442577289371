"""SQP, IPOPT and the best of several starts: the same problem, the same answer, one interface."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from online_models import pendulum_model, random_linear

from hybrid_mpc import (
    OCP,
    BestOf,
    CondensedController,
    Estimate,
    InputError,
    IpoptController,
    SafeController,
    SoftBound,
    SQPController,
    Status,
)

POINT = [0.0, 1.0], [0.0]
SOLVERS = [SQPController, IpoptController]


def estimate_of(model, x, d=0.0):
    size = model.n_x + model.n_h + 1
    return Estimate(0.0, np.array(x), np.zeros(model.n_h), np.array([d]), np.eye(size), np.zeros(1), 0.0)


def random_problem(seed):
    """A pendulum with a random network, random weights, and limits that often act; estimate, reference, weights."""
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
    return model, ocp, e, reference, rng.uniform(0.0, 2.0, size=(26, 2))


def compare(seed):
    """SQP and IPOPT from the same start; True if a limit acts."""
    model, ocp, e, reference, weight = random_problem(seed)
    plans = []
    for solver in (SQPController(model, ocp), IpoptController(model, ocp)):
        plans.append(solver.solve(solver.initial(e), e, reference, weight))
    sqp, ipopt = plans
    assert sqp.status is Status.SOLVED
    assert ipopt.status is Status.SOLVED
    assert sqp.cost <= ipopt.cost * (1 + 1e-6)  # the promise of the method's documentation
    assert sqp.kkt <= 1e-6
    assert sqp.defect == 0.0  # every iterate is a run of the model
    change = np.abs(np.diff(sqp.u, axis=0, prepend=0.0))
    limits = np.max(np.abs(sqp.u)) > 0.999 * ocp.u_max[0], np.any(sqp.x[1:] > ocp.x_max - 1e-6)
    return bool(any(limits) or (ocp.du_max is not None and np.max(change) > 0.999 * ocp.du_max[0]))


def test_sqp_is_as_good_as_ipopt():
    assert sum(compare(seed) for seed in range(20)) >= 6


@pytest.mark.full
def test_sqp_is_as_good_as_ipopt_on_a_hundred_problems():
    assert sum(compare(seed) for seed in range(100)) >= 30


def stroke(horizon=60, hit=40, speed=2.0):
    """From rest through zero at ``hit`` with a speed, then rest: nothing counts before the hit but effort."""
    reference, weight = np.zeros((horizon + 1, 2)), np.zeros((horizon + 1, 2))
    reference[: hit + 1, 1] = speed
    weight[hit], weight[hit + 1 :, 1], weight[-1] = 1e4, 1.0, 1.0
    ocp = OCP(horizon, [400.0, 1.0], [4.0], [16.0], [-2.0], [2.0], working_point=POINT)
    return ocp, reference, weight


def test_a_stroke_from_rest_where_undamped_iterations_go_astray():
    model, (ocp, reference, weight) = pendulum_model(z=3), stroke()
    e = estimate_of(model, [0.0, 0.0])
    plain = CondensedController(model, ocp)
    first = plain.solve(plain.initial(e), e, reference, weight)
    z0 = np.concatenate([e.x, e.h])
    target = plain.problem.target(reference, weight)
    carried_out = plain.problem.cost(plain.problem.run(z0, first.u), first.u, np.zeros(1), target)
    got, want = (s.solve(s.initial(e), e, reference, weight) for s in (c(model, ocp) for c in SOLVERS))
    assert carried_out > 100 * got.cost  # one linearization at rest is no plan for a large motion
    assert got.cost <= want.cost * (1 + 1e-6)
    # An error of e at the hit costs 1e4 * dt * q e^2 = 200 e_speed^2; the effort it saves is of the plan's cost.
    assert np.abs(got.x[40, 1] - 2.0) < 0.02
    assert np.abs(got.x[40, 0]) < 1e-3
    assert np.min(got.x[:40, 0]) < -0.1  # it swings back first, unplanned


def test_ipopt_takes_expressions_and_limits_as_the_condensed_solvers_do():
    model = pendulum_model(z=2)
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    power = SoftBound(ca.Function("power", [x, u], [u * x[1]]), [-0.5], [0.6], [50.0], [10.0])
    ocp = OCP(
        25, [50.0, 0.5], [0.5], [0.2], [-2.0], [2.0], [0.5], working_point=POINT, soft=[power],
        x_min=[-np.inf, -1.0], x_max=[np.inf, 1.5],
    )  # fmt: skip
    e = estimate_of(model, [0.0, 0.0], 0.1)
    got, want = (
        s.solve(s.initial(e), e, np.full((1, 2), [0.8, 0.0])) for s in (c(model, ocp) for c in SOLVERS)
    )
    assert np.max(got.u[:, 0] * got.x[:-1, 1]) > 0.6 - 1e-6  # the expression's bound acts
    assert got.cost == pytest.approx(want.cost, rel=1e-6)
    np.testing.assert_allclose(got.u, want.u, atol=2e-4)  # the cost is flat: square root of its tolerance
    assert want.excess == pytest.approx(got.excess, abs=1e-4)


@pytest.mark.parametrize("solver", SOLVERS)
def test_linear_problems_are_solved_at_once(solver):
    model, *_ = random_linear(1, n_u=1)
    ocp = OCP(10, [1.0, 0.5, 2.0], [0.5], [0.1], [-0.3], [0.3], [0.2])
    e = estimate_of(model, [1.0, -0.5, 0.2], 0.1)
    exact, got = CondensedController(model, ocp), solver(model, ocp)
    want = exact.solve(exact.initial(e), e, np.zeros((1, 3)))
    plan = got.solve(got.initial(e), e, np.zeros((1, 3)))
    np.testing.assert_allclose(plan.u, want.u, atol=1e-5)  # IPOPT's barrier leaves 1e-9 of the cost
    assert plan.cost == pytest.approx(want.cost, rel=1e-7)  # IPOPT relaxes bounds by 1e-8


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("bad", ["x", "h", "d", "reference", "weight", "plan", "far"])
def test_nothing_raises_on_numbers(solver, bad):
    model = pendulum_model(z=2)
    ocp = OCP(10, [50.0, 0.5], [0.5], [0.2], [-1.0], [1.0], [0.3], working_point=POINT, x_max=[0.4, 1.0])
    fields = {"x": np.array([np.nan, 0.0]), "h": np.array([np.inf, 0.0]), "d": np.array([np.nan]),
              "far": np.array([1e200, 1e200])}  # fmt: skip
    controller, good = solver(model, ocp), estimate_of(model, [0.1, 0.0])
    e = replace(good, **{bad if bad != "far" else "x": fields[bad]}) if bad in fields else good
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
    model, _, _, _ = random_linear(1, n_x=3, n_u=1)
    ocp = OCP(10, np.ones(3), [0.3], [0.1], [-0.5], [0.5])
    size = model.n_x + 1
    e = Estimate(0.0, np.array([1.0, -1.0, 0.5]), np.zeros(0), np.zeros(1), np.eye(size), np.zeros(1), 0.0)
    short = np.array([[0.1, 0.0, 0.0], [0.2, 0.3, 0.0], [0.5, 0.1, -0.2]])
    full = np.vstack([short, np.tile(short[-1], (8, 1))])
    c = solver(model, ocp)
    plans = [c.solve(c.initial(e), e, reference).u for reference in (short, full, full[:1])]
    np.testing.assert_array_equal(plans[0], plans[1])
    assert np.max(np.abs(plans[0] - plans[2])) > 1e-3  # the reference counts


def test_an_iteration_limit_gives_a_plan_that_may_be_applied():
    model, (ocp, reference, weight) = pendulum_model(z=3), stroke()
    e = estimate_of(model, [0.0, 0.0])
    few, many = SQPController(model, ocp, iterations=2), SQPController(model, ocp)
    early = few.solve(few.initial(e), e, reference, weight)
    late = many.solve(many.initial(e), e, reference, weight)
    assert early.status is Status.STOPPED
    assert early.status.ok
    assert early.iterations == 2
    assert early.cost > late.cost
    run = few.problem.run(np.concatenate([e.x, e.h]), early.u)
    np.testing.assert_array_equal(run[:, :2], early.x)


def test_sqp_repairs_a_start_beyond_the_limits_of_the_change():
    model = pendulum_model()
    ocp = OCP(10, [50.0, 0.5], [0.5], [0.2], [-1.0], [1.0], [0.1], working_point=POINT)
    controller, e = SQPController(model, ocp), estimate_of(model, [0.3, 0.0])
    jumps = controller.initial(e, np.resize([1.0, -1.0], (10, 1)))
    plan = controller.solve(jumps, e, np.zeros((1, 2)))
    assert plan.status is Status.SOLVED
    assert np.max(np.abs(np.diff(plan.u, axis=0, prepend=1.0))) < 0.1 + 1e-8  # the QP's tolerance


def test_the_best_of_several_starts_is_the_cheapest_of_them():
    model, (ocp, reference, weight) = pendulum_model(z=3), stroke()
    e = estimate_of(model, [0.0, 0.0])
    sqp = SQPController(model, ocp)
    starts = [np.full((60, 1), 0.5), lambda estimate: np.full((60, 1), -0.5)]
    best = BestOf(sqp, starts=starts)
    got = best.solve(best.initial(e), e, reference, weight)
    alone = sqp.solve(sqp.initial(e), e, reference, weight)
    assert got.cost <= alone.cost
    target = best.problem.target(reference, weight)
    run = best.problem.run(np.concatenate([e.x, e.h]), got.u)
    assert got.cost == best.problem.cost(run, got.u, np.zeros(1), target)


def test_of_many_guesses_only_the_cheapest_are_solved_from():
    model, (ocp, reference, weight) = pendulum_model(z=3), stroke()
    e = estimate_of(model, [0.0, 0.0])
    solved_from = []

    class Counting(SQPController):
        def solve(self, previous, estimate, reference, weight=None, *, limits=None):
            solved_from.append(float(previous.u[1, 0]))  # what the shifted plan begins with
            return super().solve(previous, estimate, reference, weight)

    costs = {}
    problem = SQPController(model, ocp).problem
    for u in (0.5, -0.5, 0.1):
        plan = np.full((60, 1), u)
        z = problem.run(np.concatenate([e.x, e.h]), plan)
        costs[u] = problem.cost(z, plan, np.zeros(1), problem.target(reference, weight))
    best = BestOf(Counting(model, ocp), starts=[np.full((60, 1), u) for u in costs], most=1)
    best.solve(best.initial(e), e, reference, weight)
    assert solved_from == [0.0, min(costs, key=costs.get)]
    with pytest.raises(InputError, match="most: 1 or more"):
        BestOf(SQPController(model, ocp), starts=[np.zeros((60, 1))], most=0)


def test_a_rivals_plan_is_a_start():
    # u = 0 is stationary on "even": only somebody else's plan shows the way down.
    model, ocp, e = even()
    single = SQPController(model, ocp)
    other, *_ = even(shift=0.3)
    rival = SQPController(other, ocp)
    best = BestOf(single, rivals=[rival])
    plans = [c.solve(c.initial(e), e, np.zeros((1, 1))) for c in (single, best)]
    theirs = rival.solve(rival.initial(e), e, np.zeros((1, 1)))
    by_model = best.problem.cost(
        best.problem.run(e.x, theirs.u), theirs.u, np.zeros(1), best.problem.target(np.zeros((1, 1)))
    )
    assert plans[0].cost == pytest.approx(4.0)  # three periods and the end at the distance 1
    assert plans[1].cost <= by_model < 3.0


def even(shift=0.0):
    from hybrid_mpc import HybridModel, Signal

    x, u = ca.MX.sym("x"), ca.MX.sym("u")
    one = (Signal("x", "-"),), (Signal("u", "-"),), (Signal("x", "-"),)
    model = HybridModel.of("even", 1.0, *one, x=x, u=u, x_next=x - u**2 - shift * u, xdot=u, y=x)
    ocp = OCP(3, [1.0], [0.1], [0.0], [-1.0], [1.0], terminal=[[1.0]])
    return model, ocp, Estimate(0.0, np.ones(1), np.zeros(0), np.zeros(1), np.eye(2), np.zeros(1), 0.0)


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (lambda m, o: SQPController(m, o, tolerance=0.0), "tolerance"),
        (lambda m, o: SQPController(m, o, iterations=0), "iterations"),
        (lambda m, o: IpoptController(m, o, tolerance=-1.0), "tolerance"),
        (lambda m, o: BestOf(SQPController(m, o)), "starts or rivals"),
        (lambda m, o: BestOf(SQPController(m, o), starts=[np.zeros((2, 1))]), r"\(10, 1\) needed"),
        (
            lambda m, o: BestOf(SQPController(m, o), rivals=[SQPController(m, shorter(o))]),
            r"needed: \(2, 1, 10\)",
        ),
    ],
)
def test_bad_options_are_refused(use, words):
    ocp = OCP(10, [50.0, 0.5], [0.5], [0.2], [-1.0], [1.0], working_point=POINT)
    with pytest.raises(InputError, match=words):
        use(pendulum_model(), ocp)


def shorter(ocp):
    return OCP(5, ocp.q, ocp.r, ocp.r_delta, ocp.u_min, ocp.u_max, working_point=POINT)
