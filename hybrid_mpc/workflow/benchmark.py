"""``hybrid-mpc benchmark``: fit and train on training recordings, and evaluate free runs over test recordings.

Every choice (settings, networks, recommended model) depends on training and validation data only.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.engine import Progress
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import check_writable, digest, locked, read_document, write_document, write_json
from hybrid_mpc.folder import JobNote, versions, write_note
from hybrid_mpc.identify.choose import Choice, evidence_of, recommend
from hybrid_mpc.identify.evaluate import OutputErrors, free_runs, unseen_runs
from hybrid_mpc.identify.fit import fit_prior, refit, smoothed
from hybrid_mpc.identify.linear import BASELINES, LinearModel
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.settings import TrainingSettings, kinds_of
from hybrid_mpc.identify.step import PriorStep, Step
from hybrid_mpc.identify.train import Trained
from hybrid_mpc.kit.parts import BENCHMARK_NOTE
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.specification import BenchmarkBudget
from hybrid_mpc.records import plain, record
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
    warm_samples,
)
from hybrid_mpc.workflow.stages.choose import CANDIDATES
from hybrid_mpc.workflow.stages.identify import PARTS, load_trained, save_trained, train_kinds

Array = NDArray[np.float64]
SCHEMA = 3
SHOWN = 20.0
"""Length of a run that is drawn in full [time constants of the machine]."""
IN_MOTION = 0.1
"""Shortest warm-up of a validation piece [time constants of the machine]. A piece begins in motion, and two samples do
not determine speed and acceleration. Whole recordings with a shorter warm-up (EMPS, 20 ms) begin at rest."""
REFIT_LENGTHS = (0.5, 1.0, 3.0)
"""Lengths of the free runs of a refit [time constants of the machine], the short ones first: from a bad start, the fit
of long runs does not converge. Short runs alone spend most of the data on their initial states."""
FEWEST_RUNS = 3
"""Smallest number of free runs of a refit: a single run would be fitted by many parameters."""


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
class _Description:
    """Content of the JSON file next to the networks, see :class:`BenchmarkModel`."""

    scenario: str
    dt: float
    fit: PriorFit
    hybrid: str
    validation: Mapping[str, OutputErrors]
    long: Mapping[str, OutputErrors]
    kinds: tuple[str, ...]
    linear: Mapping[str, LinearModel]
    no_linear: Mapping[str, str]
    choice: Choice


@dataclass(frozen=True)
class BenchmarkModel(_Description):
    """Everything that a free run over another recording needs: prior, recommended model (``hybrid``), networks by kind.

    ``validation`` and ``long`` are the errors of every model on validation pieces and on :attr:`Recordings.long`;
    ``linear`` are the linear baselines by name, ``no_linear`` says why a baseline is missing. ``choice`` compares the
    networks with the prior on held-out data.
    """

    networks: Mapping[str, Trained]


@dataclass(frozen=True)
class Refit:
    """Refit for a changed machine: errors with old and new parameters over the part after the refitted seconds."""

    seconds: float
    prior: Sequence[Mapping[str, Any]]
    before: Mapping[str, OutputErrors]
    after: Mapping[str, OutputErrors]


@dataclass(frozen=True)
class FileResult:
    """A test file: its free runs, the errors by model (``"hybrid"`` is the recommended model), and the length of the
    evaluated data ``scored_s`` [s].
    """

    runs: Sequence[BenchmarkRun]
    errors: Mapping[str, OutputErrors]
    scored_s: float
    refit: Refit | None = None


@dataclass(frozen=True)
class BenchmarkResults:
    """The model of a benchmark, and the results of each test file."""

    model: BenchmarkModel
    test: Mapping[str, FileResult]


def benchmark(
    settings: BenchmarkSettings, out: Path, *, progress: Progress | None = None, cluster: Any = None
) -> BenchmarkResults:
    """Fit, train and evaluate, or evaluate an existing model. The same command continues an interrupted benchmark.

    ``out`` gets ``results.json`` and, after a training, ``model/`` and ``checkpoints/``.

    Args:
        settings: Machine, files and effort.
        out: The folder to make, or one that an interrupted benchmark left.
        progress: What shows the progress. Default: nothing.
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
        progress.warn(warning)
    check_writable(out)
    with locked(out):
        started = time.monotonic()
        if data is None:
            assert settings.model is not None
            model = load_model(settings.model, scenario.name)
        else:
            model = _make(settings, scenario, data, out, progress, cluster)
            tests = tests or ({"held back": data.held_back} if data.held_back else {})
        for warning in model.fit.warnings:
            progress.warn(f"fit of the prior: {warning}")
        progress.start("free runs over the test files")
        found = {}
        for i, (name, trajectories) in enumerate(tests.items()):
            progress.update("files", i, len(tests), name)
            found[name] = _evaluate(scenario, model, trajectories, settings.refit)
        progress.finish("")
        results = BenchmarkResults(model, found)
        document = _document(settings, scenario, data, results, warnings)
        write_json(out / "results.json", {**document, "timing": {"seconds": time.monotonic() - started}})
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


