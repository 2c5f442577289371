"""Read recordings: find columns, convert units to those of the signals, check times and ranges.

:func:`read_recording` reads one file. All problems of the files of a run are listed in one message.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.files import opened
from hybrid_mpc.data.findings import ABSURD, LARGER, MIN_SCORED, Channel, Finding, gaps, missing_code
from hybrid_mpc.data.names import name_and_unit, said_by, unit_behind
from hybrid_mpc.data.source import Columns, MissingColumn, Source, restarts
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.machine.units import Conversion, conversion
from hybrid_mpc.records import shown
from hybrid_mpc.rules import counted

Array = NDArray[np.float64]
Flags = NDArray[np.int8]
PROPOSED = (  # units that are proposed for a column outside its signal's range
    "ms", "us", "min", "h", "deg", "mrad", "rev", "deg/s", "rpm", "Hz", "rev/s", "mm", "cm", "um", "km", "mm/s", "cm/s",
    "km/h", "mN m", "N cm", "N mm", "kN m", "mN", "kN", "mV", "kV", "mA", "Pa", "kPa", "mbar", "bar", "g", "kg", "mW",
    "kW", "K", "degC", "degF", "%", "-", "l/min", "l/s", "m^3/h",
)  # fmt: skip
SHARE = 0.05  # least share of samples outside the range: a wrong unit affects all rows
BEYOND = 4.0  # least ratio of a column's largest value to the range's limit: below, the range may be wrong
DIGITS = 1e-9  # relative deviation of equal numbers in files of different formats: ten digits
ALIKE = 0.8  # least similarity of two recording names that differ by a typo
FEWEST = 10  # fewest time stamps that show whether the sampling is uniform
UNEVEN = 1e-3  # relative deviation above which two steps differ
COARSE = 1.5  # largest sampling period in model periods: beyond it, interpolation would invent samples
NOISE_SHARE = 0.01  # share of a range that a sample may be beyond it, by the noise of a sensor at its end
ROUNDING = 1e-9  # relative distance from an end of a sensor's range within which a sample is at that end
TIME = Signal("time", "s")


class Samples:
    """Frozen samples ``(n,)``; a missing ``w`` becomes ``(n, 0)``, a missing ``censored`` zeros.

    Raises:
        ValueError: If ``w`` or ``censored`` have another length or shape.
    """

    t: Array
    y: Array
    w: Array
    censored: Flags

    def __post_init__(self) -> None:
        n = len(self.t)
        if self.w.shape[-1] == 0:
            object.__setattr__(self, "w", np.zeros((n, 0)))
        if self.censored.shape != self.y.shape and not self.censored.any():
            object.__setattr__(self, "censored", np.zeros(self.y.shape, dtype=np.int8))
        if len(self.w) != n or self.censored.shape != self.y.shape:
            raise ValueError(
                f"{n} samples with w {self.w.shape}, y {self.y.shape} and censored {self.censored.shape}: w needs one "
                "row per sample, censored the shape of y [HM-DATA-062]"
            )


@dataclass(frozen=True)
class Recording(Samples):
    """One checked recording of ``m`` samples, not resampled; ``name`` is the file's stem.

    ``t`` ``(m,)`` [s] increases strictly. Inputs ``u`` ``(m, n_u)`` are held from each time stamp to the next. Outputs
    ``y`` ``(m, n_y)`` of periodic signals are unwrapped. ``w`` ``(m, n_w)`` are the disturbances, default none. ``y``
    and ``w`` are NaN at missing samples. ``censored`` ``(m, n_y)`` is -1 where an output is at the lower end of its
    sensor's range, +1 at the upper end, else 0 (default). The recording is cut before the samples ``cuts``: the number
    of turns of an angle is unknown there.
    """

    name: str
    path: Path
    sha256: str
    t: Array
    u: Array
    y: Array
    findings: tuple[Finding, ...] = ()
    w: Array = field(default_factory=lambda: np.zeros((0, 0)))
    censored: Flags = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int8))
    cuts: tuple[int, ...] = ()

    @property
    def dt(self) -> float:
        """Median step [s] of the time stamps."""
        return float(np.median(np.diff(self.t)))


class Signals(Protocol):
    """Anything with a machine's signals: a prior, its class, a model."""

    @property
    def states(self) -> Sequence[Signal]:
        """Signals of the states."""

    @property
    def inputs(self) -> Sequence[Signal]:
        """Signals of the inputs (commands)."""

    @property
    def outputs(self) -> Sequence[Signal]:
        """Signals of the measured outputs."""

    @property
    def disturbances(self) -> Sequence[Signal]:
        """Signals of the measured disturbances."""


