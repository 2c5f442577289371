"""Checks that a ``.mat`` file is built as its format says: ``scipy.io.loadmat`` trusts that, and crashes if it is not.

Source: MathWorks, *MAT-File Format*, chapter 1 (level 5): an element is a tag of 8 bytes (type, number of bytes) and
its data, padded to 8 bytes; up to 4 bytes of data stand in the tag itself. Chapter 2 (level 4): a variable is a header
of 20 bytes, its name and its numbers.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

NUMBERS = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13)
"""Types of elements that hold numbers: int8 to uint64, single, double."""
TEXT = (16, 17, 18)
MATRIX, COMPRESSED = 14, 15
NUMERIC_CLASSES = range(6, 16)
"""Classes of arrays: double, single, int8 to uint64."""
CELL, STRUCT, OBJECT, CHAR, SPARSE, OPAQUE = 1, 2, 3, 4, 5, 17
COMPLEX = 0x08
DEEPEST = 32
"""Deepest matrices in matrices (cells, structs); a recording has a few."""
ELEMENTS = 200_000
"""Most elements of a file, four and more a variable, cell or field: some seconds of work."""
SIZES_4 = (8, 4, 4, 2, 2, 1)
"""Bytes of a number by its type in level 4: double, single, int32, int16, uint16, uint8."""


class Left:
    """What a file may still hold: ``size`` bytes of numbers, each counted as 8 of them, and ``count`` elements."""

    def __init__(self, size: int) -> None:
        self.size, self.count = size, ELEMENTS
        self._most = size

    def take(self, size: int = 0, count: int = 0) -> None:
        """Use some of it up."""
        self.size, self.count = self.size - size, self.count - count
        if self.count < 0:
            raise ValueError(f"it has more than {ELEMENTS} elements")
        if self.size < 0:
            raise ValueError(f"it declares more than {self._most / 1e6:.4g} MB of numbers")


class Element(NamedTuple):
    """Type, and where its data begin and end."""

    kind: int
    begin: int
    end: int


def version(content: bytes) -> str:
    """``"7.3"`` (HDF5), ``"5"`` (what -v6 and -v7 write) or ``"4"`` (anything else)."""
    if content[:8] == b"\x89HDF\r\n\x1a\n" or content[512:520] == b"\x89HDF\r\n\x1a\n":
        return "7.3"
    mark = content[126:128]
    if len(content) < 128 or mark not in (b"IM", b"MI") or not all(content[:4]):
        return "4"
    return "7.3" if content[125 if mark == b"IM" else 124] == 2 else "5"


def check_structure(content: bytes, budget: int) -> tuple[tuple[str, str], ...]:
    """Follow all elements of a file of level 4 or 5; a compressed variable is decompressed as far as the budget allows.

    ``budget`` is the most bytes of numbers that the file may hold, each counted as 8 of them; ValueError if there are
    more, or an element is damaged. Returned are names and classes of MATLAB's objects, which scipy does not tell apart.
    """
    left, objects = Left(budget), list[tuple[str, str]]()
    if version(content) == "4":
        _check_4(content, left)
        return ()
    order = "<" if content[126:128] == b"IM" else ">"
    for element in _elements(content, 128, len(content), order, left):
        if element.kind == COMPRESSED:
            before = left.size
            inner = _unpacked(memoryview(content)[element.begin : element.end], left)
            for matrix in _elements(inner, 0, len(inner), order, left):
                objects += _check_matrix(inner, matrix, order, 0, left)
            left.take(max(0, len(inner) - (before - left.size)))
        else:
            objects += _check_matrix(content, element, order, 0, left)
    return tuple(objects)


def _unpacked(data: memoryview, left: Left) -> bytes:
    stream = zlib.decompressobj()
    try:
        inner = stream.decompress(data, left.size + 1)
    except zlib.error as error:
        raise ValueError("a compressed variable does not match its checksum") from error
    if len(inner) > left.size:
        left.take(len(inner))
    if not stream.eof:
        raise ValueError("a compressed variable is cut off")
    return inner


def _check_4(content: bytes, left: Left) -> None:
    order = "<" if len(content) < 4 or 0 <= struct.unpack_from("<i", content)[0] <= 5000 else ">"
    begin = 0
    while begin < len(content):
        if len(content) - begin < 20:
            raise ValueError("a variable is cut off")
        kind, rows, columns, imaginary, name = struct.unpack_from(f"{order}5i", content, begin)
        number, matrix = kind // 10 % 10, kind % 10
        if not 0 <= kind <= 5000 or kind // 100 % 10 or number >= len(SIZES_4) or matrix > 2:
            raise ValueError("a variable of a type that there is not")
        if min(rows, columns) < 0 or name < 1:
            raise ValueError("a variable without its dimensions or its name")
        left.take(8 * rows * columns, 4)
        pair = 2 if imaginary == 1 and matrix != 2 else 1
        begin += 20 + name + rows * columns * SIZES_4[number] * pair
        if begin > len(content):
            raise ValueError("a variable is longer than what is there")


def _elements(data: bytes, begin: int, end: int, order: str, left: Left) -> Iterator[Element]:
    """Elements in a row from ``begin`` to ``end``."""
    while begin < end:
        left.take(count=1)
        if end - begin < 8:
            raise ValueError("an element is cut off")
        kind, size = struct.unpack_from(f"{order}II", data, begin)
        if kind >> 16:
            kind, size, start, after = kind & 0xFFFF, kind >> 16, begin + 4, begin + 8
        else:
            start, after = begin + 8, begin + 8 + size
            if kind != COMPRESSED:
                after += -size % 8
        if start + size > end or start + size > after:
            raise ValueError("an element is longer than what is there")
        yield Element(kind, start, start + size)
        begin = after


def _check_matrix(data: bytes, matrix: Element, order: str, depth: int, left: Left) -> list[tuple[str, str]]:
    """Name and class of what it is if that is an object."""
    if matrix.kind != MATRIX:
        raise ValueError(f"an element of type {matrix.kind} where a variable is due")
    if depth > DEEPEST:
        raise ValueError("structs lie too deep in each other")
    if matrix.begin == matrix.end:
        return []
    parts = list(_elements(data, matrix.begin, matrix.end, order, left))
    if parts[0].kind != 6 or parts[0].end - parts[0].begin != 8:
        raise ValueError("a variable without its flags")
    flags = struct.unpack_from(f"{order}I", data, parts[0].begin)[0]
    kind, is_complex = flags & 0xFF, bool(flags >> 8 & COMPLEX)
    if kind != OPAQUE:
        _check_head(parts)
        _check_body(kind, [part.kind for part in parts[3:]], is_complex)
        left.take(_declared(data, kind, parts, order) * (1 + is_complex))
    for part in parts[1:]:
        if part.kind == MATRIX:
            _check_matrix(data, part, order, depth + 1, left)
        elif part.kind not in NUMBERS + TEXT:
            raise ValueError(f"an element of type {part.kind} in a variable")
    if kind != OPAQUE or len(parts) < 2:
        return []
    name, made_of = (
        data[p.begin : p.end].decode("ascii", errors="replace")
        for p in (parts[1], parts[min(3, len(parts) - 1)])
    )
    return [(name, made_of)]


def _check_head(parts: list[Element]) -> None:
    """Flags, dimensions (two at least), name: what every variable begins with."""
    size = parts[1].end - parts[1].begin if len(parts) >= 3 else 0
    if size < 8 or size % 4 or parts[1].kind not in (5, 6):
        raise ValueError("a variable without its dimensions")
    if parts[2].kind not in (1, *TEXT):
        raise ValueError("a variable without its name")


def _check_body(kind: int, rest: list[int], is_complex: bool) -> None:
    """Types of the elements after the name: each kind of variable has its own."""
    if kind in (CELL, STRUCT, OBJECT):
        heads = {CELL: ([],), STRUCT: ([5, 1], [6, 1]), OBJECT: ([1, 5, 1], [1, 6, 1])}[kind]
        head = len(heads[0])
        fits = rest[:head] in heads and all(one == MATRIX for one in rest[head:])
    elif kind == CHAR:
        fits = len(rest) == 1 and rest[0] in NUMBERS + TEXT
    elif kind == SPARSE or kind in NUMERIC_CLASSES:
        fits = len(rest) == (3 if kind == SPARSE else 1) + is_complex and all(one in NUMBERS for one in rest)
    else:
        fits = True  # functions and newer objects, of which scipy gives the raw bytes at best
    if not fits:
        raise ValueError("a variable without its contents")


def _declared(data: bytes, kind: int, parts: list[Element], order: str) -> int:
    """Bytes that a variable's dimensions declare [byte]: a number, a character, a cell or a field takes 8."""
    if kind == SPARSE:  # its dimensions are not what is stored
        return 0
    dimensions = struct.unpack_from(f"{order}{(parts[1].end - parts[1].begin) // 4}i", data, parts[1].begin)
    if min(dimensions) < 0:
        raise ValueError("a variable with a negative dimension")
    return 8 * math.prod(dimensions) * _fields(data, kind, parts, order)


def _fields(data: bytes, kind: int, parts: list[Element], order: str) -> int:
    """Number of a struct's fields, one for anything else."""
    if kind not in (STRUCT, OBJECT):
        return 1
    length, names = parts[3 if kind == STRUCT else 4 :][:2]
    size = struct.unpack_from(f"{order}i", data, length.begin)[0] if length.end - length.begin == 4 else 0
    if size < 1 or (names.end - names.begin) % size:
        raise ValueError("a struct without the names of its fields")
    return max(1, (names.end - names.begin) // size)
