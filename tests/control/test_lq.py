"""On linear models one iteration must give the exact answer of the linear-quadratic problem."""

import numpy as np
import pytest
from control_parts import estimate_of, linear_problem, plan_of
from lq_oracle import constraints, lq_plan, residuals
from online_models import linear_model, random_linear

from hybrid_mpc import OCP, CondensedController, InputError, IpoptController, SQPController, Status, dare

INF = np.inf


@pytest.mark.parametrize(("n_u", "radius"), [(1, 0.98), (2, 0.98), (1, 1.3), (2, 1.3)])
def test_the_whole_plan_is_the_lqr(n_u, radius):
    model, a, b, _ = random_linear(7, n_u=n_u, radius=radius)
    controller = CondensedController(model, linear_problem(n_u, 12))
    _, k = dare(a, b, np.diag(controller.ocp.q), np.diag(controller.ocp.r))  # dt scales q and r alike
    z = np.array([0.8, -0.5, 0.3])
    plan = plan_of(controller, estimate_of(model, z), np.zeros((1, 3)))
    assert plan.status is Status.SOLVED
    for j in range(12):
        np.testing.assert_allclose(plan.u[j], -k @ z, atol=1e-8)  # rounding, cond(H) about 1e4
        np.testing.assert_allclose(plan.x[j], z, atol=1e-8)
        z = (a - b @ k) @ z


@pytest.mark.parametrize("n_h", [0, 2])
@pytest.mark.parametrize("r_delta", [0.0, 0.3])
def test_reference_disturbance_and_change_weight_without_bounds(n_h, r_delta):
    model, a, b, _ = random_linear(3, n_u=2, n_h=n_h)
    controller = CondensedController(model, linear_problem(2, 15, r_delta=r_delta))
    rng = np.random.default_rng(5)
    z, d, u_prev, reference = (rng.normal(size=size) for size in (3 + n_h, 2, 2, (16, 3)))
    plan = plan_of(controller, estimate_of(model, z, d), reference, start=np.tile(u_prev, (15, 1)))
    terminal = controller.ocp.terminal_weight(model)
    args = a, b, controller.ocp, model.dt, terminal, z, d, reference, u_prev
    np.testing.assert_allclose(plan.u, lq_plan(*args), atol=1e-8)  # rounding, as above
    assert plan.cost == pytest.approx(np.sum(residuals(plan.u, *args) ** 2), rel=1e-10)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("du_max", [None, 0.15])
@pytest.mark.parametrize("n_u", [1, 2])
def test_bounds_and_limits_of_the_change(n_u, du_max, seed):
    n_h = 2 * (seed % 2)
    model, a, b, _ = random_linear(seed, n_u=n_u, n_h=n_h, radius=1.05)
    ocp = linear_problem(n_u, 10, bound=0.5, du_max=du_max, r_delta=0.1)
    rng = np.random.default_rng(seed)
    z, d, reference = rng.normal(size=3 + n_h), 0.1 * rng.normal(size=n_u), rng.normal(size=(11, 3))
    u_prev = rng.uniform(-0.5, 0.35, size=n_u)
    start = np.tile(u_prev, (10, 1))
    plan = plan_of(CondensedController(model, ocp), estimate_of(model, z, d), reference, start=start)
    want = lq_plan(a, b, ocp, model.dt, ocp.terminal_weight(model), z, d, reference, u_prev)
    assert plan.status is Status.SOLVED
    g, h = constraints(ocp, u_prev)
    assert np.min(h - g @ want.ravel()) < 1e-9  # bounds are active: the case is not a free one
    # Both are exact but for rounding; that of NNLS is the larger.
    np.testing.assert_allclose(plan.u, want, atol=1e-8)


@pytest.mark.parametrize("du_max", [None, 0.15])
@pytest.mark.parametrize("seed", range(2))
def test_weights_over_time(seed, du_max):
    model, a, b, _ = random_linear(seed, n_u=1, n_h=2 * (seed % 2), radius=1.02)
    ocp = linear_problem(1, 10, bound=0.5, du_max=du_max, r_delta=0.1)
    rng = np.random.default_rng(seed)
    z, reference, weight = rng.normal(size=len(a)), rng.normal(size=(11, 3)), rng.uniform(0, 2, (11, 3))
    weight[:6], weight[6] = 0.0, [1e3, 1e3, 0.0]  # nothing counts until one instant at which two states do
    controller, e = CondensedController(model, ocp), estimate_of(model, z)
    got = plan_of(controller, e, reference, weight)
    args = a, b, ocp, model.dt, ocp.terminal_weight(model), z, np.zeros(1), reference, np.zeros(1), weight
    want = lq_plan(*args)
    np.testing.assert_allclose(got.u, want, atol=1e-8)
    assert got.cost == pytest.approx(np.sum(residuals(want, *args) ** 2), rel=1e-8)
    same = np.vstack([weight[:8], np.tile(weight[7], (3, 1))])  # the last value holds
    short = plan_of(controller, e, reference, weight[:8])
    np.testing.assert_array_equal(short.u, plan_of(controller, e, reference, same).u)


