"""What a study's folder says of itself: ``study.json``, and the same in the table of its results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_document, write_document
from hybrid_mpc.records import plain, record

FILE = "study.json"
SCHEMA_VERSION = 2


@dataclass(frozen=True)
class NoiseNote:
    """Process noise of a model's filters.

    Args:
        source: Where it is from, in words.
        sigma_x: Standard deviations per period by contender.
    """

    source: str
    sigma_x: Mapping[str, tuple[float, ...]]


@dataclass(frozen=True)
class ModelNote:
    """A model of a study.

    Args:
        sha256: Hash of its folder.
        provenance: What it says of itself.
        noise: What its filters assume.
    """

    sha256: str
    provenance: Mapping[str, Any]
    noise: NoiseNote


@dataclass(frozen=True)
class StudyNote:
    """What a study is made of.

    Args:
        study: Its settings as plain data.
        title: The machine, one line.
        description: The machine, a paragraph.
        models: By label.
        runs: How many there are.
        versions: Versions of the packages.
        kind: Kind of study. Default: closed loops of all combinations.
        scenario_sha256: Hash of the scenario's file; None for a registered scenario.
        engine: What has computed it; empty until it is finished.
        workers_died: Workers that died on the way.
        schema_version: Of this note.
    """

    study: Mapping[str, Any]
    title: str
    description: str
    models: Mapping[str, ModelNote]
    runs: int
    versions: Mapping[str, str] = field(default_factory=dict)
    kind: str = "loops"
    scenario_sha256: str | None = None
    engine: str = ""
    workers_died: int = 0
    schema_version: int = SCHEMA_VERSION


def write_note(folder: Path, note: StudyNote) -> None:
    """Write ``study.json``.

    Raises:
        StorageError: If it cannot be written.
    """
    write_document(folder / FILE, plain(note))


def read_note(folder: Path) -> StudyNote:
    """What a study's folder says of itself.

    Raises:
        InputError: If it is no folder of a study, damaged, or of another version.
    """
    if not (folder / FILE).is_file():
        raise InputError(f"{folder} holds no study; give the folder that 'study run --out' made")
    return note_of(read_document(folder / FILE), str(folder / FILE))


def note_of(data: Mapping[str, Any], where: str) -> StudyNote:
    """A note from plain data.

    Raises:
        InputError: If it is of another version, or a field does not fit.
    """
    if data.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{where}: a study of schema version {str(data.get('schema_version'))[:20]}, this version of hybrid-mpc "
            f"reads {SCHEMA_VERSION}; run it anew"
        )
    return record(StudyNote, data, where)
