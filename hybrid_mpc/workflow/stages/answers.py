"""The first screen of a run's report: is the model good, is the controller safe, is the monitor trustworthy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from hybrid_mpc.kit.promises import Promise
from hybrid_mpc.plots.style import name_of
from hybrid_mpc.report.page import Answer, Verdict
from hybrid_mpc.workflow.stages.advice import EXPLAINED
from hybrid_mpc.workflow.stages.compare import REPORTED
from hybrid_mpc.workflow.stages.results import Control, Identification, Results, Timing, Watch

SAFE = ("structure of the prior", "no offset", "step time", "stability margins", "limits")
"""Promises that must not be open if the controller is to be called safe."""
SHOWN_OUTPUTS = 3
TOUCHED = 1e-6
"""Relative overshoot of a limit that counts as rounding."""
FEW_FALLBACKS = 0.01
"""Largest share of periods with fallback inputs that raises no doubt."""


def answer_all(results: Results) -> tuple[Answer, Answer, Answer]:
    """Answers about model, controller and monitor, each from the figures of ``results.json``.

    Example:
        ``answer_all(read_results(read_object(path), str(path)))[0].short``
    """
    return model_answer(results.identification), controller_answer(results), monitor_answer(results.watch)


def model_answer(found: Identification) -> Answer:
    """Whether the recommended model predicts held-out recordings."""
    choice = found.details.choice
    name = choice.recommended
    fits = [fit for fit in _values(found.fit_percent.get(name)).values() if fit is not None]
    doubt = found.details.prior_parameters.in_doubt
    short, verdict = _model_verdict(bool(doubt), fits)
    lines = [f"Recommended: {name_of(name)}."]
    if doubt:
        lines.append(f"The structure of the prior is in doubt: {doubt[0]}.")
    labels = list(_values(found.rmse.get(name)))
    lines += [_error_line(found, name, label) for label in labels[:SHOWN_OUTPUTS]]
    if more := len(labels) - SHOWN_OUTPUTS:
        lines += [f"{more} more outputs are in section Free runs."] if more > 0 else []
    own = choice.candidates[choice.hybrid]
    if name == "phy" or own.ratio is None or own.upper is None:
        lines.append(f"{choice.reason.rstrip('.').capitalize()}.")
    else:
        lines.append(
            f"On held-out recordings, its error is {own.ratio:.2f} times that of the fitted prior "
            f"(95 % upper bound {own.upper:.2f})."
        )
    return Answer("Is the model good?", verdict, short, lines)


def _model_verdict(doubt: bool, fits: Sequence[float]) -> tuple[str, Verdict]:
    if doubt:
        return "In doubt", "bad"
    if not fits:
        return "No: a free run diverged", "bad"
    return ("Weak", "bad") if min(fits) < EXPLAINED else ("Yes", "good")


def _error_line(found: Identification, name: str, label: str) -> str:
    signal, _, unit = label.removesuffix("]").partition(" [")
    own, prior = (_values(found.rmse.get(m)).get(label) for m in (name, "phy"))
    fit = _values(found.fit_percent.get(name)).get(label)
    beside = "" if name == "phy" or prior is None else f"; the fitted prior has {prior:.3g} {unit}"
    size = "a free run diverged" if own is None else f"{own:.3g} {unit}"
    return (
        f"{signal}: free-run error {size}" + (f" (fit {fit:.0f} %)" if fit is not None else "") + f"{beside}."
    )


def controller_answer(results: Results) -> Answer:
    """Whether the loops kept limits and deadlines, and which promises of the kit are shown."""
    lines, bad = [], False
    for one, wrong in (*_loop_lines(results), *_time_lines(results.timing)):
        lines.append(one)
        bad |= wrong
    rows = results.promises.rows or ()
    lines += [
        f"Stability margins: {row.evidence}."
        for row in rows
        if row.name == "stability margins" and row.evidence
    ]
    open_ = [row for row in rows if row.verdict != "shown"]
    if rows:
        lines.append(_promise_line(rows, open_))
    doubted = [row.name for row in open_ if row.name in SAFE]
    if bad or doubted:
        return Answer(
            "Is the controller safe?", "bad", f"In doubt: {', '.join(doubted) or 'see below'}", lines
        )
    if results.control.details is None and results.on_model.details is None:
        return Answer("Is the controller safe?", "plain", "Not shown: no closed loop was simulated", lines)
    simulated = "Yes, in simulation" if results.control.details is not None else "Yes, on its own model"
    return Answer("Is the controller safe?", "good", simulated, lines)


def _promise_line(rows: Sequence[Promise], open_: Sequence[Promise]) -> str:
    if not open_:
        return f"Promises: all {len(rows)} are shown."
    names = ", ".join(f"{row.name} ({row.verdict})" for row in open_)
    return f"Promises: {len(rows) - len(open_)} of {len(rows)} are shown. Open: {names}."


def _loop_lines(results: Results) -> Iterator[tuple[str, bool]]:
    """Lines about limits and fallback inputs of the recommended model's loops, each with whether it is a problem."""
    control: Control = results.control
    if control.details is None:
        yield f"Closed loops: {control.gap_closed_reason.rstrip('.')}.", False
        return
    short = "prior" if results.identification.details.choice.recommended == "phy" else "hybrid"
    own = {
        task: cells[REPORTED[short]]
        for task, cells in control.details.tasks.items()
        if REPORTED[short] in cells
    }
    used = [(share, limit, task) for task, cell in own.items() for limit, share in cell.limits.items()]
    if used:
        share, limit, task = max(used)
        over = share > 1.0 + TOUCHED
        words = f"violated by {100 * (share - 1):.2g} %" if over else "kept"
        yield f"Limits: {words}. Most used: {limit}, {100 * share:.0f} % of its limit in {task}.", over
    fallback, task = max((1.0 - cell.sources["MPC"], task) for task, cell in own.items())
    words = f"Fallback inputs: {100 * fallback:.2g} % of the periods of {task}."
    yield words if fallback else "No fallback input was needed.", fallback > FEW_FALLBACKS


