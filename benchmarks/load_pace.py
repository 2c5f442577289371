"""Other paces of the load estimate in the loops of ``unknown_loops.py``: cost, settled loops, and moves of the input.

    python benchmarks/load_pace.py --names ball_and_beam --steps 0.0006/0.005 0.0008/0.0065 --seeds 10

A pace is ``quiet/slip``: the random walk of every load per period in the quiet and in the slip filter, as shares of the
load's size. Everything else is that of the default observer, the process noise, too. The ratios are paired by seeds:
geometric means with 95 % intervals over the default's loops.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import argparse
import tempfile
from pathlib import Path

import numpy as np
from unknown.loops import Made, Own, Ran, Trial, ran, trials_of
from unknown.motion import MOTION
from unknown.plants import Plant
from unknown.processes import PROCESSES
from unknown_loops import interval, prepared

from hybrid_mpc import ExtendedKalmanFilter, SwitchingFilter
from hybrid_mpc.control.sizes import disturbance_sizes
from hybrid_mpc.estimate.switching import SLIP, SWITCHES, Filter
from hybrid_mpc.kit.assembly import FIRST_LOAD, first_deviations, make_controller
from hybrid_mpc.loop.loop import Loop

JUMP = 0.05
"""Share of the load's size in the jump filter, as in the default observer."""


def observer_of(own: Made, quiet: float, slip: float) -> Filter:
    """The default observer with other random walks of the loads."""
    model, size = own.model, disturbance_sizes(own.model, own.control)

    def filter_of(scale: float, share: float) -> ExtendedKalmanFilter:
        return ExtendedKalmanFilter(
            model, sigma_y=own.sigma, sigma_x=scale * own.noise[0], sigma_x0=first_deviations(model, own.scenario),
            sigma_d=share * size, sigma_d0=FIRST_LOAD * size,
        )  # fmt: skip

    return SwitchingFilter([filter_of(1.0, quiet), filter_of(SLIP, slip), filter_of(1.0, JUMP)], SWITCHES)


def moved(own: Made, loop: Ran) -> float:
    """Sum of the input's moves, over its ranges."""
    return float(np.sum(np.abs(np.diff(loop.u, axis=0)) / (own.control.u_max - own.control.u_min)))


def compared(name: str, plant: Plant, own: Made, trials: list[Trial], steps: list[str]) -> list[str]:
    """Rows of the table: the default observer, then each pace."""
    controller = make_controller(own.model, own.model, own.control, solver="native")
    observers = {"default": own.parts[0]}
    observers |= {one: observer_of(own, *(float(v) for v in one.split("/"))) for one in steps}
    base, rows = list[Ran](), []
    for step, observer in observers.items():
        loops = [ran(plant, own, trial, Own(Loop(observer, controller), own.held)) for trial in trials]
        base = base or loops
        cost = interval([a.cost / b.cost for a, b in zip(loops, base, strict=True)])
        moves = np.mean([moved(own, a) / moved(own, b) for a, b in zip(loops, base, strict=True)])
        settled = sum(loop.settled for loop in loops)
        rows.append(
            f"| {name} | {step} | {settled} of {len(loops)} | {cost[0]:.2f} ({cost[1]:.2f} to {cost[2]:.2f}) "
            f"| {max(loop.cost / b.cost for loop, b in zip(loops, base, strict=True)):.2f} | {moves:.2f} |"
        )
    return rows


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--names", nargs="+", required=True, help="machines")
    parser.add_argument("--steps", nargs="+", required=True, help="paces, quiet/slip")
    parser.add_argument("--seeds", type=int, default=10, help="paired loops of each machine")
    given = parser.parse_args()
    print("| machine | quiet/slip | settled | cost over the default's | largest | moves |\n|" + " --- |" * 6)
    with tempfile.TemporaryDirectory() as folder:
        for machine in (*PROCESSES, *MOTION):
            if machine.name in given.names:
                plant, own = prepared(machine, Path(folder))
                trials = trials_of(machine.name, plant, own, 0, given.seeds)
                print(*compared(machine.name, plant, own, trials, given.steps), sep="\n", flush=True)


if __name__ == "__main__":
    main()
