"""MATLAB's files, v4 to v7.3, as named vectors: fields of structs, columns of matrices."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.mat_structure import check_structure, version
from hybrid_mpc.data.source import LISTED, Source, line_of
from hybrid_mpc.data.vectors import budget_of, vector_source
from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.records import shown

MOST_WIDE = 64
"""Most columns of a matrix that are read as columns."""
MOST_STRUCTS = 100
"""Most elements of an array of structs that are read."""
DEEPEST = 8
"""Deepest structs in structs that are read."""
OBJECTS = "objects"
CONVERT = {
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
"""The line of MATLAB that makes vectors of an object, by its class."""


class Leaf(NamedTuple):
    """A variable or a field: its shape, and how its numbers are read; ``what`` it is where it is not read."""

    name: str
    shape: tuple[int, ...] = ()
    read: Callable[[], NDArray[Any]] = lambda: np.zeros(0)
    what: str = ""
    kind: str = ""


def mat_source(path: Path, content: bytes, sha256: str) -> Source:
    """A ``.mat`` file as a source."""
    leaves = _leaves_73(path, content) if version(content) == "7.3" else _leaves(path, content)
    vectors: dict[str, Callable[[], NDArray[Any]]] = {}
    unread: dict[str, list[str]] = {}
    lines: list[str] = []
    for leaf in leaves:
        if leaf.what:
            unread.setdefault(leaf.what, []).append(leaf.name)
            if leaf.kind in CONVERT:
                lines.append(CONVERT[leaf.kind].format(leaf.name, f"{path.stem}_vectors.mat"))
        else:
            vectors |= dict(columns_of_leaf(leaf))
    told = [f"{what} ({', '.join(map(shown, names[:LISTED]))})" for what, names in sorted(unread.items())]
    note = f" Not read are {' and '.join(told)}." if told else ""
    note += f" In MATLAB: {lines[0]}" if lines else " Save their vectors as variables." if told else ""
    lost = tuple(name for names in unread.values() for name in names)
    return vector_source(
        path,
        sha256,
        budget_of(len(content)),
        tuple(vectors),
        lambda name: vectors[name](),
        "row",
        1,
        note,
        lost,
    )


def columns_of_leaf(leaf: Leaf) -> Iterator[tuple[str, Callable[[], NDArray[Any]]]]:
    """A vector; or the columns of a matrix, rows where these are longer."""
    long = [size for size in leaf.shape if size != 1]
    if len(leaf.shape) != 2 or len(long) < 2 or min(long) > MOST_WIDE or 0 in long:
        yield leaf.name, leaf.read
        return
    upright = leaf.shape[0] >= leaf.shape[1]
    for k in range(min(long)):
        where = f"(:,{k + 1})" if upright else f"({k + 1},:)"
        yield f"{leaf.name}{where}", partial(_taken, leaf.read, k, int(upright))


def _taken(read: Callable[[], NDArray[Any]], k: int, axis: int) -> NDArray[Any]:
    return read().take(k, axis)


# v4 to v7


def _leaves(path: Path, content: bytes) -> list[Leaf]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque, MatReadWarning

    try:
        objects = check_structure(content, budget_of(len(content)))
        with warnings.catch_warnings():
            warnings.simplefilter("error", MatReadWarning)  # two variables of one name, for one
            # scipy gives all objects this name; they are named by the file's structure
            warnings.filterwarnings("ignore", 'Duplicate variable name "None"', MatReadWarning)
            variables = loadmat(io.BytesIO(content), struct_as_record=True)
    except Exception as error:  # a damaged file raises nearly anything
        raise InputError(
            f"{path}: is no .mat file, damaged or too large ({line_of(error)}). Save it again in MATLAB with "
            f"save('{path.name}', ..., '-v7'), large vectors with '-v6'."
        ) from error
    found = [Leaf(name, what=f"{OBJECTS} of class {kind or 'unknown'}", kind=kind) for name, kind in objects]
    for name, value in variables.items():
        if not name.startswith("__") and not isinstance(value, MatlabOpaque):
            found += _walked(name, value, 0)
    return found


def _walked(name: str, value: Any, depth: int) -> Iterator[Leaf]:
    from scipy.io.matlab import MatlabObject, MatlabOpaque

    if isinstance(value, MatlabOpaque) or (isinstance(value, MatlabObject) and value.dtype.names is None):
        kind = getattr(value, "classname", "unknown")
        yield Leaf(name, what=f"{OBJECTS} of class {kind}", kind=kind)
    elif not isinstance(value, np.ndarray):
        yield Leaf(name, what="sparse matrices")
    elif value.size > MOST_STRUCTS and value.dtype.kind in "VO":
        yield Leaf(name, what="arrays of structs" if value.dtype.names else "cells")
    elif depth > DEEPEST:
        yield Leaf(name, what="structs in structs")
    elif value.dtype.kind == "O":
        for k, one in enumerate(value.ravel(), 1):
            yield from _walked(f"{name}{{{k}}}" if value.size > 1 else name, one, depth + 1)
    elif value.dtype.names is None:
        yield Leaf(name, value.shape, lambda: value)
    else:
        for k, one in enumerate(value.ravel(), 1):
            where = f"{name}({k})" if value.size > 1 else name
            for field in value.dtype.names:
                yield from _walked(f"{where}.{field}", one[field], depth + 1)


# v7.3


def _leaves_73(path: Path, content: bytes) -> list[Leaf]:
    with named_extra("reading .mat files of version 7.3"):
        import h5py
    try:
        file = h5py.File(io.BytesIO(content), "r")
        return [
            leaf
            for name in file
            if not name.startswith("#")
            for leaf in _walked_73(file, name, file[name], 0)
        ]
    except Exception as error:  # a damaged file raises nearly anything
        raise InputError(
            f"{path}: is no .mat file or damaged ({line_of(error)}). Save it again in MATLAB with "
            f"save('{path.name}', ..., '-v7')."
        ) from error


def _walked_73(file: Any, name: str, item: Any, depth: int) -> Iterator[Leaf]:
    import h5py

    kind = _class(item)
    if item.attrs.get("MATLAB_object_decode", 0) or kind in CONVERT:
        yield Leaf(name, what=f"{OBJECTS} of class {kind}", kind=kind)
    elif isinstance(item, h5py.Group):
        if "MATLAB_sparse" in item.attrs or depth > DEEPEST:
            yield Leaf(name, what="sparse matrices" if depth <= DEEPEST else "structs in structs")
            return
        for field in item:
            inner = item[field]
            if isinstance(inner, h5py.Dataset) and inner.dtype == h5py.ref_dtype and not _class(inner):
                if inner.size > MOST_STRUCTS:
                    yield Leaf(f"{name}.{field}", what="arrays of structs")
                    continue
                for k, one in enumerate(inner[()].ravel(), 1):
                    yield from _walked_73(file, f"{name}({k}).{field}", file[one], depth + 1)
            else:
                yield from _walked_73(file, f"{name}.{field}", inner, depth + 1)
    elif item.attrs.get("MATLAB_empty", 0):
        yield Leaf(name, (0, 0), lambda: np.zeros(0))
    elif kind == "cell" and item.dtype == h5py.ref_dtype and item.size <= MOST_STRUCTS and depth <= DEEPEST:
        for k, one in enumerate(item[()].ravel(), 1):
            yield from _walked_73(file, f"{name}{{{k}}}" if item.size > 1 else name, file[one], depth + 1)
    elif kind in ("cell", "function_handle") or item.dtype.kind not in "biufc":
        yield Leaf(name, what="cells")
    elif kind == "char":
        yield Leaf(name, item.shape, lambda: np.array("text"))
    else:
        yield Leaf(name, item.shape[::-1], lambda: _numbers(item))


def _class(item: Any) -> str:
    kind = item.attrs.get("MATLAB_class", b"")
    return kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)


def _numbers(item: Any) -> NDArray[Any]:
    """A dataset's numbers as MATLAB has them; what it declares is looked at first."""
    if 8 * math.prod(item.shape) > budget_of(item.file.id.get_filesize()):
        raise InputError(
            f"{item.name.lstrip('/')} declares {item.shape}, more numbers than are read from such a file"
        )
    return np.asarray(item[()]).T
