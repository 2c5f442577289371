"""Run a study: every loop once, on the disk as it ends, whatever happens to the process or to its workers."""

from __future__ import annotations

import hashlib
import os
import socket
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from threading import Lock
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from hybrid_mpc.compare.controllers import CONTROLLERS, ORACLES, find_noise
from hybrid_mpc.compare.loops import (
    Bench,
    LoopSpec,
    check_complete,
    check_faults,
    check_kit,
    stand_in,
    varied,
)
from hybrid_mpc.compare.study import RandomFaults, Study
from hybrid_mpc.compare.study_log import (
    NOUN,
    RESULTS,
    RUNS,
    ModelNote,
    NoiseNote,
    RunLog,
    RunRow,
    StudyNote,
    compact,
    intact,
    rows,
    study_note,
)
from hybrid_mpc.compare.tasks import ready, selected_tasks
from hybrid_mpc.engine import Engine, Lost, Progress, make_engine
from hybrid_mpc.errors import InputError, named_extra, no_exit
from hybrid_mpc.files import MOST_CONTENT, read_bytes, sha256
from hybrid_mpc.folder import JobNote, check_out, open_folder, versions
from hybrid_mpc.kit.artifact import Kit, load
from hybrid_mpc.kit.assembly import adaptable
from hybrid_mpc.kit.parts import artifact_files, artifact_folder
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from hybrid_mpc.compare.study_results import StudyResults

TIMING = "timing_"
"""Columns that begin so are durations and places: they differ between two runs, no other does."""
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
PROBE_PERIODS = 20
"""Periods of each kind of run that a dry run times."""


# The models of a study


@dataclass(frozen=True)
class StudyModel:
    """A loaded model that fits its study, the hash of its folder, and where its filters' noise is from, in words."""

    folder: Path
    sha256: str
    kit: Kit
    noise_source: str


def load_models(
    study: Study, held: Mapping[str, NoiseNote] | None = None, *, plant: bool = True
) -> dict[str, StudyModel]:
    """Load and check everything that a study's loops need, before the first; without ``plant`` a model may stand in for
    the machine.

    Process noise by label in ``held`` is taken as it is; else it is the artifact's, or, where that holds none,
    estimated on recordings that the scenario makes (budget quick, seed ``study.run_seed``).

    Raises:
        InputError: If the scenario has nothing to run, a folder holds no artifact or another machine's, or a task,
            fault or parameter does not fit.
    """
    scenario = load_scenario(study.scenario)
    if not plant:
        scenario = ready(scenario)
    check_complete(scenario, plant=plant)
    selected_tasks(scenario, study.tasks)
    if scenario.oracle is None and (oracles := [c for c in study.controllers if c in ORACLES]):
        raise InputError(
            f"scenario {scenario.name} has no oracle; leave controller {oracles[0]} out [HM-COMPARE-055]"
        )
    found = {}
    for label, given in study.folders.items():
        folder = artifact_folder(given)
        kit = load(folder)
        check_kit(scenario, kit, str(folder))
        _check_plant(scenario, study, kit)
        for kind in {"guard", "energy", "residuals"}.intersection(study.monitors):
            kit.on(scenario).monitor("hybrid", kind=kind)
        if study.guard == "adapt":
            adaptable(kit.models["hybrid"], scenario.causes)
        if held is None or label not in held:
            noise, source = find_noise(scenario, kit, study.controllers, study.run_seed)
        else:
            noise, source = {k: np.array(v) for k, v in held[label].sigma_x.items()}, held[label].source
        found[label] = StudyModel(folder, _digest(_files(folder)), kit.with_noise(noise), source)
    return found


def _check_plant(scenario: Scenario, study: Study, kit: Kit) -> None:
    """Refuse faults and parameters that the plant, or a model with its signals, does not have; and controllers that
    have no model to run on where there is no plant.
    """
    own = scenario.plant
    stands = [] if own is not None else [stand_in(kit, name) for name in study.controllers]
    plant = varied(stands[0] if own is None else own(), [(name, 1.0) for name, _ in study.spans])
    model = kit.models["prior"]
    sets = list(study.fault_sets)
    if isinstance(study.random_faults, RandomFaults):
        sets.append(study.random_faults.examples())
    for faults in sets:
        check_faults(replace(scenario, plant=lambda: plant), faults, model)


# What workers get