# The model: fit, training and choice; finished parts are read from the folder.


def _make(
    settings: BenchmarkSettings,
    scenario: Scenario,
    data: Recordings,
    out: Path,
    progress: Progress,
    cluster: Any,
) -> BenchmarkModel:
    _claim(out, settings, data)
    spec, warm_up, dt = benchmark_of(scenario), scenario.data.warm_up, scenario.data.dt
    progress.start("fitting the prior")
    fit = _fitted_prior(scenario, data, out, progress)
    progress.finish("")
    progress.start("training the networks")
    warm = warm_samples(warm_up, fit.delay, dt)
    train, valid = (list(smoothed(scenario.prior, fit, part, dt)) for part in (data.train, data.valid))
    budget = spec.budgets[settings.budget]
    whole = train_kinds(
        settings.scenario, fit.values, train, valid,
        {kind: training_settings(kind, budget, seed=settings.seed, warm=warm) for kind in kinds_of(scenario.prior())},
        out / "checkpoints", workers=settings.workers, on_progress=progress.update, cluster=cluster,
    )  # fmt: skip
    progress.finish("")
    progress.start("fitting the linear baselines")
    linear, no_linear = _baselines(scenario, data)
    progress.finish("")
    choice, prior = _choice(scenario, fit, whole, train, valid), scenario.prior(fit.values)
    networks = {kind: trained.shrunk(prior, choice.share(kind)) for kind, trained in whole.items()}
    errors = partial(candidate_errors, scenario, fit, networks, linear)
    validation = errors(data.valid, max(warm_up, IN_MOTION * time_unit(data.train, dt)))
    long = errors(data.long, warm_up) if data.long else {}
    hybrid = recommended(
        *({name: e.error for name, e in part.items()} for part in (validation, long)), sure=choice.sure
    )
    model = BenchmarkModel(
        scenario=scenario.name,
        dt=dt,
        fit=fit,
        hybrid=hybrid,
        validation=validation,
        long=long,
        kinds=tuple(networks),
        linear=linear,
        no_linear=no_linear,
        choice=choice,
        networks=networks,
    )
    save_model(out / "model", model)
    return model


def _baselines(scenario: Scenario, data: Recordings) -> tuple[dict[str, LinearModel], dict[str, str]]:
    """Linear models by name, chosen on the same validation pieces, and why a model is missing."""
    dt, found, missing = scenario.data.dt, {}, {}
    # the initial state of the other models is estimated with this sample
    warm = warm_samples(max(scenario.data.warm_up, IN_MOTION), 0.0, dt) + 1
    for name, fitted in BASELINES.items():
        try:
            found[name] = fitted(data.train, data.valid, dt, warm=warm)
        except InputError as error:
            missing[name] = str(error)
    return found, missing


