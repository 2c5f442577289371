"""A whole loop of C, compiled from its folder, beside the Python loop that it is to be equal to, period by period."""

import ctypes
import subprocess
from dataclasses import dataclass, replace

import casadi as ca
import embedded_parts as parts
import numpy as np
from machines import MachinePlant
from online_models import rk4

from hybrid_mpc import (
    OCP,
    ChannelLimit,
    CondensedController,
    Fault,
    Guard,
    HybridModel,
    Limits,
    Mode,
    Monitor,
    ResidualReadings,
    SafeController,
    Signal,
    WatchLimits,
    learn_limits,
    make_monitor,
    simulate,
)
from hybrid_mpc.embedded.generate import sources_of
from hybrid_mpc.loop.preview import Forecast, Previews, n_tracked

SHARED = [*parts.QUICK, "-fPIC", "-shared"]
BRIDGE = """
#include <stddef.h>
#include <string.h>
#include "hmpc.h"
const size_t whole_places[] = {sizeof(hmpc_state), @PLACES@};
/* the plan and the input of the period before, of whoever made it */
void whole_plan(hmpc_state *s, int backup, const hmpc_real *held, const hmpc_real *u, const hmpc_real *z,
                const hmpc_real *d, const hmpc_real *w);
void whole_plan(hmpc_state *s, int backup, const hmpc_real *held, const hmpc_real *u, const hmpc_real *z,
                const hmpc_real *d, const hmpc_real *w) {
  memcpy(s->u, held, sizeof s->u);
#if HMPC_BACKUP
  if (backup) {
    hmpb_load_plan(&s->backup, u, z, d, w);
    return;
  }
#endif
  (void)backup;
  hmpc_load_plan(s, u, z, d, w);
}
"""
READ = {"values": "value", "levels": "level", "share": "share", "travel": "travel"}
"""Names of a reading's numbers in Python and in C."""
WIDE = 1e-9
SAID = ("alarm", "frozen", "blind", "validity")


@dataclass(frozen=True)
class Case:
    """A loop to be replayed: what Loop is made of, and the plant with its faults."""

    estimator: object
    safe: SafeController
    monitor: object
    guard: object
    plant: object
    reference: object
    x0: object
    periods: int
    weight: object = None
    faults: tuple = ()
    seed: int = 0
    w: object = None


class Whole:
    """The generated C of a case's loop in ``folder``, compiled and loaded."""

    def __init__(self, folder, case, flags=SHARED):
        controller = case.safe.controller
        self.model, self.ocp = controller.model, controller.ocp
        found = parts.write(folder, case)
        fields = self._fields(found.sizes, case)
        (folder / "bridge.c").write_text(
            BRIDGE.replace(
                "@PLACES@", ", ".join(f"offsetof(hmpc_state, {place})" for place, *_ in fields.values())
            )
        )
        words = ["cc", *flags, *sources_of(found), "bridge.c", "-lm", "-o", "whole.so"]
        subprocess.run(words, cwd=folder, check=True)
        self._c = ctypes.CDLL(str(folder / "whole.so"))
        size, *places = (ctypes.c_size_t * (len(fields) + 1)).in_dll(self._c, "whole_places")
        memory = np.zeros(size + 64, dtype=np.uint8)
        start = -memory.ctypes.data % 64
        self._at = ctypes.c_void_p(memory.ctypes.data + start)
        self.view = {}
        for (name, (_, kind, shape)), place in zip(fields.items(), places, strict=True):
            found_bytes = memory[start + place :][: np.dtype(kind).itemsize * int(np.prod(shape))]
            self.view[name] = found_bytes.view(kind).reshape(shape)

    def _fields(self, sizes, case):
        m = self.model
        found = {
            name: (name, np.float64, (n,))
            for name, n in (("x", m.n_x), ("d", m.n_d), ("w", m.n_w), ("u", m.n_u))
        }
        found |= {name: (name, np.int32, ()) for name in ("status", "source", "age")}
        if case.guard is not None:
            found |= {f"guard_{name}": (f"guard.{name}", np.int32, ()) for name in ("mode", "wanted")}
        if case.monitor is None:
            return found
        shapes = {"value": (sizes["CHANNELS"],), "share": (), "travel": (m.n_y,)}
        shapes |= {"level": (sizes["LIMITS"],)} if sizes["LIMITS"] else {}
        found |= {f"monitor_{name}": (f"monitor.{name}", np.float64, shape) for name, shape in shapes.items()}
        return found | {f"monitor_{name}": (f"monitor.{name}", np.int32, ()) for name in SAID}

    def call(self, name, *given):
        kept = [np.ascontiguousarray(v, dtype=float) if isinstance(v, np.ndarray) else v for v in given]
        pointers = [
            ctypes.c_void_p(v.ctypes.data)
            if isinstance(v, np.ndarray)
            else ctypes.byref(v)
            if isinstance(v, ctypes.Structure)
            else v
            for v in kept
        ]
        getattr(self._c, name)(self._at, *pointers)

    def plan(self, decision, backup):
        """Go on from what Python decided."""
        plan, none = decision.solution, np.zeros(1)
        z = np.hstack([plan.x, plan.h])
        w = plan.w if plan.w.size else none
        self.call("whole_plan", int(backup), decision.u, plan.u, z, plan.d if plan.d.size else none, w)


