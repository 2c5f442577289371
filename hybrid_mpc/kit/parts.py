"""The files of an artifact: one folder, each file written whole by one stage of a run and never edited by another.

=============================  ============================================================  ==============
file                           what                                                          written by
=============================  ============================================================  ==============
``kit.json``                   machine, signals, provenance, default model                   ``export``
``models/``                    programs and weights of the models                            ``export``
``observer.json``              noise of sensors and states, disturbance model                ``noise``
``tasks.json``, ``tasks/``     common control problem, safe input; problems of single tasks  ``tasks``
``watch/NAME.json``            limits of all channels that watch with a model                ``watch``
``promises.json``              what the kit promises (:mod:`hybrid_mpc.kit.promises`)        ``promises``
=============================  ============================================================  ==============

What belongs to something carries the digest of it (``of``): the noise that of the models, limits that of the observer
whose estimates they were learned on. :func:`read_parts` composes what fits and says of the rest what is missing.
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
"""Version of the format of the whole folder; docs/kit.md describes it."""
KIT, MODELS, OBSERVER, TASKS = "kit.json", "models", "observer.json", "tasks.json"
WATCH = "watch/*.json"
PROGRAMS, WEIGHTS = f"{MODELS}/programs.json", f"{MODELS}/weights.safetensors"
OWNERS: Mapping[str, str] = {
    KIT: "export", PROGRAMS: "export", WEIGHTS: "export", OBSERVER: "noise", TASKS: "tasks", "tasks/*.json": "tasks",
    WATCH: "watch", "promises.json": "promises",
}  # fmt: skip
"""The stage of a run that writes a file; no other does."""
OLD_FILE, OLD_SCHEMA = "model.json", 4
"""The description of a kit in a former format, of one file; see :mod:`hybrid_mpc.kit.migrate`."""
SPLIT_SCHEMA = 5
"""The former format of several files, which can be migrated, too."""
OLD_FILES = (OLD_FILE, "programs.json", "weights.safetensors")
SPLIT_FILES = ("watch/energy.json", "watch/residuals.json", "guard.json")
BENCHMARK_NOTE = "benchmark_model.json"
"""File of a benchmark's model, which is no artifact."""
MOST_MODELS = 16
"""Models that an artifact may hold: prior, hybrid, and a few to compare them with."""
HYBRID = "hybrid"
MOST_MEMBERS = 32
"""Other networks of the hybrid's training that an artifact may hold."""
BALANCE = "balance"
"""Function of a balance: its program is ``<model>/balance/<name of the balance>``."""
AGAIN = "give the run's command again with --resume"
R = TypeVar("R")


