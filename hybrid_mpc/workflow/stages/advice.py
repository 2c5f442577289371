"""What to do next: hints that a run's own figures give, in words, each with a remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from hybrid_mpc.compare.sequential import hardest
from hybrid_mpc.identify.starts import POOR
from hybrid_mpc.plots.style import name_of
from hybrid_mpc.report.page import Hint
from hybrid_mpc.workflow.stages.compare import REPORTED
from hybrid_mpc.workflow.stages.promises import STRUCTURE
from hybrid_mpc.workflow.stages.results import Identification, Results

EXPLAINED = 60.0
"""FIT [%] of the fitted prior below which it lacks more than a network should have to learn."""
HELD = (0.10, 0.07)
"""By how much less and more than its share of unseen measurements a band may hold: 80 to 97 % of one for 90 %."""
FLOOR = 1.5
"""Error of a free run over the sensor's noise up to which the noise is what is left."""
SEARCH = "hybrid-mpc explain looks for missing terms (docs/explain.md)."
MOST = 4
"""Warnings of one kind that are told here; the sections have all."""


def advice(results: Results, *, explained: bool = False) -> list[Hint]:
    """Hints about a finished run, what needs the user first; where nothing does, how to go on.

    Args:
        results: The run's results.
        explained: Whether missing terms have been searched. Default: they have not, and a hint may name the command.

    Example:
        ``[hint.finding for hint in advice(read_results(read_object(path), str(path))) if hint.verdict == "bad"]``
    """
    own = results.identification
    found = [
        *_doubt(own), *_recordings(results), *_prior(own, explained), *_choice(own, explained), *_linear(own),
        *_floor(own), *_bands(own), *_promises(results), *_loops(results), *_watching(results),
    ]  # fmt: skip
    tried = results.control.details is not None
    if tried and not any(hint.verdict == "bad" for hint in found):
        found.append(
            Hint(
                "good",
                "Nothing on this page speaks against a first try on the machine.",
                "Close the loop with hm.Runner (docs/hardware.md), or export the controller as C (docs/embedded.md).",
            )
        )
    return sorted(found, key=lambda hint: hint.verdict != "bad")


def _recordings(results: Results) -> Iterator[Hint]:
    for warning in results.data.details.warnings[:MOST]:
        yield Hint(
            "bad", f"Recordings: {warning}", "Section Data shows it; record again, or say so in the DataSpec."
        )


def doubt_of(in_doubt: Sequence[str]) -> str:
    """What the terminal and the report say of doubts about the prior before all else; empty without any.

    Example:
        >>> doubt_of(["k * u in the rate of v: its sign seems wrong", "ARX has less error"])
        'The structure of the prior is in doubt: k * u in the rate of v: its sign seems wrong (and 1 more reason).'
        >>> doubt_of([])
        ''
    """
    if not in_doubt:
        return ""
    n = len(in_doubt) - 1
    more = f" (and {n} more reason{'s' * (n > 1)})" if n else ""
    return f"The structure of the prior is in doubt: {in_doubt[0]}{more}."


def _doubt(found: Identification) -> Iterator[Hint]:
    for doubt in found.details.prior_parameters.in_doubt:
        yield Hint(
            "bad", f"The structure of the prior is in doubt: {doubt}.",
            "Correct the prior first (docs/prior-wrong.md): a sign, a unit, or a state, a delay or an input that is "
            "missing. A network or an observer on top of it only hides the fault.",
        )  # fmt: skip


def _prior(found: Identification, explained: bool) -> Iterator[Hint]:
    for warning in found.details.prior_parameters.warnings[:MOST]:
        yield Hint("plain", f"Fit of the prior: {warning}", "docs/fit-trouble.md says what to do.")
    windows = min(
        (row["validation_error"] for row in found.details.prior_parameters.stages), default=math.inf
    )
    for label, fit in _by_output(found.fit_percent.get("phy")).items():
        if fit >= EXPLAINED:
            continue
        what = f"The fitted prior has a FIT of {fit:.0f} % on {label.partition(' [')[0]}"
        if windows <= POOR:
            yield Hint(
                "plain", f"{what}, but an error of only {windows:.2g} of the spread over the windows of the fit, whose "
                "initial states are free.",
                "Errors of initial states grow (docs/unstable.md), or the test data differ from the training data.",
            )  # fmt: skip
        else:
            yield Hint(
                "bad", f"{what}: it lacks much.",
                "Look at signs, units, and a term that is missing, in the sensor too; a network is for what is small."
                + ("" if explained else f" {SEARCH}"),
            )  # fmt: skip


def _choice(found: Identification, explained: bool) -> Iterator[Hint]:
    choice = found.details.choice
    own = choice.candidates[choice.hybrid]
    if choice.recommended != "phy":
        if not explained:
            yield Hint("plain", "A network was needed: the prior may lack a physical term.", SEARCH)
        return  # the page's first answer says why
    why = choice.reason
    if own.error is None or own.ratio is None:
        yield Hint(
            "plain", why, "Shorter free runs or fewer units may train; the prior alone is a model, too."
        )
    elif own.upper is None or not math.isfinite(own.upper):
        yield Hint("plain", why, "Give three recordings or more: of fewer nobody can tell what carries over.")
    elif own.ratio < 1.0:
        yield Hint("plain", why, "More recordings, in the conditions of the tasks, make the bound narrower.")
    else:
        yield Hint(
            "plain", why,
            "What the prior lacks differs from recording to recording, or is noise: look at the residuals of the free "
            "runs for a term of the prior or a curve of the sensor.",
        )  # fmt: skip


