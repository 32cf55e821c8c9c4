"""Files and folders that appear whole or not at all: the one place that makes temporary names and renames them."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ResourceError, ScanError
from .reading import read_json

# Names of temporary files, should a run be killed: `.NAME.PROCESS.RANDOM.part`, and the name's suffix again.
LEFTOVER = re.compile(r"\..*\.\d+\.[0-9a-f]{8}\.part(\.\w+)?")
# What every file of this program says of itself within its first bytes; tables, which have no room for it, begin so.
MARK, TABLES, MARKED_BYTES = (
    b"thermofusion",
    (b"x_m,y_m,z_m,nx,", b"name,kind,value_degC,", b"quantity,name,", b"scan,status,exit_code,"),
    1 << 16,
)
LISTING = "result.json"  # the file of a result that lists the others
FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))  # Windows knows no quota
# Files of this program's form that are a person's own work.
PERSONAL = (b"thermofusion-scan/", b"thermofusion-regions/", b"thermofusion-metadata/")


@contextmanager
def replacing(path: str | Path, *, whatever: bool = False) -> Iterator[Path]:
    """A temporary path in the same folder that becomes `path` when the block ends well, and vanishes otherwise.

    The file reaches the disk before its name does; its permissions are what the user's umask leaves. whatever : replace
    even what this program did not write. Raises ScanError for such a file, ResourceError where the folder or the disk
    refuses.
    """
    path = Path(path)
    _free(path)
    if not whatever:
        spared(path)
    with _refusals(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = _temporary(path)
        try:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield temporary
            _to_disk(temporary)
            temporary.replace(path)
            _to_disk(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def _free(path: Path) -> None:
    """Raises ResourceError where a folder, a device or a pipe has the name: a rename would put a file in its place."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return  # absent, or whoever writes will say what is the matter
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a device or a pipe"
        raise ResourceError(f"{what} stands where a file is to be written", place=path, hint="name a file")


def spared(path: Path) -> None:
    """Raises ScanError where a file stands that this program did not write, or that is a person's own work.

    What a result counts among its files is ours, too: earlier versions left no mark in some.
    """
    try:
        if not path.is_file():
            return
        with path.open("rb") as f:
            head = f.read(MARKED_BYTES)
    except OSError:
        return  # whoever writes will say what is the matter
    ours = (MARK in head and not any(kind in head for kind in PERSONAL)) or head.startswith(TABLES)
    if head and not ours and not _listed(path):
        hint = "name another one, or remove this one first"
        raise ScanError(
            "a file that thermofusion did not write stands here, and would be replaced", place=path, hint=hint
        )


def _listed(path: Path) -> bool:
    """Whether a result in whose folder, or sub-folder, the file lies counts it among its own."""
    for folder in path.parents[:2]:
        with suppress(ScanError):
            report = read_json(folder / LISTING)
            known = report.get("files") if isinstance(report, dict) and "thermofusion" in report else None
            return isinstance(known, list) and path.relative_to(folder).as_posix() in known
    return False


def write_whole(path: str | Path, chunks: Iterable[bytes | NDArray]) -> Path:
    """Write chunks, bytes and arrays of any shape and dtype, one after another in C order; returns the path.

    Arrays go as they lie in memory: in the unit and byte order the caller gave them. The folder must exist: a mistyped
    one is not made. Raises ResourceError.
    """
    if not Path(path).parent.is_dir():
        raise ResourceError("it cannot be written: there is no such folder", place=path)
    with replacing(path) as temporary, temporary.open("wb") as f:
        for chunk in chunks:
            if isinstance(chunk, np.ndarray):
                chunk.tofile(f)
            else:
                f.write(chunk)
    return Path(path)


def write_text(path: str | Path, text: str, *, whatever: bool = False) -> Path:
    """Write a text file in UTF-8, its folder made; returns the path. whatever : as `replacing`. Raises as it does."""
    with replacing(path, whatever=whatever) as temporary:
        temporary.write_bytes(text.encode())
    return Path(path)


def probe(folder: Path) -> None:
    """Make a folder, and a file in it for a moment. Raises ResourceError where the folder or the disk refuses."""
    with _refusals(folder):
        folder.mkdir(parents=True, exist_ok=True)
        temporary = _temporary(folder / "probe")
        temporary.write_bytes(b"probe")
        temporary.unlink()


@contextmanager
def changing_over(folder: Path, last: str) -> Iterator[Path]:
    """A temporary folder whose files replace those of `folder` one after the other when the block ends well.

    last : the file that comes last, and goes first: while it is there, all files are of one kind. Nothing of `folder`
    is touched where the block fails. Raises ResourceError.
    """
    with _refusals(folder):
        new = _temporary(folder / "new")
        new.mkdir()
        try:
            yield new
            names = sorted(p.relative_to(new) for p in new.rglob("*") if p.is_file() and p.name != last)
            (folder / last).unlink(missing_ok=True)
            for name in (*names, Path(last)):
                (folder / name).parent.mkdir(exist_ok=True)
                (new / name).replace(folder / name)
            _to_disk(folder)
        finally:
            shutil.rmtree(new, ignore_errors=True)


@contextmanager
def replacing_folder(out: Path) -> Iterator[Path]:
    """A temporary folder beside `out` that takes its place when the block ends well, and vanishes otherwise.

    An old folder of that name goes only after the new one stands. Raises ResourceError.
    """
    with _refusals(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f".{out.name[:100]}.", dir=out.parent))
        try:
            yield folder
            folder.chmod(0o777 & ~_umask())  # mkdtemp's 0700 would hide the folder from whom the umask admits
            old = folder.with_name(folder.name + ".old")
            if out.exists():
                out.rename(old)
            folder.rename(out)
            _to_disk(out.parent)
            shutil.rmtree(old, ignore_errors=True)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _refusals(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as e:
        place = path if e.filename is None or Path(e.filename).name.startswith(".") else e.filename
        hint = "free some space" if e.errno in FULL else None
        raise ResourceError(f"it cannot be written ({e.strerror})", place=place, hint=hint) from None


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name[:100]}.{os.getpid()}.{os.urandom(4).hex()}.part{path.suffix}")


def _to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's names, are on the disk; folders only where the system can."""
    if path.is_dir() and os.name != "posix":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError):  # some file systems refuse it for folders, some (FUSE) for files
            os.fsync(handle)
    finally:
        os.close(handle)


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
