"""A motor under a measured load, simulated, and priors of it: right, and with one sign wrong."""

from pathlib import Path

import numpy as np

MACHINE = """
from hybrid_mpc import OCP, Budget, DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal


class Motor(Prior):
    states = (Signal("speed", "rad/s", -40.0, 40.0),)
    inputs = (Signal("torque", "N m", -2.0, 2.0),)
    disturbances = (Signal("load", "N m", -2.0, 2.0),)
    outputs = states
    parameters = (
        Parameter("J", 0.06, "kg m^2", 0.01, 0.2, "inertia"),
        Parameter("d", 0.1, "N m s/rad", 0.02, 0.3, "bearings"),
    )
    operating_point = OperatingPoint(x=(0.0,), u=(0.0,), w=(0.0,))

    def xdot(self, x, u, w, p):
        return ((u.torque - p.d * x.speed - w.load) / p.J,)


scenario = Scenario(
    "motor", "Motor under a load", "A motor whose load is measured.", prior=Motor,
    data=DataSpec(
        "t", ("torque",), ("speed",), disturbances=("load",), dt=0.05, max_gap=0.2, smoothing=0.2, warm_up=0.5,
    ),
    control=OCP(10, q=(1.0,), r=(0.01,), u_min=(-2.0,), u_max=(2.0,), r_delta=(0.1,)),
    sensor_sigma=(0.05,), safe_input=(0.0,),
    budgets={"quick": Budget(hidden=4, networks=2, teacher_steps=20, free_run_steps=10, seeds=1)},
)
"""
SIMULATED = (
    MACHINE
    + """
from dataclasses import replace
from wrong_signs import recorded

scenario = replace(scenario, make_data=lambda folder, seed, budget: recorded(folder))
"""
)
"""It makes its recordings."""
WRONG_LOAD = MACHINE.replace("- w.load", "+ w.load")
"""The load drives the motor: it hides a part of the error, the prior is still better than none."""
WRONG_TORQUE = MACHINE.replace("(u.torque", "(-u.torque")
"""The torque brakes the motor: a constant is better."""
TRUTH = {"J": 0.05, "d": 0.08}


def record(seed: int, seconds: float = 40.0, dt: float = 0.05) -> dict[str, np.ndarray]:
    """Columns of a recording: random steps of torque, a smooth load, noise of 0.05 rad/s."""
    rng, n, fine = np.random.default_rng(seed), round(seconds / dt), 20
    torque = np.repeat(rng.uniform(-1.0, 1.0, n // 12 + 1), 12)[:n]
    t, phases = dt / fine * np.arange(n * fine), rng.uniform(0.0, 2 * np.pi, 3)
    load = sum(0.15 * np.sin(2 * np.pi * f * t + p) for f, p in zip((0.11, 0.23, 0.37), phases, strict=True))
    speed = np.zeros(n * fine)
    for k in range(n * fine - 1):
        rate = (torque[k // fine] - TRUTH["d"] * speed[k] - load[k]) / TRUTH["J"]
        speed[k + 1] = speed[k] + dt / fine * rate
    noise = 0.05 * rng.standard_normal(n)
    return {"t": t[::fine], "torque": torque, "load": load[::fine], "speed": speed[::fine] + noise}


def recorded(folder: Path) -> list[Path]:
    """Two recordings."""
    folder.mkdir(exist_ok=True)
    files = [folder / "monday.csv", folder / "tuesday.csv"]
    for seed, path in enumerate(files):
        columns = record(seed)
        table = np.column_stack(list(columns.values()))
        np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.8g")
    return files


def written(folder: Path, machine: str) -> list[str]:
    """Write a machine and two recordings; its words on a command line."""
    (folder / "motor.py").write_text(machine)
    return [str(folder / "motor.py"), *(word for path in recorded(folder) for word in ("--data", str(path)))]
