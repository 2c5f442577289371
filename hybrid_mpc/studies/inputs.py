"""What a study's runs need: the models and their noise, as workers get them."""

from __future__ import annotations

import hashlib
import os
import socket
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from time import perf_counter, process_time
from typing import Any

import numpy as np

from hybrid_mpc.artifact import FILES, artifact_folder, load
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import MOST_CONTENT, read_bytes
from hybrid_mpc.job.contenders import CONTENDERS
from hybrid_mpc.job.loops import Bench, LoopSpec, check_faults, varied
from hybrid_mpc.pipeline.control_job import ControlSettings, prepared
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import Scenario, load_scenario
from hybrid_mpc.studies.configuration import Study
from hybrid_mpc.studies.draws import RandomFaults
from hybrid_mpc.studies.note import ModelNote, NoiseNote

TIMING = "timing_"
"""Columns that begin so are durations and places: they differ between two runs, no other does."""


@dataclass(frozen=True)
class ModelInput:
    """A model as workers get it.

    Args:
        label: Its name in the study.
        folder: Artifact folder.
        digest: SHA-256 of the folder's files.
        noise: Process noise by contender.
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
    settings = ControlSettings(tuple(study.tasks), study.contenders)
    for label, folder in study.folders.items():
        before = held[label].noise if held and label in held else None
        known = None if before is None else {name: np.array(v) for name, v in before.sigma_x.items()}
        job = prepared(scenario, folder, settings, known, named=study.scenario)
        inner = artifact_folder(folder)
        if "energy" in study.monitors and job.kit.calibration is None:
            raise InputError(f"study: monitor energy: {inner} holds no calibration; take monitor own")
        source = job.noise_source if before is None else before.source
        sigma = {c: tuple(job.kit.noise(c).tolist()) for c in study.contenders if not CONTENDERS[c].truth}
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
