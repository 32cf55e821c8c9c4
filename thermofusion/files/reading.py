"""Files at the border: safe paths, whole reads, images decoded and checked, with the file named in every error."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..types import Float
from .pnm import read_pnm

MAX_PIXELS = 64_000_000  # a header that claims more is refused before it is decoded
MAX_FILE_BYTES = 512 * 2**20  # of one image or text file
MAX_NAME = 1000  # characters of a path inside a scan
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
COPY_AGAIN = "copy the recording again"


def inside(root: Path, name: str, *, place: object) -> Path:
    """`root / name`, refused if it leaves the scan's folder (also through a symbolic link)."""
    if len(name) > MAX_NAME:
        raise ScanError(f"the path '{name[:40]}...' is {len(name)} characters long", place=place)
    try:
        root = root.resolve()
        path = (root / name).resolve()
    except (OSError, ValueError, RuntimeError) as e:  # too long, a NUL inside, a loop of links
        raise ScanError(f"the path {name[:80]!r} is not usable ({type(e).__name__})", place=place) from None
    if not path.is_relative_to(root):
        raise ScanError(f"the path '{name}' leaves the scan's folder", place=place)
    return path


def read_bytes(path: Path, kind: str = "image") -> bytes:
    """A whole regular file. Raises ScanError: absent, no regular file (a pipe would block for ever), empty, huge."""
    try:
        if not path.exists():
            raise ScanError(f"the {kind} file is named in the scan but absent", place=path, hint=COPY_AGAIN)
        if not path.is_file():
            raise ScanError(f"the {kind} file is a folder or a device, expected a regular file", place=path)
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ScanError(f"the {kind} file is larger than {MAX_FILE_BYTES >> 20} MiB", place=path)
        data = path.read_bytes()
    except OSError as e:
        raise ScanError(f"the {kind} file cannot be read ({e.strerror})", place=path) from None
    if not data:
        raise ScanError(f"the {kind} file is empty", place=path, hint=COPY_AGAIN)
    return data


def read_text(path: Path, kind: str = "text") -> str:
    """A whole text file in UTF-8 (a byte-order mark is fine)."""
    try:
        return read_bytes(path, kind).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ScanError(f"the {kind} file is no UTF-8 text", place=path) from None


def read_json(path: Path) -> Any:
    """A JSON file; ScanError with the line for a fault in it."""
    return parse_json(read_text(path, "JSON"), path)


