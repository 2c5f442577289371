"""Generated C of a controller: sizes, tables and scalar code. The sources in ``c/`` are the same for all machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.problem import HALVINGS, KEPT, KNOTS, BoundRows, Problem
from hybrid_mpc.control.qp import BOUND_TOLERANCE, KKT_TOLERANCE
from hybrid_mpc.control.rti import CORRECTIONS, STRAIGHT
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.control.targets import Targets
from hybrid_mpc.embedded.cut import Cut, cut, next_places, reduced
from hybrid_mpc.embedded.layers import after_code, layer_code
from hybrid_mpc.embedded.scalar import c_function, comment, number, scalar_code, table
from hybrid_mpc.embedded.watch import (
    NOTHING,
    Watched,
    guard_parts,
    monitor_parts,
    refused_guard,
    refused_monitor,
)
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate import kalman
from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
from hybrid_mpc.estimate.switching import NEGLIGIBLE, Filter, SwitchingFilter
from hybrid_mpc.estimate.tracking import TrackedParameter, TrackingFilter, tracked_values
from hybrid_mpc.loop.guard import Guard
from hybrid_mpc.model import active_set, equilibrium
from hybrid_mpc.model.model import HybridModel, output_with_jacobian
from hybrid_mpc.model.riccati import dare
from hybrid_mpc.watch.monitor import Monitor

Array = NDArray[np.float64]
CORE = ("hmpc_model.c", "hmpc_qp.c", "hmpc_targets.c", "hmpc_mpc.c", "hmpc_estimator.c")
"""Sources of a controller and its observer; a guard's backup has the same sources with the prefix :data:`BACKUP`."""
SOURCES = (*CORE, "hmpc_monitor.c", "hmpc_loop.c")
HEADERS = ("hmpc.h", "hmpc_math.h")
BACKUP = "hmpb"
"""Prefix of the names of a guard's backup, instead of ``hmpc``."""
GENERATED = ("hmpc_config.h", "hmpc_tables.h", "hmpc_expressions.h")
FIRST = 25
"""Real-time iterations of the first plan; each one at least halves the error."""
SEARCH: Mapping[str, tuple[str, str]] = {
    "STEADY": (repr(equilibrium.STEADY), "1e-5"), "STILL": (repr(equilibrium.STILL), "1e-4"),
    "NEAR": (repr(equilibrium.NEAR), "1e-3"), "REACHED": (repr(equilibrium.REACHED), "1e-3"),
    "RANK": (repr(equilibrium.RANK), "1e-5"),
    "ASIDE": (repr(equilibrium.ASIDE), "1e-2"), "FREE": (repr(equilibrium.FREE), "1e-3"), "DAMPING": ("1e-12", "1e-7"),
    **{name: (repr(getattr(equilibrium, name)),) * 2 for name in (
        "STALLED", "CREEPS", "CONTRACTS", "FOLLOWED", "LEAST_PART", "LEAST_WEIGHT", "EQUAL", "STIFF",
    )}, "VIOLATED": ("1e-12", "1e-6"),
    "ROUNDING": ("1e-15", "1e-7"), "AWAY": (repr(equilibrium.AWAY), repr(equilibrium.AWAY)),
}  # fmt: skip
"""Constants of the search for steady states (``hybrid_mpc.model.equilibrium``), in double and in single precision."""
START: Mapping[str, tuple[str, str]] = {
    "FITS": (repr(kalman.FITS), "1e-2"), "EXACT": (repr(kalman.EXACT), "1e-3"),
    "DEPENDENT": (repr(kalman.DEPENDENT), "1e-5"),
}  # fmt: skip
"""Constants of the search for an initial state that fits the sensors (``hybrid_mpc.estimate.kalman``), likewise."""
MAX_AGE = 5
"""Maximum periods of a plan without a successful solve, as in :class:`~hybrid_mpc.control.safeguard.SafeController`."""


