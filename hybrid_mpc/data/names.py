"""What a column's name says of it: that it is the time, or that it counts samples. Then it is no signal.

Names are compared in small letters, without accents, word by word; ``camelCase``, ``snake_case`` and blanks separate
words. Names that may say it and may say something else (``T``, ``n``, ``valve_time``) are decided by their numbers.
"""

from __future__ import annotations

import re
import unicodedata
from typing import Literal, NamedTuple

from hybrid_mpc.data.files import name_and_unit
from hybrid_mpc.machine.units import time_factor

Kind = Literal["time", "step", "count", ""]


def _plain(text: str) -> str:
    """A text in small letters, without accents and forms of width."""
    whole = unicodedata.normalize("NFKD", text).casefold()
    return "".join(c for c in unicodedata.normalize("NFKD", whole) if not unicodedata.combining(c))


def _words(text: str) -> frozenset[str]:
    return frozenset(_plain(text).split())


TIME = _words(
    "time times timestamp timestamps stamp tout datetime date dates clock elapsed runtime uptime walltime simtime "
    "rostime systime daytime epoch t zeit zeiten zeitstempel zeitpunkt zeitachse uhrzeit datum messzeit laufzeit "
    "systemzeit versuchszeit temps heure horodatage horodate tiempo tempo hora fecha instante orario tijd "
    "tijdstip tijdstempel tid tidpunkt tidsstempel aika aikaleima czas cas vreme vrijeme ido idopont zaman timp "
    "waktu laikas laiks время дата час χρονος χρόνος الوقت الزمن זמן समय 시간 sekunden sekunde secondes segundos "
    "secondi"
)
"""Words for time; a name of these, of units and of ``AROUND`` says time."""
STAMPS = _words("timestamp timestamps datetime zeitstempel horodatage tijdstempel tidsstempel")
"""Words that say time whatever stands beside them."""
WITHIN = tuple(_plain(text) for text in ("时间", "時間", "时刻", "時刻", "시간"))
"""The same where a language does not separate words."""
DATES = _words("datetime date dates datum fecha дата")
"""Words for dates: their numbers may count days."""
AROUND = _words(
    "elapsed relative rel absolute abs sim simulation simulated ros unix posix utc gmt local system sys since "
    "start from begin recording recorded record log logger logging measurement measured meas test run real wall "
    "host pc plc device header stamp field total global master base axis vector in the of at and day"
)
"""What may stand beside them."""
PERHAPS = _words("T ts s ms us ns min h d data")
"""Single words that may say time: decided by their numbers."""
COUNT = _words(
    "index indices idx sample samples row rows record records seq sequence unnamed datapoint datapoints messpunkt "
    "zeile"
)
"""Words for a count of samples."""
PAIRS = ({"data", "point"}, {"data", "points"}, {"lfd", "nr"}, {"step", "number"}, {"line", "number"})
"""Pairs of words for the same."""
STEP = (
    {"dt"}, {"ts"}, {"timestep"}, {"delta", "t"}, {"time", "step"}, {"delta", "time"}, {"step", "size"},
    {"sampling", "time"}, {"sample", "time"}, {"sampling", "period"}, {"sample", "period"}, {"sampling", "interval"},
)  # fmt: skip
"""Words for the sampling time."""
BESIDE = _words("number no nr num nummer id count counter of the s ms")
"""What may stand beside them."""
COUNT_PERHAPS = _words(
    "n i j k no nr num number nummer count counter id step steps point points frame scan cycle line x"
)
"""Single words that may be a count: decided by their numbers."""
ALONE = ("s", "ms", "us", "ns", "min", "mins", "h", "d", "day", "days")
"""Units of time that as a whole name, or behind a ``t``, may be something else (a minimum, a height)."""


FIELD = re.compile(r"(?:[^\W\d]\w*\.)+([^\W\d]\w*)")
"""A field of a struct, ``run.phi``, and its own name."""


class Said(NamedTuple):
    """What a name says: ``kind``, whether its numbers must bear that out, and the unit of time [s]; None: not known.

    A ``step`` is the sampling time; it may be a time stamp, too, where its numbers increase. ``unit`` is the unit as it
    was written, empty if there is none; ``is_date`` that it speaks of dates.
    """

    kind: Kind = ""
    perhaps: bool = False
    unit: str = ""
    seconds: float | None = None
    is_date: bool = False


def said_by(column: str) -> Said:
    """What a column's name says of it.

    Example:
        >>> said_by("Time (ms)").kind, said_by("Time (ms)").seconds, said_by("t_us").seconds
        ('time', 0.001, 1e-06)
        >>> said_by("Data_Point").kind, said_by("T").perhaps, said_by("level [m]").kind
        ('count', True, '')
    """
    text = unicodedata.normalize("NFKC", column)
    name, unit = name_and_unit(text)
    if path := FIELD.fullmatch(name):
        name = path[1]
    split = re.sub(r"(?<=[^\W\d_A-Z])(?=[A-Z])", " ", name)
    written = [word for word in re.split(r"[\W_]+", split) if word]
    words = [re.sub(r"(?<=..)\d+$", "", _plain(word)) for word in written]
    words = [word for word in words if word and not word.isdigit()]
    if not words:
        return Said("count")
    if not unit and len(words) > 1 and time_factor(words[-1]) is not None:
        return _of(words[:-1], written[0], words[-1], behind=True)
    if not unit and len(words) == 1 and time_factor(words[0]) is not None:
        return Said("time", words[0] in ALONE, words[0], time_factor(words[0]))
    return _of(words, written[0], unit, behind=False)


def _of(words: list[str], first: str, unit: str, behind: bool) -> Said:
    """The same by its words, the first as it was written, and a unit in brackets or ``behind`` the name."""
    seconds = time_factor(unit) if unit else None
    zone = unit.casefold().split("+")[0] in ("utc", "gmt", "local", "cet", "cest", "est", "pst", "z")
    unit, seen = "" if zone or unit in ("-", "1") else unit, set(words)
    is_date = bool(seen & DATES)
    if seen in STEP:
        return Said("step", False, unit, seconds)
    if seen in PAIRS or (seen & COUNT and seen <= COUNT | BESIDE):
        return Said("count", False, unit, seconds)
    if seen & STAMPS or any(part in word for part in WITHIN for word in words):
        return Said("time", False, unit, seconds, is_date)
    if words == ["t"]:
        if unit and seconds is None:  # t [degC]
            return Said()
        large = first == "T" and (behind or not unit)
        return Said(
            "time", large or (behind and unit in ALONE and unit not in ("s", "ms", "us", "ns")), unit, seconds
        )
    if seen & TIME and seen <= TIME | AROUND:
        return Said("time", False, unit, seconds, is_date)
    if unit and seconds is None:
        return Said()
    if seen & (TIME - {"t"}) or (len(words) == 1 and seen & PERHAPS) or words == ["x", "value"]:
        return Said("time", True, unit, seconds, is_date)
    return Said("count", True) if len(words) == 1 and seen & COUNT_PERHAPS and not unit else Said()
