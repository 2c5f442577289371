"""Recordings read: columns found, units turned into the signals' own, times and ranges checked.

:func:`read_recording` reads one file. Everything that is wrong with the files of a run is named in one message.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.files import opened
from hybrid_mpc.data.source import Columns, MissingColumn, Source, name_and_unit, restarts
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.machine.units import Conversion, conversion
from hybrid_mpc.records import shown

Array = NDArray[np.float64]
Flags = NDArray[np.int8]
TURN = 2 * math.pi
PROPOSED = (
    "ms", "us", "min", "h", "deg", "mrad", "rev", "deg/s", "rpm", "Hz", "rev/s", "mm", "cm", "um", "km", "mm/s", "cm/s",
    "km/h", "mN m", "N cm", "N mm", "kN m", "mN", "kN", "mV", "kV", "mA", "Pa", "kPa", "mbar", "bar", "g", "kg", "mW",
    "kW", "K", "degC", "degF", "%", "-", "l/min", "l/s", "m^3/h",
)  # fmt: skip
"""Units that are proposed for a column that leaves its signal's range."""
FILLED = 0.01
"""Share of a signal's range that a column would have to fill in another unit for that unit to be proposed."""
SHARE = 0.05
"""Share of the samples beyond the range from which on a unit is proposed: a wrong unit is wrong in all rows."""
BEYOND = 4.0
"""Times the range's limit that a column must reach for a unit to be proposed: less may be a wrong range."""
NEARLY = 0.25
"""Share of a full turn within which a jump is one: what the angle truly moves from one sample to the next is less."""
DIGITS = 1e-9
"""Share by which equal numbers differ in files of other formats: ten digits."""
FAR_OFF = 3.0
"""Times the span and the size of all other values by which a code for missing ones is away from them."""
_CODE = re.compile(
    r"999+(\.9+|\.25)?|9\.9+e\+\d\d+|9\.96921e\+36|32767|32768|65535|8388607|8388608|2147483647|2147483648|4294967295|"
    r"1e\+[1-3]\d|3\.402(82|823|823466)e\+38"
)
_NEVER = re.compile(r"9999+(\.9+|\.25)?|999\.25|9\.9.*e\+\d\d+|[13].*e\+[2-9]\d")
"""Codes that are no position of a switch, where they are negative or larger than ``LARGER``."""
LARGER = 1e15
"""No number of a machine that switches is larger."""
OUTLYING = 10.0
"""Spans of all other values by which a sample is away from them that is an outlier."""
MOST_ODD = 5
"""Most samples of a column that are outliers, and at most one of a hundred: more are a motion."""
SEVERAL = 4
"""Most codes that one column is looked at for."""
HOLE = 1.5
"""Usual distances of the time stamps from which on samples are missing between two."""
UNSURE = 0.4
"""Share of a turn by which the way over missing samples may differ from that at the speeds before and after: at half a
turn another number of turns would fit as well."""
PARTS = (2, 3, 4, 6, 8)
"""Parts of a turn after which a sensor may begin anew: half turns of an arctangent, pole pairs."""
ALIKE = 0.8
"""How alike the names of two recordings are that are one, misspelt."""
BITS = (8, 10, 12, 14, 16, 20, 24, 32)
"""Bits of counters that overflow."""
LIKE = 0.03
"""Share by which a jump, the motion around it taken off, may differ from such a part."""
FEWEST = 10
"""Fewest time stamps that show whether they are even."""
UNEVEN = 1e-3
"""Share of a step from which on a step is another one."""
PAUSE = 20.0
"""Usual steps without a sample that are a pause."""
SLACK = 0.05
"""What a grid that is fitted to rounded stamps may be off beyond their rounding, in roundings."""
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

    kind: Literal["read", "clock", "wrapped", "frozen", "clipped", "speed", "missing", "outlier", "settings"]
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
    the upper end, else 0, which is the default. ``cuts`` are the samples before which it is cut, as over a gap, since
    nobody knows how many turns an angle made before them; by default none.
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
    cuts: tuple[int, ...] = ()

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
    """Read one recording, whatever its format (:func:`hybrid_mpc.data.files.opened`), and check what would mislead.

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
    refuse(
        _count_problems(spec, prior) or [*_column_problems(spec), *_stem_problems(spec, [*map(Path, paths)])]
    )
    recordings: list[Recording] = []
    problems: list[str] = []
    there: dict[str, list[str]] = {}
    missing: dict[str, list[str]] = {}
    for path in map(Path, paths):
        try:
            if any("\ud800" <= c <= "\udfff" for c in path.name):
                raise InputError(f"{str(path)!a}: the file's name is no text (UTF-8). Rename the file.")
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
    for i, one in enumerate(recordings):
        if same := next((other for other in recordings[:i] if _alike(one, other)), None):
            problems.append(
                f"{one.path} holds the same samples as {same.path.name}. Leave one out: what is recorded once is "
                "evidence once."
            )
    stems = [Path(path).stem for path in paths]
    if len(set(stems)) < len(stems):
        problems.append(
            f"two recordings have the same file stem: {', '.join(sorted(stems))}. Give each file once, or "
            "rename one: pieces and windows are named by the stem."
        )
    return recordings, problems


def _alike(one: Recording, other: Recording) -> bool:
    """Whether two recordings hold the same numbers, but for the digits of another format."""
    pairs = [(getattr(one, key), getattr(other, key)) for key in ("t", "u", "w", "y")]
    return all(a.shape == b.shape for a, b in pairs) and all(
        np.allclose(a, b, rtol=DIGITS, atol=DIGITS * float(np.nanmax(np.abs(a), initial=0.0)), equal_nan=True)
        for a, b in pairs
    )


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
    known = spec.columns - set(time)
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
    there = ", ".join(sorted(map(repr, spec.columns)))
    problems += [
        f"data specification: units names column {name!r}, which is none of {there}. Name a column as inputs, outputs, "
        "disturbances and time do."
        for name in spec.units
        if name not in spec.columns
    ]
    return list(dict.fromkeys(problems))


def _stem_problems(spec: DataSpec, paths: Sequence[Path]) -> list[str]:
    """Settings of single recordings that name a file by more than its stem, or by other letters: nobody would find
    them. Of recordings that are not given there may be some.
    """
    stems = {path.stem for path in paths}
    meant = {
        **{path.name.casefold(): path.stem for path in paths},
        **{stem.casefold(): stem for stem in stems},
    }
    return [
        f"data specification: {setting} names the recording {name!r}, and the file's stem is "
        f"{meant[name.strip().casefold()]!r}. Write it so."
        for setting, names in (
            ("windows", spec.windows),
            ("inputs_of", spec.inputs_of),
            ("delays_of", spec.delays_of),
        )
        for name in names
        if name not in stems and name.strip().casefold() in meant
    ]


def misspelt(spec: DataSpec, paths: Sequence[Path]) -> list[Finding]:
    """Settings of recordings that are not given, whose names are nearly those of recordings that are given and have no
    such settings. Names that differ in their numbers alone are those of several recordings.
    """
    found = []
    settings: dict[str, Mapping[str, object]] = {
        "windows": spec.windows, "inputs_of": spec.inputs_of, "delays_of": spec.delays_of,
    }  # fmt: skip
    for setting, names in settings.items():
        free = {path.stem: path.name for path in paths if path.stem not in names}
        for name in names:
            near = difflib.get_close_matches(name, free, n=1, cutoff=ALIKE)
            if name in {path.stem for path in paths} or not near or _letters(name) == _letters(near[0]):
                continue
            message = (
                f"{setting} of the DataSpec has {name!r}, which is not given, and nothing for {near[0]!r}: misspelt? "
                "Settings of recordings go by the stem of the file."
            )
            found.append(Finding("settings", free[near[0]], "", 0.0, 1, message))
    return found


def _letters(name: str) -> str:
    return re.sub(r"\d+", "", name)


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
    columns, values, findings = _one_clock(path.name, columns, values, spec, found[0])
    if source.notes and len(values):
        done = "; ".join(source.notes)
        findings.append(
            Finding("read", path.name, "", float(values[0, 0]), len(source.notes), f"as it was read: {done}")
        )
    first, split = 1 + len(inputs), 1 + len(inputs) + len(disturbances)
    problems = list(columns.problems)
    unclear: set[int] = set()  # columns whose unit is none of their signal's
    cuts: set[int] = set()
    raw = values.copy()
    codes = [
        None,
        *(missing_code(column) for column in values.T[1:]),
    ]  # as the file has them, before units are converted
    with np.errstate(over="ignore"):  # what overflows is out of its range
        for j, (name, signal) in enumerate(zip(names, signals, strict=True)):
            to, problem = _converted(spec, name, found[j], signal)
            values[:, j] = to.factor * values[:, j] + to.offset
            if problem:
                problems.append(problem)
                unclear.add(j)
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
        if clean and j >= split and there.any() and (censored[there, j - split] != 0).all():
            lower, upper = signal.saturation or (-math.inf, math.inf)
            problems.append(
                f"column {name!r} is at an end of its sensor's range {lower:g} to {upper:g} {signal.unit} or beyond in "
                f"all rows ({values[there, j].min():.6g} to {values[there, j].max():.6g}): nothing was measured. Check "
                f"the unit and Signal.saturation of {signal.name}, or leave this recording out."
            )
        if clean and j >= first and turn is not None:
            found_turns = unwrapped(t[there], values[there, j], turn, spec.max_gap, periodic=signal.periodic)
            if len(jumps := found_turns.jumps):
                findings.append(_wrapped(path.name, name, signal, t[there], values[there, j], found_turns))
                if signal.periodic:
                    values[there, j] = found_turns.angle
                    note = f", with {len(jumps)} jumps of a full turn taken out"
                    cuts |= set(np.flatnonzero(there)[found_turns.unclear].tolist())
            elif found_parts := folded(t[there], values[there, j], turn, spec.max_gap):
                findings.append(_folded(path.name, name, signal, t[there], values[there, j], *found_parts))
        if clean and j >= first and (found_bits := _overflow(t[there], raw[there, j], spec.max_gap)):
            findings.append(_overflowing(path.name, name, t[there], raw[there, j], *found_bits))
        if clean and j and codes[j] is None and (odd := outliers(values[:, j])) is not None:
            findings.append(_outlying(path.name, name, signal, t, values[:, j], odd))
        if clean and j >= first and there.any() and not there.all():
            findings.append(_missing(path.name, name, t, there))
        if (code := codes[j]) is not None:
            rows = np.flatnonzero(raw[:, j] == code)
            problems.append(
                f"{columns.place(int(rows[0]))}, column {name!r}: {code:.10g}, in {len(rows)} of {len(t)} rows, is far "
                "from all other values: a code for missing ones? Leave these cells blank; inputs are needed in every "
                "row."
            )
        elif j not in unclear:
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
        cuts=tuple(sorted(cuts)),
    )


def _one_clock(
    file: str, columns: Columns, values: Array, spec: DataSpec, found: str
) -> tuple[Columns, Array, list[Finding]]:
    """The same without rows that stand twice, and with time stamps that count on where they begin anew, behind a gap.

    Stamps that are uneven by rounding alone are made even. ``found`` is the full name of the time's column.
    """
    findings, name = [], _stamps(spec)
    twice = np.r_[False, (values[1:] == values[:-1]).all(axis=1)][: len(values)]
    if isinstance(spec.time, str) and twice.any():
        k = int(np.argmax(twice))
        message = (
            f"{columns.place(k)}, {name}: {int(twice.sum())} rows are those before them once more, this one the first. "
            "They are left out."
        )
        findings.append(
            Finding("clock", file, str(spec.time), float(values[k, 0]), int(twice.sum()), message)
        )
        numbers = [columns.numbers[j] for j in np.flatnonzero(~twice).tolist()]
        columns, values = replace(columns, values=columns.values[~twice], numbers=numbers), values[~twice]
    t, begins = values[:, 0].copy(), restarts(values[:, 0])
    seconds = (
        _converted(spec, spec.time, found, Signal("time", "s"))[0].factor
        if isinstance(spec.time, str)
        else 1.0
    )
    pause = 3 * spec.max_gap / seconds  # in the column's unit
    for a, b in pairwise([0, *begins, len(t)]):
        own = even(t[a:b])
        values[a:b, 0] = own if a == 0 else own - own[0] + values[a - 1, 0] + pause
    if begins:
        k, count = begins[0], len(begins)
        message = (
            f"{columns.place(k)}, {name}: time begins anew ({t[k - 1]:.10g}, then {t[k]:.10g}"
            f"{f'; {count} such rows' if count > 1 else ''}): the logger was started again. The recording is cut "
            f"there; its later samples count on from {values[k, 0]:.6g}. Split the file to give its parts other roles."
        )
        findings.append(Finding("clock", file, str(spec.time), float(values[k, 0]), count, message))
    return columns, values, findings


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


def even(t: Array) -> Array:
    """Time stamps ``(m,)`` whose steps are uneven by rounding alone, made even; all others as they are.

    Stamps are rounded to single precision, or to so many decimals. Where a grid of equal steps, with samples missing
    here and there, is nowhere further from them than that rounding, it is what was sampled. Stretches with a pause
    between them have grids of their own.

    Example:
        >>> single = (1e4 + 0.01 * np.arange(1000)).astype(np.float32).astype(float)
        >>> bool(np.ptp(np.diff(single)) > 9e-4), bool(np.ptp(np.diff(even(single))) < 1e-9)
        (True, True)
    """
    if len(t) < FEWEST or not (np.abs(t) < LARGER).all():
        return t
    steps = np.diff(t)
    usual = float(np.median(steps))
    if not (steps > 0).all():
        return t
    like = steps[np.abs(steps - usual) <= 0.6 * usual]
    if not len(like):
        return t
    usual = float(like.mean())
    if float(np.abs(steps - usual).max()) <= UNEVEN * usual:
        return t
    found, rounding = t.copy(), _rounding(t)
    for rows in np.split(np.arange(len(t)), np.flatnonzero(steps > PAUSE * usual) + 1):
        if len(rows) < FEWEST:
            continue
        own = t[rows] - t[rows[0]]
        mean = own[-1] / max(1.0, float(np.round(np.diff(own) / usual).sum()))
        count = np.r_[0.0, np.cumsum(np.round(np.diff(own) / mean))]
        slope = float(np.cov(count, own)[0, 1] / np.var(count, ddof=1)) if np.ptp(count) > 0 else 0.0
        grid = own.mean() + slope * (count - count.mean())
        off = np.abs(grid - own)
        fits = (np.diff(count) > 0).all() and (off <= rounding[rows] * (0.5 + SLACK)).all()
        if fits and off.max() > UNEVEN * slope:
            found[rows] = t[rows[0]] + grid
    return found


def _rounding(t: Array) -> Array:
    """What time stamps ``(m,)`` are rounded to, for each."""
    found, single, size = np.zeros(len(t)), t.astype(np.float32), float(np.abs(t).max())
    if (single == t).all() or all(float(str(a)) == b for a, b in zip(single, t.tolist(), strict=True)):
        found = np.spacing(np.abs(single)).astype(np.float64)
    for decimals in range(10):
        unit = 10.0**-decimals
        if (np.abs(t - np.round(t, decimals)) <= 1e-4 * unit + 4 * np.spacing(size)).all():
            return np.maximum(found, unit)
    return found


def _stamps(spec: DataSpec) -> str:
    """What the time stamps come from, as a message names it."""
    return f"column {spec.time!r}" if isinstance(spec.time, str) else f"the sampling time of {spec.time:g} s"


def _time_problems(t: Array, columns: Columns, spec: DataSpec, stem: str) -> list[str]:
    """What is wrong with the time stamps, which are finite."""
    if len(t) < 2:
        return [f"{len(t)} row(s) of numbers; a recording needs many. Record it again."]
    if disorder := columns.disorder(t, _stamps(spec)):
        return [disorder]
    steps, problems = np.diff(t), []
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


def missing_code(column: Array) -> float | None:
    """A number that logging programs write for a missing value, as the file has it, where a column has it, be it once,
    far from all others; None without.

    It is far where it is ``FAR_OFF`` spans of the others away, and as many of their sizes, or negative where all others
    are positive.
    """
    others, found = column[np.abs(column) <= ABSURD], list[float]()
    while len(others) and len(found) < SEVERAL:
        ends = (float(others.min()), float(others.max()))
        code = next((end for end in ends if _spelled(_CODE, end)), None)
        if code is None:
            break
        found.append(code)
        others = others[others != code]
    if not len(others):
        return None
    span, size = float(np.ptp(others)), float(np.abs(others).max())
    for code in found:
        away = float(np.abs(others - code).min())
        far = away > FAR_OFF * size or code < 0 <= float(others.min())
        switch = span == 0 and not (_spelled(_NEVER, code) and (code < 0 or code > LARGER))
        if far and away > FAR_OFF * span and not switch:
            return code
    return None


def _spelled(pattern: re.Pattern[str], value: float) -> bool:
    """Whether a number, or the one of single precision that it was, is written so, whatever its sign."""
    return any(pattern.fullmatch(f"{abs(value):.{digits}g}") for digits in (10, 7))


# Units


def check_unit(spec: DataSpec, column: str, signal: Signal) -> None:
    """Refuse a column whose unit, in the specification or behind its name, cannot be turned into its signal's.

    Raises:
        InputError: Naming column, unit and signal.
    """
    refuse([problem for problem in [_converted(spec, column, column, signal)[1]] if problem])


def _converted(spec: DataSpec, name: str, column: str, signal: Signal) -> tuple[Conversion, str]:
    """How the numbers of a column, ``name`` in the specification, become those of the signal; and what is wrong with
    its unit, empty if nothing is.
    """
    given = spec.units.get(name)
    if isinstance(given, float | int):
        size = float(given)
        wrong = "" if math.isfinite(size) and size else "the factor must be finite and not zero"
        return Conversion(size), wrong and f"data specification: units={{{name!r}: {given}}}: {wrong}."
    unit = name_and_unit(column)[1] if given is None else given
    if given is None and unit in ("", "1"):
        return Conversion(1.0), ""
    found = conversion(unit, signal.unit)
    if isinstance(found, Conversion):
        return found, ""
    remedy = "Name the column of that signal, correct the unit of one of them, or give the factor"
    return Conversion(1.0), (
        f"column {column!r} is in {unit!r}, {found} for {signal.label}. {remedy}: units={{{name!r}: FACTOR}} in the "
        "DataSpec."
    )


def _likely_unit(column: Array, signal: Signal) -> str:
    """Unit in which a column that leaves its signal's plausible range would keep to it; empty if there is none."""
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
        if max(-low, high) >= FILLED * limit and signal.lower <= low and high <= signal.upper:
            return unit
    return ""


