"""``hybrid-mpc tune``: search for network settings by validation error."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.cli.options import InputColumns, OutputColumns, Recordings, ScenarioName, TimeColumn
from hybrid_mpc.rules import MOST_SEED

if TYPE_CHECKING:
    from hybrid_mpc.workflow.tune import TuneResults

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc tune golf_robot --out runs/tune\n\n"
    "  hybrid-mpc tune golf_robot --trials 40 --vary hidden=8:64 --vary horizon=25:100 --out runs/tune\n\n"
    "  hybrid-mpc tune my_machine.py --data mine.csv --timeout 3600 --out runs/tune --resume\n\n"
    "  hybrid-mpc run golf_robot --settings runs/tune/settings.json --out runs/golf"
)


def tune(
    scenario: ScenarioName,
    data: Recordings = None,
    out: Annotated[Path | None, typer.Option(help="Folder to create. Default: runs/tune-SCENARIO.")] = None,
    trials: Annotated[int, typer.Option(help="Total number of trainings.", min=1)] = 20,
    budget: Annotated[str, typer.Option(help="Effort of a training: quick or full.")] = "quick",
    kind: Annotated[str, typer.Option(help="rnn, pgrnn or mopgrnn.")] = "mopgrnn",
    vary: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME or NAME=LOW:HIGH of hidden, learning_rate, free_run_learning_rate, decay, batch, horizon, "
            "prior_replay; may be repeated. Default: the first four."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of data, trainings and search.", min=0, max=MOST_SEED)] = 0,
    timeout: Annotated[
        float | None, typer.Option(help="Time after which no further training starts [s]. Default: no limit.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the search in the folder.")] = False,
    time_column: TimeColumn = "",
    input_column: InputColumns = None,
    output_column: OutputColumns = None,
) -> None:
    """Search for hidden units and other settings of the networks by the validation error of free runs."""
    from hybrid_mpc.cli.progress import make_progress, print_summary
    from hybrid_mpc.identify.tune import parsed_space
    from hybrid_mpc.workflow.tune import TuneSettings, run_tuning, usage

    folder = out or Path("runs") / f"tune-{Path(scenario).stem}"
    settings = TuneSettings(
        scenario, tuple(data or ()), seed, budget, tuple(input_column or ()), tuple(output_column or ()), time_column,
        kind=kind, space=parsed_space(vary or ()),
    )  # fmt: skip
    with make_progress() as progress:
        found = run_tuning(settings, folder, trials=trials, timeout=timeout, resume=resume, progress=progress)
    print_summary(summary(found), folder / "results.json")
    print(f"run with these settings: {usage(settings, folder)}")


def summary(found: TuneResults) -> list[str]:
    """One line per trial with the searched settings, then the best trial."""
    names = list(found.space)
    lines = ["  ".join(["trial", f"{'state':8}", f"{'E_sim':>8}", "   s", *names])]
    for row in found.trials:
        values = [f"{row.values[name]:>{len(name)}.3g}" for name in names]
        head = [f"{row.number:5}", f"{row.state:8}", f"{row.value:8.4g}", f"{row.duration:4.0f}"]
        lines.append("  ".join(head + values))
    base = "" if found.base_value is None else f"; initial settings {found.base_value:.4g}"
    return [*lines, f"best: trial {found.best.number} with {found.best.value:.4g} on validation{base}"]
