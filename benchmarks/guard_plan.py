"""What bounds to the ordinary cost in a plan: ``python benchmarks/guard_plan.py --model DIR
--data RUN/data/train_*.csv [--seeds 6] [--seconds 10] [--arms bounds] [--out FILE.json]``.

Nominal loops of the golf robot's rig on two tasks, sines and steps to random levels (guard_loops.py), the same seeds
with a free plan and with bounds learned from the recordings: ``quantile`` punishes beyond the fitted 99 % quantile
itself (``reach`` 1), ``bounds`` beyond its extrapolated tail, as learned; ``excess`` and ``region`` are either bound
alone. ``--minutes 4`` learns from so much of nominal loops in place of the recordings. Printed by task and arm: cost
over that of the free plan, mean of the paired differences with the 95 % interval of Student's t; the share of planned
samples beyond the excess's and the region's bound; processor time over that of the free plan. Each loop is
written to FILE as soon as it is there, and not run again.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from dataclasses import replace
from pathlib import Path
from time import process_time
from types import SimpleNamespace

import numpy as np
from guard_loops import DT, Loops, Plan, noise_of, nominal_plans
from scipy.stats import t as student

from hybrid_mpc import (
    CondensedController,
    Plausibility,
    SafeController,
    SQPController,
    excess_bound,
    learn_plausibility,
    load,
    load_trajectories,
    make_controller,
    make_estimator,
    make_ocp,
    region_bound,
    simulate,
)
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.records import record
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

TASKS = ("sine", "steps")
ARMS = ("free", "bounds", "quantile", "excess", "region")


def bounded(hybrid, prior, soft) -> SafeController:
    """The main job's controller with soft bounds."""
    ocp = make_ocp(prior, CONTROL).changed(soft=soft)
    return SafeController(CondensedController(hybrid, ocp), prior, first=SQPController(hybrid, ocp))


class Rig:
    """Estimator and the controllers of all arms."""

    def __init__(self, artifact, sigma_x, ordinary) -> None:
        hybrid, prior = artifact.models["hybrid"], artifact.models["prior"]
        self.estimator = make_estimator(hybrid, scenario, sigma_x)
        bounds = excess_bound(hybrid, ordinary), region_bound(hybrid, ordinary)
        self.bounds = [b.expression.map(CONTROL.horizon) for b in bounds]
        self.upper = [b.upper[:, None] for b in bounds]
        self.soft = {
            "bounds": bounds, "excess": bounds[:1], "region": bounds[1:],
            "quantile": (excess_bound(hybrid, replace(ordinary, reach=1.0)), bounds[1]),
        }  # fmt: skip
        self._make = lambda soft: bounded(hybrid, prior, soft)
        self.controllers = {"free": make_controller(hybrid, prior, CONTROL)}

    def run(self, plan: Plan, arm: str) -> dict:
        """Cost, shares of planned samples beyond each bound, processor time."""
        if arm not in self.controllers:
            self.controllers[arm] = self._make(self.soft[arm])
        beyond, planned, looked = np.zeros(2), 0, 0.0

        def look(step) -> None:
            nonlocal planned, looked
            begin, plan = process_time(), step.decision.solution
            for i, (values, upper) in enumerate(zip(self.bounds, self.upper, strict=True)):
                found = values(plan.x[:-1].T, plan.u.T).full()
                beyond[i] += np.count_nonzero((found > upper).any(axis=0))
            planned += len(plan.u)
            looked += process_time() - begin

        start = process_time()
        result = simulate(
            scenario.plant(), self.estimator, self.controllers[arm], plan.reference(), dt=DT, duration=plan.duration,
            x0=np.zeros(2), seed=plan.seed, on_step=look,
        )  # fmt: skip
        return {
            "cost": result.cost, "beyond_excess": beyond[0] / planned, "beyond_region": beyond[1] / planned,
            "cpu_s": process_time() - start - looked,
        }  # fmt: skip