def _time_lines(timing: Timing) -> Iterator[tuple[str, bool]]:
    p99 = timing.controller_step_ms.p99
    if timing.misses is None or p99 is None:
        return
    late = f"{timing.misses} steps missed the deadline" if timing.misses else "No step missed its deadline"
    yield (
        f"{late}: 99 % of the steps take less than {p99:.3g} ms; the period is {timing.period_ms:g} ms.",
        timing.misses > 0,
    )


def monitor_answer(found: Watch) -> Answer:
    """False alarms compared with the wanted rate; number of simulated faults detected, and the largest delay."""
    question, clean, wanted = "Is the monitor trustworthy?", found.details.clean, found.wanted_per_hour
    if found.alarms is None or clean is None or wanted is None:
        return Answer(
            question, "plain", "Not examined", (f"{(found.reason or found.faults_reason).rstrip('.')}.",)
        )
    many = clean.too_many(wanted)
    lines = [f"False alarms: {clean.words(wanted)}."]
    faults = found.faults or ()
    seen = [row.delay_s for row in faults if row.delay_s is not None]
    if faults:
        slowest = f", the slowest after {max(seen):.2g} s" if seen else ""
        lines.append(f"Simulated faults: {len(seen)} of {len(faults)} detected{slowest}.")
    else:
        lines.append(f"No faults were simulated: {found.faults_reason.rstrip('.')}.")
    missed = [row.title for row in faults if row.delay_s is None]
    if missed:
        lines.append(f"Not detected: {', '.join(missed)}.")
    if many:
        return Answer(question, "bad", "No: too many false alarms", lines)
    if missed:
        return Answer(question, "bad", "In part", lines)
    if not faults:
        return Answer(question, "plain", "Not tested with faults", lines)
    return Answer(question, "good", f"Yes, on {clean.seconds:.0f} s of data", lines)


def _values(by: object) -> Mapping[str, float | None]:
    return by if isinstance(by, Mapping) else {}
