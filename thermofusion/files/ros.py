"""ROS 2 messages as bytes (CDR, little-endian): pictures, cameras, readings, and what a device said of a frame.

Definitions as in common_interfaces (Apache-2.0); `thermofusion_msgs/msg/FrameInfo` is our own.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

IMAGE, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
VECTOR, FRAME_INFO = "geometry_msgs/msg/Vector3Stamped", "thermofusion_msgs/msg/FrameInfo"
_RULE = "=" * 80
_TIME = f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = f"{_RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{_TIME}"
_ROI = f"{_RULE}\nMSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\n"
_ROI += "uint32 height\nuint32 width\nbool do_rectify\n"
_PICTURE = "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n"
_CAMERA = "uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\n"
_CAMERA += "float64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
_INFO = "uint64 ticks\nuint32 number\nuint32 lost\nuint32 crc32\nbool shutter\nfloat32 fpa_degc\n"
DEFINITIONS = {
    IMAGE: f"std_msgs/Header header\n{_PICTURE}{_HEADER}",
    CAMERA_INFO: f"std_msgs/Header header\n{_CAMERA}{_HEADER}{_ROI}",
    VECTOR: f"std_msgs/Header header\ngeometry_msgs/Vector3 vector\n{_HEADER}"
    f"{_RULE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n",
    FRAME_INFO: f"std_msgs/Header header\n{_INFO}{_HEADER}",
}
MAX_STRING = 1000  # bytes of a name inside a message that is read
_BEGIN = b"\0\1\0\0"  # CDR, little-endian


class _Pack:
    """Fields in CDR: each aligned to its own size, counted from behind the first four bytes."""

    def __init__(self) -> None:
        self.data = bytearray()

    def put(self, form: str, *values: float) -> _Pack:
        size = struct.calcsize(form[-1])
        self.data += bytes(-len(self.data) % size) + struct.pack(f"<{form}", *values)
        return self

    def text(self, text: str) -> _Pack:
        data = text.encode() + b"\0"
        self.put("I", len(data))
        self.data += data
        return self

    def header(self, stamp_ns: int, frame: str) -> _Pack:
        seconds, rest = divmod(stamp_ns, 10**9)
        return self.put("iI", seconds, rest).text(frame)

    def done(self) -> bytes:
        return _BEGIN + bytes(self.data)


class ImagePacker:
    """Pictures of one camera, width_px x height_px: what stands before the pixels is made once."""

    def __init__(self, frame: str, width_px: int, height_px: int, encoding: str, step: int) -> None:
        pack = _Pack().header(0, frame).put("II", height_px, width_px).text(encoding).put("B", 0)
        pack.put("II", step, step * height_px)
        self._rest = bytes(pack.data[8:])

    def pieces(self, stamp_ns: int, pixels: bytes | memoryview) -> tuple[bytes, bytes | memoryview]:
        """A message in two pieces: its head, and the pixels as they are."""
        return _BEGIN + struct.pack("<iI", *divmod(stamp_ns, 10**9)) + self._rest, pixels


def camera_info(stamp_ns: int, frame: str, size: tuple[int, int], K: Sequence[float]) -> bytes:
    """A camera without distortion. size : (width, height) px. K : nine numbers, by rows, px."""
    pack = _Pack().header(stamp_ns, frame).put("II", size[1], size[0]).text("plumb_bob")
    pack.put("I", 5).put("5d", *[0.0] * 5).put("9d", *K).put("9d", 1, 0, 0, 0, 1, 0, 0, 0, 1)
    pack.put("12d", *K[:3], 0, *K[3:6], 0, *K[6:9], 0).put("2I", 0, 0).put("4I", 0, 0, 0, 0).put("B", 0)
    return pack.done()


def vector(stamp_ns: int, frame: str, xyz: Sequence[float]) -> bytes:
    """A reading of three numbers."""
    return _Pack().header(stamp_ns, frame).put("3d", *xyz).done()


@dataclass(frozen=True)
class FrameInfo:
    """What a device said of a frame. ticks : its own clock's. number : of the frame in its stream, lost ones counted.
    lost : frames between it and the one before. crc32 : of its pixels. shutter : spoiled by a correction."""

    stamp_ns: int
    ticks: int
    number: int
    lost: int
    crc32: int
    shutter: bool
    fpa_degC: float

    def packed(self, frame: str) -> bytes:
        """As a message."""
        pack = _Pack().header(self.stamp_ns, frame).put("Q", self.ticks)
        pack.put("3I", self.number & 0xFFFFFFFF, self.lost & 0xFFFFFFFF, self.crc32)
        return pack.put("?", self.shutter).put("f", self.fpa_degC).done()


class _Unpack:
    def __init__(self, data: bytes) -> None:
        self._data, self.at = data, 4

    def take(self, form: str) -> tuple:
        size = struct.calcsize(form[-1])
        self.at += -(self.at - 4) % size
        found = struct.unpack_from(f"<{form}", self._data, self.at)
        self.at += struct.calcsize(f"<{form}")
        return found

    def text(self) -> str:
        (length,) = self.take("I")
        if not 0 < length <= MAX_STRING or self.at + length > len(self._data):
            raise struct.error("a string that is not there")
        self.at += length
        return self._data[self.at - length : self.at - 1].decode("utf-8", "replace")

    def header(self) -> int:
        seconds, rest = self.take("iI")
        self.text()
        return seconds * 10**9 + rest


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture as it was sent: stamp ns, size px, encoding, bytes of a row, its pixels."""

    stamp_ns: int
    width_px: int
    height_px: int
    encoding: str
    step: int
    pixels: memoryview


def read_picture(data: bytes) -> Picture:
    """An Image message. Raises ValueError for bytes that are none."""
    try:
        unpack = _Unpack(data)
        stamp = unpack.header()
        h, w = unpack.take("II")
        encoding = unpack.text()
        unpack.take("B")
        step, length = unpack.take("II")
    except struct.error as e:
        raise ValueError(str(e)) from None
    pixels = memoryview(data)[unpack.at : unpack.at + length]
    if len(pixels) < length or step * h != length:
        raise ValueError(f"an image of {w} x {h} px with {len(pixels)} bytes")
    return Picture(stamp, w, h, encoding, step, pixels)


def read_frame_info(data: bytes) -> FrameInfo:
    """A FrameInfo message. Raises ValueError for bytes that are none."""
    try:
        unpack = _Unpack(data)
        stamp = unpack.header()
        (ticks,) = unpack.take("Q")
        number, lost, crc = unpack.take("3I")
        (shutter,), (fpa,) = unpack.take("?"), unpack.take("f")
    except struct.error as e:
        raise ValueError(str(e)) from None
    return FrameInfo(stamp, ticks, number, lost, crc, shutter, fpa)


def read_vector(data: bytes) -> tuple[float, float, float]:
    """The numbers of a Vector3Stamped. Raises ValueError."""
    try:
        unpack = _Unpack(data)
        unpack.header()
        x, y, z = unpack.take("3d")
    except struct.error as e:
        raise ValueError(str(e)) from None
    return x, y, z
