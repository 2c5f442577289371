"""Whatever goes wrong, the input is within its limits, and the sources follow each other as documented."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from control_parts import POINT, pendulum_problem, plan_of
from control_parts import estimate_of as estimate_at
from hypothesis import given, settings
from hypothesis import strategies as st
from online_models import levitated_ball, linear_model, pendulum_model

from hybrid_mpc import (
    OCP,
    CondensedController,
    ExtendedKalmanFilter,
    InputError,
    SafeController,
    SQPController,
    Status,
    lqr,
)
from hybrid_mpc.control.safeguard import Source

LIMITS = pendulum_problem(15, du_max=[0.25]).changed(u_min=[-1.0])


class Failing:
    """A controller whose solves fail in the periods given; it plans nonsense there."""

    def __init__(self, controller, periods, nonsense=np.nan):
        self._controller, self._periods, self._nonsense, self._k = controller, set(periods), nonsense, -1

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def solve(self, previous, estimate, reference, weight=None, *, limits=None):
        self._k += 1
        solution = self._controller.solve(previous, estimate, reference, weight)
        if self._k not in self._periods:
            return solution
        prepared = self._controller.prepare(previous)
        kept = prepared.u if self._nonsense is None else np.full_like(prepared.u, self._nonsense)
        return replace(solution, u=kept, status=Status.INACCURATE)


@pytest.fixture(scope="module")
def parts():
    model, prior = pendulum_model(z=3), pendulum_model()
    ekf = ExtendedKalmanFilter(
        model, sigma_y=[1e-3], sigma_x=[1e-3, 1e-2], sigma_d=[5e-3], sigma_x0=[1e-2, 0.1], sigma_d0=[0.1]
    )
    return model, prior, CondensedController(model, LIMITS), ekf


def estimate_of(x, d=0.0, n_h=3):
    return estimate_at(pendulum_model(n_h), x, d)


def run(safe, estimates, reference=None, u=None):
    reference = np.zeros((1, 2)) if reference is None else reference
    decision, decisions = safe.initial(estimates[0], u), []
    for e in estimates:
        decision = safe.decide(decision, e, reference)
        decisions.append(decision)
    return decisions


def within(u, held, ocp=LIMITS):
    # 4 ulp of the bound: held +- du_max is rounded once, the difference from held once more
    slack = 4 * np.finfo(float).eps * 2.0
    assert np.all(np.isfinite(u))
    assert np.all(u >= ocp.u_min)
    assert np.all(u <= ocp.u_max)
    assert np.all(np.abs(u - held) <= ocp.du_max + slack)


VALUES = st.one_of(st.floats(-3, 3), st.floats(allow_nan=True, allow_infinity=True))


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_limits_hold_whatever_comes(parts, data):
    _, prior, controller, ekf = parts
    periods = data.draw(st.sets(st.integers(0, 11)))
    nonsense = data.draw(st.sampled_from([None, np.nan, np.inf, 1e300, -7.0]))
    safe = SafeController(Failing(controller, periods, nonsense), prior, max_age=data.draw(st.integers(0, 3)))
    estimate = ekf.start([data.draw(VALUES)])
    decision = safe.initial(estimate)
    for _ in range(12):
        reference = np.array([[data.draw(VALUES), data.draw(VALUES)]])
        held = decision.u
        decision = safe.decide(decision, estimate, reference)
        within(decision.u, held)
        np.testing.assert_array_equal(decision.solution.u[0], decision.u)
        assert np.all(np.isfinite(decision.solution.u))
        assert (decision.source is Source.MPC) == decision.status.ok
        estimate = ekf.update(estimate, [data.draw(VALUES)], decision.u)


@settings(max_examples=60, deadline=None)
@given(x=st.tuples(VALUES, VALUES), h=VALUES, d=VALUES, u=st.floats(-1, 2))
def test_limits_hold_for_any_estimate(parts, x, h, d, u):
    _, prior, controller, _ = parts
    safe = SafeController(controller, prior, max_age=0)
    sane, odd = estimate_of([0.1, 0.0]), replace(estimate_of(x, d), h=np.full(3, h))
    decision, held = safe.initial(sane, np.array([u])), np.array([u])
    for e in (sane, odd, odd, sane):
        decision = safe.decide(decision, e, np.zeros((1, 2)))
        within(decision.u, held)
        held = decision.u


@pytest.mark.parametrize("max_age", [0, 1, 4])
def test_plan_then_fallback_then_mpc_again(parts, max_age):
    _, prior, controller, _ = parts
    safe = SafeController(Failing(controller, range(3, 11), None), prior, max_age=max_age)
    decisions = run(safe, [estimate_of([0.4, 0.0])] * 13)
    want = ["MPC"] * 3 + ["PLAN"] * max_age + ["FALLBACK"] * (8 - max_age) + ["MPC"] * 2
    assert [decision.source.name for decision in decisions] == want
    assert [decision.age for decision in decisions] == [0] * 3 + list(range(1, 9)) + [0, 0]
    for k in range(max_age):  # the plan that is followed is the one that was solved
        # The QP keeps du_max to its own 1e-6 of half the range; saturating takes that off.
        np.testing.assert_allclose(decisions[3 + k].u, decisions[2].solution.u[1 + k], atol=3e-6)


def test_without_a_finite_state_or_a_fallback_zero_follows(parts):
    _, prior, controller, _ = parts
    estimates = [estimate_of([0.4, 0.0])] * 3 + [estimate_of([np.nan, 0.0])] * 6 + [estimate_of([0.2, 0.0])]
    for fallback in (prior, None):
        decisions = run(SafeController(controller, fallback, max_age=2, safe_input=[0.0]), estimates)
        assert [d.source.name for d in decisions] == ["MPC"] * 3 + ["PLAN"] * 2 + ["SAFE"] * 4 + ["MPC"]
        for before, after in pairwise(decisions[4:-1]):  # to zero as fast as du_max lets it
            step = np.abs(before.u) - np.abs(after.u)
            np.testing.assert_allclose(step, np.minimum(np.abs(before.u), 0.25), atol=1e-15)
        assert decisions[-2].u[0] == 0.0


def test_fallback_is_the_priors_lqr_around_the_held_equilibrium(parts):
    _, prior, _, _ = parts
    model = pendulum_model(z=3)
    wide = pendulum_problem(15, 99.0)
    safe = SafeController(Failing(CondensedController(model, wide), range(9)), prior, max_age=0)
    goal, e = np.array([[0.5, 0.0]]), estimate_of([0.3, -0.2], d=0.15)
    decision = run(safe, [e], goal)[0]
    assert decision.source is Source.FALLBACK
    k = lqr(prior, *POINT, wide.q, wide.r + wide.r_delta)
    want = 2.4 * np.sin(0.5) - k @ (e.x - goal[0]) - 0.15  # gravity at the goal, by hand
    np.testing.assert_allclose(decision.u, want, atol=1e-9)  # least squares damped by 1e-12


def test_initial_starts_within_the_bounds(parts):
    _, prior, controller, _ = parts
    safe = SafeController(controller, prior)
    np.testing.assert_array_equal(safe.initial(estimate_of([0.0, 0.0]), np.array([7.0])).u, [2.0])
    positive = OCP(5, [1.0, 1.0], [1.0], [0.0], [0.5], [1.0], working_point=POINT)
    only_up = SafeController(CondensedController(prior, positive))
    np.testing.assert_array_equal(only_up.initial(estimate_of([0.0, 0.0], n_h=0)).u, [0.5])


@pytest.mark.parametrize("fails", [(), (3, 4)])
def test_an_unstable_machine_is_not_planned_along_its_free_run(fails):
    """Over 50 periods the free run leaves the coil's range and passes a pole: no linearization there is of use."""
    model = levitated_ball()
    ocp = OCP(50, [0.3**-2, 0.0, 0.0], [0.0], [4.0**-2], [0.0], [24.0])
    safe = SafeController(CondensedController(model, ocp), model, max_age=50)
    x, rng = model.x0 + np.array([-0.1, -2.0, 0.0]), np.random.default_rng(0)
    decision = safe.initial(estimate_at(model, x))
    for k in range(40):
        goal = model.x0[None] if k not in fails else np.full((1, 3), np.nan)  # a solve that fails
        seen = x + rng.normal(size=3) * [0.01, 1.0, 0.005]
        decision = safe.decide(decision, estimate_at(model, seen), goal)
        assert decision.status is (Status.SOLVED if k not in fails else Status.NOT_FINITE)
        x = model.step(x, [], decision.u, model.w, model.p)[0].full().ravel()
    assert abs(x[0] - 7.0) < 0.1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"max_age": -1}, "max_age"),
        ({"u": [np.nan]}, "HM-MODEL-018"),
        ({"safe_input": [-9.0]}, "HM-CONTROL-042"),
        ({"u": [0.0, 1.0]}, "HM-MODEL-017"),
        ({"fallback": linear_model(np.eye(3), np.ones((3, 1)), np.eye(3))}, "HM-CONTROL-041"),
        ({"fallback": linear_model(2 * np.eye(2), np.zeros((2, 1)), np.eye(2))}, "Riccati|stabilis"),
    ],
)
def test_bad_input_is_refused(parts, arguments, words):
    _, prior, controller, _ = parts
    fallback, max_age = arguments.get("fallback", prior), arguments.get("max_age", 5)

    def use():
        given = {"max_age": max_age, "safe_input": arguments.get("safe_input")}
        SafeController(controller, fallback, **given).initial(estimate_of([0, 0]), arguments.get("u"))

    with pytest.raises(InputError, match=words):
        use()


