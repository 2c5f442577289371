"""Cells of one column as numbers: decimal marks, dates and times of day, numbers with a unit, words for a switch.

All cells of a column are read in the same way. If no way fits, or more than one, the cells stay unread and a message
says why.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.machine.units import parse_unit

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Count = NDArray[np.int64]
BLANK = ("", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "---")
"""Cells that mark a missing value, in small letters."""
PAIRS = (  # words for the two positions of a switch, 0 and 1, in small letters
    ("off", "on"), ("false", "true"), ("no", "yes"), ("closed", "open"), ("low", "high"), ("aus", "ein"), ("aus", "an"),
    ("zu", "auf"), ("nein", "ja"), ("falsch", "wahr"), ("arrêt", "marche"), ("non", "oui"),
)  # fmt: skip
SWITCH = frozenset(word for pair in PAIRS for word in pair)
DAY = 86400.0
FAR = 20.0
"""Longest step between dates, in median steps, with which an order of day and month is accepted."""
SEEN = 100  # cells that are inspected before all are read as dates of ISO 8601
ISO = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}(:\d{2}([.,]\d{1,9})?)?(Z|[+-]\d{2}:?\d{2})?")
TIMES = "times of day read as seconds"
MONTHS = (  # how the names of months begin, in small letters
    ("jan",), ("feb", "fév", "fev"), ("mar", "mär", "mrz"), ("apr", "avr"), ("may", "mai"), ("jun", "juin"),
    ("jul", "juil"), ("aug", "aoû", "aou"), ("sep",), ("oct", "okt"), ("nov",), ("dec", "dez", "déc"),
)  # fmt: skip
_CLOCK = r"(?P<H>\d{1,3}):(?P<M>\d{2})(?::(?P<S>\d{2})(?:[.,:](?P<f>\d{1,9}))?)?\s*(?P<ap>[AaPp]\.?[Mm]\.?)?"
_ZONE = r"\s*(?P<z>Z|[A-Z]{2,5}|[+-]\d{2}:?\d{2})?"
_DAYS = (  # a day: year first, year last, with the month's name, in eight digits (before a time of day)
    r"(?P<Y>\d{4})(?P<sep>[-/.])(?P<m>\d{1,2})(?P=sep)(?P<d>\d{1,2})",
    r"(?P<a>\d{1,2})(?P<sep>[-/.])(?P<b>\d{1,2})(?P=sep)(?P<Y>\d{4}|\d{2})",
    r"(?P<d>\d{1,2})[-/. ]\s?(?P<name>[^\W\d_]{3,9})\.?[-/. ,]\s?(?P<Y>\d{4})",
    r"(?P<name>[^\W\d_]{3,9})\.?\s(?P<d>\d{1,2}),?\s(?P<Y>\d{4})",
    r"(?P<Y>\d{4})(?P<m>\d{2})(?P<d>\d{2})",
)
DATES = tuple(re.compile(rf"{day}(?:[T _,-]\s*{_CLOCK}{_ZONE})?") for day in _DAYS)
TIME_OF_DAY = re.compile(_CLOCK)
MINUTES = re.compile(r"(?P<M>\d{1,3}):(?P<S>\d{2})[.,](?P<f>\d{1,9})")
"""Minutes and seconds: two numbers, the second with decimals."""
WITH_UNIT = re.compile(
    r"(?P<number>[+-]?\d+(?:[.,]\d*)?(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\W\d_][^\d_,;]{0,11}|%|°\w?)"
)
THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:(?P<mark>[.,'’ \u00a0\u202f])\d{3})(?:(?P=mark)\d{3})*(?:[.,]\d*)?")
"""A number with marks between thousands."""


class Cells(NamedTuple):
    """A column's numbers ``(m,)``, NaN where a cell has none, and which of its cells are ``blank``.

    ``unit`` is the unit that every cell has, ``"s"`` for dates. ``done`` describes the conversion to numbers. ``fault``
    says why the conversion failed for the whole column, with a remedy.
    """

    values: Array
    blank: Mask = np.zeros(0, bool)
    unit: str = ""
    done: str = ""
    fault: str = ""


def cells_of(column: pd.Series, decimal: str = ".") -> Cells:
    """Convert a column of pandas to numbers: numbers, dates, or texts with the file's decimal mark."""
    import pandas as pd

    kind, none = column.dtype.kind, np.zeros(len(column), bool)
    if kind in "iuf" or (kind == "b" and not column.isna().any()):
        values = column.to_numpy(np.float64, na_value=np.nan)
        return Cells(values, np.isnan(values), done="true and false read as 1 and 0" if kind == "b" else "")
    if kind in "Mm":
        blank = column.isna().to_numpy()
        whole = column.dt.tz_convert("UTC") if getattr(column.dtype, "tz", None) is not None else column
        begin = whole[~blank].iloc[0] if kind == "M" and not blank.all() else pd.Timedelta(0)
        since = pd.to_timedelta(whole - begin).dt.as_unit("ns").to_numpy().astype(np.int64)
        values = np.where(blank, np.nan, since / 1e9)
        return Cells(values, blank, "s", f"dates read as seconds since {begin}" if kind == "M" else "")
    if kind == "c":
        return Cells(
            np.full(len(column), np.nan), none, fault="the cells are complex numbers. Write real numbers"
        )
    first = [one for one in column.iloc[:SEEN] if isinstance(one, str)]
    texts = len(first) == min(SEEN, len(column)) > 0
    if texts and all(map(ISO.fullmatch, first)):
        dates = pd.to_datetime(column, format="ISO8601", utc=True, errors="coerce")
        if not dates.isna().any():
            return cells_of(dates)
    found, words = None, column.tolist() if texts and all(map(is_stamp, first)) else list[Any]([None])
    if all(isinstance(one, str) for one in words):
        found = _stamps(words, np.zeros(0), ".")  # all cells are dates in one format
    if found is None or found.fault:
        codes, uniques = pd.factorize(column, use_na_sentinel=False)
        found = _of_objects(list(uniques), decimal)
        found = found._replace(values=found.values[codes], blank=found.blank[codes])
    else:
        found = found._replace(blank=none)
    values, done = found.values, found.done
    if done == TIMES and (turned := np.cumsum(np.r_[0, np.diff(values) < -DAY / 2])).any():
        values, done = values + DAY * turned, f"{done}, continued over midnight ({turned[-1]} times)"
    return found._replace(values=values, done=done)