@dataclass(frozen=True)
class Sources:
    """C of a controller: texts of the generated files by name, scalar operations by function, and sizes by name."""

    texts: Mapping[str, str]
    operations: Mapping[str, int]
    sizes: Mapping[str, int]


def make_sources(
    model: HybridModel, ocp: OCP, *, estimator: Filter | TrackingFilter | None = None,
    fallback: HybridModel | None = None, safe_input: Array | None = None, single: bool = False,
    monitor: Monitor | None = None, guard: Guard | None = None, max_age: int = MAX_AGE,
) -> Sources:  # fmt: skip
    """Generate the files of a controller; with a guard's backup, also all files of the backup.

    Args:
        model: The model of controller and observer.
        ocp: The control problem.
        estimator: The observer. Default: none; the caller of the C then passes an estimate.
        fallback: The prior, see :class:`~hybrid_mpc.control.safeguard.SafeController`. Default: none.
        safe_input: Safe input ``(n_u,)``, see there. Default: none.
        single: True: numbers are ``float``. Default: ``double``.
        monitor: The monitor; it needs the observer. Default: none.
        guard: The guard, which reacts to alarms. Default: none.
        max_age: See :class:`~hybrid_mpc.control.safeguard.SafeController`.

    Raises:
        InputError: If a part cannot be exported as C; lists all such parts together.
    """
    own, tracked = (
        (estimator.inner, estimator.tracked) if isinstance(estimator, TrackingFilter) else (estimator, ())
    )
    refused = _refused(model, ocp, own, tracked, single)
    parts: Cut | None = None
    try:
        parts = cut(model)
    except InputError as error:
        refused.append(str(error))
    watched, backup = NOTHING, None
    if monitor is not None:
        refused += refused_monitor(monitor, model)
        refused += (
            [] if estimator is not None else ["a monitor without an estimator: it needs the state estimate"]
        )
    if guard is not None:
        refused += refused_guard(guard, monitor is not None, model, ocp, safe_input)
    try:
        if not refused and parts is not None:
            watched = monitor_parts(monitor, model, parts)
    except InputError as error:
        refused.append(str(error))
    try:
        backup = backup_of(guard, single)
    except InputError as error:
        refused.append(f"its guard's backup: {error} [HM-EMBEDDED-005]")
    if refused or parts is None:
        raise InputError(
            "controller: the C export is not possible: " + "; ".join(refused) + " [HM-EMBEDDED-011]"
        )
    problem = Problem(model, ocp)
    soft = problem.soft
    expressions = sum(int(f.numel_out(0)) for f in soft.functions)
    modes = () if own is None else filters_of(own)
    starts, aims = ocp.block_starts, target_starts(problem.targets)
    curved, cost = _curved(model), problem.economic
    staged = cost.function is not None and (ocp.economic is not None or curved)
    sizes = {
        "NX": model.n_x, "NH": model.n_h, "NU": model.n_u, "NY": model.n_y, "NW": model.n_w, "ND": model.n_d,
        "TRACKED": len(tracked), "N": ocp.horizon, "BLOCKS": starts.size, "SOFT_X": soft.states.size,
        "SOFT_E": expressions, "BENT": int(soft.curved), "INPUT_BOUNDS": len(soft.on_inputs.kinds),
        "HALVINGS": HALVINGS, "CORRECTIONS": CORRECTIONS, "MODES": len(modes),
        "DELAYED": model.delay_states, "CHANGES": int(ocp.du_max is not None), "MAX_AGE": max_age, "FIRST": FIRST,
        "FALLBACK_GAIN": int(fallback is not None), "SAFE_INPUT": int(safe_input is not None),
        "NP": ocp.n_p, "HARD": int(np.any(soft.hard)), "OUTPUT_COST": int(ocp.n_y > 0), "TARGET_KNOTS": KNOTS,
        "SOFT_D": int(any(np.any(np.array(f.jac_sparsity(0, 2).get_triplet()[1]) < model.n_d) for f in soft.functions)),
        "TARGET_ITERATIONS": equilibrium.ITERATIONS, "TARGET_SETTLING": equilibrium.SETTLING,
        "TARGET_WITHIN": equilibrium.WITHIN, "TARGET_PARTS": equilibrium.MOST_PARTS, "TARGET_STARTS": len(aims),
        "TARGET_WAIT": equilibrium.WAIT,
        "TARGET_NEAREST": len(aims) - 1 if problem.targets is not None and problem.targets.run_out else 0,
        "CURVED": int(curved), "STAGE_COST": int(staged), "COST_MOVES": int(staged and cost.n_p > 0),
        "OUTPUT_ROWS": int(ocp.n_y > 0 and not staged), "STARTS": len(ocp.starts),
        "START_MODES": len(modes) if len({(f.first.tobytes(), f.noise[1].tobytes()) for f in modes}) > 1 else 1,
        "TURNS": int(estimator is not None and any(s.periodic for s in (*model.outputs, *model.disturbances))),
    }  # fmt: skip
    code, model_sizes, operations = _expressions(
        model, parts, soft, fallback, ocp, problem, sizes, watched.code, tracked
    )
    guard_sizes, guard_tables = guard_parts(guard, model)
    sizes |= {**model_sizes, **watched.sizes, **guard_sizes}
    tables = _tables(
        model, ocp, problem, soft, fallback, safe_input, own, tracked, watched.tables + guard_tables
    )
    config = _config(sizes, single, bound_names(soft, ocp.horizon), watched)
    texts = {"hmpc_config.h": config, "hmpc_tables.h": tables, "hmpc_expressions.h": code}
    return Sources(texts | (backup or {}), operations | dict(watched.operations), sizes)


