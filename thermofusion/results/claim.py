"""A result folder is claimed before anything is computed: it may be written, is nobody else's, and no other run's."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import BusyError, RecipeError, ResourceError, ScanError
from ..files.reading import read_json
from ..files.whole import LEFTOVER, LISTING, probe
from ..types import Scan
from .stages import WORK, scan_id

LOCK = ".thermofusion.lock"
REPORT = LISTING  # the file that makes a result: it comes last, and names all others
VIEWS = "views"
CHANGING = f"{WORK}/files.json"  # while files are changed over: whose they are, should the run be killed
# What version 0.1.0 wrote without a list.
UNLISTED = re.compile(
    r"(mesh\.(ply|glb|vtp|csv)|result\.npz|trajectory\.txt|recipe\.resolved\.toml|validation\.json|views/[\w.-]+\.png)$"
)


@contextmanager
def claimed(folder: Path, scan: Scan, names: list[str], *, overwrite: bool = False) -> Iterator[list[str]]:
    """A result folder, locked while the block runs; gives the names of what an earlier result left in it.

    names : of the files that will be written. Raises RecipeError where the folder is, holds or lies in the recording;
    ScanError where it holds something that is no result of this scan (unless `overwrite`); ResourceError where it
    cannot be written, or another run has it.
    """
    _apart(folder, scan)
    with _locked(folder):
        left = listed(folder)
        _clear(folder, names)
        if not overwrite:
            _own(folder, scan, names, left)
        probe(folder)
        probe(folder / WORK)
        tidy(folder)
        yield left


def complete(folder: Path) -> bool:
    """Whether a finished result stands there, with all its files."""
    return (folder / REPORT).is_file() and all((folder / name).is_file() for name in listed(folder))


def tidy(folder: Path) -> None:
    """Remove what killed runs left half-written."""
    for place in (folder, folder / WORK, folder / VIEWS):
        for path in place.glob(".*") if place.is_dir() else ():
            if LEFTOVER.fullmatch(path.name):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK, timeout=0)
        lock.acquire()
    except Timeout:
        hint = "wait until it has ended, or name another folder with -o"
        raise BusyError("another run is writing into this folder", place=folder, hint=hint) from None
    except (OSError, ValueError, RuntimeError, NotImplementedError) as e:
        cause = getattr(e, "strerror", None) or e
        raise ResourceError(f"the result folder cannot be written ({cause})", place=folder) from None
    try:
        yield
    finally:
        lock.release()  # the file stays: whoever removed it might take it from under a third run


def _apart(folder: Path, scan: Scan) -> None:
    """The recording is never written into, by whatever way the folder leads there."""
    try:
        out, root = folder.resolve(), scan.root.resolve()
    except (OSError, RuntimeError) as e:
        cause = getattr(e, "strerror", None) or "a loop of links"
        raise ResourceError(f"the result folder cannot be written ({cause})", place=folder) from None
    home = root if root.is_dir() else root.parent
    if not root.exists():
        return  # made in memory
    if out == root or out.is_relative_to(root) or (root.is_dir() and home.is_relative_to(out)):
        place = "is" if out == root else "lies inside" if out.is_relative_to(root) else "holds"
        raise RecipeError(f"the result folder {place} the recording", place=folder, hint="name another one with -o")


def _own(folder: Path, scan: Scan, names: list[str], left: list[str]) -> None:
    """Refuse a folder with somebody's files, or with another scan's result."""
    report = report_in(folder)
    there = [p for p in folder.iterdir() if p.name not in (LOCK, WORK) and not LEFTOVER.fullmatch(p.name)]
    ours = bool(report) or (folder / WORK).is_dir()
    foreign = next((p for p in there if not ours and not p.is_dir()), None)
    foreign = foreign or next((folder / n for n in names if n not in left and (folder / n).is_file()), None)
    hint = "name another folder with -o, or give --overwrite"
    if foreign is not None and report is not None:
        raise ScanError("this file is not of the result here, and would be replaced", place=foreign, hint=hint)
    if foreign is not None:
        raise ScanError("the folder holds something that is no result", place=foreign, hint=hint)
    known = (report or {}).get("scan", {})
    name, ident = known.get("name"), known.get("id")
    if report is not None and (name != scan.name or ident not in (None, scan_id(scan))):
        raise ScanError(f"the folder holds the result of another scan, '{name}'", place=folder, hint=hint)


def _clear(folder: Path, names: list[str]) -> None:
    """Find what stands in the way of a file before the work."""
    for part in (WORK, VIEWS):
        if (folder / part).exists() and not (folder / part).is_dir():
            raise ResourceError("a file stands where a folder of the result belongs", place=folder / part)
    for name in names:
        if (folder / name).is_dir():
            raise ResourceError("a folder stands where a file of the result belongs", place=folder / name)


def report_in(folder: Path) -> dict | None:
    """The report of a result; None where there is none, or none of ours."""
    try:
        report = read_json(folder / REPORT)
    except ScanError:
        return None
    return report if isinstance(report, dict) and "thermofusion" in report else None


def listed(folder: Path) -> list[str]:
    """The files that a finished result consists of, by its own word; empty without one."""
    report = report_in(folder)
    if report is None:  # killed while it changed over?
        try:
            report = {"files": read_json(folder / CHANGING)}
        except ScanError:
            return []
    files = report.get("files")
    if isinstance(files, list):
        return [f for f in files if isinstance(f, str) and ".." not in Path(f).parts and not Path(f).is_absolute()]
    found = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()]
    return [REPORT, *(f for f in found if UNLISTED.fullmatch(f))]
