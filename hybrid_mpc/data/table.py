"""Tables as engineers have them: text files and sheets with preambles, rows of units, closing rows, long form.

:func:`layout_of` looks for the table in the first rows; pandas reads what it found. What is unambiguous is done, and
``Source.notes`` says so; what is not is refused.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.cells import (
    BLANK,
    Cells,
    cause,
    cells_of,
    is_number,
    is_stamp,
    is_unit,
    is_value,
)  # fmt: skip
from hybrid_mpc.data.names import said_by, words_of
from hybrid_mpc.data.series import Series, clocked
from hybrid_mpc.data.source import Columns, Source, name_and_unit
from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.machine.units import Conversion, conversion
from hybrid_mpc.records import shown

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
LARGEST = 2**31
"""Most bytes of numbers in a file [byte]: three columns at 1 kHz for a day."""
LONGEST_ROW = 2**20
"""Longest row of a text file [byte]: ten thousand columns of a hundred characters."""
SAMPLE, MOST_SEEN = 2**17, 1000
"""Bytes, and rows, at the beginning of a file that show where its table begins."""
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "vertical bars", " ": "blanks"}
"""What may stand between the cells of a text file."""
STEADY = 3
"""Fewest rows that show a table."""
COMMENTS = ("#", "%", "//", ";;")
"""How comments begin."""
HEAD = 200
"""Rows of a column that show what it holds."""
CLOSING = 50
"""Most rows behind a table that are no rows of it: means, sums, a remark."""
TAIL = 200
"""Rows before the last one whose decimals are compared with its."""
CUT = 3.0
"""Times the largest step of a column by which its last number must be off to be one that was cut in two."""
TAGS = words_of(
    "tag tagname name variable signal channel sensor sensorid sensorname parameter point pointname kanal messstelle "
    "metric item measurement quantity node device attribute series messgroesse"
)
"""Names of the column of a table in long form that names what each row measured, in small letters."""
VALUES = words_of("value val values wert messwert reading data valeur valor result")
"""Names of the column that holds the value."""
MOST_TAGS = 500


class Look(NamedTuple):
    """A row of the sample: its index among the rows, its cells without blanks around them."""

    row: int
    cells: list[str]

    @property
    def filled(self) -> list[str]:
        """Cells that are not blank."""
        return [cell for cell in self.cells if cell]

    def values(self, comma: bool) -> int:
        """How many cells are values."""
        return sum(is_value(cell, comma) for cell in self.cells if cell)

    def is_data(self, comma: bool) -> bool:
        """Whether it may be a row of a table: half of its cells are values, and one a number or a date."""
        filled = self.filled
        if not filled or 2 * self.values(comma) < len(filled):
            return False
        return any(is_number(c) or (comma and is_number(c, ",")) or is_stamp(c) for c in filled)


@dataclass(frozen=True)
class Layout:
    """Where a table stands: row index of its header (-1 without) and of its ``first`` row of values.

    ``names`` are those of its columns, with units; ``width`` is the number of cells of its rows. ``clock`` is the
    time of the sample 0 and the sampling time [s], where the first column counts samples and the header says so.
    """

    header: int
    first: int
    names: tuple[str, ...]
    width: int
    notes: tuple[str, ...] = ()
    clock: tuple[float, float] | None = None


def layout_of(
    rows: Sequence[Look], comma: bool, split: Callable[[int], list[list[str]]], number: Callable[[int], int]
) -> tuple[float, Layout | str]:
    """The table in the first rows of a file, how well they fit it; or why there is none.

    ``split(row)`` gives the cells of a row as other separators split it, ``number(row)`` the row's number.
    """
    runs: list[list[Look]] = []
    whole = False  # whether the last row goes on
    for look in rows:
        if look.is_data(comma):
            if whole and len(runs[-1][-1].cells) == len(look.cells):
                runs[-1].append(look)
            else:
                runs.append([look])
            whole = True
        elif look.filled and not look.cells[0].startswith(COMMENTS):
            whole = False
    best = max(runs, key=len, default=[])
    # words in a row, or the header again, part a table in two: it begins with the first part
    best = next((run for run in runs if len(run) >= STEADY and _alike(run, best, comma)), best)
    top = best and not any(look.filled for look in rows if look.row < best[0].row)
    while len(best) > 1 and _words_over_numbers(best[0], best[1:4], comma, bool(top)):
        best = best[1:]
    if not best:
        return 0.0, ""
    width, first = len(best[0].cells), best[0].row
    filled = sum(len(look.filled) for look in best)
    score = len(best) * sum(look.values(comma) for look in best) / filled
    above = [look for look in rows if look.row < first and look.filled]
    return score, _headed(above, best, width, comma, split, number)


def _alike(one: Sequence[Look], other: Sequence[Look], comma: bool) -> bool:
    """Whether two runs of rows have numbers in the same columns."""
    kinds = [[is_value(cell, comma) for cell in run[-1].cells] for run in (one, other)]
    return kinds[0] == kinds[1]


def _words_over_numbers(look: Look, below: Sequence[Look], comma: bool, top: bool) -> bool:
    """Whether a row is none of values: it has words where all rows below have numbers, and is the first one of the
    file (``top``), or all of its other cells may be units, too (``s,1,1``).
    """

    def number(cell: str) -> bool:
        return is_number(cell) or (comma and is_number(cell, ","))

    words = [
        j for j, cell in enumerate(look.cells) if cell.casefold() not in BLANK and not is_value(cell, comma)
    ]
    others = [cell for j, cell in enumerate(look.cells) if j not in words]
    units = all(cell in ("", "1", "-", "%") for cell in others)
    return (top or units) and any(all(number(one.cells[j]) for one in below) for j in words)


def _headed(
    above: Sequence[Look],
    body: Sequence[Look],
    width: int,
    comma: bool,
    split: Callable[[int], list[list[str]]],
    number: Callable[[int], int],
) -> Layout | str:
    """The layout by the rows above the first row of values; or why nobody knows which column is which."""
    if scope := _of_a_scope(above, body[0].row, width):
        return scope
    first, notes = body[0].row, list[str]()
    spare = width - 1 if all(not look.cells[-1] for look in body) else width  # separators at the ends of rows
    units: list[str] = []
    candidates = list(above)
    if (
        len(candidates) > 1
        and _are_units(candidates[-1], candidates[-2], width)
        and _names_in(candidates[-2], width, spare, split)
    ):
        units = candidates.pop().cells
    names: list[str] = []
    header = -1
    if candidates:
        names = _names_in(candidates[-1], width, spare, split)
        while not names and len(candidates) > 1 and candidates[-1].is_data(comma):  # rows of another length
            candidates.pop()
            names = _names_in(candidates[-1], width, spare, split)
        last = candidates[-1]
        if names:
            header, first = last.row, first if last is above[-1] or units else last.row + 1
        elif not last.is_data(comma) and not last.cells[0].startswith(COMMENTS):
            counts = [len([cell for cell in cells if cell]) for cells in (last.cells, *split(last.row)[1:-1])]
            count = max(counts)
            if count > 1 and max(width, count) > 2 and (count > 2 or width <= 2 * count):
                return (
                    f"row {number(first)} has {width} cells, the header (row {number(last.row)}) has {count}. Separate "
                    "all cells in one way, write decimals with a point, and complete or delete the row."
                )
    if header < 0:
        counted = (
            [str(k) for k in range(width)],
            [str(k + 1) for k in range(width)],
            ["", *map(str, range(width - 1))],
        )
        if width > 2 and body[0].cells in counted:
            return (
                f"row {number(first)} counts columns: a header, or values? Write a first row with a name for each "
                "column, e.g. 'time [s]'."
            )
        names = [f"column {j + 1}" if j < spare else "" for j in range(width)]
        notes.append("no header; columns are named by their number")
    before = [look for look in above if look.row < header] if header >= 0 else list(above)
    if before:
        till = number(header) - 1 if header >= 0 else number(first) - 1
        where = f"header in row {number(header)}" if header >= 0 else f"values from row {number(first)} on"
        rows = f"rows 1 to {till} are" if till > 1 else "row 1 is"
        notes.append(f"{rows} a preamble; {where}")
    if units:
        notes.append(f"row {number(first) - 1} is a row of units")
        named = _with_units(names, units)
        if isinstance(named, str):
            return f"row {number(first) - 1}, {named}"
        names = named
    return Layout(header, first, tuple(names), width, tuple(notes))


def _of_a_scope(above: Sequence[Look], first: int, width: int) -> Layout | None:
    """The layout of an oscilloscope's file, whose header names start and increment of the time (Rigol)."""
    if len(above) < 2 or not {"start", "increment"} <= {cell.casefold() for cell in above[-2].cells}:
        return None
    header, values = above[-2], above[-1].cells
    at = {cell.casefold(): j for j, cell in enumerate(header.cells)}
    start, step = (values[at[key]] if at[key] < len(values) else "" for key in ("start", "increment"))
    if not is_number(start) or not is_number(step):
        return None
    names = [
        f"{name} [{unit}]" for name, unit in zip(header.cells[1 : at["start"]], values[1:], strict=False)
    ]
    names = ["time [s]", *names, *[""] * (width - len(names) - 1)]
    note = f"row {first} gives the time: from {start} s, every {step} s"
    return Layout(header.row, first, tuple(names[:width]), width, (note,), (float(start), float(step)))


