"""Rules for values of fields: names, units, texts and sizes. The same rule holds for constructing and for loading.

A field names its rule in its annotation, ``name: Name``. :class:`~hybrid_mpc.records.Fields` checks it when a record is
made, :func:`~hybrid_mpc.records.record` when it is read.

Names become parts of file names, C, HTML, CSV and command lines, so they have no special characters of these. Letters
and digits of any alphabet (``φ``, ``Länge``) are allowed: they are not special there. Every generator also escapes what
it writes.
"""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass
from typing import Annotated, TypeAlias

MOST_NAME = 100
"""Longest name [bytes of UTF-8]: with prefixes and suffixes, a file name stays below 255."""
MOST_UNIT = 50
MOST_LINE, MOST_TEXT = 1_000, 100_000
"""Longest title and longest description [characters]."""
MOST_SEED = 2**31 - 1
"""Largest seed: a thousand times this number, used to number loops, still fits 64 bits."""
LARGEST = 1e30
"""Largest size of a number in any unit. No measured value is larger, and cost functions, whose terms have up to the
eighth power of such numbers, stay finite."""
SMALLEST = 1e-30
"""Smallest positive number: its square, a variance, must not vanish."""
SHORTEST_S, LONGEST_S = 1e-9, 1e9
"""Shortest and longest time [s]: a nanosecond, and about thirty years."""
_NAME = re.compile(r"\w(?:[\w .\[\]-]*[\w\]-])?")
_UNIT = re.compile(
    r"(?!.*(?:\*/|/\*|//))[\w/^*()°%‰·⋅×√.+−⁻-](?:[\w/^*()°%‰·⋅×√.+−⁻ -]*[\w/^*()°%‰·⋅×√.+−⁻-])?"
)
_TURNS = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u200e\u200f\u061c\u2028\u2029"
"""Characters that change the direction of text, or end a line invisibly."""


def name_problem(name: str) -> str:
    """The problem with the name of a signal, parameter, task, model or scenario; empty without one.

    A name has letters and digits of any alphabet, ``_ . [ ] -`` and blanks. It begins with a letter, a digit or ``_``
    and does not end with a blank or a dot.

    Example:
        >>> name_problem("phi_dot"), name_problem("T [2] μ")
        ('', '')
        >>> name_problem("../x")
        "a name is needed (letters, digits, _ . [ ] - and blanks; a letter, a digit or _ first), got '../x'"
    """
    if _NAME.fullmatch(name) and len(name.encode()) <= MOST_NAME:
        return ""
    if not name.strip():
        return f"a name is needed, got {_shown(name)}"
    if len(name) > MOST_NAME or _NAME.fullmatch(name):
        return f"a name of at most {MOST_NAME} bytes is needed, got {_shown(name)}"
    return (
        "a name is needed (letters, digits, _ . [ ] - and blanks; a letter, a digit or _ first), got "
        + _shown(name)
    )


def unit_problem(unit: str) -> str:
    """The problem with a unit; empty without one. ``"-"`` means no unit.

    A unit has letters, digits, blanks and ``/ ^ * ( ) ° % ‰ · × √ . + -``, without ``*/``, ``/*`` and ``//``, which
    open and close comments.

    Example:
        >>> unit_problem("N m/rad"), unit_problem("W/(m^2*K)"), unit_problem("°C"), unit_problem("%")
        ('', '', '', '')
        >>> bool(unit_problem("m */ x")), bool(unit_problem(""))
        (True, True)
    """
    if _UNIT.fullmatch(unit) and len(unit) <= MOST_UNIT:
        return ""
    return (
        "a unit is needed (letters, digits, blanks and / ^ * ( ) ° % · √ . + - without */, /* and //; '-' for none), "
        f"got {_shown(unit)}"
    )


def line_problem(text: str) -> str:
    r"""The problem with a title or another text of one line; empty without one.

    Example:
        >>> line_problem('Pump "A" <b>, 50 % & more'), bool(line_problem("two\nlines"))
        ('', True)
    """
    if strange := [c for c in text if not _printed(c)]:
        return f"one line of text is needed, got {_shown(text)} with the character {strange[0]!r}"
    return "" if len(text) <= MOST_LINE else f"at most {MOST_LINE} characters are needed, got {len(text)}"


def text_problem(text: str) -> str:
    """The problem with a text of several lines; empty without one."""
    if strange := [c for c in text if not (_printed(c) or c in "\n\r\t")]:
        return f"text is needed, got {_shown(text)} with the character {strange[0]!r}"
    return "" if len(text) <= MOST_TEXT else f"at most {MOST_TEXT} characters are needed, got {len(text)}"


def column_problem(text: str) -> str:
    """The problem with the name of a recording's column, which may be any text; empty without one."""
    return text_problem(text) if text.strip() else f"the name of a column is needed, got {_shown(text)}"


def label_problem(text: str) -> str:
    """The problem with a short, non-empty text of one line; empty without one."""
    return line_problem(text) if text.strip() else f"a text is needed, got {_shown(text)}"


def name_or_none_problem(name: str) -> str:
    """As :func:`name_problem`; the empty name means all, or none."""
    return name_problem(name) if name else ""


