"""Stage report: figures, ``report.html`` and ``results.json``."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import chi2

from hybrid_mpc.analyze.properties import stabilisable_detectable
from hybrid_mpc.compare.controllers import CONTROLLERS
from hybrid_mpc.compare.loops import DRAWN_PRIOR, ON_MODEL
from hybrid_mpc.compare.sequential import SAME, hardest
from hybrid_mpc.compare.step_response import step_responses
from hybrid_mpc.compare.summary import StepTimes, Summary
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.files import write_json
from hybrid_mpc.identify.evaluate import OutputErrors
from hybrid_mpc.identify.settings import NO_BALANCE
from hybrid_mpc.plots.style import name_of, number
from hybrid_mpc.records import plain
from hybrid_mpc.report.page import Report, Section, Table, words, write_report
from hybrid_mpc.rules import counted, two_digits
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.watch.explain import WatchedRecording
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.explain_page import steps_table, terms_table, tests_table, trials_table
from hybrid_mpc.workflow.stage import Absent, Stage, source_of
from hybrid_mpc.workflow.stages.advice import advice, doubt_of
from hybrid_mpc.workflow.stages.analyze import LinearizedModels
from hybrid_mpc.workflow.stages.answers import answer_all
from hybrid_mpc.workflow.stages.choose import CHOICE, ChoiceResult
from hybrid_mpc.workflow.stages.compare import REPORTED, ControlResult, closed_loops
from hybrid_mpc.workflow.stages.estimate import EstimationResult
from hybrid_mpc.workflow.stages.evaluate import EVALUATION, EvaluationResult, finite
from hybrid_mpc.workflow.stages.explain import EXPLAIN
from hybrid_mpc.workflow.stages.export import ExportResult
from hybrid_mpc.workflow.stages.figures import OBSERVER_TITLES, Figures, draw_all, draw_first
from hybrid_mpc.workflow.stages.identify import DATA, DataResult, models_of, trained_kinds, training_settings
from hybrid_mpc.workflow.stages.on_model import OnModelResult
from hybrid_mpc.workflow.stages.promises import found_terms
from hybrid_mpc.workflow.stages.results import SHOWN, Results, collect
from hybrid_mpc.workflow.stages.track import TrackResult
from hybrid_mpc.workflow.stages.watch import CleanAlarms, FaultedLoop, WatchResult

TITLES: Mapping[str, str] = {
    "promises": "What this kit promises",
    "data": "Data",
    "explain": "Missing terms",
    "models": "Prior and models",
    "training": "Training",
    "free_run": "Free runs: how well the models predict",
    "export": "Export",
    "control": "Closed loops",
    "on_model": "Closed loops on the model, not the machine",
    "estimation": "Estimation: consistency of the observers",
    "timing": "Time of a controller step",
    "watch": "Monitor",
    "analysis": "Linear analysis",
    "glossary": "Names and definitions",
}
CHANNEL_CAPTION = (
    "Channels of the monitor. A false alarm begins while no fault or disturbance acts; their interval is that of a "
    "Poisson count. Each simulated fault is listed at the channel that alarms first."
)
FADED = "Training penalized the network's correction far away from all recordings"


@dataclass(frozen=True)
class ReportResult:
    """The report: its file, and the pictures in it."""

    file: str
    figures: tuple[str, ...]


def report_stage(context: Context) -> ReportResult:
    """Draw, write the report, and last the results."""
    results = collect(context)
    figures = draw_all(context)
    write_report(context.out / "report.html", _report(context, results, figures))
    write_json(context.out / "results.json", plain(results))
    drawn = tuple(path.name for group in figures.values() for path, _ in group)
    return ReportResult("report.html", drawn)


def report_so_far(context: Context) -> None:
    """Write a first report of the finished stages up to the free runs, while the run continues."""
    figures = draw_first(context)
    tables: dict[str, Sequence[Table]] = {
        "data": [_data_table(context.read(DATA))],
        **({"explain": _explain_tables(context)} if _explained(context) else {}),
        "models": [_prior_table(context)],
    }
    if "free_run" in figures:
        tables["free_run"] = _free_run_tables(context)
    texts = words("run_words.html", trained_kinds(context))
    shown = [key for key in TITLES if key in figures or key in tables]
    sections = [Section(TITLES[key], texts[key], figures.get(key, ()), tables.get(key, ())) for key in shown]
    going = "The run is not finished. It updates this page after its first stages and at its end; reload the page."
    s, title = context.scenario, f"hybrid-mpc: {context.scenario.name}"
    doubt = doubt_of(context.prior.in_doubt)
    page = Report(title, s.title, s.description, command(context), (), sections, going, doubt=doubt)
    write_report(context.out / "report.html", page)


def report_is_there(context: Context, found: ReportResult) -> str:
    """Why the report must be written again: a file is missing; empty if both files exist."""
    there = all((context.out / name).is_file() for name in (found.file, "results.json"))
    return "" if there else "report.html or results.json is missing"


def what_report_reads(context: Context) -> dict[str, object]:
    """Texts and drawings of the scenario that the report shows beside the results."""
    scenario, prior = context.scenario, context.scenario.prior()
    return {
        "titles": (scenario.title, scenario.description, [task.title for task in scenario.tasks]),
        "labels": (prior.states, prior.inputs, prior.outputs, prior.parameters),
        "drawing": source_of(scenario.draw),
        "own figures": source_of(scenario.figures),
        "command": command(context, Path(context.settings.scenario).name),
    }


def command(context: Context, scenario: str = "") -> str:
    """The command line of this run; ``scenario`` replaces the scenario as it was given."""
    s = context.settings
    words = ["hybrid-mpc", "run", scenario or s.scenario, *s.options(lambda path: path.name)]
    words += ["--settings", s.network_file.name] if s.network_file else []
    words += ["--deploy", s.deploy] if s.deploy else []
    words += [flag for flag, given in (("--explain", s.explain), ("--track", s.track)) if given]
    return shlex.join([*words, "--seed", str(s.seed), "--budget", s.budget])


def _report(context: Context, results: Results, figures: Figures) -> Report:
    tables: dict[str, Sequence[Table]] = {
        "data": [_data_table(results.data)],
        "explain": _explain_tables(context),
        "models": [_prior_table(context)],
        "free_run": _free_run_tables(context),
        "export": [_export_table(results.export)],
    }
    if not isinstance(results.promises, Absent):
        rows = [(one.name, one.verdict, one.evidence, one.remedy) for one in results.promises.rows]
        tables["promises"] = [Table(("promise", "verdict", "evidence", "what to do"), rows)]
    if (loops := closed_loops(results.control)) is not None:
        tables["control"] = [
            _control_table(loops),
            _comparison_table(loops),
            _tracking_table(loops, untracked(context)),
            _response_table(context, loops),
        ]
    if not isinstance(results.control, Absent):
        tables["timing"] = [_timing_table(results.control.step_ms)]
    if not isinstance(results.on_model, Absent):
        tables["on_model"] = _on_model_tables(results.on_model)
    if not isinstance(results.estimation, Absent):
        tables["estimation"] = [_observer_table(results.estimation)]
    if not isinstance(results.track, Absent):
        tables["estimation"] = [*tables.get("estimation", ()), _varying_table(results.track)]
    if not isinstance(results.watch, Absent):
        tables["watch"] = _watch_tables(results.watch)
    if not isinstance(results.analysis, Absent):
        tables["analysis"] = [_pole_table(results.analysis)]
    instead, after = _notes(context, results)
    for key in ("estimation", "timing", "watch"):
        # without pictures and tables the general text of the section has nothing to explain
        if key in after and not figures.get(key) and not any(t.rows for t in tables.get(key, ())):
            instead[key] = after.pop(key)
    loops = closed_loops(results.control)
    oracle = ("oracle",) if loops is not None and loops.has_oracle else ()
    texts = words("run_words.html", (*trained_kinds(context), *oracle))
    sections = tuple(
        Section(
            TITLES[key],
            instead.get(key, texts[key]),
            figures.get(key, ()),
            [t.filled() for t in tables.get(key, ()) if t.rows],
            after.get(key, ()),
        )
        for key in TITLES
        if not isinstance({"on_model": results.on_model, "explain": results.explain}.get(key), Absent)
    )
    versions = ", ".join(f"{name} {v}" for name, v in results.versions.items())
    return Report(
        f"hybrid-mpc: {context.scenario.name}",
        context.scenario.title,
        context.scenario.description,
        command(context),
        (),
        sections,
        f"seed {results.seed}, budget {results.budget}; {versions}",
        advice(results, explained=found_terms(context) is not None, declared=context.scenario.sensor_sigma),
        doubt_of(results.prior.in_doubt),
        answer_all(results),
    )


Notes = dict[str, tuple[str, ...]]


def _notes(context: Context, results: Results) -> tuple[Notes, Notes]:
    """Paragraphs by section: those that replace the usual ones, and those after tables and pictures."""
    instead: Notes = {}
    after: Notes = {}
    control, on_model, tested = results.control, results.on_model, results.estimation
    if isinstance(results.promises, Absent):
        instead["promises"] = (
            f"The promises of the kit were not examined: {results.promises.reason.rstrip('.')}.",
        )
    if (loops := closed_loops(control)) is not None:
        value, reason = loops.gap
        undefined = f"The gap closed is not defined: {reason.rstrip('.')}."
        after["control"] = (
            *((undefined,) if value is None and loops.has_oracle else ()),
            *oracle_words(loops),
        )
    else:
        timed = "" if isinstance(control, Absent) else " Instead, the controller was timed on recordings."
        if not isinstance(on_model, Absent) and on_model.plants:
            timed += f" Loops {ON_MODEL}, are in the next section."
        instead["control"] = (f"No closed loop was simulated: {control.reason.rstrip('.')}.{timed}",)
    if isinstance(control, Absent):
        after["timing"] = (f"No controller step was timed: {control.reason.rstrip('.')}.",)
    if not isinstance(on_model, Absent):
        after["on_model"] = tuple(on_model_words(on_model))
    absent = (
        [tested]
        if isinstance(tested, Absent)
        else [one for one in tested.observers.values() if isinstance(one, Absent)]
    )
    if absent:
        reasons = dict.fromkeys(one.reason for one in absent)
        after["estimation"] = (f"Observers were not tested: {'; '.join(reasons)}.",)
    after["data"] = (
        *(f"Warning: {text}" for text in results.data.warnings),
        *(f"Note: {text}" for text in results.data.notes),
    )
    if kinds := trained_kinds(context):
        replay = training_settings(context, context.read(CHOICE).deployed).prior_replay
        after["training"] = (
            *((f"There is no MOPGRNN: {NO_BALANCE}.",) if "mopgrnn" not in kinds else ()),
            *((f"{FADED} (prior_replay, weight {replay:g}).",) if replay else ()),
        )
    else:
        instead["training"] = ("This run trains no networks, so the hybrid equals the fitted prior.",)
    if context.prior.fit.warnings:
        after["models"] = ("Warnings of the fit: " + "; ".join(context.prior.fit.warnings) + ".",)
    watched, analysis = results.watch, results.analysis
    seen = () if isinstance(watched, Absent) else watched.recordings
    after["watch"] = (*_watch_words(watched), *coverage_words(seen))
    if isinstance(analysis, Absent):
        instead["analysis"] = (f"No linear analysis: {analysis.reason.rstrip('.')}.",)
    else:
        after["analysis"] = tuple(
            f"{name}: {m.fixed_point_reason}" for name, m in analysis.models.items() if m.fixed_point_reason
        )
    return instead, after


def on_model_words(found: OnModelResult) -> Iterator[str]:
    """Notes on loops on a model: controllers without loops, a drawn prior, default tasks."""
    yield from (f"{name}: {why}." for name, why in found.left_out.items())
    if DRAWN_PRIOR in found.plants.values():
        yield (
            f"The networks correct nothing, so no other model differs from the controller's. {DRAWN_PRIOR} is the "
            "prior with parameters drawn from their fitted covariance."
        )
    if found.default_tasks:
        yield "The scenario declares no tasks; the loops use default tasks."


def oracle_words(control: ControlResult) -> tuple[str, ...]:
    """A note on tasks in which another controller costs less than the oracle; empty without such a task."""
    beaten = []
    for task, cells in control.means.items():
        costs = {name: cell.cost.mean for name, cell in cells.items() if cell.cost.mean is not None}
        if "oracle" in costs and min(costs, key=lambda name: costs[name]) != "oracle":
            beaten.append(task)
    if not beaten:
        return ()
    return (
        f"In {', '.join(beaten)} the oracle does not have the least cost. The oracle knows the machine's equations, "
        "but it estimates state and load from the same measurements as the others. So the oracle's cost is no lower "
        "bound.",
    )


def _watch_words(found: WatchResult | Absent) -> tuple[str, ...]:
    """Source and rate of the limits, and the number of false alarms compared with that rate."""
    if isinstance(found, Absent) or found.limits is None or found.clean is None:
        return (f"The monitor was not examined: {found.reason.rstrip('.')}.",)
    limits, clean = found.limits, found.clean
    rate, wanted = limits.false_alarms_per_hour, found.wanted
    learned = f"Limits were learned from {found.sources[found.kind]}: {limits.words}."
    if not limits.rated:
        learned = (
            f"Limits are {limits.method}; they were learned from {found.sources[found.kind]}: {limits.words}."
        )
    elif rate > wanted:
        learned += (
            f" Nominal data are too short for {two_digits(wanted)} an hour. Use a longer run (budget full), or "
            f"recordings of the machine with hybrid-mpc monitor --learn {two_digits(wanted)}."
        )
    verdict = "too many for these limits" if clean.too_many(rate) else "consistent with these limits"
    test = f"Alarms in the {clean.test_seconds:.0f} s of test data among them: {clean.test_alarms}."
    words: tuple[str, ...] = (learned, f"False alarms: {clean.words(rate)}: {verdict}. {test}")
    if found.loops:
        words += (
            "The limits were learned from closed loops. Recordings cover a wider range; an alarm there can mean that "
            "the model is less accurate outside the range of the loops.",
        )
    return words


def coverage_words(recordings: Sequence[WatchedRecording]) -> tuple[str, ...]:
    """A sentence on parts of the recordings that were not monitored, warm-up apart; empty without such a part.

    Example:
        >>> coverage_words([WatchedRecording("monday", 6.3, 4.0, 0.3, missing_s=0.0, not_finite_s=2.0, alarms=())])
        ('Not monitored: 2 s with a non-finite value of model or estimator.',)
    """
    sums = {
        "with missing samples": sum(row.missing_s for row in recordings),
        "with a non-finite value of model or estimator": sum(row.not_finite_s for row in recordings),
    }
    parts = [f"{seconds:.3g} s {words}" for words, seconds in sums.items() if seconds > 0]
    return (f"Not monitored: {', '.join(parts)}.",) if parts else ()


def _data_table(data: DataResult) -> Table:
    rows: list[tuple[Any, ...]] = list(data.seconds.items())
    rows += [
        (f"cut: {c.file}, {c.start_s:.2f} to {c.end_s:.2f} s: {c.why}", c.end_s - c.start_s)
        for c in data.cuts
    ]
    caption = f"{counted(len(data.files), 'file')}; content hash {data.hash[:16]}."
    return Table(("part", "length [s]"), rows, caption)


def _explained(context: Context) -> bool:
    found = context.find(EXPLAIN)
    return not isinstance(found, Absent)


def _explain_tables(context: Context) -> list[Table]:
    """Steps of the search for missing terms, and the errors over the test recordings."""
    found = context.find(EXPLAIN)
    if isinstance(found, Absent):
        return []
    explanation = found.explanation
    tests = [tests_table(found)] if found.tests else []
    return [
        table
        for table in (steps_table(explanation), *tests, terms_table(explanation), trials_table(explanation))
        if table.rows
    ]


def _prior_table(context: Context) -> Table:
    prior = context.prior
    rows = [
        (p.label, p.description, prior.nominal[p.name], prior.fit.values[p.name],
         "fixed" if p.fixed else prior.fit.standard_errors.get(p.name))
        for p in context.scenario.prior().parameters
    ]  # fmt: skip
    colours = ", ".join(f"{label} {value:.2f}" for label, value in prior.error_correlation.items())
    caption = (
        "Parameters of the prior. Standard errors assume that the prior's structure is right. Correlation of "
        f"successive one-step errors (0 is white): {colours}."
        + (f" Fitted delay of the inputs: {prior.fit.delay:.3g} s." if prior.fit.delay else "")
    )
    return Table(("parameter", "meaning", "nominal", "fitted", "standard error"), rows, caption)


def _free_run_tables(context: Context) -> list[Table]:
    """Errors of every model: by output; then of its rates and by balance; the choice, and the bands."""
    prior, found = context.scenario.prior(), context.read(EVALUATION)
    models = {name_of(m): found.scores[m].model for m in models_of(context)}
    outputs = [s.label for s in prior.outputs]
    base = finite(found.scores["phy"].model.error)
    errors: dict[str, OutputErrors] = {**models}
    for name, own in context.prior.baselines.items():
        model = name if name == "constant" else f"{name} (linear)"
        errors[model] = own.errors or OutputErrors(math.inf, {}, {})
    rows: list[tuple[Any, ...]] = []
    for name, one in errors.items():
        rmse, fit = ([_by(by, label) for label in outputs] for by in (one.rmse, one.fit_percent))
        rows.append((name, finite(one.error), _percent(one.error, base), *rmse, *fit))
    columns = ("model", "error [-]", "change from prior", *(f"RMSE of {label}" for label in outputs),
               *(f"FIT of {s.name} [%]" for s in prior.outputs))  # fmt: skip
    length = context.prior.longest_run
    of = "" if length is None else f" of {length:.3g} s"
    tables = [Table(columns, rows, f"Free runs{of} on test data: outputs.")]
    balances = [f"{b.name} [{b.rate_unit}]" for b in prior.equations.balances]
    base = finite(found.scores["phy"].model.e_sim)
    rows = [
        (name, finite(s.e_sim), _percent(s.e_sim, base), *(_by(s.violation, label) for label in balances))
        for name, s in models.items()
    ]
    columns = (
        "model",
        "E_sim [-]",
        "change from prior",
        *(f"violation of {label}" for label in balances),
    )
    caption = "Free runs on test data: rates of the states" + (" and balances." if balances else ".")
    tables.append(Table(columns, rows, caption))
    return [*tables, _choice_table(context.read(CHOICE)), _band_table(context, found)]


def _choice_table(found: ChoiceResult) -> Table:
    choice = found.choice
    rows = [
        (name_of(name), None if name == "phy" else f"{100 * c.share:.0f} %", finite(c.error), finite(c.ratio),
         *((None, None, None) if name == "phy" else (finite(c.upper), f"{100 * c.harm:.0f} %", finite(c.worst))),
         "recommended" if name == choice.recommended else "")
        for name, c in choice.candidates.items()
    ]  # fmt: skip
    upper = f"{100 * choice.confidence:g} % upper bound"
    columns = ("model", "correction", "error [-]", "ratio to prior", upper, "harm", "worst output", "")
    caption = (
        f"Choice of the model on held-out parts of the training data. {choice.reason} The error is over all parts "
        "together. The ratio is the geometric mean of the ratios of the parts; the upper bound refers to this mean. "
        "Correction: share of the networks' correction that the model uses; below 100 % if the full correction is not "
        "significantly better. Harm: probability that the error is more than 5 % larger than the prior's. "
        "Worst output: largest ratio of an output, over all parts together."
    )
    return Table(columns, rows, caption)


def _band_table(context: Context, found: EvaluationResult) -> Table:
    rows: list[tuple[Any, ...]] = [
        (name_of(name), output.label, f"{100 * b.share:g} %", f"{100 * b.coverage:.0f} %",
         *(by[output.label] for by in (b.width, b.score, b.score_of_constant)))
        for name, b in found.bands.items()
        for output in context.scenario.prior().outputs
    ]  # fmt: skip
    what = ("mean width", "interval score", "of a constant band")
    columns = ("model", "output", "nominal coverage", "coverage", *what)
    caption = (
        "Prediction bands of free runs, calibrated on held-out data and evaluated on test data, in the outputs' units. "
        "A lower interval score is better."
    )
    return Table(columns, rows, caption)


def _by(values: Mapping[str, float], label: str) -> float | None:
    return finite(values.get(label, math.nan))


def _percent(value: float, base: float | None) -> str:
    return f"{100 * (value / base - 1):+.0f} %" if base and math.isfinite(value) else "–"


def _export_table(export: ExportResult) -> Table:
    rows = [
        ("values", f"{export.parity_max_abs_error:.1e}", "1e-12"),
        ("Jacobians", f"{export.jacobian_max_abs_error:.1e}", "1e-10"),
    ]
    caption = "Largest difference between the exported models and PyTorch, relative to the outputs' scale."
    return Table(("compared", "largest difference", "allowed"), rows, caption)


def _control_table(found: ControlResult) -> Table:
    names = [n for n in CONTROLLERS if any(n in cells for cells in found.means.values())]
    gaps = found.gaps if found.gap[0] is not None else {}
    rows = []
    for task, cells in found.means.items():
        costs = (_cost(cells.get(name)) for name in names)
        shares = ("–" if gap is None else f"{gap:.2f}" for gap in ([gaps[task][0]] if gaps else ()))
        rows.append((task, *costs, *shares))
    caption = (
        "Closed-loop cost J on the true state: sum of the squared deviations of all signals, weighted as in the "
        "control problem. Mean over the seeds with a 95 % interval that holds with early stopping (no interval for "
        "one seed)."
    )
    if gaps:
        caption += (
            " Gap closed: share of the distance from the better baseline to the measuring oracle that the hybrid with "
            "observer covers; a dash if baseline and oracle do not differ significantly."
        )
    return Table(
        ("task", *(n.replace("_", ", ") for n in names), *(["gap closed"] if gaps else ())), rows, caption
    )


def _comparison_table(found: ControlResult) -> Table:
    """The hybrid's cost over that of each baseline on the same seeds, with an interval valid under early stopping."""
    rows = [
        (task, base.replace("_", ", ") + " *" * (base == hardest(own)), one.words, one.n, one.finding)
        for task, own in found.comparisons.items()
        for base, one in own.items()
    ]
    caption = (
        f"Cost of the hybrid with observer over a baseline's on the same seeds: geometric mean, and a 95 % interval "
        f"that holds with early stopping. The loops of a task stop once the larger ratio (*) is decided, at most after "
        f"{found.most_seeds} seeds. Ratios within {100 * SAME:.0f} % of 1 count as the same. The 95 % hold for each "
        "row alone: one of twenty rows may be wrong."
    )
    return Table(("task", "baseline", "ratio of costs", "seeds", "finding"), rows, caption)


