"""A problem in other units gives the same targets, verdicts and plans: from all solvers, and in C."""

import shutil
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import (
    OCP,
    CondensedController,
    Disturbance,
    Estimate,
    ExtendedKalmanFilter,
    HardBound,
    HybridModel,
    InputError,
    IpoptController,
    SafeController,
    Signal,
    SoftBound,
    SQPController,
    Targets,
    with_input_delay,
)
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.embedded.native import NativeController

INF = np.inf
QUICK = ("-std=c11", "-O0", "-ffp-contract=off")
FACTORS = (1e-9, 1e-6, 1e-3, 1e3, 1e5, 1e9)
EXACT = 1e-7
"""Of an input's range or a state's size. Solvers converge to 1e-9 of them; factors that are no powers of two round
equations by 1e-16, which the Hessians' condition, 1e6 at most, makes 1e-10."""
IPOPT = 1e-5
"""The same of IPOPT, whose tolerance is 1e-9 of the gradient."""


class Case:
    """A problem, its set-points, where a plan begins, and disturbances, in units as written or in others."""

    def __init__(self, model, ocp, goals, x, d=None, delay=0.0):
        self.model, self.ocp, self.goals = model, ocp, np.atleast_2d(np.array(goals, dtype=float))
        self.x, self.delay = np.array(x, dtype=float), delay
        self.d = np.zeros(model.n_d) if d is None else np.array(d, dtype=float)

    def deployed(self):
        return with_input_delay(self.model, self.delay) if self.delay else self.model

    def scaled(self, by_x, by_u, by_y, by_w):
        """In units in which the numbers of x, u, y, w are larger by these factors."""
        m, o = self.model, self.ocp
        by_x, by_u, by_y, by_w = (np.array(v, dtype=float) for v in (by_x, by_u, by_y, by_w))
        sx, su, sy, sw = map(ca.DM, (by_x, by_u, by_y, by_w))
        x, u, w = ca.MX.sym("x", m.n_x), ca.MX.sym("u", m.n_u), ca.MX.sym("w", m.n_w)
        x_, u_, w_ = x / sx, u / su, w / sw
        signals = [
            tuple(replace(s, lower=s.lower * f, upper=s.upper * f) for s, f in zip(group, by, strict=True))
            for group, by in ((m.states, by_x), (m.inputs, by_u), (m.outputs, by_y), (m.disturbances, by_w))
        ]
        by = {"input": (m.inputs, by_u), "rate": (m.states, by_x), "output": (m.outputs, by_y)}
        of_d = by_u
        own = m.disturbance_model
        if own is not None:
            of_d = [by[one.at][1][[s.name for s in by[one.at][0]].index(one.signal)] for one in own]
            own = tuple(replace(one, size=one.size * f) for one, f in zip(own, of_d, strict=True))
        model = HybridModel.of(
            m.name, m.dt, signals[0], signals[1], signals[2], x=x, u=u, w=w,
            x_next=sx * m.step(x_, [], u_, w_, m.p)[0], xdot=sx * m.xdot(x_, [], u_, w_, m.p),
            y=sy * m.output(x_, u_, w_, m.p), disturbances=signals[3], nominal_x=tuple(m.x0 * by_x),
            nominal_u=tuple(m.u0 * by_u), nominal_w=tuple(m.w * by_w), disturbance_model=own,
        )  # fmt: skip
        model = replace(
            model, state_spread=tuple(np.array(m.state_spread) * by_x) if m.state_spread else (),
            output_spread=tuple(np.array(m.output_spread) * by_y) if m.output_spread else (),
        )  # fmt: skip

        def expression(f):
            return ca.Function(f.name(), [x, u], [f(x_, u_)])

        def hard(b):
            f = {"x": by_x, "y": by_y}.get(b.what, 1.0) if isinstance(b.what, str) else 1.0
            what = b.what if isinstance(b.what, str) else expression(b.what)
            return HardBound(what, b.lower * f, b.upper * f, b.priority, b.at_end)

        ocp = OCP(
            o.horizon, o.q / by_x**2, o.r / by_u**2, o.r_delta / by_u**2, o.u_min * by_u, o.u_max * by_u,
            None if o.du_max is None else o.du_max * by_u, x_min=o.x_min * by_x, x_max=o.x_max * by_x,
            slack_linear=None if o.slack_linear is None else o.slack_linear / by_x,
            slack_quadratic=None if o.slack_quadratic is None else o.slack_quadratic / by_x**2,
            soft=[SoftBound(expression(b.expression), b.lower, b.upper, b.linear, b.quadratic) for b in o.soft],
            q_y=o.q_y / by_y**2 if o.n_y else (), y_min=o.y_min * by_y if o.y_min.size else (),
            y_max=o.y_max * by_y if o.y_max.size else (), hard=[hard(b) for b in o.hard],
            economic=None if o.economic is None else expression(o.economic),
        )  # fmt: skip
        goals = self.goals * (by_y if o.n_y else by_x)
        return Case(model, ocp, goals, self.x * by_x, self.d * np.array(of_d), self.delay)

    def estimate(self):
        m = self.deployed()
        h = np.resize(m.u0, m.n_h)
        n = m.n_x + m.n_h + m.n_d
        return Estimate(0.0, self.x, h, self.d, np.eye(n), np.full(m.n_y, np.nan), np.nan, w=m.w)


