"""Columns of recordings: which columns move, their units, and which column is the time."""

from __future__ import annotations

import keyword
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.check.first_model import FEWEST
from hybrid_mpc.data.names import FIELD, Said, said_by, unit_behind
from hybrid_mpc.data.source import Columns, Source, name_and_unit
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.records import shown
from hybrid_mpc.rules import LARGEST, column_problem, counted

Array = NDArray[np.float64]
MOST_RECORDED = 1e-3 * LARGEST
"""Largest number of a signal; the signal's range, wider than the recording, must stay below ``LARGEST``."""
COUNTED = (
    "the column counts samples. It is used as the time, because no column is named as time. Write the sampling period "
    "[s] into units, and multiply all times below by this period"
)
"""Doubt about a time that is a count of samples."""
UNNAMED = (
    "the column rises evenly, and no column is named as time. Check that this column is the time in seconds"
)
NO_UNIT = "the column name has no unit. Check that the time is in seconds"
EPOCHS = ((1e18, 1e-9), (1e15, 1e-6), (1e12, 1e-3), (1e9, 1.0))
"""Smallest time since 1970 (in the year 2001) in each unit [s]; a number five times larger (after 2130) is no epoch."""
UNIT = re.compile(r"[\w/^*·.%°²³µμΩ() -]{1,20}")
"""Pattern of a unit; any other text behind a name is not one."""
LIMITS: Mapping[str, Sequence[float]] = {
    "%": (-100.0, 0.0, 100.0),
    "V": (-24.0, -12.0, -10.0, -5.0, 0.0, 5.0, 10.0, 12.0, 24.0),
    "mA": (0.0, 4.0, 20.0),
    "": (-1.0, 0.0, 1.0),
}
"""Usual limits of actuators, by unit (empty: no unit)."""
DIVERGED, AGAIN = 1e12, 3
"""Least size of diverged numbers, over a column's median size; and the fewest such numbers."""


@dataclass(frozen=True)
class Column:
    """A column of the recordings: full name, name and unit from the header, all its numbers ``(m,)``.

    ``lengths`` are those of the concatenated recordings. ``periodic``: an angle that is recorded wrapped; its numbers
    are unwrapped. ``asked``: the unit is a letter at the end of the name, which may be an index instead.
    """

    full: str
    name: str
    unit: str
    values: Array
    lengths: tuple[int, ...]
    periodic: bool = False
    asked: bool = False

    @property
    def pieces(self) -> tuple[Array, ...]:
        """Its numbers in each recording."""
        return tuple(np.split(self.values, np.cumsum(self.lengths)[:-1]))

    @property
    def parts(self) -> tuple[Column, ...]:
        """Columns that a linear model may take: the sine and cosine of a periodic one, else the column itself."""
        if not self.periodic:
            return (self,)
        angle = self.signal.radians * self.values
        return tuple(
            replace(self, name=f"{key}_{self.name}", unit="", values=f(angle), periodic=False)
            for key, f in (("sin", np.sin), ("cos", np.cos))
        )

    @property
    def span(self) -> tuple[float, float]:
        """Smallest and largest number."""
        return float(np.nanmin(self.values)), float(np.nanmax(self.values))

    @property
    def identifier(self) -> str:
        """The name as a Python identifier."""
        # most characters of a signal's name
        text = ascii_of(self.name)[:40].strip("_") or "signal"
        return f"c_{text}" if text[0].isdigit() or keyword.iskeyword(text) else text

    @property
    def signal(self) -> Signal:
        """The signal; its range extends the recorded one by its span on either side."""
        if self.periodic:
            return Signal(self.identifier, self.unit or "-", periodic=True)
        low, high = self.span
        span = high - low
        return Signal(
            self.identifier,
            self.unit or "-",
            float(near(low - span, span / 20)),
            float(near(high + span, span / 20)),
        )

    @property
    def limits(self) -> tuple[float | None, float | None]:
        """Ends of the recorded range that look like limits of an actuator, None where an end does not: 0 to 100 %.

        An end at exactly zero is one in any unit.
        """
        low, high = self.span
        # largest distance of a recorded end from such a limit, in spans
        near_by = 2e-3 * (high - low)
        usual = LIMITS.get("" if self.unit in ("", "-", "1") else self.unit, ())
        below = [0.0] if low == 0.0 else [end for end in usual if 0 <= low - end <= near_by]
        above = [0.0] if high == 0.0 else [end for end in usual if 0 <= end - high <= near_by]
        return below[0] if below else None, above[0] if above else None

    @property
    def input_signal(self) -> Signal:
        """The signal of an input: its range ends at recorded limits of the actuator."""
        low, high = self.limits
        one = self.signal
        if one.periodic:
            return one
        return replace(
            one, lower=one.lower if low is None else low, upper=one.upper if high is None else high
        )