def untracked(context: Context) -> set[str]:
    """Names of the tasks without tracking errors: their weights change over time."""
    return {task.name for task in context.scenario.tasks if task.weight is not None}


def _tracking_table(found: ControlResult, untracked: Collection[str]) -> Table:
    """Tracking errors of every signal that has a reference, in its unit."""
    cells = [
        (task, name, own[name])
        for task, own in found.means.items()
        for name in CONTROLLERS
        if name in own and task not in untracked
    ]
    signals, errors = _tracking([cell for *_, cell in cells])
    rows = [(task, name.replace("_", ", "), *own) for (task, name, _), own in zip(cells, errors, strict=True)]
    caption = (
        "Root mean square deviations from the reference, means over seeds: of true states, or of outputs if the "
        "reference is one of outputs."
    )
    return Table(("task", "controller", *(f"RMSE of {s}" for s in signals)), rows, caption)


def _response_table(context: Context, found: ControlResult) -> Table:
    """Rise, settling, overshoot and offset in tasks that end at a set-point."""
    scenario, drawn, prior = context.scenario, found.drawn, context.scenario.prior()
    assert scenario.control is not None
    names = {controller: name for name, controller in REPORTED.items()}
    rows = [
        (
            task.name, names[row.controller], signal.label, answer.rise, answer.settling, answer.overshoot,
            answer.offset,
        )
        for task in tasks_of(scenario, context.budget.tasks)
        for row in drawn
        if row.task == task.name and row.controller in names and task.weight is None
        for signal, answer in step_responses(task.control or scenario.control, prior, row.arrays).items()
    ]  # fmt: skip
    caption = (
        "Step response to the last set-point of each task that ends at one, first seed: rise time from 10 to 90 % of "
        "the step, settling time to 5 % of the step, overshoot, and mean deviation over the last fifth of the task in "
        "the signal's unit. A dash: the task has no clear step, for example if it rejects a load."
    )
    heads = ("task", "controller", "signal", "rise [s]", "settling [s]", "overshoot [%]", "offset")
    return Table(heads, rows, caption)


