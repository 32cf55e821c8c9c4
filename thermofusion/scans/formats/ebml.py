"""A small Matroska reader: tracks, attachments, tags, and where every frame's bytes lie. Pure on bytes.

RFC 8794 (EBML) and RFC 9559 (Matroska). Only what a recording needs: no lacing, no encryption or
compression. Elements of unknown size (a recording that was cut off) end with their parent. A file torn in
the middle yields the frames before the tear.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from ...errors import ScanError

# Element identifiers of the Matroska specification (RFC 9559)
SEGMENT, CLUSTER, TRACKS = 0x18538067, 0x1F43B675, 0x1654AE6B
ATTACHMENTS, TAGS, INFO = 0x1941A469, 0x1254C367, 0x1549A966
# identifier of the EBML header (RFC 8794)
_HEADER = 0x1A45DFA3
_TRACK_ENTRY, _NUMBER, _NAME, _CODEC, _PRIVATE, _VIDEO, _WIDTH, _HEIGHT, _COLOUR_SPACE, _ENCODINGS = (
    0xAE, 0xD7, 0x536E, 0x86, 0x63A2, 0xE0, 0xB0, 0xBA, 0x2EB524, 0x6D80,
)  # fmt: skip
# of attachments, tags, clusters (RFC 9559)
_FILE, _FILE_NAME, _FILE_DATA = 0x61A7, 0x466E, 0x465C
_TAG, _SIMPLE_TAG, _TAG_NAME, _TAG_STRING = 0x7373, 0x67C8, 0x45A3, 0x4487
_TIMESCALE, _CLUSTER_TIME, _SIMPLE_BLOCK, _BLOCK_GROUP, _BLOCK = 0x2AD7B1, 0xE7, 0xA3, 0xA0, 0xA1
_TOP = {SEGMENT, CLUSTER, TRACKS, ATTACHMENTS, TAGS, INFO, 0x1C53BB6B, 0x114D9B74, 0x1043A770}
MAX_FRAMES = 4_000_000  # a day at 30 a second is 2.6 million: more is a damaged or hostile file

Buffer = bytes | memoryview


@dataclass(frozen=True)
class Track:
    """One track. fourcc : of V_MS/VFW/FOURCC's BITMAPINFOHEADER or the uncompressed colour space, else empty."""

    number: int
    name: str
    codec: str
    width_px: int
    height_px: int
    fourcc: str


@dataclass(frozen=True)
class FrameBytes:
    """Where a frame's bytes lie in the file, and its time."""

    track: int
    time_ns: int
    offset: int
    length: int


@dataclass
class Matroska:
    """What was found. complete : False if the file ends in the middle of an element."""

    tracks: dict[int, Track] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    frames: list[FrameBytes] = field(default_factory=list)
    timescale_ns: int = 1_000_000
    complete: bool = True


class _Torn(Exception):
    """The buffer ends inside an element."""


def parse(data: Buffer, place: object) -> Matroska:
    """The contents of a Matroska file. Raises ScanError if it is none or its structure is damaged."""
    data = memoryview(data)
    if len(data) < 8 or bytes(data[:4]) != _HEADER.to_bytes(4, "big"):
        raise ScanError("it is no Matroska file", place=place)
    out = Matroska()
    try:
        for ident, start, end in _elements(data, 0, len(data), out):
            if ident == SEGMENT:
                _segment(data, start, end, out, place)
    except _Torn:
        out.complete = False
    return out


def _segment(data: memoryview, start: int, end: int, out: Matroska, place: object) -> None:
    for ident, s, e in _elements(data, start, end, out):
        if ident == INFO:
            out.timescale_ns = _first_uint(data, s, e, _TIMESCALE, out.timescale_ns) or 1_000_000
        elif ident == TRACKS:
            for track in _tracks(data, s, e, place):
                out.tracks[track.number] = track
        elif ident == ATTACHMENTS:
            out.attachments.update(_attachments(data, s, e))
        elif ident == TAGS:
            out.tags.update(_tags(data, s, e))
        elif ident == CLUSTER:
            _cluster(data, s, e, out, place)


def _elements(data: memoryview, at: int, end: int, torn: Matroska | None = None) -> Iterator[tuple[int, int, int]]:
    """(id, first byte, end) of the elements between two places.

    An element that runs over its parent's end is cut there and, where `torn` is given, that is written down.
    """
    while at < end:
        ident, at = _vint(data, at, end, keep_marker=True)
        size, at = _vint(data, at, end, keep_marker=False)
        stop = _unknown_end(data, at, end, ident) if size is None else at + size
        if stop > end:
            if torn is None:
                raise _Torn
            torn.complete, stop = False, end
        assert ident is not None
        yield ident, at, stop
        at = stop


