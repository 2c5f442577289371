"""A recording's file as named columns, and CSV files written. Nothing in these files is executed.

:func:`opened` takes CSV, ``.npz`` and ``.mat``. What would take too much memory is refused before it is unpacked.
"""

from __future__ import annotations

import codecs
import csv
import difflib
import errno
import hashlib
import io
import math
import re
import warnings
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatlabObject, MatlabOpaque, MatReadWarning

import nn_export.files
from hybrid_mpc.data.mat_structure import check_structure, version
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import check_npz, write_text
from hybrid_mpc.records import LONGEST, shown

Array = NDArray[np.float64]
Row = tuple[int, list[str]]
ENDINGS = (".csv", ".npz", ".mat")
"""Formats with a reader of their own; any other ending is read as CSV."""
LARGEST = 2**31
"""Largest file, and most bytes of numbers in it [byte]: three columns at 1 kHz for a day."""
SMALL = 2**26
"""Bytes of numbers that any file may hold [byte], however well they are compressed: 8 million numbers."""
PACKED = 20
"""Beyond ``SMALL``, most bytes of numbers for one byte of a file. Recorded motions are compressed to a tenth at best,
zeros to a thousandth."""
CHUNK = 2**20
"""Bytes of a file that are checked at a time [byte]."""
LONGEST_ROW = 2**20
"""Longest row of a CSV file [byte]: ten thousand columns of a hundred characters."""
ALIKE = 0.7
"""How alike a column's name must be to be proposed: ``inflow_degC`` is by 0.6 like ``tank_degC``, by its unit alone."""
LISTED = 30
"""Most names that a message lists."""
COMPARED = 1000
"""Most names among which a message looks for one that is nearly right."""
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
"""What may stand between the cells of a CSV file; the one that gives the header most names is taken."""
TOP = 2**16
"""Bytes of the header that are looked at for the separator [byte]."""
BLANK = ("", "nan", "na", "n/a")
"""Cells that say that there is no value, in small letters."""


def name_and_unit(column: str) -> tuple[str, str]:
    """A column's name and the unit that stands behind it in brackets; ``""`` if there is none.

    Example:
        >>> name_and_unit("level [mm]"), name_and_unit("time (s)"), name_and_unit("phi")
        (('level', 'mm'), ('time', 's'), ('phi', ''))
    """
    for opening, closing in ("[]", "()"):
        name, bracket, unit = column.removesuffix(closing).rpartition(opening)
        if column.endswith(closing) and bracket and name.strip():
            return name.strip(), unit.strip()
    return column, ""


class MissingColumn(InputError):
    """A column that a file lacks."""


@dataclass(frozen=True)
class Columns:
    """Numbers of some columns.

    ``values`` ``(m, n)`` has a column for each name asked for, NaN where there is no finite number. ``row`` is what
    the file's own tools call a row, ``"row"`` or ``"index"``, and ``numbers`` are the rows' numbers as they count.
    ``problems`` of single columns have place and remedy, without the file's name; a blank cell is one only in columns
    that may have none.
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
    """A recording's file, opened: ``read(full name of the time, full names, blanks)`` gives the columns, time first.

    ``blanks`` are the names of columns that may have blank cells; a time of None is no column. ``sha256`` is that of
    the file's bytes; ``note`` is what else a user should know who misses a column.
    """

    path: Path
    sha256: str
    header: tuple[str, ...]
    read: Callable[[str | None, Sequence[str], Collection[str]], Columns]
    note: str = ""

    def find(self, name: str) -> str:
        """Full name of a column: its own, ``struct.field`` where just one struct has it, or with its unit in brackets.

        Raises:
            MissingColumn: If there is none.
            InputError: If there are several.
        """
        count = self.header.count(name)
        if count == 1:
            return name
        more = f" and {len(self.header) - LISTED} more" if len(self.header) > LISTED else ""
        there = ", ".join(map(shown, self.header[:LISTED])) + more or "none"
        if count > 1:
            raise InputError(
                f"{self.path}: column {name!r} appears {count} times in {there}. Rename all but one."
            )
        fields = [column for column in self.header if column.endswith(f".{name}")] or [
            column for column in self.header if name_and_unit(column)[0] == name
        ]
        if len(fields) == 1:
            return fields[0]
        if fields:
            raise InputError(
                f"{self.path}: column {name!r} may be {' or '.join(map(shown, fields[:LISTED]))}. "
                "Name it whole in the scenario's DataSpec."
            )
        near = difflib.get_close_matches(
            name, [c for c in self.header[:COMPARED] if len(c) < LONGEST], n=1, cutoff=ALIKE
        )
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise MissingColumn(
            f"{self.path}: no column {name!r}; it has {there}.{hint} "
            f"Rename the column or name yours in the scenario's DataSpec.{self.note}"
        )


def opened(path: Path) -> Source:
    """Open a recording's file by its ending.

    ==========  ========================================================================================
    ``.npz``    named vectors (``numpy.savez``); objects are refused
    ``.mat``    MATLAB's vectors, ``save`` with ``-v4``, ``-v6`` or ``-v7``, not 7.3; a struct's fields are
                ``struct.field``
    any other   CSV: a comma, semicolon or tab between cells, decimals with a point (where no comma separates, with a
                comma, too), the first line the header, UTF-8
    ==========  ========================================================================================
    """
    return {".npz": _npz, ".mat": _mat}.get(path.suffix.lower(), _csv)(path)


def _content(path: Path, check: Callable[[bytes], None] = lambda piece: None) -> bytes:
    """The bytes of a regular file; ``check`` sees them piece by piece before any is kept.

    Pipes and devices are refused: nothing says how long they are, and they may never end.
    """
    try:
        with nn_export.files.opened(path, LARGEST) as (file, size):
            left = size
            while left > 0 and (piece := file.read(min(CHUNK, left))):
                check(piece)
                left -= len(piece)
            file.seek(0)
            content = file.read(size)
    except FileNotFoundError:
        raise InputError(
            f"{path}: there is no such file{_beside(path)}. Check the path given with --data."
        ) from None
    except OSError as error:
        remedy = (
            "Split the recording, or leave out columns that are not needed."
            if error.errno == errno.EFBIG
            else "Give a readable CSV, npz or mat file."
        )
        raise InputError(f"{path}: cannot be read ({error.strerror}). {remedy}") from error
    if not content or content.isspace():
        raise InputError(f"{path}: the file is empty. It needs a header line and rows of numbers.")
    return content


def _beside(path: Path) -> str:
    """Recordings in the folder of a missing one, for a message."""
    try:
        near = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in ENDINGS)
    except OSError:
        return ""
    return f"; that folder has: {', '.join(near[:LISTED])}" if near else ""


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.4g} MB"


def _line(error: BaseException) -> str:
    """The first line of an error's message, or its kind."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


