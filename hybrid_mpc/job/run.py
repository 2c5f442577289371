"""The main job: data, prior, training, evaluation, export, control, estimation, monitor, guard, analysis, report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError, StorageError
from hybrid_mpc.job.check import check_scenario
from hybrid_mpc.job.context import Context, Progress, Silent
from hybrid_mpc.job.folder import open_folder
from hybrid_mpc.job.settings import RunSettings, check_device, claim
from hybrid_mpc.job.stages import export as deploy
from hybrid_mpc.job.stages import identify
from hybrid_mpc.job.stages import monitor as judge
from hybrid_mpc.job.stages.estimate import estimation_stage
from hybrid_mpc.job.stages.guard import guard_stage
from hybrid_mpc.job.stages.report import report_stage
from hybrid_mpc.scenario import load_scenario

STAGES: tuple[tuple[str, str, Callable[[Context], None]], ...] = (
    ("data", "reading the measurements", identify.data_stage),
    ("prior", "fitting the prior", identify.prior_stage),
    ("training", "training the networks", identify.training_stage),
    ("evaluation", "free runs on unseen data", identify.evaluation_stage),
    ("export", "exporting to CasADi", deploy.export_stage),
    ("control", "closing the loop", deploy.control_stage),
    ("estimation", "testing the observers", estimation_stage),
    ("monitor", "calibrating the energy monitor", judge.monitor_stage),
    ("guard", "learning the energy guard", guard_stage),
    ("analysis", "linear analysis", judge.analysis_stage),
    ("report", "writing the report", report_stage),
)

OPTIONAL = ("control", "estimation", "monitor", "guard", "analysis")
"""Stages without which there is still a model, and a report on it: one that cannot run leaves its reason there."""


def run(
    settings: RunSettings, out: Path, *, resume: bool = False, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the main job into the folder ``out`` and return what stands in its ``results.json``.

    Every stage leaves a checkpoint in ``out/checkpoints``; a run that was interrupted, at any point, is
    finished by ``resume=True`` and then equals one that was not. A stage after the export that cannot run (a monitor
    for which the recordings are too short, say) costs its own part of the report, which then has the reason.

    Args:
        settings: What to compute.
        out: Folder to make; it must be new or empty unless ``resume``.
        resume: Finish the run that ``out`` holds.
        progress: Where to report; default: nowhere.

    Returns:
        The results (docs/results-schema.md).

    Raises:
        InputError: For any bad input; nothing half-written is left behind that a later run would trip over.
        StorageError: If something cannot be written; finished stages are kept.

    Example:
        >>> results = run(RunSettings("golf_robot"), Path("out"))  # doctest: +SKIP
    """
    scenario = load_scenario(settings.scenario)
    context = Context(settings, scenario, out, progress or Silent())
    check_scenario(scenario, context.budget)
    identify.check_data(context)
    check_device(settings.device)
    with open_folder(out, claim(settings), resume=resume):
        for name, title, stage in STAGES:
            context.progress.start(title)
            if context.done(name):
                context.progress.finish("done before")
                continue
            try:
                stage(context)
            except StorageError:
                raise
            except InputError as error:  # what was found before is worth a report
                if name not in OPTIONAL:
                    raise
                context.fail(name, str(error))
                context.progress.warn(f"stage {name} could not run: {error}")
            context.progress.finish("")
    result: dict[str, Any] = context.result("report")
    return result
