"""Recordings read: columns found, units turned into the signals' own, times and ranges checked.

:func:`read_recording` reads one file. Everything that is wrong with the files of a run is named in one message.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.files import Columns, MissingColumn, Source, opened
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec

Array = NDArray[np.float64]
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
"""Times the range's limit that a column must reach for a unit to be proposed: less may be a wrong range."""
NEARLY = 0.25
"""Share of a full turn within which a jump is one: what the angle truly moves from one sample to the next is less."""
SPAN = 1.05
"""Turns that a wrapped angle spans at most: one, and some noise. An angle that counts on and turns fast spans more."""
MIN_SCORED = 10
"""Fewest samples after the warm-up that make a piece worth a free run."""
ABSURD = 1e100
"""No machine has a value beyond: the square of its square must be finite."""


@dataclass(frozen=True)
class Finding:
    """What is doubtful about one channel of one recording; ``refused`` where nothing can be identified from it as it
    is.

    ``start`` is the time [s] of the first sample concerned, in the recording's own time; ``count`` the samples
    concerned, of a wrapped angle its jumps. ``message`` says what was found, the likely cause, and what to do.
    """

    kind: Literal["wrapped", "frozen", "clipped", "speed"]
    file: str
    channel: str
    start: float
    count: int
    message: str
    refused: bool = False

    def __str__(self) -> str:
        return f"{self.file}: {self.message}"


@dataclass(frozen=True)
class Recording:
    """One recording as it was written, checked: ``m`` samples; its ``name`` is the file's stem.

    ``t`` ``(m,)`` [s] increases strictly; inputs ``u`` ``(m, n_u)`` are held from each time stamp to the next;
    outputs ``y`` ``(m, n_y)`` of periodic signals count on. ``findings`` are the angles that were wrapped.
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


def read_recording(
    path: Path | str, spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> Recording:
    """Read one recording (CSV, ``.npz`` or ``.mat``) and check what would mislead an identification.

    Columns that ``spec`` does not name are ignored; ``spec.units`` are turned into the signals' own. A wrapped angle is
    made to count on if its signal is ``periodic``. A single number as the time, in ``.npz`` or ``.mat``, is the
    sampling time; time then begins at 0. Rows are counted from 1, as an editor or MATLAB shows them (in CSV the header
    is row 1), the indices of ``.npz`` from 0.
    """
    recordings, problems = read_recordings([path], spec, outputs=outputs, inputs=inputs)
    refuse(problems)
    return recordings[0]


def read_recordings(
    paths: Sequence[Path | str], spec: DataSpec, *, outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> tuple[list[Recording], list[str]]:
    """Read the recordings of one run: :func:`read_recording` for each, with ``spec.inputs_of`` for those it names.

    They may differ in format, length and sampling, and in columns that ``spec`` does not name.
    """
    if len(spec.outputs) != len(outputs) or len(spec.inputs) != len(inputs):
        raise InputError(
            f"data specification: {len(spec.inputs)} input and {len(spec.outputs)} output columns for a "
            f"prior with {len(inputs)} inputs and {len(outputs)} outputs; "
            "name one column for each, in its order"
        )
    recordings: list[Recording] = []
    problems: list[str] = []
    there: dict[str, list[str]] = {}
    missing: dict[str, list[str]] = {}
    for path in map(Path, paths):
        own = replace(spec, inputs=spec.inputs_of.get(path.stem, spec.inputs))
        try:
            source = opened(path)
            names, lacking = _found(source, own, there, missing)
            problems += lacking
            if not lacking:
                recordings.append(_recording(source, own, names, outputs, inputs))
        except InputError as error:
            problems += error.problems
    differ = "".join(
        f"\n  {name!r} is in {', '.join(there[name])} and not in {', '.join(files)}"
        for name, files in missing.items()
        if name in there
    )
    if differ:
        problems.insert(
            0,
            "Columns differ between the recordings. All need those that the DataSpec names; inputs_of names other "
            f"inputs for single recordings:{differ}",
        )
    stems = [Path(path).stem for path in paths]
    if len(set(stems)) < len(stems):
        problems.append(
            f"two recordings have the same file stem: {', '.join(sorted(stems))}. Give each file once, or "
            "rename one: pieces and windows are named by the stem."
        )
    return recordings, problems


def _found(
    source: Source, spec: DataSpec, there: dict[str, list[str]], missing: dict[str, list[str]]
) -> tuple[list[str], list[str]]:
    """Full names of the columns, and what is wrong with the others; notes which files have which column."""
    names, problems = [], []
    for name in (spec.time, *spec.inputs, *spec.outputs):
        try:
            names.append(source.find(name))
            there.setdefault(name, []).append(source.path.name)
        except InputError as error:
            problems.append(str(error))
            if isinstance(error, MissingColumn):
                missing.setdefault(name, []).append(source.path.name)
    return names, problems


def _recording(
    source: Source, spec: DataSpec, found: Sequence[str], outputs: Sequence[Signal], inputs: Sequence[Signal]
) -> Recording:
    """A recording whose columns are all there; every check is made, and all that fails is named."""
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
                values[:, j] *= _factor(name, spec.units[name], signal)
    t = values[:, 0]
    if (np.abs(t) <= ABSURD).all():  # the ranges tell of the others, and of what is no number
        problems += _time_problems(t, columns, spec, path.stem)
    clean = not problems and bool((np.abs(values) <= ABSURD).all())
    for j, (signal, name) in enumerate(zip(signals, names, strict=True)):
        note, turn = "", _turn(signal)
        if clean and j >= split and turn is not None:
            angle, jumps = unwrapped(t, values[:, j], turn, spec.max_gap)
            if len(jumps):
                findings.append(_wrapped(path.name, name, signal, t, values[:, j], jumps))
                if signal.periodic:
                    values[:, j] = angle
                    note = f", with {len(jumps)} jumps of a full turn taken out"
        problems += _range_problems(signal, name, values[:, j], columns, note)
    problems += [finding.message for finding in findings if finding.refused]
    refuse([f"{path}: {problem}" for problem in problems])
    return Recording(
        path.stem, path, source.sha256, t, values[:, 1:split], values[:, split:], tuple(findings)
    )


def gaps(t: Array, max_gap: float) -> NDArray[np.bool_]:
    """Which of the steps ``(m - 1,)`` between time stamps ``(m,)`` are longer than ``max_gap`` [s]."""
    return np.asarray(np.diff(t) > max_gap * (1 + 1e-6))


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
    if gaps(t, spec.max_gap).all():
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
    return problems + [
        f"the {window.role} window {window.start:g} to {window.end:g} s is not within the "
        f"recording ({t[0]:g} to {t[-1]:g} s). Give the whole recording or change the window."
        for window in spec.windows.get(stem, ())
        if window.start < t[0] - spec.dt or window.end > t[-1] + spec.dt
    ]


def _range_problems(signal: Signal, name: str, column: Array, columns: Columns, note: str) -> list[str]:
    """What is wrong with values that are there but implausible."""
    lower, upper = max(signal.lower, -ABSURD), min(signal.upper, ABSURD)
    bad = np.flatnonzero((column < lower) | (column > upper))  # not NaN, which is a problem already
    if not len(bad):
        return []
    first, worst = int(bad[0]), int(bad[np.argmax(np.abs(column[bad]))])
    such = f" ({len(bad)} such rows, the largest {column[worst]:g} in {columns.place(worst)})"
    unit = _likely_unit(column[~np.isnan(column)], signal)
    hint = f" In {unit} it would be plausible: say units={{{name!r}: {unit!r}}} in the DataSpec."
    return [
        f"{columns.place(first)}, column {name!r}: {column[first]:g} is outside the plausible range "
        f"{lower:g} to {upper:g} {signal.unit} of {signal.name}{note}{such if len(bad) > 1 else ''}."
        f"{hint if unit else ''} Check unit and sign, repair the rows, or widen the range of the signal in the "
        "scenario's prior."
    ]


# Units


def _factor(column: str, unit: str | float, signal: Signal) -> float:
    """What a column's numbers are multiplied by to be in the signal's unit."""
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


def _likely_unit(column: Array, signal: Signal) -> str:
    """Unit in which a column that leaves its signal's plausible range would keep to it; empty if there is none."""
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


