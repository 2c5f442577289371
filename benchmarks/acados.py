"""Real-time iterations of acados and of hybrid-mpc's generated C on the same control problem, both driven from C.

    python benchmarks/acados.py --acados PREFIX

``PREFIX`` is an installation of acados with HPIPM and DAQP. It is built by (``X64_AUTOMATIC`` finds the processor):

    git clone --recurse-submodules https://github.com/acados/acados && mkdir acados/build && cd acados/build
    cmake .. -DACADOS_WITH_DAQP=ON -DBLASFEO_TARGET=X64_AUTOMATIC -DHPIPM_TARGET=AVX -DCMAKE_C_FLAGS="-O3 -march=native"
    make install

``PREFIX`` is then the checkout, whose version is printed. The problem: the golf robot with a GRU of random weights,
N = 50, a bounded input; then the same with two soft bounds on states that act.

- One closed loop is recorded. At each of its states every solver gets the same last plan, shifted by a period, and the
  same measured state: each solves the same QP. A solver takes all states in order, the solvers take turns.
- A C program (``acados_driver.c``) calls both, with one thread, and takes processor time. ``whole``: preparation,
  feedback and what remains of the period; ``feedback``: from the measured state to the plan. Medians. What hands plans
  and states to acados is not timed.
- All C has the flags ``FLAGS``: the driver, hybrid-mpc's C and the model for acados. acados itself has those of its own
  build.
- acados: ``SQP_RTI`` with linear least squares; the held input is one more state. The model: the exported Jacobians, or
  those that CasADi derives from the model as a graph of matrices. HPIPM with partial condensing to N2 stages and with
  full condensing, DAQP with full condensing; of each the fastest of ``OPTIONS`` whose plans agree. qpOASES is left
  out: in an older release its plans with slacks were up to 0.33 Nm off with the status success.
- ``differs``: largest difference of an input from the plan of the controller in Python, over all states. Below ``SAME``
  for hybrid-mpc, else the script fails. Below ``AGREES`` for acados, else options are not chosen; a variant without
  any is left out, and without variants the script fails.
- Ratios take acados' fastest variant, for the whole period and for the feedback each.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from native import SOFT
from numpy.typing import NDArray
from parts import REFERENCE, SKIPPED, arguments, closed_loop, deployed, hybrid_step, problem, report

import nn_export
from hybrid_mpc import OCP, CondensedController, Estimate, HybridModel, trace_model
from hybrid_mpc.embedded.generate import make_sources, template
from hybrid_mpc.embedded.native import one_file
from hybrid_mpc.model.model import inlined

Array = NDArray[np.float64]
Row = dict[str, Any]
DRIVER = Path(__file__).with_name("acados_driver.c")
FLAGS = ("-std=gnu11", "-O3", "-march=native")
COST_TOLERANCE = 1e-9
"""Largest relative difference between what acados' numbers and the library's problem say that a plan costs."""
SAME = 1e-9
"""Largest difference [Nm] of plans of hybrid-mpc in C and in Python: one algorithm, rounded in another order."""
AGREES = 1e-3
"""Largest difference [Nm] of acados' plans, 0.1 % of the range. Its QP solvers stop at residuals of ``TOLERANCE``, and
are up to 8e-4 Nm off; options that solve another problem are 7e-3 Nm and more off."""
TOLERANCE = 1e-6
"""Residuals at which acados' QP solvers stop: the default of its Python interface."""
HORIZONS = (1, 2, 5, 10)
MODES = ("SPEED", "BALANCE")
OPTIONS: dict[str, list[str]] = {
    **{
        f"partial condensing HPIPM, N2 = {n2}": [
            f"partial,{n2},{mode},{warm},0" for mode, warm in product(MODES, (0, 2))
        ]
        for n2 in HORIZONS
    },
    "full condensing HPIPM": [
        f"full,0,{mode},{warm},{ric}" for mode, warm, ric in product(MODES, (0, 2), (0, 1))
    ],
    "full condensing DAQP": [f"daqp,0,SPEED,{warm},{ric}" for warm, ric in product((0, 1), (0, 1))],
}
"""What the driver takes of each variant: QP solver, N2, mode of HPIPM, warm start, 1: condensed by a Riccati recursion.
Partial condensing by a Riccati recursion is not among them: its plans are up to 0.14 Nm off at z = 16."""
MODELS = {"exported": "exported Jacobians", "casadi": "CasADi's derivatives"}
NATIVE = "hybrid-mpc, C alone"
HOW = """Build acados (0.6.0 or later) once and name its installation:

    git clone --recurse-submodules https://github.com/acados/acados && mkdir acados/build && cd acados/build
    cmake .. -DACADOS_WITH_DAQP=ON -DBLASFEO_TARGET=X64_AUTOMATIC -DHPIPM_TARGET=AVX -DCMAKE_C_FLAGS="-O3 -march=native"
    make install
    python benchmarks/acados.py --acados .../acados"""
