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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

import nn_export.files
from hybrid_mpc.data.mat_structure import check_structure, version
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import check_npz, write_text
from hybrid_mpc.machine.units import Conversion, conversion, parsed
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
OBJECTS = "objects (timeseries, timetable, datetime)"
"""What MATLAB's objects are called in messages."""
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
SAMPLE = 2**17
"""Bytes at the beginning of a CSV file that show where its table begins: preambles have some hundred lines [byte]."""
STEADY = 3
"""Fewest rows of numbers at the end of that sample that show a table."""
OTHERS = {"|": "vertical bars", " ": "blanks"}
"""Separators that are recognised and not read."""
ENGLISH, GERMAN = "on off true false yes no open closed high low", "ein aus an auf zu ja"
SWITCH = frozenset(f"{ENGLISH} {GERMAN}".split())
"""Words for the two positions of a switch, in small letters."""
SEEN = 1000
"""Rows of columns that are not read which are looked at for the file's decimal mark."""
CUT = 3.0
"""Times the largest step of a column by which its last number must be off to be one that was cut in two."""
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:([.,])\d{3})(?:\1\d{3})*")
_DECIMAL = re.compile(r"[+-]?\d+([.,])\d+(?:[eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:[.,'’ \u00a0\u202f]\d{3})+(?:[.,]\d*)?")
_DATE = re.compile(
    r"\d{1,4}([-/. ])(\d{1,2}|[a-z]{3,9})\.?\1\d{1,4}([T ,].*)?|\d{1,3}:\d{2}(:\d{2})?([.,]\d+)?(\s?[ap]m)?",
    re.I,
)
_WITH_UNIT = re.compile(r"[+-]?\d+(?:[.,]\d*)?(?:e[+-]?\d+)?\s*(?P<unit>[^\W\d_][^\d_,;]{0,11}|%|°\w?)", re.I)


def name_and_unit(column: str) -> tuple[str, str]:
    """A column's name and the unit that stands behind it in brackets; ``""`` if there is none.

    A whole number in brackets is an index, as in ``state[0]`` and ``y(1)``; ``[1]`` behind a blank is the unit 1.

    Example:
        >>> name_and_unit("level [mm]"), name_and_unit("time (s)"), name_and_unit("phi")
        (('level', 'mm'), ('time', 's'), ('phi', ''))
        >>> name_and_unit("state[0]"), name_and_unit("slip [1]")
        (('state[0]', ''), ('slip', '1'))
    """
    for opening, closing in ("[]", "()"):
        name, bracket, unit = column.removesuffix(closing).rpartition(opening)
        if column.endswith(closing) and bracket and name.strip():
            index = re.fullmatch(r"[\d\s,;:]*", unit) and not (unit.strip() == "1" and name[-1].isspace())
            return (column, "") if index else (name.strip(), unit.strip())
    return column, ""


class MissingColumn(InputError):
    """A column that a file lacks."""


@dataclass(frozen=True)
class Columns:
    """Numbers of some columns.

    ``values`` ``(m, n)`` has a column for each name asked for, NaN where there is no finite number. ``row`` is what
    the file's own tools call a row, ``"row"`` or ``"index"``, and ``numbers`` are the rows' numbers as they count.
    ``faults`` say by column what is wrong with its cells, with place and remedy, without the file's name; a blank cell
    is a fault only in columns that may have none. Those of the name ``""`` concern all columns.
    """

    values: Array
    row: str
    numbers: Sequence[int]
    faults: Mapping[str, str] = field(default_factory=dict)

    @property
    def problems(self) -> tuple[str, ...]:
        """All faults."""
        return tuple(self.faults.values())

    def place(self, k: int) -> str:
        """Where sample ``k`` stands in the file, e.g. ``"row 12"``."""
        return f"{self.row} {self.numbers[k]}"

    def disorder(self, t: Array, stamps: str) -> str:
        """Where time stamps ``t`` ``(m,)`` [s] do not increase, and what to do; empty where all do.

        ``stamps`` says what they come from, e.g. ``"column 't'"``.
        """
        wrong = np.diff(t) <= 0
        if not wrong.any():
            return ""
        k, such = int(np.argmax(wrong)), int(wrong.sum())
        what = "repeats" if t[k] == t[k + 1] else "decreases"
        return (
            f"{self.place(k + 1)}, {stamps}: time {what} ({t[k]:.10g} s, then {t[k + 1]:.10g} s"
            f"{f'; {such} such rows' if such > 1 else ''}). Time stamps must increase: delete the repeated rows or "
            "split the file into recordings."
        )


