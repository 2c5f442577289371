"""``hybrid-mpc study``: many closed loops from one configuration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.cli.options import Scheduler
from hybrid_mpc.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from hybrid_mpc.compare.study import Study
    from hybrid_mpc.compare.study_results import StudyResults
    from hybrid_mpc.compare.study_run import Plan

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc study list\n\n"
    "  hybrid-mpc study run plant_variation --model runs/golf/model --out studies/variation --dry-run\n\n"
    "  hybrid-mpc study run mine.yaml --workers 2 --out studies/mine\n\n"
    "  hybrid-mpc study run horizon_size --model z16=runs/small --model z32=runs/golf --out studies/size\n\n"
    "  hybrid-mpc study run mine.yaml --scheduler tcp://10.0.0.7:8786 --out studies/mine --resume"
)
FAILED = 1
"""Exit code if runs have failed."""

app = typer.Typer(
    help="Run, report and compare many closed loops from one configuration.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@app.command("run", epilog=EXAMPLES)
def run(
    study: Annotated[
        str, typer.Argument(metavar="CONFIG", help="A YAML file, or the name of a built-in study.")
    ],
    out: Annotated[Path, typer.Option(help="Folder to create.")],
    model: Annotated[
        list[str] | None,
        typer.Option(
            help="Artifact or run folder, or LABEL=FOLDER for several; overrides the file's models."
        ),
    ] = None,
    scenario: Annotated[
        str,
        typer.Option(
            help="Machine of a YAML file: a registered name or a .py file; overrides the file's scenario."
        ),
    ] = "",
    workers: Annotated[int, typer.Option(help="Processes on this machine.", min=1)] = 2,
    scheduler: Scheduler = None,
    resume: Annotated[bool, typer.Option("--resume", help="Finish the study in the folder.")] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="With --resume: repeat failed runs.")
    ] = False,
    dry: Annotated[
        bool, typer.Option("--dry-run", help="Print the number of runs and the expected time.")
    ] = False,
) -> None:
    """Run a study; exit code 1 if runs have failed."""
    from hybrid_mpc.cli.progress import make_progress
    from hybrid_mpc.compare.study_run import dry_run, run_study

    wanted = _study(study, _models(model), scenario)
    if dry:
        with make_progress() as progress:
            progress.start("timing a few periods of each kind of run")
            plan = dry_run(wanted, workers=workers)
            progress.finish("")
        print("\n".join(_plan(plan, workers)))
        return
    with make_progress() as progress:
        results = run_study(
            wanted, out, workers=workers, cluster=scheduler, resume=resume, retry_failed=retry_failed,
            progress=progress,
        )  # fmt: skip
    _tell(results)
    if len(results.failed):
        raise typer.Exit(FAILED)


@app.command("report")
def report(folder: Annotated[Path, typer.Argument(help="Folder of a study.")]) -> None:
    """Write report.html, also for a study in progress."""
    from hybrid_mpc.compare.study_results import StudyResults, write_study_report

    print(f"report: {write_study_report(StudyResults.load(folder)).resolve()}")


@app.command("compare")
def compare(
    first: Annotated[Path, typer.Argument(help="Folder of a study.")],
    second: Annotated[Path, typer.Argument(help="Folder of another study.")],
    value: Annotated[str, typer.Option(help="Quantity to compare.")] = "cost",
) -> None:
    """Compare two studies run by run, on common draws and seeds."""
    from hybrid_mpc.compare.study_results import StudyResults

    found = StudyResults.load(first).compare(StudyResults.load(second), value)
    for column, (one, two) in found.attrs["differs"].items():
        print(f"{column}: {one} against {two}")
    print(f"{value} of {second} minus that of {first}:")
    print(_text(found))


@app.command("list")
def list_studies() -> None:
    """List the built-in studies."""
    from hybrid_mpc.compare.study import built_in_studies, built_in_study

    for name, path in built_in_studies().items():
        title = path.read_text().partition("\n")[0].removeprefix("# ")
        print(f"{name:16} {built_in_study(name, 'model').size:6} runs with one model: {title}")


def _study(name: str, models: dict[str, str], scenario: str) -> Study:
    from hybrid_mpc.compare.study import built_in_studies, built_in_study, read_study

    there = built_in_studies()
    if name in there:
        if scenario:
            raise InputError(f"study {name} has its own scenario. Leave out --scenario. [HM-CLI-005]")
        if not models:
            raise InputError(
                f"study {name} needs a model. Give --model FOLDER, e.g. model/ of a finished run. [HM-CLI-006]"
            )
        return built_in_study(name, models)
    if not Path(name).is_file() and Path(name).suffix not in (".yaml", ".yml"):
        raise InputError(
            f"no study {name!r}; built-in studies are {', '.join(there)}. Or give the path of a .yaml file."
            " [HM-CLI-007]"
        )
    return read_study(
        name, **({"models": models} if models else {}), **({"scenario": scenario} if scenario else {})
    )


def _models(given: list[str] | None) -> dict[str, str]:
    models: dict[str, str] = {}
    for text in given or ():
        label, equals, folder = text.partition("=")
        if not equals:
            label, folder = "model", text
        if label in models:
            raise InputError(
                f"--model {text}: two models are called {label!r}. Give labels: --model LABEL=FOLDER. [HM-CLI-008]"
            )
        models[label] = folder
    return models


def _plan(plan: Plan, workers: int) -> list[str]:
    from hybrid_mpc.compare.study_results import duration_text

    axes = " x ".join(f"{n} {name}" for name, n in plan.axes.items() if n > 1) or "a single one"
    lines = [f"{plan.runs} runs: {axes}"]
    for kind, seconds in plan.kinds.items():
        own = "" if kind.horizon is None else f", horizon {kind.horizon}"
        lines.append(f"  {kind.model}, {kind.controller}, {kind.solver}{own}: {seconds:.2f} s per run")
    return [*lines, f"expected time: {duration_text(plan.seconds)} in {workers} processes"]


def _tell(results: StudyResults) -> None:
    from hybrid_mpc.cli.progress import say

    failed = results.failed
    if len(failed) < len(results.table):
        print(_text(results.summary()))
    for _, row in failed.head(3).iterrows():
        print(
            f"failed: {row['model']}, {row['task']}, {row['controller']}, draw {row['draw']}, seed {row['seed']}:"
        )
        say(row["error"].rstrip())
    if len(failed):
        print(f"{len(failed)} of {len(results.table)} runs failed; the column 'error' has their tracebacks")
    print(f"results: {(results.folder / 'results.parquet').resolve()}")


def _text(table: pd.DataFrame) -> str:
    return str(table.to_string(index=False, float_format=lambda v: f"{v:.4g}"))
