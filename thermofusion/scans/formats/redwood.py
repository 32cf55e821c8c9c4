"""Redwood / Open3D reconstruction folders, SUN3D, and plain folders of depth and colour images.

Layouts (http://redwood-data.org, Open3D's reconstruction system and its RealSense recorder, SUN3D): `depth/` with
`color/`, `image/` or `rgb/`; or one folder with `rgb_0.png` and `depth_0.png`. Beside them, each optional:
`camera_intrinsic.json` or `intrinsic.json` (matrix by columns, size, `depth_scale` steps a metre), `intrinsics.txt`
(matrix by rows), `trajectory.log` or `odometry.log` (camera-to-world poses by frame).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ...errors import ScanError
from ...files.reading import is_named, read_json, read_numbers, text_lines
from ...files.tum import poses_to_trajectory
from ...types import Camera, Scan, Trajectory
from ..common import NOMINAL_K, make_camera
from ..naming import Named, images_in, in_order
from ..stated import NOTHING, Stated
from . import images

COLOR_NAMES = ("color", "image", "rgb")
JSON_NAMES = ("camera_intrinsic.json", "intrinsic.json")
TEXT_NAMES = ("intrinsics.txt", "camera-intrinsics.txt", "camera_intrinsics.txt", "intrinsic.txt")
LOG_NAMES = ("trajectory.log", "odometry.log")
_LOOKS_OTHER = re.compile(r"cam|intrin|calib|pose|traj|odom|extrin|scale", re.IGNORECASE)
RIG_HINT = "put a rig.json with cameras.depth (width_px, height_px, K) beside it"


def recognise(path: Path) -> bool:
    """A depth folder, or depth_N files, with colour or a camera beside it."""
    if not path.is_dir() or not _images(path, ("depth",), images.DEPTH_SUFFIXES):
        return False
    known = (*JSON_NAMES, *TEXT_NAMES, "rig.json")
    return bool(_images(path, COLOR_NAMES, images.COLOR_SUFFIXES)) or any((path / n).is_file() for n in known)


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a folder as a scan. Raises ScanError."""
    depth = in_order(_images(path, ("depth",), images.DEPTH_SUFFIXES))
    if not depth.files:
        raise ScanError("there are no depth images (depth/*.png or depth_N.png)", place=path)
    samples = images.sample_depth(depth, stated.depth_size())
    given = _given(path)
    sun3d = depth.times_s is not None or (given.file is not None and given.file.name in TEXT_NAMES)
    layout = images.depth_layout(samples, stated, given.unit_m, rotates=sun3d)
    camera, notes = _camera(path, given, samples[0].shape, stated)
    color = in_order(_images(path, COLOR_NAMES, images.COLOR_SUFFIXES))
    if color.files and (color.times_s is None) != (depth.times_s is None):
        raise ScanError("only one of colour and depth carries time stamps in its names", place=path)
    log = next((path / n for n in LOG_NAMES if is_named(path / n)), None)
    trajectory, more = (None, ()) if log is None else _trajectory(log, depth)
    folder = images.Folder(path, "redwood", stated, depth, color, stated.depth_size())
    return folder.scan(camera, layout, trajectory=trajectory, notes=(*notes, *more, *_unread(path, log)))


def _images(path: Path, names: tuple[str, ...], suffixes: tuple[str, ...]) -> list[Path]:
    """Images in a folder of one of the names, else files in `path` that begin with one."""
    for name in names:
        if (path / name).is_dir():
            return images_in(path / name, suffixes)
    found = images_in(path, suffixes)
    return [f for f in found if f.name.lower().startswith(names) and re.search(r"\d", f.stem)]


@dataclass(frozen=True, eq=False)
class _Given:
    """What the folder's own file says: the matrix, the size it is for, and metres a step; the file."""

    K: np.ndarray | None = None
    size: tuple[int, int] | None = None
    unit_m: float | None = None
    file: Path | None = None


def _given(path: Path) -> _Given:
    for file in (path / n for n in JSON_NAMES if is_named(path / n)):
        tree = read_json(file)
        try:
            K = np.array(tree["intrinsic_matrix"], np.float64).reshape(3, 3).T
            size = (int(tree["width"]), int(tree["height"])) if "width" in tree else None
            scale = float(tree["depth_scale"]) if tree.get("depth_scale") else None
        except (KeyError, TypeError, ValueError, AttributeError):
            text = "expected 'intrinsic_matrix' (nine numbers, by columns), 'width', 'height', 'depth_scale'"
            raise ScanError(text, place=file) from None
        if scale is not None and not 1 <= scale <= 1e5:
            raise ScanError(f"key 'depth_scale': expected steps a metre, 1 to 100000, got {scale:g}", place=file)
        return _Given(K, size, None if scale is None else 1 / scale, file)
    for file in (path / n for n in TEXT_NAMES if is_named(path / n)):
        K = read_numbers(file, columns=3)
        return _Given(K, None, None, file)
    return _Given()


