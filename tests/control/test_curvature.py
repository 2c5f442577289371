"""Second derivatives of the cost, and what the SQP makes of them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from control_parts import estimate_of as estimate_at
from control_parts import pendulum_problem, plan_of
from online_models import pendulum_model

from hybrid_mpc import CondensedController, SoftBound, SQPController, Status
from hybrid_mpc.control.curvature import convex
from hybrid_mpc.control.rti import condense_all, condense_hessians
from hybrid_mpc.control.sqp import Case, ReducedCost


def estimate_of(model, d=0.1):
    return estimate_at(model, [0.0, 0.02], d)  # near rest, where the slope of friction changes


def problem(horizon=12, **others):
    return pendulum_problem(horizon, 3.0, **others)


def problem_at(model, ocp, u):
    """Cost, case and its point on inputs ``u``."""
    cost, e = ReducedCost(CondensedController(model, ocp)), estimate_of(model)
    case = Case(e.d, np.array([0.3]), cost.problem.target(np.full((1, 2), 2.0)))
    return cost, case, cost.at(cost.run(np.concatenate([e.x, e.h]), u.reshape(-1, 1), case), case)


RANDOM = np.random.default_rng(0).uniform(-0.4, 0.2, 12)


def derivatives(model, ocp, u):
    """Exact gradient and Hessian of the cost by the inputs, by CasADi's own differentiation."""
    terminal, e = ocp.terminal_weight(model), estimate_of(model)
    v = ca.MX.sym("v", ocp.horizon)
    x, h, before, cost = ca.DM(e.x), ca.DM(e.h), 0.3, 0
    for k in range(ocp.horizon):
        cost += model.dt * (
            ca.dot(ocp.q, (x - 2.0) ** 2) + 0.5 * v[k] ** 2 + 0.2 * (v[k] - before) ** 2
        )  # fmt: skip
        x, h = model.step(x, h, v[k] + 0.1, model.w, model.p)
        before = v[k]
    cost += (x - 2.0).T @ terminal @ (x - 2.0)
    hessian, gradient = ca.hessian(cost, v)
    return (m.full() for m in ca.Function("d", [v], [gradient, hessian])(u))


@pytest.mark.parametrize("z", [0, 4, 7])
def test_the_hessian_is_exact(z):
    model, ocp = pendulum_model(z=z, friction=0.5), problem()
    u = np.random.default_rng(z).uniform(-0.4, 0.2, ocp.horizon)
    gradient, hessian = derivatives(model, ocp, u)
    cost, case, at = problem_at(model, ocp, u)
    np.testing.assert_allclose(at.gradient, gradient.ravel(), rtol=1e-9, atol=1e-12)
    prepared = cost.condensed(at, case)
    rest = cost.rest(prepared, cost.curvature(at, case, at.multipliers, np.zeros(0)), case)
    missing = hessian - prepared.hessian
    assert np.max(np.abs(missing)) > 0.02 * np.max(np.abs(hessian))  # there is something to find
    # One-sided differences over 1.4e-5 rad/s (1e-5 of the tolerated deviation) of a friction law whose slope
    # changes within 1/20 rad/s: 3e-4 of a second derivative, and as much again for a factor in it.
    np.testing.assert_allclose(rest, missing, atol=6e-4 * np.max(np.abs(missing)))


def test_the_hidden_states_part_can_be_kept_or_left_out():
    cost, case, at = problem_at(pendulum_model(z=2, friction=0.5), problem(), RANDOM)
    whole = cost.curvature(at, case, at.multipliers, np.zeros(0))
    kept = cost.curvature(at, case, at.multipliers, np.zeros(0), whole + 1.0)
    np.testing.assert_array_equal(kept[:, :3, :3], whole[:, :3, :3])
    np.testing.assert_array_equal(kept[:, 3:], whole[:, 3:] + 1.0)
    few = cost.curvature(at, case, at.multipliers, np.zeros(0), whole[:, :3, :3])
    np.testing.assert_array_equal(few, whole[:, :3, :3])
    prepared = cost.condensed(at, case)
    share = 1.0 / np.max(np.abs(whole[:, 3:]))
    for size, shape in ((1e-9 * share, 3), (1e3 * share, 5)):  # far below and above what matters
        given = whole * size
        given[:, :3, :3] = whole[:, :3, :3]
        kept = cost.stages.without_what_is_small(
            given, prepared.hessian, prepared.from_u, cost.inner.condenser.by_inputs
        )
        assert kept.shape == (12, shape, shape)


def test_soft_bounds_are_in_the_lagrangian_and_its_hessian():
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    bound = SoftBound(ca.Function("power", [x, u], [u * x[1] + x[0] ** 3]), [-9.0], [9.0], [1.0], [1.0])
    ocp = problem(soft=[bound], x_max=[9.0, 9.0])
    cost, case, at = problem_at(pendulum_model(z=2, friction=0.5), ocp, RANDOM)
    mu, z0 = np.random.default_rng(1).normal(size=36), at.run.z[0]
    shift = 1e-5 * np.random.default_rng(2).normal(size=(12, 1))

    def lagrangian(u):
        run = cost.run(z0, u, case)
        return run.cost + mu @ run.soft[0], cost.lagrangian(cost.at(run, case), mu)[1]

    (up, slope_up), (down, slope_down) = (lagrangian(at.run.u + s * shift) for s in (1.0, -1.0))
    multipliers, gradient = cost.lagrangian(at, mu)
    # Central differences over 1e-5: rounding 1e-16 / 1e-5 of the cost of some hundreds.
    assert 2 * float(shift.ravel() @ gradient) == pytest.approx(up - down, rel=1e-5)
    prepared = cost.condensed(at, case)
    rest = cost.rest(prepared, cost.curvature(at, case, multipliers, mu), case)
    # The one-sided differences' 6e-4, see above.
    want = 0.5 * (slope_up - slope_down)
    got = (prepared.hessian + rest) @ shift.ravel()
    np.testing.assert_allclose(got, want, atol=1e-3 * np.max(np.abs(want)))


