"""TUM RGB-D benchmark folders: rgb.txt, depth.txt, groundtruth.txt; depth 5000 per metre, registered to colour.

Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats (the depth images are pre-registered to the
colour camera, pixel for pixel; poses are those of the colour camera).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import ScanError
from ...files.reading import inside, is_named, text_lines
from ...files.tum import read_trajectory
from ...types import Scan
from ..common import NOMINAL_K, ImageFiles, image_size, image_stream, make_camera, make_rig
from ..naming import Named
from ..stated import NOTHING, Stated
from . import images

UNITS_PER_METRE = 5000  # of the benchmark's depth images
# fx fy cx cy of the benchmark's three sensors, as its authors published them.
PUBLISHED = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}


def recognise(path: Path) -> bool:
    """rgb.txt and depth.txt are there."""
    return (path / "depth.txt").is_file() and (path / "rgb.txt").is_file()


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """A TUM folder as a scan. Intrinsics by the rig, by the sequence's name, or nominal, and noted."""
    unit_m = stated.unit_m(1 / UNITS_PER_METRE)
    depth, color = _list(path, "depth.txt"), _list(path, "rgb.txt")
    width, height = image_size(depth.files[0], "depth")
    sensor = next((s for s in PUBLISHED if s in path.resolve().name.lower()), None)
    camera, notes = stated.camera("depth"), []
    if camera is None and sensor is not None:
        fx, fy, cx, cy = PUBLISHED[sensor]
        camera = make_camera(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), place=path)
        notes.append(f"published intrinsics of {sensor}, without distortion")
    elif camera is None:
        if (width, height) != (640, 480):
            text = f"the intrinsics of a {width} x {height} camera are not known"
            raise ScanError(text, place=path, hint="put a rig.json with cameras.depth beside it")
        camera = make_camera(width, height, NOMINAL_K, place=path)
        notes.append("nominal intrinsics (f = 525 px) assumed")
    if not stated.names_unit:
        notes.append("depth is taken as 5000 steps a metre, as the benchmark's")
    color_camera, more = images.color_camera(color, camera, stated)
    truth = path / "groundtruth.txt"
    return Scan(
        name=path.resolve().name,
        root=path,
        format="tum",
        rig=make_rig(camera, color_camera, place=path),
        depth=images.depth_stream(depth, camera, images.DepthLayout(unit_m)),
        color=None
        if color_camera is None
        else image_stream(ImageFiles("color", color.files, color.stamps, path / "rgb.txt"), color_camera),
        trajectory=read_trajectory(truth) if is_named(truth) else None,
        depth_unit_m=unit_m,
        notes=(*notes, *more),
    )


def _list(root: Path, name: str) -> Named:
    """Rows `timestamp path`, in the order of their times; Windows' separators are understood."""
    rows = []
    for number, line in enumerate(text_lines(root / name), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        place = f"{root / name}, line {number}"
        try:
            time_s, file = float(words[0]), words[1].replace("\\", "/")
        except (ValueError, IndexError):
            raise ScanError("expected `timestamp path`", place=place) from None
        rows.append((time_s, inside(root, file, place=place)))
    if not rows:
        raise ScanError("no frames are listed", place=root / name)
    rows.sort(key=lambda r: r[0])
    return Named(tuple(f for _, f in rows), tuple(range(len(rows))), np.array([t for t, _ in rows]))
