"""Against do-mpc: ``python benchmarks/mpc_rivals.py [--out rivals.json] [--z 32] [--n 50] [--rounds 2]``.

do-mpc (https://www.do-mpc.com, extra ``bench``) solves the problem of ``mpc_step.py`` (golf robot's hybrid model with
random weights, |u| bounded, no other bounds) along the same states, by turns with the library's solvers, each
warm-started from its own last plan; whole Python calls, medians of processor time [ms], the first three solves of a
round not counted.

do-mpc sees a discrete model (``model_type="discrete"``): the hidden state steps once a period, so there is nothing
for its collocation to discretise, and the NLP is that of ``IpoptController``: multiple shooting over (x, h), exact
Hessian. Its settings: MX, IPOPT's default barrier or (``warm``) monotone from 1e-3, tolerance 1e-9 as there, MUMPS,
the full solution not stored; its last solution, which it does not shift, is its guess. That both solve the same problem
is checked: the plans' costs on the library's own model must agree to 1e-6. The faster variant counts.

Without do-mpc the script says so and ends; nothing else of the project needs it.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import warnings
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time

import casadi as ca
import numpy as np
from mpc_step import GOAL, RIVAL_PERIODS, hybrid, problem, record, timed

from hybrid_mpc import CondensedController, IpoptController, SQPController, Status

SAME = 1e-6
"""Largest relative difference of two solvers' costs of the same problem."""


class DoMpc:
    """do-mpc's controller behind the calls that ``timed`` makes."""

    def __init__(self, model, ocp, **ipopt):
        import do_mpc

        n_x = model.n_x
        self._own = IpoptController(model, ocp)  # first plan, terminal weight, cost of a plan
        plant = do_mpc.model.Model("discrete", "MX")
        z, u = (
            plant.set_variable("_x", "z", (n_x + model.n_h, 1)),
            plant.set_variable("_u", "u", (model.n_u, 1)),
        )
        x_next, h_next = model.step(z[:n_x], z[n_x:], u, model.w, model.p)
        plant.set_rhs("z", ca.vertcat(x_next, h_next))
        plant.setup()
        mpc = do_mpc.controller.MPC(plant)
        mpc.settings.n_horizon, mpc.settings.t_step = ocp.horizon, model.dt
        mpc.settings.store_full_solution, mpc.settings.store_lagr_multiplier = False, False
        options = {"print_level": 0, "sb": "yes", "tol": 1e-9, **ipopt}
        mpc.settings.nlpsol_opts = {"print_time": False, **{f"ipopt.{k}": v for k, v in options.items()}}
        z, u, p = plant.x["z"], plant.u["u"], self._own.problem.terminal
        error = z[:n_x] - np.array([GOAL, 0.0])
        stage = model.dt * (sum(q * error[i] ** 2 for i, q in enumerate(ocp.q)) + ocp.r[0] * u**2)
        mpc.set_objective(lterm=stage, mterm=error.T @ p @ error)
        mpc.set_rterm(u=model.dt * float(ocp.r_delta[0]))
        mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = ocp.u_min, ocp.u_max
        mpc.setup()
        self.mpc, self.ocp = mpc, ocp

    def initial(self, e):
        """A first plan: the model at rest from the estimate, as the library's controllers have it."""
        plan = self._own.initial(e)
        self.mpc.reset_history()
        self.mpc.u0 = plan.u[0]
        self.mpc.x0 = np.concatenate([e.x, e.h])
        self.mpc.set_initial_guess()
        for k, z in enumerate(np.hstack([plan.x, plan.h])):
            self.mpc.opt_x_num["_x", k, 0, -1] = z
        return plan

    def solve(self, previous, e, reference):
        """The plan; of its fields beside the inputs only cost and status are filled in."""
        z = np.concatenate([e.x, e.h])
        u_prev = np.array(self.mpc.u0.cat).ravel()
        self.mpc.make_step(z)
        u = np.array([np.array(v).ravel() for v in self.mpc.opt_x_num["_u", :, 0]])
        stats = self.mpc.solver_stats
        status = Status.SOLVED if stats["success"] else Status.STOPPED
        self._last = z, u, u_prev
        return replace(previous, u=u, status=status, iterations=stats["iter_count"])

    def cost(self, reference):
        """Cost of the last plan on the library's model."""
        z0, u, u_prev = self._last
        problem = self._own.problem
        return problem.cost(problem.run(z0, u), u, u_prev, problem.target(reference))


def against(z: int, n: int, rounds: int) -> dict[str, float]:
    """All solvers by turns at one size."""
    model, ocp = hybrid(z), problem(n)
    variants = {"": {}, "_warm": {"mu_strategy": "monotone", "mu_init": 1e-3}}
    begin = perf_counter()
    rivals = {f"do_mpc{name}": DoMpc(model, ocp, **options) for name, options in variants.items()}
    build = (perf_counter() - begin) / len(rivals)
    solvers = {
        "rti": CondensedController(model, ocp), "sqp": SQPController(model, ocp),
        **{f"ipopt{name}": IpoptController(model, ocp, options=options) for name, options in variants.items()},
        **rivals,
    }  # fmt: skip
    row, plans = timed(solvers, record(model, ocp)[:RIVAL_PERIODS], process_time, rounds)
    cost = {name: rival.cost(np.array([[GOAL, 0.0]])) for name, rival in rivals.items()}
    for name, value in cost.items():
        row[f"{name}_cost"] = value
        difference = abs(value - plans["ipopt"].cost) / plans["ipopt"].cost
        if not difference < SAME:
            raise SystemExit(
                f"{name} has the cost {value}, IPOPT {plans['ipopt'].cost}: not the same problem"
            )
    best = {key: min(row[f"{key}{name}_ms"] for name in variants) for key in ("do_mpc", "ipopt")}
    for name in ("rti", "sqp"):
        row |= {f"{rival} / {name}": ms / row[f"{name}_ms"] for rival, ms in best.items()}
    return {"z": z, "n": n, "do_mpc_build_s": build, **row}


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--z", type=int, nargs="+", default=[32], help="hidden units")
    parser.add_argument("--n", type=int, nargs="+", default=[50], help="horizons")
    parser.add_argument("--rounds", type=int, default=2, help="times that the solvers take turns")
    given = parser.parse_args()
    warnings.simplefilter("ignore")  # do-mpc's optional parts, and CasADi's about its use of numpy
    try:
        import do_mpc
    except ImportError as missing:
        raise SystemExit(f"skipped: {missing}; pip install 'hybrid-mpc[bench]'") from None
    rows = []
    print("| z | N | solver | a solve [ms] | solved | iterations | do-mpc / it |")
    print("| ---: | ---: | --- | ---: | ---: | ---: | ---: |")
    for z in given.z:
        for n in given.n:
            row = against(z, n, given.rounds)
            rows.append({"do_mpc": do_mpc.__version__, **row})
            best = min(row["do_mpc_ms"], row["do_mpc_warm_ms"])
            for name in ("rti", "sqp", "ipopt", "ipopt_warm", "do_mpc", "do_mpc_warm"):
                print(
                    f"| {z} | {n} | {name} | {row[f'{name}_ms']:.3g} | {100 * row[f'{name}_solved']:.0f} % "
                    f"| {row[f'{name}_iterations']:.1f} | {best / row[f'{name}_ms']:.3g} |",
                    flush=True,
                )
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
