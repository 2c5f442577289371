"""The folder of a run: new or resumed, locked while a process works in it, with a note of settings and versions."""

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
    """The note of a job in ``<noun>.json`` of its folder: ``settings`` determine its results, ``more`` does not."""

    noun: str
    settings: Mapping[str, Any]
    more: Mapping[str, Any] = field(default_factory=dict)


def read_note(out: Path, noun: str) -> dict[str, Any]:
    """The note of a job's folder: ``settings`` and further fields; InputError if it is missing or damaged."""
    note = read_document(out / f"{noun}.json", DAMAGED)
    if not isinstance(note.get("settings"), dict):
        raise InputError(
            f"{out / noun}.json: the file is damaged: it has no settings; {DAMAGED} [HM-FOLDER-001]"
        )
    return note


def check_out(out: Path, noun: str, *, resume: bool | None) -> None:
    """Refuse a folder in which a job cannot work, before anything is computed.

    ``resume``: a job of this noun continues there (True), or must not exist there (False); None allows both.

    Raises:
        InputError: If the folder holds something else, a job that must not exist, or no job to resume; or if it is not
            writable.
    """
    _check_place(out, noun, resume)
    check_writable(out)


def _check_place(out: Path, noun: str, resume: bool | None) -> None:
    if not (out / f"{noun}.json").is_file():
        if not is_empty(out):
            raise InputError(
                f"{out}: exists and is not the folder of a {noun}. Choose another --out. [HM-FOLDER-002]"
            )
        if resume and not (out / LOCK).is_file():  # a job that ended before its note leaves only the lock
            raise InputError(f"{out}: contains no {noun} to resume. Omit --resume. [HM-FOLDER-003]")
    elif resume is False:
        raise InputError(
            f"{out}: already contains a {noun}. Add --resume to continue it, or choose another --out. [HM-FOLDER-004]"
        )


@contextmanager
def open_folder(out: Path, note: JobNote, *, resume: bool | None) -> Iterator[None]:
    """A job's folder while it works: created, locked, with the job's note; ``resume`` as in :func:`check_out`.

    Raises:
        InputError: As :func:`check_out`; or if it holds a job with other settings, or another process uses it.
    """
    check_out(out, note.noun, resume=resume)
    _check_settings(out, note)
    with locked(out):
        write_note(out, note, resume=resume)  # checks again, since another process may have been faster
        yield


def write_note(out: Path, note: JobNote, *, resume: bool | None) -> None:
    """Write a job's note into its folder, which the caller has locked; part of :func:`open_folder`."""
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
            f"{out}: contains a {note.noun} with other settings ({', '.join(differ)} differ). Give the same settings "
            "to continue it, or choose another --out. [HM-FOLDER-005]"
        )


def versions() -> dict[str, str]:
    """Versions of the packages that affect results, without those that are not installed."""
    packages = ("casadi", "numpy", "scipy", "safetensors", "torch", "control", "pandas")
    own = {"hybrid-mpc": __version__, "python": platform.python_version()}
    return own | {name: found for name in packages if (found := installed(name))}


def installed(package: str) -> str:
    """Version of a package; empty if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
