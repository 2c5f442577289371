"""Stage promises: examine the properties of the recommended loop, and write the table beside the models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hybrid_mpc.compare.loops import LoopRow
from hybrid_mpc.compare.promises import TaskEnd, Tested, examine, task_end
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.choose import CandidateFigures, Choice
from hybrid_mpc.identify.sound import CLEARLY
from hybrid_mpc.kit.promises import Promise, PromiseTable, read_promises, write_promises
from hybrid_mpc.scenario import Task
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent, Stage
from hybrid_mpc.workflow.stages.choose import CHOICE
from hybrid_mpc.workflow.stages.compare import CONTROL, what_loops_read
from hybrid_mpc.workflow.stages.estimate import ESTIMATION
from hybrid_mpc.workflow.stages.explain import EXPLAIN
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE
from hybrid_mpc.workflow.stages.identify import PRIOR, PriorResult
from hybrid_mpc.workflow.stages.on_model import LOOPS_ON_MODEL, what_on_model_reads
from hybrid_mpc.workflow.stages.track import TRACK

STRUCTURE = "structure of the prior"
"""Name of the row about the prior, which all models are based on."""
MEND = "Correct the prior first: docs/prior-wrong.md explains each reason."
"""Remedy for a prior whose structure is in doubt."""
SEARCH = "hybrid-mpc explain looks for missing terms (docs/explain.md)."
"""Remedy for a prior that may lack a term."""


def promises_stage(context: Context) -> PromiseTable | Absent:
    """Examine the recommended model's loop, and write ``promises.json`` beside the models."""
    if context.scenario.control is None and not any(task.control for task in context.scenario.tasks):
        return Absent(f"scenario {context.scenario.name} defines no control problem")
    context.read(NOISE)
    kit, tasks = context.kit, _tasks(context)
    controller = f"{kit.recommended}_observer"
    rows, where = _loops(context, controller)
    ends: dict[str, TaskEnd] = {}
    for row in rows:
        task = next((one for one in tasks if one.name == row.task), None)
        if task is not None and row.arrays and (end := task_end(kit, task, row.arrays)) is not None:
            ends.setdefault(row.task, end)
    given_way = {row.task: row.given_way for row in rows if row.given_way}
    excess: dict[str, dict[str, float]] = {}
    for row in rows:
        own = excess.setdefault(row.task, {})
        own |= {label: max(value, own.get(label, 0.0)) for label, value in row.excess.items()}
    found = examine(
        kit, tasks, ends=tuple(ends.values()), where=where, given_way=given_way, excess=excess,
        tested=_tested(context, controller, kit.models[kit.recommended].n_y),
        lacking_delay=context.prior.fit.lacking_delay,
        report=lambda done, total, text: context.progress.update("promises", done, total, text),
    )  # fmt: skip
    of_prior = structure(context.prior, context.read(CHOICE).choice, found_terms(context))
    result = PromiseTable((of_prior, *found), kit.identity)
    put_promises(context, result)
    return result


def found_terms(context: Context) -> tuple[str, ...] | None:
    """Names of the terms that a search for missing terms found, in this run or for its scenario; None without one."""
    found, scenario = context.find(EXPLAIN), context.scenario
    if not isinstance(found, Absent):
        return tuple(term.name for term in found.explanation.found)
    return tuple(term.name for term in getattr(scenario.prior, "terms", ())) if scenario.explained else None


