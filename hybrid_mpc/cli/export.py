"""``hybrid-mpc export``: a trained controller as C."""

from __future__ import annotations

import shlex
from typing import Annotated

import typer

from hybrid_mpc.cli.options import ArtifactFolder, EmptyFolder

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc export c runs/golf --out controller\n\n"
    "  hybrid-mpc export c runs/golf --task track --float --out controller\n\n"
    "  hybrid-mpc export c runs/golf --guard --check --out controller\n\n"
    "  hybrid-mpc export c runs/tanks --track --out controller"
)

app = typer.Typer(help="Write a trained controller as C.", no_args_is_help=True, rich_markup_mode=None)


@app.command("c", epilog=EXAMPLES)
def c(
    model: ArtifactFolder,
    out: EmptyFolder,
    name: Annotated[
        str, typer.Option("--model", help="Model of the controller. Default: the recommended one.")
    ] = "",
    task: Annotated[
        str, typer.Option(help="Task with the control problem. Default: the common problem.")
    ] = "",
    single: Annotated[bool, typer.Option("--float", help="Use float instead of double.")] = False,
    monitor: Annotated[
        bool, typer.Option("--monitor/--no-monitor", help="Include the fault monitor.")
    ] = True,
    guard: Annotated[
        bool, typer.Option("--guard", help="React to alarms: the safe input acts while a sensor is frozen.")
    ] = False,
    adapt: Annotated[
        bool,
        typer.Option(
            "--adapt", help="As --guard, with a second controller that adapts to the changed machine."
        ),
    ] = False,
    track: Annotated[
        bool, typer.Option("--track", help="Track the parameters that a run with --track found.")
    ] = False,
    blended: Annotated[
        bool,
        typer.Option(
            "--blended", help="As --track, and run prior and hybrid side by side with an estimated share."
        ),
    ] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Compile it and run its test; this runs code generated from the folder's content."
        ),
    ] = False,
) -> None:
    """Write estimator, real-time iteration, safeguards, monitor and guard as self-contained C11, with a test."""
    from hybrid_mpc.files import check_folder
    from hybrid_mpc.kit.artifact import load
    from hybrid_mpc.kit.export_c import generate_controller

    check_folder(out)
    reaction = "adapt" if adapt else "rest" if guard else ""
    kit = load(model)
    folder = generate_controller(
        kit.blended() if blended else kit, out, model=name, task=task, tracking=track or blended, single=single,
        monitor=monitor, guard=reaction, check=check,
    )  # fmt: skip
    again = f"not compiled or run. Next: make -C {shlex.quote(str(folder))} test"
    print(f"C in {folder.resolve()}; {'compiled and tested; README.md has the sizes' if check else again}")
