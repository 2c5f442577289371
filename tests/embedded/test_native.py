"""The generated C gives the inputs that Python gives: plans replayed period by period, whole loops, safeguards."""

import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import embedded_parts as parts
import numpy as np
import pytest
from embedded_parts import CLoop, goal, needs_compiler

from hybrid_mpc import (
    OCP,
    CondensedController,
    ExtendedKalmanFilter,
    Limits,
    Loop,
    SafeController,
    Status,
    SwitchingFilter,
    TrueState,
)
from hybrid_mpc.control.sizes import disturbance_sizes
from hybrid_mpc.embedded.native import NativeController

sys.path.insert(0, str(Path(__file__).parents[1] / "golden"))
from golden_parts import frozen_estimates, machine, previews
from online_models import runaway

pytestmark = needs_compiler
TOLERANCE = 1e-9
"""Of an input's range. Both solve the same strictly convex QP, in sums of another order: they differed by 4e-12."""
REPLAYS = (
    ("golf_robot", "track", TOLERANCE),
    pytest.param("golf_robot", "stroke", TOLERANCE, marks=pytest.mark.full),
    pytest.param("unbalanced_disk", "swing_up", TOLERANCE, marks=pytest.mark.full),
    # the Hessian's condition is 7e7, so that rounding alone moves its answer by 1e-8: 4e-8 was found
    pytest.param("unbalanced_disk", "sway", 1e-7, marks=pytest.mark.full),
)  # fmt: skip


@pytest.mark.parametrize(("name", "problem", "tolerance"), REPLAYS)
def test_a_stored_machine_replayed(name, problem, tolerance):
    m = machine(name)
    replay = next(key for key, value in m.data["replays"].items() if value["problem"] == problem)
    known = frozen_estimates(m, replay)[: m.data["replays"][replay]["decided"]]
    safe, preview = m.safe_controller(problem), previews(m, problem)
    native = NativeController(m.hybrid, m.problem(problem), flags=parts.QUICK)
    decision, active = safe.initial(known[0], None, *preview(0.0)), 0
    for k, estimate in enumerate(known):
        before = decision.solution
        decision = safe.decide(decision, estimate, *preview(k * m.dt))
        found, wanted = native.solve(before, estimate, *preview(k * m.dt)), decision.solution
        assert found.status is wanted.status
        u = np.abs(found.u[0] - np.clip(wanted.u[0], safe.controller.ocp.u_min, safe.controller.ocp.u_max))
        assert np.max(u / safe.controller.ocp.input_range) < tolerance
        assert found.cost == pytest.approx(wanted.cost, rel=1e-9)
        active += int(found.excess > 0) + int(np.any(np.abs(found.u) >= 0.999 * safe.controller.ocp.u_max))
    assert active > 10 or name == "unbalanced_disk"  # bounds were at work


PROBLEMS = {
    "coupled": parts.coupled,
    "tanks": parts.tanks,
    "delayed": parts.delayed,
    "heaters": parts.heaters,
    "curved": parts.curved,
    "priced": parts.priced,
    "priced outputs": parts.priced_outputs,
    "spare sensors": parts.spare,
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_small_machines_with_everything(name):
    """Solves in a row from states that jump: bounds, soft bounds, blocks, delays, disturbances, limits, weights."""
    model, ocp = PROBLEMS[name]()
    python, native = CondensedController(model, ocp), NativeController(model, ocp, flags=parts.QUICK)
    rng, size = np.random.default_rng(2), python.problem.sizes.states
    seen = {"soft": 0, "limit": 0}
    x = model.x0 + 0.2 * size
    plan = python.initial(TrueState(model).start(np.concatenate([x, np.zeros(model.n_h)]), w=model.w))
    for k in range(60):
        x = model.x0 + (0.6 * (x - model.x0) + 0.5 * size * rng.standard_normal(model.n_x) * (k % 3 == 0))
        z = np.concatenate(
            [x, 0.1 * rng.standard_normal(model.n_h) + (model.u0[0] if model.delay_states else 0.0)]
        )
        e = TrueState(model).start(z, w=model.w * (1 + 0.2 * (k % 5 == 4)))
        e = replace(e, d=0.05 * disturbance_sizes(model, ocp) * rng.standard_normal(model.n_d))
        reference = model.x0 + 0.5 * size * rng.standard_normal((k % 2 + 1, model.n_x))
        if ocp.n_y:
            reference = model.x0 + 6.0 * rng.standard_normal((k % 2 + 1, 2))
        if ocp.n_p:
            reference = np.hstack([reference, rng.uniform(0.2, 2.0, (k % 2 + 1, ocp.n_p))])
        weight = None if k % 4 else rng.uniform(0.2, 2.0, (ocp.horizon + 1, model.n_x))
        middle, half = model.u0, 0.3 * ocp.input_range
        limits = Limits(middle - half, middle + half) if k % 6 == 5 else None
        wanted = python.solve(plan, e, reference, weight, limits=limits)
        found = native.solve(plan, e, reference, weight, limits=limits)
        assert found.status is wanted.status, k
        assert np.max(np.abs(found.u - wanted.u) / ocp.input_range) < TOLERANCE, k
        for got, want in ((found.x, wanted.x), (found.h, wanted.h)):
            np.testing.assert_allclose(
                got, want, atol=1e-8 * max(1.0, float(np.max(np.abs(want), initial=0.0)))
            )
        assert found.cost == pytest.approx(wanted.cost, rel=1e-8)
        assert found.excess == pytest.approx(wanted.excess, abs=1e-8)
        seen["soft"] += wanted.excess > 1e-3
        seen["limit"] += bool(np.any(np.isclose(wanted.u, ocp.u_max) | np.isclose(wanted.u, ocp.u_min)))
        plan = wanted
        np.testing.assert_allclose(found.w, wanted.w)
        assert (found.steady is None) == (not ocp.n_y)
    assert seen["limit"] > 5
    assert seen["soft"] > 3 or name == "delayed"


def test_a_plan_far_outside_of_a_declared_range_is_refused_in_c():
    model, ocp = runaway(1.0), OCP(20, [1.0], [1.0], [0.0], [-0.1], [0.1])
    python, native = CondensedController(model, ocp), NativeController(model, ocp, flags=parts.QUICK)
    for start, status in ((0.9, Status.DIVERGED), (0.19, Status.SOLVED)):
        e = TrueState(model).start(np.array([start]))
        plans = [c.solve(c.initial(e), e, np.zeros((1, 1))) for c in (python, native)]
        assert [p.status for p in plans] == [status, status]
        np.testing.assert_allclose(plans[1].u, plans[0].u, atol=1e-9)


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_period_of_c_is_a_period_of_the_loop(name):
    """Estimator, controller and safeguards, samples missing, references that are not finite, an operator's input."""
    model, ocp = PROBLEMS[name]()
    estimator, safe_input = parts.filters_of(model, ocp), model.u0
    python = SafeController(CondensedController(model, ocp), model, safe_input=safe_input)
    loop, rng = Loop(estimator, python), np.random.default_rng(1)
    c = CLoop(model, ocp, estimator, model, safe_input)
    z, size = np.concatenate([model.x0, np.zeros(model.n_h)]), python.controller.problem.sizes.states
    target, w, u = model.x0 + 0.5 * size, model.w, python.controller.problem.u_rest
    target = python.controller.problem.standing()[0] + 2.0 if ocp.n_y else np.append(target, np.ones(ocp.n_p))
    sources = set()
    for k in range(80):
        y = model.output(z[: model.n_x], u, w, model.p).full().ravel() + 0.003 * rng.standard_normal(
            model.n_y
        )
        y[rng.uniform(size=model.n_y) < 0.2 * (20 < k < 30)] = np.nan
        reference = np.full_like(target, np.nan) if 40 <= k < 52 else target
        w_now = np.full_like(w, np.nan) if k == 12 else w
        applied = 0.5 * (u + model.u0) if k == 60 else None
        given = goal(reference[None], ocp=ocp)
        if k == 0:
            first = python.initial(estimator.start(y, w=w_now))
            loop.start(y, w_now if model.n_w else None, reference=np.full_like(target, np.nan))
            loop._state = loop._first_state(y, estimator.start(y, w=w_now), first)
            loop._decide(first, reference[None], None, None)
            c.start(y, w_now, first, given)
        else:
            loop.step(y, w_now if model.n_w else None, reference=reference, applied=applied)
            c.call("step", y, w_now, applied, given)
        estimate, decision = loop.estimate, loop.decision
        scale = np.maximum(size, np.abs(estimate.x))
        assert np.max(np.abs(c.x - estimate.x) / scale) < TOLERANCE, k
        np.testing.assert_allclose(c.d, estimate.d, atol=1e-9 * float(np.max(ocp.input_range)))
        assert np.max(np.abs(c.u - decision.u) / ocp.input_range) < 1e-7, k  # of plans that go their own ways
        assert (c.source, c.age[0]) == (decision.source.name, decision.age), k
        sources.add(c.source)
        if k % 2:  # left to the next step else
            loop.finish()
            c.call("finish", given)
        u = decision.u
        z = np.concatenate(
            [v.full().ravel() for v in model.step(z[: model.n_x], z[model.n_x :], u, w, model.p)]
        )
    assert sources == {"MPC", "PLAN", "FALLBACK"}


def test_forecasts_of_measured_disturbances():
    """Rows ahead, gaps among them, fewer and more than the horizon has: as in Python's loop, from the first plan on."""
    model, ocp = parts.tanks()
    ocp = ocp.changed(preview_w=True)
    estimator, rng = parts.filters_of(model, ocp), np.random.default_rng(4)
    loop = Loop(estimator, SafeController(CondensedController(model, ocp), model))
    c, given, moved = CLoop(model, ocp, estimator, model), parts.goal(None), 0.0
    for k in range(40):
        y = model.x0[1:] + 0.02 * rng.standard_normal(1)
        rows = (1, 4, ocp.horizon, ocp.horizon + 6)[k % 4]
        ahead = model.w * (1 + np.cumsum(0.4 * rng.standard_normal((rows, 1)), axis=0))
        ahead[rng.uniform(size=ahead.shape) < 0.2] = np.nan
        given = goal(model.x0[None], w=ahead if rows > 1 else None)
        if k == 0:
            loop.start(y, ahead)
            first = SafeController(CondensedController(model, ocp)).initial(loop.estimate)
            c.start(y, ahead[0], first, given)
        else:
            kept = loop.decision
            loop.step(y, ahead)
            c.state.view["u"][:] = kept.u
            c.call("load_plan", kept.solution.u, np.hstack([kept.solution.x, kept.solution.h]), kept.solution.d,
                   kept.solution.w)  # fmt: skip
            c.call("step", y, ahead[0], None, given)
            assert np.max(np.abs(c.u - loop.decision.u) / ocp.input_range) < TOLERANCE, k
            np.testing.assert_allclose(c.plan_w, loop.decision.solution.w, rtol=1e-12)
            moved = max(moved, float(np.max(np.abs(np.diff(c.plan_w, axis=0)))))
    assert moved > 0.1 * model.w[0]


def test_the_first_plan_is_the_cheapest_of_several():
    """Round a hill there are two ways: the start that finds the cheaper one is taken."""
    model, plain = parts.ways_round()
    up, down = ([[0.8, u]] * 10 + [[0.8, -u]] * 10 for u in (0.8, -0.8))
    estimator, y, end = parts.filters_of(model, plain), np.zeros(2), np.array([[1.0, 0.0]])
    costs = {}
    for name, ways in (("none", ()), ("up", (up,)), ("down", (down,)), ("both", (down, up))):
        c = CLoop(model, plain.changed(starts=ways), estimator)
        c.call("start", y, np.zeros(1), None, parts.goal(end))
        costs[name] = float(c.cost[0])
    rti, each, e = CondensedController(model, plain), {}, estimator.start(y)
    for name, way in (("none", np.zeros((20, 2))), ("up", up), ("down", down)):
        plan = rti.initial(e, np.array(way)).delayed(np.zeros(2))
        for _ in range(25):
            plan = rti.solve(plan, e, end).delayed(np.zeros(2))
        each[name] = rti.solve(plan, e, end).cost
    assert each["up"] < 0.95 * each["none"]
    for name, known in (
        ("none", ("none",)),
        ("up", ("none", "up")),
        ("down", ("none", "down")),
        ("both", each),
    ):
        assert costs[name] == pytest.approx(min(each[k] for k in known), rel=1e-3), name


def test_modes_with_sensors_and_first_states_of_their_own():
    """Filters that differ in the noise of their sensors and in how far the first state may lie, behind bent sensors."""
    model, ocp = parts.curved()
    modes = [
        ExtendedKalmanFilter(model, sigma_y=sigma * np.array([0.05, 0.1]), sigma_x=[0.02, 0.02],
                             sigma_x0=first, sigma_d=[0.1, 0.05], sigma_d0=[0.1, 0.1])
        for sigma, first in ((1.0, (2.0, 4.0)), (20.0, (3.0, 0.5)))
    ]  # fmt: skip
    python = SwitchingFilter(modes, ((0.9, 0.1), (0.2, 0.8)))
    c, rng = CLoop(model, ocp, python), np.random.default_rng(0)
    y = model.output(model.x0, model.u0, model.w, model.p).full().ravel()
    estimate = None
    for k in range(60):
        sample = y + 3.0 * np.sin(k / 9.0) + 0.1 * rng.standard_normal(2)
        sample[rng.uniform(size=2) < 0.1] = np.nan
        u = model.u0 + rng.uniform(-1, 1, 2)
        if estimate is None:
            estimate = python.start(sample)
            c.call("estimate_start", sample, np.zeros(1))
        else:
            estimate = python.update(estimate, sample, u)
            c.call("estimate_update", sample, u, np.zeros(1))
        np.testing.assert_allclose(c.x, estimate.x, rtol=1e-10)
        np.testing.assert_allclose(c.d, estimate.d, atol=1e-9)


def test_the_first_state_is_sought_beside_the_operating_point_too():
    """Sensors that do not move at the operating point, or that several states fit: the same one as Python's."""
    model = parts.online_models.pendulum_model()
    ocp = OCP(9, [40.0, 0.5], [1.0], [0.5], [-2.0], [2.0], working_point=([0.0, 1.0], [0.0]))
    for name, y, samples in (
        ("sine", lambda x, u, w: ca.sin(x[0]), (0.0, 0.3, -0.9, 1.0, 1.2)),
        ("size", lambda x, u, w: ca.sqrt(x[1] ** 2 + 1e-4), (0.01, 0.5, 3.0)),
        ("square", lambda x, u, w: x[0] ** 2 + 0.1 * x[1] ** 2, (0.0, 0.4, 2.0)),
    ):
        own = parts.shown(model, y)
        f = ExtendedKalmanFilter(own, sigma_y=[0.01], sigma_x=[0.01, 0.1], sigma_x0=[0.5, 1.0])
        c = CLoop(own, ocp, f)
        for value in samples:
            c.call("estimate_start", np.array([value]), np.zeros(1))
            np.testing.assert_allclose(c.x, f.start([value]).x, atol=1e-7, err_msg=f"{name} {value}")


def test_what_was_prepared_for_another_plan_is_prepared_again():
    model, ocp = parts.delayed()
    native = NativeController(model, ocp, flags=parts.QUICK)
    e = TrueState(model).start(np.zeros(model.n_x + model.n_h))
    first = native.solve(native.initial(e), e, np.array([[0.3, 0.0]]))
    one, _ = native.prepare(first), native.prepare(native.initial(e))
    np.testing.assert_allclose(  # from another working set, so to rounding
        native.finish(one, e, np.array([[0.3, 0.0]])).u,
        native.solve(first, e, np.array([[0.3, 0.0]])).u,
        atol=1e-12,
    )