def structure(prior: PriorResult, choice: Choice, explained: Sequence[str] | None = None) -> Promise:
    """Row of the table: whether the structure of the fitted prior is in doubt.

    Args:
        prior: The fitted prior, with the doubts about its present terms and signals.
        choice: Choice among prior and networks: a clearly lower held-out error of a network is a sign of a missing
            term.
        explained: Names of the terms that a search for missing terms found. Default: none was made.
    """
    errors = {
        "the fitted prior": prior.errors["phy"].error,
        "the nominal one": prior.errors["phy_nominal"].error,
    }
    errors |= {name: one.errors.error for name, one in prior.baselines.items() if one.errors is not None}
    figures = ", ".join(f"{name} {error:.3g}" for name, error in errors.items())
    evidence = f"free-run error on test recordings over the outputs' spread: {figures}"
    if prior.in_doubt:
        search = f" {SEARCH}" if prior.lacking and explained is None else ""
        return Promise(STRUCTURE, "doubted", f"{'; '.join(prior.in_doubt)}; {evidence}", f"{MEND}{search}")
    present = (
        "the prior's present terms and signals were tested (signs, units, factors, bounds): none is in doubt"
    )
    own = choice.candidates.get(choice.hybrid)
    gain = ""
    if own is not None and network_gains(choice, own):
        gain = f"; with {choice.hybrid}, the held-out error is {own.ratio:.2f} times that of the fitted prior"
    if explained is not None:
        terms = ", ".join(explained) or "none"
        return Promise(
            STRUCTURE, "shown", f"{present}; missing terms found by the search: {terms}{gain}; {evidence}"
        )
    if gain:
        why = f"{present}{gain}, so a physical term may be missing; {evidence}"
        return Promise(STRUCTURE, "doubted", why, SEARCH)
    return Promise(STRUCTURE, "shown", f"{present}; missing terms were not searched for; {evidence}")


def network_gains(choice: Choice, own: CandidateFigures) -> bool:
    """Whether a network's held-out error is clearly lower than that of the fitted prior, or a network is recommended
    for its lower error.
    """
    recommended = choice.recommended == choice.hybrid or choice.hybrid in choice.sure
    return math.isfinite(own.ratio) and own.ratio < (1.0 if recommended else CLEARLY)


def _tasks(context: Context) -> tuple[Task, ...]:
    """The scenario's tasks, else default tasks; empty if default tasks are impossible."""
    try:
        return tasks_of(context.ready, context.budget.tasks)
    except InputError:  # the stage on_model says so
        return ()


def _loops(context: Context, controller: str) -> tuple[list[LoopRow], str]:
    """The run's loops of a controller with their kept signals, and a text that names their plant."""
    control, on_model = context.find(CONTROL), context.find(LOOPS_ON_MODEL)
    if not isinstance(control, Absent) and control.rows:
        return [row for row in control.kept if row.controller == controller], "on the scenario's plant"
    if isinstance(on_model, Absent):
        return [], ""
    rows = [row for row in on_model.kept if row.controller == controller]
    return rows, f"on the model {on_model.plants.get(controller, '')}, not the machine"


def _tested(context: Context, controller: str, n_y: int) -> Tested | str:
    """Statistics of the observer's innovations on test recordings, or why there are none."""
    found = context.find(ESTIMATION)
    if isinstance(found, Absent):
        return found.reason
    own = found.observers[controller]
    if isinstance(own, Absent):
        return own.reason
    correlation = float(np.abs(found.arrays[f"{controller}/autocorrelation"]).max())
    return Tested(correlation, own.mean_nis / n_y, own.samples)


def put_promises(context: Context, table: PromiseTable) -> str:
    """Write the table beside the models, unless the same table is already there."""
    folder = context.out / "model"
    try:
        there = read_promises(folder) == table
    except InputError:  # damaged or of another version: write it again
        there = False
    if not there:
        write_promises(folder, table)
    return ""


def what_promises_read(context: Context) -> Mapping[str, object]:
    """Everything that the loops depend on, with a plant or with a model as plant."""
    searched = {"a search for missing terms": context.scenario.explained}
    return {**what_on_model_reads(context), **what_loops_read(context), **searched}


PROMISES = Stage(
    "promises", "examining the kit's promises", PromiseTable, promises_stage, what_promises_read,
    (EXPLAIN, PRIOR, CHOICE, EXPORT, TRACK, NOISE, CONTROL, LOOPS_ON_MODEL, ESTIMATION), optional=True,
    restore=put_promises,
)  # fmt: skip
