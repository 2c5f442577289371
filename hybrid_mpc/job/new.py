"""A scenario to begin with, written from a recording; what only its user knows is marked TODO."""

from __future__ import annotations

import keyword
import math
import re
import tokenize
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.excitation import check_excitation
from hybrid_mpc.data.files import Columns, Source, name_and_unit, opened
from hybrid_mpc.data.names import FIELD, Said, said_by
from hybrid_mpc.data.recording import MIN_SCORED, read_recording
from hybrid_mpc.data.trajectories import load_trajectories
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import write_text
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.machine.units import per_second
from hybrid_mpc.records import shown
from hybrid_mpc.rules import LARGEST, column_problem

Array = NDArray[np.float64]
MOST_RECORDED = 1e-3 * LARGEST
"""Largest number of a signal: its range is wider than what was recorded."""
MARK = "TODO"
"""What stands before everything that is left to decide."""
ACTING = "what only acts: new ... --disturbance-column NAME"
"""What to do about a column that is no output although it is measured."""
HELD = 0.5
"""Share of samples equal to the one before from which on a column looks commanded."""
EVEN = 0.2
"""Share by which the distances of time stamps may spread."""
MOST = 2000
"""Most samples from which a first model is taken."""
BETTER = 0.8
"""Error of two states over that of one below which two are taken."""
FEWEST = 20
"""Fewest rows of a recording that tell anything."""
COUNTED = (
    "it counts samples and stands for the time, as no column says that it is: write the seconds of one count into "
    "units, and all lengths below with it"
)
"""What is not sure of a time that is a count."""
UNNAMED = "it rises evenly and no column says that it is the time; is it, in seconds?"
NO_UNIT = "is it in seconds? Its name names no unit"
SMOOTHED = 7
"""Fewest sampling times that are smoothed over: a polynomial of order 4 needs six samples, and stamps are rounded."""
LONGEST_NAME = 40
"""Most characters of a signal's name."""
ANGLES = ("rad", "mrad", "deg", "°", "rev", "turn")
"""Units in which a column may be an angle that jumps by full turns."""
USED = frozenset(("Prior", "Signal", "Parameter", "Scenario", "DataSpec", "OperatingPoint", "OCP"))
"""Names that the written file uses."""
EPOCHS = ((1e18, 1e-9), (1e15, 1e-6), (1e12, 1e-3), (1e9, 1.0))
"""What a time since 1970 is at least since 2001, and its unit [s]; after 2130 it is none."""
UNIT = re.compile(r"[\w/^*·.%°²³µμΩ() -]{1,20}")
"""How a unit is written; anything else behind a name is none."""


@dataclass(frozen=True)
class Column:
    """A column of a recording: full name, name and unit as the header has them, numbers ``(m,)``.

    ``periodic`` is an angle that jumps by full turns where it is recorded; its numbers count on.
    """

    full: str
    name: str
    unit: str
    values: Array
    periodic: bool = False

    @property
    def span(self) -> tuple[float, float]:
        """Smallest and largest number."""
        return float(np.nanmin(self.values)), float(np.nanmax(self.values))

    @property
    def identifier(self) -> str:
        """The name as Python can write it after a dot."""
        text = _ascii(self.name)[:LONGEST_NAME].strip("_") or "signal"
        return f"c_{text}" if text[0].isdigit() or keyword.iskeyword(text) else text

    @property
    def signal(self) -> Signal:
        """The signal, with a range twice as wide again as what was recorded, on either side."""
        if self.periodic:
            return Signal(self.identifier, self.unit or "-", periodic=True)
        low, high = self.span
        span = high - low
        return Signal(
            self.identifier,
            self.unit or "-",
            float(_near(low - span, span / 20)),
            float(_near(high + span, span / 20)),
        )


@dataclass(frozen=True)
class Draft:
    """What a recording shows: its time, what looks commanded and what measured, and what is neither.

    ``period`` is the sampling time [s], ``seconds`` what one in the column of the time is [s]; ``time`` is None where
    no column may be one. ``doubt`` says what is not sure of the time, ``left_out`` by column why it is no signal.
    ``disturbances`` are measured and act on the machine, but nobody commands them; no number tells them from outputs,
    so they are named or none.
    """

    time: Column | None
    period: float
    inputs: tuple[Column, ...]
    outputs: tuple[Column, ...]
    left_out: Mapping[str, str]
    disturbances: tuple[Column, ...] = ()
    seconds: float = 1.0
    doubt: str = ""

    @property
    def drives(self) -> tuple[Column, ...]:
        """All that acts on the machine."""
        return (*self.inputs, *self.disturbances)

    @property
    def signals(self) -> tuple[Column, ...]:
        """All signals."""
        return (*self.drives, *self.outputs)

    @property
    def length(self) -> float:
        """From the first to the last sample [s]."""
        if self.time is None or self.time.values.size == 1:
            return self.period * len(self.outputs[0].values)
        return self.seconds * float(np.ptp(self.time.values))

    @property
    def units(self) -> dict[str, float]:
        """Factors that the DataSpec names: of a time that is not in seconds, and of units that no signal has."""
        named = self.time is not None and (self.seconds != 1.0 or self.doubt == COUNTED)
        time = {self.time.full: self.seconds} if named and self.time else {}
        return time | {
            c.full: 1.0 for c in self.signals if not c.unit and name_and_unit(c.full)[1] not in ("", "1")
        }

    def data(self, smoothing: float, warm_up: float) -> DataSpec:
        """How the recording is read; ``smoothing`` and ``warm_up`` [s]."""
        return DataSpec(
            self.time.full if self.time else float(_rounded(self.period)),
            tuple(c.full for c in self.inputs), tuple(c.full for c in self.outputs),
            dt=float(_rounded(self.period)), max_gap=float(_rounded(5 * self.period)),
            smoothing=float(_rounded(smoothing)), warm_up=float(_rounded(warm_up)), units=self.units,
            disturbances=tuple(c.full for c in self.disturbances),
        )  # fmt: skip


