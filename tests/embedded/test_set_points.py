"""Set-points of outputs: the steady states that the generated C finds are those of Python's target calculator."""

from dataclasses import replace

import casadi as ca
import embedded_parts as parts
import machines
import numpy as np
import pytest
from embedded_parts import needs_compiler
from gated import gated, saturated

from hybrid_mpc import (
    OCP,
    CondensedController,
    Disturbance,
    HybridModel,
    Signal,
    SoftBound,
    TrueState,
    with_input_delay,
)
from hybrid_mpc.embedded.native import NativeController

pytestmark = needs_compiler
RANGE = {"r": [1e6], "r_delta": [1e6], "u_min": [5e-5], "u_max": [4e-4]}


def level(delay=0.0, **options):
    """The lower of two tanks, of which one may leak; what is asked for is often beyond the pump."""
    model = machines.two_tanks(disturbance_model=(Disturbance("rate", "lower", 1e-3),))
    model = with_input_delay(model, delay) if delay else model
    return model, OCP(20, [0.0, 0.0], **RANGE, q_y=[1.0], **options), 0.35


def motor():
    """Current and speed by one voltage: the nearest."""
    ocp = OCP(12, [0.0, 0.0], [0.1], [0.1], [-12.0], [12.0], q_y=[1.0, 1.0])
    return machines.dc_motor(), ocp, np.array([1.0, 30.0])


def written(name, states, inputs, x_next, xdot, **options):
    """A model of ``x_next(x, u)`` whose states are its outputs."""
    x, u = ca.SX.sym("x", len(states)), ca.SX.sym("u", len(inputs))
    signals = tuple(Signal(s, "m") for s in states)
    return HybridModel.of(
        name, 1.0, signals, tuple(Signal(i, "-") for i in inputs), signals, x=x, u=u, y=x, x_next=x_next(x, u),
        xdot=xdot(x, u), **options,
    )  # fmt: skip


def pumps():
    """Two pumps for one level: of all that hold it the inputs nearest to the operating point's."""
    rates = (lambda x, u: 0.5 * x + u[0] + u[1], lambda x, u: -x + u[0] + u[1])
    model = written("pumps", ["level"], ["a", "b"], *rates, nominal_x=[2.0], nominal_u=[0.6, 0.4])
    return model, OCP(8, [0.0], [1.0, 1.0], [0.1, 0.1], [0.0, 0.0], [2.0, 1.0], q_y=[1.0]), 1.0


def two_levels():
    """Two levels that one pump fills and nothing empties: the equations of rest depend on each other."""
    fills = lambda x, u: ca.vertcat(u[0], -2.0 * u[0])  # noqa: E731
    model = written("levels", ["a", "b"], ["pump"], lambda x, u: x + fills(x, u), fills)
    ocp = OCP(8, [1.0, 0.0], [1.0], [0.1], [-1.0], [1.0], q_y=[1.0, 0.0], terminal=np.diag([1.0, 0.0]))
    return model, ocp, 2.0


def sticking():
    """At 0.05 the rate has its least magnitude near rest, as with a machine that sticks: it begins beside that."""
    rate = lambda x, u: u**3 - 0.0075 * u + 7.2e-4  # noqa: E731
    model = written("sticking", ["x"], ["u"], lambda x, u: x + rate(x, u), rate)
    return model, OCP(5, [0.0], [1.0], [0.1], [-1.0], [1.0], q_y=[1.0], terminal=[[1.0]]), 0.3


def restless():
    """No steady state at all: the operating point is held."""
    rate = lambda x, u: (u - 0.3) ** 2 + 0.01  # noqa: E731
    model = written("restless", ["x"], ["u"], lambda x, u: x + rate(x, u), rate)
    return model, OCP(9, [0.0], [1.0], [0.1], [-1.0], [1.0], q_y=[1.0], terminal=[[1.0]]), 0.3


def memory():
    """A tank with a wall and a saturated memory."""
    model = saturated(1, 12)
    ocp = OCP(
        15,
        [0.0, 0.0],
        [0.1, 0.1],
        [0.1, 0.1],
        [-3.0, -3.0],
        [3.0, 3.0],
        q_y=[100.0, 100.0],
        terminal=np.eye(2),
    )
    return model, ocp, np.array([0.3, 0.3])


def far_from_rest(seed):
    """With seeds 0, 3, 4, 11 a set-point has several steady states; where they meet (0, 3, 4) rounding decides."""
    return (
        gated(seed),
        OCP(10, [0.0, 0.0], [0.01], [0.1], [-3.0], [3.0], q_y=[100.0], terminal=np.eye(2)),
        0.9,
    )


def ventilated():
    """A vent that saturates: far set-points are reached along a curved branch, or not at all."""
    ocp = OCP(30, [0.0, 0.0], [1e-6], [1e-2], [0.0], [100.0], q_y=[4.0])
    return machines.ventilated(), ocp, 3.0