def columns_of(sources: Sequence[Source]) -> tuple[dict[str, Column], dict[str, str]]:
    """Columns whose numbers move, and the reasons why others are no signals, by full name."""
    found: dict[str, Column] = {}
    tables = [read_all(source) for source in sources]
    usual = [_usual_length(read) for read, _ in tables]
    left_out: dict[str, str] = {}
    diverged: list[str] = []
    small = any(_ends_with_unit(full) for source in sources for full in source.header)
    for full in dict.fromkeys(name for source in sources for name in source.header):
        pieces: list[Array] = []
        problems: list[str] = []
        for source, (read, reasons), rows in zip(sources, tables, usual, strict=True):
            where = f" in {source.path.name}" if len(sources) > 1 else ""
            if full not in read:
                problems.append(reasons.get(full, f"missing in {source.path.name}"))
                continue
            one = read[full]
            pieces.append(one.values[:, 0])
            if full in one.faults:
                problems.append(f"{one.faults[full]}{where}")
            elif rows and len(one.values) not in (1, rows):
                problems.append(
                    f"{counted(len(one.values), 'value')}{where}, but the other columns have {rows}"
                )
            elif (k := _diverges(pieces[-1])) is not None:
                diverged.append(
                    f"{source.path}: {one.place(k)}, column {shown(full)} grows to "
                    f"{np.nanmax(np.abs(pieces[-1])):.3g}; the recording or the simulation diverged. Delete the rows "
                    "from there on, or remove the recording. [HM-CHECK-003]"
                )
        known = np.concatenate([piece[np.isfinite(piece)] for piece in pieces]) if pieces else np.zeros(0)
        if problem := column_problem(full):
            left_out[full] = problem
        elif problems:
            left_out[full] = problems[0]
        elif not len(known):
            left_out[full] = "no number"
        elif len(known) < FEWEST or max(map(len, pieces)) == 1:
            left_out[full] = f"{counted(len(known), 'number')}, fewer than {FEWEST}"
        elif known.min() == known.max():
            left_out[full] = f"constant at {known[0]:g}"
        elif np.abs(known).max() > MOST_RECORDED:
            left_out[full] = f"reaches {np.abs(known).max():g}, too large for a machine"
        else:
            inner = FIELD.fullmatch(full)
            name, unit = name_and_unit(inner[1] if inner else full)
            unit = unit if UNIT.fullmatch(unit) and unit.isprintable() and unit != "1" else ""
            ending = unit_behind(name, small)
            lengths = tuple(map(len, pieces))
            found[full] = Column(
                full,
                name,
                unit or ending.unit,
                np.concatenate(pieces),
                lengths,
                asked=not unit and ending.perhaps,
            )
    refuse(diverged)
    if not found:
        why = "".join(f"\n  {shown(name)}: {reason}" for name, reason in left_out.items())
        raise InputError(
            f"{sources[0].path}: no column has {FEWEST} numbers that vary. Give a recording in which the machine "
            f"moves.{sources[0].note}{why} [HM-CHECK-004]"
        )
    return found, left_out


def _ends_with_unit(full: str) -> bool:
    """Whether a column's name ends with a unit of several letters, or is a time with a unit: ``time_s``."""
    ending = unit_behind(full)
    return bool(ending.unit and not ending.perhaps) or (
        said_by(full).kind == "time" and bool(said_by(full).unit)
    )


def _usual_length(read: Mapping[str, Columns]) -> int:
    """Number of rows of most columns of a file; if columns differ, that of the time."""
    lengths = [
        len(one.values)
        for full, one in sorted(read.items(), key=lambda item: said_by(item[0]).kind != "time")
        if len(one.values) >= FEWEST
    ]
    return Counter(lengths).most_common(1)[0][0] if lengths else 0