@dataclass(frozen=True)
class ModelInput:
    """A model as workers get it; its folder's files are in it for workers that do not see the folder."""

    label: str
    folder: str
    digest: str
    noise: tuple[tuple[str, tuple[float, ...]], ...]
    files: tuple[tuple[str, bytes], ...] = ()


def load_inputs(
    study: Study, held: Mapping[str, ModelNote] | None = None
) -> tuple[LoopRunner, dict[str, ModelNote]]:
    """What runs a study's loops, and notes of its models by label; ``held`` are those of a study that is resumed."""
    models, notes = [], {}
    for label, m in load_models(study, {k: note.noise for k, note in (held or {}).items()}).items():
        sigma = {c: tuple(m.kit.noise(c).tolist()) for c in study.controllers if not CONTROLLERS[c].truth}
        models.append(ModelInput(label, str(m.folder.resolve()), m.sha256, tuple(sigma.items())))
        notes[label] = ModelNote(m.sha256, plain(m.kit.provenance), NoiseNote(m.noise_source, sigma))
    return LoopRunner(study.scenario, tuple(models)), notes


@dataclass(frozen=True)
class LoopRunner:
    """Runs a study's loops; it is sent to each worker once, which then keeps the models loaded."""

    scenario: str
    models: tuple[ModelInput, ...]

    def __call__(self, spec: LoopSpec) -> dict[str, Any]:
        """The loop's columns: cost, errors, limits, figures of the task, alarms, and ``timing_...``."""
        bench, alone = _bench(self)
        with alone:
            begin = perf_counter()
            bench.parts(spec)
            built = perf_counter()
            row, _ = bench.run(spec)
            times = {f"{TIMING}setup_s": built - begin, f"{TIMING}run_s": perf_counter() - built}
            return row.columns() | {"hidden_units": bench.kits[spec.model].models["hybrid"].n_h} | times

    def with_files(self) -> LoopRunner:
        """The same with the models' files in it, for workers on other machines."""
        models = tuple(replace(m, files=_files(Path(m.folder))) for m in self.models)
        return replace(self, models=models)


@lru_cache(maxsize=1)
def _bench(runner: LoopRunner) -> tuple[Bench, Lock]:
    """The bench of a process, and what lets one thread at a time to it."""
    kits = {m.label: load(local_folder(m)).with_noise(dict(m.noise)) for m in runner.models}
    return Bench(load_scenario(runner.scenario), kits), Lock()


def local_folder(model: ModelInput) -> Path:
    """The model's folder if this machine has it, else one that its files are unpacked in."""
    folder = Path(model.folder)
    if folder.is_dir() and _digest(_files(folder)) == model.digest:
        return folder
    if not model.files:
        raise InputError(
            f"study: {folder} is not the model {model.label} any more that the study began with; take a copy of the "
            "folder that nobody changes [HM-COMPARE-056]"
        )
    unpacked = Path(tempfile.mkdtemp(prefix="hybrid-mpc-model-"))
    for name, content in model.files:
        (unpacked / name).parent.mkdir(parents=True, exist_ok=True)
        (unpacked / name).write_bytes(content)
    return unpacked


def _files(folder: Path) -> tuple[tuple[str, bytes], ...]:
    return tuple((name, read_bytes(folder / name, MOST_CONTENT)) for name in sorted(artifact_files(folder)))


def _digest(files: Sequence[tuple[str, bytes]]) -> str:
    whole = hashlib.sha256()
    for name, content in files:
        whole.update(f"{name}\0{len(content)}\0".encode() + content)
    return whole.hexdigest()


# The study


@no_exit()
@named_extra("a study")
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
    what is missing. Results depend on nothing but the study; only columns that begin with ``timing_`` differ. A run
    that raises leaves its traceback, and the others go on.

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
    out, say = Path(out), progress or Progress()
    check_out(out, NOUN, resume=resume)
    say.start("reading the models, and the filters' noise")
    run, models = load_inputs(study, held_models(out))
    note = make_note(study.identity(), models, study.size)
    say.finish(f"{study.size} runs")
    if cluster is not None and isinstance(run, LoopRunner):  # its workers may not see the models' folders
        run = run.with_files()
    engine = make_engine(partial(run_batch, run), workers, cluster, threads=THREADS)
    try:
        with open_folder(out, job_note(note), resume=resume), RunLog(out / RUNS) as log:
            done = finished(out, retry_failed)
            say.start("running")
            left = (spec for spec in study.runs() if spec.id not in done)
            if study.size > len(done) or not intact(out / RESULTS):
                (out / RESULTS).unlink(missing_ok=True)
            tally = execute(left, log, engine, say, study.size - len(done))
            say.finish(tally.text)
            if not (out / RESULTS).is_file():
                made = replace(study_note(out), engine=engine.name, workers_died=tally.died)
                compact(out / RUNS, out / RESULTS, plain(made))
    finally:
        engine.close()
    # plots and pandas: what is refused, is refused before
    from hybrid_mpc.compare.study_results import StudyResults

    return StudyResults.load(out)


