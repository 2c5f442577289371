"""``hybrid-mpc run``: the stages of a run in their order; a stage runs only if something that it reads has changed."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.engine import Progress
from hybrid_mpc.errors import InputError, named_extra, no_exit
from hybrid_mpc.folder import open_folder
from hybrid_mpc.records import known
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import RunSettings, check_device, run_note
from hybrid_mpc.workflow.stage import Absent, Stage, bring_up_to_date, changed, differing
from hybrid_mpc.workflow.stages.analyze import ANALYSIS
from hybrid_mpc.workflow.stages.choose import CANDIDATES, CHOICE
from hybrid_mpc.workflow.stages.compare import CONTROL
from hybrid_mpc.workflow.stages.estimate import ESTIMATION
from hybrid_mpc.workflow.stages.evaluate import EVALUATION
from hybrid_mpc.workflow.stages.explain import EXPLAIN
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, TASKS
from hybrid_mpc.workflow.stages.identify import DATA, PRIOR, TRAINING, check_data, models_of
from hybrid_mpc.workflow.stages.on_model import LOOPS_ON_MODEL
from hybrid_mpc.workflow.stages.promises import PROMISES
from hybrid_mpc.workflow.stages.report import REPORT, report_so_far
from hybrid_mpc.workflow.stages.results import Results, read_results
from hybrid_mpc.workflow.stages.track import TRACK
from hybrid_mpc.workflow.stages.watch import WATCH

STAGES: tuple[Stage[Any], ...] = (
    DATA, EXPLAIN, PRIOR, TRAINING, CHOICE, EVALUATION, EXPORT, TRACK, NOISE, TASKS, CONTROL, LOOPS_ON_MODEL,
    ESTIMATION, PROMISES, WATCH, ANALYSIS, REPORT,
)  # fmt: skip
"""Stages in their order."""
NAMES = tuple(stage.name for stage in STAGES)
ALWAYS = (TASKS.name, REPORT.name)
"""Stages that run even if ``only`` does not name them: they only write what scenario and other stages hold."""
SECONDS = {
    "data": 4, "explain": 20, "prior": 22, "training": 26, "choice": 5, "evaluation": 4, "export": 7, "track": 30,
    "noise": 5, "tasks": 1, "control": 26, "on_model": 14, "estimation": 1, "promises": 7, "watch": 39, "analysis": 1,
    "report": 12,
}  # fmt: skip
"""Duration of each stage of `make demo` on two idle cores [s]; ``on_model`` only runs without a plant. The remaining
time of a run is estimated by these durations, scaled with the measured durations of its finished stages."""


@no_exit()
@named_extra("a run")
def run(
    settings: RunSettings,
    out: Path,
    *,
    resume: bool = False,
    only: Sequence[str] = (),
    skip: Sequence[str] = (),
    progress: Progress | None = None,
    cluster: Any = None,
) -> Results | None:
    """Compute all stages of a run into the folder ``out``; returns the content of its ``results.json``.

    Every stage writes its result to ``out/checkpoints``. With ``resume`` a stage runs again only if something that it
    reads has changed: after an edit of a task, its loops and the report are computed again, but nothing is trained. If
    a stage after the export fails, the report gives the reason in place of its section.

    With ``only`` the run ends before the first stage that has no stored result and is not named, and returns None:
    ``only=("data", "prior")`` of a new run fits the prior and writes a first report.

    Args:
        settings: Settings of the run.
        out: Folder to write; it must be new or empty unless ``resume``.
        resume: Whether to continue the run in ``out``. Default: False.
        only: Names of the stages that may run; stored results are used for the others. ``tasks`` and ``report`` always
            run. Default: all.
        skip: Names of stages after the export to leave out. Default: none.
        progress: Where to report. Default: nowhere.
        cluster: Address of a dask scheduler or a ``distributed.Client``, whose workers train the networks and run the
            closed loops; they must see ``out`` under the same path. Default: processes of this machine.

    Raises:
        InputError: For any bad input. Files are written whole or not at all.
        StorageError: If a file cannot be written; finished stages are kept.

    Example:
        >>> results = run(RunSettings("golf_robot"), Path("out"))  # doctest: +SKIP
    """
    check_choice(only, skip)
    scenario = load_scenario(settings.scenario)
    context = Context(settings, scenario, out, progress or Progress(), cluster)
    found = check_scenario(
        scenario, context.budget, (lambda: context.as_given.dataset) if settings.data else None
    )
    for warning in found.warnings:
        context.progress.warn(warning)
    check_data(context.as_given)
    check_device(settings.device)
    if settings.deploy:
        there = models_of(context)
        known(settings.deploy, [name for name in CANDIDATES if name in there], "model to deploy")
    end = _end(context, only)
    took: dict[str, float] = {}
    with open_folder(out, run_note(settings), resume=resume):
        for i, stage in enumerate(STAGES):
            if stage is end:
                report_so_far(context)
                return None
            without = (
                # stage explain leaves out the plant if a found term has a state
                "on_model" if context.scenario.plant is not None else "control",
                *(
                    name
                    for name, wanted in (("explain", settings.explain), ("track", settings.track))
                    if not wanted
                ),
            )
            ahead = [
                s.name for s in STAGES[i:] if s.name not in (*skip, *without) and (not only or s.name in only)
            ]
            announced = stage.name not in without  # a stage that is not part of this run does not begin
            if announced:
                context.progress.start(stage.title + remaining(took, ahead))
            begun = time.monotonic()
            if only and stage.name not in (*only, *ALWAYS):
                said = _as_it_is(context, stage, only)
            else:
                said = bring_up_to_date(context, stage, stage.name in skip)
                if not said and stage in (PRIOR, TRAINING, EVALUATION):
                    report_so_far(context)
                if not said and announced:
                    took[stage.name] = time.monotonic() - begun
            if announced:
                context.progress.finish(said)
    return read_results(out / "results.json")


def remaining(took: Mapping[str, float], ahead: Sequence[str]) -> str:
    """Estimated time of the remaining stages, as text; empty before the training has finished.

    Args:
        took: Durations of finished stages [s].
        ahead: Names of the remaining stages.

    Example:
        >>> remaining({"data": 8.0, "prior": 44.0, "training": 52.0}, ["watch", "analysis", "report"])
        ' (about 2 min left)'
        >>> remaining({"data": 4.0}, ["prior"])
        ''
    """
    known_ = sum(SECONDS[name] for name in took)
    left = sum(SECONDS[name] for name in ahead)
    if known_ < SECONDS["training"] or not left:
        return ""
    seconds = left * sum(took.values()) / known_
    if seconds < 90:
        return f" (about {max(10, 10 * round(seconds / 10)):.0f} s left)"
    return f" (about {seconds / 60:.0f} min left)"


def check_choice(only: Sequence[str], skip: Sequence[str]) -> None:
    """Refuse unknown names of stages, and skipping a stage that the others need."""
    for name in (*only, *skip):
        known(name, NAMES, "stage")
    optional = [stage.name for stage in STAGES if stage.optional]
    needed = [name for name in skip if name not in optional]
    if needed:
        raise InputError(
            f"--skip {needed[0]}: a run needs this stage. Stages that can be skipped: {', '.join(optional)}"
            " [HM-WORKFLOW-031]"
        )


def _end(context: Context, only: Sequence[str]) -> Stage[Any] | None:
    """The first required stage without a stored result that ``only`` does not name; None if there is none.

    Raises:
        InputError: If a stage that may run needs it.
    """
    if not only:
        return None
    for i, stage in enumerate(STAGES):
        if stage.optional or stage.name in (*only, *ALWAYS):
            continue
        stored = context.stored(stage)
        if stored is not None and not stored.unfit:
            continue
        later = [s.name for s in STAGES[i:] if s.name in only and s is not REPORT]
        if later:
            why = f"has not run in {context.out}" if stored is None else f"must run again: {stored.unfit}"
            raise InputError(
                f"stage {stage.name} {why}, but stage {later[0]} needs it. Run without --only [HM-WORKFLOW-032]"
            )
        return stage
    return None


def _as_it_is(context: Context, stage: Stage[Any], only: Sequence[str] = ()) -> str:
    """Use the stored result of a stage; its part of the artifact is restored if nothing has changed.

    Raises:
        InputError: If something that the stage read has changed, and a stage that may run (``only``) needs it.
    """
    stored = context.stored(stage)
    if stored is None or stored.unfit:
        context.leave_out(stage, f"stage {stage.name} was skipped")
        return "skipped"
    keys = stage.keys(context)
    if differ := differing(stored.keys, keys):
        needing = [s.name for s in STAGES if s.name in only and s is not REPORT and stage in _needed(s)]
        if needing:
            raise InputError(
                f"stage {stage.name} is out of date: {differ}, but stage {needing[0]} needs it. Add --only "
                f"{stage.name}, or run without --only [HM-WORKFLOW-033]"
            )
    why = changed(stored.keys, keys)
    if not why and not isinstance(stored.result, Absent):
        why = stage.restore(context, stored.result)
    if why:
        context.progress.warn(f"stage {stage.name} is out of date: {why}")
    return "stored result used"


def _needed(stage: Stage[Any]) -> list[Stage[Any]]:
    """All stages that a stage reads, directly or indirectly."""
    return [one for need in stage.needs for one in (need, *_needed(need))]


def failed_stages(out: Path) -> dict[str, str]:
    """Reasons of failed stages of a run, by stage; empty if none failed."""
    context = Context(RunSettings(""), None, out)  # type: ignore[arg-type]
    found = {stage.name: context.stored(stage) for stage in STAGES}
    absent = {name: stored.result for name, stored in found.items() if stored is not None}
    return {name: a.reason for name, a in absent.items() if isinstance(a, Absent) and a.failed}