def _claim(out: Path, settings: BenchmarkSettings, data: Recordings) -> None:
    """Write a note of the training into ``out``; another training in the same folder is refused."""
    own = {
        "scenario": settings.scenario,
        "data": data.dataset.hash,
        "budget": settings.budget,
        "seed": settings.seed,
        "pieces": digest(
            [[p.role, p.name, p.t[0], p.t[-1]] for p in (*data.train, *data.valid, *data.held_back)]
        ),
    }
    write_note(out, JobNote("benchmark", own), resume=None)


def _fitted_prior(scenario: Scenario, data: Recordings, out: Path, progress: Progress) -> PriorFit:
    """The fitted prior, read from ``out`` if it is already there."""
    note, spec = out / "checkpoints" / "prior.json", benchmark_of(scenario)
    if note.is_file():
        held = read_document(note, "delete this file; then the same command fits the prior again")
        return record(PriorFit, held, str(note))
    fit = fit_prior(
        scenario.prior, data.train, data.valid, dt=scenario.data.dt, length=spec.length or spec.piece,
        largest_delay=scenario.data.largest_delay, on_progress=partial(progress.update, "prior"),
    )  # fmt: skip
    write_document(note, plain(fit))
    return fit


def training_settings(kind: str, budget: BenchmarkBudget, *, seed: int, warm: int) -> TrainingSettings:
    """Training settings of one kind: free runs are trained on the output error, which the benchmark evaluates."""
    return TrainingSettings(
        kind=kind,  # type: ignore[arg-type]
        seed=seed,
        warm=warm,
        objectives=("output", "balances"),
        parts=max(PARTS, budget.networks),
        **asdict(budget),
    )


def candidate_errors(
    scenario: Scenario,
    fit: PriorFit,
    networks: Mapping[str, Trained],
    linear: Mapping[str, LinearModel],
    trajectories: Sequence[Trajectory],
    warm_up: float,
) -> dict[str, OutputErrors]:
    """Errors of every model's free runs after a warm-up of ``warm_up`` [s]."""
    spec, prior = benchmark_of(scenario), scenario.prior(fit.values)
    runs = run_freely(prior, fit, networks, trajectories, warm_up=warm_up, length=spec.length, linear=linear)
    return {name: run_error(runs, name, prior.outputs, spec) for name in runs[0].y_hat}


def _choice(
    scenario: Scenario,
    fit: PriorFit,
    networks: Mapping[str, Trained],
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
) -> Choice:
    """Comparison of the networks with the prior on held-out data; trajectories are smoothed."""
    prior, dt = scenario.prior(fit.values), scenario.data.dt
    settings, smoother = networks["pgrnn"].settings, fit.smoother(prior, dt)
    runs = unseen_runs(settings, training, validation, smoother, benchmark_of(scenario).length)

    def errors(step_of: Callable[[int | None], Step]) -> list[Array]:
        return [
            run.squared_errors(smoother.sizes.y)
            for own, them in runs
            for run in free_runs(step_of(own), prior, them, settings.warm)
        ]

    plain_prior = PriorStep(prior, dt, fit.substeps)
    found = {"phy": errors(lambda own: plain_prior)}

    def of_kind(kind: str, share: float = 1.0) -> list[Array]:
        trained = networks[kind].shrunk(prior, share)
        return errors(lambda own: trained.step(prior, dt, own))

    found |= {kind: of_kind(kind) for kind in networks if kind in CANDIDATES}
    recordings, evidence = evidence_of(runs)
    return recommend(
        found, samples=max(1, round(time_unit(training, dt) / dt)), recordings=recordings, evidence=evidence,
        shrunk=of_kind, rule=scenario.choice,
    )  # fmt: skip


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


def save_model(folder: Path, model: BenchmarkModel) -> None:
    """Write a model, its note last: a folder with a note is complete."""
    for trained in model.networks.values():
        save_trained(folder, trained)
    description = {f.name: getattr(model, f.name) for f in fields(_Description)}
    write_document(folder / BENCHMARK_NOTE, {"schema": SCHEMA, **description})