def _on_model_tables(found: OnModelResult) -> list[Table]:
    """One table for each controller: their plants differ, so one table must not compare two controllers."""
    tables = []
    for name, plant in found.plants.items():
        cells = {task: own[name] for task, own in found.means.items()}
        signals, errors = _tracking(list(cells.values()))
        rows = [
            (task, _cost(cell), *own, f"{100 * max(cell.limits.values(), default=0.0):.0f} %",
             f"{100 * cell.sources['MPC']:.1f} %")
            for (task, cell), own in zip(cells.items(), errors, strict=True)
        ]  # fmt: skip
        caption = (
            f"Controller {name.replace('_', ', ')} on the model {plant} in place of the machine: "
            f"{ON_MODEL}. Cost J on the model's state, root mean square deviations from the reference, means over "
            "seeds."
        )
        heads = ("task", "cost", *(f"RMSE of {s}" for s in signals), "largest share of a limit", "solved")
        tables.append(Table(heads, rows, caption))
    return tables


def _tracking(cells: Sequence[Summary]) -> tuple[list[str], list[list[float | None]]]:
    """Signals with a tracking error in any cell, and the mean errors of each cell."""
    signals = list(dict.fromkeys(s for cell in cells for s in cell.tracking_rmse))
    errors = [{s: found.mean for s, found in cell.tracking_rmse.items()} for cell in cells]
    return signals, [[own.get(s) for s in signals] for own in errors]


