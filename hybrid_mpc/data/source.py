"""Columns of a recording's file, whatever its format: names with units, numbers with what is wrong with them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.records import LONGEST, shown

Array = NDArray[np.float64]
ALIKE = 0.7
"""How alike a column's name must be to be proposed: ``inflow_degC`` is by 0.6 like ``tank_degC``, by its unit alone."""
LISTED = 30  # most names that a message lists
FEWEST = 10  # fewest samples before and behind the place where time begins anew
COMPARED = 1000  # most names among which a message looks for one that is nearly right
EMPTY = "the file is empty. It needs a header line and rows of numbers."
LARGEST = 2**31  # largest file, and most bytes of numbers in it [byte]: three columns at 1 kHz for a day


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
        """Where time stamps ``t`` ``(m,)`` [s] do not increase, and what to do; empty where all do, or begin anew.

        ``stamps`` says what they come from, e.g. ``"column 't'"``.
        """
        wrong = np.diff(t) <= 0
        wrong[[k - 1 for k in restarts(t)]] = False
        if not wrong.any():
            return ""
        k, such = int(np.argmax(wrong)), int(wrong.sum())
        what = "repeats" if t[k] == t[k + 1] else "decreases"
        return (
            f"{self.place(k + 1)}, {stamps}: time {what} ({t[k]:.10g} s, then {t[k + 1]:.10g} s"
            f"{f'; {such} such rows' if such > 1 else ''}). Time stamps must increase: delete the repeated rows or "
            "split the file into recordings."
        )


def restarts(t: Array) -> list[int]:
    """Samples at which time stamps ``t`` ``(m,)`` begin anew: they fall back to where they began, and go on from there.

    Example:
        >>> restarts(np.r_[np.arange(50), np.arange(30)]), restarts(np.r_[np.arange(50), 20, np.arange(51, 90)])
        ([50], [])
    """
    falls = (np.flatnonzero(t[1:] < t[:-1]) + 1).tolist()
    if not falls:
        return []
    with np.errstate(over="ignore"):  # what overflows is out of its range
        near = t[0] + 2 * float(np.median(np.abs(np.diff(t))))
    ends = [*falls[1:], len(t)]
    sound = all(t[k] <= near and end - k >= FEWEST for k, end in zip(falls, ends, strict=True))
    return falls if sound and falls[0] >= FEWEST else []


@dataclass(frozen=True)
class Source:
    """A recording's file, opened: ``read(full name of the time, full names, blanks)`` gives the columns, time first.

    ``blanks`` are the names of columns that may have blank cells; a time of None is no column. ``sha256`` is that of
    the file's bytes; ``note`` is what else a user should know who misses a column, ``unread`` the names of variables
    of kinds that are not read. ``notes`` say what was found and done to read the file.
    """

    path: Path
    sha256: str
    header: tuple[str, ...]
    read: Callable[[str | None, Sequence[str], Collection[str]], Columns]
    note: str = ""
    unread: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def find(self, name: str) -> str:
        """Full name of a column: its own, ``struct.field`` where just one struct has it, or with its unit in brackets.

        Fields of structs in structs come after those of structs.

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
        own, inner = name_and_unit(name)[0], f".{name}"
        fields = [c for c in self.header if name_and_unit(c)[0] == name or c == f"{own} [s]"]
        fields = fields or [
            c for c in self.header if name_and_unit(c)[0].endswith(inner) or c.endswith(inner)
        ]
        fields = [column for column in fields if column.count(".") == min(one.count(".") for one in fields)]
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


def megabytes(size: int) -> str:
    """A number of bytes, for a message."""
    return f"{size / 1e6:.4g} MB"


def line_of(error: BaseException) -> str:
    """The first line of an error's message, or its kind."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