LIBRARIES = ("acados", "hpipm", "blasfeo", "daqp")


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


def problem_data(case: Case) -> dict[str, Array]:
    """The problem as acados takes it: linear least squares over ``(x, h, held input)`` and ``u``, one input.

    Penalties of the last state (``_e``) have the period in them: acados multiplies those of the others by it.
    """
    ocp, n_x, size = case.ocp, case.model.n_x, case.model.n_x + case.model.n_h + 1
    vx, vu = np.zeros((n_x + 2, size)), np.zeros((n_x + 2, 1))
    vx[:n_x, :n_x], vx[n_x + 1, -1], vu[n_x:] = np.eye(n_x), -1.0, 1.0
    linear, quadratic = ocp.penalties
    low, high = (np.full(n_x, np.inf) if v is None else v for v in (ocp.x_min, ocp.x_max))
    bounded = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    linear, quadratic = linear[bounded], 2 * quadratic[bounded]
    return {
        "reference": REFERENCE, "vx": vx, "vu": vu, "w": 2 * np.diag([*ocp.q, *ocp.r, *ocp.r_delta]),
        "vx_e": np.eye(n_x, size), "w_e": 2 * case.rti.problem.terminal,
        "y_ref": np.array([*REFERENCE[0], *case.model.u0, 0.0]), "y_ref_e": REFERENCE[0],
        "u_min": ocp.u_min, "u_max": ocp.u_max, "bounded": bounded, "x_min": low[bounded], "x_max": high[bounded],
        "linear": linear, "quadratic": quadratic,
        "linear_e": case.model.dt * linear, "quadratic_e": case.model.dt * quadratic,
    }  # fmt: skip


def cost_of_data(a: Mapping[str, Array], dt: float, z: Array, u: Array, u_prev: Array) -> float:
    """What a plan costs by the numbers that acados is handed."""
    held = np.vstack([u_prev[None], u])
    state = np.hstack([z, held])
    stage = state[:-1] @ a["vx"].T + u @ a["vu"].T - a["y_ref"]
    end = a["vx_e"] @ state[-1] - a["y_ref_e"]
    total = 0.5 * dt * np.einsum("ki,ij,kj", stage, a["w"], stage) + 0.5 * end @ a["w_e"] @ end
    x = z[:, a["bounded"]]
    s = np.maximum(0.0, np.maximum(x - a["x_max"], a["x_min"] - x))
    total += dt * np.sum(s[1:-1] @ a["linear"] + 0.5 * s[1:-1] ** 2 @ a["quadratic"])
    return float(total + s[-1] @ a["linear_e"] + 0.5 * s[-1] ** 2 @ a["quadratic_e"])


def check_data(case: Case) -> None:
    """Refuse numbers that cost something else than the library's problem."""
    random, owner = np.random.default_rng(0), case.rti.problem
    for _ in range(5):
        u = random.uniform(-0.5, 0.5, (case.ocp.horizon, 1))
        z = random.normal(size=(case.ocp.horizon + 1, case.model.n_x + case.model.n_h))
        own = owner.cost(z, u, np.array([0.1]), owner.target(REFERENCE))
        other = cost_of_data(problem_data(case), case.model.dt, z, u, np.array([0.1]))
        if not abs(own - other) < COST_TOLERANCE * own:
            raise SystemExit(f"the library's problem costs {own}, the numbers for acados {other}")


