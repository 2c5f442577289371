"""One deployed step and its Jacobian, before and after: a GRU beside the golf robot's prior.

``python benchmarks/export_step.py [--quick] [--z 8 16 ...] [--compile] [--out step.json]``. Routes are timed in
turn in one run, one thread, CasADi's machine unless compiled; the best of several rounds counts.

Values: ``value_plain`` (one graph of matrices), ``value`` (:func:`nn_export.build`), ``value_sx`` (expanded to
scalars), ``value_onnx`` (the plain graph by way of CasADi's ONNX export and import), ``value_c`` (``build``, compiled).
Jacobians by (x, h) and u: ``plain``, ``sx``, ``onnx`` (CasADi's derivatives of a call of these), ``inlined`` (of the
plain graph copied into the user's own: CasADi's best way, and the rival that counts), ``casadi`` (CasADi's derivatives
of what ``build`` makes, inlined too), ``composed`` (:func:`nn_export.with_jacobian`), ``c`` (that, compiled).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import export_parts as parts
import numpy as np
import torch

import nn_export

Functions = dict[str, ca.Function]
ONNX_LIMIT = 128
"""Hidden units up to which CasADi reads ONNX in seconds; its time grows faster than the number of weights."""


def routes(
    z: int, program: nn_export.Program, cache: str | None
) -> tuple[dict[str, Callable[[Functions], ca.Function]], list[str]]:
    """How to build each route from those before it, and the reasons for those left out."""
    blocks = {"A": ("x", "h"), "B": ("u",)}
    skipped = [parts.l4casadi_reason()]
    found: dict[str, Callable[[Functions], ca.Function]] = {
        "value_plain": lambda _: nn_export.build(program, plain=True),
        "value": lambda _: nn_export.build(program, "value"),
        "plain": lambda f: parts.by_casadi(f["value_plain"], inline=False),
        "inlined": lambda f: parts.by_casadi(f["value_plain"], inline=True),
        "casadi": lambda f: parts.by_casadi(f["value"], inline=True),
        "composed": lambda _: nn_export.with_jacobian(program, blocks),
    }
    scalars = 6 * z * (z + 6)
    if scalars <= parts.SX_INSTRUCTIONS:
        found["value_sx"] = lambda f: f["value_plain"].expand()
        found["sx"] = lambda f: parts.by_casadi(f["value_sx"], inline=True)
    else:
        skipped.append(f"SX: about {scalars} scalar operations, its Jacobian takes minutes to build")
    if not parts.has_onnx():
        skipped.append("ONNX: this CasADi has no reader for it")
    elif z <= ONNX_LIMIT:
        found["value_onnx"] = lambda f: parts.onnx_import(f["value_plain"])
        found["onnx"] = lambda f: parts.by_casadi(f["value_onnx"], inline=False)
    else:
        skipped.append(f"ONNX: CasADi takes minutes to read it above {ONNX_LIMIT} units")
    if cache is not None:
        found["value_c"] = lambda f: nn_export.compile_function(f["value"], folder=cache)
        found["c"] = lambda f: nn_export.compile_function(f["composed"], folder=cache)
    return found, skipped


def measure(z: int, rate: dict[str, float], cache: str | None) -> dict[str, Any]:
    """All routes at one size."""
    program = parts.golf_program(z)
    found, skipped = routes(z, program, cache)
    functions: Functions = {}
    costs: dict[str, dict[str, float]] = {}
    for name, build in found.items():
        functions[name], costs[name] = parts.built(lambda build=build: build(functions))
    rng = np.random.default_rng(z)
    point = [0.5 * rng.standard_normal(n) for n in (parts.N_X, z, parts.N_U)]
    times = parts.best_microseconds(functions, point)
    needed = dict(zip(("value", "jacobian"), parts.multiply_adds(z), strict=True))
    for name in functions:
        kind = "value" if name.startswith("value") else "jacobian"
        limit = 1e6 * needed[kind] / rate["dgemv_per_s"]
        costs[name] |= {"us": times[name], "times_the_limit": times[name] / limit}
    exact = functions["plain"].call(point)
    worst = {
        name: max(float(ca.norm_inf(ca.vec(a - b))) for a, b in zip(f.call(point), exact, strict=True))
        for name, f in functions.items()
        if not name.startswith("value")
    }
    return {"z": z, "multiply_adds": needed, "routes": costs, "difference": worst, "skipped": skipped}


def table(row: dict[str, Any]) -> str:
    """One size as text."""
    needed = row["multiply_adds"]
    lines = [
        f"z = {row['z']}: {needed['value']} multiply-adds a value, {needed['jacobian']} with the Jacobian"
    ]
    lines.append(
        "  route           time [us]  x limit  build [ms]  graph [MB]  work [kB]  plain / route  inlined / route"
    )
    for name, cost in row["routes"].items():
        value = name.startswith("value")
        rival, best = (row["routes"]["value_plain" if value else key]["us"] for key in ("plain", "inlined"))
        lines.append(
            f"  {name:14}{cost['us']:11.1f}{cost['times_the_limit']:9.1f}{cost['build_ms']:12.1f}"
            f"{cost['graph_MB']:12.2f}{cost['work_kB']:11.1f}{rival / cost['us']:15.1f}"
            f"{best / cost['us']:17.1f}"
        )
    lines.append(f"  largest difference of a Jacobian from plain: {max(row['difference'].values()):.1e}")
    return "\n".join([*lines, *(f"  left out: {reason}" for reason in row["skipped"])])


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--quick", action="store_true", help="z = 8 and 32 only")
    parser.add_argument(
        "--compile", action="store_true", help="also the compiled routes (needs a C compiler)"
    )
    parser.add_argument("--z", type=int, nargs="+", help="hidden units; default 8 16 32 64 128 256")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rate = parts.rates()
    print(f"dgemv {rate['dgemv_per_s'] / 1e9:.2f}, dgemm {rate['dgemm_per_s'] / 1e9:.2f} G multiply-adds/s; "
          "limit: the multiply-adds at the rate of dgemv")  # fmt: skip
    rows = []
    for z in given.z or ([8, 32] if given.quick else [8, 16, 32, 64, 128, 256]):
        with tempfile.TemporaryDirectory() as cache:
            rows.append(measure(z, rate, cache if given.compile else None))
        print(table(rows[-1]), flush=True)
    if given.out is not None:
        given.out.write_text(json.dumps({"machine": parts.machine(), "rates": rate, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
