"""Whether a ``.mat`` file is built as its format says. ``scipy.io.loadmat`` trusts that, and crashes where it is not.

Source: MathWorks, *MAT-File Format*, chapter 1 (level 5): an element is a tag of 8 bytes (type, number of bytes) and
its data, padded to 8 bytes; up to 4 bytes of data stand in the tag itself.
"""

from __future__ import annotations

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
CELL, STRUCT, CHAR, SPARSE, OPAQUE = 1, 2, 4, 5, 17
COMPLEX = 0x08
DEEPEST = 32
"""Matrices in matrices (cells, structs) that are followed: no recording has more than a few."""


class Element(NamedTuple):
    """Type, and where its data begin and end."""

    kind: int
    begin: int
    end: int


def version(content: bytes) -> str:
    """``"7.3"`` (HDF5), ``"5"`` (what -v6 and -v7 write) or ``"4"`` (anything else).

    Example:
        >>> version(b"MATLAB 7.3 MAT-file".ljust(124) + bytes([0, 2]) + b"IM")
        '7.3'
    """
    if content[:8] == b"\x89HDF\r\n\x1a\n" or content[512:520] == b"\x89HDF\r\n\x1a\n":
        return "7.3"
    mark = content[126:128]
    if len(content) < 128 or mark not in (b"IM", b"MI") or not all(content[:4]):
        return "4"
    return "7.3" if content[125 if mark == b"IM" else 124] == 2 else "5"


def check_structure(content: bytes) -> None:
    """Follow all elements of a level 5 file; other versions pass.

    Raises:
        ValueError: If an element leaves its surroundings or is of a type that cannot stand there.

    Example:
        >>> check_structure(b"MATLAB 5.0 MAT-file".ljust(124) + bytes([0, 1]) + b"IM" + bytes([99] + 7 * [0]))
        Traceback (most recent call last):
        ...
        ValueError: an element of type 99 where a variable is due
    """
    if version(content) != "5":
        return
    order = "<" if content[126:128] == b"IM" else ">"
    for element in _elements(content, 128, len(content), order):
        if element.kind == COMPRESSED:
            try:
                inner = zlib.decompress(content[element.begin : element.end])
            except zlib.error as error:
                raise ValueError("a compressed variable does not match its checksum") from error
            for matrix in _elements(inner, 0, len(inner), order):
                _check_matrix(inner, matrix, order, 0)
        else:
            _check_matrix(content, element, order, 0)


def _elements(data: bytes, begin: int, end: int, order: str) -> Iterator[Element]:
    """Elements in a row from ``begin`` to ``end``."""
    while begin < end:
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


def _check_matrix(data: bytes, matrix: Element, order: str, depth: int) -> None:
    if matrix.kind != MATRIX:
        raise ValueError(f"an element of type {matrix.kind} where a variable is due")
    if depth > DEEPEST:
        raise ValueError("structs lie too deep in each other")
    if matrix.begin == matrix.end:
        return
    parts = list(_elements(data, matrix.begin, matrix.end, order))
    if parts[0].kind != 6 or parts[0].end - parts[0].begin != 8:
        raise ValueError("a variable without its flags")
    flags = struct.unpack_from(f"{order}I", data, parts[0].begin)[0]
    kind, is_complex = flags & 0xFF, bool(flags >> 8 & COMPLEX)
    if kind != OPAQUE:
        _check_head(parts)
        _check_body(kind, [part.kind for part in parts[3:]], is_complex)
    for part in parts[1:]:
        if part.kind == MATRIX:
            _check_matrix(data, part, order, depth + 1)
        elif part.kind not in NUMBERS + TEXT:
            raise ValueError(f"an element of type {part.kind} in a variable")


def _check_head(parts: list[Element]) -> None:
    """Flags, dimensions (two at least), name: what every variable begins with."""
    size = parts[1].end - parts[1].begin if len(parts) >= 3 else 0
    if size < 8 or size % 4 or parts[1].kind not in (5, 6):
        raise ValueError("a variable without its dimensions")
    if parts[2].kind not in (1, *TEXT):
        raise ValueError("a variable without its name")


def _check_body(kind: int, rest: list[int], is_complex: bool) -> None:
    """Types of the elements after the name: each kind of variable has its own."""
    if kind == CELL:
        fits = all(one == MATRIX for one in rest)
    elif kind == STRUCT:
        fits = rest[:2] in ([5, 1], [6, 1]) and all(one == MATRIX for one in rest[2:])
    elif kind == CHAR:
        fits = len(rest) == 1 and rest[0] in NUMBERS + TEXT
    elif kind == SPARSE:
        fits = len(rest) == 3 + is_complex and all(one in NUMBERS for one in rest)
    elif kind in NUMERIC_CLASSES:
        fits = len(rest) == 1 + is_complex and all(one in NUMBERS for one in rest)
    else:
        fits = True  # objects and functions, of which scipy gives the raw bytes at best
    if not fits:
        raise ValueError("a variable without its contents")
