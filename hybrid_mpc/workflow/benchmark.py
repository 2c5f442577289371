"""``hybrid-mpc benchmark``: the stages of a run on given training files, and free runs over test files.

Every choice (settings, networks, recommended model) depends on training and validation data only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Dataset, Trajectory
from hybrid_mpc.engine import Progress
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import check_writable, digest, locked, write_json
from hybrid_mpc.folder import JobNote, open_folder, read_note
from hybrid_mpc.identify.evaluate import OutputErrors
from hybrid_mpc.identify.fit import refit
from hybrid_mpc.identify.linear import LinearModel
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.train import Trained
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.specification import BenchmarkBudget, DataSpec
from hybrid_mpc.records import BESIDE, plain, record
from hybrid_mpc.scenario import Scenario, load_scenario
from hybrid_mpc.workflow.benchmark_runs import (
    BenchmarkRun,
    Recordings,
    benchmark_of,
    in_runs,
    read_test,
    read_training,
    run_error,
    run_freely,
    scored_signals,
)
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stage import Stage, bring_up_to_date, read_as
from hybrid_mpc.workflow.stages.choose import CANDIDATES, CHOICE, ChoiceResult, choice_stage
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, TASKS
from hybrid_mpc.workflow.stages.identify import (
    DATA,
    PRIOR,
    TRAINING,
    DataResult,
    PriorResult,
    TrainingResult,
    examined_prior,
    linear_models,
    stops,
    trained_models,
)

Array = NDArray[np.float64]
NOUN = "benchmark"
SCHEMA_VERSION = 4
SHOWN = 20.0
"""Length of a run that is drawn in full [time constants of the machine]."""
IN_MOTION = 0.1
"""Shortest warm-up of a validation piece [time constants of the machine]. A piece begins in motion, and two samples do
not determine speed and acceleration. Whole recordings with a shorter warm-up (EMPS, 20 ms) begin at rest."""
REFIT_LENGTHS = (0.5, 1.0, 3.0)
"""Lengths of the free runs of a refit [time constants of the machine], the short ones first: from a bad start, the fit
of long runs does not converge. Short runs alone spend most of the data on their initial states."""


@dataclass(frozen=True)
class BenchmarkSettings:
    """Settings of a benchmark.

    Args:
        scenario: Name or file of the scenario.
        data: Training recordings. Default: none, ``model`` is evaluated.
        test: Test recordings. Default: parts of the training recordings that the training holds back.
        model: Folder of an existing model, in place of training. Default: train one.
        budget: Name of a benchmark budget. Default: quick.
        seed: Seed of the training. Default: 0.
        workers: Number of processes. Default: 1.
        refit: For a machine that has changed: length [s] at the start of each test file to which the prior's parameters
            are fitted again; the rest is evaluated with old and new parameters. Default: no refit.
    """

    scenario: str
    data: tuple[Path, ...] = ()
    test: tuple[Path, ...] = ()
    model: Path | None = None
    budget: str = "quick"
    seed: int = 0
    workers: int = 1
    refit: float | None = None


@dataclass(frozen=True)
class _Note:
    """Inputs of a benchmark; its folder cannot continue with other inputs."""

    scenario: str
    data: str
    dt: float
    budget: str
    seed: int
    pieces: str


@dataclass(frozen=True, kw_only=True)
class BenchmarkChoice(ChoiceResult):
    """A run's choice, which long runs may overrule: see :func:`recommended`.

    Args:
        validation: Errors of every model on validation pieces.
        long: Errors on :attr:`Recordings.long`; empty without such runs.
        linear: Linear models by name.
        no_linear: Why a linear model is missing, by name.
    """

    validation: Mapping[str, OutputErrors]
    long: Mapping[str, OutputErrors]
    linear: Mapping[str, LinearModel]
    no_linear: Mapping[str, str]


@dataclass(frozen=True)
class Refit:
    """Refit for a changed machine.

    Args:
        seconds: Length [s] of the data of the refit, at the start of the file.
        values: Refitted parameters.
        before: Errors of prior and recommended model over the rest, with the old parameters.
        after: Errors with the refitted parameters.
    """

    seconds: float
    values: Mapping[str, float]
    before: Mapping[str, OutputErrors]
    after: Mapping[str, OutputErrors]


@dataclass(frozen=True)
class FileResult:
    """Free runs over a test file.

    Args:
        errors: Errors by model; ``"hybrid"`` is the recommended model.
        scored_s: Length [s] of the evaluated data.
        refit: Refit for a changed machine. Default: none.
        runs: The free runs. They are not in ``results.json``.
    """

    errors: Mapping[str, OutputErrors]
    scored_s: float
    refit: Refit | None = None
    runs: Sequence[BenchmarkRun] = field(default=(), compare=False, metadata=BESIDE)


@dataclass(frozen=True)
class BenchmarkResults:
    """``results.json`` of a benchmark: the results of a run's stages, and free runs over the test files.

    Args:
        schema_version: Version of ``results.json``.
        scenario: Name of the scenario.
        seed: Seed of the training.
        budget: Name of the benchmark budget.
        versions: Versions of the packages by name.
        warnings: Warnings about the recordings of this command.
        data: Training recordings.
        prior: Fitted prior. Its errors are those on held-back recordings, or else on the validation pieces.
        training: Trained networks.
        choice: Recommended model, and the errors of all on validation data.
        test: Free runs by test file.
    """

    schema_version: int
    scenario: str
    seed: int
    budget: str
    versions: Mapping[str, str]
    warnings: tuple[str, ...]
    data: DataResult
    prior: PriorResult
    training: TrainingResult
    choice: BenchmarkChoice
    test: Mapping[str, FileResult]

    @property
    def hybrid(self) -> str:
        """The recommended model."""
        return self.choice.choice.recommended


@dataclass(frozen=True)
class BenchmarkContext(Context):
    """A benchmark in its folder: a run whose recordings, budget and lengths of runs are those of the benchmark.

    Args:
        recordings: The training recordings. Default: none, the stages' results are only read.
    """

    recordings: Recordings | None = field(default=None, repr=False, compare=False)

    @property
    def effort(self) -> BenchmarkBudget:
        """Effort of the training."""
        return benchmark_of(self.scenario).budgets[self.settings.budget]

    @property
    def spec(self) -> DataSpec:
        """The data specification; free runs are as long as those over test files."""
        return replace(self.scenario.data, free_run=benchmark_of(self.scenario).length)

    @property
    def fit_length(self) -> float:
        """Length [s] of the longest free runs that the prior is fitted to."""
        spec = benchmark_of(self.scenario)
        return spec.length or spec.piece

    @property
    def run_length(self) -> float | None:
        """Length [s] of free runs: that of the benchmark, else that of its fit; None: whole recordings."""
        return benchmark_of(self.scenario).length or self.prior.longest_run

    def cut(self, over: Sequence[Trajectory], warm_up: float, repeated: bool = False) -> Sequence[Trajectory]:
        """Trajectories cut into free runs after a warm-up of ``warm_up`` [s], if the runs repeat or errors grow."""
        given, dt, length = benchmark_of(self.scenario).length, self.spec.dt, self.run_length
        if length is None or not (repeated or given is None):
            return over
        # two more samples than warm-up and evaluated length: the last input, and the sample that it leads to
        return in_runs(over, round(warm_up / dt) + round(length / dt) + 2)

    @property
    def dataset(self) -> Dataset:
        """The training recordings. Held-back pieces have the role of the test; without them, validation pieces do."""
        assert self.recordings is not None
        own = self.recordings
        last = own.held_back or tuple(replace(piece, role="test") for piece in own.valid)
        parts = enumerate((*own.train, *own.valid, *last), 1)
        pieces = tuple(replace(piece, name=f"{piece.file}#{i}") for i, piece in parts)
        return replace(own.dataset, trajectories=pieces)

    def networks(self, choice: ChoiceResult) -> dict[str, Trained]:
        """Trained networks by kind, each with the share of its correction that was chosen."""
        prior, kinds = self.scenario.prior(self.prior.fit.values), self.read(TRAINING).weights
        return {kind: trained_models(self, kind).shrunk(prior, choice.choice.share(kind)) for kind in kinds}


def prior_of_benchmark(context: Context) -> PriorResult:
    """The fitted prior; a poor one is reported, and does not stop the benchmark."""
    found = examined_prior(context)
    for why in stops(found):
        context.progress.warn(why)
    return found


def choice_of_benchmark(context: Context) -> BenchmarkChoice:
    """The choice of a run, and the errors of all models on validation pieces and long runs, which may overrule it."""
    assert isinstance(context, BenchmarkContext)
    assert context.recordings is not None
    data, found, warm_up = context.recordings, choice_stage(context), context.spec.warm_up
    linear = linear_models(context)
    fitted = {name: own for name, own in linear.items() if not isinstance(own, str)}
    spec, fit, networks = benchmark_of(context.scenario), context.prior.fit, context.networks(found)
    prior = context.scenario.prior(fit.values)

    def errors(over: Sequence[Trajectory], warm_up: float) -> dict[str, OutputErrors]:
        runs = run_freely(
            prior, fit, networks, context.cut(over, warm_up), warm_up=warm_up, length=context.run_length,
            linear=fitted,
        )  # fmt: skip
        return {name: run_error(runs, name, prior.outputs, spec) for name in runs[0].y_hat}

    validation = errors(data.valid, max(warm_up, IN_MOTION * context.time_unit))
    long = errors(data.long, warm_up) if data.long else {}
    hybrid = recommended(
        *({name: e.error for name, e in part.items()} for part in (validation, long)), sure=found.choice.sure
    )
    choice = replace(found.choice, recommended=hybrid)
    if hybrid != found.choice.recommended:
        why = (
            f"Over validation data and long runs, the error of {hybrid} is smaller than that of "
            f"{found.choice.recommended}."
        )
        choice = replace(
            choice, reason=f"{choice.reason} {why}", hybrid=choice.hybrid if hybrid == "phy" else hybrid
        )
    return BenchmarkChoice(
        **{**vars(found), "choice": choice},
        validation=validation,
        long=long,
        linear=fitted,
        no_linear={name: why for name, why in linear.items() if isinstance(why, str)},
    )


PRIOR_OF_BENCHMARK = replace(PRIOR, compute=prior_of_benchmark)
CHOICE_OF_BENCHMARK = Stage(
    CHOICE.name, CHOICE.title, BenchmarkChoice, choice_of_benchmark, CHOICE.reads, CHOICE.needs
)
STAGES: tuple[Stage[Any], ...] = (
    DATA, PRIOR_OF_BENCHMARK, TRAINING, CHOICE_OF_BENCHMARK, EXPORT, NOISE, TASKS,
)  # fmt: skip
"""Stages of a benchmark. They leave a kit in ``model/``; without closed loops, it holds no limits of a monitor."""


def benchmark(
    settings: BenchmarkSettings, out: Path, *, progress: Progress | None = None, cluster: Any = None
) -> BenchmarkResults:
    """Fit, train and evaluate, or evaluate an existing model. The same command continues an interrupted benchmark.

    ``out`` gets ``results.json`` and, after a training, the kit ``model/`` and ``checkpoints/``.

    Args:
        settings: Machine, files and effort.
        out: The folder to make, or one that an interrupted benchmark left.
        progress: Progress display. Default: none.
        cluster: Address of a dask scheduler or a ``distributed.Client``, whose workers train the networks. They must
            reach the files and ``out`` under the same paths. Default: processes of this machine.

    Raises:
        InputError: If a file is bad, if model, budget or folder belong to something else, or if the scheduler cannot
            be reached.
    """
    progress, scenario = progress or Progress(), load_scenario(settings.scenario)
    _check(settings, scenario)
    check_scenario(replace(scenario, plant=None))  # a benchmark runs no closed loop
    data, tests, warnings = _read(settings, scenario)
    for warning in warnings:
        if data is None or warning not in data.dataset.warnings:  # stage data reports the others
            progress.warn(warning)
    if data is None:
        context = _finished(settings, scenario, progress)
        check_writable(out)
    else:
        own = RunSettings(settings.scenario, settings.data, settings.seed, settings.budget)
        context = BenchmarkContext(
            own, scenario, out, progress, cluster, workers=settings.workers, recordings=data
        )
        tests = tests or ({"held back": data.held_back} if data.held_back else {})
    with locked(out) if data is None else open_folder(out, _note(settings, scenario, data), resume=None):
        for stage in () if data is None else STAGES:
            progress.start(stage.title)
            progress.finish(bring_up_to_date(context, stage))
        results = _evaluated(context, tests, warnings, settings.refit)
        write_json(out / "results.json", plain(results))
        return results


def _check(settings: BenchmarkSettings, scenario: Scenario) -> None:
    budgets = benchmark_of(scenario).budgets
    scored_signals(scenario.prior().outputs, benchmark_of(scenario))  # refuses units of what is no output
    if settings.budget not in budgets:
        raise InputError(
            f"budget: scenario {scenario.name} has no benchmark budget {settings.budget!r}; choose one of: "
            f"{', '.join(budgets)} [HM-WORKFLOW-004]"
        )
    if settings.model is None and not settings.data:
        raise InputError(
            "--data: no training recordings. Give them with --data FILE, or an existing model with --model DIR "
            "[HM-WORKFLOW-005]"
        )
    if settings.model is not None and settings.data:
        raise InputError(
            "--model and --data exclude each other: remove --data to evaluate the model, or --model to train a new one "
            "[HM-WORKFLOW-006]"
        )
    if settings.model is not None and not settings.test:
        raise InputError(
            "--model: no test recordings to evaluate the model; give them with --test FILE [HM-WORKFLOW-007]"
        )
    names = [path.name for path in settings.test]
    if len(set(names)) < len(names):
        raise InputError(
            f"--test: two files have the same name: {', '.join(sorted(names))}. Rename one [HM-WORKFLOW-008]"
        )


def _read(
    settings: BenchmarkSettings, scenario: Scenario
) -> tuple[Recordings | None, dict[str, tuple[Trajectory, ...]], list[str]]:
    """Training recordings unless a model is given, test recordings by name, and warnings about both."""
    data: Recordings | None = None
    tests: dict[str, tuple[Trajectory, ...]] = {}
    problems: list[str] = []
    warnings: list[str] = []
    if settings.model is None:
        try:
            data = read_training(scenario, settings.data)
            warnings += data.dataset.warnings
        except InputError as error:
            problems += error.problems
    for path in settings.test:
        try:
            tests[path.name] = read_test(scenario, path, warnings.append)
        except InputError as error:
            problems += error.problems
    refuse(problems)
    return data, tests, list(dict.fromkeys(warnings))


def recommended(
    validation: Mapping[str, float], long: Mapping[str, float], *, sure: Sequence[str] = ("pgrnn", "mopgrnn")
) -> str:
    """The candidate with the least worst-case ratio to the prior's error, over validation pieces and long runs.

    Validation pieces are held out, but they may be shorter than the test runs, and then do not show drift; long runs
    do. Only the kinds of networks in ``sure`` are considered, which are significantly better than the prior on held-out
    data (:func:`~hybrid_mpc.identify.choose.recommend`).
    """

    def larger(name: str) -> float:
        over_prior = [
            1.0 if name == "phy" else part[name] / part["phy"] for part in (validation, long) if part
        ]
        return max(math.inf if math.isnan(v) else v for v in over_prior)  # NaN: both have diverged

    able = ("phy", *sure)
    return min((n for n in CANDIDATES if n in validation and n in able), key=larger)


def _note(settings: BenchmarkSettings, scenario: Scenario, data: Recordings) -> JobNote:
    pieces = digest([[p.role, p.name, p.t[0], p.t[-1]] for p in (*data.train, *data.valid, *data.held_back)])
    own = _Note(scenario.name, data.dataset.hash, scenario.data.dt, settings.budget, settings.seed, pieces)
    return JobNote(NOUN, plain(own))


def _finished(settings: BenchmarkSettings, scenario: Scenario, progress: Progress) -> BenchmarkContext:
    """The benchmark of an existing model, whose results are only read; its folder, or ``model/`` in it, is given.

    Raises:
        InputError: If the folder is no benchmark, damaged, or of another machine or period.
    """
    assert settings.model is not None
    folder = settings.model
    if not (folder / f"{NOUN}.json").is_file():
        folder = folder.resolve().parent
    if not (folder / f"{NOUN}.json").is_file():
        raise InputError(
            f"{settings.model}: no model of a benchmark. Give the folder of 'hybrid-mpc benchmark {scenario.name} "
            "--data FILE --out DIR' [HM-WORKFLOW-009]"
        )
    note = record(_Note, read_note(folder, NOUN)["settings"], str(folder / f"{NOUN}.json"))
    if (note.scenario, note.dt) != (scenario.name, scenario.data.dt):
        raise InputError(
            f"{folder}: holds a model of {note.scenario} with a period of {note.dt:g} s, not of {scenario.name} with "
            f"{scenario.data.dt:g} s. Give a model of {scenario.name} [HM-WORKFLOW-011]"
        )
    own = RunSettings(settings.scenario, (), note.seed, note.budget)
    return BenchmarkContext(own, scenario, folder, progress)


def _evaluated(
    context: BenchmarkContext,
    tests: Mapping[str, Sequence[Trajectory]],
    warnings: Sequence[str],
    refit: float | None,
) -> BenchmarkResults:
    progress, scenario, settings = context.progress, context.scenario, context.settings
    progress.start("free runs over the test files")
    choice = context.read(CHOICE_OF_BENCHMARK)
    networks, found = context.networks(choice), {}
    for i, (name, trajectories) in enumerate(tests.items()):
        progress.update("files", i, len(tests), name)
        found[name] = _evaluate(context, choice, networks, trajectories, refit)
    progress.finish("")
    return BenchmarkResults(
        SCHEMA_VERSION, scenario.name, settings.seed, settings.budget, context.versions, tuple(warnings),
        context.read(DATA), context.prior, context.read(TRAINING), choice, found,
    )  # fmt: skip


def _evaluate(
    context: BenchmarkContext,
    choice: BenchmarkChoice,
    networks: Mapping[str, Trained],
    trajectories: Sequence[Trajectory],
    refit: float | None,
) -> FileResult:
    scenario, dt, old = context.scenario, context.spec.dt, context.prior.fit
    spec, outputs, hybrid = benchmark_of(scenario), scenario.prior().outputs, choice.choice.recommended

    def runs_of(fit: PriorFit, over: Sequence[Trajectory]) -> list[BenchmarkRun]:
        warm_up, prior = context.spec.warm_up, scenario.prior(fit.values)
        return run_freely(
            prior, fit, networks, context.cut(over, warm_up, spec.repeated), warm_up=warm_up,
            length=context.run_length, linear=choice.linear,
        )  # fmt: skip

    runs = runs_of(old, trajectories)
    names = {**{m: m for m in ("phy", *networks)}, "hybrid": hybrid, **{m: m for m in choice.linear}}
    again: Refit | None = None
    if refit is not None:
        new, rest = refitted(scenario.prior, old, trajectories[0], seconds=refit, dt=dt)
        before, after = (
            {name: run_error(own, names[name], outputs, spec) for name in ("phy", "hybrid")}
            for own in (runs_of(fit, [rest]) for fit in (old, new))
        )
        again = Refit(refit, new.values, before, after)
    return FileResult(
        {name: run_error(runs, candidate, outputs, spec) for name, candidate in names.items()},
        sum(len(run.t) for run in runs) * dt,
        again,
        runs,
    )


def read_benchmark(path: Path) -> BenchmarkResults:
    """Read a benchmark's ``results.json``, checked; arrays and runs are empty.

    Raises:
        InputError: If the file is missing, damaged, or of another version.

    Example:
        ``read_benchmark(Path("runs/disk/results.json")).test["hidden.npz"].errors["hybrid"].rmse``
    """
    return read_as(BenchmarkResults, SCHEMA_VERSION, path, "the benchmark")


def refitted(
    make: Callable[..., Prior], fit: PriorFit, trajectory: Trajectory, *, seconds: float, dt: float
) -> tuple[PriorFit, Trajectory]:
    """The prior fitted to the first seconds of a recording of a changed machine, and the rest of the recording.

    The delay is kept. Initial states are free, near those of the old prior's smoother.

    Raises:
        InputError: If the recording is not longer than ``seconds``, or ``seconds`` is too short for a fit.
    """
    lengths = [time_unit([trajectory], dt) * own for own in REFIT_LENGTHS]
    # smallest number of free runs of a refit: a single run would be fitted by many parameters
    n, least = round(seconds / dt), 3 * lengths[0]
    if n >= len(trajectory.t) - 1 or seconds < least:
        raise InputError(
            f"{trajectory.name}: a refit of {seconds:g} s is not possible. It needs at least {least:g} s and less than "
            f"the recording's {len(trajectory.t) * dt:g} s; change --refit [HM-WORKFLOW-012]"
        )
    index = np.arange(len(trajectory.t))
    first = trajectory.part(index < n, trajectory.name, trajectory.role)
    rest = trajectory.part(index >= n, trajectory.name, trajectory.role)
    return refit(make, fit, [first], dt=dt, lengths=lengths), rest


def draw(scenario: Scenario, results: BenchmarkResults, out: Path) -> list[Path]:
    """Draw the longest free run of every test file into ``out/figures``."""
    from hybrid_mpc.plots.fit import benchmark_run
    from hybrid_mpc.plots.style import save

    hybrid = results.hybrid
    chosen = "fitted prior" if hybrid == "phy" else hybrid.upper()
    made, prior = [], scenario.prior()
    units = [(signal.unit, scale) for signal, scale in scored_signals(prior.outputs, benchmark_of(scenario))]
    for file, found in results.test.items():
        run = max(found.runs, key=lambda part: len(part.t))
        drawn = {name: run.y_hat[m] for name, m in (("phy", "phy"), ("rnn", "rnn"), ("hybrid", hybrid))}
        figure = benchmark_run(
            run.t, run.y, drawn, run.u, outputs=prior.outputs, inputs=prior.inputs, units=units,
            shown=SHOWN * time_unit(found.runs, scenario.data.dt),
            title=f"{scenario.title}: free run over {file}", names={"hybrid": f"hybrid ({chosen})"},
        )  # fmt: skip
        made.append(save(figure, out / "figures" / f"{Path(file).stem}.png"))
    return made


def table(results: BenchmarkResults) -> list[str]:
    """The results as lines: a row for each test file and model, with each output's error and fit."""
    lines: list[str] = []
    for file, row in results.test.items():
        for name, found in row.errors.items():
            by_output = [(f"RMSE {label}", value) for label, value in found.rmse.items()]
            by_output += [
                (f"FIT {label.partition(' [')[0]} [%]", found.fit_percent.get(label, math.nan))
                for label in found.rmse
            ]
            if not lines:
                heads = " ".join(f"{head:>{max(12, len(head))}}" for head, _ in by_output)
                lines.append(f"{'file':28} {'model':10} {'error [-]':>12} {heads}")
            cells = " ".join(f"{value:>{max(12, len(head))}.4g}" for head, value in by_output)
            lines.append(f"{file:28} {name:10} {found.error:>12.4g} {cells}")
    lines += [f"no {name}: {why}" for name, why in results.choice.no_linear.items()]
    shares = {kind: results.choice.choice.share(kind) for kind in results.training.weights}
    lines += [
        f"{kind}: {100 * share:.0f} % of its correction" for kind, share in shares.items() if share != 1
    ]
    length = results.prior.longest_run
    lines += [] if length is None else [f"free runs of {length:.3g} s"]
    return [*lines, f"hybrid: {results.hybrid}"]
