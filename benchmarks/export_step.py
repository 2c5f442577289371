"""How long a deployed step and its Jacobian take, before and after: GRU beside the golf robot, CasADi's VM.

``python benchmarks/export_step.py [--out times.json]``. Routes are timed in turn in one run, the best of
several rounds counts: other work on the machine only ever adds time.

- value_plain, value: the step alone as a plain graph and as ``nn_export.build`` makes it;
- plain: Jacobian by CasADi, of a call of the plain graph;
- casadi: Jacobian by CasADi, of the graph that ``nn_export.build`` makes (cells with exact Jacobians);
- composed: ``nn_export.with_jacobian``.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import casadi as ca
import numpy as np
import torch

import nn_export
from hybrid_mpc.identification.networks import GRUNetwork
from hybrid_mpc.identification.step import HybridStep, Scaling, n_features
from scenarios.golf_robot import scenario

ROUNDS, CALLS = 9, 60


def by_casadi(step: ca.Function, *, inline: bool) -> ca.Function:
    """Values and the two Jacobians as :func:`nn_export.with_jacobian` gives them."""
    x, h, u = (ca.MX.sym(name, step.size1_in(i)) for i, name in enumerate(("x", "h", "u")))
    values = step.call([x, h, u], inline, False)
    z = ca.vertcat(*values)
    a = ca.densify(ca.horzcat(ca.jacobian(z, x), ca.jacobian(z, h)))
    return ca.Function("by_casadi", [x, h, u], [*values, a, ca.densify(ca.jacobian(z, u))])


def call(function: ca.Function, point: list[np.ndarray]):
    """A call without Python's conversions, and the arrays it writes."""
    buffer, evaluate = function.buffer()
    results = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
    for i, array in enumerate(point):
        buffer.set_arg(i, memoryview(array))
    for i, array in enumerate(results):
        buffer.set_res(i, memoryview(array))
    return lambda: (evaluate(), buffer), results


def seconds(evaluate) -> float:
    """Time of one of ``CALLS`` calls."""
    start = time.perf_counter()
    for _ in range(CALLS):
        evaluate()
    return (time.perf_counter() - start) / CALLS


def measure(z: int) -> dict[str, float]:
    """Microseconds by route, and the largest difference of the Jacobians from the plain route."""
    torch.manual_seed(z)
    prior = scenario.prior()

    network = GRUNetwork(n_features(prior, True), z, prior.n_q)
    ones = [(1.0,) * n for n in (len(prior.states), len(prior.inputs), prior.n_q, prior.n_q)]
    module = HybridStep(prior, network, Scaling(*ones), scenario.data.dt)
    examples = tuple(torch.zeros(n, dtype=torch.float64) for n in (len(prior.states), z, len(prior.inputs)))
    program = nn_export.trace(module, examples, output_names=["x_next", "h_next"])
    routes = {
        "value_plain": nn_export.build(program, plain=True),
        "value": nn_export.build(program),
        "plain": by_casadi(nn_export.build(program, plain=True), inline=False),
        "casadi": by_casadi(nn_export.build(program), inline=True),
        "composed": nn_export.with_jacobian(program, {"A": ("x", "h"), "B": ("u",)}),
    }
    rng = np.random.default_rng(z)
    point = [0.5 * rng.standard_normal(x.numel()) for x in examples]
    calls = {name: call(function, point) for name, function in routes.items()}
    best = dict.fromkeys(routes, np.inf)
    for _ in range(ROUNDS):
        for name, (evaluate, _results) in calls.items():
            best[name] = min(best[name], seconds(evaluate))
    pairs = zip(calls["plain"][1], calls["composed"][1], strict=True)
    difference = max(float(np.abs(a - b).max()) for a, b in pairs)
    return {"z": z, **{f"{name}_us": 1e6 * t for name, t in best.items()}, "difference": difference}


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--z", type=int, nargs="+", default=[8, 16, 32, 64], help="hidden units")
    given = parser.parse_args()
    torch.set_num_threads(1)
    print("   z  value_plain  value  plain  casadi  composed [us]  plain/composed  difference")
    rows = []
    for z in given.z:
        row = measure(z)
        rows.append(row)
        times = (
            "{value_plain_us:13.1f}{value_us:7.1f}{plain_us:7.0f}{casadi_us:8.0f}{composed_us:10.1f}".format(
                **row
            )
        )
        ratio = row["plain_us"] / row["composed_us"]
        print(f"{z:4d}{times}{ratio:20.1f}{row['difference']:12.1e}")
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
