"""Stray Scanner folders: depth/ and confidence/ (PNG, mm), rgb.mp4 of another size, camera_matrix.csv, odometry.csv.

Layout as StrayVisualizer reads it: the matrix is the video's, depth is the same view at its own size, poses are
camera-to-world in our axes.
"""

from __future__ import annotations

from pathlib import Path
from threading import Lock

import cv2
import numpy as np
from numpy.typing import NDArray

from ....errors import ScanError
from ....files.reading import read_image, read_numbers, read_text
from ....files.tum import poses_of, poses_to_trajectory
from ....types import Camera, Float, Scan, Stream
from ...common import make_camera, make_rig, make_stream
from ...naming import images_in, in_order
from ...stated import NOTHING, Stated
from ..images import DepthLayout, resized
from . import trusted_image


def recognise(path: Path) -> bool:
    """odometry.csv and depth/ beside camera_matrix.csv."""
    return all((path / n).exists() for n in ("odometry.csv", "camera_matrix.csv", "depth"))


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a folder as a scan. Raises ScanError."""
    times, poses = _odometry(path / "odometry.csv")
    depth = in_order(images_in(path / "depth", (".png",)))
    if not depth.files or max(depth.index) >= len(times):
        raise ScanError(f"{len(depth.files)} depth images for {len(times)} rows of odometry.csv", place=path)
    rows = list(depth.index)
    shape = read_image(depth.files[0], kind="depth").shape
    K = read_numbers(path / "camera_matrix.csv", columns=3)
    video = path / "rgb.mp4"
    capture = _open(video) if video.is_file() else None
    size = _size(capture) if capture is not None else (round(2 * K[0, 2]), round(2 * K[1, 2]))
    color = make_camera(size[0], size[1], K, place=path / "camera_matrix.csv")
    camera = stated.camera("depth") or resized(color, (shape[1], shape[0]), path)
    layout = DepthLayout(stated.unit_m(0.001))

    def load(i: int) -> NDArray:
        return trusted_image(depth.files[i], path / "confidence", camera, layout)

    places = [str(f) for f in depth.files]
    return Scan(
        name=path.resolve().name,
        root=path,
        format="stray",
        rig=make_rig(camera, color if capture is not None else None, place=path),
        depth=make_stream(times[rows], load, places, place=path / "depth", kind="depth", index=depth.index),
        color=None if capture is None else _video(capture, video, color, times),
        trajectory=poses_to_trajectory(times, poses, place=path / "odometry.csv"),
        depth_unit_m=layout.unit_m,
        notes=("depth that the phone does not trust at all is left out",),
    )


def _odometry(path: Path) -> tuple[Float, Float]:
    """Times (N,) s and poses (N, 4, 4) of rows `timestamp, frame, x, y, z, qx, qy, qz, qw`."""
    lines = [w for line in read_text(path).splitlines()[1:] if (w := line.replace(",", " ").split())]
    try:
        table = np.array([[float(x) for x in w[:9]] for w in lines], np.float64).reshape(len(lines), 9)
        return table[:, 0], poses_of(table[:, 2:])
    except ValueError:
        raise ScanError("expected rows `timestamp, frame, x, y, z, qx, qy, qz, qw`", place=path) from None


def _open(video: Path) -> cv2.VideoCapture:
    """The video, decoded on one thread: it is asked for frames from several."""
    return cv2.VideoCapture(str(video), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])


def _size(capture: cv2.VideoCapture) -> tuple[int, int]:
    return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))


def _video(capture: cv2.VideoCapture, path: Path, camera: Camera, times_s: Float) -> Stream:
    """The video's frames, one a row of the odometry."""
    n = min(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), len(times_s))
    if n == 0 or camera.width_px == 0:
        raise ScanError("the video cannot be read", place=path)

    lock = Lock()

    def load(i: int) -> NDArray:
        with lock:
            if int(capture.get(cv2.CAP_PROP_POS_FRAMES)) != i:
                capture.set(cv2.CAP_PROP_POS_FRAMES, i)
            ok, image = capture.read()
        if not ok:
            raise ScanError(f"frame {i} of the video cannot be decoded", place=path)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))

    return make_stream(times_s[:n], load, [f"{path}, frame {i}" for i in range(n)], place=path, kind="color")
