"""The library's solvers against the formulations that anyone writes with CasADi, and against do-mpc.

``python benchmarks/rivals.py [--z 32] [--n 50] [--rounds 2] [--out FILE.json]``. The golf robot's hybrid with random
weights; all have the same problem, states and first guess (their own last plan, shifted). Whole Python calls by turns,
medians of processor time [ms]; ``/ rti`` and ``/ sqp`` are ratios of this run. Costs of the last plans stand beside
the times: a formulation that stops short shows. ``plain`` is the model as a graph of matrices with CasADi's own
derivatives, ``structured`` the exported one.

- ``ipopt``: multiple shooting over (x, h), exact Hessian, tolerance 1e-9; IPOPT's default barrier and (``warm``) 1e-3;
- ``fatrop``: the same by fatrop, tolerance 1e-9; left out where CasADi's build lacks it;
- ``sqpmethod``: single shooting over u, CasADi's ``sqpmethod`` with qrqp and exact Hessian, tolerances 1e-6;
- ``lbfgs``: single shooting, IPOPT with L-BFGS, tolerance 1e-6;
- ``do-mpc``: a discrete model, so the problem of ``ipopt``; it does not shift its last solution. Its plan must cost on
  the library's model what IPOPT finds, to 1e-6. Left out where it is not installed
  (``pip install 'hybrid-mpc[bench]'``).
"""

from __future__ import annotations

import importlib.util
import warnings
from dataclasses import replace
from time import process_time

import casadi as ca
import numpy as np
from parts import GOAL, arguments, closed_loop, deployed, hybrid_step, problem, report, solve_times

import nn_export
from hybrid_mpc import CondensedController, IpoptController, SQPController, Status, trace_model

STATES = 18
WARM = {"mu_strategy": "monotone", "mu_init": 1e-3}
SAME = 1e-6
"""Largest relative difference of two solvers' costs of the same problem."""
QUIET = {"print_time": False, "error_on_fail": False}
SINGLE_SHOOTING = {
    "sqpmethod": ("sqpmethod", {
        **QUIET, "print_header": False, "print_iteration": False, "print_status": False, "max_iter": 50,
        "tol_pr": 1e-6, "tol_du": 1e-6, "qpsol": "qrqp",
        "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
    }),
    "lbfgs": ("ipopt", {
        **QUIET,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-6, "hessian_approximation": "limited-memory"},
    }),
}  # fmt: skip
"""CasADi's solver and its options."""


def stage_cost(model, ocp, error, u, du):
    """Cost of a period."""
    return model.dt * (ca.dot(ocp.q, error**2) + ocp.r[0] * u**2 + ocp.r_delta[0] * du**2)


class SingleShooting:
    """The textbook's form in which the inputs are the only unknowns."""

    def __init__(self, model, ocp, kind):
        guide = CondensedController(model, ocp)  # first plan, terminal weight
        self.initial, self.ocp, n, n_x = guide.initial, ocp, ocp.horizon, ocp.n_x
        u, z0, u_prev, x_ref = (
            ca.MX.sym(*s) for s in (("u", n), ("z", n_x + model.n_h), ("p", 1), ("r", n_x))
        )
        x, h, before, cost = z0[:n_x], z0[n_x:], u_prev, 0
        for k in range(n):
            cost += stage_cost(model, ocp, x - x_ref, u[k], u[k] - before)
            x, h = model.step(x, h, u[k], model.w, model.p)
            before = u[k]
        cost += (x - x_ref).T @ guide.problem.terminal @ (x - x_ref)
        name, options = SINGLE_SHOOTING[kind]
        nlp = {"x": u, "p": ca.vertcat(z0, u_prev, x_ref), "f": cost}
        self._solver = ca.nlpsol(kind, name, nlp, options)

    def solve(self, previous, e, reference):
        """The plan; its fields beside the inputs do not matter to the next solve."""
        given = np.concatenate([e.x, e.h, previous.u[0], reference[0]])
        guess = np.vstack([previous.u[1:], previous.u[-1:]])
        answer = self._solver(x0=guess, p=given, lbx=self.ocp.u_min, ubx=self.ocp.u_max)
        stats = self._solver.stats()
        status = Status.SOLVED if stats["success"] else Status.STOPPED
        u, cost = answer["x"].full(), float(answer["f"])
        return replace(previous, u=u, cost=cost, status=status, iterations=stats["iter_count"])