def _cost(cell: Summary | None) -> str:
    if cell is None:
        return "–"
    mean, half = cell.cost.mean, cell.cost.ci95
    if mean is None:
        return "diverged"
    return f"{mean:.3g}" + (f" ± {half:.1g}" if half is not None else "")


def _observer_table(found: EstimationResult) -> Table:
    rows = [
        (OBSERVER_TITLES[name], r.mean_nis, "{:.2f} to {:.2f}".format(*r.nis_band), f"{100 * r.nis_inside:.0f} %",
         f"{r.ljung_box:.0f}", f"{r.ljung_box_limit:.0f}", r.samples)
        for name, r in found.observers.items()
        if not isinstance(r, Absent)
    ]  # fmt: skip
    columns = ("observer", "mean NIS", "consistent", "below 95 %", "Ljung-Box", "white below", "samples")
    return Table(
        columns, rows, "Innovations on test recordings, without the first 25 samples of each recording."
    )


def _varying_table(found: TrackResult) -> Table:
    tracked = {one.name: one for one in found.tracking.tracked}
    rows = [
        (f"{p.name} [{p.unit}]", p.value, p.std or "fixed", p.gain,
         tracked[p.name].words(p.unit, found.tracking.horizon) if p.name in tracked else "no")
        for p in found.varying.parameters
    ]  # fmt: skip
    of = "blocks of the recording" if found.varying.blocks else "recordings"
    ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in found.tracking.ratio.items())
    gain = (
        f" Prediction errors over {found.tracking.horizon:g} s with tracking, over those without: {ratios}."
    )
    return Table(
        ("parameter", "fitted", "deviation, all together", "evidence, alone", "tracked with deviation and drift"), rows,
        f"Standard deviations of the parameters between {found.varying.pieces} {of}. If all parameters may vary, some "
        "parameters replace others and are fixed. Evidence: gain of the log evidence if one parameter alone varies. "
        "The deviation of a tracked parameter is that of the parameter alone, or of all together. Drift: standard "
        "deviation of its change within a recording."
        + (gain if tracked else " Tracking improves no prediction."),
    )  # fmt: skip


