"""Generated C of a monitor and of a guard: sizes, tables and scalar code."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.safeguard import SafeController
from hybrid_mpc.embedded.cut import Cut, cut, reduced
from hybrid_mpc.embedded.layers import layer_code, tables_of
from hybrid_mpc.embedded.scalar import c_function, scalar_code, table
from hybrid_mpc.loop.guard import TINY, Guard, Mode
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.watch.detector import CAP
from hybrid_mpc.watch.energy import HELD_SHARE, EnergyReadings, energy_balance, inertia_of, weights
from hybrid_mpc.watch.monitor import Monitor
from hybrid_mpc.watch.residuals import ResidualReadings

Array = NDArray[np.float64]
KINDS = {EnergyReadings: 1, ResidualReadings: 2}
"""Values of ``HMPC_MONITOR``."""


@dataclass(frozen=True)
class Watched:
    """Parts of the generated files that belong to a monitor.

    Args:
        sizes: Integers of the configuration.
        numbers: Real numbers of the configuration.
        tables: Tables.
        code: Scalar code.
        operations: Operations of that code by function.
    """

    sizes: Mapping[str, int]
    numbers: Mapping[str, float]
    tables: str
    code: str
    operations: Mapping[str, int]


NOTHING = Watched({"MONITOR": 0, "RATES": 0}, {}, "", "", {})


def refused_monitor(monitor: object, model: HybridModel) -> list[str]:
    """Texts about the parts of a monitor that cannot be exported as C."""
    if type(monitor) is not Monitor or type(monitor.readings) not in KINDS:
        return [f"a monitor of another kind than Monitor ({type(monitor).__name__})"]
    found = []
    if not _alike(monitor.model, model):
        found.append(
            f"a monitor of another model ({monitor.model.name}) than the controller's ({model.name})"
        )
    return found


def refused_guard(
    guard: Guard, monitored: bool, model: HybridModel, ocp: OCP, safe_input: Array | None
) -> list[str]:
    """Texts about the parts of a guard that cannot be exported as C, without those inside its backup."""
    found = [] if monitored else ["a guard without a monitor: a guard reacts to the monitor's alarms"]
    if Mode.REST in (guard.on_model, guard.on_sensor) and safe_input is None:
        found.append("a guard's mode REST without a safe input")
    if guard.backup is None:
        return found
    backup = guard.backup.controller
    if not solves_once(guard.backup):
        found.append(f"a backup with another solver than rti with one iteration ({type(backup).__name__})")
    sizes = [(m.n_x, m.n_u, m.n_y, m.n_w, m.dt) for m in (backup.model, model)]
    shapes = [(o.horizon, o.columns, o.n_y, o.n_p) for o in (backup.ocp, ocp)]
    if sizes[0] != sizes[1] or shapes[0] != shapes[1]:
        found.append("a backup whose model or reference has another size than the controller's")
    return found


def solves_once(safe: SafeController) -> bool:
    """Whether a controller is the real-time iteration with one iteration in each period, in Python or as C."""
    controller = safe.controller
    return not controller.converges and getattr(controller, "iterations", 1) == 1


def monitor_parts(monitor: Monitor | None, model: HybridModel, parts: Cut) -> Watched:
    """Generate the parts of a monitor; ``parts`` is the model's step, cut at its GRU cell.

    Raises:
        InputError: If an expression of the monitor cannot be written as C.
    """
    if monitor is None:
        return NOTHING
    readings = monitor.readings
    if isinstance(readings, EnergyReadings):
        own = _energy(readings, model, parts)
    else:
        assert isinstance(readings, ResidualReadings)
        own = _residuals(readings, model)
    limits = () if monitor.limits is None else monitor.limits.channels
    sizes = {
        "MONITOR": KINDS[type(readings)], "CHANNELS": len(monitor.channels), "LIMITS": len(limits),
        "TERMS": readings.n_terms, "LONGEST": max((one.length for one in limits), default=1) or 1,
        "BLIND_AFTER": readings.patience, "REPEATS": int(np.max(monitor.frozen_repeats)) + 1,
    }  # fmt: skip
    tables = table("frozen_travel", monitor.frozen_travel) + table(
        "frozen_repeats", monitor.frozen_repeats, "int"
    )
    if limits:
        reals = {
            "limit_threshold": np.array([one.threshold for one in limits]),
            "limit_release": np.array([one.release for one in limits]),
            "limit_drift": np.array([one.drift for one in limits]),
        }  # fmt: skip
        if readings.n_terms:
            reals["limit_scale"] = np.array(
                [one.scale or (1.0, *(0.0,) * (readings.n_terms - 1)) for one in limits]
            )
        whole = {
            "limit_channel": [monitor.channels.index(one.channel) for one in limits],
            "limit_length": [one.length for one in limits],
        }
        tables += "".join(table(name, values) for name, values in reals.items())
        tables += "".join(table(name, np.array(values), "int") for name, values in whole.items())
    numbers = {"DT": model.dt, "SUM_CAP": CAP, **own.numbers}
    return Watched({**sizes, **own.sizes}, numbers, own.tables + tables, own.code, own.operations)


def guard_parts(guard: Guard | None, model: HybridModel) -> tuple[dict[str, int], str]:
    """Generate sizes and tables of a guard; times are in periods."""
    if guard is None:
        return {"GUARD": 0, "BACKUP": 0}, ""
    times = {
        name.upper(): periods_of(getattr(guard, name), model.dt) for name in ("quiet", "dwell", "patience")
    }
    limits = guard.limits
    sizes = {
        "GUARD": 1, "BACKUP": int(guard.backup is not None), "GUARD_LIMITS": int(limits is not None),
        "ON_MODEL": int(guard.on_model), "ON_SENSOR": int(guard.on_sensor), **times,
    }  # fmt: skip
    tables = "" if limits is None else table("guard_u_min", limits.u_min) + table("guard_u_max", limits.u_max)
    return sizes, tables


def periods_of(seconds: float, dt: float) -> int:
    """Smallest number of periods that is not shorter than a duration, within the guard's tolerance for times.

    Example:
        >>> periods_of(0.5, 0.02), periods_of(0.0, 0.02), periods_of(0.5, 0.3)
        (25, 0, 2)
    """
    return max(0, math.ceil((seconds - TINY) / dt))


def _alike(own: HybridModel, other: HybridModel) -> bool:
    """Whether two models have the same sizes and the same steps (at three random points)."""
    if own is other:
        return True
    sizes = [(m.n_x, m.n_h, m.n_u, m.n_w, m.n_y, m.dt, m.nominal_w) for m in (own, other)]
    if sizes[0] != sizes[1]:
        return False
    rng = np.random.default_rng(0)
    for _ in range(3):
        x, u = (v + rng.uniform(-1, 1, v.size) for v in (own.x0, own.u0))
        h = rng.uniform(-1, 1, own.n_h)
        steps = [np.vstack([v.full() for v in m.step(x, h, u, m.w, m.p)]) for m in (own, other)]
        if not np.array_equal(steps[0], steps[1], equal_nan=True):
            return False
    return True


def _symbols(model: HybridModel) -> dict[str, ca.SX]:
    sizes = {"x": model.n_x, "u": model.n_u, "w": model.n_w}
    return {name: ca.SX.sym(name, n) for name, n in sizes.items()}


def _energy(readings: EnergyReadings, model: HybridModel, parts: Cut) -> Watched:
    window, n_q, dt = readings.window, model.n_x // 2, model.dt
    sizes = {"RATES": 1, "WINDOW": window, "FREE_RUN": readings.layout.length}
    numbers = {"HELD_SHARE": HELD_SHARE, "SHORTEST": readings.shortest}
    position, speed, acceleration, kernel, slope = weights(window, dt)
    reals: dict[str, Array] = {
        "fit_position": position, "fit_speed": speed, "fit_acceleration": acceleration, "kernel_speed": kernel[1:],
        "kernel_position": slope, "kernel_mean": 0.5 * dt * (kernel[:-1] + kernel[1:]),
        "rest_speed": np.array(readings.rest_speed), "input_span": readings.input_range,
    }  # fmt: skip
    rates, rate_sizes, operations = _rates(model, parts)
    s = _symbols(model)
    x, u, w = (ca.MX.sym(name, v.numel()) for name, v in s.items())
    rate = ca.MX.sym("rate", model.n_x)
    own = energy_balance(model, x, rate, ca.vertcat(u, w))
    balance = scalar_code("monitor: its energy balance", ca.Function("watched", [x, rate, u, w], [own]))
    inertia = ca.Function("watched", [x, u, w], [inertia_of(model, x, ca.vertcat(u, w))])
    inertia = scalar_code("monitor: its inertia", inertia)
    r, a = ca.SX.sym("rate", model.n_x), ca.SX.sym("a", n_q)
    point = {"x": s["x"], "u": s["u"], "w": s["w"]}
    value, f = balance(s["x"], r, s["u"], s["w"]), ca.densify(inertia(*point.values()) @ a)
    texts = [rates]
    functions = (
        (
            "watched_energy",
            ("x", "rate", "u", "w"),
            "value",
            {"x": s["x"], "rate": r, "u": s["u"], "w": s["w"]},
            value,
        ),
        ("watched_force", ("x", "u", "w", "a"), "force", {**point, "a": a}, f),
    )
    for name, given, out, inputs, values in functions:
        arguments = [*(f"const real *{key}" for key in given), f"real *{out}"]
        results = [(f"{out}[{i}]", values[i]) for i in range(values.numel())]
        text, operations[name] = c_function(name, arguments, inputs, results)
        texts.append(text)
    tables = "".join(table(name, values) for name, values in reals.items())
    return Watched(sizes | rate_sizes, numbers, tables, "\n".join(texts), operations)


def _rates(model: HybridModel, parts: Cut) -> tuple[str, dict[str, int], dict[str, int]]:
    """Code, sizes and operations of the model's rates; they share the GRU cell with the step if it is the same cell."""
    own = cut(model, "xdot")
    if own.cell is not None and not own.cell.same(parts.cell):  # the step has no such cell
        own = cut(model, "xdot", layered=True)
    z, u, w = (
        ca.SX.sym(name, n) for name, n in (("z", model.n_x + model.n_h), ("u", model.n_u), ("w", model.n_w))
    )
    x, h = z[: model.n_x], z[model.n_x :]
    inputs, point = {"z": z, "u": u, "w": w}, ["const real *z", "const real *u", "const real *w"]
    texts, operations = [], dict[str, int]()
    known = tables_of("layers", parts.layers)
    code = layer_code("rate_layers", own.layers, (z, u, w), known=known)
    g = ca.SX.sym("g", code.products if own.cell is None else own.cell.units)
    head, out, value = np.zeros((0, 0)), g, own.after(x, h, u, w, g)
    if own.before is not None:
        seen = own.before(x, h, u, w)
        results = [(f"seen[{i}]", seen[i]) for i in range(seen.numel())]
        text, operations["rates_before"] = c_function("rates_before", [*point, "real *seen"], inputs, results)
        texts.append(text)
        head, out, value = reduced(own, model, list(range(model.n_x)), z, u, w)
        texts.append(table("rate_head", head))
    elif own.layers:
        operations |= code.operations
        texts.append(code.text)
    results = [(f"xdot[{i}]", ca.densify(value[i])) for i in range(model.n_x)]
    arguments = [*point, "const real *out", "real *xdot"]
    text, operations["rates_after"] = c_function("rates_after", arguments, {**inputs, "out": out}, results)
    sizes = {"RATE_HEAD": len(head), "RATE_PRODUCTS": code.products}
    return "\n".join([*texts, text]), sizes, operations


