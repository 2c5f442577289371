"""How long a step of the nonlinear MPC takes: the golf robot's hybrid model with random weights, one core.

``python benchmarks/mpc_step.py [--out times.json] [--z 32] [--n 50] [--rivals] [--growth] [--cpu]``. Every
solver solves the same problem for the same sequence of states (a recorded closed loop on the model itself,
turning towards a new angle with the torque at its bound), each warm-started from its own last plan. The time
is that of the whole Python call, in milliseconds; medians, the first solves are not counted. Solvers that are
compared take turns.

- ``rti``: prepare + feedback of ``CondensedController``; ``rti_bounds``: with bounds on both states, which
  act, along the loop that keeps them; ``_compiled``: with what runs period by period as C (``-O3``);
- ``sqp``: ``SQPController`` to convergence (tolerance 1e-10 of the cost, KKT residual 1e-6);
- ``ipopt``: multiple shooting over (x, h) with exact Hessian (``IpoptController``, tolerance 1e-9), with IPOPT's
  default initial barrier and with one of 1e-3, which suits a warm start; the faster counts;
- ``sqpmethod``: single shooting over u with exact Hessian, CasADi's ``sqpmethod`` with qrqp, tolerances 1e-6;
- ``mandatory_ms``: the arithmetic that a step cannot do without, at the measured speed of ``dgemm``;
- ``--cpu``: processor time instead, which leaves out what other work on a busy machine takes;
- ``--growth``: exponents of the ``rti``'s and the ``sqp``'s time in N (20 to 200) and in z (16 to 256).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import casadi as ca
import numpy as np
import torch

from hybrid_mpc import (
    OCP,
    CondensedController,
    Estimate,
    GRUNetwork,
    HybridStep,
    IpoptController,
    Scaling,
    SQPController,
    Status,
    load,
    model_info,
    n_features,
    save_artifact,
    trace_model,
)
from scenarios.golf_robot import scenario

PERIODS, RIVAL_PERIODS, GROWTH_PERIODS, SKIPPED = 150, 18, 30, 3
GOAL = 0.6  # [rad], from rest at -0.3 rad


def programs(z: int):
    """The traced programs of the golf robot's hybrid model with a GRU of ``z`` random units."""
    torch.manual_seed(z)
    prior, dt = scenario.prior(), scenario.data.dt
    network = GRUNetwork(n_features(prior, True), z, prior.n_q)
    scaling = Scaling(x=(0.5, 1.5), u=(0.2,), acceleration=(5.0,), correction=(0.5,))
    return trace_model(HybridStep(prior, network, scaling, dt).requires_grad_(False))


def hybrid(z: int):
    """That model."""
    program, prior, dt = programs(z), scenario.prior(), scenario.data.dt
    with tempfile.TemporaryDirectory() as folder:
        save_artifact(Path(folder) / "model", {"hybrid": program}, model_info(prior, dt))
        return load(Path(folder) / "model").models["hybrid"]


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
        e = estimate(model, *(v.full().ravel() for v in model.step(e.x, e.h, plan.u[0], model.w, model.p)))
    return states


def timed(controllers, states, clock, rounds=1):
    """Of each controller by name: median [ms] of whole solves, share of solved ones, iterations; last plans.

    The controllers take turns, ``rounds`` times, each along all states: so a load of the machine meets all of them.
    """
    plans, spent, solved, count = {}, *({name: [] for name in controllers} for _ in range(3))
    for _ in range(rounds):
        for name, controller in controllers.items():
            plan, before = controller.initial(states[0]), len(spent[name])
            for e in states:
                start = clock()
                plan = controller.solve(plan, e, np.array([[GOAL, 0.0]]))
                spent[name].append(1e3 * (clock() - start))
                solved[name].append(plan.status.ok)
                count[name].append(plan.iterations)
            plans[name] = plan
            for values in (spent[name], solved[name], count[name]):
                del values[before : before + SKIPPED]
    row = {}
    for name in controllers:
        row[f"{name}_ms"] = float(np.median(spent[name]))
        row[f"{name}_solved"] = float(np.mean(solved[name]))
        row[f"{name}_iterations"] = float(np.mean(count[name]))
        row[f"{name}_cost"] = plans[name].cost
    return row, plans


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
            x, h = model.step(x, h, u[k], model.w, model.p)
            before = u[k]
        cost += (x - x_ref).T @ self._guide.problem.terminal @ (x - x_ref)
        nlp = {"x": u, "p": ca.vertcat(z0, u_prev, x_ref), "f": cost}
        self._solver = self._make(nlp)

    def _make(self, nlp):
        options = {
            "print_time": False, "print_header": False, "print_iteration": False, "print_status": False,
            "error_on_fail": False, "max_iter": 50, "tol_pr": 1e-6, "tol_du": 1e-6, "qpsol": "qrqp",
            "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
        }  # fmt: skip
        return ca.nlpsol("single", "sqpmethod", nlp, options)

    def initial(self, e):
        """A first plan."""
        return self._guide.initial(e)

    def solve(self, previous, e, reference):
        """The plan, as the library's controllers give it."""
        given = np.concatenate([e.x, e.h, previous.u[0], reference[0]])
        guess = np.vstack([previous.u[1:], previous.u[-1:]])
        answer = self._solver(x0=guess, p=given, lbx=self.ocp.u_min, ubx=self.ocp.u_max)
        stats = self._solver.stats()
        status = Status.SOLVED if stats["success"] else Status.STOPPED
        # The plan's own fields beside the inputs do not matter to the next solve.
        return replace(
            previous,
            u=answer["x"].full(),
            cost=float(answer["f"]),
            status=status,
            iterations=stats["iter_count"],
        )


