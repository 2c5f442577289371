"""How soon faults are found, at which rate of false alarms, beside two baselines.

``python benchmarks/guard_delays.py --model DIR --noise control.json [--minutes 12] [--test-minutes 6] [--seeds 6]
[--rate 1] [--keep DIR] [--out FILE.json]``

The golf robot's rig under the hybrid MPC with its switching filter (guard_loops.py). Detectors are learned on nominal
loops, a third each without drift and with friction that drifts up and down by 10 %, and judged on others: false alarms
on nominal loops, and the delay of each fault, which begins in motion on the sinusoidal task. Delays count only periods
in which the club truly moves faster than 0.3 rad/s; a miss counts as infinite; an alarm that is on before the fault
begins is a false one. All detectors are calibrated alike: a Gumbel tail of block maxima for the same rate.

Baselines on the same loops: the mean of the normalised innovation squared over 0.2 s (what a chi-square test looks
at; its threshold is calibrated too, for innovations of a switching filter are not white), and the root mean square of
the innovations over 0.2 s.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from guard_loops import DT, FAULTS, MOVING, Loops, fault_plans, nominal_plans, read_noise
from scipy.stats import chi2

from hybrid_mpc.artifact import load_artifact
from hybrid_mpc.files import write_json
from hybrid_mpc.monitor import calibrate, guard_monitor, learn_detector
from hybrid_mpc.monitor.standard import DRIFT, SETTLING_S

SETTLING = round(SETTLING_S / DT)
BASELINE_WINDOW = 10
RESOLUTION = 2 * np.pi / 4096
"""Step of the rig's default encoder [rad]."""
DETECTORS = ("guard", "forces", "power", "freeze", "level", "innovation_chi2", "innovation_rms")


@dataclass(frozen=True)
class Estimate:
    """An estimate read back."""

    x: np.ndarray
    h: np.ndarray


def replayed(monitor, loop):
    """Readings along a kept loop."""
    state, readings = monitor.initial(), []
    for k in range(len(loop["t"])):
        u_prev = loop["u"][k - 1] if k else np.zeros(1)
        state, reading = monitor.update(state, loop["y"][k], u_prev, Estimate(loop["x_hat"][k], loop["h"][k]))
        readings.append(reading)
    return readings


def baseline_levels(loop) -> dict[str, np.ndarray]:
    """Levels ``(n,)`` of the two baselines."""
    mean = np.ones(BASELINE_WINDOW) / BASELINE_WINDOW
    squares = {"innovation_chi2": loop["nis"], "innovation_rms": loop["innovation"] ** 2}
    smooth = {name: np.convolve(np.nan_to_num(v), mean)[: len(v)] for name, v in squares.items()}
    return {"innovation_chi2": smooth["innovation_chi2"], "innovation_rms": np.sqrt(smooth["innovation_rms"])}


def held(level, threshold, release=0.5):
    """Alarm with hysteresis."""
    on, found = False, []
    for value in level:
        on = value > (release if on else 1.0) * threshold
        found.append(on)
    return np.array(found)


class Judges:
    """All detectors, learned on nominal loops."""

    def __init__(self, model, loops, rate: float) -> None:
        learning = guard_monitor(model)
        readings = [replayed(learning, loop)[SETTLING:] for loop in loops]
        runs = [np.array([r.numbers for r in rows]) for rows in readings]
        self.detector = learn_detector(runs, DT, 1, drift=DRIFT, false_alarms_per_hour=rate)
        self.monitor = guard_monitor(model, self.detector, resolution=[RESOLUTION])
        self.thresholds = {}
        levels = {"level": [np.array([r.level_w for r in rows]) for rows in readings]}
        for name in ("innovation_chi2", "innovation_rms"):
            levels[name] = [baseline_levels(loop)[name][SETTLING:] for loop in loops]
        for name, values in levels.items():
            self.thresholds[name] = calibrate(
                values, DT, false_alarms_per_hour=rate, floor_w=1e-12
            ).threshold_w

    def alarms(self, loop) -> dict[str, np.ndarray]:
        """Alarms ``(n,)`` of every detector along a loop."""
        rows = replayed(self.monitor, loop)
        scores = np.array([r.scores for r in rows])
        found = {"guard": np.array([r.alarm for r in rows]), "freeze": np.array([r.frozen for r in rows])}
        found["forces"], found["power"] = held(scores[:, 0], 1.0), held(scores[:, 1], 1.0)
        levels = {**baseline_levels(loop), "level": np.array([r.level_w for r in rows])}
        for name, threshold in self.thresholds.items():
            found[name] = held(np.nan_to_num(levels[name]), threshold)
        for alarm in found.values():
            alarm[:SETTLING] = False
        return found


