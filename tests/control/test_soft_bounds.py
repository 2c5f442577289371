"""Soft bounds on linear models against an independent solver, and what an exact penalty promises."""

import casadi as ca
import numpy as np
import pytest
from control_parts import estimate_of, plan_of
from lq_oracle import soft_plan, states
from online_models import linear_model, random_linear

from hybrid_mpc import OCP, CondensedController, InputError, SoftBound, Status
from hybrid_mpc.control.problem import BoundRows
from hybrid_mpc.control.sizes import Sizes

DT = 0.1
A, B = np.array([[1.0, DT], [0.0, 1.0]]), np.array([[0.5 * DT**2], [DT]])


def solve(model, ocp, z, reference, d=0.0, weight=None, held=None):
    start = None if held is None else np.tile(held, (ocp.horizon, 1))
    return plan_of(CondensedController(model, ocp), estimate_of(model, z, d), reference, weight, start=start)


@pytest.mark.parametrize("seed", [0, 1, 3, 4])
@pytest.mark.parametrize("penalty", [0.3, 50.0])
def test_random_problems_are_solved_as_by_ipopt(seed, penalty):
    n_u, n_h = 1 + seed % 2, 2 * (seed % 3 == 0)
    model, a, b, _ = random_linear(seed, n_u=n_u, n_h=n_h, radius=1.02)
    rng = np.random.default_rng(seed)
    z, d, reference = rng.normal(size=3 + n_h), 0.1 * rng.normal(size=n_u), rng.normal(size=(11, 3))
    weight, u_prev = rng.uniform(0.0, 3.0, size=(11, 3)), rng.uniform(-0.3, 0.3, size=n_u)
    ocp = OCP(
        10, [1.0, 0.5, 2.0], [0.5] * n_u, [0.1] * n_u, [-0.5] * n_u, [0.4] * n_u, [0.3] * n_u,
        x_min=[-0.2, -np.inf, -0.4], x_max=[0.3, 0.25, np.inf],
        slack_linear=[penalty] * 3, slack_quadratic=[2 * penalty] * 3,
    )  # fmt: skip
    got = solve(model, ocp, z, reference, d, weight, u_prev)
    terminal = ocp.terminal_weight(model)
    want, cost = soft_plan(a, b, ocp, model.dt, terminal, z, d, reference, u_prev, weight)
    assert got.status is Status.SOLVED
    x = states(want, a, b, ocp, z, d)
    assert np.any(np.maximum(x - ocp.x_max, ocp.x_min - x) > -1e-6)  # a soft bound matters
    # IPOPT ends within 1e-11 of the cost, the plan is good to the root of it.
    np.testing.assert_allclose(got.u, want, atol=1e-5)
    assert got.cost == pytest.approx(cost, rel=1e-6)
    beyond = np.maximum(x - ocp.x_max, ocp.x_min - x)
    assert got.excess == pytest.approx(max(0.0, np.max(beyond)), abs=1e-5)


def double_integrator(**limits):
    model = linear_model(A, B, np.eye(2)[:1], dt=DT)
    ocp = OCP(30, [10.0, 0.1], [0.01], [0.0], [-3.0], [3.0], **limits)
    return model, ocp


def test_a_bound_that_can_be_kept_is_kept_exactly():
    model, ocp = double_integrator(x_min=[-np.inf, -0.5], x_max=[0.8, 0.5])
    got = solve(model, ocp, np.zeros(2), np.tile([1.0, 0.0], (31, 1)))
    assert got.status is Status.SOLVED
    assert np.max(got.x[:, 1]) == pytest.approx(0.5, abs=1e-6)  # both bounds are active ...
    assert np.max(got.x[:, 0]) == pytest.approx(0.8, abs=1e-6)
    assert got.excess < 1e-6  # ... and kept to the QP's tolerance, since the penalty is exact
    # the hard problem has the same answer: raising the penalties changes nothing
    _, higher = double_integrator(
        x_min=[-np.inf, -0.5], x_max=[0.8, 0.5], slack_linear=[1e5, 1e5], slack_quadratic=[1e5, 1e5]
    )
    again = solve(model, higher, np.zeros(2), np.tile([1.0, 0.0], (31, 1)))
    # the QP's tolerance of half the range of 6, times ten
    np.testing.assert_allclose(again.u, got.u, atol=2e-5)