# Wrapped angles


def _turn(signal: Signal) -> float | None:
    """A full turn in the signal's unit; None if the unit is none of an angle."""
    found = conversion("rev", signal.unit)
    angle = isinstance(found, Conversion) and signal.unit not in ("-", "1", "%", "ppm")
    return found.factor if isinstance(found, Conversion) and angle else None


@dataclass(frozen=True)
class Unwrapped:
    """An angle that counts on.

    Args:
        angle: Its samples ``(m,)``.
        jumps: Indices of the samples before which it jumped by whole turns as it was recorded.
        unclear: Indices of the samples before which so many were lost that nobody knows how many turns it made.
    """

    angle: Array
    jumps: NDArray[np.intp]
    unclear: NDArray[np.intp]


def unwrapped(t: Array, angle: Array, turn: float, max_gap: float, *, periodic: bool = True) -> Unwrapped:
    """The samples that are there of an angle, counted on.

    An angle is wrapped if it keeps within one turn and moves by more than half a turn between neighbouring samples;
    one that is not declared periodic must jump by about a full one. From one sample to the next it is taken to move by
    less than half a turn. Where samples are missing it may move by more at the speeds that it has: there the speeds
    before and after say how many turns it makes, if they agree.
    """
    step, none = np.diff(angle), np.zeros(0, dtype=np.intp)
    near = ~gaps(t, max_gap)
    large = near & (np.abs(step) > 0.5 * turn)
    full = large & (np.abs(np.abs(step) - turn) <= NEARLY * turn)
    if not (large if periodic else full).any() or np.ptp(angle) > SPAN * turn:
        return Unwrapped(angle, none, none)
    turns = np.where(near, -np.round(step / turn), 0.0)
    span, moved = np.diff(t), step + turn * turns
    usual = float(np.median(span))
    regular = near & (span <= HOLE * usual)
    speed = np.where(regular, moved / span, np.nan)
    unclear = []
    fastest = float(np.nanmax(np.abs(speed), initial=0.0))
    for k in np.flatnonzero(near & ~regular & (fastest * span > 0.5 * turn)):
        before, after = (
            speed[:k][np.isfinite(speed[:k])][-1:],
            speed[k + 1 :][np.isfinite(speed[k + 1 :])][:1],
        )
        sides = np.concatenate([before, after]) * span[k]  # the way at the speed before, and at that after
        turns[k] = np.round((sides.mean() - step[k]) / turn) if len(sides) else 0.0
        off = abs(step[k] + turn * turns[k] - sides.mean()) if len(sides) else math.inf
        if off + np.ptp(sides) > UNSURE * turn:
            unclear.append(int(k) + 1)
    counted = angle + turn * np.concatenate([[0.0], np.cumsum(turns)])
    return Unwrapped(counted, np.flatnonzero(turns) + 1, np.array(unclear, dtype=np.intp))


