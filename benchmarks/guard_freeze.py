"""A sensor that freezes 1.5 to 3.5 s into a loop: ``python benchmarks/guard_freeze.py --study DIR --model DIR``.

Loops of the study ``monitor`` (``python -m scenarios.golf_robot.monitor_study run DIR --out DIR``, its thresholds
and its seeds) in
which the encoder freezes on the sinusoidal task, with the guard that rests. Printed: how long after the freeze the
input is taken away [s], whether or not the club moved at that moment, and which loops leave a limit. ``--seeds``:
default 40, the study's.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import math
from pathlib import Path

import numpy as np

from hybrid_mpc import (
    find_noise,
    guard_monitor,
    load,
    make_controller,
    make_estimator,
    make_resting_guard,
    simulate,
)
from hybrid_mpc.files import read_json
from hybrid_mpc.records import record
from scenarios.golf_robot import scenario
from scenarios.golf_robot.monitor_study.detection import Judges
from scenarios.golf_robot.monitor_study.loops import loop_figures
from scenarios.golf_robot.monitor_study.plan import SEEDS, LoopPlan
from scenarios.golf_robot.tasks import CONTROL, sine_reference

RATE, FAULT_S = 0.25, 7.5


def main() -> None:
    """Print a line a loop, then what they come to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--study", type=Path, required=True, help="folder of the study")
    parser.add_argument("--model", type=Path, required=True, help="artifact of a run, in its folder")
    parser.add_argument("--seeds", type=int, default=40)
    given = parser.parse_args()
    artifact = load(given.model)
    hybrid, prior = artifact.models["hybrid"], artifact.models["prior"]
    noise, _ = find_noise(scenario, artifact, ("hybrid_observer",), 0, None)
    judges = record(Judges, read_json(given.study / "judges.json"), "judges.json")
    monitor = guard_monitor(
        hybrid, judges.detector_at(RATE), resolution=judges.resolution, input_range=CONTROL.input_range
    )
    parts = (
        make_estimator(hybrid, scenario, np.asarray(noise["hybrid_observer"])),
        make_controller(hybrid, prior, CONTROL),
    )
    after, beyond = [], []
    for i in range(given.seeds):
        plan = LoopPlan("encoder_freeze", "task", SEEDS["fault"] + i, FAULT_S)
        result = simulate(
            scenario.plant(), *parts, plan.reference(sine_reference), dt=hybrid.dt, duration=FAULT_S, x0=np.zeros(2),
            seed=plan.seed, monitor=monitor, faults=plan.faults(hybrid.dt), guard=make_resting_guard(hybrid),
        )  # fmt: skip
        times = [s.t - plan.onset(hybrid.dt) for s in result.switches if s.after.name == "REST"]
        after.append(times[0] if times else math.inf)
        excess = loop_figures(result, CONTROL)["excess"]
        beyond.append(any(value > 0 for value in excess.values()))
        print(
            f"{plan.seed}: {after[-1]:.2f} s, beyond its limits: {'yes' if beyond[-1] else 'no'}", flush=True
        )
    print(
        f"median {np.median(after):.2f} s, largest {max(after):.2f} s; {sum(beyond)} of {len(beyond)} leave a limit"
    )


if __name__ == "__main__":
    main()