def relative(costs, free) -> tuple[float, float, float]:
    """Mean of ``costs / free - 1`` over pairs, and its 95 % interval."""
    change = np.asarray(costs) / np.asarray(free) - 1.0
    mean, n = float(change.mean()), change.size
    half = float(student.ppf(0.975, n - 1) * change.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
    return mean, mean - half, mean + half


def table(rows: dict, arms) -> list[str]:
    """Markdown lines."""
    lines = ["| task | arm | seeds | cost, free = 0 (95 %) | beyond excess | beyond region | time |"]
    lines.append("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    for task in TASKS:
        for arm in arms:
            seeds = sorted(s for t, s, a in rows if (t, a) == (task, arm) and (task, s, "free") in rows)
            if arm == "free" or not seeds:
                continue
            found, free = ([rows[task, s, a] for s in seeds] for a in (arm, "free"))
            mean, low, high = relative([f["cost"] for f in found], [f["cost"] for f in free])
            shares = [np.mean([f[k] for f in found]) for k in ("beyond_excess", "beyond_region")]
            time = sum(f["cpu_s"] for f in found) / sum(f["cpu_s"] for f in free)
            lines.append(
                f"| {task} | {arm} | {len(seeds)} | {100 * mean:+.2f} % ({100 * low:+.2f} to {100 * high:+.2f}) | "
                f"{100 * shares[0]:.3f} % | {100 * shares[1]:.3f} % | {time:.2f} |"
            )
    return lines


def learned(given, artifact, noise, say):
    """What is ordinary in the recordings, or in nominal loops."""
    hybrid = artifact.models["hybrid"]
    if given.minutes:
        loops = Loops(artifact, noise, given.keep, say)
        data = [loops.run(plan) for plan in nominal_plans(given.minutes, 1000)]
        return learn_plausibility(hybrid, [SimpleNamespace(x=d["x_hat"], u=d["u"]) for d in data])
    found = load_trajectories(
        given.data, scenario.data, outputs=hybrid.outputs, inputs=hybrid.inputs, needed=("train",)
    )
    return learn_plausibility(hybrid, found.by_role("train"), data_hash=found.hash)


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder with prior and hybrid")
    parser.add_argument("--data", type=Path, nargs="+", default=[], help="training recordings")
    parser.add_argument("--minutes", type=float, default=0.0, help="learn from so much of nominal loops")
    parser.add_argument("--keep", type=Path, help="folder of nominal loops")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--arms", nargs="+", default=["bounds", "quantile"], choices=ARMS)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    say = lambda text: print(text, flush=True)  # noqa: E731
    artifact = load(given.model)
    noise = noise_of(artifact)
    ordinary = learned(given, artifact, noise, say)
    say(f"{ordinary.samples} samples, terms {ordinary.terms}, reach {ordinary.reach:.3f}")
    kept = read_json(given.out) if given.out is not None and given.out.is_file() else {}
    same = bool(kept) and record(Plausibility, kept["plausibility"], "") == ordinary
    loops = kept["loops"] if same else []
    rows = {(r["task"], r["seed"], r["arm"]): r for r in loops if r["seconds"] == given.seconds}
    rig, arms = Rig(artifact, noise, ordinary), ["free", *(a for a in given.arms if a != "free")]
    for seed in range(3000, 3000 + given.seeds):
        for key in [(task, seed, arm) for task in TASKS for arm in arms]:
            if key in rows:
                continue
            found = rig.run(Plan("none", key[0], seed, given.seconds), key[2])
            rows[key] = {"task": key[0], "seed": seed, "arm": key[2], "seconds": given.seconds, **found}
            say(f"{key}: {found}")
            if given.out is not None:
                write_json(given.out, {"plausibility": ordinary, "loops": list(rows.values())})
    for line in table(rows, arms):
        print(line)


if __name__ == "__main__":
    main()
