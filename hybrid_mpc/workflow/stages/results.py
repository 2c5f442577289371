"""Results of a run: the dataclasses below are the content of ``results.json``, field by field.

A missing value is null; its reason stands beside it as ``NAME_reason``, or as ``reason`` for the whole object. Names of
signals and balances contain their unit, ``"phi [rad]"``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.compare.loops import LoopRow
from hybrid_mpc.compare.sequential import Comparison
from hybrid_mpc.compare.summary import Summary, by_task, summaries
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.evaluate import Scores
from hybrid_mpc.identify.settings import NO_BALANCE
from hybrid_mpc.kit.promises import Promise
from hybrid_mpc.records import plain, record
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent
from hybrid_mpc.workflow.stages.analyze import ANALYSIS, ModelAnalysis
from hybrid_mpc.workflow.stages.choose import CHOICE
from hybrid_mpc.workflow.stages.compare import BASELINES, CONTROL, REPORTED, comparisons
from hybrid_mpc.workflow.stages.estimate import ESTIMATION, OBSERVERS, ObservedRecording, ObserverTest
from hybrid_mpc.workflow.stages.evaluate import EVALUATION, BandScores
from hybrid_mpc.workflow.stages.export import EXPORT
from hybrid_mpc.workflow.stages.identify import DATA, MODELS, BaselineScores, CutInterval
from hybrid_mpc.workflow.stages.on_model import LOOPS_ON_MODEL, by_controller
from hybrid_mpc.workflow.stages.promises import PROMISES
from hybrid_mpc.workflow.stages.watch import WATCH, CleanAlarms, FaultedLoop, NominalLoop, RecordedAlarm

Array = NDArray[np.float64]
SCHEMA_VERSION = 11
Errors = Mapping[str, Mapping[str, float] | str | None]
"""Errors by model, each by signal with unit; a model without errors has null and ``MODEL_reason``."""


@dataclass(frozen=True)
class DataDetails:
    """Seconds by role, reason of each cut, and warnings about the recordings."""

    seconds: Mapping[str, float]
    why_cut: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Data:
    """The recordings: names of the files, hash of their contents, and the parts cut out."""

    files: tuple[str, ...]
    hash: str
    cuts: tuple[CutInterval, ...]
    details: DataDetails


@dataclass(frozen=True)
class FittedPrior:
    """Parameters of the fitted prior, their standard errors, nominal parameters, warnings, error of each stage of the
    fit, and reasons to doubt the prior's structure.
    """

    values: Mapping[str, float]
    standard_errors: Mapping[str, float]
    nominal: Mapping[str, float]
    warnings: tuple[str, ...]
    stages: tuple[Mapping[str, Any], ...]
    in_doubt: tuple[str, ...] = ()


@dataclass(frozen=True)
class SmootherNoise:
    """Noise of the smoother: of each sensor, and of the random walk of each unexplained rate."""

    sigma: tuple[float, ...]
    walk: tuple[float, ...]


@dataclass(frozen=True)
class IdentificationDetails:
    """Details of the errors. ``by_file`` is the RMSE by recording, model and output, None if a run diverged;
    ``hybrid_over_phy`` are the hybrid's ``error`` and ``e_sim`` over the fitted prior's; ``network_settings`` are the
    settings that replaced the budget's.
    """

    prior_parameters: FittedPrior
    scores_of_all_networks: Mapping[str, tuple[Scores, ...]]
    by_file: Mapping[str, Mapping[str, Mapping[str, float] | None]]
    smoother: SmootherNoise
    hybrid_over_phy: Mapping[str, float | None]
    choice: ModelChoice
    bands: Mapping[str, BandScores]
    baselines: Mapping[str, BaselineScores]
    network_settings: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class ModelChoice:
    """The recommended model, the exported hybrid, the reason, and the figures of all candidates."""

    recommended: str
    hybrid: str
    reason: str
    candidates: Mapping[str, CandidateErrors]


@dataclass(frozen=True)
class CandidateErrors:
    """Errors of a candidate on held-out parts of the training data.

    ``error`` is in spreads of the outputs. ``ratio`` is the geometric mean over the recordings of the ratio to the
    prior's error, ``upper`` its upper confidence bound. None if a run diverged or the bound is unknown. ``share`` is
    the factor of the networks' correction.
    """

    error: float | None
    ratio: float | None
    upper: float | None
    share: float


@dataclass(frozen=True)
class Identification:
    """Errors of free runs on test data by model; see :class:`~hybrid_mpc.identify.evaluate.Scores`."""

    error: Mapping[str, float | str | None]
    rmse: Errors
    fit_percent: Errors
    e_sim: Mapping[str, float | str | None]
    balance_violation: Errors
    details: IdentificationDetails


@dataclass(frozen=True)
class Export:
    """Largest differences between the exported models and PyTorch, relative to the outputs' scale."""

    parity_max_abs_error: float
    jacobian_max_abs_error: float


