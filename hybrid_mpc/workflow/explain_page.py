"""The page of ``hybrid-mpc explain``: steps, terms over their data, rejected candidates, and the criteria."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from hybrid_mpc.identify.evidence import ADDED, DOUBT, FEWEST, GAIN, POOR
from hybrid_mpc.identify.explanation import ExplainStep, Explanation, Trial
from hybrid_mpc.identify.term_fits import WORTH
from hybrid_mpc.plots import explain as plots
from hybrid_mpc.plots.style import save
from hybrid_mpc.report.page import Hint, KeyFigure, Report, Section, Table, write_report
from hybrid_mpc.scenario import Scenario
from hybrid_mpc.workflow.explained import ExplainResult, state_of

PAGE = "explain.html"
RATIO = "ratio to the previous step"
"""Heading of the ratios of errors, on the page and in the terminal."""
FEW = (
    f"There are fewer than {FEWEST} recordings: a term must reduce the error by more than {1 - GAIN:.0%}, and products "
    "and couplings are no candidates."
)
"""Rule for few recordings."""
SPREADS = "over the outputs' spreads"
MODELS = {"nominal": "prior, nominal", "fitted": "prior, fitted", "explained": "prior with the found terms"}


def write_page(out: Path, scenario: Scenario, found: ExplainResult, command: Sequence[str]) -> Path:
    """Write figures and the page; its path."""
    explanation = found.explanation
    bars = plots.error_steps(*bars_of(explanation), f"held-out error, {SPREADS} [-]", found.floor)
    steps = save(bars, out / "figures" / "error_by_step.png")
    drawn = []
    for number, step in enumerate(explanation.steps, 1):
        for k, picture in enumerate(step.pictures, 1):
            path = save(plots.term_over_data(**vars(picture)), out / "figures" / f"step_{number}_{k}.png")
            drawn.append((path, f"Step {number}: {picture.ordinate.partition(' [')[0]} over its data."))
    sections = [
        Section(
            "Error by step",
            (
                "Each bar is the free-run error on held-out recordings, over all samples. The pale part is the "
                "reduction by the step. The dashed line is the sensor noise.",
                f"The ratio to the previous step is a different statistic: the {explanation.averaged}.",
            ),
            ((steps, "Held-out error of the nominal prior, of the fitted prior, and after each step."),),
            (steps_table(explanation), *([tests_table(found)] if found.tests else [])),
        ),
        Section(
            "Found terms",
            _about_terms(explanation),
            drawn,
            (terms_table(explanation),) if explanation.found else (),
        ),
        Section("All parameters", (), (), (parameters_table(explanation),)),
        Section(
            "Rejected candidates",
            (f"End of the search: {explanation.reason}.",),
            (),
            (trials_table(explanation),) if _trials(explanation) else (),
        ),
        Section("Criteria", _judged(explanation)),
    ]
    report = Report(
        f"Missing terms: {scenario.name}", scenario.title, scenario.description,
        shlex.join(["hybrid-mpc", *command]), _figures(explanation), sections, hints=_hints(found),
    )  # fmt: skip
    return write_report(out / PAGE, report)


def bars_of(explanation: Explanation) -> tuple[list[str], list[float]]:
    """Labels and held-out errors of the nominal and the fitted prior, and after each step.

    Example:
        ``plots.error_steps(*bars_of(explanation), "held-out error [-]")``
    """
    labels, errors = ["prior, nominal", "prior, fitted"], [explanation.nominal, explanation.before]
    for step in explanation.steps:
        labels.append(signed(step))
        errors.append(step.held_out.error)
    return labels, errors


def signed(step: ExplainStep) -> str:
    """Name of a step's term with its sign: + added, − removed."""
    return f"{'+' if step.action == 'added' else '−'} {step.name}"


def values_of(step: ExplainStep) -> str:
    """Fitted values of a step's parameters with their standard errors."""
    return ", ".join(str(p).replace("+-", "±").removesuffix(" -") for p in step.parameters)


def alternatives_of(step: ExplainStep) -> str:
    """Names of the terms that the data cannot distinguish from the added term."""
    return ", ".join(trial.name for trial in step.alternatives) or "none"


def steps_table(explanation: Explanation) -> Table:
    """A row a step."""
    rows = [
        (signed(s), s.held_out.error, s.words, values_of(s), alternatives_of(s))
        for s in explanation.steps
    ]  # fmt: skip
    return Table(
        ("step", "held-out error [-]", RATIO, "fitted values", "alternatives"),
        [
            ("prior, nominal", explanation.nominal, None, "", ""),
            ("prior, fitted", explanation.before, None, "", ""),
            *rows,
        ],
        f"Steps of the search, evaluated on {explanation.evidence.text}. Errors are over all samples. Ratios: "
        f"{explanation.averaged}, with an interval for all fitted candidates of a step together."
        + (f" {FEW}" if explanation.evidence.recordings < FEWEST else ""),
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
        f"{found.tests_title.capitalize()}, which are used neither in the fit nor in the search.",
    )


def terms_table(explanation: Explanation) -> Table:
    """A row a found term."""
    return Table(
        ("term", "equation", "meaning"),
        [(term.name, term.formula, term.explanation) for term in explanation.found],
        "Found terms.",
    )


