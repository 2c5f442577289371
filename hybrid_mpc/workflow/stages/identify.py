"""Stages data, prior, training and evaluation: from recordings to models and their free runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from numpy.typing import NDArray

from hybrid_mpc.check.preflight import warn_of_drift
from hybrid_mpc.data import scales
from hybrid_mpc.data.excitation import check_excitation, short_runs
from hybrid_mpc.data.trajectories import ROLES, Cut, Trajectory
from hybrid_mpc.engine import WORKERS, run_jobs
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import digest, read_document, read_document_arrays, sha256, write_document
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.evaluate import (
    FreeRun,
    OutputErrors,
    evaluation_trajectories,
    free_runs,
    output_errors,
    run_length,
    score,
    stacked_free_runs,
)
from hybrid_mpc.identify.fit import beyond_ranges, fit_prior, smoothed
from hybrid_mpc.identify.linear import BASELINES, LinearModel
from hybrid_mpc.identify.own_fits import fit_each
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.settings import KINDS, Kind, TrainingSettings, kinds_of
from hybrid_mpc.identify.simulation import measured_as
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.identify.sound import (
    BoundCost,
    bound_costs,
    bounds_doubt,
    constant_runs,
    correlation_of_errors,
    fit_doubt,
    no_gain,
    problems,
    structure_doubt,
    trial_length,
    warn_of_stability,
    warn_of_worse_fit,
    warn_of_worse_outputs,
)
from hybrid_mpc.identify.starts import POOR
from hybrid_mpc.identify.step import PriorStep, Scaling
from hybrid_mpc.identify.structure import causes, causes_of_refusal, named
from hybrid_mpc.identify.train import Trained, TrainingFailure, train
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.specification import BenchmarkBudget
from hybrid_mpc.records import beside, plain, record
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Stage, source_of
from nn_export.program import to_json

Array = NDArray[Any]

MODELS = ("phy_nominal", "phy", *KINDS)
"""Models that may be evaluated; those of a prior: :func:`models_of`."""
UNTRAINED: Kind = "pgrnn"
"""The kit's hybrid of a run without training: its correction is zero."""
PARTS = 4
"""Smallest number of parts of the training data: a network that leaves one out still uses three quarters."""
REMEDY = (
    "Correct the prior: a wrong sign or unit, or a missing term or state (docs/prior-wrong.md). Fix parameters that "
    "the recordings do not identify. 'hybrid-mpc check MACHINE --data FILE --fit' shows the fit"
)
"""Remedy for a fit that later stages must not use."""
IN_DOUBT = "the structure of the prior is in doubt"
"""Begins the warning about each doubt."""
ERRORS = {"error": "E_sim", "output": "RMSE over the spread"}
"""Name of the validation error of a training, by its first objective."""


@dataclass(frozen=True)
class DataResult:
    """The recordings of a run.

    Args:
        files: Names of the files.
        hash: Hash of their contents.
        cuts: Parts that are cut out or interpolated, and why.
        pieces: Number of trajectories by role.
        seconds: Their length [s] by role.
        warnings: Warnings about the recordings.
        notes: How files were read that needed more than a plain table.
    """

    files: tuple[str, ...]
    hash: str
    cuts: tuple[Cut, ...]
    pieces: Mapping[str, int]
    seconds: Mapping[str, float]
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class BaselineScores:
    """A simpler model than the prior.

    Args:
        errors: Errors of its free runs; None if it is missing.
        chosen: Its chosen orders.
        reason: Why it is missing.
    """

    errors: OutputErrors | None = None
    chosen: str = ""
    reason: str = ""


