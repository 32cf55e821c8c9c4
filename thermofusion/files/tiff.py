"""What a TIFF or BigTIFF says of its pages before it is decoded, and pages that OpenCV cannot decode.

TIFF 6.0 (Adobe, 1992); BigTIFF: the same with 8-byte offsets. Decoders turn an image silently as its orientation says
and give the first of many pages: both must be known first.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_INTEGERS = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
MAX_PAGES = 100_000
MAX_TAGS = 512


@dataclass(frozen=True)
class TiffPage:
    """One page. orientation : tag 274, 1 = as stored. kind : `u`, `i`, `f` with the bits of a sample."""

    width_px: int
    height_px: int
    bits: int
    kind: str
    samples: int
    compression: int
    predictor: int
    orientation: int
    offsets: tuple[int, ...]
    counts: tuple[int, ...]
    order: str


def is_tiff(data: bytes) -> bool:
    """Whether the bytes begin as a TIFF or a BigTIFF."""
    return data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def tiff_pages(data: bytes, limit: int = MAX_PAGES) -> list[TiffPage]:
    """Pages of a TIFF up to a limit; fewer where the file is torn."""
    e = "<" if data[:2] == b"II" else ">"
    big = data[2:4] in (b"+\0", b"\0+")
    pages: list[TiffPage] = []
    seen: set[int] = set()
    try:
        at = struct.unpack_from(e + ("Q" if big else "I"), data, 8 if big else 4)[0]
        while at and at not in seen and len(pages) < limit:
            seen.add(at)
            tags, at = _directory(data, at, e, big)
            page = _page(tags, e)
            if page is None:
                break
            pages.append(page)
    except struct.error:
        pass
    return pages


def _directory(data: bytes, at: int, e: str, big: bool) -> tuple[dict[int, tuple[int, ...]], int]:
    """The integer tags of a directory, and where the next one lies (0 = none)."""
    count, head, row = (struct.unpack_from(e + "Q", data, at)[0], 8, 20) if big else (*_u16(data, at, e), 2, 12)
    tags: dict[int, tuple[int, ...]] = {}
    for k in range(min(count, MAX_TAGS)):
        place = at + head + row * k
        tag, kind = struct.unpack_from(e + "HH", data, place)
        n = struct.unpack_from(e + ("Q" if big else "I"), data, place + 4)[0]
        if kind not in _INTEGERS or n > len(data):
            continue
        value, inline = place + (12 if big else 8), 8 if big else 4
        if n * _SIZES[kind] > inline:
            value = struct.unpack_from(e + ("Q" if big else "I"), data, value)[0]
        tags[tag] = struct.unpack_from(f"{e}{n}{_INTEGERS[kind]}", data, value)
    return tags, struct.unpack_from(e + ("Q" if big else "I"), data, at + head + row * count)[0]


def _u16(data: bytes, at: int, e: str) -> tuple[int]:
    return (struct.unpack_from(e + "H", data, at)[0],)


def _page(tags: dict[int, tuple[int, ...]], e: str) -> TiffPage | None:
    def one(tag: int, default: int) -> int:
        return (tags.get(tag) or (default,))[0]

    if 256 not in tags or 257 not in tags:
        return None
    kind = {1: "u", 2: "i", 3: "f"}.get(one(339, 1), "?")
    return TiffPage(
        width_px=one(256, 0),
        height_px=one(257, 0),
        bits=one(258, 1),
        kind=kind,
        samples=one(277, 1),
        compression=one(259, 1),
        predictor=one(317, 1),
        orientation=one(274, 1),
        offsets=tags.get(273, ()),
        counts=tags.get(279, ()),
        order=e,
    )


def decode_strips(data: bytes, page: TiffPage) -> NDArray | None:
    """Pixels (H, W) of a page of one float or integer sample, plain or deflated; None where it is coded otherwise."""
    plain = page.samples == 1 and page.predictor == 1 and page.bits in (16, 32, 64) and page.kind in "uif"
    if not plain or page.compression not in (1, 8, 32946) or len(page.offsets) != len(page.counts):
        return None
    wanted = page.width_px * page.height_px * page.bits // 8
    parts = []
    for offset, count in zip(page.offsets, page.counts, strict=True):
        part = data[offset : offset + count]
        if page.compression != 1:
            try:
                part = zlib.decompressobj().decompress(part, wanted)
            except zlib.error:
                return None
        parts.append(part)
    pixels = b"".join(parts)
    if len(pixels) != wanted:
        return None
    array = np.frombuffer(pixels, f"{page.order}{page.kind}{page.bits // 8}")
    return array.reshape(page.height_px, page.width_px).astype(array.dtype.newbyteorder("="))


def upright(image: NDArray, orientation: int) -> NDArray:
    """A stored image (H, W) as tag 274 says it is to be seen: 5 to 8 change rows with columns."""
    turned = {
        2: image[:, ::-1],
        3: image[::-1, ::-1],
        4: image[::-1],
        5: image.T,
        6: image.T[:, ::-1],
        7: image.T[::-1, ::-1],
        8: image.T[::-1],
    }
    return np.ascontiguousarray(turned.get(orientation, image))
