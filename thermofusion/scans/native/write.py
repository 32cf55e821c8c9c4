"""Any scan written in the native form, whole or not at all; and excerpts of scans."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import ResourceError, ScanError
from ...files.reading import PNG_MAGIC, decode_image, read_bytes
from ...files.tum import write_trajectory
from ...files.whole import replacing_folder
from ...progress import Progress, silent
from ...types import (
    BlackbodyReference,
    Camera,
    Float,
    LensScatter,
    Material,
    Reference,
    Scan,
    Stream,
    ThermalCamera,
    ThermalStream,
    Trajectory,
)
from ..common import Kind, as_loaded
from .schema import SCHEMA, STREAMS

S = TypeVar("S", bound=Stream)
Selection = slice | Sequence[int] | NDArray

_BYTES_PER_PIXEL = {"depth": 2.0, "color": 3.0, "thermal": 4.0}  # before compression: the disk-space estimate is high


# ---------------------------------------------------------------- writing


def write_scan(scan: Scan, out: str | Path, overwrite: bool = False, progress: Progress = silent) -> Path:
    """Write `scan` as a native folder `out`; returns its path.

    Images that already lie in files with the right content are copied byte for byte, others become PNG (float thermal:
    TIFF). Everything is written to a temporary folder beside `out`, then renamed: a failure leaves nothing behind.

    progress : called with (stream, frames written, frames in all). Raises ScanError where `out` exists (unless
    `overwrite` and it is a scan folder) or a frame cannot be read; ResourceError if the disk has no room.
    """
    out = Path(out)
    _check_target(scan, out, overwrite)
    _check_room(scan, out.parent)
    with replacing_folder(out) as folder:
        rows = [row for kind in STREAMS for row in _write_stream(scan, kind, folder, progress)]
        rows.sort(key=lambda row: (float(row[2]), row[0]))
        (folder / "frames.csv").write_text(_csv(rows, tuple(_measured(scan.thermal))), encoding="utf-8")
        (folder / "scan.json").write_text(json.dumps(scan_json(scan), indent=1) + "\n", encoding="utf-8")
        if scan.trajectory is not None:
            write_trajectory(folder / "trajectory.txt", scan.trajectory, exact=True)
    return out


def scan_json(scan: Scan) -> dict[str, Any]:
    """The content of scan.json for a scan."""
    rig = scan.rig
    cameras: dict[str, Any] = {
        "depth": {**_camera(rig.depth), "depth_unit_m": scan.depth_unit_m, "up": list(scan.depth_up)}
    }
    extrinsics: dict[str, Any] = {}
    if rig.color is not None and rig.T_color_depth is not None:
        cameras["color"] = _camera(rig.color)
        extrinsics["T_color_depth"] = rig.T_color_depth.tolist()
    if scan.thermal is not None:
        cameras["thermal"] = {**_camera(scan.thermal.camera.lens), **_radiometry(scan.thermal.camera)}
        if scan.thermal.camera.mount == "rig":
            extrinsics["T_thermal_depth"] = scan.thermal.camera.T_thermal_depth.tolist()
    environment = {k: v for k, v in vars(scan.environment).items() if v is not None}
    return {
        "schema": SCHEMA,
        "name": scan.name,
        **({"recorded_at": scan.recorded_at} if scan.recorded_at else {}),
        "cameras": cameras,
        "extrinsics": extrinsics,
        "environment": environment,
        "references": [_reference(r) for r in scan.references],
        **({"materials": [_material(m) for m in scan.materials]} if scan.materials else {}),
        "subject": scan.subject,
        **({"notes": list(scan.notes)} if scan.notes else {}),
        **({"times_assumed": True} if scan.times_assumed else {}),
    }


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "K": camera.K.tolist(),
        "distortion": camera.distortion.tolist(),
    }


def _radiometry(camera: ThermalCamera) -> dict[str, Any]:
    curve = camera.signal
    signal: dict[str, Any] = {"kind": curve.kind}
    if curve.kind == "counts":
        lists = ("coefficients_degC", "counts", "degC")
        values = {k: list(v) if k in lists else v[0] for k, v in curve.parameters.items()}
        signal["curve"] = {"type": curve.curve, **values}
    return {
        "signal": signal,
        "band_um": list(camera.band_um),
        "netd_K": camera.netd_K,
        "time_offset_s": camera.time_offset_s,
        **({} if camera.psf_sigma_px is None else {"psf_sigma_px": camera.psf_sigma_px}),
        **({} if camera.mount == "rig" else {"mount": camera.mount}),
        **({} if camera.scatter is None else {"scatter": scatter_document(camera.scatter)}),
    }


def scatter_document(scatter: LensScatter) -> dict[str, Any]:
    """`scatter` of a thermal camera."""
    return {"parts": [{"share": g, "width": w} for g, w in scatter.parts], "sigma": scatter.sigma}


def _reference(r: Reference) -> dict[str, Any]:
    common = {"kind": r.kind, "degC": r.degC, "uncertainty_K": r.uncertainty_K}
    if isinstance(r, BlackbodyReference):
        polygon = r.polygon_px.tolist()
        return {**common, "emissivity": r.emissivity, "thermal_polygon_px": polygon, "frames": list(r.frames)}
    return {**common, "p_world_m": r.p_world_m.tolist()}


def _material(m: Material) -> dict[str, Any]:
    polygons = [{"frame": frame, "thermal_polygon_px": corners.tolist()} for frame, corners in m.polygons_px]
    return {
        "name": m.name,
        **({} if m.emissivity is None else {"emissivity": m.emissivity}),
        **({} if m.sigma_emissivity0 is None else {"sigma_emissivity0": m.sigma_emissivity0}),
        **{key: True for key in ("not_skin", "counts_as_skin") if getattr(m, key)},
        **({"polygons": polygons} if polygons else {}),
        **({"vertices": m.vertices.tolist()} if len(m.vertices) else {}),
        **({"of_vertices": m.of_vertices} if m.of_vertices else {}),
    }


def _write_stream(scan: Scan, kind: Kind, folder: Path, progress: Progress) -> list[list[str]]:
    stream: Stream | None = getattr(scan, kind)
    if stream is None:
        return []
    (folder / kind).mkdir()
    rows, measured = [], _measured(stream)
    for i in range(len(stream)):
        image = stream.load(i)
        data, suffix = _original(kind, stream.places[i], image, scan.depth_unit_m) or _encode(kind, image, scan, i)
        name = f"{kind}/{int(stream.index[i]):06d}.{suffix}"
        (folder / name).write_bytes(data)
        shutter = "" if stream.usable[i] else "1"
        beside = [_cell(column[i]) for column in measured.values()]
        rows.append([kind, str(int(stream.index[i])), repr(float(stream.times_s[i])), name, shutter, *beside])
        progress(kind, i + 1, len(stream))
    return rows


def _measured(stream: Stream | None) -> dict[str, Float]:
    """What was measured beside each of a stream's frames, by column of frames.csv."""
    conditions = stream.conditions if isinstance(stream, ThermalStream) else None
    return {} if conditions is None else conditions.stated


