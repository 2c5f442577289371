"""``hybrid-mpc analyze``: the linear analysis of a trained model."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.cli.options import ArtifactFolder, EmptyFolder
from hybrid_mpc.rules import MOST_SEED, counted

if TYPE_CHECKING:
    from hybrid_mpc.workflow.analyze import AnalysisSettings

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc analyze runs/golf/model --out analysis\n\n"
    "  hybrid-mpc analyze runs/mine/model --scenario my_machine.py --data swing1.csv --out analysis"
)


def analyze(
    model: ArtifactFolder,
    out: EmptyFolder,
    scenario: Annotated[
        str,
        typer.Option(help="The machine, a registered name or a .py file. Default: the machine of the model."),
    ] = "",
    data: Annotated[
        list[Path] | None, typer.Option(help="A recording for a frequency response; may be repeated.")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(help="Amplitude of the speed at which friction is linearized [unit of v].")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of random draws.", min=0, max=MOST_SEED)] = 0,
) -> None:
    """Write poles, Bode plots, margins of the control loop and more as tables, figures and a page."""
    from hybrid_mpc.analyze.analysis import analyze_models
    from hybrid_mpc.analyze.page import write_analysis
    from hybrid_mpc.cli.progress import make_progress, print_summary
    from hybrid_mpc.files import check_folder
    from hybrid_mpc.workflow.analyze import AnalysisSettings, analysis_input

    check_folder(out)
    settings = AnalysisSettings(model, scenario, tuple(data or ()), speed, seed)
    with make_progress() as progress:
        progress.start("reading the model")
        given, notes = analysis_input(settings)
        progress.finish("; ".join(notes))
        progress.start("analyzing")
        result = analyze_models(given, progress.update)
        progress.finish("")
        progress.start("drawing")
        files = write_analysis(out, given, result, notes, command(settings, out))
        progress.finish(counted(len(files), "file"))
    print_summary((), out / "analysis.html", "page")


def command(settings: AnalysisSettings, out: Path) -> str:
    """The command line that repeats this analysis, with full paths."""
    words = ["hybrid-mpc", "analyze", str(settings.folder.resolve()), "--out", str(out.resolve())]
    words += ["--scenario", settings.scenario] if settings.scenario else []
    words += [word for path in settings.data for word in ("--data", str(path.resolve()))]
    words += ["--speed", f"{settings.speed!r}"] if settings.speed is not None else []
    words += ["--seed", str(settings.seed)] if settings.seed else []
    return shlex.join(words)