@dataclass(frozen=True)
class PriorResult:
    """The fitted prior, and the states of the recordings that its smoother estimates.

    Args:
        fit: Parameters with their standard errors, the inputs' delay, and the smoother's settings.
        nominal: Parameters before the fit.
        units: Units of the parameters.
        baselines: Errors on the test recordings of simpler models, by name: ``"constant"`` (the training mean) and
            linear models of inputs and outputs.
        bounds: Parameters at a bound, and the error that each bound costs.
        in_doubt: Reasons to doubt the prior's structure, those that name a cause first.
        errors: Errors on the test recordings of the prior with nominal (``"phy_nominal"``) and fitted (``"phy"``)
            parameters.
        no_gain: Why later stages must not use this fit: a constant or the nominal parameters are better. Empty if they
            may use it.
        error_correlation: Correlation of successive one-step errors of the smoother, by output; zero is white.
        longest_run: Length [s] of the free runs that evaluate models; None: whole recordings.
        arrays: States and their rates, ``"TRAJECTORY/x"`` and ``"TRAJECTORY/xdot"`` ``(n, n_x)``.
        lacking: The reasons in ``in_doubt`` that a missing term can explain: bounds, better simpler models, a poor FIT.
    """

    fit: PriorFit
    nominal: Mapping[str, float]
    units: Mapping[str, str]
    baselines: Mapping[str, BaselineScores]
    bounds: tuple[BoundCost, ...]
    in_doubt: tuple[str, ...]
    errors: Mapping[str, OutputErrors]
    no_gain: str
    error_correlation: Mapping[str, float]
    longest_run: float | None
    arrays: Mapping[str, Array] = beside()
    lacking: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrainingResult:
    """The trained networks; their weights lie in files of their own.

    Args:
        folder: Folder of the weights in ``checkpoints/training``.
        validation: Validation error of the best network by kind, of its first objective.
        skipped_updates: Updates that were skipped because a number was not finite, by kind.
        failures: Failed trainings, by kind.
        weights: Digest of the weights by kind.
    """

    folder: str
    validation: Mapping[str, float]
    skipped_updates: Mapping[str, int]
    failures: Mapping[str, tuple[TrainingFailure, ...]]
    weights: Mapping[str, str]


def check_data(context: Context) -> None:
    """Read and check the user's recordings before the run's folder is made: bad recordings leave no folder behind."""
    check_source(context)
    if context.settings.data:
        doubts(context)  # reads and checks the recordings


def check_source(context: Context) -> None:
    """Refuse a scenario that cannot simulate recordings if the user gives none."""
    if not context.settings.data and context.scenario.make_data is None:
        raise InputError(
            f"scenario {context.scenario.name}: no recordings, and the scenario cannot simulate them. Give recordings "
            "of the machine with --data FILE.csv, once for each file [HM-WORKFLOW-037]"
        )


def what_data_reads(context: Context) -> dict[str, object]:
    """Everything that the recordings and their roles depend on."""
    context = context.as_given
    prior, settings = context.scenario.prior(), context.settings
    read: dict[str, object] = {
        "data specification": context.spec,
        "signals of the prior": (prior.states, prior.inputs, prior.outputs),
    }
    if settings.data:
        return {**read, "recordings": [(path.name, sha256(path)) for path in settings.data]}
    make = source_of(context.scenario.make_data)
    return {**read, "seed": settings.seed, "budget": settings.budget, "how recordings are made": make}


def data_stage(context: Context) -> DataResult:
    """Read the user's recordings, or let the scenario simulate recordings; list files, parts and warnings."""
    context = context.as_given
    if not context.settings.data:
        assert context.scenario.make_data is not None
        context.progress.update("files", 0, 1, "recording the simulated machine")
        context.forget_data()
        context.scenario.make_data(context.out / "data", context.settings.seed, context.settings.budget)
    dataset, warnings = context.dataset, doubts(context)
    for warning in warnings:
        context.progress.warn(warning)
    for note in dataset.notes:
        context.progress.note(note)
    return DataResult(
        tuple(dataset.files),
        dataset.hash,
        dataset.cuts,
        {role: len(context.trajectories(role)) for role in ROLES},
        {role: sum(len(t.t) * t.dt for t in context.trajectories(role)) for role in ROLES},
        warnings,
        dataset.notes,
    )


def recordings_are_there(context: Context, found: DataResult) -> str:
    """Why simulated recordings must be made again: files are missing or changed; empty otherwise."""
    context = context.as_given
    if context.settings.data or (context.files and context.dataset.hash == found.hash):
        return ""
    return f"the recordings in {context.out / 'data'} are missing or were changed"


