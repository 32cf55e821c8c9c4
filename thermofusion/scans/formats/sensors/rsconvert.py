"""RealSense recordings taken apart by rs-convert: NAME_Depth_<ms>.raw (or .png), NAME_Color_<ms>.png, metadata beside.

librealsense's converter writes no camera and no size: they come from a rig.json. Depth is in the device's steps, 1 mm
unless --depth-unit or the rig says otherwise.
"""

from __future__ import annotations

import re
from pathlib import Path

from ....errors import ScanError
from ....types import Scan
from ...naming import Named, in_order, real_files
from ...stated import NOTHING, Stated
from .. import images

_DEPTH = re.compile(r"_Depth_\d+(\.\d+)?\.(raw|png)$")
_COLOR = re.compile(r"_Color_\d+(\.\d+)?\.png$")


def recognise(path: Path) -> bool:
    """At least one NAME_Depth_<ms> file."""
    return path.is_dir() and any(_DEPTH.search(f.name) for f in path.glob("*_Depth_*"))


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """Such a folder as a scan. Raises ScanError."""
    depth, color = _named(path, _DEPTH), _named(path, _COLOR)
    camera = stated.camera("depth")
    if camera is None:
        raise ScanError("rs-convert writes no camera", place=path, hint="put a rig.json with cameras.depth beside it")
    size = stated.depth_size()
    layout = images.depth_layout(images.sample_depth(depth, size), stated, None)
    return images.Folder(path, "rs-convert", stated, depth, color, size).scan(camera, layout)


def _named(path: Path, pattern: re.Pattern[str]) -> Named:
    return in_order(f for f in real_files(path.iterdir()) if pattern.search(f.name))
