"""Hints of the report's section "What to do next": a finding from the run's figures, and its remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from hybrid_mpc.compare.sequential import hardest
from hybrid_mpc.identify.starts import POOR
from hybrid_mpc.plots.style import name_of
from hybrid_mpc.report.page import Hint
from hybrid_mpc.rules import counted, time_text
from hybrid_mpc.workflow.stage import Absent
from hybrid_mpc.workflow.stages.compare import REPORTED, closed_loops
from hybrid_mpc.workflow.stages.promises import SEARCH, STRUCTURE
from hybrid_mpc.workflow.stages.results import Results

EXPLAINED = 60.0
"""FIT [%] of the fitted prior below which a network would have to learn too much."""
HELD = (0.10, 0.07)
"""How far a band's coverage of test data may lie below and above its nominal share: 80 to 97 % for a 90 % band."""
CLEARLY = 0.9
"""Ratio of errors below which a simpler model is better than the recommended one; smaller differences are chance."""
FLOOR = 1.5
"""Ratio of free-run error to sensor noise up to which sensor noise explains the error."""
MOST = 4
"""Largest number of warnings of one kind among the hints; the report's sections list all."""


def advice(results: Results, *, explained: bool = False, declared: Sequence[float] = ()) -> list[Hint]:
    """Hints about a finished run: problems first; without a problem, the next step.

    Args:
        results: The run's results.
        explained: Whether the run has searched for missing terms. Default: False; a hint may then name the command.
        declared: Standard deviations of the sensors' errors that the scenario declares. Default: unknown.

    Example:
        ``[hint.finding for hint in advice(read_results(path)) if hint.verdict == "bad"]``
    """
    found = [
        *_doubt(results), *_recordings(results), *_prior(results, explained), *_tracked(results),
        *_choice(results, explained), *_linear(results), *_floor(results, declared), *_bands(results),
        *_promises(results), *_loops(results), *_watching(results),
    ]  # fmt: skip
    if closed_loops(results.control) is not None and not any(hint.verdict == "bad" for hint in found):
        found.append(
            Hint(
                "good",
                "No problem found: the controller is ready for a first test on the machine.",
                "Close the loop with hm.Runner (docs/hardware.md), or export the controller as C (docs/embedded.md).",
            )
        )
    return sorted(found, key=lambda hint: hint.verdict != "bad")


def _recordings(results: Results) -> Iterator[Hint]:
    for warning in results.data.warnings[:MOST]:
        yield Hint(
            "bad",
            f"Recordings: {warning}",
            "See section Data. Record again, or correct the DataSpec.",
        )


def doubt_of(in_doubt: Sequence[str]) -> str:
    """First line of terminal and report about doubts in the prior's structure; empty without a doubt.

    Example:
        >>> doubt_of(["k * u in the rate of v: its sign seems wrong", "ARX has less error"])
        'The structure of the prior is in doubt: k * u in the rate of v: its sign seems wrong (and 1 more reason).'
        >>> doubt_of([])
        ''
    """
    if not in_doubt:
        return ""
    n = len(in_doubt) - 1
    more = f" (and {counted(n, 'more reason')})" if n else ""
    return f"The structure of the prior is in doubt: {in_doubt[0]}{more}."


def _doubt(results: Results) -> Iterator[Hint]:
    for doubt in results.prior.in_doubt:
        yield Hint(
            "bad", f"The structure of the prior is in doubt: {doubt}.",
            "Correct the prior first (docs/prior-wrong.md): a wrong sign or unit, or a missing state, delay or input. "
            "A network or an observer only hides such an error.",
        )  # fmt: skip


