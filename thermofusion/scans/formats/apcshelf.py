"""Princeton shelf&tote folders (Amazon Picking Challenge 2016): RGB-D views of a robot arm, two cameras, poses.

cam.info.txt holds both intrinsics, depth-to-colour and the colour camera's poses. Depth PNGs are rotated right by 3
bits and then hold 0.1 mm; `raw/` is depth in its own camera, the others are registered to colour.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import decode_image, text_lines
from ...files.tum import poses_to_trajectory
from ...types import Float, Scan
from ..common import NO_TIMES, ImageFiles, frame_times, image_size, image_stream, make_camera, make_rig
from ..naming import in_order, real_files
from ..stated import NOTHING, Stated

UNIT_M = 1e-4  # the recorder's unit of depth, 0.1 mm
# Found by predicting registered from raw depth (tests/test_scans.py): without the extrinsic's 4.3 mm along z the two
# agree to 0.6 mm, with it to 4.1 mm.
NOT_MOVED = "registered depth was moved to colour's pixels but keeps the depth camera's z: 4.3 mm less than colour's"


def recognise(path: Path) -> bool:
    """cam.info.txt and frame-*.depth.png."""
    return (path / "cam.info.txt").is_file() and next(path.glob("frame-*.depth.png"), None) is not None


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """The scan of the raw depth camera where `raw/` is there, of registered depth otherwise."""
    return read_shelf(path, registered=not (path / "raw").is_dir(), unit_m=stated.unit_m(UNIT_M))


def read_shelf(path: Path, *, registered: bool, unit_m: float = UNIT_M) -> Scan:
    """`registered`: depth as shipped in the colour camera's pixels; else the raw depth camera with its extrinsic."""
    info = _info(path / "cam.info.txt")
    T_color_depth = np.eye(4) if registered else _entry(info, "depth-to-color", path, (4, 4))
    K_color = _entry(info, "color camera intrinsic", path, (3, 3))
    K_depth = K_color if registered else _entry(info, "depth camera intrinsic", path, (3, 3))

    depth = in_order(real_files((path if registered else path / "raw").glob("frame-*.depth.png")))
    color = in_order(real_files(path.glob("frame-*.color.png")))
    if not depth.files or not color.files:
        raise ScanError("there are no frame-NNNNNN.depth.png or .color.png", place=path)
    depth_camera = make_camera(*image_size(depth.files[0], "depth"), K_depth, place=path / "cam.info.txt")
    color_camera = make_camera(*image_size(color.files[0], "color"), K_color, place=path / "cam.info.txt")
    numbers = depth.index
    T_world_color = np.stack([_entry(info, f"frame-{n:06d}", path, (4, 4)) for n in numbers])
    return Scan(
        name=path.resolve().name,
        root=path,
        format="apc-shelf",
        rig=make_rig(depth_camera, color_camera, T_color_depth, place=path / "cam.info.txt"),
        depth=image_stream(
            ImageFiles("depth", depth.files, frame_times(numbers), path, numbers),
            depth_camera,
            unit_m=unit_m,
            decode=decode_depth,
        ),
        color=image_stream(ImageFiles("color", color.files, frame_times(color.index), path, color.index), color_camera),
        trajectory=poses_to_trajectory(frame_times(numbers), T_world_color @ T_color_depth, place=path),
        depth_unit_m=unit_m,
        times_assumed=True,
        notes=(
            NO_TIMES,
            *([NOT_MOVED] if registered else []),
        ),
    )


def decode_depth(data: bytes, place: object) -> NDArray[np.uint16]:
    """A shelf PNG's values (H, W), rotated back: numbers of 0.1 mm, 0 = none."""
    v = decode_image(data, shape=None, kind="depth", place=place)
    if v.dtype != np.uint16 or v.ndim != 2:
        raise ScanError(f"depth is {v.dtype} with {v.ndim} axes, expected 16-bit grey", place=place)
    return ((v >> 3) | (v << 13)).astype(np.uint16, copy=False)


def _info(path: Path) -> dict[str, list[list[float]]]:
    """Matrices by the comment line above them, in lower case."""
    groups: dict[str, list[list[float]]] = {}
    title = ""
    for number, line in enumerate(text_lines(path), 1):
        if line.startswith("#"):
            title = line[1:].strip().lower()
            groups[title] = []
        elif line.strip():
            try:
                groups.setdefault(title, []).append([float(w) for w in line.split()])
            except ValueError:
                raise ScanError("expected numbers only", place=f"{path}, line {number}") from None
    return groups


def _entry(info: dict[str, list[list[float]]], title: str, path: Path, shape: tuple[int, int]) -> Float:
    rows = next((rows for key, rows in info.items() if re.search(re.escape(title), key)), None)
    if rows is None or [len(r) for r in rows] != [shape[1]] * shape[0] or not np.isfinite(rows).all():
        text = f"expected a {shape[0]}x{shape[1]} matrix of finite numbers under '{title}'"
        raise ScanError(text, place=path / "cam.info.txt")
    return np.array(rows)
