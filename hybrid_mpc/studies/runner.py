"""Run a study: every run once, kept as it ends, whatever happens to the process or to its workers."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from hybrid_mpc.files import sha256
from hybrid_mpc.job.engine import Engine, Lost, make_engine
from hybrid_mpc.job.folder import Claim, check_folder, open_folder
from hybrid_mpc.pipeline.context import Progress, Silent
from hybrid_mpc.pipeline.deploy import versions
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.studies.configuration import Study
from hybrid_mpc.studies.inputs import TIMING, LoopRunner, load_inputs, run_batch
from hybrid_mpc.studies.log import RunLog, rows
from hybrid_mpc.studies.note import FILE as NOTE
from hybrid_mpc.studies.note import ModelNote, StudyNote, read_note, write_note
from hybrid_mpc.studies.results import StudyResults
from hybrid_mpc.studies.table import RESULTS, compact, intact

RUNS = "runs"
BATCH_S = 0.5
"""Runs shorter than this are handed to workers several at a time, so that handing over costs little."""
BATCHES_A_SECOND = 50.0
"""Batches of all workers together are this many at most: a dask scheduler and the log take a few ms for each."""
BATCH_MOST = 500
AHEAD = 2
"""Batches a worker: one that it computes, and one that waits for it."""
TRIES = 3
"""How many workers may die of a run before it is given up."""
THREADS = 1
"""Of the numerical libraries in each process: runs are small, and as many processes as cores are side by side."""
Batch = tuple[Any, ...]
"""Some configurations, run one after the other by one worker."""
Rows = list[dict[str, Any]]
"""Their results."""


def run_study(
    study: Study,
    out: str | Path,
    *,
    workers: int = 2,
    cluster: Any = None,
    resume: bool = False,
    retry_failed: bool = False,
    progress: Progress | None = None,
) -> StudyResults:
    """Run a study into a folder and return its results.

    Finished runs are on the disk as they end; after a kill at any moment, Ctrl-C or a full disk ``resume=True`` runs
    what is missing. Results depend on nothing but the study: not on order, number of workers, or engine; only columns
    that begin with ``timing_`` differ. A run that raises is kept with its traceback, and the others go on.

    Args:
        study: What to run.
        out: Folder to make; it must be new or empty unless ``resume``.
        workers: Processes on this machine.
        cluster: Address of a dask scheduler or a ``distributed.Client``, in place of processes. Default: none.
        resume: Finish the study that ``out`` holds.
        retry_failed: Run those again that have failed.
        progress: Where to report; default: nowhere.

    Returns:
        The results, also in ``out/results.parquet``.

    Raises:
        InputError: For any bad input, an unreachable scheduler, or a disk that is full.

    Example:
        >>> results = run_study(Study("golf_robot", "runs/golf"), "studies/first")  # doctest: +SKIP
    """
    out, say = Path(out), progress or Silent()
    check_folder(out, "study", NOTE, resume=resume)
    say.start("reading the models, and the filters' noise")
    run, models = load_inputs(study, read_note(out).models if (out / NOTE).is_file() else None)
    note = make_note(study.identity(), models, study.size)
    say.finish(f"{study.size} runs")
    if cluster is not None and isinstance(run, LoopRunner):  # its workers may not see the models' folders
        run = run.with_files()
    engine = make_engine(partial(run_batch, run), workers, cluster, threads=THREADS)
    try:
        with open_folder(out, claim(note), resume=resume), RunLog(out / RUNS) as log:
            done = finished(out, retry_failed)
            say.start("running")
            left = (config for config in study.runs() if config.id not in done)
            if study.size > len(done) or not intact(out / RESULTS):
                (out / RESULTS).unlink(missing_ok=True)
            told = execute(left, log, engine, say, study.size - len(done))
            say.finish(told.text)
            if not (out / RESULTS).is_file():
                made = replace(read_note(out), engine=engine.name, workers_died=told.died)
                compact(out / RUNS, out / RESULTS, plain(made))
    finally:
        engine.close()
    return StudyResults.load(out)


@dataclass
class Tally:
    """What became of the runs so far.

    Args:
        total: Runs to do.
        runs: Runs that are done.
        failed: Those of them that failed.
        died: Workers that have died, and whose runs were begun again.
        begin: When it began, on the monotonic clock.
    """

    total: int
    runs: int = 0
    failed: int = 0
    died: int = 0
    begin: float = 0.0

    @property
    def text(self) -> str:
        """In words, with rate and remaining time."""
        spent = max(time.monotonic() - self.begin, 1e-9)
        rate = self.runs / spent
        words = [f"{rate:.3g} runs/s"]
        if 0 < self.runs < self.total:
            words.append(f"{duration_text((self.total - self.runs) / rate)} left")
        if self.failed:
            words.append(f"{self.failed} failed")
        if self.died:
            words.append(f"{self.died} workers died, what they were at was begun again")
        return ", ".join(words)


def execute(
    configs: Iterable[Any], log: RunLog, engine: Engine[Batch, Rows], progress: Progress, total: int
) -> Tally:
    """Run configurations in an engine and log their rows.

    At any time a few batches are under way; a row is logged before the next batch is asked for.

    Args:
        configs: Each with ``id`` and ``columns()``; taken as they are needed.
        log: Where the rows go.
        engine: Where they are computed.
        progress: Where to report.
        total: How many there are, for the report.
    """
    tally, waiting, pace = Tally(total, begin=time.monotonic()), iter(configs), _Pace(engine.workers)
    suspects = _Suspects()
    running = 0
    while True:
        while batch := suspects.next(running) or (
            _next_batch(waiting, pace) if running < AHEAD * engine.workers and not suspects.left else ()
        ):
            engine.submit(batch)
            running += 1
        if not running:
            return tally
        ended = engine.next(timeout=1.0)
        if ended is None:
            continue
        running -= 1
        batch, result = ended
        if isinstance(result, Lost):
            result = suspects.judge(batch, result)
        suspects.alone = None
        log.append(result)
        pace.learn(result)
        tally.died = engine.died
        tally.runs += len(result)
        tally.failed += sum(row["status"] == "failed" for row in result)
        progress.update("runs", tally.runs, total, tally.text)


class _Suspects:
    """Runs whose worker died: they are begun again one at a time with nothing beside them, to find the culprit."""

    def __init__(self) -> None:
        self.left: list[Any] = []
        self.alone: Any = None
        self._tries: dict[str, int] = {}

    def next(self, running: int) -> Batch:
        """The next suspect once nothing else runs; empty if there is none, or something runs."""
        if running or not self.left:
            return ()
        self.alone = self.left.pop()
        return (self.alone,)

    def judge(self, batch: Batch, lost: Lost) -> Rows:
        """Suspect the runs of a lost batch; rows of those that are given up."""
        given_up = []
        for config in batch:
            alone = self.alone is not None and config.id == self.alone.id
            tries = self._tries[config.id] = self._tries.get(config.id, 0) + 1
            if not alone or (tries < TRIES and not lost.final):
                self.left.append(config)
                continue
            error = f"its worker died {tries} times ({lost}); out of memory, or a crash outside Python"
            given_up.append({"id": config.id, **config.columns(), "status": "failed", "error": error})
        return given_up


class _Pace:
    """How many runs make a batch: as many as fit into ``BATCH_S``, more where there are many workers."""

    def __init__(self, workers: int) -> None:
        self.size, self._aim = 1, max(BATCH_S, workers / BATCHES_A_SECOND)

    def learn(self, done: Rows) -> None:
        spent = sum(row.get(f"{TIMING}total_s", 0.0) for row in done)
        if done:
            wanted = int(self._aim * len(done) / max(spent, 1e-6))
            self.size = max(1, min(wanted, 2 * self.size, BATCH_MOST))


def _next_batch(waiting: Iterator[Any], pace: _Pace) -> Batch:
    """Some runs; empty where none is left."""
    return tuple(islice(waiting, pace.size))


def duration_text(seconds: float) -> str:
    """A duration as people say it.

    Example:
        >>> duration_text(42.0), duration_text(600.0), duration_text(7300.0), duration_text(4e5)
        ('42 s', '10 min', '2.0 h', '4.6 d')
    """
    for size, unit, digits in ((86400.0, "d", 1), (3600.0, "h", 1), (60.0, "min", 0)):
        if seconds >= 2 * size or (unit != "min" and seconds >= 1.5 * size):
            return f"{seconds / size:.{digits}f} {unit}"
    return f"{seconds:.0f} s"


def make_note(
    study: Mapping[str, Any], models: Mapping[str, ModelNote], runs: int, kind: str = "loops"
) -> StudyNote:
    """What a study is made of.

    Args:
        study: Its settings as plain data, with its scenario.
        models: Its models by label.
        runs: Number of its runs.
        kind: Kind of study. Default: closed loops of all combinations.
    """
    scenario = load_scenario(study["scenario"])
    return StudyNote(
        study,
        scenario.title,
        scenario.description,
        models,
        runs,
        versions(),
        kind,
        _content(study["scenario"]),
    )


def claim(note: StudyNote) -> Claim:
    """What a study's folder says of it.

    Args:
        note: What the study is made of.
    """
    return Claim(
        "study",
        NOTE,
        _identity(note),
        lambda out: write_note(out, note),
        lambda out: _identity(read_note(out)),
    )


def _identity(note: StudyNote) -> dict[str, Any]:
    models = {f"the content of model {label}": model.sha256 for label, model in note.models.items()}
    settings = {key: value for key, value in note.study.items() if key != "name"}
    return {**settings, **models, "the content of the scenario's file": note.scenario_sha256}


def _content(scenario: str) -> str | None:
    """SHA-256 of a user's scenario file; None for a registered scenario."""
    path = Path(scenario)
    return sha256(path) if path.suffix == ".py" and path.is_file() else None


def finished(out: Path, retry_failed: bool) -> set[str]:
    """Ids of the runs that need not run."""
    status = {row["id"]: row["status"] for row in rows(out / RUNS)}
    return {id for id, how in status.items() if how == "done" or not retry_failed}