class Fatrop:
    """Multiple shooting in the order that fatrop wants: stage by stage, the dynamics first."""

    def __init__(self, model, ocp):
        guide = CondensedController(model, ocp)
        self.initial, self.ocp = guide.initial, ocp
        n, n_x, n_z = ocp.horizon, ocp.n_x, ocp.n_x + model.n_h
        z0, u_prev, x_ref = ca.MX.sym("z0", n_z), ca.MX.sym("p"), ca.MX.sym("r", n_x)
        # The input held before a period is a state of the stage: fatrop's costs are by stage.
        s = [ca.MX.sym(f"s{k}", n_z + 1) for k in range(n + 1)]
        u = [ca.MX.sym(f"u{k}") for k in range(n)]
        unknowns, rows, low, high, cost = [], [], [], [], 0
        for k in range(n):
            x, h, before = s[k][:n_x], s[k][n_x:n_z], s[k][n_z]
            cost += stage_cost(model, ocp, x - x_ref, u[k], u[k] - before)
            rows += [s[k + 1] - ca.vertcat(*model.step(x, h, u[k], model.w, model.p), u[k])]
            rows += [s[0] - ca.vertcat(z0, u_prev)] if k == 0 else []
            unknowns += [s[k], u[k]]
            low += [np.full(n_z + 1, -np.inf), ocp.u_min]
            high += [np.full(n_z + 1, np.inf), ocp.u_max]
        error = s[n][:n_x] - x_ref
        cost += error.T @ guide.problem.terminal @ error
        free, g = np.full(n_z + 1, np.inf), ca.vertcat(*rows)
        self._bounds = {"lbx": np.concatenate([*low, -free]), "ubx": np.concatenate([*high, free])}
        nlp = {"x": ca.vertcat(*unknowns, s[n]), "p": ca.vertcat(z0, u_prev, x_ref), "f": cost, "g": g}
        options = {
            **QUIET, "structure_detection": "auto", "equality": [True] * g.numel(),
            "fatrop": {"print_level": 0, "tolerance": 1e-9, "mu_init": 1e-3},
        }  # fmt: skip
        self._solver = ca.nlpsol("fatrop", "fatrop", nlp, options)
        self._stage = n_z + 2

    def solve(self, previous, e, reference):
        """The plan; states and hidden states come along, as the next guess."""
        n, n_z, n_x = self.ocp.horizon, self._stage - 2, self.ocp.n_x
        u = np.vstack([previous.u[1:], previous.u[-1:]])
        z = np.hstack([previous.x, previous.h])
        z = np.vstack([np.concatenate([e.x, e.h]), z[2:], z[-1:]])
        guess = np.hstack([z, np.vstack([previous.u[0], u])])
        guess = np.concatenate([np.hstack([guess[:-1], u]).ravel(), guess[-1]])
        given = np.concatenate([z[0], previous.u[0], reference[0]])
        answer = self._solver(x0=guess, p=given, lbg=0, ubg=0, **self._bounds)
        stats, w = self._solver.stats(), answer["x"].full().ravel()
        rows = w[: n * self._stage].reshape(n, -1)
        z = np.vstack([rows[:, :n_z], w[n * self._stage :][:n_z]])
        return replace(
            previous, u=rows[:, -1:], x=z[:, :n_x], h=z[:, n_x:], cost=float(answer["f"]),
            status=Status.SOLVED if stats["success"] else Status.STOPPED, iterations=stats["iter_count"],
        )  # fmt: skip