def folded(t: Array, angle: Array, turn: float, max_gap: float) -> tuple[int, NDArray[np.intp]] | None:
    """Into how many parts of a turn an angle is folded that begins anew after one, and the samples before which it
    jumps; None where it is not.

    Example:
        >>> t = 0.01 * np.arange(400)
        >>> folded(t, (2 * t) % np.pi, 2 * np.pi, 0.05)
        (2, array([158, 315]))
    """
    sizes, jumps = anew(t, angle, max_gap)
    span = float(np.ptp(angle)) if len(jumps) else 0.0
    for parts in PARTS:
        if (
            len(jumps)
            and (np.abs(sizes - turn / parts) <= LIKE * turn / parts).all()
            and span <= SPAN * turn / parts
        ):
            return parts, jumps
    return None


def anew(t: Array, x: Array, max_gap: float) -> tuple[Array, NDArray[np.intp]]:
    """By how much a signal ``(m,)`` jumps from one end of its range to the other against its motion before and after,
    that motion taken off, and the samples before which it does: there it begins anew. A machine that steps goes with
    its motion.
    """
    step, none = np.diff(x), (np.zeros(0), np.zeros(0, dtype=np.intp))
    if len(step) < 3 or not (span := float(np.ptp(x))) > 0:
        return none
    near = ~gaps(t, max_gap)
    inner = np.flatnonzero(near[1:-1] & near[:-2] & near[2:] & (np.abs(step[1:-1]) > 0.5 * span)) + 1
    before, jump, after = step[inner - 1], step[inner], step[inner + 1]
    on = (
        (before * jump < 0)
        & (after * jump < 0)
        & (np.maximum(np.abs(before), np.abs(after)) < NEARLY * np.abs(jump))
    )
    on &= np.abs(before - after) <= np.abs(before + after) / 2
    top, low = np.maximum(x[inner], x[inner + 1]), np.minimum(x[inner], x[inner + 1])
    on &= np.maximum(x.max() - top, low - x.min()) <= 0.75 * np.abs(before + after)  # from end to end
    return np.abs(jump[on] - (before[on] + after[on]) / 2), inner[on] + 1


