"""Horizons of the golf robot's step with a GRU: building, running and differentiating N steps.

``python benchmarks/export_horizon.py [--quick] [--z 32] [--n 20 50 100 200] [--out horizon.json]``. One thread,
CasADi's machine, routes in turn in one run, the best of several rounds counts.

Routes: ``inline`` (all N steps of the plain graph written out, what one gets without a step function), ``plain``
(calls of the plain step), ``onnx`` (calls of the step that came through CasADi's ONNX import), ``unroll``
(:func:`nn_export.unroll` of :func:`nn_export.build`), ``fold`` (:func:`nn_export.fold`), ``sx`` (the plain step
expanded to scalars, inline). Of each: the run; the gradient of the squared last state by all inputs; the Jacobian
of the last state by all inputs (both by CasADi). ``linearized`` is ``unroll`` of :func:`nn_export.with_jacobian`:
the run and the Jacobians A_k, B_k of all steps.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import export_parts as parts
import numpy as np
import torch

import nn_export

JACOBIAN_LIMIT = 100
"""Horizon up to which the Jacobian of the last state by all inputs is taken of the inline routes."""


def inline(step: ca.Function, n: int) -> ca.Function:
    """All steps written out in one graph."""
    kind = ca.SX if step.is_a("SXFunction") else ca.MX
    x, h, u = kind.sym("x", parts.N_X), kind.sym("h", step.size1_in(1)), kind.sym("u", parts.N_U, n)
    states, hidden, now = [], [], (x, h)
    for k in range(n):
        now = tuple(step.call([*now, u[:, k]], True, False))
        states.append(now[0])
        hidden.append(now[1])
    return ca.Function("inline", [x, h, u], [ca.horzcat(*states), ca.horzcat(*hidden)])


def derivative(run: ca.Function, jacobian: bool) -> ca.Function:
    """Gradient of the squared last state, or the last state's Jacobian, by all inputs."""
    kind = ca.SX if run.is_a("SXFunction") else ca.MX
    arguments = [kind.sym(name, *run.size_in(i)) for i, name in enumerate(("x", "h", "u"))]
    last = run.call(arguments, kind is ca.SX, False)[0][:, -1]
    u = arguments[2]
    result = ca.densify(ca.jacobian(last, u)) if jacobian else ca.gradient(ca.sumsqr(last), u)
    return ca.Function("derivative", arguments, [result])


def measure(z: int, n: int) -> dict[str, Any]:
    """All routes at one horizon."""
    program = parts.golf_program(z)
    plain, step = nn_export.build(program, plain=True), nn_export.build(program)
    composed = nn_export.with_jacobian(program, {"A": ("x", "h"), "B": ("u",)})
    found: dict[str, Callable[[], ca.Function]] = {
        "inline": lambda: inline(plain, n),
        "plain": lambda: nn_export.unroll(plain, n),
        "unroll": lambda: nn_export.unroll(step, n),
        "fold": lambda: nn_export.fold(step, n),
        "linearized": lambda: nn_export.unroll(composed, n),
    }
    skipped = [parts.l4casadi_reason()]
    scalars = 6 * z * (z + 6) * n
    if scalars <= parts.SX_INSTRUCTIONS:
        found["sx"] = lambda: inline(plain.expand(), n)
    else:
        skipped.append(f"SX: about {scalars} scalar operations, its derivatives take minutes to build")
    if parts.has_onnx():
        imported = parts.onnx_import(plain)
        states = {"x": imported.name_out(0), "h": imported.name_out(1)}
        found["onnx"] = lambda: nn_export.unroll(imported, n, states=states)
    else:
        skipped.append("ONNX: this CasADi has no reader for it")
    runs, derived, rows = {}, {}, {}
    for name, build in found.items():
        runs[name], rows[name] = parts.built(build)
        if name == "linearized":
            continue
        for kind in ("gradient", "jacobian"):
            if kind == "jacobian" and name in ("inline", "sx") and n > JACOBIAN_LIMIT:
                continue
            start = time.perf_counter()
            derived[f"{name} {kind}"] = derivative(runs[name], kind == "jacobian")
            rows[name][f"{kind}_build_ms"] = 1e3 * (time.perf_counter() - start)
    rng = np.random.default_rng(0)
    point = [0.1 * rng.standard_normal(s) for s in (parts.N_X, z, parts.N_U * n)]
    for name, us in parts.best_microseconds(runs | derived, point).items():
        route, _, kind = name.partition(" ")
        rows[route][f"{kind or 'run'}_us"] = us
    ends = {name: np.array(f.call(point)[0])[:, -1] for name, f in runs.items()}
    difference = max(float(np.abs(end - ends["plain"]).max()) for end in ends.values())
    return {"z": z, "n": n, "routes": rows, "difference": difference, "skipped": skipped}


def table(row: dict[str, Any], rate: dict[str, float]) -> str:
    """One horizon as text."""
    value, both = (1e6 * row["n"] * m / rate["dgemv_per_s"] for m in parts.multiply_adds(row["z"]))
    keys = ["build_ms", "graph_MB", "work_kB", "run_us", "gradient_build_ms", "gradient_us"]
    keys += ["jacobian_build_ms", "jacobian_us"]
    lines = [
        f"z = {row['z']}, N = {row['n']}; multiply-adds at dgemv's rate: run {value:.0f} us, linearized {both:.0f} us",
        "  route       build ms  graph MB   work kB    run us  grad. build ms    grad. us  Jac. build ms     Jac. us",
    ]
    for name, cost in row["routes"].items():
        cells = "".join(
            f"{cost[k]:{w}.1f}" if k in cost else f"{'-':>{w}}"
            for k, w in zip(keys, (10, 10, 10, 10, 16, 12, 15, 12), strict=True)
        )
        lines.append(f"  {name:10}{cells}")
    lines.append(f"  largest difference of the last state: {row['difference']:.1e}")
    return "\n".join([*lines, *(f"  left out: {reason}" for reason in row["skipped"])])


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--quick", action="store_true", help="N = 20 and 50 only, z = 8")
    parser.add_argument("--z", type=int, help="hidden units; default 32")
    parser.add_argument("--n", type=int, nargs="+", help="steps; default 20 50 100 200")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rate, rows = parts.rates(), []
    for n in given.n or ([20, 50] if given.quick else [20, 50, 100, 200]):
        rows.append(measure(given.z or (8 if given.quick else 32), n))
        print(table(rows[-1], rate), flush=True)
    if given.out is not None:
        given.out.write_text(json.dumps({"machine": parts.machine(), "rates": rate, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