def _prior(results: Results, explained: bool) -> Iterator[Hint]:
    fitted = results.prior.fit
    for warning in fitted.warnings[:MOST]:
        yield Hint("plain", f"Fit of the prior: {warning}", "docs/fit-trouble.md explains this warning.")
    windows = min((row["validation_error"] for row in fitted.stages), default=math.inf)
    for label, fit in results.evaluation.scores["phy"].model.fit_percent.items():
        if fit >= EXPLAINED or not math.isfinite(fit):
            continue
        what = f"The fitted prior has a FIT of {fit:.0f} % on {label.partition(' [')[0]}"
        if windows <= POOR:
            yield Hint(
                "plain", f"{what}. Over the windows of the fit, with free initial states, its error is only "
                f"{windows:.2g} of the spread.",
                "Either errors of the initial state grow (docs/unstable.md), or test and training data differ.",
            )  # fmt: skip
        else:
            yield Hint(
                "bad", f"{what}: the prior is too coarse.",
                "Check signs and units. Look for a missing term, in the sensor equation too. A network can only "
                "correct small errors." + ("" if explained else f" {SEARCH}"),
            )  # fmt: skip


def _tracked(results: Results) -> Iterator[Hint]:
    for doubt in () if isinstance(results.track, Absent) else results.track.tracking.doubts:
        yield Hint("bad", f"Tracking: {doubt}.", "Add the missing term, then run again with --track.")


def _choice(results: Results, explained: bool) -> Iterator[Hint]:
    choice = results.choice.choice
    own = choice.candidates[choice.hybrid]
    if choice.hybrid == "phy":
        return  # no network was trained
    if choice.recommended != "phy":
        if not explained:
            yield Hint("plain", "A network improves the prior, so a physical term may be missing.", SEARCH)
        return  # the page's first answer says why
    why = choice.reason
    if not (math.isfinite(own.error) and math.isfinite(own.ratio)):
        yield Hint("plain", why, "Train with shorter free runs or fewer units, or use the prior alone.")
    elif not math.isfinite(own.upper):
        yield Hint(
            "plain", why, "Give at least three recordings: a confidence interval needs several of them."
        )
    elif own.ratio < 1.0:
        yield Hint(
            "plain", why, "Record more under the conditions of the tasks: the confidence interval shrinks."
        )
    else:
        yield Hint(
            "plain", why,
            "The prior's error is noise, or the error differs between recordings. Look at the residuals of the free "
            "runs for a missing term of the prior or a nonlinear sensor.",
        )  # fmt: skip


def _linear(results: Results) -> Iterator[Hint]:
    """A linear or constant model with less test error than the recommended model, unless a doubt names it already."""
    if results.prior.in_doubt:
        return
    chosen = results.choice.choice.recommended
    own = results.evaluation.scores[chosen].model.error
    errors = {name: b.errors.error for name, b in results.prior.baselines.items() if b.errors is not None}
    name = min(errors, key=lambda n: errors[n], default="")
    if name and math.isfinite(own) and errors[name] < CLEARLY * own:
        model = "a constant" if name == "constant" else f"the linear model {name}"
        yield Hint(
            "bad", f"On test data {model} has an error of {errors[name]:.3g}, {name_of(chosen)} {own:.3g}.",
            "The prior lacks a linear effect: a state (lag, wall, filter), a delay, or a recorded input. "
            "Look at the residuals of its free runs.",
        )  # fmt: skip


def _floor(results: Results, declared: Sequence[float]) -> Iterator[Hint]:
    """Outputs whose free-run error is about the sensor noise: the smaller one of the declared and the estimated."""
    errors = results.evaluation.scores[results.choice.choice.recommended].model.rmse
    estimated = results.prior.fit.sigma
    given = declared if len(declared) == len(estimated) else estimated
    for (label, error), noise, own in zip(errors.items(), estimated, given, strict=True):
        name, _, unit = label.partition(" [")
        if not error < FLOOR * noise:
            continue
        said = f"The free-run error of {name} is {error:.2g} {unit.rstrip(']')}: {error / noise:.1f} times its sensor "
        if error < FLOOR * min(noise, own):
            yield Hint(
                "good", f"{said}noise as estimated by the fit.",
                f"With these recordings, no better model of {name} is possible. Use a better sensor, or excite the "
                "machine more.",
            )  # fmt: skip
        else:
            yield Hint(
                "plain", f"{said}noise as estimated by the fit, but {error / own:.1f} times the declared noise "
                f"({own:.2g}).",
                "Look at the sensor at rest: either sensor_sigma is too small, or the prior lacks an effect that the "
                "fit counts as noise.",
            )  # fmt: skip


