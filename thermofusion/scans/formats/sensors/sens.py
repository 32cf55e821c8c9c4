"""ScanNet / Structure Sensor .sens files: one binary stream of poses, JPEG colour and deflated 16-bit depth.

Layout of ScanNet's SensorData: version 4, name, four 4x4 matrices (colour and depth intrinsics, extrinsics), codecs,
sizes, steps of depth a metre, then frame by frame a camera-to-world pose, two times in microseconds and the images.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ....errors import ScanError
from ....files.reading import COPY_AGAIN, MAX_PIXELS, decode_image, open_regular
from ....files.tum import poses_to_trajectory
from ....geometry.rigid import invert
from ....types import Float, Scan
from ...common import as_loaded, make_camera, make_rig, make_stream
from ...stated import NOTHING, Stated
from ..images import DepthLayout

VERSION, MAX_FRAMES = 4, 4_000_000
DEPTH_RAW, DEPTH_ZLIB = 0, 1
COLOR_PNG, COLOR_JPEG = 1, 2


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame: its pose (4, 4), time in s, and where its images lie: (offset, size)."""

    pose: Float
    time_s: float
    color: tuple[int, int]
    depth: tuple[int, int]


def recognise(path: Path) -> bool:
    """A file named .sens."""
    return path.suffix.lower() == ".sens" and path.is_file()


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a file as a scan; frames whose pose is not finite go without one. Raises ScanError."""
    with open_regular(path, limit_bytes=None) as f:
        try:
            version, length = struct.unpack("<IQ", f.read(12))
            if version != VERSION or length > 4096:
                raise ScanError(f"a .sens file of version {version}, expected {VERSION}", place=path)
            f.read(length)
            K_color, E_color, K_depth, E_depth = _doubles(f.read(256)).reshape(4, 4, 4)
            codecs = struct.unpack("<ii", f.read(8))
            cw, ch, dw, dh, steps, n = struct.unpack("<IIIIfQ", f.read(28))
        except (struct.error, ValueError):
            raise ScanError("the .sens file is truncated", place=path, hint=COPY_AGAIN) from None
        if codecs[1] not in (DEPTH_RAW, DEPTH_ZLIB) or not 0 < dw * dh <= MAX_PIXELS or n > MAX_FRAMES or steps <= 0:
            raise ScanError("the .sens file's depth is coded in a way that is not read", place=path)
        frames = _frames(f, n, path.stat().st_size)
    if not frames:
        raise ScanError("the .sens file has no whole frame", place=path, hint=COPY_AGAIN)
    camera = stated.camera("depth") or make_camera(dw, dh, K_depth[:3, :3], place=path)
    colored = codecs[0] in (COLOR_PNG, COLOR_JPEG)
    color = make_camera(cw, ch, K_color[:3, :3], place=path) if colored else None
    layout = DepthLayout(stated.unit_m(1 / steps))
    places = [f"{path}, frame {i}" for i in range(len(frames))]

    def depth(i: int) -> NDArray:
        data = _part(path, frames[i].depth)
        if codecs[1] == DEPTH_ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, 2 * dw * dh)
            except zlib.error:
                raise ScanError("the depth is damaged", place=places[i], hint=COPY_AGAIN) from None
        if len(data) != 2 * dw * dh:
            raise ScanError("the depth is not of the header's size", place=places[i], hint=COPY_AGAIN)
        return layout.metres(np.frombuffer(data, "<u2").reshape(dh, dw).astype(np.uint16), places[i])

    def picture(i: int) -> NDArray:
        image = decode_image(_part(path, frames[i].color), shape=(ch, cw), kind="color", place=places[i])
        return as_loaded("color", image, places[i], 1.0)

    times = np.array([f.time_s for f in frames])
    tracked = [i for i, f in enumerate(frames) if np.isfinite(f.pose).all()]
    T = np.stack([frames[i].pose @ E_depth for i in tracked]) if tracked else None
    return Scan(
        name=path.stem,
        root=path,
        format="sens",
        rig=make_rig(camera, color, invert(E_color) @ E_depth if colored else None, place=path),
        depth=make_stream(times, depth, places, place=path, kind="depth"),
        color=make_stream(times, picture, places, place=path, kind="color") if colored else None,
        trajectory=None if T is None else poses_to_trajectory(times[tracked], T, place=path),
        depth_unit_m=layout.unit_m,
        notes=() if len(frames) == n else (f"the file is torn: {len(frames)} of {n} frames are used",),
    )


def _frames(f: BinaryIO, n: int, size: int) -> list[_Frame]:
    """The whole frames of the stream, found by their headers."""
    frames: list[_Frame] = []
    for _ in range(n):
        head = f.read(96)
        if len(head) < 96:
            break
        pose = _doubles(head[:64]).reshape(4, 4)
        color_us, depth_us, color_bytes, depth_bytes = struct.unpack_from("<QQQQ", head, 64)
        at = f.tell()
        end = at + color_bytes + depth_bytes
        if end > size:
            break
        frames.append(_Frame(pose, (depth_us or color_us) * 1e-6, (at, color_bytes), (at + color_bytes, depth_bytes)))
        f.seek(end)
    return frames


def _doubles(data: bytes) -> Float:
    """Float32 numbers (N,) as float64; damaged ones stay what they are, without a warning."""
    with np.errstate(invalid="ignore"):
        return np.frombuffer(data, "<f4").astype(np.float64)


def _part(path: Path, where: tuple[int, int]) -> bytes:
    with open_regular(path, limit_bytes=None) as f:
        f.seek(where[0])
        return f.read(where[1])
