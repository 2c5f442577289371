"""The folder of a job: new, or the same job's to go on with; held against other processes while it works."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import LOCK, check_writable, digest, is_empty, locked


@dataclass(frozen=True)
class JobNote:
    """What a job says of itself in its folder.

    Args:
        noun: What the folder holds then, e.g. ``"run"``.
        file: Name of its note.
        identity: What decides what the job computes, as plain data by name.
        write: Writes the note into a folder.
        held: Reads the identity that a folder's note states.
    """

    noun: str
    file: str
    identity: Mapping[str, Any]
    write: Callable[[Path], None]
    held: Callable[[Path], Mapping[str, Any]]


def check_folder(out: Path, noun: str, file: str, *, resume: bool) -> None:
    """Refuse a folder that holds something else, or (without ``resume``) a job; before anything is computed.

    Args:
        out: The folder.
        noun: What the job is, e.g. ``"run"``.
        file: Name of its note.
        resume: Whether a job goes on there.

    Raises:
        InputError: If it does, or nothing can be written.

    Example:
        >>> check_folder(Path("nowhere"), "run", "run.json", resume=True)
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: nowhere holds no run to resume; leave --resume out
    """
    _check_note(out, noun, file, resume)
    check_writable(out)


def _check_note(out: Path, noun: str, file: str, resume: bool) -> None:
    if not (out / file).is_file():
        if not is_empty(out):
            raise InputError(f"{out} exists and holds something else than a {noun}; choose another --out")
        if resume and not (out / LOCK).is_file():  # a job that ended before its first note leaves the lock
            raise InputError(f"{out} holds no {noun} to resume; leave --resume out")
    elif not resume:
        raise InputError(f"{out} already holds a {noun}; add --resume to finish it, or choose another --out")


def check_same_job(out: Path, claim: JobNote, *, resume: bool) -> None:
    """Refuse a folder that holds something else, or another job than the one that claims it.

    Args:
        out: The folder.
        claim: The job.
        resume: Whether the same job goes on there.

    Raises:
        InputError: If it does, with what differs.
    """
    _check_note(out, claim.noun, claim.file, resume)
    if not (out / claim.file).is_file():
        return
    held, own = claim.held(out), claim.identity
    if differ := sorted(k for k in {**own, **held} if digest(held.get(k)) != digest(own.get(k))):
        raise InputError(
            f"{out} holds a {claim.noun} with other settings ({', '.join(differ)} differ); give the same ones to go on "
            "with it, or choose another --out"
        )


@contextmanager
def open_folder(out: Path, claim: JobNote, *, resume: bool) -> Iterator[None]:
    """A job's folder while it works: made, held against other processes, the job noted in it.

    Args:
        out: The folder.
        claim: The job.
        resume: Whether the same job goes on there.

    Raises:
        InputError: If the folder holds something else, another job, or (without ``resume``) a job; if another process
            works in it, or nothing can be written.

    Example: ``with open_folder(Path("runs/mine"), claim, resume=False): ...``
    """
    check_same_job(out, claim, resume=resume)
    check_writable(out)
    with locked(out):
        check_same_job(out, claim, resume=resume)  # another process may have been quicker
        if not (out / claim.file).is_file():
            claim.write(out)
        yield
