"""fakenect recordings of a Kinect v1 (libfreenect's fakenect-record): INDEX.txt, PGM depth, PPM colour, tilt dumps.

INDEX.txt names `{d,r,a}-<wall seconds>-<ticks>.{pgm,ppm,dump}` in the order of arrival. Depth is the raw 11-bit
disparity, written *little-endian* under a PGM header that promises big-endian: ordinary readers return it
byte-swapped. Ticks run at 60 MHz and wrap at 2^32 (71.6 s).
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError, counted
from ...files.pnm import read_pnm
from ...files.reading import inside, read_bytes, read_head, text_lines
from ...geometry.rigid import pose
from ...types import Float, Scan
from ..clock import unwrapped_s
from ..common import ImageFiles, image_stream, make_camera, make_rig
from ..stated import NOTHING, Stated

TICK_HZ = 60e6  # of the Kinect's clock
TICK_WRAP = 2**32  # ticks: the counter has 32 bits, 72 s
NO_DEPTH_RAW = 2047  # 11 bits, all set
COUNTS_PER_G = 819.0  # of the accelerometer, libfreenect's constant
_NAME = re.compile(r"^([dra])-(\d+(?:\.\d+)?)-(\d{1,10})\.(pgm|ppm|dump)$")


@dataclass(frozen=True)
class KinectDepth:
    """Constants of a Kinect v1's disparity; a device reports its own, a fakenect recording does not.

    emitter_cm : baseline between projector and camera. reference_cm : distance of the reference plane. pixel_cm : of
    the reference plane's pixel at 1280 px across. const_shift : of the disparity. The defaults are what devices in
    the field report, to within a per cent.
    """

    emitter_cm: float = 7.5
    reference_cm: float = 120.0
    pixel_cm: float = 0.1042
    const_shift: float = 200.0

    @property
    def focal_px(self) -> float:
        """Focal length of the 640-px depth image: the reference plane's pixel is twice as large there."""
        return self.reference_cm / (2 * self.pixel_cm)

    def table_mm(self) -> NDArray[np.uint16]:
        """(2048,) millimetres of each raw value, 0 = none or out of 16 bits.

        m = ((raw - 4 shift)/4 - 0.375) pixel; mm = 10 (m reference / (emitter - m) + reference).
        """
        raw = np.arange(2048, dtype=np.float64)
        m = ((raw - 4 * self.const_shift) / 4 - 0.375) * self.pixel_cm
        with np.errstate(divide="ignore"):
            mm = 10 * (m * self.reference_cm / (self.emitter_cm - m) + self.reference_cm)
        good = (m < self.emitter_cm) & (mm > 0) & (mm < 10_000)
        good[NO_DEPTH_RAW] = False
        return np.where(good, np.rint(np.where(good, mm, 0)), 0).astype(np.uint16)


@dataclass(frozen=True)
class _Entry:
    kind: str
    wall_s: float
    ticks: int
    file: Path


def recognise(path: Path) -> bool:
    """INDEX.txt with at least one depth frame's name in it."""
    return re.search(rb"^d-[\d.]+-\d+\.pgm", read_head(path / "INDEX.txt", 65536), re.MULTILINE) is not None


