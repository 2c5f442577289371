"""Other paces of the load estimate in the loops of ``unknown_loops.py``: cost, settled loops, and moves of the input.

    python benchmarks/load_pace.py --names ball_and_beam --steps 0.0006/0.005 0.0008/0.0065 --seeds 10

A pace is ``quiet/slip``: the random walk of every load per period in the quiet and in the slip filter, as shares of the
load's size. Everything else is that of the default observer, the process noise, too. Other ``--steps``:

- ``three``: the default observer without its filter of outliers;
- ``small``: the default observer with jumps of 5 % of every load's size;
- ``rates``: a disturbance at the rate of the state that each output measures;
- ``noise:0.05``: the default observer with noise at the inputs, a share of their ranges per period.

``--outliers 0.01`` puts samples off by 5 to 50 standard deviations in that share of the outputs' samples. The ratios
are paired by seeds: geometric means with 95 % intervals over the default's loops.
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
from unknown.processes import PROCESSES, WHOLE
from unknown_loops import interval, prepared

from hybrid_mpc import Estimate, ExtendedKalmanFilter, SwitchingFilter
from hybrid_mpc.control.sizes import disturbance_sizes
from hybrid_mpc.estimate.switching import OUTLIER, SLIP, SWITCHES, Filter, with_outliers
from hybrid_mpc.kit.assembly import FIRST_LOAD, JUMP, first_deviations, make_controller, make_estimator
from hybrid_mpc.kit.disturbances import rates_of_outputs
from hybrid_mpc.loop.loop import Loop


def filter_of(own: Made, scale: float, share: float, sensor: float = 1.0) -> ExtendedKalmanFilter:
    """A filter of the default observer with another random walk of the loads."""
    model, size = own.model, disturbance_sizes(own.model, own.control)
    return ExtendedKalmanFilter(
        model, sigma_y=sensor * own.sigma, sigma_x=scale * own.noise[0],
        sigma_x0=first_deviations(model, own.scenario), sigma_d=share * size, sigma_d0=FIRST_LOAD * size,
    )  # fmt: skip


def observer_of(own: Made, quiet: float, slip: float) -> Filter:
    """The default observer with other random walks of the loads."""
    shares = (1.0, quiet), (SLIP, slip), (1.0, JUMP), (1.0, quiet, OUTLIER)
    modes = [filter_of(own, *share) for share in shares]
    return SwitchingFilter(modes, with_outliers(SWITCHES))


class Spoiled:
    """An observer whose samples have outliers in a ``share`` of them."""

    def __init__(self, observer: Filter, sigma: np.ndarray, share: float, seed: int) -> None:
        self.observer, self.sigma, self.share, self.rng = observer, sigma, share, np.random.default_rng(seed)

    def __getattr__(self, name: str) -> object:
        return getattr(self.observer, name)

    def update(self, estimate: Estimate, y: np.ndarray, u: np.ndarray, **known: np.ndarray) -> Estimate:
        """The observer's estimate after the spoiled sample."""
        off = self.rng.uniform(5.0, 50.0, len(y)) * self.rng.choice([-1.0, 1.0], len(y)) * self.sigma
        y = y + np.where(self.rng.random(len(y)) < self.share, off, 0.0)
        return self.observer.update(estimate, y, u, **known)


def moved(own: Made, loop: Ran) -> float:
    """Sum of the input's moves, over its ranges."""
    return float(np.sum(np.abs(np.diff(loop.u, axis=0)) / (own.control.u_max - own.control.u_min)))


def compared(
    name: str,
    plant: Plant,
    own: Made,
    other: Made | None,
    trials: list[Trial],
    steps: list[str],
    share: float,
) -> list[str]:
    """Rows of the table: the default observer, then each pace; ``other`` has the disturbances at rates."""
    default = own.parts[0]
    assert isinstance(default, SwitchingFilter)
    observers: dict[str, Filter] = {"default": default}
    for one in steps:
        if one == "rates" and other is not None:
            observers[one] = other.parts[0]
        elif one.startswith("noise:"):
            share_of = float(one.removeprefix("noise:"))
            observers[one] = make_estimator(
                own.model, own.scenario, own.noise[0], own.control, input_noise=share_of
            )
        elif one == "three":
            observers[one] = SwitchingFilter(default.filters[:3], SWITCHES)
        elif one == "small":
            quiet, slip, _, outlier = default.filters
            jump = filter_of(own, 1.0, JUMP)
            observers[one] = SwitchingFilter([quiet, slip, jump, outlier], with_outliers(SWITCHES))
        else:
            observers[one] = observer_of(own, *(float(v) for v in one.split("/")))
    base, rows = list[Ran](), []
    for step, observer in observers.items():
        controller = make_controller(observer.model, observer.model, own.control, solver="native")
        spoiled = [Spoiled(observer, own.sigma, share, i) if share else observer for i in range(len(trials))]
        loops = [
            ran(plant, own, trial, Own(Loop(each, controller), own.held))
            for each, trial in zip(spoiled, trials, strict=True)
        ]
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
    parser.add_argument(
        "--steps", nargs="+", required=True, help="paces, quiet/slip; three, small, rates, noise:SHARE"
    )
    parser.add_argument("--seeds", type=int, default=10, help="paired loops of each machine")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--outliers", type=float, default=0.0, help="share of outliers in the samples")
    given = parser.parse_args()
    print("| machine | quiet/slip | settled | cost over the default's | largest | moves |\n|" + " --- |" * 6)
    with tempfile.TemporaryDirectory() as folder:
        for machine in (*PROCESSES, *MOTION, *WHOLE):
            if machine.name in given.names:
                plant, own = prepared(machine, Path(folder))
                other = (
                    prepared(machine, Path(folder), rates_of_outputs)[1] if "rates" in given.steps else None
                )
                trials = trials_of(machine.name, plant, own, given.first, given.seeds)
                print(
                    *compared(machine.name, plant, own, other, trials, given.steps, given.outliers),
                    sep="\n",
                    flush=True,
                )


if __name__ == "__main__":
    main()
