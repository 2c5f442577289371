"""Tables of text: any separator and decimal mark, preambles, closing rows, remarks.

:func:`hybrid_mpc.data.layout.layout_of` finds the table in the first rows; pandas reads it. Unambiguous files are read,
and ``Source.notes`` says how; ambiguous ones are refused.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.cells import BLANK, is_value
from hybrid_mpc.data.frames import HEAD, Frame, is_blank
from hybrid_mpc.data.layout import MOST_SEEN, Layout, Look, layout_of
from hybrid_mpc.data.source import EMPTY, LARGEST, Source
from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.records import shown

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "vertical bars", " ": "blanks"}
SAMPLE = 2**17  # bytes at the beginning of a text in which the table is searched
BLANKS = sorted({form(cell) for cell in BLANK for form in (str, str.upper, str.capitalize)} | {"NaN"})
UNCLOSED = (
    "a quotation mark is not closed, so the rows after it form one cell. Delete the mark, or double a mark within a "
    "text."
)


def text_source(path: Path, content: bytes, sha256: str) -> Source:
    """Open a text file as a source."""
    with named_extra(f"{path}: reading tables"):
        import pandas  # noqa: F401  (a missing package is reported before any work)
    text, notes = _decoded(path, content)
    if not text.strip():
        raise InputError(f"{path}: {EMPTY} [HM-DATA-088]")
    sample = text[:SAMPLE]
    best: tuple[float, bool, int, str, Layout | str] | None = None
    tops: dict[str, Look] = {}
    for separator in SEPARATORS:
        rows = _Rows(path, sample, separator, whole=False)
        looks = [Look(k, rows.cells(k)) for k in range(min(MOST_SEEN, len(rows.begins) - (sample != text)))]
        tops[separator] = next((look for look in looks if look.filled), Look(0, []))
        score, layout = layout_of(looks, separator != ",", rows.splits, lambda k, rows=rows: rows.number(k))  # type: ignore[misc]
        headed, width = isinstance(layout, Layout) and layout.header >= 0, getattr(layout, "width", 0)
        if layout and (best is None or (score, headed, width) > best[:3]):
            best = score, headed, width, separator, layout
    if best is None:  # no rows of numbers: only a header
        separator = max([*SEPARATORS][:-1], key=lambda one: len(tops[one].cells))
        separator = separator if len(tops[separator].cells) > 1 else " "
        row, cells = tops[separator]
        best = 0.0, True, len(cells), separator, Layout(row, row + 1, tuple(cells), len(cells))
    *_, separator, layout = best
    if isinstance(layout, str):
        raise InputError(f"{path}: {layout} [HM-DATA-089]")
    return _frame(_Rows(path, text, separator), layout, notes).source(sha256)


def _decoded(path: Path, content: bytes) -> tuple[bytes, list[str]]:
    """The text as UTF-8 with a line feed as the end of each row, and notes about the conversion."""
    notes, marked = [], content.startswith((b"\xff\xfe", b"\xfe\xff"))
    zeros, seen = content[:4096].count(0), len(content[:4096])
    if marked or 3 * zeros > seen > 2 * zeros - 8 > 0:
        kind = "utf-16" if marked else "utf-16-le" if content[1:2] == b"\0" else "utf-16-be"
        try:
            content = content.decode(kind).encode()
        except UnicodeDecodeError as error:
            raise InputError(
                f"{path}: the text is not valid UTF-16. Export the table as CSV (UTF-8). [HM-DATA-090]"
            ) from error
        notes.append("text is UTF-16")
    content = content.removeprefix(b"\xef\xbb\xbf")
    codes = np.frombuffer(content, dtype=np.uint8)
    odd = np.flatnonzero((codes < 32) & ((codes < 9) | (codes > 13)) & (codes != 26))
    if len(odd):
        row = 1 + content.count(b"\n", 0, int(odd[0]))
        raise InputError(
            f"{path}: row {row} is not text. Export the table as CSV (UTF-8), give the file the ending of its "
            "format, or unpack a packed file. [HM-DATA-091]"
        )
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").rstrip(b"\x1a")
    try:
        content.decode()
    except UnicodeDecodeError:
        content = content.decode("cp1252", errors="replace").encode()
        notes.append("text is Latin-1")
    return content, notes


class _Rows:
    """Rows of a text, split by one separator; quoted cells may contain separators and ends of rows.

    ``begins`` and ``ends`` are byte positions, ``numbers`` the row numbers in an editor, ``widths`` the numbers of
    cells.
    """

    def __init__(self, path: Path, text: bytes, separator: str, whole: bool = True) -> None:
        self.path, self.text, self.separator = path, text, separator
        codes = np.frombuffer(text, np.uint8)
        newline = codes == 10
        lines = np.flatnonzero(newline)
        visible = (codes > 32) & (codes != 34)
        is_sep = codes == ord(separator)
        if separator == " ":  # a cell begins at a visible character after a blank
            marks = visible | (codes == 34)
            is_sep = marks & ~np.r_[False, marks[:-1]]
        else:
            visible &= ~is_sep
        if b'"' in text:
            outside = (np.cumsum(codes == 34, dtype=np.uint8) & 1) == 0
            if whole and not outside[-1]:
                odd = (k for k, line in enumerate(text.split(b"\n"), 1) if line.count(b'"') % 2)
                raise InputError(f"{path}: row {next(odd, 1)}: {UNCLOSED} [HM-DATA-092]")
            newline = newline & outside
            is_sep = is_sep & (np.r_[True, outside[:-1]] if separator == " " else outside)
        ends = np.flatnonzero(newline)
        self.ends = ends if text.endswith(b"\n") else np.r_[ends, len(text)]
        self.begins = np.r_[0, self.ends + 1][: len(self.ends)]
        self.numbers = 1 + np.searchsorted(lines, self.begins)
        at = np.searchsorted(np.flatnonzero(is_sep), np.r_[self.begins, len(text)])
        self.widths = np.diff(at) + (separator != " ")
        self.blank = ~np.logical_or.reduceat(np.r_[visible, False], self.begins)

    def number(self, k: int) -> int:
        """The number of a row."""
        return int(self.numbers[k]) if k < len(self.numbers) else k + 1

    def line(self, k: int) -> bytes:
        """A row as written."""
        return self.text[self.begins[k] : self.ends[k]]

    def cells(self, k: int) -> list[str]:
        """The cells of a row."""
        return split(self.line(k).decode(errors="replace"), self.separator) if k < len(self.begins) else []

    def splits(self, k: int) -> list[list[str]]:
        """The cells of a row for all other separators."""
        line = self.line(k).decode(errors="replace")
        ways = [split(line, separator) for separator in SEPARATORS if separator != self.separator]
        return [[cell.strip() for cell in re.split(r"\s{2,}|\t", line.strip())], *ways]

    def kept(self, keep: Mask) -> bytes:
        """The text of the rows in ``keep``."""
        chosen = np.flatnonzero(keep)
        if len(chosen) and len(chosen) == chosen[-1] - chosen[0] + 1:
            return self.text[self.begins[chosen[0]] : self.ends[chosen[-1]]]
        return b"\n".join(map(self.line, chosen.tolist()))

    def of_table(self, layout: Layout, notes: list[str]) -> Mask:
        """Which rows belong to the table; rows with another number of cells are refused."""
        keep, header = ~self.blank, layout.header
        keep[: layout.first] = False
        first = np.frombuffer(self.text, np.uint8)[np.minimum(self.begins, len(self.text) - 1)]
        remarks = keep & np.isin(first, [ord("#"), ord("%")])
        keep &= ~remarks
        if header >= 0:
            line = self.line(header)
            like = keep & (self.ends - self.begins == len(line)) & (first == (line[:1] or b"\0")[0])
            again = [k for k in np.flatnonzero(like).tolist() if self.line(k) == line]
            keep[again] = False
            if again:
                notes.append(f"row {self.numbers[again[0]]} repeats the header and is ignored")
        if remarks.any():
            notes.append(f"rows of remarks are ignored, the first is row {self.numbers[np.argmax(remarks)]}")
        top = self.cells(layout.first) if keep.any() else []
        values, closing = [j for j, cell in enumerate(top) if is_value(cell)], 0
        # most rows behind a table (means, sums, a remark) that are removed
        for k in np.flatnonzero(keep)[::-1][:50].tolist():
            cells = self.cells(k)
            begin = next((j for j, cell in enumerate(cells) if cell), 0)
            name = cells[begin] if cells else ""
            if is_value(name) or name.casefold() in BLANK or begin not in values or keep[: k + 1].sum() < 2:
                break
            keep[k], closing = False, k
        if closing:
            notes.append(f"rows from {self.numbers[closing]} on are not part of the table and are ignored")
        self.check(keep, layout)
        return keep

    def check(self, keep: Mask, layout: Layout) -> None:
        """Refuse rows with another number of cells, and cells that contain whole rows (an unclosed quotation mark)."""
        wrong, header = np.flatnonzero(keep & (self.widths != layout.width)), layout.header
        if len(wrong):
            k, such = int(wrong[0]), f" ({len(wrong)} rows in all)" if len(wrong) > 1 else ""
            place = (
                f"row {self.numbers[layout.first]}"
                if header < 0
                else f"the header (row {self.numbers[header]})"
            )
            raise InputError(
                f"{self.path}: row {self.numbers[k]} has {self.widths[k]} cells, but {place} has {layout.width}{such}. "
                f"Separate cells by {SEPARATORS[self.separator]}, write decimals with a point, and complete or delete "
                "the row. [HM-DATA-093]"
            )
        for k in np.flatnonzero(keep[:-1] & (np.diff(self.numbers) > 1)).tolist():
            inner = self.line(k).decode().split("\n")[1:-1]
            if any(line.count(self.separator) >= layout.width - 1 for line in inner):
                raise InputError(f"{self.path}: row {self.numbers[k]}: {UNCLOSED} [HM-DATA-094]")


def split(line: str, separator: str) -> list[str]:
    """The cells of a row, stripped of blanks."""
    if separator == " " and '"' not in line:
        return line.split()
    cells = line.split(separator)
    if '"' in line:
        try:
            cells = next(csv.reader([line.strip(" ")], delimiter=separator, skipinitialspace=True), [])
        except csv.Error:
            cells = [line]
    return [cell.strip() for cell in cells]


def _frame(rows: _Rows, layout: Layout, done: list[str]) -> Frame:
    """The table of the whole text; ``done`` are earlier notes."""
    path, names, notes = rows.path, layout.names, [*done, *layout.notes]
    keep = rows.of_table(layout, notes)
    chosen, numbers = np.flatnonzero(keep), rows.numbers[keep].tolist()
    count = len(numbers)
    if count * len(names) * 8 > 4 * LARGEST:
        raise InputError(
            f"{path}: {count} rows are more than are read from one file. Split the recording. [HM-DATA-095]"
        )
    body = rows.kept(keep)
    decimal, unsure = _decimal(path, body, rows.separator)
    if decimal == ",":
        notes.append("numbers have a decimal comma")
    head = np.zeros(len(keep), bool)
    head[chosen[:HEAD]] = True
    heads = _parsed(rows, rows.kept(head), layout.width, range(len(names)), ".", ".,")
    seen = [j for j, name in enumerate(names) if name or not all(map(is_blank, heads[j]))]

    def columns(places: Sequence[int]) -> list[pd.Series]:
        frame = _parsed(rows, body, layout.width, [seen[j] for j in places], decimal, unsure)
        return [frame[seen[j]] for j in places]

    def text(k: int, j: int) -> str:
        cells = rows.cells(int(chosen[k]))
        return cells[seen[j]] if seen[j] < len(cells) else ""

    def fault(j: int, values: Array) -> str:
        if unsure and (found := _grouped(columns([j])[0], unsure, decimal, numbers)):
            return found
        last = not rows.text.endswith(b"\n") and seen[j] == len(names) - 1 and len(values) > 4
        # rows before the last one whose decimals are compared with those of the last row
        before = [text(k, j) for k in range(max(0, count - 200), count)] if last else []
        if last and _is_cut(before, values):
            return (
                f"row {numbers[-1]}, COLUMN is {shown(before[-1])}: the file ends within this row, so the number "
                "may be cut in two. Delete the row, or copy the whole file again. [HM-DATA-125]"
            )
        return ""

    own, tops = tuple(names[j] for j in seen), [heads[j] for j in seen]
    return Frame(
        path=path,
        names=own,
        columns=columns,
        head=tops,
        numbers=numbers,
        text=text,
        fault=fault,
        decimal=decimal,
        notes=tuple(notes),
        clock=layout.clock,
    )


def _parsed(
    rows: _Rows, text: bytes, width: int, places: Sequence[int], decimal: str, unsure: str
) -> pd.DataFrame:
    """Columns of a text as pandas reads them: numbers, or texts if a cell is no number or ``unsure`` is given."""
    import pandas as pd

    if not text:
        return pd.DataFrame({place: pd.Series(dtype=float) for place in places})
    try:
        return pd.read_csv(
            io.BytesIO(text),
            sep=r"\s+" if rows.separator == " " else rows.separator,
            header=None,
            names=list(range(width)),
            usecols=sorted(set(places)),
            index_col=False,
            dtype=str if unsure else None,
            decimal=decimal,
            keep_default_na=False,
            na_values=[] if unsure else BLANKS,
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
            encoding="utf-8",
        )
    except (pd.errors.ParserError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"{rows.path}: {reason}. Export the table as plain CSV. [HM-DATA-096]") from error


def _decimal(path: Path, body: bytes, separator: str) -> tuple[str, str]:
    """The decimal mark, and marks that may stand between thousands (single cells cannot tell)."""
    if separator == ",":
        quoted = re.search(rb'"[+-]?\d+,\d+"', body)
        return ("," if quoted and not re.search(rb"\d\.\d", body) else "."), "," if quoted else ""
    point, comma = (_proven(body, mark) for mark in ".,")
    if point and comma:
        raise InputError(
            f"{path}: numbers have both points and commas as decimal marks, e.g. {point} and {comma}. Write the whole "
            "file with one decimal mark. [HM-DATA-097]"
        )
    between = rb"(?<![\d.,:])\d{1,3}[%s]\d{3}(?![\d:])"
    grouped = "".join(mark for mark in ".," if re.search(between % mark.encode(), body))
    if point or comma:
        decimal, other = (".", ",") if point else (",", ".")
        return decimal, other if other in grouped else ""
    return ("," if grouped == "," else "."), grouped


def _proven(body: bytes, mark: str) -> str:
    """A cell in which ``mark`` can only be the decimal mark; empty without one."""
    other = "," if mark == "." else "."
    number = (
        rf"(?<![\d.,:\-/])(?:\d+[{mark}](?:\d{{1,2}}|\d{{4,}})|(?:0\d*|\d{{4,}})[{mark}]\d{{3}}|"
        rf"\d{{1,3}}(?:[{other}'’ ]\d{{3}})+[{mark}]\d*|\d*[{mark}]\d+[eE][+-]?\d+)(?![\d.,:\-/])"
    )
    found = re.search(number.encode(), body)
    return found[0].decode(errors="replace") if found else ""


def _grouped(column: pd.Series, unsure: str, decimal: str, numbers: Sequence[int]) -> str:
    """The fault of a column whose marks may stand between thousands or before decimals; empty without one."""
    texts = column.astype(str).str.strip()
    if not (found := texts.str.contains(f"[{unsure}]", regex=True)).any():
        return ""
    whole = texts.str.fullmatch(r"[+-]?\d{1,3}")
    single = texts.str.fullmatch(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
    certain = decimal not in unsure or len(unsure) > 1  # another column shows another mark
    if not (whole | single | texts.str.casefold().isin(BLANK)).all() or not (whole.any() or certain):
        return ""
    k = int(np.argmax(found.to_numpy()))
    return (
        f"row {numbers[k]}, COLUMN is {shown(texts.iloc[k])}: the mark may be a thousands separator or a decimal mark. "
        "Write one decimal mark, the same number of decimals in all rows, and no thousands separator. [HM-DATA-126]"
    )


def _is_cut(cells: Sequence[str], values: Array) -> bool:
    """Whether the last cell is shorter than others and its number far from the expected one."""
    if len(values) < 4 or not np.isfinite(values[-1]):
        return False
    with np.errstate(over="ignore", invalid="ignore"):  # an overflow is reported as out of range
        steps = np.abs(np.diff(values))
    # step of the last number over a column's largest step, above which the number may be cut in two
    jumps = bool(steps[-1] > 3.0 * float(np.nanmax(steps[:-1], initial=0.0)))
    decimals = [len(re.split("[.,]", cell)[-1]) if re.search("[.,]", cell) else 0 for cell in cells]
    fewer = len(set(decimals[:-1])) == 1 and decimals[-1] < decimals[0]
    return fewer or (jumps and len(cells[-1]) < len(cells[-2]))
