"""HDF5 files (also MATLAB v7.3) as named vectors: datasets, columns of matrices, fields of tables.

Links to other files are ignored.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.source import Source, line_of
from hybrid_mpc.data.vectors import CONVERT, MOST_STRUCTS, OBJECTS, Leaf, budget_of, leaf_source
from hybrid_mpc.errors import InputError, named_extra

DEEPEST = 8  # deepest nesting of groups that is read
MOST_ITEMS = 10_000  # most groups and datasets that are visited: some seconds of work


def hdf5_source(path: Path, content: bytes, sha256: str) -> Source:
    """Open a file as a source."""
    matlab = path.suffix.lower() == ".mat" or content.startswith(b"MATLAB")
    with named_extra(f"{path}: reading {'.mat files of version 7.3' if matlab else 'HDF5 files'}"):
        import h5py
    try:
        file = h5py.File(io.BytesIO(content), "r")
        leaves = list(_Walk(file, matlab).fields("", file, 0))
    except Exception as error:  # h5py raises many kinds of exceptions for a damaged file
        what, again = "HDF5 file", "Write it again."
        if matlab:
            what, again = ".mat file", f"Save it again in MATLAB with save('{path.name}', ..., '-v7')."
        raise InputError(
            f"{path}: not a valid {what}, or damaged ({line_of(error)}). {again} [HM-DATA-034]"
        ) from error
    return leaf_source(path, content, sha256, leaves, matlab)


class _Walk:
    """A walk through a file; links may form cycles, so visited items are counted."""

    def __init__(self, file: Any, matlab: bool) -> None:
        self.file, self.matlab, self.left = file, matlab, MOST_ITEMS

    def fields(self, prefix: str, group: Any, depth: int) -> Iterator[Leaf]:
        """The contents of a group."""
        import h5py

        for name in group:
            full = f"{prefix}.{name}" if prefix else name
            here = isinstance(group.get(name, getlink=True), h5py.HardLink)
            if not here or (self.matlab and full.startswith("#")):
                continue
            item = group[name]
            refers = self.matlab and isinstance(item, h5py.Dataset) and item.dtype == h5py.ref_dtype
            if prefix and refers and not _class(item):  # a field of an array of structs
                yield from self.referred(item, full, f"{prefix}(\0).{name}", "arrays of structs", depth)
            else:
                yield from self.item(full, item, depth)

    def referred(self, item: Any, name: str, form: str, what: str, depth: int) -> Iterator[Leaf]:
        """The targets of references; ``form`` is the name of each, with the null replaced by its number."""
        if item.size > MOST_STRUCTS or depth > DEEPEST:
            yield Leaf(name, what=what)
            return
        for k, one in enumerate(item[()].ravel(), 1):
            yield from self.item(form.replace("\0", str(k)), self.file[one], depth + 1)

    def item(self, name: str, item: Any, depth: int) -> Iterator[Leaf]:
        """A group, or a dataset."""
        import h5py

        self.left -= 1
        if self.left < 0:
            raise ValueError(f"more than {MOST_ITEMS} groups and datasets [HM-DATA-035]")
        kind = _class(item) if self.matlab else ""
        if self.matlab and (item.attrs.get("MATLAB_object_decode", 0) or kind in CONVERT):
            yield Leaf(name, what=f"{OBJECTS} of class {kind}", kind=kind)
        elif isinstance(item, h5py.Group):
            if "MATLAB_sparse" in item.attrs or depth > DEEPEST:
                yield Leaf(name, what="sparse matrices" if depth <= DEEPEST else "structs in structs")
            else:
                yield from self.fields(name, item, depth + 1)
        elif not isinstance(item, h5py.Dataset) or item.shape is None:
            return
        elif self.matlab and item.attrs.get("MATLAB_empty", 0):
            yield Leaf(name, (0, 0))
        elif kind == "cell" and item.dtype == h5py.ref_dtype:
            form = f"{name}{{\0}}" if item.size > 1 else name
            yield from self.referred(item, name, form, "cells", depth)
        elif item.dtype.names:
            for field in item.dtype.names:
                if item.dtype[field].kind in "biuf":
                    yield Leaf(f"{name}.{field}", item.shape, partial(_numbers, item, field))
        elif kind == "char":
            yield Leaf(name, (), lambda: np.array("text"))
        elif kind in ("cell", "function_handle") or item.dtype.kind not in "biufc":
            yield Leaf(name, what="cells")
        elif self.matlab:
            yield Leaf(name, item.shape[::-1], lambda: _numbers(item).T)
        else:
            units = (item.attrs.get(key) for key in ("units", "unit"))
            unit = next((one for one in units if isinstance(one, str)), "")
            yield Leaf(f"{name} [{unit}]" if unit else name, item.shape, partial(_numbers, item))


def _class(item: Any) -> str:
    kind = item.attrs.get("MATLAB_class", b"")
    return kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)


def _numbers(item: Any, field: str = "") -> NDArray[Any]:
    """Numbers of a dataset, or of one field of its records; the declared size is checked first."""
    if max(8, item.dtype.itemsize) * item.size > budget_of(item.file.id.get_filesize()):
        raise InputError(
            f"{item.name.lstrip('/')} declares {item.shape}, more numbers than a file of this size may hold "
            "[HM-DATA-036]"
        )
    return np.asarray(item[()][field] if field else item[()])
