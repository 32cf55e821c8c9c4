"""Nested frozen dataclasses, arrays, tuples, dicts and scalars in one .npz: arrays and JSON, nothing that runs."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ScanError
from ..files.npz import DAMAGED, open_archive, read_member
from ..files.reading import read_whole
from ..files.whole import replacing
from .nouns import class_of, name_of

TREE, NOTE = "__tree__", "__note__"
MAX_TREE_BYTES = 64 << 20  # of JSON
UNUSABLE = "the file is damaged, or no result of thermofusion"
AGAIN = "`thermofusion run SCAN -o RESULT` writes it again"


def save_artifact(path: Path, value: object, note: Mapping[str, Any] | None = None) -> None:
    """Store a value, and a note (JSON) beside it in the same file; arrays bear their fields' names.

    Raises ResourceError, TypeError.
    """
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps(_pack(value, arrays))
    texts = {TREE: tree, NOTE: json.dumps(dict(note or {}))}
    members = {k: np.frombuffer(v.encode(), np.uint8) for k, v in texts.items()}
    with replacing(path, whatever=True) as temporary, temporary.open("wb") as f:
        np.savez(f, allow_pickle=False, **members, **arrays)


def load_artifact(path: Path) -> Any:
    """Inverse of `save_artifact`. Raises ScanError on a torn, foreign or newer file."""
    try:
        with open_archive(read_whole(path)) as z:
            tree = json.loads(read_member(z, TREE, limit_bytes=MAX_TREE_BYTES).tobytes())
            return _unpack(tree, z)
    except ScanError as e:
        raise ScanError(e.cause, place=path, hint=e.hint or AGAIN) from None
    except DAMAGED:
        raise ScanError(UNUSABLE, place=path, hint=AGAIN) from None


def load_note(path: Path) -> dict[str, Any]:
    """The note of a stored artifact, the rest unread. Raises ScanError."""
    try:
        with open_archive(read_whole(path)) as z:
            note = json.loads(read_member(z, NOTE, limit_bytes=MAX_TREE_BYTES).tobytes())
    except DAMAGED:
        raise ScanError(UNUSABLE, place=path, hint=AGAIN) from None
    if not isinstance(note, dict):
        raise ScanError(UNUSABLE, place=path, hint=AGAIN)
    return note


def _pack(value: Any, arrays: dict[str, np.ndarray], path: str = "") -> Any:
    """The tree of a value; its arrays under the names of the fields that lead to them."""
    if isinstance(value, np.ndarray):
        arrays[path or "value"] = value
        return {"array": path or "value"}
    if isinstance(value, Enum):
        return _pack(value.value, arrays, path)
    if isinstance(value, np.generic):
        return value.item()
    at = f"{path}." if path else ""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [f.name for f in dataclasses.fields(value) if f.init]
        return {"type": name_of(value), "fields": {n: _pack(getattr(value, n), arrays, at + n) for n in names}}
    if isinstance(value, tuple | list):
        items = [_pack(v, arrays, f"{at}{n}") for n, v in enumerate(value)]
        return {"tuple" if isinstance(value, tuple) else "list": items}
    if isinstance(value, Mapping):
        return {"dict": {str(k): _pack(v, arrays, f"{at}{k}") for k, v in value.items()}}
    if isinstance(value, Path):
        return {"path": str(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} cannot be stored in an artifact")


def _unpack(node: Any, z: zipfile.ZipFile) -> Any:
    if isinstance(node, list):
        raise ValueError("a bare list")
    if not isinstance(node, dict):
        return node
    ((kind, content), *_) = node.items()
    if kind == "array":
        return read_member(z, content)
    if kind == "type":
        cls = class_of(content)
        fields = {k: _unpack(v, z) for k, v in node["fields"].items()}
        if not fields.keys() <= {f.name for f in dataclasses.fields(cls)}:
            raise ValueError("a field that the noun does not have")
        return cls(**fields)
    if kind == "dict":
        return {k: _unpack(v, z) for k, v in content.items()}
    if kind == "path":
        return Path(content)
    if kind not in ("tuple", "list"):
        raise ValueError(f"a node of kind {kind!r}")
    items = [_unpack(v, z) for v in content]
    return tuple(items) if kind == "tuple" else items
