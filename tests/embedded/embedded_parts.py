"""Problems that C is generated for, and a C loop driven through ctypes."""

import ctypes
import shutil
from dataclasses import replace

import casadi as ca
import machines
import numpy as np
import online_models
import pytest

from hybrid_mpc import (
    OCP,
    Disturbance,
    ExtendedKalmanFilter,
    HardBound,
    HybridModel,
    Signal,
    SoftBound,
    SwitchingFilter,
    with_input_delay,
)  # fmt: skip
from hybrid_mpc.control.sizes import disturbance_sizes
from hybrid_mpc.embedded import export
from hybrid_mpc.embedded.generate import make_sources
from hybrid_mpc.embedded.native import FLAGS, State, goal_of, load_library

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
SOURCES = ("MPC", "PLAN", "FALLBACK", "SAFE", "HELD")
QUICK = ("-std=c11", "-O0", "-ffp-contract=off")  # compiling takes longer than the few solves


def coupled():
    """Two inputs and outputs, a hidden state; soft bounds on a state and on a product, move blocks, limited changes."""
    model, *_ = online_models.random_linear(4, n_x=3, n_u=2, n_y=2, n_h=2, radius=0.95)
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    product = SoftBound(ca.Function("product", [x, u], [ca.vertcat(x[0] * x[1] + 0.3 * u[1], x[2])]),
                        [-np.inf, -0.6], [0.5, np.inf], [20.0, 0.0], [5.0, 40.0])  # fmt: skip
    ocp = OCP(
        12, [3.0, 0.0, 1.0], [0.2, 0.1], [0.0, 0.3], [-1.0, -0.5], [1.5, 0.5], du_max=[0.4, 0.3],
        x_max=[0.7, np.inf, np.inf], slack_linear=[8.0, 0.0, 0.0], slack_quadratic=[2.0, 1.0, 1.0],
        soft=[product], blocks=(1, 1, 2, 3, 5),
    )  # fmt: skip
    return model, ocp


def tanks():
    """A pump, two levels, a measured inflow, rest that is not zero, an unmeasured leak; the upper level is bounded."""
    leak = (Disturbance("rate", "lower", 1e-4),)
    model = machines.two_tanks(disturbance_model=leak)
    span = 2 * machines.PUMP
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    flow = SoftBound(ca.Function("flow", [x, u, w], [(u + w) / span]), [-np.inf], [0.9], [3.0], [10.0])
    ocp = OCP(
        20, [0.0, 25.0], [1e3 / span**2 * 1e-3], [0.1 / span**2], [0.0], [span], du_max=[0.3 * span],
        x_max=[model.x0[0] + 0.1, np.inf], x_min=[0.01, 0.01], soft=[flow],
    )  # fmt: skip
    return model, ocp


def heaters():
    """Two temperatures weighed and bounded as outputs, offsets of a sensor and of a heater, set-points."""
    offsets = (Disturbance("output", "t1", 5.0), Disturbance("input", "heater_2"))
    model = machines.thermal(disturbance_model=offsets)
    ocp = OCP(
        25, [0.0, 0.0], [1e-3, 1e-3], [0.02, 0.02], [0.0, 0.0], [16.0, 12.0], du_max=[2.0, 2.0], q_y=[1.0, 0.5],
        y_max=[model.x0[0] + 6.0, np.inf], y_min=[-np.inf, model.x0[1] - 4.0],
    )  # fmt: skip
    return model, ocp


def shown(model, y, **changes):
    """The model with other outputs: ``y(x, u, w)``."""
    x, u, w, p = model.output.mx_in()
    return replace(model, output=ca.Function("y", [x, u, w, p], [y(x, u, w)]), **changes)


def curved():
    """The heaters behind sensors that bend and mix, one of which sees its heater: weights, bounds, offsets of both."""
    model, ocp = heaters()
    t = model.x0

    def y(x, u, w):
        first = x[0] + 0.004 * (x[0] - t[0]) ** 2 + 0.05 * u[0]
        return ca.vertcat(first, x[1] * ca.sqrt(0.5 + 0.5 * (x[0] / t[0]) ** 2) + 0.002 * u[1] ** 2)

    model = shown(model, y)
    top = model.output(model.x0, model.u0, model.w, model.p).full().ravel()
    return model, ocp.changed(y_max=[top[0] + 6.0, np.inf], y_min=[-np.inf, top[1] - 4.0])