def _names_in(look: Look, width: int, spare: int, split: Callable[[int], list[list[str]]]) -> list[str]:
    """The names in a header of a table ``width`` cells wide, of which the last may be blank; none if it is none."""
    for cells in (look.cells, *split(look.row)):
        if cells and (mark := next((mark for mark in COMMENTS if cells[0].startswith(mark)), "")):
            cells = [cells[0].removeprefix(mark).strip(), *cells[1:]]
            cells = cells[1:] if not cells[0] and len(cells) > width else cells
        while len(cells) > spare and (
            not cells[-1] or cells[-1].casefold() in ("comment", "comments", "kommentar")
        ):
            cells = cells[:-1]
        filled = [cell for cell in cells if cell]
        if len(cells) not in (spare, width) or not filled:
            continue
        if sum(map(is_value, filled)) < len(filled) and not (len(cells) > 1 and len(filled) == 1):
            return [*cells, *[""] * (width - len(cells))]
    return []


def _are_units(look: Look, above: Look, width: int) -> bool:
    """Whether a row holds the units of the names ``above`` it, and is no header below a preamble.

    All of its cells are units, or dashes, and one at least is more. ``T``, ``V`` may be names, too: of two rows the
    names are where the time is.
    """
    filled = look.filled
    known = [cell for cell in filled if is_unit(cell)]
    plain = [c for c in filled if c.strip("[]()") in ("", "-", "1", "%") or re.fullmatch(r"[\[(].*[\])]", c)]
    if not known or len({*known, *plain}) < len(set(filled)) or not width - 1 <= len(look.cells) <= width:
        return False
    times = [any(said_by(cell).kind == "time" for cell in row.filled) for row in (look, above)]
    return not times[0] or times[1] or filled[0] in ("s", "ms", "us", "ns", "min", "h")


