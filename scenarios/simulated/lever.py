"""A lever with one degree of freedom: measured are the height of its end, ``l sin q``, and a tachometer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import hybrid_mpc as hm
from scenarios.common import moves
from scenarios.simulated.plant import Experiment, SimulatedPlant, windows

Array = NDArray[np.float64]
DT, SECONDS = 0.02, 20.0
REST = (0.0, 0.0)


class LeverPrior(hm.MechanicalPrior):
    """``J q'' = u - mgl sin q - d q'``; ``y = (l sin q, q')``. The gear between motor and lever has no gap."""

    states: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("q", "rad", -1.6, 1.6),
        hm.Signal("q_dot", "rad/s", -15.0, 15.0),
    )
    inputs: ClassVar[tuple[hm.Signal, ...]] = (hm.Signal("u", "N m", -1.5, 1.5),)
    outputs: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("height", "m", -0.8, 0.8), hm.Signal("tacho", "rad/s", -15.0, 15.0),
    )  # fmt: skip
    parameters: ClassVar[tuple[hm.Parameter, ...]] = (
        hm.Parameter("J", 0.08, "kg m^2", 0.03, 0.2, "inertia of motor and lever"),
        hm.Parameter("mgl", 1.5, "N m", 0.7, 3.0, "weight of the lever"),
        hm.Parameter("d", 0.1, "N m s/rad", 0.0, 0.5, "viscous friction"),
        hm.Parameter("l", 0.4, "m", 0.2, 0.8, "length to the measured end"),
    )
    operating_point: ClassVar[hm.OperatingPoint] = hm.OperatingPoint(REST, (0.0,))

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia [kg m^2]."""
        return p.J

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the lever [J]."""
        return -p.mgl * ca.cos(q.q)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction [N m]."""
        return p.d * v.q_dot

    def output(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Height of the end [m] and speed [rad/s]."""
        return p.l * ca.sin(x.q), x.q_dot


@dataclass(frozen=True)
class Lever(SimulatedPlant):
    """Other numbers, and a gear with backlash: the motor turns freely by ``gap``, then a stiff tooth takes the lever
    along. The plant's states are angle and speed of the lever, then of the motor.
    """

    J_lever: float = 0.05
    J_motor: float = 0.018
    mgl: float = 1.75
    d_lever: float = 0.03
    d_motor: float = 0.055
    l: float = 0.44  # noqa: E741  a length
    gap: float = 0.12
    tooth: float = 80.0
    tooth_damping: float = 0.4
    sigma: ClassVar[tuple[float, ...]] = (1e-3, 0.02)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((0.0,), ())

    def start(self, x: Array) -> Array:
        """The motor stands as the lever does, in the middle of the gap."""
        return np.concatenate([x, x])

    def shown(self, z: Array) -> Array:
        """Angle and speed of the lever."""
        return z[:2]

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Speeds and accelerations of lever and motor."""
        q, v, q_motor, v_motor = z
        twist = q_motor - q
        beyond = twist - ca.fmax(-p.gap / 2, ca.fmin(p.gap / 2, twist))
        touching = ca.fmin(1.0, ca.fabs(beyond) / 1e-3)  # the damping comes with the contact
        torque = p.tooth * beyond + touching * p.tooth_damping * (v_motor - v)
        return (
            v, (torque - p.mgl * ca.sin(q) - p.d_lever * v) / p.J_lever,
            v_motor, (u[0] - torque - p.d_motor * v_motor) / p.J_motor,
        )  # fmt: skip

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Height of the lever's end [m], its speed [rad/s]."""
        return p.l * ca.sin(z[0]), z[1]


def signals(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Torque: random steps and a multisine of random start."""
    late = rng.uniform(0.0, SECONDS)
    u = hm.random_steps(t, -0.7, 0.7, hold=(0.4, 2.0), rng=rng)
    return (u + hm.multisine(t + late, 0.35, 0.2, 2.0, period=SECONDS))[:, None], np.zeros((len(t), 0))


EXPERIMENT = Experiment(
    "lever",
    Lever,
    ("time_s", "u_nm", "height_m", "tacho_rad_s"),
    DT,
    SECONDS,
    REST,
    signals,
    ((-1.5,), (1.5,)),
)


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget."""
    return EXPERIMENT.write(folder, seed, budget)


def heights(t: Array) -> Array:
    """Heights and speeds ``(n, 2)``; the speed has no weight."""
    height = moves(t, (0.0, 0.2, 0.3, -0.15), 1.5, 0.6)[:, 0]
    return np.column_stack([height, np.zeros(len(t))])


def lifted(t: Array) -> Array:
    """A height away from rest ``(n, 2)``."""
    return np.column_stack([moves(t, (0.0, 0.2), 0.5, 0.6)[:, 0], np.zeros(len(t))])


scenario = hm.Scenario(
    name="lever",
    title="Lever: the sine of its angle and a tachometer, a gear with a gap (simulated)",
    description="A motor lifts a lever. No sensor shows the angle itself: one shows the height of the end, one the "
    "speed. The prior's gear is tight; the machine's has a gap of 0.12 rad.",
    prior=LeverPrior,
    data=hm.DataSpec("time_s", ("u_nm",), ("height_m", "tacho_rad_s"), dt=DT, max_gap=2 * DT, smoothing=0.14,
                  warm_up=0.5, windows=windows(SECONDS), free_run=3.0),
    make_data=make_data,
    plant=Lever,
    # 1 cm, 3 rad/s, what a height needs is free, 0.5 N m a period
    control=hm.OCP(40, q=(0.0, 0.1), r=(0.01,), r_delta=(4.0,), u_min=(-1.5,), u_max=(1.5,), q_y=(1e4, 0.0)),
    sensor_sigma=(1e-3, 0.02),
    safe_input=(0.0,),
    disturbance_model=(hm.Disturbance("input", "u"), hm.Disturbance("output", "tacho", 0.2)),
    tasks=(
        hm.Task("heights", "Go from height to height", 6.0, REST, heights),
        hm.Task("hold", "Hold a height against an unknown torque", 6.0, REST, lifted,
             faults=(hm.Fault(2.0, np.inf, "input_offset", -0.3),)),
    ),
)  # fmt: skip
