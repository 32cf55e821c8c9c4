"""Redwood / Open3D reconstruction folders, and plain folders of numbered colour and depth images.

Layouts (http://redwood-data.org, Open3D's reconstruction system): `depth/` with `color/`, `image/` or `rgb/`; or one
folder with `rgb_0.png` and `depth_0.png`. Beside them, each optional: `camera_intrinsic.json` (matrix by columns),
`trajectory.log` or `odometry.log` (camera-to-world poses).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import ScanError
from ...files.reading import is_named, read_json, text_lines
from ...files.tum import poses_to_trajectory
from ...types import Camera, Float, Scan, Trajectory
from ..common import (
    NOMINAL_K,
    ImageFiles,
    frame_times,
    image_size,
    image_stream,
    make_camera,
    make_rig,
    numbered,
)

COLOR_NAMES = ("color", "image", "rgb")
_SUFFIXES = (".png", ".jpg", ".jpeg")
_STAMPED = re.compile(r"^(\d+)-(\d{9,18})$")  # Redwood's NNNNNNN-TTTTTTTTTTTT: frame number, microseconds


def recognise(path: Path) -> bool:
    """A depth folder, or depth_N.png files, beside colour."""
    return bool(path.is_dir() and _images(path, ("depth",)) and _images(path, COLOR_NAMES))


def read(path: Path) -> Scan:
    """Such a folder as a scan: depth in millimetres, registered to colour."""
    depth_files, color_files = _images(path, ("depth",)), _images(path, COLOR_NAMES)
    if not depth_files:
        raise ScanError("there are no depth images (depth/*.png or depth_N.png)", place=path)
    camera, notes = _camera(path, depth_files[0])
    notes.append("depth is taken as millimetres and as registered to colour (T_color_depth = identity)")
    depth_times, depth_index, depth_paths, stamped = _times(depth_files)
    color_times, color_index, color_paths, color_stamped = _times(color_files)
    if stamped != color_stamped and color_files:
        raise ScanError("only one of colour and depth carries time stamps in its names", place=path)
    if not stamped:
        notes.append("the recording carries no times: 30 frames a second by number are assumed")
    log = next((path / n for n in ("trajectory.log", "odometry.log") if is_named(path / n)), None)
    color = None
    if color_paths:
        color = image_stream(ImageFiles("color", color_paths, color_times, path, color_index), camera)
    return Scan(
        name=path.resolve().name,
        root=path,
        format="redwood",
        rig=make_rig(camera, camera if color is not None else None, place=path),
        depth=image_stream(ImageFiles("depth", depth_paths, depth_times, path, depth_index), camera),
        color=color,
        trajectory=None if log is None else _trajectory(log, depth_times),
        notes=tuple(notes),
    )


def _images(path: Path, names: tuple[str, ...]) -> list[Path]:
    """Images in a folder of one of the names, else files in `path` that begin with one."""
    for name in names:
        if (path / name).is_dir():
            return sorted(f for f in (path / name).iterdir() if f.suffix.lower() in _SUFFIXES)
    files = [f for f in path.iterdir() if f.suffix.lower() in _SUFFIXES and f.is_file()]
    return sorted(f for f in files if f.name.lower().startswith(names) and re.search(r"\d", f.stem))


def _times(files: list[Path]) -> tuple[Float, list[int], list[Path], bool]:
    """Times in seconds, frame numbers, files in order, and whether the names carried the times."""
    stamps = [_STAMPED.match(f.stem) for f in files]
    if files and all(stamps):
        rows = sorted((int(s[1]), int(s[2]), f) for s, f in zip(stamps, files, strict=True) if s)
        return np.array([r[1] for r in rows]) * 1e-6, [r[0] for r in rows], [r[2] for r in rows], True
    rows_by_number = numbered(files)
    index = [n for n, _ in rows_by_number]
    return frame_times(index), index, [f for _, f in rows_by_number], False


def _camera(path: Path, first_depth: Path) -> tuple[Camera, list[str]]:
    width, height = image_size(first_depth, "depth")
    for file in (path / "camera_intrinsic.json", path / "intrinsic.json"):
        if not is_named(file):
            continue
        tree = read_json(file)
        try:
            K = np.array(tree["intrinsic_matrix"], np.float64).reshape(3, 3).T
        except (KeyError, TypeError, ValueError):
            raise ScanError("key 'intrinsic_matrix': expected nine numbers, by columns", place=file) from None
        return make_camera(width, height, K, place=file), []
    if (width, height) != (640, 480):
        raise ScanError(
            f"there is no camera_intrinsic.json, and a {width} x {height} camera's is not known", place=path
        )
    return make_camera(width, height, NOMINAL_K, place=path), ["nominal intrinsics (f = 525 px) assumed"]


def _trajectory(log: Path, depth_times: Float) -> Trajectory:
    """Blocks of one line of three integers and a 4x4 camera-to-world matrix; block n belongs to depth frame n."""
    numbers = _rows(log)
    if len(numbers) % 5 or any(len(r) != (3 if i % 5 == 0 else 4) for i, r in enumerate(numbers)):
        raise ScanError("expected blocks of three integers and a 4x4 matrix", place=log)
    poses = np.array([numbers[i + 1 : i + 5] for i in range(0, len(numbers), 5)]).reshape(-1, 4, 4)
    if not 0 < len(poses) <= len(depth_times):
        raise ScanError(f"{len(poses)} poses for {len(depth_times)} depth frames", place=log)
    return poses_to_trajectory(depth_times[: len(poses)], poses, place=log)


def _rows(log: Path) -> list[list[float]]:
    rows = []
    for number, line in enumerate(text_lines(log), 1):
        try:
            row = [float(w) for w in line.split()]
        except ValueError:
            raise ScanError("expected numbers only", place=f"{log}, line {number}") from None
        if row:
            rows.append(row)
    return rows