def _diverges(values: Array) -> int | None:
    """The row from which on a column diverges; None if it does not.

    Several different huge numbers must stand at the end: a code for missing values is a single number.
    """
    known = np.flatnonzero(np.isfinite(values))
    size = np.abs(values[known])
    if len(known) < FEWEST:
        return None
    middle = float(np.median(size))
    large = (size > DIVERGED * middle) & (size > DIVERGED) if middle > 0 else size > MOST_RECORDED
    large |= size > MOST_RECORDED
    if large.sum() < AGAIN or not large[-AGAIN:].all() or len(np.unique(size[large])) < AGAIN:
        return None
    return int(known[int(np.argmax(large))])


def read_all(source: Source) -> tuple[dict[str, Columns], dict[str, str]]:
    """Each column, blank cells as NaN; and the reasons why others cannot be read, by full name."""
    read: dict[str, Columns] = {}
    counts = Counter(source.header)
    reasons = {
        name: f"its name appears {count} times in the header. Rename all but one"
        for name, count in counts.items()
        if count > 1
    }
    names = [name for name, count in counts.items() if count == 1]
    try:
        whole = source.read(None, names, names) if names else None
        if whole is not None:
            return {
                name: replace(whole, values=whole.values[:, j : j + 1]) for j, name in enumerate(names)
            }, reasons
    except InputError:  # then column by column, below
        pass
    for name in names:  # vectors may differ in length and kind: each one has its own error
        try:
            read[name] = source.read(None, [name], [name])
        except InputError as error:
            reasons[name] = str(error).removeprefix(f"{source.path}: ")
    return read, reasons


# Time


class Clock(NamedTuple):
    """The time: its column (None: only a sampling period), period, unit of the column and length [s], and a doubt.

    ``periods`` [s] are those of the recordings, in their order; ``period`` is the longest.
    """

    column: Column | None
    period: float
    seconds: float = 1.0
    doubt: str = ""
    length: float = 0.0
    periods: tuple[float, ...] = ()


def clock_of(
    sources: Sequence[Source],
    columns: Mapping[str, Column],
    left_out: dict[str, str],
    asked: str,
    chosen: set[str],
) -> Clock:
    """The time of all recordings: the first one's column, the longest sampling period, the shortest length.

    Raises:
        InputError: If the column cannot be used in a recording.
    """
    first = _time(sources[0], columns, left_out, asked, chosen)
    rows = next(iter(columns.values())).lengths
    if first.column is None:
        return first._replace(length=first.period * min(rows), periods=(first.period,) * len(rows))
    full, clocks, problems = first.column.full, list[Clock](), list[str]()
    for source in sources:
        clock = (
            _clock(source, full, said_by(full)) if full in source.header else f"missing in {source.path.name}"
        )
        if isinstance(clock, Clock):
            clocks.append(clock)
        else:
            problems.append(
                f"{source.path}: column {shown(full)} cannot be used as the time: {clock} [HM-CHECK-005]"
            )
    refuse(problems)
    lengths = [
        clock.period * m
        if clock.column is None or clock.column.values.size == 1
        else clock.seconds * float(np.ptp(clock.column.values))
        for clock, m in zip(clocks, rows, strict=True)
    ]
    periods = tuple(clock.period for clock in clocks)
    return first._replace(period=max(periods), length=min(lengths), periods=periods)


