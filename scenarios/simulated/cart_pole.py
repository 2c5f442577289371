"""A cart with a hanging pole: one force, two positions, and a rail that sticks."""

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
DT, SECONDS, GRAVITY = 0.02, 20.0, 9.81
REST = (0.0, 0.0, 0.0, 0.0)


class CartPolePrior(hm.MechanicalPrior):
    """A cart on a rail with viscous friction, and a point mass on a rod that hangs from it; angle 0 hangs down."""

    states: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("position", "m", -3.0, 3.0), hm.Signal("angle", "rad", -20.0, 20.0),
        hm.Signal("speed", "m/s", -10.0, 10.0), hm.Signal("angle_rate", "rad/s", -30.0, 30.0),
    )  # fmt: skip
    inputs: ClassVar[tuple[hm.Signal, ...]] = (hm.Signal("force", "N", -15.0, 15.0),)
    outputs: ClassVar[tuple[hm.Signal, ...]] = states[:2]
    parameters: ClassVar[tuple[hm.Parameter, ...]] = (
        hm.Parameter("M", 1.0, "kg", 0.4, 2.0, "mass of the cart"),
        hm.Parameter("m", 0.3, "kg", 0.1, 0.8, "mass of the pole"),
        hm.Parameter("l", 0.5, "m", 0.25, 1.0, "length of the pole"),
        hm.Parameter("b", 2.0, "N s/m", 0.0, 10.0, "viscous friction of the rail"),
        hm.Parameter("d", 0.01, "N m s/rad", 0.0, 0.1, "friction of the pole's bearing"),
    )
    operating_point: ClassVar[hm.OperatingPoint] = hm.OperatingPoint(REST, (0.0,))

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia: of both masses along the rail [kg], coupling [kg m], of the pole [kg m^2]."""
        coupling = p.m * p.l * ca.cos(q.angle)
        return (p.M + p.m, coupling), (coupling, p.m * p.l**2)

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the pole [J]."""
        return -p.m * GRAVITY * p.l * ca.cos(q.angle)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction of rail [N] and bearing [N m]."""
        return p.b * v.speed, p.d * v.angle_rate

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """The force drives the cart [N]; nothing drives the pole."""
        return u.force, 0.0


@dataclass(frozen=True)
class CartPole(SimulatedPlant):
    """Other numbers, and a rail whose dry friction is larger at rest than in motion (Stribeck)."""

    M: float = 1.15
    m: float = 0.26
    l: float = 0.55  # noqa: E741  a length
    b: float = 1.7
    d: float = 0.012
    dry: float = 0.8
    stick: float = 1.5
    stribeck_speed: float = 0.1
    sigma: ClassVar[tuple[float, ...]] = (5e-4, 1e-3)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((0.0,), ())

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Speeds and accelerations."""
        _, angle, v, rate = z
        share = 1 + (p.stick - 1) * ca.exp(-((v / p.stribeck_speed) ** 2))
        rubbing = p.b * v + p.dry * share * ca.tanh(v / 0.01)
        coupling, swing = p.m * p.l * ca.cos(angle), p.m * p.l**2
        f1 = u[0] - rubbing + p.m * p.l * ca.sin(angle) * rate**2
        f2 = -p.m * GRAVITY * p.l * ca.sin(angle) - p.d * rate
        det = (p.M + p.m) * swing - coupling**2
        return v, rate, (swing * f1 - coupling * f2) / det, ((p.M + p.m) * f2 - coupling * f1) / det

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Position [m] and angle [rad]."""
        return z[:2]


def signals(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Force: random steps and a multisine of random start."""
    late = rng.uniform(0.0, SECONDS)
    u = hm.random_steps(t, -6.0, 6.0, hold=(0.2, 1.2), rng=rng) + hm.multisine(
        t + late, 2.5, 0.2, 2.0, period=SECONDS
    )
    return u[:, None], np.zeros((len(t), 0))


def held_on_rail(y: Array) -> Array:
    """A weak spring that keeps the cart on its rail [N]."""
    return np.array([-6.0 * y[0]])


EXPERIMENT = Experiment(
    "cart_pole", CartPole, ("time_s", "force_n", "position_m", "angle_rad"), DT, SECONDS, REST, signals,
    ((-15.0,), (15.0,)), held_on_rail,
)  # fmt: skip


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget."""
    return EXPERIMENT.write(folder, seed, budget)


def moved(t: Array) -> Array:
    """Places of the cart, with the pole hanging ``(n, 2)``."""
    return np.column_stack([moves(t, (0.0, 0.6, -0.3, 0.2), 2.0, 1.0)[:, 0], np.zeros(len(t))])


def aside(t: Array) -> Array:
    """One place of the cart ``(n, 2)``."""
    return np.column_stack([moves(t, (0.0, 0.4), 0.5, 1.0)[:, 0], np.zeros(len(t))])


scenario = hm.Scenario(
    name="cart_pole",
    title="Cart with a hanging pole: one force, two positions, a rail that sticks (simulated)",
    description="A force moves a cart from which a pole hangs. The prior's rail has viscous friction; the machine's "
    "rail also sticks. Recordings are held on the rail by a weak spring.",
    prior=CartPolePrior,
    data=hm.DataSpec("time_s", ("force_n",), ("position_m", "angle_rad"), dt=DT, max_gap=2 * DT, smoothing=0.14,
                  warm_up=0.5, windows=windows(SECONDS), free_run=3.0),
    make_data=make_data,
    plant=CartPole,
    # 2 cm and 2 m/s of the cart, 2 rad/s of the pole, 2 N a period; a second and a half is one swing of the pole
    control=hm.OCP(75, q=(0.0, 0.0, 0.25, 0.25), r=(1e-3,), r_delta=(0.25,), u_min=(-15.0,), u_max=(15.0,),
                q_y=(2500.0, 0.0)),
    sensor_sigma=(5e-4, 1e-3),
    safe_input=(0.0,),
    disturbance_model=(hm.Disturbance("input", "force"), hm.Disturbance("output", "angle", 0.05)),
    tasks=(
        hm.Task("move", "Move the cart, keep the pole from swinging", 8.0, REST, moved),
        hm.Task("push", "Hold a place against an unknown force", 8.0, REST, aside,
             faults=(hm.Fault(3.0, np.inf, "input_offset", -2.0),)),
    ),
)  # fmt: skip
