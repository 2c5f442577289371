"""Rows of a finished study as one Parquet file, with what it is made of in the file's metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import replacing
from hybrid_mpc.records import plain
from hybrid_mpc.studies.log import rows
from nn_export.files import parse_json

if TYPE_CHECKING:
    import pyarrow as pa

RESULTS = "results.parquet"
METADATA = b"hybrid_mpc.study"
GROUP_ROWS = 20_000
"""Rows that are in memory at a time."""


def compact(log: Path, path: Path, provenance: Mapping[str, Any]) -> None:
    """Write the rows of a log as Parquet: all of it or nothing. Of several rows of a run the last counts.

    Args:
        log: Folder of the log.
        path: File to write.
        provenance: Plain data for the file's metadata.

    Raises:
        StorageError: If it cannot be written (a full disk); the log is unharmed.
    """
    import pyarrow.parquet as pq

    last: dict[str, int] = {}
    kinds: dict[str, set[type]] = {}
    for i, row in enumerate(rows(log)):
        last[row["id"]] = i
        for key, value in row.items():
            kinds.setdefault(key, set()).add(type(value))
    schema = _schema(kinds).with_metadata({METADATA: json.dumps(plain(provenance)).encode()})
    kept = (row for i, row in enumerate(rows(log)) if last[row["id"]] == i)
    with replacing(path) as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        for group in _groups(kept, GROUP_ROWS):
            writer.write_table(_table(group, schema))


def intact(path: Path) -> bool:
    """Whether a Parquet file is there and can be read to its end.

    Example:
        >>> intact(Path("nowhere.parquet"))
        False
    """
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


def provenance_of(path: Path) -> dict[str, Any]:
    """What a Parquet file of a study says of itself.

    Raises:
        InputError: If it is no such file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        metadata = pq.read_schema(path).metadata or {}
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path} is missing or damaged: {error}") from error
    if METADATA not in metadata:
        raise InputError(f"{path} is no table of a study")
    try:
        return dict(parse_json(metadata[METADATA]))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged: {error}") from error


def _schema(kinds: Mapping[str, set[type]]) -> pa.Schema:
    import pyarrow as pa

    return pa.schema([(key, _type(found - {type(None)})) for key, found in kinds.items()])


def _type(found: set[type]) -> pa.DataType:
    import pyarrow as pa

    if found == {bool}:
        return pa.bool_()
    if found == {int}:
        return pa.int64()
    return pa.float64() if found <= {int, float} else pa.string()


def _table(group: list[dict[str, Any]], schema: pa.Schema) -> pa.Table:
    import pyarrow as pa

    columns = []
    for field in schema:
        values = [row.get(field.name) for row in group]
        if field.type == pa.float64():
            values = [None if v is None else float(v) for v in values]
        elif field.type == pa.string():
            values = [None if v is None else str(v) for v in values]
        columns.append(pa.array(values, type=field.type))
    return pa.Table.from_arrays(columns, schema=schema)


def _groups(values: Iterator[dict[str, Any]], size: int) -> Iterator[list[dict[str, Any]]]:
    while group := list(islice(values, size)):
        yield group
