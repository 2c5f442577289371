"""``hybrid-mpc search``: settings of the networks, judged by validation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from hybrid_mpc.cli.options import InputColumns, OutputColumns, Recordings, ScenarioName, TimeColumn
from hybrid_mpc.records import MOST_SEED

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc search golf_robot --out runs/search\n\n"
    "  hybrid-mpc search golf_robot --trials 40 --vary hidden=8:64 --vary horizon=25:100 --out runs/search\n\n"
    "  hybrid-mpc search my_machine.py --data mine.csv --timeout 3600 --out runs/search --resume\n\n"
    "  hybrid-mpc run golf_robot --settings runs/search/settings.json --out runs/golf"
)


def search(
    scenario: ScenarioName,
    data: Recordings = None,
    out: Annotated[Path | None, typer.Option(help="Folder to make. Default: runs/search-SCENARIO.")] = None,
    trials: Annotated[int, typer.Option(help="Trainings in all.", min=1)] = 20,
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
        float | None, typer.Option(help="No further training starts after this time [s]. Default: none.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the search that the folder holds.")
    ] = False,
    time_column: TimeColumn = "",
    input_column: InputColumns = None,
    output_column: OutputColumns = None,
) -> None:
    """Search hidden units and other settings of the networks by the validation error of free runs."""
    from hybrid_mpc.cli.progress import make_progress
    from hybrid_mpc.identify.tune import parsed_space
    from hybrid_mpc.job.tune import SearchSettings, run_search, usage

    folder = out or Path("runs") / f"search-{Path(scenario).stem}"
    settings = SearchSettings(
        scenario,
        tuple(data or ()),
        seed,
        budget,
        tuple(input_column or ()),
        tuple(output_column or ()),
        time_column,
        kind=kind,
        space=parsed_space(vary or ()),
    )
    with make_progress() as progress:
        results = run_search(
            settings, folder, trials=trials, timeout=timeout, resume=resume, progress=progress
        )
    for line in summary(results):
        print(line)
    print(f"results: {(folder / 'results.json').resolve()}")
    print(f"a run with these settings: {usage(settings, folder)}")


def summary(results: dict[str, Any]) -> list[str]:
    """One line a trial, then the best.

    Args:
        results: What results.json holds.
    """
    names = list(results["space"])
    lines = ["  ".join(["trial", f"{'state':8}", f"{'E_sim':>8}", "   s", *names])]
    for row in results["trials"]:
        values = [f"{row['values'][name]:>{len(name)}.3g}" for name in names]
        head = [f"{row['number']:5}", f"{row['state']:8}", f"{row['value']:8.4g}", f"{row['duration']:4.0f}"]
        lines.append("  ".join(head + values))
    best, base = results["best"], results["base_value"]
    against = "" if base is None else f"; the settings it started from {base:.4g}"
    lines.append(f"best: trial {best['number']} with {best['value']:.4g} on validation{against}")
    return lines
