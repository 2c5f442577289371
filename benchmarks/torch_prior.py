"""A prior from CasADi in torch: how long a batch takes, forward and with its gradient.

``python benchmarks/torch_prior.py [--quick] [--out prior.json]``. The golf robot's prior, one thread, float64:

- ``torch``: the prior as it was written, in torch;
- ``from_casadi``: the same, exported and brought back by :func:`nn_export.from_casadi`;
- ``machine``, ``operators``: its two ways of evaluation, CasADi's machine and torch operators, forward only.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import export_parts as parts
import torch

import nn_export
from nn_export.batched import Batched
from scenarios.golf_robot import scenario


def measure(batch: int, rounds: int) -> dict[str, float]:
    """Microseconds of each route at one batch size, in turn; the best of several rounds."""
    prior = scenario.prior()
    inputs = torch.zeros(parts.N_X), torch.zeros(parts.N_U)
    function = nn_export.to_casadi(prior, inputs)
    module, batched = nn_export.from_casadi(function), Batched(function)
    torch.manual_seed(0)
    x, u = (torch.randn(batch, n, dtype=torch.float64, requires_grad=True) for n in (parts.N_X, parts.N_U))
    plain = [x.detach(), u.detach()]

    def gradient(f: torch.nn.Module) -> None:
        torch.autograd.grad(f(x, u).sum(), (x, u))

    routes = {
        "torch": lambda: prior(x, u),
        "from_casadi": lambda: module(x, u),
        "torch_gradient": lambda: gradient(prior),
        "from_casadi_gradient": lambda: gradient(module),
        "machine": lambda: batched._run(plain, batch),
        "operators": lambda: batched.walk(plain),
    }
    best = dict.fromkeys(routes, float("inf"))
    for _ in range(rounds):
        for name, route in routes.items():
            route()
            best[name] = min(best[name], 1e6 * parts.seconds(route, 20))
    difference = float((prior(x, u) - module(x, u)).abs().max())
    return {"batch": batch, **best, "difference": difference}


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--quick", action="store_true", help="batches of 1 and 512 only")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for batch in (1, 512) if given.quick else (1, 16, 128, 256, 512, 1024, 4096):
        rows.append(measure(batch, 7))
        if len(rows) == 1:
            print("".join(f"{name:>22}" for name in rows[0]), "[us]")
        print("".join(f"{value:22.4g}" for value in rows[-1].values()), flush=True)
    if given.out is not None:
        given.out.write_text(json.dumps({"machine": parts.machine(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
