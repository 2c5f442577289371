"""How long a step of the nonlinear MPC takes: the golf robot's hybrid model with random weights, one core.

``python benchmarks/mpc_step.py [--out times.json] [--z 32] [--n 50] [--rivals]``. Every solver solves the same
problem for the same sequence of states (a recorded closed loop on the model itself, turning towards a new
angle with the torque at its bound), each warm-started from its own last plan. The time is that of the whole
Python call, in milliseconds; medians, the first solves are not counted.

- ``rti``: prepare + feedback of ``CondensedController``; ``rti_bounds``: with bounds on both states, which
  act, along the loop that keeps them;
- ``sqp``: ``SQPController`` to convergence;
- ``ipopt``: multiple shooting over (x, h) with exact Hessian (``IpoptController``), with IPOPT's default
  initial barrier and with one of 1e-3, which suits a warm start; the faster counts;
- ``sqpmethod``: single shooting over u with exact Hessian, CasADi's ``sqpmethod`` with qrqp, tolerances 1e-6;
- ``condense``: the products of the condensing alone, by numpy and by CasADi's BLASFEO kernel.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import casadi as ca
import numpy as np
import torch

from hybrid_mpc.artifact import load_artifact, save_artifact
from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.identification.export import model_info, trace_model
from hybrid_mpc.identification.networks import GRUNetwork
from hybrid_mpc.identification.step import HybridStep, Scaling, n_features
from hybrid_mpc.mpc import OCP, CondensedController, IpoptController, SQPController
from hybrid_mpc.mpc.buffered import BufferedFunction
from hybrid_mpc.mpc.condensing import Condenser
from scenarios.golf_robot import scenario

PERIODS, RIVAL_PERIODS, SKIPPED = 150, 15, 3
GOAL = 0.6  # [rad], from rest at -0.3 rad


def hybrid(z: int):
    """The golf robot's hybrid model with a GRU of ``z`` random units."""
    torch.manual_seed(z)
    prior, dt = scenario.prior(), scenario.data.dt
    network = GRUNetwork(n_features(prior, True), z, prior.n_q)
    scaling = Scaling(x=(0.5, 1.5), u=(0.2,), acceleration=(5.0,), correction=(0.5,))
    program = trace_model(HybridStep(prior, network, scaling, dt).requires_grad_(False))
    with tempfile.TemporaryDirectory() as folder:
        save_artifact(Path(folder) / "model", {"hybrid": program}, model_info(prior, dt), provenance={})
        return load_artifact(Path(folder) / "model").models["hybrid"]


def problem(n: int, **limits) -> OCP:
    """The golf robot's own weights."""
    return OCP(n, [400.0, 1.0], [4.0], [16.0], [-0.5], [0.5], working_point=([0.0, 1.0], [0.0]), **limits)


def estimate(model, x, h) -> Estimate:
    """What an estimator would say of a known state."""
    size = model.n_x + model.n_h + 1
    return Estimate(0.0, x, h, np.zeros(1), np.eye(size), np.zeros(1), 0.0)


def record(model, ocp):
    """The states of a closed loop on the model itself."""
    controller, states = CondensedController(model, ocp), []
    e = estimate(model, np.array([-0.3, 0.0]), np.zeros(model.n_h))
    plan = controller.initial(e)
    for _ in range(PERIODS):
        states.append(e)
        plan = controller.solve(plan, e, np.array([[GOAL, 0.0]]))
        e = estimate(model, *(v.full().ravel() for v in model.step(e.x, e.h, plan.u[0])))
    return states


def timed(controller, states):
    """Median [ms] of whole solves along the states, share of solved ones, and the last solution."""
    plan, spent, solved = controller.initial(states[0]), [], []
    for e in states:
        start = time.perf_counter()
        plan = controller.solve(plan, e, np.array([[GOAL, 0.0]]))
        spent.append(1e3 * (time.perf_counter() - start))
        solved.append(plan.status.ok)
    return float(np.median(spent[SKIPPED:])), float(np.mean(solved)), plan


class SingleShooting:
    """The textbook's other form: the inputs are the only unknowns."""

    def __init__(self, model, ocp):
        self._guide = CondensedController(model, ocp)  # initial plan, terminal weight
        self.model, self.ocp, n, n_x = model, ocp, ocp.horizon, ocp.n_x
        u, z0, u_prev, x_ref = (
            ca.MX.sym(*s) for s in (("u", n), ("z", n_x + model.n_h), ("p", 1), ("r", n_x))
        )
        x, h, before, cost = z0[:n_x], z0[n_x:], u_prev, 0
        for k in range(n):
            error, du = x - x_ref, u[k] - before
            cost += model.dt * (ca.dot(ocp.q, error**2) + ocp.r[0] * u[k] ** 2 + ocp.r_delta[0] * du**2)
            x, h = model.step(x, h, u[k])
            before = u[k]
        cost += (x - x_ref).T @ self._guide.problem.terminal @ (x - x_ref)
        options = {
            "print_time": False, "print_header": False, "print_iteration": False, "print_status": False,
            "error_on_fail": False, "max_iter": 50, "tol_pr": 1e-6, "tol_du": 1e-6, "qpsol": "qrqp",
            "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
        }  # fmt: skip
        nlp = {"x": u, "p": ca.vertcat(z0, u_prev, x_ref), "f": cost}
        self._solver = ca.nlpsol("single", "sqpmethod", nlp, options)

    def initial(self, e):
        """A first plan."""
        return self._guide.initial(e)

    def solve(self, previous, e, reference):
        """The plan, as the library's controllers give it."""
        given = np.concatenate([e.x, e.h, previous.u[0], reference[0]])
        guess = np.vstack([previous.u[1:], previous.u[-1:]])
        answer = self._solver(x0=guess, p=given, lbx=self.ocp.u_min, ubx=self.ocp.u_max)
        self.iterations = self._solver.stats()["iter_count"]
        plan = self.initial(e)
        object.__setattr__(plan, "u", answer["x"].full())
        object.__setattr__(plan, "cost", float(answer["f"]))
        return plan