def doubts(context: Context) -> tuple[str, ...]:
    """Warnings about the recordings, and about poor excitation of the training recordings.

    Raises:
        InputError: If a recording is bad, or an input or output is constant in all training recordings.
    """
    found = context.dataset.warnings
    prior = context.scenario.prior()
    free = sum(not p.fixed for p in prior.parameters)
    train = context.trajectories("train")
    if not train:  # the prior's fit refuses this
        return found
    return (
        *found,
        *short_runs(context.scenario.data, context.trajectories("test")),
        *check_excitation(train, inputs=prior.inputs, outputs=prior.outputs, parameters=free),
    )


def what_prior_reads(context: Context) -> dict[str, object]:
    """The prior's equations as a traced program, and its parameters."""
    prior = context.scenario.prior()
    programs = prior_programs(prior, context.spec.dt)
    return {
        "equations of the prior": {name: to_json(program) for name, program in programs.items()},
        "parameters of the prior": prior.parameters,
        "largest delay": context.spec.largest_delay,
        "longest free run": (context.spec.free_run, context.warm),
    }


def prior_stage(context: Context) -> PriorResult:
    """Fit the prior's parameters and, if allowed, the inputs' delay; smooth all recordings with the fitted prior.

    Raises:
        InputError: If the fit is impossible, or later stages must not use its result.
    """
    found = examined_prior(context)
    refuse(stops(found))
    return found


def stops(found: PriorResult, *, cause: bool = True) -> tuple[str, ...]:
    """Errors that stop a run after the fit of the prior; ``cause``: with the first reason for doubt."""
    if not found.no_gain:
        return ()
    why = f". In doubt: {found.in_doubt[0]}" if found.in_doubt and cause else ""
    return (f"fit of the prior: {found.no_gain}{why}. {REMEDY} [HM-WORKFLOW-049]",)