def read_recording(path: Path | str, prior: Signals, spec: DataSpec) -> Recording:
    """Read one recording in any format (:func:`hybrid_mpc.data.files.opened`), and refuse misleading data.

    Numbers are converted from the unit in ``spec.units``, or in or behind a column's name, to the signal's own. A blank
    cell of an output or a disturbance is a missing sample. A wrapped angle is unwrapped if its signal is ``periodic``.
    If the time is a single number, it is the sampling period, and time begins at 0. Rows are counted from 1 as in an
    editor or MATLAB, indices of ``.npz`` from 0.
    """
    recordings, problems = read_recordings([path], prior, spec)
    refuse(problems)
    return recordings[0]


def read_recordings(
    paths: Sequence[Path | str], prior: Signals, spec: DataSpec
) -> tuple[list[Recording], list[str]]:
    """Read the recordings of a run (:func:`read_recording` for each) and collect their problems.

    Recordings may differ in format, length, sampling, and in columns that ``spec`` does not name.
    """
    refuse(count_problems(spec, prior) or _name_problems(spec, [*map(Path, paths)]))
    recordings: list[Recording] = []
    problems: list[str] = []
    there: dict[str, list[str]] = {}
    missing: dict[str, list[str]] = {}
    for path in map(Path, paths):
        try:
            if any("\ud800" <= c <= "\udfff" for c in path.name):
                raise InputError(
                    f"{str(path)!a}: the file's name is not valid text (UTF-8). Rename the file. [HM-DATA-063]"
                )
            source = opened(path)
            names, lacking = _found(source, spec, there, missing)
            problems += lacking
            if not lacking:
                recordings.append(_recording(source, spec, names, prior))
        except InputError as error:
            problems += error.problems
    if differ := "".join(
        f"\n  {name!r} is in {', '.join(there[name])} and not in {', '.join(files)}"
        for name, files in missing.items()
        if name in there
    ):
        begin = "Columns differ between the recordings. Each recording needs the columns named in the DataSpec. Name "
        problems.insert(0, f"{begin}the inputs of a recording with other columns in inputs_of:{differ}")
    for i, one in enumerate(recordings):
        if same := next((other for other in recordings[:i] if _alike(one, other)), None):
            problems.append(
                f"{one.path} has the same samples as {same.path.name}. Remove one of the two files: a recording must "
                "not count twice. [HM-DATA-064]"
            )
    stems = [Path(path).stem for path in paths]
    if len(set(stems)) < len(stems):
        problems.append(
            f"two recordings have the same file stem: {', '.join(sorted(stems))}. Give each file only once, or "
            "rename one: pieces and windows are named by the stem. [HM-DATA-065]"
        )
    return recordings, problems


def _alike(one: Recording, other: Recording) -> bool:
    """Whether two recordings hold the same numbers, up to the digits of another format."""
    pairs = [(getattr(one, key), getattr(other, key)) for key in ("t", "u", "w", "y")]
    return all(a.shape == b.shape for a, b in pairs) and all(
        np.allclose(a, b, rtol=DIGITS, atol=DIGITS * float(np.nanmax(np.abs(a), initial=0.0)), equal_nan=True)
        for a, b in pairs
    )


# The specification