def test_the_first_plan_is_made_before_the_loop_starts(parts):
    model, prior, controller, _ = parts
    estimate, target = estimate_of([0.2, -1.0]), np.zeros((1, 2))
    safe = SafeController(controller, prior, first=SQPController(model, LIMITS))
    first = safe.initial(estimate, None, target)
    assert first.u == 0  # only a plan: the machine still rests
    decision = safe.decide(first, estimate, target)
    converged = SQPController(model, LIMITS)
    best = plan_of(converged, estimate, target)
    assert best.status is Status.SOLVED
    alone = safe.decide(safe.initial(estimate), estimate, target)
    left = [float(np.max(np.abs(d.solution.u - best.u))) for d in (decision, alone)]
    # The plan handed over lacks only its last period, which one Gauss-Newton step finds but for a remainder.
    assert left[0] < 1e-4
    assert left[1] > 10 * left[0]


def test_a_first_plan_that_fails_leaves_the_held_input(parts):
    model, prior, controller, _ = parts
    estimate = estimate_of([0.6, 0.0])
    safe = SafeController(controller, prior, first=SQPController(model, LIMITS))
    failed = safe.initial(estimate, [0.2], np.full((1, 2), np.nan))
    np.testing.assert_array_equal(failed.solution.u, np.full((LIMITS.horizon, 1), 0.2))
    with pytest.raises(InputError, match="HM-CONTROL-040"):
        SafeController(controller, prior, first=CondensedController(model, LIMITS.changed(horizon=7)))
