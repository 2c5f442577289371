"""``hybrid-mpc reproduce``: data, priors, ensembles, tables, figures and claims, resumable at any point.

From top to bottom: the job, its stages, what it writes. No torch in here.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybrid_mpc.data.trajectories import Dataset, Trajectory
from hybrid_mpc.engine import WORKERS, Progress, run_jobs
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_arrays, read_json, write_json, write_text
from hybrid_mpc.folder import JobNote, open_folder, versions
from hybrid_mpc.records import record
from hybrid_mpc.scenario import Scenario, load_scenario
from hybrid_mpc.workflow.settings import check_device
from scenarios.paper.experiment import Effort, Experiment
from scenarios.paper.jobs import RULE, Case, EvaluationSet, ensemble_job, fit_job, physics_job, sindy_job
from scenarios.paper.settings import ReproductionSettings, case_key, experiment_of
from scenarios.paper.table import METRICS, Row, Table, Verdict, verdict_line

if TYPE_CHECKING:
    from hybrid_mpc.identify.prior_result import PriorFit
    from hybrid_mpc.identify.settings import TrainingSettings

Jobs = dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]
NETWORKS = ("hybrid", "mopgrnn", "pgrnn", "rnn")
"""Models that are ensembles, the slowest first."""
WITHOUT_SINDY = "sindy is left out: {} is not installed (pip install 'hybrid-mpc[sindy]')"
SCHEMA = "hybrid-mpc reproduction"
SCHEMA_VERSION = 1
DRAWN = ("phy", "mopgrnn")
"""Models whose free run is drawn with the measurement."""


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
    ``resume=True`` and then equals one that was not. ``workers=0`` runs the jobs in this process.
    """
    scenario = load_scenario(settings.scenario)
    experiment = experiment_of(scenario)
    work = Work(
        settings, scenario, experiment, settings.effort(experiment), out, progress or Progress(), workers
    )
    check_device(settings.device)
    with open_folder(out, JobNote("run", settings.identity()), resume=resume):
        stages: tuple[tuple[str, Callable[[Work], None]], ...] = (
            ("recording the machine", record_stage),
            ("fitting the priors", fit_stage),
            ("evaluating the priors", physics_stage),
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
    """A reproduction in its folder; ``workers`` processes at once, 0 for none."""

    settings: ReproductionSettings
    scenario: Scenario
    experiment: Experiment
    effort: Effort
    out: Path
    progress: Progress = field(default_factory=Progress)
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
        read = [found.warnings for found in self.sets.values() if isinstance(found, Dataset)]
        return list(dict.fromkeys(warning for warnings in read for warning in warnings))

    def trajectories(self, data_set: str, role: str, most: int) -> list[Trajectory]:
        """The first trajectories of a role, as they were recorded."""
        return [t for t in self.recorded[data_set] if t.role == role][:most]

    def fit(self, data_set: str, count: int) -> PriorFit | None:
        """The prior fitted to one amount of data; None where it is taken as it is."""
        if not self.experiment.measured:
            return None
        path = self.folder / f"{case_key(data_set, count, 'prior')}.json"
        from hybrid_mpc.identify.prior_result import PriorFit

        note = {key: value for key, value in read_json(path).items() if key != "seconds"}
        return record(PriorFit, note, str(path))

    @cached_property
    def evaluation(self) -> EvaluationSet:
        """What all models are evaluated on: prior and smoother of the most data of the last data set."""
        name, count = self.experiment.reference, self.effort.sequences[-1]
        test, fit = self.trajectories(name, "test", self.effort.test), self.fit(name, count)
        values = self.scenario.prior().values if fit is None else fit.values
        if fit is not None:
            from hybrid_mpc.identify.evaluate import evaluation_trajectories

            smoother = fit.smoother(self.scenario.prior(values), self.scenario.data.dt)
            test = evaluation_trajectories(smoother.smooth(test), smoother, self.warm)
        return EvaluationSet(test, values, self.warm, self.experiment.shown)

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
            self.scenario.prior().values if fit is None else fit.values,
            fit,
            self.evaluation,
            self.folder,
            self.settings.device,
            self.settings.form,
        )

    def training(self, model: str) -> TrainingSettings:
        """Settings of an ensemble's training."""
        from hybrid_mpc.identify.settings import TrainingSettings

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
            learning_rates=(1e-2, 1e-3, 5e-3, 1e-4),
            every=e.every,
            objectives=("error", "energy"),
        )

    def rows(self) -> list[Row]:
        """Rows of all jobs that are done."""
        found = {path: read_json(path) for path in sorted(self.folder.glob("*.json"))}
        return [record(Row, row, str(path)) for path, job in found.items() for row in job.get("rows", ())]

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

        def report(key: str, done: int, of: int, text: str) -> None:
            self.progress.update(slots.name(key), done, of, f"{key}: {text}")

        self.progress.update("jobs", finished, total, "")
        if self.workers:
            run_jobs(todo, report, self.workers, ended)
            return
        for key, (function, args) in todo.items():
            ended(key, function(*args, partial(report, key)))


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
        jobs[key] = (fit_job, (work.settings.scenario, train, valid, work.folder / key))
    work.run(jobs)
    for key in jobs:
        for warning in read_json(work.folder / f"{key}.json")["warnings"]:
            work.progress.warn(f"{key}: {warning}")


