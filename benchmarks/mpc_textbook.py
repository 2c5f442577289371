"""Textbook formulations of the problem of ``mpc_step.py``, as anyone writes them with CasADi, against the library.

``python benchmarks/mpc_textbook.py [--out textbook.json] [--z 32] [--n 50] [--rounds 2]``. Their model is the plain
graph of matrices (``nn_export.build(program, plain=True)``), derivatives are CasADi's own; the library's ``ipopt``
has the same formulation with the export's structured Jacobians. All have the same problem, states and first guess
(their own last plan, shifted); whole Python calls by turns, medians of processor time [ms], the first three solves of a
round not counted.

- ``ms_ipopt``: multiple shooting over (x, h), IPOPT with exact Hessian, tolerance 1e-9, the faster of IPOPT's default
  barrier and one of 1e-3; ``ms_fatrop``: the same by fatrop (``structure_detection="auto"``, tolerance 1e-9);
- ``ss_lbfgs``: single shooting over u, IPOPT with L-BFGS, tolerance 1e-6;
- ``ss_sqpmethod``: single shooting, CasADi's ``sqpmethod`` with qrqp and exact Hessian, tolerances 1e-6.

Costs of the last plans are printed beside the times: a formulation that stops short shows. A solver that CasADi's
build lacks is left out and named.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
from mpc_step import RIVAL_PERIODS, SingleShooting, hybrid, problem, programs, record, timed

import nn_export
from hybrid_mpc import CondensedController, IpoptController, SQPController, Status

WARM = {"mu_strategy": "monotone", "mu_init": 1e-3}


class Quasi(SingleShooting):
    """Single shooting by IPOPT with L-BFGS."""

    def _make(self, nlp):
        ipopt = {"print_level": 0, "sb": "yes", "tol": 1e-6, "hessian_approximation": "limited-memory"}
        return ca.nlpsol("quasi", "ipopt", nlp, {"print_time": False, "error_on_fail": False, "ipopt": ipopt})


class Fatrop:
    """Multiple shooting in the order that fatrop wants: stage by stage, the dynamics first."""

    def __init__(self, model, ocp):
        self._guide = CondensedController(model, ocp)
        self.model, self.ocp = model, ocp
        n, n_x, n_z = ocp.horizon, ocp.n_x, ocp.n_x + model.n_h
        z0, u_prev, x_ref = ca.MX.sym("z0", n_z), ca.MX.sym("p"), ca.MX.sym("r", n_x)
        # The input held before a period is a state of the stage: fatrop's costs are by stage.
        s = [ca.MX.sym(f"s{k}", n_z + 1) for k in range(n + 1)]
        u = [ca.MX.sym(f"u{k}") for k in range(n)]
        unknowns, rows, low, high, equal, cost = [], [], [], [], [], 0
        for k in range(n):
            x, h, before = s[k][:n_x], s[k][n_x:n_z], s[k][n_z]
            error, du = x - x_ref, u[k] - before
            cost += model.dt * (ca.dot(ocp.q, error**2) + ocp.r[0] * u[k] ** 2 + ocp.r_delta[0] * du**2)
            gaps = [s[k + 1] - ca.vertcat(*model.step(x, h, u[k], model.w, model.p), u[k])]
            gaps += [s[0] - ca.vertcat(z0, u_prev)] if k == 0 else []
            unknowns += [s[k], u[k]]
            low += [np.full(n_z + 1, -np.inf), ocp.u_min]
            high += [np.full(n_z + 1, np.inf), ocp.u_max]
            rows += gaps
            equal += [True] * sum(g.numel() for g in gaps)
        error = s[n][:n_x] - x_ref
        cost += error.T @ self._guide.problem.terminal @ error
        free = np.full(n_z + 1, np.inf)
        self._bounds = {"lbx": np.concatenate([*low, -free]), "ubx": np.concatenate([*high, free])}
        nlp = {
            "x": ca.vertcat(*unknowns, s[n]), "p": ca.vertcat(z0, u_prev, x_ref), "f": cost,
            "g": ca.vertcat(*rows),
        }  # fmt: skip
        options = {
            "structure_detection": "auto", "equality": equal, "print_time": False, "error_on_fail": False,
            "fatrop": {"print_level": 0, "tolerance": 1e-9, "mu_init": 1e-3},
        }  # fmt: skip
        self._solver = ca.nlpsol("fatrop", "fatrop", nlp, options)
        self._stage = n_z + 2

    def initial(self, e):
        """A first plan."""
        return self._guide.initial(e)

    def solve(self, previous, e, reference):
        """The plan; states and hidden states come along, as the next guess."""
        n, n_z = self.ocp.horizon, self._stage - 2
        u = np.vstack([previous.u[1:], previous.u[-1:]])
        z = np.hstack([previous.x, previous.h])
        z = np.vstack([np.concatenate([e.x, e.h]), z[2:], z[-1:]])
        before = np.vstack([previous.u[0], u])
        guess = np.hstack([z, before])
        guess = np.concatenate([np.hstack([guess[:-1], u]).ravel(), guess[-1]])
        given = np.concatenate([z[0], previous.u[0], reference[0]])
        answer = self._solver(x0=guess, p=given, lbg=0, ubg=0, **self._bounds)
        stats, w = self._solver.stats(), answer["x"].full().ravel()
        rows, n_x = w[: n * self._stage].reshape(n, -1), self.ocp.n_x
        z = np.vstack([rows[:, :n_z], w[n * self._stage :][:n_z]])
        status = Status.SOLVED if stats["success"] else Status.STOPPED
        return replace(
            previous, u=rows[:, -1:], x=z[:, :n_x], h=z[:, n_x:], cost=float(answer["f"]), status=status,
            iterations=stats["iter_count"],
        )  # fmt: skip


def against(z: int, n: int, rounds: int) -> dict[str, float]:
    """All of them by turns at one size."""
    model, ocp = hybrid(z), problem(n)
    plain = replace(model, step=nn_export.build(programs(z)["step"], plain=True))
    solvers = {
        "rti": CondensedController(model, ocp), "sqp": SQPController(model, ocp),
        "ipopt": IpoptController(model, ocp, options=WARM),
        "ms_ipopt_default": IpoptController(plain, ocp), "ms_ipopt_warm": IpoptController(plain, ocp, options=WARM),
        "ss_lbfgs": Quasi(plain, ocp), "ss_sqpmethod": SingleShooting(plain, ocp),
    }  # fmt: skip
    if ca.has_nlpsol("fatrop"):
        solvers["ms_fatrop"] = Fatrop(plain, ocp)
    else:
        print("fatrop is not in this build of CasADi: left out")
    row, _ = timed(solvers, record(model, ocp)[:RIVAL_PERIODS], time.process_time, rounds)
    row["ms_ipopt_ms"] = min(row["ms_ipopt_default_ms"], row["ms_ipopt_warm_ms"])
    for name in ("rti", "sqp"):
        for rival in ("ipopt", "ms_ipopt", "ms_fatrop", "ss_lbfgs", "ss_sqpmethod"):
            if f"{rival}_ms" in row:
                row[f"{rival} / {name}"] = row[f"{rival}_ms"] / row[f"{name}_ms"]
    return {"z": z, "n": n, **row}


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--z", type=int, nargs="+", default=[32], help="hidden units")
    parser.add_argument("--n", type=int, nargs="+", default=[50], help="horizons")
    parser.add_argument("--rounds", type=int, default=2, help="times that the solvers take turns")
    given = parser.parse_args()
    rows = [against(z, n, given.rounds) for z in given.z for n in given.n]
    for row in rows:
        print("\n".join(f"{name:30} {value:.5g}" for name, value in row.items()), "\n")
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
