"""Scans below a folder or an fsspec address, each with the hash of what its files are."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath

from ..errors import ScanError
from ..scans import FORMATS
from .store import Entry, Store, is_address

# Recordings that are one file; all others are folders.
FILE_SUFFIXES = (".mcap", ".bag", ".db3", ".db", ".mkv", ".sens", ".r3d")
# What tells a folder behind an address, where no reader can look before it is copied.
FOLDER_SIGNS = ("scan.json", "frames.csv", "recording.mcap", "INDEX.txt", "scene_camera.json", "odometry.csv")
KEPT = ("batch.html", "batch.csv", "batch.json")  # names of the batch's own files
UNREADABLE = "unreadable"  # in the place of a hash
NO_SCAN = ("flir",)  # formats of thermal frames alone: there is no surface to be made of them


@dataclass(frozen=True)
class Source:
    """A scan that was found.

    name : of its result below the batch's folder, with `/` where scans lie in folders of folders. place : path or
    address. content : hash of its files' names, sizes and times (or what else the storage knows them by).
    """

    name: str
    place: str
    content: str


def find_scans(place: str, out: str) -> list[Source]:
    """All scans below a folder or address, by name; what lies in `out` is none.

    A folder that some reader recognises is a scan and is not looked into. Raises ScanError where nothing is there, or
    no scan; RecipeError where the address's library is not installed.
    """
    found = list(_behind(Store(place)) if is_address(place) else _below(Path(place), out))
    if not found:
        hint = "each scan is a folder or a file of a format that `run` takes; --format is not guessed"
        raise ScanError("no scan is here or below", place=place, hint=hint)
    return sorted(_named(found), key=lambda s: s.name)


def _below(root: Path, out: str) -> Iterator[tuple[PurePosixPath, str, str]]:
    """(name, path, hash) of the scans in a folder; links are followed, rounds are not run."""
    if not root.exists():
        raise ScanError("there is no such folder", place=root)
    apart = None if is_address(out) else Path(out).resolve()
    seen: set[Path] = set()

    def look(path: Path, name: PurePosixPath) -> Iterator[tuple[PurePosixPath, str, str]]:
        real = path.resolve()
        if real in seen or real == apart:
            return
        seen.add(real)
        if _is_scan(path):
            yield name, str(path), content_of(_files(path))
        elif path.is_dir():
            try:
                # what is here goes before links to it
                inside = sorted(
                    (p for p in path.iterdir() if not p.name.startswith(".")), key=lambda p: (p.is_symlink(), p.name)
                )
            except OSError:
                yield name, str(path), UNREADABLE  # it may hold scans: the table says so
                return
            for part in inside:
                if part.is_dir() or part.suffix.lower() in FILE_SUFFIXES:
                    yield from look(part, name / part.name)

    for name, path, content in look(root, PurePosixPath()):
        yield (name if name.parts else PurePosixPath(root.resolve().name)), path, content


def _is_scan(path: Path) -> bool:
    try:
        return any(f.recognise(path) for f in FORMATS if f.name not in NO_SCAN)
    except OSError:
        return False


def _files(path: Path) -> Iterator[Entry]:
    if path.is_file():
        stat = path.stat()
        yield Entry(path.name, stat.st_size, str(stat.st_mtime_ns))
        return
    seen: set[str] = set()
    for folder, below, names in os.walk(path, followlinks=True):  # images may lie on another disk
        real = os.path.realpath(folder)
        if real in seen:
            below.clear()  # a link that leads round
            continue
        seen.add(real)
        for name in names:
            file = Path(folder, name)
            try:
                stat = file.stat()
            except OSError:
                continue  # a link to nowhere; the reader will say so
            yield Entry(file.relative_to(path).as_posix(), stat.st_size, str(stat.st_mtime_ns))


def _behind(store: Store) -> Iterator[tuple[PurePosixPath, str, str]]:
    """(name, address, hash) of the scans behind an address, told by one listing of it."""
    entries = store.entries()
    folders = {str(PurePosixPath(e.name).parent) for e in entries if PurePosixPath(e.name).name in FOLDER_SIGNS}
    for folder in sorted(folders):
        if any(str(parent) in folders for parent in PurePosixPath(folder).parents if str(parent) != folder):
            continue
        inside = [e for e in entries if folder == "." or e.name.startswith(f"{folder}/")]
        inside = [e for e in inside if not PurePosixPath(e.name).name.startswith(".")]
        name = PurePosixPath(folder) if folder != "." else PurePosixPath(store.basename)
        yield name, store.address("" if folder == "." else folder), content_of(inside)
    for entry in entries:
        path = PurePosixPath(entry.name)
        alone = not any(str(parent) in folders for parent in path.parents)
        if alone and path.suffix.lower() in FILE_SUFFIXES:
            yield path, store.address(entry.name), content_of([entry])


def _named(found: Iterable[tuple[PurePosixPath, str, str]]) -> Iterator[Source]:
    """Results bear the scans' names without suffixes, unless their folders would be one, or lie in another's."""
    found = sorted(found)
    short = [n.with_suffix("") if n.suffix.lower() in FILE_SUFFIXES else n for n, _, _ in found]
    taken = Counter(_folded(name) for name in short)
    above = {_folded(parent) for name in short for parent in name.parents}
    used: set[str] = set()
    for name, (whole, place, content) in zip(short, found, strict=True):
        own = name if taken[_folded(name)] == 1 and _folded(name) not in above else whole
        number, free = 1, own
        while _folded(free) in used or _folded(free) in KEPT:  # a.bag beside a.mkv and a.bag.mkv
            number += 1
            free = own.with_name(f"{own.name}-{number}")
        used.add(_folded(free))
        yield Source(str(free), place, content)


def _folded(name: PurePosixPath) -> str:
    """As file systems compare names that do not tell large letters from small ones."""
    return str(name).casefold()


def content_of(entries: Iterable[Entry]) -> str:
    """Hash of files' names, sizes and times."""
    h = sha256()
    for entry in sorted(entries):
        h.update(f"{entry.name}\0{entry.size}\0{entry.mark}\n".encode("utf-8", "surrogateescape"))
    return h.hexdigest()[:24]