def number(cell: str) -> float:
    """The number in a cell; NaN if the cell holds no finite number.

    Example:
        >>> number("1e3"), number("1_000")
        (1000.0, nan)
    """
    try:
        value = float(cell)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and "_" not in cell else math.nan


def is_number(cell: str, decimal: str = ".") -> bool:
    """Whether a cell is a number by itself, with the decimal mark."""
    return math.isfinite(number(_pointed(cell, decimal)))


def is_value(cell: str, comma: bool = True) -> bool:
    """Whether a cell belongs to a row of values, not of names: a number, a date, a switch, a number with a unit.

    ``comma``: a decimal comma is allowed.
    """
    return (
        is_number(cell) or (comma and is_number(cell, ",")) or is_stamp(cell) or cell.casefold() in SWITCH
        or WITH_UNIT.fullmatch(cell) is not None or THOUSANDS.fullmatch(cell) is not None
    )  # fmt: skip


def is_stamp(cell: str) -> bool:
    """Whether a cell is a date or a time of day."""
    if not cell[:1].isalnum() or len(cell) > 60:
        return False
    return any(pattern.fullmatch(cell) for pattern in (*DATES, TIME_OF_DAY, MINUTES))


def is_unit(cell: str) -> bool:
    """Whether a cell names a unit, with or without brackets; marks of missing values are no units."""
    bare = cell.strip().strip("[]()").strip()
    return (
        re.search(r"[^\W\d_]|[%°]", bare) is not None
        and bare.casefold() not in BLANK
        and parse_unit(bare) is not None
    )


def cause(cell: str) -> str:
    """Why a cell is not a number, and what to write instead; empty if the cause is unknown."""
    if THOUSANDS.fullmatch(cell):
        return "the number has a thousands separator. Delete the separator and write a decimal point"
    if re.fullmatch(r"[+-]?\d*,\d+", cell):
        return "the number has a decimal comma. Write a decimal point, or separate cells by semicolons"
    if is_stamp(cell):
        return "the cell is a date or a time of day, but other cells are not. Write all rows in one format"
    if cell.casefold() in SWITCH:
        return "the cell is a word such as on or true. Write 1 or 0"
    if found := WITH_UNIT.fullmatch(cell):
        unit = found["unit"].strip()
        return (
            f"the cell has a unit. Write the number alone and the unit into the header, e.g. 'name [{unit}]'"
        )
    return ""


def _pointed(cell: str, decimal: str) -> str:
    return cell if decimal == "." else cell.replace(".", "x").replace(",", ".")