def signals(*names, **ranges):
    return tuple(Signal(name, "-", *ranges.get(name, (-INF, INF))) for name in names)


def two_states():
    """No weight, no range and no operating point: nothing but the equations says how large the states are."""
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    rate = ca.vertcat(-x[0] + 0.4 * x[1] + 0.5 * u, -0.8 * x[1] + 0.6 * u + 0.1 * x[1] * x[0])
    model = HybridModel.of(
        "two", 0.1, signals("a", "b"), signals("u"), signals("a"), x=x, u=u, y=x[0], x_next=x + 0.1 * rate, xdot=rate,
    )  # fmt: skip
    return Case(
        model,
        OCP(20, [0.0, 0.0], [0.01], [0.1], [-2.0], [2.0], q_y=[1.0]),
        [[0.15], [0.7], [40.0]],
        [0.1, 0.3],
    )


def heaters():
    """Two inputs and outputs, offsets of a sensor and a heater, limited changes, an inflow that is measured."""
    x, u, w = ca.MX.sym("x", 2), ca.MX.sym("u", 2), ca.MX.sym("w")
    rate = ca.vertcat(
        u[0] - 0.05 * (x[0] - w), 0.7 * u[1] + 0.02 * x[0] - 0.06 * (x[1] - w) - 1e-5 * x[1] ** 2
    )
    rest = (40.0, 35.0)
    u0 = (0.05 * 20.0, (-0.02 * 40.0 + 0.06 * 15.0 + 1e-5 * 35.0**2) / 0.7)
    offsets = (Disturbance("output", "t1", 5.0), Disturbance("input", "p2"))
    model = HybridModel.of(
        "heaters", 1.0, signals("t1", "t2"), signals("p1", "p2"), signals("t1", "t2"), x=x, u=u, w=w, y=x,
        x_next=x + rate, xdot=rate, disturbances=signals("air"), nominal_x=rest, nominal_u=u0, nominal_w=(20.0,),
        disturbance_model=offsets,
    )  # fmt: skip
    model = replace(model, state_spread=(8.0, 6.0), output_spread=(8.0, 6.0))
    ocp = OCP(
        15, [0.0, 0.0], [1e-3, 1e-3], [0.5, 0.5], [0.0, 0.0], [4.0, 3.0], du_max=[0.5, 0.5], q_y=[1.0, 0.5],
        y_max=[44.0, INF],
    )  # fmt: skip
    return Case(model, ocp, [[42.0, 36.0], [43.0, 30.0], [900.0, 500.0]], [39.0, 36.0], [1.5, -0.1])