def physics_stage(work: Work) -> None:
    """Evaluate the priors."""
    if work.done("physics"):
        return
    cases = [(work.case(*case), case[1]) for case in work.cases]
    work.run({"physics": (physics_job, (cases, work.folder / "physics"))})


def ensemble_stage(work: Work) -> None:
    """Train and evaluate every ensemble, and identify the sparse equations."""
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
    return "" if importlib.util.find_spec("pysindy") else "pysindy"


def _with_states(trajectories: Sequence[Trajectory], arrays: Mapping[str, Any]) -> list[Trajectory]:
    return [replace(t, x=arrays[f"{t.name}/x"], xdot=arrays[f"{t.name}/xdot"]) for t in trajectories]


class Slots:
    """Gives every running job a place, so that the terminal has a bar a process and not one a job.

    Example:
        >>> slots = Slots(2)
        >>> slots.name("one"), slots.name("two"), slots.name("one")
        ('process 1', 'process 2', 'process 1')
        >>> slots.free("one")
        >>> slots.name("three")
        'process 1'
    """

    def __init__(self, count: int) -> None:
        self._jobs: dict[int, str] = {}
        self._count = count

    def name(self, key: str) -> str:
        """Place of a job; a new one takes the first that is free."""
        slot = next((i for i, job in self._jobs.items() if job == key), None)
        if slot is None:
            slot = next((i for i in range(self._count) if i not in self._jobs), self._count)
            self._jobs[slot] = key
        return f"process {slot + 1}"

    def free(self, key: str) -> None:
        """The job is over."""
        self._jobs = {i: job for i, job in self._jobs.items() if job != key}


def write_outputs(work: Work) -> dict[str, Any]:
    """Collect what the jobs left, check the claims, write tables and figures."""
    rows = work.rows()
    table = Table(rows)
    results = collected(work, rows, table)
    draw(work, table)
    write_text(work.out / "results.csv", table.csv())
    write_text(work.out / "claims.txt", "".join(f"{line}\n" for line in claim_lines(results)))
    write_json(work.out / "results.json", results)
    return read_results(work.out / "results.json")


def collected(work: Work, rows: Sequence[Row], table: Table) -> dict[str, Any]:
    """The results in the form of the schema; ``timing`` is the only part that two equal runs do not share."""
    experiment, jobs = work.experiment, {p.stem: read_json(p) for p in sorted(work.folder.glob("*.json"))}
    claims = []
    for each in experiment.claims:
        verdict = each.check(table)
        claims.append({"name": each.name, "text": each.text, "source": each.source, **asdict(verdict)})
    priors = {key: {"values": job["values"], "standard_errors": job["standard_errors"],
                    "smoother": {"sigma": job["sigma"], "walk": job["walk"]}}
              for key, job in jobs.items() if key.endswith("_prior")}  # fmt: skip
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "scenario": work.scenario.name,
        "figure": experiment.figure,
        "data_sets": dict(experiment.data_sets),
        "settings": work.settings.identity(),
        "versions": versions(),
        "data": {name: _hash(work, name) for name in experiment.data_sets},
        "divergence_rule": RULE,
        "notes": work.notes(),
        "priors": priors,
        "summary": table.summary(),
        "claims": claims,
        "rows": [asdict(row) for row in rows],
        "details": {key: job["details"] for key, job in jobs.items() if job.get("details")},
        "timing": {"seconds_of_jobs": {key: job["seconds"] for key, job in jobs.items()}},
    }


