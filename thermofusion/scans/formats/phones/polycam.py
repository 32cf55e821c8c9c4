"""Polycam raw data: keyframes/ with cameras/ (JSON a frame), depth/ and confidence/ (PNG, mm), images/.

Layout by PolyCam's polyform: names are microseconds, poses t_00 .. t_23 are of ARKit's camera; the `corrected_` folders
hold what the program's own optimisation made of poses and pictures, and are preferred.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....errors import ScanError
from ....files.reading import read_image, read_json
from ....files.tum import poses_to_trajectory
from ....types import Camera, Scan
from ...common import ImageFiles, image_stream, make_camera, make_rig, make_stream
from ...naming import images_in
from ...stated import NOTHING, Stated
from ..images import DepthLayout, resized
from . import from_opengl, trusted_image


def recognise(path: Path) -> bool:
    """keyframes/ with depth/ and cameras/."""
    root = path / "keyframes" if (path / "keyframes").is_dir() else path
    return (root / "depth").is_dir() and any((root / n).is_dir() for n in ("corrected_cameras", "cameras"))


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a folder as a scan. Raises ScanError."""
    root = path / "keyframes" if (path / "keyframes").is_dir() else path
    cameras = _first(root, "corrected_cameras", "cameras")
    pictures = _first(root, "corrected_images", "images")
    files = {int(f.stem): f for f in images_in(root / "depth", (".png",)) if f.stem.isdigit()}
    stamps = [s for s in sorted(files) if (cameras / f"{s}.json").is_file()]
    if not stamps:
        raise ScanError("there are no depth images with a camera of the same name", place=root)
    trees = [read_json(cameras / f"{s}.json") for s in stamps]
    color = _camera(trees[0], cameras / f"{stamps[0]}.json")
    shape = read_image(files[stamps[0]], kind="depth").shape
    camera = stated.camera("depth") or resized(color, (shape[1], shape[0]), path)
    times, layout = np.array(stamps) * 1e-6, DepthLayout(stated.unit_m(0.001))
    T = from_opengl(np.stack([_pose(t, cameras / f"{s}.json") for t, s in zip(trees, stamps, strict=True)]))

    def load(i: int) -> NDArray:
        return trusted_image(files[stamps[i]], root / "confidence", camera, layout)

    seen = [i for i, s in enumerate(stamps) if (pictures / f"{s}.jpg").is_file()]
    shots = ImageFiles("color", [pictures / f"{stamps[i]}.jpg" for i in seen], times[seen], pictures, seen)
    focal = [_camera(t, cameras).focal_px for t in trees]
    return Scan(
        name=path.resolve().name,
        root=path,
        format="polycam",
        rig=make_rig(camera, color if seen else None, place=path),
        depth=make_stream(times, load, [str(files[s]) for s in stamps], place=root, kind="depth"),
        color=image_stream(shots, color) if seen else None,
        trajectory=poses_to_trajectory(times, T, place=cameras),
        depth_unit_m=layout.unit_m,
        notes=(
            f"poses of {cameras.name}; depth that the phone does not trust at all is left out",
            *(
                [f"the first frame's intrinsics for all: they differ by {np.ptp(focal):.1f} px"]
                if np.ptp(focal)
                else []
            ),
        ),
    )


def _first(root: Path, *names: str) -> Path:
    return next((root / n for n in names if (root / n).is_dir()), root / names[-1])


def _camera(tree: Any, place: object) -> Camera:
    try:
        K = np.array([[tree["fx"], 0, tree["cx"]], [0, tree["fy"], tree["cy"]], [0, 0, 1]], np.float64)
        return make_camera(int(tree["width"]), int(tree["height"]), K, place=place)
    except (KeyError, TypeError, ValueError):
        raise ScanError("expected fx, fy, cx, cy, width, height", place=place) from None


def _pose(tree: Any, place: object) -> NDArray:
    try:
        rows = [[float(tree[f"t_{r}{c}"]) for c in range(4)] for r in range(3)]
    except (KeyError, TypeError, ValueError):
        raise ScanError("expected the pose t_00 .. t_23", place=place) from None
    return np.array([*rows, [0, 0, 0, 1.0]])