EXPORTED_SLOPE = """#include "casadi.c"

static const int shape_state[3] = {NX + NH + 1, 1, 1}, shape_input[3] = {1, 1, 1};
static const int shape_slopes[3] = {NX + NH + 2, NX + NH + 1, 1};

int exported_slope(const double** arg, double** res, int* iw, double* w, void* mem) {
  enum { Z = NX + NH };
  double *a = w, *b = w + Z * Z, *rest = b + Z;
  const double* given[3 + INNER_SZ_ARG] = {arg[0], arg[0] + NX, arg[1]};
  double* found[4 + INNER_SZ_RES] = {res[0], res[0] + NX, a, b};
  (void)mem;
  if (inner(given, found, iw, rest, 0)) return 1;
  res[0][Z] = arg[1][0];
  for (int i = 0; i < Z; i++) { /* a column of the transposed Jacobian: by the input, the state, the held input */
    double* column = res[1] + i * (Z + 2);
    column[0] = b[i];
    for (int j = 0; j < Z; j++) column[1 + j] = a[j * Z + i];
    column[1 + Z] = 0;
  }
  for (int j = 0; j < Z + 2; j++) res[1][Z * (Z + 2) + j] = j == 0;
  return 0;
}
int exported_slope_work(int* sz_arg, int* sz_res, int* sz_iw, int* sz_w) {
  *sz_arg = 2, *sz_res = 2, *sz_iw = INNER_SZ_IW, *sz_w = INNER_SZ_W + (NX + NH) * (NX + NH + 1);
  return 0;
}
const int* exported_slope_sparsity_in(int i) { return i == 0 ? shape_state : shape_input; }
const int* exported_slope_sparsity_out(int i) { return i == 0 ? shape_state : shape_slopes; }
int exported_slope_n_in(void) { return 2; }
int exported_slope_n_out(void) { return 2; }
"""
"""The exported Jacobians as acados wants them: transposed, by the input and then the states, the held one last."""


def write_model(case: Case, folder: Path) -> None:
    """``model.c``: the step over ``(x, h, held input)`` and its Jacobians, exported and CasADi's, as acados takes them.

    A Jacobian is transposed: rows by the input and then the states. CasADi's is dense, since acados reads dense ones
    faster.
    """
    m = case.model
    state, u = ca.MX.sym("state", m.n_x + m.n_h + 1), ca.MX.sym("u")
    point = [ca.MX(v) for v in (state[: m.n_x], state[m.n_x : -1], u, m.w, m.p)]
    plain = ca.vertcat(*inlined(case.plain, point), u)
    slopes = ca.densify(ca.jacobian(plain, ca.vertcat(u, state)).T)
    assert m.with_jacobian is not None
    x, h = ca.MX.sym("x", m.n_x), ca.MX.sym("h", m.n_h)
    inner = ca.Function("inner", [x, h, u], inlined(m.with_jacobian, [x, h, u, ca.MX(m.w), ca.MX(m.p)]))
    writer = ca.CodeGenerator("casadi", {"casadi_int": "int", "casadi_real": "double"})
    writer.add(ca.Function("next_state", [state, u], [ca.vertcat(*inlined(m.step, point), u)]))
    writer.add(ca.Function("casadi_slope", [state, u], [plain, slopes]))
    writer.add(inner)
    writer.generate(f"{folder}/")
    text = f"enum {{ NX = {m.n_x}, NH = {m.n_h} }};\n{EXPORTED_SLOPE}"
    for name in ("arg", "res", "iw", "w"):
        text = text.replace(f"INNER_SZ_{name.upper()}", str(getattr(inner, f"sz_{name}")()))
    (folder / "model.c").write_text(text)


def write_case(case: Case, folder: Path) -> None:
    """``case.h`` with the problem's numbers (matrices column by column), ``records`` and hybrid-mpc's C."""
    m, data = case.model, problem_data(case)
    n_b = data["bounded"].size
    lines = [
        f"enum {{ N = {case.ocp.horizon}, NX = {m.n_x}, NH = {m.n_h}, BOUNDED = {n_b}, STEPS = {len(case.states)} }};"
    ]
    lines += [f"static const int bounded[] = {{{', '.join(str(v) for v in [*data['bounded'], 0])}}};"]
    lines += [f"static const double dt = {m.dt!r}, tolerance = {TOLERANCE!r};"]
    for name, value in data.items():
        if name != "bounded":
            numbers = ", ".join(repr(float(v)) for v in np.append(np.ravel(value, order="F"), 0.0))
            lines.append(f"static const double {name}[] = {{{numbers}}};")
    (folder / "case.h").write_text("\n".join([*lines, ""]))
    records(case).tofile(folder / "records")
    sources = make_sources(m, case.ocp)
    (folder / "native.c").write_text(one_file(sources.texts))
    for name, text in {**sources.texts, "hmpc.h": template("hmpc.h")}.items():
        if name.endswith(".h"):
            (folder / name).write_text(text)