def _of_objects(cells: Sequence[Any], decimal: str) -> Cells:
    """Numbers of distinct cells of any kind: texts, and the types of a spreadsheet."""
    import pandas as pd

    dates = (datetime.datetime, datetime.date, pd.Timestamp)
    stamps = [isinstance(c, dates) and c is not pd.NaT for c in cells]
    texts = [_text(cell) for cell in cells]
    blank = np.array([text.casefold() in BLANK for text in texts], dtype=bool)
    values = np.array([number(_pointed(text, decimal)) for text in texts])
    if any(stamps) and (np.array(stamps) | blank).all():
        made = pd.Series([None if b else c for b, c in zip(blank, cells, strict=True)], dtype=object)
        return cells_of(pd.to_datetime(made))._replace(blank=blank)
    texts = [
        c.isoformat(" ") if isinstance(c, datetime.datetime) else t for c, t in zip(cells, texts, strict=True)
    ]
    odd = ~np.isfinite(values) & ~blank
    if odd.any():
        words, others = [texts[k] for k in np.flatnonzero(odd)], values[~odd & ~blank]
        for make in (_switch, _stamps, _with_units, _thousands):
            if found := make(words, others, decimal):
                values[odd] = found.values
                return found._replace(values=values, blank=blank)
    return Cells(values, blank)


def _text(cell: Any) -> str:
    """A cell as text; a whole number of a spreadsheet keeps all its digits."""
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return ""
    if isinstance(cell, datetime.timedelta):
        return f"{cell.total_seconds():.9f}"
    return cell.strip() if isinstance(cell, str) else str(cell)


def _switch(words: Sequence[str], others: Array, decimal: str) -> Cells | None:
    small = {word.casefold() for word in words}
    pair = next((pair for pair in PAIRS if small <= set(pair)), None)
    if pair is None or not np.isin(others, (0.0, 1.0)).all():
        return None
    values = np.array([float(word.casefold() == pair[1]) for word in words])
    return Cells(values, done=f"{pair[0]!r} and {pair[1]!r} read as 0 and 1")


def _with_units(words: Sequence[str], others: Array, decimal: str) -> Cells | None:
    found = [WITH_UNIT.fullmatch(word) for word in words]
    units = {match["unit"].strip() for match in found if match}
    if len(others) or len(units) != 1 or not all(found):
        return None
    values = np.array([number(_pointed(match["number"], decimal)) for match in found if match])
    unit = units.pop()
    return Cells(values, unit=unit, done=f"cells are numbers with the unit {unit!r}")


def _thousands(words: Sequence[str], others: Array, decimal: str) -> Cells | None:
    """Numbers with a thousands separator that cannot be the decimal mark."""
    mark = "." if decimal == "," else ","
    sure = re.compile(rf"[+-]?\d{{1,3}}(?:([{mark}'’ \u00a0\u202f])\d{{3}})(?:\1\d{{3}})*(?:[{decimal}]\d*)?")
    # a mark must be a thousands separator if a cell has two of them, or one and a decimal mark
    certain = any(mark not in word or word.count(mark) > 1 or decimal in word for word in words)
    if not certain or not all(map(sure.fullmatch, words)):
        return None
    bare = [re.sub(rf"[{mark}'’ \u00a0\u202f]", "", word) for word in words]
    values = np.array([number(_pointed(one, decimal)) for one in bare])
    return Cells(values, done="thousands separators removed")


# Dates


def _stamps(words: Sequence[str], others: Array, decimal: str) -> Cells | None:
    """Dates as seconds since the date in the first row; times of day as seconds."""
    import pandas as pd

    if len(others):
        return None
    parts, pattern = None, TIME_OF_DAY
    for pattern in (p for p in (*DATES, MINUTES, TIME_OF_DAY) if p.fullmatch(words[0])):
        parts = _fixed(words, pattern)
        if parts is None and all(map(pattern.fullmatch, words)):
            parts = pd.Series(words).str.extract(rf"^(?:{pattern.pattern})$")
        if parts is not None:
            break
    if parts is None:
        return None
    none = np.zeros(len(words), np.int64)
    count = {key: pd.to_numeric(parts[key]).fillna(0).to_numpy(np.int64) for key in "HMS" if key in parts}
    hours = count.get("H", none)
    if "ap" in parts and parts["ap"].notna().any():
        if parts["ap"].isna().any() or (hours > 12).any() or (hours < 1).any():
            return Cells(
                np.full(len(words), np.nan),
                none > 0,
                fault="AM and PM do not fit all cells. Write 24-hour times",
            )
        hours = hours % 12 + 12 * parts["ap"].str.upper().str.startswith("P").to_numpy()
    fraction = none
    if "f" in parts and parts["f"].notna().any():
        written = parts["f"].dtype.kind != "i"
        fraction = (parts["f"].fillna("0").str.ljust(9, "0") if written else parts["f"]).to_numpy(np.int64)
    within = ((hours * 60 + count.get("M", none)) * 60 + count.get("S", none)) * 10**9 + fraction
    if pattern is MINUTES:
        return Cells(within / 1e9, none > 0, "s", "minutes and seconds read as seconds")
    zone, fault, ways = none, "", list[Count]()
    if pattern is TIME_OF_DAY:
        if parts["S"].notna().any():
            return Cells(within / 1e9, none > 0, "s", TIMES)
        fault = "may be hours and minutes, or minutes and seconds. Write hours, minutes and seconds"
    elif (offsets := _zone(parts)) is None:
        fault = "have different time zones. Write the offset, e.g. +02:00"
    else:
        zone, ways = offsets, _days(parts)
        fault = "do not exist in the calendar. Correct the row" if not ways else ""
    ways = [days * 86400 * 10**9 + within - zone for days in ways]
    if any((np.diff(way) != np.diff(ways[0])).any() for way in ways[1:]):
        ways = [way for way in ways if _goes_on(way)]
        if len(ways) != 1:
            fault = "may begin with the day or with the month. Write year, month and day, e.g. 2024-01-31"
    if fault:
        return Cells(np.full(len(words), np.nan), fault=f"dates such as {words[0]!r} {fault}")
    return Cells((ways[0] - ways[0][0]) / 1e9, none > 0, "s", f"dates read as seconds since {words[0]}")