def blasfeo_condensing(n: int, n_z: int) -> BufferedFunction:
    """The products of the condensing in CasADi's virtual machine, by its BLASFEO kernel."""
    a_t, b_t = ca.MX.sym("a_t", n_z, n_z * n), ca.MX.sym("b_t", n_z, n)
    blocks, columns = [], ca.MX(n_z, 0)
    for k in range(n):
        a = a_t[:, k * n_z : (k + 1) * n_z]
        columns = ca.mtimes(a, columns, "blasfeo") if k else columns
        columns = ca.horzcat(columns, b_t[:, k])
        blocks.append(columns[:2, :])
    f = ca.Function("condense", [a_t, b_t], [ca.horzcat(*blocks)])
    return BufferedFunction(f)


def median_us(call) -> float:
    """Median time of 200 calls."""
    spent = []
    for _ in range(200):
        start = time.perf_counter()
        call()
        spent.append(time.perf_counter() - start)
    return 1e6 * float(np.median(spent))


def condensing_times(model, ocp, states) -> dict[str, float]:
    """Microseconds of the condensing's products by the two routes."""
    controller = CondensedController(model, ocp)
    prepared = controller.prepare(controller.initial(states[0]))
    routes = {"condense_numpy_us": median_us(lambda: condense(prepared.a_t, prepared.b, 2))}
    kernel = blasfeo_condensing(ocp.horizon, model.n_x + model.n_h)
    kernel.inputs[0][:] = prepared.a_t.ravel()
    kernel.inputs[1][:] = prepared.b.ravel()
    return routes | {"condense_blasfeo_us": median_us(kernel)}


def measure(z: int, n: int, rivals: bool) -> dict[str, float]:
    """All times of one size."""
    model, ocp = hybrid(z), problem(n)
    states = record(model, ocp)
    row: dict[str, float] = {"z": z, "n": n}
    rti = CondensedController(model, ocp)
    row["rti_ms"], row["rti_solved"], plan = timed(rti, states)
    prepared = rti.prepare(plan)
    row["prepare_ms"] = 1e-3 * median_us(lambda: rti.prepare(plan))
    row["feedback_ms"] = 1e-3 * median_us(lambda: rti.feedback(prepared, states[-1], np.array([[GOAL, 0.0]])))
    bounded = problem(n, x_max=[0.55, 1.0], x_min=[-np.inf, -1.0])
    controller = CondensedController(model, bounded)
    row["rti_bounds_ms"], row["rti_bounds_solved"], _ = timed(controller, record(model, bounded))
    row["sqp_ms"], row["sqp_solved"], _ = timed(SQPController(model, ocp), states[:60])
    row |= condensing_times(model, ocp, states)
    if rivals:
        few = states[:RIVAL_PERIODS]
        row["sqp_same_ms"], _, sqp = timed(SQPController(model, ocp), few)
        row["sqp_cost"] = sqp.cost
        variants = {"ipopt_default_ms": {}, "ipopt_warm_ms": {"mu_strategy": "monotone", "mu_init": 1e-3}}
        for name, options in variants.items():
            row[name], row["ipopt_solved"], plan = timed(IpoptController(model, ocp, options=options), few)
            row["ipopt_cost"], row["ipopt_iterations"] = plan.cost, plan.iterations
        row["ipopt_ms"] = min(row["ipopt_default_ms"], row["ipopt_warm_ms"])
        single = SingleShooting(model, ocp)
        row["sqpmethod_ms"], _, plan = timed(single, few)
        row["sqpmethod_cost"], row["sqpmethod_iterations"] = plan.cost, single.iterations
    return row


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--z", type=int, nargs="+", default=[32], help="hidden units")
    parser.add_argument("--n", type=int, nargs="+", default=[50], help="horizons")
    parser.add_argument("--rivals", action="store_true", help="textbook formulations too (slow)")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for z in given.z:
        for n in given.n:
            row = measure(z, n, given.rivals)
            rows.append(row)
            print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
            if given.rivals:
                for name in ("ipopt", "sqpmethod"):
                    ratios = row[f"{name}_ms"] / row["rti_ms"], row[f"{name}_ms"] / row["sqp_same_ms"]
                    print(f"{name} / rti {ratios[0]:.0f}   {name} / sqp {ratios[1]:.1f}")
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