@dataclass(frozen=True)
class Roles:
    """Signals by their role, as reading asks for them: a state an output, and a second one where it has a speed."""

    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    disturbances: tuple[Signal, ...]

    @classmethod
    def of(cls, draft: Draft, names: Sequence[str] = (), speeds: Sequence[Signal] = ()) -> Roles:
        """Those of a draft; ``names`` of the outputs, by default their own, and ``speeds`` of some of them."""
        inputs, outputs, disturbances = (
            tuple(c.signal for c in group) for group in (draft.inputs, draft.outputs, draft.disturbances)
        )
        if names:
            outputs = tuple(replace(s, name=name) for s, name in zip(outputs, names, strict=True))
        return cls((*outputs, *speeds), inputs, outputs, disturbances)


@dataclass(frozen=True)
class Lag:
    """A first linear model of one output: ``states`` 1 or 2, its time constant [s], damping, gains, offset."""

    states: int
    seconds: float
    damping: float
    gains: tuple[float, ...]
    offset: float


def write_scenario(
    path: Path, data: Path, inputs: Sequence[str] = (), outputs: Sequence[str] = (), time: str = "",
    disturbances: Sequence[str] = (),
) -> Draft:  # fmt: skip
    """Write a scenario for a recording; returned is what it was made from.

    Args:
        path: Python file to make; there must be none.
        data: The recording (CSV, npz, mat).
        inputs: Columns of the inputs. Default: those that are held from one sample to the next.
        outputs: Columns of the outputs. Default: all others that move.
        time: Column of the time. Default: one whose name says so, or else one that rises evenly.
        disturbances: Columns of measured disturbances. Default: none.

    Raises:
        InputError: If the file is there, the recording is bad or too short, shows no input or no output, or has a time
            that cannot be used: with the reader's reason.

    Example:
        ``write_scenario(Path("my_machine.py"), Path("monday.csv"))``
    """
    if path.suffix != ".py":
        raise InputError(f"{path}: a scenario is a Python file; give a name that ends with .py")
    if path.exists():
        raise InputError(f"{path} is there already; give another name, or remove it")
    draft = drafted(opened(data), inputs, outputs, time, disturbances)
    write_text(path, scenario_text(path, data, draft))
    return draft


def left_to_decide(path: Path) -> list[str]:
    r"""Lines of a scenario's file whose comment begins with the mark, with their numbers; texts do not count.

    Raises:
        InputError: If the file is no text of Python.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "a.py"
        ...     _ = path.write_text("x = 1\ny = 2  # TODO: is it?\n")
        ...     left_to_decide(path)
        ['line 2: is it?']
    """
    found, mark = [], f"# {MARK}"
    try:
        with path.open("rb") as file:
            for token in tokenize.tokenize(file.readline):
                if token.type == tokenize.COMMENT and token.string.startswith(mark):
                    found.append(f"line {token.start[0]}: {token.string.removeprefix(mark).lstrip(': ')}")
    except (SyntaxError, UnicodeDecodeError, tokenize.TokenError) as error:
        raise InputError(f"{path}: cannot be read as Python ({error}). Save it as UTF-8 text.") from error
    return found


