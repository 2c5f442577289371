"""Find the table in the first rows of a file: header, row of units, first row of values."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from hybrid_mpc.data.cells import BLANK, is_number, is_stamp, is_unit, is_value
from hybrid_mpc.data.names import name_and_unit, said_by
from hybrid_mpc.machine.units import Conversion, conversion
from hybrid_mpc.records import shown

MOST_SEEN = 1000  # rows at the beginning of a file that are searched for the table
STEADY = 3  # fewest rows of a table
COMMENTS = ("#", "%", "//", ";;")
"""First characters of a comment."""


class Look(NamedTuple):
    """A row of the sample: its index and its cells, stripped of blanks."""

    row: int
    cells: list[str]

    @property
    def filled(self) -> list[str]:
        """Cells with text."""
        return [cell for cell in self.cells if cell]

    def values(self, comma: bool) -> int:
        """Number of cells that are values."""
        return sum(is_value(cell, comma) for cell in self.cells if cell)

    def is_data(self, comma: bool) -> bool:
        """Whether the row may belong to a table: half of its cells are values, at least one a number or a date."""
        filled = self.filled
        if not filled or 2 * self.values(comma) < len(filled):
            return False
        return any(is_number(c) or (comma and is_number(c, ",")) or is_stamp(c) for c in filled)


@dataclass(frozen=True)
class Layout:
    """Position of a table: row index of its header (-1 without a header) and of its ``first`` row of values.

    ``names`` are the column names with units; ``width`` is the number of cells of a row. ``clock`` is the time of
    sample 0 and the sampling period [s], if the first column counts samples and the header gives both.
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
    """The table in the first rows of a file and its score; or the reason why there is none.

    ``split(row)`` gives the cells of a row for other separators, ``number(row)`` the row's number.
    """
    runs: list[list[Look]] = []
    whole = False  # whether the current run of rows continues
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
    # words in a row, or a repeated header, split a table: the table begins with the first part
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
    """Whether a row is a header or units instead of values: it has words where all rows below have numbers, and it is
    the file's first row (``top``), or all of its other cells may be units (``s,1,1``).
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
    """The layout from the rows above the first row of values; or the reason why the columns cannot be named."""
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
                    f"row {number(first)} has {width} cells, but the header (row {number(last.row)}) has {count}. "
                    "Use one separator for all cells and a decimal point, and complete or delete the row."
                )
    if header < 0:
        counted = (
            [str(k) for k in range(width)],
            [str(k + 1) for k in range(width)],
            ["", *map(str, range(width - 1))],
        )
        if width > 2 and body[0].cells in counted:
            return (
                f"row {number(first)} numbers the columns: the row may be a header or values. Write a first row with a "
                "name for each column, e.g. 'time [s]'."
            )
        names = [f"column {j + 1}" if j < spare else "" for j in range(width)]
        notes.append("no header: columns are named by their number")
    before = [look for look in above if look.row < header] if header >= 0 else list(above)
    if before:
        till = number(header) - 1 if header >= 0 else number(first) - 1
        where = f"header in row {number(header)}" if header >= 0 else f"values from row {number(first)} on"
        rows = f"rows 1 to {till} are" if till > 1 else "row 1 is"
        notes.append(f"{rows} a preamble, not read; {where}")
    if units:
        notes.append(f"row {number(first) - 1} is a row of units")
        named = _with_units(names, units)
        if isinstance(named, str):
            return f"row {number(first) - 1}, {named}"
        names = named
    return Layout(header, first, tuple(names), width, tuple(notes))


def _of_a_scope(above: Sequence[Look], first: int, width: int) -> Layout | None:
    """The layout of an oscilloscope's file (Rigol), whose header gives start and increment of the time."""
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
    note = f"row {first} gives the time: start {start} s, step {step} s"
    return Layout(header.row, first, tuple(names[:width]), width, (note,), (float(start), float(step)))


def _names_in(look: Look, width: int, spare: int, split: Callable[[int], list[list[str]]]) -> list[str]:
    """Names in the header of a table of ``width`` cells, the last of which may be blank; empty if it is no header."""
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
    """Whether a row holds the units of the names in the row ``above``.

    All of its cells are units or dashes, at least one a unit. ``T`` and ``V`` may be names as well: of two such rows,
    the one that names the time is the header.
    """
    filled = look.filled
    known = [cell for cell in filled if is_unit(cell)]
    plain = [c for c in filled if c.strip("[]()") in ("", "-", "1", "%") or re.fullmatch(r"[\[(].*[\])]", c)]
    if not known or len({*known, *plain}) < len(set(filled)) or not width - 1 <= len(look.cells) <= width:
        return False
    times = [any(said_by(cell).kind == "time" for cell in row.filled) for row in (look, above)]
    return not times[0] or times[1] or filled[0] in ("s", "ms", "us", "ns", "min", "h")


def _with_units(names: Sequence[str], units: Sequence[str]) -> list[str] | str:
    """Names with the units of the row below; or a message if the two rows contradict each other."""
    found = []
    for name, cell in zip(names, [*units, *[""] * (len(names) - len(units))], strict=True):
        unit, said = cell.strip("[]()").strip(), name_and_unit(name)[1]
        if said and unit and conversion(said, unit) != Conversion(1.0):
            return (
                f"column {shown(name)} has the unit {shown(unit)}, but the header says {shown(said)}. Delete one of "
                "the two units."
            )
        found.append(f"{name} [{unit}]" if unit not in ("", "-") and not said and name else name)
    return found