def _fixed(words: Sequence[str], pattern: re.Pattern[str]) -> pd.DataFrame | None:
    """Parts of dates that differ only in digits at fixed positions; None for all other dates."""
    import pandas as pd

    first = pattern.fullmatch(words[0])
    if first is None or not words[0].isascii() or max(map(len, words)) != len(words[0]):
        return None
    try:
        codes = np.array(words, dtype="S").view(np.uint8).reshape(len(words), -1)
    except UnicodeEncodeError:
        return None
    digits = np.array([c.isdigit() for c in words[0]])
    if ((codes[:, digits] - 48) > 9).any() or (codes[:, ~digits] != codes[0, ~digits]).any():
        return None
    parts = {}
    for key, text in first.groupdict().items():
        begin, end = first.span(key)
        if text is not None and text.isdigit():
            width = 9 if key == "f" else end - begin
            powers = 10 ** np.arange(width - 1, width - 1 - (end - begin), -1)
            parts[key] = (codes[:, begin:end].astype(np.int64) - 48) @ powers
        elif text is not None and (codes[:, begin:end] != codes[0, begin:end]).any():
            return None
        else:
            parts[key] = np.full(len(words), text, dtype=object)
    return pd.DataFrame(parts)


def _goes_on(stamps: Count) -> bool:
    """Whether distinct stamps increase, without a step far longer than the median step."""
    steps = np.diff(stamps)
    steps = steps[steps != 0]
    return bool(len(steps) and (steps > 0).all() and steps.max() <= FAR * np.median(steps))


def _days(parts: pd.DataFrame) -> list[Count]:
    """Days since 1970 for every possible order of day, month and year; empty if no order gives valid dates."""
    year = parts["Y"].to_numpy(np.int64)
    if "name" in parts:
        begins = {begin: k + 1 for k, names in enumerate(MONTHS) for begin in names}
        small = parts["name"].str.casefold()
        month = small.map(lambda name: begins.get(name[:4]) or begins.get(name[:3]) or 0).to_numpy(np.int64)
        return _since_1970(year, month, parts["d"].to_numpy(np.int64))
    if "a" not in parts:
        return _since_1970(year, parts["m"].to_numpy(np.int64), parts["d"].to_numpy(np.int64))
    first, second = parts["a"].to_numpy(np.int64), parts["b"].to_numpy(np.int64)
    ways = _since_1970(year, second, first)
    if (parts["sep"] == ".").all():
        return ways
    ways += _since_1970(year, first, second)
    return ways + (_since_1970(first, second, year) if (year < 100).all() else [])


def _since_1970(year: Count, month: Count, day: Count) -> list[Count]:
    if (month < 1).any() or (month > 12).any() or (day < 1).any():
        return []
    year = np.where(year < 100, year + 2000, year)
    months = ((year - 1970) * 12 + month - 1).astype("datetime64[M]")
    days = months.astype("datetime64[D]") + (day - 1)
    return [days.astype(np.int64)] if (days.astype("datetime64[M]") == months).all() else []


def _zone(parts: pd.DataFrame) -> Count | None:
    """Offsets of the time zones [ns]; None if the zones are names and the names differ."""
    codes, zones = parts["z"].fillna("").factorize()
    found = [re.fullmatch(r"([+-])(\d{2}):?(\d{2})", zone) for zone in zones]
    names = {zone for zone, match in zip(zones, found, strict=True) if not match} - {"Z", "UTC", "GMT"}
    if len(names) > 1 or (names and any(found)):
        return None
    sizes = [int(f"{m[1]}1") * (int(m[2]) * 3600 + int(m[3]) * 60) if m else 0 for m in found]
    return np.asarray(np.array(sizes, np.int64)[codes] * 10**9)
