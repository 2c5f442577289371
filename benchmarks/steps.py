"""How long a step of the solvers and a period of the loop take: the golf robot's hybrid model.

``python benchmarks/steps.py [--z 32] [--n 50] [--growth] [--loop [--model DIR]] [--cpu] [--out FILE.json]``. One
core; random weights but with ``--model``, which take the same time.

- ``rti``: prepare and feedback of ``CondensedController``; ``rti_bounds``: with bounds on both states that act,
  ``rti_hard``: with hard ones; ``sqp``: ``SQPController`` to convergence. Whole Python calls, medians and 99 % [ms];
  ``/ mandatory`` is the ratio to the arithmetic that a step of ``rti`` cannot do without, at the speed of ``dgemm``
  measured here;
- ``--growth``: exponents of the times in N (20 to 200) and in z (16 to 256);
- ``--loop``: wall clock of the parts of a period [ms], with four filters and with one: estimator, ``rti`` behind its
  safeguards, monitor;
- ``--cpu``: processor time of the solvers, which leaves out what other work on a busy machine takes.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
from parts import (
    REFERENCE,
    arguments,
    closed_loop,
    deployed,
    hybrid_step,
    median_time,
    problem,
    report,
    solve_times,
)

from hybrid_mpc import (
    CondensedController,
    HardBound,
    SQPController,
    load,
    make_controller,
    make_estimator,
    make_monitor,
    simulate,
)
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

SIGMA_X = (1e-4, 2e-2)
"""Process noise per period [rad, rad/s] where none is given."""
TASKS = ("track_sine", "track_step", "stroke_1.4", "reject_load")
SHARES = {"median": 50, "p95": 95, "p99": 99, "max": 100}


def mandatory_ms(z: int, n: int, clock) -> float:
    """Condensing, its Hessian's half, and the products of the GRU's Jacobians (2 states, 1 input), as ``dgemm``."""
    a = np.random.default_rng(0).normal(size=(400, 400))
    flop = n**2 * (z + 2) ** 2 + 2 * n**3 + n * 12 * z**2
    return 1e3 * flop * median_time(lambda: a @ a, clock) / (2 * 400**3)


def solvers(z: int, n: int, clock) -> list[dict]:
    """The solvers at one size."""
    model, ocp = deployed(hybrid_step(z)), problem(n)
    bounded = problem(n, x_max=[0.55, 1.0], x_min=[-np.inf, -1.0])
    hard = problem(n, hard=[HardBound("x", [-np.inf, -1.0], [0.55, 1.0])])
    states, rti = closed_loop(model, ocp), CondensedController(model, ocp)
    found, plans = solve_times({"rti": rti}, states, clock, rounds=2)
    for name, other in (("rti_bounds", bounded), ("rti_hard", hard)):
        found |= solve_times({name: CondensedController(model, other)}, closed_loop(model, other), clock)[0]
    found |= solve_times({"sqp": SQPController(model, ocp)}, states[:60], clock, rounds=2)[0]
    prepared = rti.prepare(plans["rti"])
    parts = {
        "rti prepare": partial(rti.prepare, plans["rti"]),
        "rti feedback": partial(rti.feedback, prepared, states[-1], REFERENCE),
    }
    least, first = mandatory_ms(z, n, clock), found["rti"]["ms"]
    ms = {name: (row["ms"], row["p99"]) for name, row in found.items()}
    ms |= {name: (1e3 * median_time(call, clock), np.nan) for name, call in parts.items()}
    return [
        {"z": z, "n": n, "solver": name, "ms": t, "p99": p99, "/ rti": t / first, "/ mandatory": t / least}
        for name, (t, p99) in ms.items()
    ]


def growth(clock) -> list[dict]:
    """Exponents: slopes of the logarithms, by least squares."""
    rows = []
    for letter, sizes in (
        ("n", [(32, n) for n in (20, 50, 100, 200)]),
        ("z", [(z, 50) for z in (16, 32, 64, 128, 256)]),
    ):
        times: dict[str, list[float]] = {"rti": [], "sqp": []}
        for z, n in sizes:
            model, ocp = deployed(hybrid_step(z)), problem(n)
            kinds = {"rti": CondensedController(model, ocp), "sqp": SQPController(model, ocp)}
            for name, row in solve_times(kinds, closed_loop(model, ocp)[:30], clock)[0].items():
                times[name].append(row["ms"])
        at = np.log([size[letter == "n"] for size in sizes])
        rows += [
            {
                "grows": letter,
                "solver": name,
                "exponent": float(np.polyfit(at, np.log(ms), 1)[0]),
                "ms": str(ms),
            }
            for name, ms in times.items()
        ]
    return rows


def loop_parts(folder: Path | None, seeds: int) -> list[dict]:
    """Durations of the parts of a period, the first one of a loop left out."""
    if folder is None:
        model, noise = deployed(hybrid_step(32)), {}
        models = {"prior": model, "hybrid": model}
    else:
        kit = load(folder)
        models, noise = kit.models, kit.loop.process_noise
    model, sigma_x, rows = models["hybrid"], np.array(noise.get("hybrid_observer", SIGMA_X)), []
    for kind, observer in (("four filters", True), ("one filter", False)):
        loops = []
        for task in (t for t in scenario.tasks if t.name in TASKS):
            control = task.control or CONTROL
            estimator = make_estimator(model, scenario, sigma_x, control, observer=observer)
            controller = make_controller(model, models["prior"], control)
            for seed in range(seeds):
                result = simulate(
                    scenario.plant(), estimator, controller, task.reference, weight=task.weight, dt=model.dt,
                    duration=task.duration, x0=np.array(task.x0), seed=seed, faults=task.faults,
                    monitor=make_monitor(model),
                )  # fmt: skip
                loops.append({part: spent[1:] for part, spent in result.timing_ms.items()})
        total = np.median(np.concatenate([loop["total"] for loop in loops]))
        for part in ("estimate", "solve", "monitor", "prepare", "total"):
            spent = np.concatenate([loop[part] for loop in loops])
            shares = {f"{key} [ms]": float(np.percentile(spent, share)) for key, share in SHARES.items()}
            ratio = float(np.median(spent) / total)
            rows.append({"estimator": kind, "part": part, **shares, "median / total": ratio})
    return rows


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--z", type=int, nargs="*", default=[32], help="hidden units")
    parser.add_argument("--n", type=int, nargs="+", default=[50], help="horizons")
    parser.add_argument("--growth", action="store_true", help="exponents in N and z too (slow)")
    parser.add_argument("--loop", action="store_true", help="whole periods too")
    parser.add_argument("--model", type=Path, help="artifact folder for --loop")
    parser.add_argument("--seeds", type=int, default=2, help="loops of a task")
    parser.add_argument("--cpu", action="store_true", help="processor time instead of the wall clock's")
    given = parser.parse_args()
    clock = process_time if given.cpu else perf_counter
    rows = [row for z in given.z for n in given.n for row in solvers(z, n, clock)]
    rows += growth(clock) if given.growth else []
    rows += loop_parts(given.model, given.seeds) if given.loop else []
    report(rows, given.out)


if __name__ == "__main__":
    main()