@pytest.mark.parametrize("weight", [0.0, np.nan, -1.0])
def test_a_weight_of_zero_leaves_only_effort_and_one_that_makes_no_sense_is_a_failed_solve(weight):
    model, *_ = random_linear(0, n_u=1)
    controller = CondensedController(model, linear_problem(1, 10))
    got = plan_of(controller, estimate_of(model, np.ones(3)), np.ones((1, 3)), np.full((1, 3), weight))
    assert np.all(np.isfinite(got.u))
    if weight == 0:
        np.testing.assert_allclose(got.u, 0.0, atol=1e-12)  # rounding
        assert got.cost == pytest.approx(0.0, abs=1e-20)
    else:
        assert got.status is Status.NOT_FINITE


@pytest.mark.parametrize("n_h", [0, 2])
def test_a_disturbance_that_has_changed_since_the_last_plan(n_h):
    model, a, b, _ = random_linear(5, n_u=2, n_h=n_h)
    controller = CondensedController(model, linear_problem(2, 12, r_delta=0.2))
    rng = np.random.default_rng(1)
    z, before, d, reference = (rng.normal(size=size) for size in (3 + n_h, 2, 2, (13, 3)))
    plan = plan_of(controller, estimate_of(model, z, before), reference)
    got = controller.solve(plan, estimate_of(model, z, d), reference)
    np.testing.assert_array_equal(got.d, d)
    args = a, b, controller.ocp, model.dt, controller.ocp.terminal_weight(model), z
    # On a linear model the new plan owes nothing to the old one: not its trajectory, not its disturbance.
    np.testing.assert_allclose(got.u, lq_plan(*args, d, reference, plan.u[0]), atol=1e-8)
    assert np.max(np.abs(got.u - lq_plan(*args, before, reference, plan.u[0]))) > 0.1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reference": np.zeros((0, 3))}, "reference"),
        ({"reference": np.zeros((4, 2))}, "HM-CONTROL-038"),
        ({"reference": np.zeros(3)}, "reference"),
        ({"u": np.zeros((3, 1))}, r"10.*HM-CONTROL-024"),
        ({"u": np.full((10, 1), np.nan)}, "finite"),
        ({"weight": np.zeros((4, 2))}, r"weight.*\(4, 2\).*HM-CONTROL-038"),
        ({"iterations": 0}, "iterations"),
        ({"n_u": 2}, "HM-CONTROL-035"),
    ],
)
def test_bad_input_is_refused(change, words):
    given = {"reference": np.zeros((1, 3)), "weight": None, "u": None, "n_u": 1, "iterations": 1, **change}
    model, *_ = random_linear(0, n_u=1)

    def use():
        controller = CondensedController(
            model, linear_problem(given["n_u"], 10), iterations=given["iterations"]
        )
        e = estimate_of(model, np.zeros(3))
        plan_of(controller, e, given["reference"], given["weight"], start=given["u"])

    with pytest.raises(InputError, match=words):
        use()


@pytest.mark.parametrize(
    "limits",
    [(0.5, 2), (-2, 0), (-0.5, INF), (-INF, -0.5), (-INF, INF),
     *(pytest.param(one, marks=pytest.mark.full) for one in ((-1, 2), (0, 2), (-2, -0.5), (0, INF), (0.5, INF)))],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize(
    ("solver", "size"),
    # IPOPT gets its unknowns as they are, and takes inputs of a millionth for zero.
    [(CondensedController, 1e5), (CondensedController, 1e-6), (SQPController, 1e5), (SQPController, 1e-6),
     (IpoptController, 1.0), (IpoptController, 1e5)],
)  # fmt: skip
@pytest.mark.parametrize("du_max", [None, 0.6])
def test_limits_of_any_sign_in_units_of_any_size(limits, solver, size, du_max):
    _, a, b, c = random_linear(3, n_x=3, n_u=2)
    b, lower, upper = b / size, *([bound * size] * 2 for bound in limits)
    change = None if du_max is None else [du_max * size] * 2
    weights = np.array([0.3, 0.5]) / size**2, np.array([0.1, 0.1]) / size**2
    model, ocp = linear_model(a, b, c), OCP(8, [1.0, 2.0, 3.0], *weights, lower, upper, change)
    e, reference, controller = estimate_of(model, [3.0, -2.0, 1.0]), np.zeros((9, 3)), solver(model, ocp)
    first = controller.initial(e)
    np.testing.assert_array_equal(first.u, np.tile(np.clip(0.0, lower, upper), (8, 1)))
    found = controller.solve(first, e, reference)
    want = lq_plan(a, b, ocp, model.dt, ocp.terminal_weight(model), e.x, np.zeros(2), reference, first.u[0])
    assert found.status.ok
    # NNLS, which the oracle stands on, ends at about 1e-9; IPOPT relaxes bounds by 1e-8 and ends at 1e-5 near them.
    np.testing.assert_allclose(found.u / size, want / size, atol=1e-5 if solver is IpoptController else 1e-8)
