"""The real-time iteration of the library against that of acados, on the same control problem; no estimator in it.

acados runs in processes of its own (``acados_worker.py``), since its libraries have the names of those in CasADi's
wheel, and in an environment of its own, since its wheel brings a package ``casadi`` that would overwrite this one's:

    python3.11 -m venv acados-env
    acados-env/bin/pip install comma-deps-acados==0.2.2.post92
    acados-env/bin/pip install --force-reinstall casadi==3.8.2
    python benchmarks/acados.py --acados acados-env/bin/python --out acados.json
    python benchmarks/acados.py --acados acados-env/bin/python --soft   # two soft bounds on states, active

Without acados the library's rows are printed and the reason why the others are missing. The golf robot with a GRU of
random weights, N = 50, |u| bounded. All solvers take one Gauss-Newton iteration a period along the states of one
closed loop, each from its own last plan, shifted by a period; rounds by turns, one thread, wall clock or with ``--cpu``
processor time. acados knows the input held before as one more state, and the cost as linear least squares; the script
checks that its numbers cost what the library's problem does.

- ``plain``: the model as a graph of matrices with CasADi's own derivatives, as acados itself generates them;
  ``structured``: with the exported model's Jacobians under the names that acados expects. Both are compiled for the
  processor at hand, with ``-Ofast``, which takes up to a quarter off ``-O3`` for acados; ``native`` has ``-O3``.
  acados' own libraries are those of its wheel, made for Haswell.
- acados' QP solvers: full condensing with HPIPM and with qpOASES, partial condensing with HPIPM; the options of each
  are the fastest of ``CANDIDATES`` on the structured model that answer as the library does. The plain model is timed
  with the fastest of all three.
- Of ``rti`` and ``native`` whole Python calls are timed, of ``native, C alone`` and acados the C functions:
  what Python hands over and takes back is left out. ``for Haswell`` is ``native`` with the instructions of acados'
  libraries.
- ``QP``: acados' own time within its QP solver. This version condenses in the feedback; a later one, which
  condenses before it, has a feedback between the two.
- ``cost``: mean over the closed loop's states of what the plans cost when the library's model runs on their inputs;
  ``KKT``: largest residual in the library's QP of answers from the same last plan, of the largest gradient;
  ``input differs``: how far these are from those of ``rti``; ``answered``: the share of them with the status solved.
  On random weights one step a period is far from convergence, and plans of their own part by and by.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import casadi as ca
import numpy as np
from native import SOFT, bare, times
from numpy.typing import NDArray
from parts import REFERENCE, SKIPPED, arguments, closed_loop, deployed, hybrid_step, problem, report
from scipy.optimize import lsq_linear

import nn_export
from hybrid_mpc import OCP, CondensedController, Estimate, HybridModel, trace_model
from hybrid_mpc.control.problem import Solution
from hybrid_mpc.embedded.native import FLAGS, NativeController
from hybrid_mpc.model.model import inlined

Array = NDArray[np.float64]
Clock = Callable[[], float]
NAME = "golf"
WORKER = Path(__file__).with_name("acados_worker.py")
SAME = 1e-9
"""Largest relative difference between what acados' numbers and the library's problem say that a plan costs."""
AGREES = 1e-4
"""Largest difference of the inputs [Nm] from ``rti`` with which options may be chosen: 0.01 % of the range."""
COMPARED = 7
"""Every so many states answers from the same last plan are compared."""
SPEED = {"hpipm_mode": "SPEED"}
CANDIDATES: dict[str, list[dict[str, Any]]] = {
    "FULL_CONDENSING_HPIPM": [
        {},
        *(
            {**SPEED, "qp_solver_cond_ric_alg": ric, "qp_solver_warm_start": warm}
            for ric in (0, 1)
            for warm in (0, 1)
        ),
    ],
    "FULL_CONDENSING_QPOASES": [{"qp_solver_warm_start": warm} for warm in (0, 1, 2)],
    "PARTIAL_CONDENSING_HPIPM": [
        {"qp_solver_cond_N": 5},  # its cond_ric_alg is 1, with which some answers are wrong
        *(
            {**mode, "qp_solver_cond_N": n, "qp_solver_cond_ric_alg": 0}
            for mode in ({}, SPEED)
            for n in (1, 5, 10)
        ),
    ],
}
HASWELL = tuple("-march=haswell" if flag == "-march=native" else flag for flag in FLAGS)
ACADOS_FLAGS = ("-std=c99", "-Ofast", "-march=native")
Measured = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """A model with its problem, and the states along which it is solved."""

    plain: ca.Function
    model: HybridModel
    ocp: OCP
    rti: CondensedController
    states: list[Estimate]


def made(z: int, n: int, *, soft: bool) -> Case:
    """The golf robot with ``z`` random units, as all benchmarks have it."""
    step = hybrid_step(z)
    model, ocp = deployed(step), problem(n, **(SOFT if soft else {}))
    plain = nn_export.build(trace_model(step)["step"], plain=True)
    return Case(plain, model, ocp, CondensedController(model, ocp), closed_loop(model, ocp))


def problem_data(case: Case) -> dict[str, Any]:
    """The problem as acados takes it: linear least squares over ``(x, h, held input)`` and ``u``, one input."""
    ocp, n_x, size = case.ocp, case.model.n_x, case.model.n_x + case.model.n_h + 1
    vx, vu = np.zeros((n_x + 2, size)), np.zeros((n_x + 2, 1))
    vx[:n_x, :n_x], vx[n_x + 1, -1], vu[n_x:] = np.eye(n_x), -1.0, 1.0
    linear, quadratic = ocp.penalties
    low, high = (np.full(n_x, np.inf) if v is None else v for v in (ocp.x_min, ocp.x_max))
    bounded = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    numbers = {
        "vx": vx, "vu": vu, "w": 2 * np.diag([*ocp.q, *ocp.r, *ocp.r_delta]), "vx_e": np.eye(n_x, size),
        "w_e": 2 * case.rti.problem.terminal, "y_ref": np.array([*REFERENCE[0], *case.model.u0, 0.0]),
        "y_ref_e": REFERENCE[0], "u_min": ocp.u_min, "u_max": ocp.u_max, "bounded": bounded,
        "x_min": low[bounded], "x_max": high[bounded],
        "linear": linear[bounded], "quadratic": 2 * quadratic[bounded],
    }  # fmt: skip
    return {"n": ocp.horizon, "dt": case.model.dt, "numbers": {k: v.tolist() for k, v in numbers.items()}}


def cost_of_data(data: Mapping[str, Any], z: Array, u: Array, u_prev: Array) -> float:
    """What a plan costs by the numbers that acados is handed."""
    a, dt = {k: np.array(v) for k, v in data["numbers"].items()}, data["dt"]
    held = np.vstack([u_prev[None], u])
    state = np.hstack([z, held])
    stage = state[:-1] @ a["vx"].T + u @ a["vu"].T - a["y_ref"]
    end = a["vx_e"] @ state[-1] - a["y_ref_e"]
    total = 0.5 * dt * np.einsum("ki,ij,kj", stage, a["w"], stage) + 0.5 * end @ a["w_e"] @ end
    if a["bounded"].size:
        x = z[1:, a["bounded"].astype(int)]
        s = np.maximum(0.0, np.maximum(x - a["x_max"], a["x_min"] - x))
        total += dt * np.sum(s @ a["linear"] + 0.5 * s**2 @ a["quadratic"])
    return float(total)


def check_data(case: Case) -> None:
    """Refuse numbers that cost something else than the library's problem."""
    random, owner = np.random.default_rng(0), case.rti.problem
    for _ in range(5):
        u = random.uniform(-0.5, 0.5, (case.ocp.horizon, 1))
        z = random.normal(size=(case.ocp.horizon + 1, case.model.n_x + case.model.n_h))
        own = owner.cost(z, u, np.array([0.1]), owner.target(REFERENCE))
        other = cost_of_data(problem_data(case), z, u, np.array([0.1]))
        if not abs(own - other) < SAME * own:
            raise SystemExit(f"the library's problem costs {own}, the numbers for acados {other}")


