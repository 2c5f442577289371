"""``hybrid-mpc reproduce``: data, priors, ensembles, tables, figures and claims, resumable at any point."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybrid_mpc.data.trajectories import Dataset, Trajectory
from hybrid_mpc.files import read_arrays, read_json
from hybrid_mpc.job.engine import WORKERS, run_jobs
from hybrid_mpc.job.folder import open_folder
from hybrid_mpc.pipeline.context import Progress, Silent
from hybrid_mpc.pipeline.devices import check_device
from hybrid_mpc.pipeline.settings import claim
from hybrid_mpc.reproduction.experiment import Effort, Experiment
from hybrid_mpc.reproduction.jobs import Case, Ruler, ensemble_job, fit_job, physics_job, sindy_job
from hybrid_mpc.reproduction.outputs import write_outputs
from hybrid_mpc.reproduction.settings import ReproductionSettings, case_key, experiment_of
from hybrid_mpc.reproduction.slots import Slots
from hybrid_mpc.reproduction.table import Row
from hybrid_mpc.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from hybrid_mpc.identification.settings import TrainingSettings

Jobs = dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]
NETWORKS = ("hybrid", "mopgrnn", "pgrnn", "rnn")
"""Models that are ensembles, the slowest first."""
WITHOUT_SINDY = "sindy is left out: {} is not installed (pip install 'hybrid-mpc[sindy]')"


def reproduce(
    settings: ReproductionSettings,
    out: Path,
    *,
    resume: bool = False,
    progress: Progress | None = None,
    workers: int = WORKERS,
) -> dict[str, Any]:
    """Rebuild a scenario's experiment into the folder ``out`` and return what stands in its ``results.json``.

    Every fit and every ensemble is a job in a process of its own that leaves its files in ``out/checkpoints``; a
    training also leaves its state as it goes. A reproduction that was interrupted, at any point, is finished by
    ``resume=True`` and then equals one that was not.

    Args:
        settings: What to compute.
        out: Folder to make; it must be new or empty unless ``resume``.
        resume: Finish the reproduction that ``out`` holds.
        progress: Where to report. Default: nowhere.
        workers: Processes side by side; 0 runs the jobs in this one. Default: two.

    Returns:
        The results (docs/reproduction.md).

    Raises:
        InputError: If the scenario has no experiment, a setting is bad, or the folder holds something else.

    Example:
        >>> results = reproduce(ReproductionSettings("pendulum"), Path("out"))  # doctest: +SKIP
    """
    scenario = load_scenario(settings.scenario)
    experiment = experiment_of(scenario)
    work = Work(
        settings, scenario, experiment, settings.effort(experiment), out, progress or Silent(), workers
    )
    check_device(settings.device)
    with open_folder(out, claim(settings), resume=resume):
        stages: tuple[tuple[str, Callable[[Work], None]], ...] = (
            ("recording the machine", record_stage),
            ("fitting the priors", fit_stage),
            ("judging the priors", physics_stage),
            ("training the networks", ensemble_stage),
        )
        for title, stage in stages:
            work.progress.start(title)
            stage(work)
            work.progress.finish("")
        work.progress.start("writing tables and figures")
        results = write_outputs(work)
        work.progress.finish("")
        return results


@dataclass(frozen=True)
class Work:
    """A reproduction in its folder.

    Args:
        settings: What it computes.
        scenario: The machine.
        experiment: Its experiment.
        effort: How much of it.
        out: The folder.
        progress: Where to report.
        workers: Processes side by side; 0 for none.
    """

    settings: ReproductionSettings
    scenario: Scenario
    experiment: Experiment
    effort: Effort
    out: Path
    progress: Progress = field(default_factory=Silent)
    workers: int = WORKERS

    @property
    def folder(self) -> Path:
        """Where the jobs leave their files."""
        return self.out / "checkpoints"

    @property
    def cases(self) -> list[tuple[str, int]]:
        """Data sets and amounts of training data."""
        return [(data_set, n) for data_set in self.experiment.data_sets for n in self.effort.sequences]

    @property
    def warm(self) -> int:
        """Samples of the warm-up."""
        return round(self.scenario.data.warm_up / self.scenario.data.dt)

    @cached_property
    def sets(self) -> dict[str, Sequence[Trajectory] | Dataset]:
        """What the experiment gives for each data set; the same seed makes the same."""
        sets: dict[str, Sequence[Trajectory] | Dataset] = {}
        for i, name in enumerate(self.experiment.data_sets):
            self.progress.update("data sets", i, len(self.experiment.data_sets), name)
            sets[name] = self.experiment.runs(name, self.settings.seed, self.out / "data" / name)
        return sets

    @cached_property
    def recorded(self) -> dict[str, list[Trajectory]]:
        """All trajectories of each data set."""
        return {
            name: list(found.trajectories if isinstance(found, Dataset) else found)
            for name, found in self.sets.items()
        }

    @property
    def doubts(self) -> list[str]:
        """What is doubtful about the recordings."""
        read = [found.findings for found in self.sets.values() if isinstance(found, Dataset)]
        return list(dict.fromkeys(str(finding) for findings in read for finding in findings))

    def trajectories(self, data_set: str, role: str, most: int) -> list[Trajectory]:
        """The first trajectories of a role, as they were recorded."""
        return [t for t in self.recorded[data_set] if t.role == role][:most]

    def fit(self, data_set: str, count: int) -> dict[str, Any]:
        """Fitted values and smoother of one amount of data; without a fit the scenario's prior and None."""
        if not self.experiment.measured:
            return {"values": self.scenario.prior().values, "smoother": None}
        result: dict[str, Any] = read_json(self.folder / f"{case_key(data_set, count, 'prior')}.json")
        return result

    @cached_property
    def ruler(self) -> Ruler:
        """What judges all models: prior and smoother of the most data of the last data set."""
        name, count = self.experiment.reference, self.effort.sequences[-1]
        test, fit = self.trajectories(name, "test", self.effort.test), self.fit(name, count)
        if self.experiment.measured:
            from hybrid_mpc.identification.evaluation import judged
            from hybrid_mpc.identification.smoothing import Smoother

            prior, levels = self.scenario.prior(fit["values"]), fit["smoother"]
            smoother = Smoother(prior, self.scenario.data.dt, tuple(levels["sigma"]), tuple(levels["walk"]))
            test = judged(smoother.smooth(test), smoother, self.warm)
        return Ruler(test, fit["values"], self.warm, self.experiment.shown)

    def case(self, data_set: str, count: int) -> Case:
        """Data and prior of one amount of training data."""
        train = self.trajectories(data_set, "train", count)
        valid = self.trajectories(data_set, "valid", self.effort.valid)
        fit = self.fit(data_set, count)
        if self.experiment.measured:
            arrays = read_arrays(self.folder / f"{case_key(data_set, count, 'prior')}.npz")
            train, valid = (_with_states(part, arrays) for part in (train, valid))
        return Case(
            self.settings.scenario,
            data_set,
            train,
            valid,
            fit["values"],
            fit["smoother"],
            self.ruler,
            self.folder,
            self.settings.device,
        )

    def training(self, model: str) -> TrainingSettings:
        """Settings of an ensemble's training."""
        from hybrid_mpc.identification.settings import TrainingSettings

        e, free = self.effort, self.effort.free_run_steps if model == "hybrid" else 0
        return TrainingSettings(
            kind="mopgrnn" if model == "hybrid" else model,  # type: ignore[arg-type]
            hidden=e.hidden,
            networks=e.networks,
            teacher_steps=e.steps - free,
            free_run_steps=free,
            seed=self.settings.seed,
            warm=self.warm,
            batch=e.batch,
            decay=e.decay,
            every=e.every,
            form=self.settings.form,  # type: ignore[arg-type]
            fused=True,
        )

    def rows(self) -> list[Row]:
        """Rows of all jobs that are done."""
        found = [read_json(path) for path in sorted(self.folder.glob("*.json"))]
        return [Row.of(row) for job in found for row in job.get("rows", ())]

    def notes(self) -> list[str]:
        """What is doubtful about the recordings, and what was left out, and why."""
        missing = missing_for_sindy()
        return [*self.doubts, *([WITHOUT_SINDY.format(missing)] if missing else [])]

    def done(self, key: str) -> bool:
        """Whether a job has left its files."""
        return (self.folder / f"{key}.json").is_file()

    def run(self, jobs: Jobs) -> None:
        """Run those of the jobs that are not done, and show how many are and what each process does."""
        total, slots = len(jobs), Slots(self.workers)
        todo = {key: job for key, job in jobs.items() if not self.done(key)}
        finished = total - len(todo)

        def ended(key: str, result: Any) -> None:
            nonlocal finished
            finished += 1
            slots.free(key)
            self.progress.update("jobs", finished, total, f"{key} is done")

        def told(key: str, done: int, of: int, text: str) -> None:
            self.progress.update(slots.name(key), done, of, f"{key}: {text}")

        self.progress.update("jobs", finished, total, "")
        if self.workers:
            run_jobs(todo, told, self.workers, ended)
            return
        for key, (function, args) in todo.items():
            ended(key, function(*args, partial(told, key)))


