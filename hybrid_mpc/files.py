"""Files: written whole or not at all, read as pure data within limits; folders locked by one job at a time.

The library writes all files with :func:`replacing`; :func:`read_json` and :func:`read_arrays` read its own JSON files
and arrays.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

import nn_export.files
from hybrid_mpc.errors import InputError, StorageError, named_extra
from hybrid_mpc.records import plain, shown

MOST_JSON = 16 * 2**20
"""Largest JSON file [byte]. A model's file has a few KiB, the longest results a few hundred."""
MOST_ARRAYS = 2**30
"""Largest content of a file of arrays, unpacked [byte]."""
MOST_CONTENT = 2**31
"""Largest user file that is read [byte]."""
MOST_MEMBERS = 10_000
"""Most arrays in a file."""
HASH, ARRAYS_HASH = "sha256", "arrays_sha256"
"""Fields of a document with the hashes of its content and of the arrays beside it."""
LOCK, PART = ".lock", ".part"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """An open binary file that replaces ``path`` when the block ends without error; missing folders are created.

    After a kill, a full disk or with a second writer there is either the old file or a complete new one. StorageError
    if the file cannot be written.
    """
    try:
        with nn_export.files.replacing(path) as file:
            yield file
    except OSError as error:
        raise cannot_write(path, error) from error


@contextlib.contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """A new folder whose content becomes that of ``folder`` when the block ends without error.

    A full disk or an exception within the block leaves ``folder`` unchanged. A new folder appears as a whole, whenever
    the process is killed; finished files are moved into an existing one. Files of other names stay in it.

    Raises:
        StorageError: If something cannot be written; with a remedy.
    """
    there = folder.is_dir()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        place = folder if there else folder.parent
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name[:50]}.", suffix=PART, dir=place))
        try:
            new = work / "new"
            new.mkdir()
            yield new
            if there:
                _move_into(folder, new, work / "before")
            else:
                new.rename(folder)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except (StorageError, OSError) as error:
        cause = error.__cause__ if isinstance(error, StorageError) and error.__cause__ else error
        kept = "it is unchanged" if there else "no partial files are left"
        raise StorageError(
            f"{folder}: cannot be written: {reason(cause)}; {kept}. Free disk space or choose another folder, and "
            "repeat the command. [HM-FILES-001]"
        ) from error