def backup_of(guard: Guard | None, single: bool) -> dict[str, str]:
    """Generate all files of a guard's backup, named with the prefix :data:`BACKUP`; empty without a backup.

    Raises:
        InputError: As :func:`make_sources`.
    """
    if guard is None or guard.backup is None or guard.backup_estimator is None:
        return {}
    safe, estimator = guard.backup, guard.backup_estimator
    found = make_sources(
        safe.controller.model, safe.controller.ocp, estimator=cast(Filter, estimator), fallback=safe.fallback,
        safe_input=safe.safe_input, single=single, max_age=safe.max_age,
    )  # fmt: skip
    texts = {name: template(name) for name in (*HEADERS, *CORE)} | dict(found.texts)
    return {_rename(name): _rename(text) for name, text in texts.items()}


def _rename(text: str) -> str:
    return text.replace("hmpc", BACKUP).replace("HMPC", BACKUP.upper())


def sources_of(found: Sources) -> tuple[str, ...]:
    """Names of all files to compile."""
    return (*SOURCES, *(_rename(name) for name in CORE if found.sizes["BACKUP"]))


def _refused(
    model: HybridModel, ocp: OCP, estimator: object, tracked: Sequence[TrackedParameter], single: bool
) -> list[str]:
    """Texts about the parts of a control problem and an observer that cannot be exported as C."""
    found, names = [], [one.name for one in tracked]
    if [s.name for s in model.disturbances[max(0, model.n_w - len(names)) :]] != names:
        found.append(
            f"an observer that tracks {', '.join(names)} beside a controller that does not; give the controller the "
            "observer's model (tracking=True)"
        )
    if type(estimator) not in (ExtendedKalmanFilter, SwitchingFilter, type(None)):
        found.append(
            f"an estimator of this kind ({type(estimator).__name__}); needed: an ExtendedKalmanFilter or a "
            "SwitchingFilter, on a model that holds the delays (with_input_delay)"
        )
    if ocp.hard and single:
        found.append(
            "hard bounds in single precision: the penalty of a relaxed bound is 1e5 times larger than the cost, and "
            "seven digits leave no accuracy for the cost; generate double precision"
        )
    return found


