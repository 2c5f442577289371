"""``python -m scenarios.golf_robot.monitor_study``: how well the guard finds faults on the golf robot."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from hybrid_mpc.cli.progress import make_progress
from hybrid_mpc.errors import InputError
from scenarios.golf_robot.monitor_study.plan import monitor_study
from scenarios.golf_robot.monitor_study.run import finish, run_monitor_study

FAILED, BAD_INPUT = 1, 2

app = typer.Typer(
    help="How well the guard finds faults on the golf robot.",
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.command("run")
def run(
    model: Annotated[Path, typer.Argument(help="Artifact folder or run folder of the golf robot.")],
    out: Annotated[Path, typer.Option(help="Folder to make.")],
    budget: Annotated[str, typer.Option(help="Size: full or quick.")] = "full",
    workers: Annotated[int, typer.Option(help="Processes on this machine.", min=1)] = 2,
    resume: Annotated[bool, typer.Option("--resume", help="Finish the study that the folder holds.")] = False,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="With --resume: failed jobs again.")
    ] = False,
) -> None:
    """Learn from nominal loops, then judge loops with faults; exit code 1 if jobs have failed."""
    with make_progress() as progress:
        results = run_monitor_study(
            monitor_study(str(model), budget), out, workers=workers, resume=resume, retry_failed=retry_failed,
            progress=progress,
        )  # fmt: skip
    print((out / "table.md").read_text(encoding="utf-8"))
    print(f"report: {(out / 'report.html').resolve()}")
    if results["jobs"]["failed"]:
        print(f"{results['jobs']['failed']} jobs failed; {out / 'runs'} has their tracebacks")
        raise typer.Exit(FAILED)


@app.command("report")
def report(folder: Annotated[Path, typer.Argument(help="Folder of a study.")]) -> None:
    """Write report.html, of a study that still runs too."""
    finish(folder)
    print(f"report: {(folder / 'report.html').resolve()}")


def main() -> None:
    """Run the command; bad input ends with a message and exit code 2."""
    try:
        app()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)


if __name__ == "__main__":
    main()
