"""What the benchmarks share: models with random weights, timing by turns, and the table and JSON that each prints."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy and torch are loaded

import argparse
import json
import platform
import tempfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

import casadi as ca
import numpy as np
import torch

from hybrid_mpc import (
    OCP,
    CondensedController,
    Estimate,
    GRUNetwork,
    HybridStep,
    Scaling,
    load,
    model_info,
    n_features,
    save_artifact,
    trace_model,
)
from scenarios.golf_robot import scenario

SCALING = Scaling(x=(0.5, 1.5), u=(0.2,), rate=(5.0,), correction=(0.5,))
GOAL = 0.6  # [rad], from rest at -0.3 rad
REFERENCE = np.array([[GOAL, 0.0]])
PERIODS, SKIPPED = 150, 3

torch.set_num_threads(1)


def arguments(doc: str) -> argparse.ArgumentParser:
    """The command line that all have."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write; without it, JSON follows the table")
    return parser


def report(rows: list[dict], out: Path | None, packages: Sequence[str] = (), **more: object) -> None:
    """Rows with the same keys as a Markdown table, and all with the machine's packages as JSON.

    ``packages`` are named beside those that all benchmarks use; ``more`` goes into the JSON alone.
    """
    columns: tuple = ()
    for row in rows:
        if tuple(row) != columns:
            columns = tuple(row)
            print("\n| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns))
        print("| " + " | ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()) + " |")
    versions = {name: version(name) for name in ("casadi", "torch", "numpy", *packages)}
    machine = {"machine": platform.machine(), "python": platform.python_version(), **versions}
    text = json.dumps({**machine, "rows": rows, **more}, indent=1)
    print("\n" + text) if out is None else out.write_text(text + "\n")


def hybrid_step(z: int) -> HybridStep:
    """The golf robot's prior with a GRU of ``z`` random units beside it."""
    torch.manual_seed(z)
    prior = scenario.prior()
    network = GRUNetwork(n_features(prior, True), z, prior.n_q)
    return HybridStep(prior, network, SCALING, scenario.data.dt).requires_grad_(False)


def deployed(step):
    """A torch step as the model that a controller loads."""
    with tempfile.TemporaryDirectory() as folder:
        save_artifact(Path(folder) / "model", {"hybrid": trace_model(step)}, model_info(step.prior, step.dt))
        return load(Path(folder) / "model").models["hybrid"]


def problem(n: int, **limits) -> OCP:
    """The golf robot's own weights."""
    return OCP(n, [400.0, 1.0], [4.0], [16.0], [-0.5], [0.5], working_point=([0.0, 1.0], [0.0]), **limits)


def estimate(model, x, h) -> Estimate:
    """What an estimator would say of a known state."""
    size = model.n_x + model.n_h + 1
    return Estimate(0.0, x, h, np.zeros(1), np.eye(size), np.zeros(1), 0.0)


def closed_loop(model, ocp) -> list[Estimate]:
    """The states of a loop on the model itself, turning towards a new angle with the torque at its bound."""
    controller, states = CondensedController(model, ocp), []
    e = estimate(model, np.array([-0.3, 0.0]), np.zeros(model.n_h))
    plan = controller.initial(e)
    for _ in range(PERIODS):
        states.append(e)
        plan = controller.solve(plan, e, REFERENCE)
        e = estimate(model, *(v.full().ravel() for v in model.step(e.x, e.h, plan.u[0], model.w, model.p)))
    return states


def solve_times(controllers, states, clock, rounds=1) -> tuple[dict[str, dict], dict]:
    """By solver: median and 99 % of whole solves [ms], share of solved ones, iterations, cost; and the last plans.

    The solvers take turns, ``rounds`` times, each along all states from its own last plan. The first solves of a
    round are not counted.
    """
    found: dict[str, list] = {name: [] for name in controllers}
    plans = {}
    for _ in range(rounds):
        for name, controller in controllers.items():
            plan, one_round = controller.initial(states[0]), []
            for e in states:
                start = clock()
                plan = controller.solve(plan, e, REFERENCE)
                one_round.append((1e3 * (clock() - start), plan.status.ok, plan.iterations))
            found[name] += one_round[SKIPPED:]
            plans[name] = plan
    rows = {}
    for name, solves in found.items():
        spent, solved, iterations = np.array(solves, dtype=float).T
        rows[name] = {
            "ms": float(np.median(spent)),
            "p99": float(np.percentile(spent, 99)),
            "solved": solved.mean(),
            "iterations": iterations.mean(),
        }
        rows[name]["cost"] = plans[name].cost
    return rows, plans


def best_times(routes, rounds: int, calls: int = 1, clock=perf_counter) -> dict[str, float]:
    """Best time of a call [s] of each route, by turns: other work on the machine only ever adds."""
    best = dict.fromkeys(routes, float("inf"))
    for _ in range(rounds + 1):  # the first round warms up; as the best counts, it may stay
        for name, route in routes.items():
            start = clock()
            for _ in range(calls):
                route()
            best[name] = min(best[name], (clock() - start) / calls)
    return best


def median_time(call, clock, calls: int = 200) -> float:
    """Median time of a call [s]."""
    spent = []
    for _ in range(calls):
        start = clock()
        call()
        spent.append(clock() - start)
    return float(np.median(spent))


def buffered(function: ca.Function, point):
    """A call of a function at a point, without Python's conversions."""
    buffer, evaluate = function.buffer()
    arrays = [np.ascontiguousarray(p, dtype=float) for p in point]
    results = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
    for i, array in enumerate(arrays):
        buffer.set_arg(i, memoryview(array))
    for i, array in enumerate(results):
        buffer.set_res(i, memoryview(array))

    def call(_keep=(buffer, arrays, results)):
        evaluate()

    return call
