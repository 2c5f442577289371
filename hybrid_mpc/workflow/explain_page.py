"""The page of ``hybrid-mpc explain``: steps, terms over their data, what was not added, and how it was judged."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from hybrid_mpc.identify.explain import DOUBT, HARM, WORTH
from hybrid_mpc.identify.explanation import ExplainStep, Explanation, Trial, bound
from hybrid_mpc.plots import explain as plots
from hybrid_mpc.plots.style import save
from hybrid_mpc.report.page import Hint, KeyFigure, Report, Section, Table, write_report
from hybrid_mpc.scenario import Scenario
from hybrid_mpc.workflow.explained import ExplainResult, state_of

PAGE = "explain.html"
SPREADS = "over the outputs' spreads"
MODELS = {"nominal": "prior, nominal", "fitted": "prior, fitted", "explained": "prior with the found terms"}


def write_page(out: Path, scenario: Scenario, found: ExplainResult, command: Sequence[str]) -> Path:
    """Write figures and the page; its path."""
    told = found.explanation
    bars = plots.error_steps(*bars_of(told), f"held-out error, {SPREADS} [-]", found.floor)
    steps = save(bars, out / "figures" / "error_by_step.png")
    drawn = []
    for number, step in enumerate(told.steps, 1):
        for k, picture in enumerate(step.pictures, 1):
            figure = plots.term_over_data(picture)
            path = save(figure, out / "figures" / f"step_{number}_{k}.png")
            drawn.append((path, f"Step {number}: {picture.ordinate.partition(' [')[0]} over its data."))
    sections = [
        Section(
            "Error by step",
            (
                "Each bar is the error of free runs over recordings that the model was not fitted to. The pale part is "
                "what the step removed. The dashed line is the sensors' noise.",
            ),
            ((steps, "Held-out error of the nominal and the fitted prior, and after each step."),),
            (steps_table(told), *([tests_table(found)] if found.tests else [])),
        ),
        Section("Found terms", _about_terms(told), drawn, (terms_table(told),) if told.found else ()),
        Section("All parameters", (), (), (parameters_table(told),)),
        Section(
            "What was not added",
            (f"The search ended: {told.reason}.",),
            (),
            (trials_table(told),) if _trials(told) else (),
        ),
        Section("How it was judged", _judged(told)),
    ]
    report = Report(
        f"Missing terms: {scenario.name}", scenario.title, scenario.description,
        shlex.join(["hybrid-mpc", *command]), _figures(told), sections, hints=_hints(found),
    )  # fmt: skip
    return write_report(out / PAGE, report)


def bars_of(told: Explanation) -> tuple[list[str], list[float]]:
    """Labels and held-out errors of the nominal and the fitted prior, and after each step.

    Example:
        ``plots.error_steps(*bars_of(explanation), "held-out error [-]")``
    """
    labels, errors = ["prior, nominal", "prior, fitted"], [told.nominal, told.before]
    for step in told.steps:
        labels.append(signed(step))
        errors.append(step.held_out.error)
    return labels, errors


def signed(step: ExplainStep) -> str:
    """What a step added or removed."""
    return f"{'+' if step.action == 'added' else '−'} {step.name}"


def interval(step: ExplainStep) -> str:
    """Ratio of errors with its interval.

    Example:
        ``"0.42 (0.31 to 0.55)"``
    """
    own = step.held_out
    if own.lower <= 0.0:
        return f"{own.ratio:.2f} ({bound(own.upper)})"
    return f"{own.ratio:.2f} ({own.lower:.2f} to {own.upper:.2f})"


def values_of(step: ExplainStep) -> str:
    """Fitted values of a step's parameters with their standard errors."""
    return ", ".join(str(p).replace("+-", "±").removesuffix(" -") for p in step.parameters)


def alternatives_of(step: ExplainStep) -> str:
    """Names of the terms that the data do not tell from what was added."""
    return ", ".join(trial.name for trial in step.alternatives) or "none"


def steps_table(told: Explanation) -> Table:
    """A row a step."""
    rows = [
        (signed(s), s.held_out.error, interval(s), values_of(s), alternatives_of(s))
        for s in told.steps
    ]  # fmt: skip
    return Table(
        ("step", "held-out error [-]", "ratio to the step before", "fitted values", "alternatives"),
        [("prior, nominal", told.nominal, None, "", ""), ("prior, fitted", told.before, None, "", ""), *rows],
        "Steps of the search. The intervals hold for all candidates of a step that were fitted, together.",
    )