@dataclass(frozen=True)
class Source:
    """A recording's file, opened: ``read(full name of the time, full names, blanks)`` gives the columns, time first.

    ``blanks`` are the names of columns that may have blank cells; a time of None is no column. ``sha256`` is that of
    the file's bytes; ``note`` is what else a user should know who misses a column, ``unread`` the names of variables
    of kinds that are not read.
    """

    path: Path
    sha256: str
    header: tuple[str, ...]
    read: Callable[[str | None, Sequence[str], Collection[str]], Columns]
    note: str = ""
    unread: tuple[str, ...] = ()

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
    _check_layout(path, content, separator)
    line, header = next(_rows(path, content, separator), (1, []))
    names = tuple(name.strip() for name in header)

    def read(time: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        rows = _rows(path, content, separator)
        next(rows, None)
        ended = content.endswith((b"\n", b"\r"))
        return _parsed(
            path, rows, line, names, [*([] if time is None else [time]), *wanted], blanks, separator, ended
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


class _Look(NamedTuple):
    """What a row looks like: its number, its cells, how many hold something, how many of these a number."""

    line: int
    cells: int
    filled: int
    numbers: int
    ends_blank: bool

    @property
    def is_data(self) -> bool:
        """Whether it may be a row of a table of numbers."""
        return self.cells > 1 and self.numbers > 0 and 2 * self.numbers >= self.filled


def _looks(text: str, separator: str, whole: bool) -> list[_Look]:
    """The rows of a sample; the last one may be cut off unless the sample is the ``whole`` file."""
    if separator == " ":
        rows: Iterator[Row] = ((i, line.split()) for i, line in enumerate(text.splitlines(), 1))
    else:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
        rows = ((reader.line_num, cells) for cells in reader)
    found = []
    try:
        for line, cells in rows:
            filled = [cell.strip() for cell in cells if cell.strip()]
            if filled:
                numbers = sum(math.isfinite(_number(_pointed(cell, separator))) for cell in filled)
                found.append(_Look(line, len(cells), len(filled), numbers, not cells[-1].strip()))
    except csv.Error:  # reading the rows says where
        return []
    return found if whole else found[:-1]


def _table(rows: Sequence[_Look], strict: bool = False) -> int:
    """How many rows at the end are a table's rows of numbers, all with as many cells; ``strict``: of numbers alone."""
    count = 0
    for row in reversed(rows):
        if not row.is_data or row.cells != rows[-1].cells or (strict and row.numbers < row.filled):
            break
        count += 1
    return count


def _check_layout(path: Path, content: bytes, separator: str) -> None:
    """Refuse a file whose first row is not the header of its table, by its cause: nothing in it could be found.

    Where its beginning, split by the header's separator, does not end with a table, it is split by all others.
    """
    text, whole = content[:SAMPLE].decode("utf-8-sig", errors="ignore"), len(content) <= SAMPLE
    _, first = next(_rows(path, content, separator), (1, list[str]()))
    best, rows = separator, _looks(text, separator, whole)
    length, told = _table(rows), list[str]()
    if length < STEADY:
        looks = {one: _looks(text, one, whole) for one in (*SEPARATORS, *OTHERS) if one != separator}
        best = max(looks, key=lambda one: _table(looks[one], strict=True))
        length = _table(looks[best], strict=True)
        best, rows, length = (best, looks[best], length) if length >= STEADY else (separator, rows, 0)
    begin = len(rows) - length
    header = begin - 1
    above = rows[header - 1] if header > 0 else None
    if above and above.cells == rows[header].cells == rows[-1].cells and above.filled >= rows[header].filled:
        header -= 1  # a row of units below it
    if best in OTHERS:
        told.append(f"cells are separated by {OTHERS[best]}. Separate them by commas, semicolons or tabs.")
    elif best != separator and header <= 0:
        told.append(
            f"cells are separated by {SEPARATORS[best]}, and the first row has {SEPARATORS[separator]}, too. Leave "
            "these out there."
        )
    other = length > sum(row.is_data and row.cells == rows[0].cells for row in rows[:begin])
    if _are_values(first, separator) if best == separator else begin == 0:
        told.append(
            f"row {rows[0].line if rows else 1} holds values, where the header is due. Write a first row with a name "
            "for each column, e.g. 'time [s]'."
        )
    elif other and rows[0].cells != rows[-1].cells:
        if header > 0:
            told.append(
                f"a preamble stands before the table, whose header seems to be row {rows[header].line}. Delete the "
                "rows before it."
            )
        elif rows[-1].cells - rows[0].cells == 1 and all(row.ends_blank for row in rows[begin:]):
            told.append(
                f"rows end with a separator and the header (row {rows[0].line}) does not: {rows[-1].cells} cells for "
                f"{rows[0].cells} names. Delete the separators at the ends of the rows."
            )
        elif rows[0].cells - rows[-1].cells == 1 and rows[0].ends_blank:
            told.append(
                f"the header (row {rows[0].line}) ends with a separator and the rows do not. Delete it there."
            )
    refuse([f"{path}: {one}" for one in told])


def _are_values(cells: Sequence[str], separator: str) -> bool:
    """Whether cells are those of a row of numbers or dates, not names: all that are not blank, and one at least."""
    filled = [cell.strip() for cell in cells if cell.strip()]
    numbers = [
        math.isfinite(_number(_pointed(cell, separator))) or bool(_DATE.fullmatch(cell)) for cell in filled
    ]
    return any(numbers) and all(
        number or cell.casefold() in {*BLANK, *SWITCH} or bool(_WITH_UNIT.fullmatch(cell))
        for number, cell in zip(numbers, filled, strict=True)
    )


def _pointed(cell: str, separator: str) -> str:
    """A cell with a decimal point: where no comma separates, the decimal mark may be a comma."""
    return cell if separator == "," else cell.replace(",", ".")


def _cause(cell: str) -> str:
    """What a cell that is no number is, and what to write; empty where nobody knows."""
    if _THOUSANDS.fullmatch(cell):
        return "it has a mark between thousands. Write numbers without that, with a decimal point"
    if re.fullmatch(r"[+-]?\d*,\d+", cell):
        return "it has a decimal comma. Write a decimal point, or separate cells by semicolons"
    if _DATE.fullmatch(cell):
        return "it is a date or a time of day. Write numbers, of a time seconds since the beginning"
    if cell.casefold() in SWITCH:
        return "it is a word for a switch. Write 1 and 0"
    if found := _WITH_UNIT.fullmatch(cell):
        unit = found["unit"]
        return f"it is a number with a unit. Write the number alone and the unit into the header, e.g. 'name [{unit}]'"
    return ""


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
    ended: bool,
) -> Columns:
    """Numbers of the wanted columns; a row of another length than the header is an error of the whole file.

    ``ended`` says whether the file ends with the end of a row.
    """
    places = [names.index(name) for name in wanted]
    lax = [name in blanks for name in wanted]
    columns, numbers = [array("d") for _ in places], array("q")
    bad = [0] * len(places)  # cells of each column that are no number, and the first of them
    first_bad = [(0, "")] * len(places)
    unequal, first_unequal = 0, (0, 0)
    words = 0  # the first row, if it holds no number at all
    marks = _Marks([names[place] for place in places], set(places))
    units = _UnitsRow()
    tail, last = _Tail(), [j for j, place in enumerate(places) if place == len(names) - 1]
    before = header
    most = LARGEST // 8 // (len(places) + 1)
    for line, cells in rows:
        if len(cells) != len(names):
            first_unequal = first_unequal if unequal else (line, len(cells))
            unequal += 1
            continue
        if line > before + 1:
            _check_quotes(path, line, cells, separator)
        before = line
        if len(numbers) == most:
            raise InputError(f"{path}: has more than {most} rows, more than are read. Split the recording.")
        if not numbers and not any(math.isfinite(_number(_pointed(cell, separator))) for cell in cells):
            words = line
        if len(numbers) < 2:
            units.look(line, cells, separator)
        if separator != ",":
            marks.look(len(numbers), line, cells, places)
        numbers.append(line)
        if not ended and last:
            tail.look(cells[-1])
        for j, place in enumerate(places):
            cell = cells[place]
            value = _number(_pointed(cell, separator))
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
    faults = {}
    for name, count, (line, cell) in zip(wanted, bad, first_bad, strict=True):
        if count:
            what = f"is {shown(cell)}, not a finite number" if cell else "is empty"
            such = f" ({count} such rows)" if count > 1 else ""
            remedy = ". Delete the row (longer gaps are cut out) or repair the value."
            if line in (words, units.row):
                said = name_and_unit(name)[1]
                remedy = (
                    f", and the header has {shown(said)}. Delete one of the two; which is right, nobody here knows."
                    if said and conversion(said, cell) != Conversion(1.0)
                    else ", as no cell of that row: a row of units? Delete it, and write the units behind the names, "
                    "e.g. 'time [s]'."
                )
            elif cause := _cause(cell):
                remedy = f": {cause}."
            faults[name] = f"row {line}, column {shown(name)} {what}{such}{remedy}"
    if units.row and not any(line == units.row for line, _ in first_bad):
        faults["row of units"] = (
            f"row {units.row} is a row of units ({shown(units.cell)})? Delete it, and write the units behind "
            "the names, e.g. 'time [s]'."
        )
    faults |= marks.faults()
    for j in last[:1]:
        if not ended and wanted[j] not in faults and tail.is_cut(np.array(columns[j])):
            faults[wanted[j]] = (
                f"row {numbers[-1]}, column {shown(wanted[j])} is {shown(tail.last)}, where the file ends without the "
                "end of the row: the number seems to be cut in two. Delete that row, or record it whole."
            )
    return Columns(np.column_stack([np.array(column) for column in columns]), "row", numbers, faults)


class _Marks:
    """Decimal marks of a file whose cells no comma separates: where points and commas stand, and what they may be.

    A mark is decimal where a cell has it as no mark between thousands stands: ``0.5``, ``12.25``. Cells like ``1.250``
    may be either.
    """

    def __init__(self, names: Sequence[str], read: set[int]) -> None:
        self._names, self._read = names, read
        self._first: dict[str, tuple[int, str]] = {}
        self._decimal: set[str] = set()
        self._grouped: dict[int, tuple[str, int, str]] = {}  # by column its first cell that may be either
        self._small: set[int] = set()  # columns with whole numbers below 1000
        self._not: set[int] = set()  # columns without marks between thousands

    def look(self, k: int, line: int, cells: Sequence[str], places: Sequence[int]) -> None:
        """See a row, the ``k``-th; of columns that are not read the first ones are enough."""
        for j, place in enumerate(places):
            cell = cells[place].strip()
            for mark in ",.":
                if mark in cell:
                    self._first.setdefault(mark, (line, cell))
                    if mark not in self._decimal and not _GROUPED.fullmatch(cell):
                        self._decimal.add(mark)
            if j in self._not:
                continue
            if found := _GROUPED.fullmatch(cell):
                self._grouped.setdefault(j, (found[1], line, cell))
            elif re.fullmatch(r"[+-]?\d{1,3}", cell):
                self._small.add(j)
            elif cell.casefold() not in BLANK:
                self._not.add(j)
        if k < SEEN:
            for place, cell in enumerate(cells):
                found = _DECIMAL.fullmatch(cell.strip())
                if found and place not in self._read and not _GROUPED.fullmatch(cell.strip()):
                    self._decimal.add(found[1])

    def faults(self) -> dict[str, str]:
        """What is wrong with them, by column; ``""`` is all columns."""
        if len(self._first) > 1:
            (with_comma, comma), (with_point, point) = self._first[","], self._first["."]
            return {
                "": f"numbers have commas and points: {shown(comma)} in row {with_comma}, {shown(point)} in row "
                f"{with_point}. Write the file with one decimal mark and nothing between thousands."
            }
        return {
            self._names[
                j
            ]: f"row {line}, column {shown(self._names[j])} is {shown(cell)}: a mark between thousands, or "
            "decimals? Other cells of the column are whole numbers, or other columns have another decimal mark. Write "
            "numbers with one decimal mark, as many decimals in all rows, and nothing between thousands."
            for j, (mark, line, cell) in self._grouped.items()
            if j not in self._not and mark not in self._decimal and (j in self._small or self._decimal)
        }


class _UnitsRow:
    """Whether the first row of numbers is a row of units, of which some are written as numbers: ``s;1;1``."""

    def __init__(self) -> None:
        self.row, self.cell = 0, ""
        self._words: dict[int, str] = {}
        self._line = 0

    def look(self, line: int, cells: Sequence[str], separator: str) -> None:
        """See the first row of numbers, then the second."""
        numbers = [math.isfinite(_number(_pointed(cell, separator))) for cell in cells]
        if not self._line:
            self._line = line
            self._words = {
                j: cell.strip()
                for j, (cell, number) in enumerate(zip(cells, numbers, strict=True))
                if not number and _is_unit(cell.strip())
            }
        elif found := next((cell for j, cell in self._words.items() if numbers[j]), ""):
            self.row, self.cell = self._line, found


def _is_unit(cell: str) -> bool:
    """Whether a cell is the name of a unit, and no mark for a missing value."""
    return (
        cell.casefold() not in BLANK
        and re.search(r"[^\W\d_]|[%°]", cell) is not None
        and parsed(cell) is not None
    )


class _Tail:
    """The last cell of a column, and what the cells before it look like."""

    def __init__(self) -> None:
        self.last, self._before = "", ""
        self._decimals: set[int] = set()

    def look(self, cell: str) -> None:
        """See the next cell."""
        if self.last:
            self._decimals.add(_decimals(self.last))
        self._before, self.last = self.last, cell.strip()

    def is_cut(self, column: Array) -> bool:
        """Whether the last cell is shorter than others, and its number ``column[-1]`` far from what is due."""
        if len(column) < STEADY + 1 or not np.isfinite(column[-1]):
            return False
        with np.errstate(over="ignore"):  # what overflows is out of its range
            steps = np.abs(np.diff(column))
        jumps = bool(steps[-1] > CUT * float(np.nanmax(steps[:-1], initial=0.0)))
        fewer = len(self._decimals) == 1 and _decimals(self.last) < max(self._decimals)
        return fewer or (jumps and len(self.last) < len(self._before))


def _decimals(cell: str) -> int:
    """Characters behind a number's decimal mark."""
    return len(re.split("[.,]", cell)[-1]) if re.search("[.,]", cell) else 0


def _check_quotes(path: Path, line: int, cells: Sequence[str], separator: str) -> None:
    """Refuse a row of which a cell holds whole rows: a quotation mark that was opened and never closed."""
    for cell in cells:
        inner = re.split(r"[\r\n]+", cell)[1:]
        if any(one.count(separator) >= len(cells) - 1 for one in inner):
            raise InputError(
                f"{path}: row {line}: a quotation mark that stands before it is not closed, and the rows between are "
                "one cell. Delete the mark, or double it within a text."
            )


def _number(cell: str) -> float:
    """The number in a cell; NaN for what is no finite one."""
    try:
        value = float(cell)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and "_" not in cell else math.nan


MOST_DECIMALS = 17
"""Most digits after the point that are written: a float has no more."""


def real_numbers(values: object, name: str) -> Array:
    """Numbers as a float array.

    Raises:
        InputError: If they are none; ``name`` says what they are.
    """
    try:
        given = np.asarray(values)
        if given.dtype.kind in "biufO":
            return np.asarray(given, dtype=np.float64)
    except Exception as error:  # whatever an object of anybody's raises where it is asked for its numbers
        raise InputError(f"{name}: numbers are needed, got {type(values).__name__}") from error
    raise InputError(f"{name}: numbers are needed, got {type(values).__name__} of {given.dtype}")


def write_csv(path: Path | str, columns: Mapping[str, Array], *, decimals: int | None = None) -> Path:
    r"""Write columns of equal length as CSV: all of it or nothing, the same data as the same bytes; the path.

    Args:
        path: File to write; its folder is made if need be, an old file of that name is replaced.
        columns: Values ``(m,)`` by column name.
        decimals: Digits after the point. Default: ten significant digits.

    Raises:
        InputError: If the columns differ in length or are not one-dimensional, or there is no such path or number of
            decimals.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_csv(Path(folder) / "a.csv", {"t": np.array([0.0, 0.1])}).read_text()
        't\n0\n0.1\n'
    """
    if not isinstance(path, str | Path) or not Path(path).name:
        raise InputError(f"write_csv: the path of a file is needed, got {path!r:.80}")
    if not isinstance(columns, Mapping):
        raise InputError(f"write_csv: columns by name are needed, got {type(columns).__name__}")
    if decimals is not None and not (type(decimals) is int and 0 <= decimals <= MOST_DECIMALS):
        raise InputError(
            f"write_csv: decimals from 0 to {MOST_DECIMALS} are needed, got {type(decimals).__name__}"
        )
    path = Path(path)
    arrays = {
        name: real_numbers(column, f"write_csv: column {shown(str(name))}")
        for name, column in columns.items()
    }
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
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque, MatReadWarning

    content = _content(path)
    if version(content) == "7.3":
        raise InputError(
            f"{path}: is a .mat file of version 7.3 (HDF5), which is not read. Save it in MATLAB with "
            f"save('{path.name}', ..., '-v7')."
        )
    try:
        objects = check_structure(content, _budget(content))
        with warnings.catch_warnings():
            warnings.simplefilter("error", MatReadWarning)  # two variables of one name, for one
            # scipy gives all objects this name; they are named by the file's structure
            warnings.filterwarnings("ignore", 'Duplicate variable name "None"', MatReadWarning)
            variables = loadmat(io.BytesIO(content), struct_as_record=True)
    except Exception as error:  # a damaged file raises nearly anything
        raise InputError(
            f"{path}: is no .mat file, damaged or too large ({_line(error)}). Save it again in MATLAB with "
            f"save('{path.name}', ..., '-v7'), large vectors with '-v6'."
        ) from error
    vectors: dict[str, NDArray[Any]] = {}
    unread: dict[str, list[str]] = {}  # kinds of variables that are not read, and their names
    if objects:
        unread[OBJECTS] = list(objects)
    for name, value in variables.items():
        if name.startswith("__") or isinstance(value, MatlabOpaque):
            continue
        if what := _unread(value):
            unread.setdefault(what, []).append(name)
        elif value.dtype.names is None:
            vectors[name] = value
        else:
            for field in value.dtype.names:
                inner = value[field].item()
                if what := _unread(inner) or ("structs in structs" if inner.dtype.names else ""):
                    unread.setdefault(what, []).append(f"{name}.{field}")
                else:
                    vectors[f"{name}.{field}"] = inner
    told = [f"{what} ({', '.join(map(shown, names[:LISTED]))})" for what, names in sorted(unread.items())]
    note = f" Not read are {' and '.join(told)}. Save their vectors as variables." if told else ""
    lost = tuple(name for names in unread.values() for name in names)
    return _vectors(path, content, tuple(vectors), vectors.__getitem__, "row", 1, note, lost)


def _unread(value: Any) -> str:
    """What kind of variable this is if it is of a kind that is not read."""
    from scipy.io.matlab import MatlabObject, MatlabOpaque

    if isinstance(value, MatlabOpaque | MatlabObject):
        return OBJECTS
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
    unread: tuple[str, ...] = (),
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
                if time is not None and name == names[0] and array.dtype == np.float16 and array.size > 1:
                    raise InputError(
                        f"{path}: column {shown(name)} has half precision, three digits, which do not tell time stamps "
                        "apart. Save it in double precision."
                    )
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
        found = {}
        for name, column in zip(names, values.T, strict=True):
            bad = np.flatnonzero(np.isinf(column) if name in blanks else ~np.isfinite(column))
            if len(bad):
                found[name] = (
                    f"{row} {bad[0] + first}, column {shown(name)} is {column[bad[0]]:g}, not a finite number "
                    f"({len(bad)} such). Delete the row (longer gaps are cut out) or repair the value."
                )
        values[~np.isfinite(values)] = np.nan
        return Columns(values, row, range(first, first + len(values)), found)

    return Source(path, hashlib.sha256(content).hexdigest(), header, read, note, unread)


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