def _time(
    source: Source, columns: Mapping[str, Column], left_out: dict[str, str], asked: str, chosen: set[str]
) -> Clock:
    """The column of the time.

    A name that means time decides; then numbers that rise evenly; a count of samples only as the last resort.

    Raises:
        InputError: If a column is named as time and cannot be used; with the reason.
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
            role = "was given as the time" if asked else "is the time by its name"
            many = troubles | dict.fromkeys(lost, f"its data type is not supported.{source.note}")
            refuse([
                f"{source.path}: column {shown(name)} {role} and cannot be used: {trouble} [HM-CHECK-006]"
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
    return Clock(
        None, 1.0, doubt="no column of the recording looks like a time. Give the sampling period [s]"
    )


def _clock(source: Source, full: str, said: Said) -> Clock | str:
    """A column as the time; or the reason why it cannot be."""
    if source.header.count(full) > 1:
        return "its name appears more than once in the header. Rename all but one"
    if said.unit and said.seconds is None:
        return (
            f"its unit {said.unit!r} is not a unit of time. Write seconds, or name the unit, e.g. 'time [ms]'"
        )
    try:
        columns = source.read(None, [full], ())
    except InputError as error:
        return str(error).removeprefix(f"{source.path}: ")
    if columns.faults:
        return "; ".join(columns.problems)
    t = columns.values[:, 0]
    if not len(t):
        return "no number"
    seconds = said.seconds or 1.0
    if not said.unit and said.kind:
        epoch = next(((least, unit) for least, unit in EPOCHS if least <= t[0] < 5 * least), None)
        seconds = epoch[1] if epoch else 1.0
        if said.is_date and epoch is None:
            return "the unit of the dates is unknown. Write seconds since the start of the recording"
    column = Column(full, *name_and_unit(full), t, (len(t),))
    if len(t) == 1:
        fine = 0 < t[0] < math.inf
        return (
            Clock(column, seconds * float(t[0]), seconds)
            if fine
            else f"its sampling period {t[0]:g} is not positive"
        )
    if np.abs(t).max() * seconds > MOST_RECORDED:
        return f"reaches {np.abs(t).max():g}, too large for a time"
    if disorder := columns.disorder(seconds * t, f"column {shown(full)}"):
        return disorder
    return Clock(column, seconds * float(np.median(np.diff(t))), seconds)


def _sampling_time(source: Source, full: str, said: Said) -> Clock | None:
    """The sampling period that a column gives: one number, or the same number in every row."""
    clock = _clock(source, full, said)
    if isinstance(clock, Clock):
        return clock._replace(doubt="" if said.unit else NO_UNIT)
    try:
        values = source.read(None, [full], ()).values[:, 0]
    except InputError:
        return None
    values = values[np.isfinite(values)]
    if not (len(values) and 0 < values[0] < math.inf and (values == values[0]).all()):
        return None
    if said.unit and said.seconds is None:
        return None
    seconds = said.seconds or 1.0
    return Clock(None, seconds * float(values[0]), doubt=f"the sampling period [s], from {shown(full)}")


def no_signal(column: Column) -> str:
    """Reason why a column with changing numbers is not a signal; empty if it may be one."""
    said = said_by(column.full)
    even = _mostly_even(column.values)
    if said.kind == "time" and (even or not said.perhaps):
        return "the time by its name"
    if said.kind == "step":
        return "the sampling period by its name"
    if said.kind == "count" and (not said.perhaps or (even and _is_count(column.values))):
        return "a counter of samples" if column.name else "no name"
    return "rises evenly, like a time" if _rises(column.values) else ""


def _rises(values: Array) -> bool:
    """Whether numbers rise evenly, like a time."""
    return bool(np.isfinite(values).all() and (np.diff(values) > 0).all()) and _mostly_even(values)


def _mostly_even(values: Array) -> bool:
    """Whether most numbers rise evenly, like a time that may repeat, restart or have gaps."""
    steps = np.diff(values[np.isfinite(values)])
    middle = float(np.median(steps)) if len(steps) else 0.0
    # largest relative spread of evenly spaced time stamps
    return middle > 0 and bool(np.quantile(np.abs(steps / middle - 1), 0.9) < 0.2)


def _is_count(values: Array) -> bool:
    """Whether numbers are whole and mostly have one step."""
    known = values[np.isfinite(values)]
    steps = np.diff(known)
    return bool((known == np.round(known)).all() and (steps == np.median(steps)).mean() >= 0.9)


# Names and numbers


def ascii_of(text: str) -> str:
    """A text with only letters, digits and underscores: no accents, underscores for all other characters."""
    bare = text.replace("ß", "ss")
    bare = "".join(c for c in unicodedata.normalize("NFKD", bare) if not unicodedata.combining(c))
    return re.sub(r"\W+", "_", bare, flags=re.ASCII).strip("_")


def near(value: float, step: float) -> str:
    """A number with enough digits to tell it from one that is ``step`` away."""
    if not (math.isfinite(value) and 0 < step < math.inf):
        return repr(float(value) + 0.0)
    return repr(round(float(value), -math.floor(math.log10(step))) + 0.0)
