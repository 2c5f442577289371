"""The folder of a run: new, or the same run's to resume; locked while a process works in it; versions noted in it."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hybrid_mpc import __version__
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import LOCK, check_writable, digest, is_empty, locked, read_document, write_document
from hybrid_mpc.records import plain

DAMAGED = "choose another --out"


@dataclass(frozen=True)
class JobNote:
    """What a job says of itself in ``<noun>.json`` of its folder: ``settings`` decide what it computes, ``more``
    nothing.
    """

    noun: str
    settings: Mapping[str, Any]
    more: Mapping[str, Any] = field(default_factory=dict)


def read_note(out: Path, noun: str) -> dict[str, Any]:
    """The note of a job's folder: ``settings``, and what else it says; InputError if it is missing or damaged."""
    note = read_document(out / f"{noun}.json", DAMAGED)
    if not isinstance(note.get("settings"), dict):
        raise InputError(f"{out / noun}.json is damaged: no settings in it; {DAMAGED} [HM-FOLDER-001]")
    return note


def check_out(out: Path, noun: str, *, resume: bool | None) -> None:
    """Refuse a folder that a job cannot work in, before anything is computed.

    With ``resume`` a job of this noun goes on there, without it none may be there; None: either way.

    Raises:
        InputError: If the folder holds something else, a job where none is to go on, no job where one is; or if nothing
            can be written there.
    """
    _check_place(out, noun, resume)
    check_writable(out)


def _check_place(out: Path, noun: str, resume: bool | None) -> None:
    if not (out / f"{noun}.json").is_file():
        if not is_empty(out):
            raise InputError(
                f"{out} exists and holds something else than a {noun}; choose another --out [HM-FOLDER-002]"
            )
        if resume and not (out / LOCK).is_file():  # a job that ended before its note leaves the lock
            raise InputError(f"{out} holds no {noun} to resume; leave --resume out [HM-FOLDER-003]")
    elif resume is False:
        raise InputError(
            f"{out} already holds a {noun}; add --resume to finish it, or choose another --out"
            " [HM-FOLDER-004]"
        )


@contextmanager
def open_folder(out: Path, note: JobNote, *, resume: bool | None) -> Iterator[None]:
    """A job's folder while it works: made, held against other processes, the job noted in it; ``resume`` as above.

    Raises:
        InputError: As :func:`check_out`; or if it holds a job of other settings, or another process works in it.
    """
    check_out(out, note.noun, resume=resume)
    _check_settings(out, note)
    with locked(out):
        write_note(out, note, resume=resume)  # another process may have been quicker: checked again
        yield


def write_note(out: Path, note: JobNote, *, resume: bool | None) -> None:
    """Note a job in its folder, which the caller holds; the part of :func:`open_folder` after the lock."""
    _check_place(out, note.noun, resume)
    _check_settings(out, note)
    path, own = out / f"{note.noun}.json", {**plain(note.more), "settings": plain(note.settings)}
    if not path.is_file() or read_document(path, DAMAGED) != own:
        write_document(path, own)


def _check_settings(out: Path, note: JobNote) -> None:
    if not (out / f"{note.noun}.json").is_file():
        return
    held, own = read_note(out, note.noun)["settings"], note.settings
    if differ := sorted(k for k in {**own, **held} if digest(held.get(k)) != digest(own.get(k))):
        raise InputError(
            f"{out} holds a {note.noun} with other settings ({', '.join(differ)} differ); give the same ones to go on "
            "with it, or choose another --out [HM-FOLDER-005]"
        )


def versions() -> dict[str, str]:
    """Versions of what a result depends on, by package; those that are not installed are left out."""
    packages = ("casadi", "numpy", "scipy", "safetensors", "torch", "control", "pandas")
    own = {"hybrid-mpc": __version__, "python": platform.python_version()}
    return own | {name: found for name in packages if (found := installed(name))}


def installed(package: str) -> str:
    """Version of an installed package; empty where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