INNER, STEP, WITH_JACOBIAN = (
    f"{NAME}_{what}" for what in ("inner", "dyn_disc_phi_fun", "dyn_disc_phi_fun_jac")
)
WRAPPER = """#include "INNER.c"

static const int shape_state[3] = {STATES, 1, 1}, shape_input[3] = {1, 1, 1}, shape_none[3] = {0, 0, 1};
static const int shape_slopes[3] = {STATES + 1, STATES, 1};
enum {Z = STATES - 1};

int FUNCTION(const double** arg, double** res, int* iw, double* w, void* mem) {
  double *a = w, *b = w + Z * Z, *rest = b + Z;
  const double* given[3 + INNER_SZ_ARG] = {arg[0], arg[0] + N_X, arg[1]};
  double* found[4 + INNER_SZ_RES] = {res[0], res[0] + N_X, a, b};
  (void)mem;
  if (INNER(given, found, iw, rest, 0)) return 1;
  res[0][Z] = arg[1][0];
  for (int i = 0; i < Z; i++) {  /* a column of the transposed Jacobian: by the input, the state, the held input */
    double* column = res[1] + i * (STATES + 1);
    column[0] = b[i];
    for (int j = 0; j < Z; j++) column[1 + j] = a[j * Z + i];
    column[1 + Z] = 0;
  }
  for (int j = 0; j <= STATES; j++) res[1][Z * (STATES + 1) + j] = j == 0;
  return 0;
}

int FUNCTION_work(int* sz_arg, int* sz_res, int* sz_iw, int* sz_w) {
  *sz_arg = 3, *sz_res = 2, *sz_iw = INNER_SZ_IW, *sz_w = INNER_SZ_W + Z * Z + Z;
  return 0;
}
const int* FUNCTION_sparsity_in(int i) { return i == 0 ? shape_state : i == 1 ? shape_input : shape_none; }
const int* FUNCTION_sparsity_out(int i) { return i == 0 ? shape_state : shape_slopes; }
int FUNCTION_n_in(void) { return 3; }
int FUNCTION_n_out(void) { return 2; }
"""
"""The exported Jacobians as acados wants them: transposed, by the input and then the states, the held one last."""