@dataclass
class Told:
    """What a replay found: periods, alarms, modes, the largest differences, and the first period with one of more than
    :data:`WIDE` of the input's range; 0 for none.
    """

    periods: int
    alarms: int
    frozen: int
    modes: tuple
    sources: tuple
    input: float
    estimate: float
    reading: float
    wide: int = 0


def run(case):
    """The Python loop, its steps and its result."""
    steps = []
    result = simulate(
        case.plant, case.estimator, case.safe, case.reference, weight=case.weight, dt=case.safe.controller.model.dt,
        duration=case.periods * case.safe.controller.model.dt, x0=case.x0, seed=case.seed, monitor=case.monitor,
        guard=case.guard, w=case.w, faults=case.faults, on_step=steps.append,
    )  # fmt: skip
    return steps, result


def replay(whole, case, *, own=False, told=True, known=None):
    """Both loops on the same samples, C going on from Python's plan in each period, or with ``own`` from its own ones
    after the first: all decisions are the same. With ``own`` C is ``told`` which input really acted, Python's.
    ``known`` is what :func:`run` gave, by default it runs.
    """
    steps, result = run(case) if known is None else known
    model, ocp, view = whole.model, whole.ocp, whole.view
    preview = Previews(case.reference, case.weight, case.safe.controller.problem, np.inf)
    n_measured = model.n_w - n_tracked(case.estimator)
    forecast = Forecast(case.w, ocp, n_measured, model.dt)
    size = case.safe.controller.problem.sizes.states
    names = {name: own for name, own in READ.items() if f"monitor_{own}" in view}
    found, wanted = {name: [] for name in names}, {name: [] for name in names}
    largest_u = largest_x = 0.0
    ws = []
    wide = 0
    said = {Mode[name]: 0 for name in {*result.mode}}
    for k, step in enumerate(steps):
        rows, weight = preview(k * model.dt)
        goal = parts.goal(rows, weight, ocp=ocp, w=forecast(k * model.dt))
        w = step.estimate.w[:n_measured] if n_measured else np.zeros(1)
        if k == 0:
            whole.call("hmpc_start", step.y, w, None, goal)
        else:
            before = steps[k - 1].decision
            if k == 1 or not own:
                whole.plan(before, backup=result.mode[k - 1] == "BACKUP")
            whole.call("hmpc_step", step.y, w, before.u if own and told else None, goal)
            decision = step.decision
            assert parts.SOURCES[int(view["source"])] == decision.source.name, k
            assert STATUSES[int(view["status"])] == decision.status.name, k
            if k > 1:
                assert int(view["age"]) == decision.age, k
            largest_u = max(largest_u, float(np.max(np.abs(view["u"] - decision.u) / ocp.input_range)))
            if largest_u > WIDE and not wide:
                wide = k
        if case.guard is not None:
            assert Mode(int(view["guard_mode"])).name == result.mode[k], k
            said[Mode[result.mode[k]]] += 1
        scale = np.maximum(size, np.abs(step.estimate.x))
        largest_x = max(largest_x, float(np.max(np.abs(view["x"] - step.estimate.x) / scale)))
        ws.append((view["w"].copy(), step.estimate.w))
        whole.call("hmpc_finish", goal)
        for name in SAID:
            assert int(view[f"monitor_{name}"]) == int(getattr(step.reading, name)), (k, name)
        for name, place in names.items():
            found[name].append(np.array(view[f"monitor_{place}"]))
            wanted[name].append(np.array(getattr(step.reading, name)))
    if model.n_w:
        got, want = (np.array(v) for v in zip(*ws, strict=True))
        scale = np.maximum(np.max(np.abs(want), axis=0), 1e-300)
        largest_x = max(largest_x, float(np.max(np.abs(got - want) / scale)))
    largest = 0.0
    for name in names:
        got, want = (np.array(v).reshape(len(steps), -1) for v in (found[name], wanted[name]))
        np.testing.assert_array_equal(np.isnan(got), np.isnan(want), err_msg=name)
        scale = np.max(np.abs(np.nan_to_num(want)), axis=0)
        off = np.nan_to_num(np.abs(got - want)) / np.where(scale > 0, scale, 1.0)
        largest = max(largest, float(np.max(off)))
    return Told(
        len(steps), int(np.sum(result.alarm)), sum(s.reading.frozen for s in steps), tuple(dict.fromkeys(result.mode)),
        tuple(dict.fromkeys(result.source)), largest_u, largest_x, largest, wide,
    )  # fmt: skip


