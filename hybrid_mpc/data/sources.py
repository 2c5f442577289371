"""What a recording's file holds, whatever its format: names of columns, and numbers on request."""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]
ENDINGS = (".csv", ".npz", ".mat")
"""Formats with a reader of their own; any other ending is read as CSV."""


class MissingColumn(InputError):
    """A column that a file lacks."""


@dataclass(frozen=True)
class Columns:
    """Numbers of some columns, all finite.

    Args:
        values: ``(m, n)``, a column for each name asked for.
        row: What the file's own tools call a row: ``"row"`` or ``"index"``.
        numbers: Number of each row, ``m`` of them, as those tools count.
    """

    values: Array
    row: str
    numbers: Sequence[int]

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
        there = ", ".join(repr(column) for column in self.header) or "none"
        if count > 1:
            raise InputError(
                f"{self.path}: column {name!r} appears {count} times in {there}. Rename all but one."
            )
        fields = [column for column in self.header if column.endswith(f".{name}")]
        if len(fields) == 1:
            return fields[0]
        if fields:
            raise InputError(
                f"{self.path}: column {name!r} may be {' or '.join(map(repr, fields))}. "
                "Name it whole in the scenario's DataSpec."
            )
        near = difflib.get_close_matches(name, self.header, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise MissingColumn(
            f"{self.path}: no column {name!r}; it has {there}.{hint} "
            f"Rename the column or name yours in the scenario's DataSpec.{self.note}"
        )


def content_of(path: Path) -> bytes:
    """The file's bytes, at least one of which says something.

    Raises:
        InputError: If it is missing, cannot be read or is empty.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        files = path.parent.iterdir() if path.parent.is_dir() else ()
        near = sorted(p.name for p in files if p.suffix.lower() in ENDINGS)
        there = f"; that folder has: {', '.join(near)}" if near else ""
        raise InputError(f"{path}: there is no such file{there}. Check the path given with --data.") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}). Give a readable CSV, npz or mat file."
        ) from error
    if not content.strip():
        raise InputError(f"{path}: the file is empty. It needs a header line and rows of numbers.")
    return content


def digest_of(content: bytes) -> str:
    """SHA-256 in hexadecimal.

    Example:
        >>> digest_of(b"a")[:8]
        'ca978112'
    """
    return hashlib.sha256(content).hexdigest()