def parameters_table(explanation: Explanation) -> Table:
    """A row a parameter."""
    rows = [
        (p.name, p.value, p.standard_error or None, p.unit, "at its bound" if p.at_bound else p.description)
        for p in explanation.parameters
    ]
    return Table(
        ("parameter", "fitted", "standard error", "unit", ""), rows, "Parameters fitted with the terms."
    )


def _trials(explanation: Explanation) -> list[tuple[str, Trial]]:
    numbered = [(str(n), s.trials) for n, s in enumerate(explanation.steps, 1) if s.action == "added"]
    every = [*numbered, ("last", explanation.last)]
    return [(number, trial) for number, trials in every for trial in trials if trial.outcome != "added"]


def trials_table(explanation: Explanation) -> Table:
    """A row a candidate that was fitted and not added."""
    rows = [
        (
            number,
            trial.name,
            trial.held_out.ratio if trial.held_out else None,
            trial.outcome_words,
            trial.reason,
        )
        for number, trial in _trials(explanation)
    ]
    return Table(
        ("step", "candidate", "ratio [-]", "outcome", "why"),
        rows,
        "Candidates that were fitted and not added.",
    )


def _about_terms(explanation: Explanation) -> Sequence[str]:
    if not explanation.found:
        return ("No term reduces the held-out error significantly: the prior is unchanged.",)
    hidden = [term.name for term in explanation.found if state_of(term)]
    texts = [
        "The line is the fitted term. The points are the term plus the residual of the model with all terms, sample by "
        "sample; terms of inputs and sensors have no points."
    ]
    if hidden:
        texts.append(f"Terms with a state of their own have no curve: {', '.join(hidden)}.")
    return texts


def _judged(explanation: Explanation) -> Sequence[str]:
    own = explanation.evidence
    return (
        f"The search is evaluated on {own.text}, in free runs of {own.length:.3g} s, and in short ones of "
        f"{own.short:.2g} s. Similar recordings are held out together.",
        f"The search chose from {explanation.candidates} candidates. Each step scores all candidates by one "
        "Gauss-Newton step. The best candidates are fitted in every fold, with all parameters and initial states.",
        f"A term is added if its ratio to the previous step is below {ADDED:g} and the upper bound of its interval is "
        f"below 1. The ratio is the {explanation.averaged}. The true ratio exceeds one bound of the interval with a "
        f"probability of {DOUBT:.0%}, for all fitted candidates of the step together. For the upper bound, a "
        f"reduction by more than {1 - GAIN:.0%} counts as {1 - GAIN:.0%}.",
        f"If the runs do not suffice, but their ratio is below {WORTH:g}, short runs may show the same. Of candidates "
        f"whose errors differ by less than a factor of {1 / ADDED:.2f}, the one with the fewest parameters is added.",
        "A term is not added if its parameters are not identifiable or end at a bound, or if the error with the term "
        f"stays above {POOR:g} and the ratio above {GAIN:g}.",
        *([FEW] if own.recordings < FEWEST else []),
        "Errors are root mean squares over all held-out samples, divided by the outputs' spreads.",
    )


def _figures(explanation: Explanation) -> Sequence[KeyFigure]:
    error = explanation.steps[-1].held_out.error if explanation.steps else explanation.before
    return (
        KeyFigure("Found terms", len(explanation.found), "", f"of {explanation.candidates} candidates"),
        KeyFigure("Held-out error, fitted prior", explanation.before, "", SPREADS),
        KeyFigure("With the terms", error, "", SPREADS),
        KeyFigure("Ratio with to without the terms", round(explanation.after.ratio, 2), "", explanation.averaged,
                  "good" if explanation.found else "plain"),
    )  # fmt: skip


def _hints(found: ExplainResult) -> Sequence[Hint]:
    explanation, hints = found.explanation, []
    if found.file:
        hints.append(
            Hint("good", f"{found.file} is the scenario with the found terms.",
                 "Review the file. Then use it with your recordings in hybrid-mpc check --fit and hybrid-mpc run.")
        )  # fmt: skip
    else:
        hints.append(
            Hint(
                "plain",
                "No term was added, so no scenario file was written.",
                "The prior may lack dynamics that no library term describes: hybrid-mpc run trains networks.",
            )
        )
    for p in explanation.parameters:
        if p.at_bound:
            hints.append(
                Hint("bad", f"{p.name} ends at its bound ({p.value:.3g} {p.unit}).",
                     "Such a parameter may compensate another missing term. Check the bound and the prior.")
            )  # fmt: skip
    tests = found.tests
    if "explained" in tests and tests["explained"].error > tests["fitted"].error:
        hints.append(
            Hint("bad", "On the test recordings, the found terms increase the error.",
                 "The test recordings cover conditions that the training recordings lack: use some of the test "
                 "recordings for training.")
        )  # fmt: skip
    alternatives = [(s.name, alternatives_of(s)) for s in explanation.steps if s.alternatives]
    hints += [
        Hint(
            "plain",
            f"The data cannot distinguish {name} from: {names}.",
            "Choose by your knowledge of the machine.",
        )
        for name, names in alternatives
    ]
    return hints
