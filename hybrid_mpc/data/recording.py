"""Recordings read: columns found, units turned into the signals' own, times and ranges checked.

:func:`read_recording` reads one file. Everything that is wrong with the files of a run is named in one message.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.files import Columns, MissingColumn, Source, name_and_unit, opened
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.machine.units import alike, factor
from hybrid_mpc.records import shown

Array = NDArray[np.float64]
Flags = NDArray[np.int8]
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
TEMPERATURES = frozenset({"K", "degC", "°C", "degF", "°F"})
"""Units of temperature, which have zeros of their own."""
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
COARSE = 1.5
"""Model periods from one sample to the next beyond which what lies between would be made up."""
ROUNDING = 1e-9
"""Share of the end of a sensor's range within which a sample is at that end: ten digits in a file, and units."""
ABSURD = 1e100
"""No machine has a value beyond: the square of its square must be finite."""


@dataclass(frozen=True)
class Finding:
    """What is doubtful about one channel of one recording; ``refused`` where nothing can be identified from it as it
    is.

    ``start`` is the time [s] of the first sample concerned, in the recording's own time; ``count`` the samples
    concerned, of a wrapped angle its jumps. ``message`` says what was found, the likely cause, and what to do.
    """

    kind: Literal["wrapped", "frozen", "clipped", "speed", "missing"]
    file: str
    channel: str
    start: float
    count: int
    message: str
    refused: bool = False

    def __str__(self) -> str:
        return f"{self.file}: {self.message}"


def empty() -> Array:
    """What stands for no disturbances until the number of samples is known."""
    return np.zeros((0, 0))


def no_flags() -> Flags:
    """The same for flags."""
    return np.zeros((0, 0), dtype=np.int8)


@dataclass(frozen=True)
class Recording:
    """One recording as it was written, checked: ``m`` samples; its ``name`` is the file's stem.

    ``t`` ``(m,)`` [s] increases strictly; inputs ``u`` ``(m, n_u)`` are held from each time stamp to the next;
    outputs ``y`` ``(m, n_y)`` of periodic signals count on. ``findings`` are the angles that were wrapped and the
    samples that are missing. ``w`` ``(m, n_w)`` are the disturbances, by default none. ``y`` and ``w`` are NaN where a
    sample is missing. ``censored`` ``(m, n_y)`` is -1 where an output is at the lower end of its sensor's range, +1 at
    the upper end, else 0, which is the default.
    """

    name: str
    path: Path
    sha256: str
    t: Array
    u: Array
    y: Array
    findings: tuple[Finding, ...] = ()
    w: Array = field(default_factory=empty)
    censored: Flags = field(default_factory=no_flags)

    def __post_init__(self) -> None:
        complete(self)

    @property
    def dt(self) -> float:
        """Median distance [s] of the time stamps."""
        return float(np.median(np.diff(self.t)))


class Signals(Protocol):
    """Whatever names a machine's signals: a prior, its class, a model."""

    @property
    def states(self) -> Sequence[Signal]:
        """Signals of the states."""

    @property
    def inputs(self) -> Sequence[Signal]:
        """Signals of what is commanded."""

    @property
    def outputs(self) -> Sequence[Signal]:
        """Signals of what is measured."""

    @property
    def disturbances(self) -> Sequence[Signal]:
        """Signals of what is measured and not commanded."""


class _Samples(Protocol):
    @property
    def t(self) -> Array: ...
    @property
    def y(self) -> Array: ...
    @property
    def w(self) -> Array: ...
    @property
    def censored(self) -> Flags: ...


def complete(samples: _Samples) -> None:
    """Give a frozen record of ``n`` samples its ``w`` ``(n, 0)`` and its ``censored`` of zeros where it has none.

    Raises:
        ValueError: If it has some, and they have another length or shape.
    """
    n = len(samples.t)
    if samples.w.shape[-1] == 0:
        object.__setattr__(samples, "w", np.zeros((n, 0)))
    if samples.censored.shape != samples.y.shape and not samples.censored.any():
        object.__setattr__(samples, "censored", np.zeros(samples.y.shape, dtype=np.int8))
    if len(samples.w) != n or samples.censored.shape != samples.y.shape:
        raise ValueError(
            f"{n} samples with w {samples.w.shape}, y {samples.y.shape} and censored {samples.censored.shape}: w needs "
            "a row, censored a number for each"
        )


