"""The native scan folder: scan.json + frames.csv + images (docs/scan-format.md)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ...errors import ScanError
from ...files.reading import COPY_AGAIN, inside, read_json, read_text
from ...files.strict import validated
from ...files.tum import read_trajectory
from ...types import Camera, Environment, Scan, Stream
from ..common import ImageFiles, as_thermal, image_stream
from .schema import SCHEMA, STREAMS, ScanDoc, reference_of, rig_of, thermal_camera_of, unknown_keys

__all__ = ["SCHEMA", "STREAMS", "is_native", "read_native"]

COLUMNS = ("stream", "index", "time_s", "path")  # of frames.csv; `shutter` and `fpa_degC` are optional


def is_native(root: Path) -> bool:
    """A scan.json or a frames.csv is there: without the other one it is a torn scan, not a foreign one."""
    return (root / "scan.json").is_file() or (root / "frames.csv").is_file()


def read_native(root: Path) -> Scan:
    """Open a native scan folder. Images are decoded when asked for; everything else is checked here.

    Raises ScanError with the file, the key and what was expected.
    """
    path = root / "scan.json"
    if not path.exists():
        raise ScanError("there is no scan.json here", place=root, hint="give a scan folder")
    doc = validated(ScanDoc, read_json(path), path)
    rig, group = rig_of(doc.cameras, doc.extrinsics, path), doc.cameras.thermal
    camera = None if group is None else thermal_camera_of(group, doc.extrinsics, path)
    unit_m = doc.cameras.depth.depth_unit_m
    cameras = {"depth": rig.depth, "color": rig.color, "thermal": None if camera is None else camera.lens}
    streams = _read_frames(root, cameras, unit_m)
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
        thermal=as_thermal(streams["thermal"], camera) if camera is not None and "thermal" in streams else None,
        environment=Environment(**{k: getattr(doc.environment, k) for k in Environment.__dataclass_fields__}),
        references=tuple(reference_of(r) for r in doc.references),
        trajectory=read_trajectory(trajectory_file) if trajectory_file.exists() else None,
        depth_unit_m=unit_m,
        depth_up=doc.cameras.depth.up,
        recorded_at=doc.recorded_at,
        subject=doc.subject,
        notes=(*doc.notes, *notes),
    )


@dataclass(frozen=True)
class _Row:
    stream: str
    index: int
    time_s: float
    file: Path
    usable: bool


def _read_frames(root: Path, cameras: Mapping[str, Camera | None], unit_m: float) -> dict[str, Stream]:
    path = root / "frames.csv"
    if not path.exists():
        raise ScanError("there is no frames.csv here", place=root)
    try:
        reader = csv.DictReader(io.StringIO(read_text(path, "frames.csv"), newline=""))
        missing = set(COLUMNS) - set(reader.fieldnames or ())
        table = list(reader)
    except csv.Error as e:
        raise ScanError(f"it cannot be read as CSV ({e})", place=path) from None
    if missing:
        raise ScanError(f"column(s) {', '.join(sorted(missing))} are missing", place=path)

    rows = [_row(root, row, f"{path}, line {number}") for number, row in enumerate(table, 2)]
    streams: dict[str, Stream] = {}
    for kind in STREAMS:
        camera = cameras[kind]
        own = [r for r in rows if r.stream == kind]
        if not own:
            continue
        if camera is None:
            raise ScanError(f"{kind} frames are listed, but scan.json has no 'cameras.{kind}'", place=path)
        _check_files(own, path)
        files = ImageFiles(
            kind,
            [r.file for r in own],
            [r.time_s for r in own],
            path,
            [r.index for r in own],
            [r.usable for r in own],
        )
        streams[kind] = image_stream(files, camera, unit_m=unit_m)
    return streams


def _row(root: Path, row: dict[str, str], place: str) -> _Row:
    stream = (row["stream"] or "").strip()
    if stream not in STREAMS:
        raise ScanError(f"stream '{stream[:40]}' is none of {', '.join(STREAMS)}", place=place)
    try:
        index, time_s = int(row["index"]), float(row["time_s"])
    except (TypeError, ValueError):
        raise ScanError("index must be a whole number and time_s a number", place=place) from None
    if not 0 <= index < 2**31:
        raise ScanError(f"index {index} is not within 0 and 2^31", place=place)
    if not math.isfinite(time_s):
        raise ScanError("time_s is not finite", place=place)
    name = (row["path"] or "").strip()
    if not name:
        raise ScanError("the path is empty", place=place)
    shutter = (row.get("shutter") or "").strip().lower() not in ("", "0", "false", "no")
    return _Row(stream, index, time_s, inside(root, name, place=place), not shutter)


def _check_files(rows: list[_Row], path: Path) -> None:
    """Every file named once, there, and a regular one; every index once."""
    if len({r.index for r in rows}) < len(rows):
        raise ScanError(f"an index of the {rows[0].stream} stream stands twice", place=path)
    for r in rows:
        try:
            regular = r.file.is_file()
        except OSError:
            regular = False
        if not regular:
            what = "no regular file" if r.file.exists() else "absent"
            raise ScanError(f"the {r.stream} file is named in frames.csv but {what}", place=r.file, hint=COPY_AGAIN)
