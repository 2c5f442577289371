"""A DC motor: current and speed are measured, and it rubs the more the slower it turns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import hybrid_mpc as hm
from scenarios.simulated.plant import Experiment, SimulatedPlant, windows

Array = NDArray[np.float64]
DT, SECONDS = 0.005, 8.0
RESISTANCE, INDUCTANCE, CONSTANT, INERTIA, DAMPING, LOAD = 1.0, 0.01, 0.1, 2e-3, 1e-3, 0.05
SPEED = 20.0
CURRENT = (DAMPING * SPEED + LOAD) / CONSTANT
VOLTAGE = RESISTANCE * CURRENT + CONSTANT * SPEED
REST = (CURRENT, SPEED)
"""Operating point: 20 rad/s against a steady load."""


class DcMotorPrior(hm.Prior):
    """``L i' = u - R i - k v``, ``J v' = k i - d v - load``: it drives a load that is always there."""

    states: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("current", "A", -20.0, 20.0), hm.Signal("speed", "rad/s", -100.0, 150.0),
    )  # fmt: skip
    inputs: ClassVar[tuple[hm.Signal, ...]] = (hm.Signal("voltage", "V", 0.0, 10.0),)
    outputs: ClassVar[tuple[hm.Signal, ...]] = states
    parameters: ClassVar[tuple[hm.Parameter, ...]] = (
        hm.Parameter("R", RESISTANCE, "ohm", 0.5, 2.0, "resistance of the winding"),
        hm.Parameter("L", INDUCTANCE, "H", 0.005, 0.02, "inductance of the winding"),
        hm.Parameter("k", CONSTANT, "N m/A", 0.05, 0.2, "torque constant, and of the induced voltage"),
        hm.Parameter("J", INERTIA, "kg m^2", 1e-3, 4e-3, "inertia"),
        hm.Parameter("d", DAMPING, "N m s/rad", 0.0, 5e-3, "viscous friction"),
        hm.Parameter("load", LOAD, "N m", 0.0, 0.3, "steady load"),
    )
    operating_point: ClassVar[hm.OperatingPoint] = hm.OperatingPoint(REST, (VOLTAGE,))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of current [A/s] and speed [rad/s^2]."""
        return (
            (u.voltage - p.R * x.current - p.k * x.speed) / p.L,
            (p.k * x.current - p.d * x.speed - p.load) / p.J,
        )

    def balances(self, x: Any, u: Any, w: Any, p: Any) -> tuple[hm.Balance, ...]:
        """Energy of the winding and of the rotor."""
        stored = 0.5 * (p.L * x.current**2 + p.J * x.speed**2)
        supplied = u.voltage * x.current - p.load * x.speed
        return (hm.Balance("energy", stored, supplied, p.R * x.current**2 + p.d * x.speed**2),)


@dataclass(frozen=True)
class DcMotor(SimulatedPlant):
    """Other numbers, and dry friction that is larger the slower it turns (Stribeck) in place of a steady load."""

    R: float = 1.15
    L: float = 0.0085
    k: float = 0.088
    J: float = 2.3e-3
    d: float = 1.15e-3
    load: float = 0.045
    stiction: float = 0.16
    stribeck_speed: float = 12.0
    sigma: ClassVar[tuple[float, ...]] = (0.02, 0.1)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((VOLTAGE,), ())

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of current and speed."""
        current, speed = z
        dry = p.load + (p.stiction - p.load) * ca.exp(-((speed / p.stribeck_speed) ** 2))
        rubbing = dry * ca.tanh(speed / 0.2)
        return ((u[0] - p.R * current - p.k * speed) / p.L, (p.k * current - p.d * speed - rubbing) / p.J)

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Current [A] and speed [rad/s]."""
        return z


def signals(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Voltage in random steps: at 2 V it hardly turns."""
    return hm.random_steps(t, 1.0, 8.0, hold=(0.05, 0.5), rng=rng)[:, None], np.zeros((len(t), 0))


EXPERIMENT = Experiment(
    "dc_motor", DcMotor, ("time_s", "voltage_v", "current_a", "speed_rad_s"), DT, SECONDS, REST, signals,
    ((0.0,), (10.0,)),
)  # fmt: skip


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget."""
    return EXPERIMENT.write(folder, seed, budget)


def speeds(t: Array) -> Array:
    """Set-points ``(n, 2)``: of the speed [rad/s]; the current is free."""
    speed = np.interp(t, [0.3, 0.4, 1.0, 1.1, 1.7, 1.8], [SPEED, 40.0, 40.0, 8.0, 8.0, SPEED])
    return np.column_stack([np.full(len(t), CURRENT), speed])


def steady(t: Array) -> Array:
    """The operating point's speed ``(n, 2)``."""
    return np.tile(REST, (len(t), 1))


scenario = hm.Scenario(
    name="dc_motor",
    title="DC motor with current and speed: Stribeck friction (simulated)",
    description="A voltage drives a motor against a load. The prior takes the load as steady; the machine's dry "
    "friction grows below 12 rad/s.",
    prior=DcMotorPrior,
    data=hm.DataSpec("time_s", ("voltage_v",), ("current_a", "speed_rad_s"), dt=DT, max_gap=2 * DT, smoothing=0.04,
                  warm_up=0.2, windows=windows(SECONDS), free_run=2.0),
    make_data=make_data,
    plant=DcMotor,
    # 1 rad/s, half the voltage, 2 V a period; 0.3 s are half of the mechanical time constant's three
    control=hm.OCP(60, q=(0.0, 0.0), r=(1e-4,), r_delta=(0.25,), u_min=(0.0,), u_max=(10.0,), q_y=(0.0, 1.0)),
    sensor_sigma=(0.02, 0.1),
    safe_input=(0.0,),
    disturbance_model=(hm.Disturbance("input", "voltage"), hm.Disturbance("rate", "speed", 50.0)),
    tasks=(
        hm.Task("speeds", "Change the speed", 2.4, REST, speeds),
        hm.Task("brake", "Keep the speed although the supply drops", 2.4, REST, steady,
             faults=(hm.Fault(0.4, np.inf, "input_offset", -1.0),)),
    ),
)  # fmt: skip