def examined_prior(context: Context) -> PriorResult:
    """:func:`prior_stage` without the final refusal: ``no_gain`` says why later stages must not use the fit.

    Raises:
        InputError: If the fit is impossible, or its result is not finite or far out of range
            (:func:`~hybrid_mpc.identify.sound.problems`).
    """
    make, spec = context.scenario.prior, context.spec
    train, valid, test = (context.trajectories(role) for role in ("train", "valid", "test"))
    longest = context.fit_length
    try:
        fit = fit_prior(
            make, train, valid, dt=spec.dt, length=longest, largest_delay=spec.largest_delay,
            time_unit=context.time_unit, warm_up=spec.warm_up,
            on_progress=lambda done, total, text: context.progress.update("free runs", done, total, text),
        )  # fmt: skip
    except InputError as error:
        wrong = named(causes_of_refusal(make, train, spec.dt, longest or math.inf, context.time_unit))
        raise InputError(f"{error}. In doubt: {wrong}" if wrong else str(error)) from error
    every = smoothed(make, fit, [*train, *valid, *test], spec.dt)
    fitted = make(fit.values)
    smoother = fit.smoother(fitted, spec.dt)
    refuse([f"fit of the prior: {one}" for one in problems(smoother, fit, every)])
    context.progress.update("free runs", 1, 1, "comparing with simpler models")
    trial = trial_length(make, fit, every, spec.dt, longest, context.time_unit)
    bounds = bound_costs(make, fit, every[: len(train)], spec.dt, trial)
    ranges = *beyond_ranges(fitted, every), *warn_of_drift(fitted, max(10 * spec.dt, spec.warm_up))
    fit = replace(fit, warnings=(*fit.warnings, *(str(one) for one in bounds if one.costs), *ranges))
    if fit.delay:
        context.progress.note(f"fitted delay of the inputs: {fit.delay:.3g} s")
    for warning in fit.warnings:
        context.progress.warn(f"fit of the prior: {warning}")
    unseen = every[len(train) + len(valid) :]
    judge, linear = _Judge(context, fitted, fit, smoother), linear_models(context, fit.delay)
    length_of_runs = run_length(
        make, fit, every[: len(train)], every[len(train) :], dt=spec.dt, warm=context.warm, longest=longest,
        free_run=spec.free_run,
    )  # fmt: skip
    longest_run, growth = length_of_runs.seconds, length_of_runs.warnings
    errors, baselines, runs = judge.errors(unseen, longest_run, linear)
    for warning in growth:
        context.progress.warn(warning)
    nominal, squares = (
        [run.squared_errors(smoother.sizes.y) for run in runs[name]] for name in ("phy_nominal", "phy")
    )
    recordings = [run.name.partition("#")[0] for run in runs["phy"]]
    worse = (
        *warn_of_worse_outputs(errors["phy_nominal"].rmse, errors["phy"].rmse),
        *warn_of_worse_fit(nominal, squares, recordings, max(1, round(context.time_unit / spec.dt))),
        *warn_of_stability(make, fit, every[: len(train)], spec.dt),
    )
    length = longest_run or longest or trial
    known_late = spec.largest_delay > 0 or any("HM-IDENTIFY-080" in one for one in fit.warnings)
    common = context.scenario_path, fit, spec.dt, length
    looked = run_jobs(
        {
            "wrong terms": (_wrong_terms, (*common, shifted(train, fit.delay), context.time_unit)),
            "recordings": (_each_recording, (*common, [*train, *valid], not known_late)),
        },
        lambda name, done, total, text: context.progress.update("free runs", 1, 1, text),
        context.workers,
        cluster=context.cluster,
    )
    wrong, differ = looked["wrong terms"], looked["recordings"]
    for warning in (*worse, *differ):
        context.progress.warn(f"fit of the prior: {warning}")
    fit = replace(fit, warnings=(*fit.warnings, *growth, *worse, *differ))
    own = {name: one.error for name, one in errors.items()} | {"constant": _error_of(baselines["constant"])}
    training: dict[str, float] = {}
    if own["phy"] >= own["constant"]:
        seen, mean, _ = judge.errors(every[: len(train)], longest_run)
        training = {"phy": seen["phy"].error, "constant": _error_of(mean["constant"])}
    # an unstable machine is recorded in closed loop: the controller's inputs depend on the outputs, so linear models
    # predict the outputs from the inputs and look better than they are
    compared = baselines if not growth else {"constant": baselines["constant"]}
    simpler = {name: one.errors.error for name, one in compared.items() if one.errors is not None}
    off = zip(errors["phy"].rmse.items(), smoother.sizes.y, strict=True)
    lacks = [bounds_doubt(bounds, len(fit.standard_errors))]
    # where small errors grow, errors of initial states grow too: then the windows of the fit, with free initial states,
    # test the equations
    short = length_of_runs.growth < (longest or 0.0) and longest_run is not None
    follows = short and min(row["validation_error"] for row in fit.stages) <= POOR
    if not follows:
        lacks += [
            structure_doubt(own["phy"], simpler),
            fit_doubt(errors["phy"].fit_percent, {name: e / size for (name, e), size in off}),
        ]
    lacking = tuple(one for one in lacks if one)
    in_doubt = (*([wrong] if wrong else []), *lacking)
    for doubt in in_doubt:
        context.progress.warn(f"{IN_DOUBT}: {doubt}")
    one_step = smoother.prediction_errors(shifted(train, fit.delay))
    return PriorResult(
        fit=fit,
        nominal=make().values,
        units={p.name: p.unit for p in make().parameters},
        baselines=baselines,
        bounds=bounds,
        in_doubt=in_doubt,
        errors=errors,
        no_gain="" if follows else no_gain(own, training),
        error_correlation={
            s.label: float(r) for s, r in zip(fitted.outputs, correlation_of_errors(one_step), strict=True)
        },
        longest_run=longest_run,
        arrays={f"{t.name}/{key}": getattr(t, key) for t in every for key in ("x", "xdot")},
        lacking=lacking,
    )


def _wrong_terms(
    scenario: str, fit: PriorFit, dt: float, length: float, acting: Sequence[Trajectory], unit: float,
    report: Callable[[int, int, str], None],
) -> str:  # fmt: skip
    """Job of one process: the mistakes in the prior that explain its errors, in words."""

    def searching(text: str) -> None:
        report(0, 1, f"looking for wrong terms: {text}")

    def testing(text: str) -> None:
        searching(f"testing '{text}'")

    searching("smoothing the recordings")
    return named(causes(load_scenario(scenario).prior, fit.values, acting, dt, length, unit, testing))