def step_code(case: Case, *, structured: bool, folder: Path) -> list[Path]:
    """C of the step over ``(x, h, held input)``, and with its Jacobian, named and shaped for acados."""
    m = case.model
    state, u, p = ca.MX.sym("state", m.n_x + m.n_h + 1), ca.MX.sym("u"), ca.MX.sym("p", 0)
    point = [ca.MX(v) for v in (state[: m.n_x], state[m.n_x : -1], u, m.w, m.p)]
    following = ca.vertcat(*inlined(m.step if structured else case.plain, point), u)
    files = [generated(ca.Function(STEP, [state, u, p], [following]), folder)]
    if not structured:  # as acados itself generates it
        slopes = ca.jacobian(following, ca.vertcat(u, state)).T
        return [*files, generated(ca.Function(WITH_JACOBIAN, [state, u, p], [following, slopes]), folder)]
    assert m.with_jacobian is not None
    x, h = ca.MX.sym("x", m.n_x), ca.MX.sym("h", m.n_h)
    inner = ca.Function(INNER, [x, h, u], inlined(m.with_jacobian, [x, h, u, ca.MX(m.w), ca.MX(m.p)]))
    generated(inner, folder)
    text = WRAPPER
    for name in ("arg", "res", "iw", "w"):
        text = text.replace(f"INNER_SZ_{name.upper()}", str(getattr(inner, f"sz_{name}")()))
    for name, value in (
        ("FUNCTION", WITH_JACOBIAN),
        ("INNER", INNER),
        ("STATES", state.numel()),
        ("N_X", m.n_x),
    ):
        text = text.replace(name, str(value))
    file = folder / f"{WITH_JACOBIAN}.c"
    file.write_text(text)
    return [*files, file]


