"""Columns of a recording's file in any format: names with units, numbers, and faults of the numbers."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.names import is_named, name_and_unit
from hybrid_mpc.errors import InputError
from hybrid_mpc.records import LONGEST, shown

Array = NDArray[np.float64]
ALIKE = 0.7
"""Least similarity of a proposed column name: ``inflow_degC`` and ``tank_degC`` have 0.6, from their unit alone."""
LISTED = 30  # most names that a message lists
FEWEST = 10  # fewest samples before and after a restart of the time
COMPARED = 1000  # most names among which a message looks for a similar one
EMPTY = "the file is empty. It needs a header line and rows of numbers."
LARGEST = 2**31  # largest file, and largest table of numbers [byte]: three columns at 1 kHz for a day
ROUNDING, SHARE = 5e-7, 1e-3
"""Stamps of two clocks are equal if they differ by less than this, in their unit and in steps of the fastest clock."""
TIME = "time [s]"  # name of the time in files whose signals have their own clocks


class MissingColumn(InputError):
    """A column is missing in a file."""


@dataclass(frozen=True)
class Columns:
    """Numbers of some columns of a file.

    ``values`` ``(m, n)`` has a column for each requested name, NaN where a cell holds no finite number. ``row`` is the
    word for a row in the file's own tools, ``"row"`` or ``"index"``; ``numbers`` are the row numbers in their count.
    ``faults`` describe, by column, its faulty cells with place and remedy, without the file's name. A blank cell is a
    fault only in columns without missing samples. Faults of the name ``""`` concern all columns.
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
        """Where sample ``k`` is in the file, e.g. ``"row 12"``."""
        return f"{self.row} {self.numbers[k]}"

    def disorder(self, t: Array, stamps: str) -> str:
        """The first place where time stamps ``t`` ``(m,)`` [s] do not increase; empty without one. Restarts may be.

        ``stamps`` names the source of the time stamps, e.g. ``"column 't'"``.
        """
        wrong = np.diff(t) <= 0
        wrong[[k - 1 for k in restarts(t)]] = False
        if not wrong.any():
            return ""
        k, such = int(np.argmax(wrong)), int(wrong.sum())
        what = "repeats" if t[k] == t[k + 1] else "decreases"
        return (
            f"{self.place(k + 1)}, {stamps}: time {what} ({t[k]:.10g} s, then {t[k + 1]:.10g} "
            f"s{f'; {such} rows in all' if such > 1 else ''}). Time stamps must increase: delete repeated rows or "
            "split the file into recordings. [HM-DATA-116]"
        )


def restarts(t: Array) -> list[int]:
    """Samples at which time stamps ``t`` ``(m,)`` restart: they fall back to the first stamp and increase again.

    Example:
        >>> restarts(np.r_[np.arange(50), np.arange(30)]), restarts(np.r_[np.arange(50), 20, np.arange(51, 90)])
        ([50], [])
    """
    falls = (np.flatnonzero(t[1:] < t[:-1]) + 1).tolist()
    if not falls:
        return []
    with np.errstate(over="ignore"):  # an overflow is reported as out of range
        near = t[0] + 2 * float(np.median(np.abs(np.diff(t))))
    ends = [*falls[1:], len(t)]
    sound = all(t[k] <= near and end - k >= FEWEST for k, end in zip(falls, ends, strict=True))
    return falls if sound and falls[0] >= FEWEST else []


@dataclass(frozen=True)
class Source:
    """An opened file: ``read(full name of the time or None, full names, blanks)`` gives the columns, time first.

    ``blanks`` are the names of columns that may have blank cells. ``sha256`` is the hash of the file's bytes. ``note``
    is added to messages about missing columns. ``unread`` are names of variables of unsupported kinds. ``notes``
    describe how the file was read.
    """

    path: Path
    sha256: str
    header: tuple[str, ...]
    read: Callable[[str | None, Sequence[str], Collection[str]], Columns]
    note: str = ""
    unread: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def find(self, name: str) -> str:
        """Full name of a column: equal to ``name``, or with a unit in brackets or behind (``level [m]``,
        ``level_m``), or ``struct.field`` if only one struct has that field; nested structs are searched last.

        Raises:
            MissingColumn: If no column matches.
            InputError: If several columns match.
        """
        count = self.header.count(name)
        if count == 1:
            return name
        more = f" and {len(self.header) - LISTED} more" if len(self.header) > LISTED else ""
        there = ", ".join(map(shown, self.header[:LISTED])) + more or "none"
        if count > 1:
            raise InputError(
                f"{self.path}: column {name!r} appears {count} times in {there}. Rename all but one. [HM-DATA-083]"
            )
        own, inner = name_and_unit(name)[0], f".{name}"
        ways: list[Callable[[str], bool]] = [
            lambda c: name_and_unit(c)[0] == name or c == f"{own} [s]",
            lambda c: c.startswith(name) and is_named(c, name),
            lambda c: c.endswith(inner) or name_and_unit(c)[0].endswith(inner),
        ]
        fields = next((found for way in ways if (found := [c for c in self.header if way(c)])), [])
        fields = [column for column in fields if column.count(".") == min(one.count(".") for one in fields)]
        if len(fields) == 1:
            return fields[0]
        if fields:
            raise InputError(
                f"{self.path}: column {name!r} is ambiguous: {' or '.join(map(shown, fields[:LISTED]))}. "
                "Give the full name in the scenario's DataSpec. [HM-DATA-084]"
            )
        near = difflib.get_close_matches(
            name, [c for c in self.header[:COMPARED] if len(c) < LONGEST], n=1, cutoff=ALIKE
        )
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise MissingColumn(
            f"{self.path}: no column {name!r}; the file has {there}.{hint} "
            f"Rename the column in the file, or correct the name in the scenario's DataSpec.{self.note} [HM-DATA-085]"
        )


