"""One acados solver in a process of its own, for ``acados.py``, which says what it is asked.

acados and CasADi's plugins carry libraries of the same names, so that both cannot be loaded into one process. It runs
in acados' own environment and imports nothing of the library. A request is a line of JSON on the standard input, its
answer a line on the standard output; all else that is printed goes to the standard error.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from time import perf_counter, process_time
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NAME = "golf"
PREPARATION, FEEDBACK = 1, 2
LIBRARIES = ("-lacados", "-lhpipm", "-lblasfeo", "-lqpOASES_e", "-lm")


def formulated(module: ModuleType, given: dict[str, Any]) -> Any:
    """The problem as acados states it; ``given`` is what ``acados.problem_data`` returns, with ``options``."""
    import casadi as ca

    ocp, numbers = module.AcadosOcp(), {k: np.array(v) for k, v in given["numbers"].items()}
    size, n = numbers["vx"].shape[1], given["n"]
    x, u = ca.SX.sym("x", size), ca.SX.sym("u")
    ocp.model.name, ocp.model.x, ocp.model.u = NAME, x, u
    ocp.model.disc_dyn_expr = x  # the C code is made elsewhere; of this only the size counts
    ocp.dims.N, cost, limits, options = n, ocp.cost, ocp.constraints, ocp.solver_options
    cost.cost_type = cost.cost_type_e = "LINEAR_LS"
    cost.Vx, cost.Vu, cost.W, cost.yref = (numbers[k] for k in ("vx", "vu", "w", "y_ref"))
    cost.Vx_e, cost.W_e, cost.yref_e = (numbers[k] for k in ("vx_e", "w_e", "y_ref_e"))
    limits.x0 = np.zeros(size)
    limits.lbu, limits.ubu, limits.idxbu = numbers["u_min"], numbers["u_max"], np.arange(1)
    bounded = numbers["bounded"].astype(int)
    if bounded.size:
        limits.idxbx = limits.idxbx_e = bounded
        limits.lbx = limits.lbx_e = numbers["x_min"]
        limits.ubx = limits.ubx_e = numbers["x_max"]
        limits.idxsbx = limits.idxsbx_e = np.arange(bounded.size)
        cost.zl = cost.zu = numbers["linear"]
        cost.Zl = cost.Zu = numbers["quadratic"]
        # acados multiplies stages by dt, the end by 1
        cost.zl_e = cost.zu_e = given["dt"] * numbers["linear"]
        cost.Zl_e = cost.Zu_e = given["dt"] * numbers["quadratic"]
    options.tf = n * given["dt"]
    options.integrator_type, options.nlp_solver_type = "DISCRETE", "SQP_RTI"
    options.hessian_approx = "GAUSS_NEWTON"  # the cost is quadratic: this is its own Hessian
    for name, value in given["options"].items():
        setattr(options, name, value)
    return ocp


class Solver:
    """An acados solver made from the C code of the model in ``given["objects"]``."""

    def __init__(self, given: dict[str, Any]) -> None:
        acados: Any = import_module("acados")  # the package, not the script of that name beside this one
        os.environ["ACADOS_SOURCE_DIR"], os.environ["TERA_PATH"] = acados.DIR, acados.TERA_PATH
        os.environ["ACADOS_PYTHON_INTERFACE_PATH"] = acados.TEMPLATE_DIR
        for name in ("blasfeo", "hpipm", "qpOASES_e", "acados"):  # they do not know where the others lie
            ctypes.CDLL(f"{acados.LIB_DIR}/lib{name}.so", ctypes.RTLD_GLOBAL)
        module = import_module("acados.acados_template")
        maker: Any = import_module("acados.acados_template.acados_ocp_solver")
        folder = Path(given["folder"])
        folder.mkdir(parents=True, exist_ok=True)
        os.chdir(folder)  # acados writes beside its process
        ocp = formulated(module, given)
        ocp.acados_include_path, ocp.acados_lib_path = acados.INCLUDE_DIR, acados.LIB_DIR
        ocp.code_export_directory, description = str(folder / "code"), str(folder / "ocp.json")
        maker.ocp_generate_external_functions = lambda *_: (folder / "code" / f"{NAME}_model").mkdir(
            parents=True, exist_ok=True
        )
        module.AcadosOcpSolver.generate(ocp, json_file=description)
        self._compile(folder / "code", Path(acados.INCLUDE_DIR), acados.LIB_DIR, given)
        self.acados = module.AcadosOcpSolver(ocp, json_file=description, build=False, generate=False)
        self._solve = getattr(self.acados.shared_lib, f"{NAME}_acados_solve")  # solve() sets its types
        self._n, self._clock = given["n"], process_time if given["cpu"] else perf_counter

    @staticmethod
    def _compile(code: Path, include: Path, libraries: str, given: dict[str, Any]) -> None:
        folders = (
            include,
            include / "acados",
            *(include / name for name in ("blasfeo/include", "hpipm/include")),
        )
        command = [given["compiler"], "-shared", "-fPIC", "-DACADOS_WITH_QPOASES", *given["flags"]]
        command += [f"acados_solver_{NAME}.c"]
        command += [*given["objects"], "-I.", *(f"-I{f}" for f in (*folders, include / "qpOASES_e"))]
        command += [
            f"-L{libraries}",
            f"-Wl,-rpath,{libraries}",
            *LIBRARIES,
            "-o",
            f"libacados_ocp_solver_{NAME}.so",
        ]
        subprocess.run(command, cwd=code, check=True, stdout=sys.stderr)

    def step(self, u: Array, z: Array, x0: Array) -> tuple[float, float, float, int]:
        """A real-time iteration along ``u`` ``(N,)``, ``z`` ``(N + 1, n)``: preparation, feedback, QP [s]; status.

        What is handed over before each is not in the times.
        """
        solver = self.acados
        for k in range(self._n):
            solver.set(k, "x", z[k])
            solver.set(k, "u", u[k : k + 1])
        solver.set(self._n, "x", z[-1])
        solver.options_set("rti_phase", PREPARATION)
        start = self._clock()
        self._solve(solver.capsule)
        prepared = self._clock() - start
        solver.set(0, "lbx", x0)
        solver.set(0, "ubx", x0)
        solver.options_set("rti_phase", FEEDBACK)
        start = self._clock()
        status = self._solve(solver.capsule)
        fed = self._clock() - start
        return prepared, fed, float(solver.get_stats("time_qp_solver_call")[0]), int(status)

    def plan(self) -> tuple[Array, Array]:
        """Inputs and states of the last step."""
        u = np.array([self.acados.get(k, "u")[0] for k in range(self._n)])
        return u, np.array([self.acados.get(k, "x") for k in range(self._n + 1)])

    def round(self, given: dict[str, Any]) -> dict[str, Any]:
        """A closed loop's states, each from the last plan, shifted by a period."""
        u, z = np.array(given["u"]), np.array(given["z"])
        times, plans, ok = [], [], []
        for state in np.array(given["states"]):
            held = u[0]
            ahead, guess = np.append(u[1:], u[-1]), np.vstack([z[1:], z[-1:]])
            *spent, status = self.step(ahead, guess, np.append(state, held))
            u, z = self.plan()
            solved = status == 0 and bool(np.all(np.isfinite(u)) and np.all(np.isfinite(z)))
            if not solved:  # as the library does: the shifted plan is kept
                u, z = ahead, guess
            times.append(spent)
            plans.append(u.tolist())
            ok.append(solved)
        return {"times": times, "plans": plans, "ok": ok}

    def replay(self, given: dict[str, Any]) -> dict[str, Any]:
        """Answers from plans that are handed over."""
        plans, ok = [], []
        for case in given["cases"]:
            *_, status = self.step(*(np.array(case[k]) for k in ("u", "z", "x0")))
            plans.append(self.plan()[0].tolist())
            ok.append(status == 0)
        return {"plans": plans, "ok": ok}


def main() -> None:
    """Answer until the input ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # acados and the compiler print too
    solver: Solver | None = None
    for line in sys.stdin:
        given = json.loads(line)
        try:
            if given["do"] == "make":
                solver, answer = Solver(given), {}
                solver.acados.solve()
            else:
                answer = getattr(solver, given["do"])(given)
        except Exception as error:  # whatever acados' old template raises belongs into the report
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
