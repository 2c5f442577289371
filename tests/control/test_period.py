"""A period that is a multiple of the model's: the model's own steps, its exact Jacobian, and the loop at that rate."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from closed_loop_parts import DT, PendulumPlant, Recorder, make_safe, sine
from control_parts import estimate_of, plan_of
from online_models import pendulum_model, random_linear

from hybrid_mpc import (
    OCP,
    CondensedController,
    ExtendedKalmanFilter,
    InputError,
    IpoptController,
    SafeController,
    SQPController,
    Status,
    dare,
    longer_period,
    simulate,
)

M = 3


@dataclass(frozen=True)
class InSteps:
    """The pendulum, which steps by 0.02 s only, led through a longer period on one input."""

    plant: PendulumPlant

    def step(self, state, u, dt):
        for _ in range(round(dt / DT)):
            state = self.plant.step(state, u, DT)
        return state

    def __getattr__(self, name):
        return getattr(self.plant, name)


@pytest.mark.parametrize(("z", "m"), [(0, M), (4, M), (4, 1)])
def test_a_step_is_the_models_own_steps(z, m):
    model = pendulum_model(z)
    slow = longer_period(model, m)
    assert slow.dt == pytest.approx(m * model.dt, rel=1e-15)
    rng = np.random.default_rng(z)
    x, h, u = np.array([0.4, -1.0]), rng.normal(size=z), np.array([0.7])
    x_m, h_m = x, h
    for _ in range(m):
        x_m, h_m = (v.full().ravel() for v in model.step(x_m, h_m, u, model.w, model.p))
    for f in (slow.step, slow.with_jacobian):  # the same operations in the same order
        x_s, h_s = (v.full().ravel() for v in f(x, h, u, slow.w, slow.p)[:2])
        np.testing.assert_allclose(x_s, x_m, rtol=1e-14)
        np.testing.assert_allclose(h_s, h_m, rtol=1e-14)


@pytest.mark.parametrize("z", [0, 4])
def test_the_jacobian_by_three_routes(z):
    slow = longer_period(pendulum_model(z), M)
    symbols = [ca.MX.sym(n, s) for n, s in (("x", 2), ("h", z), ("u", 1))]
    stacked = ca.vertcat(*symbols)
    after = ca.vertcat(*slow.step(*symbols, slow.w, slow.p))
    exact = ca.Function("exact", symbols, [ca.densify(ca.jacobian(after, stacked))])
    rng = np.random.default_rng(1)
    at = rng.normal(size=3 + z)
    split = lambda v: (v[:2], v[2:-1], v[-1:], slow.w, slow.p)  # noqa: E731
    chain = np.hstack([m.full() for m in slow.with_jacobian(*split(at))[2:]])
    np.testing.assert_allclose(chain, exact(*split(at)[:3]).full(), atol=1e-13)  # rounding
    run = lambda v: np.concatenate([m.full().ravel() for m in slow.step(*split(v))])  # noqa: E731
    for i in range(at.size):
        e = 1e-6 * np.eye(at.size)[i]
        # central differences: rounding 1e-16 / 1e-6, truncation 1e-12 times the third derivative
        np.testing.assert_allclose((run(at + e) - run(at - e)) / 2e-6, chain[:, i], atol=1e-7)


def test_the_lqr_of_the_longer_period():
    model, a, b, _ = random_linear(7, n_u=1)
    slow = longer_period(model, M)
    a_m, b_m = np.linalg.matrix_power(a, M), sum(np.linalg.matrix_power(a, k) @ b for k in range(M))
    ocp = OCP(10, [1.0, 0.5, 2.0], [0.4], [0.0], [-np.inf], [np.inf])
    _, k = dare(a_m, b_m, np.diag(ocp.q), np.diag(ocp.r))
    e = estimate_of(slow, np.array([0.8, -0.5, 0.3]))
    plan = plan_of(CondensedController(slow, ocp), e, np.zeros((1, 3)))
    np.testing.assert_allclose(plan.u[0], -k @ e.x, atol=1e-8)  # rounding, cond(H) about 1e4


def test_the_same_plan_as_move_blocks_of_the_models_period():
    """With weights at the blocks' ends only, the longer period and move blocks are one problem."""
    model = pendulum_model(4)
    slow, n = longer_period(model, M), 8
    q, r, p = np.array([30.0, 1.0]), [0.5], np.diag([3.0, 0.1])
    coarse = OCP(n, M * q, r, [0.0], [-2.0], [2.0], terminal=p)
    fine = OCP(n * M, M * M * q, r, [0.0], [-2.0], [2.0], terminal=p, blocks=(M,) * n)
    weight = np.zeros((n * M + 1, 2))
    weight[::M] = 1.0
    start, goal = np.concatenate([[0.6, 0.0], np.zeros(4)]), np.array([[-0.4, 0.0]])
    plans = []
    for own, ocp, factors in ((slow, coarse, None), (model, fine, weight)):
        plans.append(plan_of(SQPController(own, ocp), estimate_of(own, start), goal, factors))
        assert plans[-1].status is Status.SOLVED
    np.testing.assert_allclose(plans[0].u, plans[1].u[::M], atol=1e-5)  # both to 1e-10 of the cost
    reference = plan_of(IpoptController(slow, coarse), estimate_of(slow, start), goal)
    assert plans[0].cost == pytest.approx(reference.cost, rel=1e-6)


def test_the_loop_runs_at_the_longer_period_and_holds_the_input():
    model = pendulum_model(4)
    slow = longer_period(model, M)
    ocp = OCP(15, (300.0, 1.0), [0.05], [0.05], [-6.0], [6.0], working_point=([0.0, 1.0], [0.0]))
    safe = SafeController(CondensedController(slow, ocp), longer_period(pendulum_model(), M))
    ekf = ExtendedKalmanFilter(
        slow, sigma_y=[1e-3], sigma_x=[2e-3, 2e-2], sigma_d=[4e-2], sigma_x0=[1e-2, 0.1], sigma_d0=[0.1]
    )
    plant = Recorder(InSteps(PendulumPlant()), [])
    result = simulate(plant, ekf, safe, sine, dt=M * DT, duration=3.0, x0=[0.0, 0.0], seed=0)
    assert len(result.t) == len(plant.inputs) == 50
    np.testing.assert_allclose(np.diff(result.t), M * DT)
    assert set(result.source) == {"MPC"}
    # the plant differs from the model by some per cent and friction; the sine's own rms is 0.35 rad
    assert result.tracking_rmse[0] < 0.03


def test_a_loop_at_the_models_own_period_is_refused():
    slow = longer_period(pendulum_model(), M)
    ekf = ExtendedKalmanFilter(slow, sigma_y=[1e-3], sigma_x=[1e-3, 1e-2], sigma_x0=[1e-2, 0.1])
    with pytest.raises(InputError, match="HM-LOOP-048"):
        simulate(PendulumPlant(), ekf, make_safe(slow), sine, dt=DT, duration=1.0, x0=[0.0, 0.0], seed=0)


@pytest.mark.parametrize("periods", [0, -1, 1.5])
def test_other_numbers_of_periods_are_refused(periods):
    with pytest.raises(InputError, match="HM-MODEL-028"):
        longer_period(pendulum_model(), periods)


def test_the_model_s_fast_way_is_not_taken_for_the_longer_period():
    model = replace(pendulum_model(z=3), side_by_side=lambda n: pytest.fail("one period only"))
    slow = longer_period(model, M)
    assert slow.side_by_side is None
    CondensedController(slow, OCP(5, [1.0, 0.1], [1.0], [0.0], [-1.0], [1.0], working_point=([0, 1], [0])))
