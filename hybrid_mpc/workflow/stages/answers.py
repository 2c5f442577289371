"""The first screen of a run's report: is the model good, is the controller safe, is the monitor trustworthy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from hybrid_mpc.compare.promises import LATE_INPUTS
from hybrid_mpc.kit.promises import Promise
from hybrid_mpc.plots.style import name_of
from hybrid_mpc.report.page import Answer, Verdict
from hybrid_mpc.rules import counted, time_text
from hybrid_mpc.workflow.stage import Absent
from hybrid_mpc.workflow.stages.advice import EXPLAINED
from hybrid_mpc.workflow.stages.compare import REPORTED, ControlResult, closed_loops
from hybrid_mpc.workflow.stages.promises import STRUCTURE
from hybrid_mpc.workflow.stages.results import Results
from hybrid_mpc.workflow.stages.watch import WatchResult

SAFE = (STRUCTURE, "no offset", "step time", "stability margins", "limits")
"""Promises that must not be open if the controller is to be called safe."""
SHOWN_OUTPUTS = 3


def answer_all(results: Results) -> tuple[Answer, Answer, Answer]:
    """Answers about model, controller and monitor, each from the figures of ``results.json``.

    Example:
        ``answer_all(read_results(Path("runs/mine/results.json")))[0].short``
    """
    return model_answer(results), controller_answer(results), monitor_answer(results.watch)


def model_answer(results: Results) -> Answer:
    """Whether the recommended model predicts held-out recordings."""
    choice, doubt = results.choice.choice, results.prior.in_doubt
    name = choice.recommended
    own = results.evaluation.scores[name].model
    short, verdict = _model_verdict(bool(doubt), list(own.fit_percent.values()))
    lines = [f"Recommended: {name_of(name)}."]
    if doubt:
        lines.append(f"The structure of the prior is in doubt: {doubt[0]}.")
    labels = list(own.rmse)
    lines += [_error_line(results, name, label) for label in labels[:SHOWN_OUTPUTS]]
    if more := len(labels) - SHOWN_OUTPUTS:
        lines += (
            [f"{counted(more, 'more output is', 'more outputs are')} in section Free runs."]
            if more > 0
            else []
        )
    hybrid = choice.candidates[choice.hybrid]
    if name == "phy" or not (math.isfinite(hybrid.ratio) and math.isfinite(hybrid.upper)):
        lines.append(f"{choice.reason.rstrip('.').capitalize()}.")
    else:
        lines.append(
            f"On held-out recordings, its error is {hybrid.ratio:.2f} times that of the fitted prior "
            f"({100 * choice.confidence:g} % upper bound {hybrid.upper:.2f})."
        )
    return Answer("Is the model good?", verdict, short, lines)


def _model_verdict(doubt: bool, fits: Sequence[float]) -> tuple[str, Verdict]:
    if doubt:
        return "In doubt", "bad"
    if not fits or not all(map(math.isfinite, fits)):
        return "No: a free run diverged", "bad"
    return ("Weak", "bad") if min(fits) < EXPLAINED else ("Yes", "good")


def _error_line(results: Results, name: str, label: str) -> str:
    signal, _, unit = label.removesuffix("]").partition(" [")
    own, prior = (results.evaluation.scores[m].model for m in (name, "phy"))
    text = f"{signal}: "
    if math.isfinite(own.rmse[label]):
        text += f"free-run error {own.rmse[label]:.3g} {unit}"
        text += f" (fit {own.fit_percent[label]:.0f} %)" if label in own.fit_percent else ""
    else:
        text += "a free run diverged"
    if name != "phy" and math.isfinite(prior.rmse[label]):
        text += f"; the fitted prior has {prior.rmse[label]:.3g} {unit}"
    return f"{text}."


def controller_answer(results: Results) -> Answer:
    """Whether the loops kept limits and deadlines, and which promises of the kit are shown."""
    lines, bad = [], False
    for one, wrong in (*_loop_lines(results), *_time_lines(results.control)):
        lines.append(one)
        bad |= wrong
    rows = () if isinstance(results.promises, Absent) else results.promises.rows
    for name, title in (
        ("step time", "Step time under constant loads"),
        ("stability margins", "Stability margins"),
    ):
        lines += [f"{title}: {row.evidence}." for row in rows if row.name == name and row.evidence]
    open_ = [row for row in rows if row.verdict != "shown"]
    if rows:
        lines.append(_promise_line(rows, open_))
    # a term that may be missing, which the recommended network corrects, is no doubt about the loops that were tested
    safe = set(SAFE) if results.prior.in_doubt else set(SAFE) - {STRUCTURE}
    safe |= {LATE_INPUTS} if results.prior.fit.lacking_delay else set()
    doubted = [row.name for row in open_ if row.name in safe]
    if bad or doubted:
        return Answer(
            "Is the controller safe?", "bad", f"In doubt: {', '.join(doubted) or 'see below'}", lines
        )
    if closed_loops(results.control) is not None:
        return Answer("Is the controller safe?", "good", "Yes, in simulation", lines)
    none = isinstance(results.on_model, Absent)
    tested = "no closed loop was simulated" if none else "its loops ran on a model, without a plant"
    return Answer("Is the controller safe?", "plain", f"Not shown: {tested}", lines)


def _promise_line(rows: Sequence[Promise], open_: Sequence[Promise]) -> str:
    if not open_:
        return f"Promises: all {len(rows)} are shown."
    names = ", ".join(f"{row.name} ({row.verdict})" for row in open_)
    return f"Promises: {len(rows) - len(open_)} of {len(rows)} are shown. Open: {names}."


def _loop_lines(results: Results) -> Iterator[tuple[str, bool]]:
    """Lines about limits and fallback inputs of the recommended model's loops, each with whether it is a problem."""
    control = closed_loops(results.control)
    if control is None:
        yield f"Closed loops: {results.control.reason.rstrip('.')}.", False
        return
    name = REPORTED["prior" if results.choice.choice.recommended == "phy" else "hybrid"]
    own = {task: cells[name] for task, cells in control.means.items() if name in cells}
    used = [(share, limit, task) for task, cell in own.items() for limit, share in cell.limits.items()]
    if used:
        share, limit, task = max(used)
        # relative overshoot of a limit that counts as rounding
        over = share > 1.0 + 1e-6
        words = f"violated by {100 * (share - 1):.2g} %" if over else "kept"
        yield f"Limits: {words}. Most used: {limit}, {100 * share:.0f} % of its limit in {task}.", over
    fallback, task = max((1.0 - cell.sources["MPC"], task) for task, cell in own.items())
    words = f"Fallback inputs: {100 * fallback:.2g} % of the periods of {task}."
    # largest share of periods with fallback inputs that raises no doubt
    yield words if fallback else "No fallback input was needed.", fallback > 0.01


def _time_lines(found: ControlResult | Absent) -> Iterator[tuple[str, bool]]:
    if isinstance(found, Absent):
        return
    ms = found.step_ms
    where = "of the tasks' loops" if found.rows else "on recordings"
    late = f"{counted(ms.misses, 'step')} missed the deadline" if ms.misses else "No step missed its deadline"
    yield (
        f"{late}: 99 % of the steps {where} take less than {time_text(ms.p99)} of wall time; the period is "
        f"{time_text(ms.period)}.",
        ms.misses > 0,
    )


def monitor_answer(found: WatchResult | Absent) -> Answer:
    """False alarms compared with the wanted rate; number of simulated faults detected, and the largest delay."""
    question = "Is the monitor trustworthy?"
    if isinstance(found, Absent) or found.limits is None or found.clean is None:
        return Answer(question, "plain", "Not examined", (f"{found.reason.rstrip('.')}.",))
    clean, wanted = found.clean, found.limits.false_alarms_per_hour
    many = clean.too_many(wanted)
    lines = [f"False alarms: {clean.words(wanted)}."]
    if not found.limits.rated:
        words = found.limits.words
        lines = [f"False alarms: {clean.alarms} in {clean.seconds:.0f} s of undisturbed data; {words}."]
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
