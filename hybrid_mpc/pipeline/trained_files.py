"""Trained networks on disk, as the jobs keep them between their stages: JSON and plain arrays, a pair a kind."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_document, read_document_arrays, write_document
from hybrid_mpc.identification.settings import TrainingSettings
from hybrid_mpc.identification.step import Scaling
from hybrid_mpc.identification.trained import Fault, Trained
from hybrid_mpc.records import plain, record


@dataclass(frozen=True)
class _Note:
    """What stands in the JSON file beside the arrays."""

    settings: TrainingSettings
    scaling: Scaling
    faults: tuple[Fault, ...]


def save_trained(folder: Path, trained: Trained) -> None:
    """Write the networks of one kind."""
    kind = trained.settings.kind
    arrays: dict[str, Any] = {f"weights.{n}": v for n, v in trained.weights.items()}
    arrays |= {f"curve.{n}": v for n, v in trained.curve.items()}
    arrays |= {"own.validation": trained.validation, "own.skipped": trained.skipped}
    note = _Note(trained.settings, trained.scaling, trained.faults)
    write_document(folder / f"{kind}.json", plain(note), arrays)


def is_trained(folder: Path, settings: TrainingSettings) -> bool:
    """Whether a folder holds finished networks of these settings.

    Raises:
        InputError: If it holds networks of the same kind and other settings.

    Example:
        >>> is_trained(Path("nowhere"), TrainingSettings("pgrnn", 4, 1, 5, 5, seed=0, warm=2))
        False
    """
    if not (folder / f"{settings.kind}.json").is_file():
        return False
    held, own = (asdict(s) for s in (load_trained(folder, settings.kind).settings, settings))
    changed = [f"{name} {held[name]} instead of {own[name]}" for name in own if held[name] != own[name]]
    if changed:
        raise InputError(
            f"{folder} holds finished networks of other settings ({settings.kind}: {'; '.join(changed)}), from another "
            "version or scenario; choose another --out"
        )
    return True


def load_trained(folder: Path, kind: str) -> Trained:
    """Read the networks of one kind.

    Raises:
        InputError: If a file is missing or damaged.
    """
    path = folder / f"{kind}.json"
    remedy = f"delete {kind}.* in {folder}, and the same command trains these networks anew"
    note = record(_Note, read_document(path, remedy), str(path))
    arrays = read_document_arrays(path, remedy)
    part: dict[str, dict[str, Any]] = {"weights": {}, "curve": {}, "own": {}}
    for name, value in arrays.items():
        group, _, key = name.partition(".")
        part[group][key] = value
    return Trained(
        note.settings,
        note.scaling,
        part["weights"],
        part["own"]["validation"],
        part["curve"],
        part["own"]["skipped"],
        note.faults,
    )
