"""Tables as sources: columns read as numbers, dates as seconds; a table in long form gives one column per signal."""

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
from hybrid_mpc.rules import counted

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
HEAD = 200  # rows of a column that show its kind
TAGS = words_of(
    "tag tagname name variable signal channel sensor sensorid sensorname parameter point pointname kanal messstelle "
    "metric item measurement quantity node device attribute series messgroesse"
)
"""Names of the column, in a table in long form, that names the signal of each row; in small letters."""
VALUES = words_of("value val values wert messwert reading data valeur valor result")
"""Names of the column that holds the values."""
MOST_TAGS = 500


@dataclass
class Frame:
    """A table: names and numbers of its rows, and functions that read its columns.

    ``columns(places)`` gives columns of pandas; ``head`` is the beginning of each column, as text. ``text(k, place)``
    is a cell as written in the file. ``fault(place, values)`` describes further faults of a column. ``places`` are the
    positions of each named column of the source; a date and a time of day in two columns have two. Each column is read
    once and then kept in ``done``.
    """

    path: Path
    names: tuple[str, ...]
    columns: Callable[[Sequence[int]], list[pd.Series]]
    head: Sequence[pd.Series]
    numbers: Sequence[int]
    text: Callable[[int, int], str]
    fault: Callable[[int, Array], str] = lambda place, values: ""
    decimal: str = "."
    notes: tuple[str, ...] = ()
    clock: tuple[float, float] | None = None
    places: dict[str, tuple[int, ...]] = field(default_factory=dict)
    done: dict[str, Cells] = field(default_factory=dict)

    def source(self, sha256: str) -> Source:
        """The table as a source; dates become seconds, a table in long form one column per signal."""
        notes, header = list(self.notes), list[str]()
        heads = [cells_of(head, self.decimal) if len(head) else None for head in self.head]
        dates, clocks = ([_holds(head, date) for head in self.head] for date in (True, False))
        taken: set[int] = set()
        for j, name in enumerate(self.names):
            near = [k for k in (j - 1, j + 1) if 0 <= k < len(dates) and dates[k] and k not in taken]
            date = near[0] if clocks[j] and near else None
            if date is not None:
                taken.add(date)
                notes.append(f"columns {shown(self.names[date])} and {shown(name)} together give the time")
                if (gone := _in_seconds(self.names[date])) in header:
                    header.remove(gone)
            elif j in taken:
                continue
            head = heads[j]
            full = _in_seconds(name) if dates[j] or clocks[j] else name
            if head is not None and head.unit not in ("", "s") and not name_and_unit(name)[1]:
                full = f"{name} [{head.unit}]"
            header.append(full)
            self.places[full] = (j,) if date is None else (date, j)
            if head is not None and head.done:
                notes.append(f"column {shown(full)}: {head.done}")
        source = Source(self.path, sha256, tuple(header), self.read, notes=tuple(notes))
        return self.in_long_form(source) or source

    def read(self, time: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        """Read columns, as :class:`Source` describes."""
        names, faults = [*([] if time is None else [time]), *wanted], {}
        missing = [name for name in dict.fromkeys(names) if name not in self.done]
        places = list(dict.fromkeys(place for name in missing for place in self.places[name]))
        read = dict(zip(places, self.columns(places), strict=True)) if places else {}
        for name in missing:
            cells = cells_of(_joined([read[place] for place in self.places[name]]), self.decimal)
            if self.clock is not None and self.places[name] == (0,):
                cells = cells._replace(values=self.clock[0] + self.clock[1] * cells.values)
            self.done[name] = cells
        for name in names:
            if fault := self.fault_of(name, self.done[name], name in blanks):
                faults[name] = fault
        values = [self.done[name].values for name in names]
        table = np.column_stack([np.zeros((len(self.numbers), 0)), *values])
        return Columns(np.where(np.isfinite(table), table, np.nan), "row", self.numbers, faults)

    def fault_of(self, name: str, one: Cells, may_be_blank: bool) -> str:
        """The fault of a column's cells; empty without one."""
        if one.fault:
            return f"column {shown(name)}: {one.fault}. [HM-DATA-122]"
        bad = np.flatnonzero(~np.isfinite(one.values) & ~(one.blank & may_be_blank))
        place = self.places[name][-1]
        if not len(bad):
            return self.fault(place, one.values).replace("COLUMN", f"column {shown(name)}")
        cell = self.text(int(bad[0]), place)
        such = f" ({len(bad)} rows in all)" if len(bad) > 1 else ""
        what = f"is {shown(cell)}, not a finite number" if cell else "is empty"
        why = cause(cell)
        remedy = (
            f": {why}." if why else ". Correct the value or delete the row (gaps above max_gap are cut out)."
        )
        return f"row {self.numbers[int(bad[0])]}, column {shown(name)} {what}{such}{remedy} [HM-DATA-123]"

    def in_long_form(self, source: Source) -> Source | None:
        """The source of a table in long form, where each row names its signal; None for other tables."""
        header = source.header
        small = {name: re.sub(r"[\W_]", "", name_and_unit(name)[0].casefold()) for name in header}
        tags = [name for name in header if small[name] in TAGS]
        times = [name for name in header if said_by(name).kind == "time" and name not in tags]
        if len(tags) != 1 or not times or len(self.numbers) == 0:
            return None

        def texts(name: str) -> pd.Series:
            return self.columns([self.places[name][0]])[0].astype(str).str.strip()

        said = texts(tags[0])
        several = list(dict.fromkeys(said))
        if all(map(is_number, several)) and not small[tags[0]].endswith("id"):
            return None
        others = [name for name in header if name not in (tags[0], *times) and self.is_measured(name)]
        values = [name for name in header if small[name] in VALUES] or others
        if not 1 < len(several) <= min(MOST_TAGS, len(said) // 2) or not values:
            return None
        time = self.read(None, [times[0]], ())
        if time.faults:
            return None
        units = [name for name in header if small[name] in ("unit", "units", "einheit")]
        written = texts(units[0]) if units and len(values) == 1 else None
        found = []
        for tag in several:
            rows = np.flatnonzero(said == tag)
            for value in values:
                one = self.read(None, [value], [value])
                name = tag if len(values) == 1 else f"{tag}.{value}"
                if written is not None and written.iloc[rows[0]] not in ("", "-"):
                    name = f"{tag} [{written.iloc[rows[0]]}]"
                at, x = time.values[rows, 0], one.values[rows, 0]
                order = np.argsort(at, kind="stable")
                found.append(Series(name, at[order], x[order], one.faults.get(value, "")))
        note = f"long format: {counted(len(several), 'signal')}, named in column {shown(tags[0])}"
        return replace(clocked(source.path, source.sha256, found, times[0]), notes=(*source.notes, note))

    def is_measured(self, name: str) -> bool:
        """Whether a column begins with a number."""
        head = self.head[self.places[name][0]]
        return len(head) > 0 and bool(np.isfinite(cells_of(head).values).any())


def _joined(columns: Sequence[pd.Series]) -> pd.Series:
    """One column; a column of dates and one of times of day are joined."""
    if len(columns) == 1:
        return columns[0]
    date, time = (column.astype(str).str.strip() for column in columns)
    return date.str.replace(r" 00:00:00$", "", regex=True) + " " + time


def _in_seconds(name: str) -> str:
    """A column's name with the unit seconds instead of its own."""
    return f"{name_and_unit(name)[0]} [s]"


def _holds(head: pd.Series, date: bool) -> bool:
    """Whether a column begins with dates (``date``), or with times of day."""
    if head.dtype.kind == "M":
        return date
    cells = [str(cell).strip() for cell in head if not is_blank(cell)]
    if not cells or any(is_number(cell) for cell in cells) or not all(map(is_stamp, cells)):
        return False
    return date != bool(re.match(r"\d{1,3}:\d{2}", cells[0]))


def is_blank(cell: object) -> bool:
    """Whether a cell of any kind marks a missing value."""
    return cell is None or str(cell).strip().casefold() in (*BLANK, "nat", "<na>")
