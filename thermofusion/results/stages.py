"""The result folder: files that appear whole or not at all, and stages that are not computed twice.

A stage's key is the hash of everything that goes into it: the scan's fingerprint, the recipe sections it reads, the
program's version, and the key of the stage before. A stored artifact with the same key is taken as it is.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from ..files.json import _plain, to_json
from ..files.whole import write_text
from ..types import Scan
from .artifacts import load_artifact, save_artifact

T = TypeVar("T")
WORK = "stages"  # sub-folder of a result that holds the artifacts


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