def _with_units(names: Sequence[str], units: Sequence[str]) -> list[str] | str:
    """Names with the units of the row below; or a contradiction between the two."""
    found = []
    for name, cell in zip(names, [*units, *[""] * (len(names) - len(units))], strict=True):
        unit, said = cell.strip("[]()").strip(), name_and_unit(name)[1]
        if said and unit and conversion(said, unit) != Conversion(1.0):
            return (
                f"column {shown(name)} is {shown(unit)}, and the header has {shown(said)}. Delete one of the two; "
                "which is right, nobody here knows."
            )
        found.append(f"{name} [{unit}]" if unit not in ("", "-") and not said and name else name)
    return found


# Frames


@dataclass(frozen=True)
class Frame:
    """A table: names, how its columns are read, and the numbers of its rows.

    ``columns(places)`` gives pandas' columns; ``head`` is the beginning of each, as text. ``text(k, place)`` is a cell
    as the file has it. ``fault(place, values)`` says what else is wrong with a column.
    """

    names: tuple[str, ...]
    columns: Callable[[Sequence[int]], list[pd.Series]]
    head: Sequence[pd.Series]
    numbers: Sequence[int]
    text: Callable[[int, int], str]
    fault: Callable[[int, Array], str] = lambda place, values: ""
    decimal: str = "."
    notes: tuple[str, ...] = ()
    clock: tuple[float, float] | None = None