def megabytes(size: int) -> str:
    """A number of bytes, for a message."""
    return f"{size / 1e6:.4g} MB"


def line_of(error: BaseException) -> str:
    """The first line of an error's message, or the name of its class."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


# Signals with their own clocks in one file


@dataclass(frozen=True)
class Series:
    """A signal of a file: its time stamps ``t`` ``(m,)`` [s], its numbers ``(m,)``, and its fault, if any."""

    name: str
    t: Array
    values: Array
    fault: str = ""


def clocked(path: Path, sha256: str, series: Sequence[Series], time: str = TIME, note: str = "") -> Source:
    """A source of signals with their own clocks.

    The rows are all stamps of the requested signals. A column that may have blank cells (an output, a disturbance) has
    a number only where it was sampled. All other columns (inputs) hold their last number; rows before the first number
    of such a column are left out.
    """
    series = [_once(one) for one in series]
    by_name = {one.name: one for one in series}
    found = {one.name: fault for one in series if (fault := one.fault or _disorder(one))}

    def read(asked: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        names = [*([] if asked is None else [asked]), *wanted]
        faults = {name: found[name] for name in names if name in found}
        sound = [by_name[name] for name in names if name != time and name not in found]
        t = _joined([one.t for one in sound or series if one.name not in found])
        if 8 * len(t) * len(names) > LARGEST:
            raise InputError(
                f"{path}: {len(names)} signals at {len(t)} stamps are more numbers than can be read at once. Name "
                "fewer signals, or split the recording. [HM-DATA-086]"
            )
        values, first = np.full((len(t), len(names)), np.nan), t[0] if len(t) else 0.0
        for j, name in enumerate(names):
            if name == time:
                values[:, j] = t
            elif name not in faults and len(by_name[name].t):
                one = by_name[name]
                known = np.isfinite(one.values) | (name in blanks)
                stamps = t[
                    np.searchsorted(t, one.t[known], side="right") - 1
                ]  # the nearest of all stamps before
                if name in blanks:
                    values[np.searchsorted(t, stamps), j] = one.values
                elif known.any():
                    at = np.searchsorted(stamps, t, side="right") - 1
                    values[:, j] = np.where(at >= 0, one.values[known][np.maximum(at, 0)], np.nan)
                    first = max(first, float(t[np.argmax(at >= 0)]))
        rows = t >= first
        return Columns(values[rows], "sample", range(1, int(rows.sum()) + 1), faults)

    if len(by_name) < len(series):
        raise InputError(
            f"{path}: two signals have the same name and the same clock. Rename one of them. [HM-DATA-087]"
        )
    return Source(path, sha256, (time, *by_name), read, note)


def _once(one: Series) -> Series:
    """A signal without repeated samples."""
    again = (one.t[1:] == one.t[:-1]) & (one.values[1:] == one.values[:-1])
    keep = np.r_[np.ones(min(1, len(one.t)), bool), ~again]
    return one if keep.all() else replace(one, t=one.t[keep], values=one.values[keep])


def _joined(stamps: Sequence[Array]) -> Array:
    """All stamps of several clocks; stamps that differ only by rounding are merged."""
    t = np.unique(np.concatenate([np.zeros(0), *stamps]))
    steps = [float(np.median(np.diff(one))) for one in stamps if len(one) > 1]
    least = min([ROUNDING, *(SHARE * step for step in steps if step > 0)])
    return t[np.r_[True, np.diff(t) > least]] if len(t) else t


def _disorder(one: Series) -> str:
    """The first place where a signal's stamps do not increase; empty without one."""
    k = int(np.argmax(np.r_[np.diff(one.t) <= 0, True]))
    if k >= len(one.t) - 1:
        return ""
    stamps = f"sample {k + 2} is at {one.t[k + 1]:.10g} s, sample {k + 1} at {one.t[k]:.10g} s"
    remedy = "Time stamps must increase: delete repeated samples, or split the file."
    return f"column {shown(one.name)}: {stamps}. {remedy} [HM-DATA-117]"
