"""Time of a training step of 16 stacked networks against one ``torch.nn.GRU`` network and against a loop over 16.

``python benchmarks/ensemble_training.py [--z 16 32 64] [--batch 32] [--steps 100] [--rounds 7] [--device cpu]
[--out training.json]``. A training step is what a training does with the network: the sequence forward (one layer,
one linear layer), mean absolute error, backward, AdamW. float64, one thread, the golf robot's number of features.

Routes: ``one`` and ``loop`` (``torch.nn.GRU`` with ``torch.nn.Linear``: one, and one after the other), ``plain`` and
``fused`` (a stack as it trains by default, and ``TrainingSettings(fused=True)``), ``plain_8`` and ``fused_8`` (the half
of it), ``two_plain`` and ``two_fused`` (two processes of 8 at the same time, each on its own core; the slower one
counts). Routes in turn in each round, processor time (on a GPU wall time), best of the rounds; the ratio to ``one``
is that of the bests. The goals are ratios of ``GOALS``.

``memory_mb``: what three training steps add to the largest resident memory of a process that has torch loaded and the
data made, each route in a process of its own; left out on a GPU.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hybrid_mpc import n_features
from hybrid_mpc.identify.networks import StackedGRU
from scenarios.golf_robot import scenario

NETWORKS = 16
GOALS = {16: 3.0, 32: 5.0, 64: 7.0}
N_IN = n_features(scenario.prior(), True)
Step = Callable[[], None]


class Single(nn.Module):
    """What one would write with torch's own layers."""

    def __init__(self, z: int) -> None:
        super().__init__()
        self.gru = nn.GRU(N_IN, z, dtype=torch.float64)
        self.head = nn.Linear(z, 1, dtype=torch.float64)

    def forward(self, s: Tensor) -> Tensor:
        """Outputs ``(T, batch, 1)``."""
        out: Tensor = self.head(self.gru(s)[0])
        return out


def data(steps: int, batch: int, device: str) -> tuple[Tensor, Tensor]:
    """Features and targets ``(T, 1, batch, n)``, the same for all networks."""
    torch.manual_seed(0)
    s, y = (torch.randn(steps, 1, batch, n, dtype=torch.float64) for n in (N_IN, 1))
    return s.to(device), y.to(device)


def singles(z: int, count: int, s: Tensor, y: Tensor) -> Step:
    """A training step of ``count`` networks, one after the other."""
    models = [Single(z).to(s.device) for _ in range(count)]
    optimizers = [torch.optim.AdamW(model.parameters(), lr=1e-4) for model in models]

    def step() -> None:
        for model, optimizer in zip(models, optimizers, strict=True):
            optimizer.zero_grad()
            (model(s[:, 0]) - y[:, 0]).abs().mean().backward()
            optimizer.step()

    return step


def stacked(z: int, count: int, fused: bool, s: Tensor, y: Tensor) -> Step:
    """A training step of ``count`` networks at once."""
    stack = StackedGRU(count, N_IN, z, 1, seed=0, fused=fused).to(s.device)
    optimizer = torch.optim.AdamW(stack.parameters(), lr=1e-4)

    def step() -> None:
        optimizer.zero_grad()
        out, _ = stack.sequence(s, stack.initial(s.shape[2]))
        (out - y).abs().mean(dim=(0, 2, 3)).sum().backward()
        optimizer.step()

    return step


def seconds(step: Step, device: str) -> float:
    """Time of one step: of the processor, or on a GPU by the wall."""
    clock = time.process_time if device == "cpu" else time.perf_counter
    if device != "cpu":
        torch.cuda.synchronize()
    start = clock()
    step()
    if device != "cpu":
        torch.cuda.synchronize()
    return clock() - start


