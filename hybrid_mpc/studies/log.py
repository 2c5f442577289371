"""The rows of a study while it runs: appended durably, whole after a kill at any moment."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import locked
from hybrid_mpc.records import NUMBERS, plain
from nn_export.files import parse_json

STATUS = ("done", "failed")
MOST_LINE = 2**24
"""Largest row [bytes]: a run's figures, or the traceback of one that failed."""
SEGMENT_ROWS = 10_000
"""Rows of one file: a study of a million runs has a hundred of them."""


class RunLog:
    """Append-only JSON lines in a few numbered files, one row a finished run.

    What :meth:`append` has returned from is on the disk. A line that a kill tore apart is cut off when the log is
    opened again: its run counts as not finished. One process at a time may hold the log.

    Args:
        folder: Folder of the files; made if missing.

    Raises:
        InputError: If another process holds the log.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with RunLog(folder) as log:
        ...     log.append([{"id": "a", "status": "done", "cost": cost} for cost in (0.1, float("inf"))])
        >>> [row["cost"] for row in rows(folder)]
        [0.1, inf]
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held = ExitStack()
        self._held.enter_context(locked(folder))
        files = segments(folder)
        self._number = len(files) - 1 if files else 0
        self._rows = _repaired(files[-1]) if files else 0
        self._file = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, t: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the files; the log may be opened again."""
        os.close(self._file)
        self._held.close()

    def append(self, new: Iterable[Mapping[str, Any]]) -> None:
        """Add rows; on return they are on the disk.

        Raises:
            InputError: If they cannot be written (a full disk); what was there before is unharmed.
        """
        lines = [json.dumps(plain(row), separators=(",", ":")) + "\n" for row in new]
        if not lines:
            return
        if self._rows >= SEGMENT_ROWS:
            os.close(self._file)
            self._number, self._rows = self._number + 1, 0
            self._file = self._open()
        end = os.fstat(self._file).st_size
        try:
            left = memoryview("".join(lines).encode())
            while left:
                left = left[os.write(self._file, left) :]
            os.fsync(self._file)
        except OSError as error:
            os.ftruncate(self._file, end)  # needs no room
            raise InputError(
                f"{self._folder}: cannot write ({error.strerror}); the runs that were finished before are kept. Make "
                "room, then the same command with --resume goes on"
            ) from error
        self._rows += len(lines)

    def _open(self) -> int:
        path = self._folder / f"{self._number:06}.jsonl"
        binary = getattr(os, "O_BINARY", 0)  # on Windows: line ends as they are written
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | binary, 0o644)


def segments(folder: Path) -> list[Path]:
    """Files of a log, in order."""
    return sorted(path for path in folder.glob("[0-9]*.jsonl") if path.is_file())


def rows(folder: Path) -> Iterator[dict[str, Any]]:
    """Rows of a log, in the order in which they were written; a torn last line is left out.

    Raises:
        InputError: If a line within is damaged.
    """
    for path in segments(folder):
        with path.open("rb") as file:
            for number, line in enumerate(iter(partial(file.readline, MOST_LINE), b""), 1):
                if not line.endswith(b"\n") and len(line) < MOST_LINE:
                    return
                yield _parsed(line, path, number)


def _parsed(line: bytes, path: Path, number: int) -> dict[str, Any]:
    try:
        if len(line) == MOST_LINE:
            raise ValueError(f"longer than {MOST_LINE} bytes")
        row = parse_json(line)
        if not (isinstance(row, dict) and isinstance(row.get("id"), str) and row.get("status") in STATUS):
            raise ValueError("no row of a run: id and status are needed")
    except ValueError as error:
        raise InputError(
            f"{path}:{number} is damaged ({error}); delete this line, and --resume runs its run again"
        ) from error
    return {
        key: NUMBERS[value] if isinstance(value, str) and value in NUMBERS else value
        for key, value in row.items()
    }


def _repaired(path: Path) -> int:
    """Rows of a file, after a torn line at its end was cut off."""
    count = whole = 0
    with path.open("rb") as file:
        for line in file:
            if line.endswith(b"\n"):
                count, whole = count + 1, whole + len(line)
    if whole < path.stat().st_size:
        os.truncate(path, whole)
    return count
