"""How long a whole period of the closed loop takes: estimator, controller and monitor.

``python benchmarks/loop_step.py [--model DIR] [--task NAME ...] [--seeds 2] [--out FILE.json]``.
The golf robot's loops with the hybrid, as ``hybrid-mpc control`` runs them: switching filter (three extended Kalman
filters over states, hidden states and disturbance), ``rti`` at the scenario's horizon behind its safeguards, energy
monitor. Wall clock of every period but the first of a loop [ms]: median, 95 %, 99 %, largest, of the parts and of the
whole, for one disturbance filter in place of the switching one too. Without ``--model`` the network has 32 random
units, which estimates nothing better but takes the same time.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
from pathlib import Path

import numpy as np

from hybrid_mpc import load, make_controller, make_estimator, make_monitor, simulate
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

SIGMA_X = (1e-4, 2e-2)
"""Process noise per period [rad, rad/s] where none is given."""
TASKS = ("track_sine", "track_step", "stroke_1.4", "reject_load")
SHARES = {"median": 50, "p95": 95, "p99": 99, "max": 100}


def models_of(folder: Path | None):
    """Prior and hybrid of an artifact, or with random weights; and the process noise of their filters, if known."""
    if folder is not None:
        kit = load(folder)
        return kit.models, kit.loop.process_noise
    from mpc_step import hybrid

    model = hybrid(32)
    return {"prior": scenario.oracle(model.dt) if scenario.oracle else model, "hybrid": model}, {}


def looped(models, task, estimator, seed: int) -> dict[str, np.ndarray]:
    """Durations [ms] of one loop by part, the first period left out."""
    control = task.control or CONTROL
    controller = make_controller(models["hybrid"], models["prior"], control)
    result = simulate(
        scenario.plant(), estimator(control), controller, task.reference, weight=task.weight,
        dt=models["hybrid"].dt, duration=task.duration, x0=np.array(task.x0), seed=seed, faults=task.faults,
        monitor=make_monitor(models["hybrid"], None),
    )  # fmt: skip
    return {name: spent[1:] for name, spent in result.timing_ms.items()}


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, help="artifact folder")
    parser.add_argument("--task", nargs="+", default=TASKS, choices=[t.name for t in scenario.tasks])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    models, noise = models_of(given.model)
    sigma_x = np.array(noise.get("hybrid_observer", SIGMA_X))
    kinds = {
        "switching": lambda control: make_estimator(models["hybrid"], scenario, sigma_x, control),
        "single": lambda control: make_estimator(
            models["hybrid"], scenario, sigma_x, control, observer=False
        ),
    }
    rows = []
    print("| estimator | part | median | 95 % | 99 % | largest |\n| --- | --- | ---: | ---: | ---: | ---: |")
    for kind, estimator in kinds.items():
        loops = [
            looped(models, task, estimator, seed)
            for task in scenario.tasks
            if task.name in given.task
            for seed in range(given.seeds)
        ]
        for part in ("estimate", "solve", "monitor", "prepare", "total"):
            spent = np.concatenate([loop[part] for loop in loops])
            row = {key: float(np.percentile(spent, share)) for key, share in SHARES.items()}
            rows.append({"estimator": kind, "part": part, "periods": spent.size, **row})
            print(f"| {kind} | {part} | " + " | ".join(f"{v:.2f}" for v in row.values()) + " |", flush=True)
    print(f"period {1e3 * models['hybrid'].dt:g} ms, horizon {CONTROL.horizon}, z = {models['hybrid'].n_h}")
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
