"""Speed of free runs [samples/s]: torch, CasADi's machine and compiled C, the golf robot's hybrid, random weights.

``python benchmarks/free_run.py [--z 16 32 64] [--samples 200] [--rounds 5] [--out free_run.json]``. One core, float64.
A sample is one step of the hybrid: features, GRU, Runge-Kutta on prior and correction; each step starts where the
last one ended. All routes have the same weights and input (steps of torque).

- ``torch_one``: one network, one run; ``torch_16``: 16 stacked networks, one run each; ``torch_16x32``: 16 networks,
  32 runs each, what a validation does; without gradients. The samples of all runs count;
- ``casadi``: the exported step in CasADi's machine, the whole run in one call (``mapaccum``);
- ``compiled``: the same with the step as C (``-O3``); left out where there is no compiler.

Routes in turn in each round, processor time, best of the rounds. ``difference`` is that of the last state to
``torch_one``'s, the largest over routes, relative to the largest state.
"""

from __future__ import annotations

import argparse
import json
import platform
import tempfile
import time
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import torch

from hybrid_mpc import HybridStep, Scaling, load, model_info, n_features, save_artifact, trace_model
from hybrid_mpc.identify.networks import StackedGRU
from nn_export import compile_function
from scenarios.golf_robot import scenario

NETWORKS, RUNS = 16, 32
SCALING = Scaling(x=(0.5, 1.5), u=(0.2,), acceleration=(5.0,), correction=(0.5,))
X0 = (0.3, 0.0)


def torques(samples):
    """Steps of torque [N m] ``(samples, 1)``, a new one every 20 samples."""
    rng = np.random.default_rng(0)
    return np.repeat(rng.uniform(-0.1, 0.1, samples // 20 + 1), 20)[:samples, None]


def torch_run(step, h, u, *shape):
    """A free run of a network or a stack: a function that returns the last states."""
    x0 = torch.tensor(X0, dtype=torch.float64).expand(*shape, 2)
    inputs = [torch.tensor(row, dtype=torch.float64).expand(*shape, 1) for row in u]

    def run():
        x, hidden = x0, h
        with torch.no_grad():
            for row in inputs:
                x, hidden = step(x, hidden, row)
        return x.reshape(-1, 2)[0].numpy()

    return run


def exported(step):
    """The step as CasADi runs it, over state and hidden state in one column."""
    program = trace_model(step.requires_grad_(False))
    with tempfile.TemporaryDirectory() as folder:
        info = model_info(step.prior, step.dt)
        save_artifact(Path(folder) / "model", {"hybrid": program}, info)
        model = load(Path(folder) / "model").models["hybrid"]
    z, u = ca.MX.sym("z", model.n_x + model.n_h), ca.MX.sym("u", model.n_u)
    inline = model.step.is_a("MXFunction")
    after = model.step.call([z[: model.n_x], z[model.n_x :], u, model.w, model.p], inline, False)
    return ca.Function("z_step", [z, u], [ca.vertcat(*after)])


def compiled_or_none(step):
    """The step as C, or None without a compiler."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return compile_function(step)
        except RuntimeWarning:
            return None


def casadi_run(step, z, u):
    """A free run in one call."""
    along, z0 = step.mapaccum("run", len(u)), np.concatenate([X0, np.zeros(z)])
    return lambda: along(z0, u.T)[:2, -1].full().ravel()


def measure(z, samples, rounds):
    """Samples a second of every route."""
    prior, dt, u = scenario.prior(), scenario.data.dt, torques(samples)
    stack = StackedGRU(NETWORKS, n_features(prior, True), z, prior.n_q, seed=z)
    one, many = (HybridStep(prior, network, SCALING, dt) for network in (stack.member(0), stack))
    step = exported(one)
    routes = {
        "torch_one": (1, torch_run(one, torch.zeros(z, dtype=torch.float64), u)),
        "torch_16": (NETWORKS, torch_run(many, stack.initial(1), u, NETWORKS, 1)),
        "torch_16x32": (NETWORKS * RUNS, torch_run(many, stack.initial(RUNS), u, NETWORKS, RUNS)),
        "casadi": (1, casadi_run(step, z, u)),
    }
    if (fast := compiled_or_none(step)) is not None:
        routes["compiled"] = (1, casadi_run(fast, z, u))
    last, best = {}, dict.fromkeys(routes, float("inf"))
    for _ in range(rounds + 1):  # the first one warms up; as the best counts, it may stay
        for name, (_, run) in routes.items():
            start = time.process_time()
            last[name] = run()
            best[name] = min(best[name], time.process_time() - start)
    scale = np.abs(last["torch_one"]).max()
    return {
        "z": z,
        "samples_per_s": {name: count * samples / best[name] for name, (count, _) in routes.items()},
        "difference": float(np.max([np.abs(x - last["torch_one"]) for x in last.values()]) / scale),
    }


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32, 64])
    parser.add_argument("--samples", type=int, default=200, help="samples of a run")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = {
        "samples": options.samples, "dt_s": scenario.data.dt, "clock": "processor", "torch": torch.__version__,
        "casadi": ca.__version__, "machine": platform.machine(), "rows": [],
    }  # fmt: skip
    for z in options.z:
        row = measure(z, options.samples, options.rounds)
        results["rows"].append(row)
        speeds = row["samples_per_s"]
        print(f"z = {z}, difference {row['difference']:.1e}")
        for name, speed in speeds.items():
            ratio, times = speed / speeds["torch_one"], speed * scenario.data.dt
            print(
                f"  {name:12}{speed:12.0f} samples/s{ratio:8.1f} x{times:10.0f} times real time", flush=True
            )
    if options.out:
        options.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
