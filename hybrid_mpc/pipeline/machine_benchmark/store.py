"""A benchmark's model on disk: parameters, delay, smoother and networks as JSON and plain arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_arrays, read_json, write_arrays, write_json
from hybrid_mpc.identification.prior_result import PriorFit
from hybrid_mpc.identification.settings import KINDS, TrainingSettings
from hybrid_mpc.identification.step import Scaling
from hybrid_mpc.identification.trained import Fault, Trained
from hybrid_mpc.pipeline.machine_benchmark.physics import Physics

NOTE = "benchmark_model.json"
SCHEMA = 1


@dataclass(frozen=True)
class BenchmarkModel:
    """Everything that a free run over another recording needs.

    Args:
        scenario: Name of the machine.
        dt: Model period [s].
        physics: The fitted prior with its delay and smoother.
        networks: Trained networks by kind.
        hybrid: The model that validation recommends, e.g. ``"mopgrnn mean"``.
        validation: Error of every candidate on the validation pieces [unit of the benchmark].
    """

    scenario: str
    dt: float
    physics: Physics
    networks: Mapping[str, Trained]
    hybrid: str
    validation: Mapping[str, float]


def save_model(folder: Path, model: BenchmarkModel) -> None:
    """Write a model; the note comes last, so a folder that has it is whole."""
    for trained in model.networks.values():
        save_trained(folder, trained)
    write_json(
        folder / NOTE,
        {
            "schema": SCHEMA,
            "scenario": model.scenario,
            "dt": model.dt,
            "physics": asdict(model.physics),
            "hybrid": model.hybrid,
            "validation": dict(model.validation),
        },
    )


def load_model(folder: Path, scenario: str) -> BenchmarkModel:
    """Read a model from its folder, or from that of the run which made it.

    Raises:
        InputError: If there is none, it is damaged, or of another machine.
    """
    folder = folder if (folder / NOTE).is_file() else folder / "model"
    if not (folder / NOTE).is_file():
        raise InputError(
            f"{folder.parent} holds no model of a benchmark; give the folder that 'hybrid-mpc benchmark {scenario} "
            "--data FILE --out DIR' has made"
        )
    note = read_json(folder / NOTE)
    if note.get("schema") != SCHEMA:
        raise InputError(
            f"{folder / NOTE}: schema {note.get('schema')}, this version reads {SCHEMA}; train anew"
        )
    if note["scenario"] != scenario:
        raise InputError(f"{folder} holds a model of {note['scenario']}, not of {scenario}")
    physics = physics_of(note["physics"])
    networks: dict[str, Trained] = {kind: load_trained(folder, kind) for kind in KINDS}
    validation = {name: float(value) for name, value in note["validation"].items()}
    return BenchmarkModel(note["scenario"], note["dt"], physics, networks, note["hybrid"], validation)


def physics_of(plain: Mapping[str, Any]) -> Physics:
    """A :class:`Physics` from its JSON form."""
    fit = dict(plain["fit"])
    fit |= {"warnings": tuple(fit["warnings"]), "stages": tuple(fit["stages"])}
    return Physics(PriorFit(**fit), plain["delay"], tuple(plain["sigma"]), tuple(plain["walk"]))


def save_trained(folder: Path, trained: Trained) -> None:
    """Write the networks of one kind."""
    kind = trained.settings.kind
    arrays: dict[str, Any] = {f"weights.{n}": v for n, v in trained.weights.items()}
    arrays |= {f"curve.{n}": v for n, v in trained.curve.items()}
    arrays |= {"own.validation": trained.validation, "own.skipped": trained.skipped}
    write_arrays(folder / f"{kind}.npz", arrays)
    write_json(
        folder / f"{kind}.json",
        {
            "settings": asdict(trained.settings),
            "scaling": asdict(trained.scaling),
            "faults": [asdict(fault) for fault in trained.faults],
        },
    )


def load_trained(folder: Path, kind: str) -> Trained:
    """Read the networks of one kind.

    Raises:
        InputError: If a file is missing or damaged.
    """
    note, arrays = read_json(folder / f"{kind}.json"), read_arrays(folder / f"{kind}.npz")
    part: dict[str, dict[str, Any]] = {"weights": {}, "curve": {}, "own": {}}
    for name, value in arrays.items():
        group, _, key = name.partition(".")
        part[group][key] = value
    note["settings"]["learning_rates"] = tuple(note["settings"]["learning_rates"])
    return Trained(
        TrainingSettings(**note["settings"]),
        Scaling(**{name: tuple(v) for name, v in note["scaling"].items()}),
        part["weights"],
        part["own"]["validation"],
        part["curve"],
        part["own"]["skipped"],
        tuple(Fault(**fault) for fault in note["faults"]),
    )
