"""The benchmark from files to ``results.json``."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import (
    check_writable,
    digest,
    locked,
    read_document,
    write_document,
    write_json,
)
from hybrid_mpc.identification.settings import KINDS
from hybrid_mpc.job.folder import Claim, check_claim
from hybrid_mpc.pipeline.context import Progress, Silent
from hybrid_mpc.pipeline.deploy import versions
from hybrid_mpc.pipeline.machine_benchmark.choice import IN_MOTION, candidate_errors, recommended
from hybrid_mpc.pipeline.machine_benchmark.free_runs import MODELS, Run, figures_of, run_freely, warm_samples
from hybrid_mpc.pipeline.machine_benchmark.networks import settings_of, train_all
from hybrid_mpc.pipeline.machine_benchmark.physics import Physics, fit_physics, smoothed
from hybrid_mpc.pipeline.machine_benchmark.recordings import (
    Recordings,
    benchmark_of,
    read_test,
    read_training,
)
from hybrid_mpc.pipeline.machine_benchmark.refit import refitted
from hybrid_mpc.pipeline.machine_benchmark.store import BenchmarkModel, load_model, save_model
from hybrid_mpc.pipeline.preflight import check_scenario
from hybrid_mpc.records import plain, record
from hybrid_mpc.scenario import Scenario, load_scenario

SCHEMA = 1
NOTE = "benchmark.json"
"""What says which benchmark a folder holds."""


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
    claim = Claim(
        "benchmark", NOTE, own, lambda folder: write_document(folder / NOTE, own),
        lambda folder: read_document(folder / NOTE),
    )  # fmt: skip
    there = (out / NOTE).is_file()
    check_claim(out, claim, resume=there)
    if not there:
        claim.write(out)


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
