"""ICL-NUIM (POV-Ray) folders: scene_00_NNNN.depth (text, metres along the ray), .png, .txt (POV-Ray's camera).

Layout and conventions of the VaFRIC sources: one known camera; POV-Ray's world is left-handed with y up, so the second
axis of the world and of the camera are turned.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import read_text
from ...files.tum import poses_to_trajectory
from ...types import Camera, Float, Scan
from ..common import NO_TIMES, make_camera, make_rig, make_stream
from ..naming import in_order, real_files
from ..stated import NOTHING, Stated
from . import images

SIZE = (640, 480)  # (width, height) px
K = np.array([[481.2, 0, 319.5], [0, 480.0, 239.5], [0, 0, 1]])  # of the data set; its fy is -480 for y up
FLIP = np.diag([1.0, -1, 1, 1])
_VECTOR = re.compile(r"cam_(\w+)\s*=\s*\[([^\]]*)\]")


def recognise(path: Path) -> bool:
    """NAME_NNNN.depth beside its .txt."""
    first = next(iter(sorted(path.glob("*_[0-9]*.depth"))), None) if path.is_dir() else None
    return first is not None and first.with_suffix(".txt").is_file()


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a folder as a scan. Raises ScanError."""
    depth = in_order(real_files(path.glob("*.depth")))
    color = in_order(f.with_suffix(".png") for f in depth.files if f.with_suffix(".png").is_file())
    camera = stated.camera("depth") or make_camera(*SIZE, K, place=path)
    unit_m, slant = stated.unit_m(1.0), _slant(camera)

    def load(i: int) -> NDArray:
        z = _numbers(depth.files[i], camera) / slant * unit_m
        return np.where(np.isfinite(z) & (z > 0), z, np.nan).astype(np.float32)

    poses = np.stack([_pose(f.with_suffix(".txt")) for f in depth.files])
    color_camera, notes = images.color_camera(color, camera, stated) if color.files else (None, ())
    return Scan(
        name=path.resolve().name,
        root=path,
        format="icl-nuim",
        rig=make_rig(camera, color_camera, place=path),
        depth=make_stream(
            depth.stamps, load, [str(f) for f in depth.files], place=path, kind="depth", index=depth.index
        ),
        color=None if color_camera is None else images.color_stream(color, color_camera),
        trajectory=poses_to_trajectory(depth.stamps, poses, place=path),
        depth_unit_m=images.FLOAT_UNIT_M,
        notes=(NO_TIMES, *notes),
        times_assumed=True,
    )


def _slant(camera: Camera) -> Float:
    """(H, W) how much longer the ray is than its part along the axis."""
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    x, y = (u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]
    return np.sqrt(x**2 + y**2 + 1)


def _numbers(path: Path, camera: Camera) -> Float:
    try:
        values = np.array(read_text(path, "depth").split(), np.float64)
    except ValueError:
        raise ScanError("expected numbers only", place=path) from None
    if len(values) != camera.width_px * camera.height_px:
        text = f"{len(values)} numbers are no {camera.width_px} x {camera.height_px} px"
        raise ScanError(text, place=path, hint="put a rig.json with cameras.depth beside it")
    return values.reshape(camera.shape)


def _pose(path: Path) -> Float:
    """Camera-to-world (4, 4) m of POV-Ray's position, direction and up."""
    try:
        v = {k: np.array([float(x) for x in text.split(",")]) for k, text in _VECTOR.findall(read_text(path))}
        z = v["dir"] / np.linalg.norm(v["dir"])
        x = np.cross(v["up"], z)
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), v["pos"]
    except (KeyError, ValueError):
        raise ScanError("expected cam_pos, cam_dir and cam_up of three numbers", place=path) from None
    return FLIP @ T @ FLIP
