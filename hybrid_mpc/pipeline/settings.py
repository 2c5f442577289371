"""Settings of a run and the folder that holds it."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import digest, read_json, write_json

FILE = "run.json"


@dataclass(frozen=True)
class RunSettings:
    """Everything that decides what a run computes.

    Args:
        scenario: Registered name or path of a user's Python file.
        data: Recordings of the user (CSV, npz, mat), in order; empty for a simulated machine.
        seed: Seed of data, training and closed loops.
        budget: Name of the scenario's budget.
        inputs: Columns that replace the scenario's inputs; default: the scenario's.
        outputs: Columns that replace the scenario's outputs; default: the scenario's.
        time: Column that replaces the scenario's time; default: the scenario's.
    """

    scenario: str
    data: tuple[Path, ...] = ()
    seed: int = 0
    budget: str = "quick"
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    time: str = ""

    def identity(self) -> dict[str, Any]:
        """Settings as plain data, with the content hash of every file in place of where it lies."""
        files = [{"name": path.name, "sha256": _sha256(path)} for path in self.data]
        scenario = self.scenario
        if scenario.endswith(".py") and Path(scenario).is_file():
            scenario = f"{Path(scenario).name} {_sha256(Path(scenario))}"
        return {**asdict(replace(self, data=(), scenario=scenario)), "data": files}


class Identified(Protocol):
    """Settings that tell whether two runs are the same."""

    def identity(self) -> dict[str, Any]:
        """Settings as plain data."""


def open_folder(out: Path, settings: Identified, *, resume: bool) -> None:
    """Prepare the run's folder and note the settings in it.

    Raises:
        InputError: If the folder holds something else, another run, or (without ``resume``) a run.
    """
    identity = settings.identity()
    note = out / FILE
    if note.is_file():
        held = read_json(note)
        if not resume:
            raise InputError(f"{out} already holds a run; add --resume to finish it, or choose another --out")
        if digest(held.get("settings")) != digest(identity):
            changed = sorted(k for k in identity if digest(identity[k]) != digest(held["settings"].get(k)))
            raise InputError(
                f"{out} holds a run with other settings ({', '.join(changed)} differ); resume with the same "
                f"ones or choose another --out"
            )
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists and holds something else than a run; choose another --out")
    if resume:
        raise InputError(f"{out} holds no run to resume; leave --resume out")
    out.mkdir(parents=True, exist_ok=True)
    write_json(note, {"settings": identity})


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