def drafted(
    source: Source, inputs: Sequence[str], outputs: Sequence[str], time: str, disturbances: Sequence[str] = ()
) -> Draft:
    """Roles of a recording's columns: as they are given, or as their names and numbers look."""
    columns, left_out = _columns(source)

    def named(names: Sequence[str]) -> tuple[Column, ...]:
        found = list(map(source.find, names))
        refuse(
            [
                f"{source.path}: column {shown(name)} is no signal: {left_out[name]}"
                for name in found
                if name in left_out
            ]
        )
        return tuple(columns[name] for name in found)

    given = named(inputs), named(outputs), named(disturbances)
    chosen = {c.full for group in given for c in group}
    clock = _time(source, columns, left_out, source.find(time) if time else "", chosen)
    free = []
    for full, column in columns.items():
        if full in chosen or (clock.column is not None and full == clock.column.full):
            continue
        if reason := _no_signal(column):
            left_out[full] = reason
        else:
            free.append(column)
    while True:
        held = tuple(c for c in free if _is_held(c.values))
        whole = [c for c in free if np.isfinite(c.values).all()] or free  # an input is known in every row
        u = given[0] or held or tuple(whole[: 1 if len(free) > 1 or given[1] else 0])
        y = given[1] or tuple(c for c in free if c not in u)
        if not u or not y:
            reasons = "".join(f"\n  {shown(name)}: {reason}" for name, reason in left_out.items())
            raise InputError(
                f"{source.path}: no column is left for {'an output' if u else 'an input'}; it has "
                f"{', '.join(source.header)}. Say which is which: --input-column, --output-column, --disturbance-column"
                f".{source.note}{f' No signals are:{reasons}' if reasons else ''}"
            )
        draft = _counting_on(
            source, Draft(clock.column, clock.period, u, y, left_out, given[2], clock.seconds, clock.doubt)
        )
        still = [full for full in _at_rest(source.path, draft) if full not in chosen]
        if not still:
            break
        free = [c for c in free if c.full not in still]
        left_out |= dict.fromkeys(still, "it does not move in the part of the recording that trains")
    return replace(
        draft, left_out=left_out | {c.full: "no role was given to it" for c in free if c not in (*u, *y)}
    )


def _counting_on(source: Source, draft: Draft) -> Draft:
    """The draft whose angles count on where they are recorded wrapped; the recording can be read as it says."""
    trial = replace(draft, outputs=tuple(replace(c, periodic=c.unit in ANGLES) for c in draft.outputs))
    recording = read_recording(
        source.path, Roles.of(trial), trial.data(SMOOTHED * draft.period, 2 * draft.period)
    )
    wrapped = {finding.channel for finding in recording.findings if finding.kind == "wrapped"}
    return replace(
        draft,
        outputs=tuple(
            replace(c, periodic=True, values=values) if c.full in wrapped else c
            for c, values in zip(draft.outputs, recording.y.T, strict=True)
        ),
    )


def _at_rest(path: Path, draft: Draft) -> list[str]:
    """Inputs and outputs that do not move in what trains, by their full names."""
    roles = Roles.of(draft)
    dataset = load_trajectories(
        [path], roles, draft.data(SMOOTHED * draft.period, 2 * draft.period), needed=("train",)
    )
    found = []
    for key, columns, signals in (("u", draft.inputs, roles.inputs), ("y", draft.outputs, roles.outputs)):
        for j, (column, signal) in enumerate(zip(columns, signals, strict=True)):
            # as input and as output: what else there is does not count
            train = [
                replace(piece, u=part, y=part, censored=np.zeros(part.shape, dtype=np.int8))
                for piece in dataset.by_role("train")
                for part in [getattr(piece, key)[:, [j]]]
            ]
            try:
                check_excitation(train, inputs=(signal,), outputs=(signal,))
            except InputError:
                found.append(column.full)
    return found


def _columns(source: Source) -> tuple[dict[str, Column], dict[str, str]]:
    """Columns whose numbers move, and why the others are no signals, by full name."""
    found: dict[str, Column] = {}
    read, left_out = _read(source)
    lengths = [
        len(one.values)
        for full, one in sorted(read.items(), key=lambda item: said_by(item[0]).kind != "time")
        if len(one.values) >= FEWEST
    ]
    usual = Counter(lengths).most_common(1)[0][0] if lengths else 0
    for full, one in read.items():
        values = one.values[:, 0]
        known = values[np.isfinite(values)]
        if problem := column_problem(full):
            left_out[full] = problem
        elif full in one.faults:
            left_out[full] = one.faults[full]
        elif len(values) not in (1, usual) and usual:
            left_out[full] = f"it has {len(values)} values, the others have {usual}"
        elif not len(known):
            left_out[full] = "it has no number"
        elif len(known) < FEWEST:
            left_out[full] = f"it has {len(known)} number{'s' * (len(known) > 1)}, fewer than {FEWEST}"
        elif known.min() == known.max():
            left_out[full] = f"it is {known[0]:g} throughout"
        elif np.abs(known).max() > MOST_RECORDED:
            left_out[full] = f"it reaches {np.abs(known).max():g}; no machine does"
        else:
            field = FIELD.fullmatch(full)
            name, unit = name_and_unit(field[1] if field else full)
            unit = unit if UNIT.fullmatch(unit) and unit.isprintable() and unit != "1" else ""
            found[full] = Column(full, name, unit, values)
    if not found:
        reasons = "".join(f"\n  {shown(name)}: {reason}" for name, reason in left_out.items())
        raise InputError(
            f"{source.path}: no column has {FEWEST} numbers that move; give a recording in which the machine moves."
            f"{source.note}{reasons}"
        )
    return found, left_out