@dataclass(frozen=True)
class ControllerCosts:
    """Cost on the plant's true state, summed over the tasks, and tracking error by signal: of the states, or of the
    outputs for tasks with references of outputs.
    """

    cost: float | None
    tracking_rmse: Mapping[str, float] | None
    cost_reason: str = ""
    reason: str = ""


@dataclass(frozen=True)
class Gap:
    """Share of the distance from the better baseline to the oracle that the hybrid covers, or why it is undefined."""

    value: float | None
    reason: str = ""


@dataclass(frozen=True)
class ControlDetails:
    """Figures by task and controller, the gap closed by task, and the hybrid's cost over that of each baseline by task.

    ``most_seeds`` is the largest number of seeds of a task.
    """

    tasks: Mapping[str, Mapping[str, Summary]]
    gap_closed_by_task: Mapping[str, Gap]
    comparisons: Mapping[str, Mapping[str, Comparison]]
    most_seeds: int


@dataclass(frozen=True)
class Control:
    """Closed loops: the three controllers, and the gap closed, a mean over the tasks."""

    prior: ControllerCosts
    hybrid: ControllerCosts
    oracle: ControllerCosts
    gap_closed: float | None
    gap_closed_reason: str = ""
    details: ControlDetails | None = None


@dataclass(frozen=True)
class OnModelDetails:
    """Figures by controller and task."""

    controllers: Mapping[str, Mapping[str, Summary]]


@dataclass(frozen=True)
class OnModel:
    """Closed loops for a scenario without plant, by controller, each on another model than the controller's own.

    They show whether two models agree, and nothing about the machine. Each controller has another plant, so do not
    compare their figures. ``plants`` names the models in place of the machine; ``default_tasks`` is true if the
    scenario declares no tasks; ``left_out`` says why a controller has no loops.
    """

    plants: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    default_tasks: bool = False
    details: OnModelDetails | None = None
    reason: str = ""


@dataclass(frozen=True)
class EstimationDetails:
    """Recordings that the observers were tested on."""

    recordings: tuple[ObservedRecording, ...]


@dataclass(frozen=True)
class ObserverFigures:
    """Statistics of an observer's innovations; see :class:`~hybrid_mpc.workflow.stages.estimate.ObserverTest`."""

    mean_nis: float | None = None
    nis_low: float | None = None
    nis_high: float | None = None
    nis_inside: float | None = None
    ljung_box: float | None = None
    ljung_box_limit: float | None = None
    samples: int | None = None
    reason: str = ""


@dataclass(frozen=True)
class Estimation:
    """Tests of the observers on test recordings."""

    prior_observer: ObserverFigures | None
    hybrid_observer: ObserverFigures | None
    details: EstimationDetails | None = None
    reason: str = ""