def generated(f: ca.Function, folder: Path) -> Path:
    """The C file of a function."""
    writer = ca.CodeGenerator(f.name(), {"casadi_int": "int", "casadi_real": "double"})
    writer.add(f)
    return Path(writer.generate(f"{folder}/"))


def compiled(case: Case, folder: Path, *, structured: bool) -> list[str]:
    """The paths of the compiled model."""
    folder.mkdir(parents=True)
    objects = []
    for file in step_code(case, structured=structured, folder=folder):
        objects.append(str(file.with_suffix(".o")))
        subprocess.run(["cc", "-c", "-fPIC", *ACADOS_FLAGS, str(file), "-o", objects[-1]], check=True)
    return objects


class WorkerError(Exception):
    """What a worker says went wrong."""


class Worker:
    """An acados solver in a process of its own."""

    def __init__(self, python: str, **given: Any) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (the worker's, as long as it lives)
        self._process = subprocess.Popen(
            [python, "-P", str(WORKER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, text=True,
            env=own_environment(),
        )  # fmt: skip
        self.ask("make", **given)

    def ask(self, what: str, **given: Any) -> dict[str, Any]:
        """Its answer to a request."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({"do": what, **given}) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        answer = json.loads(line) if line else {"error": f"it ended with {self._process.wait()}"}
        if "error" in answer:
            self._log.seek(0)
            tail = self._log.read().decode(errors="replace").strip().splitlines()[-3:]
            self.close()
            raise WorkerError(" ".join([answer["error"], *tail]))
        return dict(answer)

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
        self._log.close()


def own_environment() -> dict[str, str]:
    """The environment without the modules that this process sees."""
    return {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}


def why_not(python: str) -> str:
    """Why acados cannot be used from an interpreter; empty if it can."""
    command = [python, "-P", "-c", "import acados.acados_template"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=own_environment(), check=False)
    except OSError as error:
        return f"{python} does not start: {error.strerror}"
    return (done.stderr.strip().splitlines() or ["it does not start"])[-1] if done.returncode else ""


@dataclass(frozen=True)
class Recorded:
    """A QP of the library with the plan it came from, and its answer."""

    hessian: Array
    gradient: Array
    soft: tuple[Array, Array] | None
    u: Array
    z: Array
    plan: Solution
    estimate: Estimate
    answer: Array


def recorded(case: Case) -> list[Recorded]:
    """Some of the QPs of the closed loop, as ``rti`` has them."""
    rti, found = case.rti, []
    plan, handed = rti.initial(case.states[0]), []
    original = rti.qp.solve

    def watched(*given: Any, **more: Any) -> Any:
        handed.append(given)
        return original(*given, **more)

    rti.qp.solve = watched  # type: ignore[method-assign]
    for k, e in enumerate(case.states):
        prepared = rti.prepare(plan)
        answer = rti.finish(prepared, e, REFERENCE)
        hessian, gradient, _, _, soft, *_ = handed[-1]
        if k >= SKIPPED and k % COMPARED == 0:
            soft = None if soft is None else (soft[0].copy(), soft[1].copy())
            found.append(Recorded(
                hessian.copy(), gradient.copy(), soft, prepared.u.copy(), prepared.z.copy(), plan, e, answer.u.copy()
            ))  # fmt: skip
        plan = answer
    rti.qp.solve = original  # type: ignore[method-assign]
    return found


def residual(case: Case, at: Recorded, u: Array, tolerance: float = 1e-5) -> float:
    """Largest residual of the QP's optimality at inputs ``u``.

    A bound within the tolerance may have any multiplier of its sign, a soft one at most its penalty.
    """
    rows, dt = case.rti.problem.soft, case.model.dt
    step = (u - at.u).ravel()
    gradient = at.hessian @ step + at.gradient
    eye, columns, most = np.eye(step.size), [], []
    for side, near in ((-1.0, u.ravel() - case.ocp.u_min), (1.0, case.ocp.u_max - u.ravel())):
        acting = np.flatnonzero(near < tolerance)
        columns += list(side * eye[acting])
        most += [np.inf] * acting.size
    if at.soft is not None:
        value, slope = at.soft[0] + at.soft[1] @ step, at.soft[1]
        for side, excess in ((-1.0, rows.lower - value), (1.0, value - rows.upper)):
            beyond = excess > tolerance
            force = np.where(beyond, dt * (rows.linear + 2 * rows.quadratic * excess), 0.0)
            gradient = gradient + side * force @ slope
            touching = np.flatnonzero(np.abs(excess) <= tolerance)
            columns += list(side * slope[touching])
            most += list(dt * (rows.linear + 2 * rows.quadratic * tolerance)[touching])
    if not columns:
        return float(np.max(np.abs(gradient)))
    found = lsq_linear(np.array(columns).T, -gradient, (0.0, np.array(most)), method="bvls")
    return float(np.max(np.abs(found.fun)))


def answers(case: Case, solver: Any, cases: Sequence[Recorded]) -> tuple[list[Array], list[bool]]:
    """What a solver answers to QPs from the same last plans ``(N, 1)`` each, and whether it says it solved them."""
    if not isinstance(solver, Worker):
        plans = [solver.solve(at.plan, at.estimate, REFERENCE) for at in cases]
        return [plan.u for plan in plans], [plan.status.ok for plan in plans]
    given = []
    for at in cases:
        held = np.concatenate([at.plan.u[0], at.u.ravel()])  # known before a period, the first is now
        x0 = np.concatenate([at.estimate.x, at.estimate.h, at.plan.u[0]])
        z = np.hstack([at.z, held[: len(at.z), None]])
        given.append({"u": at.u.ravel().tolist(), "z": z.tolist(), "x0": x0.tolist()})
    found = solver.ask("replay", cases=given)
    return [np.array(u)[:, None] for u in found["plans"]], found["ok"]


def quality(case: Case, solver: Any, cases: Sequence[Recorded]) -> Measured:
    """How right its answers are."""
    found, ok = answers(case, solver, cases)
    size = max(float(np.max(np.abs(at.gradient))) for at in cases)
    both = list(zip(cases, found, strict=True))
    return {
        "answered": float(np.mean(ok)),
        "KKT": max(residual(case, at, u) for at, u in both) / size,
        "input differs": max(float(np.max(np.abs(u - at.answer))) for at, u in both),
    }


def one_round(case: Case, solver: Any, clock: Clock) -> Measured:
    """Times [ms], solved steps and plans along the states."""
    first = case.rti.initial(case.states[0])
    if isinstance(solver, Worker):
        held = np.full((case.ocp.horizon + 1, 1), first.u[0, 0])
        z = np.hstack([first.x, first.h, held])
        states = [np.concatenate([e.x, e.h]).tolist() for e in case.states]
        found = solver.ask("round", u=first.u.ravel().tolist(), z=z.tolist(), states=states)
        prepared, fed, inner = 1e3 * np.array(found["times"])[SKIPPED:].T
        return {
            "whole": prepared + fed,
            "feedback": fed,
            "QP": inner,
            "ok": found["ok"],
            "plans": found["plans"],
        }
    whole, feedback = times(solver, case.states, 1, clock)
    plan, plans, ok = first, [], []
    for e in case.states:
        plan = solver.solve(plan, e, REFERENCE)
        plans.append(plan.u.ravel().tolist())
        ok.append(plan.status.ok)
    return {"whole": whole, "feedback": feedback, "ok": ok, "plans": plans}


def mean_cost(case: Case, plans: Sequence[Sequence[float]]) -> float:
    """Mean of what the plans cost on the library's model."""
    owner, held, costs = case.rti.problem, case.rti.initial(case.states[0]).u[0], []
    target = owner.target(REFERENCE)
    for e, inputs in zip(case.states, plans, strict=True):
        u = np.clip(np.array(inputs)[:, None], case.ocp.u_min, case.ocp.u_max)
        costs.append(owner.cost(owner.run(np.concatenate([e.x, e.h]), u), u, held, target))
        held = u[0]
    return float(np.mean(costs))


class Acados:
    """Makes acados' solvers of one case."""

    def __init__(self, case: Case, python: str, folder: Path, *, cpu: bool) -> None:
        self.case, self._python, self._cpu = case, python, cpu
        self._data, self._folder, self._number = problem_data(case), folder, 0
        self._objects = {
            kind: compiled(case, folder / kind, structured=kind == "structured")
            for kind in ("plain", "structured")
        }

    def solver(self, kind: str, qp: str, options: Mapping[str, Any]) -> Worker:
        """A solver on the ``plain`` or the ``structured`` model.

        Raises:
            WorkerError: If acados cannot be made ready with these options.
        """
        self._number += 1
        return Worker(
            self._python, **self._data, folder=str(self._folder / str(self._number)), cpu=self._cpu,
            objects=self._objects[kind], compiler="cc", flags=ACADOS_FLAGS, options={"qp_solver": qp, **options},
        )  # fmt: skip

    def best(self, qp: str, cases: Sequence[Recorded]) -> tuple[dict[str, Any] | None, list[Measured]]:
        """The fastest options that answer as the library does, and what was found of all."""
        tried: list[Measured] = []
        for options in CANDIDATES[qp]:
            row: Measured = {"qp": qp, "options": options}
            try:
                worker = self.solver("structured", qp, options)
                found = one_round(self.case, worker, perf_counter)
                row |= quality(self.case, worker, cases) | {"solved": float(np.mean(found["ok"]))}
                row["ms"] = float(np.median(found["whole"]))
                worker.close()
            except WorkerError as error:
                row["error"] = str(error)
            tried.append(row)
        right = [r for r in tried if r.get("input differs", np.inf) < AGREES and r["solved"] == 1.0]
        return (min(right, key=lambda r: float(r["ms"]))["options"] if right else None), tried


def label(qp: str, options: Mapping[str, Any]) -> str:
    """A QP solver with its options, for the table."""
    kind = qp.replace("_CONDENSING_", " ").replace("FULL", "full").replace("PARTIAL", "partial")
    return f"{kind}, cond_N {options['qp_solver_cond_N']}" if "qp_solver_cond_N" in options else kind


def compared(
    z: int, n: int, *, soft: bool, rounds: int, cpu: bool, acados: str | None
) -> tuple[list[Measured], list[Measured]]:
    """Rows of one size, and what was tried of acados' options; ``acados`` is the interpreter that has it."""
    case, clock = made(z, n, soft=soft), process_time if cpu else perf_counter
    check_data(case)
    native = NativeController(case.model, case.ocp)
    alone = {"native, C alone": native}
    if platform.machine() == "x86_64":
        alone["native, C alone, for Haswell"] = NativeController(case.model, case.ocp, flags=HASWELL)
    solvers: dict[str, Any] = {"rti": case.rti, "native": native}
    cases, tried, failed = recorded(case), [], []
    with tempfile.TemporaryDirectory() as folder:
        if acados is not None:
            maker, best = Acados(case, acados, Path(folder), cpu=cpu), {}
            for qp in CANDIDATES:
                best[qp], rows = maker.best(qp, cases)
                tried += [{"z": z, **row} for row in rows]
                if best[qp] is None:
                    failed.append(f"acados, structured, {label(qp, {})}")
            usable = [r for r in tried if r["options"] == best[r["qp"]]]
            for row in usable:
                solvers[f"acados, structured, {label(row['qp'], row['options'])}"] = maker.solver(
                    "structured", row["qp"], row["options"]
                )
            if usable:
                row = min(usable, key=lambda r: float(r["ms"]))
                name = f"acados, plain, {label(row['qp'], row['options'])}"
                solvers[name] = maker.solver("plain", row["qp"], row["options"])
        found: dict[str, list[Measured]] = {name: [] for name in solvers}
        inner: dict[str, list[tuple[Array, Array]]] = {name: [] for name in alone}
        for _ in range(rounds):
            for name, solver in solvers.items():
                found[name].append(one_round(case, solver, clock))
            for name, solver in alone.items():
                inner[name].append(bare(solver, case.states, 1, clock))
        rows = []
        for name, solver in solvers.items():
            kept = [k for k in ("whole", "feedback", "QP") if k in found[name][0]]
            measured: dict[str, Array] = {k: np.concatenate([r[k] for r in found[name]]) for k in kept}
            last = found[name][-1]
            rest = {"solved": float(np.mean(last["ok"])), "cost": mean_cost(case, last["plans"])}
            rest |= quality(case, solver, cases)
            rows.append({"z": z, "solver": name, **statistics(measured), **rest})
            if solver is native:
                for kind, spent in inner.items():
                    whole, feedback = (np.concatenate(v) for v in zip(*spent, strict=True))
                    bare_row = statistics({"whole": whole, "feedback": feedback})
                    rows.append({"z": z, "solver": kind, **bare_row, **rest})
            if isinstance(solver, Worker):
                solver.close()
    empty = statistics({k: np.full(1, np.nan) for k in ("whole", "feedback", "QP")})
    none = dict.fromkeys(("solved", "cost", "answered", "KKT", "input differs"), float("nan"))
    return rows + [{"z": z, "solver": name, **empty, **none} for name in failed], tried


def statistics(measured: Mapping[str, Array]) -> Measured:
    """Medians and 99th percentiles."""
    row: Measured = {}
    for what in ("whole", "feedback"):
        row |= {f"{what} [ms]": float(np.median(measured[what]))}
        row |= {f"{what} p99": float(np.percentile(measured[what], 99))}
    row["QP [ms]"] = float(np.median(measured["QP"])) if "QP" in measured else float("nan")
    return row


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32, 64, 128], help="hidden units")
    parser.add_argument("--n", type=int, default=50, help="horizon")
    parser.add_argument("--rounds", type=int, default=5, help="times that the solvers take turns")
    parser.add_argument("--soft", action="store_true", help="two soft bounds on states")
    parser.add_argument("--cpu", action="store_true", help="processor time instead of the wall clock's")
    parser.add_argument("--acados", default=sys.executable, help="Python of the environment that has acados")
    given = parser.parse_args()
    reason = why_not(given.acados)
    rows, tried = [], []
    load = [round(v, 1) for v in os.getloadavg()]
    for z in given.z:
        acados = None if reason else given.acados
        more, options = compared(
            z, given.n, soft=given.soft, rounds=given.rounds, cpu=given.cpu, acados=acados
        )
        rows += more
        tried += options
    load += [round(v, 1) for v in os.getloadavg()]
    flags = {"native": " ".join(FLAGS), "acados": " ".join(ACADOS_FLAGS)}
    report(
        rows,
        given.out,
        soft=given.soft,
        cpu=given.cpu,
        tried=tried,
        flags=flags,
        load=load,
        without_acados=reason,
    )
    if reason:
        print(f"\nacados is left out: {reason}")


if __name__ == "__main__":
    main()