def bounded_state():
    """A soft bound on a state without a weight; the set-point is beyond it."""
    case = two_states()
    return Case(case.model, case.ocp.changed(x_max=[INF, 0.35]), case.goals, [0.1, 0.2])


def zone():
    """An output without a weight stays in a zone; the other one follows its set-point. A range says how large it is."""
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u", 2)
    rate = ca.vertcat(u[0] - ca.sqrt(0.5 + x[0] ** 2), u[1] + 0.8 * x[0] - x[1])
    model = HybridModel.of(
        "zone", 0.1, signals("level", "heat", level=(-1.0, 4.0), heat=(-1.0, 6.0)), signals("in", "power"),
        signals("level", "heat"), x=x, u=u, y=x, x_next=x + 0.1 * rate, xdot=rate, nominal_x=(0.5, 1.0),
        nominal_u=(np.sqrt(0.75), 0.6),
    )  # fmt: skip
    ocp = OCP(
        15, [0.0, 0.0], [0.01, 0.01], [0.1, 0.1], [-3.0, -3.0], [3.0, 3.0], q_y=[10.0, 0.0], y_min=[-INF, 0.8],
        y_max=[INF, 1.05],
    )  # fmt: skip
    return Case(model, ocp, [[1.2, np.nan], [2.5, np.nan]], [0.5, 1.0])


def late():
    """The input acts one and a half periods later; references are the states'; hard bounds and one on a product."""
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    rate = ca.vertcat(x[1], -2.0 * ca.sin(x[0]) - 0.2 * x[1] + 3.0 * u)
    model = HybridModel.of(
        "late", 0.05, signals("phi", "omega"), signals("torque"), signals("phi"), x=x, u=u, y=x[0],
        x_next=x + 0.05 * rate, xdot=rate,
    )  # fmt: skip
    power = SoftBound(ca.Function("power", [x, u], [x[1] * u]), [-INF], [0.3], [10.0], [1.0])
    ocp = OCP(
        12, [20.0, 0.0], [0.1], [0.1], [-1.0], [1.0], soft=[power], x_max=[INF, 1.0],
        hard=[HardBound("x", [-INF, -1.5], [0.9, 1.5])],
    )  # fmt: skip
    return Case(model, ocp, [[0.6, 0.0]], [0.1, 0.0], delay=0.075)


def economic():
    """An economic cost that curves down in one direction, a hard bound on one side."""
    case = two_states()
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    cost = ca.Function("economic", [x, u], [-0.5 * x[0] * u + 0.4 * x[1] ** 2 - 0.2 * x[0]])
    ocp = OCP(
        20, [0.5, 0.0], [1.0], [0.1], [-2.0], [2.0], economic=cost, hard=[HardBound("x", [-INF, -INF], [INF, 0.25])],
    )  # fmt: skip
    return Case(case.model, ocp, [[0.3, 0.0]], [0.1, 0.2])


CASES = {f.__name__: f for f in (two_states, heaters, bounded_state, zone, late, economic)}
WEIGHED = ("two_states", "heaters", "bounded_state", "zone")
SOLVERS = {"rti": CondensedController, "sqp": SQPController, "ipopt": IpoptController}


def units(case, draw):
    """Factors of x, u, y, w: first some that were wrong once, then random ones."""
    m, rng = case.model, np.random.default_rng(draw)
    sizes = m.n_x, m.n_u, m.n_y, m.n_w
    first = ((1e-6,), (1e5, 1e-3), (1e9, 1e9), (1e-9, 1e9))
    if draw < len(first):
        return tuple(np.resize(first[draw], n) for n in sizes)
    return tuple(rng.choice(FACTORS, n) * rng.uniform(1.0, 3.0, n) for n in sizes)


DRAWS = (1, 5, *(pytest.param(k, marks=pytest.mark.full) for k in (0, 2, 3, 4, 6, 7)))


