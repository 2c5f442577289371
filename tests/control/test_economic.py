"""Economic stage costs: derivatives by differences, plans by IPOPT."""

import casadi as ca
import numpy as np
import pytest
from online_models import pendulum_model

from hybrid_mpc import (
    OCP,
    CondensedController,
    Estimate,
    InputError,
    IpoptController,
    SQPController,
    Status,
    output_cost,
)
from hybrid_mpc.control.problem import EconomicCost

POINT = [0.0, 1.0], [0.0]
X, U = ca.MX.sym("x", 2), ca.MX.sym("u")
COSTS = {
    "power": 3 * U * X[1],  # mechanical power that a supply takes back: bilinear, indefinite
    "losses": ca.log(1 + 10 * U**2) + 0.5 * ca.exp(X[0]),  # curves down where the input is large
    "friction": ca.sqrt(X[1] ** 2 + 0.1) + ca.cos(3 * X[0]),
}


def estimate_of(model, x):
    size = model.n_x + model.n_h + 1
    return Estimate(0.0, np.array(x), np.zeros(model.n_h), np.zeros(1), np.eye(size), np.zeros(1), 0.0)


def problem(name, **others):
    f = None if name is None else ca.Function("economic", [X, U], [COSTS[name]])
    return OCP(
        20, [10.0, 0.1], [0.5], [0.2], [-2.0], [2.0], working_point=POINT, economic=f, **others
    )  # fmt: skip


@pytest.mark.parametrize("z", [0, 3])
@pytest.mark.parametrize("name", COSTS)
def test_sqp_and_the_iterated_rti_find_ipopts_plan(name, z):
    model, ocp, reference = pendulum_model(z=z), problem(name), np.array([[0.4, 0.0]])
    e = estimate_of(model, [-0.3, 0.5])
    sqp, ipopt = (
        c.solve(c.initial(e), e, reference) for c in (SQPController(model, ocp), IpoptController(model, ocp))
    )
    assert sqp.status is ipopt.status is Status.SOLVED
    assert sqp.cost == pytest.approx(ipopt.cost, rel=1e-6)  # the promise of sqp's documentation
    rti = CondensedController(model, ocp, iterations=40)
    plan = rti.solve(rti.initial(e), e, reference)
    # Where it converges it is a stationary point: the convexified Hessian changes the way, not the end.
    np.testing.assert_allclose(plan.u, ipopt.u, atol=1e-3)
    without = SQPController(model, problem(None))
    plain = without.solve(without.initial(e), e, reference)
    assert np.max(np.abs(plain.u - sqp.u)) > 0.02  # it does change the plan


@pytest.mark.parametrize("name", COSTS)
def test_derivatives_are_those_of_finite_differences(name):
    cost, rng = EconomicCost(problem(name), 0.1), np.random.default_rng(0)
    x, u, step = rng.normal(size=(21, 2)), rng.normal(size=(20, 1)), 1e-6
    slope, curvature = cost.derivatives(x, u)
    moved = x + np.array([step, 0.0]), x - np.array([step, 0.0])
    # Central differences over 1e-6: rounding of 1e-16 / 1e-6 in values of some units.
    by_x0 = (cost.value(moved[0], u) - cost.value(moved[1], u)) / (2 * step)
    assert np.sum(slope[:, 0]) == pytest.approx(by_x0, abs=1e-7)
    up, down = (cost.derivatives(x, u + sign * step)[0] for sign in (1, -1))
    np.testing.assert_allclose(curvature[:, 2], (up - down) / (2 * step), atol=1e-7)
    assert np.min(np.linalg.eigvalsh(cost.convex(x, u)[1])) > -1e-12  # rounding
    assert np.min(np.linalg.eigvalsh(curvature)) < 0  # each of them curves down somewhere


@pytest.mark.parametrize(
    "bad",
    [
        ca.Function("f", [X], [X[0]]),
        ca.Function("f", [X, U], [X]),
        ca.Function("f", [ca.MX.sym("x", 3), U], [U]),
    ],
)
def test_bad_expressions_are_refused(bad):
    with pytest.raises(InputError, match="economic"):
        CondensedController(
            pendulum_model(),
            OCP(5, [1.0, 1.0], [1.0], [0.0], [-1.0], [1.0], working_point=POINT, economic=bad),
        )


HEIGHT = ca.Function("height", [X, U], [ca.vertcat(ca.sin(X[0]) + 0.1 * X[1], U**2)])
COURSE = 0.3 + 0.2 * np.sin(0.3 * np.arange(21))


def tracked(model, solver, reference, **options):
    """The plan that tracks outputs which are no states, with ``reference`` ``(m, 4)``."""
    ocp = OCP(
        20, [0.1, 0.1], [0.5], [0.2], [-2.0], [2.0], terminal=np.zeros((2, 2)),
        economic=output_cost(HEIGHT, [300.0, 0.5]),
    )  # fmt: skip
    controller, e = solver(model, ocp, **options), estimate_of(model, [-0.3, 0.5])
    return controller.solve(controller.initial(e), e, reference)


@pytest.mark.parametrize("z", [0, 3])
def test_outputs_follow_their_reference_in_every_solver(z):
    model = pendulum_model(z=z)
    reference = np.column_stack([np.zeros((21, 2)), COURSE, np.full(21, 0.2)])
    sqp, ipopt = (tracked(model, solver, reference) for solver in (SQPController, IpoptController))
    rti = tracked(model, CondensedController, reference, iterations=40)
    assert sqp.status is ipopt.status is rti.status is Status.SOLVED
    assert sqp.cost == pytest.approx(ipopt.cost, rel=1e-6)  # the promise of sqp's documentation
    np.testing.assert_allclose(
        rti.u, ipopt.u, atol=1e-3
    )  # the convexified Hessian changes the way, not the end

    def missed(plan):
        return np.abs(np.sin(plan.x[10:20, 0]) + 0.1 * plan.x[10:20, 1] - COURSE[10:20]).mean()

    held = tracked(model, SQPController, reference[:1])  # without the preview
    assert missed(sqp) < 0.5 * missed(held)


def test_parameters_are_columns_of_the_reference():
    model = pendulum_model()
    with pytest.raises(InputError, match=r"shape \(1, 2\) given, \(m, 4\)"):
        tracked(model, CondensedController, np.zeros((1, 2)))
    plan = tracked(model, SQPController, np.array([[0.0, 0.0, np.nan, 0.0]]))
    assert plan.status is Status.NOT_FINITE
    assert (
        tracked(model, CondensedController, np.array([[0.0, 0.0, np.nan, 0.0]])).status is Status.NOT_FINITE
    )


@pytest.mark.parametrize("weights", [[1.0], [1.0, -1.0], [np.nan, 1.0]])
def test_bad_output_weights_are_refused(weights):
    with pytest.raises(InputError, match="q_y"):
        output_cost(HEIGHT, weights)