def _each_recording(
    scenario: str, fit: PriorFit, dt: float, length: float, recordings: Sequence[Trajectory], delay: bool,
    report: Callable[[int, int, str], None],
) -> tuple[str, ...]:  # fmt: skip
    """Job of one process: warnings of fits of each recording alone."""
    report(0, 1, "fitting each recording alone")
    alone = fit_each(load_scenario(scenario).prior, fit, recordings, dt=dt, length=length, delay=delay)
    return () if alone is None else alone.warnings


def _error_of(baseline: BaselineScores) -> float:
    return math.inf if baseline.errors is None else baseline.errors.error


def linear_models(context: Context, delay: float = 0.0) -> dict[str, LinearModel | str]:
    """Linear input-output models by name, or why the model is missing.

    With a ``delay`` [s] they are models of the inputs that act, for runs over these.
    """
    train, valid = (shifted(context.trajectories(role), delay) for role in ("train", "valid"))
    found: dict[str, LinearModel | str] = {}
    for name, fit_linear in BASELINES.items():
        try:
            found[name] = fit_linear(train, valid, context.spec.dt, warm=context.warm + 1)
        except InputError as error:
            found[name] = str(error)
    return found


@dataclass(frozen=True)
class _Judge:
    """Free runs of a prior and of simpler models over the same trajectories, from the same warm-up."""

    context: Context
    fitted: Prior
    fit: PriorFit
    smoother: Smoother

    def errors(
        self,
        trajectories: Sequence[Trajectory],
        length: float | None,
        linear: Mapping[str, LinearModel | str] = MappingProxyType({}),
    ) -> tuple[dict[str, OutputErrors], dict[str, BaselineScores], dict[str, list[FreeRun]]]:
        """Errors of the two priors (nominal, fitted), errors of a constant and of linear models, and the priors' runs.

        Args:
            trajectories: Smoothed trajectories.
            length: Length [s] of the runs; None: whole trajectories.
            linear: Linear models by name, or why the model is missing.
        """
        context, fitted = self.context, self.fitted
        runs = evaluation_trajectories(trajectories, self.smoother, context.warm, length)
        dt, own, drawn = context.spec.dt, {}, {}
        for name, step in (
            ("phy_nominal", PriorStep(context.scenario.prior(), dt)),
            ("phy", PriorStep(fitted, dt, self.fit.substeps)),
        ):
            drawn[name] = free_runs(step, fitted, runs, context.warm)
            found = score(drawn[name], fitted, self.smoother.sizes.y)
            own[name] = OutputErrors(found.error, found.rmse, found.fit_percent)
        warm = context.warm + 1  # the prior's initial state is estimated with this sample
        simpler = {
            "constant": self._scored(constant_runs(context.trajectories("train"), runs, warm), runs, warm)
        }
        for name, model in linear.items():
            if isinstance(model, str):
                simpler[name] = BaselineScores(reason=model)
            else:
                scored = self._scored(model.free_runs(runs, warm), runs, warm)
                simpler[name] = replace(scored, chosen=model.chosen.text)
        return own, simpler, drawn

    def _scored(self, y_hat: Sequence[Array], runs: Sequence[Trajectory], warm: int) -> BaselineScores:
        shown = [measured_as(self.fitted, own) for own in y_hat]
        measured = [t.y[warm:] for t in runs]
        return BaselineScores(output_errors(shown, measured, self.fitted.outputs, self.smoother.sizes.y))


def what_training_reads(context: Context) -> dict[str, object]:
    """Settings of the networks, the device, and the period of the recordings."""
    return {
        "settings of the networks": {
            kind: training_settings(context, kind) for kind in trained_kinds(context) or (UNTRAINED,)
        },
        "device": context.settings.device,
        "period": context.spec.dt,
    }


def trained_kinds(context: Context) -> tuple[Kind, ...]:
    """Kinds of networks that the run trains; empty if its settings have no optimizer steps."""
    own = training_settings(context, UNTRAINED)
    return kinds_of(context.scenario.prior()) if own.teacher_steps + own.free_run_steps else ()


