"""Iterated to convergence, the controller must find what an interior-point solver finds for the full problem."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from control_parts import estimate_of, pendulum_problem, plan_of
from online_models import linear_model, pendulum_model

from hybrid_mpc import OCP, CondensedController, InputError, IpoptController, Status


def ipopt_plan(model, ocp, e, reference):
    """Direct multiple shooting over (x, h) and u, written again and solved by IPOPT from rest."""
    z0, before, terminal = np.concatenate([e.x, e.h]), np.zeros(1), ocp.terminal_weight(model)
    opti, n, n_x = ca.Opti(), ocp.horizon, ocp.n_x
    z, u = opti.variable(z0.size, n + 1), opti.variable(ocp.n_u, n)
    opti.subject_to(z[:, 0] == z0)
    cost = 0
    for k in range(n):
        x_next, h_next = model.step(z[:n_x, k], z[n_x:, k], u[:, k] + e.d, model.w, model.p)
        opti.subject_to(z[:, k + 1] == ca.vertcat(x_next, h_next))
        error, du = z[:n_x, k] - reference[k], u[:, k] - before
        cost += model.dt * (
            ca.dot(ocp.q, error**2) + ca.dot(ocp.r, u[:, k] ** 2) + ca.dot(ocp.r_delta, du**2)
        )
        opti.subject_to(opti.bounded(ocp.u_min, u[:, k], ocp.u_max))
        if ocp.du_max is not None:
            opti.subject_to(opti.bounded(-ocp.du_max, du, ocp.du_max))
        before = u[:, k]
    last = z[:n_x, n] - reference[n]
    opti.minimize(cost + last.T @ terminal @ last)
    opti.set_initial(z, np.tile(z0[:, None], n + 1))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-10})
    answer = opti.solve()
    return np.array(answer.value(u)).reshape(ocp.n_u, n).T, answer.value(opti.f)


@pytest.mark.parametrize(
    ("z", "bound", "du_max", "x0"),
    [
        (0, 20.0, None, [0.9, 0.0]),
        (0, 2.0, None, [0.9, -1.0]),
        (0, 2.0, [0.3], [0.9, 1.0]),
        (4, 2.0, [0.3], [-0.7, 0.0]),
    ],
)
def test_converged_iterations_are_ipopts_answer(z, bound, du_max, x0):
    model, ocp = pendulum_model(z=z), pendulum_problem(25, bound, du_max=du_max)
    e = estimate_of(model, x0, 0.1)
    reference = np.column_stack([0.2 * np.sin(0.3 * np.arange(26)), np.zeros(26)])
    plan = plan_of(CondensedController(model, ocp, iterations=40), e, reference)
    u, cost = ipopt_plan(model, ocp, e, reference)
    assert plan.status is Status.SOLVED
    # Gauss-Newton contracts: after 40 linearizations the trajectory is the model's own to rounding ...
    assert plan.defect < 1e-9
    for k in range(25):  # ... the model's run on u + d ...
        x, _ = model.step(plan.x[k], plan.h[k], plan.u[k] + e.d, model.w, model.p)
        np.testing.assert_allclose(plan.x[k + 1], x.full().ravel(), atol=1e-8)
    # ... and the inputs are the NLP's to IPOPT's tolerance of the cost, its root.
    np.testing.assert_allclose(plan.u, u, atol=1e-5 * bound)
    assert plan.cost == pytest.approx(cost, rel=1e-6)  # at a minimum the cost is flat: better than u's
    change = np.abs(np.diff(u, axis=0, prepend=0.0))
    active = np.max(change) > 0.99 * du_max[0] if du_max else np.max(np.abs(u)) > 0.99 * bound
    assert active == (bound == 2.0)  # the limits matter just where they should


def test_real_time_iterations_converge_along_a_closed_loop():
    model, ocp = pendulum_model(), pendulum_problem(25, r_delta=0.0)
    controller, e = CondensedController(model, ocp), estimate_of(model, [0.9, 0.0], 0.1)
    plan, defects = controller.initial(e), []
    for _ in range(40):
        plan = controller.solve(plan, e, np.zeros((1, 2)))
        e = replace(e, x=model.step(e.x, e.h, plan.u[0] + e.d, model.w, model.p)[0].full().ravel())
        defects.append(plan.defect)
    full = CondensedController(model, ocp, iterations=30).solve(plan, e, np.zeros((1, 2)))
    once = controller.solve(plan, e, np.zeros((1, 2)))
    # RTI: the defects fade, and one linearization a period is as good as thirty.
    assert max(defects[-5:]) < 1e-2 * max(defects)
    np.testing.assert_allclose(once.u[0], full.u[0], atol=1e-3)  # 0.1 % of the bound's size


def test_sparse_jacobians_of_a_users_model_are_read_rightly():
    a, b = np.diag([0.9, 0.8]), np.array([[0.1], [0.0]])
    dense = linear_model(a, b, np.eye(2)[:1])
    x, h, u, w, p = (ca.MX.sym(name, n) for name, n in zip("xhuwp", (2, 0, 1, 0, 0), strict=True))
    jacobians = ca.sparsify(ca.DM(a)), ca.sparsify(ca.DM(b))
    assert not jacobians[0].is_dense()
    by_hand = ca.Function("j", [x, h, u, w, p], [*dense.step(x, h, u, w, p), *jacobians])
    ocp = OCP(8, [1.0, 1.0], [0.1], [0.0], [-1.0], [1.0])
    plans = [
        plan_of(CondensedController(model, ocp), estimate_of(model, [1.0, -2.0]), np.zeros((1, 2))).u
        for model in (dense, replace(dense, with_jacobian=by_hand))
    ]
    np.testing.assert_array_equal(*plans)
    assert np.max(np.abs(plans[0])) > 0.1


def test_solve_is_pure_and_the_constructor_leaves_nothing_behind():
    model, ocp = pendulum_model(z=4), pendulum_problem(10, r_delta=0.0)
    used, fresh = CondensedController(model, ocp), CondensedController(model, ocp)
    e = estimate_of(model, [0.4, 0.0], 0.1)
    plan = used.initial(e)
    first = used.solve(plan, e, np.zeros((1, 2)))
    kept = [v.copy() for v in (first.u, first.x, first.h)]
    used.solve(first, estimate_of(model, [2.0, 5.0], 0.1), np.ones((1, 2)))
    for before, now in zip(kept, (first.u, first.x, first.h), strict=True):
        np.testing.assert_array_equal(before, now)  # later calls reuse buffers, not results
    for controller in (used, fresh):
        np.testing.assert_array_equal(controller.solve(plan, e, np.zeros((1, 2))).u, first.u)


def test_an_option_that_ipopt_does_not_know_is_refused():
    with pytest.raises(InputError, match=r"nonsense.*HM-CONTROL-008"):
        IpoptController(pendulum_model(), pendulum_problem(3), options={"nonsense": 1})


def test_a_weight_of_zero_at_the_end_makes_no_noise(capfd):
    model, ocp = pendulum_model(), OCP(4, [1.0, 1.0], [1.0], [0.0], [-1.0], [1.0], terminal=np.eye(2))
    weight = np.vstack([np.ones((4, 2)), np.zeros((1, 2))])  # as in a stroke before its follow-through
    plan = plan_of(IpoptController(model, ocp), estimate_of(model, [0.3, 0.0]), np.zeros((1, 2)), weight)
    assert plan.status is Status.SOLVED
    told = capfd.readouterr()
    assert "NaN" not in told.out + told.err  # the root of the weight has no slope there, and nobody needs it
