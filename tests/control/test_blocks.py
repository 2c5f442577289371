"""Move blocking: every solver finds the same plan, and holds its inputs."""

import numpy as np
import pytest
from control_parts import estimate_of, pendulum_problem, plan_of
from lq_oracle import states
from online_models import pendulum_model, random_linear
from scipy.optimize import minimize

from hybrid_mpc import OCP, CondensedController, IpoptController, SQPController, Status

BLOCKS = (1, 1, 2, 3, 5, 8)


def is_held(u):
    return all(np.ptp(part, axis=0).max() == 0.0 for part in np.split(u, np.cumsum(BLOCKS)[:-1]))


@pytest.mark.parametrize("limits", [{}, {"du_max": [0.5]}, {"x_max": [0.55, 1.0]}])
def test_sqp_and_ipopt_find_the_same_held_inputs(limits):
    model, ocp = pendulum_model(z=3), pendulum_problem(20, blocks=BLOCKS, **limits)
    e, reference = estimate_of(model, [-0.5, 0.0]), np.array([[0.5, 0.0]])
    sqp, ipopt = (plan_of(c(model, ocp), e, reference) for c in (SQPController, IpoptController))
    assert sqp.status is ipopt.status is Status.SOLVED
    assert is_held(sqp.u)
    assert sqp.cost == pytest.approx(ipopt.cost, rel=1e-6)  # the promise of sqp's documentation
    free, single = (SQPController(model, ocp.changed(blocks=b)) for b in (None, (1,) * 20))
    best = plan_of(free, e, reference)
    assert best.cost < sqp.cost * (1 - 1e-4)  # blocks cost something
    # Blocks of one period change nothing but the order of sums, which an exact penalty stretches.
    assert plan_of(single, e, reference).cost == pytest.approx(best.cost, rel=1e-9)
    if "du_max" in limits:
        assert np.max(np.abs(np.diff(sqp.u, axis=0))) == pytest.approx(0.5, abs=1e-5)  # and the limit acts


def test_a_linear_problem_by_an_independent_minimiser():
    model, a, b, _ = random_linear(3, n_x=3, n_u=2)
    ocp = OCP(
        8, np.ones(3), [0.3] * 2, [0.1] * 2, [-0.4] * 2, [0.4] * 2, terminal=np.eye(3), blocks=(1, 2, 5)
    )
    e = estimate_of(model, [1.0, -2.0, 0.5])
    plan = plan_of(CondensedController(model, ocp), e, np.zeros((1, 3)))

    def cost(v):
        u = np.repeat(v.reshape(3, 2), (1, 2, 5), axis=0)
        x, du = np.vstack([e.x, states(u, a, b, ocp, e.x, e.d)]), np.diff(u, axis=0, prepend=np.zeros((1, 2)))
        return model.dt * np.sum(ocp.stage_cost(x[:-1], u, np.zeros((8, 3)), du)) + x[-1] @ x[-1]

    options = {"ftol": 1e-15, "gtol": 1e-9}
    want = minimize(cost, np.zeros(6), bounds=[(-0.4, 0.4)] * 6, method="L-BFGS-B", options=options)
    assert np.max(np.abs(want.x)) == pytest.approx(0.4)  # a bound acts
    # L-BFGS-B differentiates numerically: 1e-8 of the slope, over a condition of some tens.
    np.testing.assert_allclose(plan.u, np.repeat(want.x.reshape(3, 2), (1, 2, 5), axis=0), atol=1e-5)
    assert plan.cost == pytest.approx(want.fun, rel=1e-9)
