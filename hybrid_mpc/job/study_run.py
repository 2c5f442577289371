"""Run a study: every run once, kept as it ends, whatever happens to the process or to its workers."""

from __future__ import annotations

import hashlib
import os
import socket
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from threading import Lock
from time import perf_counter, process_time
from typing import Any

import numpy as np

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import MOST_CONTENT, read_bytes, sha256
from hybrid_mpc.job.context import Progress, Silent
from hybrid_mpc.job.control import ControlSettings, prepared
from hybrid_mpc.job.controllers import CONTROLLERS
from hybrid_mpc.job.engine import Engine, Lost, make_engine
from hybrid_mpc.job.folder import JobNote, check_folder, open_folder
from hybrid_mpc.job.loops import Bench, LoopSpec, check_faults, varied
from hybrid_mpc.job.stages.export import versions
from hybrid_mpc.job.study import RandomFaults, Study
from hybrid_mpc.job.study_log import FILE as NOTE
from hybrid_mpc.job.study_log import (
    RESULTS,
    ModelNote,
    NoiseNote,
    RunLog,
    StudyNote,
    compact,
    intact,
    read_note,
    rows,
    write_note,
)
from hybrid_mpc.job.study_results import StudyResults, duration_text
from hybrid_mpc.kit.artifact import FILES, artifact_folder, load
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import Scenario, load_scenario

# What a study's runs need: the models and their noise, as workers get them.

TIMING = "timing_"
"""Columns that begin so are durations and places: they differ between two runs, no other does."""


@dataclass(frozen=True)
class ModelInput:
    """A model as workers get it.

    Args:
        label: Its name in the study.
        folder: Artifact folder.
        digest: SHA-256 of the folder's files.
        noise: Process noise by controller.
        files: Names and contents of the folder's files, for workers that do not see the folder. Default: none.
    """

    label: str
    folder: str
    digest: str
    noise: tuple[tuple[str, tuple[float, ...]], ...]
    files: tuple[tuple[str, bytes], ...] = ()


@dataclass(frozen=True)
class LoopRunner:
    """Runs a study's loops; it is sent to each worker once, which then keeps the models loaded.

    Args:
        scenario: Registered name or path of a user's file.
        models: The models.

    Example: ``LoopRunner("golf_robot", models)(run)["cost"]``
    """

    scenario: str
    models: tuple[ModelInput, ...]

    def __call__(self, spec: LoopSpec) -> dict[str, Any]:
        """The loop's results: cost, errors, limits, figures of the task, alarms, and ``timing_...``."""
        worker = _worker(self)
        with worker.alone:
            return worker.run(spec)

    def with_files(self) -> LoopRunner:
        """The same with the models' files in it, for workers on other machines."""
        models = tuple(replace(m, files=_files(Path(m.folder))) for m in self.models)
        return replace(self, models=models)


@lru_cache(maxsize=1)
def _worker(runner: LoopRunner) -> _Worker:
    return _Worker(runner)


class _Worker:
    """The bench of a process; it serves one thread at a time."""

    def __init__(self, runner: LoopRunner) -> None:
        self.alone = Lock()
        kits = {m.label: load(local_folder(m)).with_noise(dict(m.noise)) for m in runner.models}
        self._bench = Bench(load_scenario(runner.scenario), kits)

    def run(self, spec: LoopSpec) -> dict[str, Any]:
        begin = perf_counter()
        self._bench.parts(spec)
        ready = perf_counter()
        row, _ = self._bench.run(spec)
        told = row.columns() | {"hidden_units": self._bench.kits[spec.model].models["hybrid"].n_h}
        return told | {f"{TIMING}setup_s": ready - begin, f"{TIMING}run_s": perf_counter() - ready}


def run_batch(run: Callable[[Any], Mapping[str, Any]], configs: Sequence[Any]) -> list[dict[str, Any]]:
    """Rows of several runs; one that raises leaves its traceback in ``error``.

    Args:
        run: Makes the results of one configuration.
        configs: Each with ``id`` and ``columns()``.
    """
    rows = []
    for config in configs:
        begin, cpu = perf_counter(), process_time()
        try:
            results: Mapping[str, Any] = {"status": "done", "error": "", **run(config)}
        except Exception:  # the study goes on; the traceback is what there is to tell
            results = {"status": "failed", "error": traceback.format_exc()}
        total: dict[str, Any] = {
            f"{TIMING}total_s": perf_counter() - begin,
            f"{TIMING}cpu_s": process_time() - cpu,
        }
        total[f"{TIMING}process"] = f"{socket.gethostname()}:{os.getpid()}"
        rows.append({"id": config.id, **config.columns(), **results, **total})
    return rows


