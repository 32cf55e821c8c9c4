"""Thermal files by themselves, without a depth recording beside them: one maker or container a file.

`read_thermal` takes a file or a folder of any kind that the table `KINDS` knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...errors import ScanError
from ..naming import in_order, real_files
from . import flir, infiray, infratec, lepton, pictures, tables
from .frames import ThermalFrames, ThermalSaid, joined
from .named import refusal

NOT_SAID = ThermalSaid()


@dataclass(frozen=True)
class ThermalKind:
    """Files of one maker or container. recognise : by a few bytes or the name. read : path, what was said -> frames."""

    name: str
    recognise: Callable[[Path], bool]
    read: Callable[[Path, ThermalSaid], ThermalFrames]


# In the order of recognition.
KINDS: tuple[ThermalKind, ...] = (
    ThermalKind("FLIR radiometric JPEG, FFF, SEQ, CSQ, AFF", flir.recognise, lambda p, _: flir.read(p)),
    ThermalKind("InfiRay IRG and IJPEG", infiray.recognise, lambda p, _: infiray.read(p)),
    ThermalKind("InfraTec IRB", infratec.recognise, lambda p, _: infratec.read(p)),
    ThermalKind("tCam (Lepton) TJSN", lepton.recognise, lambda p, _: lepton.read(p)),
    ThermalKind("TIFF, PNG, PGM, NPY", pictures.recognise, pictures.read),
    ThermalKind("CSV and TSV tables", tables.recognise, tables.read),
)
ASIDE = ("rig.json", "times.csv", "times.txt", "readme.md", "readme.txt")  # files of ours beside the frames
MAKERS_SUFFIXES = (".jpg", ".jpeg", ".seq", ".csq", ".fff", ".irg", ".irb", ".tjsn")
RAW_SUFFIXES = (".raw", ".bin")


def recognise(path: Path) -> bool:
    """A radiometric file by its own bytes, or a folder that begins with one: what is thermal without being told so."""
    try:
        if path.is_dir():
            files = [f for f in real_files(path.iterdir()) if f.suffix.lower() in MAKERS_SUFFIXES]
            return any(_makers(f) for f in sorted(files)[:3])
        return path.is_file() and _makers(path)
    except OSError:
        return False


def _makers(path: Path) -> bool:
    return any(k.recognise(path) for k in KINDS[:4])


def read_thermal(path: str | Path, said: ThermalSaid = NOT_SAID, shape: tuple[int, int] | None = None) -> ThermalFrames:
    """The frames of a thermal file, or of a folder of them: by their clock, else in the order of their names.

    said : what a person says of the values. shape : (H, W) px by the rig, for files without a header. Pictures for the
    eye that lie among radiometric ones are left out and counted in a note. Raises ScanError: nothing is radiometric
    here (with the vendor's way to something that is), or a faulty file.
    """
    path = Path(path)
    if not path.exists():
        raise ScanError("there is no such file", place=path)
    if not path.is_dir():
        return _one(path, said, shape)
    files = [f for f in in_order(real_files(path.iterdir())).files if f.name.lower() not in ASIDE]
    parts: list[ThermalFrames] = []
    left_out: list[ScanError] = []
    for file in files:
        try:
            parts.append(_one(file, said, shape))
        except _NotThermal as e:
            left_out.append(e)
    if not parts:
        raise left_out[0] if left_out else ScanError("there are no thermal files here", place=path)
    found = joined(parts)
    if not left_out:
        return found
    first = Path(left_out[0].place or "").name
    note = f"{len(left_out)} file(s) left out, no temperatures in them (the first: {first})"
    return replace(found, notes=(*found.notes, note))


class _NotThermal(ScanError):
    """A file that holds no temperatures: the eye's picture beside a radiometric one."""


def _one(path: Path, said: ThermalSaid, shape: tuple[int, int] | None) -> ThermalFrames:
    try:
        kind = next((k for k in KINDS if k.recognise(path)), None)
        known = None if kind is not None else refusal(path)
    except OSError as e:
        raise ScanError(f"the thermal file cannot be read ({e.strerror})", place=path) from None
    if kind is not None:
        return kind.read(path, said)
    if path.suffix.lower() in RAW_SUFFIXES:
        return pictures.read_raw(path, said, shape)
    if known is not None:
        raise _NotThermal(f"this is {known[0]}", place=path, hint=known[1])
    raise _NotThermal(
        "no thermal file of a known kind",
        place=path,
        hint="export float TIFF or CSV in degC from the camera's own program",
    )


def with_times(frames: ThermalFrames, times_s: Sequence[float] | np.ndarray) -> ThermalFrames:
    """The frames with other times_s (N,), s, in their order."""
    return replace(frames, times_s=np.asarray(times_s, np.float64))


__all__ = ["KINDS", "ThermalFrames", "ThermalKind", "ThermalSaid", "read_thermal", "recognise", "with_times"]