@pytest.mark.parametrize("draw", DRAWS)
@pytest.mark.parametrize("name", WEIGHED)
def test_targets_and_their_verdicts_are_the_same(name, draw):
    case = CASES[name]()
    factors = units(case, draw)
    other = case.scaled(*factors)
    one, two = Targets(case.model, case.ocp), Targets(other.model, other.ocp)
    np.testing.assert_allclose(
        two.scale[: case.model.n_x], one.scale[: case.model.n_x] * factors[0], rtol=1e-9
    )
    for goal, converted in zip(case.goals, other.goals, strict=True):
        for d, d_converted in ((None, None), (case.d, other.d)):
            want, found = one.at(goal, d), two.at(converted, d_converted)
            assert (found.steady, found.reached) == (want.steady, want.reached), goal
            n_x = case.model.n_x
            u_size, x_size = one.scale[n_x:], np.maximum(one.scale[:n_x], np.abs(want.x))
            np.testing.assert_allclose(found.u / factors[1] / u_size, want.u / u_size, atol=EXACT)
            np.testing.assert_allclose(found.x / factors[0] / x_size, want.x / x_size, atol=EXACT)
            rest = (
                case.model.step(
                    want.x,
                    [],
                    want.u + case.model.disturbed[0] @ (case.d if d is not None else 0 * case.d),
                    case.model.w,
                    case.model.p,
                )[0]
                .full()
                .ravel()
            )
            np.testing.assert_allclose(rest, want.x, atol=1e-8 * np.max(x_size))


def plans(case, make, goal, periods=3):
    """Plans of solves in a row, each from the last."""
    controller, estimate = make(case.deployed(), case.ocp), case.estimate()
    goal = np.where(np.isfinite(goal), goal, 0.0)[None]
    plan, found = controller.initial(estimate), []
    for _ in range(periods):
        plan = controller.solve(plan, estimate, goal)
        found.append(plan)
    return found


@pytest.mark.parametrize("draw", DRAWS[:6])
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", CASES)
def test_plans_are_the_same(name, solver, draw):
    case = CASES[name]()
    factors = units(case, draw)
    other = case.scaled(*factors)
    size = Sizes(case.deployed(), case.ocp).states
    near = IPOPT if solver == "ipopt" else EXACT
    periods = 1 if solver == "ipopt" else 3
    for goal, converted in list(zip(case.goals, other.goals, strict=True))[:2]:
        wanted, found = (plans(c, SOLVERS[solver], g, periods) for c, g in ((case, goal), (other, converted)))
        for want, got in zip(wanted, found, strict=True):
            assert got.status is want.status
            assert got.status.ok
            np.testing.assert_allclose(
                got.u / factors[1] / case.ocp.input_range, want.u / case.ocp.input_range, atol=near
            )
            large = np.maximum(size, np.max(np.abs(want.x), axis=0))
            np.testing.assert_allclose(got.x / factors[0] / large, want.x / large, atol=10 * near)
            assert got.cost == pytest.approx(want.cost, rel=100 * near, abs=1e-9)
            assert set(got.given_way) == set(want.given_way)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
@pytest.mark.parametrize(
    "name",
    [
        "heaters",
        *(pytest.param(n, marks=pytest.mark.full) for n in ("two_states", "bounded_state", "zone", "late")),
    ],
)
def test_the_c_gives_the_same_plans(name):
    case = CASES[name]()
    factors = units(case, 3 if name == "zone" else 1)
    other = case.scaled(*factors)

    def native(model, ocp):
        return NativeController(model, ocp, flags=QUICK)

    for goal, converted in list(zip(case.goals, other.goals, strict=True))[:2]:
        wanted, found = plans(case, CondensedController, goal), plans(other, native, converted)
        for want, got in zip(wanted, found, strict=True):
            assert got.status is want.status
            np.testing.assert_allclose(
                got.u / factors[1] / case.ocp.input_range, want.u / case.ocp.input_range, atol=EXACT
            )
            if want.steady is not None:
                assert (got.steady.steady, got.steady.reached) == (want.steady.steady, want.steady.reached)