@dataclass(frozen=True)
class BalanceInfo:
    """Name and units of a :class:`~hybrid_mpc.model.model.Balance`: of the storage, of its rate and of the residual."""

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
    """What the models' programs do not say themselves; the same for all models of an artifact.

    Args:
        dt: Model period [s].
        states: Signals of x.
        inputs: Signals of u.
        outputs: Signals of y.
        parameters: The prior's parameters with their fitted values, in the order of p. Default: none.
        input_delay: Time [s] from a command to the input that the programs take. Default: none.
        time_unit: The machine's second [s], see :class:`~hybrid_mpc.model.model.HybridModel`. Default 1.
        disturbances: Signals of w. Default: none.
        nominal_w: What is taken for w where none is given. Default: zeros.
        covariance: Rows of the covariance of the fitted values. Default: unknown.
        balances: Balances that have programs. Default: none.
        nominal_x: State of the operating point. Default: zeros.
        nominal_u: Input of the operating point. Default: zeros.
        state_spread: Spread of the states in the training recordings; 0 where one does not move. Default: not known.
        output_spread: Likewise of the outputs.

    Raises:
        InputError: If a field is of another kind, the period or the machine's second is not positive, the delay
            negative, or two signals of one kind, parameters or balances have one name; all of it together.
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
    """What an artifact was made from. None of it is a path, and nothing of it is ever executed.

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
    """What loops need beside the models.

    Args:
        control: Control problems by task; under ``""`` the one of all tasks that have none of their own. Default: none.
        sensor_sigma: Standard deviations of the sensors ``(n_y,)`` [output units], as estimators assume them.
        first_sigma: Those of the states that no output shows alone, at an estimator's start. Default: by the sensors'
            and the states' ranges.
        process_noise: Standard deviations per period ``(n_x,)`` [state units] by model, and by model with ``_observer``
            behind it where the estimator follows an unknown load.
        causes: What may break, by name: the parameters that change together then.
        safe_input: Input ``(n_u,)`` that the machine may be left with. Default: none is declared.
        tasks: Names of the tasks, with or without a control problem of their own. Default: those of ``control``.
        disturbance_model: What unmeasured disturbances are added to. Default: one at each input.

    Raises:
        InputError: If a field is of another kind, a deviation is negative or not finite, a task has two problems of one
            name, or the safe input is outside a problem's limits; all of it together.
    """

    control: Mapping[NameOrNone, OCP] = field(default_factory=dict)
    sensor_sigma: tuple[NotNegative, ...] = ()
    first_sigma: tuple[NotNegative, ...] | None = None
    process_noise: Mapping[Name, tuple[NotNegative, ...]] = field(default_factory=dict)
    causes: Mapping[Name, tuple[Name, ...]] = field(default_factory=dict)
    safe_input: tuple[Number, ...] | None = None
    tasks: tuple[Name, ...] = ()
    disturbance_model: tuple[Disturbance, ...] | None = None

    def __post_init__(self) -> None:
        own = Fields(self, "loop")
        own.distinct("tasks", lambda: self.tasks, "tasks: the name")
        own.need(
            "safe_input control",
            lambda: (
                self.safe_input is None or all(_within(self.safe_input, p) for p in self.control.values())
            ),
            f"safe_input {self.safe_input} is outside the limits of a control problem [HM-KIT-029]",
        )
        own.refuse()


def _within(u: tuple[float, ...], problem: OCP) -> bool:
    """Whether an input fits a problem's number of inputs and their limits."""
    return len(u) == problem.n_u and all(
        low <= value <= high for value, low, high in zip(u, problem.u_min, problem.u_max, strict=True)
    )


def loop_settings(
    scenario: Scenario, process_noise: Mapping[str, tuple[float, ...]] | None = None
) -> LoopSettings:
    """What a scenario's loops need beside the models; process noise by estimator, unless it is estimated later."""
    problems = {"": scenario.control} | {task.name: task.control for task in scenario.tasks}
    safe = scenario.safe_input
    return LoopSettings(
        {name: problem for name, problem in problems.items() if problem is not None},
        scenario.sensor_sigma,
        scenario.first_sigma,
        dict(process_noise or {}),
        dict(scenario.causes),
        None if safe is None else tuple(numbers(safe, "safe_input").tolist()),
        tuple(task.name for task in scenario.tasks),
        scenario.disturbance_model,
    )


