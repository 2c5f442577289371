"""CSV files, read into columns and written."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.sources import Columns, Source, content_of, digest_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import write_text

Array = NDArray[np.float64]


def csv_source(path: Path) -> Source:
    """Open a CSV file: comma, decimal point, first line the header, UTF-8.

    Raises:
        InputError: If the file is missing, empty, no UTF-8 text or no table.
    """
    content = content_of(path)
    header, rows = _rows(path, content)

    def read(names: Sequence[str]) -> Columns:
        places = [header.index(name) for name in names]
        values = np.array([[_number(path, header, line, row, j) for j in places] for line, row in rows])
        return Columns(values.reshape(len(rows), len(places)), "row", [line for line, _ in rows])

    return Source(path, digest_of(content), tuple(header), read)


def write_csv(path: Path | str, columns: Mapping[str, Array]) -> Path:
    r"""Write columns of equal length as CSV: all of it or nothing, the same data as the same bytes.

    Numbers are written with ten significant digits. The file appears under its name only when complete.

    Args:
        path: File to write; its folder is made if need be, an old file of that name is replaced.
        columns: Values ``(m,)`` by column name.

    Returns:
        The path.

    Raises:
        InputError: If the columns differ in length or are not one-dimensional.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_csv(Path(folder) / "a.csv", {"t": np.array([0.0, 0.1])}).read_text()
        't\n0\n0.1\n'
    """
    path = Path(path)
    arrays = {name: np.asarray(column, dtype=float) for name, column in columns.items()}
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) != 1 or any(len(shape) != 1 for shape in shapes.values()):
        raise InputError(f"{path}: columns must be one-dimensional and of one length, got {shapes}")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(arrays)
    writer.writerows([f"{value + 0.0:.10g}" for value in row] for row in zip(*arrays.values(), strict=True))
    write_text(path, text.getvalue())
    return path


def _rows(path: Path, content: bytes) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Header and ``(row number, cells)``; blank lines are skipped but counted."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = content[: error.start].count(b"\n") + 1
        raise InputError(
            f"{path}: row {row} is no UTF-8 text. Export the table as CSV (UTF-8), or name the file .npz or "
            ".mat if it is one."
        ) from error
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: row {reader.line_num}: {error}. Export the table as plain CSV.") from error
    header = [name.strip() for name in rows[0][1]] if rows else []
    for line, cells in rows[1:]:
        if len(cells) != len(header):
            raise InputError(
                f"{path}: row {line} has {len(cells)} cells, the header (row {rows[0][0]}) has "
                f"{len(header)}. "
                "Separate cells by commas, write decimals with a point, and complete or delete the row."
            )
    return header, rows[1:]


def _number(path: Path, header: list[str], line: int, row: list[str], place: int) -> float:
    cell = row[place].strip()
    try:
        value = math.nan if "_" in cell else float(cell)
    except ValueError:
        value = math.nan
    if math.isfinite(value):
        return value
    what = f"is {cell!r}, not a finite number" if cell else "is empty"
    raise InputError(
        f"{path}: row {line}, column {header[place]!r} {what}. Delete the row (longer gaps are cut out) "
        "or repair the value."
    )