def _timing_table(ms: StepTimes) -> Table:
    row = (ms.median, ms.p95, ms.p99, ms.max, ms.period, ms.misses)
    caption = "Wall time of whole steps. The promise on the step time refers to processor time."
    return Table(
        ("median [ms]", "p95 [ms]", "p99 [ms]", "max [ms]", "period [ms]", "misses"), (row,), caption
    )


def _watch_tables(found: WatchResult) -> list[Table]:
    if found.limits is None:
        return []
    tables = [watching_table(found, found.limits)]
    if found.faults:
        heads = ("fault", "at [s]", "detection delay [s]", "alarms before", "guard")
        rows = [
            (
                row.title, row.start_s, "never" if row.delay_s is None else f"{row.delay_s:.3g}", row.false_alarms,
                ", ".join(f"{s.after.lower()} at {s.t_s:.2f} s" for s in row.switches) or "stays normal",
            )
            for row in found.faults
        ]  # fmt: skip
        tables.append(
            Table(heads, rows, f"Closed loops of the task {found.faults[0].task} with a simulated fault.")
        )
    alarms = [
        (name, a.start_s, a.end_s, ", ".join(a.channels), a.diagnosis or None) for name, a in found.alarms
    ]
    heads = ("recording", "from [s]", "to [s]", "channels", "diagnosis")
    return [*tables, Table(heads, alarms, "Alarms over the whole recordings.")]


