"""The native scan folder: scan.json + frames.csv + images (docs/scan-format.md)."""

from __future__ import annotations

import math
import os
import stat
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...errors import ScanError
from ...files.reading import COPY_AGAIN, MAX_NAME, inside, is_named, read_json
from ...files.strict import validated
from ...files.table import table_rows
from ...files.tum import read_trajectory
from ...types import Camera, Environment, FrameConditions, Scan, Stream
from ..common import ImageFiles, as_thermal, image_stream
from .schema import (
    CONDITIONS,
    SCHEMA,
    STREAMS,
    ScanDoc,
    material_of,
    reference_of,
    rig_of,
    thermal_camera_of,
    unknown_keys,
)

__all__ = ["SCHEMA", "STREAMS", "is_native", "read_native"]

COLUMNS = ("stream", "index", "time_s", "path")  # of frames.csv; `shutter` and `CONDITIONS` are optional


def is_native(root: Path) -> bool:
    """A scan.json or a frames.csv is there: without the other one it is a torn scan, not a foreign one."""
    return is_named(root / "scan.json") or is_named(root / "frames.csv")


def read_native(root: Path) -> Scan:
    """Open a native scan folder. Images are decoded when asked for; everything else is checked here.

    Raises ScanError with the file, the key and what was expected.
    """
    path = root / "scan.json"
    if not is_named(path):
        raise ScanError("there is no scan.json here", place=root, hint="give a scan folder")
    doc = validated(ScanDoc, read_json(path), path)
    rig, group = rig_of(doc.cameras, doc.extrinsics, path), doc.cameras.thermal
    camera = None if group is None else thermal_camera_of(group, doc.extrinsics, path)
    unit_m = doc.cameras.depth.depth_unit_m
    cameras = {"depth": rig.depth, "color": rig.color, "thermal": None if camera is None else camera.lens}
    streams, conditions = _read_frames(root, cameras, unit_m)
    if "depth" not in streams:
        raise ScanError("no depth frames are listed", place=root / "frames.csv")
    unknown = unknown_keys(doc)
    notes = (f"scan.json keys not used here: {', '.join(unknown)}",) if unknown else ()
    trajectory_file = root / "trajectory.txt"
    return Scan(
        name=doc.name,
        root=root,
        format="native",
        rig=rig,
        depth=streams["depth"],
        color=streams.get("color"),
        thermal=None
        if camera is None or "thermal" not in streams
        else as_thermal(streams["thermal"], camera, conditions),
        environment=Environment(**{k: getattr(doc.environment, k) for k in Environment.__dataclass_fields__}),
        references=tuple(
            reference_of(r, f"references.{i}", cameras["thermal"], path) for i, r in enumerate(doc.references)
        ),
        materials=tuple(
            material_of(m, f"materials.{i}", cameras["thermal"], path) for i, m in enumerate(doc.materials)
        ),
        trajectory=read_trajectory(trajectory_file) if is_named(trajectory_file) else None,
        depth_unit_m=unit_m,
        depth_up=doc.cameras.depth.up,
        recorded_at=doc.recorded_at,
        subject=doc.subject,
        notes=(*doc.notes, *notes),
        times_assumed=doc.times_assumed,
    )


@dataclass
class _Frames:
    """One stream's rows of frames.csv, as columns: a row costs little."""

    index: array[int] = field(default_factory=lambda: array("q"))
    times_s: array[float] = field(default_factory=lambda: array("d"))
    files: list[str] = field(default_factory=list)
    usable: bytearray = field(default_factory=bytearray)
    conditions: dict[str, array[float]] = field(default_factory=lambda: {name: array("d") for name in CONDITIONS})


