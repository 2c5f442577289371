"""Read recordings into checked tables, with messages that a user can act on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.array_files import mat_source, npz_source
from hybrid_mpc.data.csv_files import csv_source
from hybrid_mpc.data.sources import Columns, MissingColumn, Source
from hybrid_mpc.data.units import factor
from hybrid_mpc.data_spec import DataSpec
from hybrid_mpc.errors import InputError
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


def read_table(
    path: Path | str, spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> Table:
    """Read one recording, whose ending tells its format, and check what would mislead an identification.

    Columns that ``spec`` does not name are ignored; ``spec.units`` are turned into the signals' own.

    ==========  ========================================================================================
    ``.npz``    named vectors (``numpy.savez``); objects are refused
    ``.mat``    MATLAB's vectors, ``save`` with ``-v4``, ``-v6`` or ``-v7``, not 7.3; a struct's fields are
                ``struct.field``, or ``field`` where that is unambiguous
    any other   CSV: a comma between cells, decimals with a point, the first line the header, UTF-8
    ==========  ========================================================================================

    Where the time is a single number in ``.npz`` or ``.mat`` it is the sampling time, and time begins at 0.

    Args:
        path: The file.
        spec: Names of the columns, their units, ``max_gap`` and ``warm_up`` [s], windows by file stem.
        outputs: Signals of ``spec.outputs``, with their plausible ranges.
        inputs: Signals of ``spec.inputs``, with their plausible ranges.

    Returns:
        The table with ``m`` rows.

    Raises:
        InputError: If the file or a column is missing, a cell is no finite number, columns differ in length,
            time stamps repeat or decrease, values are implausible, the sampling is coarser than
            ``max_gap`` throughout, or there are fewer samples than a window or the warm-up needs. Rows
            are counted from 1 as an editor or MATLAB shows them (in CSV the header is row 1), the
            indices of ``.npz`` from 0.

    Example:
        >>> import tempfile
        >>> spec = DataSpec("Ts", ("tau",), ("phi",), dt=0.1, max_gap=0.2, smoothing=0.5, warm_up=0.5,
        ...                 units={"phi": "deg"})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "run.npz"
        ...     np.savez(file, Ts=0.1, tau=np.zeros(40), phi=np.full(40, 90.0))
        ...     table = read_table(file, spec, outputs=[Signal("phi", "rad")], inputs=[Signal("tau", "N m")])
        >>> table.name, round(float(table.t[-1]), 6), round(float(table.y[0, 0]), 6)
        ('run', 3.9, 1.570796)
    """
    return _table(source_of(Path(path)), spec, outputs, inputs)


def read_csv(
    path: Path | str, spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> Table:
    """Read one recording as CSV, whatever its ending; otherwise as :func:`read_table`.

    Example:
        >>> import tempfile
        >>> from hybrid_mpc.data import write_csv
        >>> spec = DataSpec("t", ("tau",), ("phi",), dt=0.1, max_gap=0.2, smoothing=0.5, warm_up=0.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     t = 0.1 * np.arange(40)
        ...     file = write_csv(Path(folder) / "run.csv", {"t": t, "tau": 0 * t, "phi": np.sin(t)})
        ...     table = read_csv(file, spec, outputs=[Signal("phi", "rad")], inputs=[Signal("tau", "N m")])
        >>> table.name, table.y.shape
        ('run', (40, 1))
    """
    return _table(csv_source(Path(path)), spec, outputs, inputs)


def read_tables(
    paths: Sequence[Path | str], spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> list[Table]:
    """Read the recordings of one run: :func:`read_table` for each, with ``spec.inputs_of`` for those it names.

    They may differ in format, length and sampling, and in columns that ``spec`` does not name.

    Raises:
        InputError: If one of them is bad, a column is in some of them and not in others, or two have one stem.

    Example:
        >>> spec = DataSpec("t", ("u",), ("y",), dt=0.1, max_gap=0.2, smoothing=0.5, warm_up=0.5)
        >>> read_tables([], spec, outputs=[Signal("y", "rad")], inputs=[Signal("u", "N m")])
        []
    """
    own = {
        path: replace(spec, inputs=spec.inputs_of.get(path.stem, spec.inputs)) for path in map(Path, paths)
    }
    try:
        tables = [read_table(path, own[path], outputs=outputs, inputs=inputs) for path in map(Path, paths)]
    except MissingColumn as error:
        raise InputError(f"{error}{_unequal(own)}") from None
    stems = [table.name for table in tables]
    if len(set(stems)) < len(stems):
        raise InputError(
            f"two recordings have the same file stem: {', '.join(sorted(stems))}. Give each file once, or "
            "rename one: pieces and windows are named by the stem."
        )
    return tables


def _unequal(specs: Mapping[Path, DataSpec]) -> str:
    """Columns that some of the recordings have and others lack, for a message; nothing if there are none."""
    there: dict[str, list[str]] = {}
    missing: dict[str, list[str]] = {}
    for path, spec in specs.items():
        for name in (spec.time, *spec.inputs, *spec.outputs):
            try:
                source_of(path).find(name)
                there.setdefault(name, []).append(path.name)
            except MissingColumn:
                missing.setdefault(name, []).append(path.name)
            except InputError:
                pass  # a fault of its own, told when its turn comes
    lines = "".join(
        f"\n  {name!r} is in {', '.join(there[name])} and not in {', '.join(files)}"
        for name, files in missing.items()
        if name in there
    )
    remedy = " All need those that the DataSpec names; inputs_of names other inputs for single recordings:"
    return f" Columns differ between the recordings.{remedy}{lines}" if lines else ""


def source_of(path: Path) -> Source:
    """Open a recording's file by its ending.

    Raises:
        InputError: If it is missing, empty, damaged or not of the format that its ending says.
    """
    return {".npz": npz_source, ".mat": mat_source}.get(path.suffix.lower(), csv_source)(path)


def _table(source: Source, spec: DataSpec, outputs: Sequence[Signal], inputs: Sequence[Signal]) -> Table:
    path = source.path
    if len(spec.outputs) != len(outputs) or len(spec.inputs) != len(inputs):
        raise InputError(
            f"data specification: {len(spec.inputs)} input and {len(spec.outputs)} output columns for a "
            f"prior with {len(inputs)} inputs and {len(outputs)} outputs; "
            "name one column for each, in its order"
        )
    names = (spec.time, *spec.inputs, *spec.outputs)
    signals = (Signal("time", "s"), *inputs, *outputs)
    columns = source.read([source.find(name) for name in names])
    values = columns.values
    for j, (name, signal) in enumerate(zip(names, signals, strict=True)):
        if name in spec.units:
            values[:, j] *= factor(name, spec.units[name], signal)
    t, split = values[:, 0], 1 + len(inputs)
    _check_time(path, t, columns, spec)
    for signal, name, column in zip(signals[1:], names[1:], values[:, 1:].T, strict=True):
        _check_range(path, signal, name, column, columns)
    return Table(path.stem, path, source.sha256, t, values[:, 1:split], values[:, split:])


def _check_time(path: Path, t: Array, columns: Columns, spec: DataSpec) -> None:
    if len(t) < 2:
        raise InputError(f"{path}: {len(t)} row(s) of numbers; a recording needs many. Record it again.")
    steps = np.diff(t)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        what = "repeats" if steps[k] == 0 else "decreases"
        raise InputError(
            f"{path}: {columns.place(k + 1)}, column {spec.time!r}: time {what} ({t[k]:g} s, then "
            f"{t[k + 1]:g} s). Time stamps must increase: delete the repeated rows or split "
            "the file into recordings."
        )
    if steps.min() > spec.max_gap * (1 + 1e-6):
        raise InputError(
            f"{path}: sampling is {np.median(steps):g} s, declared max_gap is {spec.max_gap:g} s: every step "
            f"is a gap. Record faster, raise max_gap, or check that column {spec.time!r} is in seconds "
            "(DataSpec.units names another unit)."
        )
    need = spec.warm_up + MIN_SCORED * spec.dt
    length = float(t[-1] - t[0])
    if length < need:
        raise InputError(
            f"{path}: {len(t)} samples over {length:g} s are fewer than the {need:g} s that the warm-up "
            f"({spec.warm_up:g} s) and {MIN_SCORED} periods need. Give a longer recording, or check that "
            f"column {spec.time!r} is in seconds (DataSpec.units names another unit)."
        )
    for window in spec.windows.get(path.stem, ()):
        if window.start < t[0] - spec.dt or window.end > t[-1] + spec.dt:
            raise InputError(
                f"{path}: the {window.role} window {window.start:g} to {window.end:g} s is not within the "
                f"recording ({t[0]:g} to {t[-1]:g} s). Give the whole recording or change the window."
            )


def _check_range(path: Path, signal: Signal, name: str, column: Array, columns: Columns) -> None:
    bad = (column < signal.lower) | (column > signal.upper)
    if not bad.any():
        return
    k = int(np.argmax(bad))
    hint = ""
    limit = max(abs(signal.lower), abs(signal.upper))
    if signal.unit in ("rad", "rad/s") and np.abs(column).max() > 4 * limit:
        hint = f" It looks like degrees: say units={{{name!r}: 'deg'}} in the DataSpec."
    raise InputError(
        f"{path}: {columns.place(k)}, column {name!r}: {column[k]:g} is outside the plausible range "
        f"{signal.lower:g} to {signal.upper:g} {signal.unit} of {signal.name} ({int(bad.sum())} such rows)."
        f"{hint} Check unit and sign, or widen the range of the signal in the scenario's prior."
    )