# CSV


def _csv(path: Path) -> Source:
    text = _Text(path)
    content = _content(path, text.check)
    text.check(b"", last=True)
    separator = _separator(content)
    line, header = next(_rows(path, content, separator), (1, []))
    names = tuple(name.strip() for name in header)

    def read(time: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        rows = _rows(path, content, separator)
        next(rows, None)
        return _parsed(
            path, rows, line, names, [*([] if time is None else [time]), *wanted], blanks, separator
        )

    return Source(path, hashlib.sha256(content).hexdigest(), names, read)


def _separator(content: bytes) -> str:
    """What separates the cells of a CSV file, by its header."""
    found = re.search(rb"[^\s,;][^\r\n]{0,%d}" % TOP, content)
    line = (found[0] if found else b"").decode("utf-8-sig", errors="replace").splitlines()[:1]
    return max(
        SEPARATORS,
        key=lambda separator: max((len(row) for row in csv.reader(line, delimiter=separator)), default=0),
    )


class _Text:
    """Checks piece by piece that bytes are UTF-8 text with rows of a bearable length."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        self._row, self._length = 1, 0

    def check(self, piece: bytes, last: bool = False) -> None:
        codes = np.frombuffer(piece, dtype=np.uint8)
        ends = np.flatnonzero((codes == ord("\n")) | (codes == ord("\r")))
        lengths = np.diff(ends, prepend=-1 - self._length)
        rest = len(piece) - 1 - int(ends[-1]) if len(ends) else self._length + len(piece)
        if max(int(lengths.max(initial=0)), rest) > LONGEST_ROW:
            raise InputError(
                f"{self._path}: has a row of more than {_megabytes(LONGEST_ROW)}. Write one line a sample, with "
                "the columns that are needed."
            )
        try:
            self._decoder.decode(piece, last)
        except UnicodeDecodeError as error:
            row = self._row + error.object[: error.start].count(b"\n")
            raise InputError(
                f"{self._path}: row {row} is no UTF-8 text. Export the table as CSV (UTF-8), or name the file .npz or "
                ".mat if it is one; unpack it if it is packed."
            ) from error
        self._row, self._length = self._row + piece.count(b"\n"), rest


def _rows(path: Path, content: bytes, separator: str) -> Iterator[Row]:
    """Number and cells of each row; blank ones are skipped but counted."""
    file = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig", newline="")
    reader = csv.reader(file, delimiter=separator)
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                yield reader.line_num, row
    except csv.Error as error:
        raise InputError(f"{path}: row {reader.line_num}: {error}. Export the table as plain CSV.") from error


def _parsed(
    path: Path,
    rows: Iterator[Row],
    header: int,
    names: Sequence[str],
    wanted: Sequence[str],
    blanks: Collection[str],
    separator: str,
) -> Columns:
    """Numbers of the wanted columns; a row of another length than the header is an error of the whole file."""
    places = [names.index(name) for name in wanted]
    lax = [name in blanks for name in wanted]
    columns, numbers = [array("d") for _ in places], array("q")
    bad = [0] * len(places)  # cells of each column that are no number, and the first of them
    first_bad = [(0, "")] * len(places)
    unequal, first_unequal = 0, (0, 0)
    marks: dict[
        str, tuple[int, str]
    ] = {}  # decimal marks where they may be commas, and the first cell of each
    most = LARGEST // 8 // (len(places) + 1)
    for line, cells in rows:
        if len(cells) != len(names):
            first_unequal = first_unequal if unequal else (line, len(cells))
            unequal += 1
            continue
        if len(numbers) == most:
            raise InputError(f"{path}: has more than {most} rows, more than are read. Split the recording.")
        numbers.append(line)
        for j, place in enumerate(places):
            cell = cells[place]
            if separator != ",":
                for mark in ",.":
                    if mark in cell:
                        marks.setdefault(mark, (line, cell.strip()))
                cell = cell.replace(",", ".")
            value = _number(cell)
            columns[j].append(value)
            if value != value and not (lax[j] and cell.strip().lower() in BLANK):
                first_bad[j] = first_bad[j] if bad[j] else (line, cells[place].strip())
                bad[j] += 1
    if unequal:
        line, count = first_unequal
        such = f" ({unequal} such rows)" if unequal > 1 else ""
        raise InputError(
            f"{path}: row {line} has {count} cells, the header (row {header}) has {len(names)}{such}. "
            f"Separate cells by {SEPARATORS[separator]}, write decimals with a point, and complete or delete the row."
        )
    problems = []
    for name, count, (line, cell) in zip(wanted, bad, first_bad, strict=True):
        if count:
            what = f"is {shown(cell)}, not a finite number" if cell else "is empty"
            such = f" ({count} such rows)" if count > 1 else ""
            problems.append(
                f"row {line}, column {shown(name)} {what}{such}. Delete the row (longer gaps are cut out) or repair "
                "the value."
            )
    if len(marks) > 1:
        (with_comma, comma), (with_point, point) = marks[","], marks["."]
        problems.append(
            f"numbers have commas and points: {shown(comma)} in row {with_comma}, {shown(point)} in row {with_point}. "
            "Write the file with one decimal mark and nothing between thousands."
        )
    return Columns(np.column_stack([np.array(column) for column in columns]), "row", numbers, tuple(problems))


def _number(cell: str) -> float:
    """The number in a cell; NaN for what is no finite one."""
    try:
        value = float(cell)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and "_" not in cell else math.nan


def write_csv(path: Path | str, columns: Mapping[str, Array], *, decimals: int | None = None) -> Path:
    r"""Write columns of equal length as CSV: all of it or nothing, the same data as the same bytes; the path.

    Args:
        path: File to write; its folder is made if need be, an old file of that name is replaced.
        columns: Values ``(m,)`` by column name.
        decimals: Digits after the point. Default: ten significant digits.

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
    for row in zip(*arrays.values(), strict=True):
        # + 0.0: no "-0"
        writer.writerow([f"{x + 0.0:.10g}" if decimals is None else f"{x:.{decimals}f}" for x in row])
    write_text(path, text.getvalue())
    return path


# Vectors of .npz and .mat


def _npz(path: Path) -> Source:
    content = _content(path)
    if content.startswith(npy.MAGIC_PREFIX):
        raise InputError(
            f"{path}: is no .npz file but one array without a name. Write named vectors with numpy.savez(file, "
            "name=vector, ...)."
        )
    try:
        check_npz(content, 0, ())
        file = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # a damaged archive raises nearly anything
        raise InputError(
            f"{path}: is no .npz file or damaged ({_line(error)}). Write it with numpy.savez(file, name=vector, ...)."
        ) from error

    def lookup(name: str) -> NDArray[Any]:
        try:
            check_npz(content, _budget(content), (name,))
            return np.asarray(file[name])
        except Exception as error:
            raise InputError(
                f"{path}: column {shown(name)} cannot be read ({_line(error)}). Save it as a vector of numbers, large "
                "ones with numpy.savez and not packed; objects are refused, since loading them could run code."
            ) from error

    return _vectors(path, content, tuple(file.files), lookup, "index", 0)


def _mat(path: Path) -> Source:
    content = _content(path)
    if version(content) == "7.3":
        raise InputError(
            f"{path}: is a .mat file of version 7.3 (HDF5), which is not read. Save it in MATLAB with "
            f"save('{path.name}', ..., '-v7')."
        )
    try:
        check_structure(content, _budget(content))
        with warnings.catch_warnings():
            warnings.simplefilter("error", MatReadWarning)  # two variables of one name, for one
            variables = loadmat(io.BytesIO(content), struct_as_record=True)
    except Exception as error:  # a damaged file raises nearly anything
        raise InputError(
            f"{path}: is no .mat file, damaged or too large ({_line(error)}). Save it again in MATLAB with "
            f"save('{path.name}', ..., '-v7'), large vectors with '-v6'."
        ) from error
    vectors: dict[str, NDArray[Any]] = {}
    unread: set[str] = set()
    for name, value in variables.items():
        if name.startswith("__"):
            continue
        if what := _unread(value):
            unread.add(what)
        elif value.dtype.names is None:
            vectors[name] = value
        else:
            for field in value.dtype.names:
                inner = value[field].item()
                if what := _unread(inner) or ("structs in structs" if inner.dtype.names else ""):
                    unread.add(what)
                else:
                    vectors[f"{name}.{field}"] = inner
    note = f" Not read are {' and '.join(sorted(unread))}: save their vectors as variables." if unread else ""
    return _vectors(path, content, tuple(vectors), vectors.__getitem__, "row", 1, note)


def _unread(value: Any) -> str:
    """What kind of variable this is if it is of a kind that is not read."""
    if isinstance(value, MatlabOpaque | MatlabObject):
        return "objects (timeseries, timetable, datetime)"
    if isinstance(value, np.ndarray) and value.dtype.names is not None and value.size != 1:
        return "arrays of structs"
    return "" if isinstance(value, np.ndarray) else "sparse matrices"


def _budget(content: bytes) -> int:
    """Bytes of numbers that a file of this content may hold [byte]."""
    return min(LARGEST, max(SMALL, PACKED * len(content)))


def _vectors(
    path: Path,
    content: bytes,
    header: tuple[str, ...],
    lookup: Callable[[str], NDArray[Any]],
    row: str,
    first: int,
    note: str = "",
) -> Source:
    """A source of vectors of one length, whose rows are counted from ``first``.

    A single number as the time is the sampling time.
    """

    def read(time: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        names = [*([] if time is None else [time]), *wanted]
        columns: list[Array] = []
        problems: list[str] = []
        left = _budget(content)
        for name in names:
            try:
                array = lookup(name)
                left -= 8 * array.size
                if left < 0:
                    raise InputError(
                        f"{path}: its columns take more than the {_megabytes(_budget(content))} of numbers that are "
                        "read from a file of this length. Save it unpacked, or split the recording."
                    )
                columns.append(_vector(path, name, array))
            except InputError as error:
                problems += error.problems
        refuse(problems)
        if time is not None and columns[0].size == 1 and len(columns) > 1:
            columns[0] = _uniform(path, names[0], columns[0].item(), len(columns[1]))
        lengths = dict(zip(names, map(len, columns), strict=True))
        if len(set(lengths.values())) > 1:
            each = ", ".join(f"{shown(name)} {length}" for name, length in lengths.items())
            raise InputError(f"{path}: columns differ in length: {each}. Save vectors of one length.")
        values = np.column_stack(columns)
        found = []
        for name, column in zip(names, values.T, strict=True):
            bad = np.flatnonzero(np.isinf(column) if name in blanks else ~np.isfinite(column))
            if len(bad):
                found.append(
                    f"{row} {bad[0] + first}, column {shown(name)} is {column[bad[0]]:g}, not a finite number "
                    f"({len(bad)} such). Delete the row (longer gaps are cut out) or repair the value."
                )
        values[~np.isfinite(values)] = np.nan
        return Columns(values, row, range(first, first + len(values)), tuple(found))

    return Source(path, hashlib.sha256(content).hexdigest(), header, read, note)


def _vector(path: Path, name: str, array: NDArray[Any]) -> Array:
    if array.dtype.kind not in "biuf":
        what = {"c": "complex numbers", "U": "text", "S": "text", "M": "dates"}.get(array.dtype.kind)
        raise InputError(
            f"{path}: column {shown(name)} holds {what or 'cells or other objects'}, not real numbers. "
            "Save it as a vector of numbers."
        )
    if array.size and sum(length != 1 for length in array.shape) > 1:
        raise InputError(
            f"{path}: column {shown(name)} has the shape {array.shape}, not that of a vector. Save each of its columns "
            "under a name of its own."
        )
    return np.asarray(array, dtype=np.float64).ravel()


def _uniform(path: Path, name: str, dt: float, m: int) -> Array:
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(
            f"{path}: column {shown(name)} is the single number {dt:g}; as a sampling time [s] it must be positive. "
            "Give that, or a vector of time stamps."
        )
    return dt * np.arange(m, dtype=np.float64)