STATUSES = ("INITIAL", "SOLVED", "NOT_FINITE", "INFEASIBLE", "INACCURATE", "DIVERGED")


def freezes(start, end=np.inf, channel=""):
    return Fault(start, end, "measurement_freeze", 0.0, channel)


def lost(start, end, channel=""):
    return Fault(start, end, "measurement_dropout", 0.0, channel)


def arm():
    """Two joints whose inertia couples them, dry friction and springs; a measured load on the second one."""
    dt, names = 0.02, ("q1", "q2")
    q, v = (tuple(Signal(n + end, unit) for n in names) for end, unit in (("", "rad"), ("_dot", "rad/s")))
    x, u, w, rate = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("w"), ca.SX.sym("rate", 4)

    def inertia(x):
        coupled = 0.02 * ca.cos(x[1])
        return ca.vertcat(ca.horzcat(0.12, coupled), ca.horzcat(coupled, 0.08))

    def force(x):
        return (
            u + ca.vertcat(0, w) - ca.vertcat(1.5, 0.8) * x[:2] - 0.1 * x[2:] - 0.05 * ca.tanh(x[2:] / 0.02)
        )

    rates = lambda x: ca.vertcat(x[2:], ca.solve(inertia(x), force(x)))  # noqa: E731
    power = ca.dot(x[2:], inertia(x) @ rate[2:] - force(x))
    return HybridModel.of(
        "arm", dt, q + v, tuple(Signal(f"u{i}", "N m", -2.0, 2.0) for i in (1, 2)), q, x=x, u=u, w=w,
        disturbances=(Signal("load", "N m"),), xdot=rates(x), x_next=rk4(rates, x, dt, 4), y=x[:2], rate=rate,
        energy=power,
    )  # fmt: skip


