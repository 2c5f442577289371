"""Speed of free runs [samples/s]: torch, CasADi's machine and compiled C, the golf robot's hybrid, random weights.

``python benchmarks/free_run.py [--z 16 32 64] [--samples 200] [--rounds 5] [--out FILE.json]``. One core, float64,
processor time by turns, best of the rounds. A sample is one step of the hybrid, which starts where the last one ended;
all routes have the same weights and input.

- ``torch_one``: one network, one run; ``torch_16``: 16 stacked networks, one run each; ``torch_16x32``: 32 runs each,
  what a validation does; without gradients. The samples of all runs count;
- ``casadi``: the exported step in CasADi's machine, the whole run in one call; ``compiled``: the same with the step as
  C (``-O3``), left out where there is no compiler.

``difference`` is that of the last state to ``torch_one``'s, relative to the largest state.
"""

from __future__ import annotations

import warnings
from time import process_time

import casadi as ca
import numpy as np
import torch
from parts import SCALING, arguments, best_times, deployed, report

from hybrid_mpc import HybridStep, n_features
from hybrid_mpc.identify.networks import StackedGRU
from nn_export import compile_function
from scenarios.golf_robot import scenario

NETWORKS, RUNS = 16, 32
X0 = (0.3, 0.0)


def torch_run(step, h, u, *shape):
    """A free run of a network or a stack: a function that returns the last state of the first."""
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
    model = deployed(step.requires_grad_(False))
    z, u = ca.MX.sym("z", model.n_x + model.n_h), ca.MX.sym("u", model.n_u)
    inline = model.step.is_a("MXFunction")
    after = model.step.call([z[: model.n_x], z[model.n_x :], u, model.w, model.p], inline, False)
    return ca.Function("z_step", [z, u], [ca.vertcat(*after)])


def casadi_run(step, z, u):
    """A free run in one call."""
    along, z0 = step.mapaccum("run", len(u)), np.concatenate([X0, np.zeros(z)])
    return lambda: along(z0, u.T)[:2, -1].full().ravel()


def measure(z: int, samples: int, rounds: int) -> list[dict]:
    """Every route at one size."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-0.1, 0.1, samples // 20 + 1), 20)[:samples, None]  # N m, new every 20 samples
    prior, dt = scenario.prior(), scenario.data.dt
    stack = StackedGRU(NETWORKS, n_features(prior, True), z, prior.n_q, seed=z)
    one, many = (HybridStep(prior, network, SCALING, dt) for network in (stack.member(0), stack))
    step = exported(one)
    routes = {
        "torch_one": (1, torch_run(one, torch.zeros(z, dtype=torch.float64), u)),
        "torch_16": (NETWORKS, torch_run(many, stack.initial(1), u, NETWORKS, 1)),
        "torch_16x32": (NETWORKS * RUNS, torch_run(many, stack.initial(RUNS), u, NETWORKS, RUNS)),
        "casadi": (1, casadi_run(step, z, u)),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # there is no compiler
        try:
            routes["compiled"] = (1, casadi_run(compile_function(step), z, u))
        except RuntimeWarning as reason:
            print(f"compiled: left out, {reason}")
    best = best_times({name: run for name, (_, run) in routes.items()}, rounds, clock=process_time)
    speed = {name: count * samples / best[name] for name, (count, _) in routes.items()}
    exact = routes["torch_one"][1]()
    return [
        {
            "z": z, "route": name, "samples / s": speed[name], "/ torch_one": speed[name] / speed["torch_one"],
            "times real time": speed[name] * dt, "difference": float(np.abs(run() - exact).max() / np.abs(exact).max()),
        }
        for name, (_, run) in routes.items()
    ]  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32, 64], help="hidden units")
    parser.add_argument("--samples", type=int, default=200, help="samples of a run")
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    report([row for z in given.z for row in measure(z, given.samples, given.rounds)], given.out)


if __name__ == "__main__":
    main()