def _curved(model: HybridModel) -> bool:
    """Whether the outputs' slopes by state and input are not constant: they depend on state, input or disturbances."""
    point = [ca.SX.sym(name, n) for name, n in (("x", model.n_x), ("u", model.n_u), ("w", model.n_w))]
    y = scalar_code("controller: the output", model.output)(*point, ca.DM(model.p))
    return bool(ca.depends_on(ca.jacobian(y, ca.vertcat(*point[:2])), ca.vertcat(*point)))


def filters_of(estimator: Filter | TrackingFilter) -> tuple[ExtendedKalmanFilter, ...]:
    """The filter of each mode; of an observer that tracks, those over ``(x, h, theta, d)``."""
    own = estimator.inner if isinstance(estimator, TrackingFilter) else estimator
    return own.filters if isinstance(own, SwitchingFilter) else (own,)


def kinds_of(soft: BoundRows, horizon: int) -> list[int]:
    """Rows of the last period, in which all bounds hold: the states' bounds, then those of each expression."""
    sizes = [soft.states.size, *(int(f.numel_out(0)) for f in soft.functions)]
    ends = horizon * np.cumsum(sizes)
    return [row for end, size in zip(ends, sizes, strict=True) for row in range(end - size, end)]


def bound_names(soft: BoundRows, horizon: int) -> list[str]:
    """Names of the hard bounds in the order of ``given_way``; empty for soft bounds."""
    return [soft.names[row] if soft.hard[row] else "" for row in kinds_of(soft, horizon)]


def _first_periods(soft: BoundRows, horizon: int) -> list[int]:
    """First period in which each bound holds, in the order of a period's bounds."""
    bounded = np.isfinite(soft.lower) | np.isfinite(soft.upper)
    first, at = [], 0
    for size in (soft.states.size, *(int(f.numel_out(0)) for f in soft.functions)):
        rows = bounded[at : at + horizon * size].reshape(horizon, size)
        first += [int(np.argmax(column)) for column in rows.T]
        at += horizon * size
    return first


def _config(sizes: Mapping[str, int], single: bool, names: list[str], watched: Watched) -> str:
    defined = "".join(f"#define HMPC_{name} {value}\n" for name, value in sizes.items())
    hard = "".join(f"   {i}: {comment(name)}\n" for i, name in enumerate(names) if name)
    defined += f"/* Hard bounds by their place in given_way:\n{hard}*/\n" if hard else ""
    # tolerances of the QP in single precision follow from the seven digits of a float
    tolerances = [
        (name, floats if single else repr(value))
        for name, floats, value in (
            ("VIOLATED", "2e-5", active_set.PRIMAL_TOLERANCE), ("LEAST_SHARE", "1.0", active_set.LEAST_SHARE),
            ("ROUNDING", "1e-7", active_set.ROUNDING), ("DEPENDENT", "1e-4", active_set.DEPENDENT),
            ("KKT_TOLERANCE", "2e-3", KKT_TOLERANCE), ("BOUND_TOLERANCE", "1e-3", BOUND_TOLERANCE),
            ("KEPT", "1e-3", KEPT), ("STRAIGHT", "1e-3", STRAIGHT),
        )
    ]  # fmt: skip
    tolerances += [(f"TARGET_{name}", value[single]) for name, value in SEARCH.items()]
    tolerances += [(f"START_{name}", value[single]) for name, value in START.items()]
    defined += "".join(f"#define HMPC_{name} {number(value)}\n" for name, value in watched.numbers.items())
    return (
        "/* Sizes of this controller, generated. */\n#ifndef HMPC_CONFIG_H\n#define HMPC_CONFIG_H\n"
        + ("#define HMPC_FLOAT\n" if single else "")
        + "#ifdef HMPC_FLOAT\ntypedef float hmpc_real;\n#define HMPC_HUGE 3.402823466e+38F\n#else\n"
        + "typedef double hmpc_real;\n#define HMPC_HUGE 1.7976931348623157e308\n#endif\n"
        + defined
        + "".join(f"#define HMPC_{name} R({value})\n" for name, value in tolerances)
        + f"#define HMPC_NEGLIGIBLE {NEGLIGIBLE!r}\n"
        + "#define HMPC_QP_CAP (10 * HMPC_MOST + 100) /* iterations of the QP */\n#endif\n"
    )