def read_recording(
    path: Path | str,
    prior: Signals,
    spec: DataSpec,
) -> Recording:
    """Read one recording (CSV, ``.npz`` or ``.mat``) and check what would mislead an identification.

    Columns that ``spec`` does not name are ignored; ``spec.units``, or units in brackets behind a column's name, are
    turned into the signals' own. A blank cell or NaN in the column of an output or a disturbance is a missing sample. A
    wrapped angle is made to count on if its signal is ``periodic``. A single number as the time, in ``.npz`` or
    ``.mat``, is the sampling time; time then begins at 0, as it does where ``spec.time`` is a number. Rows are counted
    from 1, as an editor or MATLAB shows them (in CSV the header is row 1), the indices of ``.npz`` from 0.
    """
    recordings, problems = read_recordings([path], prior, spec)
    refuse(problems)
    return recordings[0]


def read_recordings(
    paths: Sequence[Path | str],
    prior: Signals,
    spec: DataSpec,
) -> tuple[list[Recording], list[str]]:
    """Read the recordings of one run: :func:`read_recording` for each, with ``spec.inputs_of`` for those it names.

    They may differ in format, length and sampling, and in columns that ``spec`` does not name.
    """
    refuse(_count_problems(spec, prior) or _column_problems(spec))
    recordings: list[Recording] = []
    problems: list[str] = []
    there: dict[str, list[str]] = {}
    missing: dict[str, list[str]] = {}
    for path in map(Path, paths):
        try:
            source = opened(path)
            names, lacking = _found(source, spec, there, missing)
            problems += lacking
            if not lacking:
                recordings.append(_recording(source, spec, names, prior))
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


def _count_problems(spec: DataSpec, prior: Signals) -> list[str]:
    """Roles that have more or fewer columns than the prior has signals."""
    inputs, disturbances, outputs = prior.inputs, prior.disturbances, prior.outputs
    roles: list[tuple[str, str, Sequence[str], Sequence[Signal]]] = [
        ("inputs", "input", spec.inputs, inputs),
        ("disturbances", "disturbance", spec.disturbances, disturbances),
        ("outputs", "output", spec.outputs, outputs),
    ]
    roles += [(f"inputs_of {stem!r}", "input", names, inputs) for stem, names in spec.inputs_of.items()]
    problems = []
    for role, word, names, signals in roles:
        if len(names) != len(signals):
            problems.append(
                f"data specification: {role} has {len(names)} column{'s' * (len(names) != 1)} "
                f"({', '.join(map(repr, names)) or 'none'}) for a prior with {len(signals)} {word}"
                f"{'s' * (len(signals) != 1)} ({', '.join(s.label for s in signals) or 'none'}). Name one column for "
                "each, in its order."
            )
    return problems


def _column_problems(spec: DataSpec) -> list[str]:
    """Columns that are named for more than one signal, and delays of columns that nobody reads.

    A file's own inputs in ``inputs_of`` may be disturbances as well: there it was asked for.
    """
    time = (spec.time,) if isinstance(spec.time, str) else ()
    of_files = [(f"inputs_of {stem!r}", names, ("outputs", "time")) for stem, names in spec.inputs_of.items()]
    roles: dict[str, Sequence[str]] = {
        "time": time, "inputs": spec.inputs, "disturbances": spec.disturbances, "outputs": spec.outputs,
    }  # fmt: skip
    problems = []
    for role, names, others in [*((role, roles[role], tuple(roles)) for role in roles), *of_files]:
        for name in dict.fromkeys(names):
            twice = [role] * (list(names).count(name) - 1)
            also = twice + [other for other in others if other != role and name in roles[other]]
            if also:
                problems.append(
                    f"data specification: column {name!r} is named in {' and '.join(sorted([role, *also]))}. A column "
                    "holds one signal: name it once."
                )
    known = {*spec.inputs, *spec.disturbances, *spec.outputs, *itertools.chain(*spec.inputs_of.values())}
    for role, delays in [
        ("delays", spec.delays),
        *((f"delays_of {s!r}", d) for s, d in spec.delays_of.items()),
    ]:
        problems += [
            f"data specification: {role} names column {name!r}, which is none of {', '.join(sorted(map(repr, known)))}."
            " Name a column of an input, a disturbance or an output."
            for name in delays
            if name not in known
        ]
    return list(dict.fromkeys(problems))


def _found(
    source: Source, spec: DataSpec, there: dict[str, list[str]], missing: dict[str, list[str]]
) -> tuple[list[str], list[str]]:
    """Full names of the columns, and what is wrong with the others; notes which files have which column."""
    names, problems = [], []
    asked = _asked(source, spec)
    for name in asked:
        try:
            names.append(source.find(name))
            there.setdefault(name, []).append(source.path.name)
        except InputError as error:
            problems.append(str(error))
            if isinstance(error, MissingColumn):
                missing.setdefault(name, []).append(source.path.name)
    if not problems:
        by_full = dict(zip(asked, names, strict=True))
        for full in dict.fromkeys(names):
            same = [name for name, found in by_full.items() if found == full]
            if len(same) > 1:
                problems.append(
                    f"{source.path}: columns {' and '.join(map(repr, same))} are one, {full!r}. A column holds one "
                    "signal: name each whole."
                )
    return names, problems


