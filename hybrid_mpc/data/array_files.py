"""Named vectors of ``.npz`` and MATLAB ``.mat`` files as columns. Nothing in these files is executed."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatlabObject, MatlabOpaque, MatReadWarning

from hybrid_mpc.data.mat_structure import check_structure, version
from hybrid_mpc.data.sources import Columns, Source, budget_of, content_of, digest_of, megabytes
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import check_npz
from hybrid_mpc.records import shown

Array = NDArray[np.float64]
Lookup = Callable[[str], NDArray[Any]]


def npz_source(path: Path) -> Source:
    """Open a ``.npz`` file of named vectors; object arrays (pickles) are refused, not loaded.

    Raises:
        InputError: If the file is missing, no regular file, too large, empty, damaged or no ``.npz``.
    """
    content = content_of(path)
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
            f"{path}: is no .npz file or damaged ({_line(error)}). Write it with numpy.savez(file, name=vector, ...)."
        ) from error

    def lookup(name: str) -> NDArray[Any]:
        try:
            check_npz(content, budget_of(content), (name,))
            return np.asarray(file[name])
        except Exception as error:
            raise InputError(
                f"{path}: column {shown(name)} cannot be read ({_line(error)}). Save it as a vector of numbers, large "
                "ones with numpy.savez and not packed; objects are refused, since loading them could run code."
            ) from error

    return Source(path, digest_of(content), tuple(file.files), _reader(path, content, lookup, "index", 0))


def mat_source(path: Path) -> Source:
    """Open a ``.mat`` file (MATLAB's -v4, -v6 or -v7): its vectors, and those in its structs as ``struct.field``.

    Raises:
        InputError: If the file is missing, empty, damaged, no ``.mat`` or one of version 7.3 (HDF5).
    """
    content = content_of(path)
    if version(content) == "7.3":
        raise InputError(
            f"{path}: is a .mat file of version 7.3 (HDF5), which is not read. Save it in MATLAB with "
            f"save('{path.name}', ..., '-v7')."
        )
    try:
        check_structure(content, budget_of(content))
        with warnings.catch_warnings():
            warnings.simplefilter("error", MatReadWarning)  # two variables of one name, for one
            variables = loadmat(io.BytesIO(content), struct_as_record=True)
    except Exception as error:  # a damaged file raises nearly anything
        raise InputError(
            f"{path}: is no .mat file, damaged or too large ({_line(error)}). Save it again in MATLAB with "
            f"save('{path.name}', ..., '-v7'), large vectors with '-v6'."
        ) from error
    vectors, note = _fields({name: v for name, v in variables.items() if not name.startswith("__")})
    return Source(
        path, digest_of(content), tuple(vectors), _reader(path, content, vectors.__getitem__, "row", 1), note
    )


def _fields(variables: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], str]:
    """Variables and the fields of structs, by name; a note on what a user may miss among them."""
    found: dict[str, NDArray[Any]] = {}
    left: set[str] = set()
    for name, value in variables.items():
        what = _unread(value)
        if what:
            left.add(what)
        elif value.dtype.names is None:
            found[name] = value
        else:
            for field in value.dtype.names:
                inner = value[field].item()
                what = _unread(inner) or ("structs in structs" if inner.dtype.names else "")
                if what:
                    left.add(what)
                else:
                    found[f"{name}.{field}"] = inner
    note = f" Not read are {' and '.join(sorted(left))}: save their vectors as variables." if left else ""
    return found, note


def _unread(value: Any) -> str:
    """What kind of variable this is if it is of a kind that is not read."""
    if isinstance(value, MatlabOpaque | MatlabObject):
        return "objects (timeseries, timetable, datetime)"
    if isinstance(value, np.ndarray) and value.dtype.names is not None and value.size != 1:
        return "arrays of structs"
    return "" if isinstance(value, np.ndarray) else "sparse matrices"


def _reader(
    path: Path, content: bytes, lookup: Lookup, row: str, first: int
) -> Callable[[Sequence[str]], Columns]:
    """A source's ``read``: vectors of one length; a single number as the time is the sampling time."""

    def read(names: Sequence[str]) -> Columns:
        columns: list[Array] = []
        problems: list[str] = []
        left = budget_of(content)
        for name in names:
            try:
                array = lookup(name)
                left -= 8 * array.size
                if left < 0:
                    raise InputError(
                        f"{path}: its columns take more than the {megabytes(budget_of(content))} of numbers that are "
                        "read from a file of this length. Save it unpacked, or split the recording."
                    )
                columns.append(_vector(path, name, array))
            except InputError as error:
                problems += error.problems
        refuse(problems)
        if columns[0].size == 1 and len(columns) > 1:
            columns[0] = _uniform(path, names[0], columns[0].item(), len(columns[1]))
        lengths = dict(zip(names, map(len, columns), strict=True))
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{shown(name)} {length}" for name, length in lengths.items())
            raise InputError(f"{path}: columns differ in length: {told}. Save vectors of one length.")
        values = np.column_stack(columns)
        found = []
        for name, column in zip(names, values.T, strict=True):
            bad = np.flatnonzero(~np.isfinite(column))
            if len(bad):
                found.append(
                    f"{row} {bad[0] + first}, column {shown(name)} is {column[bad[0]]:g}, not a finite number "
                    f"({len(bad)} such). Delete the row (longer gaps are cut out) or repair the value."
                )
        values[~np.isfinite(values)] = np.nan
        return Columns(values, row, range(first, first + len(values)), tuple(found))

    return read


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


def _line(error: BaseException) -> str:
    """The first line of an error's message, or its kind."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
