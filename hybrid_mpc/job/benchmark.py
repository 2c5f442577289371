"""The benchmark from files to ``results.json``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import check_writable, digest, locked, read_document, write_document, write_json
from hybrid_mpc.identify.delay import OutputErrorFit, Physics, cut_runs, fit_physics, shifted, smoothed
from hybrid_mpc.identify.settings import KINDS, TrainingSettings
from hybrid_mpc.identify.train import Trained, train
from hybrid_mpc.job.benchmark_runs import (
    MODELS,
    Recordings,
    Run,
    benchmark_of,
    figures_of,
    read_test,
    read_training,
    run_freely,
    warm_samples,
)
from hybrid_mpc.job.check import check_scenario
from hybrid_mpc.job.context import Progress, Silent
from hybrid_mpc.job.engine import run_jobs
from hybrid_mpc.job.folder import JobNote, write_note
from hybrid_mpc.job.stages.export import versions
from hybrid_mpc.job.stages.identify import is_trained, load_trained, save_trained
from hybrid_mpc.machine.specification import BenchmarkBudget
from hybrid_mpc.machine.torch_prior import Prior
from hybrid_mpc.records import plain, record
from hybrid_mpc.scenario import Scenario, load_scenario

# Which model a benchmark recommends, from free runs that no test file enters.

IN_MOTION = 0.1
"""Least length [s] that is given of a validation piece: it begins in motion, while a recording that gives less (EMPS,
20 ms) begins at rest, and two samples tell no speed beside an unknown acceleration."""
CANDIDATES = ("phy", "pgrnn", "mopgrnn", "pgrnn mean", "mopgrnn mean")
"""What may be recommended."""


def candidate_errors(
    scenario: Scenario,
    physics: Physics,
    networks: Mapping[str, Trained],
    trajectories: Sequence[Trajectory],
    warm_up: float,
) -> dict[str, float]:
    """Error of every candidate's free runs, in the benchmark's unit.

    Args:
        scenario: The machine.
        physics: The fitted prior.
        networks: Trained networks by kind.
        trajectories: Recordings with the commanded inputs.
        warm_up: Length [s] of what is given of each.
    """
    spec, prior = benchmark_of(scenario), scenario.prior(physics.fit.values)
    runs = run_freely(prior, physics, networks, trajectories, warm_up=warm_up, length=spec.length)
    return {name: figures_of(runs, name, unit=spec.unit, scale=spec.scale)["rmse"] for name in runs[0].y_hat}


def recommended(validation: Mapping[str, float], long: Mapping[str, float]) -> str:
    """The candidate whose larger error, over the prior's, is least: on validation pieces and on runs of full length.

    Validation pieces are what nothing was trained on, but they may be shorter than the runs that judge, and then say
    nothing of a drift.

    Args:
        validation: Errors on the validation pieces.
        long: Errors on :attr:`Recordings.long`; may be empty.

    Example:
        >>> short = {"phy": 2.0, "pgrnn": 1.0, "mopgrnn": 1.5, "pgrnn mean": 1.2, "mopgrnn mean": 1.6}
        >>> recommended(short, {}), recommended(short, {**short, "pgrnn": 3.0, "pgrnn mean": 2.1})
        ('pgrnn', 'mopgrnn')
    """

    def worse(name: str) -> float:
        over_prior = [
            1.0 if name == "phy" else part[name] / part["phy"] for part in (validation, long) if part
        ]
        return max(math.inf if math.isnan(v) else v for v in over_prior)  # NaN: both have diverged

    return min(CANDIDATES, key=worse)


# The free runs of a benchmark as pictures, one for each test file.


def draw(
    scenario: Scenario, results: Mapping[str, Any], runs: Mapping[str, Sequence[Run]], out: Path
) -> list[Path]:
    """Draw the longest free run of every test file into ``out/figures``.

    Args:
        scenario: The machine.
        results: What stands in ``results.json``.
        runs: Free runs by test file.
        out: The benchmark's folder.

    Returns:
        The files.
    """
    from hybrid_mpc.plots.fit import benchmark_run
    from hybrid_mpc.plots.style import save

    kind, _, mean = results["model"]["hybrid"].partition(" ")
    chosen = "fitted prior" if kind == "phy" else kind.upper() + (", mean" if mean else "")
    made, prior, spec = [], scenario.prior(), benchmark_of(scenario)
    for file, parts in runs.items():
        run = max(parts, key=lambda part: len(part.t))
        shown = {
            "phy": run.y_hat["phy"],
            "rnn": run.y_hat["rnn"],
            "hybrid": run.y_hat[results["model"]["hybrid"]],
        }
        figure = benchmark_run(
            run.t, run.y[:, 0], {name: y[:, 0] for name, y in shown.items()}, run.u,
            output=prior.outputs[0], inputs=prior.inputs, unit=spec.unit, scale=spec.scale,
            title=f"{scenario.title}: free run over {file}", names={"hybrid": f"hybrid ({chosen})"},
        )  # fmt: skip
        made.append(save(figure, out / "figures" / f"{Path(file).stem}.png"))
    return made


# The networks of a benchmark: settings from the budget, training in processes of their own.

Report = Callable[[str, int, int, str], None]


def settings_of(kind: str, budget: BenchmarkBudget, *, seed: int, warm: int) -> TrainingSettings:
    """Settings of one kind: free runs are trained on the error of the position, by which they are judged.

    Example:
        >>> budget = BenchmarkBudget(16, 2, teacher_steps=100, free_run_steps=200, horizon=40)
        >>> settings_of("mopgrnn", budget, seed=0, warm=10).objectives
        ('position', 'energy')
    """
    return TrainingSettings(
        kind=kind,  # type: ignore[arg-type]
        hidden=budget.hidden,
        networks=budget.networks,
        teacher_steps=budget.teacher_steps,
        free_run_steps=budget.free_run_steps,
        seed=seed,
        warm=warm,
        horizon=budget.horizon,
        batch=budget.batch,
        decay=budget.decay,
        prior_replay=budget.prior_replay,
        objectives=("position", "energy"),
        fused=True,
    )


def train_all(
    scenario: str,
    values: Mapping[str, float],
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: Callable[[str], TrainingSettings],
    folder: Path,
    *,
    workers: int,
    on_progress: Report = lambda key, done, total, text: None,
) -> dict[str, Trained]:
    """Train the networks of every kind that ``folder`` does not hold yet; an interrupted one goes on.

    Args:
        scenario: Registered name or path, which every process loads for itself.
        values: Parameters of the fitted prior.
        training: Smoothed training pieces.
        validation: Smoothed validation pieces.
        settings: ``kind -> settings``.
        folder: Where checkpoints and finished networks lie.
        workers: Kinds trained side by side.
        on_progress: ``(kind, done, total, text)``.
    """
    jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        kind: (_train, (scenario, dict(values), list(training), list(validation), settings(kind), folder))
        for kind in reversed(KINDS)
        if not is_trained(folder, settings(kind))
    }
    run_jobs(jobs, on_progress, workers)
    return {str(kind): load_trained(folder, kind) for kind in KINDS}


def _train(
    scenario: str,
    values: dict[str, float],
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: TrainingSettings,
    folder: Path,
    report: Callable[[int, int, str], None],
) -> None:
    trained = train(
        load_scenario(scenario).prior(values),
        training,
        validation,
        settings,
        checkpoint=folder / f"{settings.kind}.safetensors",
        on_progress=lambda done, total, error: report(done, total, f"validation RMSE {error:.4g}"),
    )
    save_trained(folder, trained)


# A benchmark's model on disk: parameters, delay, smoother and networks as JSON and plain arrays.

MODEL_NOTE = "benchmark_model.json"
SCHEMA = 1


@dataclass(frozen=True)
class BenchmarkModel:
    """Everything that a free run over another recording needs.

    Args:
        scenario: Name of the machine.
        dt: Model period [s].
        physics: The fitted prior with its delay and smoother.
        networks: Trained networks by kind.
        hybrid: The model that validation recommends, e.g. ``"mopgrnn mean"``.
        validation: Error of every candidate on the validation pieces [unit of the benchmark].
        long: The same over whole recordings, most of which was trained on; empty where none was split in order of time.
    """

    scenario: str
    dt: float
    physics: Physics
    networks: Mapping[str, Trained]
    hybrid: str
    validation: Mapping[str, float]
    long: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Note:
    """What stands in the JSON file beside the networks."""

    schema: int
    scenario: str
    dt: float
    physics: Physics
    hybrid: str
    validation: Mapping[str, float]
    long: Mapping[str, float]


def save_model(folder: Path, model: BenchmarkModel) -> None:
    """Write a model; the note comes last, so a folder that has it is whole."""
    for trained in model.networks.values():
        save_trained(folder, trained)
    note = _Note(SCHEMA, model.scenario, model.dt, model.physics, model.hybrid, model.validation, model.long)
    write_document(folder / MODEL_NOTE, plain(note))


def load_model(folder: Path, scenario: str) -> BenchmarkModel:
    """Read a model from its folder, or from that of the run which made it.

    Raises:
        InputError: If there is none, it is damaged, or of another machine.
    """
    folder = folder if (folder / MODEL_NOTE).is_file() else folder / "model"
    if not (folder / MODEL_NOTE).is_file():
        raise InputError(
            f"{folder.parent} holds no model of a benchmark; give the folder that 'hybrid-mpc benchmark {scenario} "
            "--data FILE --out DIR' has made"
        )
    document = read_document(folder / MODEL_NOTE, "make the benchmark anew")
    if document.get("schema") != SCHEMA:
        raise InputError(
            f"{folder / MODEL_NOTE}: schema {document.get('schema')}, this version reads {SCHEMA}; train anew"
        )
    note = record(_Note, document, str(folder / MODEL_NOTE))
    if note.scenario != scenario:
        raise InputError(f"{folder} holds a model of {note.scenario}, not of {scenario}")
    networks: dict[str, Trained] = {kind: load_trained(folder, kind) for kind in KINDS}
    return BenchmarkModel(
        note.scenario, note.dt, note.physics, networks, note.hybrid, note.validation, note.long
    )


# A machine that has changed: the prior's parameters again, from a few seconds of its motion, and nothing else.

LENGTHS = (0.5, 1.0)
"""Free runs [s] that are fitted, the short ones first: from parameters that are far off a long one leads nowhere."""
EVALUATIONS = 15
FEWEST = 3
"""Free runs at least: one alone would be fitted by any parameters."""


def refitted(
    make: Callable[..., Prior], physics: Physics, trajectory: Trajectory, *, seconds: float, dt: float
) -> tuple[Physics, Trajectory]:
    """Fit the parameters to the first seconds of a recording, starting from those of the machine as it was.

    The delay stays what it is. The free runs start from states that the old prior smooths, then from those of the new
    one: its noise is fitted to what it did not know, so a wrong prior costs little there.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        physics: The prior as it was fitted.
        trajectory: Recording of the changed machine, with the commanded inputs.
        seconds: Length [s] of what is fitted.
        dt: Model period [s].

    Returns:
        The prior with its new parameters, and the rest of the recording.

    Raises:
        InputError: If the recording is no longer than what is to be fitted, or that is too short.
    """
    n = round(seconds / dt)
    if n >= len(trajectory.t) - 1 or seconds < FEWEST * LENGTHS[0]:
        raise InputError(
            f"{trajectory.name}: {seconds:g} s are to be fitted; that takes at least {FEWEST * LENGTHS[0]:g} s and a "
            f"recording that is longer than it ({len(trajectory.t) * dt:g} s)"
        )
    index = np.arange(len(trajectory.t))
    first = trajectory.part(index < n, trajectory.name, trajectory.role)
    rest = trajectory.part(index >= n, trajectory.name, trajectory.role)
    fit = OutputErrorFit(make, dt)
    values = physics.fit.values
    theta, slope = np.array([values[p.name] for p in fit.free]) / fit.unit, np.zeros((0, 0))
    stages = []
    for length in LENGTHS:
        smoother = physics.smoother(make(values), dt)
        known = smoother.smooth(shifted([first], physics.delay))
        runs = cut_runs(known, round(length / dt), 0, len(first.t))
        theta, slope = fit.fit(theta, runs, EVALUATIONS, robust=True)
        values = fit.values(theta)
        stages.append({"stage": f"free runs of {length:g} s", "validation_error": fit.rmse(theta, runs)})
    return replace(physics, fit=fit.result(theta, slope, stages)), rest


@dataclass(frozen=True)
class BenchmarkSettings:
    """What one benchmark computes.

    Args:
        scenario: Registered name or path of a user's Python file.
        data: Training files.
        test: Files to judge on.
        model: Folder of a model made before; then nothing is trained. Default: none.
        budget: Name of the machine's effort. Default: quick.
        seed: Of the networks.
        workers: Kinds of networks trained side by side.
        refit: Length [s] of each test file's start that the prior's parameters are fitted to anew, for a machine that
            has changed; the rest is then judged with the old parameters and with the new ones. Default: none.
    """

    scenario: str
    data: tuple[Path, ...] = ()
    test: tuple[Path, ...] = ()
    model: Path | None = None
    budget: str = "quick"
    seed: int = 0
    workers: int = 1
    refit: float | None = None


def benchmark(
    settings: BenchmarkSettings, out: Path, *, progress: Progress | None = None
) -> tuple[dict[str, Any], dict[str, list[Run]]]:
    """Fit, train, and judge; or judge a model made before.

    The same command goes on where it was interrupted. Settings, the choice among networks and the recommended model
    know the training files' training and validation parts and nothing else.

    Args:
        settings: What to compute.
        out: Folder for ``results.json`` and, if something is trained, ``model/`` and ``checkpoints/``.
        progress: Where to report; default: nowhere.

    Returns:
        What stands in ``results.json``, and the free runs by test file.

    Raises:
        InputError: If a file, the model, the budget or the folder does not fit.
    """
    progress, scenario = progress or Silent(), load_scenario(settings.scenario)
    _check(settings, scenario)
    check_scenario(scenario)
    data, tests, doubts = _read(settings, scenario)
    for doubt in doubts:
        progress.warn(doubt)
    check_writable(out)
    with locked(out):
        return _made_and_judged(settings, scenario, data, tests, doubts, out, progress)


def _made_and_judged(
    settings: BenchmarkSettings,
    scenario: Scenario,
    data: Recordings | None,
    tests: dict[str, tuple[Trajectory, ...]],
    doubts: list[str],
    out: Path,
    progress: Progress,
) -> tuple[dict[str, Any], dict[str, list[Run]]]:
    spec, started = benchmark_of(scenario), time.monotonic()
    notes: dict[str, Any] = {}
    if data is None:
        assert settings.model is not None
        model = load_model(settings.model, scenario.name)
    else:
        model, notes = _made(settings, scenario, data, out, progress)
    for warning in model.physics.fit.warnings:
        progress.warn(f"fit of the prior: {warning}")
    prior = scenario.prior(model.physics.fit.values)
    if data is not None and not tests and data.held_back:
        tests = {"held back": data.held_back}
    progress.start("free runs over the test files")
    runs: dict[str, list[Run]] = {}
    test: dict[str, Any] = {}
    for i, (name, trajectories) in enumerate(tests.items()):
        progress.update("files", i, len(tests), name)
        runs[name] = run_freely(
            prior,
            model.physics,
            model.networks,
            trajectories,
            warm_up=scenario.data.warm_up,
            length=spec.length,
        )
        test[name] = {m: figures_of(runs[name], m, unit=spec.unit, scale=spec.scale) for m in MODELS}
        test[name]["hybrid"] = figures_of(runs[name], model.hybrid, unit=spec.unit, scale=spec.scale)
        if settings.refit is not None:
            test[name]["refit"] = _changed(scenario, model, trajectories[0], settings.refit)
        test[name]["scored_s"] = sum(len(run.t) for run in runs[name]) * model.dt
    progress.finish("")
    results = {
        "schema": SCHEMA,
        "machine": scenario.name,
        "budget": settings.budget if settings.model is None else None,
        "seed": settings.seed if settings.model is None else None,
        **notes,
        "warnings": doubts,
        "model": describe(model, scenario),
        "test": test,
        "versions": versions(),
        "timing": {"seconds": time.monotonic() - started},
    }
    write_json(out / "results.json", results)
    return results, runs


def _changed(scenario: Scenario, model: BenchmarkModel, whole: Trajectory, seconds: float) -> dict[str, Any]:
    """Figures over what follows a recording's first seconds, with the old parameters and with those fitted to them."""
    spec, data = benchmark_of(scenario), scenario.data
    physics, rest = refitted(scenario.prior, model.physics, whole, seconds=seconds, dt=model.dt)
    found: dict[str, Any] = {"seconds": seconds, "prior": physics.fit.rows(scenario.prior().parameters_spec)}
    for key, own in (("before", model.physics), ("after", physics)):
        prior = scenario.prior(own.fit.values)
        runs = run_freely(prior, own, model.networks, [rest], warm_up=data.warm_up, length=spec.length)
        found[key] = {
            name: figures_of(runs, candidate, unit=spec.unit, scale=spec.scale)
            for name, candidate in (("phy", "phy"), ("hybrid", model.hybrid))
        }
    return found


