"""How near the simulated disk is to the real one: free runs of the plant under the voltages of a recording.

    python benchmarks/disk_plant.py multisine_2024.npz

Every run starts from an angle and a speed that a cubic through seven samples gives; nothing else is told to the plant.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenarios.unbalanced_disk.nominal import DT
from scenarios.unbalanced_disk.plant import DiskPlant, DiskState

Array = NDArray[np.float64]
AROUND = 3  # samples before and after a start
RUNS = 4


def begun(plant: DiskPlant, u: Array, th: Array, k: int) -> DiskState:
    """The plant as the recording has it at sample ``k``: current settled, bristle bent by the motion."""
    p = plant.parameters
    cubic = np.polyfit(DT * np.arange(-AROUND, AROUND + 1), th[k - AROUND : k + AROUND + 1], 3)
    phi, speed = cubic[-1], cubic[-2]
    z = np.array([phi, speed, (u[k - 1] - p.k * speed) / p.R, np.sign(speed) * p.bristle])
    return replace(plant.reset(z[:2], 0), z=z, acting=float(u[k - 1]))


def error(plant: DiskPlant, u: Array, th: Array, k: int, periods: int) -> float:
    """Root mean square error [rad] of a free run of so many periods from sample ``k`` on."""
    state, off = begun(plant, u, th, k), []
    for j in range(k, k + periods):
        state = plant.step(state, u[j : j + 1], DT)
        off.append(plant.truth(state)[0] - th[j + 1])
    return float(np.sqrt(np.mean(np.square(off))))


def main() -> None:
    """Print the errors of runs spread over the recording."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a free run")
    arguments = parser.parse_args()
    with np.load(arguments.recording) as arrays:
        u, th = arrays["u"].ravel(), arrays["th"].ravel()
    periods = round(arguments.seconds / DT)
    plant = DiskPlant()
    for k in np.linspace(AROUND, len(th) - periods - 2, RUNS).round().astype(int):
        print(f"from {k * DT:6.1f} s: {error(plant, u, th, int(k), periods):.4f} rad")


if __name__ == "__main__":
    main()