def _overflow(t: Array, raw: Array, max_gap: float) -> tuple[int, NDArray[np.intp]] | None:
    """The bits of a counter that overflows, and the samples before which it does; None where it does not."""
    if not (raw == np.round(raw)).all():
        return None
    sizes, jumps = anew(t, raw, max_gap)
    for bits in BITS:
        if len(jumps) and (np.abs(sizes - 2.0**bits) <= LIKE * 2.0**bits).all() and np.ptp(raw) < 2.0**bits:
            return bits, jumps
    return None


def _folded(
    file: str, name: str, signal: Signal, t: Array, raw: Array, parts: int, jumps: NDArray[np.intp]
) -> Finding:
    """The finding of an angle as it was recorded ``raw`` ``(m,)`` that begins anew after a part of a turn."""
    k, count = int(jumps[0]), len(jumps)
    message = (
        f"column {name!r} jumps {count} time{'s' * (count > 1)} by about 1/{parts} of a turn against its motion "
        f"(first from {raw[k - 1]:.4g} to {raw[k]:.4g} {signal.unit} at {t[k]:.6g} s): an angle that begins anew after "
        f"each 1/{parts} of a turn, or a wrong unit. Record one that counts on, or unwrap it before: numpy.unwrap(..., "
        f"period={(_turn(signal) or 0.0) / parts:.6g})."
    )
    return Finding("wrapped", file, name, float(t[k]), count, message, refused=True)


