"""Cells, numbers and texts of a MATLAB 5 file, for picks made with a toolbox.

Layout: MathWorks, "MAT-File Format", chapter 1. A general reader allocates what a file claims; this one holds
every claim against the bytes that are there.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

MAX_UNPACKED_BYTES = 64 << 20  # of all variables together: a hundred views of picks have 2 MB
MAX_DEPTH = 8  # of cells in cells
_MATRIX, _COMPRESSED = 14, 15  # types of elements
_CELL, _CHAR, _NUMBERS = 1, 4, range(6, 16)  # classes of matrices: double to uint64
_COMPLEX = 0x0800  # flag of a matrix
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "utf-8", 2: "utf-8", 4: "utf-16", 16: "utf-8", 17: "utf-16"}  # 17: its byte order is the file's


def read_matlab(data: bytes, names: Collection[str]) -> dict[str, Any]:
    """The variables of those names: cells as object arrays, numbers as float64 arrays (of the shapes stated), texts.

    Raises ValueError, KeyError, StopIteration or zlib.error for what is damaged or of another kind.
    """
    if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("no MATLAB 5 file")
    order = "<" if data[126:128] == b"IM" else ">"
    found: dict[str, Any] = {}
    unpacked = 0
    for kind, body in _elements(data[128:], order):
        if kind == _COMPRESSED:
            whole = zlib.decompressobj().decompress(body, MAX_UNPACKED_BYTES - unpacked + 1)
            unpacked += len(whole)
            if unpacked > MAX_UNPACKED_BYTES:
                raise ValueError("it unpacks to too much")
            kind, body = next(_elements(whole, order))
        if kind == _MATRIX and (name := _name(body, order)) in names:
            found[name] = _matrix(body, order, 0)
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """(type, content) one after another; up to four bytes of content stand in the tag itself."""
    at = 0
    while at + 8 <= len(data):
        kind, size = np.frombuffer(data, f"{order}u4", 2, at).tolist()
        start = at + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        if start + size > len(data) or (start == at + 4 and size > 4):
            raise ValueError("an element is longer than the file")
        yield kind, data[start : start + size]
        at = at + 8 if start == at + 4 else start + size + (-size % 8 if kind != _COMPRESSED else 0)


def _name(body: bytes, order: str) -> str:
    _, _, (_, name), *_ = _elements(body, order)
    return name.decode("latin-1")


def _matrix(body: bytes, order: str, depth: int) -> Any:
    parts = _elements(body, order)
    flags = int(np.frombuffer(next(parts)[1], f"{order}u4")[0])
    shape = tuple(np.frombuffer(next(parts)[1], f"{order}i4").tolist())
    next(parts)  # its name
    count = math.prod(shape)
    if depth > MAX_DEPTH or len(shape) > 8 or min(shape, default=0) < 0 or flags & _COMPLEX:
        raise ValueError("a matrix of another kind")
    if flags & 0xFF == _CELL:
        items = [_matrix(inner, order, depth + 1) if inner else np.zeros((0, 0)) for _, inner in parts]
        if len(items) != count:
            raise ValueError("cells are missing")
        cells = np.empty(count, object)
        cells[:] = items
        return cells.reshape(shape, order="F")
    kind, content = next(parts)
    if flags & 0xFF == _CHAR:
        return content.decode(f"{_TEXTS[kind]}-{'le' if order == '<' else 'be'}" if kind in (4, 17) else _TEXTS[kind])
    if flags & 0xFF not in _NUMBERS:
        raise ValueError("a matrix of another kind")
    numbers = np.frombuffer(content, f"{order}{_DTYPES[kind]}").astype(np.float64)
    if len(numbers) != count:
        raise ValueError("numbers are missing")
    return numbers.reshape(shape, order="F")
