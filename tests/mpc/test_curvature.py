"""Second derivatives of the cost, and what the SQP makes of them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from online_models import pendulum_model

from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.mpc import OCP, CondensedController, SQPController, Status
from hybrid_mpc.mpc.curvature import Secants, convex
from hybrid_mpc.mpc.descent import Case, Landscape

POINT = [0.0, 1.0], [0.0]
X0 = [0.0, 0.02]  # near rest, where the slope of friction changes


def estimate_of(model, x=X0, d=0.1):
    size = model.n_x + model.n_h + 1
    return Estimate(0.0, np.array(x), np.zeros(model.n_h), np.array([d]), np.eye(size), np.zeros(1), 0.0)


def problem(horizon=12):
    return OCP(horizon, [50.0, 0.5], [0.5], [0.2], [-3.0], [3.0], working_point=POINT)


def derivatives(model, ocp, u):
    """Exact gradient and Hessian of the cost by the inputs, by CasADi's own differentiation."""
    terminal, e = ocp.terminal_weight(model), estimate_of(model)
    v = ca.MX.sym("v", ocp.horizon)
    x, h, before, cost = ca.DM(e.x), ca.DM(e.h), 0.3, 0
    for k in range(ocp.horizon):
        cost += model.dt * (
            ca.dot(ocp.q, (x - 2.0) ** 2) + 0.5 * v[k] ** 2 + 0.2 * (v[k] - before) ** 2
        )  # fmt: skip
        x, h = model.step(x, h, v[k] + 0.1)
        before = v[k]
    cost += (x - 2.0).T @ terminal @ (x - 2.0)
    hessian, gradient = ca.hessian(cost, v)
    return (m.full() for m in ca.Function("d", [v], [gradient, hessian])(u))


def model_of_cost(model, ocp, u):
    """The same by the library, Gauss-Newton's Hessian apart from the rest."""
    controller = CondensedController(model, ocp)
    land, e = Landscape(controller), estimate_of(model)
    case = Case(e.d, np.array([0.3]), controller.problem.target(np.full((1, 2), 2.0)))
    at = land.at(np.concatenate([e.x, e.h]), u[:, None], case)
    prepared = land.condensed(at, case)
    rest = land.stages.condensed(land.curvature(at, case), prepared.from_u)
    return at.gradient, prepared.hessian, rest


@pytest.mark.parametrize("seed", range(3))
def test_without_a_hidden_state_the_hessian_is_exact(seed):
    model, ocp = pendulum_model(friction=0.5), problem()
    u = np.random.default_rng(seed).uniform(-0.4, 0.2, ocp.horizon)
    gradient, hessian = derivatives(model, ocp, u)
    got, gauss_newton, rest = model_of_cost(model, ocp, u)
    np.testing.assert_allclose(got, gradient.ravel(), rtol=1e-9, atol=1e-12)
    missing = hessian - gauss_newton
    assert np.max(np.abs(missing)) > 0.02 * np.max(np.abs(hessian))  # there is something to find
    # One-sided differences over 1.4e-5 rad/s (1e-5 of the tolerated deviation) of a friction law whose slope
    # changes within 1/20 rad/s: 3e-4 of a second derivative, and as much again for a factor in it.
    np.testing.assert_allclose(rest, missing, atol=6e-4 * np.max(np.abs(missing)))


def test_a_hidden_state_leaves_out_little():
    model, ocp = pendulum_model(z=4, friction=0.5), problem()
    u = np.random.default_rng(0).uniform(-0.4, 0.2, ocp.horizon)
    gradient, hessian = derivatives(model, ocp, u)
    got, gauss_newton, rest = model_of_cost(model, ocp, u)
    np.testing.assert_allclose(got, gradient.ravel(), rtol=1e-9, atol=1e-12)
    without, left = (np.max(np.abs(hessian - h)) for h in (gauss_newton, gauss_newton + rest))
    assert left < 0.1 * without  # a random network's own curvature, with friction as the golf robot's


def test_a_part_can_be_taken_anew():
    model, ocp = pendulum_model(z=2, friction=0.5), problem()
    controller, e = CondensedController(model, ocp), estimate_of(model)
    land, u = Landscape(controller), np.random.default_rng(0).uniform(-0.4, 0.2, (ocp.horizon, 1))
    case = Case(e.d, np.array([0.3]), controller.problem.target(np.full((1, 2), 2.0)))
    at = land.at(np.concatenate([e.x, e.h]), u, case)
    whole = land.curvature(at, case)
    old = whole + 1.0
    part = land.curvature(at, case, old, [1])
    # Symmetric both ways; one-sided differences of two orders differ by their error, 3e-4 as above.
    np.testing.assert_allclose(part[:, 1], whole[:, 1], atol=1e-3 * np.max(np.abs(whole)))
    np.testing.assert_array_equal(part[:, [0, 2]][:, :, [0, 2]], old[:, [0, 2]][:, :, [0, 2]])
    prepared = land.condensed(at, case)
    assert 1 in land.stages.that_matter(whole, prepared.from_u, prepared.hessian)  # friction is the speed's
    assert land.stages.that_matter(np.zeros_like(whole), prepared.from_u, prepared.hessian) == []


def test_a_hessian_that_curves_down_is_made_convex():
    rng = np.random.default_rng(0)
    root, other = rng.normal(size=(2, 6, 6))
    gauss_newton, rest = root @ root.T + np.eye(6), 5 * (other + other.T)
    assert np.min(np.linalg.eigvalsh(gauss_newton + rest)) < 0
    got = convex(gauss_newton, rest)
    # 0.1 of Gauss-Newton's curvature in every direction; rounding of a sum of squares.
    assert np.min(np.linalg.eigvalsh(got - 0.1 * gauss_newton)) > -1e-9
    up = other @ other.T
    np.testing.assert_array_equal(convex(gauss_newton, up), gauss_newton + up)  # what is convex is left alone


def test_secants_make_the_hessian_right_along_the_last_step():
    rng = np.random.default_rng(1)
    root, step = rng.normal(size=(5, 5)), rng.normal(size=5)
    hessian = root @ root.T + np.eye(5)
    memory = Secants()
    memory.see(step, 2.0 * step, 3, False)
    assert not memory.pairs  # early steps need no correction
    memory.see(step, 20.0 * step, 20, False)
    got = memory.corrected(hessian)
    np.testing.assert_allclose(got @ step, 20.0 * step, rtol=1e-12)
    assert np.min(np.linalg.eigvalsh(got)) > 0
    memory.see(step, -step, 21, False)  # curving down: damped
    assert np.min(np.linalg.eigvalsh(memory.corrected(hessian))) > 0
    memory.see(step, step, 22, True)  # a soft bound's kink is no curvature
    assert not memory.pairs


def closed_loop(controller, periods=25):
    """Plans along a loop on the model itself."""
    model, e = controller.model, estimate_of(controller.model, d=0.0)
    plan, plans = controller.initial(e), []
    for _ in range(periods):
        plan = controller.solve(plan, e, np.array([[0.5, 0.0]]))
        plans.append(plan)
        x, h = (v.full().ravel() for v in model.step(e.x, e.h, plan.u[0]))
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
    plan = controller.solve(controller.initial(e), e, np.zeros((1, 2)))
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