def _read_frames(
    root: Path, cameras: Mapping[str, Camera | None], unit_m: float
) -> tuple[dict[str, Stream], FrameConditions | None]:
    """The streams by kind, and what was measured beside the thermal frames."""
    path = root / "frames.csv"
    if not is_named(path):
        raise ScanError("there is no frames.csv here", place=root)
    found: dict[str, _Frames] = {}
    files = _Files(root)
    for number, row in table_rows(path, "frames.csv", COLUMNS):
        try:
            kind, index, time_s, file, usable = _row(row, files)
            measured = _measured(row) if kind == "thermal" else {}
        except ScanError as e:
            raise ScanError(e.cause, place=e.place or f"{path}, line {number}", hint=e.hint) from None
        frames = found.setdefault(kind, _Frames())
        frames.index.append(index)
        frames.times_s.append(time_s)
        frames.files.append(file)
        frames.usable.append(usable)
        for name, value in measured.items():
            frames.conditions[name].append(value)

    streams: dict[str, Stream] = {}
    for kind in STREAMS:
        camera, own = cameras[kind], found.get(kind)
        if own is None:
            continue
        if camera is None:
            raise ScanError(f"{kind} frames are listed, but scan.json has no 'cameras.{kind}'", place=path)
        numbers, flags = np.array(own.index, np.int64), np.frombuffer(own.usable, np.bool_)
        if len(np.unique(numbers)) < len(numbers):
            raise ScanError(f"an index of the {kind} stream stands twice", place=path)
        images = ImageFiles(kind, own.files, np.array(own.times_s), path, numbers, flags)
        streams[kind] = image_stream(images, camera, unit_m=unit_m)
    thermal = found.get("thermal", _Frames())
    columns = {name: np.array(column) for name, column in thermal.conditions.items() if column}
    return streams, FrameConditions.of(len(thermal.index), columns)


def _row(row: Mapping[str, str], files: _Files) -> tuple[str, int, float, str, bool]:
    """Stream, index, time [s], file, usable. Raises ScanError, without a place where the row itself is wrong."""
    stream = row["stream"]
    if stream not in STREAMS:
        raise ScanError(f"stream '{stream[:40]}' is none of {', '.join(STREAMS)}")
    try:
        index, time_s = int(row["index"]), float(row["time_s"])
    except ValueError:
        raise ScanError("index must be a whole number and time_s a number") from None
    if not 0 <= index < 2**31:
        raise ScanError(f"index {row['index'][:40]} is not within 0 and 2^31")
    if not math.isfinite(time_s):
        raise ScanError("time_s is not finite")
    if not row["path"]:
        raise ScanError("the path is empty")
    usable = row.get("shutter", "").lower() in ("", "0", "false", "no")
    return stream, index, time_s, files.find(row["path"], stream), usable


def _measured(row: Mapping[str, str]) -> dict[str, float]:
    """What a row states of its frame, by column; NaN where the cell is empty. Raises ScanError."""
    out = {}
    for name, (low, high) in CONDITIONS.items():
        if name not in row:
            continue
        try:
            value = float(row[name] or "nan")
        except ValueError:
            raise ScanError(f"{name} must be a number or empty, got {row[name][:40]!r}") from None
        if not (math.isnan(value) or low <= value <= high):
            raise ScanError(f"{name} is {row[name][:40]}, expected {low:g} to {high:g}")
        out[name] = value
    return out


class _Files:
    """The files that a table names: inside the scan's folder, there, regular; each folder is resolved once."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._known: dict[str, str] = {}
        self._folders: dict[str, str] = {}

    def find(self, name: str, kind: str) -> str:
        """The file's path. Raises ScanError, with a place only where the row is right and the file is not."""
        if name not in self._known:
            self._known[name] = self._found(name, kind)
        return self._known[name]

    def _found(self, name: str, kind: str) -> str:
        head, _, tail = name.rpartition("/")
        path = name
        try:
            if os.sep == "/" and name[0] != "/" and len(name) <= MAX_NAME:
                if head not in self._folders:
                    self._folders[head] = str(inside(self._root, head, place=None))
                path = f"{self._folders[head]}/{tail}"
                if stat.S_ISREG(os.lstat(path).st_mode):
                    return path
            path = str(inside(self._root, name, place=None))  # a link, or `..`: resolved as a whole
            if not stat.S_ISREG(Path(path).stat().st_mode):
                raise ScanError(f"the {kind} file is named in frames.csv but no regular file", place=path)
        except FileNotFoundError:
            text = f"the {kind} file is named in frames.csv but absent"
            raise ScanError(text, place=path, hint=COPY_AGAIN) from None
        except OSError as e:
            raise ScanError(f"the {kind} file cannot be read ({e.strerror})", place=path) from None
        except ValueError as e:
            raise ScanError(f"the path {name[:80]!r} is not usable ({type(e).__name__})") from None
        return path
