"""The result folder: files that appear whole or not at all, and stages that are not computed twice.

A stage's key is the hash of everything that goes into it: the scan's fingerprint, the recipe sections it reads, the
program's version, and the key of the stage before. A stored artifact with the same key is taken as it is.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import io
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel

from .errors import ResourceError
from .types import Scan

T = TypeVar("T")
WORK = "stages"  # sub-folder of a result that holds the artifacts


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder that becomes `path` when the block ends well, and vanishes otherwise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as e:
        raise ResourceError(f"the file cannot be written ({e.strerror})", place=path, hint="free some space") from e
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def to_json(value: object) -> str:
    """JSON for people and programs: NaN becomes null, arrays become lists."""
    return json.dumps(_plain(value), indent=1, allow_nan=False, ensure_ascii=False)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, BaseModel):
        return _plain(value.model_dump())
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value


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


# ---------------------------------------------------------------- stages


@dataclasses.dataclass(frozen=True)
class StagePlan:
    """What a stage would do: `reuse` a stored artifact, or compute, and why."""

    name: str
    reuse: bool
    why: str


class Stages:
    """Runs named stages in order and remembers their results in a folder (or not at all, without a folder)."""

    def __init__(
        self, folder: Path | None, base: Mapping[str, Any], *, redo_from: str | None = None, order: tuple[str, ...] = ()
    ) -> None:
        self._folder = None if folder is None else folder / WORK
        self._key = _hash(base)
        self._base = dict(base)
        self._redo = frozenset(order[order.index(redo_from) :]) if redo_from else frozenset()
        self.reused: list[str] = []

    def run(self, name: str, inputs: Mapping[str, Any], compute: Callable[[], T]) -> T:
        """The stage's result: stored, if its key still fits; else computed, and stored."""
        plan, artifact = self._advance(name, inputs)
        if plan.reuse and artifact is not None:
            try:
                value = load_artifact(artifact)
                self.reused.append(name)
                return value
            except (OSError, ValueError, KeyError, TypeError, AttributeError):
                pass  # torn or written by another version: compute again
        value = compute()
        if artifact is not None:
            save_artifact(artifact, value)
            write_text(artifact.with_suffix(".json"), json.dumps({"key": self._key, "inputs": self._stored(inputs)}))
        return value

    def plan(self, name: str, inputs: Mapping[str, Any]) -> StagePlan:
        """What `run` would do, without doing it."""
        return self._advance(name, inputs)[0]

    def _stored(self, inputs: Mapping[str, Any]) -> dict[str, Any]:
        return json.loads(to_json({**self._base, **_flat(_plain(inputs))}))

    def _advance(self, name: str, inputs: Mapping[str, Any]) -> tuple[StagePlan, Path | None]:
        self._key = _hash({"before": self._key, "stage": name, "inputs": _plain(inputs)})
        if self._folder is None:
            return StagePlan(name, False, "nothing is stored"), None
        artifact = self._folder / f"{name}.npz"
        if name in self._redo:
            return StagePlan(name, False, "asked for"), artifact
        try:
            note = json.loads(artifact.with_suffix(".json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return StagePlan(name, False, "not computed yet"), artifact
        if note.get("key") == self._key and artifact.is_file():
            return StagePlan(name, True, "inputs unchanged"), artifact
        now, then = self._stored(inputs), note.get("inputs", {})
        changed = sorted(k for k in now.keys() | then.keys() if now.get(k) != then.get(k))
        why = f"changed: {', '.join(changed)}" if changed else "an earlier stage changed"
        return StagePlan(name, False, why), artifact


def fingerprint(scan: Scan) -> str:
    """Hash of all that a scan says and of its files' names, sizes and times (their bytes are not read)."""
    h = hashlib.sha256()
    for stream in (scan.depth, scan.color, scan.thermal):
        if stream is None:
            continue
        h.update(stream.times_s.tobytes() + stream.index.tobytes() + stream.usable.tobytes())
        for place in stream.places:
            try:
                stat = Path(place).stat()
                h.update(f"{place} {stat.st_size} {stat.st_mtime_ns};".encode())
            except OSError:
                h.update(place.encode())
    rest = {
        f.name: getattr(scan, f.name)
        for f in dataclasses.fields(scan)
        if f.name not in ("depth", "color", "thermal", "root")
    }
    h.update(_hash(rest).encode())
    return h.hexdigest()[:24]


def _hash(value: object) -> str:
    return hashlib.sha256(json.dumps(_plain(value), sort_keys=True, default=str).encode()).hexdigest()[:24]


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat
