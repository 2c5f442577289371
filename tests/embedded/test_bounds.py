"""Hard bounds and bounds that move: the generated C keeps them, and lets them give way, as Python does."""

from dataclasses import replace

import casadi as ca
import embedded_parts as parts
import numpy as np
import pytest
from embedded_parts import needs_compiler

from hybrid_mpc import (
    CondensedController,
    ExtendedKalmanFilter,
    HardBound,
    SafeController,
    SoftBound,
    TrueState,
)
from hybrid_mpc.control.safeguard import Source
from hybrid_mpc.embedded.native import NativeController

pytestmark = needs_compiler
X, U, W, P = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 0), ca.SX.sym("p")


def thrown(ocp, rng, k):
    """A state at up to 3 m/s, now and then towards a wall that no plan keeps it from; the goal is behind it."""
    return rng.uniform([-0.5, -1.0], [0.52, 3.0]), np.array([[1.0, 0.0]])


def with_walls(ocp, rng, k):
    """The same with one to 31 rows of where the wall is."""
    z, rows = rng.uniform([-0.5, -0.5], [0.4, 2.0]), (1, 5, ocp.horizon + 1)[k % 3]
    return z, np.column_stack([np.ones(rows), np.zeros(rows), rng.uniform(0.4, 1.0, rows)])


def around(ocp, rng, k):
    """States and references that jump."""
    return 0.6 * rng.standard_normal(3), 0.5 * rng.standard_normal((1 + k % 2, 3))


def asked(ocp, rng, k):
    """Set-points within and beyond the band, and the parameters' values."""
    rest, rows = np.array([42.7, 38.5]), 1 + k % 3
    columns = rest + 8.0 * rng.standard_normal((rows, 2)), rng.uniform([12.0, 4.0], [22.0, 9.0], (rows, 2))
    return rest + 4.0 * rng.standard_normal(2), np.hstack(columns)


WALL = HardBound("x", [-np.inf, -np.inf], [0.5, np.inf])
FAST = HardBound("x", [-0.6, -1.0], [np.inf, 1.0])
GENTLE = HardBound(ca.Function("gentle", [X, U], [U]), [-1.0], [np.inf], priority=1)
LATE = HardBound("x", [-np.inf, -np.inf], [0.5, np.inf], priority=2)
AWAY = ca.Function("wall", [X, U, W, P], [X[0] - P])
NEAR = SoftBound(ca.Function("near", [X, U, W, P], [X[0] - 0.9 * P]), [-np.inf], [0.0], [1.0], [1.0])
TARGET = HardBound("x", [0.2, -0.05], [0.3, 0.05], at_end=True)
FAST_AND_FAR = HardBound(ca.Function("ellipse", [X, U], [(X[0] / 0.5) ** 2 + X[1] ** 2]), [-np.inf], [1.0])
FORCE = HardBound(ca.Function("force", [X, U], [U**2 + 0.1 * X[1] ** 2]), [-np.inf], [0.7], priority=1)
BEHIND = HardBound(ca.Function("behind", [X, U, W, P], [X[0] * P + 0.1 * X[1] ** 2]), [-np.inf], [0.5])
KEPT = {"band": 1e-8}
"""Of an input's range, where all are kept; steady states within a band are found to 1e-9 of their scales."""
GIVEN = {"bounded": 1e-3}
"""Of an input's range, where a bound gives way; default 1e-6. Its penalty is 1e5 times the cost or more, so that
rounding moves it: by 4e-8, and by 3e-4 where that penalty also weighs the curvature of a bound."""
CASES = {
    "wall": (lambda: parts.cart([WALL, FAST]), thrown),
    "wall last": (lambda: parts.cart([WALL, GENTLE]), thrown),
    "wall first": (lambda: parts.cart([GENTLE, LATE], du_max=[1.5]), thrown),
    "delayed": (lambda: parts.cart([WALL], delay=0.25), thrown),
    "at the end": (lambda: parts.cart([TARGET], horizon=12), thrown),
    "moving wall": (lambda: parts.cart([HardBound(AWAY, [-np.inf], [0.0])], soft=[NEAR]), with_walls),
    "ellipse": (lambda: parts.cart([FAST_AND_FAR, FORCE]), thrown),
    "moving ellipse": (lambda: parts.cart([BEHIND]), with_walls),
    "bounded": (parts.bounded, around),
    "band": (parts.band, asked),
}


@pytest.mark.parametrize("name", CASES)
def test_bounds_are_kept_and_give_way_as_in_python(name):
    """From states thrown at random, each with the last plan to begin with: inputs, and the record of what gave way."""
    make, draw = CASES[name]
    model, ocp = make()
    python, native = CondensedController(model, ocp), NativeController(model, ocp, flags=parts.QUICK)
    rng, seen = np.random.default_rng(5), {"kept": 0, "given": 0, "active": 0}
    plan = python.initial(TrueState(model).start(np.concatenate([model.x0, np.zeros(model.n_h)])))
    for k in range(60):
        x, reference = draw(ocp, rng, k)
        e = TrueState(model).start(np.concatenate([x, 0.1 * rng.standard_normal(model.n_h)]))
        e = replace(e, d=0.05 * parts.disturbance_sizes(model, ocp) * rng.standard_normal(model.n_d))
        wanted, found = (c.solve(plan, e, reference) for c in (python, native))
        assert found.status is wanted.status, k
        assert bool(found.given_way) == bool(wanted.given_way), k
        off = np.max(np.abs(found.u - wanted.u) / ocp.input_range)
        given = GIVEN.get(name, 1e-6)
        assert off < (given if wanted.given_way else KEPT.get(name, 1e-9)), k
        for key in {*found.given_way, *wanted.given_way}:
            same = pytest.approx(wanted.given_way.get(key, 0.0), abs=given)
            assert found.given_way.get(key, 0.0) == same, (k, key)
        assert found.cost == pytest.approx(wanted.cost, rel=1e-6 if wanted.given_way else 1e-8), k
        assert found.excess == pytest.approx(wanted.excess, abs=given)
        seen["kept"] += not wanted.given_way
        seen["given"] += bool(wanted.given_way)
        seen["active"] += wanted.active is not None and bool(np.any(wanted.active))
        plan = wanted
    assert seen["active"] > 30, seen
    assert min(seen.values()) > 3, seen


@pytest.mark.parametrize("limited", [False, True])
def test_applied_inputs_keep_bounds_of_inputs_as_in_python(limited):
    """The shifted plan, then the fallback; both begin at the corner of the box, outside of the circle."""
    model, ocp = parts.circle()
    ocp = ocp.changed(du_max=[0.3, 0.3]) if limited else ocp
    estimator = ExtendedKalmanFilter(model, sigma_y=[1e-3] * 2, sigma_x=[1e-3] * 2, sigma_x0=[0.1] * 2)
    c = parts.CLoop(model, ocp, estimator, fallback=model, safe_input=np.zeros(2))
    safe = SafeController(CondensedController(model, ocp), fallback=model, safe_input=[0.0, 0.0])
    estimate = TrueState(model).start([-9.0, -8.0])
    first = safe.initial(estimate)
    decision = replace(first, solution=replace(first.solution, u=np.vstack([[[0.0, 0.0]], np.ones((14, 2))])))
    view, plan = c.state.view, decision.solution
    c.call("load_plan", plan.u, np.hstack([plan.x, plan.h]), plan.d, np.zeros(1))
    view["u"][:], seen = decision.u, set()
    for k in range(8):
        view["x"][:] = estimate.x
        rows = np.full((1, 2), np.nan)
        decision = safe.decide(decision, estimate, rows)
        c.call("decide", parts.goal(rows, ocp=ocp), None)
        np.testing.assert_allclose(c.u, decision.u, atol=1e-9, err_msg=str(k))
        assert c.source == decision.source.name, k
        assert np.sum(c.u**2) < 1 + 2e-7, k  # the tolerance of hard bounds
        # the only bound
        assert c.given_way[0] == pytest.approx(decision.solution.given_way.get("speed", 0.0), abs=1e-9), k
        seen.add((decision.source, bool(decision.solution.given_way)))
    assert {(Source.PLAN, True), (Source.FALLBACK, True)} <= seen


def test_the_names_are_in_the_generated_files():
    """What a user of the C finds given_way by."""
    model, ocp = parts.cart(
        [WALL, GENTLE], soft=[SoftBound(ca.Function("soft", [X, U], [X[0]]), [-1], [1], [1], [1])]
    )
    found = parts.make_sources(model, ocp)
    assert "given_way:\n   0: x0\n   2: gentle\n*/" in found.texts["hmpc_config.h"]
    assert found.sizes["HARD"] == 1
