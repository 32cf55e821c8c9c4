"""Thermal files that are not read: what each looks like, why, and its vendor's way to float TIFF or CSV."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ...files.reading import open_regular
from .flir import jpeg_segments

HEAD_BYTES = 2**20


def refusal(path: Path) -> tuple[str, str] | None:
    """(what the file is and why it is not read, the way) of a file that is known by its bytes or name; else None."""
    with open_regular(path, limit_bytes=None) as f:
        head = f.read(HEAD_BYTES)
        f.seek(max(f.seek(0, 2) - HEAD_BYTES, 0))
        tail = f.read()
    return next(((what, way) for test, what, way in _KINDS if test(head, tail, path.suffix.lower())), None)


def _dji(head: bytes, tail: bytes, suffix: str) -> bool:
    found = dict(jpeg_segments(head)) if head[:2] == b"\xff\xd8" else {}
    return b"DJI\0" in found.get(0xE1, b"") + head[:65536] and {0xE3, 0xE4} <= found.keys()


def _hikmicro(head: bytes, tail: bytes, suffix: str) -> bool:
    end = tail.rfind(b"\xff\xd9HDRI")
    return head[:2] == b"\xff\xd8" and (end >= 0 or b"\xff\xd9HDRI" in head)


def _uni_t(head: bytes, tail: bytes, suffix: str) -> bool:
    return head[:2] == b"BM" and int.from_bytes(head[2:6], "little") < len(head)


def _ends(*suffixes: str) -> Callable[[bytes, bytes, str], bool]:
    return lambda head, tail, suffix: suffix in suffixes


def _picture(head: bytes, tail: bytes, suffix: str) -> bool:
    return head[:2] in (b"\xff\xd8", b"BM") or head[:4] == b"GIF8"


_KINDS: tuple[tuple[Callable[[bytes, bytes, str], bool], str, str], ...] = (
    (
        _dji,
        "a DJI R-JPEG: its counts become temperatures by the vendor's own library alone",
        "convert each with DJI's Thermal SDK (`dji_irp -s IN.JPG -a measure --measurefmt float32 -o OUT.raw`); such "
        ".raw files are read in the size that --rig states",
    ),
    (
        _hikmicro,
        "a HIKMICRO picture: counts alone, the scale stands in the picture",
        "export it from HIKMICRO Analyzer as CSV in degC",
    ),
    (
        _uni_t,
        "a UNI-T bitmap: 8 bits after contrast stretching, its temperatures are lost",
        "record with a program that stores CSV or float TIFF in degC",
    ),
    (_ends(".is2", ".is3"), "a Fluke recording", "export it from SmartView or Fluke Connect as CSV in degC"),
    (_ends(".bmt"), "a Testo recording", "export it from testo IRSoft as CSV or Excel in degC"),
    (_ends(".ravi", ".tiffx"), "an Optris recording", "export it from PIX Connect as CSV or radiometric TIFF"),
    (_ends(".sp", ".seek"), "a Seek recording", "export it as CSV or TIFF in degC"),
    (
        _ends(".ats", ".ptw", ".sfmov", ".inc"),
        "a FLIR science recording",
        "export it from Research Studio as CSV or TIFF",
    ),
    (
        _picture,
        "an ordinary picture: no temperatures are stored in it",
        "set the camera to radiometric pictures, or export float TIFF or CSV in degC with its own program",
    ),
)