def _asked(source: Source, spec: DataSpec) -> list[str]:
    """Columns that are read of a file: time, if it is one, inputs, disturbances, outputs."""
    time = [spec.time] if isinstance(spec.time, str) else []
    return [*time, *spec.inputs_in(source.path.stem), *spec.disturbances, *spec.outputs]


def _recording(
    source: Source,
    spec: DataSpec,
    found: Sequence[str],
    prior: Signals,
) -> Recording:
    """A recording whose columns are all there; every check is made, and all that fails is named."""
    path, inputs, disturbances, outputs = source.path, prior.inputs, prior.disturbances, prior.outputs
    names, signals = _asked(source, spec), [*inputs, *disturbances, *outputs]
    if isinstance(spec.time, str):
        signals = [Signal("time", "s"), *signals]
        blanks = set(found[1 + len(inputs) :]) - set(found[: 1 + len(inputs)])
        columns = source.read(found[0], found[1:], blanks)
        values = columns.values
    else:
        names, signals, found = [_stamps(spec), *names], [Signal("time", "s"), *signals], ["", *found]
        blanks = set(found[1 + len(inputs) :]) - set(found[: 1 + len(inputs)])
        columns = source.read(None, found[1:], blanks)
        values = np.column_stack([spec.time * np.arange(len(columns.values)), columns.values])
    first, split = 1 + len(inputs), 1 + len(inputs) + len(disturbances)
    problems = list(columns.problems)
    findings: list[Finding] = []
    with np.errstate(over="ignore"):  # what overflows is out of its range
        for j, (name, signal) in enumerate(zip(names, signals, strict=True)):
            if name in spec.units:
                values[:, j] *= _factor(name, spec.units[name], signal)
            else:
                values[:, j] *= _written_factor(found[j], signal)
                problems += [problem for problem in [_unit_problem(found[j], signal)] if problem]
    t = values[:, 0]
    if (np.abs(t) <= ABSURD).all():  # the ranges tell of the others, and of what is no number
        problems += _time_problems(t, columns, spec, path.stem)
    known = np.isfinite(values)
    clean = not problems and bool((np.abs(values[known]) <= ABSURD).all())
    censored = censored_of(values[:, split:], outputs)  # before angles are unwrapped: none of these saturates
    for j, (signal, name) in enumerate(zip(signals, names, strict=True)):
        note, turn, there = "", _turn(signal), known[:, j]
        told = any(f"column {shown(found[j])} " in problem for problem in columns.problems)
        if j >= first and len(t) and not there.any() and not told:
            problems.append(
                f"column {name!r} has no number in any row; {signal.name} was not measured. Record it, or leave this "
                "recording out."
            )
        if clean and j >= first and turn is not None:
            angle, jumps = unwrapped(t[there], values[there, j], turn, spec.max_gap)
            if len(jumps):
                findings.append(_wrapped(path.name, name, signal, t[there], values[there, j], jumps))
                if signal.periodic:
                    values[there, j] = angle
                    note = f", with {len(jumps)} jumps of a full turn taken out"
        if clean and j >= first and there.any() and not there.all():
            findings.append(_missing(path.name, name, t, there))
        problems += _range_problems(signal, name, values[:, j], columns, note)
    problems += [finding.message for finding in findings if finding.refused]
    refuse([f"{path}: {problem}" for problem in problems])
    return Recording(
        name=path.stem,
        path=path,
        sha256=source.sha256,
        t=t,
        u=values[:, 1:first],
        y=values[:, split:],
        findings=tuple(findings),
        w=values[:, first:split],
        censored=censored,
    )


def censored_of(y: Array, outputs: Sequence[Signal]) -> Flags:
    """Which samples ``(m, n_y)`` are at an end of their sensor's range or beyond: -1 lower, +1 upper, 0 measured.

    Example:
        >>> censored_of(np.array([[0.2], [9.9], [10.0], [np.nan]]), [Signal("h", "V", saturation=(0.5, 10.0))]).ravel()
        array([-1,  0,  1,  0], dtype=int8)
    """
    flags = np.zeros(y.shape, dtype=np.int8)
    for j, signal in enumerate(outputs):
        if signal.saturation is not None:
            lower, upper = signal.saturation
            near = ROUNDING * max((abs(end) for end in (lower, upper) if math.isfinite(end)), default=0.0)
            flags[:, j] = np.where(y[:, j] >= upper - near, 1, np.where(y[:, j] <= lower + near, -1, 0))
    return flags


