"""Stages that are not computed twice.

A stage's key is the hash of everything that goes into it: the scan's fingerprint, the recipe sections it reads (the
same that it is handed), the edition of its code, and the key of the stage before. A stored artifact with the same key
is taken as it is. Artifact and key are one file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar

from ..errors import ScanError
from ..files.json import plain
from ..progress import Progress
from ..recipe import Recipe
from ..types import Scan
from .artifacts import load_artifact, load_note, save_artifact

T = TypeVar("T", covariant=True)
BY_STAGE = {"materials": "temperature"}  # fields of a scan that one stage alone reads
WORK = "stages"  # sub-folder of a result that holds the artifacts
# What version 0.1.0 left there under other names.
STALE = (
    "track.json",
    "surface.json",
    "align.json",
    "observe.json",
    "temperature.json",
    "track.npz",
    "align.npz",
    "observe.npz",
)


@dataclasses.dataclass(frozen=True)
class Stage:
    """A step of the method.

    reads : the recipe sections that it is handed, and that its key holds. edition : raised when its numbers change.
    handed_out : the file of a finished result that holds the stage's artifact instead of a file of its own.
    """

    name: str
    reads: tuple[str, ...]
    edition: int = 1
    handed_out: str = ""

    @property
    def file(self) -> str:
        """Where its artifact is stored in a result folder."""
        return f"{WORK}/{self.name}.npz"

    def sections(self, recipe: Recipe) -> dict[str, Any]:
        """What the stage reads of a recipe, by name."""
        return {name: getattr(recipe, name) for name in self.reads}


@dataclasses.dataclass(frozen=True)
class StagePlan:
    """What a stage would do: `reuse` a stored artifact, or compute, and why."""

    name: str
    reuse: bool
    why: str


class Computes(Protocol[T]):
    """A stage's function: recipe sections by name, and progress."""

    def __call__(self, *, progress: Progress, **sections: Any) -> T: ...


class Stages:
    """Runs stages in order and remembers their results in a folder (or not at all, without a folder)."""

    def __init__(
        self, folder: Path | None, base: Mapping[str, Any], recipe: Recipe, said: Mapping[str, Any] | None = None
    ) -> None:
        """said : by stage, what of the scan that stage alone reads."""
        self._folder, self._said = folder, dict(said or {})
        self._base, self._recipe = dict(base), recipe
        self.key = _hash(base)
        self.note: dict[str, Any] = {}
        self.reused: list[str] = []

    def run(self, stage: Stage, compute: Computes[T], progress: Progress, *, anew: bool = False) -> T:
        """The stage's result: stored, if its key still fits; else computed, and stored. anew : whatever is stored."""
        stored, _ = self._look(stage, anew)
        self.note = {"key": self.key, "inputs": self._inputs(stage)}
        if stored is not None:
            try:
                value = load_artifact(stored)
                self.reused.append(stage.name)
                return value
            except ScanError:
                pass  # damaged since its key was read: compute again
        value = compute(**stage.sections(self._recipe), progress=progress)
        if self._folder is not None:
            save_artifact(self._folder / stage.file, value, self.note)
        return value

    def plan(self, stage: Stage, *, anew: bool = False) -> StagePlan:
        """What `run` would do, without doing it; the next stage's key goes on from here."""
        stored, why = self._look(stage, anew)
        return StagePlan(stage.name, stored is not None, why)

    def _look(self, stage: Stage, anew: bool) -> tuple[Path | None, str]:
        """The file whose artifact is as good as computing, and why it is, or why there is none."""
        sections = plain(stage.sections(self._recipe) | self._said.get(stage.name, {}))
        self.key = _hash({"before": self.key, "stage": stage.name, "edition": stage.edition, "inputs": sections})
        if self._folder is None:
            return None, "nothing is stored"
        if anew:
            return None, "asked for"
        why = "not computed yet"
        for artifact in (self._folder / name for name in (stage.file, stage.handed_out) if name):
            if not artifact.is_file():
                continue
            try:
                note = load_note(artifact)
            except ScanError:
                why = "what is stored cannot be read"
                continue
            if note.get("key") == self.key:
                return artifact, "inputs unchanged"
            now, then = self._inputs(stage), note.get("inputs", {})
            changed = sorted(k for k in now.keys() | then.keys() if now.get(k) != then.get(k))
            why = f"changed: {', '.join(changed)}" if changed else "an earlier stage changed"
        return None, why

    def tidy(self) -> None:
        """Remove what an earlier version stored under other names."""
        if self._folder is not None:
            for name in STALE:
                (self._folder / WORK / name).unlink(missing_ok=True)

    def _inputs(self, stage: Stage) -> dict[str, Any]:
        sections = plain(stage.sections(self._recipe) | self._said.get(stage.name, {}))
        inputs = {**self._base, "edition": stage.edition, **_flat(sections)}
        return json.loads(json.dumps(inputs))


def fingerprint(scan: Scan) -> str:
    """Hash of all that a scan says and of its files' names, sizes and times (their bytes are not read).

    Names are taken from the scan's own folder: a scan that was moved as it is, is the same.
    """
    h = hashlib.sha256()
    home = f"{scan.root}/"
    streams = ("depth", "color", "thermal")
    for stream in (scan.depth, scan.color, scan.thermal):
        if stream is None:
            continue
        h.update(stream.times_s.tobytes() + stream.index.tobytes() + stream.usable.tobytes())
        for place in stream.places:
            try:
                stat = Path(place).stat()
                h.update(
                    f"{place.removeprefix(home)} {stat.st_size} {stat.st_mtime_ns};".encode("utf-8", "surrogateescape")
                )
            except OSError:
                h.update(place.encode("utf-8", "surrogateescape"))
    if scan.thermal is not None and scan.thermal.conditions is not None:
        h.update(_hash(scan.thermal.conditions.stated).encode())
    apart = (*streams, "root", *BY_STAGE)
    rest = {f.name: getattr(scan, f.name) for f in dataclasses.fields(scan) if f.name not in apart}
    rest["thermal camera"] = None if scan.thermal is None else scan.thermal.camera
    h.update(_hash(rest).encode())
    return h.hexdigest()[:24]


def said_to(scan: Scan) -> dict[str, dict[str, object]]:
    """By stage, what of the scan that stage alone reads: a change of it leaves the stages before as they are."""
    out: dict[str, dict[str, object]] = {}
    for name, stage in BY_STAGE.items():
        if getattr(scan, name):
            out.setdefault(stage, {})[name] = _hash(getattr(scan, name))
    return out


def run_id(key: str, output: object) -> str:
    """The id that every file of a result carries: same input, same id."""
    return _hash({"key": key, "output": output})[:12]


def scan_id(scan: Scan) -> str:
    """What tells one recording from another, wherever it lies: its name, and its streams' times."""
    times = {k: s.times_s for k in ("depth", "color", "thermal") if (s := getattr(scan, k)) is not None}
    return _hash({"name": scan.name, **times})[:16]


def _hash(value: object) -> str:
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True, default=str).encode()).hexdigest()[:24]


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat
