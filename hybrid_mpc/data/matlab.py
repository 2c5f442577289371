"""MATLAB files v4 to v7 as named vectors: fields of structs, columns of matrices; :mod:`.hdf5` reads v7.3.

The module has its own reader that checks every length: ``scipy.io.loadmat`` trusts the lengths declared in a file and
crashes the process if they are wrong.
Source: MathWorks, *MAT-File Format*, chapter 1 (level 5): an element is a tag of 8 bytes (type, number of bytes) and
its data, padded to 8 bytes; up to 4 bytes of data stand in the tag itself. Chapter 2 (level 4): a variable is a header
of 20 bytes, its name and its numbers.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.source import Source, line_of
from hybrid_mpc.data.vectors import MOST_STRUCTS, OBJECTS, Leaf, budget_of, leaf_source
from hybrid_mpc.errors import InputError

NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Types of elements that hold numbers, as numpy dtypes."""
TEXT = (16, 17, 18)
MATRIX, COMPRESSED = 14, 15
CELL, STRUCT, OBJECT, CHAR, SPARSE, FUNCTION, OPAQUE = 1, 2, 3, 4, 5, 16, 17
NUMERIC = range(6, 16)  # classes of arrays: double, single, int8 to uint64
COMPLEX = 0x08
DEEPEST = 32  # deepest nesting of structs and cells; a recording has a few levels
ELEMENTS = 200_000  # most elements of a file, at least four per variable, cell or field: some seconds of work
LEVEL_4 = ("f8", "f4", "i4", "i2", "u2", "u1")


def mat_source(path: Path, content: bytes, sha256: str) -> Source:
    """Open a ``.mat`` file as a source."""
    if version(content) == "7.3":
        from hybrid_mpc.data.hdf5 import hdf5_source

        return hdf5_source(path, content, sha256)
    try:
        leaves = leaves_of(content, budget_of(len(content)))
    except ValueError as error:
        raise InputError(
            f"{path}: not a valid .mat file, damaged or too large ({line_of(error)}). Save it again in MATLAB with "
            f"save('{path.name}', ..., '-v7'), large vectors with '-v6'. [HM-DATA-041]"
        ) from error
    return leaf_source(path, content, sha256, leaves)


def version(content: bytes) -> str:
    """``"7.3"`` (HDF5), ``"5"`` (written by -v6 and -v7) or ``"4"`` (all others)."""
    if content[:8] == b"\x89HDF\r\n\x1a\n" or content[512:520] == b"\x89HDF\r\n\x1a\n":
        return "7.3"
    mark = content[126:128]
    if len(content) < 128 or mark not in (b"IM", b"MI") or not all(content[:4]):
        return "4"
    return "7.3" if content[125 if mark == b"IM" else 124] == 2 else "5"


def leaves_of(content: bytes, budget: int) -> list[Leaf]:
    """Vectors and matrices of a file of level 4 or 5, and its variables that are not read.

    ``budget`` is the most bytes of numbers that the file may hold, 8 per number.

    Raises:
        ValueError: If the file holds more, or an element is damaged.
    """
    file = _File(content, budget)
    found = list(file.level_4() if version(content) == "4" else file.level_5())
    if twice := next((name for name, count in Counter(file.names).items() if count > 1), None):
        raise ValueError(f"two variables are named {twice!r} [HM-DATA-042]")
    return found


class _Element(NamedTuple):
    """An element: its type, and where its data begin and end."""

    kind: int
    begin: int
    end: int

    @property
    def size(self) -> int:
        return self.end - self.begin


class _File:
    """A file, the bytes (``size``) and elements (``count``) that it may still hold, and its variables' names."""

    def __init__(self, content: bytes, budget: int) -> None:
        self.content, self.budget = content, budget
        self.size, self.count, self.order, self.names = budget, ELEMENTS, "<", list[str]()

    def take(self, size: int = 0, count: int = 0) -> None:
        """Reduce the remaining budget of bytes and elements."""
        self.size, self.count = self.size - size, self.count - count
        if self.count < 0:
            raise ValueError(f"the file has more than {ELEMENTS} elements [HM-DATA-043]")
        if self.size < 0:
            raise ValueError(
                f"the file declares more than {self.budget / 1e6:.4g} MB of numbers [HM-DATA-044]"
            )

    def level_4(self) -> Iterator[Leaf]:
        """All variables."""
        content, begin = self.content, 0
        order = "<" if len(content) < 4 or 0 <= struct.unpack_from("<i", content)[0] <= 5000 else ">"
        while begin < len(content):
            if len(content) - begin < 20:
                raise ValueError("a variable is cut off [HM-DATA-045]")
            kind, rows, columns, imaginary, length = struct.unpack_from(f"{order}5i", content, begin)
            number, matrix = kind // 10 % 10, kind % 10
            if not 0 <= kind <= 5000 or kind // 100 % 10 or number >= len(LEVEL_4) or matrix > 2:
                raise ValueError("a variable has an unknown type [HM-DATA-046]")
            if min(rows, columns) < 0 or length < 1:
                raise ValueError("a variable has no dimensions or no name [HM-DATA-047]")
            self.take(8 * rows * columns, 4)
            pair = 1 + (imaginary == 1 and matrix != 2)
            dtype, start = np.dtype(order + LEVEL_4[number]), begin + 20 + length
            name = content[begin + 20 : start].split(b"\0")[0].decode("latin-1")
            begin = start + rows * columns * dtype.itemsize * pair
            if begin > len(content):
                raise ValueError("a variable is longer than the file [HM-DATA-048]")
            self.names.append(name)
            if matrix:
                yield Leaf(name, (), _text) if matrix == 1 else Leaf(name, what="sparse matrices")
            else:
                yield _leaf(name, content, dtype, (rows, columns), start, pair)

    def level_5(self) -> Iterator[Leaf]:
        """All variables; a compressed variable is decompressed up to the budget."""
        content = self.content
        self.order = "<" if content[126:128] == b"IM" else ">"
        for element in self.elements(content, 128, len(content)):
            if element.kind != COMPRESSED:
                yield from self.leaves(content, element)
                continue
            before, inner = self.size, self.unpacked(memoryview(content)[element.begin : element.end])
            for matrix in self.elements(inner, 0, len(inner)):
                yield from self.leaves(inner, matrix)
            self.take(max(0, len(inner) - (before - self.size)))

    def unpacked(self, data: memoryview) -> bytes:
        """The content of a compressed variable."""
        stream = zlib.decompressobj()
        try:
            inner = stream.decompress(data, self.size + 1)
        except zlib.error as error:
            raise ValueError("the checksum of a compressed variable is wrong [HM-DATA-049]") from error
        if len(inner) > self.size:
            self.take(len(inner))
        if not stream.eof:
            raise ValueError("a compressed variable is cut off [HM-DATA-050]")
        return inner

    def elements(self, data: bytes, begin: int, end: int) -> Iterator[_Element]:
        """Consecutive elements from ``begin`` to ``end``."""
        while begin < end:
            self.take(count=1)
            if end - begin < 8:
                raise ValueError("an element is cut off [HM-DATA-051]")
            kind, size = struct.unpack_from(f"{self.order}II", data, begin)
            start, after = begin + 8, begin + 8 + size
            if kind >> 16:
                kind, size, start, after = kind & 0xFFFF, kind >> 16, begin + 4, begin + 8
            elif kind != COMPRESSED:
                after += -size % 8
            if start + size > end or start + size > after:
                raise ValueError("an element is longer than the file [HM-DATA-052]")
            yield _Element(kind, start, start + size)
            begin = after

    def leaves(
        self, data: bytes, matrix: _Element, named: str | None = None, depth: int = 0
    ) -> Iterator[Leaf]:
        """Contents of an array, nested ones included; a variable carries its own name."""
        if matrix.kind != MATRIX:
            raise ValueError(f"an element has type {matrix.kind} where a variable is expected [HM-DATA-053]")
        if depth > DEEPEST:
            raise ValueError(f"structs are nested more than {DEEPEST} deep [HM-DATA-054]")
        parts = list(self.elements(data, matrix.begin, matrix.end))
        if not parts and named is not None:
            yield Leaf(named, (0, 0))
            return
        if not parts or parts[0].kind != 6 or parts[0].size != 8:
            raise ValueError("a variable has no flags [HM-DATA-055]")
        flags = struct.unpack_from(f"{self.order}I", data, parts[0].begin)[0]
        kind, pair = flags & 0xFF, 1 + bool(flags >> 8 & COMPLEX)
        own = parts[1 if kind == OPAQUE else 2 :][:1]
        if not own or own[0].kind not in (1, *TEXT):
            raise ValueError("a variable has no name [HM-DATA-056]")
        name = data[own[0].begin : own[0].end].decode("latin-1") if named is None else named
        if named is None:
            self.names.append(name)
        if not name:  # an internal variable of MATLAB
            return
        if kind in (OPAQUE, FUNCTION):
            made_of = data[parts[3].begin : parts[3].end] if len(parts) > 3 else b""
            name_of_class = made_of.decode("ascii", errors="replace") if kind == OPAQUE else "function_handle"
            yield Leaf(name, what=f"{OBJECTS} of class {name_of_class or 'unknown'}", kind=name_of_class)
            return
        if parts[1].kind not in (5, 6) or parts[1].size < 8 or parts[1].size % 4:
            raise ValueError("a variable has no dimensions [HM-DATA-057]")
        shape = struct.unpack_from(f"{self.order}{parts[1].size // 4}i", data, parts[1].begin)
        if min(shape) < 0:
            raise ValueError("a variable has a negative dimension [HM-DATA-058]")
        count, rest = math.prod(shape), parts[3:]
        if kind != SPARSE:  # a sparse matrix stores less than its dimensions say
            self.take(8 * count * pair)
        fits = all(part.kind in NUMBERS for part in rest)
        if kind in NUMERIC and fits and len(rest) == pair:
            dtypes = [np.dtype(self.order + NUMBERS[part.kind]) for part in rest]
            fits = all(one.size == count * dtype.itemsize for one, dtype in zip(rest, dtypes, strict=True))
            leaf = _leaf(name, data, dtypes[0], shape, rest[0].begin, pair) if fits else None
        elif kind == CHAR:
            leaf = Leaf(name, (), _text) if [p.kind in (*NUMBERS, *TEXT) for p in rest] == [True] else None
        elif kind in (CELL, STRUCT, OBJECT):
            yield from self.inner(data, rest[kind == OBJECT :], name, depth, count, kind == CELL)
            return
        else:
            sparse = kind == SPARSE and fits and len(rest) == 2 + pair
            leaf = Leaf(name, what="sparse matrices") if sparse else None
        if leaf is None:
            raise ValueError("the contents of a variable are missing [HM-DATA-059]")
        yield leaf

    def inner(
        self, data: bytes, rest: list[_Element], name: str, depth: int, count: int, cell: bool
    ) -> Iterator[Leaf]:
        """Contents of cells, or of the fields of structs."""
        fields = [""]
        if not cell:
            length, names = rest[:2] if len(rest) > 1 else 2 * [_Element(0, 0, 0)]
            size = struct.unpack_from(f"{self.order}i", data, length.begin)[0] if length.size == 4 else 0
            if size < 1 or length.kind not in (5, 6) or names.kind != 1 or names.size % size:
                raise ValueError("a struct has no field names [HM-DATA-060]")
            begins = range(names.begin, names.end, size)
            fields = ["." + data[k : k + size].split(b"\0")[0].decode("latin-1") for k in begins]
            self.take(8 * count * max(0, len(fields) - 1))
            rest = rest[2:]
        if len(rest) != count * len(fields):
            raise ValueError("the contents of a variable are missing [HM-DATA-061]")
        if count > MOST_STRUCTS:
            yield Leaf(name, what="cells" if cell else "arrays of structs")
            return
        for k, one in enumerate(rest):
            number = k // len(fields) + 1
            place = (f"{{{number}}}" if cell else f"({number})") if count > 1 else ""
            yield from self.leaves(data, one, f"{name}{place}{fields[k % len(fields)]}", depth + 1)


def _text() -> NDArray[Any]:
    return np.array("text")


def _leaf(
    name: str, data: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], begin: int, pair: int
) -> Leaf:
    """Numbers in column-major order; a ``pair`` of real and imaginary parts is only marked as complex."""
    if pair == 2:
        return Leaf(name, shape, partial(np.zeros, shape, complex))
    return Leaf(
        name, shape, lambda: np.frombuffer(data, dtype, math.prod(shape), begin).reshape(shape, order="F")
    )
