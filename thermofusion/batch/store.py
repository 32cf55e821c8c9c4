"""Files behind an fsspec address (`s3://`, `file://`, `memory://` ...), copied piece by piece to and from here."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import RecipeError, ResourceError, ScanError, told_by
from ..files.whole import write_text

MARKS = ("ETag", "etag", "checksum", "md5Hash", "mtime", "LastModified", "last_modified", "created")
LATEST_S = 2_000_000_000  # a copy's time stands for the mark of what was copied: some second before the year 2033


@dataclass(frozen=True, order=True)
class Entry:
    """A file: name below its root, size in bytes, and the mark that changes when it does (time, ETag)."""

    name: str
    size: int
    mark: str


def is_address(place: str) -> bool:
    """Whether fsspec is asked, rather than this machine's disk."""
    return "://" in place or "::" in place


class Store:
    """What lies below an address. Raises RecipeError where fsspec or the address's own library is missing."""

    def __init__(self, address: str) -> None:
        try:
            core: Any = import_module("fsspec.core")
        except ImportError:
            hint = "pip install 'thermofusion[cluster]', and s3fs for s3://"
            raise RecipeError("addresses need fsspec, which is not installed", place=address, hint=hint) from None
        try:
            self._fs, root = core.url_to_fs(address)
        except (ImportError, ValueError) as e:
            raise RecipeError(f"this kind of address cannot be used ({e})", place=address) from None
        self._root, self._shown = str(root).rstrip("/"), address.rstrip("/")

    @property
    def basename(self) -> str:
        """The last part of the address."""
        return PurePosixPath(self._root).name or "scan"

    def address(self, name: str) -> str:
        """Of a file or folder in here."""
        return f"{self._shown}/{name}" if name else self._shown

    def entries(self) -> list[Entry]:
        """All files in here, or the one that the address itself is; empty where there is none. Raises ScanError."""
        with _refusals(self._shown):
            self._fs.invalidate_cache()
            try:
                found = self._fs.find(self._root, detail=True)
            except FileNotFoundError:
                return []
        return sorted(Entry(self._name(path), int(info.get("size") or 0), _mark(info)) for path, info in found.items())

    def _name(self, path: str) -> str:
        name = str(path)[len(self._root) :] if str(path).startswith(self._root) else f"/{path}"
        return name.strip("/") or self.basename

    def _path(self, name: str) -> str:
        return self._root if name == self.basename and self._fs.isfile(self._root) else f"{self._root}/{name}"

    def read(self, name: str) -> bytes | None:
        """A small file's content, None where it is not there."""
        try:
            return bytes(self._fs.cat_file(f"{self._root}/{name}"))
        except FileNotFoundError:
            return None

    def write(self, name: str, content: bytes) -> None:
        """A small file. Raises ResourceError."""
        with _refusals(self.address(name), writing=True):
            self._fs.makedirs(str(PurePosixPath(f"{self._root}/{name}").parent), exist_ok=True)
            self._fs.pipe_file(f"{self._root}/{name}", content)

    def fetch(self, entry: Entry, to: Path) -> None:
        """Copy a file here, piece by piece; its time tells the entry's mark. What is here already stays."""
        moment_s = int(sha256(entry.mark.encode()).hexdigest()[:12], 16) % LATEST_S
        if to.is_file() and to.stat().st_size == entry.size and int(to.stat().st_mtime) == moment_s:
            return
        with _refusals(self.address(entry.name)):
            to.parent.mkdir(parents=True, exist_ok=True)
            part = to.with_name(f".{to.name[:100]}.copied")
            self._fs.get_file(self._path(entry.name), str(part))
            os.utime(part, (moment_s, moment_s))
            part.replace(to)

    def send(self, path: Path, name: str) -> None:
        """Copy a file there, piece by piece. Raises ResourceError."""
        with _refusals(self.address(name), writing=True):
            self._fs.makedirs(str(PurePosixPath(f"{self._root}/{name}").parent), exist_ok=True)
            self._fs.put_file(str(path), f"{self._root}/{name}")

    def remove(self, name: str) -> None:
        """A file that may be gone already."""
        with suppress(FileNotFoundError):
            self._fs.rm_file(f"{self._root}/{name}")