# Wrapped angles


def _turn(signal: Signal) -> float | None:
    """A full turn in the signal's unit; None if the unit is none of an angle."""
    radians = {"rad": 1.0, **UNITS["rad"]}.get(signal.unit)
    return None if radians is None else TURN / radians


def unwrapped(t: Array, angle: Array, turn: float, max_gap: float) -> tuple[Array, NDArray[np.intp]]:
    """An angle that counts on, and the indices of the samples where it jumped by about a full turn.

    An angle is wrapped if it keeps within one turn and jumps by about one between neighbouring samples.
    """
    step = np.diff(angle)
    jumps = ~gaps(t, max_gap) & (np.abs(np.abs(step) - turn) <= NEARLY * turn)
    if not jumps.any() or np.ptp(angle) > SPAN * turn:
        return angle, np.zeros(0, dtype=np.intp)
    turns = np.cumsum(np.r_[0.0, np.where(jumps, np.sign(step), 0.0)])
    return angle - turn * turns, np.flatnonzero(jumps) + 1


def _wrapped(file: str, name: str, signal: Signal, t: Array, raw: Array, jumps: NDArray[np.intp]) -> Finding:
    """The finding of an angle as it was recorded ``raw`` ``(m,)`` that jumps."""
    k, count = int(jumps[0]), len(jumps)
    what = (
        f"column {name!r} jumps {count} time{'s' * (count > 1)} by about a full turn (first from {raw[k - 1]:.4g} to "
        f"{raw[k]:.4g} {signal.unit} at {t[k]:.6g} s): a wrapped angle"
    )
    remedy = (
        f". {signal.name} is periodic, so the turns were added up and the angle counts on. An estimator or monitor "
        "that runs on the sensor itself needs an angle that counts on, too."
        if signal.periodic
        else f", which no smooth motion explains. Declare Signal(..., periodic=True) for {signal.name} in the prior, "
        "and it is made to count on; or record an angle that does."
    )
    return Finding("wrapped", file, name, float(t[k]), count, what + remedy, refused=not signal.periodic)
