"""7-Scenes (Kinect v1) and 3DMatch folders: frame-NNNNNN.{color.png|jpg, depth.png, pose.txt}.

Format: https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/. Depth in millimetres, 0 or 65535
invalid; camera-to-world poses of the depth camera in metres. Nothing is said there about colour's own calibration.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import ScanError, counted
from ...files.reading import is_named, read_numbers
from ...files.tum import poses_to_trajectory
from ...geometry.rigid import pose
from ...types import Scan, Trajectory
from ..common import NO_TIMES, ImageFiles, frame_times, image_size, image_stream, make_camera, make_rig
from ..naming import Named, in_order, real_files
from ..stated import NOTHING, Stated

INVALID = (0, 65535)  # raw depths that mean none
PUBLISHED_K = np.array([[585.0, 0, 320], [0, 585.0, 240], [0, 0, 1]])
# The Kinect v1's colour camera is not calibrated in this data set: OpenNI's focal length and the mechanical baseline.
COLOR_K = np.array([[525.0, 0, 320], [0, 525.0, 240], [0, 0, 1]])
T_COLOR_DEPTH = pose(np.eye(3), np.array([-0.025, 0.0, 0.0]))


def recognise(path: Path) -> bool:
    """At least one frame-*.depth.png."""
    return path.is_dir() and next(path.glob("frame-*.depth.png"), None) is not None


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a folder as a scan, with its poses; frames whose pose is not finite (tracking lost) go without one."""
    depth = _frames(path, "depth")
    if not depth.files:
        raise ScanError("there are no frame-NNNNNN.depth.png", place=path)
    numbers, files = depth.index, depth.files
    width, height = image_size(files[0], "depth")
    own = path / "camera-intrinsics.txt"
    K = read_numbers(own, columns=3) if is_named(own) else PUBLISHED_K
    camera = stated.camera("depth") or make_camera(width, height, K, place=own if is_named(own) else path)
    unit_m = stated.unit_m(0.001)
    notes = [NO_TIMES]
    color_camera, color = None, None
    color_frames = _frames(path, "color")
    if color_frames.files:
        pictures, size = color_frames.files, image_size(color_frames.files[0], "color")
        color_camera = stated.camera("color") or make_camera(*size, COLOR_K, place=path)
        color = image_stream(
            ImageFiles("color", pictures, frame_times(color_frames.index), path, color_frames.index), color_camera
        )
        notes.append("colour is not calibrated here: nominal Kinect colour camera, 25 mm beside depth, assumed")
    trajectory, lost = _poses(path, numbers)
    if lost:
        notes.append(f"{counted(lost, 'frame')} without a finite pose")
    return Scan(
        name=path.resolve().name,
        root=path,
        format="7-scenes",
        rig=make_rig(camera, color_camera, T_COLOR_DEPTH if color_camera is not None else None, place=path),
        depth=image_stream(
            ImageFiles("depth", files, frame_times(numbers), path, numbers), camera, unit_m=unit_m, invalid=INVALID
        ),
        color=color,
        trajectory=trajectory,
        depth_unit_m=unit_m,
        notes=tuple(notes),
        times_assumed=True,
    )


def _frames(path: Path, kind: str) -> Named:
    return in_order(real_files(f for s in ("png", "jpg") for f in path.glob(f"frame-*.{kind}.{s}")))


def _poses(path: Path, numbers: tuple[int, ...]) -> tuple[Trajectory | None, int]:
    kept, poses, lost = [], [], 0
    for n in numbers:
        file = path / f"frame-{n:06d}.pose.txt"
        if not is_named(file):
            continue
        T = read_numbers(file, columns=4)
        if T.shape != (4, 4):
            raise ScanError("expected a 4x4 matrix", place=file)
        if np.isfinite(T).all():
            kept.append(n)
            poses.append(T)
        else:
            lost += 1
    if not kept:
        return None, lost
    return poses_to_trajectory(frame_times(kept), np.array(poses), place=path), lost
