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
from ...types import Camera, Scan, Stream
from ..common import NOMINAL_K, ImageFiles, Kind, image_size, image_stream, make_camera, make_rig

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


def read(path: Path) -> Scan:
    """A TUM folder as a scan. Intrinsics by the sequence's name; otherwise nominal, and noted."""
    unit_m = 1 / UNITS_PER_METRE
    times, files = _list(path, "depth.txt")
    width, height = image_size(files[0], "depth")
    sensor = next((s for s in PUBLISHED if s in path.resolve().name.lower()), None)
    if sensor is None and (width, height) != (640, 480):
        raise ScanError(
            f"the intrinsics of a {width} x {height} camera are not known", place=path, hint="put a rig.json beside it"
        )
    fx, fy, cx, cy = PUBLISHED[sensor] if sensor else (525.0, 525.0, 319.5, 239.5)
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) if sensor else NOMINAL_K
    camera = make_camera(width, height, K, place=path)
    notes = [
        "depth is registered to colour: one camera, T_color_depth = identity",
        f"published intrinsics of {sensor}, without distortion"
        if sensor
        else "nominal intrinsics (f = 525 px) assumed",
    ]
    truth = path / "groundtruth.txt"
    return Scan(
        name=path.resolve().name,
        root=path,
        format="tum",
        rig=make_rig(camera, camera, place=path),
        depth=image_stream(ImageFiles("depth", files, times, path / "depth.txt"), camera, unit_m=unit_m),
        color=_stream(path, "rgb.txt", "color", camera),
        trajectory=read_trajectory(truth) if is_named(truth) else None,
        depth_unit_m=unit_m,
        notes=tuple(notes),
    )


def _stream(path: Path, name: str, kind: Kind, camera: Camera) -> Stream:
    times, files = _list(path, name)
    return image_stream(ImageFiles(kind, files, times, path / name), camera)


def _list(root: Path, name: str) -> tuple[list[float], list[Path]]:
    """Rows `timestamp path`."""
    times, files = [], []
    for number, line in enumerate(text_lines(root / name), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        place = f"{root / name}, line {number}"
        try:
            time_s, file = float(words[0]), words[1]
        except (ValueError, IndexError):
            raise ScanError("expected `timestamp path`", place=place) from None
        times.append(time_s)
        files.append(inside(root, file, place=place))
    if not files:
        raise ScanError("no frames are listed", place=root / name)
    return times, files