def record_stage(work: Work) -> None:
    """Make the recordings, again if the reproduction was interrupted: the same seed makes the same ones."""
    for doubt in work.doubts:
        work.progress.warn(doubt)


def fit_stage(work: Work) -> None:
    """Fit the prior to every amount of training data of every data set, if it is fitted."""
    jobs: Jobs = {}
    for data_set, count in work.cases if work.experiment.measured else []:
        key = case_key(data_set, count, "prior")
        train = work.trajectories(data_set, "train", count)
        valid = work.trajectories(data_set, "valid", work.effort.valid)
        jobs[key] = (
            fit_job,
            (work.settings.scenario, train, valid, work.effort.fit, work.folder / key),
        )
    work.run(jobs)
    for key in jobs:
        for warning in read_json(work.folder / f"{key}.json")["warnings"]:
            work.progress.warn(f"{key}: {warning}")


def physics_stage(work: Work) -> None:
    """Judge the priors."""
    if work.done("physics"):
        return
    cases = [(work.case(*case), case[1]) for case in work.cases]
    work.run({"physics": (physics_job, (cases, work.folder / "physics"))})


def ensemble_stage(work: Work) -> None:
    """Train and judge every ensemble, and identify the sparse equations."""
    jobs: Jobs = {}
    models = NETWORKS if missing_for_sindy() else (*NETWORKS, "sindy")
    for data_set, count in work.cases:
        keys = {model: case_key(data_set, count, model) for model in models}
        if all(work.done(key) for key in keys.values()):
            jobs |= dict.fromkeys(keys.values(), (ensemble_job, ()))
            continue
        case = work.case(data_set, count)
        for model, key in keys.items():
            if model == "sindy":
                jobs[key] = (sindy_job, (case, count, key))
            else:
                jobs[key] = (ensemble_job, (case, count, model, work.training(model), key))
    work.run(jobs)


def missing_for_sindy() -> str:
    """What the row ``sindy`` needs and is not there; empty if it can be made."""
    for name in ("hybrid_mpc.identification.sindy", "pysindy"):
        if importlib.util.find_spec(name) is None:
            return name
    return ""


def _with_states(trajectories: Sequence[Trajectory], arrays: Mapping[str, Any]) -> list[Trajectory]:
    return [replace(t, x=arrays[f"{t.name}/x"], xdot=arrays[f"{t.name}/xdot"]) for t in trajectories]