@dataclass(frozen=True)
class Description:
    """What ``kit.json`` holds beside the format's version and its hash.

    Args:
        models: Names of the models.
        programs_sha256: Hash of ``models/programs.json``.
        model: Period, signals and parameters of all models.
        provenance: What the models were made from.
        recommended: Default model of a loop. Empty: the hybrid.
        members: How many networks the hybrid is the mean of, each held alone beside it, the best first. Default: it is
            a single one.
        predicting: What predictions of recordings need beside the models. Default: there can be none.

    Raises:
        InputError: If there are no models, too many, or two of one name.
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
                f"members: 0 to {MOST_MEMBERS} networks beside a model {HYBRID!r} are needed, got {self.members}"
                " [HM-KIT-030]"
            )
        if self.recommended and self.recommended not in self.models:
            raise InputError(
                f"recommended: no model {self.recommended!r}; there are: {', '.join(self.models)} [HM-KIT-031]"
            )
        if not 0 < len(set(self.models)) == len(self.models) <= MOST_MODELS:
            raise InputError(
                f"models: 1 to {MOST_MODELS} different names are needed, got {len(self.models)} [HM-KIT-032]"
            )


@dataclass(frozen=True)
class ObserverSettings:
    """What ``observer.json`` holds.

    Args:
        sensor_sigma: See :class:`LoopSettings`, as the other fields of these names.
        first_sigma: Likewise.
        process_noise: Likewise.
        disturbance_model: Likewise.
        of: Digest of the models that the noise was estimated with (:func:`models_digest`). Empty: of any, it was given
            by hand.
    """

    sensor_sigma: tuple[NotNegative, ...] = ()
    first_sigma: tuple[NotNegative, ...] | None = None
    process_noise: Mapping[Name, tuple[NotNegative, ...]] = field(default_factory=dict)
    disturbance_model: tuple[Disturbance, ...] | None = None
    of: Line = ""


@dataclass(frozen=True)
class TaskList:
    """What ``tasks.json`` holds; it is written after the files in ``tasks/``.

    Args:
        control: The control problem of all tasks that have none of their own; None: there is none.
        safe_input: See :class:`LoopSettings`, as the other fields of these names.
        causes: Likewise.
        tasks: Likewise.
        own: Digest of the control problem of each task that has its own, in ``tasks/NAME.json``.
    """

    control: OCP | None = None
    safe_input: tuple[Number, ...] | None = None
    causes: Mapping[Name, tuple[Name, ...]] = field(default_factory=dict)
    tasks: tuple[Name, ...] = ()
    own: Mapping[Name, Line] = field(default_factory=dict)


@dataclass(frozen=True)
class TaskProblem:
    """What ``tasks/NAME.json`` holds: the control problem of a task."""

    control: OCP


@dataclass(frozen=True)
class WatchFile:
    """What ``watch/NAME.json`` holds: by what a monitor with the model of that name alarms.

    Args:
        limits: WatchLimits by kind of readings (:mod:`hybrid_mpc.watch.readings`).
        reason: Why some are missing. Default: none is.
        rest_speed: Speeds ``(n_q,)`` below which friction may stick. Default: unknown.
        of: Digest of the observer that they were learned with (:meth:`Parts.observer`). Empty: by hand, of any.
    """

    limits: Mapping[Name, WatchLimits]
    reason: Text = ""
    rest_speed: tuple[Positive, ...] = ()
    of: Line = ""


@dataclass(frozen=True)
class Parts:
    """What the files of an artifact say together.

    Args:
        description: ``kit.json``.
        loop: Control problems, noise and what else loops need.
        watch: By what monitors alarm, by model.
        lacks: What is missing, and the stage that gives it, by file.
    """

    description: Description
    loop: LoopSettings
    watch: Mapping[str, WatchFile]
    lacks: Mapping[str, str]

    @property
    def models(self) -> str:
        """Digest of the models, to which noise belongs."""
        return digest([self.description.programs_sha256, self.description.model.input_delay])

    def observer(self, model: str) -> str:
        """Digest of all that makes the observer of a model, to which limits belong: the models, its noise, and how
        large its loads may be.
        """
        loop, problem, sizes = self.loop, self.loop.control.get(""), None
        if problem is not None:  # loads elsewhere than at the inputs have sizes that weights decide too
            spans: object = (problem.u_min, problem.u_max, problem.input_range, problem.horizon)
            sizes = spans if loop.disturbance_model is None else problem
        noise = loop.process_noise.get(f"{model}_observer")
        return digest(
            [self.models, model, noise, loop.sensor_sigma, loop.first_sigma, loop.disturbance_model, sizes]
        )


def write_description(folder: Path, description: Description) -> None:
    """Write ``kit.json``; what a kit of a former format has left in the folder goes."""
    _write(folder, KIT, description)
    for name in (*OLD_FILES, *SPLIT_FILES):
        (folder / name).unlink(missing_ok=True)


def write_observer(folder: Path, observer: ObserverSettings) -> None:
    """Write ``observer.json``, unless it is there."""
    _write_once(folder, OBSERVER, observer)


def write_tasks(folder: Path, loop: LoopSettings) -> None:
    """Write the control problems, safe input and causes of loops, ``tasks.json`` last; unless they are there."""
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
    """Write ``watch/NAME.json`` of each model, unless it is there; files of other models go."""
    for name, limits in watch.items():
        _write_once(folder, watch_file(name), limits)
    for path in (folder / "watch").glob("*.json"):
        if path.stem not in watch:
            path.unlink()


def watch_file(model: str) -> str:
    """Place of what a monitor with a model alarms by."""
    return f"watch/{model}.json"


def save_loop(folder: Path, loop: LoopSettings) -> None:
    """Write what loops need beside the models, as a script states it: ``tasks.json``, ``tasks/``, ``observer.json``."""
    write_tasks(folder, loop)
    write_observer(
        folder,
        ObserverSettings(loop.sensor_sigma, loop.first_sigma, loop.process_noise, loop.disturbance_model),
    )


def set_process_noise(folder: Path, noise: Mapping[str, ArrayLike]) -> None:
    """Write the process noise of the estimators by hand: standard deviations per period ``(n_x,)``, by estimator.

    Raises:
        InputError: If the folder holds no artifact.
        StorageError: If it cannot be written.
    """
    read_description(folder)
    held = _read(folder, OBSERVER, ObserverSettings) or ObserverSettings()
    write_observer(folder, replace(held, process_noise=tuples(noise), of=""))


def set_limits(folder: Path, limits: Mapping[str, Sequence[WatchLimits]]) -> None:
    """Write by hand what monitors alarm by: limits of one or more kinds of readings, by model.

    Raises:
        InputError: If the folder holds no artifact, or no such model.
        StorageError: If it cannot be written.
    """
    _check_models(limits, read_description(folder))
    write_watch(
        folder,
        {
            model: WatchFile(
                {one.kind: one for one in own},
                rest_speed=next((one.rest_speed for one in own if one.rest_speed), ()),
            )
            for model, own in limits.items()
        },
    )


def tuples(noise: Mapping[str, ArrayLike]) -> dict[str, tuple[float, ...]]:
    """Noise by estimator as plain numbers."""
    return {name: tuple(np.asarray(sigma, dtype=float).tolist()) for name, sigma in noise.items()}


def read_description(folder: Path) -> Description:
    """What ``kit.json`` says; InputError if it is missing, damaged, changed by hand, or of another version."""
    found = _read(folder, KIT, Description)
    if found is None:
        raise InputError(f"{folder / KIT} is missing [HM-KIT-033]")
    return found


def read_parts(folder: Path) -> Parts:
    """What all files of an artifact say together, and what is missing; the models' programs are not read.

    Raises:
        InputError: If there is no ``kit.json``, or a file is damaged, was changed by hand, or is of another version.
    """
    found = read_description(folder)
    lacks: dict[str, str] = {}
    tasks, control = _read_tasks(folder, lacks)
    held = _read(folder, OBSERVER, ObserverSettings)
    observer = held or ObserverSettings()
    loop = LoopSettings(
        control, observer.sensor_sigma, observer.first_sigma, observer.process_noise, tasks.causes, tasks.safe_input,
        tasks.tasks, observer.disturbance_model,
    )  # fmt: skip
    parts = Parts(found, loop, {}, lacks)
    if held is None:
        lacks[OBSERVER] = _absent(OBSERVER)
    elif observer.of not in ("", parts.models):
        lacks[OBSERVER] = _stale(OBSERVER, "models")
        parts = replace(parts, loop=replace(loop, process_noise={}))
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
                f"{_task_file(name)} is not the one that {TASKS} was written with, a run ended in between; the stage "
                f"tasks writes both: {AGAIN}"
            )
            return TaskList(), {}
        control[name] = problem.control
    return held, control


def _task_file(name: str) -> str:
    return f"tasks/{name}.json"


def _absent(file: str) -> str:
    return f"there is no {file}; the run's stage {OWNERS[file]} writes it, if it can (its report says why not): {AGAIN}"


def _stale(file: str, other: str) -> str:
    whose = "are of other models" if other == "models" else "were learned with another observer"
    return f"the numbers in {file} {whose} than this kit's; the run's stage {OWNERS[file]} writes new ones: {AGAIN}"


def _check_models(names: Collection[str], found: Description) -> None:
    if strange := [name for name in names if name not in found.models]:
        raise InputError(f"watch: no model {strange[0]!r}; there are: {', '.join(found.models)} [HM-KIT-034]")


def _write(folder: Path, file: str, content: object) -> None:
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    write_document(path, {"schema_version": SCHEMA_VERSION, **plain(content)})


def _write_once(folder: Path, file: str, content: object) -> None:
    """Write a file whose content is not there yet; one that is damaged or of another version is written anew."""
    with contextlib.suppress(InputError):
        held = _read(folder, file, type(content))
        if held is not None and digest(held) == digest(content):
            return
    _write(folder, file, content)


def _read(folder: Path, file: str, kind: type[R]) -> R | None:
    """What a file of an artifact holds; None where there is none.

    Raises:
        InputError: If it is damaged, was changed by hand, or is of another version.
    """
    path = folder / file
    if not is_file(path):
        return None
    if (version := read_object(path).get("schema_version")) != SCHEMA_VERSION:
        remedy = _anew(folder) if version == SPLIT_SCHEMA else "train the models anew"
        raise InputError(
            f"{path} is of version {version!r} of the format (field schema_version); this version of hybrid-mpc reads "
            f"{SCHEMA_VERSION}: {remedy} [HM-KIT-035]"
        )
    again = "" if file == KIT else f"; or delete it, and {AGAIN}"
    document = read_document(path, f"take the folder from its run again{again}")
    del document["schema_version"]
    return record(kind, document, str(path))


def _anew(folder: Path) -> str:
    return f"Write it in the present one with: hybrid-mpc export kit {folder} --out NEW"


def artifact_files(folder: Path) -> tuple[str, ...]:
    """All files of an artifact but its promises, of which no loop depends; others in its folder do not belong to it."""
    known = [name for name in OWNERS if "*" not in name and name != "promises.json"]
    own = [
        path.relative_to(folder).as_posix()
        for part in ("tasks", "watch")
        for path in sorted((folder / part).glob("*.json"))
    ]
    return tuple(name for name in (*known, *own) if is_file(folder / name))


def artifact_digest(folder: Path) -> str:
    """Digest of all files of an artifact: ``kit.json`` names the models' programs by their hash.

    Raises:
        InputError: If a file is damaged or cannot be read.
    """
    names = [name for name in artifact_files(folder) if not name.startswith(f"{MODELS}/")]
    return digest({name: read_object(folder / name).get("sha256") for name in names})


def artifact_folder(folder: Path) -> Path:
    """The artifact's folder, given it or the folder of a run that holds it as ``model``; InputError if neither holds
    one.
    """
    for place in (folder, folder / "model"):
        if is_file(place / KIT):
            return place
    for place in (folder, folder / "model"):
        if is_file(place / OLD_FILE):
            raise InputError(
                f"{place / OLD_FILE}: this kit has a former format, of one file. {_anew(place)} [HM-KIT-036]"
            )
        if is_file(place / BENCHMARK_NOTE):
            raise InputError(
                f"{folder} is the folder of a benchmark: its model ({place / BENCHMARK_NOTE}) predicts and has no "
                f"controller. Evaluate it with: hybrid-mpc benchmark SCENARIO --model {folder} --test FILE. For loops "
                "make an artifact of the same recordings: hybrid-mpc run SCENARIO --data FILE --out FOLDER [HM-KIT-037]"
            )
    try:
        state = f"holds no {KIT}" if folder.is_dir() else "is a file" if folder.exists() else "does not exist"
    except OSError as error:
        state = f"cannot be looked into ({reason(error)})"
    raise InputError(
        f"{folder} {state}; needed is an artifact folder, such as model/ of a finished run, or the run's own folder"
        " [HM-KIT-038]"
    )