def printable(text: str) -> str:
    r"""Any text for a terminal: control characters are shown as escapes.

    Example:
        >>> printable("a\x1b[2Jb")
        'a\\x1b[2Jb'
    """
    return "".join(c if _printed(c) or c in "\n\t" else repr(c)[1:-1] for c in text)


def counted(count: int, noun: str, plural: str = "") -> str:
    """A count with its noun; ``plural`` if it is not the noun and an s.

    Example:
        >>> counted(1, "error"), counted(2, "warning"), counted(0, "recording"), counted(2, "try", "tries")
        ('1 error', '2 warnings', '0 recordings', '2 tries')
    """
    return f"{count} {noun if count == 1 else plural or noun + 's'}"


def two_digits(value: float) -> str:
    """A number with two significant digits, without an exponent where it has few digits.

    Example:
        >>> two_digits(0.0277778), two_digits(10.4167), two_digits(2.0), two_digits(170.2)
        ('0.028', '10', '2', '170')
    """
    return f"{float(f'{value:.2g}'):g}"


def time_text(ms: float) -> str:
    """A time [ms] with three significant digits: in seconds from one second on.

    Example:
        >>> time_text(2.13456), time_text(999.9), time_text(1e4), time_text(9e7)
        ('2.13 ms', '1 s', '10 s', '90000 s')
    """
    rounded = float(f"{ms:.3g}")
    return f"{rounded:g} ms" if rounded < 1e3 else f"{float(f'{rounded / 1e3:.3g}'):g} s"


def markdown(text: str) -> str:
    """Any text for Markdown and cells of its tables: one line, special characters as numeric entities.

    Example:
        >>> markdown("a <b> *c* | 50 %")
        'a &#60;b&#62; &#42;c&#42; &#124; 50 %'
    """
    return re.sub(r"[^\w .,:;/%°²³'=+()-]", lambda found: f"&#{ord(found[0])};", text)


def csv_cell(text: str) -> str:
    """Any text for a cell of a CSV file: a text that a spreadsheet would evaluate gets an apostrophe in front.

    Source: OWASP, *CSV injection*. A number or a lone sign is no formula.

    Example:
        >>> csv_cell("=HYPERLINK(1)"), csv_cell("-"), csv_cell("-0.5"), csv_cell("prior")
        ("'=HYPERLINK(1)", '-', '-0.5', 'prior')
    """
    formula = re.match(r"[=+\-@\t\r].", text, re.DOTALL) and not re.fullmatch(
        r"[+-][\d.]+(?:[eE][+-]?\d+)?", text
    )
    return f"'{text}" if formula else text


def _printed(c: str) -> bool:
    return unicodedata.category(c) not in ("Cc", "Cs") and c not in _TURNS


def _shown(text: str) -> str:
    return ascii(text) if len(text) <= 40 else f"{text[:40]!a}... ({len(text)} characters)"


@dataclass(frozen=True)
class Within:
    """A rule for numbers: from ``low`` to ``high``, or one of ``also``; never NaN. ``needed`` describes it in messages.

    Example:
        >>> Within(0.0, 1.0, "a share from 0 to 1")(1.5)
        'a share from 0 to 1 is needed, got 1.5'
    """

    low: float
    high: float
    needed: str
    also: tuple[float, ...] = ()

    def __call__(self, value: float) -> str:
        """The problem with a number; empty without one."""
        return (
            ""
            if self.low <= value <= self.high or value in self.also
            else f"{self.needed} is needed, got {value}"
        )


_INFINITE = (-math.inf, math.inf)
Name: TypeAlias = Annotated[str, name_problem]
NameOrNone: TypeAlias = Annotated[str, name_or_none_problem]
Unit: TypeAlias = Annotated[str, unit_problem]
Line: TypeAlias = Annotated[str, line_problem]
Label: TypeAlias = Annotated[str, label_problem]
Text: TypeAlias = Annotated[str, text_problem]
Column: TypeAlias = Annotated[str, column_problem]
Number: TypeAlias = Annotated[
    float, Within(-LARGEST, LARGEST, f"a finite number of at most {LARGEST:g} in size")
]
Bound: TypeAlias = Annotated[
    float,
    Within(-LARGEST, LARGEST, f"a number of at most {LARGEST:g} in size, or an infinite one", _INFINITE),
]
Positive: TypeAlias = Annotated[
    float, Within(SMALLEST, LARGEST, f"a positive number from {SMALLEST:g} to {LARGEST:g}")
]
NotNegative: TypeAlias = Annotated[
    float, Within(SMALLEST, LARGEST, f"0, or a positive number from {SMALLEST:g} to {LARGEST:g},", (0.0,))
]
Seconds: TypeAlias = Annotated[
    float, Within(SHORTEST_S, LONGEST_S, f"a positive number of seconds, {SHORTEST_S:g} to {LONGEST_S:g},")
]
Duration: TypeAlias = Annotated[
    float, Within(SHORTEST_S, LONGEST_S, f"0 s, or a positive number of seconds to {LONGEST_S:g},", (0.0,))
]
Shift: TypeAlias = Annotated[float, Within(-LONGEST_S, LONGEST_S, "a number of seconds")]
Share: TypeAlias = Annotated[float, Within(0.0, 1.0, "a share from 0 to 1")]