def make_note(
    study: Mapping[str, Any], models: Mapping[str, ModelNote], runs: int, kind: str = "loops"
) -> StudyNote:
    """What a study of these settings (with its scenario) and models is made of."""
    scenario, path = load_scenario(study["scenario"]), Path(study["scenario"])
    content = sha256(path) if path.suffix == ".py" and path.is_file() else None
    return StudyNote(study, scenario.title, scenario.description, models, runs, versions(), kind, content)


def job_note(note: StudyNote) -> JobNote:
    """What a study's folder says of it."""
    models = {f"the content of model {label}": model.sha256 for label, model in note.models.items()}
    settings = {key: value for key, value in note.study.items() if key != "name"}
    settings |= models | {"the content of the scenario's file": note.scenario_sha256}
    return JobNote(NOUN, settings, plain(note))


def held_models(out: Path) -> Mapping[str, ModelNote] | None:
    """Notes of the models of the study that a folder holds; None if it holds none yet."""
    return study_note(out).models if (out / f"{NOUN}.json").is_file() else None


def finished(out: Path, retry_failed: bool) -> set[str]:
    """Ids of the runs that need not run."""
    status = {row.id: row.status for row in rows(out / RUNS)}
    return {id for id, how in status.items() if how == "done" or not retry_failed}


# Batches of runs in an engine


class Config(Protocol):
    """What a run is made of, e.g. a :class:`~hybrid_mpc.compare.loops.LoopSpec`."""

    @property
    def id(self) -> str:
        """Name made of all that decides what it computes."""

    def columns(self) -> dict[str, Any]:
        """What says which run it is."""


def run_batch(run: Callable[[Any], Mapping[str, Any]], configs: Sequence[Config]) -> list[RunRow]:
    """Rows of several runs; one that raises leaves its traceback in ``error``."""
    found = []
    for config in configs:
        begin, cpu = perf_counter(), process_time()
        status, error, results = "done", "", {}
        try:
            with no_exit():
                results = dict(run(config))
        except Exception:  # the study goes on; the traceback is what there is to report
            status, error = "failed", traceback.format_exc()
        times = {f"{TIMING}total_s": perf_counter() - begin, f"{TIMING}cpu_s": process_time() - cpu}
        place = {f"{TIMING}process": f"{socket.gethostname()}:{os.getpid()}"}
        found.append(RunRow(config.id, status, error, {**config.columns(), **results, **times, **place}))
    return found


@dataclass
class Tally:
    """What became of the runs so far; ``died`` workers have died, and what they were at was begun again."""

    total: int
    runs: int = 0
    failed: int = 0
    died: int = 0
    begin: float = 0.0

    @property
    def text(self) -> str:
        """In words, with rate and remaining time."""
        rate = self.runs / max(time.monotonic() - self.begin, 1e-9)
        words = [f"{rate:.3g} runs/s"]
        if 0 < self.runs < self.total:
            from hybrid_mpc.compare.study_results import duration_text

            words.append(f"{duration_text((self.total - self.runs) / rate)} left")
        if self.failed:
            words.append(f"{self.failed} failed")
        if self.died:
            words.append(f"{self.died} workers died, what they were at was begun again")
        return ", ".join(words)


