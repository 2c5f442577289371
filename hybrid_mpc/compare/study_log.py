"""Files in the folder of a study: a note with its settings, the log with the rows of its runs, and the final table.

Rows are appended when runs end, and survive a kill at any time; the table is one Parquet file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.files import locked, replacing
from hybrid_mpc.folder import read_note
from hybrid_mpc.records import NUMBERS, plain, record
from nn_export.files import parse_json

if TYPE_CHECKING:
    import pyarrow as pa


NOUN = "study"
SCHEMA_VERSION = 2
RUNS = "runs"
"""Folder of the log within the study's folder."""
RESULTS = "results.parquet"
METADATA = b"hybrid_mpc.study"
STATUS = ("done", "failed")
MOST_LINE = 2**24
"""Largest row [bytes]: figures of a run, or traceback of a failed run."""
SEGMENT_ROWS = 10_000
"""Rows of one file of the log; a study of a million runs has a hundred files."""


@dataclass(frozen=True)
class NoiseNote:
    """Process noise of a model's filters.

    Args:
        source: Its source.
        sigma_x: Standard deviations per period by controller.
    """

    source: str
    sigma_x: Mapping[str, tuple[float, ...]]


@dataclass(frozen=True)
class ModelNote:
    """A model of a study.

    Args:
        sha256: Hash of its folder.
        provenance: Its provenance.
        noise: Process noise of its filters.
    """

    sha256: str
    provenance: Mapping[str, Any]
    noise: NoiseNote


@dataclass(frozen=True)
class StudyNote:
    """Note of a study.

    Args:
        study: Its settings.
        title: Title of the scenario.
        description: Description of the scenario.
        models: Its models by label.
        runs: Number of its loops.
        versions: Versions of the packages by name.
        kind: What its runs are. Default: ``"loops"``.
        scenario_sha256: Hash of the scenario's file; None for a registered scenario.
        engine: What computed the runs; empty until the study is finished.
        workers_died: Number of dead workers.
        schema_version: Version of the note.
    """

    study: Mapping[str, Any]
    title: str
    description: str
    models: Mapping[str, ModelNote]
    runs: int
    versions: Mapping[str, str] = field(default_factory=dict)
    kind: str = "loops"
    scenario_sha256: str | None = None
    engine: str = ""
    workers_died: int = 0
    schema_version: int = SCHEMA_VERSION


def study_note(folder: Path) -> StudyNote:
    """Read the note in a study's folder.

    Raises:
        InputError: If the folder belongs to no study, or the note is damaged or of another version.
    """
    if not (folder / f"{NOUN}.json").is_file():
        raise InputError(
            f"{folder}: no study in this folder; give the folder of 'study run --out' [HM-COMPARE-043]"
        )
    note = read_note(folder, NOUN)
    del note["settings"]
    return note_of(note, str(folder / f"{NOUN}.json"))


def note_of(data: Mapping[str, Any], where: str) -> StudyNote:
    """A note from plain data; InputError for another version or an invalid field."""
    if data.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{where}: schema version {str(data.get('schema_version'))[:20]}, but this version of hybrid-mpc reads "
            f"{SCHEMA_VERSION}. Run the study again [HM-COMPARE-044]"
        )
    return record(StudyNote, data, where)


@dataclass(frozen=True)
class RunRow:
    """The row of a run: settings and results (``columns``), ``status`` (``"done"`` or ``"failed"``), and the traceback
    of a failed run.
    """

    id: str
    status: str
    error: str
    columns: Mapping[str, Any]

    def plain(self) -> dict[str, Any]:
        """The row as one flat mapping: ``id``, its columns, ``status`` and ``error``."""
        return {"id": self.id, **self.columns, "status": self.status, "error": self.error}


class RunLog:
    """Append-only log of JSON lines in numbered files, one row for each finished run.

    After :meth:`append` has returned, its rows are on the disk. An incomplete last line (after a kill) is removed when
    the log is opened again; its run counts as not finished. Only one process at a time may open the log.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held = ExitStack()
        self._held.enter_context(locked(folder))
        files = segments(folder)
        self._number = len(files) - 1 if files else 0
        self._rows = _repair(files[-1]) if files else 0
        self._file = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; the log may be opened again."""
        os.close(self._file)
        self._held.close()

    def append(self, new: Iterable[RunRow]) -> None:
        """Add rows; on return they are on the disk. On a full disk, earlier rows are kept."""
        lines = [json.dumps(plain(row.plain()), separators=(",", ":")) + "\n" for row in new]
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
            os.ftruncate(self._file, end)  # possible on a full disk
            raise InputError(
                f"{self._folder}: cannot write ({error.strerror}). Finished runs are kept. Free disk space, then "
                "continue with the same command and --resume [HM-COMPARE-045]"
            ) from error
        self._rows += len(lines)

    def _open(self) -> int:
        path = self._folder / f"{self._number:06}.jsonl"
        binary = getattr(os, "O_BINARY", 0)  # Windows only: do not translate line ends
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | binary, 0o644)


