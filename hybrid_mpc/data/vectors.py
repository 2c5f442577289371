"""Files of named vectors: ``.npz``, ``.mat`` and HDF5."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from hybrid_mpc.data.names import said_by
from hybrid_mpc.data.source import LARGEST, LISTED, TIME, Columns, Series, Source, clocked, line_of, megabytes
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import check_npz
from hybrid_mpc.records import shown

Array = NDArray[np.float64]
SMALL = 2**26
"""Bytes of numbers that any file may hold [byte], however well compressed: 8 million numbers."""
PACKED = 20
"""Above ``SMALL``, most bytes of numbers per byte of the file. Recorded motions compress to a tenth at best, zeros to a
thousandth."""


def npz_source(path: Path, content: bytes, sha256: str) -> Source:
    """Open named vectors of numpy as a source."""
    if content.startswith(npy.MAGIC_PREFIX):
        raise InputError(
            f"{path}: the file is one array without a name, not an .npz file. Write named vectors with "
            "numpy.savez(file, name=vector, ...). [HM-DATA-105]"
        )
    try:
        check_npz(content, 0, ())
        file = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # numpy raises many kinds of exceptions for a damaged archive
        raise InputError(
            f"{path}: not a valid .npz file, or damaged ({line_of(error)}). Write it with "
            "numpy.savez(file, name=vector, ...). [HM-DATA-106]"
        ) from error

    def lookup(name: str) -> NDArray[Any]:
        try:
            check_npz(content, budget_of(len(content)), (name,))
            return np.asarray(file[name])
        except Exception as error:
            raise InputError(
                f"{path}: column {shown(name)} cannot be read ({line_of(error)}). Save a vector of numbers; save large "
                "vectors with numpy.savez, uncompressed. Objects are refused, since loading them could run code."
                " [HM-DATA-107]"
            ) from error

    return vector_source(path, sha256, budget_of(len(content)), tuple(file.files), lookup, "index", 0)


def budget_of(size: int) -> int:
    """Bytes of numbers that a file of ``size`` bytes may hold [byte]."""
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
    """A source of vectors of equal length; rows are counted from ``first``.

    If the time is a single number, it is the sampling period.
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
                        f"{path}: column {shown(name)} has half precision, too coarse for time stamps (three digits). "
                        "Save the column in double precision. [HM-DATA-108]"
                    )
                left -= 8 * array.size
                if left < 0:
                    raise InputError(
                        f"{path}: the columns take more than {megabytes(budget)} of numbers, the limit for a file of "
                        "this size. Save the file uncompressed, or split the recording. [HM-DATA-109]"
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
            raise InputError(
                f"{path}: columns differ in length: {each}. Save vectors of equal length. [HM-DATA-110]"
            )
        values = np.column_stack(columns)
        found = {}
        for name, column in zip(names, values.T, strict=True):
            bad = np.flatnonzero(np.isinf(column) if name in blanks else ~np.isfinite(column))
            if len(bad):
                found[name] = (
                    f"{row} {bad[0] + first}, column {shown(name)} is {column[bad[0]]:g}, not a finite number "
                    f"({len(bad)} in all). Correct the value or delete the row (gaps above max_gap are cut out). "
                    "[HM-DATA-124]"
                )
        values[~np.isfinite(values)] = np.nan
        return Columns(values, row, range(first, first + len(values)), found)

    return Source(path, sha256, header, read, note, unread)


def _vector(path: Path, name: str, array: NDArray[Any]) -> Array:
    if array.dtype.kind not in "biuf":
        what = {"c": "complex numbers", "U": "text", "S": "text", "M": "dates"}.get(array.dtype.kind)
        raise InputError(
            f"{path}: column {shown(name)} contains {what or 'cells or other objects'}, not real numbers. Save a "
            "vector of numbers. [HM-DATA-111]"
        )
    if array.size and sum(length != 1 for length in array.shape) > 1:
        raise InputError(
            f"{path}: column {shown(name)} has shape {array.shape} and is not a vector. Save each column of the array "
            "under its own name. [HM-DATA-112]"
        )
    return np.asarray(array, dtype=np.float64).ravel()


def _uniform(path: Path, name: str, dt: float, m: int) -> Array:
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(
            f"{path}: column {shown(name)} is the single number {dt:g}, which is not a positive sampling period [s]. "
            "Give a positive number, or a vector of time stamps. [HM-DATA-113]"
        )
    return dt * np.arange(m, dtype=np.float64)


# Variables, fields and datasets


MOST_STRUCTS = 100  # most elements of an array of structs or cells that are read
OBJECTS = "objects"
CONVERT = {  # MATLAB code that converts an object to vectors, by its class
    "timeseries": "t = {0}.Time; y = {0}.Data; save('{1}', 't', 'y', '-v7')",
    "timetable": "t = seconds({0}.Properties.RowTimes - {0}.Properties.RowTimes(1)); "
    "s = table2struct(timetable2table({0}, 'ConvertRowTimes', false), 'ToScalar', true); save('{1}', 't', 's', '-v7')",
    "table": "s = table2struct({0}, 'ToScalar', true); save('{1}', 's', '-v7')",
    "iddata": "t = {0}.SamplingInstants; u = {0}.InputData; y = {0}.OutputData; save('{1}', 't', 'u', 'y', '-v7')",
    "Simulink.SimulationData.Dataset": "x = {0}.getElement(1).Values; t = x.Time; y = x.Data; "
    "save('{1}', 't', 'y', '-v7')",
    "datetime": "t = seconds({0} - {0}(1)); save('{1}', 't', '-v7', '-append')",
    "duration": "t = seconds({0}); save('{1}', 't', '-v7', '-append')",
}


class Leaf(NamedTuple):
    """A variable or field: its shape and a function that reads its numbers; ``what`` is the kind of an unread one."""

    name: str
    shape: tuple[int, ...] = ()
    read: Callable[[], NDArray[Any]] = lambda: np.zeros(0)
    what: str = ""
    kind: str = ""


def leaf_source(
    path: Path, content: bytes, sha256: str, leaves: Sequence[Leaf], matlab: bool = True
) -> Source:
    """A source of vectors and columns of matrices; for MATLAB files, unread variables are named in messages."""
    vectors: dict[str, Callable[[], NDArray[Any]]] = {}
    lengths: dict[str, int] = {}
    unread: dict[str, list[str]] = {}
    lines: list[str] = []
    for leaf in leaves:
        if not leaf.what:
            columns = _columns_of(leaf)
            vectors |= columns
            lengths |= dict.fromkeys(columns, max(leaf.shape, default=1))
        elif matlab:
            unread.setdefault(leaf.what, []).append(leaf.name)
            if leaf.kind in CONVERT:
                lines.append(CONVERT[leaf.kind].format(leaf.name, f"{path.stem}_vectors.mat"))
    kinds = [f"{what} ({', '.join(map(shown, names[:LISTED]))})" for what, names in sorted(unread.items())]
    note = f" Not read: {' and '.join(kinds)}." if kinds else ""
    note += f" In MATLAB: {lines[0]}" if lines else " Save their vectors as variables." if kinds else ""
    lost = tuple(name for names in unread.values() for name in names)
    row, first = ("row", 1) if matlab else ("index", 0)
    budget = budget_of(len(content))
    plain = vector_source(
        path, sha256, budget, tuple(vectors), lambda name: vectors[name](), row, first, note, lost
    )
    return _with_clocks(plain, lengths, budget) or plain


def _columns_of(leaf: Leaf) -> dict[str, Callable[[], NDArray[Any]]]:
    """A vector, or the columns of a matrix (its rows, if they are longer)."""
    long = [size for size in leaf.shape if size != 1]
    # most columns of a matrix that are read as signals
    if len(leaf.shape) != 2 or len(long) < 2 or min(long) > 64 or 0 in long:
        return {leaf.name: leaf.read}
    upright = leaf.shape[0] >= leaf.shape[1]
    form = "(:,{})" if upright else "({},:)"
    return {
        leaf.name + form.format(k + 1): partial(_taken, leaf.read, k, int(upright)) for k in range(min(long))
    }


def _taken(read: Callable[[], NDArray[Any]], k: int, axis: int) -> NDArray[Any]:
    return read().take(k, axis)


# Vectors with several clocks


def _with_clocks(source: Source, lengths: dict[str, int], budget: int) -> Source | None:
    """A source with clocks, if vectors of different lengths have their own times: in one struct, or of equal length.

    None if all vectors have one length, or only one of them is a time.
    """
    times = [name for name, length in lengths.items() if length > 1 and _is_time(name)]
    if len({lengths[name] for name in times}) < 2:
        return None
    clocks: dict[str, str] = {}
    for name, length in lengths.items():
        scope = name
        while name not in times and scope and length > 1:
            scope = scope.rpartition(".")[0]
            near = [one for one in times if one.rpartition(".")[0] == scope and lengths[one] == length]
            if near:
                clocks |= {name: near[0]} if len(near) == 1 else {}
                break
    if len(set(clocks.values())) < 2 or 16 * sum(lengths[name] for name in clocks) > budget:
        return None
    clocks |= {clock: clock for clock in clocks.values()}  # a time is a signal of its own clock
    read = {name: source.read(None, [name], [name]) for name in clocks}
    series = [
        Series(
            name,
            (said_by(clock).seconds or 1.0) * read[clock].values[:, 0],
            read[name].values[:, 0],
            read[clock].faults.get(clock, "") or read[name].faults.get(name, ""),
        )
        for name, clock in clocks.items()
    ]
    own = {clock.rpartition(".")[2] for clock in clocks.values()}
    time = f"{own.pop()} [s]" if len(own) == 1 else TIME
    used = ", ".join(map(shown, list(dict.fromkeys(clocks.values()))[:LISTED]))
    lost = [name for name in lengths if name not in clocks]
    note = f" Without time stamps: {', '.join(map(shown, lost[:LISTED]))}." if lost else ""
    return replace(
        clocked(source.path, source.sha256, series, time, source.note + note),
        unread=(*source.unread, *lost),
        notes=(f"vectors have different time stamps: {used}",),
    )


def _is_time(name: str) -> bool:
    """Whether a vector's name means time; ``t`` beside other words counts: ``t_pos``, ``t2``."""
    return said_by(name).kind == "time" or "t" in re.split(r"[\W_\d]+", name.rpartition(".")[2])
