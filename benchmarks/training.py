"""Time of a training step of 16 stacked networks against one ``torch.nn.GRU`` network and a loop over 16.

``python benchmarks/training.py [--z 16 32 64] [--batch 32] [--steps 100] [--rounds 7] [--device cpu]``.
A step is what a training does with the network: the sequence forward (one GRU layer, one linear layer), mean absolute
error, backward, AdamW; float64, one thread, the golf robot's number of features. Processor time (on a GPU wall time),
by turns, best of the rounds.
"""

from __future__ import annotations

from time import perf_counter, process_time

import torch
from parts import arguments, best_times, report
from torch import Tensor, nn

from hybrid_mpc import n_features
from hybrid_mpc.identify.networks import StackedGRU
from scenarios.golf_robot import scenario

NETWORKS = 16
N_IN = n_features(scenario.prior(), True)


class Single(nn.Module):
    """What one would write with torch's own layers."""

    def __init__(self, z: int) -> None:
        super().__init__()
        self.gru = nn.GRU(N_IN, z, dtype=torch.float64)
        self.head = nn.Linear(z, 1, dtype=torch.float64)

    def forward(self, s: Tensor) -> Tensor:
        """Outputs ``(T, batch, 1)``."""
        return self.head(self.gru(s)[0])


def singles(z: int, count: int, s: Tensor, y: Tensor):
    """A training step of ``count`` networks, one after the other."""
    models = [Single(z).to(s.device) for _ in range(count)]
    optimizers = [torch.optim.AdamW(model.parameters(), lr=1e-4) for model in models]

    def step() -> None:
        for model, optimizer in zip(models, optimizers, strict=True):
            optimizer.zero_grad()
            (model(s[:, 0]) - y[:, 0]).abs().mean().backward()
            optimizer.step()

    return step


def stacked(z: int, count: int, s: Tensor, y: Tensor):
    """A training step of ``count`` networks at once."""
    stack = StackedGRU(count, N_IN, z, 1, seed=0).to(s.device)
    optimizer = torch.optim.AdamW(stack.parameters(), lr=1e-4)

    def step() -> None:
        optimizer.zero_grad()
        out, _ = stack.sequence(s, stack.initial(s.shape[2]))
        (out - y).abs().mean(dim=(0, 2, 3)).sum().backward()
        optimizer.step()

    return step


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32, 64], help="hidden units")
    parser.add_argument("--batch", type=int, default=32, help="windows a step")
    parser.add_argument("--steps", type=int, default=100, help="samples of a window")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--device", default="cpu")
    given, rows = parser.parse_args(), []
    on_gpu = given.device != "cpu"

    def waited(step):
        """On a GPU the time ends when the GPU has ended."""
        return (lambda: (step(), torch.cuda.synchronize())) if on_gpu else step

    torch.manual_seed(0)
    s, y = (
        torch.randn(given.steps, 1, given.batch, n, dtype=torch.float64).to(given.device) for n in (N_IN, 1)
    )
    for z in given.z:
        routes = {
            "one": singles(z, 1, s, y),
            "loop": singles(z, NETWORKS, s, y),
            "stack": stacked(z, NETWORKS, s, y),
            "half a stack": stacked(z, NETWORKS // 2, s, y),
        }
        routes = {name: waited(step) for name, step in routes.items()}
        best = best_times(routes, given.rounds, clock=perf_counter if on_gpu else process_time)
        rows += [{"z": z, "route": name, "ms": 1e3 * t, "/ one": t / best["one"]} for name, t in best.items()]
    report(rows, given.out)


if __name__ == "__main__":
    main()
