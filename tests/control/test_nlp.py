"""Iterated to convergence, the controller must find what an interior-point solver finds for the full problem."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from online_models import linear_model, pendulum_model

from hybrid_mpc import OCP, CondensedController, Estimate, InputError, IpoptController, Status


def ipopt_plan(model, ocp, terminal, z0, d, reference, u_prev):
    """Direct multiple shooting over (x, h) and u, solved by IPOPT from rest."""
    opti, n, n_x = ca.Opti(), ocp.horizon, ocp.n_x
    z, u = opti.variable(z0.size, n + 1), opti.variable(ocp.n_u, n)
    opti.subject_to(z[:, 0] == z0)
    cost, before = 0, u_prev
    for k in range(n):
        x_next, h_next = model.step(z[:n_x, k], z[n_x:, k], u[:, k] + d, model.w, model.p)
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


def start(model, x):
    return Estimate(
        0.0, np.array(x), np.zeros(model.n_h), np.array([0.1]), np.eye(3 + model.n_h), np.zeros(1), 0.0
    )


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
    model = pendulum_model(z=z)
    ocp = OCP(25, [50.0, 0.5], [0.5], [0.2], [-bound], [bound], du_max, working_point=([0.0, 1.0], [0.0]))
    controller = CondensedController(model, ocp, iterations=40)
    e = start(model, x0)
    reference = np.column_stack([0.2 * np.sin(0.3 * np.arange(26)), np.zeros(26)])
    solution = controller.solve(controller.initial(e), e, reference)
    z0 = np.concatenate([e.x, e.h])
    u, cost = ipopt_plan(model, ocp, ocp.terminal_weight(model), z0, e.d, reference, np.zeros(1))
    assert solution.status is Status.SOLVED
    # Gauss-Newton contracts: after 40 linearizations the trajectory is the model's own to rounding ...
    assert solution.defect < 1e-9
    # ... and the inputs are the NLP's to DAQP's tolerance of 1e-6 of half the range, times ten.
    np.testing.assert_allclose(solution.u, u, atol=1e-5 * bound)
    assert solution.cost == pytest.approx(cost, rel=1e-6)  # at a minimum the cost is flat: better than u's
    change = np.abs(np.diff(u, axis=0, prepend=0.0))
    active = np.max(change) > 0.99 * du_max[0] if du_max else np.max(np.abs(u)) > 0.99 * bound
    assert active == (bound == 2.0)  # the limits matter just where they should


def test_real_time_iterations_converge_along_a_closed_loop():
    model = pendulum_model()
    ocp = OCP(25, [50.0, 0.5], [0.5], [0.0], [-2.0], [2.0], working_point=([0.0, 1.0], [0.0]))
    controller = CondensedController(model, ocp)
    e = start(model, [0.9, 0.0])
    solution, defects = controller.initial(e), []
    for _ in range(40):
        solution = controller.solve(solution, e, np.zeros((1, 2)))
        x = model.step(e.x, e.h, solution.u[0] + e.d, model.w, model.p)[0].full().ravel()
        e, _ = start(model, x), defects.append(solution.defect)
    full = CondensedController(model, ocp, iterations=30).solve(solution, e, np.zeros((1, 2)))
    once = controller.solve(solution, e, np.zeros((1, 2)))
    # RTI: the defects fade, and one linearization a period is as good as thirty.
    assert max(defects[-5:]) < 1e-2 * max(defects)
    np.testing.assert_allclose(once.u[0], full.u[0], atol=1e-3)  # 0.1 % of the bound's size


def test_disturbance_acts_like_an_input():
    model = pendulum_model()
    ocp = OCP(20, [50.0, 0.5], [0.5], [0.0], [-9.0], [9.0], terminal=np.zeros((2, 2)))
    controller = CondensedController(model, ocp, iterations=20)
    e = start(model, [0.3, 0.0])
    s = controller.solve(controller.initial(e), e, np.zeros((1, 2)))
    for k in range(20):  # the plan is the model's own run on u + d; defects are below 1e-9 by then
        x, _ = model.step(s.x[k], s.h[k], s.u[k] + e.d, model.w, model.p)
        np.testing.assert_allclose(s.x[k + 1], x.full().ravel(), atol=1e-8)


def test_sparse_jacobians_of_a_users_model_are_read_rightly():
    a, b = np.diag([0.9, 0.8]), np.array([[0.1], [0.0]])
    dense = linear_model(a, b, np.eye(2)[:1])
    x, h, u, w, p = (ca.MX.sym(name, n) for name, n in zip("xhuwp", (2, 0, 1, 0, 0), strict=True))
    jacobians = ca.sparsify(ca.DM(a)), ca.sparsify(ca.DM(b))
    assert not jacobians[0].is_dense()
    by_hand = ca.Function("j", [x, h, u, w, p], [*dense.step(x, h, u, w, p), *jacobians])
    sparse = replace(dense, with_jacobian=by_hand)
    ocp = OCP(8, [1.0, 1.0], [0.1], [0.0], [-1.0], [1.0])
    e = Estimate(0.0, np.array([1.0, -2.0]), np.zeros(0), np.zeros(1), np.eye(3), np.zeros(1), 0.0)
    plans = []
    for model in (dense, sparse):
        controller = CondensedController(model, ocp)
        plans.append(controller.solve(controller.initial(e), e, np.zeros((1, 2))).u)
    np.testing.assert_array_equal(*plans)
    assert np.max(np.abs(plans[0])) > 0.1


def test_solve_is_pure_and_the_constructor_leaves_nothing_behind():
    model = pendulum_model(z=4)
    ocp = OCP(10, [50.0, 0.5], [0.5], [0.0], [-2.0], [2.0], working_point=([0.0, 1.0], [0.0]))
    used, fresh = CondensedController(model, ocp), CondensedController(model, ocp)
    e = start(model, [0.4, 0.0])
    plan = used.initial(e)
    first = used.solve(plan, e, np.zeros((1, 2)))
    kept = first.u.copy(), first.x.copy(), first.h.copy()
    used.solve(first, start(model, [2.0, 5.0]), np.ones((1, 2)))
    np.testing.assert_array_equal(kept[0], first.u)  # later calls reuse buffers, not results
    np.testing.assert_array_equal(kept[1], first.x)
    np.testing.assert_array_equal(kept[2], first.h)
    for controller in (used, fresh):
        np.testing.assert_array_equal(controller.solve(plan, e, np.zeros((1, 2))).u, first.u)


def test_an_option_that_ipopt_does_not_know_is_refused():
    ocp = OCP(3, [1.0, 1.0], [1.0], [0.0], [-1.0], [1.0])
    with pytest.raises(InputError, match="nonsense"):
        IpoptController(pendulum_model(), ocp, options={"nonsense": 1})


def test_a_weight_of_zero_at_the_end_makes_no_noise(capfd):
    model, ocp = pendulum_model(), OCP(4, [1.0, 1.0], [1.0], [0.0], [-1.0], [1.0], terminal=np.eye(2))
    estimate = Estimate(0.0, np.array([0.3, 0.0]), np.zeros(0), np.zeros(1), np.eye(3), np.zeros(1), 0.0)
    controller = IpoptController(model, ocp)
    weight = np.vstack([np.ones((4, 2)), np.zeros((1, 2))])  # as in a stroke before its follow-through
    plan = controller.solve(controller.initial(estimate), estimate, np.zeros((1, 2)), weight)
    assert plan.status is Status.SOLVED
    told = capfd.readouterr()
    assert "NaN" not in told.out + told.err  # the root of the weight has no slope there, and nobody needs it
