"""``hybrid-mpc monitor``: run a machine's fault monitor over recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.cli.options import ArtifactFolder, EmptyFolder
from hybrid_mpc.errors import InputError
from hybrid_mpc.rules import two_digits

if TYPE_CHECKING:
    from hybrid_mpc.workflow.monitor import MonitorJob, MonitorResult

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc monitor runs/golf/model today.csv --out today\n\n"
    "  hybrid-mpc monitor runs/golf/model day1.csv day2.csv --learn 1 --out nominal\n\n"
    "  hybrid-mpc monitor runs/golf/model today.csv --calibration nominal/calibration.json --out today\n\n"
    "  hybrid-mpc monitor runs/mine/model today.csv --scenario edited_machine.py --out today"
)


def monitor(
    model: ArtifactFolder,
    recordings: Annotated[list[Path], typer.Argument(help="Recordings: CSV, .npz or .mat.")],
    out: EmptyFolder,
    scenario: Annotated[
        str,
        typer.Option(
            help="Columns, sensors, control problem: a name or a .py file. Default: from the model's folder."
        ),
    ] = "",
    learn: Annotated[
        float,
        typer.Option(
            help="Learn limits for this many false alarms per hour; the recordings must be nominal."
        ),
    ] = 0.0,
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.json with limits. Default: the model's.")
    ] = None,
    residuals: Annotated[
        bool,
        typer.Option(
            "--residuals",
            help="Monitor residuals of outputs and balances instead of the energy (mechanical machine).",
        ),
    ] = False,
    resolution: Annotated[
        list[float] | None,
        typer.Option(
            help=(
                "Resolution of each sensor [its unit] for the frozen-sensor check; may be repeated. Default: from the "
                "noise."
            )
        ),
    ] = None,
) -> None:
    """Report where the model does not describe recordings, with a diagnosis.

    Exit code 1 if a recording has no valid reading.
    """
    from hybrid_mpc.cli.progress import make_progress, print_summary, say
    from hybrid_mpc.files import check_folder
    from hybrid_mpc.kit.parts import KIT, artifact_folder, read_description
    from hybrid_mpc.scenario import scenario_of
    from hybrid_mpc.workflow.monitor import learn as learn_job
    from hybrid_mpc.workflow.monitor import prepared, watch

    check_folder(out)
    folder = artifact_folder(model)
    held = read_description(folder)
    machine = None
    if scenario or held.predicting is None:  # else the folder has all that is needed
        machine = scenario_of(held.provenance.scenario, folder / KIT, scenario)
        if machine is None:
            raise InputError(f"{folder / KIT} does not name its scenario. Give --scenario. [HM-CLI-004]")
    job = prepared(
        machine, folder, recordings, resolution=tuple(resolution) if resolution else None,
        calibration=None if learn else calibration, residuals=residuals,
    )  # fmt: skip
    for warning in job.data.warnings:
        say(f"warning: {warning}")
    for note in job.data.notes:
        say(f"note: {note}")
    if learn:
        with make_progress() as progress:
            found = learn_job(job, learn, out, progress)
        rate = two_digits(found.false_alarms_per_hour)
        line = f"learned from {two_digits(60 * found.hours)} min for {rate} false alarms per hour"
        if not found.rated:
            line = f"learned from {two_digits(60 * found.hours)} min: {found.method}"
        print_summary([line], out / "calibration.json", "limits")
        return
    say(watching(job))
    with make_progress() as progress:
        result = watch(job, out, progress)
    print_summary(summary(result), out / "monitor.json")
    if any(not row.valid_s for row in result.recordings):
        raise typer.Exit(1)


def watching(job: MonitorJob) -> str:
    """The channels and limits, in one line."""
    limits = job.limits
    if limits is None:
        why = next((text for file, text in job.kit.lacks.items() if file.startswith("watch/")), "")
        return (
            f"the kit has no limits of {job.kind}{f' ({why})' if why else ''}: only missing readings raise an alarm. "
            "Learn limits with --learn"
        )
    channels = ", ".join(dict.fromkeys(one.channel for one in limits.channels))
    return (
        f"channels: {channels}; limits for {two_digits(limits.false_alarms_per_hour)} false alarms per hour, learned "
        f"from {two_digits(60 * limits.hours)} min: {limits.method}"
    )


def summary(result: MonitorResult) -> list[str]:
    """One line per recording and alarm."""
    lines = []
    for row in result.recordings:
        n = len(row.alarms)
        parts = (
            (row.warm_up_s, "warm-up"),
            (row.missing_s, "samples are missing"),
            (row.not_finite_s, "results of model or estimator are not finite"),
        )
        text = ", ".join(f"{seconds:.2f} s {why}" for seconds, why in parts if seconds)
        without = (
            f"; no valid reading for {text}" * bool(text) if row.valid_s else f"; NO VALID READING: {text}"
        )
        lines.append(f"{row.recording}: {row.seconds:.1f} s, {n} alarm{'' if n == 1 else 's'}{without}")
        for alarm in row.alarms:
            why = f": {alarm.diagnosis}" if alarm.diagnosis else ""
            of = f" ({', '.join(alarm.channels)})" if alarm.channels else ""
            lines.append(f"  {alarm.start_s:.2f} to {alarm.end_s:.2f} s{of}{why}")
    for what, cuts in (("gap", result.gaps), ("not monitored", result.not_watched)):
        lines += [f"{what} in {cut.file}: {cut.start_s:.2f} to {cut.end_s:.2f} s, {cut.why}" for cut in cuts]
    return lines
