"""What a recording's file holds, whatever its format: names of columns, and numbers on request."""

from __future__ import annotations

import difflib
import errno
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import nn_export.files
from hybrid_mpc.errors import InputError
from hybrid_mpc.records import LONGEST, shown

Array = NDArray[np.float64]
ENDINGS = (".csv", ".npz", ".mat")
"""Formats with a reader of their own; any other ending is read as CSV."""
LARGEST = 2**31
"""Most bytes of a file, and of the numbers in it [byte]: three columns at 1 kHz for a day."""
SMALL = 2**26
"""Bytes of numbers that any file may hold [byte], however well they are compressed: 8 million numbers."""
PACKED = 20
"""Beyond ``SMALL``, most bytes of numbers for one byte of a file. Recorded motions are compressed to a tenth at best; a
thousand to one is what zeros, and bombs, come to."""
CHUNK = 2**20
"""Bytes of a file that are looked at in one go [byte]."""
LISTED = 30
"""Most names that a message lists."""
COMPARED = 1000
"""Most names among which a message looks for one that is nearly right."""


class MissingColumn(InputError):
    """A column that a file lacks."""


@dataclass(frozen=True)
class Columns:
    """Numbers of some columns.

    Args:
        values: ``(m, n)``, a column for each name asked for; NaN where there is no finite number.
        row: What the file's own tools call a row: ``"row"`` or ``"index"``.
        numbers: Number of each row, ``m`` of them, as those tools count.
        problems: What is wrong with single columns, each with place and remedy, without the file's name. Default: all
            numbers are finite.
    """

    values: Array
    row: str
    numbers: Sequence[int]
    problems: tuple[str, ...] = ()

    def place(self, k: int) -> str:
        """Where sample ``k`` stands in the file, e.g. ``"row 12"``."""
        return f"{self.row} {self.numbers[k]}"


@dataclass(frozen=True)
class Source:
    """A recording's file, opened.

    Args:
        path: The file.
        sha256: SHA-256 of its bytes, in hexadecimal.
        header: Names of its columns, in its order.
        read: ``(full names) -> Columns``, the first one being the time.
        note: What else a user should know who misses a column; default: nothing.
    """

    path: Path
    sha256: str
    header: tuple[str, ...]
    read: Callable[[Sequence[str]], Columns]
    note: str = ""

    def find(self, name: str) -> str:
        """Full name of a column: its own, or ``struct.field`` where just one struct has such a field.

        Raises:
            MissingColumn: If there is none.
            InputError: If there are several.
        """
        count = self.header.count(name)
        if count == 1:
            return name
        there = listed(self.header)
        if count > 1:
            raise InputError(
                f"{self.path}: column {name!r} appears {count} times in {there}. Rename all but one."
            )
        fields = [column for column in self.header if column.endswith(f".{name}")]
        if len(fields) == 1:
            return fields[0]
        if fields:
            raise InputError(
                f"{self.path}: column {name!r} may be {' or '.join(map(shown, fields[:LISTED]))}. "
                "Name it whole in the scenario's DataSpec."
            )
        near = difflib.get_close_matches(name, [c for c in self.header[:COMPARED] if len(c) < LONGEST], n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise MissingColumn(
            f"{self.path}: no column {name!r}; it has {there}.{hint} "
            f"Rename the column or name yours in the scenario's DataSpec.{self.note}"
        )


def content_of(path: Path, check: Callable[[bytes], None] | None = None) -> bytes:
    """The file's bytes, at least one of which says something.

    Only a regular file is read: nothing else says how long it is, and a pipe or a device may never end. It is opened
    without waiting.

    Args:
        path: The file.
        check: Called with one piece of at most ``CHUNK`` after the other before anything is kept; it raises where the
            rest is not worth reading. Default: no check.

    Raises:
        InputError: If it is missing, no regular file, too large, cannot be read or is empty.
    """
    try:
        with nn_export.files.opened(path, LARGEST) as (file, size):
            left = size
            while check is not None and left > 0 and (piece := file.read(min(CHUNK, left))):
                check(piece)
                left -= len(piece)
            file.seek(0)
            content = file.read(size)  # what is written to it by now is left for the next time
    except FileNotFoundError:
        raise InputError(
            f"{path}: there is no such file{_beside(path)}. Check the path given with --data."
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). {_instead(error)}") from error
    if not content or content.isspace():
        raise InputError(f"{path}: the file is empty. It needs a header line and rows of numbers.")
    return content


def _instead(error: OSError) -> str:
    """What to do about it."""
    if error.errno == errno.EFBIG:
        return "Split the recording, or leave out columns that are not needed."
    return "Give a readable CSV, npz or mat file."


def _beside(path: Path) -> str:
    """What recordings the folder of a missing one has, for a message."""
    try:
        near = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in ENDINGS)
    except OSError:
        return ""
    return f"; that folder has: {', '.join(near[:LISTED])}" if near else ""


def budget_of(content: bytes) -> int:
    """Bytes of numbers that a file of this content may hold [byte].

    Example:
        >>> budget_of(bytes(100)) == SMALL, budget_of(bytes(10_000_000)) == 200_000_000
        (True, True)
    """
    return min(LARGEST, max(SMALL, PACKED * len(content)))


def megabytes(size: int) -> str:
    """A number of bytes for a message.

    Example:
        >>> megabytes(2_500_000)
        '2.5 MB'
    """
    return f"{size / 1e6:.4g} MB"


def listed(names: Sequence[str]) -> str:
    """Names in quotes for a message, the first of many.

    Example:
        >>> listed(["t", "phi"]), listed([])
        ("'t', 'phi'", 'none')
    """
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(shown(name) for name in names[:LISTED]) + more or "none"


def digest_of(content: bytes) -> str:
    """SHA-256 in hexadecimal.

    Example:
        >>> digest_of(b"a")[:8]
        'ca978112'
    """
    return hashlib.sha256(content).hexdigest()