def _read(source: Source) -> tuple[dict[str, Columns], dict[str, str]]:
    """Each column, where blank cells are none; and why the others cannot be read, by full name."""
    read: dict[str, Columns] = {}
    counts = Counter(source.header)
    reasons = {
        name: f"the name stands {count} times in the header; rename all but one"
        for name, count in counts.items()
        if count > 1
    }
    names = [name for name, count in counts.items() if count == 1]
    if source.path.suffix.lower() not in (".npz", ".mat"):
        whole = source.read(None, names, names) if names else None
        if whole is not None:
            refuse([f"{source.path}: {fault}" for name, fault in whole.faults.items() if not name])
            for j, name in enumerate(names):
                read[name] = replace(whole, values=whole.values[:, j : j + 1])
        return read, reasons
    for name in names:  # vectors may be of any length and kind
        try:
            read[name] = source.read(None, [name], [name])
        except InputError as error:
            reasons[name] = str(error).removeprefix(f"{source.path}: ")
    return read, reasons


# Time


class Clock(NamedTuple):
    """The time: its column, None for a sampling time alone; the period and the column's unit [s]; what is not sure."""

    column: Column | None
    period: float
    seconds: float = 1.0
    doubt: str = ""


def _time(
    source: Source, columns: Mapping[str, Column], left_out: dict[str, str], asked: str, chosen: set[str]
) -> Clock:
    """The column of the time.

    A name that says time decides; then numbers that rise evenly; a count of samples only where there is nothing else.

    Raises:
        InputError: If a column says that it is the time and cannot be used; with the reason.
    """
    names = [asked] if asked else [full for full in dict.fromkeys(source.header) if full not in chosen]
    said = {full: said_by(full) for full in names}
    troubles: dict[str, str] = {}
    for perhaps in (False, True):
        for full in names:
            column, one = columns.get(full), said[full]
            kinds = ("time", "step") if perhaps else ("time",)
            if not asked and (one.kind not in kinds or one.perhaps > perhaps):
                continue
            if perhaps and (column is None or not _mostly_even(column.values)):
                continue
            clock = _clock(source, full, one)
            if isinstance(clock, Clock):
                left_out.pop(full, None)
                left_out |= {
                    other: f"{reason}; {shown(full)} is the time" for other, reason in troubles.items()
                }
                known = one.seconds is not None or clock.seconds != 1.0 or not one.kind
                return clock if known else clock._replace(doubt=NO_UNIT)
            troubles[full] = clock
        lost = [name for name in source.unread if said_by(name).kind == "time"]
        if troubles or lost:
            role = "was named as" if asked else "says that it is"
            many = troubles | dict.fromkeys(lost, f"it is of a kind that is not read.{source.note}")
            refuse([
                f"{source.path}: column {shown(name)} {role} the time and cannot be used: {trouble}"
                for name, trouble in many.items()
            ])  # fmt: skip
    for full in names:
        if said[full].kind == "step" and (step := _sampling_time(source, full, said[full])):
            if step.column is not None:
                left_out.pop(full, None)
            return step
    for counts in (False, True):
        for full in names:
            column, one = columns.get(full), said[full]
            if column is None or (column.unit and one.seconds is None) or not _rises(column.values):
                continue
            clock = _clock(source, full, one)
            if isinstance(clock, Clock) and counts is (one.kind == "count" or _is_count(column.values)):
                return clock._replace(doubt=COUNTED if counts else UNNAMED)
    return Clock(None, 1.0, doubt="the sampling time [s]; no column of the recording looks like time")


def _clock(source: Source, full: str, said: Said) -> Clock | str:
    """A column as the time; or what is wrong with it."""
    if source.header.count(full) > 1:
        return "its name stands more than once in the header. Rename all but one"
    if said.unit and said.seconds is None:
        return f"its unit {said.unit!r} is none of time. Write seconds, or name the unit, e.g. 'time [ms]'"
    try:
        columns = source.read(None, [full], ())
    except InputError as error:
        return str(error).removeprefix(f"{source.path}: ")
    if columns.faults:
        return "; ".join(columns.problems)
    t = columns.values[:, 0]
    if not len(t):
        return "it has no number"
    seconds = said.seconds or 1.0
    if not said.unit and said.kind:
        epoch = next(((least, unit) for least, unit in EPOCHS if least <= t[0] < 5 * least), None)
        seconds = epoch[1] if epoch else 1.0
        if said.is_date and epoch is None:
            return "what the numbers of its dates count is not known. Write seconds since the beginning"
    column = Column(full, *name_and_unit(full), t)
    if len(t) == 1:
        fine = 0 < t[0] < math.inf
        return (
            Clock(column, seconds * float(t[0]), seconds)
            if fine
            else f"the sampling time {t[0]:g} is not positive"
        )
    if np.abs(t).max() * seconds > MOST_RECORDED:
        return f"it reaches {np.abs(t).max():g}"
    if disorder := columns.disorder(seconds * t, f"column {shown(full)}"):
        return disorder
    return Clock(column, seconds * float(np.median(np.diff(t))), seconds)


