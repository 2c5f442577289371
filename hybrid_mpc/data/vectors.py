"""Files of named vectors, as ``.npz`` and ``.mat`` hold them."""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from hybrid_mpc.data.source import Columns, Source, line_of, megabytes
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import check_npz
from hybrid_mpc.records import shown

Array = NDArray[np.float64]
LARGEST = 2**31
"""Most bytes of numbers in a file [byte]."""
SMALL = 2**26
"""Bytes of numbers that any file may hold [byte], however well they are compressed: 8 million numbers."""
PACKED = 20
"""Beyond ``SMALL``, most bytes of numbers for one byte of a file. Recorded motions are compressed to a tenth at best,
zeros to a thousandth."""


def npz_source(path: Path, content: bytes, sha256: str) -> Source:
    """Named vectors of numpy as a source."""
    if content.startswith(npy.MAGIC_PREFIX):
        raise InputError(
            f"{path}: is no .npz file but one array without a name. Write named vectors with numpy.savez(file, "
            "name=vector, ...)."
        )
    try:
        check_npz(content, 0, ())
        file = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # a damaged archive raises nearly anything
        raise InputError(
            f"{path}: is no .npz file or damaged ({line_of(error)}). Write it with numpy.savez(file, name=vector, ...)."
        ) from error

    def lookup(name: str) -> NDArray[Any]:
        try:
            check_npz(content, budget_of(len(content)), (name,))
            return np.asarray(file[name])
        except Exception as error:
            raise InputError(
                f"{path}: column {shown(name)} cannot be read ({line_of(error)}). Save it as a vector of numbers, "
                "large ones with numpy.savez and not packed; objects are refused, since loading them could run code."
            ) from error

    return vector_source(path, sha256, budget_of(len(content)), tuple(file.files), lookup, "index", 0)


def budget_of(size: int) -> int:
    """Bytes of numbers that a file of this size may hold [byte]."""
    return min(LARGEST, max(SMALL, PACKED * size))


def vector_source(
    path: Path,
    sha256: str,
    budget: int,
    header: tuple[str, ...],
    lookup: Callable[[str], NDArray[Any]],
    row: str,
    first: int,
    note: str = "",
    unread: tuple[str, ...] = (),
) -> Source:
    """A source of vectors of one length, whose rows are counted from ``first``.

    A single number as the time is the sampling time.
    """

    def read(time: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        names = [*([] if time is None else [time]), *wanted]
        columns: list[Array] = []
        problems: list[str] = []
        left = budget
        for name in names:
            try:
                array = lookup(name)
                if time is not None and name == names[0] and array.dtype == np.float16 and array.size > 1:
                    raise InputError(
                        f"{path}: column {shown(name)} has half precision, three digits, which do not tell time stamps "
                        "apart. Save it in double precision."
                    )
                left -= 8 * array.size
                if left < 0:
                    raise InputError(
                        f"{path}: its columns take more than the {megabytes(budget)} of numbers that are "
                        "read from a file of this length. Save it unpacked, or split the recording."
                    )
                columns.append(_vector(path, name, array))
            except InputError as error:
                problems += error.problems
        refuse(problems)
        if time is not None and columns[0].size == 1 and len(columns) > 1:
            columns[0] = _uniform(path, names[0], columns[0].item(), len(columns[1]))
        lengths = dict(zip(names, map(len, columns), strict=True))
        if len(set(lengths.values())) > 1:
            each = ", ".join(f"{shown(name)} {length}" for name, length in lengths.items())
            raise InputError(f"{path}: columns differ in length: {each}. Save vectors of one length.")
        values = np.column_stack(columns)
        found = {}
        for name, column in zip(names, values.T, strict=True):
            bad = np.flatnonzero(np.isinf(column) if name in blanks else ~np.isfinite(column))
            if len(bad):
                found[name] = (
                    f"{row} {bad[0] + first}, column {shown(name)} is {column[bad[0]]:g}, not a finite number "
                    f"({len(bad)} such). Delete the row (longer gaps are cut out) or repair the value."
                )
        values[~np.isfinite(values)] = np.nan
        return Columns(values, row, range(first, first + len(values)), found)

    return Source(path, sha256, header, read, note, unread)


def _vector(path: Path, name: str, array: NDArray[Any]) -> Array:
    if array.dtype.kind not in "biuf":
        what = {"c": "complex numbers", "U": "text", "S": "text", "M": "dates"}.get(array.dtype.kind)
        raise InputError(
            f"{path}: column {shown(name)} holds {what or 'cells or other objects'}, not real numbers. "
            "Save it as a vector of numbers."
        )
    if array.size and sum(length != 1 for length in array.shape) > 1:
        raise InputError(
            f"{path}: column {shown(name)} has the shape {array.shape}, not that of a vector. Save each of its columns "
            "under a name of its own."
        )
    return np.asarray(array, dtype=np.float64).ravel()


def _uniform(path: Path, name: str, dt: float, m: int) -> Array:
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(
            f"{path}: column {shown(name)} is the single number {dt:g}; as a sampling time [s] it must be positive. "
            "Give that, or a vector of time stamps."
        )
    return dt * np.arange(m, dtype=np.float64)
