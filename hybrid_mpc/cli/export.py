"""``hybrid-mpc export``: a trained controller for other machines, a kit of the former format in the present one."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from hybrid_mpc.cli.options import ArtifactFolder, EmptyFolder

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc export c runs/golf --out controller\n\n"
    "  hybrid-mpc export c runs/golf --task track --float --out controller\n\n"
    "  hybrid-mpc export c runs/golf --guard --check --out controller"
)

app = typer.Typer(
    help="Write a trained controller for other machines, or an old kit in the present format.",
    no_args_is_help=True, rich_markup_mode=None,
)  # fmt: skip


@app.command("kit", epilog="Example:\n\n  hybrid-mpc export kit runs/old --out kit")
def kit(
    old: Annotated[
        Path, typer.Argument(help="Kit of the former format (model.json), or the folder of its run.")
    ],
    out: EmptyFolder,
) -> None:
    """Write a kit of the former format in the present one, into a new folder; nothing is computed again."""
    from hybrid_mpc.kit.migrate import migrate_kit

    folder = migrate_kit(old, out)
    print(f"kit in {folder.resolve()}. Load it with hm.load, or name the folder in place of the old one.")


@app.command("c", epilog=EXAMPLES)
def c(
    model: ArtifactFolder,
    out: EmptyFolder,
    name: Annotated[
        str, typer.Option("--model", help="Model that plans. Default: the recommended one.")
    ] = "",
    task: Annotated[str, typer.Option(help="Whose control problem. Default: the common one.")] = "",
    single: Annotated[bool, typer.Option("--float", help="Numbers are float instead of double.")] = False,
    monitor: Annotated[bool, typer.Option("--monitor/--no-monitor", help="Watch the loop.")] = True,
    guard: Annotated[
        bool, typer.Option("--guard", help="React to the monitor: no input while the sensor is frozen.")
    ] = False,
    adapt: Annotated[
        bool,
        typer.Option(
            "--adapt", help="--guard, and a second controller that learns what has become of the machine."
        ),
    ] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Compile it and run its test: code made of the folder's content runs here."
        ),
    ] = False,
) -> None:
    """Estimator, real-time iteration, safeguards, monitor and guard as self-contained C11, with a test program."""
    from hybrid_mpc.files import check_folder
    from hybrid_mpc.kit.artifact import load
    from hybrid_mpc.kit.export_c import generate_controller

    check_folder(out)
    reaction = "adapt" if adapt else "rest" if guard else ""
    folder = generate_controller(
        load(model), out, model=name, task=task, single=single, monitor=monitor, guard=reaction, check=check
    )
    said = (
        "compiled, its test passed, README.md has the sizes" if check else "nothing of it was compiled or run"
    )
    print(f"C in {folder.resolve()}; {said}. Next: make -C {shlex.quote(str(folder))} test")
