"""A benchmark's model on disk: parameters, delay, smoother and networks as JSON and plain arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_document, write_document
from hybrid_mpc.identification.settings import KINDS
from hybrid_mpc.identification.trained import Trained
from hybrid_mpc.pipeline.machine_benchmark.physics import Physics
from hybrid_mpc.pipeline.trained_files import load_trained, save_trained
from hybrid_mpc.records import plain, record

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
        long: The same over whole recordings, most of which was trained on; empty where none was split in order of time.
    """

    scenario: str
    dt: float
    physics: Physics
    networks: Mapping[str, Trained]
    hybrid: str
    validation: Mapping[str, float]
    long: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Note:
    """What stands in the JSON file beside the networks."""

    schema: int
    scenario: str
    dt: float
    physics: Physics
    hybrid: str
    validation: Mapping[str, float]
    long: Mapping[str, float]


def save_model(folder: Path, model: BenchmarkModel) -> None:
    """Write a model; the note comes last, so a folder that has it is whole."""
    for trained in model.networks.values():
        save_trained(folder, trained)
    note = _Note(SCHEMA, model.scenario, model.dt, model.physics, model.hybrid, model.validation, model.long)
    write_document(folder / NOTE, plain(note))


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
    document = read_document(folder / NOTE, "make the benchmark anew")
    if document.get("schema") != SCHEMA:
        raise InputError(
            f"{folder / NOTE}: schema {document.get('schema')}, this version reads {SCHEMA}; train anew"
        )
    note = record(_Note, document, str(folder / NOTE))
    if note.scenario != scenario:
        raise InputError(f"{folder} holds a model of {note.scenario}, not of {scenario}")
    networks: dict[str, Trained] = {kind: load_trained(folder, kind) for kind in KINDS}
    return BenchmarkModel(
        note.scenario, note.dt, note.physics, networks, note.hybrid, note.validation, note.long
    )