def _sampling_time(source: Source, full: str, said: Said) -> Clock | None:
    """The sampling time that a column names: one number, or the same one in every row."""
    clock = _clock(source, full, said)
    if isinstance(clock, Clock):
        return clock._replace(doubt="" if said.unit else NO_UNIT)
    try:
        values = source.read(None, [full], ()).values[:, 0]
    except InputError:
        return None
    if not (len(values) and 0 < values[0] < math.inf and (values == values[0]).all()):
        return None
    if said.unit and said.seconds is None:
        return None
    seconds = said.seconds or 1.0
    return Clock(None, seconds * float(values[0]), doubt=f"the sampling time [s], by {shown(full)}")


def _no_signal(column: Column) -> str:
    """Why a column is no signal although its numbers move; empty if it may be one."""
    said = said_by(column.full)
    even = _mostly_even(column.values)
    if said.kind == "time" and (even or not said.perhaps):
        return "its name says time"
    if said.kind == "step":
        return "its name says sampling time"
    if said.kind == "count" and (not said.perhaps or (even and _is_count(column.values))):
        return "it counts samples" if column.name else "it has no name"
    return "it rises evenly, as a time does" if _rises(column.values) else ""


def _rises(values: Array) -> bool:
    """Whether numbers rise evenly, as time does."""
    return bool(np.isfinite(values).all() and (np.diff(values) > 0).all()) and _mostly_even(values)


def _mostly_even(values: Array) -> bool:
    """Whether most numbers rise evenly: time that may repeat, begin again or lack some."""
    steps = np.diff(values[np.isfinite(values)])
    middle = float(np.median(steps)) if len(steps) else 0.0
    return middle > 0 and bool(np.quantile(np.abs(steps / middle - 1), 0.9) < EVEN)


def _is_count(values: Array) -> bool:
    """Whether numbers are whole and mostly follow each other at one distance."""
    known = values[np.isfinite(values)]
    steps = np.diff(known)
    return bool((known == np.round(known)).all() and (steps == np.median(steps)).mean() >= 0.9)


def _is_held(values: Array) -> bool:
    known = values[np.isfinite(values)]
    return bool((np.diff(known) == 0).mean() >= HELD)


