"""The artifact: a folder of the deployed models as data. Loading needs no torch and runs nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import nn_export
from hybrid_mpc.delayed import with_input_delay
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_document, read_object, sha256, write_document
from hybrid_mpc.model import HybridModel
from hybrid_mpc.monitor.calibration import Calibration
from hybrid_mpc.records import plain, record
from hybrid_mpc.signals import Signal

SCHEMA_VERSION = 2
FILE = "model.json"
FILES = (FILE, "programs.json", "weights.safetensors")
"""All files of an artifact; whatever else lies in its folder is none of it."""
MOST_MODELS = 16
"""Models that an artifact may hold: prior, hybrid, and a few to compare them with."""
FUNCTIONS = ("step", "xdot", "output", "energy_balance")
INPUTS = {
    "step": ("x", "h", "u"),
    "xdot": ("x", "h", "u"),
    "output": ("x", "u"),
    "energy_balance": ("x", "xdot", "u"),
}
OUTPUTS = {
    "step": ("x_next", "h_next"),
    "xdot": ("xdot",),
    "output": ("y",),
    "energy_balance": ("dE",),
}
PARAMETRIC = "parametric"
"""Program ``(x, u, p) -> acceleration`` of the prior, which artifacts of earlier versions lack."""
JACOBIANS = {"A": ("x", "h"), "B": ("u",)}


@dataclass(frozen=True)
class ModelInfo:
    """What a model's programs do not say themselves.

    Args:
        dt: Model period [s].
        states: Signals of x.
        inputs: Signals of u.
        outputs: Signals of y.
        parameters: Values [SI] of the prior's parameters by name. Default: unknown.
        input_delay: Time [s] from a command to the input that the programs take. Default: none.
        time_unit: The machine's second [s], see :class:`~hybrid_mpc.model.HybridModel`. Default 1.
    """

    dt: float
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    parameters: Mapping[str, float] = field(default_factory=dict)
    input_delay: float = 0.0
    time_unit: float = 1.0


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
        test_scores: Errors of the hybrid's free runs on test data by name.
    """

    scenario: str = ""
    seed: int = 0
    budget: str = ""
    data_hash: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    prior_parameters: Mapping[str, float] = field(default_factory=dict)
    test_scores: Mapping[str, float | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Description:
    """What ``model.json`` holds beside its schema version and its hash.

    Args:
        models: Names of the models, whose programs ``programs.json`` holds.
        programs_sha256: Hash of ``programs.json``: a pair that does not belong together is refused.
        dt_s: Model period [s].
        states: Signals of x.
        inputs: Signals of u.
        outputs: Signals of y.
        parameters: Values [SI] of the prior's parameters by name.
        input_delay_s: Time [s] from a command to the input that the programs take.
        time_unit_s: The machine's second [s], see :attr:`HybridModel.time_unit`.
        calibration: Calibration of the energy monitor, or None.
        provenance: What the models were made from.

    Raises:
        InputError: If a number or the models' names cannot be.
    """

    models: tuple[str, ...]
    programs_sha256: str
    dt_s: float
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    parameters: Mapping[str, float]
    input_delay_s: float
    time_unit_s: float
    calibration: Calibration | None
    provenance: Provenance

    def __post_init__(self) -> None:
        if not 0 < self.dt_s < math.inf:
            raise InputError(f"dt_s: a positive number of seconds is needed, got {self.dt_s}")
        if not 0 < self.time_unit_s < math.inf:
            raise InputError(f"time_unit_s: a positive number of seconds is needed, got {self.time_unit_s}")
        if not 0 <= self.input_delay_s < math.inf:
            raise InputError(f"input_delay_s: a number of seconds is needed, got {self.input_delay_s}")
        if not 0 < len(set(self.models)) == len(self.models) <= MOST_MODELS:
            raise InputError(f"models: 1 to {MOST_MODELS} different names are needed, got {len(self.models)}")
        if not all(math.isfinite(value) for value in self.parameters.values()):
            raise InputError("parameters: finite numbers are needed")


@dataclass(frozen=True)
class Artifact:
    """Models by name (``"hybrid"``, ``"prior"``), the monitor's calibration and the provenance.

    Args:
        models: Deployed models.
        calibration: Calibration of the energy monitor, or None.
        provenance: What the models were made from.
        input_delay: Delay [s] that the models hold. Default: none.
    """

    models: Mapping[str, HybridModel]
    calibration: Calibration | None
    provenance: Provenance
    input_delay: float = 0.0


def save_artifact(
    folder: Path,
    programs: Mapping[str, Mapping[str, nn_export.Program]],
    info: ModelInfo,
    *,
    calibration: Calibration | None = None,
    provenance: Provenance | None = None,
) -> None:
    """Write models to ``folder``: ``programs.json``, ``weights.safetensors`` and, last, ``model.json``.

    Args:
        folder: Made if missing.
        programs: Program of each function of each model, e.g. ``programs["hybrid"]["step"]``.
        info: Period and signals, the same for all models.
        calibration: Calibration of the monitor.
        provenance: What the models were made from.
    """
    folder.mkdir(parents=True, exist_ok=True)
    flat = {f"{model}/{name}": p for model, functions in programs.items() for name, p in functions.items()}
    nn_export.save_programs(folder, flat)
    write_description(
        folder,
        Description(
            tuple(programs), sha256(folder / "programs.json"), info.dt, info.states, info.inputs, info.outputs,
            info.parameters, info.input_delay, info.time_unit, calibration, provenance or Provenance(),
        ),
    )  # fmt: skip


def set_calibration(folder: Path, calibration: Calibration) -> None:
    """Put the monitor's calibration into an artifact.

    Raises:
        InputError: If the folder holds none, or cannot be written.
    """
    write_description(folder, replace(read_description(folder), calibration=calibration))


def write_description(folder: Path, description: Description) -> None:
    """Write ``model.json`` with the hash of its content.

    Raises:
        StorageError: If it cannot be written.
    """
    write_document(folder / FILE, {"schema_version": SCHEMA_VERSION, **plain(description)})


def artifact_folder(folder: Path) -> Path:
    """The artifact's folder, given it or the folder of a run that holds it as ``model``.

    Raises:
        InputError: If neither holds one.

    Example:
        >>> artifact_folder(Path("nowhere"))
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: nowhere does not exist; needed is an artifact folder, such as model/ of a ...
    """
    for place in (folder, folder / "model"):
        if (place / FILE).is_file():
            return place
    state = "holds no model.json" if folder.is_dir() else "does not exist"
    raise InputError(f"{folder} {state}; needed is an artifact folder, such as model/ of a finished run")


def read_description(folder: Path) -> Description:
    """What an artifact says of itself, checked.

    Raises:
        InputError: If it is missing, damaged, changed by hand, or of another schema.
    """
    path = folder / FILE
    if read_object(path).get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{path} is no artifact of schema version {SCHEMA_VERSION} (field schema_version): this version of "
            "hybrid-mpc reads no other; train it anew"
        )
    document = read_document(path, "take the folder from its run again, or train it anew")
    del document["schema_version"]
    return record(Description, document, str(path))


