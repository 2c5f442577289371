"""Read recordings into checked tables, with messages that a user can act on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.doubts import Finding, unwrapped, wrapped
from hybrid_mpc.data.files import Columns, MissingColumn, Source, csv_source, mat_source, npz_source
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec

# Units that recordings come in, and what turns them into the signals' own.

TURN = 2 * math.pi
UNITS: Mapping[str, Mapping[str, float]] = {
    "s": {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "rad": {"deg": TURN / 360, "mrad": 1e-3, "rev": TURN},
    "rad/s": {"deg/s": TURN / 360, "rev/s": TURN, "rpm": TURN / 60, "mrad/s": 1e-3},
    "m": {"mm": 1e-3, "cm": 1e-2, "um": 1e-6},
    "m/s": {"mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6},
    "N m": {"mN m": 1e-3, "N cm": 1e-2, "N mm": 1e-3, "kN m": 1e3},
    "N": {"mN": 1e-3, "kN": 1e3},
    "V": {"mV": 1e-3},
    "A": {"mA": 1e-3},
    "Pa": {"kPa": 1e3, "mbar": 1e2, "bar": 1e5},
    "kg": {"g": 1e-3},
    "W": {"mW": 1e-3, "kW": 1e3},
}
"""For each unit of a signal the units a recording may have, as multiples of it."""
FILLED = 0.01
"""Share of a signal's range that a column would have to fill in another unit for that unit to be proposed."""
SHARE = 0.05
"""Share of the samples beyond the range from which on a unit is proposed: a wrong unit is wrong in all rows."""
BEYOND = 4.0
"""Times the range's limit that a column must reach for a wrong unit to be proposed: less may be a wrong range."""


def factor(column: str, unit: str | float, signal: Signal) -> float:
    """What a column's numbers are multiplied by to be in the signal's unit.

    Args:
        column: Name of the column, for messages.
        unit: The column's unit by name, or the factor itself, e.g. 35.15 N/V for a force recorded as a voltage.
        signal: What the column is.

    Raises:
        InputError: If the unit is none of the signal's quantity, or the factor is zero or not finite.

    Example:
        >>> factor("time_ms", "ms", Signal("time", "s"))
        0.001
    """
    if isinstance(unit, str):
        known = {signal.unit: 1.0, **UNITS.get(signal.unit, {})}
        if unit in known:
            return known[unit]
        raise InputError(
            f"data specification: unit {unit!r} of column {column!r} is none for {signal.label}; there are: "
            f"{', '.join(known)}. Or give the factor to {signal.unit} as a number."
        )
    if not math.isfinite(unit) or unit == 0:
        raise InputError(
            f"data specification: factor {unit} of column {column!r} to {signal.label} must be finite and not zero"
        )
    return float(unit)


def likely_unit(column: NDArray[np.float64], signal: Signal) -> str:
    """Unit in which a column that leaves its signal's plausible range would be plausible; empty if there is none.

    It speaks only of a column that is beyond the range in many rows, far beyond (``BEYOND``), and that, in the other
    unit, keeps to the range and fills a hundredth of it at least: a value of 1e300 is in no unit.

    Args:
        column: The numbers ``(m,)``; what is not finite is in no unit.
        signal: What the column is.

    Example:
        >>> phi = Signal("phi", "rad", -3.2, 3.2)
        >>> likely_unit(np.array([0.0, 90.0, -120.0]), phi), likely_unit(np.array([0.0, 1e307]), phi)
        ('deg', '')
    """
    limit = max(abs(signal.lower), abs(signal.upper))
    largest = float(np.abs(column).max(initial=0.0))
    beyond = float(((column < signal.lower) | (column > signal.upper)).mean())
    if beyond < SHARE or not BEYOND * limit < largest < math.inf:
        return ""
    for unit, size in UNITS.get(signal.unit, {}).items():
        low, high = size * float(column.min()), size * float(column.max())
        if size * largest >= FILLED * limit and signal.lower <= low and high <= signal.upper:
            return unit
    return ""


def turn_of(signal: Signal) -> float | None:
    """A full turn in the signal's unit; None if the signal is no angle.

    Example:
        >>> turn_of(Signal("phi", "deg")), turn_of(Signal("q", "m"))
        (360.0, None)
    """
    radians = {"rad": 1.0, **UNITS["rad"]}.get(signal.unit)
    return None if radians is None else TURN / radians


Array = NDArray[np.float64]
MIN_SCORED = 10
"""Fewest samples after the warm-up that make a piece worth a free run."""
ABSURD = 1e100
"""No machine has a value beyond: its square, and the square of that, could not be computed with."""


@dataclass(frozen=True)
class Table:
    """One recording as it was written, checked.

    Args:
        name: File stem; windows are looked up by it.
        path: The file.
        sha256: SHA-256 of the file's bytes, in hexadecimal.
        t: Time stamps ``(m,)`` [s], strictly increasing.
        u: Inputs ``(m, n_u)``, held from each time stamp to the next.
        y: Measured outputs ``(m, n_y)``; those of periodic signals count on.
        findings: What reading had to change: angles that were wrapped. Default: nothing.
    """

    name: str
    path: Path
    sha256: str
    t: Array
    u: Array
    y: Array
    findings: tuple[Finding, ...] = ()

    @property
    def dt(self) -> float:
        """Median distance [s] of the time stamps."""
        return float(np.median(np.diff(self.t)))


