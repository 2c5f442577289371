"""``hybrid-mpc tune``: stages data and prior of a run, then trials of one kind of network with other settings."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.engine import Progress
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import write_json, write_text
from hybrid_mpc.folder import JobNote, open_folder, versions
from hybrid_mpc.identify.settings import TrainingSettings
from hybrid_mpc.identify.tune import SearchResult, SearchSpace, TrialRow, check_numbers, tune
from hybrid_mpc.plots import tune as plots
from hybrid_mpc.plots.style import save
from hybrid_mpc.report.page import Cell, Table
from hybrid_mpc.rules import counted
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stage import bring_up_to_date, read_as
from hybrid_mpc.workflow.stages.identify import DATA, MODELS, PRIOR, check_data, training_settings

SCHEMA_VERSION = 1
RATES = ("learning_rate", "free_run_learning_rate")


@dataclass(frozen=True)
class TuneSettings(RunSettings):
    """Settings of ``hybrid-mpc tune``: those of a run, whose networks are the first trial; kind of network; search
    space.
    """

    kind: str = "mopgrnn"
    space: SearchSpace = field(default_factory=SearchSpace)

    def __post_init__(self) -> None:
        kinds = [name for name in MODELS if not name.startswith("phy")]
        if self.kind not in kinds:
            raise InputError(
                f"kind: unknown network {self.kind!r}; choose one of: {', '.join(kinds)} [HM-WORKFLOW-045]"
            )
        if self.kind == "rnn" and self.space.prior_replay is not None:
            raise InputError(
                "prior_replay: an rnn has no prior, so it cannot be varied; remove it from the search space "
                "[HM-WORKFLOW-046]"
            )


@dataclass(frozen=True)
class TuneData:
    """The recordings of a search.

    Args:
        hash: Hash of their contents.
        warnings: Warnings about the recordings.
    """

    hash: str
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class TuneResults:
    """``results.json`` of ``hybrid-mpc tune``.

    Args:
        schema: ``"hybrid-mpc tune"``.
        schema_version: Version of the file.
        scenario: Registered name, or the name in the scenario file.
        seed: Seed of data, trainings and search.
        budget: ``quick``, ``full``, or a budget of the scenario.
        kind: Kind of network.
        space: Bounds of the searched settings.
        base_settings: Settings of the first trial, and all settings that are not searched.
        versions: Versions of the packages by name.
        data: Recordings.
        base_value: Validation error with ``base_settings``; None if these are outside the space.
        best: The best trial.
        settings: Settings of the best trial, as in ``settings.json``.
        importance: Share of each setting in the variation of the errors; empty if unknown.
        trials: All trials.
    """

    schema: str
    schema_version: int
    scenario: str
    seed: int
    budget: str
    kind: str
    space: Mapping[str, tuple[int | float, int | float]]
    base_settings: TrainingSettings
    versions: Mapping[str, str]
    data: TuneData
    base_value: float | None
    best: TrialRow
    settings: Mapping[str, int | float | tuple[float, ...]]
    importance: Mapping[str, float]
    trials: tuple[TrialRow, ...]


def read_tuning(path: Path) -> TuneResults:
    """Read a ``results.json`` of ``hybrid-mpc tune``, checked.

    Raises:
        InputError: If the file is missing, damaged, or of another version.

    Example:
        ``read_tuning(Path("runs/tune/results.json")).best.value``
    """
    return read_as(TuneResults, SCHEMA_VERSION, path, "hybrid-mpc tune")


def run_tuning(
    settings: TuneSettings,
    out: Path,
    *,
    trials: int = 20,
    timeout: float | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> TuneResults:
    """Search the settings of one kind of network, and write settings, tables and figures into ``out``.

    Stages data and prior are those of a run with the same seed, so a run with the best settings trains the networks of
    the best trial. Only training and validation recordings are used.

    Args:
        settings: Settings of the run, kind of network, search space.
        out: Folder to write.
        trials: Number of trials. Default: 20. A resumed search may have more.
        timeout: Time [s] after which no new trial starts. Default: none.
        resume: Whether to continue the search in ``out``. Default: False.
        progress: Where to report. Default: nowhere.

    Raises:
        InputError: For any bad input.
    """
    check_numbers(trials, settings.seed, timeout)
    context = Context(settings, load_scenario(settings.scenario), out, progress or Progress())
    check_scenario(replace(context.scenario, plant=None), context.budget)  # tuning runs no closed loop
    check_data(context)
    with open_folder(out, JobNote("run", settings.identity()), resume=resume):
        for stage in (DATA, PRIOR):
            context.progress.start(stage.title)
            context.progress.finish(bring_up_to_date(context, stage))
        context.progress.start(f"searching, {trials} trials")
        found = tune(
            context.scenario.prior(context.prior.fit.values),
            context.smoothed("train"),
            context.smoothed("valid"),
            training_settings(context, settings.kind),
            settings.space,
            trials=trials,
            storage=out / "tune.jsonl",
            seed=settings.seed,
            timeout=timeout,
            on_progress=lambda number, done, total, error: context.progress.update(
                "trials",
                number * total + done,
                trials * total,
                f"trial {number}: validation E_sim {error:.4g}",
            ),
        )
        context.progress.finish(counted(len(found.trials), "trial"))
        return _write(context, settings, found)


def usage(settings: RunSettings, out: Path) -> str:
    """The command line of a run with the best settings."""
    effort = "--seed", str(settings.seed), "--budget", settings.budget
    found = "--settings", str(out / "settings.json"), "--out", f"{out}-run"
    return shlex.join(["hybrid-mpc", "run", settings.scenario, *settings.options(str), *effort, *found])


def _write(context: Context, settings: TuneSettings, found: SearchResult) -> TuneResults:
    out, names = context.out, settings.space.names
    fields = dict.fromkeys("learning_rates" if name in RATES else name for name in names)
    best = {name: getattr(found.settings, name) for name in fields}
    data = context.read(DATA)
    results = TuneResults(
        "hybrid-mpc tune", SCHEMA_VERSION, context.scenario.name, settings.seed, settings.budget, settings.kind,
        {name: settings.space.bounds(name) for name in names}, training_settings(context, settings.kind), versions(),
        TuneData(data.hash, data.warnings), found.base, found.best, best, found.importance, found.trials,
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = [
        (t.number, t.state, t.value, t.mean, t.steps, t.duration, *(t.values[n] for n in names))
        for t in found.trials
    ]
    columns = ("number", "state", "value", "mean", "steps", "duration_s", *names)
    write_text(out / "trials.csv", Table(columns, rows).csv())
    drawn = [t.state for t in found.trials], [t.value for t in found.trials]
    searched = {name: [t.values[name] for t in found.trials] for name in names}
    save(plots.history(*drawn, base=found.base), out / "figures" / "tune_history.png")
    save(plots.settings(searched, *drawn), out / "figures" / "tune_settings.png")
    write_json(out / "settings.json", best)
    write_json(out / "results.json", results)
    return results
