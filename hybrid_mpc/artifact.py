"""The artifact: a folder of the deployed models as data. Loading needs no torch and runs nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import nn_export
from hybrid_mpc.delayed import with_input_delay
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.model import HybridModel
from hybrid_mpc.signals import Signal

SCHEMA_VERSION = 1
FILE = "model.json"
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
class Artifact:
    """Models by name (``"hybrid"``, ``"prior"``), the monitor's calibration and the provenance.

    Args:
        models: Deployed models.
        calibration: Calibration of the energy monitor in plain form, or None.
        provenance: Data hash, versions, seed, metrics.
        input_delay: Delay [s] that the models hold. Default: none.
    """

    models: Mapping[str, HybridModel]
    calibration: Mapping[str, Any] | None
    provenance: Mapping[str, Any]
    input_delay: float = 0.0


def save_artifact(
    folder: Path,
    programs: Mapping[str, Mapping[str, nn_export.Program]],
    info: ModelInfo,
    *,
    calibration: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
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
    description = {
        "schema_version": SCHEMA_VERSION,
        "models": list(programs),
        "dt_s": info.dt,
        **{role: [_signal_out(s) for s in getattr(info, role)] for role in ("states", "inputs", "outputs")},
        "parameters": dict(info.parameters),
        "calibration": calibration,
        "provenance": provenance or {},
        **({"input_delay_s": info.input_delay} if info.input_delay else {}),
        **({"time_unit_s": info.time_unit} if info.time_unit != 1.0 else {}),
    }
    write_json(folder / FILE, description)


def set_calibration(folder: Path, calibration: Mapping[str, Any]) -> None:
    """Put the monitor's calibration into an artifact."""
    write_json(folder / FILE, {**read_json(folder / FILE), "calibration": calibration})


def load_artifact(folder: Path) -> Artifact:
    """Models of an artifact folder, built as CasADi functions.

    Raises:
        InputError: If a file is missing, damaged, of another schema, or does not fit the others.
    """
    description = read_json(folder / FILE)
    if not isinstance(description, dict) or description.get("schema_version") != SCHEMA_VERSION:
        raise InputError(f"{folder / FILE} is no artifact of schema version {SCHEMA_VERSION}")
    try:
        signals = {r: tuple(_signal_in(s) for s in description[r]) for r in ("states", "inputs", "outputs")}
        parameters = {str(k): float(v) for k, v in description.get("parameters", {}).items()}
        delay = float(description.get("input_delay_s", 0.0))
        unit = float(description.get("time_unit_s", 1.0))
        info = ModelInfo(
            float(description["dt_s"]), **signals, parameters=parameters, input_delay=delay, time_unit=unit
        )
        names = [str(name) for name in description["models"]]
        calibration, provenance = description["calibration"], description["provenance"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{folder / FILE} is damaged: {type(error).__name__} {error}") from error
    try:
        programs = nn_export.load_programs(folder)
        models = {name: build_model(name, programs, info) for name in names}
    except KeyError as error:
        raise InputError(f"{folder}: programs.json lacks {error}, which {FILE} names") from error
    except nn_export.ExportError as error:
        raise InputError(f"{folder}: {error}") from error
    return Artifact(models, calibration, provenance, delay)


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


def _signal_out(s: Signal) -> dict[str, Any]:
    bounds = [None if math.isinf(b) else b for b in (s.lower, s.upper)]
    return {"name": s.name, "unit": s.unit, "lower": bounds[0], "upper": bounds[1], "periodic": s.periodic}


def _signal_in(s: Mapping[str, Any]) -> Signal:
    lower = -math.inf if s["lower"] is None else float(s["lower"])
    upper = math.inf if s["upper"] is None else float(s["upper"])
    return Signal(str(s["name"]), str(s["unit"]), lower, upper, bool(s["periodic"]))