def _vint(data: memoryview, at: int, end: int, *, keep_marker: bool) -> tuple[int | None, int]:
    """A variable-length integer and the place behind it; None = the reserved unknown size."""
    if at >= end:
        raise _Torn
    first = data[at]
    length = 9 - first.bit_length()
    if first == 0 or (keep_marker and length > 4) or at + length > end:
        raise _Torn
    value = int.from_bytes(data[at : at + length], "big")
    if not keep_marker:
        value &= (1 << 7 * length) - 1
        if value == (1 << 7 * length) - 1:
            return None, at + length
    return value, at + length


def _unknown_end(data: memoryview, at: int, end: int, ident: int | None) -> int:
    """Where an element of unknown size ends: a segment with the file, others at the next top-level element."""
    if ident == SEGMENT:
        return end
    while at < end:
        try:
            child, behind = _vint(data, at, end, keep_marker=True)
            size, behind = _vint(data, behind, end, keep_marker=False)
        except _Torn:
            return end
        if child in _TOP:
            return at
        if size is None:
            return end
        at = behind + size
    return end


def _uint(data: memoryview, s: int, e: int) -> int:
    return int.from_bytes(data[s : min(e, s + 8)], "big")


def _text(data: memoryview, s: int, e: int) -> str:
    return bytes(data[s : min(e, s + 65536)]).split(b"\0")[0].decode("utf-8", "replace")


def _first_uint(data: memoryview, start: int, end: int, wanted: int, default: int) -> int:
    return next((_uint(data, s, e) for ident, s, e in _elements(data, start, end) if ident == wanted), default)


def _tracks(data: memoryview, start: int, end: int, place: object) -> Iterator[Track]:
    for ident, s, e in _elements(data, start, end):
        if ident != _TRACK_ENTRY:
            continue
        number, name, codec, fourcc, width, height = 0, "", "", "", 0, 0
        for key, a, b in _elements(data, s, e):
            if key == _NUMBER:
                number = _uint(data, a, b)
            elif key == _NAME:
                name = _text(data, a, b)
            elif key == _CODEC:
                codec = _text(data, a, b)
            elif key == _PRIVATE and b - a >= 20:  # BITMAPINFOHEADER: biCompression at 16
                fourcc = bytes(data[a + 16 : a + 20]).decode("latin-1")
            elif key == _ENCODINGS:
                raise ScanError("a compressed or encrypted track is not supported", place=place)
            elif key == _VIDEO:
                video = {k: (x, y) for k, x, y in _elements(data, a, b)}
                width = _uint(data, *video[_WIDTH]) if _WIDTH in video else 0
                height = _uint(data, *video[_HEIGHT]) if _HEIGHT in video else 0
                if _COLOUR_SPACE in video:
                    fourcc = fourcc or _text(data, *video[_COLOUR_SPACE])
        yield Track(number, name, codec, width, height, fourcc if codec == "V_MS/VFW/FOURCC" or not codec else codec)


def _attachments(data: memoryview, start: int, end: int) -> Iterator[tuple[str, bytes]]:
    for ident, s, e in _elements(data, start, end):
        if ident == _FILE:
            parts = {k: (a, b) for k, a, b in _elements(data, s, e)}
            if _FILE_NAME in parts and _FILE_DATA in parts:
                a, b = parts[_FILE_DATA]
                yield _text(data, *parts[_FILE_NAME]), bytes(data[a:b])


def _tags(data: memoryview, start: int, end: int) -> Iterator[tuple[str, str]]:
    for ident, s, e in _elements(data, start, end):
        if ident != _TAG:
            continue
        for key, a, b in _elements(data, s, e):
            if key == _SIMPLE_TAG:
                parts = {k: (x, y) for k, x, y in _elements(data, a, b)}
                if _TAG_NAME in parts and _TAG_STRING in parts:
                    yield _text(data, *parts[_TAG_NAME]), _text(data, *parts[_TAG_STRING])


def _cluster(data: memoryview, start: int, end: int, out: Matroska, place: object) -> None:
    time = 0
    for ident, s, e in _elements(data, start, end):
        if ident == _CLUSTER_TIME:
            time = _uint(data, s, e)
        elif ident == _SIMPLE_BLOCK:
            out.frames.append(_block(data, s, e, time, out.timescale_ns, place))
        elif ident == _BLOCK_GROUP:
            for key, a, b in _elements(data, s, e):
                if key == _BLOCK:
                    out.frames.append(_block(data, a, b, time, out.timescale_ns, place))
        if len(out.frames) > MAX_FRAMES:
            raise ScanError(f"more than {MAX_FRAMES} frames", place=place)


def _block(data: memoryview, s: int, e: int, cluster_time: int, scale_ns: int, place: object) -> FrameBytes:
    """Track, signed 16-bit time relative to the cluster, flags; lacing is not used by recorders of images."""
    track, at = _vint(data, s, e, keep_marker=False)
    if track is None or at + 3 > e:
        raise _Torn
    relative = int.from_bytes(data[at : at + 2], "big", signed=True)
    if data[at + 2] & 0x06:
        raise ScanError("laced blocks are not supported", place=place)
    return FrameBytes(track, (cluster_time + relative) * scale_ns, at + 3, e - at - 3)
