"""A recording's file opened, whatever its format, and CSV files written. Nothing in these files is executed.

What would take too much memory is refused before it is unpacked.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import importlib
import io
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import nn_export.files
from hybrid_mpc.data.source import EMPTY, LARGEST, LISTED, Source, megabytes
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import write_text
from hybrid_mpc.records import shown

Array = NDArray[np.float64]
ENDINGS = (  # endings that a message lists of a folder's files
    ".csv", ".txt", ".npz", ".mat", ".xlsx", ".parquet", ".feather", ".h5", ".mf4", ".tdms", ".mcap", ".bag", ".ulg"
)  # fmt: skip
CHUNK = 2**20  # bytes of a file that are checked at a time [byte]
LONGEST_ROW = 2**20  # longest row of a text file [byte]: ten thousand columns of a hundred characters


BEGINS = (  # how files of a format begin, and what reads them
    (re.compile(rb"PAR1|ARROW1"), ("sheets", "arrow_source")),
    (re.compile(rb"\x89HDF\r\n\x1a\n"), ("hdf5", "hdf5_source")),
    (re.compile(rb"MATLAB (5.0|7.3) MAT-file"), ("matlab", "mat_source")),
    (
        re.compile(
            rb"MDF     |TDSm|\x89MCAP0\r\n|#ROSBAG V2|SQLite format 3|ULog\x01\x125|LOGG|"
            rb"date .*\r?\n\s*base (hex|dec)|\(\d+\.\d+\) \S+ [0-9A-Fa-f]+#|;\$FILEVERSION"
        ),
        ("loggers", "logger_source"),
    ),
)
ENDS = {  # the same by their ending, for formats that do not say what they are
    ".npz": ("vectors", "npz_source"),
    ".mat": ("matlab", "mat_source"),
    ".xlsx": ("sheets", "excel_source"),
    ".xlsm": ("sheets", "excel_source"),
}
OTHERS = (  # formats that are not read
    (re.compile(rb"\xd0\xcf\x11\xe0"), "an old Excel workbook"),
    (re.compile(rb"PK\x03\x04.{26}mimetypeapplication/vnd\.oasis", re.DOTALL), "an OpenDocument file"),
)


def opened(path: Path) -> Source:
    """Open a recording's file: by its ending, by how it begins, else as a table of text.

    ==================  ==================================================================================
    ``.npz``            named vectors (``numpy.savez``); objects are refused
    ``.mat``            MATLAB's vectors and matrices, v4 to v7.3; a struct's fields are ``struct.field``
    ``.xlsx``           the table of a workbook
    Parquet, Feather    columns
    HDF5                datasets: vectors, matrices, tables
    loggers             MDF, TDMS, ROS bags, MCAP, PX4 and CAN logs: :mod:`hybrid_mpc.data.loggers`
    any other           a table of text: :mod:`hybrid_mpc.data.text`
    ==================  ==================================================================================
    """
    reader = ENDS.get(path.suffix.lower())
    content = _content(path, reader is None)
    if reader is None:
        reader = next((found for begin, found in BEGINS if begin.match(content)), ("text", "text_source"))
    if other := next((what for begin, what in OTHERS if begin.match(content)), ""):
        raise InputError(
            f"{path}: is {other}, which is not read. Save the table as .xlsx or as CSV (UTF-8). [HM-DATA-023]"
        )
    module = importlib.import_module(f"hybrid_mpc.data.{reader[0]}")
    source: Source = getattr(module, reader[1])(path, content, hashlib.sha256(content).hexdigest())
    return source


def _content(path: Path, is_text: bool) -> bytes:
    """The bytes of a regular file; rows of text have a bearable length, which is seen before any is kept.

    Pipes and devices are refused: nothing says how long they are, and they may never end.
    """
    try:
        with nn_export.files.opened(path, LARGEST) as (file, size):
            left, longest = size if is_text else 0, 0
            while left > 0 and (piece := file.read(min(CHUNK, left))):
                if left == size and any(begin.match(piece) for begin, _ in BEGINS):
                    break  # what is no text has no rows
                first, *others = map(len, piece.replace(b"\r", b"\n").split(b"\n"))
                if max(longest + first, *others, 0) > LONGEST_ROW:
                    raise InputError(
                        f"{path}: has a row of more than {megabytes(LONGEST_ROW)}. Write one line a sample, with the "
                        "columns that are needed. [HM-DATA-024]"
                    )
                longest = others[-1] if others else longest + first
                left -= len(piece)
            file.seek(0)
            content = file.read(size)
    except FileNotFoundError:
        raise InputError(
            f"{path}: there is no such file{_beside(path)}. Check the path given with --data. [HM-DATA-025]"
        ) from None
    except OSError as error:
        large = error.errno == errno.EFBIG
        remedy = (
            "Split the recording, or leave out columns that are not needed."
            if large
            else "Give a readable file."
        )
        raise InputError(f"{path}: cannot be read ({error.strerror}). {remedy} [HM-DATA-026]") from error
    if not content or content.isspace():
        raise InputError(f"{path}: {EMPTY} [HM-DATA-027]")
    return content


def _beside(path: Path) -> str:
    """Recordings in the folder of a missing one, for a message."""
    try:
        near = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in ENDINGS)
    except OSError:
        return ""
    return f"; that folder has: {', '.join(near[:LISTED])}" if near else ""


MOST_DECIMALS = 17  # most digits after the point that are written: a float has no more


def real_numbers(values: object, name: str) -> Array:
    """Numbers as a float array.

    Raises:
        InputError: If they are none; ``name`` says what they are.
    """
    try:
        given = np.asarray(values)
        if given.dtype.kind in "biufO":
            return np.asarray(given, dtype=np.float64)
    except Exception as error:  # whatever an object of anybody's raises where it is asked for its numbers
        raise InputError(f"{name}: numbers are needed, got {type(values).__name__} [HM-DATA-028]") from error
    raise InputError(
        f"{name}: numbers are needed, got {type(values).__name__} of {given.dtype} [HM-DATA-029]"
    )


def write_csv(path: Path | str, columns: Mapping[str, Array], *, decimals: int | None = None) -> Path:
    r"""Write columns of equal length as CSV: all of it or nothing, the same data as the same bytes; the path.

    Args:
        path: File to write; its folder is made if need be, an old file of that name is replaced.
        columns: Values ``(m,)`` by column name.
        decimals: Digits after the point. Default: ten significant digits.

    Raises:
        InputError: If the columns differ in length or are not one-dimensional, or there is no such path or number of
            decimals.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_csv(Path(folder) / "a.csv", {"t": np.array([0.0, 0.1])}).read_text()
        't\n0\n0.1\n'
    """
    if not isinstance(path, str | Path) or not Path(path).name:
        raise InputError(f"write_csv: the path of a file is needed, got {path!r:.80} [HM-DATA-030]")
    if not isinstance(columns, Mapping):
        raise InputError(f"write_csv: columns by name are needed, got {type(columns).__name__} [HM-DATA-031]")
    if decimals is not None and not (type(decimals) is int and 0 <= decimals <= MOST_DECIMALS):
        raise InputError(
            f"write_csv: decimals from 0 to {MOST_DECIMALS} are needed, got {type(decimals).__name__} [HM-DATA-032]"
        )
    path = Path(path)
    arrays = {n: real_numbers(column, f"write_csv: column {shown(str(n))}") for n, column in columns.items()}
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) != 1 or any(len(shape) != 1 for shape in shapes.values()):
        raise InputError(
            f"{path}: columns must be one-dimensional and of one length, got {shapes} [HM-DATA-033]"
        )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(arrays)
    for row in zip(*arrays.values(), strict=True):
        # + 0.0: no "-0"
        writer.writerow([f"{x + 0.0:.10g}" if decimals is None else f"{x:.{decimals}f}" for x in row])
    write_text(path, text.getvalue())
    return path
