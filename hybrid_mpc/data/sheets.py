"""Excel workbooks, Parquet and Feather files as sources."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybrid_mpc.data.frames import HEAD, Frame
from hybrid_mpc.data.layout import MOST_SEEN, STEADY, Layout, Look, layout_of
from hybrid_mpc.data.source import LARGEST, LISTED, Source, line_of, megabytes
from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.records import shown

if TYPE_CHECKING:
    import pandas as pd

UNPACKED = 50  # largest ratio of unpacked bytes of a workbook to bytes of its file
MOST_CELLS = 20_000_000  # most cells of a sheet: each takes a hundred bytes of memory


def excel_source(path: Path, content: bytes, sha256: str) -> Source:
    """Read the table of a workbook; formulas are not evaluated, their stored values are read."""
    with named_extra(f"{path}: reading Excel files"):
        import openpyxl
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            size = sum(one.file_size for one in archive.infolist())
        if size > min(LARGEST, max(2**28, UNPACKED * len(content))):
            raise ValueError(f"the workbook unpacks to {megabytes(size)} [HM-DATA-075]")
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True, keep_links=False)
        sheets = {name: _cells_of(book[name]) for name in book.sheetnames if hasattr(book[name], "iter_rows")}
    except InputError:
        raise
    except Exception as error:  # openpyxl raises many kinds of exceptions for a damaged workbook
        raise InputError(
            f"{path}: not a valid Excel workbook, damaged or too large ({line_of(error)}). Save the table as CSV "
            "(UTF-8). [HM-DATA-076]"
        ) from error
    found = {}
    for name, rows in sheets.items():
        looks = [Look(k, [_written(cell) for cell in row]) for k, row in enumerate(rows[:MOST_SEEN])]
        wide = max((len(look.cells) for look in looks), default=0)
        looks = [Look(look.row, look.cells + [""] * (wide - len(look.cells))) for look in looks]
        score, layout = layout_of(looks, False, lambda row: [], lambda row: row + 1)
        if score >= STEADY:
            found[name] = len(rows), layout
    order = sorted(found, key=lambda name: -found[name][0])
    if not order:
        raise InputError(
            f"{path}: no sheet has a table of numbers. Save the table alone, with a header above it. [HM-DATA-077]"
        )
    # rows of the sheet that is read, over those of any other sheet with a table
    if len(order) > 1 and found[order[0]][0] < 10 * found[order[1]][0]:
        raise InputError(
            f"{path}: {len(order)} sheets have tables ({', '.join(map(shown, order[:LISTED]))}). Save the sheet "
            "to read in a workbook of its own. [HM-DATA-078]"
        )
    layout = found[order[0]][1]
    if isinstance(layout, str):
        raise InputError(f"{path}: sheet {shown(order[0])}: {layout} [HM-DATA-079]")
    note = [f"sheet {shown(order[0])}"] if len(sheets) > 1 else []
    return _frame_of(path, sheets[order[0]], layout, note).source(sha256)


def _cells_of(sheet: Any) -> list[tuple[Any, ...]]:
    rows, count = [], 0
    for row in sheet.iter_rows(values_only=True):
        count += len(row)
        if count > MOST_CELLS:
            raise ValueError(f"a sheet has more than {MOST_CELLS} cells [HM-DATA-080]")
        rows.append(row)
    return rows


def _written(cell: Any) -> str:
    return "" if cell is None else str(cell).strip()


def _frame_of(path: Path, rows: Sequence[tuple[Any, ...]], layout: Layout, notes: Sequence[str]) -> Frame:
    """The rows of a sheet below its header, without blank rows and without closing remarks."""
    import pandas as pd

    numbers = [k for k in range(layout.first, len(rows)) if any(_written(cell) for cell in rows[k])]
    words = [isinstance(next((c for c in rows[k] if c is not None), None), str) for k in numbers]
    closing: list[int] = []
    while len(numbers) > 2 and words[len(numbers) - 1] and not words[0]:
        closing.append(numbers.pop() + 1)
    notes = [*notes, *layout.notes]
    if closing:
        notes.append(f"rows from {closing[-1]} on are not part of the table and are ignored")
    seen = [j for j, name in enumerate(layout.names) if name]

    def cell(k: int, j: int) -> Any:
        row = rows[numbers[k]]
        return row[seen[j]] if seen[j] < len(row) else None

    def columns(places: Sequence[int], most: int | None = None) -> list[pd.Series]:
        return [pd.Series([cell(k, j) for k in range(len(numbers[:most]))]) for j in places]

    names, heads = tuple(layout.names[j] for j in seen), columns(range(len(seen)), HEAD)
    count = [k + 1 for k in numbers]
    return Frame(path, names, columns, heads, count, lambda k, j: _written(cell(k, j)), notes=tuple(notes))


# Columns of Arrow


def arrow_source(path: Path, content: bytes, sha256: str) -> Source:
    """Read a Parquet or Feather file; its declared size is checked before it is unpacked."""
    with named_extra(f"{path}: reading Parquet and Feather files"):
        import pandas as pd
        import pyarrow
    kinds, ipc = pyarrow.types, pyarrow.ipc
    try:
        if content.startswith(b"PAR1"):
            from pyarrow.parquet import ParquetFile

            file = ParquetFile(io.BytesIO(content))
            schema, rows = file.schema_arrow, file.metadata.num_rows
        else:
            none = ipc.open_file(io.BytesIO(content), options=ipc.IpcReadOptions(included_fields=[]))
            file, schema, rows = None, ipc.open_file(io.BytesIO(content)).schema, none.read_all().num_rows
        names = tuple(
            field.name
            for field in schema
            if not (kinds.is_nested(field.type) or kinds.is_binary(field.type))
            and schema.names.count(field.name) == 1
        )
        if 8 * rows * max(1, len(names)) > LARGEST:
            raise InputError(
                f"{path}: {rows} rows are more than can be read from one file. Split the recording. [HM-DATA-081]"
            )
        if file is None:
            own = ipc.IpcReadOptions(included_fields=[schema.get_field_index(name) for name in names])
            table = ipc.open_file(io.BytesIO(content), options=own).read_all()
        else:
            table = file.read(list(names))
        whole = [pd.Series(table.column(name).to_pandas()) for name in names]
    except InputError:
        raise
    except Exception as error:  # pyarrow raises many kinds of exceptions for a damaged file
        raise InputError(
            f"{path}: not a valid Parquet or Feather file, or damaged ({line_of(error)}). Write it again, e.g. with "
            "pandas. [HM-DATA-082]"
        ) from error
    frame = Frame(
        path,
        names,
        lambda places: [whole[j] for j in places],
        [column.iloc[:HEAD] for column in whole],
        range(1, rows + 1),
        lambda k, j: _written(whole[j].iloc[k]),
    )
    return frame.source(sha256)