def load_model(folder: Path, scenario: str) -> BenchmarkModel:
    """Read a model from its folder, or from the folder of its benchmark.

    Raises:
        InputError: If the model is missing, damaged, or of another machine.
    """
    folder = folder if (folder / BENCHMARK_NOTE).is_file() else folder / "model"
    path = folder / BENCHMARK_NOTE
    if not path.is_file():
        raise InputError(
            f"{folder.parent}: no model of a benchmark. Give the folder of 'hybrid-mpc benchmark {scenario} "
            "--data FILE --out DIR' [HM-WORKFLOW-009]"
        )
    document = read_document(path, "run the benchmark again")
    schema = document.pop("schema", None)
    if schema != SCHEMA:
        raise InputError(
            f"{path}: schema {schema}, but this version reads {SCHEMA}. Train the model again [HM-WORKFLOW-010]"
        )
    found = record(_Description, document, str(path))
    if found.scenario != scenario:
        raise InputError(
            f"{folder}: holds a model of {found.scenario}, not of {scenario}. Give a model of {scenario} "
            "[HM-WORKFLOW-011]"
        )
    return BenchmarkModel(**vars(found), networks={kind: load_trained(folder, kind) for kind in found.kinds})


# The evaluation.


def _evaluate(
    scenario: Scenario, model: BenchmarkModel, trajectories: Sequence[Trajectory], refit: float | None
) -> FileResult:
    runs = _runs(scenario, model, model.fit, trajectories)
    spec, outputs = benchmark_of(scenario), scenario.prior().outputs
    names = {**{m: m for m in ("phy", *model.kinds)}, "hybrid": model.hybrid, **{m: m for m in model.linear}}
    return FileResult(
        runs,
        {name: run_error(runs, candidate, outputs, spec) for name, candidate in names.items()},
        sum(len(run.t) for run in runs) * model.dt,
        None if refit is None else _refit(scenario, model, trajectories[0], refit),
    )


def _runs(
    scenario: Scenario, model: BenchmarkModel, fit: PriorFit, trajectories: Sequence[Trajectory]
) -> list[BenchmarkRun]:
    prior, spec = scenario.prior(fit.values), benchmark_of(scenario)
    warm_up, dt = scenario.data.warm_up, model.dt
    if spec.repeated and spec.length is not None:
        # two more samples than warm-up and evaluated length: the last input, and the sample that it leads to
        trajectories = in_runs(trajectories, round(warm_up / dt) + round(spec.length / dt) + 2)
    return run_freely(
        prior, fit, model.networks, trajectories, warm_up=warm_up, length=spec.length, linear=model.linear
    )


def _refit(scenario: Scenario, model: BenchmarkModel, whole: Trajectory, seconds: float) -> Refit:
    fit, rest = refitted(scenario.prior, model.fit, whole, seconds=seconds, dt=model.dt)
    spec, outputs, errors = benchmark_of(scenario), scenario.prior().outputs, []
    for own in (model.fit, fit):
        runs = _runs(scenario, model, own, [rest])
        names = {"phy": "phy", "hybrid": model.hybrid}
        errors.append({name: run_error(runs, of, outputs, spec) for name, of in names.items()})
    return Refit(seconds, fit.rows(scenario.prior().parameters), *errors)


def refitted(
    make: Callable[..., Prior], fit: PriorFit, trajectory: Trajectory, *, seconds: float, dt: float
) -> tuple[PriorFit, Trajectory]:
    """The prior fitted to the first seconds of a recording of a changed machine, and the rest of the recording.

    The delay is kept. Initial states are free, near those of the old prior's smoother.

    Raises:
        InputError: If the recording is not longer than ``seconds``, or ``seconds`` is too short for a fit.
    """
    lengths = [time_unit([trajectory], dt) * own for own in REFIT_LENGTHS]
    n, least = round(seconds / dt), FEWEST_RUNS * lengths[0]
    if n >= len(trajectory.t) - 1 or seconds < least:
        raise InputError(
            f"{trajectory.name}: a refit of {seconds:g} s is not possible. It needs at least {least:g} s and less than "
            f"the recording's {len(trajectory.t) * dt:g} s; change --refit [HM-WORKFLOW-012]"
        )
    index = np.arange(len(trajectory.t))
    first = trajectory.part(index < n, trajectory.name, trajectory.role)
    rest = trajectory.part(index >= n, trajectory.name, trajectory.role)
    return refit(make, fit, [first], dt=dt, lengths=lengths), rest


