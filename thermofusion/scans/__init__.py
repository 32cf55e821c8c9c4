"""Recordings: one reader per format, all presenting the same `Scan`.

`FORMATS` is the table of readers; docs/adding-a-reader.md says how to add one.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

from ..errors import RecipeError, ScanError, visible
from ..files.reading import is_named
from ..types import Scan
from .naming import real_files
from .native.compose import with_rig, with_thermal
from .native.read import is_native, read_native
from .stated import NOTHING, Stated, refused, unmirrored, with_times

NAMED = 5  # recordings of a folder that a refusal names


@dataclass(frozen=True)
class Format:
    """A kind of recording.

    name : what `--format` calls it. recognise : looks at file names only, quick, never raises. read : path, and what a
    person says beside it, -> Scan; raises ScanError. what : one line for people. signs : the files it is known by.
    """

    name: str
    recognise: Callable[[Path], bool]
    read: Callable[[Path, Stated], Scan]
    what: str
    signs: str


def _late(module: str, function: str) -> Callable:
    """A function of a reader's module, imported when it is called: --help stays fast."""

    def call(*args: object) -> object:
        return getattr(import_module(module, __name__), function)(*args)

    return call


def _reader(name: str, module: str, what: str, signs: str) -> Format:
    return Format(name, _late(module, "recognise"), _late(module, "read"), what, signs)


def _native(path: Path, stated: Stated) -> Scan:
    refused(stated, {"depth_unit_m": "scan.json says it (cameras.depth.depth_unit_m)"}, path)
    return read_native(path)


# In the order of recognition: the more particular layouts first.
FORMATS: tuple[Format, ...] = (
    Format("native", is_native, _native, "thermofusion's own folder: scan.json + frames.csv + images", "scan.json"),
    _reader("recording", ".formats.recorded", "what the verb `record` wrote, whole or torn", "recording.mcap"),
    _reader("ros", ".formats.sensors.ros", "ROS 1 or 2 bag: depth, colour, thermal, cameras", "*.bag, *.db3, *.mcap"),
    _reader("azure-mkv", ".formats.azure", "Azure Kinect recording, without the vendor's library", "*.mkv"),
    _reader("realsense-bag", ".formats.realsense", "RealSense recording, through Open3D", "*.bag"),
    _reader(
        "flir",
        ".formats.thermalonly",
        "thermal frames only (FLIR, InfiRay, InfraTec, tCam), to be joined to a depth recording",
        "FLIR *.jpg or *.seq",
    ),
    _reader("record3d", ".formats.phones.record3d", "Record3D recording", "*.r3d"),
    _reader("stray", ".formats.phones.stray", "Stray Scanner folder", "odometry.csv"),
    _reader("polycam", ".formats.phones.polycam", "Polycam raw data", "keyframes/"),
    _reader("rtabmap", ".formats.rtabmap", "RTAB-Map database, or the folders of rtabmap-export", "*.db, *_calib/"),
    _reader("sens", ".formats.sensors.sens", "ScanNet / Structure Sensor stream", "*.sens"),
    _reader("bop", ".formats.bop", "BOP data set folder", "scene_camera.json"),
    _reader("icl-nuim", ".formats.iclnuim", "ICL-NUIM folder", "scene_00_0000.depth"),
    _reader("kinect2", ".formats.sensors.kinect2", "Kinect v2 depth of libfreenect2, dumped", "depth/*.bin"),
    _reader("rs-convert", ".formats.sensors.rsconvert", "RealSense frames of rs-convert", "*_Depth_*.raw"),
    _reader("fakenect", ".formats.fakenect", "Kinect v1 recording of libfreenect's fakenect-record", "INDEX.txt"),
    _reader("tum", ".formats.tum", "TUM RGB-D benchmark folder (groundtruth.txt: poses)", "rgb.txt and depth.txt"),
    _reader("apc-shelf", ".formats.apcshelf", "Princeton shelf&tote folder (bit-rotated depth)", "cam.info.txt"),
    _reader("7-scenes", ".formats.sevenscenes", "7-Scenes / 3DMatch folder", "frame-000000.depth.png"),
    _reader("jhu", ".formats.jhu", "laboratory layout of the paper: depth and thermal counts", "*.pgm and *_0000.raw"),
    _reader("redwood", ".formats.redwood", "plain, Redwood, Open3D or SUN3D folder", "color/ and depth/"),
)


def open_scan(
    path: str | Path, *, format: str | None = None, stated: Stated = NOTHING, times: Path | None = None
) -> Scan:
    """Open a recording of any known format (recognised by its files, or named by `format`).

    A `rig.json` beside the recording's files, or the one that was `stated`, replaces the cameras and extrinsics that a
    foreign format cannot carry or that its reader had to assume. times : a list of the depth frames' times, s, for a
    recording without. What was assumed stands in `Scan.notes`.

    Raises ScanError: no such path, no format recognises it, or the recording is faulty; RecipeError: unknown format.
    """
    root = Path(path)
    try:
        there = root.exists()
    except (OSError, ValueError):
        there = False
    if not there:
        raise ScanError("there is no such scan", place=root)
    try:
        known = find_format(format) if format else next((f for f in FORMATS if f.recognise(root)), None)
    except OSError as e:
        raise ScanError(f"it cannot be read ({e.strerror})", place=e.filename or root) from None
    if known is None:
        inside = _only_one_inside(root)
        scan = open_scan(inside, stated=stated, times=times)
        return replace(scan, notes=(*scan.notes, f"read from {visible(inside.name)}, the only recording in the folder"))
    beside = (root if root.is_dir() else root.parent) / "rig.json"
    if stated.rig is None and known.name != "native" and is_named(beside):
        stated = stated.with_rig(beside)
    try:
        scan = known.read(root, stated)
    except OSError as e:
        raise ScanError(f"it cannot be read as {known.name} ({e.strerror})", place=e.filename or root) from None
    scan = replace(scan, name=visible(scan.name))  # it goes into every file of a result and onto the terminal
    if stated.rig_path is not None:
        scan = with_rig(scan, stated.rig_path)
    if times is not None:
        scan = with_times(scan, times)
    return unmirrored(scan) if stated.mirrored else scan


def _only_one_inside(root: Path) -> Path:
    """The one recording that lies in a folder which is none itself. Raises ScanError: there is none, or are several."""
    try:
        beside = sorted(root.iterdir()) if root.is_dir() else []
        beside = real_files(beside) + [p for p in beside if p.is_dir() and not p.name.startswith(".")]
        found = [p for p in beside if any(f.recognise(p) for f in FORMATS if f.name != "flir")]
    except OSError as e:
        raise ScanError(f"it cannot be read ({e.strerror})", place=e.filename or root) from None
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(visible(p.name) for p in found[:NAMED])
        raise ScanError(f"there are {len(found)} recordings here", place=root, hint=f"name one of them: {names}")
    raise ScanError(
        "no known recording format was recognised here",
        place=root,
        hint=f"looked for {', '.join(f'{f.signs} ({f.name})' for f in FORMATS)}; name one with --format",
    )


def find_format(name: str) -> Format:
    """The format of that name; RecipeError (usage) with the nearest match for an unknown one."""
    names = [f.name for f in FORMATS]
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
        hint = f"did you mean '{near[0]}'?" if near else None
        raise RecipeError(f"there is no format '{name}', known are {', '.join(names)}", hint=hint)
    return FORMATS[names.index(name)]


__all__ = ["FORMATS", "Format", "Stated", "find_format", "open_scan", "with_rig", "with_thermal"]
