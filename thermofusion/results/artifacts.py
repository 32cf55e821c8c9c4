"""Nested frozen dataclasses, arrays, tuples, dicts and scalars in one .npz: arrays and JSON, nothing that runs."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ScanError
from ..files.reading import read_whole
from ..files.whole import replacing
from .nouns import class_of, name_of

TREE, NOTE = "__tree__", "__note__"
MAX_MEMBERS = 4096  # arrays in a file: a result has some fifty
MAX_TREE_BYTES = 64 << 20  # of JSON
MAX_INFLATION = 8  # a file may unpack to this many times its size,
ALWAYS_UNPACKED_BYTES = 64 << 20  # or to this much, whatever its size
UNUSABLE = "the file is damaged, or no result of thermofusion"
AGAIN = "run `thermofusion run` again"


def save_artifact(path: Path, value: object, note: Mapping[str, Any] | None = None) -> None:
    """Store a value, and a note (JSON) beside it in the same file; arrays bear their fields' names.

    Raises ResourceError, TypeError.
    """
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps(_pack(value, arrays))
    texts = {TREE: tree, NOTE: json.dumps(dict(note or {}))}
    members = {k: np.frombuffer(v.encode(), np.uint8) for k, v in texts.items()}
    with replacing(path) as temporary, temporary.open("wb") as f:
        np.savez(f, allow_pickle=False, **members, **arrays)


def load_artifact(path: Path) -> Any:
    """Inverse of `save_artifact`. Raises ScanError on a torn, foreign or newer file."""
    try:
        with _opened(path) as z:
            tree = json.loads(_member(z, TREE).tobytes())
            return _unpack(tree, z)
    except ScanError as e:
        raise ScanError(e.cause, place=path, hint=e.hint or AGAIN) from None
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError, EOFError, zipfile.BadZipFile):
        raise ScanError(UNUSABLE, place=path, hint=AGAIN) from None


def load_note(path: Path) -> dict[str, Any]:
    """The note of a stored artifact, the rest unread. Raises ScanError."""
    try:
        with _opened(path) as z:
            note = json.loads(_member(z, NOTE).tobytes())
    except (ValueError, KeyError, RecursionError, EOFError, zipfile.BadZipFile):
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
        return _member(z, content)
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


def _opened(path: Path) -> zipfile.ZipFile:
    """The archive, its claims checked before anything is unpacked."""
    data = read_whole(path)
    z = zipfile.ZipFile(io.BytesIO(data))
    members = z.infolist()
    if len(members) > MAX_MEMBERS or len({m.filename for m in members}) < len(members):
        raise ValueError("too many members, or one name twice")
    if any(m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for m in members):
        raise ValueError("a member that is neither stored nor deflated")
    if sum(m.file_size for m in members) > max(ALWAYS_UNPACKED_BYTES, MAX_INFLATION * len(data)):
        raise ValueError("it would unpack to far more than its size")
    return z


def _member(z: zipfile.ZipFile, name: str) -> np.ndarray:
    """One array, its header held against the bytes that are there."""
    info = z.getinfo(f"{name}.npy")
    if name in (TREE, NOTE) and info.file_size > MAX_TREE_BYTES:
        raise ValueError("a tree too large")
    data = z.read(info)
    f = io.BytesIO(data)
    version = np.lib.format.read_magic(f)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read_header(f)
    left = len(data) - f.tell()
    count = 1
    for n in shape:
        count *= n
    if dtype.hasobject or count * dtype.itemsize != left:
        raise ValueError("an array's header and its size disagree")
    array = np.frombuffer(data, dtype, offset=f.tell()).copy()
    return array.reshape(shape, order="F" if fortran else "C")
