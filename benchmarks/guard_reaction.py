"""What a guard's reaction is worth: ``python benchmarks/guard_reaction.py --model DIR --noise control.json
--detector calibration.json [--seeds 3] [--plan] [--out FILE.json]``.

The golf robot's rig on the sinusoidal task, 6 s, a fault from 1.5 to 3.5 s on (guard_loops.py), the same seeds without
a guard and with three: the MPC of the fitted prior as backup, tighter limits (0.3 N m of 0.5), and the fallback. A
frozen sensor puts all of them to rest. Cost on the true state, largest angle [rad] and speed beyond its soft limits.
With ``--plan`` also what the bounds of the plan cost on nominal tasks. The detector is that of ``hybrid-mpc monitor
... --learn`` or of ``guard_delays.py --out`` (its field ``detector``).
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from guard_loops import DT, Loops, fault_plans, nominal_plans, read_noise

from hybrid_mpc.artifact import load_artifact
from hybrid_mpc.closed_loop import Guard, simulate
from hybrid_mpc.closed_loop.guard import Mode
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.monitor import Detector, excess_bound, guard_monitor, learn_plausibility, region_bound
from hybrid_mpc.mpc import OCP, CondensedController, Limits, SafeController, SQPController
from hybrid_mpc.pipeline.loops import make_controller, make_estimator, make_ocp
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

CASES = ("friction_x2", "mass_+50", "motor_-20", "encoder_freeze", "push")
RESOLUTION = 2 * np.pi / 4096
TIGHT = 0.3


class Arms:
    """Estimator, controller, monitor, and the guards."""

    def __init__(self, artifact, noise, detector) -> None:
        hybrid, prior = artifact.models["hybrid"], artifact.models["prior"]
        self.hybrid, self.prior = hybrid, prior
        self.estimator = make_estimator(hybrid, CONTROL, np.array(noise["hybrid_observer"]))
        self.controller = make_controller(hybrid, prior, CONTROL)
        self.monitor = guard_monitor(hybrid, detector, resolution=[RESOLUTION])
        limits = Limits([-TIGHT], [TIGHT])
        backup = make_controller(prior, prior, CONTROL)
        backup_estimator = make_estimator(prior, CONTROL, np.array(noise["prior_observer"]))
        self.guards = {
            "off": None,
            "backup": Guard(backup=backup, backup_estimator=backup_estimator),
            "limits": Guard(limits=limits),
            "fallback": Guard(Mode.FALLBACK),
        }

    def run(self, plan, guard, controller=None):
        """One loop."""
        return simulate(
            scenario.plant(), self.estimator, controller or self.controller, plan.reference(), dt=DT,
            duration=plan.duration, x0=np.zeros(2), seed=plan.seed, faults=plan.faults(), monitor=self.monitor,
            guard=guard,
        )  # fmt: skip


def figures(result) -> dict:
    """What counts of a loop."""
    beyond = np.maximum(np.abs(result.x) - np.array(CONTROL.x_max), 0.0).max(axis=0)
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


def with_bounds(arms, data) -> SafeController:
    """The controller whose plan is bound to what is ordinary in the data."""
    ordinary = learn_plausibility(arms.hybrid, data)
    ocp = make_ocp(arms.prior, CONTROL)
    bounds = [excess_bound(arms.hybrid, ordinary), region_bound(arms.hybrid, ordinary)]
    c = CONTROL
    bound = OCP(
        c.horizon, c.q, c.r, c.r_delta, c.u_min, c.u_max, c.du_max, "riccati", ocp.working_point, c.x_min, c.x_max,
        soft=bounds,
    )  # fmt: skip
    first = SQPController(arms.hybrid, bound)
    return SafeController(CondensedController(arms.hybrid, bound), arms.prior, first=first)


def planning(arms, keep, artifact, noise_file, say) -> dict:
    """Costs of nominal loops without and with the bounds; learned on other nominal loops' estimates."""

    class Data:
        def __init__(self, loop) -> None:
            self.x, self.u = loop["x_hat"], loop["u"]

    loops = Loops(artifact, read_noise(noise_file), keep, say)
    controller = with_bounds(arms, [Data(loops.run(plan)) for plan in nominal_plans(4, 1000)])
    rows: dict = {}
    for plan in nominal_plans(2, 3000):
        short = replace(plan, duration=10.0)
        rows[short.name] = {
            "free": figures(arms.run(short, None)), "bound": figures(arms.run(short, None, controller)),
        }  # fmt: skip
        say(f"{short.name}: {rows[short.name]}")
    return rows


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder with prior and hybrid")
    parser.add_argument(
        "--noise", type=Path, required=True, help="control.json of a run: process noise of the filters"
    )
    parser.add_argument("--detector", type=Path, required=True, help="JSON file with a field 'detector'")
    parser.add_argument("--seeds", type=int, default=3, help="loops of each fault and arm")
    parser.add_argument("--plan", action="store_true", help="also the bounds of the plan on nominal tasks")
    parser.add_argument("--keep", type=Path, help="folder of nominal loops (guard_delays.py --keep)")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    artifact, noise = load_artifact(given.model), json.loads(given.noise.read_text())["sigma_x"]
    arms = Arms(artifact, noise, Detector.from_dict(read_json(given.detector)["detector"]))
    result = {"reaction": reactions(arms, given.seeds, lambda text: print(text, flush=True))}
    if given.plan:
        say = lambda text: print(text, flush=True)  # noqa: E731
        result["plan"] = planning(arms, given.keep, artifact, given.noise, say)
    print("| fault | " + " | ".join(arms.guards) + " |\n| --- |" + " ---: |" * len(arms.guards))
    for case, row in result["reaction"].items():
        cells = [f"{np.mean([f['cost'] for f in found]):.3g}" for found in row.values()]
        print(f"| {case} | " + " | ".join(cells) + " |")
    if given.out is not None:
        write_json(given.out, result)


if __name__ == "__main__":
    main()