def tests_table(found: ExplainResult) -> Table:
    """Errors over the test recordings."""
    labels = list(next(iter(found.tests.values())).rmse)
    return Table(
        ("model", "error [-]", *(f"RMSE {label}" for label in labels)),
        [
            (MODELS[name], one.error, *(one.rmse[label] for label in labels))
            for name, one in found.tests.items()
        ],
        "Free runs over the test recordings, which neither fit nor search has seen.",
    )


def terms_table(told: Explanation) -> Table:
    """A row a found term."""
    return Table(
        ("term", "equation", "what it is"),
        [(term.name, term.formula, term.explanation) for term in told.found],
        "Terms that were found.",
    )


def parameters_table(told: Explanation) -> Table:
    """A row a parameter."""
    rows = [
        (p.name, p.value, p.standard_error or None, p.unit, "at its bound" if p.at_bound else p.description)
        for p in told.parameters
    ]
    return Table(("parameter", "fitted", "standard error", "unit", ""), rows, "Fitted with the terms.")


def _trials(told: Explanation) -> list[tuple[str, Trial]]:
    numbered = [(str(n), s.trials) for n, s in enumerate(told.steps, 1) if s.action == "added"]
    every = [*numbered, ("last", told.last)]
    return [(number, trial) for number, trials in every for trial in trials if trial.outcome != "added"]


def trials_table(told: Explanation) -> Table:
    """A row a candidate that was fitted and not added."""
    rows = [
        (number, trial.name, trial.held_out.ratio if trial.held_out else None, trial.outcome, trial.reason)
        for number, trial in _trials(told)
    ]
    return Table(
        ("step", "candidate", "ratio [-]", "outcome", "why"),
        rows,
        "Candidates that were fitted and not added.",
    )


def _about_terms(told: Explanation) -> Sequence[str]:
    if not told.found:
        return ("No term surely lowers the held-out error: the prior is kept as it is.",)
    hidden = [term.name for term in told.found if state_of(term)]
    texts = [
        "A line is the fitted term. Points are what the recordings ask for there: the term and what the model with all "
        "terms leaves unexplained."
    ]
    if hidden:
        texts.append(f"Terms with a state of their own have no curve: {', '.join(hidden)}.")
    return texts


def _judged(told: Explanation) -> Sequence[str]:
    own = told.evidence
    return (
        f"Evidence: {own.text}; free runs of {own.length:.3g} s. Recordings that are alike are held out together.",
        f"The search chose from {told.candidates} candidates. In each step all are scored by one Gauss-Newton step. "
        "The best are fitted in every group, with all parameters and initial states.",
        f"A term is added if the held-out error is below {WORTH:g} of that before, and if the probability of a "
        f"{HARM - 1:.0%} larger error is below {DOUBT:g} for all fitted candidates of the step together.",
        "Errors are root mean squares over the outputs' spreads.",
    )


def _figures(told: Explanation) -> Sequence[KeyFigure]:
    removed = 100.0 * (1.0 - told.after.ratio)
    return (
        KeyFigure("Found terms", len(told.found), "", f"of {told.candidates} candidates"),
        KeyFigure("Held-out error, fitted prior", told.before, "", SPREADS),
        KeyFigure("With the terms", told.steps[-1].held_out.error if told.steps else told.before, "", SPREADS),
        KeyFigure("Removed", round(removed), "%", f"ratio {told.after.ratio:.2f}, {bound(told.after.upper)}",
                  "good" if told.found else "plain"),
    )  # fmt: skip


def _hints(found: ExplainResult) -> Sequence[Hint]:
    told, hints = found.explanation, []
    if found.file:
        hints.append(
            Hint("good", f"{found.file} is the scenario with the found terms.",
                 "Read it, then give it and your recordings to hybrid-mpc check --fit, then to hybrid-mpc run.")
        )  # fmt: skip
    else:
        hints.append(
            Hint(
                "plain",
                "No term was added.",
                "What the prior lacks may be memory: hybrid-mpc run trains networks.",
            )
        )
    for p in told.parameters:
        if p.at_bound:
            hints.append(
                Hint("bad", f"{p.name} ends at its bound ({p.value:.3g} {p.unit}).",
                     "A parameter at its bound may stand for something else that the prior lacks.")
            )  # fmt: skip
    tests = found.tests
    if "explained" in tests and tests["explained"].error > tests["fitted"].error:
        hints.append(
            Hint("bad", "On the test recordings the found terms make the error larger.",
                 "The test recordings go where the others did not: give some of them for training.")
        )  # fmt: skip
    alternatives = [(s.name, alternatives_of(s)) for s in told.steps if s.alternatives]
    hints += [
        Hint(
            "plain", f"The data do not tell {name} from: {names}.", "Choose by what you know of the machine."
        )
        for name, names in alternatives
    ]
    return hints
