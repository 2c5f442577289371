"""Tables as sources: each column is read in one way, dates become seconds, in long form every tag is a column."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.cells import BLANK, Cells, cause, cells_of, is_number, is_stamp
from hybrid_mpc.data.names import name_and_unit, said_by, words_of
from hybrid_mpc.data.source import Columns, Series, Source, clocked
from hybrid_mpc.records import shown

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
HEAD = 200  # rows of a column that show what it holds
TAGS = words_of(
    "tag tagname name variable signal channel sensor sensorid sensorname parameter point pointname kanal messstelle "
    "metric item measurement quantity node device attribute series messgroesse"
)
"""Names of the column of a table in long form that names what each row measured, in small letters."""
VALUES = words_of("value val values wert messwert reading data valeur valor result")
"""Names of the column that holds the value."""
MOST_TAGS = 500


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

    def read(self, time: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        """As :class:`Source` says."""
        names, faults = [*([] if time is None else [time]), *wanted], {}
        missing = [name for name in dict.fromkeys(names) if name not in self.done]
        places = list(dict.fromkeys(place for name in missing for place in self.places[name]))
        read = dict(zip(places, self.frame.columns(places), strict=True)) if places else {}
        for name in missing:
            cells = cells_of(_joined([read[place] for place in self.places[name]]), self.frame.decimal)
            if self.frame.clock is not None and self.places[name] == (0,):
                start, step = self.frame.clock
                cells = cells._replace(values=start + step * cells.values)
            self.done[name] = cells
        for name in names:
            if fault := self._fault(name, self.done[name], name in blanks):
                faults[name] = fault
        rows = np.zeros((len(self.frame.numbers), 0))
        values = np.column_stack([rows, *(self.done[name].values for name in names)])
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
    cells = [str(cell).strip() for cell in head if not is_blank(cell)]
    if not cells or any(is_number(cell) for cell in cells) or not all(map(is_stamp, cells)):
        return False
    return date != bool(re.match(r"\d{1,3}:\d{2}", cells[0]))


def is_blank(cell: object) -> bool:
    """Whether a cell of any kind says that there is no value."""
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