def gaps(t: Array, max_gap: float) -> NDArray[np.bool_]:
    """Which of the steps ``(m - 1,)`` between time stamps ``(m,)`` are longer than ``max_gap`` [s]."""
    return np.asarray(np.diff(t) > max_gap * (1 + 1e-6))


def _stamps(spec: DataSpec) -> str:
    """What the time stamps come from, as a message names it."""
    return f"column {spec.time!r}" if isinstance(spec.time, str) else f"the sampling time of {spec.time:g} s"


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
            f"{columns.place(k + 1)}, {_stamps(spec)}: time {what} ({t[k]:g} s, then {t[k + 1]:g} s"
            f"{f'; {such} such rows' if such > 1 else ''}). Time stamps must increase: delete the repeated rows or "
            "split the file into recordings."
        ]
    problems = []
    if gaps(t, spec.max_gap).all():
        problems.append(
            f"sampling is {np.median(steps):g} s, declared max_gap is {spec.max_gap:g} s: every step "
            f"is a gap. Record faster, raise max_gap, or check that {_stamps(spec)} is in seconds "
            "(DataSpec.units names another unit)."
        )
    need = spec.warm_up + MIN_SCORED * spec.dt
    length = float(t[-1] - t[0])
    if length < need:
        problems.append(
            f"{len(t)} samples over {length:g} s are fewer than the {need:g} s that the warm-up "
            f"({spec.warm_up:g} s) and {MIN_SCORED} periods need. Give a longer recording, or check that "
            f"{_stamps(spec)} is in seconds (DataSpec.units names another unit)."
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


def check_unit(spec: DataSpec, column: str, signal: Signal) -> None:
    """Refuse a column whose unit, in the specification or behind its name, cannot be turned into its signal's.

    Raises:
        InputError: Naming column, unit and signal.
    """
    if column in spec.units:
        _factor(column, spec.units[column], signal)
    elif problem := _unit_problem(column, signal):
        raise InputError(problem)


def _unit_problem(column: str, signal: Signal) -> str:
    """What is wrong with the unit behind a column's name; empty if nothing, or if it may be an index, ``y(1)``."""
    unit = name_and_unit(column)[1]
    if unit in ("", "1") or alike(unit, signal.unit):
        return ""
    return (
        f"column {column!r} is in {unit}, which is no unit of {signal.label}. Name the column of that signal, correct "
        "the unit of one of them, or give the factor: units={...} in the DataSpec."
    )


def _factor(column: str, unit: str | float, signal: Signal) -> float:
    """What a column's numbers are multiplied by to be in the signal's unit."""
    if isinstance(unit, str):
        known = {signal.unit: 1.0, **UNITS.get(signal.unit, {})}
        if size := known.get(unit) or factor(unit, signal.unit):
            return size
        remedy = f"there are: {', '.join(known)}. Or give the factor to {signal.unit} as a number."
        if {unit, signal.unit} <= TEMPERATURES:
            remedy = (
                f"they differ by an offset, and no factor brings that: write the column in {signal.unit}."
            )
        raise InputError(
            f"data specification: unit {unit!r} of column {column!r} is none for {signal.label}; {remedy}"
        )
    if not math.isfinite(unit) or unit == 0:
        raise InputError(
            f"data specification: factor {unit} of column {column!r} to {signal.label} must be finite and not zero"
        )
    return float(unit)


def _written_factor(column: str, signal: Signal) -> float:
    """The same by the unit behind the column's name, where it is known; else the column is in the signal's own."""
    _, unit = name_and_unit(column)
    if unit in ("", "1"):  # none, or an index
        return 1.0
    known = {_plainly(name): size for name, size in UNITS.get(signal.unit, {}).items()}
    return known.get(_plainly(unit)) or factor(unit, signal.unit) or 1.0


def _plainly(unit: str) -> str:
    """A unit without what writers differ in."""
    return unit.replace(" ", "").replace("·", "").replace("µ", "u").replace("μ", "u").replace("°", "deg")


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


def _missing(file: str, name: str, t: Array, there: NDArray[np.bool_]) -> Finding:
    """The finding of a column that has numbers in the rows ``there`` ``(m,)`` alone."""
    first, count = int(np.argmin(there)), int((~there).sum())
    ends = np.r_[t[0], t[there], t[-1]]
    message = (
        f"column {name!r} has no number in {count} of {len(t)} rows ({100 * count / len(t):.3g} %), first at "
        f"{t[first]:.6g} s, and none for {float(np.diff(ends).max()):.4g} s at most. These samples count as missing; "
        "if they should not, check the cells."
    )
    return Finding("missing", file, name, float(t[first]), count, message)


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