# Output: results.json, figures, table.


def _document(
    settings: BenchmarkSettings,
    scenario: Scenario,
    data: Recordings | None,
    results: BenchmarkResults,
    warnings: Sequence[str],
) -> dict[str, Any]:
    """The content of ``results.json`` without the computing time."""
    trained = settings.model is None
    notes = {}
    if data is not None:
        parts = {"train": data.train, "valid": data.valid, "held_back": data.held_back}
        notes["data"] = {
            "files": data.dataset.files,
            "hash": data.dataset.hash,
            "seconds": {role: sum(len(t.t) for t in part) * results.model.dt for role, part in parts.items()},
            "validated_on": [piece.name for piece in data.valid],
        }
    test = {
        name: {**row.errors, **({} if row.refit is None else {"refit": row.refit}), "scored_s": row.scored_s}
        for name, row in results.test.items()
    }
    return {
        "schema": SCHEMA,
        "machine": scenario.name,
        "budget": settings.budget if trained else None,
        "seed": settings.seed if trained else None,
        **notes,
        "warnings": warnings,
        "model": describe(results.model, scenario),
        "test": test,
        "versions": versions(),
    }


def describe(model: BenchmarkModel, scenario: Scenario) -> dict[str, Any]:
    """Plain description of a model: parameters, delay, smoother, errors by candidate and network."""
    fit = model.fit
    return {
        "prior": fit.rows(scenario.prior().parameters),
        "identifiability": fit.identifiability,
        "fits": fit.stages,
        "delay_s": fit.delay,
        "smoother": {"sigma": fit.sigma, "walk": fit.walk},
        "hybrid": model.hybrid,
        "choice": model.choice,
        "validation": model.validation,
        "long": model.long,
        "baselines": {name: {"chosen": own.chosen.text} for name, own in model.linear.items()}
        | {name: {"reason": why} for name, why in model.no_linear.items()},
        "networks": {kind: trained.validation for kind, trained in model.networks.items()},
        "faults": {kind: trained.failures for kind, trained in model.networks.items()},
    }


def draw(scenario: Scenario, results: BenchmarkResults, out: Path) -> list[Path]:
    """Draw the longest free run of every test file into ``out/figures``."""
    from hybrid_mpc.plots.fit import benchmark_run
    from hybrid_mpc.plots.style import save

    hybrid = results.model.hybrid
    chosen = "fitted prior" if hybrid == "phy" else hybrid.upper()
    made, prior = [], scenario.prior()
    units = [(signal.unit, scale) for signal, scale in scored_signals(prior.outputs, benchmark_of(scenario))]
    for file, found in results.test.items():
        run = max(found.runs, key=lambda part: len(part.t))
        drawn = {name: run.y_hat[m] for name, m in (("phy", "phy"), ("rnn", "rnn"), ("hybrid", hybrid))}
        figure = benchmark_run(
            run.t, run.y, drawn, run.u, outputs=prior.outputs, inputs=prior.inputs, units=units,
            shown=SHOWN * time_unit(found.runs, results.model.dt),
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
    lines += [f"no {name}: {why}" for name, why in results.model.no_linear.items()]
    model, shares = results.model, {kind: results.model.choice.share(kind) for kind in results.model.kinds}
    lines += [
        f"{kind}: {100 * share:.0f} % of its correction" for kind, share in shares.items() if share != 1
    ]
    return [*lines, f"hybrid: {model.hybrid}"]
