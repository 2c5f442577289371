"""One run of a study: the closed loop that ``hybrid-mpc control`` runs, as a row of a table."""

from __future__ import annotations

import hashlib
import os
import socket
import tempfile
import traceback
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from time import perf_counter, process_time
from typing import Any

import numpy as np

from hybrid_mpc.artifact import FILES, Kit, artifact_folder, load
from hybrid_mpc.assembly import make_monitor
from hybrid_mpc.closed_loop import ClosedLoopResult, simulate
from hybrid_mpc.closed_loop.faults import check_channels, install
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import MOST_CONTENT, read_bytes
from hybrid_mpc.job.contenders import CONTENDERS
from hybrid_mpc.pipeline.control_job import ControlSettings, Job, parts, prepared, selected_tasks
from hybrid_mpc.pipeline.control_results import row
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import Scenario, Task, load_scenario
from hybrid_mpc.studies.configuration import Study
from hybrid_mpc.studies.draws import RandomFaults, varied
from hybrid_mpc.studies.note import ModelNote, NoiseNote
from hybrid_mpc.studies.run_config import RunConfig

KEPT_PARTS = 64
"""Controllers that a process keeps built; runs come ordered by controller, so few are asked for again."""
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

    def __call__(self, run: RunConfig) -> dict[str, Any]:
        """The run's results: cost, errors, limits, figures of the task, alarms, and ``timing_...``."""
        loops = _loops(self)
        with loops.alone:
            return loops.run(run)

    def with_files(self) -> LoopRunner:
        """The same with the models' files in it, for workers on other machines."""
        models = tuple(replace(m, files=_files(Path(m.folder))) for m in self.models)
        return replace(self, models=models)


@lru_cache(maxsize=1)
def _loops(runner: LoopRunner) -> _Loops:
    return _Loops(runner)


class _Loops:
    """Models and controllers of a process, built when first needed; they serve one thread at a time."""

    def __init__(self, runner: LoopRunner) -> None:
        self.alone = Lock()
        self._scenario = load_scenario(runner.scenario)
        self._inputs = {m.label: m for m in runner.models}
        self._artifacts: dict[str, Kit] = {}
        self._parts: OrderedDict[tuple[object, ...], tuple[Any, Any]] = OrderedDict()

    def run(self, run: RunConfig) -> dict[str, Any]:
        begin = perf_counter()
        (task,) = selected_tasks(self._scenario, (run.task,))
        task = _with_horizon(task, self._scenario, run.horizon)
        artifact = self._artifact(run.model)
        estimator, controller = self._made(run, task, artifact)
        assert self._scenario.plant is not None
        ready = perf_counter()
        result = simulate(
            varied(self._scenario.plant(), run.parameters), estimator, controller, task.reference,
            weight=task.weight, dt=artifact.models["prior"].dt,
            duration=min(task.duration, run.duration or task.duration), x0=np.array(task.x0),
            seed=run.noise_seed, monitor=_monitor(run, artifact), faults=(*task.faults, *run.faults, *run.drawn_faults),
            late=_late(run) if run.late else None,
        )  # fmt: skip
        shown = figures(task, run, result) | {"hidden_units": artifact.models["hybrid"].n_h}
        return shown | {f"{TIMING}setup_s": ready - begin, f"{TIMING}run_s": perf_counter() - ready}

    def _artifact(self, label: str) -> Kit:
        if label not in self._artifacts:
            self._artifacts[label] = load(_local_folder(self._inputs[label]))
        return self._artifacts[label]

    def _made(self, run: RunConfig, task: Task, artifact: Kit) -> tuple[Any, Any]:
        key = (run.model, run.controller, run.solver, task.control or self._scenario.control)
        if key not in self._parts:
            noise = {name: np.array(sigma) for name, sigma in self._inputs[run.model].noise}
            settings = ControlSettings((run.task,), (run.controller,), run.solver)
            job = Job(self._scenario, artifact, (task,), settings, noise, "")
            self._parts[key] = parts(job, task, run.controller)
            if len(self._parts) > KEPT_PARTS:
                self._parts.popitem(last=False)
        self._parts.move_to_end(key)
        return self._parts[key]


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


