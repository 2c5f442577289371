"""``hybrid-mpc analyze``: the linear analysis of a model that exists."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.records import MOST_SEED

if TYPE_CHECKING:
    from hybrid_mpc.job.analyze import Request

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc analyze runs/golf/model --out analysis\n\n"
    "  hybrid-mpc analyze runs/mine/model --scenario my_machine.py --data swing1.csv --out analysis"
)


def analyze(
    model: Annotated[Path, typer.Argument(help="Artifact folder: model/ of a finished run.")],
    out: Annotated[Path, typer.Option(help="Folder to make; an existing one must be empty.")],
    scenario: Annotated[
        str,
        typer.Option(
            help="The machine, a registered name or a .py file. Default: the one the model was made for."
        ),
    ] = "",
    data: Annotated[
        list[Path] | None,
        typer.Option(help="A recording to take a frequency response from; may be repeated."),
    ] = None,
    speed: Annotated[
        float | None, typer.Option(help="Size of the motions that friction is linearized for [units of v].")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of what is drawn at random.", min=0, max=MOST_SEED)] = 0,
) -> None:
    """Poles, Bode plots, margins of the control loop and more, as tables, pictures and a page."""
    from hybrid_mpc.cli.progress import make_progress
    from hybrid_mpc.files import check_folder
    from hybrid_mpc.job.analyze import Request, study, subject_of
    from hybrid_mpc.job.analyze_page import write_analysis

    check_folder(out)
    request = Request(model, scenario, tuple(data or ()), speed, seed)
    with make_progress() as progress:
        progress.start("reading the model")
        subject, notes = subject_of(request)
        progress.finish("; ".join(notes))
        progress.start("analyzing")
        findings = study(subject, progress.update)
        progress.finish("")
        progress.start("drawing")
        files = write_analysis(out, subject, findings, notes, command(request, out))
        progress.finish(f"{len(files)} files")
    print(f"page: {(out / 'analysis.html').resolve()}")


def command(request: Request, out: Path) -> str:
    """The command line that repeats this analysis, with folders by their last names.

    Args:
        request: What was asked for.
        out: Where it was written.
    """
    folder = f"{request.folder.parent.name}/{request.folder.name}".lstrip("/")
    words = ["hybrid-mpc analyze", folder, f"--out {out.name}"]
    words += [f"--scenario {request.scenario}"] if request.scenario else []
    words += [f"--data {path.name}" for path in request.data]
    words += [f"--speed {request.speed:g}"] if request.speed is not None else []
    words += [f"--seed {request.seed}"] if request.seed else []
    return " ".join(words)