def priced():
    """Two levels, a pump whose power has a price, an overflow that curves the cost down, a band that moves with it."""
    model, ocp = tanks()
    span = 2 * machines.PUMP
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    worth = p * (u / span) * ca.sqrt(0.1 + x[0] ** 2) - 0.3 * ca.tanh(4.0 * (x[1] - model.x0[1])) * (
        1 + u / span
    )
    return model, ocp.changed(economic=ca.Function("price", [x, u, p], [worth]))


def priced_outputs():
    """Curved sensors that are weighed, and a cost of its own without parameters."""
    model, ocp = curved()
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    return model, ocp.changed(
        economic=ca.Function("power", [x, u], [0.01 * u[0] * u[1] + 1e-4 * x[0] * u[0]])
    )


def spare():
    """Three sensors for one level and one for the other, one of them curved."""
    model, ocp = tanks()
    names = ("a", "b", "c", "d")
    return shown(
        model, lambda x, u, w: ca.vertcat(x[1], 2.0 * x[1], x[1] + 0.5 * x[1] ** 2, 3.0 * x[1]),
        outputs=tuple(Signal(n, "m") for n in names),
    ), ocp  # fmt: skip


def bounded():
    """Soft and hard bounds on the same states, an expression, outputs, blocks, limited changes, a hidden state."""
    model, ocp = coupled()
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    power = HardBound(
        ca.Function("power", [x, u], [ca.vertcat(u[0] * x[1], x[2])]), [-0.3, -0.8], [0.3, 0.8], 1
    )
    hard = [
        HardBound("x", [-0.9, -0.8, -np.inf], [0.9, np.inf, 1.0]),
        power,
        HardBound("y", [-1.5] * 2, [1.5] * 2, 2),
    ]
    return model, ocp.changed(hard=hard)


def band():
    """Outputs are controlled, and may not leave a band that a sensor's offset moves; one bound follows a parameter."""
    model, ocp = heaters()
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u", 2), ca.SX.sym("w", 0), ca.SX.sym("p", 2)
    power = SoftBound(
        ca.Function("power", [x, u, w, p], [u[0] + u[1] - p[0]]), [-np.inf], [0.0], [5.0], [1.0]
    )
    apart = HardBound(ca.Function("apart", [x, u, w, p], [x[0] - x[1] - p[1]]), [-np.inf], [0.0], 1)
    band = HardBound("y", model.x0 - 8.0, model.x0 + 8.0)
    return model, ocp.changed(hard=[apart, band], soft=[power])


def cart(hard, *, delay=0.0, horizon=25, **options):
    """A cart without friction, pushed by 3 m/s^2 at most."""
    a, b = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    model = online_models.linear_model(a, b, np.eye(2)[:1], dt=0.1)
    model = with_input_delay(model, delay) if delay else model
    return model, OCP(horizon, [10.0, 0.1], [0.01], [0.0], [-3.0], [3.0], hard=hard, **options)


def circle():
    """A point that is driven along a plane, at a speed of at most 1 m/s in any direction."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    place, speeds = tuple(Signal(n, "m") for n in "ab"), tuple(Signal(f"v{n}", "m/s") for n in "ab")
    model = HybridModel.of("point", 0.1, place, speeds, place, x=x, u=u, x_next=x + 0.1 * u, xdot=u, y=x)
    speed = HardBound(ca.Function("speed", [x, u], [ca.sumsqr(u)]), [-np.inf], [1.0])
    return model, OCP(15, [1.0] * 2, [0.0] * 2, [0.01] * 2, [-1.0] * 2, [1.0] * 2, hard=[speed])


def ways_round():
    """A point that is driven along a plane round a hill: the way that a plan finds by itself costs more."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    place, speeds = tuple(Signal(n, "m") for n in "ab"), tuple(Signal(f"v{n}", "m/s") for n in "ab")
    model = HybridModel.of("point", 0.1, place, speeds, place, x=x, u=u, x_next=x + 0.1 * u, xdot=u, y=x)
    hill = 8.0 * ca.exp(-((x[0] - 0.5) ** 2 + (x[1] - 0.1) ** 2) / 0.04) + 1 / (
        1 + ca.exp(30 * (x[1] + 0.15))
    )
    return model, OCP(
        20, [4.0, 1.0], [0.05, 0.05], [0.05, 0.05], [-2.0, -2.0], [2.0, 2.0],
        economic=ca.Function("hill", [x, u], [hill]),
    )  # fmt: skip