def segments(folder: Path) -> list[Path]:
    """Files of a log, in order."""
    return sorted(path for path in folder.glob("[0-9]*.jsonl") if path.is_file())


def rows(folder: Path) -> Iterator[RunRow]:
    """Rows of a log in the order of writing, without an incomplete last line.

    Raises:
        InputError: If another line is damaged.
    """
    for path in segments(folder):
        with path.open("rb") as file:
            for number, line in enumerate(iter(partial(file.readline, MOST_LINE), b""), 1):
                if not line.endswith(b"\n") and len(line) < MOST_LINE:
                    return
                yield _parse(line, path, number)


def _parse(line: bytes, path: Path, number: int) -> RunRow:
    try:
        if len(line) == MOST_LINE:
            raise ValueError(f"longer than {MOST_LINE} bytes [HM-COMPARE-046]")
        row = parse_json(line)
        if not (isinstance(row, dict) and isinstance(row.get("id"), str) and row.get("status") in STATUS):
            raise ValueError("not the row of a run: id or status is missing [HM-COMPARE-047]")
    except ValueError as error:
        raise InputError(
            f"{path}:{number}: damaged ({error}). Delete this line; then --resume repeats its run [HM-COMPARE-048]"
        ) from error
    name, status, why = (row.pop(key, "") for key in ("id", "status", "error"))
    columns = {key: NUMBERS.get(v, v) if isinstance(v, str) else v for key, v in row.items()}
    return RunRow(name, status, str(why), columns)


def _repair(path: Path) -> int:
    """Number of rows of a file, after removing an incomplete last line."""
    count = whole = 0
    with path.open("rb") as file:
        for line in file:
            if line.endswith(b"\n"):
                count, whole = count + 1, whole + len(line)
    if whole < path.stat().st_size:
        os.truncate(path, whole)
    return count


@named_extra("a study")
def compact(log: Path, path: Path, provenance: Mapping[str, Any]) -> None:
    """Write the rows of a log as one Parquet file, whole or not at all; of several rows of a run, the last one."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    last: dict[str, int] = {}
    kinds: dict[str, set[type]] = {}
    for i, row in enumerate(rows(log)):
        last[row.id] = i
        for key, value in row.plain().items():
            kinds.setdefault(key, set()).add(type(value))
    columns = {key: _convert_column(found - {type(None)}) for key, found in kinds.items()}
    schema = pa.schema([(key, kind) for key, (kind, _) in columns.items()])
    schema = schema.with_metadata({METADATA: json.dumps(plain(provenance)).encode()})
    final = (row.plain() for i, row in enumerate(rows(log)) if last[row.id] == i)
    with replacing(path) as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        # largest number of rows in memory
        while group := list(islice(final, 20_000)):
            for values in group:
                values |= {
                    k: make(values[k]) for k, (_, make) in columns.items() if values.get(k) is not None
                }
            writer.write_table(pa.Table.from_pylist(group, schema=schema))


@named_extra("a study")
def intact(path: Path) -> bool:
    """Whether a Parquet file exists and can be read to its end."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        return False
    try:
        provenance_of(path)
        for group in pq.ParquetFile(path).iter_batches():
            group.validate(full=True)
    except (InputError, OSError, ValueError, pa.ArrowException):
        return False
    return True


@named_extra("a study")
def provenance_of(path: Path) -> dict[str, Any]:
    """The note in a Parquet file of a study; InputError for any other file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        metadata = pq.read_schema(path).metadata or {}
    except (OSError, pa.ArrowException) as error:
        raise InputError(
            f"{path}: missing or damaged: {error}. Delete the file; then --resume writes it again [HM-COMPARE-049]"
        ) from error
    if METADATA not in metadata:
        raise InputError(f"{path}: not the table of a study; give a file of 'study run' [HM-COMPARE-050]")
    try:
        return dict(parse_json(metadata[METADATA]))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path}: damaged: {error}. Delete the file; then --resume writes it again [HM-COMPARE-059]"
        ) from error


def _convert_column(found: set[type]) -> tuple[pa.DataType, Callable[[Any], Any]]:
    """Arrow type of a column with values of these Python types, and the conversion of its values."""
    import pyarrow as pa

    if found == {bool}:
        return pa.bool_(), bool
    if found == {int}:
        return pa.int64(), int
    return (pa.float64(), float) if found <= {int, float} else (pa.string(), str)
