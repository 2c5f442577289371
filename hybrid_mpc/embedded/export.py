"""Folder with the C of a controller: sources, vectors for a test program, and a README with sizes."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.rti import CondensedController
from hybrid_mpc.control.safeguard import SafeController
from hybrid_mpc.embedded.generate import (
    GENERATED,
    HEADERS,
    SOURCES,
    Sources,
    filters_of,
    make_sources,
    sources_of,
    template,
)
from hybrid_mpc.embedded.scalar import table
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.estimate.switching import Filter
from hybrid_mpc.estimate.tracking import TrackingFilter, tracked_range
from hybrid_mpc.files import replacing_folder, write_text
from hybrid_mpc.loop.guard import Guard
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.rules import markdown
from hybrid_mpc.watch.monitor import Monitor, Reading

Array = NDArray[np.float64]
VECTORS = 25
"""Periods that the test program replays."""
TOLERANCE = {False: 1e-9, True: 1e-3}
"""Tolerance of the test, double and single precision: inputs over their range, states over their size. In single
precision (seven digits) the QP limits the accuracy."""
ROUNDED = 100.0
"""Deviations of C from Python that count as rounding, over those by one rounding error of the samples: a step adds up
hundreds of numbers, in C in another order."""
OTHERS = ("hmpc_test.c", "Makefile", "CMakeLists.txt")
MONITOR_README = """\
`hmpc_finish` runs the monitor on @WATCHED@. `s.monitor.alarm` is 1 during an alarm; the other fields of `s.monitor`
show its cause. @REACTION@

"""
REACTS = """\
The guard reacts in the next `hmpc_step`: `s.guard.mode` is its mode,
`s.guard.why` the reason."""
REACTIONS = {
    "none": "There is no guard: the caller reacts to an alarm.",
    "guard": REACTS,
    "backup": f"""{REACTS} The backup controller and its observer are `hmpb_state backup` in the state;
their files and names begin with `hmpb`. The observer of the backup also runs in every period;
the table does not include it.""",
}
TARGETS_README = """\
The set-point is one of outputs, `goal.y`. Every step computes its steady state (`s.steady`), starting from the previous
one: two or three iterations, and more after a jump of set-point or disturbance. If this fails, the search starts from
every start point, with at most `HMPC_TARGET_ITERATIONS` iterations each, and again for the same set-point after
`HMPC_TARGET_WAIT` steps at the earliest.

