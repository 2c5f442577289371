"""What a backup that adapts is worth: ``python benchmarks/guard_adaptation.py --model DIR
--detector calibration.json [--seeds 8] [--first 720] [--cases ...] [--arms ...] [--keep DIR] [--out FILE.json]``.

The golf robot's rig on the sinusoidal task, 6 s, a fault from 1.5 to 3.5 s on to the end (guard_loops.py), the same
seeds three times: hybrid MPC with its observer (off), the same with a guard whose backup estimates what mass and
friction have become (guard), and that backup all the time without a guard (always). Cost on the true state; ratios to
"off" of the mean costs with 95 % intervals from the paired loops. ``--keep`` is a folder that finished loops lie in.
``--time`` prints the processor time of a period instead. The detector is that of ``hybrid-mpc monitor ... --learn``
or ``judges.json`` of ``python -m scenarios.golf_robot.monitor_study``.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
from pathlib import Path
from time import process_time

import numpy as np
from guard_loops import DT, Plan
from scipy.stats import t as student

from hybrid_mpc import guard_monitor, load, make_adaptive_guard, make_controller, make_estimator, simulate
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.job.monitor import read_detector
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

CASES = ("none", "friction_x2", "mass_+50", "mass_+20", "motor_-20", "push")
ARMS = ("off", "guard", "always")
LENGTH_S = 6.0
RESOLUTION = 2 * np.pi / 4096


class Arms:
    """Estimators, controllers, monitor and guard."""

    def __init__(self, artifact, noise, detector) -> None:
        hybrid, prior = artifact.models["hybrid"], artifact.models["prior"]
        sigma_x = np.array(noise["hybrid_observer"])
        self.estimator = make_estimator(hybrid, scenario, sigma_x)
        self.controller = make_controller(hybrid, prior, CONTROL)
        self.monitor = guard_monitor(hybrid, detector, resolution=[RESOLUTION])
        self.guard = make_adaptive_guard(hybrid, prior, scenario, sigma_x)
        self.adaptive, self.filter = self.guard.backup, self.guard.backup_estimator

    def run(self, plan: Plan, arm: str):
        """One loop."""
        own = (self.filter, self.adaptive) if arm == "always" else (self.estimator, self.controller)
        watched = {"monitor": self.monitor, "guard": self.guard} if arm == "guard" else {}
        return simulate(
            scenario.plant(), *own, plan.reference(), dt=DT, duration=plan.duration, x0=np.zeros(2), seed=plan.seed,
            faults=plan.faults(), **watched,
        )  # fmt: skip


def figures(plan: Plan, result) -> dict:
    """What counts of a loop; costs before the fault, in the half second after it, and later."""
    onset = round(plan.onset / DT)
    parts = np.split(DT * result.stage_cost, [onset, onset + 25])
    beyond = np.maximum(np.abs(result.x) - CONTROL.x_max, 0.0).max(axis=0)
    return {
        "cost": result.cost,
        "before": float(parts[0].sum()),
        "half_second": float(parts[1].sum()),
        "later": float(parts[2].sum()),
        "angle_beyond": float(beyond[0]),
        "speed_beyond": float(beyond[1]),
        "largest_u": float(np.abs(result.u).max()),
        "largest_slew": float(np.abs(np.diff(result.u, axis=0)).max()),
        "switches": [[s.t - plan.onset, s.after.name] for s in result.switches],
        "solved": result.source.count("MPC") / len(result.source),
    }


def loops(arms: Arms, cases, names, seeds: range, keep: Path | None) -> dict:
    """Figures by fault and arm, in the order of the seeds."""
    rows: dict = {case: {arm: [] for arm in names} for case in cases}
    for seed in seeds:
        for case in cases:
            for arm in names:
                plan = Plan(case, "sine", seed, LENGTH_S)
                path = None if keep is None else keep / f"{plan.name}_{arm}.json"
                if path is not None and path.is_file():
                    found = read_json(path)
                else:
                    found = figures(plan, arms.run(plan, arm))
                    if path is not None:
                        write_json(path, found)
                rows[case][arm].append(found)
                print(f"{plan.name} {arm}: {found['cost']:.3f} {found['switches']}", flush=True)
    return rows


def ratio(costs, base) -> tuple[float, float]:
    """Ratio of the means and half its 95 % interval, from the paired residuals of that ratio."""
    costs, base, n = np.array(costs), np.array(base), len(costs)
    value = costs.mean() / base.mean()
    spread = np.std(costs - value * base, ddof=1) / np.sqrt(n) / base.mean() if n > 1 else np.nan
    return float(value), float(student.ppf(0.975, n - 1) * spread) if n > 1 else float("nan")


def table(rows, names) -> tuple[str, dict]:
    """Mean costs and ratios to "off", as text and as data."""
    heads = [*names, *(f"{arm} / off" for arm in names[1:]), "switched after [s]"]
    lines = ["| fault | " + " | ".join(heads) + " |", "| --- |" + " ---: |" * len(heads)]
    summary: dict = {}
    for case, row in rows.items():
        costs = {arm: [f["cost"] for f in found] for arm, found in row.items()}
        ratios = {arm: ratio(costs[arm], costs["off"]) for arm in names[1:]}
        first = [f["switches"][0][0] for f in row.get("guard", ()) if f["switches"]]
        when = f"{np.median(first):.2f} ({len(first)} of {len(costs['off'])})" if first else "never"
        cells = [f"{np.mean(costs[arm]):.3g}" for arm in names]
        cells += [f"{v:.2f} ± {h:.2f}" for v, h in ratios.values()]
        lines.append(f"| {case} | " + " | ".join([*cells, when]) + " |")
        summary[case] = {
            "mean_cost": {arm: float(np.mean(values)) for arm, values in costs.items()},
            "ratio": {arm: {"mean": v, "ci95": h} for arm, (v, h) in ratios.items()},
            "largest_ratio": {arm: float(np.max(np.divide(costs[arm], costs["off"]))) for arm in names[1:]},
            "beyond_limits": {
                arm: [float(max(f[key] for f in found)) for key in ("angle_beyond", "speed_beyond")]
                for arm, found in row.items()
            },
        }
    return "\n".join(lines), summary


def times(arms: Arms, periods: int = 200, repeats: int = 5) -> dict:
    """Processor time [ms] of a period's estimate and decision, the arms in turn, on one nominal loop."""
    run = arms.run(Plan("none", "sine", 0, DT * periods), "off")
    sides = {"hybrid": (arms.estimator, arms.controller), "adaptive": (arms.filter, arms.adaptive)}
    spent: dict = {name: {"estimate": [], "decide": []} for name in sides}
    reference = np.vstack([run.reference, np.tile(run.reference[-1], (CONTROL.horizon + 1, 1))])
    for _ in range(repeats):
        for name, (estimator, safe) in sides.items():
            estimate = estimator.start(run.y[0])
            decision = safe.initial(estimate)
            sums = np.zeros(2)
            for k in range(1, periods):
                a = process_time()
                estimate = estimator.update(estimate, run.y[k], run.u[k - 1])
                b = process_time()
                decision = safe.decide(decision, estimate, reference[k : k + CONTROL.horizon + 1])
                sums += b - a, process_time() - b
            for key, value in zip(spent[name], 1e3 * sums / (periods - 1), strict=True):
                spent[name][key].append(float(value))
    return {name: {key: float(np.median(v)) for key, v in row.items()} for name, row in spent.items()}


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder with prior and hybrid")
    parser.add_argument("--detector", type=Path, required=True, help="JSON file with a field 'detector'")
    parser.add_argument("--cases", nargs="+", default=CASES, help="faults")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS), help="controllers beside off")
    parser.add_argument("--seeds", type=int, default=8, help="loops of each fault and arm")
    parser.add_argument("--first", type=int, default=720, help="first seed")
    parser.add_argument("--keep", type=Path, help="folder of finished loops")
    parser.add_argument("--time", action="store_true", help="processor time of a period instead")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    detector = read_detector(given.detector)
    kit = load(given.model)
    arms = Arms(kit, kit.loop.process_noise, detector)
    if given.time:
        print(json.dumps(times(arms), indent=1))
        return
    if given.keep is not None:
        given.keep.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(["off", *given.arms]))
    rows = loops(arms, given.cases, names, range(given.first, given.first + given.seeds), given.keep)
    text, summary = table(rows, names)
    print(text)
    if given.out is None:
        print(json.dumps(summary, indent=1))
    else:
        write_json(given.out, {"summary": summary, "loops": rows})


if __name__ == "__main__":
    main()