def execute(
    configs: Iterable[Config],
    log: RunLog,
    engine: Engine[tuple[Config, ...], list[RunRow]],
    progress: Progress,
    total: int,
) -> Tally:
    """Run configurations, taken as they are needed, in an engine and log their rows.

    At any time a few batches are under way; a row is logged before the next batch is asked for. ``total`` is how many
    there are, for the report.
    """
    tally, left, pace = Tally(total, begin=time.monotonic()), iter(configs), _Pace(engine.workers)
    suspects, running = _Suspects(), 0
    while True:
        while batch := suspects.next(running) or (
            tuple(islice(left, pace.size)) if running < AHEAD * engine.workers and not suspects.left else ()
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
            result = suspects.given_up(batch, result)
        suspects.alone = None
        log.append(result)
        pace.learn(result)
        tally.died = engine.died
        tally.runs += len(result)
        tally.failed += sum(row.status == "failed" for row in result)
        progress.update("runs", tally.runs, total, tally.text)


class _Suspects:
    """Runs whose worker died: they are begun again one at a time with nothing beside them, to find the culprit."""

    def __init__(self) -> None:
        self.left: list[Config] = []
        self.alone: Config | None = None
        self._tries: dict[str, int] = {}

    def next(self, running: int) -> tuple[Config, ...]:
        """The next suspect once nothing else runs; empty if there is none, or something runs."""
        if running or not self.left:
            return ()
        self.alone = self.left.pop()
        return (self.alone,)

    def given_up(self, batch: Sequence[Config], lost: Lost) -> list[RunRow]:
        """Suspect the runs of a lost batch; rows of those that are given up."""
        found = []
        for config in batch:
            alone = self.alone is not None and config.id == self.alone.id
            tries = self._tries[config.id] = self._tries.get(config.id, 0) + 1
            if not alone or (tries < TRIES and not lost.final):
                self.left.append(config)
                continue
            error = f"its worker died {tries} times ({lost}); out of memory, or a crash outside Python"
            found.append(RunRow(config.id, "failed", error, config.columns()))
        return found


class _Pace:
    """How many runs make a batch: as many as fit into ``BATCH_S``, more where there are many workers."""

    def __init__(self, workers: int) -> None:
        self.size, self._aim = 1, max(BATCH_S, workers / BATCHES_A_SECOND)

    def learn(self, done: Sequence[RunRow]) -> None:
        spent = sum(row.columns.get(f"{TIMING}total_s", 0.0) for row in done)
        if done:
            wanted = int(self._aim * len(done) / max(spent, 1e-6))
            self.size = max(1, min(wanted, 2 * self.size, BATCH_MOST))


# What a study would take


@dataclass(frozen=True)
class RunKind:
    """Runs that take about the same time a period."""

    model: str
    controller: str
    solver: str
    horizon: int | None


@dataclass(frozen=True)
class Plan:
    """What a study would take: seconds of all runs on the given workers, without starting processes, and of a run of
    each kind, averaged over tasks.
    """

    runs: int
    axes: dict[str, int]
    seconds: float
    kinds: dict[RunKind, float]


@no_exit()
@named_extra("a study")
def dry_run(study: Study, *, workers: int = 2, say: Callable[[str], None] = lambda text: None) -> Plan:
    """Check a study as far as running it would, and expect its time from a few periods of each kind of run.

    Args:
        study: The study.
        workers: Processes that it is to run in.
        say: Called with what is timed.

    Returns:
        Number of ``runs``, how many of each thing (``axes``), expected ``seconds`` of all, and ``kinds`` of runs with
        the seconds of one.

    Raises:
        InputError: As :func:`run_study`.

    Example: ``dry_run(study, workers=2).seconds``
    """
    scenario = load_scenario(study.scenario)
    run, _ = load_inputs(study)
    dt, lengths = scenario.data.dt, {task.name: task.duration for task in scenario.tasks}
    firsts: dict[tuple[RunKind, str], LoopSpec] = {}
    for spec in replace(study, draws=1, seeds=study.loop_seeds[:1], faults=study.fault_sets[:1]).runs():
        firsts.setdefault((RunKind(spec.model, spec.controller, spec.solver, spec.horizon), spec.task), spec)
    tasks, kinds = {task for _, task in firsts}, dict[RunKind, float]()
    for (kind, task), first in firsts.items():
        say(f"{first.controller}, {task}")
        period = run(replace(first, duration=PROBE_PERIODS * dt))[f"{TIMING}run_s"] / PROBE_PERIODS
        periods = min(lengths[task], study.duration or lengths[task]) / dt
        kinds[kind] = kinds.get(kind, 0.0) + period * periods / len(tasks)
    return Plan(study.size, study.axes, study.size / len(kinds) * sum(kinds.values()) / workers, kinds)
