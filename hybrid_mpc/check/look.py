"""Inspection of a recording's file without a scenario: its columns, its time, and odd values."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.check.columns import clock_of, columns_of, near, read_all
from hybrid_mpc.data.files import opened
from hybrid_mpc.data.findings import missing_code, outliers
from hybrid_mpc.data.names import FIELD, said_by, unit_behind
from hybrid_mpc.data.source import Source, name_and_unit, restarts
from hybrid_mpc.errors import InputError
from hybrid_mpc.records import shown
from hybrid_mpc.rules import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Column:
    """A column: full name, unit, count of numbers, the ends of its range, and a note."""

    name: str
    unit: str
    count: int
    low: str
    high: str
    note: str
    values: Array


@dataclass(frozen=True)
class Look:
    """The contents of a file: number of rows, columns, the time, notes on how it was read, and findings.

    ``t`` ``(rows,)`` are time stamps [s], or sample numbers if there is no time.
    """

    path: Path
    rows: int
    time: str
    columns: tuple[Column, ...]
    notes: tuple[str, ...]
    findings: tuple[str, ...]
    t: Array


def look(path: Path) -> Look:
    """Inspect a file.

    Raises:
        InputError: If it cannot be read.

    Example:
        ``look(Path("monday.csv")).time``
    """
    source = opened(path)
    read, reasons = read_all(source)
    lengths = Counter(len(one.values) for one in read.values())
    rows = lengths.most_common(1)[0][0] if lengths else 0
    findings = list[str]()
    time, t, name = _time(source, findings, rows)
    columns = []
    for full in dict.fromkeys(source.header):
        if full not in read:
            columns.append(Column(full, "", 0, "", "", reasons.get(full, ""), np.zeros(0)))
            continue
        one = read[full]
        values = one.values[:, 0]
        known = values[np.isfinite(values)]
        note = one.faults.get(full, "")
        if full == name:
            note = "time"
        elif not note and len(known):
            findings += _odd(full, values)
            note = "constant" if len(known) > 1 and np.ptp(known) == 0 else ""
            note = note or (f"{len(values) - len(known)} blank" if len(known) < len(values) else "")
        inner = FIELD.fullmatch(full)
        own, unit = name_and_unit(inner[1] if inner else full)
        ends = ("", "")
        if len(known):
            low, high = float(known.min()), float(known.max())
            ends = (
                (near(low, (high - low) / 1000), near(high, (high - low) / 1000))
                if high > low
                else (f"{low:.10g}",) * 2
            )
        unit = unit or unit_behind(own).unit or (said_by(full).unit if full == name else "")
        columns.append(Column(full, unit, len(known), *ends, note, values))
    if source.note:
        findings.append(source.note.strip())
    return Look(path, rows, time, tuple(columns), source.notes, tuple(findings), t)


def _time(source: Source, findings: list[str], rows: int) -> tuple[str, Array, str]:
    """A description of the time, its stamps, and the name of its column."""
    count = np.arange(rows, dtype=np.float64)
    try:
        columns, left_out = columns_of([source])
        clock = clock_of([source], columns, left_out, "", set())
    except InputError as error:
        findings.append(str(error).removeprefix(f"{source.path}: "))
        return "not found", count, ""
    if clock.column is None:
        return clock.doubt or "no time column: rows are numbered", clock.period * count, ""
    name, t = clock.column.full, clock.seconds * clock.column.values
    if len(t) == 1:
        return f"{shown(name)}: sampled every {clock.period:.4g} s", clock.period * count, name
    steps = np.diff(t)
    # least gap in the time, in median steps; ``new`` writes it as ``max_gap``
    gaps = np.flatnonzero(steps > 5.0 * clock.period)
    text = f"{shown(name)}: {t[0]:.10g} to {t[-1]:.10g} s, sampled every {clock.period:.4g} s"
    place = source.read(None, [name], ()).place
    if len(gaps):
        k = int(gaps[np.argmax(steps[gaps])])
        findings.append(f"gaps in the time: {len(gaps)}, the longest {steps[k]:.4g} s before {place(k + 1)}")
    for k in restarts(t):
        findings.append(f"{place(k)}: time restarts; the recording is cut there")
    if clock.doubt:
        findings.append(f"time: {clock.doubt}")
    return text, t, name


def _odd(full: str, values: Array) -> list[str]:
    """Findings about numbers of a column that may be wrong."""
    if (code := missing_code(values)) is not None:
        count = int((values == code).sum())
        rows = counted(count, "row")
        return [
            f"column {shown(full)}: {code:.10g} in {rows} is far from all other values; probably a code for missing "
            "values"
        ]
    if (odd := outliers(values)) is not None:
        return [
            f"column {shown(full)}: {counted(len(odd), 'value is', 'values are')} far from all others, "
            f"e.g. {values[odd[0]]:.6g}"
        ]
    return []


def picture(found: Look) -> Figure:
    """Figure of the columns that move over time, one panel each."""
    from hybrid_mpc.plots.style import finish_column, new_column, plain

    moving = [
        one
        for one in found.columns
        if one.low != one.high and one.note != "time" and len(one.values) == len(found.t)
    ]
    # most columns in the picture
    figure, panels = new_column([1.0] * max(1, len(moving[:12])), title=found.path.name)
    for panel, one in zip(panels, moving, strict=False):
        known = np.isfinite(one.values)
        panel.plot(found.t[known], one.values[known], color="black", linewidth=0.9)
        panel.set_ylabel(plain(one.name[:30]))
    finish_column(figure, panels)
    return figure