def test_bounds_without_a_weight_act_in_every_unit():
    """The state or output is where it would not be without its bound, and within it."""
    for make, values in ((bounded_state, lambda p: p.x[1:, 1] - 0.35), (zone, lambda p: p.x[:-1, 1] - 1.05)):
        case = make()
        none = {"x_max": None, "y_min": (), "y_max": ()}
        free = Case(case.model, case.ocp.changed(**none), case.goals, case.x)
        at = 1 if make is bounded_state else 0
        assert np.max(values(plans(free, SQPController, case.goals[at], 1)[0])) > 0.01
        assert np.max(values(plans(case, SQPController, case.goals[at], 1)[0])) < 1e-6


def test_what_nothing_tells_the_size_of_is_refused():
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    rate = ca.vertcat(u - x[0], 0.0)

    def model(*room):
        return HybridModel.of(
            "still", 0.1, (Signal("a", "m"), Signal("b", "m", *room)), signals("u"), signals("a"), x=x, u=u, y=x[0],
            x_next=x + 0.1 * rate, xdot=rate,
        )  # fmt: skip

    ocp = OCP(5, [1.0, 0.0], [1.0], [0.0], [-1.0], [1.0], terminal=np.eye(2))
    with pytest.raises(InputError, match="HM-CONTROL-043"):
        CondensedController(model(), ocp)
    assert Sizes(model(0.0, 4.0), ocp).states[1] == 2.0
    assert Sizes(replace(model(), state_spread=(0.0, 3.0)), ocp).states.tolist() == [1.0, 3.0]
    assert Sizes(model(), ocp.changed(q=[1.0, 0.25])).states.tolist() == [1.0, 2.0]


@pytest.mark.parametrize("draw", DRAWS[:6])
def test_first_estimates_and_fallbacks_are_the_same(draw):
    """Sensors that show sums of states: which state is nearest must not depend on units; nor when a filter is lost."""
    case = heaters()
    x, u, w = (ca.MX.sym(name, n) for name, n in (("x", 2), ("u", 2), ("w", 1)))
    m = replace(case.model, output=ca.Function("output", [x, u, w, ca.MX.sym("p", 0)],
                                               [ca.vertcat(x[0] + 0.5 * x[1], 2.0 * x[0] + x[1])]))  # fmt: skip
    case = Case(m, case.ocp.changed(q_y=(), y_max=(), q=[1.0, 0.0]), [[42.0, 36.0]], case.x, case.d)
    factors = units(case, draw)
    other = case.scaled(*factors)
    y = np.array([60.0, 118.0])
    sigma = np.array([0.1, 0.2])
    found = []
    for c, (by_x, by_u, by_y) in ((case, (1.0, 1.0, 1.0)), (other, factors[:3])):
        by_d = np.array([by_y[0], by_u[1]]) if c is other else 1.0
        kalman = ExtendedKalmanFilter(
            c.model, sigma_y=sigma * by_y, sigma_x=np.array([0.01, 0.02]) * by_x, sigma_x0=np.array([1.0, 3.0]) * by_x,
            sigma_d=np.array([1e-3, 1e-3]) * by_d,
        )  # fmt: skip
        estimate = kalman.start(y * by_y)
        first = estimate.x / by_x
        for k in range(5):
            estimate = kalman.update(estimate, (y + 0.1 * k) * by_y, c.model.u0)
        safe = SafeController(CondensedController(c.model, c.ocp), c.model, max_age=0)
        late = safe.late(safe.initial(estimate), estimate, c.goals)
        found.append((first, estimate.x / by_x, late.u / by_u, np.array([late.source.name == "FALLBACK"])))
        assert not kalman.lost(estimate)
        assert kalman.lost(replace(estimate, P=estimate.P * 1e16))
    for want, got in zip(*found, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-6)