def first_model(draft: Draft, output: Column) -> Lag:
    """A lag of one or two states whose free run is nearest to an output."""
    every = np.column_stack([output.values, *(c.values for c in draft.drives)])
    there = np.flatnonzero(np.isfinite(every).all(axis=1))
    # a gain of zero would be no input at all
    slight = tuple(float(0.1 * np.ptp(output.span) / np.ptp(c.span)) for c in draft.drives)
    level = sum(gain * float(np.nanmean(c.values)) for gain, c in zip(slight, draft.drives, strict=True))
    default = Lag(1, 20 * draft.period, 1.0, slight, float(np.nanmean(output.values)) - level)
    if len(there) < FEWEST:
        return default
    every = every[there]
    # about their means and by their spans: levels and units do not enter
    middle, size = every.mean(axis=0), np.ptp(every, axis=0)
    size[size == 0] = 1.0
    if not (np.isfinite(middle).all() and np.isfinite(size).all()):
        return default
    stride = max(1, len(every) // MOST)
    y, u = np.split(((every - middle) / size)[::stride], [1], axis=1)
    y, per = y[:, 0], size[0] / size[1:]
    dt = stride * draft.period * float(np.median(np.diff(there)))
    best: tuple[float, Lag] | None = None
    for order in (1, 2):
        rows = [y[order - 1 - i : len(y) - 1 - i] for i in range(order)]
        a = np.column_stack([*rows, u[order - 1 : -1], np.ones(len(y) - order)])
        theta = np.linalg.lstsq(a, y[order:], rcond=None)[0]
        poles = np.roots(np.concatenate([[1.0], -theta[:order]]))
        if not (np.isfinite(theta).all() and (np.abs(poles) < 1).all() and (np.abs(poles) > 0.05).all()):
            continue
        if order == 1 and not poles[0].real > 0:
            continue
        run = y[:order].tolist()
        for k in range(order, len(y)):
            run.append(float(theta @ np.concatenate([run[: -order - 1 : -1], u[k - 1], [1.0]])))
        error = float(np.sqrt(np.mean((np.array(run) - y) ** 2)))
        rates = np.log(poles.astype(complex)) / dt
        speed = float(np.sqrt(np.abs(np.prod(rates)))) if order == 2 else float(np.abs(rates[0]))
        damping = float(-rates.real.sum() / (2 * speed)) if order == 2 else 1.0
        still = 1.0 - theta[:order].sum()
        if not (still > 0 and 0 < speed < math.inf):
            continue
        gains = per * theta[order:-1] / still
        offset = float(middle[0] + size[0] * theta[-1] / still - gains @ middle[1:])
        if not (np.isfinite(gains).all() and (gains != 0).all() and math.isfinite(offset)):
            continue
        lag = Lag(order, 1 / speed, damping, tuple(gains.tolist()), offset)
        if best is None or error < BETTER * best[0]:
            best = error, lag
    return default if best is None else best[1]


# What is written


def _text(text: str) -> str:
    """A string as Python writes it: everything that a recording or a path says stands in these, or in comments."""
    written = repr(text)
    return f'"{written[1:-1]}"' if not {'"', "'"} & set(text) else written


def printable(text: str) -> str:
    r"""A text that cannot end its line, as a comment or a terminal takes it: unseen characters are escaped.

    Example:
        >>> print(printable("u\n1, größe"))
        u\n1, größe
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _ascii(text: str) -> str:
    """Letters, digits and underscores alone: letters without their accents, anything else as an underscore."""
    bare = text.replace("ß", "ss")
    bare = "".join(c for c in unicodedata.normalize("NFKD", bare) if not unicodedata.combining(c))
    return re.sub(r"\W+", "_", bare, flags=re.ASCII).strip("_")


def _rounded(value: float, digits: int = 3) -> str:
    return f"{float(f'{value:.{digits}g}') + 0.0!r}"


def _near(value: float, step: float) -> str:
    """A number with the digits that tell it from one that is ``step`` away."""
    if not (math.isfinite(value) and 0 < step < math.inf):
        return repr(float(value) + 0.0)
    return repr(round(float(value), -math.floor(math.log10(step))) + 0.0)


def _signal(column: Column, name: str) -> tuple[str, str]:
    """A Signal as it is written, and what stands behind it."""
    low, high = column.span
    recorded = f"recorded: {_near(low, (high - low) / 2000)} to {_near(high, (high - low) / 2000)}"
    unit = f"unit by the header; {recorded}" if column.unit else f"{MARK}: its unit; {recorded}"
    signal = column.signal
    ends = "periodic=True" if column.periodic else f"{signal.lower!r}, {signal.upper!r}"
    return f"Signal({_text(name)}, {_text(column.unit or '-')}, {ends})", unit


def _names(columns: Sequence[Column], taken: set[str]) -> list[str]:
    names = []
    for column in columns:
        name = _unused(column.identifier, taken)
        taken.add(name)
        names.append(name)
    return names


def _unused(name: str, taken: Iterable[str]) -> str:
    """A name that is not taken: the given one, or with a number behind it."""
    there, given, k = set(taken), name, 2
    while name in there:
        name, k = f"{given}_{k}", k + 1
    return name


def scenario_text(path: Path, data: Path, draft: Draft) -> str:
    """The file: signals, a first prior of lags, and how the recording is read.

    Raises:
        InputError: If the recording cannot be read with them, with the reader's reason.
    """
    y_names = _names(draft.outputs, set())
    u_names, w_names = _names(draft.inputs, set()), _names(draft.disturbances, set())
    drives = [*(("u", n) for n in u_names), *(("w", n) for n in w_names)]
    lags = [first_model(draft, column) for column in draft.outputs]
    kind = "".join(part.capitalize() for part in _ascii(path.stem).split("_")) or "Machine"
    kind = f"Machine{kind}" if kind[0].isdigit() or keyword.iskeyword(kind) or kind in USED else kind
    rates, parameters, steady = [], list[tuple[str, float, str, float, float, str]](), list[str]()
    gains, offsets = list[list[float]](), list[float]()
    taken, lag_names = set[str](), list[tuple[str, str]]()

    def parameter(name: str, value: float, unit: str, low: float, high: float, text: str) -> str:
        name = _unused(name, taken)
        taken.add(name)
        parameters.append((name, min(max(value, low), high), unit, low, high, text))
        return f"p.{name}"

    speeds: dict[str, tuple[str, Signal]] = {}  # a second state of an output: its name and itself
    for name, column, lag in zip(y_names, draft.outputs, lags, strict=True):
        unit = column.unit or "-"
        span = float(np.ptp(column.span))
        low, high = column.span[0] - span, column.span[1] + span
        # what the drives make of the output at their middle; what they leave of it may lie far from all that it was
        made = sum(
            gain * float(np.nanmedian(c.values)) for gain, c in zip(lag.gains, draft.drives, strict=True)
        )
        middle = min(max(lag.offset + made, low), high) - made
        low, high = min(low, low - made, middle), max(high, high - made, middle)
        rest = _near(low, span / 20), _near(middle, span / 500), _near(high, span / 20)
        seconds = float(_rounded(lag.seconds))
        constant = parameter(
            f"T_{name}",
            seconds,
            "s",
            float(_rounded(seconds / 20)),
            float(_rounded(seconds * 20)),
            "time constant",
        )
        damping = ""
        if lag.states == 2:
            bounded = float(_rounded(min(max(lag.damping, 0.01), 5.0)))
            damping = parameter(f"D_{name}", bounded, "-", 0.0, 10.0, "damping")
        lag_names.append((constant, damping))
        low, middle, high = map(float, rest)
        towards = [parameter(f"rest_{name}", middle, unit, low, high, "value without inputs")]
        offsets.append(parameters[-1][1])
        gains.append([])
        for (kind_of, drive), source, gain in zip(drives, draft.drives, lag.gains, strict=True):
            reach = float(_rounded(min(10 * max(abs(gain), span / float(np.ptp(source.span))), LARGEST)))
            per = f"{unit}/({source.unit})" if source.unit and source.unit != "-" else unit
            # rounded by what it makes of the output at the largest input
            value = float(_near(gain, span / 500 / max(map(abs, source.span)))) or float(_rounded(gain))
            towards.append(
                f"{parameter(f'k_{name}_{drive}', value, per, -reach, reach, f'gain from {drive}')} * {kind_of}.{drive}"
            )
            gains[-1].append(parameters[-1][1])
        steady.append(f"{name}_steady = {' + '.join(towards)}")
        if lag.states == 1:
            rates.append((f"({name}_steady - x.{name}) / {constant}", "a lag of first order"))
            continue
        steps = np.diff(column.values) / draft.period
        rms = float(np.sqrt(np.nanmean(steps**2))) if np.isfinite(steps).any() else 0.0
        # refused are speeds whose rms is beyond: a sensor's noise, differentiated, is within
        fast = float(_rounded(max(10 * span / lag.seconds, 3 * rms), 2))
        speed = _unused(f"{name}_rate", {*y_names, *(one for one, _ in speeds.values())})
        speeds[name] = speed, Signal(speed, per_second(unit), -fast, fast)
        rates.append((f"x.{speed}", f"exact: the rate of {name}"))
    states = [_signal(column, name) for name, column in zip(y_names, draft.outputs, strict=True)]
    for name, (constant, damping) in zip(y_names, lag_names, strict=True):
        if damping:
            speed, signal = speeds[name]
            ends = f"{signal.lower!r}, {signal.upper!r}"
            states.append((f"Signal({_text(speed)}, {_text(signal.unit)}, {ends})", "not measured"))
            pull = f"({name}_steady - x.{name}) / {constant}**2"
            rates.append((f"{pull} - 2 * {damping} / {constant} * x.{speed}", "second order"))
    corrected = [n for n in y_names if n not in speeds] + [speed for speed, _ in speeds.values()]
    slowest = max(lag.seconds for lag in lags)
    dt, length = draft.period, draft.length
    # a fifth of the recording validates and a fifth tests: each must hold a warm-up and what is scored
    smoothing = max(SMOOTHED * dt, min(10 * dt, length / 40))
    warm = max(
        2 * dt, min(max(10 * dt, slowest), length / 10, length / 5 - smoothing - (MIN_SCORED + 2) * dt)
    )
    spec = draft.data(smoothing, warm)
    # what is refused of the recording as the file reads it is refused here, by its reason
    roles = Roles.of(draft, y_names, [signal for _, signal in speeds.values()])
    train = load_trajectories([data], roles, spec).by_role("train")
    check_excitation(train, inputs=roles.inputs, outputs=roles.outputs)
    x0, u0, w0 = _first_rest(draft, np.array(gains), np.array(offsets))
    still = [*(_near(v, float(np.ptp(c.span)) / 1e4) for v, c in zip(x0, draft.outputs, strict=True))]
    point = f"x={_tuple([*still, *['0.0'] * (len(states) - len(still))])}, u={_tuple(map(repr, u0))}"
    point += f", w={_tuple(map(repr, w0))}" if w_names else ""
    title = printable(path.stem)
    lines = [
        _text(
            f"{title}: written from {printable(data.name)} by hybrid-mpc new. Lines marked {MARK} are yours to decide."
        ),
        "",
        "from hybrid_mpc import OCP, DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal",
        "",
        "",
        f"class {kind}(Prior):",
        '    """A first prior: each output is a lag of all that acts."""',
        "",
        f"    # {MARK}: write the machine's own equations in xdot; its states need not be measured",
        "    states = (",
        *(f"        {text},  # {note}" for text, note in states),
        "    )",
        "    inputs = (",
        *(
            f"        {text},  # {note}"
            for text, note in (_signal(c, n) for c, n in zip(draft.inputs, u_names, strict=True))
        ),
        "    )",
        f"    outputs = states[:{len(y_names)}]",
        *(["    disturbances = ("] if w_names else []),
        *(
            f"        {text},  # {note}"
            for text, note in (_signal(c, n) for c, n in zip(draft.disturbances, w_names, strict=True))
        ),
        *(["    )"] if w_names else []),
        "    parameters = (  # name, value, unit, bounds of the fit",
        *(
            f"        Parameter({_text(n)}, {v!r}, {_text(unit)}, {low!r}, {high!r}, {_text(text)}),"
            for n, v, unit, low, high, text in parameters
        ),
        "    )",
        f"    corrects = {_tuple(map(_text, corrected))}",
        f"    # {MARK}: where the machine works; your own equations rest elsewhere: see check",
        f"    # operating_point = OperatingPoint({point})",
        f"    # {MARK}: balances(self, x, u, w, p), if something is stored: energy, mass, heat",
        "",
        "    def xdot(self, x, u, w, p):",
        *(f"        {text}" for text in steady),
        "        return (",
        *(f"            {text},  # {note}" for text, note in rates),
        "        )",
        "",
        "",
        "scenario = Scenario(",
        f"    {_text(_ascii(path.stem) or 'machine')},",
        f"    {_text(title)},  # {MARK}: a title",
        f'    "",  # {MARK}: a few words for the report',
        f"    prior={kind},",
        "    data=DataSpec(",
        f"        {_text(spec.time) if isinstance(spec.time, str) else repr(spec.time)},"
        + (f"  # {MARK}: {printable(draft.doubt)}" if draft.doubt else ""),
        f"        {_tuple(map(_text, spec.inputs))},  # {MARK}: are these commanded?",
        f"        {_tuple(map(_text, spec.outputs))},  # {MARK}: does the machine move these? {ACTING}",
        *(
            f"        # {MARK}: not used: {printable(name)} ({printable(reason)})"
            for name, reason in draft.left_out.items()
        ),
        f"        dt={spec.dt!r},  # s, as it was sampled; a tenth of the fastest motion is enough",
        f"        max_gap={spec.max_gap!r},",
        f"        smoothing={spec.smoothing!r},",
        f"        warm_up={spec.warm_up!r},  # s of the past that start a free run",
        *([f"        disturbances={_tuple(map(_text, spec.disturbances))},"] if w_names else []),
        *(
            [f"        units={{{', '.join(f'{_text(n)}: {f!r}' for n, f in spec.units.items())}}},"]
            if spec.units
            else []
        ),
        "    ),",
        *_first_control(draft, len(states), min(max(round(2 * slowest / dt), 20), 100)),
        ")",
        "",
    ]
    return "\n".join(line.rstrip() for line in lines)


def _first_rest(draft: Draft, gains: Array, offsets: Array) -> tuple[list[float], list[float], list[float]]:
    """Outputs, inputs and disturbances at which the lags rest: as near to the recording's middle as they can."""
    n_u = len(draft.inputs)
    y, drives = (np.array([np.nanmedian(c.values) for c in cs]) for cs in (draft.outputs, draft.drives))
    missing = y - offsets - gains @ drives
    sizes = np.array([np.ptp(c.span) for c in (*draft.outputs, *draft.drives)])
    per_y, per_u = sizes[: len(y)], sizes[len(y) : len(y) + n_u]
    # in shares of what was recorded: units do not enter
    drives[:n_u] += per_u * (np.linalg.pinv(gains[:, :n_u] * per_u / per_y[:, None]) @ (missing / per_y))
    held = [
        float(_near(min(max(v, c.span[0]), c.span[1]), np.ptp(c.span) / 500))
        for v, c in zip(drives, draft.drives, strict=True)
    ]
    return (offsets + gains @ np.array(held)).tolist(), held[:n_u], held[n_u:]


def _first_control(draft: Draft, n_x: int, horizon: int) -> list[str]:
    """A control problem for a first loop, commented out: what only the user knows is marked.

    Outputs are weighed by one over the square of a twentieth of what was recorded, changes of inputs of a tenth
    (Bryson's rule); inputs stay within what was recorded.
    """

    def each(columns: Sequence[Column], share: float) -> str:
        return _tuple(_rounded(share * float(np.ptp(c.span))) + "**-2" for c in columns)

    low, high = (_tuple(_near(c.span[i], np.ptp(c.span) / 500) for c in draft.inputs) for i in (0, 1))
    free = f"q={_tuple(['0.0'] * n_x)}, r={_tuple(['0.0'] * len(draft.inputs))}"
    sigma = _tuple(_rounded(0.005 * float(np.ptp(c.span))) for c in draft.outputs)
    return [
        f"    # {MARK}: what a controller is to do. For a first loop take away the # before:",
        f"    # control=OCP({horizon}, {free}, u_min={low}, u_max={high},",
        "    #             # weights: one over the square of a deviation that you tolerate",
        f"    #             r_delta={each(draft.inputs, 0.1)}, q_y={each(draft.outputs, 0.05)}),",
        f"    # sensor_sigma={sigma},  # how much each sensor errs",
        "    # safe_input=(...),  # within these limits, and no harm when a sensor is lost: nobody can guess it",
    ]


def _tuple(written: Iterable[str]) -> str:
    """What is written already, as a tuple."""
    given = list(written)
    return f"({', '.join(given)},)" if len(given) == 1 else f"({', '.join(given)})"
