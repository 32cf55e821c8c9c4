"""PGM and PPM: a pure parser on bytes, with the byte order as a choice (fakenect writes it the wrong way round)."""

from __future__ import annotations

import re
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError

_GAP = rb"(?:\s|#[^\n]*\n)++"  # possessive: what was read is never tried another way, so no header takes long
_HEADER = re.compile(rb"P([56])" + (_GAP + rb"(\d{1,7}+)") * 2 + _GAP + rb"(\d{1,5}+)\s")


def read_pnm(data: bytes, *, place: object, byteorder: Literal[">", "<"] = ">", header_only: bool = False) -> NDArray:
    """Binary PGM (H, W) or PPM (H, W, 3 as B, G, R like OpenCV); uint8, or uint16 where maxval > 255.

    byteorder : of 16-bit samples; the format says big-endian. header_only : a zero-stride view of the right shape, so
    that a header's claim can be judged before memory is spent on it.
    """
    header = _HEADER.match(data[:4096])
    if header is None:
        raise ScanError("the PGM or PPM header is damaged", place=place)
    channels = {b"5": 1, b"6": 3}[header[1]]
    w, h, maxval = (int(g) for g in header.groups()[1:])
    dtype = np.dtype(f"{byteorder}u2") if maxval > 255 else np.dtype(np.uint8)
    shape = (h, w) if channels == 1 else (h, w, channels)
    if header_only:
        return np.broadcast_to(np.zeros((), dtype), shape)
    needed = w * h * channels * dtype.itemsize
    if len(data) - header.end() < needed:
        raise ScanError("the PGM or PPM is truncated", place=place, hint="copy the recording again")
    pixels = np.frombuffer(data, dtype, w * h * channels, header.end()).reshape(shape)
    pixels = pixels.astype(dtype.newbyteorder("="))
    return pixels if channels == 1 else np.ascontiguousarray(pixels[..., ::-1])
