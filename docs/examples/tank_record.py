"""Recordings of a simulated tank for docs/own-machine.md: ``python tank_record.py`` writes monday.csv and tuesday.csv.

The tank is not the prior of docs/examples/tank.py: its outlet follows the power 0.55 of the level, not the root.
"""

import numpy as np

DT = 5.0  # [s] between two samples
AREA, K, POWER = 5.2, 15.4, 0.55  # [dm^2], [l/min/m^POWER], exponent of the outlet
NOISE = 2e-3  # [m] standard deviation of the level sensor


def record(name: str, seed: int, hours: float = 3.0) -> None:
    """Write one recording: the pump is held for 2 to 10 minutes, then jumps."""
    rng = np.random.default_rng(seed)
    level, pump, left, rows = 0.25, 7.5, 0.0, []
    for k in range(int(hours * 3600 / DT)):
        if left <= 0.0:
            pump, left = rng.uniform(4.5, 11.0), rng.uniform(120.0, 600.0)
        left -= DT
        rows.append((k * DT, round(pump, 2), round(level + NOISE * rng.standard_normal(), 4)))
        for _ in range(10):  # Euler steps of 0.5 s; the time constant is minutes
            level += DT / 10 * (pump - K * max(level, 0.0) ** POWER) / (600 * AREA)
    np.savetxt(name, rows, fmt="%g", delimiter=",", header="time_s,pump_lpm,level_m", comments="")


if __name__ == "__main__":
    record("monday.csv", 1)
    record("tuesday.csv", 2)
