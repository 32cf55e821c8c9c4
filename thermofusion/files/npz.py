"""Archives of arrays (.npz) from outside: claims are judged before anything is unpacked, and nothing in them runs."""

from __future__ import annotations

import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from .reading import read_bytes

MAX_MEMBERS = 4096  # arrays in a file: a result has some fifty
MAX_INFLATION = 8  # a file may unpack to this many times its size,
ALWAYS_UNPACKED_BYTES = 64 << 20  # or to this much, whatever its size
# What NumPy writes before the numbers; structured types and objects are none of ours.
_HEADER = re.compile(
    rb"\{'descr': '([<>|=]?[?biufcSU]\d{0,6})', 'fortran_order': (True|False), 'shape': \(([\d, ]{0,200})\), \}\s*"
)
# What zipfile, zlib and our own parsing raise for a damaged archive.
DAMAGED: tuple[type[Exception], ...]
DAMAGED = (ValueError, LookupError, TypeError, AttributeError, EOFError, OSError, RuntimeError, OverflowError)
DAMAGED += (struct.error, zlib.error, zipfile.BadZipFile)


def read_npz(path: Path, kind: str, names: Sequence[str], *, hint: str | None = None) -> list[NDArray]:
    """The arrays of those names, of any shape and of numbers. Raises ScanError: damaged, huge, a name is absent."""
    data = read_bytes(path, kind)
    try:
        with open_archive(data) as z:
            absent = [n for n in names if f"{n}.npy" not in z.namelist()]
            if absent:
                raise ScanError(f"the {kind} has no array '{absent[0]}'", place=path, hint=hint)
            arrays = [read_member(z, n) for n in names]
    except DAMAGED:
        raise ScanError(f"the {kind} file is damaged, or no archive of arrays", place=path, hint=hint) from None
    for name, array in zip(names, arrays, strict=True):
        if array.dtype.kind not in "biuf":
            raise ScanError(f"the array '{name}' of the {kind} is no array of numbers", place=path, hint=hint)
    return arrays


def open_archive(data: bytes) -> zipfile.ZipFile:
    """The archive, its claims checked before anything is unpacked. Raises one of `DAMAGED`."""
    z = zipfile.ZipFile(io.BytesIO(data))
    members = z.infolist()
    if len(members) > MAX_MEMBERS or len({m.filename for m in members}) < len(members):
        raise ValueError("too many members, or one name twice")
    if any(m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for m in members):
        raise ValueError("a member that is neither stored nor deflated")
    if sum(m.file_size for m in members) > max(ALWAYS_UNPACKED_BYTES, MAX_INFLATION * len(data)):
        raise ValueError("it would unpack to far more than its size")
    return z


def read_member(z: zipfile.ZipFile, name: str, *, limit_bytes: int | None = None) -> NDArray:
    """One array of any shape, its header held against the bytes that are there. Raises one of `DAMAGED`."""
    info = z.getinfo(f"{name}.npy")
    if limit_bytes is not None and info.file_size > limit_bytes:
        raise ValueError("a member too large")
    data = z.read(info)
    if data[:6] != b"\x93NUMPY" or data[6:7] not in (b"\1", b"\2"):
        raise ValueError("no array")
    width = 2 if data[6] == 1 else 4
    start = 8 + width + int.from_bytes(data[8 : 8 + width], "little")
    header = _HEADER.fullmatch(data[8 + width : start])
    if header is None:
        raise ValueError("an array's header is damaged")
    dtype = np.dtype(header[1].decode())
    shape = tuple(int(n) for n in header[3].split(b",") if n.strip())
    if dtype.hasobject or len(shape) > 8 or math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError("an array's header and its size disagree")
    array = np.frombuffer(data, dtype, math.prod(shape), start).copy()
    return array.reshape(shape, order="F" if header[2] == b"True" else "C")
