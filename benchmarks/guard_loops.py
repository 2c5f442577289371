"""Closed loops of the golf robot's rig, nominal and faulted, that the guard's benchmarks share.

A loop is kept as one ``.npz``: what the machine did, what the estimator believed. Monitors change nothing in a loop,
so any number of them can be replayed over the same one.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_mpc import Kit, make_controller, make_estimator, simulate, write_arrays
from hybrid_mpc.files import read_arrays
from scenarios.golf_robot import scenario
from scenarios.golf_robot.faults import FaultCase, catalogue
from scenarios.golf_robot.tasks import CONTROL, sine_reference, steps

DT = 0.02
MOVING = 0.3  # rad/s; delays count only while the club truly moves
FAULTS = ("friction_x2", "mass_+50", "mass_+20", "encoder_freeze", "push")
NOMINAL = ("none", "friction_ageing_up", "friction_ageing_down")
NOMINAL_S, FAULT_S, RAMP_S = 60.0, 6.0, 30.0
FIELDS = ("t", "x", "y", "u", "x_hat", "h", "d")


@dataclass(frozen=True)
class Plan:
    """One loop.

    Args:
        case: Name in the fault catalogue, or ``"none"``.
        task: ``"sine"`` or ``"steps"``.
        seed: Of the sensor, the onset and the steps.
        duration: Length [s].
    """

    case: str
    task: str
    seed: int
    duration: float

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.case}_{self.task}_{self.seed}_{self.duration:g}s"

    @property
    def onset(self) -> float:
        """First instant of the fault [s], 1.5 to 3.5 s."""
        return DT * int(np.random.default_rng([self.seed, 1]).integers(75, 175))

    def faults(self):
        """What acts."""
        if self.case == "none":
            return ()
        cases: dict[str, FaultCase] = {c.name: c for c in catalogue(self.onset, drift_time=RAMP_S)}
        return cases[self.case].faults

    def reference(self):
        """Reference of the task; steps go to random levels."""
        if self.task == "sine":
            return sine_reference
        levels = np.random.default_rng([self.seed, 2]).uniform(-0.5, 0.5, 200)
        return steps((0.0, *levels.tolist()))


def nominal_plans(minutes: float, seed: int) -> list[Plan]:
    """Loops of a minute in which nothing is wrong, or friction drifts by 10 %; sines and steps in turn."""
    kinds = [(case, task) for case in NOMINAL for task in ("sine", "steps")]
    return [
        Plan(*kinds[i % len(kinds)], seed + i, NOMINAL_S)
        for i in range(max(1, round(60 * minutes / NOMINAL_S)))
    ]


def fault_plans(cases, seeds: int, seed: int) -> list[Plan]:
    """Loops on the sinusoidal task in which a fault begins in motion."""
    return [Plan(case, "sine", seed + i, FAULT_S) for i in range(seeds) for case in cases]


class Loops:
    """Runs loops, or reads those that lie in a folder."""

    def __init__(self, artifact: Kit, sigma_x, keep: Path | None, say=print) -> None:
        self._models, self._keep, self._say = artifact.models, keep, say
        self._control = CONTROL.changed(x_min=(-0.85, -2.5), x_max=(0.85, 2.5))
        hybrid = self._models["hybrid"]
        self._estimator = make_estimator(hybrid, scenario, np.asarray(sigma_x))
        self._controller = make_controller(hybrid, self._models["prior"], self._control)

    def run(self, plan: Plan) -> dict:
        """Arrays of a loop: :data:`FIELDS`, ``innovation`` and ``nis``."""
        path = None if self._keep is None else self._keep / f"{plan.name}.npz"
        if path is not None and path.is_file():
            return read_arrays(path)
        seen = []
        result = simulate(
            scenario.plant(), self._estimator, self._controller, plan.reference(), dt=DT, duration=plan.duration,
            x0=np.zeros(2), seed=plan.seed, faults=plan.faults(),
            on_step=lambda s: seen.append((s.estimate.innovation[0], s.estimate.nis)),
        )  # fmt: skip
        arrays = {name: getattr(result, name) for name in FIELDS}
        arrays["innovation"], arrays["nis"] = np.array(seen).T
        if path is not None:
            write_arrays(path, arrays)
        self._say(f"{plan.name}: cost {result.cost:.3g}")
        return arrays


def noise_of(kit):
    """Process noise of the hybrid's filter."""
    return np.array(kit.loop.process_noise["hybrid_observer"])