def describe(model: BenchmarkModel, scenario: Scenario) -> dict[str, Any]:
    """What is worth knowing of a model, in plain data."""
    fit, spec = model.physics.fit, benchmark_of(scenario)
    return {
        "prior": fit.rows(scenario.prior().parameters_spec),
        "identifiability": list(fit.identifiability),
        "fits": list(fit.stages),
        "delay_s": model.physics.delay,
        "smoother": {"sigma": model.physics.sigma, "walk": model.physics.walk},
        "hybrid": model.hybrid,
        "validation": {"unit": spec.unit, "rmse": dict(model.validation), "long_rmse": dict(model.long)},
        "networks": {kind: trained.validation for kind, trained in model.networks.items()},
        "faults": {kind: [asdict(f) for f in trained.faults] for kind, trained in model.networks.items()},
    }


def _read(
    settings: BenchmarkSettings, scenario: Scenario
) -> tuple[Recordings | None, dict[str, tuple[Trajectory, ...]], list[str]]:
    """Training files if there are to be some, test files by name, and what is doubtful about them."""
    data: Recordings | None = None
    tests: dict[str, tuple[Trajectory, ...]] = {}
    problems: list[str] = []
    doubts: list[str] = []
    if settings.model is None:
        try:
            data = read_training(scenario, settings.data)
            doubts += [str(finding) for finding in data.dataset.findings]
        except InputError as error:
            problems += error.problems
    for path in settings.test:
        try:
            tests[path.name] = read_test(scenario, path, doubts.append)
        except InputError as error:
            problems += error.problems
    refuse(problems)
    return data, tests, list(dict.fromkeys(doubts))


