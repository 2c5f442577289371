"""Processor time of one update of the energy monitor: ``python benchmarks/monitor_step.py --model DIR [--rounds 7]``.

The hybrid of an artifact along 6 s of a sinusoid of 0.6 rad (a quarter of it near rest, where the residual's dead band
asks for two accelerations more), for the main job's monitor and the guard's; both take turns. Median and largest of
the rounds' means, and what the CasADi function alone takes of it [us]. With a network of 32 units.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import numpy as np

from hybrid_mpc import Detector, guard_monitor, load, make_monitor

SAMPLES = 300


@dataclass(frozen=True)
class Estimate:
    """State and hidden state of a sample."""

    x: np.ndarray
    h: np.ndarray


def samples(model):
    """Measurements, inputs and estimates of the sinusoid."""
    t = model.dt * np.arange(SAMPLES)
    phase = 2 * np.pi * 0.5 * t
    x = np.column_stack([0.6 * np.sin(phase), 0.6 * np.pi * np.cos(phase)])
    u = 0.3 * np.sin(phase + 0.5)[:, None]
    return list(zip(x[:, :1].copy(), u, [Estimate(row, np.zeros(model.n_h)) for row in x], strict=True))


def update_time(monitor, rows) -> float:
    """Mean processor time [us] of an update."""
    state = monitor.initial()
    begin = process_time()
    for y, u, estimate in rows:
        state, _ = monitor.update(state, y, u, estimate)
    return 1e6 * (process_time() - begin) / len(rows)


def evaluation_time(monitor) -> float:
    """Mean processor time [us] of the CasADi function at its last arguments."""
    begin = process_time()
    for _ in range(SAMPLES):
        monitor._evaluate()
    return 1e6 * (process_time() - begin) / SAMPLES


def measured(model, rounds: int) -> dict[str, dict[str, float]]:
    """Times by monitor."""
    detector = Detector(model.dt, ((0.01, 0.0, 0.0, 0.0),), (0.01, 0.0, 0.0, 0.0), 2.0, 20.0, 4.0)
    monitors = {
        "main job": make_monitor(model, None),
        "guard": guard_monitor(model, detector, resolution=[1.5e-3]),
        "guard with history": guard_monitor(model, detector, resolution=[1.5e-3], diagnose=model.n_p > 0),
    }
    rows, found = samples(model), {name: [] for name in monitors}
    for _ in range(rounds):
        for name, monitor in monitors.items():
            found[name].append((update_time(monitor, rows), evaluation_time(monitor)))
    return {
        name: {
            "median_us": float(np.median([a for a, _ in times])),
            "largest_us": float(np.max([a for a, _ in times])),
            "casadi_us": float(np.median([b for _, b in times])),
        }
        for name, times in found.items()
    }


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    result = measured(load(given.model).models["hybrid"], given.rounds)
    print("| monitor | median | largest | CasADi |\n| --- | ---: | ---: | ---: |")
    for name, row in result.items():
        print(f"| {name} | " + " | ".join(f"{v:.1f}" for v in row.values()) + " |")
    if given.out is not None:
        given.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
