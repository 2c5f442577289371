"""``hybrid-mpc run``: the main job."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from hybrid_mpc.cli.options import Device, InputColumns, OutputColumns, Recordings, ScenarioName, TimeColumn
from hybrid_mpc.records import MOST_SEED

INCOMPLETE = 1
"""Exit code of a run whose report lacks a part."""
EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc run golf_robot --out runs/golf\n\n"
    "  hybrid-mpc run torque_pendulum --data swing1.csv --data swing2.csv --out runs/pendulum\n\n"
    "  hybrid-mpc run my_machine.py --data mine.csv --budget full --out runs/mine\n\n"
    "  hybrid-mpc run my_machine.py --data mine.csv --budget full --out runs/mine --resume"
)


def run(
    scenario: ScenarioName,
    data: Recordings = None,
    out: Annotated[Path | None, typer.Option(help="Folder to make. Default: runs/SCENARIO.")] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of data, training and closed loops.", min=0, max=MOST_SEED)
    ] = 0,
    budget: Annotated[str, typer.Option(help="Effort: quick or full.")] = "quick",
    resume: Annotated[bool, typer.Option("--resume", help="Finish the run that the folder holds.")] = False,
    time_column: TimeColumn = "",
    input_column: InputColumns = None,
    output_column: OutputColumns = None,
    network_settings: Annotated[
        Path | None,
        typer.Option("--settings", help="JSON file of network settings, as hybrid-mpc tune leaves it."),
    ] = None,
    device: Device = "cpu",
) -> None:
    """Fit the prior, train, export, close the loop, monitor, learn the guard, analyze, and write a report.

    Exit code 1 if a stage after the export could not run; the report then says why.
    """
    from hybrid_mpc.cli.progress import make_progress
    from hybrid_mpc.job.context import failed_stages
    from hybrid_mpc.job.run import run as run_job
    from hybrid_mpc.job.settings import RunSettings

    folder = out or Path("runs") / Path(scenario).stem
    settings = RunSettings(
        scenario,
        tuple(data or ()),
        seed,
        budget,
        tuple(input_column or ()),
        tuple(output_column or ()),
        time_column,
        network_settings,
        device,
    )
    with make_progress() as progress:
        results = run_job(settings, folder, resume=resume, progress=progress)
    for line in summary(results):
        print(line)
    print(f"report: {(folder / 'report.html').resolve()}")
    if failed := failed_stages(folder):
        for stage, why in failed.items():
            print(f"stage {stage} could not run: {why}")
        raise typer.Exit(INCOMPLETE)


def summary(results: dict[str, object]) -> list[str]:
    """The figures of a run that are worth a line on the terminal."""
    identification, control = results["identification"], results["control"]
    assert isinstance(identification, dict)
    assert isinstance(control, dict)
    known = [errors for errors in identification["rmse"].values() if isinstance(errors, dict)]
    signal = next(iter(known[0])) if known else "output"
    lines = [f"free runs on unseen data:    E_sim      RMSE {signal}   energy violation [W]"]
    for name, e_sim in identification["e_sim_s"].items():
        rmse, balance = identification["rmse"][name], identification["balance_violation"][name]
        lines.append(f"  {name:22} {_number(e_sim)} {_number(rmse)} {_number(balance)}")
    for name in ("prior", "hybrid", "oracle"):
        loop = control[name]
        if loop["cost"] is not None:
            lines.append(
                f"closed loop, {name:8} cost {loop['cost']:.4g}, tracking {tracking(loop['tracking_rmse'])}"
            )
    monitor = results["monitor"]
    assert isinstance(monitor, dict)
    if monitor["alarms"] is None:
        lines.append(f"energy monitor: {monitor['reason']}")
    lines += guard_lines(results["guard"])
    return lines


def tracking(errors: Mapping[str, float]) -> str:
    """The first tracking error with its signal's unit.

    Args:
        errors: By signal with unit.

    Example:
        >>> tracking({"phi [rad]": 0.01234, "phi_dot [rad/s]": 0.5})
        'phi 0.01234 rad'
    """
    label, value = next(iter(errors.items()))
    name, _, unit = label.partition(" ")
    return f"{name} {value:.4g} {unit.strip('[]')}"


def guard_lines(guard: Any) -> list[str]:
    """What the run says of its energy guard.

    Args:
        guard: The group of that name in the results.
    """
    if guard["data_hash"] is None:
        return [f"energy guard: {guard['reason']}"]
    lines = [
        f"energy guard: learned from {60 * guard['hours']:.1f} min for {guard['false_alarms_per_hour']:g} false alarms "
        "an hour"
    ]
    for row in guard["faults"] or ():
        seen = "never seen" if row["delay_s"] is None else f"seen after {row['delay_s']:.2f} s"
        lines.append(f"  {row['fault']}: {seen}" + (f": {row['diagnosis']}" if row["diagnosis"] else ""))
    return lines


def _number(value: object) -> str:
    if isinstance(value, Mapping):
        value = next(iter(value.values()))
    return f"{value:12.4g}" if isinstance(value, float) else f"{value!s:>12}"
