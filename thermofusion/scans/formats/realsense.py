"""RealSense recordings (.bag) through Open3D's reader. Not yet proved on a recording: none was at hand.

Open3D plays the file and aligns depth to colour's pixels, so both share one camera (colour's intrinsics, without
distortion). Playback cannot go back to the very same frame, so it runs once, into a temporary folder that lives as
long as the scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import read_head, read_image
from ...types import Scan
from ..common import Kind, as_loaded, make_camera, make_rig, make_stream
from ..stated import NOTHING, Stated

MAGIC = b"#ROSBAG V2.0"


def recognise(path: Path) -> bool:
    """A file that begins like a ROS bag."""
    return read_head(path, len(MAGIC)) == MAGIC


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """A .bag as a scan. Raises ScanError where Open3D cannot play it, or where it holds no frames."""
    if not recognise(path):
        raise ScanError("it is no ROS bag", place=path)
    reader = _open(path)
    try:
        spool = _play(reader, path)
        m = reader.metadata
        camera = make_camera(int(m.width), int(m.height), np.array(m.intrinsics.intrinsic_matrix), place=path)
        unit_m = stated.unit_m(1.0 / float(m.depth_scale))
    finally:
        reader.close()
    places = [f"{path}, frame {i}" for i in range(len(spool.times_s))]
    shape = camera.shape
    return Scan(
        name=path.stem,
        root=path,
        format="realsense-bag",
        rig=make_rig(camera, camera, place=path),
        depth=make_stream(
            spool.times_s, lambda i: spool.load("depth", i, shape, unit_m), places, place=path, kind="depth"
        ),
        color=make_stream(
            spool.times_s, lambda i: spool.load("color", i, shape, unit_m), places, place=path, kind="color"
        ),
        depth_unit_m=unit_m,
        notes=("Open3D aligned depth to colour; colour's distortion is not carried over",),
    )


@dataclass(frozen=True)
class _Spool:
    """Frames played to disk. The folder goes when the last stream that needs it goes."""

    folder: TemporaryDirectory
    times_s: list[float]

    def load(self, kind: Kind, i: int, shape: tuple[int, int], unit_m: float) -> NDArray:
        file = Path(self.folder.name) / f"{kind}{i}.png"
        return as_loaded(kind, read_image(file, shape=shape, kind=kind), file, unit_m)


def _open(path: Path) -> Any:
    from ...geometry._open3d import o3d

    reader = o3d.t.io.RSBagReader()
    try:
        opened = reader.open(str(path))
    except RuntimeError as e:
        raise ScanError(f"Open3D cannot read the recording ({str(e).splitlines()[-1]})", place=path) from None
    if not opened:
        raise ScanError("Open3D cannot read the recording: damaged, or no RealSense recording", place=path)
    return reader


def _play(reader: Any, path: Path) -> _Spool:
    spool = _Spool(TemporaryDirectory(prefix="thermofusion-bag-"), [])
    while not reader.is_eof():
        frame = reader.next_frame()
        if frame.is_empty():
            continue
        time_s = reader.get_timestamp() * 1e-6
        if spool.times_s and time_s <= spool.times_s[-1]:
            continue
        images = {
            "depth": np.squeeze(np.asarray(frame.depth.as_tensor().cpu().numpy())),
            "color": cv2.cvtColor(np.asarray(frame.color.as_tensor().cpu().numpy()), cv2.COLOR_RGB2BGR),
        }
        for kind, image in images.items():
            file = Path(spool.folder.name) / f"{kind}{len(spool.times_s)}.png"
            file.write_bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())
        spool.times_s.append(time_s)
    if not spool.times_s:
        raise ScanError("the recording has no frames that can be read", place=path)
    return spool