class DoMpc:
    """do-mpc's controller behind the calls of the library's."""

    def __init__(self, model, ocp, ipopt):
        import do_mpc

        n_x = model.n_x
        self._own = IpoptController(model, ocp)  # first plan, terminal weight, cost of a plan
        plant = do_mpc.model.Model("discrete", "MX")
        z = plant.set_variable("_x", "z", (n_x + model.n_h, 1))
        u = plant.set_variable("_u", "u", (model.n_u, 1))
        plant.set_rhs("z", ca.vertcat(*model.step(z[:n_x], z[n_x:], u, model.w, model.p)))
        plant.setup()
        mpc = do_mpc.controller.MPC(plant)
        mpc.settings.n_horizon, mpc.settings.t_step = ocp.horizon, model.dt
        mpc.settings.store_full_solution, mpc.settings.store_lagr_multiplier = False, False
        options = {"print_level": 0, "sb": "yes", "tol": 1e-9, **ipopt}
        mpc.settings.nlpsol_opts = {"print_time": False, **{f"ipopt.{k}": v for k, v in options.items()}}
        z, u, p = plant.x["z"], plant.u["u"], self._own.problem.terminal
        error = z[:n_x] - np.array([GOAL, 0.0])
        mpc.set_objective(lterm=stage_cost(model, ocp, error, u, 0), mterm=error.T @ p @ error)
        mpc.set_rterm(u=model.dt * float(ocp.r_delta[0]))
        mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = ocp.u_min, ocp.u_max
        mpc.setup()
        self.mpc = mpc

    def initial(self, e):
        """A first plan: the model at rest from the estimate, as the library's controllers have it."""
        plan = self._own.initial(e)
        self.mpc.reset_history()
        self.mpc.u0, self.mpc.x0 = plan.u[0], np.concatenate([e.x, e.h])
        self.mpc.set_initial_guess()
        for k, z in enumerate(np.hstack([plan.x, plan.h])):
            self.mpc.opt_x_num["_x", k, 0, -1] = z
        return plan

    def solve(self, previous, e, reference):
        """The plan; of its fields beside the inputs only status, iterations and cost are filled in."""
        z0, u_prev, problem = np.concatenate([e.x, e.h]), np.array(self.mpc.u0.cat).ravel(), self._own.problem
        self.mpc.make_step(z0)
        u = np.array([np.array(v).ravel() for v in self.mpc.opt_x_num["_u", :, 0]])
        stats = self.mpc.solver_stats
        return replace(
            previous, u=u, status=Status.SOLVED if stats["success"] else Status.STOPPED,
            iterations=stats["iter_count"],
            cost=problem.cost(problem.run(z0, u), u, u_prev, problem.target(reference)),
        )  # fmt: skip


def against(z: int, n: int, rounds: int) -> list[dict]:
    """All of them by turns at one size."""
    step = hybrid_step(z)
    model, ocp = deployed(step), problem(n)
    plain = replace(model, step=nn_export.build(trace_model(step)["step"], plain=True))
    solvers = {
        "rti": CondensedController(model, ocp),
        "sqp": SQPController(model, ocp),
        "ipopt structured": IpoptController(model, ocp),
        "ipopt structured warm": IpoptController(model, ocp, options=WARM),
        "ipopt plain": IpoptController(plain, ocp),
        "ipopt plain warm": IpoptController(plain, ocp, options=WARM),
        "sqpmethod structured": SingleShooting(model, ocp, "sqpmethod"),
        "sqpmethod plain": SingleShooting(plain, ocp, "sqpmethod"),
        "lbfgs plain": SingleShooting(plain, ocp, "lbfgs"),
    }
    if ca.has_nlpsol("fatrop"):
        solvers["fatrop plain"] = Fatrop(plain, ocp)
    if importlib.util.find_spec("do_mpc") is not None:
        solvers |= {"do-mpc": DoMpc(model, ocp, {}), "do-mpc warm": DoMpc(model, ocp, WARM)}
    found, _ = solve_times(solvers, closed_loop(model, ocp)[:STATES], process_time, rounds)
    cost = found["ipopt structured"]["cost"]
    for name in (name for name in found if name.startswith("do-mpc")):
        if not abs(found[name]["cost"] - cost) < SAME * cost:
            raise SystemExit(f"{name} has the cost {found[name]['cost']}, IPOPT {cost}: not the same problem")
    return [
        {"z": z, "n": n, "solver": name, **row, **{f"/ {own}": row["ms"] / found[own]["ms"] for own in ("rti", "sqp")}}
        for name, row in found.items()
    ]  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--z", type=int, nargs="+", default=[32], help="hidden units")
    parser.add_argument("--n", type=int, nargs="+", default=[50], help="horizons")
    parser.add_argument("--rounds", type=int, default=2, help="times that the solvers take turns")
    given = parser.parse_args()
    warnings.simplefilter("ignore")  # do-mpc's optional parts, and CasADi's about its use of numpy
    report([row for z in given.z for n in given.n for row in against(z, n, given.rounds)], given.out)


if __name__ == "__main__":
    main()