def _residuals(readings: ResidualReadings, model: HybridModel) -> Watched:
    names = model.balances
    sizes = {
        "RATES": 0, "BALANCES": len(names), "SETTLING": readings.settling, "FREE_RUN": readings.free_run,
    }  # fmt: skip
    tables = table("sensor_end", readings.sensor_ends)
    code, operations = "", {}
    if names:
        s, r = _symbols(model), ca.SX.sym("r", model.n_x)
        x, u, w = (ca.MX.sym(name, v.numel()) for name, v in s.items())
        rate, none = ca.MX.sym("r", model.n_x), ca.MX.zeros(model.n_x)
        rows = [b.residual(x, rate, u, w, model.p) - b.residual(x, none, u, w, model.p) for b in names]
        f = scalar_code("monitor: a balance", ca.Function("watched", [x, rate, u, w], [ca.vertcat(*rows)]))
        values = ca.densify(f(s["x"], r, s["u"], s["w"]))
        arguments = [*(f"const real *{key}" for key in "xruw"), "real *violation"]
        results = [(f"violation[{i}]", values[i]) for i in range(values.numel())]
        inputs = {"x": s["x"], "r": r, "u": s["u"], "w": s["w"]}
        code, operations["watched_balances"] = c_function("watched_balances", arguments, inputs, results)
    return Watched(sizes, {}, tables, code, operations)