def count_problems(spec: DataSpec, prior: Signals) -> list[str]:
    """Roles whose number of columns differs from the prior's number of signals."""
    roles: list[tuple[str, str, Sequence[str], Sequence[Signal]]] = [
        ("inputs", "input", spec.inputs, prior.inputs),
        ("disturbances", "disturbance", spec.disturbances, prior.disturbances),
        ("outputs", "output", spec.outputs, prior.outputs),
        *((f"inputs_of {stem!r}", "input", names, prior.inputs) for stem, names in spec.inputs_of.items()),
    ]
    return [
        f"data specification: {role} has {counted(len(names), 'column')} "
        f"({', '.join(map(repr, names)) or 'none'}) for a prior with {len(signals)} {word}"
        f"{'s' * (len(signals) != 1)} ({', '.join(s.label for s in signals) or 'none'}). Name one column per signal, "
        "in the prior's order. [HM-DATA-129]"
        for role, word, names, signals in roles
        if len(names) != len(signals)
    ]


def _settings(spec: DataSpec) -> dict[str, Mapping[str, object]]:
    """Settings of single recordings, by the stems of their files."""
    return {"windows": spec.windows, "inputs_of": spec.inputs_of, "delays_of": spec.delays_of}


def _name_problems(spec: DataSpec, paths: Sequence[Path]) -> list[str]:
    """Columns with two roles, settings of columns without a role, and recordings not named by their stem.

    Inputs in ``inputs_of`` may also be disturbances.
    """
    time = (spec.time,) if isinstance(spec.time, str) else ()
    roles: dict[str, Sequence[str]] = {
        "time": time, "inputs": spec.inputs, "disturbances": spec.disturbances, "outputs": spec.outputs,
    }  # fmt: skip
    problems, every = [], [(role, names, [*roles]) for role, names in roles.items()]
    every += [(f"inputs_of {stem!r}", names, ["outputs", "time"]) for stem, names in spec.inputs_of.items()]
    for role, names, others in every:
        for name in names:
            if also := [other for other in others if other != role and name in roles[other]]:
                problems.append(
                    f"data specification: column {name!r} is named in {' and '.join(sorted([role, *also]))}. A column "
                    "has one role: name it once. [HM-DATA-066]"
                )
    signals = spec.columns - set(time)
    any_signal = "Name a column of an input, a disturbance or an output."
    any_column = "Name a column that inputs, outputs, disturbances or time name."
    known: list[tuple[str, Mapping[str, object], frozenset[str], str]] = [
        ("delays", spec.delays, signals, any_signal),
        *((f"delays_of {stem!r}", delays, signals, any_signal) for stem, delays in spec.delays_of.items()),
        ("units", spec.units, spec.columns, any_column),
    ]
    problems += [
        f"data specification: {role} names column {name!r}, which is not among "
        f"{', '.join(sorted(map(repr, columns)))}. {remedy} [HM-DATA-067]"
        for role, names, columns, remedy in known
        for name in names
        if name not in columns
    ]
    stems = {path.stem: path.stem for path in paths}
    meant = {name.casefold(): path.stem for path in paths for name in (path.name, path.stem)}
    problems += [
        f"data specification: {setting} names the recording {name!r}, but the file's stem is "
        f"{meant[name.strip().casefold()]!r}. Write the stem. [HM-DATA-068]"
        for setting, of_files in _settings(spec).items()
        for name in of_files
        if name not in stems and name.strip().casefold() in meant
    ]
    return list(dict.fromkeys(problems))


def find_misspelt(spec: DataSpec, paths: Sequence[Path]) -> list[Finding]:
    """Settings of recordings that are not given, if the name is nearly that of a given recording without such settings.

    Names that differ only in their digits belong to different recordings.
    """
    found = []
    for setting, names in _settings(spec).items():
        free = {path.stem: path.name for path in paths if path.stem not in names}
        for name in set(names) - {path.stem for path in paths}:
            near = difflib.get_close_matches(name, free, n=1, cutoff=ALIKE)
            if near and re.sub(r"\d+", "", name) != re.sub(r"\d+", "", near[0]):
                message = (
                    f"{setting} of the DataSpec names the recording {name!r}, which is not given. Did you mean "
                    f"{near[0]!r}? A recording is named by the stem of its file."
                )
                found.append(Finding("settings", free[near[0]], "", 0.0, 1, message))
    return found


def _found(
    source: Source, spec: DataSpec, there: dict[str, list[str]], missing: dict[str, list[str]]
) -> tuple[list[str], list[str]]:
    """Full names of the requested columns, and problems with others; records which file has which column."""
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
    by_full = dict(zip(asked, names, strict=True)) if not problems else {}
    for full in dict.fromkeys(by_full.values()):
        same = [name for name, found in by_full.items() if found == full]
        if len(same) > 1:
            problems.append(
                f"{source.path}: columns {' and '.join(map(repr, same))} are the same column, {full!r}. A column has "
                "one role: give full names. [HM-DATA-069]"
            )
    return names, problems


def _asked(source: Source, spec: DataSpec) -> list[str]:
    """Columns that are read from a file: time (if it is a column), inputs, disturbances, outputs."""
    time = [spec.time] if isinstance(spec.time, str) else []
    return [*time, *spec.inputs_in(source.path.stem), *spec.disturbances, *spec.outputs]


# One recording


def _recording(source: Source, spec: DataSpec, found: Sequence[str], prior: Signals) -> Recording:
    """A recording whose columns all exist; all checks are made, and all failures are reported together."""
    path, names = source.path, _asked(source, spec)
    signals = [TIME, *prior.inputs, *prior.disturbances, *prior.outputs]
    first, split = 1 + len(prior.inputs), 1 + len(prior.inputs) + len(prior.disturbances)
    if not isinstance(spec.time, str):
        names, found = [_stamps(spec), *names], ["", *found]
    columns = source.read(found[0] or None, found[1:], set(found[first:]) - set(found[:first]))
    values = columns.values
    if not isinstance(spec.time, str):
        values = np.column_stack([spec.time * np.arange(len(values)), values])
    columns, values, findings = _one_clock(path.name, columns, values, spec, found[0])
    if source.notes and len(values):
        text = f"conversions while reading: {'; '.join(source.notes)}"
        findings.append(Finding("read", path.name, "", float(values[0, 0]), len(source.notes), text))
    problems, raw = list(columns.problems), values.copy()
    codes = [None, *map(missing_code, raw.T[1:])]  # before conversion of units
    unclear: set[int] = set()  # columns whose unit cannot be converted to that of their signal
    with np.errstate(over="ignore"):  # an overflow is reported as out of range
        for j, (name, signal) in enumerate(zip(names, signals, strict=True)):
            to, problem = _converted(spec, name, found[j], signal)
            values[:, j] = to.factor * values[:, j] + to.offset
            if problem:
                problems.append(problem)
                unclear.add(j)
    t = values[:, 0]
    if (np.abs(t) <= ABSURD).all():  # other times, NaN included, are reported as out of range
        problems += _time_problems(t, columns, spec, path.stem)
    known = np.isfinite(values)
    clean = not problems and bool((np.abs(values[known]) <= ABSURD).all())
    censored = censored_of(
        values[:, split:], prior.outputs
    )  # before unwrapping: periodic signals do not saturate
    cuts: set[int] = set()
    for j, (signal, name) in enumerate(zip(signals, names, strict=True)):
        note, there = "", known[:, j]
        faulty = any(f"column {shown(found[j])} " in problem for problem in columns.problems)
        if j >= first and len(t) and not there.any() and not faulty:
            problems.append(
                f"column {name!r} has no number in any row; {signal.name} was not measured. Record this signal, or "
                "remove this recording. [HM-DATA-070]"
            )
        if clean and j >= split and there.any() and (censored[there, j - split] != 0).all():
            lower, upper = signal.saturation or (-math.inf, math.inf)
            problems.append(
                f"column {name!r} is at or beyond an end of its sensor's range {lower:g} to {upper:g} {signal.unit} in "
                f"all rows ({values[there, j].min():.6g} to {values[there, j].max():.6g}), so it has no measured "
                f"value. Check the unit and Signal.saturation of {signal.name}, or remove this recording. [HM-DATA-071]"
            )
        if clean and j >= first:
            channel = Channel(path.name, name, signal, t[there], values[there, j])
            jumping, angle = channel.jumps(raw[there, j], spec.max_gap)
            findings += jumping
            if angle is not None:
                values[there, j] = angle.angle
                note = f", with {counted(len(angle.jumps), 'jump')} of a full turn removed"
                cuts |= set(np.flatnonzero(there)[angle.unclear].tolist())
        channel = Channel(path.name, name, signal, t, values[:, j])
        if clean and j:
            findings += channel.odd(there)
        if (code := codes[j]) is not None:
            rows = np.flatnonzero(raw[:, j] == code)
            problems.append(
                f"{columns.place(int(rows[0]))}, column {name!r}: {code:.10g}, in {len(rows)} of {len(t)} rows, is far "
                "from all other values and probably a code for missing values. Leave these cells blank; inputs need a "
                "number in every row. [HM-DATA-072]"
            )
        elif j not in unclear:
            problems += _range_problems(channel, columns, note)
    problems += [f"{finding.message} [HM-DATA-121]" for finding in findings if finding.refused]
    refuse([f"{path}: {problem}" for problem in problems])
    u, w, y = values[:, 1:first], values[:, first:split], values[:, split:]
    return Recording(
        path.stem, path, source.sha256, t, u, y, tuple(findings), w, censored, tuple(sorted(cuts))
    )


def censored_of(y: Array, outputs: Sequence[Signal]) -> Flags:
    """Samples ``(m, n_y)`` at or beyond an end of their sensor's range: -1 lower, +1 upper; else 0."""
    flags = np.zeros(y.shape, dtype=np.int8)
    for j, signal in enumerate(outputs):
        if signal.saturation is not None:
            lower, upper = signal.saturation
            near = ROUNDING * max((abs(end) for end in (lower, upper) if math.isfinite(end)), default=0.0)
            flags[:, j] = np.where(y[:, j] >= upper - near, 1, np.where(y[:, j] <= lower + near, -1, 0))
    return flags


def _range_problems(channel: Channel, columns: Columns, note: str) -> list[str]:
    """Problems with implausible values."""
    signal, column = channel.signal, channel.y
    lower, upper = max(signal.lower, -ABSURD), min(signal.upper, ABSURD)
    # noise carries a value at an end of its range beyond it; NaN is already reported elsewhere
    noise = NOISE_SHARE * (signal.upper - signal.lower) if math.isfinite(signal.upper - signal.lower) else 0.0
    bad = np.flatnonzero((column < lower - noise) | (column > upper + noise))
    if not len(bad):
        return []
    first, worst = int(bad[0]), int(bad[np.argmax(np.abs(column[bad]))])
    such = f" ({len(bad)} rows in all; the largest is {column[worst]:g} in {columns.place(worst)})"
    unit = _likely_unit(column[~np.isnan(column)], signal)
    hint = f" The values are plausible in {unit}: write units={{{channel.name!r}: {unit!r}}} in the DataSpec."
    return [
        f"{columns.place(first)}, column {channel.name!r}: {column[first]:g} is outside the plausible range "
        f"{lower:g} to {upper:g} {signal.unit} of {signal.name}{note}{such if len(bad) > 1 else ''}."
        f"{hint if unit else ''} Check unit and sign, correct the rows, or widen the range of the signal in the "
        "scenario's prior. [HM-DATA-118]"
    ]


# Time


def _stamps(spec: DataSpec) -> str:
    """The source of the time stamps, for a message."""
    return f"column {spec.time!r}" if isinstance(spec.time, str) else f"the sampling time of {spec.time:g} s"