def _camera(path: Path, given: _Given, shape: tuple[int, ...], stated: Stated) -> tuple[Camera, tuple[str, ...]]:
    """The depth camera: the rig's, the folder's own, or nominal; its size must be the images'."""
    height, width = shape[:2]
    own = stated.camera("depth")
    if own is not None:
        return own, ()
    if given.K is None:
        if (width, height) != (640, 480):
            text = f"there is no camera_intrinsic.json, and a {width} x {height} camera's is not known"
            raise ScanError(text, place=path, hint=RIG_HINT)
        return make_camera(width, height, NOMINAL_K, place=path), ("nominal intrinsics (f = 525 px) assumed",)
    if given.size is not None and given.size != (width, height):
        text = f"the camera is for {given.size[0]} x {given.size[1]} px, the depth images have {width} x {height}"
        raise ScanError(text, place=given.file, hint=f"{RIG_HINT}: those of the images")
    if given.size is None and not (0.25 < given.K[0, 2] / width < 0.75 and 0.25 < given.K[1, 2] / height < 0.75):
        text = f"the camera's centre ({given.K[0, 2]:.0f}, {given.K[1, 2]:.0f}) is not that of {width} x {height} px"
        raise ScanError(text, place=given.file, hint=f"{RIG_HINT}: those of the images")
    return make_camera(width, height, given.K, place=given.file), ()


def _trajectory(log: Path, depth: Named) -> tuple[Trajectory, tuple[str, ...]]:
    """Blocks of a line of three integers, the first the frame's, and a 4x4 camera-to-world matrix; and notes."""
    numbers = _rows(log)
    if len(numbers) % 5 or any(len(r) != (3 if i % 5 == 0 else 4) for i, r in enumerate(numbers)):
        raise ScanError("expected blocks of three integers and a 4x4 matrix", place=log)
    poses = np.array([numbers[i + 1 : i + 5] for i in range(0, len(numbers), 5)]).reshape(-1, 4, 4)
    rows = _positions([int(r[0]) for r in numbers[::5]], depth, log)
    lost = sorted(set(range(len(depth.files))) - set(rows))
    named = ", ".join(str(depth.index[i]) for i in lost[:10])
    notes = (f"{len(lost)} depth frames have no pose (frames {named}{', ...' if len(lost) > 10 else ''})",)
    return poses_to_trajectory(depth.stamps[rows], poses, place=log), notes if lost else ()


def _positions(ids: list[int], depth: Named, log: Path) -> list[int]:
    """The depth frames that the poses' ids name: by the numbers in the files' names, else counted from 0, or from 1."""
    n = len(depth.files)
    if not 0 < len(ids) <= n:
        raise ScanError(f"{len(ids)} poses for {n} depth frames", place=log)
    if len(set(ids)) == 1 < len(ids) == n:
        return list(range(n))  # a writer that fills the line with zeros
    if any(b <= a for a, b in pairwise(ids)):
        raise ScanError("the poses' numbers do not rise from block to block", place=log)
    numbers = {number: i for i, number in enumerate(depth.index)} if depth.times_s is None else {}
    if all(k in numbers for k in ids):
        return [numbers[k] for k in ids]
    first = 1 if ids[-1] == n else 0
    if ids[0] < first or ids[-1] - first >= n:
        raise ScanError(f"the poses are numbered {ids[0]} to {ids[-1]}, the depth frames 0 to {n - 1}", place=log)
    return [k - first for k in ids]


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


def _unread(path: Path, log: Path | None) -> tuple[str, ...]:
    """A note on files that look like cameras or poses and are not read here."""
    known = {*JSON_NAMES, *TEXT_NAMES, "rig.json"} | ({log.name} if log is not None else set())
    suffixes = (".json", ".txt", ".csv", ".yaml", ".yml", ".log", ".npz", ".npy", ".xml", ".ini")
    found = sorted(f.name for f in images_in(path, suffixes) if _LOOKS_OTHER.search(f.stem) and f.name not in known)
    return (f"not read, though they may hold cameras or poses: {', '.join(found)}",) if found else ()