def figures(task: Task, run: RunConfig, result: ClosedLoopResult) -> dict[str, Any]:
    """A loop's figures in one flat row.

    Args:
        task: The task.
        run: Its configuration.
        result: Its record.
    """
    r = row(task, run.controller, run.seed, result)
    alarms = np.flatnonzero(result.alarm)
    level = result.level[np.isfinite(result.level)]
    return {
        "cost": r["cost"],
        "tracking_rmse_rad": r["tracking_rmse_rad"],
        "largest_u": r["largest_u"],
        "largest_x": float(np.abs(result.x[:, 0]).max()),
        **{f"share_{source}": share for source, share in r["sources"].items()},
        **{f"task_{name}": float(value) for name, value in r["figures"].items()},
        "alarm_share": float(np.mean(result.alarm)),
        "first_alarm_s": float(result.t[alarms[0]]) if alarms.size else float("nan"),
        "largest_level_w": float(level.max()) if level.size else float("nan"),
        **{f"{TIMING}step_{k}_ms": v for k, v in r["timing_ms"]["total"].items()},
        **{f"{TIMING}solve_{k}_ms": v for k, v in r["timing_ms"]["solve"].items()},
    }


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
        job = prepared(scenario, folder, settings, known)
        inner = artifact_folder(folder)
        if "energy" in study.monitors and job.artifact.calibration is None:
            raise InputError(f"study: monitor energy: {inner} holds no calibration; take monitor own")
        source = job.noise_source if before is None else before.source
        sigma = {c: tuple(map(float, job.noise[c])) for c in study.contenders if c in job.noise}
        digest = _digest(_files(inner))
        models.append(ModelInput(label, str(inner.resolve()), digest, tuple(sigma.items())))
        notes[label] = ModelNote(digest, plain(job.artifact.provenance), NoiseNote(source, sigma))
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
        outside = install(plant, faults)[1]
        check_channels(outside, len(scenario.sensor_sigma), scenario.control.n_u)


def _with_horizon(task: Task, scenario: Scenario, horizon: int | None) -> Task:
    if horizon is None:
        return task
    control = task.control or scenario.control
    assert control is not None
    return replace(task, control=control.changed(horizon=horizon))


def _monitor(run: RunConfig, artifact: Kit) -> Any:
    if run.monitor == "none" or CONTENDERS[run.controller].model != "hybrid":
        return None
    calibration = None
    if run.monitor == "energy" and artifact.calibration is not None:
        calibration = artifact.calibration
    return make_monitor(artifact.models["hybrid"], calibration)


def _late(run: RunConfig) -> Callable[[float], bool]:
    return lambda t: any(a - 1e-9 <= t < b - 1e-9 for a, b in run.late)


def _files(folder: Path) -> tuple[tuple[str, bytes], ...]:
    return tuple((name, read_bytes(folder / name, MOST_CONTENT)) for name in sorted(FILES))


def _digest(files: Sequence[tuple[str, bytes]]) -> str:
    whole = hashlib.sha256()
    for name, content in files:
        whole.update(f"{name}\0{len(content)}\0".encode() + content)
    return whole.hexdigest()


def _local_folder(model: ModelInput) -> Path:
    """The model's folder if this machine has it, else one that its files are unpacked in."""
    folder = Path(model.folder)
    if not model.files:
        return folder
    if folder.is_dir() and _digest(_files(folder)) == model.digest:
        return folder
    unpacked = Path(tempfile.mkdtemp(prefix="hybrid-mpc-model-"))
    for name, content in model.files:
        (unpacked / name).write_bytes(content)
    return unpacked
