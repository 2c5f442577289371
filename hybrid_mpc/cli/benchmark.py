"""``hybrid-mpc benchmark``: free runs of a machine's models over held-out recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybrid_mpc.cli.options import ScenarioName, Scheduler
from hybrid_mpc.rules import MOST_SEED

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc benchmark unbalanced_disk --data multisine_2024.npz --test hidden_2024.npz --out runs/disk\n\n"
    "  hybrid-mpc benchmark emps --data DATA_EMPS.mat --test DATA_EMPS_PULSES.mat --budget full --out runs/emps\n\n"
    "  hybrid-mpc benchmark unbalanced_disk --model runs/disk --test another.npz --out runs/disk-another"
)


def benchmark(
    machine: ScenarioName,
    data: Annotated[
        list[Path] | None, typer.Option(help="A recording for training; may be repeated.")
    ] = None,
    test: Annotated[
        list[Path] | None,
        typer.Option(help="A recording for evaluation; may be repeated. Default: the held-out test data."),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="Folder of an earlier benchmark: evaluate its model, train nothing.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to create. Default: runs/MACHINE-benchmark.")
    ] = None,
    budget: Annotated[str, typer.Option(help="Effort: quick or full.")] = "quick",
    seed: Annotated[int, typer.Option(help="Seed of the networks.", min=0, max=MOST_SEED)] = 0,
    refit: Annotated[
        float | None,
        typer.Option(
            help="For a machine that has changed: refit the prior to this many seconds of each test file."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(help="Number of network kinds trained in parallel.", min=1)] = 2,
    scheduler: Scheduler = None,
) -> None:
    """Fit the prior, train networks, and evaluate free runs over held-out recordings."""
    from hybrid_mpc.cli.progress import make_progress, print_summary
    from hybrid_mpc.scenario import load_scenario
    from hybrid_mpc.workflow.benchmark import BenchmarkSettings, draw, table
    from hybrid_mpc.workflow.benchmark import benchmark as run_job

    folder = out or Path("runs") / f"{Path(machine).stem}-benchmark"
    settings = BenchmarkSettings(
        machine, tuple(data or ()), tuple(test or ()), model, budget, seed, workers, refit
    )
    with make_progress() as progress:
        results = run_job(settings, folder, progress=progress, cluster=scheduler)
        draw(load_scenario(machine), results, folder)
    print_summary(table(results), folder / "results.json")
