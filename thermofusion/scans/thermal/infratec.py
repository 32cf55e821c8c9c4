"""InfraTec .irb files without compression: little-endian, as the irb project (Apache-2.0) describes them.

A header, a table of blocks of 32 bytes (type 1 = image); an image has 60 bytes of header, a table of 256 kelvins, and
two bytes a pixel: the second picks an entry of the table, the first says how far it is on the way to the next.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import COPY_AGAIN, open_regular, read_bytes
from ...physics.band import ZERO_DEGC_K
from ...types import Float32
from .frames import APPARENT, ThermalFrames

MAGIC = b"\xffIRB\0"
_IMAGE = 1  # type of a block
_TABLE, _PIXELS = 60, 1728  # bytes from an image's beginning to its table of kelvins, and to its pixels
MAX_BLOCKS = 100_000
WAY = "export it from IRBIS as float TIFF or CSV in degC"


def recognise(path: Path) -> bool:
    """A file that begins as IRB."""
    with open_regular(path, limit_bytes=None) as f:
        return f.read(5) == MAGIC


def read(path: Path) -> ThermalFrames:
    """The frames of an .irb file, apparent °C. Raises ScanError: compressed, or truncated."""
    data = read_bytes(path, "thermal")
    try:
        start, count = struct.unpack_from("<ii", data, 25)
        blocks = [struct.unpack_from("<iiiii", data, start + 32 * k) for k in range(min(count, MAX_BLOCKS))]
        with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers
            images = [_image(data, offset, path) for kind, _, _, offset, size in blocks if kind == _IMAGE and size > 0]
    except (struct.error, ValueError):
        raise ScanError("the IRB file is truncated or damaged", place=path, hint=COPY_AGAIN) from None
    if not images:
        raise ScanError("the IRB file has no image that is known how to read", place=path, hint=WAY)
    if len({i.shape for i in images}) > 1:
        raise ScanError("the images of the IRB file differ in size", place=path, hint=WAY)
    places = tuple(f"{path}, frame {i}" if len(images) > 1 else str(path) for i in range(len(images)))
    shape = (images[0].shape[0], images[0].shape[1])
    return ThermalFrames(shape, lambda i: images[i], np.full(len(images), np.nan), places, APPARENT)


def _image(data: bytes, at: int, path: Path) -> Float32:
    bytes_per_pixel, compressed, w, h = struct.unpack_from("<HHHH", data, at)
    if bytes_per_pixel != 2 or compressed:
        raise ScanError("the IRB image is compressed, which is not read", place=path, hint=WAY)
    if not 0 < w * h <= 2**24:
        raise ScanError(f"the IRB image claims {w} x {h} px", place=path)
    kelvin = np.frombuffer(data, "<f4", 256, at + _TABLE).astype(np.float64)
    pixels: NDArray = np.frombuffer(data, np.uint8, 2 * w * h, at + _PIXELS).reshape(h, w, 2)
    low, entry = pixels[..., 0] / 256.0, pixels[..., 1].astype(int)
    T_K = kelvin[entry] * (1 - low) + kelvin[np.minimum(entry + 1, 255)] * low
    return (T_K - ZERO_DEGC_K).astype(np.float32)
