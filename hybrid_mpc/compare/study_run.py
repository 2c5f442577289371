"""Run a study: run every loop once, and write its row when it ends, even if the process or workers are killed."""

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

from hybrid_mpc.compare.controllers import CONTROLLERS, ORACLES, find_noise, noise_name
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
"""Begin of the names of columns with durations and processes; only these columns differ when a study is repeated."""
BATCH_S = 0.5
"""Target duration of a batch [s]: short runs are sent to workers in batches to reduce overhead."""
BATCHES_A_SECOND = 50.0
"""Largest rate of batches of all workers together: a dask scheduler and the log take a few ms for each batch."""
BATCH_MOST = 500
AHEAD = 2
"""Batches for each worker: one in progress, and one waiting."""
THREADS = 1
"""Threads of the numerical libraries in each process: runs are small, and all cores are used by processes."""
PROBE_PERIODS = 20
"""Periods of each kind of run that a dry run measures."""


# The models of a study


@dataclass(frozen=True)
class StudyModel:
    """A loaded and checked model of a study, the hash of its folder, and the source of its filters' noise."""

    folder: Path
    sha256: str
    kit: Kit
    noise_source: str

    def note(self, controllers: Iterable[str]) -> ModelNote:
        """Its note, with the noise of the filters of these controllers."""
        names = {noise_name(c): None for c in controllers if not CONTROLLERS[c].truth}
        sigma = {name: tuple(self.kit.noise(name).tolist()) for name in names}
        return ModelNote(self.sha256, plain(self.kit.provenance), NoiseNote(self.noise_source, sigma))


