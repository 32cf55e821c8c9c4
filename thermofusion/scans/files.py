"""Image files at the border: safe paths, decoded and checked, with the file named in every error."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError

MAX_PIXELS = 64_000_000  # a header that claims more is refused before it is decoded


def inside(root: Path, name: str, *, place: object) -> Path:
    """`root / name`, refused if it leaves the scan's folder."""
    root = root.resolve()
    path = (root / name).resolve()
    if not path.is_relative_to(root):
        raise ScanError(f"the path '{name}' leaves the scan's folder", place=place)
    return path


def read_image(path: Path, *, shape: tuple[int, int] | None = None, kind: str = "image") -> NDArray:
    """Decode an image unchanged (depth of bits kept; colour as B, G, R).

    shape : expected (height, width). Raises ScanError naming the file: absent, empty, truncated, oversized, wrong size.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ScanError(f"the {kind} file is named in the scan but absent", place=path) from None
    except OSError as e:
        raise ScanError(f"the {kind} file cannot be read ({e.strerror})", place=path) from None
    if not data:
        raise ScanError(f"the {kind} file is empty", place=path)
    _refuse_oversized(data, path)
    if data[:8] == b"\x89PNG\r\n\x1a\n" and b"IEND" not in data[-16:]:
        raise ScanError(
            f"the {kind} file is truncated (PNG without its end)", place=path, hint="copy the recording again"
        )
    if data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-64:]:
        raise ScanError(
            f"the {kind} file is truncated (JPEG without its end)", place=path, hint="copy the recording again"
        )
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ScanError(f"the {kind} file is truncated or is no image that can be decoded", place=path)
    if shape is not None and image.shape[:2] != shape:
        raise ScanError(
            f"the {kind} is {image.shape[1]} x {image.shape[0]} px, expected {shape[1]} x {shape[0]}",
            place=path,
            hint="width_px and height_px of that camera must match its images",
        )
    return image


def _refuse_oversized(data: bytes, path: Path) -> None:
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        w, h = struct.unpack(">II", data[16:24])
        if w * h > MAX_PIXELS:
            raise ScanError(f"the image claims {w} x {h} px, more than {MAX_PIXELS} pixels are refused", place=path)


def depth_from_raw(
    raw: NDArray, unit_m: float, *, place: object, invalid: tuple[int, ...] = (0,)
) -> NDArray[np.float32]:
    """16-bit depth to float32 metres with NaN where there is none."""
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise ScanError(f"depth is {raw.dtype} with {raw.ndim} axes, expected 16-bit grey", place=place)
    depth = raw.astype(np.float32) * np.float32(unit_m)
    for value in invalid:
        depth[raw == value] = np.nan
    return depth
