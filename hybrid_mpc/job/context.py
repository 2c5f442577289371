"""What the stages of a run share: settings, folder, data, and the results of the stages before."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Dataset, Trajectory, load_trajectories
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_document, read_document_arrays, write_document
from hybrid_mpc.job.settings import RunSettings
from hybrid_mpc.kit.artifact import Kit, load
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.scenario import Budget, Scenario

STAGES = (
    "data", "prior", "training", "evaluation", "export", "control", "estimation", "monitor", "guard", "analysis",
    "report",
)  # fmt: skip
"""Stages of the main job in their order; each may read what those before it have left."""


class Progress(Protocol):
    """Where a run reports to: bars on a terminal, lines elsewhere, nothing in tests."""

    def start(self, title: str) -> None:
        """A stage begins."""

    def update(self, key: str, done: int, total: int, text: str) -> None:
        """Part ``key`` of the stage has done ``done`` of ``total``."""

    def warn(self, text: str) -> None:
        """Something that the user should know of, and that stops nothing."""

    def finish(self, text: str) -> None:
        """The stage is done."""


class Silent:
    """A :class:`Progress` that says nothing."""

    def start(self, title: str) -> None:
        """Ignored."""

    def update(self, key: str, done: int, total: int, text: str) -> None:
        """Ignored."""

    def warn(self, text: str) -> None:
        """Ignored."""

    def finish(self, text: str) -> None:
        """Ignored."""


@dataclass(frozen=True)
class Context:
    """A run in its folder.

    Args:
        settings: What the run computes.
        scenario: The machine.
        out: The run's folder.
        progress: Where to report.
    """

    settings: RunSettings
    scenario: Scenario
    out: Path
    progress: Progress = field(default_factory=Silent)

    @property
    def budget(self) -> Budget:
        """The scenario's budget of the run's name."""
        budgets = self.scenario.budgets
        if self.settings.budget not in budgets:
            raise InputError(
                f"scenario {self.scenario.name} has no budget {self.settings.budget!r}; "
                f"it has: {', '.join(budgets)}"
            )
        return budgets[self.settings.budget]

    @property
    def spec(self) -> DataSpec:
        """The scenario's data specification with the user's columns, which hold for every file."""
        s, spec = self.settings, self.scenario.data
        if s.inputs:
            spec = replace(spec, inputs=s.inputs, inputs_of={})
        return replace(spec, time=s.time or spec.time, outputs=s.outputs or spec.outputs)

    @property
    def warm(self) -> int:
        """Samples of the warm-up."""
        return round(self.spec.warm_up / self.spec.dt)

    @cached_property
    def dataset(self) -> Dataset:
        """All trajectories of the user's files, or of those that the simulated machine recorded."""
        made = self.out / "data"
        files = list(self.settings.data) or sorted(made.glob("*.csv")) or sorted(made.glob("*.npz"))
        prior = self.scenario.prior()
        return load_trajectories(
            files, self.spec, outputs=prior.outputs, inputs=prior.inputs, states=prior.states
        )

    @cached_property
    def time_unit(self) -> float:
        """The machine's second [s], of the training recordings; see :func:`~hybrid_mpc.data.scales.time_unit`."""
        return time_unit(self.trajectories("train"), self.spec.dt)

    def trajectories(self, role: str) -> list[Trajectory]:
        """Trajectories of one role."""
        return [t for t in self.dataset.trajectories if t.role == role]

    def smoothed(self, role: str) -> list[Trajectory]:
        """Trajectories of one role with the states that the fitted prior's equations smooth them to.

        Their inputs are those that act; of a delay's first samples nobody knows what acted, so they are left out.
        """
        return self._with_states(self._acting(self.trajectories(role)))

    def commanded(self, role: str) -> list[Trajectory]:
        """The same with the inputs as they were commanded: what the deployed models, which hold the delay, take."""
        return self._with_states([self._late(t) for t in self.trajectories(role)])

    @property
    def delay(self) -> float:
        """Delay of the input [s] that was fitted with the prior; zero for none."""
        return float(self.result("prior").get("delay", 0.0))

    def _with_states(self, trajectories: list[Trajectory]) -> list[Trajectory]:
        arrays = self.arrays("prior")
        return [replace(t, x=arrays[f"{t.name}/x"], xdot=arrays[f"{t.name}/xdot"]) for t in trajectories]

    def _acting(self, trajectories: list[Trajectory]) -> list[Trajectory]:
        if not self.delay:
            return trajectories
        from hybrid_mpc.identify.delay import delayed

        return [delayed(t, self.delay) for t in trajectories]

    def _late(self, t: Trajectory) -> Trajectory:
        lost = math.ceil(self.delay / t.dt - 1e-6)
        return t.part(np.arange(len(t.t)) >= lost, t.name, t.role) if lost else t

    def save(self, stage: str, result: Mapping[str, Any], arrays: Mapping[str, Any] | None = None) -> None:
        """Keep a stage's result; its JSON is written last and means that the stage is done."""
        write_document(self._path(stage), result, arrays)

    def fail(self, stage: str, why: str) -> None:
        """Note that a stage could not run, and why: those after it go on without, and the report says so."""
        self.save(stage, {"reason": why, "failed": True}, {})

    @property
    def kit(self) -> Kit:
        """The run's artifact as it is now, with the control problems that the scenario now states."""
        return load(self.out / "model").on(self.scenario)

    def done(self, stage: str) -> bool:
        """Whether a stage's result is there."""
        return self._path(stage).is_file()

    def result(self, stage: str) -> Any:
        """Result of a stage that is done.

        Raises:
            InputError: If its file is damaged; it names the files to delete.
        """
        return read_document(self._path(stage), self._remedy(stage))

    def arrays(self, stage: str) -> dict[str, Any]:
        """Arrays of a stage that is done.

        Raises:
            InputError: If their file is damaged; it names the files to delete.
        """
        return read_document_arrays(self._path(stage), self._remedy(stage))

    def _path(self, stage: str) -> Path:
        return self.out / "checkpoints" / f"{stage}.json"

    def _remedy(self, stage: str) -> str:
        later = STAGES[STAGES.index(stage) :] if stage in STAGES else (stage,)
        return (
            f"delete what the stage {stage} left and what stands on it ({', '.join(f'{name}.*' for name in later)} in "
            f"{self.out / 'checkpoints'}), and --resume computes it anew"
        )


def failed_stages(out: Path) -> dict[str, str]:
    """Why stages of a run could not run, by stage; empty where all did.

    Args:
        out: The run's folder.

    Raises:
        InputError: If a checkpoint is damaged.

    Example:
        >>> failed_stages(Path("nowhere"))
        {}
    """
    paths = {stage: out / "checkpoints" / f"{stage}.json" for stage in STAGES}
    found = {stage: read_document(path) for stage, path in paths.items() if path.is_file()}
    return {stage: str(result["reason"]) for stage, result in found.items() if result.get("failed")}