@dataclass
class _Reader:
    """Columns of a frame by their names as :class:`Source` gives them; each is read once."""

    path: Path
    frame: Frame
    places: dict[str, tuple[int, ...]] = field(default_factory=dict)
    done: dict[str, Cells] = field(default_factory=dict)

    def cells(self, names: Sequence[str]) -> list[Cells]:
        """The columns of these names."""
        missing = [name for name in dict.fromkeys(names) if name not in self.done]
        places = list(dict.fromkeys(place for name in missing for place in self.places[name]))
        read = dict(zip(places, self.frame.columns(places), strict=True)) if places else {}
        for name in missing:
            columns = [read[place] for place in self.places[name]]
            cells = cells_of(_joined(columns), self.frame.decimal)
            if self.frame.clock is not None and self.places[name] == (0,):
                start, step = self.frame.clock
                cells = cells._replace(values=start + step * cells.values)
            self.done[name] = cells
        return [self.done[name] for name in names]

    def read(self, time: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        """As :class:`Source` says."""
        names = [*([] if time is None else [time]), *wanted]
        cells = self.cells(names)
        faults = {}
        for name, one in zip(names, cells, strict=True):
            if fault := self._fault(name, one, name in blanks):
                faults[name] = fault
        values = (
            np.column_stack([one.values for one in cells])
            if cells
            else np.zeros((len(self.frame.numbers), 0))
        )
        return Columns(np.where(np.isfinite(values), values, np.nan), "row", self.frame.numbers, faults)

    def _fault(self, name: str, one: Cells, may_be_blank: bool) -> str:
        if one.fault:
            return f"column {shown(name)}: {one.fault}."
        bad = np.flatnonzero(~np.isfinite(one.values) & ~(one.blank & may_be_blank))
        place = self.places[name][-1]
        if not len(bad):
            found = self.frame.fault(place, one.values)
            return found and f"{found.replace('COLUMN', f'column {shown(name)}')}"
        cell = self.frame.text(int(bad[0]), place)
        such = f" ({len(bad)} such rows)" if len(bad) > 1 else ""
        what = f"is {shown(cell)}, not a finite number" if cell else "is empty"
        why = cause(cell)
        remedy = f": {why}." if why else ". Delete the row (longer gaps are cut out) or repair the value."
        return f"row {self.frame.numbers[int(bad[0])]}, column {shown(name)} {what}{such}{remedy}"


def _joined(columns: Sequence[pd.Series]) -> pd.Series:
    """One column; of a date and a time of day both."""
    if len(columns) == 1:
        return columns[0]
    date, time = (column.astype(str).str.strip() for column in columns)
    return date.str.replace(r" 00:00:00$", "", regex=True) + " " + time


def frame_source(path: Path, sha256: str, frame: Frame) -> Source:
    """A table as a source: dates are seconds, in long form every tag is a column."""
    reader, header, notes = _Reader(path, frame), list[str](), list(frame.notes)
    heads = [cells_of(head, frame.decimal) if len(head) else None for head in frame.head]
    dates = [_holds(head, date=True) for head in frame.head]
    clocks = [_holds(head, date=False) for head in frame.head]
    taken: set[int] = set()
    for j, name in enumerate(frame.names):
        places: tuple[int, ...] = (j,)
        near = [k for k in (j - 1, j + 1) if 0 <= k < len(dates) and dates[k] and k not in taken]
        date = near[0] if clocks[j] and near else None
        if date is not None:
            places = (date, j)
            taken.add(date)
            notes.append(f"columns {shown(frame.names[date])} and {shown(name)} are one time")
            if (gone := _renamed(frame.names[date], "s")) in header:
                header.remove(gone)
        elif j in taken:
            continue
        head = heads[j]
        full = _renamed(name, "s") if dates[j] or clocks[j] else name
        if head is not None and head.unit not in ("", "s") and not name_and_unit(name)[1]:
            full = f"{name} [{head.unit}]"
        header.append(full)
        reader.places[full] = places
        if head is not None and head.done:
            notes.append(f"column {shown(full)}: {head.done}")
    source = Source(path, sha256, tuple(header), reader.read, notes=tuple(notes))
    return _in_long_form(source, frame, reader) or source


def _renamed(name: str, unit: str) -> str:
    """A column's name with this unit in place of its own."""
    return f"{name_and_unit(name)[0]} [{unit}]"


def _holds(head: pd.Series, date: bool) -> bool:
    """Whether a column begins with dates, or with times of day."""
    if head.dtype.kind == "M":
        return date
    cells = [str(cell).strip() for cell in head if not _is_blank(cell)]
    if not cells or any(is_number(cell) for cell in cells) or not all(map(is_stamp, cells)):
        return False
    return date != bool(re.match(r"\d{1,3}:\d{2}", cells[0]))


def _is_blank(cell: object) -> bool:
    return cell is None or str(cell).strip().casefold() in (*BLANK, "nat", "<na>")


def _in_long_form(source: Source, frame: Frame, reader: _Reader) -> Source | None:
    """The same where each row names what it measured; None where rows do not."""
    small = {name: re.sub(r"[\W_]", "", name_and_unit(name)[0].casefold()) for name in source.header}
    tags = [name for name in source.header if small[name] in TAGS]
    times = [name for name in source.header if said_by(name).kind == "time" and name not in tags]
    if len(tags) != 1 or not times or len(frame.numbers) == 0:
        return None
    (place,) = reader.places[tags[0]]
    said = frame.columns([place])[0].astype(str).str.strip()
    units = next(
        (reader.places[n][0] for n in source.header if small[n] in ("unit", "units", "einheit")), None
    )
    several = list(dict.fromkeys(said))
    if all(map(is_number, several)) and not small[tags[0]].endswith("id"):
        return None
    values = [n for n in source.header if small[n] in VALUES] or [
        n
        for n in source.header
        if n not in (tags[0], *times) and _is_measured(frame.head[reader.places[n][0]])
    ]
    if not 1 < len(several) <= min(MOST_TAGS, len(said) // 2) or not values:
        return None
    time = reader.read(None, [times[0]], ())
    if time.faults:
        return None
    written = frame.columns([units])[0].astype(str).str.strip() if units is not None else None
    found = []
    for tag in several:
        rows = np.flatnonzero(said == tag)
        for value in values:
            one = reader.read(None, [value], [value])
            name = tag if len(values) == 1 else f"{tag}.{value}"
            if written is not None and len(values) == 1 and written.iloc[rows[0]] not in ("", "-"):
                name = f"{tag} [{written.iloc[rows[0]]}]"
            at, x = time.values[rows, 0], one.values[rows, 0]
            order = np.argsort(at, kind="stable")
            found.append(Series(name, at[order], x[order], one.faults.get(value, "")))
    note = f"long form: {len(several)} signals by column {shown(tags[0])}"
    return replace(clocked(source.path, source.sha256, found, times[0]), notes=(*source.notes, note))


def _is_measured(head: pd.Series) -> bool:
    return bool(len(head)) and bool(np.isfinite(cells_of(head).values).any())


# Text


def text_source(path: Path, content: bytes, sha256: str) -> Source:
    """A text file as a source."""
    with named_extra("reading tables"):
        import pandas  # noqa: F401  (asked for before anything is done)
    text, notes = _decoded(path, content)
    best: tuple[float, int, int, str, Layout | str] | None = None
    for separator in SEPARATORS:
        body = _Body(path, text, separator)
        looks = body.looks()
        score, layout = layout_of(looks, separator != ",", body.splits, body.number)
        matched = isinstance(layout, Layout) and layout.header >= 0
        one = (score, matched, layout.width if isinstance(layout, Layout) else 0, separator, layout)
        if layout and (best is None or one[:3] > best[:3]):
            best = one
    if best is None:
        tops = {
            one: next((look for look in _Body(path, text, one).looks() if look.filled), Look(0, []))
            for one in SEPARATORS
        }
        separator = max([*SEPARATORS][:-1], key=lambda one: len(tops[one].cells))
        separator = separator if len(tops[separator].cells) > 1 else " "
        first = tops[separator]
        names = tuple(first.cells)
        best = (0.0, 0, 0, separator, Layout(first.row, first.row + 1, names, len(names)))
    separator, layout = best[3:]
    if isinstance(layout, str):
        raise InputError(f"{path}: {layout}")
    frame = _Body(path, text, separator).frame(layout)
    return frame_source(path, sha256, replace(frame, notes=(*notes, *frame.notes)))


def _decoded(path: Path, content: bytes) -> tuple[bytes, list[str]]:
    """The text as UTF-8, with one end for all rows, and what was done."""
    notes = []
    zeros = content[:4096].count(0)
    if content.startswith((b"\xff\xfe", b"\xfe\xff")) or 3 * zeros > len(content[:4096]) > 2 * zeros - 8 > 0:
        try:
            begins = content.startswith((b"\xff\xfe", b"\xfe\xff"))
            kind = "utf-16" if begins else "utf-16-le" if content[1:2] == b"\0" else "utf-16-be"
            content = content.decode(kind).encode()
            notes.append("text is UTF-16")
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: is no UTF-16 text. Export the table as CSV (UTF-8).") from error
    content = content.removeprefix(b"\xef\xbb\xbf")
    codes = np.frombuffer(content, dtype=np.uint8)
    odd = np.flatnonzero((codes < 32) & ((codes < 9) | (codes > 13)) & (codes != 26))
    if len(odd):
        row = 1 + content.count(b"\n", 0, int(odd[0]))
        raise InputError(
            f"{path}: row {row} is no text. Export the table as CSV (UTF-8), or give the file the ending of its "
            "format; unpack it if it is packed."
        )
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").rstrip(b"\x1a")
    try:
        content.decode()
    except UnicodeDecodeError:
        content = content.decode("cp1252", errors="replace").encode()
        notes.append("text is Latin-1")
    return content, notes


class _Body:
    """Rows of a text, split by one separator; quotation marks may hold separators and ends of rows."""

    def __init__(self, path: Path, text: bytes, separator: str) -> None:
        self.path, self.text, self.separator = path, text, separator
        self._begins: NDArray[np.int64] | None = None

    def number(self, row: int) -> int:
        """The number of a row of the sample, as an editor counts."""
        return 1 + self.text.count(b"\n", 0, self._starts[row]) if row < len(self._starts) else row + 1

    def looks(self) -> list[Look]:
        """The rows of the sample."""
        piece = self.text[:SAMPLE]
        inside = np.cumsum(np.frombuffer(piece, np.uint8) == 34, dtype=np.uint8) & 1
        ends = np.flatnonzero((np.frombuffer(piece, np.uint8) == 10) & (inside == 0))
        whole = len(piece) == len(self.text)
        begins = np.r_[0, ends + 1]
        ends = np.r_[ends, len(piece)] if whole else ends
        self._starts = begins[:MOST_SEEN].tolist()
        lines = [
            piece[a:b].decode(errors="replace") for a, b in zip(self._starts, ends[:MOST_SEEN], strict=False)
        ]
        self._sample = lines
        return [Look(k, split(line, self.separator)) for k, line in enumerate(lines)]

    def splits(self, row: int) -> list[list[str]]:
        """A row of the sample as other separators split it."""
        line = self._sample[row]
        ways = [split(line, separator) for separator in SEPARATORS if separator != self.separator]
        return [[cell.strip() for cell in re.split(r"\s{2,}|\t", line.strip())], *ways]

    def frame(self, layout: Layout) -> Frame:
        """The table of the whole text."""
        rows = _rows(self.path, self.text, self.separator)
        keep = _kept(self, rows, layout)
        count, names = int(keep.sum()), layout.names
        if count * len(names) * 8 > 4 * LARGEST:
            raise InputError(f"{self.path}: has {count} rows, more than are read. Split the recording.")
        numbers = rows.numbers[keep].tolist()
        decimal, unsure = self._decimal(rows, keep, layout)

        def columns(places: Sequence[int]) -> list[pd.Series]:
            frame = _parsed(
                self.path, self._kept_text(rows, keep), self.separator, layout.width, places, decimal, unsure
            )
            return [frame[place] for place in places]

        def text(k: int, place: int) -> str:
            line = int(np.flatnonzero(keep)[k])
            cells = split(self.text[rows.begins[line] : rows.ends[line]].decode(), self.separator)
            return cells[place] if place < len(cells) else ""

        def fault(place: int, values: Array) -> str:
            if unsure and (found := self._grouped(columns([place])[0], unsure, decimal, numbers)):
                return found
            last = not self.text.endswith(b"\n") and place == len(names) - 1 and len(values) > 4
            before = [text(k, place) for k in range(max(0, count - TAIL), count)] if last else []
            if last and _is_cut(before, values):
                return (
                    f"row {numbers[-1]}, COLUMN is {shown(before[-1])}, where the file ends without the end of the "
                    "row: the number seems to be cut in two. Delete that row, or record it whole."
                )
            return ""

        top = np.zeros(len(keep), bool)
        top[np.flatnonzero(keep)[:HEAD]] = True
        heads = _parsed(
            self.path, self._kept_text(rows, top), self.separator, layout.width, range(len(names)), ".", ".,"
        )
        seen = [j for j, name in enumerate(names) if name or not _all_blank(heads[j])]
        places = dict(enumerate(seen))
        notes = [*layout.notes, *rows.notes, *(["numbers have a decimal comma"] if decimal == "," else [])]
        return Frame(
            tuple(names[j] for j in seen),
            lambda chosen: columns([places[j] for j in chosen]),
            [heads[j] for j in seen],
            numbers,
            lambda k, j: text(k, places[j]),
            lambda j, values: fault(places[j], values),
            decimal,
            tuple(notes),
            layout.clock,
        )

    def _kept_text(self, rows: _Rows, keep: NDArray[np.bool_]) -> bytes:
        chosen = np.flatnonzero(keep)
        if not len(chosen):
            return b""
        begin, end = rows.begins[chosen[0]], rows.ends[chosen[-1]]
        if len(chosen) == chosen[-1] - chosen[0] + 1:
            return self.text[begin:end]
        return b"\n".join(
            [self.text[a:b] for a, b in zip(rows.begins[chosen], rows.ends[chosen], strict=True)]
        )

    def _decimal(self, rows: _Rows, keep: NDArray[np.bool_], layout: Layout) -> tuple[str, str]:
        """The decimal mark, and marks of which nobody knows from single cells whether they stand between thousands."""
        body = self._kept_text(rows, keep)
        if self.separator == ",":
            quoted = re.search(rb'"[+-]?\d+,\d+"', body)
            return ("," if quoted and not re.search(rb"\d\.\d", body) else "."), "," if quoted else ""
        point, comma = (_proven(body, mark) for mark in ".,")
        if point and comma:
            raise InputError(
                f"{self.path}: numbers have commas and points, e.g. {point} and {comma}. Write the file with one "
                "decimal mark."
            )
        grouped = "".join(
            m for m in ".," if re.search(rb"(?<![\d.,:])\d{1,3}[%s]\d{3}(?![\d:])" % m.encode(), body)
        )
        if point or comma:
            decimal = "." if point else ","
            other = "," if point else "."
            return decimal, other if other in grouped else ""
        return ("," if grouped == "," else "."), grouped

    def _grouped(self, column: pd.Series, unsure: str, decimal: str, numbers: Sequence[int]) -> str:
        """Whether a column's marks may stand between thousands, and may not: the fault, empty without one."""
        texts = column.astype(str).str.strip()
        if not (found := texts.str.contains(f"[{unsure}]", regex=True)).any():
            return ""
        whole = texts.str.fullmatch(r"[+-]?\d{1,3}")
        single = texts.str.fullmatch(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
        blank = texts.str.casefold().isin(BLANK)
        told = decimal not in unsure or len(unsure) > 1  # another column shows another mark
        if (whole | single | blank).all() and (whole.any() or told):
            k = int(np.argmax(found.to_numpy()))
            return (
                f"row {numbers[k]}, COLUMN is {shown(texts.iloc[k])}: a mark between thousands, or decimals? Write "
                "numbers with one decimal mark, as many decimals in all rows, and nothing between thousands."
            )
        return ""


def split(line: str, separator: str) -> list[str]:
    """The cells of a row, without blanks around them."""
    if separator == " " and '"' not in line:
        return line.split()
    if '"' in line:
        try:
            cells = next(csv.reader([line.strip(" ")], delimiter=separator, skipinitialspace=True), [])
        except csv.Error:
            cells = [line]
        return [cell.strip() for cell in cells]
    return [cell.strip() for cell in line.split(separator)]


@dataclass(frozen=True)
class _Rows:
    """Where the rows of a text begin and end, their numbers, how many cells they have, and which are blank."""

    begins: Rows
    ends: Rows
    numbers: Rows
    cells: Rows
    blank: NDArray[np.bool_]
    notes: list[str] = field(default_factory=list)


def _rows(path: Path, text: bytes, separator: str) -> _Rows:
    """All rows of a text."""
    codes = np.frombuffer(text, np.uint8)
    newline = codes == 10
    visible = (codes > 32) & (codes != 34)
    if separator == " ":
        marks = visible | (codes == 34)
        is_sep = marks & ~np.r_[False, marks[:-1]]  # where cells begin
    else:
        is_sep = codes == ord(separator)
        visible &= ~is_sep
    numbers = None
    if b'"' in text:
        outside = (np.cumsum(codes == 34, dtype=np.uint8) & 1) == 0
        if not outside[-1]:
            raise InputError(
                f"{path}: {_unclosed(text)}: a quotation mark is not closed, and the rows behind it are one cell. "
                "Delete the mark, or double it within a text."
            )
        all_ends = np.flatnonzero(newline)
        newline &= outside
        is_sep &= np.r_[True, outside[:-1]] if separator == " " else outside
        numbers = all_ends
    ends = np.flatnonzero(newline)
    if not text.endswith(b"\n"):
        ends = np.r_[ends, len(text)]
    begins = np.r_[0, ends[:-1] + 1] if len(ends) else np.zeros(0, np.int64)
    if not len(begins):
        return _Rows(begins, ends, begins, begins, np.zeros(0, bool))
    seps = np.flatnonzero(is_sep)
    at = np.searchsorted(seps, np.r_[begins, len(text)])
    cells = np.diff(at) + (separator != " ")
    blank = ~np.logical_or.reduceat(np.r_[visible, False], np.minimum(begins, len(text)))
    row = np.arange(1, len(begins) + 1) if numbers is None else 1 + np.searchsorted(numbers, begins)
    return _Rows(begins, ends, row, cells, blank)


def _unclosed(text: bytes) -> str:
    """Where a quotation mark is not closed: the first row with an odd number of them."""
    for row, line in enumerate(text.split(b"\n"), 1):
        if line.count(b'"') % 2:
            return f"row {row}"
    return "row 1"


def _kept(body: _Body, rows: _Rows, layout: Layout) -> NDArray[np.bool_]:
    """Which rows are the table's; rows of another length are refused."""
    text, header = body.text, layout.header
    keep = ~rows.blank
    keep[: layout.first] = False
    codes = np.frombuffer(text, np.uint8)
    first = codes[np.minimum(rows.begins, len(text) - 1)]
    remarks = keep & np.isin(first, [ord("#"), ord("%")])
    keep &= ~remarks
    if header >= 0:
        line = text[rows.begins[header] : rows.ends[header]]
        like = np.flatnonzero(
            keep & (rows.ends - rows.begins == len(line)) & (first == (line[:1] or b"\0")[0])
        )
        again = [k for k in like.tolist() if text[rows.begins[k] : rows.ends[k]] == line]
        keep[again] = False
        if again:
            rows.notes.append(f"the header stands again in row {rows.numbers[again[0]]}: left out")
    if remarks.any():
        rows.notes.append(f"rows of remarks are left out, first row {rows.numbers[np.argmax(remarks)]}")
    closing = 0
    values = (
        [j for j, cell in enumerate(_cells(body, rows, layout.first)) if is_value(cell)] if keep.any() else []
    )
    for k in np.flatnonzero(keep)[::-1][:CLOSING].tolist():
        cells = _cells(body, rows, k)
        begin = next((j for j, cell in enumerate(cells) if cell), 0)
        name = cells[begin] if cells else ""
        if is_value(name) or name.casefold() in BLANK or begin not in values or keep[: k + 1].sum() < 2:
            break
        keep[k], closing = False, k
    if closing:
        rows.notes.append(f"rows from {rows.numbers[closing]} on are no rows of the table: left out")
    wrong = np.flatnonzero(keep & (rows.cells != layout.width))
    if len(wrong):
        k = int(wrong[0])
        such = f" ({len(wrong)} such rows)" if len(wrong) > 1 else ""
        place = (
            f"the header (row {rows.numbers[header]})" if header >= 0 else f"row {rows.numbers[layout.first]}"
        )
        raise InputError(
            f"{body.path}: row {rows.numbers[k]} has {rows.cells[k]} cells, {place} has {layout.width}{such}. Separate "
            f"cells by {SEPARATORS[body.separator]}, write decimals with a point, and complete or delete the row."
        )
    _check_quotes(body, rows, keep, layout.width)
    return keep


def _cells(body: _Body, rows: _Rows, k: int) -> list[str]:
    return (
        split(body.text[rows.begins[k] : rows.ends[k]].decode(), body.separator)
        if k < len(rows.begins)
        else []
    )


def _check_quotes(body: _Body, rows: _Rows, keep: NDArray[np.bool_], width: int) -> None:
    """Refuse a row of which a cell holds whole rows: a quotation mark that was opened and never closed."""
    for k in np.flatnonzero(keep[:-1] & (np.diff(rows.numbers) > 1)).tolist():
        inner = body.text[rows.begins[k] : rows.ends[k]].decode().split("\n")[1:-1]
        if any(line.count(body.separator) >= width - 1 for line in inner):
            raise InputError(
                f"{body.path}: row {rows.numbers[k]}: a quotation mark is not closed, and the rows behind it are one "
                "cell. Delete the mark, or double it within a text."
            )


def _parsed(
    path: Path, text: bytes, separator: str, width: int, places: Sequence[int], decimal: str, unsure: str
) -> pd.DataFrame:
    """Columns of a text as pandas reads them: numbers, or texts where a cell is none; all texts if ``unsure``."""
    import pandas as pd

    if not text:
        return pd.DataFrame({place: pd.Series(dtype=float) for place in places})
    blanks = sorted({form(cell) for cell in BLANK for form in (str, str.upper, str.capitalize, _camel)})
    try:
        return pd.read_csv(
            io.BytesIO(text),
            sep=r"\s+" if separator == " " else separator,
            header=None,
            names=list(range(width)),
            usecols=sorted(set(places)),
            index_col=False,
            dtype=str if unsure else None,
            decimal=decimal,
            keep_default_na=False,
            na_values=[] if unsure else blanks,
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
            encoding="utf-8",
        )
    except (pd.errors.ParserError, ValueError) as error:
        raise InputError(
            f"{path}: {str(error).strip().splitlines()[0]}. Export the table as plain CSV."
        ) from error


def _camel(cell: str) -> str:
    return {"nan": "NaN"}.get(cell, cell)


def _all_blank(head: pd.Series) -> bool:
    return all(_is_blank(cell) for cell in head)


def _proven(body: bytes, mark: str) -> str:
    """A cell whose mark is a decimal one, since no mark between thousands stands so; empty without."""
    one, other = mark, "." if mark == "," else ","
    number = (
        rf"(?<![\d.,:\-/])(?:\d+[{one}](?:\d{{1,2}}|\d{{4,}})|(?:0\d*|\d{{4,}})[{one}]\d{{3}}|"
        rf"\d{{1,3}}(?:[{other}'’ ]\d{{3}})+[{one}]\d*|\d*[{one}]\d+[eE][+-]?\d+)(?![\d.,:\-/])"
    )
    found = re.search(number.encode(), body)
    return found[0].decode(errors="replace") if found else ""


def _is_cut(cells: Sequence[str], values: Array) -> bool:
    """Whether the last cell is shorter than others, and its number far from what is due."""
    if len(values) < 4 or not np.isfinite(values[-1]):
        return False
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is out of its range
        steps = np.abs(np.diff(values))
    jumps = bool(steps[-1] > CUT * float(np.nanmax(steps[:-1], initial=0.0)))
    decimals = {_decimals(cell) for cell in cells[:-1]}
    fewer = len(decimals) == 1 and _decimals(cells[-1]) < max(decimals)
    return fewer or (jumps and len(cells[-1]) < len(cells[-2]))


def _decimals(cell: str) -> int:
    """Characters behind a number's decimal mark."""
    return len(re.split("[.,]", cell)[-1]) if re.search("[.,]", cell) else 0
