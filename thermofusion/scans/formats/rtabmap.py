"""RTAB-Map: its database (.db), and the folders that rtabmap-export writes (*_rgb, *_depth, *_calib, *_poses.txt).

By RTAB-Map's DatabaseSchema.sql, CameraModel::serialize and tools/Export: a node has the pose of the robot's body, and
the camera a local transform from its optical frame to that body; depth is in millimetres, registered to colour.
"""

from __future__ import annotations

import re
import sqlite3
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import decode_image, open_regular, read_numbers, read_text
from ...files.tum import poses_of, poses_to_trajectory
from ...geometry.rigid import pose
from ...types import Camera, Float, Scan, Trajectory
from ..common import as_loaded, make_camera, make_rig, make_stream
from ..naming import images_in, in_order
from ..stated import NOTHING, Stated
from . import images

SQLITE = b"SQLite format 3\0"
_MATRIX = re.compile(  # as OpenCV's FileStorage writes a matrix
    r"^(\w+):[^\n]*\n\s+rows:\s*\d+\s*\n\s+cols:\s*\d+\s*\n(?:\s+dt:.*\n)?\s+data:\s*\[([^\]]*)\]", re.MULTILINE
)
QUERY = "SELECT Node.id, stamp, pose, calibration FROM Node JOIN Data ON Node.id = Data.id WHERE depth IS NOT NULL"


def recognise(path: Path) -> bool:
    """A .db that is SQLite, or a folder with *_rgb, *_depth and *_calib."""
    if path.is_dir():
        return _exported(path) is not None
    if path.suffix.lower() != ".db" or not path.is_file():
        return False
    with open_regular(path, limit_bytes=None) as f:
        return f.read(16) == SQLITE


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """A database, or an export, as a scan. Raises ScanError."""
    return _read_export(path, stated) if path.is_dir() else _read_database(path, stated)


# ---------------------------------------------------------------- the database


def _read_database(path: Path, stated: Stated) -> Scan:
    try:
        rows = _query(path, f"{QUERY} ORDER BY stamp, Node.id")
    except (sqlite3.Error, UnicodeError, OverflowError) as e:
        raise ScanError(f"it is no RTAB-Map database that can be read ({e})", place=path) from None
    if not rows:
        raise ScanError("the database holds no depth images", place=path)
    own, _ = _model(rows[0][3], path)
    camera, layout = stated.camera("depth") or own, images.DepthLayout(stated.unit_m(0.001))
    ids, times = [int(r[0]) for r in rows], np.array([float(r[1]) for r in rows])
    places = [f"{path}, node {i}" for i in ids]

    def blob(column: str, i: int) -> bytes:
        return bytes(_query(path, f"SELECT {column} FROM Data WHERE id = ?", ids[i])[0][0])

    def depth(i: int) -> NDArray:
        raw = decode_image(blob("depth", i), shape=camera.shape, kind="depth", place=places[i])
        if raw.dtype == np.uint8 and raw.ndim == 3 and raw.shape[2] == 4:  # float metres in the four bytes of RGBA
            return images.DepthLayout(1.0).metres(raw.view("<f4")[..., 0], places[i])
        return layout.metres(raw, places[i])

    def picture(i: int) -> NDArray:
        image = decode_image(blob("image", i), shape=camera.shape, kind="color", place=places[i])
        return as_loaded("color", image, places[i], 1.0)

    colored = _query(path, "SELECT count(*) FROM Data WHERE depth IS NOT NULL AND image IS NULL")[0][0] == 0
    return Scan(
        name=path.stem,
        root=path,
        format="rtabmap",
        rig=make_rig(camera, camera if colored else None, place=path),
        depth=make_stream(times, depth, places, place=path, kind="depth", index=ids),
        color=make_stream(times, picture, places, place=path, kind="color", index=ids) if colored else None,
        trajectory=_node_poses(rows, times, path),
        depth_unit_m=layout.unit_m,
        notes=(
            "poses are the odometry's: to have RTAB-Map's optimised ones, export them (rtabmap-export --poses_camera)",
        ),
    )


def _query(path: Path, text: str, *values: int) -> list[tuple]:
    uri = f"{path.resolve().as_uri()}?mode=ro"
    base = sqlite3.connect(uri, uri=True)
    try:
        return base.execute(text, values).fetchall()
    finally:
        base.close()


