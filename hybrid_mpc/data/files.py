"""Open a recording's file in any supported format, and write CSV files. No content of a file is executed.

A file that would take too much memory is refused before it is unpacked.
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
ENDINGS = (  # endings of files that a message lists
    ".csv", ".txt", ".npz", ".mat", ".xlsx", ".parquet", ".feather", ".h5", ".mf4", ".tdms", ".mcap", ".bag", ".ulg"
)  # fmt: skip
CHUNK = 2**20  # bytes of a file that are checked at once [byte]
LONGEST_ROW = 2**20  # longest row of a text file [byte]: ten thousand columns of a hundred characters


BEGINS = (  # first bytes of a format, and the function that reads it
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
ENDS = {  # the same by file ending, for formats without typical first bytes
    ".npz": ("vectors", "npz_source"),
    ".mat": ("matlab", "mat_source"),
    ".xlsx": ("sheets", "excel_source"),
    ".xlsm": ("sheets", "excel_source"),
}
OTHERS = (  # formats without support
    (re.compile(rb"\xd0\xcf\x11\xe0"), "an old Excel workbook"),
    (re.compile(rb"PK\x03\x04.{26}mimetypeapplication/vnd\.oasis", re.DOTALL), "an OpenDocument file"),
)


def opened(path: Path) -> Source:
    """Open a recording's file: by its ending, else by its first bytes, else as a table of text.

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
            f"{path}: {other} is not supported. Save the table as .xlsx or as CSV (UTF-8). [HM-DATA-023]"
        )
    module = importlib.import_module(f"hybrid_mpc.data.{reader[0]}")
    source: Source = getattr(module, reader[1])(path, content, hashlib.sha256(content).hexdigest())
    return source


def _content(path: Path, is_text: bool) -> bytes:
    """The bytes of a regular file; the length of text rows is checked before any row is kept.

    Pipes and devices are refused: their length is unknown and may be infinite.
    """
    try:
        with nn_export.files.opened(path, LARGEST) as (file, size):
            left, longest = size if is_text else 0, 0
            while left > 0 and (piece := file.read(min(CHUNK, left))):
                if left == size and any(begin.match(piece) for begin, _ in BEGINS):
                    break  # a binary file has no rows
                first, *others = map(len, piece.replace(b"\r", b"\n").split(b"\n"))
                if max(longest + first, *others, 0) > LONGEST_ROW:
                    raise InputError(
                        f"{path}: a row is longer than {megabytes(LONGEST_ROW)}. Write one line per sample, and only "
                        "the columns that are needed. [HM-DATA-024]"
                    )
                longest = others[-1] if others else longest + first
                left -= len(piece)
            file.seek(0)
            content = file.read(size)
    except FileNotFoundError:
        raise InputError(
            f"{path}: file not found{_beside(path)}. Check the path given with --data. [HM-DATA-025]"
        ) from None
    except OSError as error:
        large = error.errno == errno.EFBIG
        remedy = (
            "Split the recording, or delete columns that are not needed."
            if large
            else "Give a readable file."
        )
        raise InputError(
            f"{path}: the file cannot be read ({error.strerror}). {remedy} [HM-DATA-026]"
        ) from error
    if not content or content.isspace():
        raise InputError(f"{path}: {EMPTY} [HM-DATA-027]")
    return content


def _beside(path: Path) -> str:
    """Recordings in the folder of a missing file, for a message."""
    try:
        near = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in ENDINGS)
    except OSError:
        return ""
    return f"; its folder contains {', '.join(near[:LISTED])}" if near else ""


MOST_DECIMALS = 17  # largest number of decimals: a double has no more


def real_numbers(values: object, name: str) -> Array:
    """Convert numbers to a float array.

    Raises:
        InputError: If ``values`` are not numbers; the message begins with ``name``.
    """
    try:
        given = np.asarray(values)
        if given.dtype.kind in "biufO":
            return np.asarray(given, dtype=np.float64)
    except Exception as error:  # numpy passes on any exception of a user's object
        raise InputError(
            f"{name}: must be numbers, got {type(values).__name__}. Give an array of numbers. [HM-DATA-028]"
        ) from error
    raise InputError(
        f"{name}: must be numbers, got {type(values).__name__} of {given.dtype}. Give an array of numbers. "
        "[HM-DATA-029]"
    )


def write_csv(path: Path | str, columns: Mapping[str, Array], *, decimals: int | None = None) -> Path:
    r"""Write columns of equal length as CSV, whole or not at all; equal data give equal bytes. Returns the path.

    Args:
        path: File to write. A missing folder is created, an old file is replaced.
        columns: Values ``(m,)`` by column name.
        decimals: Digits after the point. Default: ten significant digits.

    Raises:
        InputError: If columns differ in length or are not one-dimensional, or ``path`` or ``decimals`` is invalid.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_csv(Path(folder) / "a.csv", {"t": np.array([0.0, 0.1])}).read_text()
        't\n0\n0.1\n'
    """
    if not isinstance(path, str | Path) or not Path(path).name:
        raise InputError(f"write_csv: path must name a file, got {path!r:.80} [HM-DATA-030]")
    if not isinstance(columns, Mapping):
        raise InputError(
            f"write_csv: columns must be a dict of values by column name, got {type(columns).__name__} [HM-DATA-031]"
        )
    if decimals is not None and not (type(decimals) is int and 0 <= decimals <= MOST_DECIMALS):
        raise InputError(
            f"write_csv: decimals must be an integer from 0 to {MOST_DECIMALS}, got {type(decimals).__name__} "
            "[HM-DATA-032]"
        )
    path = Path(path)
    arrays = {n: real_numbers(column, f"write_csv: column {shown(str(n))}") for n, column in columns.items()}
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) != 1 or any(len(shape) != 1 for shape in shapes.values()):
        raise InputError(
            f"{path}: columns must be one-dimensional and equally long, got {shapes} [HM-DATA-033]"
        )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(arrays)
    for row in zip(*arrays.values(), strict=True):
        # + 0.0: no "-0"
        writer.writerow([f"{x + 0.0:.10g}" if decimals is None else f"{x:.{decimals}f}" for x in row])
    write_text(path, text.getvalue())
    return path