@dataclass(frozen=True)
class Promises:
    """The table "What this kit promises" (:attr:`~hybrid_mpc.kit.artifact.Kit.promises`); None if not examined."""

    rows: tuple[Promise, ...] | None = None
    reason: str = ""


@dataclass(frozen=True)
class StepTimes:
    """Durations of whole controller steps [ms]."""

    median: float | None = None
    p95: float | None = None
    p99: float | None = None
    max: float | None = None
    reason: str = ""


@dataclass(frozen=True)
class Timing:
    """Durations of the hybrid's steps, the period [ms], and how many steps took longer."""

    controller_step_ms: StepTimes
    period_ms: float
    misses: int | None
    misses_reason: str = ""


@dataclass(frozen=True)
class WatchDetails:
    """Data that limits were learned from, limits by model and kind of readings, monitored time of each recording, and
    false alarms, in total and by channel.
    """

    sources: Mapping[str, str] = field(default_factory=dict)
    loops: tuple[NominalLoop, ...] = ()
    limits: Mapping[str, Mapping[str, WatchLimits]] = field(default_factory=dict)
    recordings: tuple[Mapping[str, float | str], ...] = ()
    clean: CleanAlarms | None = None
    by_channel: Mapping[str, CleanAlarms] = field(default_factory=dict)


@dataclass(frozen=True)
class Watch:
    """The monitor: kind of its readings, wanted false alarm rate [1/h], length of the nominal data [h], measured false
    alarm rate [1/h], alarms on the recordings, and loops with a fault.
    """

    kind: str | None = None
    wanted_per_hour: float | None = None
    hours: float | None = None
    false_alarms_per_hour: float | None = None
    alarms: tuple[RecordedAlarm, ...] | None = None
    faults: tuple[FaultedLoop, ...] | None = None
    faults_reason: str = ""
    details: WatchDetails = WatchDetails()
    reason: str = ""


@dataclass(frozen=True)
class AnalysisDetails:
    """Linearized models by name, at rest and at working speed, and the working speed."""

    models: Mapping[str, ModelAnalysis]
    working_speed: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Analysis:
    """The hybrid at rest: eigenvalues as (real part, imaginary part), and its properties."""

    eigenvalues: tuple[tuple[float, float], ...] | None = None
    stabilisable: bool | None = None
    detectable: bool | None = None
    details: AnalysisDetails | None = None
    reason: str = ""


@dataclass(frozen=True)
class Results:
    """The content of ``results.json``."""

    schema_version: int
    scenario: str
    seed: int
    budget: str
    versions: Mapping[str, str]
    data: Data
    identification: Identification
    export: Export
    control: Control
    on_model: OnModel
    estimation: Estimation
    promises: Promises
    timing: Timing
    watch: Watch
    analysis: Analysis

    def plain(self) -> dict[str, Any]:
        """The results in JSON's own types; empty reasons and details are left out."""
        found: dict[str, Any] = _without_empty(plain(self))
        return found


def _without_empty(value: Any) -> Any:
    if isinstance(value, list):
        return [_without_empty(v) for v in value]
    if not isinstance(value, Mapping):
        return value
    return {
        key: _without_empty(v)
        for key, v in value.items()
        if not (v == "" and (key == "reason" or key.endswith("_reason")))
        and not (v is None and key == "details")
    }


def read_results(values: Mapping[str, Any], where: str = "results") -> Results:
    """Results from the content of ``results.json``, checked; ``where`` names the file in messages.

    Raises:
        InputError: If a field is missing, unknown, of the wrong kind, or null without a reason.
    """
    results = record(Results, values, where)
    if results.schema_version != SCHEMA_VERSION:
        raise InputError(
            f"{where}: schema_version is {results.schema_version}, but this version reads {SCHEMA_VERSION}. Run the "
            "scenario again with this version [HM-WORKFLOW-040]"
        )
    for group in (
        "identification", "control", "estimation", "promises", "timing", "watch", "analysis",
    ):  # fmt: skip
        _check_values(values[group], group, where)
    return results