def _overflowing(file: str, name: str, t: Array, raw: Array, bits: int, jumps: NDArray[np.intp]) -> Finding:
    """The finding of a counter that overflows."""
    k, count = int(jumps[0]), len(jumps)
    message = (
        f"column {name!r} jumps {count} time{'s' * (count > 1)} by about {2**bits} against its motion (first from "
        f"{raw[k - 1]:.10g} to {raw[k]:.10g} at {t[k]:.6g} s): a counter of {bits} bits that overflows. Record one "
        f"that counts on, or unwrap it before: numpy.unwrap(..., period={2**bits})."
    )
    return Finding("wrapped", file, name, float(t[k]), count, message, refused=True)


def outliers(column: Array) -> NDArray[np.intp] | None:
    """The few samples that are away from all others by ``OUTLYING`` times what these span; None without."""
    known = np.abs(column) <= ABSURD
    others, most = np.sort(column[known]), max(1, min(MOST_ODD, int(0.01 * known.sum())))
    best = None
    for low in range(most + 1):
        for high in range(most + 1 - low):
            rest = others[low : len(others) - high]
            if not (low or high) or len(rest) < MIN_SCORED or not (span := float(np.ptp(rest))) > 0:
                continue
            if (not low or rest[0] - others[low - 1] > OUTLYING * span) and (
                not high or others[len(others) - high] - rest[-1] > OUTLYING * span
            ):
                best = np.flatnonzero(known & ((column < rest[0]) | (column > rest[-1])))
    return best