def _made(
    settings: BenchmarkSettings, scenario: Scenario, data: Recordings, out: Path, progress: Progress
) -> tuple[BenchmarkModel, dict[str, Any]]:
    """Fit and train, or take what ``out`` holds of it; and what is known of the data."""
    _claim(out, settings, data)
    spec, warm_up, dt = benchmark_of(scenario), scenario.data.warm_up, scenario.data.dt
    progress.start("fitting the prior")
    physics = _physics(scenario, data, out, progress)
    train, valid = (smoothed(scenario.prior, physics, part, dt) for part in (data.train, data.valid))
    progress.finish("")
    progress.start("training the networks")
    warm = warm_samples(warm_up, physics.delay, dt)
    budget = spec.budgets[settings.budget]
    networks = train_all(
        settings.scenario,
        physics.fit.values,
        train,
        valid,
        lambda kind: settings_of(kind, budget, seed=settings.seed, warm=warm),
        out / "checkpoints",
        workers=settings.workers,
        on_progress=progress.update,
    )
    progress.finish("")
    errors = partial(candidate_errors, scenario, physics, networks)
    validation = errors(data.valid, max(warm_up, IN_MOTION))
    long = errors(data.long, warm_up) if data.long else {}
    model = BenchmarkModel(
        scenario.name, dt, physics, networks, recommended(validation, long), validation, long
    )
    save_model(out / "model", model)
    seconds = {
        role: sum(len(t.t) for t in part) * dt
        for role, part in (("train", data.train), ("valid", data.valid), ("held_back", data.held_back))
    }
    notes = {
        "files": data.dataset.files,
        "hash": data.dataset.hash,
        "seconds": seconds,
        "validated_on": [piece.name for piece in data.valid],
    }
    return model, {"data": notes}