def test_expression_that_is_a_state_or_an_input_bounds_it():
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    z, reference = np.zeros(2), np.tile([1.0, 0.0], (31, 1))
    speed = SoftBound(ca.Function("speed", [x, u], [x[1]]), [-0.5], [0.5], [1e3], [1e3])
    limit = {"slack_linear": [1.0, 1e3], "slack_quadratic": [1.0, 1e3]}
    model, by_state = double_integrator(x_min=[-np.inf, -0.5], x_max=[np.inf, 0.5], **limit)
    by_expression = double_integrator(soft=[speed])[1]
    want, got = (solve(model, ocp, z, reference) for ocp in (by_state, by_expression))
    # x_N is bounded by x_max but is in no stage; at rest at the goal neither bound acts there.
    np.testing.assert_allclose(got.u, want.u, atol=2e-5)
    assert np.max(want.x[:, 1]) == pytest.approx(0.5, abs=1e-6)
    torque = SoftBound(ca.Function("torque", [x, u], [u + 0.5 * x[1]]), [-np.inf], [1.0], [1e3], [1e3])
    plan = solve(model, double_integrator(soft=[torque])[1], z, reference)
    values = plan.u[:, 0] + 0.5 * plan.x[:-1, 1]
    assert np.max(values) == pytest.approx(1.0, abs=1e-6)
    assert np.sum(values > 1 - 1e-6) > 1


def test_derivatives_of_expressions_are_those_of_finite_differences():
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u", 2)
    e = ca.Function("e", [x, u], [ca.vertcat(x[0] * u[1], ca.sin(x[1]) + u[0] ** 2, x[0] * x[1])])
    bound = SoftBound(e, [-1.0] * 3, [1.0] * 3, [1.0] * 3, [1.0] * 3)
    ocp = OCP(3, [1.0, 1.0], [1.0] * 2, [0.0] * 2, [-9.0] * 2, [9.0] * 2, x_max=[np.inf, 0.5], soft=[bound])
    model = linear_model(0.9 * np.eye(2), np.eye(2), np.eye(2))
    rows, rng = BoundRows(ocp, model, Sizes(model, ocp)), np.random.default_rng(0)
    xs, us = rng.normal(size=(4, 2)), rng.normal(size=(3, 2))
    value, by_x, by_u = rows.linearize(xs, us)
    assert len(rows) == 3 + 9
    dx, du = rng.normal(size=(4, 2)), rng.normal(size=(3, 2))
    step = 1e-6
    change = (rows.values(xs + step * dx, us + step * du) - rows.values(xs - step * dx, us - step * du)) / (
        2 * step
    )
    inputs = np.vstack([du, np.zeros(2)])[rows.stage]
    want = np.sum(by_x * dx[rows.stage], axis=1) + np.sum(by_u * inputs, axis=1)
    np.testing.assert_allclose(change, want, atol=1e-8)  # central differences, rounding of 1e-16 / 1e-6
    np.testing.assert_array_equal(value[:3], xs[1:, 1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x_min": [0.0]}, r"lower.*HM-CONTROL-052"),
        ({"x_min": [1.0, 0.0], "x_max": [0.0, 1.0]}, "HM-CONTROL-051"),
        ({"x_max": [np.nan, 1.0]}, "HM-CONTROL-051"),
        ({"slack_linear": [-1.0, 1.0]}, "HM-CONTROL-049"),
        ({"slack_quadratic": [0.0, 1.0]}, "positive"),
        ({"slack_quadratic": [np.inf, 1.0]}, "HM-CONTROL-050"),
    ],
)
def test_bad_bounds_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        double_integrator(**change)


def test_bad_expressions_are_refused():
    x, u = ca.MX.sym("x", 3), ca.MX.sym("u")
    with pytest.raises(InputError, match=r"\(x, u\).*HM-CONTROL-044"):
        SoftBound(ca.Function("e", [x], [x]), [0.0] * 3, [1.0] * 3, [1.0] * 3, [1.0] * 3)
    with pytest.raises(InputError, match="HM-CONTROL-052"):
        SoftBound(ca.Function("e", [x, u], [x]), [0.0], [1.0], [1.0], [1.0])
    three = SoftBound(ca.Function("e", [x, u], [x]), [0.0] * 3, [1.0] * 3, [1.0] * 3, [1.0] * 3)
    model, ocp = double_integrator(soft=[three])
    with pytest.raises(InputError, match="HM-CONTROL-033"):
        CondensedController(model, ocp)