def _cell(value: float) -> str:
    return "" if np.isnan(value) else repr(float(value))


def _original(kind: Kind, place: str, image: NDArray, unit_m: float) -> tuple[bytes, str] | None:
    """The bytes of the frame's own file, if a plain decode of them gives `image`; colour keeps its JPEG so."""
    path = Path(place)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif", ".tiff") or not path.is_file():
        return None
    data = read_bytes(path, kind)
    suffix = {PNG_MAGIC[:4]: "png", b"II*\0": "tiff", b"MM\0*": "tiff"}.get(data[:4])
    suffix = "jpg" if data[:2] == b"\xff\xd8" else suffix
    if suffix is None:
        return None
    try:
        again = as_loaded(kind, decode_image(data, shape=image.shape[:2], kind=kind, place=path), path, unit_m)
    except ScanError:
        return None
    same = again.dtype == image.dtype and np.array_equal(again, image, equal_nan=image.dtype.kind == "f")
    return (data, suffix) if same else None


def _encode(kind: Kind, image: NDArray, scan: Scan, i: int) -> tuple[bytes, str]:
    suffix = "png"
    if kind == "depth":
        raw = np.rint(np.nan_to_num(image, nan=0.0).astype(np.float64) / scan.depth_unit_m)
        if raw.min() < 0 or raw.max() > 65535:
            raise ScanError("depth does not fit 16 bits in the scan's depth unit", place=scan.depth.places[i])
        pixels = raw.astype(np.uint16)
    elif kind == "color":
        pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    else:
        pixels, suffix = image, "tiff" if image.dtype == np.float32 else "png"
    ok, buffer = cv2.imencode(f".{suffix}", pixels)
    if not ok:
        raise ResourceError(f"the {kind} image {i} cannot be encoded")
    return buffer.tobytes(), suffix


def _csv(rows: list[list[str]], measured: tuple[str, ...]) -> str:
    """frames.csv; measured : columns that thermal rows alone fill."""
    text, head = io.StringIO(), ("stream", "index", "time_s", "path", "shutter", *measured)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([*row, *[""] * (len(head) - len(row))] for row in rows)
    return text.getvalue()