def records(case: Case) -> Array:
    """What the driver reads, a row a state: last plan's inputs and states, appended state, measured state, answer."""
    rti, rows = case.rti, []
    plan = rti.initial(case.states[0])
    for e in case.states:
        prepared = rti.prepare(plan)
        answer = rti.finish(prepared, e, REFERENCE)
        if not answer.status.ok:
            raise SystemExit(f"the controller in Python does not solve its problem: {answer.status}")
        z = np.hstack([plan.x, plan.h])
        rows.append(np.concatenate([plan.u.ravel(), z.ravel(), prepared.z[-1], e.x, e.h, answer.u.ravel()]))
        plan = answer
    return np.array(rows)


class DriverError(Exception):
    """What the driver or the compiler says went wrong."""


@dataclass(frozen=True)
class Driver:
    """The C program of one case, with acados where an installation is named."""

    folder: Path
    prefix: Path | None

    @staticmethod
    def build(case: Case, folder: Path, prefix: Path | None, flags: Sequence[str] = FLAGS) -> Driver:
        """Write the C of a case into the folder and compile it."""
        write_case(case, folder)
        command = ["cc", *flags, f"-I{folder}", str(DRIVER), str(folder / "native.c")]
        if prefix is not None:
            write_model(case, folder)
            include = prefix / "include"
            places = (include, include / "acados", include / "blasfeo/include", include / "hpipm/include")
            command += [
                "-DWITH_ACADOS",
                "-DACADOS_WITH_DAQP",
                str(folder / "model.c"),
                *(f"-I{place}" for place in places),
            ]
            command += [
                f"-L{prefix / 'lib'}",
                f"-Wl,-rpath,{prefix / 'lib'}",
                *(f"-l{name}" for name in LIBRARIES),
            ]
        told([*command, "-lm", "-o", str(folder / "driver")])
        return Driver(folder, prefix)

    def run(self, solvers: Sequence[str], rounds: int) -> list[Row]:
        """Of each solver: times ``whole`` and ``feedback`` [ms], what plans differ by [Nm], the share of solved ones.

        Raises:
            DriverError: If the program fails.
        """
        environment = dict(os.environ)
        if self.prefix is not None:  # acados' libraries do not say where those that they need lie
            environment["LD_LIBRARY_PATH"] = f"{self.prefix / 'lib'}:{environment.get('LD_LIBRARY_PATH', '')}"
        words = [str(self.folder / name) for name in ("driver", "records", "results")]
        told([*words, str(rounds), *solvers], environment)
        found = np.loadtxt(self.folder / "results")
        rows = []
        for index in range(len(solvers)):
            own = found[found[:, 0] == index]
            counted = own[own[:, 1] >= SKIPPED]
            whole, feedback = 1e3 * counted[:, 2:5].sum(axis=1), 1e3 * counted[:, 3]
            rows.append({
                "whole": float(np.median(whole)), "feedback": float(np.median(feedback)),
                "differs": float(np.max(own[:, 5])), "solved": float(np.mean(own[:, 6] == 0)),
            })  # fmt: skip
        return rows


