"""The exporter's routes by turns: a step and its Jacobian, a horizon, a prior back in torch.

``python benchmarks/export.py [--only step horizon torch] [--z 32] [--n 20 50 100 200] [--compile] [--out FILE.json]``.
The golf robot's prior with a GRU of z random units; one thread, CasADi's machine unless compiled, the best of 15
rounds [us]. ``difference`` is the largest one to the first route.

- ``step``: values ``value_plain`` (a graph of matrices), ``value`` (:func:`nn_export.build`), ``value_sx`` (expanded to
  scalars), ``value_c`` (``build``, compiled). Jacobians by (x, h) and u: ``plain``, ``sx`` (CasADi's derivatives of a
  call of these), ``inlined`` (of the plain graph copied into the user's own: CasADi's best way, the rival that counts),
  ``casadi`` (CasADi's derivatives of what ``build`` makes, inlined too), ``composed`` (``with_jacobian``),
  ``c`` (that, compiled), ``onnx`` (through CasADi's ONNX export and import);
- ``horizon``: ``inline`` (N steps of the plain graph written out), ``plain`` (calls of the plain step), ``unroll``,
  ``fold`` and ``linearized`` (:func:`nn_export.unroll` of ``with_jacobian``); ``gradient`` is that of the squared last
  state by all inputs, by CasADi;
- ``torch``: rates of a prior as they are written in torch against :func:`nn_export.from_casadi` of the exported one,
  forward and with its gradient; ``machine`` and ``operators`` are its two ways of evaluation.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import perf_counter

import casadi as ca
import numpy as np
import torch
from parts import arguments, best_times, buffered, hybrid_step, report

import nn_export
from nn_export.batched import Batched

N_X, N_U, ROUNDS = 2, 1, 15
PARTS = ("step", "horizon", "torch")
BLOCKS = {"A": ("x", "h"), "B": ("u",)}
SX_OPERATIONS = 30_000
"""Scalar graphs above this are skipped: their Jacobians take minutes to build."""
ONNX_UNITS = 128
"""Hidden units up to which CasADi reads ONNX in seconds."""


class Undisturbed(torch.nn.Module):
    """A step over (x, h, u): no disturbance is measured."""

    def __init__(self, step: torch.nn.Module) -> None:
        super().__init__()
        self.step = step

    def forward(self, x: torch.Tensor, h: torch.Tensor, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Next states."""
        return self.step(x, h, u, u[..., :0])


class Rates(torch.nn.Module):
    """Rates of a pendulum with dry friction, as a prior has them."""

    def forward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """Rates of q and v."""
        q, v = x[..., :1], x[..., 1:]
        torque = u - 2.0 * torch.sin(q) - 0.05 * v - 0.2 * torch.tanh(v / 0.05)
        return torch.cat([v, torque / 0.15], -1)


def program_of(z: int) -> nn_export.Program:
    """The traced step over (x, h, u)."""
    examples = tuple(torch.zeros(n, dtype=torch.float64) for n in (N_X, z, N_U))
    return nn_export.trace(Undisturbed(hybrid_step(z)), examples, output_names=["x_next", "h_next"])


def by_casadi(step: ca.Function, inline: bool) -> ca.Function:
    """Values and Jacobians as :func:`nn_export.with_jacobian` gives them, by CasADi."""
    kind = ca.SX if step.is_a("SXFunction") else ca.MX
    x, h, u = (kind.sym(name, step.size1_in(i)) for i, name in enumerate(("x", "h", "u")))
    values = step.call([x, h, u], inline, False)
    z = ca.vertcat(*values)
    a = ca.densify(ca.horzcat(ca.jacobian(z, x), ca.jacobian(z, h)))
    return ca.Function("by_casadi", [x, h, u], [*values, a, ca.densify(ca.jacobian(z, u))])


def through_onnx(plain: ca.Function) -> ca.Function:
    """The plain graph written as ONNX and read again, both by CasADi."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "step.onnx")
        ca.GraphBuilder(plain, {}).export_onnx(path, {})
        return ca.GraphBuilder(path, {}).create("imported", [], [], {"symbolic": True})


def timed(functions: dict[str, ca.Function], point) -> dict[str, float]:
    """Microseconds of each."""
    best = best_times({name: buffered(f, point) for name, f in functions.items()}, ROUNDS, calls=20)
    return {name: 1e6 * seconds for name, seconds in best.items()}


def difference(function: ca.Function, exact: ca.Function, point) -> float:
    """Largest difference of two functions' outputs."""
    pairs = zip(function.call(point), exact.call(point), strict=True)
    return max(float(ca.norm_inf(ca.vec(a - b))) for a, b in pairs)