def _one_clock(
    file: str, columns: Columns, values: Array, spec: DataSpec, found: str
) -> tuple[Columns, Array, list[Finding]]:
    """Columns, numbers and findings after removing repeated rows and shifting restarted time stamps behind a gap.

    Stamps that are uneven only by rounding are made even. ``found`` is the full name of the time's column.
    """
    findings, name, seconds = list[Finding](), _stamps(spec), 1.0

    def tell(k: int, count: int, what: str) -> None:
        message = f"{columns.place(k)}, {name}: {what}"
        findings.append(Finding("clock", file, str(spec.time), float(values[k, 0]), count, message))

    if isinstance(spec.time, str):
        seconds = _converted(spec, spec.time, found, TIME)[0].factor
        twice = np.r_[False, (values[1:] == values[:-1]).all(axis=1)][: len(values)]
        if twice.any():
            count = int(twice.sum())
            what = (
                f"{counted(count, 'row repeats', 'rows repeat')} the previous row and are dropped; this row is the "
                "first."
            )
            tell(int(np.argmax(twice)), count, what)
            numbers = [columns.numbers[j] for j in np.flatnonzero(~twice).tolist()]
            columns, values = replace(columns, values=columns.values[~twice], numbers=numbers), values[~twice]
    t, begins = values[:, 0].copy(), restarts(values[:, 0])
    pause = 3 * spec.max_gap / seconds  # in the column's unit
    for a, b in pairwise([0, *begins, len(t)]):
        own = make_even(t[a:b])
        values[a:b, 0] = own if a == 0 else own - own[0] + values[a - 1, 0] + pause
    if begins:
        k, count = begins[0], len(begins)
        such = f"; {count} restarts in all" if count > 1 else ""
        what = f"time restarts ({t[k - 1]:.10g}, then {t[k]:.10g}{such}): the logger was started again. The "
        what += (
            f"recording is cut there, and its later time stamps are shifted to begin at {values[k, 0]:.6g}. Split the "
            "file to give "
        )
        tell(k, count, f"{what}its parts different roles.")
    return columns, values, findings


def make_even(t: Array) -> Array:
    """Replace time stamps ``(m,)`` that are uneven only by rounding by a uniform grid; return all others unchanged.

    Stamps may be rounded to single precision or to decimals. A grid of equal steps, with samples missing here and
    there, replaces them if it is nowhere farther away than the rounding. Stretches separated by a pause have grids of
    their own.
    """
    steps = np.diff(t)
    if len(t) < FEWEST or not (np.abs(t) < LARGER).all() or not (steps > 0).all():
        return t
    usual = float(np.median(steps))
    like = steps[np.abs(steps - usual) <= 0.6 * usual]
    usual = float(like.mean()) if len(like) else math.inf
    if float(np.abs(steps - usual).max()) <= UNEVEN * usual:
        return t
    found, rounding = t.copy(), _rounding(t)
    # time step, in median steps, above which the recording pauses
    for rows in np.split(np.arange(len(t)), np.flatnonzero(steps > 20.0 * usual) + 1):
        if len(rows) < FEWEST:
            continue
        own = t[rows] - t[rows[0]]
        mean = own[-1] / max(1.0, float(np.round(np.diff(own) / usual).sum()))
        count = np.r_[0.0, np.cumsum(np.round(np.diff(own) / mean))]
        slope = float(np.cov(count, own)[0, 1] / np.var(count, ddof=1)) if np.ptp(count) > 0 else 0.0
        grid = own.mean() + slope * (count - count.mean())
        off = np.abs(grid - own)
        # allowed deviation of a fitted grid beyond the rounding of the stamps, in roundings
        fits = (np.diff(count) > 0).all() and (off <= rounding[rows] * (0.5 + 0.05)).all()
        if fits and off.max() > UNEVEN * slope:
            found[rows] = t[rows[0]] + grid
    return found


def _rounding(t: Array) -> Array:
    """Rounding of each of the time stamps ``(m,)``."""
    found, single, size = np.zeros(len(t)), t.astype(np.float32), float(np.abs(t).max())
    if (single == t).all() or all(float(str(a)) == b for a, b in zip(single, t.tolist(), strict=True)):
        found = np.spacing(np.abs(single)).astype(np.float64)
    for decimals in range(10):
        unit = 10.0**-decimals
        if (np.abs(t - np.round(t, decimals)) <= 1e-4 * unit + 4 * np.spacing(size)).all():
            return np.maximum(found, unit)
    return found


