"""Files at the border: safe paths, one door for every file, JSON, numbers, images; the file named in every error."""

from __future__ import annotations

import io
import json
import math
import os
import re
import stat
import struct
import zlib
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..types import Float
from .pnm import read_pnm
from .tiff import is_tiff, tiff_pages

MAX_PIXELS = 64_000_000  # a header that claims more is refused before it is decoded
MAX_FILE_BYTES = 512 * 2**20  # of one image or mesh
MAX_TEXT_BYTES = 128 * 2**20  # of a text file: a million poses with room to spare
MAX_JSON_BYTES = 16 * 2**20  # Python's objects take some twenty times as much
MAX_JSON_DEPTH = 64  # ours have seven
MAX_LINES = 1_500_000  # of a text file: a million frames, nine hours at 30 a second, and their heads
MAX_LINE = 100_000  # characters of a line in a text table
MAX_NAME = 1000  # characters of a path inside a scan
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
COPY_AGAIN = "copy the recording again"
# A pipe without a writer would block whoever opens it. Windows tells binary from text.
_OPEN_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_COMMENT = re.compile(r"(?:^|\s)#")
_NAN = re.compile(r"[-+]?(nan\w*(\(\w*\))?|1\.#\w+)", re.IGNORECASE)  # Microsoft's C library: -nan(ind), -1.#IND


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


def is_named(path: Path) -> bool:
    """Whether something has this name, be it a pipe or a link to nothing: a file that may be absent, but not so."""
    return os.path.lexists(path)


def open_regular(path: str | Path, kind: str = "", *, limit_bytes: int | None = MAX_FILE_BYTES) -> BinaryIO:
    """A regular file, open for reading: the one door for all files from outside.

    kind : what the file is, for messages. limit_bytes : None = any size (for what is mapped, not read). Raises
    ScanError: absent, a link to nothing, a folder, pipe or device (none of which is ever waited for), huge.
    """
    path, what = Path(path), f"the {kind} file" if kind else "the file"
    try:
        _check_regular(path.stat(), what, path)
        file = os.fdopen(os.open(path, _OPEN_FLAGS), "rb")
    except FileNotFoundError:
        state = "a link to nothing" if path.is_symlink() else "absent"
        raise ScanError(f"{what} is {state}", place=path, hint=COPY_AGAIN) from None
    except OSError as e:
        raise ScanError(f"{what} cannot be read ({e.strerror})", place=path) from None
    except ValueError:  # a name with NUL or half a character
        raise ScanError(f"{what} has a name that no file can have", place=path) from None
    try:
        status = os.fstat(file.fileno())
        _check_regular(status, what, path)  # again: it may have been exchanged since
        if limit_bytes is not None and status.st_size > limit_bytes:
            raise ScanError(f"{what} is larger than {limit_bytes >> 20} MiB", place=path)
    except BaseException:
        file.close()
        raise
    return file


def _check_regular(status: os.stat_result, what: str, path: object) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise ScanError(f"{what} is a folder, a pipe or a device, expected a regular file", place=path)


def read_head(path: Path, count: int) -> bytes:
    """The first `count` bytes, to recognise a file by; none of what is no regular file."""
    try:
        with open_regular(path, limit_bytes=None) as f:
            return f.read(count)
    except (ScanError, OSError):
        return b""


def read_bytes(path: str | Path, kind: str = "image", *, limit_bytes: int = MAX_FILE_BYTES) -> bytes:
    """A whole regular file. Raises ScanError, as `open_regular` does, and for an empty one."""
    with open_regular(path, kind, limit_bytes=limit_bytes) as f:
        try:
            data = f.read(limit_bytes + 1)
        except OSError as e:
            raise ScanError(f"the {kind} file cannot be read ({e.strerror})", place=path) from None
    if not data:
        raise ScanError(f"the {kind} file is empty", place=path, hint=COPY_AGAIN)
    return data