def step_rows(z: int, compiled: bool) -> list[dict]:
    """All routes of a step at one size."""
    program, built = program_of(z), {}

    def add(name, build):
        begin = perf_counter()
        built[name] = build(), 1e3 * (perf_counter() - begin)
        return built[name][0]

    plain = add("value_plain", lambda: nn_export.build(program, plain=True))
    value = add("value", lambda: nn_export.build(program, "value"))
    add("inlined", lambda: by_casadi(plain, True))
    add("plain", lambda: by_casadi(plain, False))
    add("casadi", lambda: by_casadi(value, True))
    composed = add("composed", lambda: nn_export.with_jacobian(program, BLOCKS))
    if 6 * z * (z + 6) <= SX_OPERATIONS:
        scalars = add("value_sx", plain.expand)
        add("sx", lambda: by_casadi(scalars, True))
    if z <= ONNX_UNITS and hasattr(ca, "has_graphmodel") and ca.has_graphmodel("onnx"):
        add("onnx", lambda: by_casadi(through_onnx(plain), False))
    with tempfile.TemporaryDirectory() as cache:
        if compiled:
            add("value_c", lambda: nn_export.compile_function(value, folder=cache))
            add("c", lambda: nn_export.compile_function(composed, folder=cache))
        rng = np.random.default_rng(z)
        point = [0.5 * rng.standard_normal(n) for n in (N_X, z, N_U)]
        us, rows = timed({name: f for name, (f, _) in built.items()}, point), []
        for name, (f, build_ms) in built.items():
            best = "value_plain" if name.startswith("value") else "inlined"
            rows.append({
                "z": z, "route": name, "us": us[name], "plain or inlined / it": us[best] / us[name],
                "build_ms": build_ms, "difference": difference(f, built[best][0], point),
            })  # fmt: skip
    return rows


def inline(step: ca.Function, n: int) -> ca.Function:
    """All steps written out in one graph."""
    x, h, u = ca.MX.sym("x", N_X), ca.MX.sym("h", step.size1_in(1)), ca.MX.sym("u", N_U, n)
    states, now = [], (x, h)
    for k in range(n):
        now = tuple(step.call([*now, u[:, k]], True, False))
        states.append(now[0])
    return ca.Function("inline", [x, h, u], [ca.horzcat(*states)])


def gradient(run: ca.Function) -> ca.Function:
    """Gradient of the squared last state by all inputs."""
    x, h, u = (ca.MX.sym(name, *run.size_in(i)) for i, name in enumerate(("x", "h", "u")))
    return ca.Function("gradient", [x, h, u], [ca.gradient(ca.sumsqr(run.call([x, h, u])[0][:, -1]), u)])


def horizon_rows(z: int, n: int) -> list[dict]:
    """All routes along one horizon."""
    program = program_of(z)
    plain, step = nn_export.build(program, plain=True), nn_export.build(program)
    composed, runs, build_ms = nn_export.with_jacobian(program, BLOCKS), {}, {}
    for name, build in {
        "inline": lambda: inline(plain, n),
        "plain": lambda: nn_export.unroll(plain, n),
        "unroll": lambda: nn_export.unroll(step, n),
        "fold": lambda: nn_export.fold(step, n),
        "linearized": lambda: nn_export.unroll(composed, n),
    }.items():
        begin = perf_counter()
        runs[name] = build()
        build_ms[name] = 1e3 * (perf_counter() - begin)
    gradients = {f"{name} gradient": gradient(run) for name, run in runs.items() if name != "linearized"}
    rng = np.random.default_rng(0)
    point = [0.1 * rng.standard_normal(s) for s in (N_X, z, N_U * n)]
    us = timed(runs | gradients, point)
    ends = {name: run.call(point)[0].full()[:, -1] for name, run in runs.items()}
    return [
        {
            "z": z, "N": n, "route": name, "build_ms": build_ms[name], "run_us": us[name],
            "inline / it": us["inline"] / us[name], "gradient_us": us.get(f"{name} gradient", "-"),
            "difference": float(np.abs(ends[name] - ends["inline"]).max()),
        }
        for name in runs
    ]  # fmt: skip


def torch_row(batch: int) -> dict:
    """A batch through the prior."""
    prior = Rates()
    function = nn_export.to_casadi(prior, (torch.zeros(N_X), torch.zeros(N_U)))
    module, batched = nn_export.from_casadi(function), Batched(function)
    torch.manual_seed(0)
    x, u = (torch.randn(batch, n, dtype=torch.float64, requires_grad=True) for n in (N_X, N_U))
    plain = [x.detach(), u.detach()]
    routes = {
        "torch": lambda: prior(x, u),
        "from_casadi": lambda: module(x, u),
        "torch_gradient": lambda: torch.autograd.grad(prior(x, u).sum(), (x, u)),
        "from_casadi_gradient": lambda: torch.autograd.grad(module(x, u).sum(), (x, u)),
        "machine": lambda: batched._run(plain, batch),
        "operators": lambda: batched.walk(plain, (batch,)),
    }
    us = {name: 1e6 * seconds for name, seconds in best_times(routes, 7, calls=20).items()}
    ratio = us["from_casadi_gradient"] / us["torch_gradient"]
    worst = float((prior(x, u) - module(x, u)).detach().abs().max())
    return {"batch": batch, **us, "gradients: from_casadi / torch": ratio, "difference": worst}


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts")
    parser.add_argument("--z", type=int, nargs="+", default=[32], help="hidden units")
    parser.add_argument("--n", type=int, nargs="+", default=[20, 50, 100, 200], help="steps of a horizon")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 16, 128, 512, 1024, 4096])
    parser.add_argument("--compile", action="store_true", help="compiled routes too (needs a C compiler)")
    given, rows = parser.parse_args(), []
    if "step" in given.only:
        rows += [row for z in given.z for row in step_rows(z, given.compile)]
    if "horizon" in given.only:
        rows += [row for z in given.z for n in given.n for row in horizon_rows(z, n)]
    if "torch" in given.only:
        rows += [torch_row(batch) for batch in given.batch]
    report(rows, given.out)


if __name__ == "__main__":
    main()