def told(command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
    """Run a program; its last words where it fails."""
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        words = (done.stderr.strip() or done.stdout.strip()).splitlines()[-8:]
        raise DriverError("\n".join([f"{command[0]} ends with code {done.returncode}", *words]))


def version_of(prefix: Path) -> str:
    """The version of an installation: ``git describe`` where it is a checkout, else the commit that its build wrote."""
    top = subprocess.run(
        ["git", "-C", str(prefix), "rev-parse", "--show-toplevel"],
        capture_output=True,
        text=True,
        check=False,
    )
    if top.returncode == 0 and Path(top.stdout.strip()).resolve() == prefix.resolve():
        command = ["git", "-C", str(prefix), "describe", "--tags", "--always"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    commit = prefix / "lib" / "git_commit_hash"
    return f"commit {commit.read_text().strip()}" if commit.is_file() else "unknown: no checkout"


def lacks(prefix: Path) -> list[str]:
    """What an installation of acados lacks."""
    lib = prefix / "lib"
    missing = (
        []
        if (prefix / "include/acados_c/ocp_nlp_interface.h").is_file()
        else ["include/acados_c/ocp_nlp_interface.h"]
    )
    return missing + [f"lib/lib{name}" for name in LIBRARIES if not list(lib.glob(f"lib{name}.*"))]


def agrees(row: Row) -> bool:
    """Whether a variant of acados solved the same problem at every state."""
    return bool(row["differs"] < AGREES and row["solved"] == 1.0)


def chosen(driver: Driver, n: int) -> tuple[dict[str, str], list[Row]]:
    """Of each variant the fastest options whose plans agree, if any do, and what was measured of all."""
    every = [(variant, options) for variant, candidates in OPTIONS.items() for options in candidates]
    every = [(variant, options) for variant, options in every if int(options.split(",")[1]) <= n]
    found = driver.run([f"exported,{options}" for _, options in every], 1)
    tried = [
        {"variant": v, "options": options, **row} for (v, options), row in zip(every, found, strict=True)
    ]
    best: dict[str, str] = {}
    for row in sorted(filter(agrees, tried), key=lambda row: float(row["whole"])):
        best.setdefault(row["variant"], row["options"])
    return best, tried


def compared(
    z: int, n: int, *, soft: bool, rounds: int, prefix: Path, flags: Sequence[str]
) -> tuple[list[Row], Row, list[Row]]:
    """Rows of one size and set of bounds, the ratios, and what was tried of acados' options."""
    case = made(z, n, soft=soft)
    check_data(case)
    with tempfile.TemporaryDirectory() as folder:
        driver = Driver.build(case, Path(folder), prefix, flags)
        best, tried = chosen(driver, n)
        names = {"native": NATIVE}
        for (variant, options), (model, what) in product(best.items(), MODELS.items()):
            names[f"{model},{options}"] = f"acados, {variant}, {what}"
        found = driver.run(list(names), rounds)
    kind: Row = {"z": z, "soft bounds": 2 if soft else 0}
    rows, right = [], []
    for (options, name), row in zip(names.items(), found, strict=True):
        shown = {"whole [ms]": row["whole"], "feedback [ms]": row["feedback"], "differs [Nm]": row["differs"]}
        rows.append({**kind, "solver": name, "options": options, **shown, "solved": row["solved"]})
        if options != "native" and agrees(row):
            right.append(rows[-1])
    native = rows[0]
    if not (native["differs [Nm]"] < SAME and native["solved"] == 1.0):
        raise SystemExit(f"hybrid-mpc's C does not find the plan of the controller in Python: {native}")
    if not right:
        raise SystemExit(f"no variant of acados solves the same problem at z = {z}: {tried}")
    ratio = dict(kind)
    for what in ("whole", "feedback"):
        fastest = min(right, key=lambda row: float(row[f"{what} [ms]"]))
        ratio[f"{what}: acados / hybrid-mpc"] = fastest[f"{what} [ms]"] / native[f"{what} [ms]"]
        ratio[f"{what}: fastest of acados"] = fastest["solver"].removeprefix("acados, ")
    return rows, ratio, [{**kind, **row} for row in tried]


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument(
        "--acados", type=Path, help="installation of acados: the folder that has include and lib"
    )
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32, 64, 128], help="sizes of the network")
    parser.add_argument("--n", type=int, default=50, help="horizon")
    parser.add_argument("--rounds", type=int, default=3, help="times that the solvers take turns")
    parser.add_argument(
        "--flags", default=" ".join(FLAGS), help="of the compiler, for all C that is compiled here"
    )
    given = parser.parse_args()
    if given.acados is None:
        raise SystemExit(f"--acados is missing: the comparison needs acados. {HOW}")
    missing = lacks(given.acados)
    if missing:
        raise SystemExit(f"--acados {given.acados}: no {', no '.join(missing)} in it. {HOW}")
    version = version_of(given.acados)
    print(f"acados {version}; compiler flags {given.flags}")
    rows: list[Row] = []
    ratios: list[Row] = []
    tried: list[Row] = []
    load = [round(v, 1) for v in os.getloadavg()]
    for soft, z in product((False, True), given.z):
        more, ratio, options = compared(
            z,
            given.n,
            soft=soft,
            rounds=given.rounds,
            prefix=given.acados.resolve(),
            flags=given.flags.split(),
        )
        rows, ratios, tried = rows + more, [*ratios, ratio], tried + options
    load += [round(v, 1) for v in os.getloadavg()]
    report([*rows, *ratios], given.out, acados=version, flags=given.flags, tried=tried, load=load)


if __name__ == "__main__":
    main()