def _outlying(
    file: str, name: str, signal: Signal, t: Array, column: Array, odd: NDArray[np.intp]
) -> Finding:
    """The finding of samples that are far from all others."""
    rest = np.delete(column, odd)
    message = (
        f"column {name!r} is {column[odd[0]]:.6g} {signal.unit} at {t[odd[0]]:.6g} s, far from all but {len(odd)} of "
        f"{len(t)} samples, which are within {np.nanmin(rest):.6g} to {np.nanmax(rest):.6g}. A code for a missing "
        "value, or a lost digit? Leave these cells blank, or delete the rows."
    )
    return Finding("outlier", file, name, float(t[odd[0]]), len(odd), message)


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


def _wrapped(file: str, name: str, signal: Signal, t: Array, raw: Array, found: Unwrapped) -> Finding:
    """The finding of an angle as it was recorded ``raw`` ``(m,)`` that jumps."""
    k, count = int(found.jumps[0]), len(found.jumps)
    what = (
        f"column {name!r} jumps {count} time{'s' * (count > 1)} by about a full turn (first from {raw[k - 1]:.4g} to "
        f"{raw[k]:.4g} {signal.unit} at {t[k]:.6g} s): a wrapped angle"
    )
    remedy = (
        f". {signal.name} is periodic, so the turns were added up and the angle counts on. An estimator or monitor "
        "that runs on the sensor itself needs an angle that counts on, too."
        + (
            f" Before {len(found.unclear)} samples (first at {t[found.unclear[0]]:.6g} s) so many are missing that "
            "nobody knows how many turns it made: the recording is cut there."
            if len(found.unclear)
            else ""
        )
        if signal.periodic
        else f", which no smooth motion explains. Declare Signal(..., periodic=True) for {signal.name} in the prior, "
        "and it is made to count on; or record an angle that does."
    )
    return Finding("wrapped", file, name, float(t[k]), count, what + remedy, refused=not signal.periodic)
