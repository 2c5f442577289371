"""What the study ``monitor`` consists of: nominal loops to learn from and judge on, faulted, guarded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import digest
from hybrid_mpc.loop.faults import Fault
from hybrid_mpc.records import plain

Array = NDArray[np.float64]
MOVE_S, HOLD_S = 0.8, 1.3
"""Length [s] of a move between random levels, and the time from one move to the next."""
AMPLITUDE = 0.5
DRIFT = 0.1
"""Share by which friction drifts in nominal loops."""
LEARN, NOMINAL, FAULT, GUARD = "learn", "nominal", "fault", "guard"
SEEDS = {LEARN: 1_000_000, NOMINAL: 2_000_000, FAULT: 3_000_000}
"""First seed of each kind of loop, so that none meets the noise of another; guarded loops share the faulted ones'."""


@dataclass(frozen=True)
class Case:
    """A fault of the study: target and value of a :class:`~hybrid_mpc.loop.faults.Fault`, and how long [s] it lasts."""

    name: str
    title: str
    target: str
    value: float = 0.0
    length: float = math.inf


CASES = (
    Case("friction_x2", "friction x 2", "plant_friction", 2.0),
    Case("mass_+50", "mass +50 %", "plant_mass", 1.5),
    Case("mass_+20", "mass +20 %", "plant_mass", 1.2),
    Case("motor_-20", "motor -20 %", "input_gain", 0.8),
    Case("encoder_freeze", "encoder freezes", "measurement_freeze"),
    Case("push", "push", "plant_push", 1.0, 0.2),
)
"""Sizes as in the golf robot's catalogue of faults."""


@dataclass(frozen=True)
class LoopPlan:
    """One loop of ``duration`` [s]; its seed is that of sensor, onset and levels.

    ``case`` is ``"none"``, ``"drift_up"``, ``"drift_down"``, or the name of a :class:`Case`; ``motion`` ``"task"``,
    the task's reference, or ``"moves"`` between random levels.
    """

    case: str
    motion: str
    seed: int
    duration: float

    def onset(self, dt: float) -> float:
        """First instant of the fault [s]: a sample from 1.5 to 3.5 s."""
        first, last = round(1.5 / dt), round(3.5 / dt)
        return dt * int(np.random.default_rng([self.seed, 1]).integers(first, last + 1))

    def faults(self, dt: float) -> tuple[Fault, ...]:
        """What acts; friction that drifts goes one way in a third of the loop, and in half of it back and beyond."""
        if self.case == "none":
            return ()
        if self.case.startswith("drift"):
            first = 1 + DRIFT if self.case == "drift_up" else 1 - DRIFT
            third, half = self.duration / 3, self.duration / 2
            return (
                Fault(0.0, math.inf, "plant_friction", first, ramp=third),
                Fault(third, math.inf, "plant_friction", (2 - first) / first, ramp=half),
            )
        case, onset = next(c for c in CASES if c.name == self.case), self.onset(dt)
        return (Fault(onset, onset + case.length, case.target, case.value),)

    def reference(self, task: Callable[[Array], Array]) -> Callable[[Array], Array]:
        """What the loop is to follow, ``t (n,) -> (n, 2)``."""
        if self.motion == "task":
            return task
        count = math.ceil(self.duration / HOLD_S) + 2
        levels = np.random.default_rng([self.seed, 2]).uniform(-AMPLITUDE, AMPLITUDE, count)
        return moves(np.concatenate([[0.0], levels]))


@dataclass(frozen=True)
class MonitorJob:
    """Loops that a worker runs in one go: ``"learn"``, ``"nominal"``, ``"fault"``, or ``"guard"`` with the reaction
    ``arm``.

    ``number`` is its place in the study, no part of the identity.
    """

    kind: str
    plans: tuple[LoopPlan, ...]
    arm: str = ""
    number: int = field(default=0, compare=False)

    @cached_property
    def id(self) -> str:
        """Name made of what it runs."""
        return digest({key: value for key, value in asdict(self).items() if key != "number"})[:20]

    def columns(self) -> dict[str, Any]:
        """What says which it is."""
        first = self.plans[0]
        return {
            "run": self.number,
            "kind": self.kind,
            "case": first.case,
            "arm": self.arm,
            "seed": first.seed,
        }