def _time_problems(t: Array, columns: Columns, spec: DataSpec, stem: str) -> list[str]:
    """Problems with finite time stamps."""
    if len(t) < 2:
        return [f"{len(t)} row(s) of numbers are too few for a recording. Record more samples. [HM-DATA-119]"]
    if disorder := columns.disorder(t, _stamps(spec)):
        return [disorder]
    in_seconds = f"check that {_stamps(spec)} is in seconds (DataSpec.units names another unit)."
    need, length, problems = spec.warm_up + MIN_SCORED * spec.dt, float(t[-1] - t[0]), []
    if gaps(t, spec.max_gap).all():
        problems.append(
            f"sampling is {np.median(np.diff(t)):g} s, but max_gap is {spec.max_gap:g} s: every step is a gap. "
            f"Record faster, raise max_gap, or {in_seconds} [HM-DATA-073]"
        )
    if length < need:
        problems.append(
            f"the recording is {length:g} s long ({len(t)} samples), but the warm-up ({spec.warm_up:g} s) and "
            f"{MIN_SCORED} periods need {need:g} s. Give a longer recording, or {in_seconds} [HM-DATA-074]"
        )
    return problems + [
        f"the {window.role} window {window.start:g} to {window.end:g} s is not within the "
        f"recording ({t[0]:g} to {t[-1]:g} s). Give the whole recording, or change the window. [HM-DATA-120]"
        for window in spec.windows.get(stem, ())
        if window.start < t[0] - spec.dt or window.end > t[-1] + spec.dt
    ]


# Units


def check_unit(spec: DataSpec, column: str, signal: Signal) -> None:
    """Refuse a column whose unit, in the specification or in its name, cannot be converted to its signal's.

    Raises:
        InputError: With column, unit and signal.
    """
    refuse([problem for problem in [_converted(spec, column, column, signal)[1]] if problem])


def _converted(spec: DataSpec, name: str, column: str, signal: Signal) -> tuple[Conversion, str]:
    """Conversion of a column, ``name`` in the specification, to the signal's unit; and the problem with its unit,
    empty without one.
    """
    given = spec.units.get(name)
    if isinstance(given, float | int):
        size = float(given)
        wrong = "" if math.isfinite(size) and size else "the factor must be finite and nonzero"
        return Conversion(
            size
        ), wrong and f"data specification: units={{{name!r}: {given}}}: {wrong}. [HM-DATA-127]"
    unit, index = name_and_unit(column)[1] if given is None else given, False
    if given is None and not unit:
        # the end of the name; a single letter at the end of a full name may be an index
        ending = unit_behind(column)
        unit = (said_by(column).unit if signal is TIME else "") or ending.unit
        index = ending.perhaps and name == column
    found = conversion(unit, signal.unit) if given is not None or unit not in ("", "1") else Conversion(1.0)
    if isinstance(found, Conversion) or index:
        return found if isinstance(found, Conversion) else Conversion(1.0), ""
    remedy = "Name the column of that signal, correct one of the units, or give the factor"
    return Conversion(1.0), (
        f"column {column!r} is in {unit!r}, {found} for {signal.label}. {remedy}: units={{{name!r}: FACTOR}} in the "
        "DataSpec. [HM-DATA-128]"
    )


def _likely_unit(column: Array, signal: Signal) -> str:
    """Unit in which a column outside its signal's plausible range would lie inside; empty without one."""
    limit = max(abs(signal.lower), abs(signal.upper))
    largest = float(np.abs(column).max(initial=0.0))
    beyond = float(((column < signal.lower) | (column > signal.upper)).mean())
    if beyond < SHARE or not BEYOND * limit < largest < math.inf:
        return ""
    for unit in PROPOSED:
        found = conversion(unit, signal.unit)
        if isinstance(found, str) or found == Conversion(1.0):
            continue
        values = found.factor * column + found.offset
        low, high = float(values.min()), float(values.max())
        # least share of a signal's range that a column fills in a proposed unit
        if max(-low, high) >= 0.01 * limit and signal.lower <= low and high <= signal.upper:
            return unit
    return ""