"""


@dataclass(frozen=True)
class Footprint:
    """Memory of a compiled controller [bytes]: code and tables, state, and the sum of all stack frames."""

    flash: int
    state: int
    stack: int


def write_controller(
    folder: Path, model: HybridModel, ocp: OCP, *, estimator: Filter | TrackingFilter | None = None,
    fallback: HybridModel | None = None, safe_input: Array | None = None, single: bool = False,
    monitor: Monitor | None = None, guard: Guard | None = None, check: bool = False,
) -> Sources:  # fmt: skip
    """Write the C of a controller, its test and its README; the arguments are those of :func:`make_sources`.

    With ``check``, the C is compiled and its test runs before the folder is replaced, and the README holds the sizes.
    Without ``check``, nothing is compiled or run.

    Raises:
        InputError: If a part cannot be exported as C (before anything is written), or the check fails.
        StorageError: If the folder cannot be written; it is then unchanged.
    """
    found = make_sources(
        model, ocp, estimator=estimator, fallback=fallback, safe_input=safe_input, single=single, monitor=monitor,
        guard=guard,
    )  # fmt: skip
    safe = SafeController(CondensedController(model, ocp), fallback, safe_input=safe_input)
    texts = {name: template(name) for name in (*HEADERS, *SOURCES, *OTHERS)} | dict(found.texts)
    for name in ("Makefile", "CMakeLists.txt"):
        texts[name] = texts[name].replace("@SOURCES@", " ".join(sources_of(found)))
    tolerance, texts["hmpc_vectors.h"] = _vectors(safe, estimator, single, monitor)
    with replacing_folder(folder) as new:
        for name, text in texts.items():
            write_text(new / name, text)
        sizes = checked(new, sources_of(found)) if check else None
        write_text(new / "README.md", _readme(model, found, sizes, single, tolerance))
    return found


def _vectors(
    safe: SafeController, estimator: Filter | TrackingFilter | None, single: bool, monitor: Monitor | None
) -> tuple[float, str]:
    """Tolerance and vectors of the test: a short loop on the model itself, from the operating point to one near it."""
    model, ocp = safe.controller.model, safe.controller.ocp
    size = safe.controller.problem.sizes.states
    tolerated = (
        1.0 / np.sqrt(np.where(ocp.q_y > 0, ocp.q_y, np.inf)) if ocp.n_y else np.where(ocp.q > 0, size, 0.0)
    )
    goal = safe.controller.problem.standing()[0]
    goal[: tolerated.size] += tolerated
    rng = np.random.default_rng(0)
    z, n_x = np.concatenate([model.x0, np.zeros(model.n_h)]), model.n_x
    sigma = np.zeros(model.n_y) if estimator is None else np.sqrt(filters_of(estimator)[0].noise[1])
    acting = model.w
    if isinstance(estimator, TrackingFilter):  # a machine whose parameters are a standard deviation off
        acting = np.append(acting[: -len(estimator.tracked)], tracked_range(model, estimator.tracked, 1.0)[1])
    estimate: Estimate | None = None
    decision, rows, readings = None, [], []
    memory: Any = None if monitor is None else monitor.initial()
    for _ in range(VECTORS):
        u = safe.controller.problem.u_rest if decision is None else decision.u
        y = model.output(z[:n_x], u, acting, model.p).full().ravel() + sigma * rng.standard_normal(model.n_y)
        estimate = _estimated(model, estimator, estimate, z, y, u)
        if monitor is not None:
            memory, reading = monitor.update(memory, y, u, estimate)
            readings.append(_numbers(reading))
        decision = safe.initial(estimate) if decision is None else decision
        decision = safe.decide(decision, estimate, goal[None])
        rows.append((y, model.w, estimate.x, estimate.h, decision.u))
        step = model.step(z[:n_x], z[n_x:], decision.u, acting, model.p)
        z = np.concatenate([v.full().ravel() for v in step])
    rounding = _rounding(safe, estimator, rows, goal)
    columns = zip("ywxhu", (np.array(c) for c in zip(*rows, strict=True)), strict=True)
    tables = [table(f"vector_{name}", values) for name, values in columns]
    tables += [table("vector_goal", goal[None]), table("vector_x_size", size)]
    tables.append(table("vector_u_size", ocp.input_range))
    if readings:
        found = np.array(readings)
        largest = np.max(np.nan_to_num(np.abs(found)), axis=0)
        tables.append(table("vector_reading", found))
        tables.append(table("vector_reading_size", np.where(largest > 0, largest, 1.0)))
    tolerance = max(TOLERANCE[single], ROUNDED * rounding)
    head = f"#define VECTORS {VECTORS}\n#define VECTOR_TOLERANCE R({tolerance!r})\n"
    text = "/* Decisions of the Python controller in a short loop, generated. */\n"
    return tolerance, f"{text}#ifndef HMPC_VECTORS_H\n#define HMPC_VECTORS_H\n{head}{''.join(tables)}#endif\n"


def _estimated(
    model: HybridModel, estimator: Filter | TrackingFilter | None, before: Estimate | None, z: Array, y: Array,
    u: Array,
) -> Estimate:  # fmt: skip
    """Estimate after a sample ``y``; without an estimator that of the states and hidden states ``z``."""
    if estimator is None:
        none = np.zeros((0, 0))
        return Estimate(0.0, z[: model.n_x], z[model.n_x :], np.zeros(model.n_d), none, y, 0.0, w=model.w)
    if before is None:
        return estimator.start(y, w=model.w)
    return estimator.update(before, y, u, w=model.w)


def _rounding(
    safe: SafeController,
    estimator: Filter | TrackingFilter | None,
    rows: Sequence[tuple[Array, ...]],
    goal: Array,
) -> float:
    """Largest change of an input, over its range, if every sample changes by a rounding error.

    Plans of an unstable machine depend on their start exponentially, and so does what rounding makes of them.
    """
    model, rng = safe.controller.model, np.random.default_rng(1)
    eps, estimate, decision, largest = float(np.finfo(float).eps), None, None, 0.0
    for y, _, x, h, want in rows:
        u = safe.controller.problem.u_rest if decision is None else decision.u
        z = np.concatenate([x, h])
        z, y = (v * (1.0 + eps * rng.choice([-1.0, 1.0], v.size)) for v in (z, y))
        estimate = _estimated(model, estimator, estimate, z, y, u)
        decision = safe.initial(estimate) if decision is None else decision
        decision = safe.decide(decision, estimate, goal[None])
        largest = max(largest, float(np.max(np.abs(decision.u - want) / safe.controller.ocp.input_range)))
    return largest


def _numbers(reading: Reading) -> Array:
    """Numbers of a monitor's reading that the test program compares: alarm, and the channels' values."""
    return np.array([float(reading.alarm), *reading.values])


def checked(folder: Path, names: Sequence[str] = SOURCES) -> Footprint:
    """Compile the sources ``names`` with gcc -O3, run the test program, and measure the memory on this machine.

    Raises:
        InputError: If gcc is not installed, the compilation fails, or the test fails.
    """
    gcc, size = shutil.which("gcc"), shutil.which("size")
    if gcc is None or size is None:
        raise InputError(
            "check: gcc and size (binutils) are not installed. Install them, or omit the check [HM-EMBEDDED-002]"
        )
    with tempfile.TemporaryDirectory() as work:
        flags = ["-std=c11", "-O3", "-ffp-contract=off", "-fstack-usage"]
        sources = [str((folder / name).resolve()) for name in names]
        made = subprocess.run(
            [gcc, *flags, "-c", *sources], cwd=work, capture_output=True, text=True, check=False
        )
        objects = sorted(str(p) for p in Path(work).glob("*.o"))
        test = [str((folder / "hmpc_test.c").resolve()), *objects, "-lm", "-o", "test"]
        linked = subprocess.run(
            [gcc, *flags[:3], *test], cwd=work, capture_output=True, text=True, check=False
        )
        if made.returncode or linked.returncode:
            raise InputError(
                f"check: the generated C does not compile: {(made.stderr + linked.stderr)[-2000:]} [HM-EMBEDDED-003]"
            )
        table_of = subprocess.run([size, *objects], capture_output=True, text=True, check=True).stdout
        flash = sum(int(line.split()[0]) + int(line.split()[1]) for line in table_of.splitlines()[1:])
        frames = [
            int(line.split("\t")[1])
            for p in Path(work).glob("hmp*_*.su")
            for line in p.read_text().splitlines()
        ]
        done = subprocess.run([str(Path(work) / "test")], capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(
                f"check: inputs of the generated C differ from those of Python: {done.stderr[-2000:]} [HM-EMBEDDED-004]"
            )
        state = re.search(r"the state has (\d+) bytes", done.stderr)
        return Footprint(flash, int(state[1]) if state else 0, sum(frames))


def _watching(n: Mapping[str, int], code: Mapping[str, int], step: int) -> int:
    """Operations of the monitor in one period: the maximum, which the energy balance needs near rest."""
    if n["MONITOR"] == 2:
        return 3 * step + code.get("watched_balances", 0) + n["LIMITS"] * n["LONGEST"]
    rows = n["WINDOW"] * (7 * n["NX"] + 2 * (n["NU"] + n["NW"]))
    return (
        3 * step
        + 12 * (step + code["rates_after"])
        + 4 * (code["watched_energy"] + code["watched_force"])
        + 3 * rows
    )


def _estimator_readme(model: HybridModel, sizes: Mapping[str, int]) -> str:
    if not sizes["MODES"]:
        return "none, the caller passes an estimate"
    tracked = [markdown(s.name) for s in model.disturbances[model.n_w - sizes["TRACKED"] :]]
    values = f"; tracked parameters, the last entries of `s.w`: {', '.join(tracked)}" if tracked else ""
    return f"{sizes['MODES']} parallel Kalman filters{values}"


def _monitor_readme(sizes: Mapping[str, int]) -> str:
    if not sizes["MONITOR"]:
        return "There is no monitor: the controller was generated without one.\n\n"
    watched = (
        "the energy balance of the model" if sizes["MONITOR"] == 1 else "residuals of outputs and balances"
    )
    reaction = REACTIONS["backup" if sizes["BACKUP"] else "guard" if sizes["GUARD"] else "none"]
    return MONITOR_README.replace("@WATCHED@", watched).replace("@REACTION@", reaction)


def operations(found: Sources) -> dict[str, int]:
    """Additions and multiplications of one period, by part; for the QP those of one iteration."""
    n, code = found.sizes, found.operations
    n_z, n_v, units = n["NX"] + n["NH"], n["BLOCKS"] * n["NU"], n["UNITS"]
    padded = -(-n_z // 8) * 8
    width = padded + n["NU"] + n["TRACKED"]
    active = np.minimum(np.arange(1, n["N"]) * n["NU"], n_v)
    stage = (
        code.get("model_before_slope", 0)
        + code["model_after_slope"]
        + units * (6 * (n.get("FEATURES", 0) + units) + 110)
    )
    stage += units * (5 * units + 8 * n.get("SEEN_SLOPES", 0)) + 2 * n["HEAD"] * units * width
    of_layers = [
        count for name, count in code.items() if name.startswith("layers") and not name.endswith("_seen")
    ]
    stage += sum(of_layers) + 2 * n["PASSED"] * width
    n_e = n_z + n["TRACKED"] + n["ND"]
    n_t = n_z + n["NU"]
    newton = 2 * n_z**2 * n_t + 4 * n_z * n_t * n["NU"] + 2 * n["NH"] ** 3 // 3
    search = {"step: steady state, one iteration": stage + newton} if n["OUTPUT_COST"] else {}
    step_only = stage - units * (5 * units + 8 * n.get("SEEN_SLOPES", 0)) - 2 * n["HEAD"] * units * width
    watch = {"finish: monitor, at most": _watching(n, code, step_only)} if n["MONITOR"] else {}
    return (
        search
        | watch
        | {
            "prepare: stages' Jacobians": n["N"] * stage,
            "prepare: condensing": int(2 * n_z**2 * np.sum(-(-active // 8) * 8)),
            "prepare: Hessian and its factor": int(n["NX"] * np.sum(active**2)) + n_v**3,
            "step: estimator": n["MODES"] * (stage + 4 * n_e * padded * n_e + 2 * n["MODES"] * n_e**2),
            "step: free response, gradient, bounds": 2 * n["N"] * n_z * padded + 6 * n["N"] * n["NX"] * n_v,
            "step: QP, one iteration": 4 * n_v**2 + 2 * n_v * n["N"] * (n["SOFT_X"] + n["SOFT_E"]),
        }
    )


def _readme(
    model: HybridModel, found: Sources, sizes: Footprint | None, single: bool, tolerance: float
) -> str:
    n = found.sizes
    rows = "".join(f"| {name} | {count:,} |\n" for name, count in operations(found).items())
    if sizes is None:
        memory = "Not measured: generated without `--check`. `make test` prints the size of the state.\n"
    else:
        memory = (
            "| | bytes |\n| --- | ---: |\n"
            f"| flash: code and tables | {sizes.flash:,} |\n| RAM: one `hmpc_state` | {sizes.state:,} |\n"
            f"| stack: sum of all frames, an upper bound (no recursion) | {sizes.stack:,} |\n\n"
            "Compiled with `gcc -O3` on the machine that generated the controller.\n"
        )
    values: Mapping[str, object] = {
        "NAME": markdown(model.name), "KIND": "float" if single else "double", "MEMORY": memory, "OPERATIONS": rows,
        "SIZES": f"{n['NX']} states, {n['NH']} hidden states, {n['NU']} inputs, {n['NY']} outputs, horizon {n['N']}",
        "DT": model.dt, "TOLERANCE": f"{tolerance:.2g}",
        "MONITOR": _monitor_readme(n), "TARGETS": TARGETS_README if n["OUTPUT_COST"] else "",
        "ESTIMATOR": _estimator_readme(model, n),
        "FILES": ", ".join(f"`{name}`" for name in GENERATED),
    }  # fmt: skip
    return re.sub("@([A-Z]+)@", lambda found: str(values[found[1]]), template("README.md"))