def read_table(
    path: Path | str, spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> Table:
    """Read one recording, whose ending tells its format, and check what would mislead an identification.

    Columns that ``spec`` does not name are ignored; ``spec.units`` are turned into the signals' own. An angle that
    jumps by full turns is made to count on if its signal is ``periodic``.

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
            time stamps repeat or decrease, values are implausible, an angle jumps by full turns and its signal is
            not ``periodic``, the sampling is coarser than ``max_gap`` throughout, or there are fewer samples than
            a window or the warm-up needs; all that is wrong is told at once. Rows are counted from 1 as an
            editor or MATLAB shows them (in CSV the header is row 1), the indices of ``.npz`` from 0.

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
    return _only(_tables([(Path(path), source_of)], spec, outputs, inputs))


def read_csv(
    path: Path | str, spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> Table:
    """Read one recording as CSV, whatever its ending; otherwise as :func:`read_table`.

    Example:
        >>> import tempfile
        >>> from hybrid_mpc.data.files import write_csv
        >>> spec = DataSpec("t", ("tau",), ("phi",), dt=0.1, max_gap=0.2, smoothing=0.5, warm_up=0.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     t = 0.1 * np.arange(40)
        ...     file = write_csv(Path(folder) / "run.csv", {"t": t, "tau": 0 * t, "phi": np.sin(t)})
        ...     table = read_csv(file, spec, outputs=[Signal("phi", "rad")], inputs=[Signal("tau", "N m")])
        >>> table.name, table.y.shape
        ('run', (40, 1))
    """
    return _only(_tables([(Path(path), csv_source)], spec, outputs, inputs))


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
    tables, problems = checked_tables(paths, spec, outputs=outputs, inputs=inputs)
    refuse(problems)
    return tables


def checked_tables(
    paths: Sequence[Path | str], spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> tuple[list[Table], list[str]]:
    """The recordings of one run that can be read, and all problems of the others.

    Args:
        paths: The files.
        spec: As in :func:`read_tables`.
        outputs: Signals of ``spec.outputs``.
        inputs: Signals of ``spec.inputs``.
    """
    tables, problems = _tables([(Path(path), source_of) for path in paths], spec, outputs, inputs)
    stems = [Path(path).stem for path in paths]
    if len(set(stems)) < len(stems):
        problems.append(
            f"two recordings have the same file stem: {', '.join(sorted(stems))}. Give each file once, or "
            "rename one: pieces and windows are named by the stem."
        )
    return tables, problems


def _tables(
    files: Sequence[tuple[Path, Callable[[Path], Source]]],
    spec: DataSpec,
    outputs: Sequence[Signal],
    inputs: Sequence[Signal],
) -> tuple[list[Table], list[str]]:
    """Tables of the files that can be read, and the problems of the others."""
    _check_columns(spec, outputs, inputs)
    tables: list[Table] = []
    problems: list[str] = []
    there: dict[str, list[str]] = {}
    missing: dict[str, list[str]] = {}
    for path, opened in files:
        own = replace(spec, inputs=spec.inputs_of.get(path.stem, spec.inputs))
        try:
            source = opened(path)
            names, lacking = _found(source, own, there, missing)
            problems += lacking
            if not lacking:
                tables.append(_table(source, own, names, outputs, inputs))
        except InputError as error:
            problems += error.problems
    differ = _unequal(there, missing)
    return tables, [*([differ] if differ else []), *problems]


def _only(read: tuple[list[Table], list[str]]) -> Table:
    """The one table that was read."""
    refuse(read[1])
    return read[0][0]


def _check_columns(spec: DataSpec, outputs: Sequence[Signal], inputs: Sequence[Signal]) -> None:
    if len(spec.outputs) != len(outputs) or len(spec.inputs) != len(inputs):
        raise InputError(
            f"data specification: {len(spec.inputs)} input and {len(spec.outputs)} output columns for a "
            f"prior with {len(inputs)} inputs and {len(outputs)} outputs; "
            "name one column for each, in its order"
        )


def _found(
    source: Source, spec: DataSpec, there: dict[str, list[str]], missing: dict[str, list[str]]
) -> tuple[list[str], list[str]]:
    """Full names of the columns, and what is wrong with those that have none; notes what is there and what is not."""
    names, problems = [], []
    for name in (spec.time, *spec.inputs, *spec.outputs):
        try:
            names.append(source.find(name))
            there.setdefault(name, []).append(source.path.name)
        except MissingColumn as error:
            problems.append(str(error))
            missing.setdefault(name, []).append(source.path.name)
        except InputError as error:
            problems.append(str(error))
    return names, problems


def _unequal(there: Mapping[str, Sequence[str]], missing: Mapping[str, Sequence[str]]) -> str:
    """Columns that some of the recordings have and others lack, for a message; nothing if there are none."""
    lines = "".join(
        f"\n  {name!r} is in {', '.join(there[name])} and not in {', '.join(files)}"
        for name, files in missing.items()
        if name in there
    )
    remedy = "All need those that the DataSpec names; inputs_of names other inputs for single recordings:"
    return f"Columns differ between the recordings. {remedy}{lines}" if lines else ""


def source_of(path: Path) -> Source:
    """Open a recording's file by its ending.

    Raises:
        InputError: If it is missing, empty, damaged or not of the format that its ending says.
    """
    return {".npz": npz_source, ".mat": mat_source}.get(path.suffix.lower(), csv_source)(path)


def _table(
    source: Source, spec: DataSpec, found: Sequence[str], outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> Table:
    """The table of columns that are all there; every check is made, and what fails is told together."""
    path = source.path
    names = (spec.time, *spec.inputs, *spec.outputs)
    signals = (Signal("time", "s"), *inputs, *outputs)
    columns = source.read(found)
    values, split = columns.values, 1 + len(inputs)
    problems = list(columns.problems)
    findings: list[Finding] = []
    with np.errstate(over="ignore"):  # what overflows is out of its range
        for j, (name, signal) in enumerate(zip(names, signals, strict=True)):
            if name in spec.units:
                values[:, j] *= factor(name, spec.units[name], signal)
    t = values[:, 0]
    if (np.abs(t) <= ABSURD).all():  # what is not is told with the ranges, or as no number
        problems += _time_problems(t, columns, spec, path.stem)
    clean = not problems and bool((np.abs(values) <= ABSURD).all())
    for j, (signal, name) in enumerate(zip(signals, names, strict=True)):
        note = ""
        turn = turn_of(signal) if clean and j >= split else None
        if turn is not None:
            angle, jumps = unwrapped(t, values[:, j], turn, spec.max_gap)
            if len(jumps):
                findings.append(wrapped(path.name, name, signal, t, values[:, j], jumps))
            if len(jumps) and signal.periodic:
                values[:, j] = angle
                note = f", with {len(jumps)} jumps of a full turn taken out"
        problems += _range_problems(signal, name, values[:, j], columns, note)
    problems += [finding.message for finding in findings if finding.refused]
    refuse([f"{path}: {problem}" for problem in problems])
    return Table(path.stem, path, source.sha256, t, values[:, 1:split], values[:, split:], tuple(findings))


def _time_problems(t: Array, columns: Columns, spec: DataSpec, stem: str) -> list[str]:
    """What is wrong with the time stamps, which are finite."""
    if len(t) < 2:
        return [f"{len(t)} row(s) of numbers; a recording needs many. Record it again."]
    steps = np.diff(t)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        what = "repeats" if steps[k] == 0 else "decreases"
        such = int((steps <= 0).sum())
        return [
            f"{columns.place(k + 1)}, column {spec.time!r}: time {what} ({t[k]:g} s, then {t[k + 1]:g} s"
            f"{f'; {such} such rows' if such > 1 else ''}). Time stamps must increase: delete the repeated rows or "
            "split the file into recordings."
        ]
    problems = []
    if steps.min() > spec.max_gap * (1 + 1e-6):
        problems.append(
            f"sampling is {np.median(steps):g} s, declared max_gap is {spec.max_gap:g} s: every step "
            f"is a gap. Record faster, raise max_gap, or check that column {spec.time!r} is in seconds "
            "(DataSpec.units names another unit)."
        )
    need = spec.warm_up + MIN_SCORED * spec.dt
    length = float(t[-1] - t[0])
    if length < need:
        problems.append(
            f"{len(t)} samples over {length:g} s are fewer than the {need:g} s that the warm-up "
            f"({spec.warm_up:g} s) and {MIN_SCORED} periods need. Give a longer recording, or check that "
            f"column {spec.time!r} is in seconds (DataSpec.units names another unit)."
        )
    problems += [
        f"the {window.role} window {window.start:g} to {window.end:g} s is not within the "
        f"recording ({t[0]:g} to {t[-1]:g} s). Give the whole recording or change the window."
        for window in spec.windows.get(stem, ())
        if window.start < t[0] - spec.dt or window.end > t[-1] + spec.dt
    ]
    return problems


def _range_problems(signal: Signal, name: str, column: Array, columns: Columns, note: str) -> list[str]:
    """What is wrong with values that are there but implausible."""
    lower, upper = max(signal.lower, -ABSURD), min(signal.upper, ABSURD)
    bad = np.flatnonzero((column < lower) | (column > upper))  # NaN is neither, and told before
    if not len(bad):
        return []
    first, worst = int(bad[0]), int(bad[np.argmax(np.abs(column[bad]))])
    such = (
        f" ({len(bad)} such rows, the largest {column[worst]:g} in {columns.place(worst)})"
        if len(bad) > 1
        else ""
    )
    unit = likely_unit(column[~np.isnan(column)], signal)
    hint = (
        f" In {unit} it would be plausible: say units={{{name!r}: {unit!r}}} in the DataSpec." if unit else ""
    )
    return [
        f"{columns.place(first)}, column {name!r}: {column[first]:g} is outside the plausible range "
        f"{lower:g} to {upper:g} {signal.unit} of {signal.name}{note}{such}."
        f"{hint} Check unit and sign, repair the rows, or widen the range of the signal in the scenario's prior."
    ]
