"""CSV files, read into columns and written."""

from __future__ import annotations

import codecs
import csv
import io
import math
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.sources import LARGEST, Columns, Source, content_of, digest_of, megabytes
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import write_text
from hybrid_mpc.records import shown

Array = NDArray[np.float64]
Row = tuple[int, list[str]]
LONGEST_ROW = 2**20
"""Most bytes of a row [byte]: ten thousand columns of a hundred characters."""


def csv_source(path: Path) -> Source:
    """Open a CSV file: comma, decimal point, first line the header, UTF-8.

    Raises:
        InputError: If the file is missing, no regular file, too large, empty, no UTF-8 text or no table.
    """
    text = _Text(path)
    content = content_of(path, text.check)
    text.finish()
    header_row, header = next(_rows(path, content), (1, []))
    names = [name.strip() for name in header]

    def read(wanted: Sequence[str]) -> Columns:
        return _columns(path, _rows(path, content), (header_row, names), wanted)

    return Source(path, digest_of(content), tuple(names), read)


def write_csv(path: Path | str, columns: Mapping[str, Array], *, decimals: int | None = None) -> Path:
    r"""Write columns of equal length as CSV: all of it or nothing, the same data as the same bytes.

    The file appears under its name only when complete.

    Args:
        path: File to write; its folder is made if need be, an old file of that name is replaced.
        columns: Values ``(m,)`` by column name.
        decimals: Digits after the point. Default: ten significant digits.

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
    writer.writerows(
        [_written(value, decimals) for value in row] for row in zip(*arrays.values(), strict=True)
    )
    write_text(path, text.getvalue())
    return path


def _written(value: float, decimals: int | None) -> str:
    return f"{value + 0.0:.10g}" if decimals is None else f"{value:.{decimals}f}"  # + 0.0: no "-0"


class _Text:
    """Whether bytes are UTF-8 text with rows of a bearable length, told piece by piece."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        self._row, self._length = 1, 0

    def check(self, piece: bytes) -> None:
        """Look at the next piece of the file.

        Raises:
            InputError: If it is no text, or a row is too long.
        """
        codes = np.frombuffer(piece, dtype=np.uint8)
        ends = np.flatnonzero((codes == ord("\n")) | (codes == ord("\r")))
        lengths = np.diff(ends, prepend=-1 - self._length)
        rest = len(piece) - 1 - int(ends[-1]) if len(ends) else self._length + len(piece)
        if max(int(lengths.max(initial=0)), rest) > LONGEST_ROW:
            raise InputError(
                f"{self._path}: has a row of more than {megabytes(LONGEST_ROW)}. Write one line a sample, with "
                "the columns that are needed."
            )
        self._decode(piece)
        self._row, self._length = self._row + piece.count(b"\n"), rest

    def finish(self) -> None:
        """Nothing follows.

        Raises:
            InputError: If the text ends within a character.
        """
        self._decode(b"", last=True)

    def _decode(self, piece: bytes, last: bool = False) -> None:
        try:
            self._decoder.decode(piece, last)
        except UnicodeDecodeError as error:
            row = self._row + error.object[: error.start].count(b"\n")
            raise InputError(
                f"{self._path}: row {row} is no UTF-8 text. Export the table as CSV (UTF-8), or name the file .npz or "
                ".mat if it is one; unpack it if it is packed."
            ) from error


def _rows(path: Path, content: bytes) -> Iterator[Row]:
    """Number and cells of each row; blank ones are skipped but counted."""
    reader = csv.reader(io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig", newline=""))
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                yield reader.line_num, row
    except csv.Error as error:
        raise InputError(f"{path}: row {reader.line_num}: {error}. Export the table as plain CSV.") from error


def _columns(
    path: Path, rows: Iterator[Row], header: tuple[int, list[str]], wanted: Sequence[str]
) -> Columns:
    """Numbers of the wanted columns; a row of another length than the header is an error of the whole file."""
    names = header[1]
    next(rows, None)
    places = [names.index(name) for name in wanted]
    columns, numbers = [array("d") for _ in places], array("q")
    bad: list[tuple[int, str, int] | None] = [None] * len(places)
    unequal: tuple[int, int, int] | None = None
    most = LARGEST // 8 // (len(places) + 1)
    for line, cells in rows:
        if len(cells) != len(names):
            unequal = (unequal[0], unequal[1], unequal[2] + 1) if unequal else (line, len(cells), 1)
            continue
        if len(numbers) == most:
            raise InputError(f"{path}: has more than {most} rows, more than are read. Split the recording.")
        numbers.append(line)
        for j, place in enumerate(places):
            value = _number(cells[place])
            columns[j].append(value)
            if value != value:
                first = bad[j]
                bad[j] = (first[0], first[1], first[2] + 1) if first else (line, cells[place].strip(), 1)
    if unequal:
        line, count, times = unequal
        raise InputError(
            f"{path}: row {line} has {count} cells, the header (row {header[0]}) has {len(names)}"
            f"{f' ({times} such rows)' if times > 1 else ''}. "
            "Separate cells by commas, write decimals with a point, and complete or delete the row."
        )
    values = np.column_stack([np.array(column) for column in columns])
    problems = tuple(_told(name, *one) for name, one in zip(wanted, bad, strict=True) if one)
    return Columns(values, "row", numbers, problems)


def _number(cell: str) -> float:
    """The number in a cell; NaN for what is no finite one."""
    try:
        value = float(cell)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and "_" not in cell else math.nan


def _told(name: str, line: int, cell: str, count: int) -> str:
    """What is wrong with a column that has other cells than numbers."""
    what = f"is {shown(cell)}, not a finite number" if cell else "is empty"
    such = f" ({count} such rows)" if count > 1 else ""
    return (
        f"row {line}, column {shown(name)} {what}{such}. Delete the row (longer gaps are cut out) or repair "
        "the value."
    )