def delayed():
    """The pendulum with a GRU written in scalars, whose torque acts one and a half periods later."""
    model = with_input_delay(online_models.pendulum_model(z=4, seed=1), 0.03)
    return model, OCP(15, [40.0, 0.5], [1.0], [0.5], [-0.4], [0.4], working_point=([0.0, 1.0], [0.0]))


def filters_of(model, ocp):
    """A switching filter of three modes."""
    span = disturbance_sizes(model, ocp)
    size = np.where(model.x0 != 0, np.abs(model.x0), 0.3)
    modes = [
        ExtendedKalmanFilter(
            model, sigma_y=np.full(model.n_y, 0.01), sigma_x=scale * 0.01 * size, sigma_x0=0.1 * size,
            sigma_d=step * span, sigma_d0=0.01 * span,
        )
        for scale, step in ((1.0, 1e-3), (10.0, 1e-3), (1.0, 0.05))
    ]  # fmt: skip
    return SwitchingFilter(modes, ((0.97, 0.02, 0.01), (0.5, 0.49, 0.01), (0.45, 0.05, 0.5)))


def write(folder, case, **options):
    """The C of a whole loop, of what ``Loop`` is made of."""
    controller = case.safe.controller
    return export.write_controller(
        folder, controller.model, controller.ocp, estimator=case.estimator, fallback=case.safe.fallback,
        safe_input=case.safe.safe_input, monitor=case.monitor, guard=case.guard, **options,
    )  # fmt: skip


class CLoop:
    """The loop of the generated C: ``start`` on a given first plan, ``step``, ``finish``."""

    def __init__(self, model, ocp, estimator, fallback=None, safe_input=None, flags=QUICK):
        found = make_sources(model, ocp, estimator=estimator, fallback=fallback, safe_input=safe_input)
        self.library = load_library(found, flags)
        self.state, self.model = State(self.library), model
        self._kept = None

    def __getattr__(self, name):
        found = self.state.view[name]
        return SOURCES[found[0]] if name == "source" else found

    def call(self, name, *given):
        self._kept = [np.ascontiguousarray(v, dtype=float) if isinstance(v, np.ndarray) else v for v in given]
        pointers = [
            v.ctypes.data
            if isinstance(v, np.ndarray)
            else ctypes.byref(v)
            if isinstance(v, ctypes.Structure)
            else v
            for v in self._kept
        ]
        getattr(self.library.c, f"hmpc_{name}")(self.state.at, *pointers)

    def start(self, y, w, first, goal):
        self.call("estimate_start", y, w)
        plan = first.solution
        self.state.view["u"][:] = first.u
        self.call(
            "load_plan",
            plan.u,
            np.hstack([plan.x, plan.h]),
            plan.d,
            plan.w if self.model.n_w else np.zeros(1),
        )
        self.call("decide", goal, None)


def goal(reference, weight=None, limits=None, *, ocp=None, w=None):
    """A goal whose arrays live as long as it; ``ocp`` says of what the reference is, its parameters last."""
    n = None if ocp is None else ocp.columns - ocp.n_p
    given = (None, None) if reference is None else (reference[:, :n], reference[:, n:] if n else None)
    kept = [None if v is None else np.ascontiguousarray(v, dtype=float) for v in (*given, weight, w)]
    rows, p, weight, w = kept
    x, y = (None, rows) if ocp is not None and ocp.n_y else (rows, None)
    bounds = (None, None) if limits is None else (limits.u_min, limits.u_max)
    found = goal_of(x, weight, *bounds, y=y, p=p if ocp is not None and ocp.n_p else None, w=w)
    found.kept = kept, limits
    return found


__all__ = ["FLAGS"]