def _bands(results: Results) -> Iterator[Hint]:
    name = results.choice.choice.recommended
    band = results.evaluation.bands.get(name)
    if band is None:
        return
    if band.coverage < band.share - HELD[0]:
        yield Hint(
            "bad", (
                f"The {band.share:.0%} band of {name_of(name)} contains {band.coverage:.0%} of the test data: the band "
                "is too narrow."
            ),
            "Test recordings differ from those that calibrated the band. Add such recordings to the training.",
        )  # fmt: skip
    elif band.coverage > band.share + HELD[1]:
        yield Hint(
            "plain", f"The {band.share:.0%} band contains {band.coverage:.0%} of the test data: the band is wide.",
            "Validation recordings were harder to predict than the test recordings.",
        )  # fmt: skip


def _promises(results: Results) -> Iterator[Hint]:
    """Promises that the kit does not give, one hint for each verdict."""
    rows = () if isinstance(results.promises, Absent) else results.promises.rows
    for verdict, say in (("doubted", "Doubted"), ("not promised", "Not promised")):
        names = [one.name for one in rows if one.verdict == verdict and one.name != STRUCTURE]  # said first
        if names:
            yield Hint(
                "bad" if verdict == "doubted" else "plain", f"{say} by this kit: {', '.join(names)}.",
                'Read evidence and remedy in the table "What this kit promises".',
            )  # fmt: skip


def _loops(results: Results) -> Iterator[Hint]:
    ms = None if isinstance(results.control, Absent) else results.control.step_ms
    if ms is not None and ms.p99 > ms.period:
        yield Hint(
            "bad", f"Controller step time: the 99th percentile is {time_text(ms.p99)} of wall time, but the "
            f"period is {time_text(ms.period)}.",
            "Measure again on an idle computer. If the step is still too slow, use the solver native (compiled C), a "
            "shorter horizon or a longer dt.",
        )  # fmt: skip
    control = closed_loops(results.control)
    for task, own in control.comparisons.items() if control is not None else ():
        found = own[base := hardest(own)]
        means = {name: control.means[task][name].cost.mean for name in (REPORTED["hybrid"], *own)}  # type: ignore[union-attr]
        lost = means.pop(REPORTED["hybrid"]) is None and any(cost is not None for cost in means.values())
        if found.finding == "more expensive" or lost:
            worse = "diverges" if lost else f"has {found.words} times the cost of {base}"
            yield Hint(
                "bad", f"In {task} hybrid_observer {worse}.",
                f"Control such tasks with {base}: hybrid-mpc control --controller {base}; in Python with "
                "kit.observer('prior') and kit.controller('prior').",
            )  # fmt: skip
    if not isinstance(results.on_model, Absent):
        yield Hint(
            "plain", "The scenario has no plant: its closed loops ran on a model and show nothing about the machine.",
            "Write a plant that differs from the prior as the machine may differ (Scenario(plant=...)).",
        )  # fmt: skip


def _watching(results: Results) -> Iterator[Hint]:
    found = results.watch
    if isinstance(found, Absent) or found.limits is None or found.clean is None:
        return
    clean, rate = found.clean, found.limits.false_alarms_per_hour
    if clean.too_many(rate):
        yield Hint(
            "bad", f"The monitor has too many false alarms: {clean.words(rate)}.",
            "The limits were learned from too few or too different recordings. Look at the alarms, then record more "
            "nominal data.",
        )  # fmt: skip