@dataclass(frozen=True)
class MonitorStudy:
    """How soon faults are found, how often without one, and what a reaction is worth.

    Args:
        scenario: Registered name or path of a user's file.
        model: Artifact folder, or that of a run.
        task: Task whose reference the faulted loops follow. Default: the golf robot's sinusoids.
        learn_hours: Nominal loops to learn thresholds from [h].
        nominal_hours: Others, on which false alarms are counted [h].
        run_s: Length of a nominal loop [s].
        together: Nominal loops that a worker runs side by side.
        horizon: Periods of the controller in nominal loops; None for the task's own. A shorter one moves the machine
            alike and costs half.
        seeds: Loops of each fault.
        guard_seeds: Of these, how many are run with each reaction too.
        rates: Wanted rates of false alarms [1/h]; the first is that of ROC scores and of the guard.
        resolution: Step of each sensor ``(n_y,)``.
        fault_s: Length of a faulted loop [s].
        name: For the report.
    """

    scenario: str
    model: str
    task: str = "track_sine"
    learn_hours: float = 1.0
    nominal_hours: float = 10.0
    run_s: float = 180.0
    together: int = 10
    horizon: int | None = 20
    seeds: int = 40
    guard_seeds: int = 20
    rates: tuple[float, ...] = (0.25, 1.0)
    resolution: tuple[float, ...] = (2 * math.pi / 4096,)
    fault_s: float = 7.5
    name: str = "monitor"

    def __post_init__(self) -> None:
        numbers = {
            k: getattr(self, k) for k in ("learn_hours", "nominal_hours", "run_s", "together", "seeds")
        }
        numbers |= {"fault_s": self.fault_s, "rates": min(self.rates, default=0.0)}
        if wrong := [f"{k} = {v}" for k, v in numbers.items() if not (math.isfinite(v) and v > 0)]:
            raise InputError(
                f"study monitor: positive numbers needed, got {', '.join(wrong)} [HM-SCENARIOS-011]"
            )
        if not 0 <= self.guard_seeds <= self.seeds:
            raise InputError(
                f"study monitor: guard_seeds {self.guard_seeds} must be 0 to {self.seeds}, the seeds [HM-SCENARIOS-012]"
            )

    def jobs(self) -> Iterator[MonitorJob]:
        """All jobs, in the order in which they are handed out."""
        parts = [*self._nominal(LEARN, self.learn_hours), *self._nominal(NOMINAL, self.nominal_hours)]
        for i in range(self.seeds):
            for case in CASES:
                plan = LoopPlan(case.name, "task", SEEDS[FAULT] + i, self.fault_s)
                parts.append((FAULT, (plan,), ""))
                if i < self.guard_seeds:
                    parts += [(GUARD, (plan,), arm) for arm in ARMS]
        for number, (kind, plans, arm) in enumerate(parts):
            yield MonitorJob(kind, plans, arm, number)

    def _nominal(self, kind: str, hours: float) -> list[tuple[str, tuple[LoopPlan, ...], str]]:
        """Loops in which nothing is wrong, a third of them with friction that drifts; two motions in turn."""
        count = max(1, math.ceil(3600 * hours / self.run_s - 1e-9))
        first = SEEDS[kind]
        plans = [LoopPlan(*NOMINALS[i % len(NOMINALS)], first + i, self.run_s) for i in range(count)]
        groups = [tuple(plans[i : i + self.together]) for i in range(0, count, self.together)]
        return [(kind, group, "") for group in groups]

    @property
    def size(self) -> int:
        """Number of jobs."""
        return sum(1 for _ in self.jobs())

    def identity(self) -> dict[str, Any]:
        """The study as plain data, without where its model lies."""
        whole: dict[str, Any] = plain(asdict(self))
        return {**whole, "model": "model"}


ARMS = ("rest", "backup", "adapt")
"""Reactions: record faults of the model, rest when the sensor freezes; the same with the prior's MPC as backup; with
one that adapts."""
NOMINALS = (
    ("none", "task"), ("none", "moves"), ("drift_up", "task"), ("none", "task"), ("none", "moves"),
    ("drift_down", "moves"),
)  # fmt: skip
BUDGETS = {
    "full": {},
    "quick": {"learn_hours": 0.25, "nominal_hours": 1.0, "seeds": 6, "guard_seeds": 3, "rates": (1.0,)},
}
"""What the study's two sizes change of :class:`MonitorStudy`."""


def monitor_study(model: str, budget: str = "full") -> MonitorStudy:
    """The golf robot's study."""
    if budget not in BUDGETS:
        raise InputError(
            f"study monitor: no budget {budget!r}; there are: {', '.join(BUDGETS)} [HM-SCENARIOS-013]"
        )
    chosen: dict[str, Any] = dict(BUDGETS[budget])
    return MonitorStudy("golf_robot", str(model), **chosen)


def moves(levels: Array) -> Callable[[Array], Array]:
    """Reference ``t (n,) -> (n, 2)`` from level to level along quintics, and its derivative."""

    def reference(t: Array) -> Array:
        index = np.clip(np.floor(t / HOLD_S + 1e-9).astype(int), 0, len(levels) - 1)
        before = levels[np.maximum(index - 1, 0)]
        rise, s = levels[index] - before, np.clip((t - index * HOLD_S) / MOVE_S, 0.0, 1.0)
        share, slope = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / MOVE_S
        return np.column_stack([before + rise * share, rise * slope])

    return reference