def _expressions(
    model: HybridModel,
    parts: Cut,
    soft: BoundRows,
    fallback: HybridModel | None,
    ocp: OCP,
    problem: Problem,
    asked: Mapping[str, int],
    watched: str,
    tracked: Sequence[TrackedParameter],
) -> tuple[str, dict[str, int], dict[str, int]]:
    """The scalar code, the sizes that follow from it, and its operations by function."""
    n_x, n_h, n_u = model.n_x, model.n_h, model.n_u
    n_z = n_x + n_h
    padded = -(-n_z // 8) * 8
    row = padded + n_u + len(tracked)
    z, u, w = ca.SX.sym("z", n_z), ca.SX.sym("u", n_u), ca.SX.sym("w", model.n_w)
    v = ca.vertcat(z, u, w[model.n_w - len(tracked) :])  # the Jacobian's columns
    inputs = {"z": z, "u": u, "w": w}
    point = ["const real *z", "const real *u", "const real *w"]
    texts, operations = ['#include "hmpc_math.h"\n'], {}
    places = [*range(n_z), *range(padded, row)]

    def add(name: str, *given: object) -> None:
        text, operations[name] = c_function(name, *given)  # type: ignore[arg-type]
        texts.append(text)

    cell, units = parts.cell, 0 if parts.cell is None else parts.cell.units
    layered = layer_code("layers", parts.layers, (z, u, w), v, places)
    texts.append(layered.text if parts.layers else "")
    operations |= layered.operations
    g = ca.SX.sym("g", layered.products or units)
    x, h = z[:n_x], z[n_x:]
    z_next = parts.after(x, h, u, w, g)
    own: dict[int, int] = {}
    sizes = {"UNITS": units, "PRODUCTS": layered.products, "THROUGH": layered.through}
    if cell is not None and parts.before is not None:
        seen = parts.before(x, h, u, w)
        slope = ca.jacobian(seen, v)
        rows, columns = slope.sparsity().get_triplet()
        values = [slope[i, j] for i, j in zip(rows, columns, strict=True)]
        own = next_places(z_next, g)
        first = min(own, default=0)
        sizes |= {
            "FEATURES": seen.numel(), "SEEN_SLOPES": len(values), "HIDDEN": n_x + cell.first, "HIDDEN_NEXT": first,
        }  # fmt: skip
        # weights row by row for the Jacobian, and column by column for the values
        gates = -(-3 * units // 8) * 8
        sizes["GATES"] = gates
        weights = {"input_weight": cell.input_weight, "hidden_weight": cell.hidden_weight}
        for which, weight, bias in (
            ("input", cell.input_weight, cell.input_bias), ("hidden", cell.hidden_weight, cell.hidden_bias)
        ):  # fmt: skip
            more = (0, gates - 3 * units)
            weights |= {
                f"{which}_columns": np.pad(weight, (more, (0, 0))).T,
                f"{which}_bias": np.pad(bias, more),
            }
        texts += [table(name, value) for name, value in weights.items()]
        texts.append(
            table("seen_row", rows, "int") + table("seen_column", [places[j] for j in columns], "int")
        )
        outs = [(f"seen[{i}]", seen[i]) for i in range(seen.numel())]
        add("model_before", [*point, "real *seen"], inputs, outs)
        slopes = [(f"by_v[{i}]", value) for i, value in enumerate(values)]
        add("model_before_slope", [*point, "real *seen", "real *by_v"], inputs, outs + slopes)
    rest = [i for i in range(n_z) if i not in own]
    head, out, z_next = reduced(parts, model, rest, z, u, w) if units else (np.zeros((0, 0)), g, z_next)
    sizes["HEAD"] = len(head)
    texts.append(table("head", head))
    inputs = {**inputs, "out": out}
    point.append("const real *out")
    outs = [(f"z_next[{i}]", z_next[i]) for i in rest]
    add("model_after", [*point, "real *z_next"], inputs, outs)
    by_out, by_v = ca.jacobian(z_next, out), ca.jacobian(z_next, v)
    passed: list[tuple[str, ca.SX]] = []
    reached: list[int] = []
    if parts.layers:
        text, passed, reached = after_code("layers_after", z_next, out, layered)
        texts.append(text)
    outs, sizes["PASSED"] = outs + passed, len(passed)
    corrected = [i for i in rest if units and by_out[i, :].nnz()]
    outs += [
        (f"slope[{i * row + places[j]}]", by_v[i, j])
        for i in rest
        for j in by_v[i, :].sparsity().get_triplet()[1]
    ]
    outs += [
        (f"by_out[{k * len(head) + j}]", ca.densify(by_out[i, j]))
        for k, i in enumerate(corrected)
        for j in range(len(head))
    ]
    cleared = [f"memset(slope + {i * row}, 0, sizeof(real) * HMPC_LJ);" for i in (*corrected, *reached)]
    add("model_after_slope", [*point, "real *z_next", "real *slope", "real *by_out"], inputs, outs, cleared)
    sizes["CORRECTED"] = len(corrected)
    texts.append(table("corrected", np.array(corrected, dtype=float), "int"))
    if tracked:
        theta, symbol = ca.SX.sym("theta", len(tracked)), ca.MX.sym("theta", len(tracked))
        value = ca.Function("values", [symbol], [tracked_values(model, tracked, symbol)])(theta)
        outs = [(f"value[{i}]", value[i]) for i in range(len(tracked))]
        outs += [(f"by_theta[{i}]", ca.jacobian(value[i], theta[i])) for i in range(len(tracked))]
        add("tracked_values", ["const real *theta", "real *value", "real *by_theta"], {"theta": theta}, outs)
    x, d, p = ca.SX.sym("x", n_x), ca.SX.sym("d", model.n_d), ca.SX.sym("p", ocp.n_p)
    if soft.functions:
        values, e = [], ca.vertcat(d, w, p)
        for f in soft.functions:
            values.append(scalar_code(f"controller: soft bound {f.name()}", f)(x, u, e))
        value = ca.densify(ca.vertcat(*values))
        outs = [(f"value[{i}]", value[i]) for i in range(value.numel())]
        for name, by, width in (("by_x", x, n_x), ("by_u", u, n_u)):
            jacobian = ca.densify(ca.jacobian(value, by))
            outs += [
                (f"{name}[{i * width + j}]", jacobian[i, j])
                for i in range(value.numel())
                for j in range(width)
            ]
        arguments = [
            *(f"const real *{name}" for name in "xuwdp"),
            *(f"real *{name}" for name in ("value", "by_x", "by_u")),
        ]
        given = {"x": x, "u": u, "w": w, "d": d, "p": p}
        add("soft_expressions", arguments, given, outs)
        if soft.curved:
            m, both = ca.SX.sym("m", value.numel()), ca.vertcat(x, u)
            curve, n = ca.densify(ca.hessian(ca.dot(m, value), both)[0]), both.numel()
            add("bounds_values", [*arguments[:5], "real *value"], given, outs[: value.numel()])
            outs = [(f"curve[{i * n + j}]", curve[i, j]) for i in range(n) for j in range(n)]
            add("bounds_curvature", [*arguments[:5], "const real *m", "real *curve"], given | {"m": m}, outs)
    if asked["INPUT_BOUNDS"]:
        value = scalar_code("controller: hard bounds on inputs", soft.on_inputs.function)(u)
        outs = [(f"value[{i}]", value[i]) for i in range(value.numel())]
        add("bounds_of_inputs", ["const real *u", "real *value"], {"u": u}, outs)
    if asked["MODES"] or ocp.n_y:
        y = ca.densify(scalar_code("controller: the output", model.output)(x, u, w, ca.DM(model.p)))
        outs = [(f"y[{i}]", y[i]) for i in range(model.n_y)]
        given, read = {"x": x, "u": u, "w": w}, ["const real *x", "const real *u", "const real *w"]
        add("outputs", [*read, "real *y"], given, outs)
        if asked["CURVED"]:
            for name, of in (("by_x", x), ("by_u", u)):
                jacobian = ca.densify(ca.jacobian(y, of)).T
                outs += [(f"{name}[{i}]", jacobian[i]) for i in range(jacobian.numel())]
            add("output_slopes", [*read, "real *y", "real *by_x", "real *by_u"], given, outs)
    if asked["STAGE_COST"] and problem.economic.function is not None:
        y_ref, both = ca.SX.sym("y", ocp.n_y), ca.vertcat(x, u)
        known = ca.vertcat(p, y_ref, d, w) if ocp.n_y else p[: problem.economic.n_p]
        f = scalar_code("controller: the stage cost", problem.economic.function)
        cost = model.dt * ca.densify(f(x, u, known) if f.n_in() > 2 else f(x, u))
        by = ca.densify(ca.jacobian(cost, both))
        curve = ca.densify(ca.jacobian(by, both))
        given, n = {"x": x, "u": u, "w": w, "d": d, "p": p, "y": y_ref}, both.numel()
        read = [f"const real *{name}" for name in given]
        add("stage_cost", [*read, "real *value"], given, [("value[0]", cost)])
        outs = [(f"slope[{i}]", by[i]) for i in range(n)]
        outs += [(f"curve[{i * n + j}]", curve[i, j]) for i in range(n) for j in range(i + 1)]
        add("stage_cost_slopes", [*read, "real *slope", "real *curve"], given, outs)
    if fallback is not None:
        prior = scalar_code("controller: the prior", fallback.xdot)
        rates = prior(x, ca.DM.zeros(fallback.n_h), u, w, ca.DM(fallback.p))
        best = equilibrium.holding(rates, u, fallback.u0, Sizes(fallback, ocp).states, ocp.input_scale)
        outs = [(f"best[{i}]", best[i]) for i in range(n_u)]
        add("equilibrium", ["const real *x", "const real *w", "real *best"], {"x": x, "w": w}, outs)
    guard = "HMPC_EXPRESSIONS_H"
    opening = f"/* Scalar code of this controller, generated. */\n#ifndef {guard}\n#define {guard}\n"
    return opening + "\n".join([*texts, watched]) + "\n#endif\n", sizes, operations


def target_starts(own: Targets | None) -> Array:
    """Start points of the target calculator, one row each: the operating point first, the end of the run last."""
    return np.zeros((0, 0)) if own is None else np.array([*own.beside, *own.run_out])


def _tables(
    model: HybridModel, ocp: OCP, problem: Problem, soft: BoundRows, fallback: HybridModel | None,
    safe_input: Array | None, estimator: Filter | None, tracked: Sequence[TrackedParameter], watched: str,
) -> str:  # fmt: skip
    """Tables of problem, observer, monitor and guard."""
    dt, n = model.dt, ocp.horizon
    on_u, on_x, on_y = model.disturbed
    starts = ocp.block_starts
    lengths = np.diff(np.append(starts, n))
    kinds = kinds_of(soft, n)
    scale, linear, quadratic = (v[kinds] for v in (soft.scale, soft.linear, soft.quadratic))
    reals: dict[str, Array] = {
        "u_min": ocp.u_min, "u_max": ocp.u_max, "u_scale": ocp.input_scale, "u_rest": model.u0, "x_rest": model.x0,
        "w_rest": model.w, "du_max": np.full(model.n_u, np.inf) if ocp.du_max is None else ocp.du_max,
        "x_reach": np.array(problem.reach), "x_usable": np.array(problem.usable),
        "q_x": ocp.q * dt, "r_u": ocp.r * dt, "r_delta": ocp.r_delta * dt, "terminal": problem.terminal,
        "disturbs_u": on_u, "disturbs_x": on_x,
        "soft_lower": soft.lower[kinds], "soft_upper": soft.upper[kinds],
        "soft_scale": scale if scale.size else np.ones(1),
        "soft_linear": dt * linear * scale, "soft_quadratic": 2 * dt * quadratic * scale**2,
        "safe_input": np.zeros(model.n_u) if safe_input is None else safe_input,
    }  # fmt: skip
    if soft.on_inputs.kinds:
        limits = soft.on_inputs
        reals |= {"input_lower": limits.lower, "input_upper": limits.upper, "input_centre": limits.centre}
    if fallback is not None:
        gain = dare(*ocp.linear_quadratic(fallback))[1]
        reals["gain"] = gain[:, : ocp.n_x + fallback.delay_states]
    if ocp.starts:
        reals |= {"starts": np.array([np.clip(s, ocp.u_min, ocp.u_max).ravel() for s in ocp.starts])}
    if problem.economic.function is not None or soft.curved:
        reals |= {"cost_size": problem.economic.size}
    if estimator is not None or ocp.n_y:
        c, by_u = (m.full() for m in output_with_jacobian(model)(model.x0, model.u0, model.w)[1:])
        reals |= {"output_x": c, "output_d": by_u @ on_u + on_y, "disturbs_y": on_y}
        rest = model.output(model.x0, model.u0, model.w, model.p).full().ravel()
        reals |= {"q_y": ocp.q_y * dt, "output_u": by_u, "y_rest": rest} if ocp.n_y else {}
    if problem.targets is not None:
        own = problem.targets
        reals |= {
            "target_scale": own.scale, "target_heed": own.scale[: own.heed.size] * own.heed,
            "target_root": np.sqrt(ocp.q_y), "target_starts": target_starts(own),
            "target_x_range": np.array(own.x_range).T, "target_y_range": np.array(own.y_range).T,
            "target_begun": own.begun[1], "target_slopes": own.slopes, "target_flat": np.array([own.flat]),
        }  # fmt: skip
    if estimator is not None:
        modes = filters_of(estimator)
        switching = estimator if isinstance(estimator, SwitchingFilter) else None
        reals |= {
            "noise": np.array([f.noise[0] for f in modes]), "noise_y": np.array([f.noise[1] for f in modes]),
            "decay": np.array([*(one.decay(dt) for one in tracked), *np.ones(model.n_d)]),
            "first_variance": np.array([f.first for f in modes]), "start_size": np.array([f.nearness for f in modes]),
            "lost_variance": np.array([np.where(f.most < np.finfo(float).max, f.most, np.inf) for f in modes]),
            "y_period": np.array([s.period for s in model.outputs]),
            "w_period": np.array([s.period for s in model.disturbances]),
            "switches": np.ones((1, 1)) if switching is None else switching.transition,
            "first_probability": np.ones(1) if switching is None else switching.first_probability,
        }  # fmt: skip
    whole: dict[str, Array | NDArray[np.int64] | NDArray[np.bool_] | list[int]] = {
        "block_of": np.repeat(np.arange(starts.size), lengths), "block_start": starts, "block_length": lengths,
        "soft_state": soft.states, "soft_first": _first_periods(soft, n), "soft_hard": soft.hard[kinds],
        "soft_convex": soft.convex[kinds],
        "input_kind": soft.on_inputs.kinds,
        "target_knots": np.linspace(0, n, KNOTS).astype(int),
    }  # fmt: skip
    text = "".join(table(name, value) for name, value in reals.items())
    text += "".join(table(name, value, "int") for name, value in whole.items())
    text += watched
    return f"/* Numbers of this controller, generated. */\n#ifndef HMPC_TABLES_H\n#define HMPC_TABLES_H\n{text}#endif\n"


def template(name: str) -> str:
    """Read a source that is the same for all controllers."""
    return (files("hybrid_mpc.embedded") / "c" / name).read_text()
