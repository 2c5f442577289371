"""``hybrid-mpc run``: the main job."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.cli.options import (
    Device,
    InputColumns,
    OutputColumns,
    Recordings,
    ScenarioName,
    Scheduler,
    TimeColumn,
)
from hybrid_mpc.rules import MOST_SEED, counted, two_digits

if TYPE_CHECKING:
    from hybrid_mpc.compare.sequential import Comparison
    from hybrid_mpc.workflow.stage import Absent
    from hybrid_mpc.workflow.stages.compare import ControlResult
    from hybrid_mpc.workflow.stages.on_model import OnModelResult
    from hybrid_mpc.workflow.stages.results import Results
    from hybrid_mpc.workflow.stages.watch import WatchResult

INCOMPLETE = 1
"""Exit code of a run whose report is incomplete."""
EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc run golf_robot --out runs/golf\n\n"
    "  hybrid-mpc run torque_pendulum --data swing1.csv --data swing2.csv --out runs/pendulum\n\n"
    "  hybrid-mpc run my_machine.py --data mine.csv --budget full --out runs/mine\n\n"
    "  hybrid-mpc run my_machine.py --data mine.csv --budget full --out runs/mine --resume\n\n"
    "  hybrid-mpc run my_machine.py --data mine.csv --out runs/mine --resume --only control"
)


def run(
    scenario: ScenarioName,
    data: Recordings = None,
    out: Annotated[Path | None, typer.Option(help="Folder to create. Default: runs/SCENARIO.")] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of data, training and closed loops.", min=0, max=MOST_SEED)
    ] = 0,
    budget: Annotated[str, typer.Option(help="Effort: quick or full.")] = "quick",
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the run in the folder: finish it, or repeat the stages whose inputs have changed.",
        ),
    ] = False,
    time_column: TimeColumn = "",
    input_column: InputColumns = None,
    output_column: OutputColumns = None,
    network_settings: Annotated[
        Path | None,
        typer.Option("--settings", help="JSON file of network settings, as written by hybrid-mpc tune."),
    ] = None,
    device: Device = "cpu",
    deploy: Annotated[
        str,
        typer.Option(
            help="Model to recommend regardless of validation: phy (the fitted prior), pgrnn or mopgrnn."
        ),
    ] = "",
    only: Annotated[
        list[str] | None,
        typer.Option(help="Run only this stage; may be repeated. Other stages keep their results."),
    ] = None,
    skip: Annotated[
        list[str] | None, typer.Option(help="Skip this stage after the export; may be repeated.")
    ] = None,
    scheduler: Scheduler = None,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain", help="Search for missing terms first, and use the prior with the found terms."
        ),
    ] = False,
    track: Annotated[
        bool,
        typer.Option(
            "--track",
            help="Identify parameters that differ between recordings, for an observer that tracks them.",
        ),
    ] = False,
) -> None:
    """Fit the prior, train, export, close the loop, learn alarm limits, analyze, and write a report.

    The stages are data, explain, prior, training, choice, evaluation, export, track, noise, tasks, control, on_model,
    estimation, promises, watch, analysis and report. With --resume a stage runs again only if one of its inputs has
    changed.
    Exit code 1 if a stage after the export failed; the report gives the reason.
    """
    from hybrid_mpc.cli.progress import make_progress, print_summary, say
    from hybrid_mpc.workflow.run import failed_stages
    from hybrid_mpc.workflow.run import run as run_job
    from hybrid_mpc.workflow.settings import RunSettings

    folder = out or Path("runs") / Path(scenario).stem
    settings = RunSettings(
        scenario=scenario,
        data=tuple(data or ()),
        seed=seed,
        budget=budget,
        inputs=tuple(input_column or ()),
        outputs=tuple(output_column or ()),
        time=time_column,
        network_file=network_settings,
        device=device,
        deploy=deploy,
        explain=explain,
        track=track,
    )
    with make_progress() as progress:
        results = run_job(
            settings, folder, resume=resume, only=only or (), skip=skip or (), progress=progress, cluster=scheduler,
        )  # fmt: skip
    lines = ["the run stops here, because --only excludes the later stages"]
    print_summary(lines if results is None else summary(results), folder / "report.html", "report")
    if failed := failed_stages(folder):
        for stage, why in failed.items():
            say(f"stage {stage} failed: {why}")
        raise typer.Exit(INCOMPLETE)


def summary(results: Results) -> list[str]:
    """The most important results of a run, one line each."""
    from hybrid_mpc.kit.promises import promise_lines
    from hybrid_mpc.workflow.stage import Absent
    from hybrid_mpc.workflow.stages.advice import doubt_of
    from hybrid_mpc.workflow.stages.compare import closed_loops

    doubt = doubt_of(results.prior.in_doubt)
    lines = [*([doubt] if doubt else []), *errors_table(results), results.choice.choice.reason]
    if (loops := closed_loops(results.control)) is not None:
        lines += loop_lines(loops)
    if not isinstance(results.on_model, Absent):
        lines += on_model_lines(results.on_model)
    lines += track_lines(results)
    lines += watch_lines(results.watch)
    if isinstance(results.promises, Absent):
        return [*lines, f"promises of the kit: not tested: {results.promises.reason}"]
    return lines + promise_lines(results.promises.rows)


def track_lines(results: Results) -> list[str]:
    """The tracked parameters of a run with --track."""
    from hybrid_mpc.workflow.stage import Absent

    found = results.track
    if isinstance(found, Absent):
        return []
    units = {p.name: p.unit for p in found.varying.parameters}
    own = found.tracking
    names = ", ".join(f"{one.name} ({one.words(units[one.name], own.horizon)})" for one in own.tracked)
    if not names:
        return ["tracked parameters: none, since tracking improves no prediction"]
    ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in own.ratio.items())
    return [
        f"tracked parameters, with their standard deviations: {names}; ratio of prediction errors with to without "
        f"tracking: {ratios}",
        *own.doubts,
    ]


def loop_lines(found: ControlResult) -> list[str]:
    """Costs and tracking errors, then the comparison with the baselines."""
    from hybrid_mpc.workflow.stages.compare import REPORTED

    lines = []
    for short, name in REPORTED.items():
        if (cost := found.cost(name)) is not None:
            lines.append(f"closed loop, {short:8} cost {cost:.4g}, tracking {tracking(found.tracking(name))}")
    return lines + comparison_lines(found.comparisons)


def comparison_lines(comparisons: Mapping[str, Mapping[str, Comparison]]) -> list[str]:
    """By task, the hybrid's cost over that of its strongest baseline, on equal seeds."""
    from hybrid_mpc.compare.sequential import hardest

    lines = []
    for task, own in comparisons.items():
        least = own[base := hardest(own)]
        lines.append(f"{task}: hybrid_observer / {base} {least.words}, {least.n} seeds: {least.finding}")
    return lines


