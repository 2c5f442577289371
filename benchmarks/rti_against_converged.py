"""What one real-time iteration a period costs in closed loop: rti against converged sqp and ipopt.

``python benchmarks/rti_against_converged.py --model DIR [--task NAME ...] [--seeds 5]
[--solver sqp ...] [--ipopt-seeds 1] [--out FILE.json]``. The golf robot's tasks under the hybrid's observer and
controller; the cost is that of the rig's true state. All solvers have the same problem, estimator, sensor noise (seed
by seed), first plan (converged) and safeguards; only what happens within a period differs: one linearization
(``rti``), two or five (``rti2``, ``rti5``), convergence with the dynamics' second derivatives (``sqp``), IPOPT with
exact ones. Printed by task: the mean cost of ``rti`` and, for each other solver, the ratio of the mean costs
J_rti / J_solver with its 95 % interval from the differences seed by seed (Student's t), and the range of single seeds'
ratios: above 1 the single iteration is dearer. IPOPT runs ``--ipopt-seeds``
seeds, since it is a hundred times slower. ``--finer 64`` gives the rig 64 times the encoder's counts and no noise.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy import stats

from hybrid_mpc import (
    CondensedController,
    IpoptController,
    SafeController,
    SQPController,
    load,
    make_estimator,
    make_ocp,
    simulate,
)
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

SIGMA_X = (1e-4, 2e-2)
"""Process noise per period [rad, rad/s] where none is given."""
TASKS = ("track_sine", "track_step", "stroke_1.4", "reject_load")
SOLVERS = {
    "rti": lambda model, ocp: CondensedController(model, ocp),
    "rti2": lambda model, ocp: CondensedController(model, ocp, iterations=2),
    "rti5": lambda model, ocp: CondensedController(model, ocp, iterations=5),
    "sqp": lambda model, ocp: SQPController(model, ocp),
    "ipopt": lambda model, ocp: IpoptController(model, ocp),
}


def rig(finer: int):
    """The plant, on request with a finer encoder without noise."""
    plant = scenario.plant()
    counts = finer * plant.parameters.counts
    return (
        plant
        if finer == 1
        else replace(plant, parameters=replace(plant.parameters, counts=counts, noise=0.0))
    )


def looped(models, task, name: str, sigma_x, seeds, finer: int = 1) -> list[dict]:
    """Loops of a task with a solver; the controller is built once."""
    model, control, rows = models["hybrid"], task.control or CONTROL, []
    ocp = make_ocp(models["prior"], control)
    safe = SafeController(SOLVERS[name](model, ocp), models["prior"], first=SQPController(model, ocp))
    for seed in seeds:
        begin = perf_counter()
        result = simulate(
            rig(finer), make_estimator(model, scenario, np.array(sigma_x), control), safe, task.reference,
            weight=task.weight, dt=model.dt, duration=task.duration, x0=np.array(task.x0), seed=seed,
            faults=task.faults,
        )  # fmt: skip
        figures = task.figures(result) if task.figures is not None else {}
        rows.append(
            {
                "task": task.name, "solver": name, "seed": seed, "cost": result.cost,
                "solved": result.source.count("MPC") / len(result.source),
                "not_converged": result.status.count("STOPPED"),
                "solve_ms": float(np.median(result.timing_ms["solve"])), "figures": figures,
                "wall_s": perf_counter() - begin,
            }
        )  # fmt: skip
    return rows


def pairs(rows: list[dict], task: str, solver: str) -> tuple[np.ndarray, np.ndarray]:
    """Costs of ``rti`` and of a solver, seed by seed."""
    cost = {(r["solver"], r["seed"]): r["cost"] for r in rows if r["task"] == task}
    both = [(cost["rti", seed], value) for (name, seed), value in cost.items() if name == solver]
    return tuple(np.array(both).T)


def half_width(one: np.ndarray, other: np.ndarray) -> float:
    """Half the 95 % interval of the ratio of their means, from paired differences; NaN for one pair."""
    n = one.size
    if n < 2:
        return float("nan")
    return float(stats.t.ppf(0.975, n - 1) * np.std(one - other, ddof=1) / np.sqrt(n) / other.mean())


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder")
    parser.add_argument("--task", nargs="+", default=TASKS, choices=[t.name for t in scenario.tasks])
    parser.add_argument("--solver", nargs="*", default=["sqp"], choices=[s for s in SOLVERS if s != "rti"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--ipopt-seeds", type=int, default=1)
    parser.add_argument("--finer", type=int, default=1, help="times the encoder's counts, then without noise")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    kit, rows = load(given.model), []
    models, noise = kit.models, kit.loop.process_noise
    sigma_x = noise.get("hybrid_observer", SIGMA_X)
    print("| task | J rti | against | seeds | ratio of means | range | solve [ms] |")
    print("| --- | ---: | --- | ---: | ---: | --- | ---: |")
    for task in (t for t in scenario.tasks if t.name in given.task):
        rows += looped(models, task, "rti", sigma_x, range(given.seeds), given.finer)
        base = np.mean([r["cost"] for r in rows if r["task"] == task.name])
        for name in given.solver:
            count = min(given.seeds, given.ipopt_seeds) if name == "ipopt" else given.seeds
            new = looped(models, task, name, sigma_x, range(count), given.finer)
            rows += new
            one, other = pairs(rows, task.name, name)
            ratio, mean = one / other, one.mean() / other.mean()
            print(
                f"| {task.name} | {base:.4g} | {name} | {count} | {mean:.3f} ± {half_width(one, other):.3f} "
                f"| {ratio.min():.4f} to {ratio.max():.4f} | {np.median([r['solve_ms'] for r in new]):.1f} |",
                flush=True,
            )
        if given.out is not None:
            given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
