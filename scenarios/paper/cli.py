"""``hybrid-mpc reproduce``: the paper's experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hybrid_mpc.cli.options import Device
from hybrid_mpc.rules import MOST_SEED

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc reproduce pendulum --budget quick --out runs/fig3_quick\n\n"
    "  hybrid-mpc reproduce golf_robot --out runs/fig5\n\n"
    "  hybrid-mpc reproduce golf_robot --out runs/fig5 --resume\n\n"
    "  hybrid-mpc reproduce pendulum --networks 4 --sequences 3,15 --out runs/fig3_small"
)


def reproduce(
    scenario: Annotated[str, typer.Argument(help="pendulum, golf_robot, or a .py file with an experiment.")],
    networks: Annotated[
        int | None, typer.Option(help="Networks of each ensemble. Default: the budget's (full: 16).")
    ] = None,
    sequences: Annotated[
        str, typer.Option(help="Amounts of training data. Default: the budget's (full: 3,6,9,12,15).")
    ] = "",
    budget: Annotated[str, typer.Option(help="Effort: quick or full.")] = "full",
    form: Annotated[
        str, typer.Option(help="hybrid, or paper: the network gives the whole derivative and explicit Euler.")
    ] = "hybrid",
    seed: Annotated[int, typer.Option(help="Seed of data and training.", min=0, max=MOST_SEED)] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder to make. Default: runs/reproduce_SCENARIO.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Finish the reproduction that the folder holds.")
    ] = False,
    device: Device = "cpu",
) -> None:
    """Rebuild the paper's experiment on a machine: tables, figures, and its claims with what was found."""
    from hybrid_mpc.cli.progress import make_progress
    from scenarios.paper.run import claim_lines, text_table
    from scenarios.paper.run import reproduce as run_job
    from scenarios.paper.settings import ReproductionSettings, parsed_sequences

    folder = out or Path("runs") / f"reproduce_{Path(scenario).stem}"
    amounts = parsed_sequences(sequences) if sequences else None
    settings = ReproductionSettings(scenario, budget, networks, amounts, seed, form, device)
    with make_progress() as progress:
        results = run_job(settings, folder, resume=resume, progress=progress)
    for line in (*text_table(results), *claim_lines(results)):
        print(line)
    print(f"results: {(folder / 'results.json').resolve()}")