def _check_values(values: Mapping[str, Any], path: str, where: str) -> None:
    for key, value in values.items():
        if value is None and not (values.get(f"{key}_reason") or values.get("reason")):
            raise InputError(
                f"{where}: {path}.{key} is null without a reason; put '{key}_reason' or 'reason' beside it"
                " [HM-WORKFLOW-041]"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(
                f"{where}: {path}.{key} is {value}; write a finite number, or null with a reason [HM-WORKFLOW-042]"
            )
        if isinstance(value, Mapping) and key != "details":
            _check_values(value, f"{path}.{key}", where)


def collect(context: Context) -> Results:
    """Results of all stages."""
    return Results(
        schema_version=SCHEMA_VERSION,
        scenario=context.scenario.name,
        seed=context.settings.seed,
        budget=context.settings.budget,
        versions=context.versions,
        data=recordings(context),
        identification=identification(context),
        export=Export(context.read(EXPORT).parity_max_abs_error, context.read(EXPORT).jacobian_max_abs_error),
        control=_control(context),
        on_model=_on_model(context),
        estimation=_estimation(context),
        promises=promises(context),
        timing=_timing(context),
        watch=_watch(context),
        analysis=_analysis(context),
    )


def recordings(context: Context) -> Data:
    """Results of stage data."""
    data = context.read(DATA)
    return Data(
        data.files,
        data.hash,
        tuple(CutInterval(c.file, c.start_s, c.end_s) for c in data.cuts),
        DataDetails(data.seconds, tuple(c.why for c in data.cuts), data.warnings),
    )


def identification(context: Context) -> Identification:
    """Results of the identification: errors of all models, and the recommended model."""
    found, prior, chosen = context.read(EVALUATION), context.prior, context.read(CHOICE).choice
    network = context.settings.network()
    model = {name: scores.model for name, scores in found.scores.items()}
    error = {name: finite(scores.error) for name, scores in model.items()}
    e_sim = {name: finite(scores.e_sim) for name, scores in model.items()}
    details = IdentificationDetails(
        prior_parameters=FittedPrior(
            prior.fit.values,
            prior.fit.standard_errors,
            prior.nominal,
            prior.fit.warnings,
            prior.fit.stages,
            prior.in_doubt,
        ),
        scores_of_all_networks={name: scores.networks for name, scores in found.scores.items()},
        by_file={
            stem: {m: _all_finite(by[stem].rmse) for m, by in found.by_file.items()}
            for stem in found.by_file["phy"]
        },
        smoother=SmootherNoise(prior.fit.sigma, prior.fit.walk),
        hybrid_over_phy={
            "error": ratio(error[chosen.hybrid], error["phy"]),
            "e_sim": ratio(e_sim[chosen.hybrid], e_sim["phy"]),
        },
        choice=ModelChoice(
            chosen.recommended,
            chosen.hybrid,
            chosen.reason,
            {
                name: CandidateErrors(finite(c.error), finite(c.ratio), finite(c.upper), c.share)
                for name, c in chosen.candidates.items()
            },
        ),
        bands=found.bands,
        baselines=prior.baselines,
        network_settings=network or None,
    )
    return Identification(
        _with_reasons(error),
        _with_reasons({name: _all_finite(scores.rmse) for name, scores in model.items()}),
        _with_reasons({name: _all_finite(scores.fit_percent) for name, scores in model.items()}),
        _with_reasons(e_sim),
        _with_reasons({name: _all_finite(scores.violation) for name, scores in model.items()}),
        details,
    )


def _with_reasons(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of all models, with a reason for each missing value."""
    every = {name: values.get(name) for name in MODELS}
    reasons = {name: "a free run diverged" if name in values else NO_BALANCE for name in MODELS}
    return every | {f"{name}_reason": reasons[name] for name, value in every.items() if value is None}


def _all_finite(values: Mapping[str, float]) -> dict[str, float] | None:
    """Values by signal, or None if one of them is not finite."""
    return dict(values) if all(math.isfinite(value) for value in values.values()) else None


def finite(value: float) -> float | None:
    """The number, or None if it is not finite."""
    return float(value) if math.isfinite(float(value)) else None


def ratio(value: float | None, baseline: float | None) -> float | None:
    """A value over the baseline's, or None if one of them is missing or the baseline is zero."""
    return None if value is None or not baseline else value / baseline


def _control(context: Context) -> Control:
    found = context.find(CONTROL)
    if found.reason:
        none = ControllerCosts(None, None, reason=found.reason)
        return Control(none, none, none, None, found.reason)
    assert not isinstance(found, Absent)
    rows = found.rows
    table, means = by_task(list(rows)), summaries(list(rows), context.budget.seeds)
    costs = {name: _costs(controller, rows, means) for name, controller in REPORTED.items()}
    gaps = {task: Gap(*gap_closed(cells)) for task, cells in table.items()}
    defined = [gap.value for gap in gaps.values() if gap.value is not None]
    return Control(
        **costs,
        gap_closed=float(np.mean(defined)) if defined else None,
        gap_closed_reason="" if defined else "; ".join(dict.fromkeys(gap.reason for gap in gaps.values())),
        details=ControlDetails(
            means,
            gaps,
            {task: comparisons(cells, context.budget.seeds) for task, cells in table.items()},
            context.budget.seeds,
        ),
    )


def _costs(
    controller: str, rows: Sequence[LoopRow], means: Mapping[str, Mapping[str, Summary]]
) -> ControllerCosts:
    own = [cells[controller].cost.mean for cells in means.values() if controller in cells]
    loops = [row for row in rows if row.controller == controller]
    if not own:
        return ControllerCosts(None, None, reason="the scenario has no oracle")
    squares: dict[str, dict[str, list[float]]] = {}  # by task: each may have another number of seeds
    for row in loops:
        for signal, rmse in row.tracking_rmse.items():
            squares.setdefault(signal, {}).setdefault(row.task, []).append(rmse**2)
    tracking = {
        signal: math.sqrt(np.mean([np.mean(own) for own in by.values()])) for signal, by in squares.items()
    }
    known = [cost for cost in own if cost is not None]
    diverged = len(known) < len(own)
    return ControllerCosts(
        None if diverged else float(sum(known)), tracking, "a loop diverged" if diverged else ""
    )


def gap_closed(cells: Mapping[str, Sequence[LoopRow]]) -> tuple[float | None, str]:
    """Share of the distance from the better baseline to the measuring oracle that the hybrid covers in a task.

    The baselines are the fitted prior with and without disturbance observer; the hybrid has the observer. Returns None
    and a reason if the distance is below twice its standard error; one seed has no standard error.

    gap closed = (J_baseline - J_hybrid) / (J_baseline - J_oracle), with mean costs J over the seeds.
    """
    if "oracle" not in cells:
        return None, "the scenario has no oracle"
    costs = {name: np.array([row.cost for row in rows]) for name, rows in cells.items()}
    baseline = min((costs[n] for n in BASELINES if n in costs), key=lambda c: float(c.mean()))
    hybrid, oracle = costs[REPORTED["hybrid"]], costs["oracle"]
    if min(len(baseline), len(oracle)) < 2:
        single = "the oracle ran" if len(oracle) < 2 else "the prior ran"
        return None, f"{single} with one seed only, which gives no standard error; use --budget full"
    if not all(np.all(np.isfinite(c)) for c in (baseline, hybrid, oracle)):
        return None, "a loop diverged"
    gap = float(baseline.mean() - oracle.mean())
    error = math.sqrt(sum(float(c.var(ddof=1)) / len(c) for c in (baseline, oracle)))
    if gap <= 2.0 * error:
        return None, (
            f"the costs of baseline {baseline.mean():.4g} and oracle {oracle.mean():.4g} do not differ significantly"
        )
    return float(baseline.mean() - hybrid.mean()) / gap, ""


def _on_model(context: Context) -> OnModel:
    found = context.find(LOOPS_ON_MODEL)
    if isinstance(found, Absent):
        return OnModel(reason=found.reason)
    tables = {
        name: {task: cells[name] for task, cells in summaries(rows).items()}
        for name, rows in by_controller(found.rows).items()
        if rows
    }
    return OnModel(found.plants, found.left_out, found.default_tasks, OnModelDetails(tables))


def _estimation(context: Context) -> Estimation:
    found = context.find(ESTIMATION)
    if isinstance(found, Absent):
        return Estimation(None, None, reason=found.reason)
    own = {name: _observer(found.observers[name]) for name in OBSERVERS}
    return Estimation(own["prior_observer"], own["hybrid_observer"], EstimationDetails(found.recordings))


def _observer(test: ObserverTest | Absent) -> ObserverFigures:
    if isinstance(test, Absent):
        return ObserverFigures(reason=test.reason)
    return ObserverFigures(
        test.mean_nis, test.nis_low, test.nis_high, test.nis_inside, test.ljung_box, test.ljung_box_limit,
        test.samples,
    )  # fmt: skip


def promises(context: Context) -> Promises:
    """The promises of the kit, or why they were not examined."""
    found = context.find(PROMISES)
    return Promises(reason=found.reason) if isinstance(found, Absent) else Promises(found.rows)


def step_times(context: Context) -> dict[str, Array]:
    """Durations [ms] of whole controller steps by controller."""
    found = context.find(CONTROL)
    if isinstance(found, Absent):
        return {}
    if "step_ms" in found.arrays:
        return {"hybrid": found.arrays["step_ms"]}
    timed = [row for row in found.drawn if "step_ms" in row.arrays]
    own = {
        n: [r.arrays["step_ms"] for r in timed if r.controller == REPORTED[n]] for n in ("prior", "hybrid")
    }
    return {name: np.concatenate(times) for name, times in own.items() if times}


def _timing(context: Context) -> Timing:
    period = 1e3 * context.spec.dt
    ms = step_times(context).get("hybrid")
    if ms is None:
        reason = context.find(CONTROL).reason
        return Timing(StepTimes(reason=reason), period, None, reason)
    median, p95, p99 = (float(np.quantile(ms, q)) for q in (0.5, 0.95, 0.99))
    return Timing(StepTimes(median, p95, p99, float(ms.max())), period, int((ms > period).sum()))


def _watch(context: Context) -> Watch:
    found = context.find(WATCH)
    if isinstance(found, Absent):
        return Watch(reason=found.reason)
    limits = {model: dict(own.limits) for model, own in found.watch.items()}
    details = WatchDetails(
        found.sources, found.loops, limits, found.recordings, found.clean, found.by_channel
    )
    if found.limits is None or found.clean is None:
        return Watch(found.kind, details=details, reason=found.reason)
    clean, own = found.clean, found.limits
    lacks = "plant to simulate faults with" if context.scenario.plant is None else "task without faults"
    return Watch(
        found.kind, own.false_alarms_per_hour, own.hours,
        clean.alarms / (clean.seconds / 3600.0) if clean.seconds else 0.0,
        found.alarms, found.faults,
        f"scenario {context.scenario.name} has no {lacks}" if found.faults is None else "",
        details,
    )  # fmt: skip


def _analysis(context: Context) -> Analysis:
    found = context.find(ANALYSIS)
    if isinstance(found, Absent):
        return Analysis(reason=found.reason)
    rest = found.models["hybrid"].rest
    return Analysis(
        rest.poles, rest.stabilisable, rest.detectable, AnalysisDetails(found.models, found.working_speed)
    )