def parse_json(text: str, place: object) -> Any:
    """JSON text; ScanError with the line for a fault in it."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as e:
        raise ScanError(f"not valid JSON: {e.msg} at line {e.lineno}", place=place) from None
    except (ValueError, RecursionError):
        raise ScanError("not valid JSON: a number too long, or nested too deep", place=place) from None


def read_numbers(path: Path, *, columns: int | None = None) -> Float:
    """Rows of numbers (N, columns), blanks or commas between, `#` comments; ScanError names the line."""
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(w) for w in words]
        except ValueError:
            raise ScanError("expected numbers only", place=f"{path}, line {number}") from None
        width = columns or (len(rows[0]) if rows else len(row))
        if len(row) != width:
            raise ScanError(f"expected {width} numbers, got {len(row)}", place=f"{path}, line {number}")
        rows.append(row)
    return np.array(rows, np.float64).reshape(len(rows), len(rows[0]) if rows else columns or 0)


def read_image(path: Path, *, shape: tuple[int, int] | None = None, kind: str = "image") -> NDArray:
    """Decode an image unchanged, (H, W) or (H, W, 3): depth of bits kept, colour as B, G, R. PNG, JPEG, TIFF, PNM.

    shape : expected (height, width), px. Raises ScanError naming the file: absent, empty, truncated, oversized, of
    another size.
    """
    return decode_image(read_bytes(path, kind), shape=shape, kind=kind, place=path)


def decode_image(data: bytes, *, shape: tuple[int, int] | None, kind: str, place: object) -> NDArray:
    """`read_image` on bytes: (H, W) or (H, W, 3). The size in px that the header claims is judged before decoding."""
    size = claimed_size(data, place)
    if size is None:
        raise ScanError(
            f"the {kind} file is no image of a known kind", place=place, hint="expected PNG, JPEG, TIFF, PGM or PPM"
        )
    w, h = size
    if w * h > MAX_PIXELS or w == 0 or h == 0:
        raise ScanError(f"the {kind} claims {w} x {h} px, at most {MAX_PIXELS} pixels are decoded", place=place)
    if shape is not None and (h, w) != shape:
        raise ScanError(
            f"the {kind} is {w} x {h} px, expected {shape[1]} x {shape[0]}",
            place=place,
            hint="width_px and height_px of that camera must match its images",
        )
    fault = _png_fault(data) if data.startswith(PNG_MAGIC) else None
    if data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-64:]:
        fault = "truncated (JPEG without its end)"
    if fault:
        raise ScanError(f"the {kind} file is {fault}", place=place, hint=COPY_AGAIN)
    if data[:1] == b"P":
        return read_pnm(data, place=place)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise ScanError(f"the {kind} file is truncated or damaged: it cannot be decoded", place=place, hint=COPY_AGAIN)
    if image.shape[:2] != (h, w):
        raise ScanError(f"the {kind} file decodes to another size than its header claims", place=place)
    return image


def claimed_size(data: bytes, place: object = None) -> tuple[int, int] | None:
    """(width, height) an image's header claims; None if it is no PNG, JPEG, TIFF, PGM or PPM."""
    if data.startswith(PNG_MAGIC) and len(data) >= 24:
        w, h = struct.unpack(">II", data[16:24])
        return w, h
    if data[:2] == b"\xff\xd8":
        return _jpeg_size(data)
    if data[:2] in (b"P5", b"P6"):
        return read_pnm(data, place=place, header_only=True).shape[1::-1]
    if data[:4] in (b"II*\0", b"MM\0*"):
        return _tiff_size(data)
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height from the first start-of-frame marker (ITU T.81, B.2.2)."""
    at = 2
    while at + 9 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            h, w = struct.unpack(">HH", data[at + 5 : at + 9])
            return w, h
        else:
            at += 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Width and height from the first directory's tags 256 and 257 (TIFF 6.0)."""
    e = "<" if data[:2] == b"II" else ">"
    size = {}
    try:
        (at,) = struct.unpack_from(e + "I", data, 4)
        (count,) = struct.unpack_from(e + "H", data, at)
        for k in range(min(count, 512)):
            tag, kind = struct.unpack_from(e + "HH", data, at + 2 + 12 * k)
            if tag in (256, 257) and kind in (3, 4):
                (size[tag],) = struct.unpack_from(e + ("H" if kind == 3 else "I"), data, at + 10 + 12 * k)
    except struct.error:
        return None
    return (size[256], size[257]) if len(size) == 2 else None


def _png_fault(data: bytes) -> str | None:
    """What is wrong with a PNG's chunks; decoders fill a torn image with grey and say nothing."""
    at = len(PNG_MAGIC)
    while at + 12 <= len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            return "truncated (PNG without its end)"
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            return "damaged (PNG checksum)"
        if name == b"IEND":
            return None
        at = end
    return "truncated (PNG without its end)"


def depth_from_raw(
    raw: NDArray, unit_m: float, *, place: object, invalid: tuple[int, ...] = (0,)
) -> NDArray[np.float32]:
    """16-bit depth `raw` (H, W), numbers of `unit_m`, to float32 metres with NaN where there is none."""
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise ScanError(f"depth is {raw.dtype} with {raw.ndim} axes, expected 16-bit grey", place=place)
    depth = raw.astype(np.float32) * np.float32(unit_m)
    for value in invalid:
        depth[raw == value] = np.nan
    return depth


def read_whole(path: str | Path) -> bytes:
    """A file's bytes. Raises ScanError."""
    try:
        return Path(path).read_bytes()
    except OSError as e:
        raise ScanError(f"the file cannot be read ({e.strerror})", place=path) from None


def read_array(data: bytes, dtype: np.dtype | str, count: int, offset: int, place: object) -> NDArray:
    """Numbers (N,), `count` of them, from byte `offset` on, writable. Raises ScanError if the file ends before."""
    dtype = np.dtype(dtype)
    if count < 0 or offset < 0 or offset + count * dtype.itemsize > len(data):
        raise ScanError("the file is truncated: it ends before its own header says", place=place)
    return np.frombuffer(data, dtype, count, offset).copy()