def arm_case(periods, seed=0):
    """The arm's energy and a detector; one sensor is lost, later frozen, then something pushes; limits on alarms."""
    model = arm()
    ocp = OCP(12, [40.0, 40.0, 0.5, 0.5], [0.2, 0.2], [0.1, 0.1], [-2.0, -2.0], [2.0, 2.0], du_max=[0.8, 0.8])
    size = (0.02**2, 0.02**2, 0.02**2, 0.02**2)
    force = [ChannelLimit(f"force of {q}", "N m", 0, 12.0, 6.0, size, 1.0) for q in ("q1", "q2")]
    power = ChannelLimit("power of the free run", "W", 1, 6.0, 3.0, size)
    limits = WatchLimits("energy", model.dt, (*force, power), (3e-3, 3e-3), (0, 0), rest_speed=(0.05, 0.08))
    monitor = make_monitor(model, limits)
    guard = Guard(Mode.LIMITED, Mode.REST, limits=Limits([-1.0, -1.2], [1.0, 0.9]), dwell=0.3, quiet=0.4)
    safe = SafeController(CondensedController(model, ocp), model, safe_input=[0.0, 0.0])
    t = periods * model.dt
    faults = (
        lost(0.2 * t, 0.21 * t, "q2"), freezes(0.3 * t, 0.34 * t, "q1"),
        Fault(0.6 * t, 0.75 * t, "input_offset", 0.6, "u1"),
    )  # fmt: skip

    def reference(t):
        return np.column_stack(
            [0.4 * np.sin(2 * t), 0.3 * np.cos(3 * t), 0.8 * np.cos(2 * t), -0.9 * np.sin(3 * t)]
        )

    return Case(
        parts.filters_of(model, ocp), safe, monitor, guard, MachinePlant(model, sigma=1e-3), reference, model.x0,
        periods, faults=faults, seed=seed,
    )  # fmt: skip


def residual_case(make, reference, guard, faults, sigma, periods, seed=0):
    """A machine watched by its residuals, whose limits are learned in loops in which nothing is wrong."""
    model, ocp = make()
    estimator = parts.filters_of(model, ocp)
    safe = SafeController(CondensedController(model, ocp), model, safe_input=model.u0)
    plant = MachinePlant(model, sigma=sigma)
    case = Case(estimator, safe, None, None, plant, reference, model.x0, periods, seed=seed)
    nominal = [run(replace(case, seed=100 + i))[1] for i in range(2)]
    limits = learn_limits(ResidualReadings(model), estimator, nominal)
    return replace(case, monitor=Monitor(ResidualReadings(model), limits), guard=guard, faults=faults)


def tanks_case(periods, seed=0):
    """Two tanks and a measured inflow; its level's sensor freezes, is lost, shows too much; the feedback takes over."""
    t = 5.0 * periods
    faults = (
        freezes(0.35 * t, 0.45 * t),
        lost(0.5 * t, 0.62 * t),
        Fault(0.75 * t, 0.85 * t, "measurement_offset", 0.05),
    )
    guard = Guard(Mode.FALLBACK, Mode.REST, dwell=20.0, quiet=60.0)
    level = parts.tanks()[0].x0

    def reference(t):
        return level + np.column_stack([0 * t, 0.05 * np.sin(t / 150.0)])

    return residual_case(parts.tanks, reference, guard, faults, 1e-3, periods, seed)


def heaters_case(periods, seed=0):
    """Two temperatures that are controlled as outputs; one sensor freezes, one heater is weak; patience."""
    model, _ = parts.heaters()
    t = model.dt * periods
    faults = (freezes(0.4 * t, 0.5 * t, "t2"), Fault(0.65 * t, 0.9 * t, "input_gain", 0.4, "heater_1"))
    guard = Guard(
        Mode.LIMITED,
        Mode.REST,
        limits=Limits([2.0, 2.0], [14.0, 10.0]),
        dwell=50.0,
        quiet=100.0,
        patience=40.0,
    )

    def reference(t):
        return model.x0 + np.column_stack([3 * np.sin(t / 400.0), 2 * np.sin(t / 300.0)])

    return residual_case(parts.heaters, reference, guard, faults, 5e-2, periods, seed)