def _model(blob: bytes | None, path: Path) -> tuple[Camera, Float]:
    """Camera and T_body_camera (4, 4) m of a serialised CameraModel of one camera."""
    try:
        _, _, _, kind, w, h, nK, nD, nR, nP, nL = struct.unpack_from("<11i", blob or b"")
        if kind != 0 or nK != 9 or nL != 12 or not 0 <= nD <= 14 or nR not in (0, 9) or nP not in (0, 12):
            raise ValueError
        numbers = np.frombuffer(blob or b"", "<f8", nK + nD + nR + nP, 44)
        local = np.frombuffer(blob or b"", "<f4", nL, 44 + 8 * len(numbers)).reshape(3, 4).astype(np.float64)
    except (struct.error, ValueError):
        text = "the calibration is none of a single camera"
        raise ScanError(text, place=path, hint="export it (rtabmap-export --images --poses_camera)") from None
    camera = make_camera(w, h, numbers[:9].reshape(3, 3), _distortion(numbers[9 : 9 + nD]), place=path)
    return camera, pose(local[:, :3], local[:, 3])


def _distortion(values: NDArray) -> NDArray | None:
    return values[:8] if len(values) >= 8 else values[:5] if len(values) in (4, 5) else None


def _node_poses(rows: list[tuple], times_s: Float, path: Path) -> Trajectory | None:
    found = []
    for i, (_, _, blob, calibration) in enumerate(rows):
        if blob is not None and len(blob) == 48:
            M = np.frombuffer(blob, "<f4").reshape(3, 4).astype(np.float64)
            if np.isfinite(M).all() and np.abs(M[:, :3]).max() > 0:
                found.append((i, pose(M[:, :3], M[:, 3]) @ _model(calibration, path)[1]))
    if not found:
        return None
    return poses_to_trajectory(times_s[[i for i, _ in found]], np.stack([T for _, T in found]), place=path)


# ---------------------------------------------------------------- the export


def _exported(path: Path) -> str | None:
    """The name before _rgb, _depth and _calib."""
    names = {f.name[: -len("_depth")] for f in path.glob("*_depth") if f.is_dir()}
    return next((n for n in sorted(names) if (path / f"{n}_calib").is_dir()), None)


def _read_export(path: Path, stated: Stated) -> Scan:
    name = _exported(path)
    depth = in_order(images_in(path / f"{name}_depth", images.DEPTH_SUFFIXES))
    color = in_order(images_in(path / f"{name}_rgb", images.COLOR_SUFFIXES))
    calibrations = in_order(images_in(path / f"{name}_calib", (".yaml", ".yml")))
    if not depth.files or not calibrations.files:
        raise ScanError("there are no depth images, or no calibration", place=path)
    own, T_body_camera = _yaml(calibrations.files[0])
    camera = stated.camera("depth") or own
    layout = images.depth_layout(images.sample_depth(depth, None), stated, None)
    trajectory = _export_poses(path, name or "", T_body_camera)
    return images.Folder(path, "rtabmap", stated, depth, color).scan(camera, layout, trajectory=trajectory)


def _yaml(file: Path) -> tuple[Camera, Float]:
    """Camera and T_body_camera (4, 4) m of a calibration file as OpenCV writes it."""
    text = read_text(file)
    blocks = _MATRIX.findall(text)
    size = dict(re.findall(r"^(image_width|image_height):\s*(\d+)", text, re.MULTILINE))
    try:
        m = {k: np.array([float(x) for x in v.replace(",", " ").split()]) for k, v in blocks}
        K, (w, h) = m["camera_matrix"].reshape(3, 3), (int(size["image_width"]), int(size["image_height"]))
        local = m["local_transform"].reshape(3, 4) if "local_transform" in m else np.eye(4)[:3]
    except (KeyError, ValueError):
        raise ScanError("expected image_width, image_height and camera_matrix", place=file) from None
    camera = make_camera(w, h, K, _distortion(m.get("distortion_coefficients", np.zeros(0))), place=file)
    return camera, pose(local[:, :3], local[:, 3])


def _export_poses(path: Path, name: str, T_body_camera: Float) -> Trajectory | None:
    """Rows `time x y z qx qy qz qw [id]`: of the camera where the file says so, else of the robot's body."""
    for file, local in ((path / f"{name}_camera_poses.txt", np.eye(4)), (path / f"{name}_poses.txt", T_body_camera)):
        if file.is_file():
            table = read_numbers(file)
            if table.shape[1] not in (8, 9):
                raise ScanError(
                    "expected rows `time x y z qx qy qz qw id` (rtabmap-export --poses_format 11)", place=file
                )
            return poses_to_trajectory(table[:, 0], poses_of(table[:, 1:8]) @ local, place=file)
    return None