def test_penalties_and_their_multipliers_bound_each_other():
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    bound = SoftBound(ca.Function("v", [x, u], [x[1]]), [-1.0], [0.5], [2.0], [3.0])
    cost = ReducedCost(CondensedController(pendulum_model(), problem(soft=[bound])))
    rng = np.random.default_rng(0)
    for _ in range(20):
        mu, values, other = rng.normal(size=12), rng.normal(size=12), rng.normal(size=12)
        # What any change of the values saves, the multipliers' share of it paid, is at most the gap.
        saved = cost.penalty(values) - cost.penalty(other) - mu @ (values - other)
        assert saved <= cost.gap(values, mu) + 1e-12  # rounding
    values = np.full(12, 0.7)
    mu = np.full(12, cost.problem.model.dt * (2.0 + 2 * 3.0 * 0.2))  # the slope of the penalty there
    assert cost.gap(values, mu) == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize(("n", "n_u"), [(1, 1), (5, 2), (23, 1)])
def test_condensing_with_hidden_states_is_condensing(n, n_u):
    rng = np.random.default_rng(n)
    by_inputs = rng.normal(size=(n + 1, 3, n * n_u))
    for k in range(n + 1):
        by_inputs[k, :, k * n_u :] = 0.0  # later inputs do not reach back
    stages = rng.normal(size=(n, 3 + n_u, 3 + n_u))
    stages += stages.transpose(0, 2, 1)
    from_u = by_inputs.reshape(-1, n * n_u)
    # Three states or two and a hidden one: the order is x, u, h.
    order = [0, 1, *range(3, 3 + n_u), 2]
    got = condense_all(stages[:, order][:, :, order], by_inputs, 2, n_u)
    np.testing.assert_allclose(got, condense_hessians(stages, from_u, 3), rtol=1e-12, atol=1e-11)


def test_a_hessian_that_curves_down_is_made_convex():
    rng = np.random.default_rng(0)
    root, other = rng.normal(size=(2, 6, 6))
    gauss_newton, rest = root @ root.T + np.eye(6), 5 * (other + other.T)
    assert np.min(np.linalg.eigvalsh(gauss_newton + rest)) < 0
    got = convex(gauss_newton, rest)
    # 0.001 of Gauss-Newton's curvature in every direction; rounding of a sum of squares.
    assert np.min(np.linalg.eigvalsh(got - 0.001 * gauss_newton)) > -1e-9
    up = other @ other.T
    np.testing.assert_array_equal(convex(gauss_newton, up), gauss_newton + up)  # what is convex is left alone


def test_what_is_held_bears_the_change():
    rng = np.random.default_rng(0)
    root, other = rng.normal(size=(2, 6, 6))
    gauss_newton, rest = root @ root.T + np.eye(6), 0.3 * (other + other.T)
    rest[0, 0] -= 50.0
    held = np.arange(6) == 0
    whole = gauss_newton + rest
    assert np.min(np.linalg.eigvalsh(whole)) < 0 < np.min(np.linalg.eigvalsh(whole[1:, 1:]))
    got = convex(gauss_newton, rest, held)
    assert np.min(np.linalg.eigvalsh(got)) > 0
    got[0, 0] = whole[0, 0]
    np.testing.assert_array_equal(got, whole)  # a step that leaves it there does not feel it


def closed_loop(controller, periods=25):
    """Plans along a loop on the model itself."""
    model, e = controller.model, estimate_of(controller.model, d=0.0)
    plan, plans = controller.initial(e), []
    for _ in range(periods):
        plan = controller.solve(plan, e, np.array([[0.5, 0.0]]))
        plans.append(plan)
        x, h = (v.full().ravel() for v in model.step(e.x, e.h, plan.u[0], model.w, model.p))
        e = replace(e, x=x, h=h)
    return plans


def test_a_warm_start_converges_in_a_few_iterations():
    plans = closed_loop(SQPController(pendulum_model(z=3), problem(30)))
    assert all(p.status is Status.SOLVED and p.kkt <= 1e-6 for p in plans)
    # Newton squares the error: from 1e-2 of a warm start to 1e-6 in three steps where it is right, and some slack.
    assert np.mean([p.iterations for p in plans[1:]]) < 5


@pytest.mark.parametrize("bad", ["nan", "shape", "wrong", "none"])
def test_a_plans_second_derivatives_are_a_guess_only(bad):
    controller = SQPController(pendulum_model(z=3), problem(30))
    e = estimate_of(controller.model)
    plan = plan_of(controller, e, np.zeros((1, 2)))
    wrong = {
        "nan": np.full_like(plan.curvature, np.nan), "shape": plan.curvature[:5],
        "wrong": -50 * plan.curvature, "none": None,
    }  # fmt: skip
    want = controller.solve(plan, e, np.full((1, 2), 0.2))
    got = controller.solve(replace(plan, curvature=wrong[bad]), e, np.full((1, 2), 0.2))
    assert got.status is want.status is Status.SOLVED
    # Both have a residual of at most 1e-6 of the bounds' size 3, over a condition of some hundreds.
    np.testing.assert_allclose(got.u, want.u, atol=1e-3)
    assert got.cost == pytest.approx(want.cost, rel=1e-8)  # flat there
