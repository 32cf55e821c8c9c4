"""Kinect v2 frames as libfreenect2 hands them out, dumped: depth/*.bin, 512 x 424 float32 mm, mirrored, no header.

libfreenect2 delivers depth, infrared and registered colour left to right as in a mirror (its issue 172): they are
turned round here. `ir_params.txt` holds the depth camera's fx, fy, cx, cy for the images as they stand.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ....files.reading import read_text
from ....types import Camera, Scan
from ...common import make_camera
from ...naming import images_in, in_order
from ...stated import NOTHING, Stated, unmirrored
from .. import images

SIZE = (512, 424)  # (width, height) px
NOMINAL = {"fx": 365.5, "fy": 365.5, "cx": 511 - 254.9, "cy": 205.4}  # of devices in the field, mirrored
COLOR_NAMES = ("registered", "color", "rgb")


def recognise(path: Path) -> bool:
    """depth/*.bin of that many bytes."""
    first = next(iter(images_in(path / "depth", (".bin",))), None)
    return first is not None and first.stat().st_size == 4 * SIZE[0] * SIZE[1]


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a folder as a scan, turned round. Raises ScanError."""
    depth = in_order(images_in(path / "depth", (".bin",)))
    samples = images.sample_depth(depth, SIZE)
    layout = images.depth_layout(samples, stated, None)
    own, notes = _camera(path)
    camera = stated.camera("depth") or own
    color = in_order(next((f for n in COLOR_NAMES if (f := images_in(path / n, images.COLOR_SUFFIXES))), []))
    scan = images.Folder(path, "kinect2", stated, depth, color, SIZE).scan(camera, layout, notes=notes)
    return scan if stated.mirrored else unmirrored(scan)


def _camera(path: Path) -> tuple[Camera, list[str]]:
    file = path / "ir_params.txt"
    values, notes = dict(NOMINAL), ["nominal Kinect v2 intrinsics assumed: a rig.json replaces them"]
    if file.is_file():
        found = {k: float(v) for k, v in re.findall(r"\b(f[xy]|c[xy])\b\W+([-+\d.eE]+)", read_text(file))}
        if found.keys() >= values.keys():
            values, notes = found, []
    K = np.array([[values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1]])
    return make_camera(*SIZE, K, place=file), notes