def _physics(scenario: Scenario, data: Recordings, out: Path, progress: Progress) -> Physics:
    """The fitted prior; a fit that ``out`` holds is not made again."""
    note, spec = out / "checkpoints" / "physics.json", benchmark_of(scenario)
    if note.is_file():
        held = read_document(note, "delete it, and the same command fits the prior anew")
        return record(Physics, held, str(note))
    physics = fit_physics(
        scenario.prior,
        data.train,
        data.valid,
        dt=scenario.data.dt,
        length=spec.length or spec.piece,
        largest_delay=spec.largest_delay,
        on_progress=lambda done, total, text: progress.update("prior", done, total, text),
    )
    write_document(note, plain(physics))
    return physics


def _check(settings: BenchmarkSettings, scenario: Scenario) -> None:
    budgets = benchmark_of(scenario).budgets
    if settings.budget not in budgets:
        raise InputError(
            f"scenario {scenario.name} has no benchmark budget {settings.budget!r}; it has: {', '.join(budgets)}"
        )
    if settings.model is None and not settings.data:
        raise InputError(
            "give recordings to train on with --data FILE, or a model made before with --model DIR"
        )
    if settings.model is not None and settings.data:
        raise InputError("--model is judged as it is: leave --data out, or leave --model out to train anew")
    if settings.model is not None and not settings.test:
        raise InputError("a model made before needs recordings to be judged on: --test FILE")
    names = [path.name for path in settings.test]
    if len(set(names)) < len(names):
        raise InputError(f"two test files have the same name: {', '.join(sorted(names))}; rename one")


def _claim(out: Path, settings: BenchmarkSettings, data: Recordings) -> None:
    """Note in ``out`` what is trained there; another training in the same folder is refused."""
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


def table(results: dict[str, Any]) -> list[str]:
    """The results as lines: a row for each test file and model.

    Example:
        >>> figures = {"rmse": 0.02, "relative": 0.04, "unit": "rad"}
        >>> for line in table({"test": {"a.csv": {"phy": figures, "scored_s": 5.0}}, "model": {"hybrid": "phy"}}):
        ...     print(line)
        file                         model      RMSE         share of the motion
        a.csv                        phy        0.02 rad     0.04
        hybrid: phy
    """
    lines = [f"{'file':28} {'model':10} {'RMSE':12} share of the motion"]
    for file, row in results["test"].items():
        for name in (*MODELS, "hybrid"):
            if name in row:
                rmse = f"{float(row[name]['rmse']):.4g} {row[name]['unit']}"
                lines.append(f"{file:28} {name:10} {rmse:12} {float(row[name]['relative']):.4g}")
    return [*lines, f"hybrid: {results['model']['hybrid']}"]


__all__ = ["BenchmarkSettings", "benchmark", "describe", "table", "KINDS"]