def put(out: str, name: str, text: str, *, whatever: bool = False) -> None:
    """Write a small text file below a path or an address. whatever : as `files.whole.replacing`. Raises as it does."""
    if is_address(out):
        Store(out).write(name, text.encode())
    else:
        write_text(Path(out) / name, text, whatever=whatever)


class Mirror:
    """A folder here that stands for one behind an address: what changes in it is sent on request."""

    def __init__(self, store: Store, folder: Path) -> None:
        self._store, self._folder = store, folder
        there = store.entries()
        _only(folder, {e.name for e in there})
        for entry in there:
            store.fetch(entry, folder / entry.name)
        self._sent = self._stats()

    def _stats(self) -> dict[str, tuple[int, int]]:
        files = (p for p in self._folder.rglob("*") if p.is_file() and not p.name.startswith("."))
        return {p.relative_to(self._folder).as_posix(): (p.stat().st_size, p.stat().st_mtime_ns) for p in files}

    def send(self, last: str = "", below: str = "") -> None:
        """Send what is new in the folder `below`; the file `last` goes first and comes last, as on a disk."""
        now = self._stats()
        new = [n for n in sorted(now) if n.startswith(below) and self._sent.get(n) != now[n] and n != last]
        if last and (new or now.get(last) != self._sent.get(last)):
            self._store.remove(last)
        for name in new:
            self._store.send(self._folder / name, name)
        gone = [] if below else [n for n in self._sent if n not in now]
        for name in gone:
            self._store.remove(name)
            del self._sent[name]
        if last and last in now:
            self._store.send(self._folder / last, last)
            new = [*new, last]
        self._sent |= {n: now[n] for n in new}


@contextmanager
def at_hand(place: str) -> Iterator[Path]:
    """A scan's path on this machine: its own, or of a copy that goes when the block ends (not when it is killed).

    The copy lies at the same path whenever the same address is asked for: what a killed worker had copied is used.
    """
    if not is_address(place):
        yield Path(place)
        return
    store = Store(place)
    home = scratch(place)
    entries = store.entries()
    if not entries:
        raise ScanError("there is no such scan", place=place)
    alone = len(entries) == 1 and entries[0].name == store.basename
    root = home if alone else home / store.basename
    _only(root, {e.name for e in entries})
    try:
        for entry in entries:
            store.fetch(entry, root / entry.name)
        yield home / store.basename
    finally:
        shutil.rmtree(home, ignore_errors=True)


def scratch(place: str) -> Path:
    """The folder in which an address's copy lies, in the system's place for temporary files (TMPDIR).

    Only this user may look into it. Raises ResourceError where somebody else has made it.
    """
    user = os.getuid() if hasattr(os, "getuid") else None
    home = Path(tempfile.gettempdir()) / f"thermofusion-batch-{user}"
    try:
        home.mkdir(mode=0o700, exist_ok=True)
        stat = home.lstat()
    except OSError as e:
        raise ResourceError(f"it cannot be written ({e.strerror})", place=home, hint="set TMPDIR") from None
    if user is not None and (stat.st_uid != user or stat.st_mode & 0o077 or home.is_symlink()):
        raise ResourceError("this folder is open to others", place=home, hint="set TMPDIR to a place of your own")
    return home / sha256(place.encode()).hexdigest()[:16]


def _only(folder: Path, names: set[str]) -> None:
    """Remove files of an earlier copy that are no longer there."""
    for path in folder.rglob("*") if folder.is_dir() else ():
        if path.is_file() and path.relative_to(folder).as_posix() not in names:
            path.unlink()


def _mark(info: dict[str, Any]) -> str:
    value = next((info[k] for k in MARKS if info.get(k)), "")
    return value.isoformat() if isinstance(value, datetime) else str(value)


@contextmanager
def _refusals(place: str, writing: bool = False) -> Iterator[None]:
    """Whatever a storage's library raises, as one sentence of ours."""
    try:
        yield
    except (FileNotFoundError, RecipeError):
        raise
    except Exception as e:
        kind = ResourceError if writing else ScanError
        raise kind(f"the storage refused ({told_by(e)})", place=place) from None
