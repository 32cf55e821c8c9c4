"""BOP data sets: scene_camera.json (K, depth_scale, world-to-camera poses in mm), depth/ with rgb/ or gray/.

Format: bop_toolkit's bop_datasets_format.md. depth_scale turns stored values into millimetres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import ScanError
from ...files.reading import read_json
from ...files.tum import poses_to_trajectory
from ...geometry.rigid import invert, pose
from ...types import Scan, Trajectory
from ..common import make_camera
from ..naming import Named, images_in, in_order
from ..stated import NOTHING, Stated
from . import images


def recognise(path: Path) -> bool:
    """scene_camera.json beside depth/."""
    return (path / "scene_camera.json").is_file() and (path / "depth").is_dir()


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a folder as a scan; one camera for all frames. Raises ScanError."""
    file = path / "scene_camera.json"
    depth = in_order(images_in(path / "depth", images.DEPTH_SUFFIXES))
    color = in_order(images_in(path / "rgb", images.COLOR_SUFFIXES) or images_in(path / "gray", images.COLOR_SUFFIXES))
    if not depth.files:
        raise ScanError("there are no depth images", place=path / "depth")
    tree = read_json(file)
    try:
        rows = [tree[str(n)] for n in depth.index]
        K = np.array([r["cam_K"] for r in rows], np.float64).reshape(-1, 3, 3)
        scales = {float(r.get("depth_scale", 1.0)) for r in rows}
    except (KeyError, TypeError, ValueError, AttributeError):
        raise ScanError("expected 'cam_K' and 'depth_scale' for the number of every depth image", place=file) from None
    if len(scales) > 1 or np.abs(K - K[0]).max() > 0.5:
        raise ScanError("the frames differ in camera or depth_scale, which is not read", place=file)
    samples = images.sample_depth(depth, None)
    layout = images.depth_layout(samples, stated, scales.pop() * 1e-3)
    height, width = samples[0].shape[:2]
    camera = stated.camera("depth") or make_camera(width, height, K[0], place=file)
    return images.Folder(path, "bop", stated, depth, color).scan(camera, layout, trajectory=_poses(rows, depth, file))


def _poses(rows: list[Any], depth: Named, file: Path) -> Trajectory | None:
    """Camera-to-world of the frames that state world-to-camera, `cam_R_w2c` and `cam_t_w2c` in mm."""
    kept = [i for i, r in enumerate(rows) if "cam_R_w2c" in r and "cam_t_w2c" in r]
    if not kept:
        return None
    try:
        T = np.stack(
            [
                pose(np.array(rows[i]["cam_R_w2c"], float).reshape(3, 3), np.array(rows[i]["cam_t_w2c"], float) * 1e-3)
                for i in kept
            ]
        )
    except (TypeError, ValueError):
        raise ScanError("expected nine numbers 'cam_R_w2c' and three 'cam_t_w2c'", place=file) from None
    return poses_to_trajectory(depth.stamps[kept], invert(T), place=file)
