"""What a guard's reaction is worth: ``python benchmarks/guard_reaction.py --model DIR
--detector calibration.json [--seeds 3] [--out FILE.json]``.

The golf robot's rig on the sinusoidal task, 6 s, a fault from 1.5 to 3.5 s on (guard_loops.py), the same seeds without
a guard and with two: tighter limits (0.3 N m of 0.5), and the fallback. A frozen sensor puts both to rest. Backups are
judged by ``python -m scenarios.golf_robot.monitor_study``. Cost on the true state, largest angle [rad] and speed
beyond its soft
limits. The detector is that of ``hybrid-mpc monitor ... --learn`` or ``judges.json`` of that study.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from pathlib import Path

import numpy as np
from guard_loops import DT, fault_plans

from hybrid_mpc import Guard, Limits, Mode, guard_monitor, load, make_controller, make_estimator, simulate
from hybrid_mpc.files import write_json
from hybrid_mpc.job.monitor import read_detector
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

CASES = ("friction_x2", "mass_+50", "motor_-20", "encoder_freeze", "push")
RESOLUTION = 2 * np.pi / 4096
TIGHT = 0.3


class Arms:
    """Estimator, controller, monitor, and the guards."""

    def __init__(self, artifact, noise, detector) -> None:
        hybrid, prior = artifact.models["hybrid"], artifact.models["prior"]
        self.estimator = make_estimator(hybrid, scenario, np.array(noise["hybrid_observer"]))
        self.controller = make_controller(hybrid, prior, CONTROL)
        self.monitor = guard_monitor(hybrid, detector, resolution=[RESOLUTION])
        limits = Limits([-TIGHT], [TIGHT])
        self.guards = {
            "off": None,
            "limits": Guard(limits=limits),
            "fallback": Guard(Mode.FALLBACK),
        }

    def run(self, plan, guard):
        """One loop."""
        return simulate(
            scenario.plant(), self.estimator, self.controller, plan.reference(), dt=DT,
            duration=plan.duration, x0=np.zeros(2), seed=plan.seed, faults=plan.faults(), monitor=self.monitor,
            guard=guard,
        )  # fmt: skip


def figures(result) -> dict:
    """What counts of a loop."""
    beyond = np.maximum(np.abs(result.x) - CONTROL.x_max, 0.0).max(axis=0)
    slew = float(np.abs(np.diff(result.u, axis=0)).max())
    return {
        "cost": result.cost,
        "angle_beyond": float(beyond[0]),
        "speed_beyond": float(beyond[1]),
        "largest_slew": slew,
        "switches": [f"{s.t:.2f} {s.after.name}" for s in result.switches],
    }


def reactions(arms, seeds: int, say) -> dict:
    """Figures by fault and arm."""
    rows: dict = {}
    for plan in fault_plans(CASES, seeds, 700):
        for name, guard in arms.guards.items():
            found = figures(arms.run(plan, guard))
            rows.setdefault(plan.case, {}).setdefault(name, []).append(found)
            say(f"{plan.case} {plan.seed} {name}: {found}")
    return rows


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder with prior and hybrid")
    parser.add_argument("--detector", type=Path, required=True, help="JSON file with a field 'detector'")
    parser.add_argument("--seeds", type=int, default=3, help="loops of each fault and arm")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    artifact = load(given.model)
    arms = Arms(artifact, artifact.loop.process_noise, read_detector(given.detector))
    result = {"reaction": reactions(arms, given.seeds, lambda text: print(text, flush=True))}
    print("| fault | " + " | ".join(arms.guards) + " |\n| --- |" + " ---: |" * len(arms.guards))
    for case, row in result["reaction"].items():
        cells = [f"{np.mean([f['cost'] for f in found]):.3g}" for found in row.values()]
        print(f"| {case} | " + " | ".join(cells) + " |")
    if given.out is not None:
        write_json(given.out, result)


if __name__ == "__main__":
    main()
