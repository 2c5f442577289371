"""Run the study ``monitor``: learn, then judge; resumable, with a report."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from hybrid_mpc.compare.study import Study
from hybrid_mpc.compare.study_log import NOUN, RUNS, RunLog, RunRow, rows, study_note
from hybrid_mpc.compare.study_run import (
    THREADS,
    Config,
    execute,
    finished,
    held_models,
    job_note,
    load_inputs,
    make_note,
    run_batch,
)
from hybrid_mpc.engine import Engine, Progress, make_engine
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.folder import check_out, open_folder
from hybrid_mpc.kit.artifact import Kit, load
from hybrid_mpc.kit.assembly import adaptable
from hybrid_mpc.records import record
from hybrid_mpc.scenario import load_scenario
from scenarios.golf_robot.monitor_study.detection import Detectors
from scenarios.golf_robot.monitor_study.loops import (
    CONTROLLER,
    DETECTORS,
    LEARNING,
    PRIOR,
    MonitorRunner,
    learn,
)
from scenarios.golf_robot.monitor_study.plan import LEARN, MonitorJob, MonitorStudy
from scenarios.golf_robot.monitor_study.report import write_monitor_report
from scenarios.golf_robot.monitor_study.results import monitor_results

RESULTS = "results.json"
KIND = "monitor"


def run_monitor_study(
    study: MonitorStudy,
    out: str | Path,
    *,
    workers: int = 2,
    resume: bool = False,
    retry_failed: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run the study into a folder and return its results.

    What is finished is on the disk; after a kill at any moment ``resume=True`` goes on.
    """
    out, say = Path(out), progress or Progress()
    check_out(out, NOUN, resume=resume)
    say.start("reading the model, and the filters' noise")
    loops, models = load_inputs(
        Study(study.scenario, study.model, tasks=(study.task,), controllers=(PRIOR, CONTROLLER)),
        held_models(out),
    )
    (model,) = loops.models
    note = make_note(study.identity(), models, study.size, KIND)
    say.finish(f"{study.size} jobs")
    if study.guard_seeds:
        causes = load_scenario(study.scenario).causes
        adaptable(load(Path(model.folder)).models["hybrid"], causes)  # or the last loops would fail
    run = MonitorRunner(study, model, str(out.resolve()))
    engine = make_engine(partial(run_batch, run), workers, threads=THREADS)
    try:
        jobs = list(study.jobs())
        with open_folder(out, job_note(note), resume=resume), RunLog(out / RUNS) as log:
            todo = _Todo(out, log, engine, say, finished(out, retry_failed))
            first = [job for job in jobs if job.kind == LEARN]
            todo.run("nominal loops to learn from", first)
            if not (out / DETECTORS).is_file():
                _learn(study, out, first, load(Path(model.folder)))
            shutil.rmtree(out / LEARNING, ignore_errors=True)  # detectors.json has what was learned
            todo.run("nominal, faulted and guarded loops", [job for job in jobs if job.kind != LEARN])
    finally:
        engine.close()
    return finish(out)


def finish(out: Path) -> dict[str, Any]:
    """Results and report of a study's folder, of one that still runs too."""
    note = study_note(out)
    done = {row.id: row.plain() for row in rows(out / RUNS)}
    detectors = record(Detectors, read_json(out / DETECTORS), str(out / DETECTORS))
    results = monitor_results(note.study, detectors, list(done.values()))
    write_json(out / RESULTS, results)
    write_monitor_report(out, results, note)
    return results


class _Todo:
    """What is left of a study, run in its engine."""

    def __init__(
        self,
        out: Path,
        log: RunLog,
        engine: Engine[tuple[Config, ...], list[RunRow]],
        say: Progress,
        done: set[str],
    ) -> None:
        self._out, self._log, self._engine, self._say, self._done = out, log, engine, say, done

    def run(self, title: str, jobs: Iterable[MonitorJob]) -> None:
        """Those of the jobs that are not done."""
        left = [job for job in jobs if job.id not in self._done]
        self._say.start(title)
        told = execute(iter(left), self._log, self._engine, self._say, len(left))
        self._say.finish(told.text if left else "done before")


def _learn(study: MonitorStudy, out: Path, jobs: list[MonitorJob], artifact: Kit) -> None:
    failed = [row for row in rows(out / RUNS) if row.columns["kind"] == LEARN and row.status == "failed"]
    paths = [out / LEARNING / f"{job.id}.npz" for job in jobs]
    if failed and not all(path.is_file() for path in paths):
        raise InputError(
            f"{out}: a nominal loop for learning failed: {failed[-1].error.strip().splitlines()[-1]}. Repeat it with "
            "--resume --retry-failed [HM-SCENARIOS-016]"
        )
    write_json(out / DETECTORS, learn(study, paths, artifact))
