"""The result folder: files that appear whole or not at all, and stages that are not computed twice.

A stage's key is the hash of everything that goes into it: the scan's fingerprint, the recipe sections it reads, the
program's version, and the key of the stage before. A stored artifact with the same key is taken as it is.
"""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from ..files.whole import replacing

# ---------------------------------------------------------------- artifacts: dataclasses of arrays as .npz


def save_artifact(path: Path, value: object) -> None:
    """Store nested frozen dataclasses, arrays, tuples, dicts and scalars in one .npz (no pickles)."""
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps(_pack(value, arrays))
    with replacing(path) as temporary, temporary.open("wb") as f:
        np.savez(f, allow_pickle=False, __tree__=np.frombuffer(tree.encode(), np.uint8), **arrays)


def load_artifact(path: Path) -> Any:
    """Inverse of `save_artifact`. Raises ValueError, KeyError or OSError on a torn or foreign file."""
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as z:
        return _unpack(json.loads(z["__tree__"].tobytes()), z)


def _pack(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, np.ndarray):
        arrays[f"a{len(arrays)}"] = value
        return {"array": f"a{len(arrays) - 1}"}
    if isinstance(value, Enum):
        return _pack(value.value, arrays)
    if isinstance(value, np.generic):
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _pack(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
        return {"type": f"{type(value).__module__}:{type(value).__qualname__}", "fields": fields}
    if isinstance(value, tuple | list):
        return {"tuple" if isinstance(value, tuple) else "list": [_pack(v, arrays) for v in value]}
    if isinstance(value, Mapping):
        return {"dict": {str(k): _pack(v, arrays) for k, v in value.items()}}
    if isinstance(value, Path):
        return {"path": str(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} cannot be stored in an artifact")


def _unpack(node: Any, arrays: Any) -> Any:
    if not isinstance(node, dict):
        return node
    ((kind, content), *_) = node.items()
    if kind == "array":
        return arrays[content]
    if kind == "type":
        module, _, name = content.partition(":")
        if not module.startswith("thermofusion."):
            raise ValueError(f"an artifact may not name {content}")
        cls = getattr(importlib.import_module(module), name)
        return cls(**{k: _unpack(v, arrays) for k, v in node["fields"].items()})
    if kind == "dict":
        return {k: _unpack(v, arrays) for k, v in content.items()}
    if kind == "path":
        return Path(content)
    items = [_unpack(v, arrays) for v in content]
    return tuple(items) if kind == "tuple" else items
