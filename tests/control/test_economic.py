"""Economic stage costs: derivatives by differences, plans by IPOPT."""

import casadi as ca
import numpy as np
import pytest
from control_parts import POINT, estimate_of, plan_of
from online_models import pendulum_model

from hybrid_mpc import (
    OCP,
    CondensedController,
    InputError,
    IpoptController,
    SQPController,
    Status,
)
from hybrid_mpc.control.problem import StageCost

X, U = ca.MX.sym("x", 2), ca.MX.sym("u")
COSTS = {
    "power": 3 * U * X[1],  # mechanical power that a supply takes back: bilinear, indefinite
    "losses": ca.log(1 + 10 * U**2) + 0.5 * ca.exp(X[0]),  # curves down where the input is large
    "friction": ca.sqrt(X[1] ** 2 + 0.1) + ca.cos(3 * X[0]),
}
HEIGHT = ca.Function("height", [X, U], [ca.vertcat(ca.sin(X[0]) + 0.1 * X[1], U**2)])
COURSE = 0.3 + 0.2 * np.sin(0.3 * np.arange(21))


def problem(name):
    f = None if name is None else ca.Function("economic", [X, U], [COSTS[name]])
    return OCP(20, [10.0, 0.1], [0.5], [0.2], [-2.0], [2.0], working_point=POINT, economic=f)


def tracking():
    """A problem that tracks outputs which are no states."""
    p = ca.MX.sym("p", 2)
    cost = ca.Function("cost", [X, U, p], [ca.dot(ca.DM([300.0, 0.5]), (HEIGHT(X, U) - p) ** 2)])
    return OCP(
        20, [0.1, 0.1], [0.5], [0.2], [-2.0], [2.0], terminal=np.zeros((2, 2)), economic=cost
    )  # fmt: skip


def plans(model, ocp, reference):
    """Of ``sqp``, ``ipopt`` and the iterated ``rti``, which have to agree."""
    e = estimate_of(model, [-0.3, 0.5])
    solvers = (
        SQPController(model, ocp), IpoptController(model, ocp), CondensedController(model, ocp, iterations=40)
    )  # fmt: skip
    sqp, ipopt, rti = (plan_of(solver, e, reference) for solver in solvers)
    assert sqp.status is ipopt.status is Status.SOLVED
    assert sqp.cost == pytest.approx(ipopt.cost, rel=1e-6)  # the promise of sqp's documentation
    # Where it converges it is a stationary point: the convexified Hessian changes the way, not the end.
    np.testing.assert_allclose(rti.u, ipopt.u, atol=1e-3)
    return sqp


@pytest.mark.parametrize("z", [0, 3])
@pytest.mark.parametrize("name", COSTS)
def test_every_solver_finds_ipopts_plan(name, z):
    model, reference = pendulum_model(z=z), np.array([[0.4, 0.0]])
    sqp = plans(model, problem(name), reference)
    plain = plan_of(SQPController(model, problem(None)), estimate_of(model, [-0.3, 0.5]), reference)
    assert np.max(np.abs(plain.u - sqp.u)) > 0.02  # the cost does change the plan


@pytest.mark.parametrize("z", [0, 3])
def test_outputs_follow_their_reference_in_every_solver(z):
    model = pendulum_model(z=z)
    reference = np.column_stack([np.zeros((21, 2)), COURSE, np.full(21, 0.2)])
    sqp = plans(model, tracking(), reference)
    held = plan_of(SQPController(model, tracking()), estimate_of(model, [-0.3, 0.5]), reference[:1])
    missed, without_preview = (
        np.abs(np.sin(p.x[10:20, 0]) + 0.1 * p.x[10:20, 1] - COURSE[10:20]).mean() for p in (sqp, held)
    )
    assert missed < 0.5 * without_preview


@pytest.mark.parametrize("solver", [SQPController, CondensedController])
def test_parameters_are_columns_of_the_reference(solver):
    controller = solver(pendulum_model(), tracking())
    e = estimate_of(controller.model, [-0.3, 0.5])
    with pytest.raises(InputError, match=r"\(1, 2\).*HM-CONTROL-038"):
        plan_of(controller, e, np.zeros((1, 2)))
    assert plan_of(controller, e, np.array([[0.0, 0.0, np.nan, 0.0]])).status is Status.NOT_FINITE


@pytest.mark.parametrize("name", COSTS)
def test_derivatives_are_those_of_finite_differences(name):
    cost, rng = StageCost(problem(name), 0.1), np.random.default_rng(0)
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


THREE = ca.MX.sym("x", 3)


@pytest.mark.parametrize("given", [([X], [X[0]]), ([X, U], [X]), ([THREE, U], [U])])
def test_bad_expressions_are_refused(given):
    with pytest.raises(InputError, match="economic"):
        CondensedController(pendulum_model(), problem(None).changed(economic=ca.Function("f", *given)))


@pytest.mark.parametrize("weights", [[1.0, 1.0], [-1.0], [np.nan]])
def test_bad_output_weights_are_refused(weights):
    with pytest.raises(InputError, match="q_y"):
        CondensedController(pendulum_model(), problem(None).changed(q_y=weights))