def read_results(path: Path) -> dict[str, Any]:
    """Results of a reproduction."""
    results = read_json(path)
    if not isinstance(results, dict) or results.get("schema") != SCHEMA:
        raise InputError(
            f"{path}: no results of 'hybrid-mpc reproduce'; give its results.json [HM-SCENARIOS-022]"
        )
    if results.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{path}: schema version {results.get('schema_version')}, but this version reads {SCHEMA_VERSION}. "
            "Use the version that wrote it, or run 'hybrid-mpc reproduce' again [HM-SCENARIOS-023]"
        )
    return results


def table_of(results: Mapping[str, Any]) -> Table:
    """The table of results that were read."""
    return Table([record(Row, row, "results of a reproduction") for row in results["rows"]])


def claim_lines(results: Mapping[str, Any]) -> list[str]:
    """A line a claim, then a line a note."""
    lines = [verdict_line(c["text"], c["source"], Verdict(c["holds"], c["found"])) for c in results["claims"]]
    return [*lines, *results["notes"]]


def draw(work: Work, table: Table) -> None:
    """E_sim, RMSE and violation over the amount of data, and a free run of the last data set's most data."""
    from hybrid_mpc.plots.style import save
    from scenarios.paper.plots import errors_over_sequences, shown_free_run

    folder, titles = work.out / "figures", work.experiment.data_sets
    for i, metric in enumerate(("e_sim_s", "rmse_rad", "energy_violation_w")):
        work.progress.update("figures", i, 3 + len(titles), metric)
        figure = errors_over_sequences(panels(table, titles, metric), METRICS[metric])
        save(figure, folder / f"{metric.rsplit('_', 1)[0]}.png")
    for name, title in titles.items():
        runs = {model: _shown(work, name, model) for model in DRAWN}
        prior = work.scenario.prior()
        figure = shown_free_run(runs, prior.states, prior.inputs, model=DRAWN[-1], title=title)
        save(figure, folder / f"free_run_{name}.png")


def panels(table: Table, titles: Mapping[str, str], metric: str) -> dict[str, dict[str, dict[str, Any]]]:
    """Curves by panel title and model: amounts, means, standard deviations, and diverged networks of how many."""
    drawn: dict[str, dict[str, dict[str, Any]]] = {}
    for data_set, title in titles.items():
        curves = drawn.setdefault(title, {})
        for model in table.models:
            cells = {
                n: c for n in table.sequences if (c := table.cell(data_set, n, model, metric)) is not None
            }
            curves[model] = {
                "sequences": list(cells),
                "mean": [np.nan if c.mean is None else c.mean for c in cells.values()],
                "std": [0.0 if c.std is None else c.std for c in cells.values()],
                "diverged": [c.diverged for c in cells.values()],
                "networks": [c.networks for c in cells.values()],
            }
    return drawn


def _shown(work: Work, data_set: str, model: str) -> dict[str, Any]:
    """The drawn run of a model trained on most data; of an ensemble the network best on validation runs."""
    key = case_key(data_set, work.effort.sequences[-1], model)
    if model.startswith("phy"):
        arrays, prefix = read_arrays(work.folder / "physics.npz"), f"{key}/"
    else:
        arrays, prefix = read_arrays(work.folder / f"{key}.npz"), "shown."
    return {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}


def _hash(work: Work, data_set: str) -> str:
    digest = hashlib.sha256()
    for t in work.recorded[data_set]:
        digest.update(t.name.encode())
        for array in (t.u, t.y):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def text_table(results: Mapping[str, Any]) -> list[str]:
    """E_sim of all rows as lines for a terminal: mean ± standard deviation, and diverged networks."""
    table = table_of(results)
    lines = []
    for data_set in table.data_sets:
        lines.append(f"E_sim [s] on test runs, {results['data_sets'][data_set]}")
        lines.append(f"  {'sequences':14}" + "".join(f"{n:>22}" for n in table.sequences))
        for model in table.models:
            cells = [cell_text(table, data_set, n, model) for n in table.sequences]
            lines.append(f"  {model:14}" + "".join(f"{cell:>22}" for cell in cells))
    return lines


def cell_text(table: Table, data_set: str, sequences: int, model: str, metric: str = "e_sim_s") -> str:
    """A figure as tables print it: mean ± standard deviation, and how many networks diverged."""
    cell = table.cell(data_set, sequences, model, metric)
    if cell is None:
        return "-"
    if cell.mean is None:
        return "all diverged"
    text = f"{cell.mean:.4g}" + ("" if cell.std is None else f" ± {cell.std:.2g}")
    return text + (f" ({cell.diverged} diverged)" if cell.diverged else "")
