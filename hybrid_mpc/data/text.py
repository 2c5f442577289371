"""Tables of text as engineers have them: any separator and decimal mark, preambles, closing rows, remarks.

:func:`hybrid_mpc.data.layout.layout_of` looks for the table in the first rows; pandas reads what it found. What is
unambiguous is done, and ``Source.notes`` says so; what is not is refused.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.cells import BLANK, is_value
from hybrid_mpc.data.frames import HEAD, Frame, frame_source, is_blank
from hybrid_mpc.data.layout import MOST_SEEN, Layout, Look, layout_of
from hybrid_mpc.data.source import Source
from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.records import shown

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
LARGEST = 2**31
"""Most bytes of numbers in a file [byte]: three columns at 1 kHz for a day."""
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "vertical bars", " ": "blanks"}
"""What may stand between the cells of a text file."""
SAMPLE = 2**17
"""Bytes at the beginning of a text that show where its table begins."""
CLOSING = 50
"""Most rows behind a table that are no rows of it: means, sums, a remark."""
TAIL = 200
"""Rows before the last one whose decimals are compared with its."""
CUT = 3.0
"""Times the largest step of a column by which its last number must be off to be one that was cut in two."""


def text_source(path: Path, content: bytes, sha256: str) -> Source:
    """A text file as a source."""
    with named_extra("reading tables"):
        import pandas  # noqa: F401  (asked for before anything is done)
    text, notes = _decoded(path, content)
    best: tuple[float, int, int, str, Layout | str] | None = None
    for separator in SEPARATORS:
        body = _Body(path, text, separator)
        looks = body.looks()
        score, layout = layout_of(looks, separator != ",", body.splits, body.number)
        matched = isinstance(layout, Layout) and layout.header >= 0
        one = (score, matched, layout.width if isinstance(layout, Layout) else 0, separator, layout)
        if layout and (best is None or one[:3] > best[:3]):
            best = one
    if best is None:
        tops = {
            one: next((look for look in _Body(path, text, one).looks() if look.filled), Look(0, []))
            for one in SEPARATORS
        }
        separator = max([*SEPARATORS][:-1], key=lambda one: len(tops[one].cells))
        separator = separator if len(tops[separator].cells) > 1 else " "
        first = tops[separator]
        names = tuple(first.cells)
        best = (0.0, 0, 0, separator, Layout(first.row, first.row + 1, names, len(names)))
    separator, layout = best[3:]
    if isinstance(layout, str):
        raise InputError(f"{path}: {layout}")
    frame = _Body(path, text, separator).frame(layout)
    return frame_source(path, sha256, replace(frame, notes=(*notes, *frame.notes)))


def _decoded(path: Path, content: bytes) -> tuple[bytes, list[str]]:
    """The text as UTF-8, with one end for all rows, and what was done."""
    notes = []
    zeros = content[:4096].count(0)
    if content.startswith((b"\xff\xfe", b"\xfe\xff")) or 3 * zeros > len(content[:4096]) > 2 * zeros - 8 > 0:
        try:
            begins = content.startswith((b"\xff\xfe", b"\xfe\xff"))
            kind = "utf-16" if begins else "utf-16-le" if content[1:2] == b"\0" else "utf-16-be"
            content = content.decode(kind).encode()
            notes.append("text is UTF-16")
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: is no UTF-16 text. Export the table as CSV (UTF-8).") from error
    content = content.removeprefix(b"\xef\xbb\xbf")
    codes = np.frombuffer(content, dtype=np.uint8)
    odd = np.flatnonzero((codes < 32) & ((codes < 9) | (codes > 13)) & (codes != 26))
    if len(odd):
        row = 1 + content.count(b"\n", 0, int(odd[0]))
        raise InputError(
            f"{path}: row {row} is no text. Export the table as CSV (UTF-8), or give the file the ending of its "
            "format; unpack it if it is packed."
        )
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").rstrip(b"\x1a")
    try:
        content.decode()
    except UnicodeDecodeError:
        content = content.decode("cp1252", errors="replace").encode()
        notes.append("text is Latin-1")
    return content, notes


class _Body:
    """Rows of a text, split by one separator; quotation marks may hold separators and ends of rows."""

    def __init__(self, path: Path, text: bytes, separator: str) -> None:
        self.path, self.text, self.separator = path, text, separator

    def number(self, row: int) -> int:
        """The number of a row of the sample, as an editor counts."""
        return 1 + self.text.count(b"\n", 0, self._starts[row]) if row < len(self._starts) else row + 1

    def looks(self) -> list[Look]:
        """The rows of the sample."""
        piece = self.text[:SAMPLE]
        inside = np.cumsum(np.frombuffer(piece, np.uint8) == 34, dtype=np.uint8) & 1
        ends = np.flatnonzero((np.frombuffer(piece, np.uint8) == 10) & (inside == 0))
        whole = len(piece) == len(self.text)
        begins = np.r_[0, ends + 1]
        ends = np.r_[ends, len(piece)] if whole else ends
        self._starts = begins[:MOST_SEEN].tolist()
        lines = [
            piece[a:b].decode(errors="replace") for a, b in zip(self._starts, ends[:MOST_SEEN], strict=False)
        ]
        self._sample = lines
        return [Look(k, split(line, self.separator)) for k, line in enumerate(lines)]

    def splits(self, row: int) -> list[list[str]]:
        """A row of the sample as other separators split it."""
        line = self._sample[row]
        ways = [split(line, separator) for separator in SEPARATORS if separator != self.separator]
        return [[cell.strip() for cell in re.split(r"\s{2,}|\t", line.strip())], *ways]

    def frame(self, layout: Layout) -> Frame:
        """The table of the whole text."""
        rows = _rows(self.path, self.text, self.separator)
        keep = _kept(self, rows, layout)
        count, names = int(keep.sum()), layout.names
        if count * len(names) * 8 > 4 * LARGEST:
            raise InputError(f"{self.path}: has {count} rows, more than are read. Split the recording.")
        numbers = rows.numbers[keep].tolist()
        decimal, unsure = self._decimal(rows, keep, layout)

        def columns(places: Sequence[int]) -> list[pd.Series]:
            frame = _parsed(
                self.path, self._kept_text(rows, keep), self.separator, layout.width, places, decimal, unsure
            )
            return [frame[place] for place in places]

        def text(k: int, place: int) -> str:
            line = int(np.flatnonzero(keep)[k])
            cells = split(self.text[rows.begins[line] : rows.ends[line]].decode(), self.separator)
            return cells[place] if place < len(cells) else ""

        def fault(place: int, values: Array) -> str:
            if unsure and (found := self._grouped(columns([place])[0], unsure, decimal, numbers)):
                return found
            last = not self.text.endswith(b"\n") and place == len(names) - 1 and len(values) > 4
            before = [text(k, place) for k in range(max(0, count - TAIL), count)] if last else []
            if last and _is_cut(before, values):
                return (
                    f"row {numbers[-1]}, COLUMN is {shown(before[-1])}, where the file ends without the end of the "
                    "row: the number seems to be cut in two. Delete that row, or record it whole."
                )
            return ""

        top = np.zeros(len(keep), bool)
        top[np.flatnonzero(keep)[:HEAD]] = True
        heads = _parsed(
            self.path, self._kept_text(rows, top), self.separator, layout.width, range(len(names)), ".", ".,"
        )
        seen = [j for j, name in enumerate(names) if name or not _all_blank(heads[j])]
        places = dict(enumerate(seen))
        notes = [*layout.notes, *rows.notes, *(["numbers have a decimal comma"] if decimal == "," else [])]
        return Frame(
            tuple(names[j] for j in seen),
            lambda chosen: columns([places[j] for j in chosen]),
            [heads[j] for j in seen],
            numbers,
            lambda k, j: text(k, places[j]),
            lambda j, values: fault(places[j], values),
            decimal,
            tuple(notes),
            layout.clock,
        )

    def _kept_text(self, rows: _Rows, keep: NDArray[np.bool_]) -> bytes:
        chosen = np.flatnonzero(keep)
        if not len(chosen):
            return b""
        begin, end = rows.begins[chosen[0]], rows.ends[chosen[-1]]
        if len(chosen) == chosen[-1] - chosen[0] + 1:
            return self.text[begin:end]
        return b"\n".join(
            [self.text[a:b] for a, b in zip(rows.begins[chosen], rows.ends[chosen], strict=True)]
        )

    def _decimal(self, rows: _Rows, keep: NDArray[np.bool_], layout: Layout) -> tuple[str, str]:
        """The decimal mark, and marks of which nobody knows from single cells whether they stand between thousands."""
        body = self._kept_text(rows, keep)
        if self.separator == ",":
            quoted = re.search(rb'"[+-]?\d+,\d+"', body)
            return ("," if quoted and not re.search(rb"\d\.\d", body) else "."), "," if quoted else ""
        point, comma = (_proven(body, mark) for mark in ".,")
        if point and comma:
            raise InputError(
                f"{self.path}: numbers have commas and points, e.g. {point} and {comma}. Write the file with one "
                "decimal mark."
            )
        grouped = "".join(
            m for m in ".," if re.search(rb"(?<![\d.,:])\d{1,3}[%s]\d{3}(?![\d:])" % m.encode(), body)
        )
        if point or comma:
            decimal = "." if point else ","
            other = "," if point else "."
            return decimal, other if other in grouped else ""
        return ("," if grouped == "," else "."), grouped

    def _grouped(self, column: pd.Series, unsure: str, decimal: str, numbers: Sequence[int]) -> str:
        """Whether a column's marks may stand between thousands, and may not: the fault, empty without one."""
        texts = column.astype(str).str.strip()
        if not (found := texts.str.contains(f"[{unsure}]", regex=True)).any():
            return ""
        whole = texts.str.fullmatch(r"[+-]?\d{1,3}")
        single = texts.str.fullmatch(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
        blank = texts.str.casefold().isin(BLANK)
        told = decimal not in unsure or len(unsure) > 1  # another column shows another mark
        if (whole | single | blank).all() and (whole.any() or told):
            k = int(np.argmax(found.to_numpy()))
            return (
                f"row {numbers[k]}, COLUMN is {shown(texts.iloc[k])}: a mark between thousands, or decimals? Write "
                "numbers with one decimal mark, as many decimals in all rows, and nothing between thousands."
            )
        return ""


def split(line: str, separator: str) -> list[str]:
    """The cells of a row, without blanks around them."""
    if separator == " " and '"' not in line:
        return line.split()
    if '"' in line:
        try:
            cells = next(csv.reader([line.strip(" ")], delimiter=separator, skipinitialspace=True), [])
        except csv.Error:
            cells = [line]
        return [cell.strip() for cell in cells]
    return [cell.strip() for cell in line.split(separator)]


@dataclass(frozen=True)
class _Rows:
    """Where the rows of a text begin and end, their numbers, how many cells they have, and which are blank."""

    begins: Rows
    ends: Rows
    numbers: Rows
    cells: Rows
    blank: NDArray[np.bool_]
    notes: list[str] = field(default_factory=list)


def _rows(path: Path, text: bytes, separator: str) -> _Rows:
    """All rows of a text."""
    codes = np.frombuffer(text, np.uint8)
    newline = codes == 10
    visible = (codes > 32) & (codes != 34)
    if separator == " ":
        marks = visible | (codes == 34)
        is_sep = marks & ~np.r_[False, marks[:-1]]  # where cells begin
    else:
        is_sep = codes == ord(separator)
        visible &= ~is_sep
    numbers = None
    if b'"' in text:
        outside = (np.cumsum(codes == 34, dtype=np.uint8) & 1) == 0
        if not outside[-1]:
            raise InputError(
                f"{path}: {_unclosed(text)}: a quotation mark is not closed, and the rows behind it are one cell. "
                "Delete the mark, or double it within a text."
            )
        all_ends = np.flatnonzero(newline)
        newline &= outside
        is_sep &= np.r_[True, outside[:-1]] if separator == " " else outside
        numbers = all_ends
    ends = np.flatnonzero(newline)
    if not text.endswith(b"\n"):
        ends = np.r_[ends, len(text)]
    begins = np.r_[0, ends[:-1] + 1] if len(ends) else np.zeros(0, np.int64)
    if not len(begins):
        return _Rows(begins, ends, begins, begins, np.zeros(0, bool))
    seps = np.flatnonzero(is_sep)
    at = np.searchsorted(seps, np.r_[begins, len(text)])
    cells = np.diff(at) + (separator != " ")
    blank = ~np.logical_or.reduceat(np.r_[visible, False], np.minimum(begins, len(text)))
    row = np.arange(1, len(begins) + 1) if numbers is None else 1 + np.searchsorted(numbers, begins)
    return _Rows(begins, ends, row, cells, blank)


def _unclosed(text: bytes) -> str:
    """Where a quotation mark is not closed: the first row with an odd number of them."""
    for row, line in enumerate(text.split(b"\n"), 1):
        if line.count(b'"') % 2:
            return f"row {row}"
    return "row 1"


def _kept(body: _Body, rows: _Rows, layout: Layout) -> NDArray[np.bool_]:
    """Which rows are the table's; rows of another length are refused."""
    text, header = body.text, layout.header
    keep = ~rows.blank
    keep[: layout.first] = False
    codes = np.frombuffer(text, np.uint8)
    first = codes[np.minimum(rows.begins, len(text) - 1)]
    remarks = keep & np.isin(first, [ord("#"), ord("%")])
    keep &= ~remarks
    if header >= 0:
        line = text[rows.begins[header] : rows.ends[header]]
        like = np.flatnonzero(
            keep & (rows.ends - rows.begins == len(line)) & (first == (line[:1] or b"\0")[0])
        )
        again = [k for k in like.tolist() if text[rows.begins[k] : rows.ends[k]] == line]
        keep[again] = False
        if again:
            rows.notes.append(f"the header stands again in row {rows.numbers[again[0]]}: left out")
    if remarks.any():
        rows.notes.append(f"rows of remarks are left out, first row {rows.numbers[np.argmax(remarks)]}")
    closing = 0
    values = (
        [j for j, cell in enumerate(_cells(body, rows, layout.first)) if is_value(cell)] if keep.any() else []
    )
    for k in np.flatnonzero(keep)[::-1][:CLOSING].tolist():
        cells = _cells(body, rows, k)
        begin = next((j for j, cell in enumerate(cells) if cell), 0)
        name = cells[begin] if cells else ""
        if is_value(name) or name.casefold() in BLANK or begin not in values or keep[: k + 1].sum() < 2:
            break
        keep[k], closing = False, k
    if closing:
        rows.notes.append(f"rows from {rows.numbers[closing]} on are no rows of the table: left out")
    wrong = np.flatnonzero(keep & (rows.cells != layout.width))
    if len(wrong):
        k = int(wrong[0])
        such = f" ({len(wrong)} such rows)" if len(wrong) > 1 else ""
        place = (
            f"the header (row {rows.numbers[header]})" if header >= 0 else f"row {rows.numbers[layout.first]}"
        )
        raise InputError(
            f"{body.path}: row {rows.numbers[k]} has {rows.cells[k]} cells, {place} has {layout.width}{such}. Separate "
            f"cells by {SEPARATORS[body.separator]}, write decimals with a point, and complete or delete the row."
        )
    _check_quotes(body, rows, keep, layout.width)
    return keep


def _cells(body: _Body, rows: _Rows, k: int) -> list[str]:
    return (
        split(body.text[rows.begins[k] : rows.ends[k]].decode(), body.separator)
        if k < len(rows.begins)
        else []
    )


def _check_quotes(body: _Body, rows: _Rows, keep: NDArray[np.bool_], width: int) -> None:
    """Refuse a row of which a cell holds whole rows: a quotation mark that was opened and never closed."""
    for k in np.flatnonzero(keep[:-1] & (np.diff(rows.numbers) > 1)).tolist():
        inner = body.text[rows.begins[k] : rows.ends[k]].decode().split("\n")[1:-1]
        if any(line.count(body.separator) >= width - 1 for line in inner):
            raise InputError(
                f"{body.path}: row {rows.numbers[k]}: a quotation mark is not closed, and the rows behind it are one "
                "cell. Delete the mark, or double it within a text."
            )


def _parsed(
    path: Path, text: bytes, separator: str, width: int, places: Sequence[int], decimal: str, unsure: str
) -> pd.DataFrame:
    """Columns of a text as pandas reads them: numbers, or texts where a cell is none; all texts if ``unsure``."""
    import pandas as pd

    if not text:
        return pd.DataFrame({place: pd.Series(dtype=float) for place in places})
    blanks = sorted({form(cell) for cell in BLANK for form in (str, str.upper, str.capitalize, _camel)})
    try:
        return pd.read_csv(
            io.BytesIO(text),
            sep=r"\s+" if separator == " " else separator,
            header=None,
            names=list(range(width)),
            usecols=sorted(set(places)),
            index_col=False,
            dtype=str if unsure else None,
            decimal=decimal,
            keep_default_na=False,
            na_values=[] if unsure else blanks,
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
            encoding="utf-8",
        )
    except (pd.errors.ParserError, ValueError) as error:
        raise InputError(
            f"{path}: {str(error).strip().splitlines()[0]}. Export the table as plain CSV."
        ) from error


def _camel(cell: str) -> str:
    return {"nan": "NaN"}.get(cell, cell)


def _all_blank(head: pd.Series) -> bool:
    return all(is_blank(cell) for cell in head)


def _proven(body: bytes, mark: str) -> str:
    """A cell whose mark is a decimal one, since no mark between thousands stands so; empty without."""
    one, other = mark, "." if mark == "," else ","
    number = (
        rf"(?<![\d.,:\-/])(?:\d+[{one}](?:\d{{1,2}}|\d{{4,}})|(?:0\d*|\d{{4,}})[{one}]\d{{3}}|"
        rf"\d{{1,3}}(?:[{other}'’ ]\d{{3}})+[{one}]\d*|\d*[{one}]\d+[eE][+-]?\d+)(?![\d.,:\-/])"
    )
    found = re.search(number.encode(), body)
    return found[0].decode(errors="replace") if found else ""


def _is_cut(cells: Sequence[str], values: Array) -> bool:
    """Whether the last cell is shorter than others, and its number far from what is due."""
    if len(values) < 4 or not np.isfinite(values[-1]):
        return False
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is out of its range
        steps = np.abs(np.diff(values))
    jumps = bool(steps[-1] > CUT * float(np.nanmax(steps[:-1], initial=0.0)))
    decimals = {_decimals(cell) for cell in cells[:-1]}
    fewer = len(decimals) == 1 and _decimals(cells[-1]) < max(decimals)
    return fewer or (jumps and len(cells[-1]) < len(cells[-2]))


def _decimals(cell: str) -> int:
    """Characters behind a number's decimal mark."""
    return len(re.split("[.,]", cell)[-1]) if re.search("[.,]", cell) else 0
