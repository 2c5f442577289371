"""Stage explain: search for missing terms of the prior; later stages use the prior with the found terms."""

from __future__ import annotations

from pathlib import Path

from hybrid_mpc.files import write_text
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.machine.terms import extended
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.explain_search import Search, chosen_terms, prior_class
from hybrid_mpc.workflow.explained import ExplainResult, scenario_code
from hybrid_mpc.workflow.stage import Absent, Stage
from hybrid_mpc.workflow.stages.identify import DATA, what_prior_reads
from nn_export.program import to_json

FOLDER = "explain"
"""Folder of the search within the run's."""


def what_explain_reads(context: Context) -> dict[str, object]:
    """Whether the search is requested; then the user's prior and the candidate terms."""
    if not context.settings.explain:
        return {"asked for": False}
    own = context.as_given
    chosen = chosen_terms(own.scenario)
    programs = prior_programs(extended(prior_class(own.scenario), *chosen.own)(), own.spec.dt)
    return {
        "asked for": True,
        **what_prior_reads(own),
        "laws": chosen.laws,
        "own terms": {name: to_json(program) for name, program in programs.items()},
    }


def explain_stage(context: Context) -> ExplainResult | Absent:
    """Search for the terms that the user's prior lacks, and write the scenario with them.

    Raises:
        InputError: If there are too few recordings to judge terms, or an own term does not fit the prior.
    """
    if not context.settings.explain:
        return Absent("--explain was not given")
    own, out = context.as_given, context.out / FOLDER
    found = Search(own, prior_class(own.scenario), own.dataset, chosen_terms(own.scenario), out).result()
    if found.file:
        write_text(out / found.file, scenario_code(own.scenario, own.scenario_path, found.explanation, out))
    return found


def scenario_is_there(context: Context, found: ExplainResult) -> str:
    """Why the stage must run again: its scenario file is missing; empty otherwise."""
    path: Path = context.out / FOLDER / found.file
    return (
        "" if not found.file or path.is_file() else f"{path}, the scenario with the found terms, is missing"
    )


EXPLAIN = Stage(
    "explain", "searching for missing terms", ExplainResult, explain_stage, what_explain_reads, (DATA,), optional=True,
    restore=scenario_is_there,
)  # fmt: skip