def read_text(path: Path, kind: str = "text", *, limit_bytes: int = MAX_TEXT_BYTES) -> str:
    """A whole text file in UTF-8 (a byte-order mark is fine)."""
    try:
        return read_bytes(path, kind, limit_bytes=limit_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ScanError(f"the {kind} file is no UTF-8 text", place=path) from None


def text_lines(path: Path, kind: str = "text") -> Iterator[str]:
    """The lines of a text file in UTF-8, with their ends, one after another: little memory whatever its size.

    Raises ScanError: as `read_text`; for a line of more than `MAX_LINE` characters, for more than `MAX_LINES` lines.
    """
    with open_regular(path, kind, limit_bytes=MAX_TEXT_BYTES) as binary:
        try:
            number = 0
            with io.TextIOWrapper(binary, "utf-8-sig", newline="") as f:
                while line := f.readline(MAX_LINE + 1):
                    number += 1
                    if len(line) > MAX_LINE:
                        text = f"the line has more than {MAX_LINE:,} characters"
                        raise ScanError(text, place=f"{path}, line {number}")
                    if number > MAX_LINES:
                        raise ScanError(f"the {kind} file has more than {MAX_LINES:,} lines", place=path)
                    yield line
        except UnicodeDecodeError:
            raise ScanError(f"the {kind} file is no UTF-8 text", place=path) from None
        except OSError as e:
            raise ScanError(f"the {kind} file cannot be read ({e.strerror})", place=path) from None
    if number == 0:
        raise ScanError(f"the {kind} file is empty", place=path, hint=COPY_AGAIN)


def read_json(path: Path, kind: str = "JSON") -> Any:
    """A JSON file; ScanError with the line for a fault in it."""
    return parse_json(read_text(path, kind, limit_bytes=MAX_JSON_BYTES), path)


def parse_json(text: str, place: object) -> Any:
    """JSON text; ScanError with the line or the key for a fault in it.

    A key that stands twice, NaN, infinite numbers and halves of characters are faults, as is deep nesting.
    """
    try:
        tree = json.loads(text, object_pairs_hook=_once, parse_constant=_not_finite, parse_float=_finite)
        _check_tree(tree)
    except json.JSONDecodeError as e:
        raise ScanError(f"not valid JSON: {e.msg} at line {e.lineno}", place=place) from None
    except RecursionError:
        raise ScanError("not valid JSON: it is nested too deep", place=place) from None
    except _JsonError as e:
        raise ScanError(f"not valid JSON: {e}", place=place) from None
    except ValueError:
        raise ScanError("not valid JSON: a number has too many digits", place=place) from None
    return tree


class _JsonError(Exception):
    """A fault that Python's reader lets pass."""


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    tree = dict(pairs)
    if len(tree) < len(pairs):
        names = [k for k, _ in pairs]
        twice = next(k for k in names if names.count(k) > 1)
        raise _JsonError(f"the key '{twice[:40]}' stands twice")
    return tree


def _not_finite(word: str) -> NoReturn:
    raise _JsonError(f"{word} stands where a finite number is expected")


def _finite(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        _not_finite(text[:20])
    return number


def _check_tree(tree: Any) -> None:
    """Level by level, without recursion."""
    level = [tree]
    for _ in range(MAX_JSON_DEPTH):
        below: list[Any] = []
        for node in level:
            if isinstance(node, dict):
                below.extend(node)
                below.extend(node.values())
            elif isinstance(node, list):
                below.extend(node)
            elif isinstance(node, str) and not _is_text(node):
                raise _JsonError("a text holds half a character (a lone surrogate)")
        if not below:
            return
        level = below
    raise _JsonError("it is nested too deep")


def _is_text(text: str) -> bool:
    if text.isascii():
        return True
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def read_numbers(path: Path, *, columns: int | None = None) -> Float:
    """Rows of numbers (N, columns), blanks or commas between, `#` comments; ScanError names the line."""
    numbers, rows, width = array("d"), 0, columns or 0
    for number, line in enumerate(text_lines(path), 1):
        words = _COMMENT.split(line)[0].replace(",", " ").split()
        if not words:
            continue
        place = f"{path}, line {number}"
        width, rows = width or len(words), rows + 1
        try:
            numbers.extend(float("nan" if _NAN.fullmatch(w) else w) for w in words)
        except ValueError:
            raise ScanError("expected numbers only", place=place) from None
        if len(words) != width:
            raise ScanError(f"expected {width} numbers, got {len(words)}", place=place)
    return np.frombuffer(numbers, np.float64).reshape(rows, width) if rows else np.zeros((0, width))


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
    if is_tiff(data):
        _check_tiff(data, kind, place)
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


def _check_tiff(data: bytes, kind: str, place: object) -> None:
    """ScanError for what a decoder would do in silence: turn the image, or give the first page of many."""
    pages = tiff_pages(data, 2)
    if pages and pages[0].orientation != 1:
        text = f"the {kind} TIFF says it is to be turned or mirrored (orientation {pages[0].orientation}, tag 274)"
        raise ScanError(text, place=place, hint="write it as the camera's pixels lie, with orientation 1")
    if len(pages) > 1:
        hint = "write one file a frame (`thermofusion import DEPTH -o SCAN --thermal FILE` reads many pages)"
        raise ScanError(f"the {kind} TIFF holds more than one page", place=place, hint=hint)


def claimed_size(data: bytes, place: object = None) -> tuple[int, int] | None:
    """(width, height) an image's header claims; None if it is no PNG, JPEG, TIFF, PGM or PPM."""
    if data.startswith(PNG_MAGIC) and len(data) >= 24:
        w, h = struct.unpack(">II", data[16:24])
        return w, h
    if data[:2] == b"\xff\xd8":
        return _jpeg_size(data)
    if data[:2] in (b"P5", b"P6"):
        return read_pnm(data, place=place, header_only=True).shape[1::-1]
    if is_tiff(data):
        return next(((p.width_px, p.height_px) for p in tiff_pages(data, 1)), None)
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
    """A mesh's or an archive's bytes. Raises ScanError, as `open_regular` does."""
    with open_regular(path) as f:
        return f.read(MAX_FILE_BYTES + 1)


def read_array(data: bytes, dtype: np.dtype | str, count: int, offset: int, place: object) -> NDArray:
    """Numbers (N,), `count` of them, from byte `offset` on, writable. Raises ScanError if the file ends before."""
    dtype = np.dtype(dtype)
    if count < 0 or offset < 0 or offset + count * dtype.itemsize > len(data):
        raise ScanError("the file is truncated: it ends before its own header says", place=place)
    return np.frombuffer(data, dtype, count, offset).copy()