def read(path: Path, stated: Stated = NOTHING, constants: KinectDepth = KinectDepth()) -> Scan:
    """A fakenect folder as a scan: depth in whole millimetres by `constants`, nominal cameras."""
    entries = _entries(path)
    walls, ticks = np.array([e.wall_s for e in entries]), np.array([e.ticks for e in entries])
    times = unwrapped_s(walls, ticks, TICK_HZ, TICK_WRAP)
    rows = {kind: [i for i, e in enumerate(entries) if e.kind == kind] for kind in "dra"}
    if not rows["d"]:
        raise ScanError("no depth frames are listed", place=path / "INDEX.txt")
    f = constants.focal_px
    depth_camera = make_camera(640, 480, np.array([[f, 0, 319.5], [0, f, 239.5], [0, 0, 1]]), place=path)
    table, unit_m = constants.table_mm(), stated.unit_m(0.001)
    depth_rows = _in_time(rows["d"], times)
    depth = image_stream(
        ImageFiles("depth", [entries[i].file for i in depth_rows], times[depth_rows], path / "INDEX.txt"),
        depth_camera,
        unit_m=unit_m,
        decode=lambda data, place: decode_depth(data, place, table),
    )
    color, color_camera = None, None
    if rows["r"]:
        color_rows = _in_time(rows["r"], times)
        color_camera = make_camera(640, 480, np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]]), place=path)
        pictures = [entries[i].file for i in color_rows]
        color = image_stream(ImageFiles("color", pictures, times[color_rows], path / "INDEX.txt"), color_camera)
    T_color_depth = pose(np.eye(3), np.array([-0.025, 0.0, 0.0]))
    dropped = len(rows["d"]) - len(depth_rows)
    return Scan(
        name=path.resolve().name,
        root=path,
        format="fakenect",
        rig=make_rig(depth_camera, color_camera, T_color_depth if color_camera else None, place=path),
        depth=depth,
        color=color,
        depth_unit_m=unit_m,
        recorded_at=_date(entries[0].wall_s),
        notes=(
            "depth in mm by typical constants of a Kinect v1 (the device's own are not in the recording)",
            f"nominal cameras assumed (depth f = {f:.1f} px, colour f = 525 px, 25 mm apart): a rig.json replaces them",
            *([f"{counted(dropped, 'depth frame')} with a repeated or earlier time left out"] if dropped else []),
            *_gravity(path, [entries[i] for i in rows["a"]]),
        ),
    )


def decode_depth(data: bytes, place: object, table: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """A fakenect PGM (little-endian 11-bit disparity) in millimetres through `table` (2048,)."""
    raw = read_pnm(data, place=place, byteorder="<")
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise ScanError("expected a 16-bit PGM of raw depth", place=place)
    if raw.max(initial=0) > NO_DEPTH_RAW:
        swapped = int(raw.byteswap().max()) <= NO_DEPTH_RAW
        order = "it was written big-endian, unlike fakenect does" if swapped else "it is no raw 11-bit disparity"
        raise ScanError(f"the depth has values above 2047: {order}", place=place)
    return table[raw]


def read_acceleration(data: bytes, place: object = None) -> tuple[Float, float, int]:
    """An accelerometer dump (12 bytes, `<hhhbxI`): (3,) acceleration in g, tilt in degrees, motor status."""
    if len(data) != 12:
        raise ScanError(f"an accelerometer dump has 12 bytes, got {len(data)}", place=place)
    x, y, z, tilt, status = struct.unpack("<hhhbxI", data)
    return np.array([x, y, z]) / COUNTS_PER_G, tilt / 2, status


def _entries(path: Path) -> list[_Entry]:
    index = path / "INDEX.txt"
    entries = []
    for number, line in enumerate(text_lines(index, "INDEX.txt"), 1):
        if not line.strip():
            continue
        match = _NAME.match(line.strip())
        if match is None:
            raise ScanError("expected {d,r,a}-<wall s>-<ticks>.{pgm,ppm,dump}", place=f"{index}, line {number}")
        file = inside(path, line.strip(), place=f"{index}, line {number}")
        entries.append(_Entry(match[1], float(match[2]), int(match[3]), file))
    if not entries:
        raise ScanError("no frames are listed", place=index)
    return entries


def _in_time(rows: list[int], times: Float) -> list[int]:
    """The rows whose time is later than all before: a driver may deliver a frame twice."""
    latest = np.maximum.accumulate(np.concatenate([[-np.inf], times[rows]]))[:-1]
    return [i for i, before in zip(rows, latest, strict=True) if times[i] > before]


def _gravity(path: Path, entries: list[_Entry]) -> list[str]:
    """A note on which way was down, from the readings near 1 g (the others were in motion)."""
    g = [read_acceleration(read_bytes(e.file, "accelerometer"), e.file)[0] for e in entries[:1000]]
    still = [v for v in g if 0.9 < np.linalg.norm(v) < 1.1]
    if not still:
        return []
    x, y, z = np.mean(still, axis=0)
    return [f"accelerometer, mean of {len(still)} readings at rest: ({x:.3f}, {y:.3f}, {z:.3f}) g in the device's axes"]


def _date(wall_s: float) -> str | None:
    try:
        return datetime.fromtimestamp(wall_s, UTC).isoformat(timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return None