def half(z: int, fused: bool, steps: int, batch: int, rounds: int, start: float) -> float:
    """In a process of its own: the best time of a step of half the networks, from the time ``start`` on."""
    torch.set_num_threads(1)
    step = stacked(z, NETWORKS // 2, fused, *data(steps, batch, "cpu"))
    step()
    time.sleep(max(0.0, start - time.time()))
    return min(seconds(step, "cpu") for _ in range(rounds))


def two(pool: ProcessPoolExecutor, z: int, fused: bool, options: argparse.Namespace) -> float:
    """Two processes of half the networks at the same time: the slower one."""
    start = time.time() + 2.0  # both are ready by then
    job = (z, fused, options.steps, options.batch, options.rounds, start)
    return max(future.result() for future in [pool.submit(half, *job) for _ in range(2)])


def peak_mb() -> float:
    """Largest resident memory of this process so far [MB]."""
    status = Path("/proc/self/status")
    if status.is_file():  # of this program alone, not of the process that started it
        line = next(row for row in status.read_text().splitlines() if row.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    import resource

    per_mb = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / per_mb


def make(route: str, z: int, s: Tensor, y: Tensor) -> Step:
    """The training step of a route whose memory is measured."""
    if route == "one":
        return singles(z, 1, s, y)
    return stacked(z, NETWORKS, route == "fused", s, y)


def added_mb(route: str, z: int, options: argparse.Namespace) -> None:
    """In a process of its own: print what training steps add to the peak."""
    s, y = data(options.steps, options.batch, "cpu")
    make(route, 2, s[:2], y[:2])()  # what torch itself takes when it first works
    before = peak_mb()
    step = make(route, z, s, y)
    for _ in range(3):
        step()
    print(peak_mb() - before)


def memory(z: int, options: argparse.Namespace) -> dict[str, float]:
    """Megabytes that one network and 16 stacked ones take to train."""
    command = [
        sys.executable,
        __file__,
        "--z",
        str(z),
        "--batch",
        str(options.batch),
        "--steps",
        str(options.steps),
    ]
    return {
        route: float(subprocess.check_output([*command, "--memory", route], text=True))
        for route in ("one", "plain", "fused")
    }


def measure(z: int, options: argparse.Namespace, pool: ProcessPoolExecutor | None) -> dict[str, Any]:
    """Milliseconds of all routes at one number of hidden units, and ratios to one network."""
    s, y = data(options.steps, options.batch, options.device)
    routes = {
        "one": singles(z, 1, s, y),
        "loop": singles(z, NETWORKS, s, y),
        "plain": stacked(z, NETWORKS, False, s, y),
        "fused": stacked(z, NETWORKS, True, s, y),
        "plain_8": stacked(z, NETWORKS // 2, False, s, y),
        "fused_8": stacked(z, NETWORKS // 2, True, s, y),
    }
    best = dict.fromkeys(routes, float("inf"))
    for _ in range(options.rounds + 1):  # the first one warms up; as the best counts, it may stay
        for name, step in routes.items():
            best[name] = min(best[name], seconds(step, options.device))
    if pool is not None:
        for name, fused in (("two_plain", False), ("two_fused", True)):
            best[name] = two(pool, z, fused, options)
    ratios = {name: value / best["one"] for name, value in best.items()}
    row = {"ms": {name: 1e3 * value for name, value in best.items()}, "ratio": ratios, "goal": GOALS.get(z)}
    return row if pool is None else {**row, "memory_mb": memory(z, options)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32, 64])
    parser.add_argument("--batch", type=int, default=32, help="windows a step")
    parser.add_argument("--steps", type=int, default=100, help="samples of a window")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--memory", choices=["one", "plain", "fused"], help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.memory:
        added_mb(options.memory, options.z[0], options)
        return
    results: dict[str, Any] = {
        "networks": NETWORKS, "features": N_IN, "batch": options.batch, "samples": options.steps,
        "device": options.device, "torch": torch.__version__, "machine": platform.machine(), "z": {},
    }  # fmt: skip
    if options.device == "cpu":
        with ProcessPoolExecutor(2, get_context("spawn")) as pool:
            results["z"] = {z: measure(z, options, pool) for z in options.z}
    else:
        results["z"] = {z: measure(z, options, None) for z in options.z}
    text = json.dumps(results, indent=1)
    print(text)
    for z, result in results["z"].items():
        print(f"z = {z}: one network {result['ms']['one']:.1f} ms; goal {result['goal']} x")
        for name, ratio in result["ratio"].items():
            print(f"  {name:10}{result['ms'][name]:9.1f} ms{ratio:7.2f} x")
        if "memory_mb" in result:
            print("  memory " + ", ".join(f"{k} {v:.0f} MB" for k, v in result["memory_mb"].items()))
    if options.out:
        options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
