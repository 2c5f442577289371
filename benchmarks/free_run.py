"""Speed of free runs [samples/s]: by torch's own operations, by the graph of a training, and exported.

``python benchmarks/free_run.py [--z 16 32 64] [--samples 50] [--rounds 5] [--out FILE.json]``. The golf robot's hybrid
with random weights, 2 stacked networks, 32 runs each: a batch of the training. One core, float64, processor time by
turns, best of the rounds. The samples of all runs count.

- ``torch``, ``graph``: values alone, as in a validation; with ``and gradient`` also the derivative by all weights;
- ``casadi``: the exported step in CasADi's machine, one run in one call; ``compiled``: the same with the step as C
  (``-O3``), left out where there is no compiler.

``difference`` is that of the last states, or of the gradients, to torch's, relative to the largest.
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
from hybrid_mpc.identify.step import Step
from nn_export import compile_function
from scenarios.golf_robot import scenario

NETWORKS, RUNS = 2, 32
X0 = (0.3, 0.0)


def values(free_run, step, held):
    """The last states of all runs."""
    x = torch.tensor(X0, dtype=torch.float64).expand(NETWORKS, RUNS, 2)

    def run():
        with torch.no_grad():
            return free_run(step, x, step.network.initial(RUNS), *held)[-1].numpy()

    return run


def gradients(free_run, step, held):
    """The derivative of a number of all states by all weights."""
    x, weights = (
        torch.tensor(X0, dtype=torch.float64).expand(NETWORKS, RUNS, 2),
        list(step.network.parameters()),
    )

    def run():
        states = free_run(step, x, step.network.initial(RUNS), *held)
        return np.concatenate(
            [g.flatten().numpy() for g in torch.autograd.grad(states.square().mean(), weights)]
        )

    return run


def one_run(step, rest, u, z):
    """A run of an exported step in one call: its last state."""
    sizes = step.size1_in(0), step.size1_in(1)
    both, now = ca.MX.sym("z", sum(sizes)), ca.MX.sym("u")
    inline = step.is_a("MXFunction")
    after = step.call([both[: sizes[0]], both[sizes[0] :], now, *rest], inline, False)
    along = ca.Function("z_step", [both, now], [ca.vertcat(*after)]).mapaccum("run", len(u))
    z0 = np.concatenate([X0, np.zeros(z)])
    return lambda: along(z0, u.T)[:2, -1].full().ravel()


def measure(z: int, samples: int, rounds: int) -> list[dict]:
    """Every route at one size."""
    prior, dt = scenario.prior(), scenario.data.dt
    u = np.random.default_rng(0).uniform(-0.1, 0.1, (samples, 1))  # N m
    held = [
        torch.tensor(a).view(samples, 1, 1, -1).expand(-1, NETWORKS, RUNS, -1)
        for a in (u, np.zeros((samples, 0)))
    ]
    n_in, n_out = n_features(prior, True), len(prior.corrected)
    hybrid = HybridStep(prior, StackedGRU(NETWORKS, n_in, z, n_out, seed=z), SCALING, dt)
    alone = HybridStep(prior, hybrid.network.member(0), SCALING, dt)
    exported = deployed(alone.requires_grad_(False))
    rest = exported.w, exported.p
    own, by_torch, many = HybridStep.free_run, Step.free_run, NETWORKS * RUNS
    routes = {
        "torch": (many, values(by_torch, hybrid, held)),
        "graph": (many, values(own, hybrid, held)),
        "torch and gradient": (many, gradients(by_torch, hybrid, held)),
        "graph and gradient": (many, gradients(own, hybrid, held)),
        "casadi": (1, one_run(exported.step, rest, u, z)),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # there is no compiler
        try:
            routes["compiled"] = (1, one_run(compile_function(exported.step), rest, u, z))
        except RuntimeWarning as reason:
            print(f"compiled: left out, {reason}")
    best = best_times({name: run for name, (_, run) in routes.items()}, rounds, clock=process_time)
    speed = {name: count * samples / best[name] for name, (count, _) in routes.items()}
    exact = {True: routes["torch and gradient"][1](), False: routes["torch"][1]()}
    rows = []
    for name, (count, run) in routes.items():
        want, found = exact["gradient" in name], run()
        same = want if count == many else want[0, 0]
        by = speed["torch and gradient" if "gradient" in name else "torch"]
        rows.append(
            {
                "z": z, "route": name, "samples / s": speed[name], "/ torch": speed[name] / by,
                "difference": float(np.abs(found - same).max() / np.abs(same).max()),
            }
        )  # fmt: skip
    return rows


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32, 64], help="hidden units")
    parser.add_argument("--samples", type=int, default=50, help="samples of a run")
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    report([row for z in given.z for row in measure(z, given.samples, given.rounds)], given.out)


if __name__ == "__main__":
    main()