def load_inputs(
    study: Study, held: Mapping[str, ModelNote] | None = None
) -> tuple[LoopRunner, dict[str, ModelNote]]:
    """Load and check everything that the runs need, before the first.

    Args:
        study: The study.
        held: Notes of the models of a study that is resumed: their noise is taken. Default: none.

    Returns:
        What runs the loops, and notes by label: the model's digest, its provenance, the noise and where it is from.

    Raises:
        InputError: If a model, task, fault or parameter does not fit the scenario.
    """
    scenario = load_scenario(study.scenario)
    _check_plant(scenario, study)
    models, notes = [], {}
    settings = ControlSettings(tuple(study.tasks), tuple(study.controllers))
    for label, folder in study.folders.items():
        before = held[label].noise if held and label in held else None
        known = None if before is None else {name: np.array(v) for name, v in before.sigma_x.items()}
        job = prepared(scenario, folder, settings, known, named=study.scenario)
        inner = artifact_folder(folder)
        if "energy" in study.monitors and job.kit.calibration is None:
            raise InputError(f"study: monitor energy: {inner} holds no calibration; take monitor own")
        source = job.noise_source if before is None else before.source
        sigma = {c: tuple(job.kit.noise(c).tolist()) for c in study.controllers if not CONTROLLERS[c].truth}
        digest = _digest(_files(inner))
        models.append(ModelInput(label, str(inner.resolve()), digest, tuple(sigma.items())))
        notes[label] = ModelNote(digest, plain(job.kit.provenance), NoiseNote(source, sigma))
    return LoopRunner(study.scenario, tuple(models)), notes


def _check_plant(scenario: Scenario, study: Study) -> None:
    """Refuse faults and parameters that the plant does not have."""
    if scenario.plant is None or scenario.control is None:
        return  # prepared says what lacks
    plant = varied(scenario.plant(), [(name, 1.0) for name, _ in study.spans])
    sets: list[Any] = list(study.fault_sets)
    if isinstance(study.random_faults, RandomFaults):
        sets.append(study.random_faults.examples())
    for faults in sets:
        check_faults(replace(scenario, plant=lambda: plant), faults)


def _files(folder: Path) -> tuple[tuple[str, bytes], ...]:
    return tuple((name, read_bytes(folder / name, MOST_CONTENT)) for name in sorted(FILES))


def _digest(files: Sequence[tuple[str, bytes]]) -> str:
    whole = hashlib.sha256()
    for name, content in files:
        whole.update(f"{name}\0{len(content)}\0".encode() + content)
    return whole.hexdigest()


def local_folder(model: ModelInput) -> Path:
    """The model's folder if this machine has it, else one that its files are unpacked in."""
    folder = Path(model.folder)
    if folder.is_dir() and _digest(_files(folder)) == model.digest:
        return folder
    if not model.files:
        raise InputError(
            f"study: {folder} is not the model {model.label} any more that the study began with; take a copy of the "
            "folder that nobody changes"
        )
    unpacked = Path(tempfile.mkdtemp(prefix="hybrid-mpc-model-"))
    for name, content in model.files:
        (unpacked / name).write_bytes(content)
    return unpacked


# What a study would take, found out by a few periods of each kind of run.

PROBE_PERIODS = 20
Kind = tuple[object, ...]


@dataclass(frozen=True)
class Plan:
    """What a study would take.

    Args:
        runs: Number of runs.
        axes: How many of each thing.
        seconds: Expected time of all runs on the given workers [s]; without starting processes.
        kinds: By model, controller, solver and horizon: seconds a run, averaged over tasks.
    """

    runs: int
    axes: dict[str, int]
    seconds: float
    kinds: dict[Kind, float]


def dry_run(
    study: Study,
    *,
    workers: int = 2,
    say: Callable[[str], None] = lambda text: None,
) -> Plan:
    """Check a study as far as running it would, and expect its time from a few periods of each kind of run.

    Args:
        study: The study.
        workers: Processes that it is to run in.
        say: Told what is timed.

    Raises:
        InputError: As :func:`~hybrid_mpc.job.study_run.run_study`.

    Example: ``dry_run(study, workers=2).seconds``
    """
    scenario = load_scenario(study.scenario)
    run, _ = load_inputs(study)
    dt, lengths = scenario.data.dt, {task.name: task.duration for task in scenario.tasks}
    tasks = list(dict.fromkeys(r.task for r in _first_runs(study)))
    period: dict[tuple[Kind, str], float] = {}
    for first in _first_runs(study):
        say(f"{first.controller}, {first.task}")
        probe = replace(first, duration=PROBE_PERIODS * dt)
        period[_kind(first), first.task] = run(probe)[f"{TIMING}run_s"] / PROBE_PERIODS
    kinds: dict[Kind, float] = {}
    for (kind, task), seconds in period.items():
        periods = min(lengths[task], study.duration or lengths[task]) / dt
        kinds[kind] = kinds.get(kind, 0.0) + seconds * periods / len(tasks)
    each = study.size / len(kinds)
    return Plan(study.size, study.axes, each * sum(kinds.values()) / workers, kinds)


def _kind(run: LoopSpec) -> Kind:
    return run.model, run.controller, run.solver, run.horizon


def _first_runs(study: Study) -> list[LoopSpec]:
    """One run of each kind and task."""
    small = replace(study, draws=1, seeds=study.loop_seeds[:1], faults=study.fault_sets[:1])
    kinds: dict[tuple[Kind, str], LoopSpec] = {}
    for run in small.runs():
        kinds.setdefault((_kind(run), run.task), run)
    return list(kinds.values())


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


def claim(note: StudyNote) -> JobNote:
    """What a study's folder says of it.

    Args:
        note: What the study is made of.
    """
    return JobNote(
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