def heated(**options):
    """Heater and vent, whose effect turns."""
    ocp = OCP(
        20, [0.0, 0.0], [1e-5, 1e-2], [2.5e-3, 2.5e-3], [0.0, 0.0], [100.0, 100.0], q_y=[4.0], **options
    )
    return machines.heated(), ocp, 12.0


def heater_or_vent():
    """Not both: a soft bound on their product hardly depends on the inputs where both are small."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    return heated(
        soft=[SoftBound(ca.Function("both", [x, u], [u[0] * u[1]]), [-np.inf], [0.0], [0.02], [1e-6])]
    )


CASES = {
    "heaters": lambda: (*parts.heaters(), 8.0),
    "curved": lambda: (*parts.curved(), 8.0),
    "level": level,
    "delayed level": lambda: level(7.0),
    "bounded level": lambda: level(y_max=[0.4], x_min=[0.1, 0.0]),
    "motor": motor,
    "pumps": pumps,
    "two levels": two_levels,
    "sticking": sticking,
    "saturating vent": ventilated,
    "heater and vent": heated,
    "heater or vent": heater_or_vent,
    "restless": restless,
    "memory": memory,
    "begun at the run's end": lambda: far_from_rest(2),
    "by set-points on the way": lambda: far_from_rest(5),
    "several steady states": lambda: far_from_rest(11),
}


@pytest.mark.parametrize("name", CASES)
def test_steady_states_are_those_of_python(name):
    """Set-points within and beyond reach, held, stepping and moving all the time, under disturbances that change."""
    model, ocp, reach = CASES[name]()
    python, native = CondensedController(model, ocp), NativeController(model, ocp, flags=parts.QUICK)
    rng, standing, n = np.random.default_rng(3), python.problem.standing()[0], ocp.horizon
    size, ends = python.problem.targets.scale, {"reached": 0, "steady": 0}
    plan = python.initial(TrueState(model).start(np.concatenate([model.x0, np.zeros(model.n_h)]), w=model.w))
    for k in range(24):
        z = (
            np.concatenate([model.x0, plan.h[0]])
            + 0.02 * size[: model.n_x + model.n_h] * rng.standard_normal()
        )
        e = TrueState(model).start(z, w=model.w * (1 + 0.3 * (k % 5 == 4)))
        e = replace(e, d=0.05 * parts.disturbance_sizes(model, ocp) * rng.standard_normal(model.n_d))
        rows = (1, n + 1, n // 2 + 1, 3)[k % 4]
        course = np.cumsum(rng.standard_normal((rows, standing.size)), axis=0)
        if k % 4 == 2:
            course = np.where(np.arange(rows) < n // 3, course[0, 0], course[-1, 0])[:, None]
        reference = standing + reach * course / (1 + np.max(np.abs(course)))
        wanted, found = (c.solve(plan, e, reference) for c in (python, native))
        assert (found.status, found.steady.steady) == (wanted.status, wanted.steady.steady), k
        assert found.steady.reached == wanted.steady.reached, k
        if wanted.steady.steady:
            for key, scale in (
                ("x", size[: model.n_x]),
                ("h", 1.0),
                ("u", ocp.input_range),
                ("y", np.max(reach)),
            ):
                off = np.abs(getattr(found.steady, key) - getattr(wanted.steady, key)) / scale
                assert np.max(off, initial=0.0) < 1e-9, (k, key)
        assert np.max(np.abs(found.u - wanted.u) / ocp.input_range) < 1e-9, k
        ends["reached"] += wanted.steady.reached
        ends["steady"] += wanted.steady.steady
        plan = wanted
    assert (ends["steady"] == 0) == (name == "restless")
    assert (ends["reached"] > 0) == (name not in ("restless", "motor"))


def test_a_standstill_is_left_as_in_python():
    """The size alone shows of what pump and leak make together: with the leak, more of the pump seems to be less."""
    rate = lambda x, u: ca.sqrt(u**2 + 0.0025) - 0.05 - x  # noqa: E731
    model = written(
        "counting", ["shown"], ["u"], lambda x, u: x + 0.1 * rate(x, u), rate, nominal_x=[1.0], nominal_u=[1.05],
        disturbance_model=(Disturbance("input", "u", 2.0),),
    )  # fmt: skip
    ocp = OCP(5, [0.0], [1.0], [0.1], [0.0], [3.0], q_y=[1.0])
    python, native = CondensedController(model, ocp), NativeController(model, ocp, flags=parts.QUICK)
    estimate = TrueState(model).start(model.x0)
    plan = python.initial(estimate)
    for goal, leak in ((1.0, 0.0), (0.0, 0.0), (1.0, -0.3), (0.0, 0.0), (0.3, -0.3), (2.0, -0.3)):
        e = replace(estimate, d=np.array([leak]))
        plan, found = (c.solve(plan, e, np.array([[goal]])) for c in (python, native))
        assert plan.steady.reached
        assert found.steady.reached
        # both have converged to a step of 1e-9 of the scales
        np.testing.assert_allclose(found.steady.u, plan.steady.u, atol=1e-8)
