"""The files of an artifact: one folder, in which each file is written by exactly one stage of a run.

=============================  ============================================================  ==============
file                           content                                                       written by
=============================  ============================================================  ==============
``kit.json``                   machine, signals, provenance, default model                   ``export``
``models/``                    programs and weights of the models                            ``export``
``observer.json``              noise of sensors and states, disturbances, tracked parameters ``noise``
``tasks.json``, ``tasks/``     common control problem, safe input; problems of single tasks  ``tasks``
``watch/NAME.json``            limits of all channels of the monitor with a model            ``watch``
``promises.json``              promises of the kit (:mod:`hybrid_mpc.kit.promises`)          ``promises``
=============================  ============================================================  ==============

A file that depends on others holds their digest (``of``): the noise that of the models, limits that of the observer
that they were learned with. :func:`read_parts` combines the files that match, and lists those that are missing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.tracking import TrackedParameter
from hybrid_mpc.files import digest, is_file, read_document, read_object, reason, write_document
from hybrid_mpc.kit.prediction import Predicting
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.model.disturbance import Disturbance
from hybrid_mpc.model.limits import numbers
from hybrid_mpc.records import Fields, plain, record
from hybrid_mpc.rules import (
    Duration,
    Line,
    Name,
    NameOrNone,
    NotNegative,
    Number,
    Positive,
    Seconds,
    Text,
    Unit,
)
from hybrid_mpc.scenario import Scenario
from hybrid_mpc.watch.detector import WatchLimits

SCHEMA_VERSION = 6
"""Format version of the whole folder, described in docs/kit.md."""
KIT, MODELS, OBSERVER, TASKS = "kit.json", "models", "observer.json", "tasks.json"
WATCH = "watch/*.json"
PROGRAMS, WEIGHTS = f"{MODELS}/programs.json", f"{MODELS}/weights.safetensors"
OWNERS: Mapping[str, str] = {
    KIT: "export", PROGRAMS: "export", WEIGHTS: "export", OBSERVER: "noise", TASKS: "tasks", "tasks/*.json": "tasks",
    WATCH: "watch", "promises.json": "promises",
}  # fmt: skip
"""The only stage of a run that writes a file, by file."""
MOST_MODELS = 16
"""Largest number of models in an artifact: prior, hybrid, and a few for comparison."""
HYBRID = "hybrid"
MOST_MEMBERS = 32
"""Largest number of single networks of the hybrid in an artifact."""
BALANCE = "balance"
"""Begin of a balance's program name: ``<model>/balance/<name of the balance>``."""
AGAIN = "repeat the command of the run with --resume"
R = TypeVar("R")


@dataclass(frozen=True)
class BalanceInfo:
    """Name and units of a :class:`~hybrid_mpc.model.model.Balance`: of the storage, and of its rate and residual."""

    name: Name
    unit: Unit
    rate_unit: Unit

    def __post_init__(self) -> None:
        Fields(self, f"balance {self.name!r}").refuse()

    @property
    def program(self) -> str:
        """Name of its program among those of a model."""
        return f"{BALANCE}/{self.name}"


