"""Arguments and options of several commands; each command sets its own default."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

ScenarioName: TypeAlias = Annotated[
    str, typer.Argument(help="A registered name (see: hybrid-mpc scenarios) or a .py file.")
]
Recordings: TypeAlias = Annotated[list[Path] | None, typer.Option(help="A recording; may be repeated.")]
TimeColumn: TypeAlias = Annotated[
    str, typer.Option(help="Column of the time [s]. Default: that of the scenario; new finds it.")
]
InputColumns: TypeAlias = Annotated[
    list[str] | None, typer.Option(help="Column of an input, in the prior's order; may be repeated.")
]
OutputColumns: TypeAlias = Annotated[
    list[str] | None, typer.Option(help="Column of a measured output, in the prior's order; may be repeated.")
]
DisturbanceColumns: TypeAlias = Annotated[
    list[str] | None, typer.Option(help="Column of a measured disturbance (not commanded); may be repeated.")
]
Device: TypeAlias = Annotated[str, typer.Option(help="Device for training: cpu, cuda, cuda:1, ...")]
ArtifactFolder: TypeAlias = Annotated[
    Path, typer.Argument(help="Artifact folder, e.g. model/ of a finished run.")
]
EmptyFolder: TypeAlias = Annotated[
    Path, typer.Option(help="Folder to create; an existing one must be empty.")
]
Scheduler: TypeAlias = Annotated[
    str | None, typer.Option(help="Address of a dask scheduler, tcp://HOST:PORT, instead of local processes.")
]