def watching_table(found: WatchResult, limits: WatchLimits) -> Table:
    """Table of the channels with limits, of the frozen-sensor checks, and of all together."""
    rows, faults = [], found.faults or ()
    for channel in found.channels:
        own = limits.of(channel.name)
        if own:
            threshold = "; ".join(limit.words(limits.dt) for limit in own)
            rows.append(_channel_row(channel.name, threshold, found.by_channel, faults))
    frozen = [name for name in found.by_channel if name.endswith(" frozen")]
    for name, far, often in zip(frozen, limits.travel, limits.repeats, strict=True):
        rows.append(_channel_row(name, f"travel {far:.3g}, {often} repeats", found.by_channel, faults))
    clean = found.clean or CleanAlarms()
    never = [row for row in faults if row.delay_s is None]
    rows.append(("all together", "", rate_words(clean.alarms, clean.seconds), *_delays_of(never)))
    heads = (
        "channel",
        "threshold",
        "false alarms an hour (95 % interval)",
        "detection delay of faults",
        "diagnosis",
    )
    return Table(heads, rows, CHANNEL_CAPTION)


def rate_words(alarms: int, seconds: float) -> str:
    """Alarms an hour with their 95 % interval.

    Source: exact interval of a Poisson count (Garwood, 1936).

    Example:
        >>> rate_words(1, 300.0), rate_words(0, 76.0), rate_words(0, 0.0)
        ('12 (0.3 to 67)', '0 (0 to 170)', 'not watched')
    """
    if not seconds > 0:
        return "not watched"
    hours = seconds / 3600.0
    low = 0.5 * float(chi2.ppf(0.025, 2 * alarms)) / hours if alarms else 0.0
    high = 0.5 * float(chi2.ppf(0.975, 2 * alarms + 2)) / hours
    rate, least, most = map(two_digits, (alarms / hours, low, high))
    return f"{rate} ({least} to {most})"


