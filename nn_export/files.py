"""Files read with a limit and written whole or not at all; JSON that holds no traps. Standard library alone."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import secrets
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

MAX_DEPTH = 40
"""Nested levels of JSON that are read: what this library writes has lists of lists of lists at most."""
MAX_DIGITS = 20
"""Digits of a whole number that are read: enough for any of 64 bits."""
MAX_VALUES = 2**21
"""Commas, colons and brackets in JSON that are read. Each may cost 80 bytes of memory: 160 MiB altogether."""
LEFTOVER_AGE = 3600.0
"""Age [s] from which a temporary file is a killed writer's: no file of this library takes minutes to write."""

_KINDS = {
    stat.S_IFDIR: "is a directory",
    stat.S_IFIFO: "is a named pipe, not a file",
    stat.S_IFSOCK: "is a socket, not a file",
    stat.S_IFCHR: "is a device, not a file",
    stat.S_IFBLK: "is a device, not a file",
}
_UNSYNCED = {errno.EACCES, errno.EINVAL, errno.ENOTSUP, errno.EPERM}
"""What a file system says that cannot write a folder through, or a folder that may be written but not read."""
_DIGITS = bytes(ord("0") if code in b"0123456789" else 0 for code in range(256))
"""Every digit becomes a 0: to look for a row of zeros is much faster than to look for a row of digits."""
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def read_bytes(path: Path, limit: int) -> bytes:
    """Content of a regular file of at most ``limit`` bytes. It never waits and never reads more than that.

    The ``strerror`` of its OSError reads well behind ``cannot read PATH: ``.
    """
    with opened(path, limit) as (file, length):
        blocks, size = [], 0
        while block := file.read(min(max(length - size, 2**16), limit - size) + 1):
            blocks.append(block)
            size += len(block)
            if size > limit:
                raise OSError(errno.EFBIG, f"grew while it was read: {_too_long(size, limit)}", str(path))
    return b"".join(blocks)


@contextmanager
def opened(path: Path, limit: int) -> Iterator[tuple[BinaryIO, int]]:
    """A regular file of at most ``limit`` bytes, opened for reading without waiting, and its length [byte].

    Only a regular file says how long it is; a pipe or a device may never end.
    """
    try:
        _refuse_kind(os.stat(path), path)  # before it is opened: to open a device may already do something
    except ValueError as error:  # no name of a file: a null character, half a surrogate pair
        raise OSError(errno.EINVAL, f"is no name of a file ({error})", str(path)) from error
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    with os.fdopen(os.open(path, flags), "rb") as file:
        found = os.fstat(file.fileno())
        _refuse_kind(found, path)  # another one may have taken its place
        if hasattr(os, "O_NONBLOCK"):
            os.set_blocking(file.fileno(), True)
        if found.st_size > limit:
            raise OSError(errno.EFBIG, _too_long(found.st_size, limit), str(path))
        yield file, found.st_size


def _refuse_kind(found: os.stat_result, path: Path) -> None:
    kind = stat.S_IFMT(found.st_mode)
    if kind != stat.S_IFREG:
        code = errno.EISDIR if kind == stat.S_IFDIR else errno.EINVAL
        raise OSError(code, _KINDS.get(kind, "is not a file"), str(path))


def _too_long(size: int, limit: int) -> str:
    texts = [_size(size), _size(limit)]
    if texts[0] == texts[1]:
        texts = [f"{size} bytes", f"{limit} bytes"]
    return f"has {texts[0]}, at most {texts[1]} are read"


def _size(count: int) -> str:
    for power, unit in ((3, "GiB"), (2, "MiB"), (1, "KiB")):
        if count >= 1024**power:
            return f"{count / 1024**power:.3g} {unit}"
    return f"{count} bytes"


def parse_json(content: bytes) -> Any:
    """A JSON text as Python's own types, with all refused that readers disagree on, or that costs without limit.

    A ValueError gives the reason: no JSON or UTF-8, ``NaN`` or ``Infinity``, a number that overflows, a whole number of
    more than 20 digits, a name twice in one object, half a surrogate pair, more than 40 nested levels or two million
    values.
    """
    if sum(map(content.count, (b",", b":", b"[", b"{"))) > MAX_VALUES:
        raise ValueError(f"more than {MAX_VALUES} values [NN-029]")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"no UTF-8 text at byte {error.start} [NN-030]") from error
    try:
        whole = _whole if b"0" * (MAX_DIGITS + 1) in content.translate(_DIGITS) else None
        data = json.loads(
            text, parse_constant=_constant, parse_float=_float, parse_int=whole, object_pairs_hook=_object
        )
    except RecursionError as error:  # soon: the reader counts its levels
        raise ValueError(f"nested deeper than {MAX_DEPTH} levels [NN-031]") from error
    if _too_deep(data):
        raise ValueError(f"nested deeper than {MAX_DEPTH} levels [NN-032]")
    if _SURROGATE.search(text):
        try:
            json.dumps(data, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            raise ValueError(
                "half a surrogate pair (\\ud800 to \\udfff), which is no character [NN-033]"
            ) from error
    return data


def _constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not JSON [NN-034]")


def _float(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"{text:.20} is too large a number [NN-035]")
    return value


def _whole(text: str) -> int:
    if len(text) - text.startswith("-") > MAX_DIGITS:
        raise ValueError(f"{text:.20}... has more than {MAX_DIGITS} digits [NN-036]")
    return int(text)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))  # type: ignore[func-returns-value]
        raise ValueError(f"{twice!r:.60} appears twice in one object [NN-037]")
    return found


def _too_deep(data: Any) -> bool:
    level = [data] if type(data) in (dict, list) else []
    for _ in range(MAX_DEPTH):
        inside = (holder.values() if type(holder) is dict else holder for holder in level)
        level = [value for values in inside for value in values if type(value) in (dict, list)]
        if not level:
            return False
    return True


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write in, which takes the place of ``path`` when the block ends well.

    A reader sees the old file or the new one, whole, also after a kill or a loss of power at any moment, and however
    many processes write to the same path. An exception within the block leaves the old file. The file lies in the same
    folder under a hidden name of its own until then; :func:`sweep` removes those that killed writers leave.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # 50: a name has at most 255 bytes
    part = path.with_name(f".{path.name[:50]}.{secrets.token_hex(8)}.part")
    # The mode is given to open, which takes the umask off: to ask for the umask is to change it, for all threads.
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    handle = os.open(part, flags, 0o644)
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    if os.name != "posix":
        return  # Windows has no such call
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno not in _UNSYNCED:
            raise


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, as :func:`replacing` does."""
    with replacing(path) as file:
        file.write(content)


def sweep(folder: Path, age: float = LEFTOVER_AGE) -> None:
    """Remove the temporary files (``.*.part``) older than ``age`` [s] that killed writers left in a folder."""
    now = time.time()
    for part in folder.glob(".*.part"):
        with suppress(FileNotFoundError, PermissionError):  # another sweep was faster; another user's stays
            found = part.lstat()
            if stat.S_ISREG(found.st_mode) and now - found.st_mtime > age:
                part.unlink()