def load_artifact(folder: Path) -> Artifact:
    """Models of an artifact folder, built as CasADi functions.

    Raises:
        InputError: If a file is missing, damaged, of another schema, or does not fit the others.
    """
    d = read_description(folder)
    info = ModelInfo(d.dt_s, d.states, d.inputs, d.outputs, d.parameters, d.input_delay_s, d.time_unit_s)
    if sha256(folder / "programs.json") != d.programs_sha256:
        raise InputError(
            f"{folder}: programs.json is not the one that {FILE} was saved with; take the folder from its run again"
        )
    try:
        programs = nn_export.load_programs(folder)
        models = {name: build_model(name, programs, info) for name in d.models}
    except KeyError as error:
        raise InputError(f"{folder}: programs.json lacks {error}, which {FILE} names") from error
    except nn_export.ExportError as error:
        raise InputError(f"{folder}: {error}") from error
    return Artifact(models, d.calibration, d.provenance, d.input_delay_s)


def build_model(name: str, programs: Mapping[str, nn_export.Program], info: ModelInfo) -> HybridModel:
    """The :class:`HybridModel` of ``programs["<name>/step"]`` and its siblings, with the input's delay."""
    functions: dict[str, Any] = {f: nn_export.build(programs[f"{name}/{f}"], f) for f in FUNCTIONS}
    step = programs[f"{name}/step"]
    functions["with_jacobian"] = nn_export.with_jacobian(step, JACOBIANS)
    many = partial(nn_export.SideBySide, step)
    known: dict[str, Any] = {}
    if info.parameters and f"{name}/{PARAMETRIC}" in programs:
        parametric = nn_export.build(programs[f"{name}/{PARAMETRIC}"], PARAMETRIC)
        known = {"parameters": info.parameters, "parametric": parametric}
    model = HybridModel(
        name, info.dt, info.states, info.inputs, info.outputs, **functions, side_by_side=many, **known,
        time_unit=info.time_unit,
    )  # fmt: skip
    return with_input_delay(model, info.input_delay) if info.input_delay else model