def delay(alarm, loop, onset: float) -> tuple[float, bool]:
    """Time in motion [s] from the onset to the first alarm after it, and whether one was on before."""
    first = round(onset / DT)
    early = bool(alarm[:first].any())
    later = np.flatnonzero(alarm[first:])
    if not later.size:
        return math.inf, early
    moving = np.abs(loop["x"][first : first + later[0] + 1, 1]) > MOVING
    return DT * int(moving.sum()), early


def summary(judges, loops, tests, faults) -> dict:
    """Figures of all detectors: false alarms, and delays by fault."""
    hours = sum((len(loop["t"]) - SETTLING) * DT for loop in tests) / 3600
    alarms = [judges.alarms(loop) for loop in tests]
    result = {
        "learned_min": 60 * judges.detector.hours,
        "tested_min": 60 * hours,
        "false_alarms": {},
        "delays_s": {},
    }
    for name in DETECTORS:
        count = sum(int(np.sum(np.diff(a[name].astype(int)) == 1)) for a in alarms)
        bound = float(chi2.ppf(0.95, 2 * count + 2) / 2 / hours)
        result["false_alarms"][name] = {"count": count, "per_hour_upper_95": bound}
    for plan in faults:
        loop = loops.run(plan)
        rows = result["delays_s"].setdefault(plan.case, {name: [] for name in DETECTORS})
        for name, alarm in judges.alarms(loop).items():
            seconds, early = delay(alarm, loop, plan.onset)
            rows[name].append({"delay": seconds, "early": early})
    result["detector"] = judges.detector.to_dict()
    return result


def table(result: dict) -> list[str]:
    """Markdown rows: median (largest) delay [s] by fault, false alarms."""
    lines = [
        f"learned on {result['learned_min']:.1f} min, false alarms in {result['tested_min']:.1f} min "
        "(upper 95 % Poisson bound an hour)",
        "| | " + " | ".join(DETECTORS) + " |", "| --- |" + " ---: |" * len(DETECTORS),
    ]  # fmt: skip
    for case, rows in result["delays_s"].items():
        cells = []
        for name in DETECTORS:
            delays = [r["delay"] for r in rows[name]]
            early = sum(r["early"] for r in rows[name])
            cells.append(
                f"{np.median(delays):.2f} ({max(delays):.2f})" + (f" {early} early" if early else "")
            )
        lines.append(f"| {case} | " + " | ".join(cells) + " |")
    cells = [f"{r['count']} ({r['per_hour_upper_95']:.1f})" for r in result["false_alarms"].values()]
    return [*lines, "| false alarms | " + " | ".join(cells) + " |"]


def main() -> None:
    """Print the table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder with prior and hybrid")
    parser.add_argument(
        "--noise", type=Path, required=True, help="control.json of a run: process noise of the filter"
    )
    parser.add_argument("--minutes", type=float, default=12.0, help="nominal data to learn from")
    parser.add_argument(
        "--test-minutes", type=float, default=6.0, help="nominal data to count false alarms on"
    )
    parser.add_argument("--seeds", type=int, default=6, help="loops of each fault")
    parser.add_argument("--rate", type=float, default=1.0, help="wanted false alarms an hour")
    parser.add_argument("--case", nargs="+", default=FAULTS, help="faults of the catalogue")
    parser.add_argument(
        "--keep", type=Path, help="folder of the loops; those that lie in it are not run again"
    )
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    artifact = load_artifact(given.model)
    loops = Loops(artifact, read_noise(given.noise), given.keep)
    nominal = [loops.run(plan) for plan in nominal_plans(given.minutes, 1000)]
    judges = Judges(artifact.models["hybrid"], nominal, given.rate)
    tests = [loops.run(plan) for plan in nominal_plans(given.test_minutes, 2000)]
    result = summary(judges, loops, tests, fault_plans(given.case, given.seeds, 500))
    print("\n".join(table(result)))
    if given.out is not None:
        write_json(given.out, json.loads(json.dumps(result)))


if __name__ == "__main__":
    main()
