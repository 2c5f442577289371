"""Arguments and options that several commands take; a default is the command's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

ScenarioName: TypeAlias = Annotated[
    str, typer.Argument(help="A registered name (see: hybrid-mpc scenarios) or a .py file.")
]
Recordings: TypeAlias = Annotated[
    list[Path] | None, typer.Option(help="A recording; give it once for each file.")
]
TimeColumn: TypeAlias = Annotated[str, typer.Option(help="Column of the time [s]. Default: the scenario's.")]
InputColumns: TypeAlias = Annotated[
    list[str] | None, typer.Option(help="Column of an input, in the prior's order.")
]
OutputColumns: TypeAlias = Annotated[
    list[str] | None, typer.Option(help="Column of a measured output, in the prior's order.")
]
DisturbanceColumns: TypeAlias = Annotated[
    list[str] | None, typer.Option(help="Column of a measured disturbance: it acts, and nobody commands it.")
]
Device: TypeAlias = Annotated[str, typer.Option(help="Where networks are trained: cpu, cuda, cuda:1, ...")]
ArtifactFolder: TypeAlias = Annotated[Path, typer.Argument(help="Artifact folder: model/ of a finished run.")]
EmptyFolder: TypeAlias = Annotated[Path, typer.Option(help="Folder to make; an existing one must be empty.")]
Scheduler: TypeAlias = Annotated[
    str | None,
    typer.Option(help="Address of a dask scheduler, tcp://HOST:PORT, in place of processes of this machine."),
]
