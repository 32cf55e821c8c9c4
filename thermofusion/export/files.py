"""Files written whole or not at all, and read with the file named in every error."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ResourceError, ScanError


def write_whole(path: str | Path, chunks: Iterable[bytes | NDArray]) -> Path:
    """Write bytes and arrays (in C order) one after another under a temporary name, then rename.

    Raises ResourceError where the folder or the disk refuses; nothing partial is left.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as f:
            for chunk in chunks:
                if isinstance(chunk, np.ndarray):
                    chunk.tofile(f)
                else:
                    f.write(chunk)
        temporary.replace(path)
    except OSError as e:
        raise ResourceError(f"the file cannot be written ({e.strerror})", place=path) from None
    finally:
        temporary.unlink(missing_ok=True)
    return path


def read_whole(path: str | Path) -> bytes:
    """A file's bytes. Raises ScanError."""
    try:
        return Path(path).read_bytes()
    except OSError as e:
        raise ScanError(f"the file cannot be read ({e.strerror})", place=path) from None


def read_array(data: bytes, dtype: np.dtype | str, count: int, offset: int, place: object) -> NDArray:
    """`count` items at `offset`, copied and thus writable. Raises ScanError where the file ends before."""
    dtype = np.dtype(dtype)
    if count < 0 or offset < 0 or offset + count * dtype.itemsize > len(data):
        raise ScanError("the file is truncated: it ends before its own header says", place=place)
    return np.frombuffer(data, dtype, count, offset).copy()
