"""An arm of two links that hangs: two torques, two angles, and joints that stick."""

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
LIMITS = (8.0, 3.0)
REST = (0.0, 0.0, 0.0, 0.0)


class TwoLinkArmPrior(hm.MechanicalPrior):
    """Two links without dry friction; angle 0 hangs down, the elbow's is that of the forearm against the upper arm."""

    states: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("shoulder", "rad", -3.0, 3.0), hm.Signal("elbow", "rad", -3.0, 3.0),
        hm.Signal("shoulder_rate", "rad/s", -20.0, 20.0), hm.Signal("elbow_rate", "rad/s", -30.0, 30.0),
    )  # fmt: skip
    inputs: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("tau_1", "N m", -LIMITS[0], LIMITS[0]), hm.Signal("tau_2", "N m", -LIMITS[1], LIMITS[1]),
    )  # fmt: skip
    outputs: ClassVar[tuple[hm.Signal, ...]] = states[:2]
    parameters: ClassVar[tuple[hm.Parameter, ...]] = (
        hm.Parameter("a", 0.35, "kg m^2", 0.15, 0.7, "both links about the shoulder, elbow at a right angle"),
        hm.Parameter("b", 0.09, "kg m^2", 0.02, 0.12, "coupling"),
        hm.Parameter("c", 0.09, "kg m^2", 0.05, 0.2, "forearm about the elbow"),
        hm.Parameter("g_1", 5.0, "N m", 2.0, 10.0, "weight at the shoulder"),
        hm.Parameter("g_2", 1.8, "N m", 0.8, 4.0, "weight at the elbow"),
        hm.Parameter("d_1", 0.4, "N m s/rad", 0.0, 2.0, "viscous friction of the shoulder"),
        hm.Parameter("d_2", 0.1, "N m s/rad", 0.0, 1.0, "viscous friction of the elbow"),
    )
    operating_point: ClassVar[hm.OperatingPoint] = hm.OperatingPoint(REST, (0.0, 0.0))

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia [kg m^2]."""
        coupling = p.b * ca.cos(q.elbow)
        return (p.a + 2 * coupling, p.c + coupling), (p.c + coupling, p.c)

    def potential(self, q: Any, p: Any) -> Any:
        """Height of both links [J]."""
        return -p.g_1 * ca.cos(q.shoulder) - p.g_2 * ca.cos(q.shoulder + q.elbow)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction [N m]."""
        return p.d_1 * v.shoulder_rate, p.d_2 * v.elbow_rate


@dataclass(frozen=True)
class TwoLinkArm(SimulatedPlant):
    """Other numbers, and joints whose dry friction is larger at rest than in motion (Stribeck)."""

    a: float = 0.3
    b: float = 0.08
    c: float = 0.1
    g_1: float = 5.8
    g_2: float = 1.55
    d_1: float = 0.33
    d_2: float = 0.085
    dry_1: float = 0.5
    dry_2: float = 0.15
    stick: float = 1.5  # largest dry friction over that in motion
    stribeck_speed: float = 0.3
    sigma: ClassVar[tuple[float, ...]] = (1e-3, 1e-3)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((0.0, 0.0), ())

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Speeds and accelerations."""
        q1, q2, v1, v2 = z

        def friction(v: Any, d: Any, dry: Any) -> Any:
            share = 1 + (p.stick - 1) * ca.exp(-((v / p.stribeck_speed) ** 2))
            return d * v + dry * share * ca.tanh(v / 0.02)

        k, s = p.b * ca.cos(q2), p.b * ca.sin(q2)
        m11, m12, m22 = p.a + 2 * k, p.c + k, p.c
        weight_2 = p.g_2 * ca.sin(q1 + q2)
        f1 = u[0] - friction(v1, p.d_1, p.dry_1) - p.g_1 * ca.sin(q1) - weight_2 + s * v2 * (2 * v1 + v2)
        f2 = u[1] - friction(v2, p.d_2, p.dry_2) - weight_2 - s * v1**2
        det = m11 * m22 - m12**2
        return v1, v2, (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Both angles [rad]."""
        return z[:2]


def signals(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Torques: random steps and a multisine of random start."""
    late = rng.uniform(0.0, SECONDS)
    tau = [
        hm.random_steps(t, -0.3 * most, 0.3 * most, hold=(0.3, 1.5), rng=rng)
        + hm.multisine(t + late, 0.12 * most, 0.2, 2.5, period=SECONDS)
        for most in LIMITS
    ]
    return np.column_stack(tau), np.zeros((len(t), 0))


EXPERIMENT = Experiment(
    "two_link_arm", TwoLinkArm, ("time_s", "tau1_nm", "tau2_nm", "shoulder_rad", "elbow_rad"), DT, SECONDS, REST,
    signals, (tuple(-v for v in LIMITS), LIMITS),
)  # fmt: skip


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget."""
    return EXPERIMENT.write(folder, seed, budget)


def reach(t: Array) -> Array:
    """From place to place ``(n, 2)`` [rad]."""
    return np.column_stack(
        [moves(t, levels, 1.5, 0.7)[:, 0] for levels in ((0.0, 0.8, 0.3, -0.5), (0.0, -0.6, 0.7, 0.2))]
    )


def lifted(t: Array) -> Array:
    """A place away from rest ``(n, 2)`` [rad]."""
    return np.column_stack([moves(t, (0.0, level), 0.5, 0.7)[:, 0] for level in (0.5, 0.4)])


scenario = hm.Scenario(
    name="two_link_arm",
    title="Two-link arm with two torques: joints that stick (simulated)",
    description="An arm of two links hangs from its shoulder. The prior knows inertia, weight and viscous friction; "
    "the machine's joints also stick.",
    prior=TwoLinkArmPrior,
    data=hm.DataSpec("time_s", ("tau1_nm", "tau2_nm"), ("shoulder_rad", "elbow_rad"), dt=DT, max_gap=2 * DT,
                  smoothing=0.14, warm_up=0.5, windows=windows(SECONDS), free_run=3.0),
    make_data=make_data,
    plant=TwoLinkArm,
    # 20 mrad, 2 rad/s, what a place needs is free, a fifth of the torque a period
    control=hm.OCP(40, q=(0.0, 0.0, 0.25, 0.25), r=(1e-3, 1e-2), r_delta=(0.4, 3.0), u_min=tuple(-v for v in LIMITS),
                u_max=LIMITS, q_y=(2500.0, 2500.0)),
    sensor_sigma=(1e-3, 1e-3),
    safe_input=(0.0, 0.0),
    disturbance_model=(hm.Disturbance("input", "tau_1"), hm.Disturbance("input", "tau_2")),
    tasks=(
        hm.Task("reach", "Go from place to place", 6.0, REST, reach),
        hm.Task("carry", "Hold a place against an unknown torque", 6.0, REST, lifted,
             faults=(hm.Fault(2.0, np.inf, "input_offset", -1.0, "tau_1"),)),
    ),
)  # fmt: skip
