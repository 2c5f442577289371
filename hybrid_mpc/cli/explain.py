"""``hybrid-mpc explain``: physical terms that a prior lacks, selected on held-out recordings."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from hybrid_mpc.cli.check import make_table
from hybrid_mpc.cli.options import InputColumns, OutputColumns, Recordings, ScenarioName, TimeColumn

if TYPE_CHECKING:
    from hybrid_mpc.workflow.explained import ExplainResult

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc explain my_machine.py --data monday.csv --data tuesday.csv --out explained\n\n"
    "  hybrid-mpc explain my_machine.py --data monday.csv --terms coulomb --terms viscous --most 2\n\n"
    "  hybrid-mpc check explained/my_machine_explained.py --data monday.csv --data tuesday.csv --fit"
)


def explain(
    scenario: ScenarioName,
    data: Recordings = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to create. Default: runs/explain-SCENARIO.")
    ] = None,
    terms: Annotated[
        list[str] | None,
        typer.Option(
            help="Law to consider, e.g. coulomb; may be repeated. Default: the scenario's, else all."
        ),
    ] = None,
    most: Annotated[int, typer.Option(help="Maximum number of steps that add terms.", min=1)] = 8,
    time_column: TimeColumn = "",
    input_column: InputColumns = None,
    output_column: OutputColumns = None,
) -> None:
    """Find physical terms that the prior lacks: fit it, search a library of terms, evaluate on held-out recordings.

    Writes explain.html, explain.json and NAME_explained.py, a scenario whose prior has the found terms. No network is
    trained. Repeat the command to continue a search that was stopped, also with another --most.
    """
    from hybrid_mpc.cli.progress import make_progress, print_summary
    from hybrid_mpc.workflow.explain import explain as search
    from hybrid_mpc.workflow.explain_page import PAGE
    from hybrid_mpc.workflow.settings import RunSettings

    folder = out or Path("runs") / f"explain-{Path(scenario).stem}"
    settings = RunSettings(
        scenario, tuple(data or ()), inputs=tuple(input_column or ()), outputs=tuple(output_column or ()),
        time=time_column,
    )  # fmt: skip
    with make_progress() as progress:
        found = search(settings, folder, terms=tuple(terms or ()), most=most, progress=progress)
    console = Console(highlight=False)
    console.print()
    console.print(_steps(found))
    if found.tests:
        console.print(_tests(found))
    print_summary(summary(found, folder, settings.data), folder / PAGE, "page")


def summary(found: ExplainResult, folder: Path, data: Sequence[Path] = ()) -> list[str]:
    """The result in a few lines, with the next command for these recordings."""
    from hybrid_mpc.identify.evidence import FEWEST
    from hybrid_mpc.workflow.explain_page import FEW

    explanation = found.explanation
    lines = [f"evaluated on {explanation.evidence.text}, in free runs of {explanation.evidence.length:.3g} s"]
    if explanation.evidence.recordings < FEWEST:
        lines.append(FEW)
    if explanation.steps:
        lines.append(f"errors: all samples together; ratios: {explanation.averaged}")
    if not explanation.found:
        return [
            *lines, f"no term was added: {explanation.reason}",
            "no scenario file was written: the prior is unchanged",
        ]  # fmt: skip
    lines += [f"found: {term.name}: {term.formula}" for term in explanation.found]
    return [
        *lines,
        f"end of the search: {explanation.reason}",
        f"scenario: {(folder / found.file).resolve()}",
        "next: "
        + shlex.join(
            [
                "hybrid-mpc",
                "check",
                str(folder / found.file),
                *(v for file in data for v in ("--data", str(file))),
                "--fit",
            ]
        ),
    ]


def _steps(found: ExplainResult) -> Table:
    from hybrid_mpc.workflow.explain_page import RATIO, alternatives_of, signed, values_of

    explanation = found.explanation
    table = make_table("steps", "step", "held-out error [-]", RATIO, "fitted values", "alternatives")
    table.add_row("prior, nominal", f"{explanation.nominal:.3g}", "", "", "")
    table.add_row("prior, fitted", f"{explanation.before:.3g}", "", "", "")
    for step in explanation.steps:
        table.add_row(
            signed(step), f"{step.held_out.error:.3g}", step.words, values_of(step), alternatives_of(step)
        )  # fmt: skip
    return table


def _tests(found: ExplainResult) -> Table:
    from hybrid_mpc.workflow.explain_page import MODELS

    labels = list(next(iter(found.tests.values())).rmse)
    table = make_table(found.tests_title, "model", "error [-]", *(f"RMSE {one}" for one in labels))
    for name, one in found.tests.items():
        table.add_row(MODELS[name], f"{one.error:.3g}", *(f"{one.rmse[label]:.4g}" for label in labels))
    return table
