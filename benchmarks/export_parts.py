"""What the benchmarks of the exporter share: the model, the rivals, the clock, the machine's own rates."""

from __future__ import annotations

import ctypes
import gc
import importlib.util
import math
import platform
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from scipy.linalg import blas

import nn_export
from hybrid_mpc import GRUNetwork, HybridStep, Scaling, n_features
from scenarios.golf_robot import scenario

ROUNDS = 15
N_X, N_U = 2, 1
SX_INSTRUCTIONS = 30_000
"""Scalar graphs above this are skipped: their Jacobians take minutes to build."""


def golf_program(z: int) -> nn_export.Program:
    """One step of the golf robot's prior with a GRU of ``z`` hidden units beside it."""
    torch.manual_seed(z)
    prior = scenario.prior()
    network = GRUNetwork(n_features(prior, True), z, prior.n_q)
    module = HybridStep(prior, network, Scaling((1.0,) * N_X, (1.0,) * N_U, (1.0,), (1.0,)), scenario.data.dt)
    examples = tuple(torch.zeros(n, dtype=torch.float64) for n in (N_X, z, N_U))
    return nn_export.trace(module, examples, output_names=["x_next", "h_next"])


def multiply_adds(z: int) -> tuple[int, int]:
    """What any method has to do: (value, value and Jacobian).

    Value: the cell's six matrices times vectors and the read-out. Jacobian besides: three scaled matrices by
    the hidden state, three by the features, these times the features' slopes by (x, u), and the read-out of all.
    """
    s = n_features(scenario.prior(), True)
    value = 3 * z * (z + s) + z
    return value, value + 3 * z * (z + s) + z * s * (N_X + N_U) + z * (z + N_X + N_U)


def rates() -> dict[str, float]:
    """Multiply-adds a second of one thread, dgemv and dgemm of 256 x 256 (in cache), best of several."""
    a, b, x = (np.asfortranarray(np.random.default_rng(0).random(s)) for s in ((256, 256), (256, 256), 256))
    vector = min(seconds(lambda: blas.dgemv(1.0, a, x), 50) for _ in range(20))
    matrix = min(seconds(lambda: blas.dgemm(1.0, a, b), 5) for _ in range(20))
    return {"dgemv_per_s": 256**2 / vector, "dgemm_per_s": 256**3 / matrix}


def seconds(evaluate: Callable[[], Any], calls: int) -> float:
    """Time of one call."""
    start = time.perf_counter()
    for _ in range(calls):
        evaluate()
    return (time.perf_counter() - start) / calls


class Timed:
    """A function at a point, called without Python's conversions; keeps the arrays it writes."""

    def __init__(self, function: ca.Function, point: list[np.ndarray]) -> None:
        self.buffer, self.evaluate = function.buffer()
        self.point = [np.ascontiguousarray(p, dtype=float) for p in point]
        self.results = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, array in enumerate(self.point):
            self.buffer.set_arg(i, memoryview(array))
        for i, array in enumerate(self.results):
            self.buffer.set_res(i, memoryview(array))
        once = seconds(self.evaluate, 1)
        self.calls = int(np.clip(0.01 / max(once, 1e-9), 1, 200))


def best_microseconds(functions: dict[str, ca.Function], point: list[np.ndarray]) -> dict[str, float]:
    """Time of each, in turn in several rounds; the best counts: other work on the machine only ever adds."""
    timed = {name: Timed(f, point) for name, f in functions.items()}
    best = dict.fromkeys(timed, np.inf)
    for _ in range(ROUNDS):
        for name, t in timed.items():
            best[name] = min(best[name], 1e6 * seconds(t.evaluate, t.calls))
    return best


def built(build: Callable[[], ca.Function]) -> tuple[ca.Function, dict[str, float]]:
    """The function with its build time, the memory its graph holds, and that of one evaluation."""
    before, start = _heap(), time.perf_counter()
    function = build()
    taken = time.perf_counter() - start
    held = (_heap() - before) / 2**20
    return function, {"build_ms": 1e3 * taken, "graph_MB": held, "work_kB": function.sz_w() * 8e-3}


class _Mallinfo(ctypes.Structure):
    """What glibc tells of its heap: ten numbers."""

    _fields_ = [(f"field_{i}", ctypes.c_size_t) for i in range(10)]


def _heap() -> float:
    """Bytes that the C heap has given out; NaN where the C library cannot tell."""
    gc.collect()
    mallinfo = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if mallinfo is None:
        return math.nan
    mallinfo.restype = _Mallinfo
    info = mallinfo()
    return float(info.field_7 + info.field_4)  # in use, and mapped for large arrays


def by_casadi(step: ca.Function, *, inline: bool) -> ca.Function:
    """Values and the Jacobians by (x, h) and by u, as :func:`nn_export.with_jacobian` gives them, by CasADi."""
    kind = ca.SX if step.is_a("SXFunction") else ca.MX
    x, h, u = (kind.sym(name, step.size1_in(i)) for i, name in enumerate(("x", "h", "u")))
    values = step.call([x, h, u], inline, False)
    z = ca.vertcat(*values)
    a = ca.densify(ca.horzcat(ca.jacobian(z, x), ca.jacobian(z, h)))
    return ca.Function("by_casadi", [x, h, u], [*values, a, ca.densify(ca.jacobian(z, u))])


def has_onnx() -> bool:
    """True if this CasADi reads and writes ONNX."""
    return hasattr(ca, "has_graphmodel") and bool(ca.has_graphmodel("onnx"))


def onnx_import(plain: ca.Function) -> ca.Function:
    """The plain graph written as ONNX and read again, both by CasADi."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "step.onnx")
        ca.GraphBuilder(plain, {}).export_onnx(path, {})
        return ca.GraphBuilder(path, {}).create("imported", [], [], {"symbolic": True})


def l4casadi_reason() -> str:
    """Why l4casadi is not among the rivals here."""
    if importlib.util.find_spec("l4casadi") is None:
        return "l4casadi: not installed"
    return "l4casadi: installed, but this benchmark has no route for it"


def machine() -> dict[str, str]:
    """What the numbers were measured with."""
    packages = {name: version(name) for name in ("casadi", "torch", "numpy")}
    return {
        "processor": platform.processor() or platform.machine(),
        "python": platform.python_version(),
        **packages,
    }