def models_of(context: Context) -> tuple[str, ...]:
    """Names of the models to evaluate: nominal prior, fitted prior, and each kind of trained network."""
    return ("phy_nominal", "phy", *trained_kinds(context))


def training_stage(context: Context) -> TrainingResult:
    """Train the networks of every kind, two kinds at once; without training, make only the kit's hybrid."""
    # networks of other settings or data have a folder of their own
    name = digest(TRAINING.keys(context))[:12]
    folder = context.out / "checkpoints" / "training" / name
    trained = train_kinds(
        context.scenario_path,
        context.prior.fit.values,
        context.smoothed("train"),
        context.smoothed("valid"),
        {kind: _as_long_as_judged(context, kind) for kind in trained_kinds(context) or (UNTRAINED,)},
        folder.resolve(),
        device=context.settings.device,
        workers=context.workers,
        on_progress=context.progress.update,
        cluster=context.cluster,
    )
    return TrainingResult(
        name,
        {k: float(t.validation.min()) for k, t in trained.items()},
        {k: int(t.skipped.sum()) for k, t in trained.items()},
        {k: t.failures for k, t in trained.items()},
        {k: sha256(folder / f"{k}.json") for k in trained},
    )


def train_kinds(
    scenario: str,
    values: Mapping[str, float],
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: Mapping[str, TrainingSettings],
    folder: Path,
    *,
    device: str = "cpu",
    workers: int = WORKERS,
    on_progress: Callable[[str, int, int, str], None] = lambda key, done, total, text: None,
    cluster: Any = None,
) -> dict[str, Trained]:
    """Train the networks of every kind that ``folder`` does not hold yet; continue an interrupted training."""
    jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        kind: (_train_kind, (scenario, dict(values), training, validation, settings[kind], folder, device))
        for kind in reversed(list(settings))
        if not is_trained(folder, settings[kind])
    }
    run_jobs(jobs, on_progress, workers, cluster=cluster)
    return {kind: load_trained(folder, kind) for kind in settings}


def _train_kind(
    scenario: str,
    values: dict[str, float],
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: TrainingSettings,
    folder: Path,
    device: str,
    report: Callable[[int, int, str], None],
) -> None:
    """Job of one process: train one kind and write its files."""
    label = ERRORS.get(settings.objectives[0], settings.objectives[0])
    trained = train(
        load_scenario(scenario).prior(values),
        training,
        validation,
        settings,
        checkpoint=folder / f"{settings.kind}.safetensors",
        device=device,
        on_progress=lambda done, total, error: report(done, total, f"validation {label} {error:.4g}"),
    )
    save_trained(folder, trained)


def networks_are_there(context: Context, found: TrainingResult) -> str:
    """Why the networks must be trained again: files are missing or changed; empty otherwise."""
    folder = context.out / "checkpoints" / "training" / found.folder
    for kind, content in found.weights.items():
        path = folder / f"{kind}.json"
        if not path.is_file() or sha256(path) != content:
            return f"{path}, the networks {kind}, is missing or was changed"
    return ""


def trained_models(context: Context, kind: str) -> Trained:
    """The trained networks of one kind."""
    return load_trained(context.out / "checkpoints" / "training" / context.read(TRAINING).folder, kind)


def runs_of(
    context: Context, name: str, phy: Prior, trajectories: Sequence[Trajectory], own: int | None = None,
    share: float = 1.0,
) -> list[list[FreeRun]]:  # fmt: skip
    """Free runs of one model, then of each of its networks if it has several.

    The model is the mean of its networks. With ``own``, the model is network ``own`` alone, the only network that did
    not train on these trajectories. The networks' correction is multiplied by ``share``.
    """
    dt, warm = context.spec.dt, context.warm
    if name in ("phy_nominal", "phy"):
        fitted, nominal = (phy, dt, context.prior.fit.substeps), (context.scenario.prior(), dt)
        step = PriorStep(*fitted) if name == "phy" else PriorStep(*nominal)
        return [free_runs(step, phy, trajectories, warm)]
    trained = trained_models(context, name).shrunk(phy, share)
    if len(trained.validation) == 1:
        return [free_runs(trained.step(phy, dt), phy, trajectories, warm)]
    every = stacked_free_runs(trained, phy, dt, phy, trajectories, warm)
    return [
        every[own] if own is not None else free_runs(trained.step(phy, dt), phy, trajectories, warm),
        *every,
    ]