def _check_target(scan: Scan, out: Path, overwrite: bool) -> None:
    if not out.exists():
        return
    if out.resolve() == scan.root.resolve() or scan.root.resolve().is_relative_to(out.resolve()):
        raise ScanError("a scan cannot be written over itself", place=out, hint="choose another folder")
    if not overwrite:
        raise ScanError("it exists already", place=out, hint="choose another folder, or give --overwrite")
    if not out.is_dir() or (any(out.iterdir()) and not (out / "scan.json").is_file()):
        raise ScanError("it exists and is no scan folder, so it is not overwritten", place=out)


def _check_room(scan: Scan, folder: Path) -> None:
    needed = 1 << 20
    lens = None if scan.thermal is None else scan.thermal.camera.lens
    for kind, camera in (("depth", scan.rig.depth), ("color", scan.rig.color), ("thermal", lens)):
        stream: Stream | None = getattr(scan, kind)
        if stream is not None and camera is not None:
            needed += int(len(stream) * camera.width_px * camera.height_px * _BYTES_PER_PIXEL[kind])
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise ResourceError(
            f"the scan may need {needed / 2**30:.1f} GiB and the disk has {free / 2**30:.1f} GiB", place=folder
        )


# ---------------------------------------------------------------- excerpts


def excerpt(
    scan: Scan,
    depth: Selection | None = None,
    color: Selection | None = None,
    thermal: Selection | None = None,
) -> Scan:
    """A part of a scan: frames by position in their streams (a slice or indices; sorted, each once).

    Where `color` or `thermal` is not given, the frames within the kept depth frames' span of time stay (half a depth
    step more at both ends; thermal on the depth clock). The trajectory is cut to the same span with one more pose at
    either end; a blackbody reference keeps the frames that are left, and goes when there are none.

    Raises ScanError if no depth frame is left.
    """
    kept = _positions(depth, len(scan.depth))
    if len(kept) == 0:
        raise ScanError("the excerpt has no depth frame", place=scan.root)
    t = scan.depth.times_s
    slack = 0.5 * float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    span = (t[kept[0]] - slack, t[kept[-1]] + slack)
    thermal_stream: ThermalStream | None = None
    if scan.thermal is not None:
        thermal_stream = _cut(scan.thermal, thermal, span, scan.thermal.camera.time_offset_s)
    return replace(
        scan,
        depth=_take(scan.depth, kept),
        color=_cut(scan.color, color, span, 0.0),
        thermal=thermal_stream,
        trajectory=_cut_trajectory(scan.trajectory, span),
        references=_cut_references(scan.references, thermal_stream),
    )


def _positions(selection: Selection | None, n: int) -> NDArray[np.int64]:
    everything = np.arange(n)
    if selection is None:
        return everything
    if isinstance(selection, slice):
        return everything[selection]
    picked = np.asarray(selection)
    return np.unique(everything[picked]) if picked.size else everything[:0]


def _take(stream: S, kept: NDArray[np.int64]) -> S:
    positions = kept.tolist()
    beside = {}
    if isinstance(stream, ThermalStream) and stream.conditions is not None:
        beside["conditions"] = stream.conditions.take(kept)
    return replace(
        stream,
        times_s=stream.times_s[kept],
        load=lambda i: stream.load(positions[i]),
        places=tuple(stream.places[k] for k in positions),
        index=stream.index[kept],
        usable=stream.usable[kept],
        **beside,
    )


def _cut(stream: S | None, selection: Selection | None, span: tuple[float, float], offset_s: float) -> S | None:
    if stream is None:
        return None
    if selection is None:
        t = stream.times_s + offset_s
        kept = np.flatnonzero((t >= span[0]) & (t <= span[1]))
    else:
        kept = _positions(selection, len(stream))
    return _take(stream, kept) if len(kept) else None


def _cut_trajectory(trajectory: Trajectory | None, span: tuple[float, float]) -> Trajectory | None:
    if trajectory is None:
        return None
    t = trajectory.times_s
    first = max(int(np.searchsorted(t, span[0])) - 1, 0)
    last = int(np.searchsorted(t, span[1], side="right")) + 1
    return Trajectory(t[first:last], trajectory.T_world_depth[first:last])


def _cut_references(references: tuple[Reference, ...], thermal: Stream | None) -> tuple[Reference, ...]:
    left = set() if thermal is None else set(thermal.index.tolist())
    kept: list[Reference] = []
    for r in references:
        if isinstance(r, BlackbodyReference):
            frames = tuple(f for f in r.frames if f in left)
            if frames:
                kept.append(replace(r, frames=frames))
        else:
            kept.append(r)
    return tuple(kept)
