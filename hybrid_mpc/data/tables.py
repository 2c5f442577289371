"""Read and write recordings as CSV tables, with messages that a user can act on."""

from __future__ import annotations

import csv
import difflib
import hashlib
import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.scenario import DataSpec
from hybrid_mpc.signals import Signal

Array = NDArray[np.float64]
MIN_SCORED = 10
"""Fewest samples after the warm-up that make a piece worth a free run."""


@dataclass(frozen=True)
class Table:
    """One recording as it was written, checked.

    Args:
        name: File stem; windows are looked up by it.
        path: The file.
        sha256: SHA-256 of the file's bytes, in hexadecimal.
        t: Time stamps ``(m,)`` [s], strictly increasing.
        u: Inputs ``(m, n_u)``, held from each time stamp to the next.
        y: Measured outputs ``(m, n_y)``.
    """

    name: str
    path: Path
    sha256: str
    t: Array
    u: Array
    y: Array

    @property
    def dt(self) -> float:
        """Median distance [s] of the time stamps."""
        return float(np.median(np.diff(self.t)))


def read_csv(
    path: Path | str, spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> Table:
    """Read one recording and check everything that would mislead an identification.

    Columns that ``spec`` does not name are ignored. The separator is a comma, the decimal sign a point,
    the first line the header, the encoding UTF-8.

    Args:
        path: CSV file.
        spec: Names of the columns, ``max_gap`` and ``warm_up`` [s], windows by file stem.
        outputs: Signals of ``spec.outputs``, with their plausible ranges.
        inputs: Signals of ``spec.inputs``, with their plausible ranges.

    Returns:
        The table with ``m`` rows.

    Raises:
        InputError: If the file or a column is missing, a cell is no finite number, time stamps repeat or
            decrease, values are implausible, the sampling is coarser than ``max_gap`` throughout, or
            there are fewer samples than a window or the warm-up needs. Rows are counted from 1 as an
            editor shows them (the header is row 1).

    Example:
        >>> import tempfile
        >>> spec = DataSpec("t", ("tau",), ("phi",), dt=0.1, max_gap=0.2, smoothing=0.5, warm_up=0.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     t = 0.1 * np.arange(40)
        ...     file = write_csv(Path(folder) / "run.csv", {"t": t, "tau": 0 * t, "phi": np.sin(t)})
        ...     table = read_csv(file, spec, outputs=[Signal("phi", "rad")], inputs=[Signal("tau", "N m")])
        >>> table.name, table.y.shape
        ('run', (40, 1))
    """
    path = Path(path)
    if len(spec.outputs) != len(outputs) or len(spec.inputs) != len(inputs):
        raise InputError(
            f"data specification: {len(spec.inputs)} input and {len(spec.outputs)} output columns for a "
            f"prior with {len(inputs)} inputs and {len(outputs)} outputs; "
            "name one column for each, in its order"
        )
    content = _content(path)
    header, rows = _rows(path, content)
    names = (spec.time, *spec.inputs, *spec.outputs)
    places = [_column(path, header, name) for name in names]
    lines = [line for line, _ in rows]
    values = np.array([[_number(path, header, line, row, j) for j in places] for line, row in rows])
    values = values.reshape(len(rows), len(places))
    t, split = values[:, 0], 1 + len(inputs)
    _check_time(path, t, lines, spec)
    for signal, name, column in zip((*inputs, *outputs), names[1:], values[:, 1:].T, strict=True):
        _check_range(path, signal, name, column, lines)
    sha256 = hashlib.sha256(content).hexdigest()
    return Table(path.stem, path, sha256, t, values[:, 1:split], values[:, split:])


def write_csv(path: Path | str, columns: Mapping[str, Array]) -> Path:
    r"""Write columns of equal length as CSV: all of it or nothing, the same data as the same bytes.

    Numbers are written with ten significant digits. The file appears under its name only when complete.

    Args:
        path: File to write; its folder is made if need be, an old file of that name is replaced.
        columns: Values ``(m,)`` by column name.

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
    writer.writerows([f"{value + 0.0:.10g}" for value in row] for row in zip(*arrays.values(), strict=True))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.write_bytes(text.getvalue().encode())
    os.replace(part, path)
    return path


def _content(path: Path) -> bytes:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        near = sorted(p.name for p in path.parent.glob("*.csv")) if path.parent.is_dir() else []
        there = f"; that folder has: {', '.join(near)}" if near else ""
        raise InputError(f"{path}: there is no such file{there}. Check the path given with --data.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Give a readable CSV file.") from error
    if not content.strip():
        raise InputError(f"{path}: the file is empty. It needs a header line and rows of numbers.")
    return content


def _rows(path: Path, content: bytes) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Header and ``(row number, cells)``; blank lines are skipped but counted."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = content[: error.start].count(b"\n") + 1
        raise InputError(f"{path}: row {row} is no UTF-8 text. Export the table as CSV (UTF-8).") from error
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: row {reader.line_num}: {error}. Export the table as plain CSV.") from error
    header = [name.strip() for name in rows[0][1]] if rows else []
    for line, cells in rows[1:]:
        if len(cells) != len(header):
            raise InputError(
                f"{path}: row {line} has {len(cells)} cells, the header (row {rows[0][0]}) has "
                f"{len(header)}. "
                "Separate cells by commas, write decimals with a point, and complete or delete the row."
            )
    return header, rows[1:]


def _column(path: Path, header: list[str], name: str) -> int:
    count = header.count(name)
    if count == 1:
        return header.index(name)
    there = ", ".join(repr(column) for column in header)
    if count > 1:
        raise InputError(f"{path}: column {name!r} appears {count} times in {there}. Rename all but one.")
    near = difflib.get_close_matches(name, header, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise InputError(
        f"{path}: no column {name!r}; it has {there}.{hint} "
        "Rename the column or name yours in the scenario's DataSpec."
    )


def _number(path: Path, header: list[str], line: int, row: list[str], place: int) -> float:
    cell = row[place].strip()
    try:
        value = math.nan if "_" in cell else float(cell)
    except ValueError:
        value = math.nan
    if math.isfinite(value):
        return value
    what = f"is {cell!r}, not a finite number" if cell else "is empty"
    raise InputError(
        f"{path}: row {line}, column {header[place]!r} {what}. Delete the row (longer gaps are cut out) "
        "or repair the value."
    )


def _check_time(path: Path, t: Array, lines: list[int], spec: DataSpec) -> None:
    if len(t) < 2:
        raise InputError(f"{path}: {len(t)} row(s) of numbers; a recording needs many. Record it again.")
    steps = np.diff(t)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        what = "repeats" if steps[k] == 0 else "decreases"
        raise InputError(
            f"{path}: row {lines[k + 1]}, column {spec.time!r}: time {what} ({t[k]:g} s, then "
            f"{t[k + 1]:g} s). Time stamps must increase: delete the repeated rows or split "
            "the file into recordings."
        )
    if steps.min() > spec.max_gap * (1 + 1e-6):
        raise InputError(
            f"{path}: sampling is {np.median(steps):g} s, declared max_gap is {spec.max_gap:g} s: every step "
            f"is a gap. Record faster, raise max_gap, or check that column {spec.time!r} is in seconds."
        )
    need = spec.warm_up + MIN_SCORED * spec.dt
    length = float(t[-1] - t[0])
    if length < need:
        raise InputError(
            f"{path}: {len(t)} samples over {length:g} s are fewer than the {need:g} s that the warm-up "
            f"({spec.warm_up:g} s) and {MIN_SCORED} periods need. Give a longer recording, or check that "
            f"column {spec.time!r} is in seconds."
        )
    for window in spec.windows.get(path.stem, ()):
        if window.start < t[0] - spec.dt or window.end > t[-1] + spec.dt:
            raise InputError(
                f"{path}: the {window.role} window {window.start:g} to {window.end:g} s is not within the "
                f"recording ({t[0]:g} to {t[-1]:g} s). Give the whole recording or change the window."
            )


def _check_range(path: Path, signal: Signal, name: str, column: Array, lines: list[int]) -> None:
    bad = (column < signal.lower) | (column > signal.upper)
    if not bad.any():
        return
    k = int(np.argmax(bad))
    hint = ""
    limit = max(abs(signal.lower), abs(signal.upper))
    if signal.unit in ("rad", "rad/s") and np.abs(column).max() > 4 * limit:
        hint = " It looks like degrees: multiply by pi/180."
    raise InputError(
        f"{path}: row {lines[k]}, column {name!r}: {column[k]:g} is outside the plausible range "
        f"{signal.lower:g} to {signal.upper:g} {signal.unit} of {signal.name} ({int(bad.sum())} such rows)."
        f"{hint} Check unit and sign, or widen the range of the signal in the scenario's prior."
    )
