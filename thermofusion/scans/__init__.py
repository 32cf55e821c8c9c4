"""Recordings: one reader per format, all presenting the same `Scan`."""

from __future__ import annotations

from pathlib import Path

from ..errors import ScanError
from ..types import Scan
from .native import is_native, read_native


def open_scan(path: str | Path, *, format: str | None = None) -> Scan:
    """Open a recording of any known format (recognised by its files, or named by `format`)."""
    root = Path(path)
    if not root.exists():
        raise ScanError("there is no such scan", place=root)
    if is_native(root):
        return read_native(root)
    raise ScanError("no known recording format was recognised here", place=root)


__all__ = ["open_scan"]