def load_models(
    study: Study, held: Mapping[str, NoiseNote] | None = None, *, plant: bool = True
) -> dict[str, StudyModel]:
    """Load and check everything that a study's loops need.

    Args:
        study: The study.
        held: Process noise by label of the model. Default: the artifact's; if it has none, the noise is estimated on
            simulated recordings (budget quick, seed ``study.run_seed``).
        plant: Whether the scenario must have a plant; otherwise a model may replace it. Default: True.

    Raises:
        InputError: If the scenario has nothing to run, a folder holds no artifact of this machine, or a task, fault or
            parameter is unknown.
    """
    scenario = load_scenario(study.scenario)
    if not plant:
        scenario = ready(scenario)
    check_complete(scenario, plant=plant)
    selected_tasks(scenario, study.tasks)
    if scenario.oracle is None and (oracles := [c for c in study.controllers if c in ORACLES]):
        raise InputError(
            f"controller {oracles[0]}: scenario {scenario.name} has no oracle. Omit this controller [HM-COMPARE-055]"
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
        found[label] = StudyModel(folder, _hash_files(_read_files(folder)), kit.with_noise(noise), source)
    return found


def _check_plant(scenario: Scenario, study: Study, kit: Kit) -> None:
    """Refuse faults and parameters that plant or model do not have and, without a plant, controllers without a model
    that can replace it.
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


# Input of the workers


@dataclass(frozen=True)
class ModelInput:
    """A model for workers; it contains the files of its folder for workers that cannot see the folder."""

    label: str
    folder: str
    digest: str
    noise: tuple[tuple[str, tuple[float, ...]], ...]
    files: tuple[tuple[str, bytes], ...] = ()


def load_inputs(
    study: Study, held: Mapping[str, ModelNote] | None = None
) -> tuple[LoopRunner, dict[str, ModelNote]]:
    """Runner of a study's loops, and notes of its models by label; ``held`` are the notes of a resumed study."""
    models, notes = [], {}
    for label, m in load_models(study, {k: note.noise for k, note in (held or {}).items()}).items():
        notes[label] = note = m.note(study.controllers)
        noise = tuple(note.noise.sigma_x.items())
        models.append(ModelInput(label, str(m.folder.resolve()), m.sha256, noise))
    return LoopRunner(study.scenario, tuple(models)), notes


@dataclass(frozen=True)
class LoopRunner:
    """Runs a study's loops; each worker gets it once and keeps the models loaded."""

    scenario: str
    models: tuple[ModelInput, ...]

    def __call__(self, spec: LoopSpec) -> dict[str, Any]:
        """The loop's columns: cost, errors, limits, figures of the task, alarms, and ``timing_...``."""
        bench, alone = _load_bench(self)
        with alone:
            begin = perf_counter()
            bench.parts(spec)
            built = perf_counter()
            row, _ = bench.run(spec)
            times = {f"{TIMING}setup_s": built - begin, f"{TIMING}run_s": perf_counter() - built}
            return row.columns() | {"hidden_units": bench.kits[spec.model].models["hybrid"].n_h} | times

    def carry_files(self) -> LoopRunner:
        """A copy with the models' files, for workers on other computers."""
        models = tuple(replace(m, files=_read_files(Path(m.folder))) for m in self.models)
        return replace(self, models=models)


@lru_cache(maxsize=1)
def _load_bench(runner: LoopRunner) -> tuple[Bench, Lock]:
    kits = {m.label: load(local_folder(m)).with_noise(dict(m.noise)) for m in runner.models}
    return Bench(load_scenario(runner.scenario), kits), Lock()


def local_folder(model: ModelInput) -> Path:
    """The model's folder if this computer has it, else a temporary folder with its files."""
    folder = Path(model.folder)
    if folder.is_dir() and _hash_files(_read_files(folder)) == model.digest:
        return folder
    if not model.files:
        raise InputError(
            f"study: {folder}, model {model.label}, has changed since the study began. Use a copy of the folder that "
            "does not change [HM-COMPARE-056]"
        )
    unpacked = Path(tempfile.mkdtemp(prefix="hybrid-mpc-model-"))
    for name, content in model.files:
        (unpacked / name).parent.mkdir(parents=True, exist_ok=True)
        (unpacked / name).write_bytes(content)
    return unpacked


def _read_files(folder: Path) -> tuple[tuple[str, bytes], ...]:
    return tuple((name, read_bytes(folder / name, MOST_CONTENT)) for name in sorted(artifact_files(folder)))


def _hash_files(files: Sequence[tuple[str, bytes]]) -> str:
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

    Rows are written when runs end; after a kill, Ctrl-C or a full disk, ``resume=True`` runs the missing ones. Results
    only depend on the study, except for the columns that begin with ``timing_``. A failed run leaves its traceback, and
    the other runs continue.

    Args:
        study: The study.
        out: Folder to write; it must be new or empty unless ``resume``.
        workers: Number of processes on this computer. Default: 2.
        cluster: Address of a dask scheduler or a ``distributed.Client``, in place of processes. Default: none.
        resume: Whether to continue the study in ``out``. Default: False.
        retry_failed: Whether to repeat failed runs. Default: False.
        progress: Where to report. Default: nowhere.

    Returns:
        The results, also in ``out/results.parquet``.

    Raises:
        InputError: For any bad input, an unreachable scheduler, or a full disk.

    Example:
        >>> results = run_study(Study("golf_robot", "runs/golf"), "studies/first")  # doctest: +SKIP
    """
    out, say = Path(out), progress or Progress()
    check_out(out, NOUN, resume=resume)
    say.start("reading the models and the observers' noise")
    run, models = load_inputs(study, held_models(out))
    note = make_note(study.identity(), models, study.size)
    say.finish(f"{study.size} runs")
    if cluster is not None and isinstance(run, LoopRunner):  # workers may not see the folders of the models
        run = run.carry_files()
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
    # import plots and pandas only after all checks
    from hybrid_mpc.compare.study_results import StudyResults

    return StudyResults.load(out)


def make_note(
    study: Mapping[str, Any], models: Mapping[str, ModelNote], runs: int, kind: str = "loops"
) -> StudyNote:
    """The note of a study with these settings (including its scenario) and models."""
    scenario, path = load_scenario(study["scenario"]), Path(study["scenario"])
    content = sha256(path) if path.suffix == ".py" and path.is_file() else None
    return StudyNote(study, scenario.title, scenario.description, models, runs, versions(), kind, content)


def job_note(note: StudyNote, noun: str = NOUN) -> JobNote:
    """The note in the folder of a study, or of another job (``noun``) with its settings."""
    models = {f"the content of model {label}": model.sha256 for label, model in note.models.items()}
    settings = {key: value for key, value in note.study.items() if key != "name"}
    settings |= models | {"the content of the scenario's file": note.scenario_sha256}
    return JobNote(noun, settings, plain(note))


def held_models(out: Path) -> Mapping[str, ModelNote] | None:
    """Notes of the models of the study in a folder; None without a study."""
    return study_note(out).models if (out / f"{NOUN}.json").is_file() else None


def finished(out: Path, retry_failed: bool) -> set[str]:
    """Ids of the finished runs."""
    status = {row.id: row.status for row in rows(out / RUNS)}
    return {id for id, how in status.items() if how == "done" or not retry_failed}


# Batches of runs in an engine


class Config(Protocol):
    """Specification of a run, e.g. a :class:`~hybrid_mpc.compare.loops.LoopSpec`."""

    @property
    def id(self) -> str:
        """Digest of everything that the result of the run depends on."""

    def columns(self) -> dict[str, Any]:
        """Columns that describe the run."""


def run_batch(run: Callable[[Any], Mapping[str, Any]], configs: Sequence[Config]) -> list[RunRow]:
    """Rows of several runs; a failed run has its traceback in ``error``."""
    found = []
    for config in configs:
        begin, cpu = perf_counter(), process_time()
        status, error, results = "done", "", {}
        try:
            with no_exit():
                results = dict(run(config))
        except Exception:  # keep the traceback and continue with the other runs
            status, error = "failed", traceback.format_exc()
        times = {f"{TIMING}total_s": perf_counter() - begin, f"{TIMING}cpu_s": process_time() - cpu}
        place = {f"{TIMING}process": f"{socket.gethostname()}:{os.getpid()}"}
        found.append(RunRow(config.id, status, error, {**config.columns(), **results, **times, **place}))
    return found


@dataclass
class Tally:
    """Counts of runs: in total, finished, failed; ``died`` is the number of dead workers, whose runs were restarted."""

    total: int
    runs: int = 0
    failed: int = 0
    died: int = 0
    begin: float = 0.0

    @property
    def text(self) -> str:
        """Text with rate and remaining time."""
        rate = self.runs / max(time.monotonic() - self.begin, 1e-9)
        words = [f"{rate:.3g} runs/s"]
        if 0 < self.runs < self.total:
            from hybrid_mpc.compare.study_results import duration_text

            words.append(f"{duration_text((self.total - self.runs) / rate)} left")
        if self.failed:
            words.append(f"{self.failed} failed")
        if self.died:
            words.append(f"{self.died} workers died, their runs were restarted")
        return ", ".join(words)


def execute(
    configs: Iterable[Config],
    log: RunLog,
    engine: Engine[tuple[Config, ...], list[RunRow]],
    progress: Progress,
    total: int,
) -> Tally:
    """Run configurations in an engine and log their rows.

    Only a few batches are submitted at any time; rows are logged before the next result is fetched. ``total`` is the
    number of configurations, for the progress report.
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
            result = suspects.give_up(batch, result)
        suspects.alone = None
        log.append(result)
        pace.learn(result)
        tally.died = engine.died
        tally.runs += len(result)
        tally.failed += sum(row.status == "failed" for row in result)
        progress.update("runs", tally.runs, total, tally.text)


class _Suspects:
    """Runs of dead workers: each is repeated alone, to find the run that kills workers."""

    def __init__(self) -> None:
        self.left: list[Config] = []
        self.alone: Config | None = None
        self._tries: dict[str, int] = {}

    def next(self, running: int) -> tuple[Config, ...]:
        """The next suspect if nothing else runs; otherwise empty."""
        if running or not self.left:
            return ()
        self.alone = self.left.pop()
        return (self.alone,)

    def give_up(self, batch: Sequence[Config], lost: Lost) -> list[RunRow]:
        """Add the runs of a lost batch to the suspects; returns the rows of runs that count as failed."""
        found = []
        for config in batch:
            alone = self.alone is not None and config.id == self.alone.id
            tries = self._tries[config.id] = self._tries.get(config.id, 0) + 1
            # number of dead workers after which a run counts as failed
            if not alone or (tries < 3 and not lost.final):
                self.left.append(config)
                continue
            error = f"its worker died {tries} times ({lost}): out of memory, or a crash outside Python"
            found.append(RunRow(config.id, "failed", error, config.columns()))
        return found


class _Pace:
    """Number of runs in a batch: as many as fit into ``BATCH_S``, more with many workers."""

    def __init__(self, workers: int) -> None:
        self.size, self._aim = 1, max(BATCH_S, workers / BATCHES_A_SECOND)

    def learn(self, done: Sequence[RunRow]) -> None:
        spent = sum(row.columns.get(f"{TIMING}total_s", 0.0) for row in done)
        if done:
            wanted = int(self._aim * len(done) / max(spent, 1e-6))
            self.size = max(1, min(wanted, 2 * self.size, BATCH_MOST))


# Dry run: expected time of a study


@dataclass(frozen=True)
class RunKind:
    """Runs with about the same computing time for each period."""

    model: str
    controller: str
    solver: str
    horizon: int | None


@dataclass(frozen=True)
class Plan:
    """Expected time of a study [s]: of all runs on the given workers, without the start of processes, and of one run of
    each kind, averaged over tasks.
    """

    runs: int
    axes: dict[str, int]
    seconds: float
    kinds: dict[RunKind, float]


@no_exit()
@named_extra("a study")
def dry_run(study: Study, *, workers: int = 2, say: Callable[[str], None] = lambda text: None) -> Plan:
    """Check a study, and estimate its computing time from a few periods of each kind of run.

    Args:
        study: The study.
        workers: Number of processes of the study. Default: 2.
        say: Called with a text about the run that is measured. Default: nothing.

    Returns:
        Number of ``runs``, levels of each axis (``axes``), expected ``seconds`` of all runs, and ``kinds`` of runs with
        the seconds of one run.

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
