"""A run in its folder: settings, scenario, data, and the results of its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from hybrid_mpc.compare.tasks import ready
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Dataset, Trajectory, load_trajectories
from hybrid_mpc.engine import WORKERS, Progress
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import digest, sha256
from hybrid_mpc.folder import versions
from hybrid_mpc.kit.artifact import Kit, load
from hybrid_mpc.kit.parts import artifact_digest
from hybrid_mpc.machine.specification import BenchmarkBudget, DataSpec, Role
from hybrid_mpc.scenario import Budget, Scenario, load_scenario
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stage import Absent, Stage, Stored, read_stage, write_stage

if TYPE_CHECKING:
    from hybrid_mpc.workflow.stages.identify import PriorResult

R = TypeVar("R")


@dataclass(frozen=True)
class Context:
    """A run in its folder: settings, scenario, recordings, and the results of its stages.

    Args:
        settings: Settings of the run.
        given: The user's scenario; stages use :attr:`scenario`.
        out: Folder of the run.
        progress: Where to report. Default: nowhere.
        cluster: Address of a dask scheduler or a ``distributed.Client``, which trains networks and runs loops.
            Default: processes of this machine.
        workers: Number of kinds of networks that are trained at once. Default: 2.
        pictures: Figures that this process has drawn, by part of the report: section, file, caption.
    """

    settings: RunSettings
    given: Scenario
    out: Path
    progress: Progress = field(default_factory=Progress)
    cluster: Any = field(default=None, repr=False, compare=False)
    workers: int = field(default=WORKERS, repr=False, compare=False)
    pictures: dict[str, list[tuple[str, Path, str]]] = field(default_factory=dict, repr=False, compare=False)
    _read: dict[str, Stored[Any]] = field(default_factory=dict, repr=False, compare=False)
    _kits: dict[str, Kit] = field(default_factory=dict, repr=False, compare=False)
    _data: dict[object, Dataset] = field(default_factory=dict, init=False, repr=False, compare=False)
    _explained: dict[str, Scenario] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def scenario(self) -> Scenario:
        """The user's scenario, or the scenario with the terms that stage ``explain`` found."""
        file = self.explained
        if file is None:
            return self.given
        if (content := sha256(file)) not in self._explained:
            self._explained[content] = load_scenario(str(file))
        return self._explained[content]

    @property
    def explained(self) -> Path | None:
        """The scenario file of stage ``explain``; None if the stage found no term or was not requested."""
        if not self.settings.explain:
            return None
        from hybrid_mpc.workflow.stages.explain import EXPLAIN, FOLDER

        found = self.find(EXPLAIN)
        if isinstance(found, Absent) or not found.file:
            return None
        return self.out / FOLDER / found.file

    @cached_property
    def as_given(self) -> Context:
        """The same run with the user's scenario, without found terms."""
        return (
            replace(self, settings=replace(self.settings, explain=False)) if self.settings.explain else self
        )

    @property
    def budget(self) -> Budget:
        """The scenario's budget of the run's name."""
        budgets = self.scenario.budgets
        if self.settings.budget not in budgets:
            raise InputError(
                f"budget: scenario {self.scenario.name} has no budget {self.settings.budget!r}; "
                f"choose one of: {', '.join(budgets)} [HM-WORKFLOW-017]"
            )
        return budgets[self.settings.budget]

    @property
    def effort(self) -> BenchmarkBudget:
        """Effort of the training."""
        return self.budget

    @property
    def fit_length(self) -> float | None:
        """Length [s] of the longest free runs that the prior is fitted to: that of the runs that models are judged by.

        None without validation and test recordings.
        """
        runs = (*self.trajectories("valid"), *self.trajectories("test"))
        return self.spec.free_run or max(((len(t.t) - self.warm) * self.spec.dt for t in runs), default=None)

    @property
    def spec(self) -> DataSpec:
        """The scenario's data specification with the user's columns, which replace the scenario's in every file.

        Units and delays of replaced columns are dropped.
        """
        s, own = self.settings, self.scenario.data
        spec = own
        if s.inputs:
            spec = replace(spec, inputs=s.inputs, inputs_of={})
        spec = replace(spec, time=s.time or spec.time, outputs=s.outputs or spec.outputs)
        gone = own.columns - spec.columns
        return replace(
            spec,
            units={name: unit for name, unit in spec.units.items() if name not in gone},
            delays={name: delay for name, delay in spec.delays.items() if name not in gone},
            delays_of={
                stem: {name: delay for name, delay in delays.items() if name not in gone}
                for stem, delays in spec.delays_of.items()
            },
        )

    @property
    def scenario_path(self) -> str:
        """Name of the scenario, or the full path of its file, which other processes can load."""
        if (file := self.explained) is not None:
            return str(file.resolve())
        name = self.settings.scenario
        return str(Path(name).resolve()) if Path(name).is_file() else name

    @property
    def warm(self) -> int:
        """Samples of the warm-up."""
        return round(self.spec.warm_up / self.spec.dt)

    @property
    def files(self) -> list[Path]:
        """The user's recordings, or the simulated ones."""
        made = self.out / "data"
        return list(self.settings.data) or sorted(made.glob("*.csv")) or sorted(made.glob("*.npz"))

    def forget_data(self) -> None:
        """Remove simulated recordings."""
        self._data.clear()
        if not self.settings.data:
            for path in self.files:
                path.unlink()

    @property
    def dataset(self) -> Dataset:
        """All trajectories of the run's recordings, with the states of the prior."""
        prior = self.scenario.prior()
        if prior.states not in self._data:
            self._data[prior.states] = load_trajectories(self.files, prior, self.spec)
        return self._data[prior.states]

    @cached_property
    def time_unit(self) -> float:
        """Time constant of the machine [s], estimated from the training recordings."""
        return time_unit(self.trajectories("train"), self.spec.dt)

    def trajectories(self, role: Role) -> list[Trajectory]:
        """Trajectories of one role."""
        return list(self.dataset.by_role(role))

    def smoothed(self, role: Role) -> list[Trajectory]:
        """Trajectories of one role with the states of the fitted prior's smoother.

        Their inputs are delayed as they act on the machine. Samples before the first delayed input are left out.
        """
        from hybrid_mpc.identify.delay import shifted

        return self._with_states(shifted(self.trajectories(role), self.prior.fit.delay))

    def commanded(self, role: Role) -> list[Trajectory]:
        """The same with inputs as commanded; the deployed models contain the delay."""
        from hybrid_mpc.identify.delay import lost_samples

        found = []
        for t in self.trajectories(role):
            lost = lost_samples(self.prior.fit.delay, t.dt)
            found.append(t.part(np.arange(len(t.t)) >= lost, t.name, t.role) if lost else t)
        return self._with_states(found)

    @property
    def prior(self) -> PriorResult:
        """The fitted prior."""
        from hybrid_mpc.workflow.stages.identify import PRIOR

        return self.read(PRIOR)

    @property
    def ready(self) -> Scenario:
        """The scenario, with default tasks at the fitted prior's equilibrium if it declares none."""
        return ready(self.scenario, self.kit.fitted)

    def _with_states(self, trajectories: list[Trajectory]) -> list[Trajectory]:
        arrays = self.prior.arrays
        return [replace(t, x=arrays[f"{t.name}/x"], xdot=arrays[f"{t.name}/xdot"]) for t in trajectories]

    @property
    def kit(self) -> Kit:
        """The run's artifact with the scenario's present control problems.

        It is read again only if one of its files has changed.
        """
        folder = self.out / "model"
        content = artifact_digest(folder)
        if content not in self._kits:
            self._kits.clear()
            self._kits[content] = load(folder).on(self.scenario)
        return self._kits[content]

    @cached_property
    def versions(self) -> dict[str, str]:
        """Versions of the packages that results depend on."""
        return versions()

    def path(self, stage: str) -> Path:
        """File of a stage."""
        return self.out / "checkpoints" / f"{stage}.json"

    def stored(self, stage: Stage[R]) -> Stored[R] | None:
        """The stored result of a stage, or None; InputError with the file to delete if the file is damaged."""
        if stage.name not in self._read:
            path = self.path(stage.name)
            if not path.is_file():
                return None
            remedy = f"delete {stage.name}.* in {path.parent}; then --resume computes this stage again"
            self._read[stage.name] = read_stage(path, stage, remedy)
        return self._read[stage.name]

    def keep(self, stage: Stage[R], keys: Mapping[str, str], result: R | Absent) -> None:
        """Write a stage's result."""
        self._read[stage.name] = write_stage(self.path(stage.name), stage, keys, result)

    def leave_out(self, stage: Stage[Any], reason: str) -> None:
        """Continue without a stage; an existing file of the stage stays."""
        self._read[stage.name] = Stored({}, Absent(reason), digest(reason))

    def find(self, stage: Stage[R]) -> R | Absent:
        """Result of a stage, or why the stage has no result."""
        stored = self.stored(stage)
        return Absent(f"stage {stage.name} has not run") if stored is None else stored.result

    def read(self, stage: Stage[R]) -> R:
        """Result of a stage; InputError with the reason if the stage has no result."""
        found = self.find(stage)
        if isinstance(found, Absent):
            raise InputError(f"{found.reason} [HM-WORKFLOW-048]")
        return found

    def digest_of(self, stage: Stage[Any]) -> str:
        """Digest of a stage's result, or of the reason why it has none."""
        stored = self.stored(stage)
        return "" if stored is None else stored.content
