"""InfiRay (Topdon, Vevor, Thermal Master): .irg files, and JPEG with `IJPEG` segments.

Layouts as the infiray_irg project (MIT) and ExifTool's tables describe them. IRG: a header that states its own length,
an 8-bit plane, a 16-bit plane of kelvin x 16, a small JPEG. IJPEG: segments APP3 put together hold two 16-bit planes, a
picture and kelvin x 64.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ...errors import ScanError
from ...files.reading import COPY_AGAIN, claimed_size, open_regular, read_bytes
from ...types import SignalCurve
from .flir import jpeg_segments
from .frames import ThermalFrames, one_frame

_IRG_MAGICS = (b"\xca\xac", b"\xba\xab")


def kelvin_steps(per_K: float) -> SignalCurve:
    """Counts that are kelvin times `per_K`."""
    return SignalCurve("counts", "linear_kelvin", {"gain_K": (1 / per_K,), "offset_K": (0.0,)})


def recognise(path: Path) -> bool:
    """An .irg file, or a JPEG whose APP2 says IJPEG."""
    with open_regular(path, limit_bytes=None) as f:
        head = f.read(4096)
    if head[:2] in _IRG_MAGICS and path.suffix.lower() == ".irg":
        return True
    return head[:2] == b"\xff\xd8" and any(m == 0xE2 and b[:5] == b"IJPEG" for m, b in jpeg_segments(head))


def read(path: Path) -> ThermalFrames:
    """The frame of one file. Raises ScanError."""
    data = read_bytes(path, "thermal")
    return _ijpeg(data, path) if data[:2] == b"\xff\xd8" else _irg(data, path)


def _irg(data: bytes, path: Path) -> ThermalFrames:
    if len(data) < 128:
        raise ScanError("the IRG file is truncated", place=path, hint=COPY_AGAIN)
    header, pixels = struct.unpack_from("<HI", data, 2)
    h, w = struct.unpack_from("<HH", data, 8)
    if w * h != pixels or not 0 < pixels <= 2**22:
        raise ScanError(f"the IRG header claims {w} x {h} px and {pixels} bytes", place=path)
    plane = data[header + pixels : header + 3 * pixels]
    if len(plane) < 2 * pixels:
        raise ScanError("the IRG file is truncated", place=path, hint=COPY_AGAIN)
    image = np.frombuffer(plane, "<u2").reshape(h, w).astype(np.uint16)
    return one_frame(image, path, kelvin_steps(16))


def _ijpeg(data: bytes, path: Path) -> ThermalFrames:
    size = claimed_size(data, path)
    planes = b"".join(b for m, b in jpeg_segments(data) if m == 0xE3)
    if size is None or len(planes) < 4 * size[0] * size[1]:
        raise ScanError("the thermal segments of the JPEG are not whole", place=path, hint=COPY_AGAIN)
    w, h = size
    image = np.frombuffer(planes, "<u2", w * h, 2 * w * h).reshape(h, w).astype(np.uint16)
    return one_frame(image, path, kelvin_steps(64))