def on_model_lines(found: OnModelResult) -> list[str]:
    """Closed-loop costs on models, one line per controller."""
    lines = []
    for name, plant in found.plants.items():
        words = ", ".join(f"{task} {_cell(cells[name].cost.mean)}" for task, cells in found.means.items())
        lines.append(f"{name} on the model {plant}, not the machine: cost of {words}")
    return lines


def errors_table(results: Results) -> list[str]:
    """Errors of free runs on held-out data: one row per model, one column per output and balance."""
    scores = {name: own.model for name, own in results.evaluation.scores.items()}
    outputs, balances = (list(errors) for errors in (scores["phy"].rmse, scores["phy"].violation))
    heads = ["error [-]", "E_sim [-]", *(f"RMSE {s}" for s in outputs), *(f"violation {b}" for b in balances)]
    rows: dict[str, list[object]] = {"": list(heads)}
    for name, one in scores.items():
        rows[name] = [
            one.error,
            one.e_sim,
            *(one.rmse[s] for s in outputs),
            *(one.violation[b] for b in balances),
        ]
    for name, own in results.prior.baselines.items():
        if own.errors is not None:
            rmse = (own.errors.rmse.get(label) for label in outputs)
            rows[name] = [own.errors.error, "–", *rmse, *("–" for _ in balances)]
    widths = [max(10, len(head)) for head in heads]
    lines = [
        f"  {name:12}" + "".join(f"  {_cell(cell):>{w}}" for cell, w in zip(cells, widths, strict=True))
        for name, cells in rows.items()
    ]
    return ["free runs on held-out data:", *lines]


def tracking(errors: Mapping[str, float]) -> str:
    """Tracking errors, each with its signal's unit.

    Example:
        >>> tracking({"phi [rad]": 0.01234, "phi_dot [rad/s]": 0.5})
        'phi 0.01234 rad, phi_dot 0.5 rad/s'
    """
    split = ((*label.removesuffix("]").split(" [", 1), value) for label, value in errors.items())
    return ", ".join(f"{name} {value:.4g} {unit}" for name, unit, value in split)


def watch_lines(found: WatchResult | Absent) -> list[str]:
    r"""Results of the fault monitor.

    Example:
        >>> from hybrid_mpc.kit.parts import WatchFile
        >>> from hybrid_mpc.watch.detector import WatchLimits
        >>> from hybrid_mpc.workflow.stages.watch import FaultedLoop, WatchResult
        >>> limits = WatchLimits("residuals", 1.0, (), (), (), false_alarms_per_hour=2.0, hours=0.1)
        >>> row = FaultedLoop("weak_pump", "the pump weakens", "levels", 450.0, None, (), "", 1)
        >>> watch = WatchResult({"hybrid": WatchFile({"residuals": limits})}, "residuals", faults=(row,))
        >>> print(*watch_lines(watch), sep="\n")
        monitor of residuals: learned from 6 min for 2 false alarms per hour; 0 alarms on recordings
          weak_pump: not detected (alarms before the fault: 1)
    """
    from hybrid_mpc.workflow.stage import Absent

    if isinstance(found, Absent) or found.limits is None:
        return [f"monitor: {found.reason}"]
    limits = found.limits
    rate = f"for {two_digits(limits.false_alarms_per_hour)} false alarms per hour"
    if not limits.rated:
        rate = "too short to guarantee a false alarm rate"
    lines = [
        f"monitor of {found.kind}: learned from {two_digits(60 * limits.hours)} min {rate}; "
        f"{counted(len(found.alarms), 'alarm')} on recordings"
    ]
    for row in found.faults or ():
        seen = "not detected" if row.delay_s is None else f"detected after {row.delay_s:.3g} s"
        seen += f" in {row.channels[0]}" if row.channels else ""
        before = f" (alarms before the fault: {row.false_alarms})" if row.false_alarms else ""
        lines.append(f"  {row.fault}: {seen}{before}" + (f": {row.diagnosis}" if row.diagnosis else ""))
    return lines


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "diverged"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