def _linear(found: Identification) -> Iterator[Hint]:
    """A simpler model that has less error on unseen data than the recommended one, unless a doubt says so already."""
    if found.details.prior_parameters.in_doubt:
        return
    chosen = found.details.choice.recommended
    own = found.error.get(chosen)
    errors = {name: b.errors.error for name, b in found.details.baselines.items() if b.errors is not None}
    name = min(errors, key=lambda n: errors[n], default="")
    if name and isinstance(own, float) and errors[name] < own:
        model = "a constant" if name == "constant" else f"the linear model {name}"
        yield Hint(
            "bad", f"On unseen data {model} has an error of {errors[name]:.3g}, {name_of(chosen)} {own:.3g}.",
            "The prior lacks something that is linear: a state (a lag, a wall, a filter), a delay, or an input that "
            "the recordings have. Look at the residuals of its free runs.",
        )  # fmt: skip


def _floor(found: Identification) -> Iterator[Hint]:
    """Outputs whose error is the sensor's own noise."""
    errors = _by_output(found.rmse.get(found.details.choice.recommended))
    if len(errors) != len(found.details.smoother.sigma):
        return
    for (label, error), noise in zip(errors.items(), found.details.smoother.sigma, strict=True):
        name, _, unit = label.partition(" [")
        if error < FLOOR * noise:
            yield Hint(
                "good", f"Free runs of {name} err by {error:.2g} {unit.rstrip(']')}, {error / noise:.1f} of the noise "
                "that the fit finds in its sensor.",
                "There is nothing left to learn: a better sensor, or harder recordings, would show more.",
            )  # fmt: skip


def _bands(found: Identification) -> Iterator[Hint]:
    name = found.details.choice.recommended
    band = found.details.bands.get(name)
    if band is None:
        return
    if band.coverage < band.share - HELD[0]:
        yield Hint(
            "bad", f"The {band.share:.0%} band of {name_of(name)} holds {band.coverage:.0%} of unseen measurements.",
            "Unseen recordings differ from those that calibrated it: train on such ones; its width is too small.",
        )  # fmt: skip
    elif band.coverage > band.share + HELD[1]:
        yield Hint(
            "plain", f"The {band.share:.0%} band holds {band.coverage:.0%} of unseen measurements: it is wide.",
            "Validation recordings were harder than the unseen ones.",
        )  # fmt: skip


def _promises(results: Results) -> Iterator[Hint]:
    """What the kit does not promise, in one hint."""
    rows = results.promises.rows or ()
    for verdict, say in (("doubted", "Doubted"), ("not promised", "Not promised")):
        names = [one.name for one in rows if one.verdict == verdict and one.name != STRUCTURE]  # said first
        if names:
            yield Hint(
                "bad" if verdict == "doubted" else "plain", f"{say} of this kit: {', '.join(names)}.",
                'The table "What this kit promises" says why, and what to do.',
            )  # fmt: skip


def _loops(results: Results) -> Iterator[Hint]:
    times, period = results.timing.controller_step_ms, results.timing.period_ms
    if times.p99 is not None and times.p99 > period:
        yield Hint(
            "bad", f"A controller step takes {times.p99:.3g} ms in 99 of 100 periods, the period is {period:g} ms.",
            "Was the computer busy? Else the solver native (compiled C), a shorter horizon or a longer dt.",
        )  # fmt: skip
    details = results.control.details
    for task, own in (details.comparisons if details is not None else {}).items():
        found = own[base := hardest(own)]
        means = {name: details.tasks[task][name].cost.mean for name in (REPORTED["hybrid"], *own)}  # type: ignore[union-attr]
        lost = means.pop(REPORTED["hybrid"]) is None and any(cost is not None for cost in means.values())
        if found.finding == "dearer" or lost:
            worse = "diverges" if lost else f"costs {found.words} times as much as {base}"
            yield Hint(
                "bad", f"In {task} hybrid_observer {worse}.",
                f"Control such tasks with {base}: hybrid-mpc control --controller {base}, and from Python the kit's "
                "observer('prior') and controller('prior').",
            )  # fmt: skip
    if not results.on_model.reason:
        yield Hint(
            "plain", "There is no plant: loops ran on a model, which shows no more than that they run.",
            "Write a plant that differs from the prior as your machine may (Scenario(plant=...)).",
        )  # fmt: skip


def _watching(results: Results) -> Iterator[Hint]:
    clean, rate = results.watch.details.clean, results.watch.wanted_per_hour
    if clean is not None and rate is not None and clean.too_many(rate):
        yield Hint(
            "bad", f"Alarms of the monitor: {clean.words(rate)}.",
            "Recordings that it learned from are too few or too unlike: look where it alarms before you act on it.",
        )  # fmt: skip


def _by_output(fit: object) -> dict[str, float]:
    """FIT by output, of those that have one."""
    if not isinstance(fit, dict):
        return {}
    return {label: float(v) for label, v in fit.items() if isinstance(v, int | float) and math.isfinite(v)}