def _channel_row(
    name: str, threshold: str, by_channel: Mapping[str, CleanAlarms], faults: Sequence[FaultedLoop]
) -> tuple[str, str, str, str, str]:
    own = by_channel.get(name, CleanAlarms())
    seen = [row for row in faults if row.channels[:1] == (name,)]
    return (name, threshold, rate_words(own.alarms, own.seconds), *_delays_of(seen))


def _delays_of(faults: Sequence[FaultedLoop]) -> tuple[str, str]:
    """Detection delays and diagnoses of faults, as text."""
    after = [f"{row.fault} {'never' if row.delay_s is None else f'{row.delay_s:.2g} s'}" for row in faults]
    causes = [f"{row.fault}: {row.diagnosis or 'none'}" for row in faults if row.delay_s is not None]
    return "; ".join(after), "; ".join(causes)


def _pole_table(analysis: LinearizedModels) -> Table:
    rows, verdicts = [], dict[str, set[bool]]()
    for model, found in analysis.models.items():
        for point, own in found.points.items():
            slow = [f"{number(m.frequency)} ({m.damping:.2f})" for m in own[:2] if m.pole != 0]
            stable = all(abs(m.pole) < 1.0 for m in own)
            verdicts.setdefault(point, set()).add(stable)
            rows.append((model, point, ", ".join(slow), stable, *stabilisable_detectable(own)))
    columns = ("model", "point", "slowest poles: rad/s (damping)", "stable", "stabilisable", "detectable")
    points = {"rest": "at rest", "moving": "at working speed"}
    there = [points[p] for p in points if p in verdicts]
    caption = f"Poles of the models linearized {' and '.join(there)}."
    if differ := [points[p] for p in points if len(verdicts.get(p, ())) > 1]:
        caption += (
            f" Stable and unstable models {' and '.join(differ)}: near zero damping, a small error of a model changes "
            "the sign of the damping. At a resonance the phase falls by 180° in a stable model and rises by 180° in an "
            "unstable one; -180° and 180° are the same phase."
        )
    return Table(columns, rows, caption)


REPORT = Stage(
    "report",
    "writing the report",
    ReportResult,
    report_stage,
    what_report_reads,
    SHOWN,
    restore=report_is_there,
)
