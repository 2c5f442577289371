"""Closed loops on true plants that differ from the prior: does a new user's loop settle, and what does it cost?

    python benchmarks/unknown_loops.py                                  # 12 textbook machines, and the cases
    python benchmarks/unknown_loops.py --names ship building --seeds 4  # some of them

Of each machine's recordings a new user gets a fitted prior, the control problem that ``hybrid-mpc new`` proposes
(weights on no more outputs than inputs, set-points not known ahead), and the observer and controller of a run.
The loop runs on the plant of the recordings, every parameter of which is 20 % off, up or down, with constant loads at
all inputs: a fifth of the room to a limit. Its rival is PI(D) by SIMC or LQR with integral action and Kalman filter,
designed on the same fitted prior (:mod:`unknown.rivals` says which, by rule); noise, parameters, loads, set-points,
limits, period and measurements are the same for both.

The cost is that of the control problem on the noise-free outputs, a second of time: errors over a twentieth of the
recorded range, squared, and changes of inputs over a tenth of theirs. Both share it: the regulator has these weights,
and the free number of either rule is the one that makes this cost least on the prior. ``error`` is the ratio of the
errors' part alone. A ratio is the geometric mean over seeds with a 95 % interval (paired, by Student's t of the
logarithms).

A loop has settled if in the last 30 % of every set-point the mean error of each controlled output is at most one
standard deviation of its sensor, and the scatter about it at most five, as in a kit's promises.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student
from unknown.case_plants import case_plants
from unknown.cases import Case, cases
from unknown.common import Machine, report
from unknown.loops import Choice, Made, Ran, made, ran, trials_of, tuned_rival
from unknown.motion import MOTION
from unknown.plants import PLANTS, Plant
from unknown.processes import PROCESSES, WHOLE
from unknown_machines import read

from hybrid_mpc import InputError
from hybrid_mpc.kit.disturbances import default_disturbances

HELD = {
    "flexible_shaft": ("load",), "magnetic_levitation": ("gap",), "inverted_pendulum": ("s",),
    "quadruple_tank_levels": ("h1", "h2"), "building_walls": ("T_i",),
}  # fmt: skip
"""Controlled outputs where a machine has more outputs than inputs."""
BOUND = 1.05
"""Largest upper bound of a ratio that is good."""
IN_VIEW = (*(m.name for m in PROCESSES[:3]), *(m.name for m in MOTION[:3]))
"""Machines by which the tool was mended; the others were run once, at the end."""


def prepared(
    machine: Machine, folder: Path, disturbances: Choice = default_disturbances
) -> tuple[Plant, Made]:
    """The plant of a machine, and what a new user gets of its recordings, with other ``disturbances`` if wanted."""
    parts = read(machine.write(folder / machine.name), machine.prior, machine.spec)
    names = [signal.name for signal in machine.prior.outputs]
    held = [names.index(one) for one in HELD.get(machine.name, names)]
    plant = PLANTS[machine.name]
    sigma = np.hypot(plant.sigma, np.array(plant.step) / np.sqrt(12)).tolist()
    own = made(machine.name, machine.prior, machine.spec, parts[0], parts[1], machine.length, sigma, held,
               choice=disturbances)  # fmt: skip
    return plant, own


def of_case(case: Case, plant: Plant) -> Made:
    """What a new user gets of a case, whose scenario has a control problem: one held output an input."""
    own = case.scenario
    assert own.control is not None
    parts = read(case.files, own.prior, own.data)  # type: ignore[arg-type]
    held = list(range(min(own.control.n_u, own.control.n_y)))
    weights = np.where(np.isin(np.arange(own.control.n_y), held), own.control.q_y, 0.0)
    control = own.control.changed(q_y=weights, preview=False)
    sigma = np.maximum(own.sensor_sigma, np.hypot(plant.sigma, np.array(plant.step) / np.sqrt(12)))
    return made(
        case.name, own.prior, own.data, parts[0], parts[1], case.length, sigma.tolist(), held, control
    )  # type: ignore[arg-type]


def interval(ratios: Sequence[float]) -> tuple[float, float, float]:
    """Geometric mean and 95 % interval of finite ratios; NaN of fewer than two."""
    logs = np.log(ratios)
    if len(logs) < 2:
        return float("nan"), float("nan"), float("nan")
    wide = student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    return tuple(float(np.exp(logs.mean() + s * wide)) for s in (0, -1, 1))  # type: ignore[return-value]


def compared(name: str, plant: Plant, own: Made, seeds: int) -> dict[str, Any]:
    """A row of the table."""
    began = time.process_time()
    try:
        _ = own.parts
    except InputError as error:
        return {
            "machine": name,
            "rival": "–",
            "settled": "refused",
            "rival settled": "–",
            "cost": str(error),
            "good": "no",
        }
    make, what = tuned_rival(name, own)
    pairs, offs = list[tuple[Ran, Ran]](), list[float]()
    for trial in trials_of(name, plant, own, 0, seeds):
        offs.append(trial.off)
        pairs.append((ran(plant, own, trial, own.loop()), ran(plant, own, trial, make())))
    both = [(a, b) for a, b in pairs if np.isfinite(a.cost) and np.isfinite(b.cost)]
    mean, low, high = interval([a.cost / b.cost for a, b in both])
    errors = interval([a.error / b.error for a, b in both])
    lost = [sum(not np.isfinite(one[i].cost) for one in pairs) for i in (0, 1)]
    settled = [sum(one[i].settled for one in pairs) for i in (0, 1)]
    return {
        "machine": name,
        "rival": what,
        "settled": f"{settled[0]} of {seeds}",
        "rival settled": f"{settled[1]} of {seeds}",
        "cost": f"{mean:.2f} ({low:.2f} to {high:.2f})",
        "error": f"{errors[0]:.2f} ({errors[1]:.2f} to {errors[2]:.2f})",
        "ran away": f"{lost[0]}, {lost[1]}",
        "off [%]": f"{100 * min(offs):.0f}",
        "good": "yes" if settled[0] == seeds and high <= BOUND else "no",
        "offset": f"{max(float(np.abs(a.offset).max()) for a, _ in pairs):.2f}",
        "scatter": f"{max(float(a.scatter.max()) for a, _ in pairs):.1f}",
        "seconds": f"{time.process_time() - began:.0f}",
    }


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--names", nargs="+", default=(), help="some machines alone")
    parser.add_argument("--only", choices=("all", "in-view", "others"), default="all")
    parser.add_argument("--cases", type=Path, default=Path("../shared/cases"), help="folder of the cases")
    parser.add_argument("--seeds", type=int, default=10, help="paired loops of each machine")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for machine in (*PROCESSES, *MOTION, *(m for m in WHOLE if m.name in given.names)):
            wanted = given.only == "all" or (machine.name in IN_VIEW) == (given.only == "in-view")
            if (given.names and machine.name not in given.names) or not wanted:
                continue
            rows.append(compared(machine.name, *prepared(machine, Path(folder)), given.seeds))
            print(rows[-1], flush=True)
        found, missing = cases(given.cases, Path("no recordings of real machines"), Path(folder))
        plants = case_plants(given.cases)
        print(*(f"left out: {why}" for why in missing), sep="\n")
        for case in found:
            if (
                case.name not in plants
                or given.only == "in-view"
                or (given.names and case.name not in given.names)
            ):
                continue
            rows.append(compared(case.name, plants[case.name], of_case(case, plants[case.name]), given.seeds))
            print(rows[-1], flush=True)
    report(rows, given.out)


if __name__ == "__main__":
    main()