def training_settings(context: Context, kind: str) -> TrainingSettings:
    """Training settings of a kind: those of the budget, replaced by those of the run's settings file."""
    effort = context.effort
    own = {f.name: getattr(effort, f.name) for f in fields(BenchmarkBudget)}
    settings = TrainingSettings(
        kind=kind,  # type: ignore[arg-type]
        seed=context.settings.seed,
        warm=context.warm,
        parts=max(PARTS, effort.networks),
        **own,
    )
    return replace(settings, **context.settings.network())


def _as_long_as_judged(context: Context, kind: str) -> TrainingSettings:
    """Training settings; for an unstable machine, free runs are at most as long as those that compare the models."""
    settings, longest = training_settings(context, kind), context.prior.longest_run
    if context.spec.free_run is not None or longest is None:
        return settings
    most = scales.periods(longest, context.spec.dt, 2)
    validation = settings.validation_horizon or most
    return replace(settings, horizon=min(settings.horizon, most), validation_horizon=validation)


@dataclass(frozen=True)
class _Note:
    """Content of the JSON file of trained networks; their arrays are in a file next to it."""

    settings: TrainingSettings
    scaling: Scaling
    failures: tuple[TrainingFailure, ...]


def save_trained(folder: Path, trained: Trained) -> None:
    """Write the networks of one kind."""
    kind = trained.settings.kind
    arrays: dict[str, Any] = {f"weights.{n}": v for n, v in trained.weights.items()}
    arrays |= {f"curve.{n}": v for n, v in trained.curve.items()}
    arrays |= {"own.validation": trained.validation, "own.skipped": trained.skipped}
    note = _Note(trained.settings, trained.scaling, trained.failures)
    write_document(folder / f"{kind}.json", plain(note), arrays)


def is_trained(folder: Path, settings: TrainingSettings) -> bool:
    """Whether a folder holds finished networks of these settings.

    Raises:
        InputError: If it holds networks of the same kind and other settings.

    Example:
        >>> is_trained(Path("nowhere"), TrainingSettings("pgrnn", 4, 1, 5, 5, seed=0, warm=2))
        False
    """
    if not (folder / f"{settings.kind}.json").is_file():
        return False
    found, own = (asdict(s) for s in (load_trained(folder, settings.kind).settings, settings))
    changed = [f"{name} {found[name]} instead of {own[name]}" for name in own if found[name] != own[name]]
    if changed:
        raise InputError(
            f"{folder}: holds networks of other settings ({settings.kind}: {'; '.join(changed)}). Another version or "
            "scenario wrote them; choose another --out [HM-WORKFLOW-039]"
        )
    return True


def load_trained(folder: Path, kind: str) -> Trained:
    """Read the networks of one kind.

    Raises:
        InputError: If a file is missing or damaged.
    """
    path = folder / f"{kind}.json"
    remedy = f"delete {kind}.* in {folder}; then the same command trains these networks again"
    note = record(_Note, read_document(path, remedy), str(path))
    arrays = read_document_arrays(path, remedy)
    part: dict[str, dict[str, Any]] = {"weights": {}, "curve": {}, "own": {}}
    for name, value in arrays.items():
        group, _, key = name.partition(".")
        part[group][key] = value
    return Trained(
        note.settings,
        note.scaling,
        part["weights"],
        part["own"]["validation"],
        part["curve"],
        part["own"]["skipped"],
        note.failures,
    )


DATA = Stage(
    "data", "reading the measurements", DataResult, data_stage, what_data_reads, restore=recordings_are_there
)
PRIOR = Stage("prior", "fitting the prior", PriorResult, prior_stage, what_prior_reads, (DATA,))
TRAINING = Stage(
    "training", "training the networks", TrainingResult, training_stage, what_training_reads, (DATA, PRIOR),
    restore=networks_are_there,
)  # fmt: skip