@dataclass(frozen=True)
class ModelInfo:
    """Description of the models besides their programs; the same for all models of an artifact.

    Args:
        dt: Model period [s].
        states: Signals of x.
        inputs: Signals of u.
        outputs: Signals of y.
        parameters: The prior's parameters with their fitted values, in the order of p. Default: none.
        input_delay: Delay [s] from a command to the input of the programs. Default: 0.
        time_unit: Time constant of the machine [s], see :class:`~hybrid_mpc.model.model.HybridModel`. Default: 1.
        disturbances: Signals of w. Default: none.
        nominal_w: Default of w. Default: zeros.
        covariance: Rows of the covariance of the fitted values. Default: unknown.
        balances: Balances with programs. Default: none.
        nominal_x: State of the operating point. Default: zeros.
        nominal_u: Input of the operating point. Default: zeros.
        state_spread: Spread of the states in the training recordings; 0 for a constant state. Default: unknown.
        output_spread: Spread of the outputs. Default: unknown.

    Raises:
        InputError: If a field is of the wrong kind, period or time constant are not positive, the delay is negative, or
            names of signals, parameters or balances are not unique. The message lists all errors together.
    """

    dt: Seconds
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    parameters: tuple[Parameter, ...] = ()
    input_delay: Duration = 0.0
    time_unit: Positive = 1.0
    disturbances: tuple[Signal, ...] = ()
    nominal_w: tuple[Number, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()
    balances: tuple[BalanceInfo, ...] = ()
    nominal_x: tuple[Number, ...] = ()
    nominal_u: tuple[Number, ...] = ()
    state_spread: tuple[NotNegative, ...] = ()
    output_spread: tuple[NotNegative, ...] = ()

    def __post_init__(self) -> None:
        own = Fields(self, "model")
        for role in ("states", "inputs", "outputs", "disturbances", "parameters", "balances"):
            own.distinct(role, partial(_names, self, role), f"{role}: the name")
        own.refuse()


def _names(info: ModelInfo, role: str) -> list[str]:
    return [one.name for one in getattr(info, role)]


@dataclass(frozen=True)
class Provenance:
    """Origin of an artifact. It contains no path, and is never executed.

    Args:
        scenario: Name of the scenario.
        seed: Seed of data and training.
        budget: Name of the budget.
        data_hash: Hash of the recordings.
        versions: Versions of the packages.
        prior_parameters: Fitted values [SI] of the prior's parameters by name.
    """

    scenario: Line = ""
    seed: int = 0
    budget: Line = ""
    data_hash: Line = ""
    versions: Mapping[Line, Line] = field(default_factory=dict)
    prior_parameters: Mapping[Name, float] = field(default_factory=dict)


@dataclass(frozen=True)
class LoopSettings:
    """Settings of loops besides the models.

    Args:
        control: Control problems by task; ``""`` is the common one, of all tasks without one of their own. Default:
            none.
        sensor_sigma: Standard deviations of the sensors ``(n_y,)`` [output units] in the estimators.
        first_sigma: Initial standard deviations of the states that no output measures directly. Default: from sensors
            and ranges.
        process_noise: Standard deviations per period ``(n_x,)`` [state units] by estimator: the name of the model,
            followed by ``_observer`` if an unknown load is estimated. Default: none.
        causes: Possible faults by name: the parameters that change together. Default: none.
        safe_input: Input ``(n_u,)`` with which the machine may be left alone. Default: not declared.
        tasks: Names of the tasks, with or without a control problem of their own. Default: those of ``control``.
        disturbance_model: Unmeasured disturbances. Default: one at each input.
        tracked: Parameters that :meth:`~hybrid_mpc.kit.artifact.Kit.tracking_observer` tracks. Default: none.

    Raises:
        InputError: If a field is of the wrong kind, a deviation is negative or not finite, a name of a task is not
            unique, or the safe input is outside a problem's limits. The message lists all errors together.
    """

    control: Mapping[NameOrNone, OCP] = field(default_factory=dict)
    sensor_sigma: tuple[NotNegative, ...] = ()
    first_sigma: tuple[NotNegative, ...] | None = None
    process_noise: Mapping[Name, tuple[NotNegative, ...]] = field(default_factory=dict)
    causes: Mapping[Name, tuple[Name, ...]] = field(default_factory=dict)
    safe_input: tuple[Number, ...] | None = None
    tasks: tuple[Name, ...] = ()
    disturbance_model: tuple[Disturbance, ...] | None = None
    tracked: tuple[TrackedParameter, ...] = ()

    def __post_init__(self) -> None:
        own = Fields(self, "loop")
        own.distinct("tasks", lambda: self.tasks, "tasks: the name")
        own.need(
            "safe_input control",
            lambda: (
                self.safe_input is None or all(_within(self.safe_input, p) for p in self.control.values())
            ),
            f"safe_input: {self.safe_input} is outside the limits of a control problem; choose it within [HM-KIT-029]",
        )
        own.refuse()


def _within(u: tuple[float, ...], problem: OCP) -> bool:
    """Whether an input has the size of a problem's inputs and lies within their limits."""
    return len(u) == problem.n_u and all(
        low <= value <= high for value, low, high in zip(u, problem.u_min, problem.u_max, strict=True)
    )


def loop_settings(
    scenario: Scenario, process_noise: Mapping[str, tuple[float, ...]] | None = None
) -> LoopSettings:
    """Settings of a scenario's loops; ``process_noise`` by estimator, empty if it is estimated later."""
    problems = {"": scenario.control} | {task.name: task.control for task in scenario.tasks}
    safe = scenario.safe_input
    return LoopSettings(
        {name: problem for name, problem in problems.items() if problem is not None}, scenario.sensor_sigma,
        scenario.first_sigma, dict(process_noise or {}), dict(scenario.causes),
        None if safe is None else tuple(numbers(safe, "safe_input").tolist()),
        tuple(task.name for task in scenario.tasks), scenario.disturbance_model,
    )  # fmt: skip


@dataclass(frozen=True)
class Description:
    """Content of ``kit.json`` besides format version and hash.

    Args:
        models: Names of the models.
        programs_sha256: Hash of ``models/programs.json``.
        model: Period, signals and parameters of all models.
        provenance: Origin of the models.
        recommended: Name of the default model of a loop; empty means the hybrid.
        members: Number of networks that the hybrid is the mean of; the artifact also holds each alone, the best first.
            Default: 0, the hybrid is a single network.
        predicting: Settings of predictions of recordings. Default: none, predictions are not possible.

    Raises:
        InputError: If there are no models, too many models, or two models with the same name.
    """

    models: tuple[Name, ...]
    programs_sha256: Line
    model: ModelInfo
    provenance: Provenance
    recommended: NameOrNone = ""
    members: int = 0
    predicting: Predicting | None = None

    def __post_init__(self) -> None:
        Fields(self, "artifact").refuse()
        if not 0 <= self.members <= (MOST_MEMBERS if HYBRID in self.models else 0):
            raise InputError(
                f"members: give 0 to {MOST_MEMBERS}, and a model {HYBRID!r} with any member; got {self.members}"
                " [HM-KIT-030]"
            )
        if self.recommended and self.recommended not in self.models:
            raise InputError(
                f"recommended: no model {self.recommended!r}; choose one of: {', '.join(self.models)} [HM-KIT-031]"
            )
        if not 0 < len(set(self.models)) == len(self.models) <= MOST_MODELS:
            raise InputError(
                f"models: give 1 to {MOST_MODELS} different names, got {len(self.models)} [HM-KIT-032]"
            )


@dataclass(frozen=True)
class ObserverSettings:
    """Content of ``observer.json``.

    Args:
        sensor_sigma: As in :class:`LoopSettings`.
        first_sigma: As in :class:`LoopSettings`.
        process_noise: As in :class:`LoopSettings`.
        disturbance_model: As in :class:`LoopSettings`.
        of: Digest of the models that the noise was estimated with (:attr:`Parts.models`). Empty: given by hand, valid
            for any models.
        tracked: As in :class:`LoopSettings`. Default: none, as in kits of older versions.
    """

    sensor_sigma: tuple[NotNegative, ...] = ()
    first_sigma: tuple[NotNegative, ...] | None = None
    process_noise: Mapping[Name, tuple[NotNegative, ...]] = field(default_factory=dict)
    disturbance_model: tuple[Disturbance, ...] | None = None
    of: Line = ""
    tracked: tuple[TrackedParameter, ...] = ()


@dataclass(frozen=True)
class TaskList:
    """Content of ``tasks.json``, which is written after the files in ``tasks/``.

    Args:
        control: The common control problem, of all tasks without one of their own; None if missing.
        safe_input: As in :class:`LoopSettings`.
        causes: As in :class:`LoopSettings`.
        tasks: As in :class:`LoopSettings`.
        own: Digests of the control problems of single tasks, in ``tasks/NAME.json``.
    """

    control: OCP | None = None
    safe_input: tuple[Number, ...] | None = None
    causes: Mapping[Name, tuple[Name, ...]] = field(default_factory=dict)
    tasks: tuple[Name, ...] = ()
    own: Mapping[Name, Line] = field(default_factory=dict)


@dataclass(frozen=True)
class TaskProblem:
    """Content of ``tasks/NAME.json``: the control problem of a task."""

    control: OCP


@dataclass(frozen=True)
class WatchFile:
    """Content of ``watch/NAME.json``: limits of a monitor with the model of that name.

    Args:
        limits: Limits by kind of readings (:mod:`hybrid_mpc.watch.readings`).
        reason: Why limits are missing. Default: empty, none are missing.
        rest_speed: Speeds ``(n_q,)`` below which friction may stick. Default: unknown.
        of: Digest of the observer that the limits were learned with (:meth:`Parts.observer`). Empty: given by hand,
            valid for any observer.
    """

    limits: Mapping[Name, WatchLimits]
    reason: Text = ""
    rest_speed: tuple[Positive, ...] = ()
    of: Line = ""


@dataclass(frozen=True)
class Parts:
    """Combined content of the files of an artifact.

    Args:
        description: Content of ``kit.json``.
        loop: Settings of loops: control problems, noise.
        watch: Limits of the monitors, by model.
        lacks: Missing content and the stage that writes it, by file.
    """

    description: Description
    loop: LoopSettings
    watch: Mapping[str, WatchFile]
    lacks: Mapping[str, str]

    @property
    def models(self) -> str:
        """Digest of the models; process noise depends on it."""
        return digest([self.description.programs_sha256, self.description.model.input_delay])

    def observer(self, model: str) -> str:
        """Digest of a model's observer: models, noise, and sizes of the loads; limits depend on it."""
        loop, problem, sizes = self.loop, self.loop.control.get(""), None
        if problem is not None:  # sizes of loads that do not act at inputs also depend on weights
            spans: object = (problem.u_min, problem.u_max, problem.input_range, problem.horizon)
            sizes = spans if loop.disturbance_model is None else problem
        noise = loop.process_noise.get(f"{model}_observer")
        return digest(
            [self.models, model, noise, loop.sensor_sigma, loop.first_sigma, loop.disturbance_model, sizes]
        )


def write_description(folder: Path, description: Description) -> None:
    """Write ``kit.json``."""
    _write(folder, KIT, description)


def write_observer(folder: Path, observer: ObserverSettings) -> None:
    """Write ``observer.json`` unless it already has this content."""
    _write_once(folder, OBSERVER, observer)


def write_tasks(folder: Path, loop: LoopSettings) -> None:
    """Write control problems, safe input and causes of loops, ``tasks.json`` last; skip files with this content."""
    problems = {name: TaskProblem(problem) for name, problem in loop.control.items() if name}
    for name, problem in problems.items():
        _write_once(folder, _task_file(name), problem)
    own = {name: str(read_object(folder / _task_file(name)).get("sha256")) for name in problems}
    _write_once(folder, TASKS, TaskList(loop.control.get(""), loop.safe_input, loop.causes, loop.tasks, own))
    kept = {Path(_task_file(name)).name for name in own}
    for path in (folder / "tasks").glob("*.json"):
        if path.name not in kept:
            path.unlink()


def write_watch(folder: Path, watch: Mapping[str, WatchFile]) -> None:
    """Write ``watch/NAME.json`` of each model unless it has this content; delete files of other models."""
    for name, limits in watch.items():
        _write_once(folder, watch_file(name), limits)
    for path in (folder / "watch").glob("*.json"):
        if path.stem not in watch:
            path.unlink()


def watch_file(model: str) -> str:
    """File of the limits of a monitor with a model, relative to the artifact's folder."""
    return f"watch/{model}.json"


def save_loop(folder: Path, loop: LoopSettings) -> None:
    """Write settings of loops from a script: ``tasks.json``, ``tasks/``, ``observer.json``."""
    write_tasks(folder, loop)
    sigmas = loop.sensor_sigma, loop.first_sigma, loop.process_noise
    write_observer(folder, ObserverSettings(*sigmas, loop.disturbance_model, tracked=loop.tracked))


def set_process_noise(folder: Path, noise: Mapping[str, ArrayLike]) -> None:
    """Write the process noise of the estimators by hand: standard deviations per period ``(n_x,)``, by estimator.

    Raises:
        InputError: If the folder holds no artifact.
        StorageError: If the file cannot be written.
    """
    read_description(folder)
    held = _read(folder, OBSERVER, ObserverSettings) or ObserverSettings()
    write_observer(folder, replace(held, process_noise=tuples(noise), of=""))


def set_limits(folder: Path, limits: Mapping[str, Sequence[WatchLimits]]) -> None:
    """Write limits of monitors by hand: limits of one or more kinds of readings, by model.

    Raises:
        InputError: If the folder holds no artifact, or a model is unknown.
        StorageError: If a file cannot be written.
    """
    _check_models(limits, read_description(folder))
    found = {}
    for model, own in limits.items():
        rest = next((one.rest_speed for one in own if one.rest_speed), ())
        found[model] = WatchFile({one.kind: one for one in own}, rest_speed=rest)
    write_watch(folder, found)


def tuples(noise: Mapping[str, ArrayLike]) -> dict[str, tuple[float, ...]]:
    """Noise by estimator as plain numbers."""
    return {name: tuple(np.asarray(sigma, dtype=float).tolist()) for name, sigma in noise.items()}


def read_description(folder: Path) -> Description:
    """Read ``kit.json``; InputError if it is missing, damaged, changed by hand, or of another version."""
    found = _read(folder, KIT, Description)
    if found is None:
        raise InputError(f"{folder / KIT}: file is missing; {AGAIN} [HM-KIT-033]")
    return found


def read_parts(folder: Path) -> Parts:
    """Read all files of an artifact except the models' programs, and list what is missing.

    Raises:
        InputError: If ``kit.json`` is missing, or a file is damaged, was changed by hand, or is of another version.
    """
    found = read_description(folder)
    lacks: dict[str, str] = {}
    tasks, control = _read_tasks(folder, lacks)
    held = _read(folder, OBSERVER, ObserverSettings)
    observer = held or ObserverSettings()
    loop = LoopSettings(
        control, observer.sensor_sigma, observer.first_sigma, observer.process_noise, tasks.causes, tasks.safe_input,
        tasks.tasks, observer.disturbance_model, observer.tracked,
    )  # fmt: skip
    parts = Parts(found, loop, {}, lacks)
    if held is None:
        lacks[OBSERVER] = _absent(OBSERVER)
    elif observer.of not in ("", parts.models):
        lacks[OBSERVER] = _stale(OBSERVER, "models")
        parts = replace(parts, loop=replace(loop, process_noise={}, tracked=()))
    names = [path.stem for path in sorted((folder / "watch").glob("*.json"))]
    _check_models(names, found)
    watch = {}
    for name in names:
        file = watch_file(name)
        own = _read(folder, file, WatchFile)
        if own is None or own.of not in ("", parts.observer(name)):
            lacks[file] = _stale(WATCH, "observer").replace(WATCH, file)
            continue
        watch[name] = own
        if own.reason:
            lacks[file] = f"{file} lacks limits: {own.reason.rstrip('.')}"
    if not names:
        lacks[WATCH] = _absent(WATCH)
    return replace(parts, watch=watch)


def _read_tasks(folder: Path, lacks: dict[str, str]) -> tuple[TaskList, dict[str, OCP]]:
    held = _read(folder, TASKS, TaskList)
    if held is None:
        lacks[TASKS] = _absent(TASKS)
        return TaskList(), {}
    control = {} if held.control is None else {"": held.control}
    for name, of in held.own.items():
        problem = _read(folder, _task_file(name), TaskProblem)
        if problem is None or read_object(folder / _task_file(name)).get("sha256") != of:
            lacks[TASKS] = (
                f"{_task_file(name)} does not belong to {TASKS}, because a run was interrupted; stage tasks writes "
                f"both: {AGAIN}"
            )
            return TaskList(), {}
        control[name] = problem.control
    return held, control


def _task_file(name: str) -> str:
    return f"tasks/{name}.json"


def _absent(file: str) -> str:
    return (
        f"{file} is missing; stage {OWNERS[file]} of the run writes it, or the report says why not: {AGAIN}"
    )


def _stale(file: str, other: str) -> str:
    whose = "belong to other models" if other == "models" else "were learned with another observer"
    return f"the numbers in {file} {whose} than this kit's; stage {OWNERS[file]} of the run updates them: {AGAIN}"


def _check_models(names: Collection[str], found: Description) -> None:
    if strange := [name for name in names if name not in found.models]:
        raise InputError(
            f"watch: no model {strange[0]!r}; choose from: {', '.join(found.models)} [HM-KIT-034]"
        )


def _write(folder: Path, file: str, content: object) -> None:
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    write_document(path, {"schema_version": SCHEMA_VERSION, **plain(content)})


def _write_once(folder: Path, file: str, content: object) -> None:
    """Write a file unless it already has this content; replace a file that is damaged or of another version."""
    with contextlib.suppress(InputError):
        held = _read(folder, file, type(content))
        if held is not None and digest(held) == digest(content):
            return
    _write(folder, file, content)


def _read(folder: Path, file: str, kind: type[R]) -> R | None:
    """Read a file of an artifact; None if it is missing.

    Raises:
        InputError: If it is damaged, was changed by hand, or is of another version.
    """
    path = folder / file
    if not is_file(path):
        return None
    if (version := read_object(path).get("schema_version")) != SCHEMA_VERSION:
        raise InputError(
            f"{path}: format version {version!r} (field schema_version), but this version of hybrid-mpc reads "
            f"{SCHEMA_VERSION}. Run the scenario again [HM-KIT-035]"
        )
    again = "" if file == KIT else f"; or delete it, and {AGAIN}"
    document = read_document(path, f"copy the folder from its run again{again}")
    del document["schema_version"]
    return record(kind, document, str(path))


def artifact_files(folder: Path) -> tuple[str, ...]:
    """Files of an artifact that loops depend on: all except the promises and unknown files in the folder."""
    known = [name for name in OWNERS if "*" not in name and name != "promises.json"]
    own = [
        path.relative_to(folder).as_posix()
        for part in ("tasks", "watch")
        for path in sorted((folder / part).glob("*.json"))
    ]
    return tuple(name for name in (*known, *own) if is_file(folder / name))


def artifact_digest(folder: Path) -> str:
    """Digest of all files of an artifact; ``kit.json`` contains the hash of the models' programs.

    Raises:
        InputError: If a file is damaged or cannot be read.
    """
    names = [name for name in artifact_files(folder) if not name.startswith(f"{MODELS}/")]
    return digest({name: read_object(folder / name).get("sha256") for name in names})


def artifact_folder(folder: Path) -> Path:
    """The artifact's folder: ``folder`` itself, or its subfolder ``model``; InputError if neither holds an artifact."""
    for place in (folder, folder / "model"):
        if is_file(place / KIT):
            return place
    try:
        state = f"no {KIT} in it" if folder.is_dir() else "is a file" if folder.exists() else "does not exist"
    except OSError as error:
        state = f"cannot be read ({reason(error)})"
    raise InputError(
        f"{folder}: {state}. Give the folder of a finished run, or its folder model/ [HM-KIT-038]"
    )