def _move_into(folder: Path, new: Path, before: Path) -> None:
    """Move finished files into a folder, all or none; files of the same names move to ``before``."""
    before.mkdir()
    moved: list[Path] = []
    try:
        for path in sorted(new.iterdir()):
            target = folder / path.name
            if target.exists():
                target.rename(before / path.name)
            path.rename(target)
            moved.append(target)
    except BaseException:
        for target in moved:
            target.rename(new / target.name)
        for path in before.iterdir():
            path.rename(folder / path.name)
        raise


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path``, whole or not at all."""
    with replacing(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as JSON (see :func:`~hybrid_mpc.records.plain`), whole or not at all."""
    write_text(path, json.dumps(plain(value), indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Content of a JSON file; InputError if it is missing, not a regular file, larger than 16 MiB, or not JSON."""
    content = read_bytes(path, MOST_JSON)
    try:
        return nn_export.files.parse_json(content)
    except ValueError as error:
        raise InputError(f"{path}: the file is damaged: {error} [HM-FILES-017]") from error


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file; InputError if it holds anything else, or as :func:`read_json`."""
    found = read_json(path)
    if not isinstance(found, dict):
        raise InputError(f"{path}: the file is damaged: it is not a JSON object [HM-FILES-002]")
    return found


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as ``.npz`` (no pickle), whole or not at all.

    Raises:
        StorageError: If the file cannot be written.
    """
    with replacing(path) as file:
        np.savez_compressed(file, **{name: np.asarray(a) for name, a in arrays.items()})  # type: ignore[arg-type]


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of a ``.npz`` file; InputError if it is missing, damaged, unpacks to more than 1 GiB, or holds objects."""
    content = read_bytes(path, MOST_ARRAYS)
    try:
        check_npz(content, MOST_ARRAYS)
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: the file is damaged: {error} [HM-FILES-018]") from error


def write_document(
    path: Path, value: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None
) -> None:
    """Write a JSON object with the hash of its content, so that damage is detected when it is read.

    Its ``arrays`` are written beside it as ``.npz``, with their hash in the JSON.
    """
    document = plain(value)
    if arrays is not None:
        beside = path.with_suffix(".npz")
        write_arrays(beside, arrays)
        document[ARRAYS_HASH] = sha256(beside)
    write_json(path, {**document, HASH: digest(document)})


def read_document(path: Path, remedy: str = "") -> dict[str, Any]:
    """The object in a file of :func:`write_document`; ``remedy`` is added to the message about a damaged file."""
    document = _whole(path, remedy)
    document.pop(ARRAYS_HASH, None)
    return document


def read_document_arrays(path: Path, remedy: str = "") -> dict[str, NDArray[Any]]:
    """The arrays of a JSON file of :func:`write_document`."""
    expected, beside = _whole(path, remedy).get(ARRAYS_HASH), path.with_suffix(".npz")
    try:
        if sha256(beside) != expected:
            raise InputError(
                f"{beside}: the file is damaged, or does not belong to {path.name} [HM-FILES-003]"
            )
        return read_arrays(beside)
    except InputError as error:
        raise type(error)(_with(str(error), remedy)) from error


def _whole(path: Path, remedy: str) -> dict[str, Any]:
    try:
        document = read_object(path)
        if document.pop(HASH, None) != digest(document):
            raise InputError(
                f"{path}: the file is damaged or was changed by hand: its hash is wrong [HM-FILES-004]"
            )
    except InputError as error:
        raise type(error)(_with(str(error), remedy)) from error
    return document


def _with(text: str, remedy: str) -> str:
    return f"{text}; {remedy}" if remedy else text


def check_npz(content: bytes, budget: int, names: Sequence[str] | None = None) -> None:
    """Check the declared sizes in an archive of arrays before any array is decompressed.

    ``budget`` is the most bytes of numbers in the arrays to read (``names``; default: all), at least 8 per number.

    Raises:
        ValueError: If there are too many members, or a member is not compressed like numpy's, is no array, or has
            another number of bytes than its shape declares, or the arrays exceed the budget.
        zipfile.BadZipFile: If the content is not an archive, or a damaged one.
        KeyError: If an array of such a name is missing.
    """
    if content.count(b"PK\x01\x02") > MOST_MEMBERS:  # the mark of an entry in the list of members
        raise ValueError(f"the archive has more than {MOST_MEMBERS} members [HM-FILES-005]")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.namelist()
        wanted = members if names is None else [n if n in members else f"{n}.npy" for n in names]
        size = sum(_declared(archive, name) for name in wanted)
    if size > budget:
        raise ValueError(
            f"the arrays take {size / 1e6:.4g} MB, more than the {budget / 1e6:.4g} MB that are read [HM-FILES-006]"
        )


def _declared(archive: zipfile.ZipFile, name: str) -> int:
    """Bytes of an array by its header, at least 8 per number [byte]."""
    member = archive.getinfo(name)
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"member {name[:80]!r} is not compressed like numpy's [HM-FILES-007]")
    with archive.open(member) as file:
        # first bytes of an array, which contain its header: numpy reads at most 10 000 characters of it [byte]
        begin = io.BytesIO(file.read(10_100))
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(npy.read_magic(begin))
    if read is None:
        raise ValueError(f"member {name[:80]!r} is not an array of numbers [HM-FILES-008]")
    shape, _, dtype = read(begin)
    if dtype.hasobject:  # arrays of objects are refused when they are read
        return member.file_size
    count = math.prod(shape)
    if min(shape, default=0) < 0 or begin.tell() + count * dtype.itemsize != member.file_size:
        raise ValueError(
            f"member {name[:80]!r} declares the shape {shown(str(shape))} of {dtype.str} but holds "
            f"{member.file_size} bytes [HM-FILES-009]"
        )
    return count * max(8, dtype.itemsize)


def read_bytes(path: Path, limit: int) -> bytes:
    """Content of a regular file of at most ``limit`` bytes; InputError if it is missing or cannot be read."""
    try:
        return nn_export.files.read_bytes(path, limit)
    except FileNotFoundError as error:
        raise InputError(f"{path}: the file is missing [HM-FILES-010]") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {reason(error)} [HM-FILES-011]") from error


def reason(error: BaseException) -> str:
    """The reason of an error of the file system, as text."""
    if isinstance(error, FileExistsError) and error.filename:
        return f"{error.filename} is a file, not a folder"
    return str(getattr(error, "strerror", None) or error)


def cannot_write(path: Path, error: OSError) -> StorageError:
    """The error that ``path`` cannot be written: place, reason, and what remains."""
    kept = "the old file is unchanged" if _exists(path) else "no partial file is left"
    return StorageError(f"{path}: cannot be written: {reason(error)}; {kept} [HM-FILES-019]")


def is_file(path: Path) -> bool:
    """Whether a readable file exists; False for a name that is too long for the file system."""
    try:
        return path.is_file()
    except OSError:
        return False


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:
        return False


def sha256(path: Path) -> str:
    """SHA-256 of a regular file's content."""
    return hashlib.sha256(read_bytes(path, MOST_CONTENT)).hexdigest()


def digest(value: Any) -> str:
    """SHA-256 of a value's JSON form."""
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()


def is_empty(folder: Path) -> bool:
    """Whether a folder is missing, or holds only leftovers of a killed writer or a lock."""
    try:
        if not folder.is_dir():
            return not folder.exists()
        names = [path.name for path in folder.iterdir()]
        return all(name == LOCK or (name.startswith(".") and name.endswith(PART)) for name in names)
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: cannot be listed: {reason(error)} [HM-FILES-012]") from error


def check_folder(folder: Path) -> None:
    """Refuse a folder for results that is not empty or not writable; it is not created."""
    if not is_empty(folder):
        raise InputError(f"{folder}: exists and is not an empty folder. Choose another --out. [HM-FILES-013]")
    check_writable(folder)


def check_writable(folder: Path) -> None:
    """Refuse a folder that is not writable; it may not exist yet."""
    try:
        if "\0" in str(folder):
            raise ValueError("its name contains a null character [HM-FILES-014]")
        place = folder.absolute()
        while not place.exists():  # a name that is too long for the file system raises here
            place = place.parent
        with tempfile.TemporaryFile(dir=place) as file:
            file.write(bytes(4096))
            file.flush()
            os.fsync(file.fileno())
    except (OSError, ValueError) as error:
        raise StorageError(
            f"{folder}: cannot be written: {reason(error)}. Choose another --out. [HM-FILES-015]"
        ) from error


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder (created if missing) against other jobs, and remove leftovers of killed writers.

    The system releases the lock whenever the process ends. InputError if another job holds it.
    """
    with named_extra("a job's folder"):
        from filelock import FileLock, Timeout

    lock = FileLock(folder / LOCK, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        raise InputError(
            f"{folder}: another process uses this folder. Wait for it, or choose another --out. [HM-FILES-016]"
        ) from error
    except OSError as error:
        raise cannot_write(folder, error) from error
    try:
        for place in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
            nn_export.files.sweep(place, age=-1.0)  # the lock excludes other writers
        yield
    finally:
        lock.release()