def median_us(call, clock) -> float:
    """Median time of 200 calls."""
    spent = []
    for _ in range(200):
        start = clock()
        call()
        spent.append(clock() - start)
    return 1e6 * float(np.median(spent))


def mandatory_mflop(z: int, n: int) -> float:
    """Condensing, its Hessian's half, and the products of the GRU's Jacobians; 2 states, 1 input."""
    n_z = z + 2
    return 1e-6 * (n**2 * n_z**2 + 2 * n**3 + n * 12 * z**2)


def dgemm_gflops(clock) -> float:
    """Speed of a large product, one core."""
    a = np.random.default_rng(0).normal(size=(400, 400))
    return 2 * 400**3 / median_us(lambda: a @ a, clock) / 1e3


def measure(z: int, n: int, clock) -> dict[str, float]:
    """The library's times at one size."""
    model, ocp = hybrid(z), problem(n)
    states = record(model, ocp)
    kinds = {
        "rti": CondensedController(model, ocp), "rti_compiled": CondensedController(model, ocp, compiled=True)
    }  # fmt: skip
    row, plans = timed(kinds, states, clock, rounds=2)
    for name, suffix in (("rti", ""), ("rti_compiled", "_compiled")):
        controller, plan = kinds[name], plans[name]
        prepared = controller.prepare(plan)
        row[f"prepare{suffix}_ms"] = 1e-3 * median_us(partial(controller.prepare, plan), clock)
        row[f"feedback{suffix}_ms"] = 1e-3 * median_us(
            partial(controller.feedback, prepared, states[-1], np.array([[GOAL, 0.0]])), clock
        )
    bounded = problem(n, x_max=[0.55, 1.0], x_min=[-np.inf, -1.0])
    row |= timed({"rti_bounds": CondensedController(model, bounded)}, record(model, bounded), clock)[0]
    row |= timed({"sqp": SQPController(model, ocp), "sqp_compiled": SQPController(model, ocp, compiled=True)},
                 states[:60], clock, rounds=2)[0]  # fmt: skip
    row["mandatory_mflop"], row["dgemm_gflops"] = mandatory_mflop(z, n), dgemm_gflops(clock)
    row["mandatory_ms"] = row["mandatory_mflop"] / row["dgemm_gflops"]
    row["rti_to_mandatory"] = row["rti_ms"] / row["mandatory_ms"]
    return {"z": z, "n": n, **row}


def against_rivals(z: int, n: int, clock) -> dict[str, float]:
    """Library and textbook, taking turns."""
    model, ocp = hybrid(z), problem(n)
    variants = {"ipopt_default": {}, "ipopt_warm": {"mu_strategy": "monotone", "mu_init": 1e-3}}
    solvers = {
        "rti": CondensedController(model, ocp), "sqp": SQPController(model, ocp),
        "rti_compiled": CondensedController(model, ocp, compiled=True),
        "sqp_compiled": SQPController(model, ocp, compiled=True),
        **{name: IpoptController(model, ocp, options=options) for name, options in variants.items()},
        "sqpmethod": SingleShooting(model, ocp),
    }  # fmt: skip
    row, _ = timed(solvers, record(model, ocp)[:RIVAL_PERIODS], clock, rounds=2)
    best = {"ipopt": min(row[f"{v}_ms"] for v in variants), "sqpmethod": row["sqpmethod_ms"]}
    for name in ("rti", "sqp", "rti_compiled", "sqp_compiled"):
        row |= {f"{rival} / {name}": ms / row[f"{name}_ms"] for rival, ms in best.items()}
    return {"z": z, "n": n, **row}


def growth(clock) -> dict[str, float]:
    """Exponents: slopes of the logarithms, by least squares."""
    row: dict[str, float] = {}
    for letter, sizes in (
        ("n", [(32, n) for n in (20, 50, 100, 200)]),
        ("z", [(z, 50) for z in (16, 32, 64, 128, 256)]),
    ):
        times: dict[str, list[float]] = {"rti": [], "sqp": []}
        for z, n in sizes:
            model, ocp = hybrid(z), problem(n)
            states = record(model, ocp)[:GROWTH_PERIODS]
            kinds = {"rti": CondensedController(model, ocp), "sqp": SQPController(model, ocp)}
            got, _ = timed(kinds, states, clock)
            for name, values in times.items():
                values.append(got[f"{name}_ms"])
                row[f"{name}_ms at z={z} n={n}"] = got[f"{name}_ms"]
        at = np.log([size[letter == "n"] for size in sizes])
        row |= {
            f"{name} exponent in {letter}": float(np.polyfit(at, np.log(v), 1)[0])
            for name, v in times.items()
        }
    return row


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--z", type=int, nargs="+", default=[32], help="hidden units")
    parser.add_argument("--n", type=int, nargs="+", default=[50], help="horizons")
    parser.add_argument("--rivals", action="store_true", help="textbook formulations too (slow)")
    parser.add_argument("--growth", action="store_true", help="exponents in N and z too (slow)")
    parser.add_argument("--cpu", action="store_true", help="processor time instead of the wall clock's")
    given = parser.parse_args()
    clock = time.process_time if given.cpu else time.perf_counter
    torch.set_num_threads(1)
    sizes = [(z, n) for z in given.z for n in given.n]
    kinds = [("library", measure)] + ([("rivals", against_rivals)] if given.rivals else [])
    kind = {"clock": "processor" if given.cpu else "wall"}
    rows = [{"part": part, **kind, **f(z, n, clock)} for z, n in sizes for part, f in kinds]
    rows += [{"part": "growth", **kind, **growth(clock)}] if given.growth else []
    for row in rows:
        print(
            "\n".join(
                f"{name:28s} {v if isinstance(v, str) else format(v, '.4g')}" for name, v in row.items()
            ),
            "\n",
        )
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
