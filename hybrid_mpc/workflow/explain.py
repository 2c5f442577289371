"""``hybrid-mpc explain``: fit the prior, search for missing terms, and write a scenario with the found terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.data.trajectories import Dataset, load_trajectories
from hybrid_mpc.engine import Progress
from hybrid_mpc.errors import InputError, named_extra, no_exit
from hybrid_mpc.files import write_json, write_text
from hybrid_mpc.folder import JobNote, open_folder, versions
from hybrid_mpc.identify.explain import STEPS
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.specification import Role
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.explain_page import write_page
from hybrid_mpc.workflow.explain_search import Search, chosen_terms, prior_class
from hybrid_mpc.workflow.explained import ExplainResult, scenario_code
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stages.identify import check_source

SCHEMA, SCHEMA_VERSION = "hybrid-mpc explain", 1
RESULT = "explain.json"
NEEDED: tuple[Role, ...] = ("train", "valid")
"""Roles that the search needs; test recordings only judge its result."""


@no_exit()
@named_extra("the search")
def explain(
    settings: RunSettings,
    out: Path,
    *,
    terms: Sequence[str] = (),
    most: int = STEPS,
    progress: Progress | None = None,
) -> ExplainResult:
    """Fit the prior, search for missing physical terms, and write the result into ``out``.

    ``explain.json`` holds the result, ``explain.html`` shows it, ``NAME_explained.py`` is a scenario whose prior has
    the found terms, with the fitted values as nominal values. The same arguments continue an interrupted search;
    ``most`` may differ. Nothing is trained.

    Args:
        settings: Scenario, recordings and columns, as for a run.
        out: Folder to write.
        terms: Names of laws (:mod:`hybrid_mpc.machine.terms`) that limit the search. Default: those of the scenario's
            ``terms``, else all.
        most: Largest number of steps that add a term.
        progress: Where to report. Default: nowhere.

    Raises:
        InputError: For any bad input: no recordings, too few recordings to judge terms, an unknown law, a term that
            does not fit the prior.

    Example:
        >>> found = explain(RunSettings("my_machine.py", data=(Path("swing.csv"),)), Path("out"))  # doctest: +SKIP
        >>> [term.name for term in found.explanation.found]  # doctest: +SKIP
        ['Coulomb friction of phi_dot']
    """
    if most < 1:
        raise InputError(f"most: the search needs at least one step, got {most} [HM-WORKFLOW-018]")
    scenario = load_scenario(settings.scenario)
    chosen = chosen_terms(scenario, terms)
    context = Context(settings, scenario, out, progress or Progress())
    check_scenario(replace(scenario, plant=None, oracle=None, control=None, tasks=()))
    check_source(context)
    make = prior_class(scenario)
    # bad recordings leave no folder behind
    data = _recordings(context, make) if settings.data else None
    note = JobNote("search", {**settings.identity(), "terms": tuple(terms)}, {"most": most})
    with open_folder(out, note, resume=None):
        if data is None:
            data = _simulated(context, make)
        found = Search(context, make, data, chosen, out, most).result()
        write(context, found, out, ["explain", settings.scenario, *settings.options(str), "--out", str(out)])
        return found


def _recordings(context: Context, make: type[Prior]) -> Dataset:
    """Recordings; test recordings are optional."""
    data = load_trajectories(context.files, make(), context.spec, needed=NEEDED)
    for warning in data.warnings:
        context.progress.warn(warning)
    for note in data.notes:
        context.progress.note(note)
    return data


def _simulated(context: Context, make: type[Prior]) -> Dataset:
    """Simulated recordings; existing ones are reused."""
    scenario, folder = context.scenario, context.out / "data"
    assert scenario.make_data is not None
    done = folder / "made.json"
    if not done.is_file():
        for path in context.files:
            path.unlink()
        scenario.make_data(folder, context.settings.seed, context.settings.budget)
        write_json(done, {"seed": context.settings.seed})
    return _recordings(context, make)


def write(context: Context, found: ExplainResult, out: Path, command: Sequence[str]) -> None:
    """Write page, scenario file and, last, ``explain.json``; ``command`` is the command line that made them."""
    if found.file:
        write_text(
            out / found.file, scenario_code(context.scenario, context.scenario_path, found.explanation, out)
        )
    write_page(out, context.scenario, found, command)
    write_json(
        out / RESULT,
        {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, "versions": versions(), "result": found},
    )
