"""Putting together what was recorded apart: a calibrated rig, and thermal frames from a camera of their own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import read_json
from ...files.strict import validated
from ...types import Camera, Rig, Scan, SignalCurve, ThermalSensor
from ..common import make_rig, make_stream
from .schema import DepthCorrectionDoc, RigDoc, RigThermalDoc, camera_of, matrix_of, sensor_of

CORRECTED_UNIT_M = 0.00025  # rounding to a millimetre would undo a correction of that size; 16 bits reach 16 m


@dataclass(frozen=True, eq=False)
class ThermalFrames:
    """A recording of a thermal camera alone.

    images : (N, H, W) as stored (uint16 counts or float32). times_s : (N,) the camera's own clock, NaN = not stated.
    places : where each came from. signal : how a count becomes an apparent blackbody temperature.
    degC : (N, H, W) float32, the temperature by the file's own emissivity, distance and room; for comparison only.
    notes : what had to be assumed.
    """

    images: NDArray
    times_s: NDArray[np.float64]
    places: tuple[str, ...]
    signal: SignalCurve
    degC: NDArray[np.float32] | None = None
    notes: tuple[str, ...] = ()


def with_rig(scan: Scan, path: str | Path) -> Scan:
    """`scan` with the cameras and extrinsics of a rig.json (the `cameras` and `extrinsics` groups of a scan.json).

    Its depth correction is applied to every depth image: give a rig to a recording once, on import. What the file does
    not name stays. Raises ScanError if the file is faulty or a camera's size is not its images'.
    """
    path = Path(path)
    doc = validated(RigDoc, read_json(path), path)
    parts: dict[str, Camera | NDArray | None] = {
        k: getattr(scan.rig, k) for k in ("depth", "color", "thermal", "T_color_depth", "T_thermal_depth")
    }
    for name in ("depth", "color", "thermal"):
        group = getattr(doc.cameras, name)
        if group is None:
            continue
        camera, old = camera_of(group, f"cameras.{name}", path), getattr(scan.rig, name)
        if old is not None and camera.shape != old.shape:
            raise ScanError(
                f"key 'cameras.{name}': {camera.width_px} x {camera.height_px} px, but the scan's images have "
                f"{old.width_px} x {old.height_px}",
                place=path,
            )
        if old is not None or name == "depth":
            parts[name] = camera
    for key in ("T_color_depth", "T_thermal_depth"):
        rows = getattr(doc.extrinsics, key)
        if rows is not None and parts[key.split("_")[1]] is not None:
            parts[key] = matrix_of(rows, f"extrinsics.{key}", path)
    sensor = _sensor(scan, doc.cameras.thermal, path)
    rig = make_rig(**parts, place=path)  # type: ignore[arg-type]
    scan = replace(scan, rig=rig, sensor=sensor, notes=(*scan.notes, f"cameras and extrinsics from {path.name}"))
    return scan if doc.depth_correction is None else _depth_corrected(scan, doc.depth_correction, path)


def _depth_corrected(scan: Scan, doc: DepthCorrectionDoc, path: Path) -> Scan:
    """The scan with its depth images corrected, stored a quarter of a millimetre fine if written."""
    if doc.model == "disparity":
        text = f"the depth correction of {path.name} is one of raw disparity: this recording's metric depth stays"
        return replace(scan, notes=(*scan.notes, text))
    from .depth_correction import MetricDepth

    camera = scan.rig.depth
    model = MetricDepth((camera.width_px, camera.height_px))
    missing = [n for n in model.names if n not in doc.parameters]
    if missing:
        raise ScanError(f"key 'depth_correction.parameters': '{missing[0]}' is missing", place=path)
    correct, load = model.of_images(np.array([doc.parameters[n] for n in model.names])), scan.depth.load
    depth = replace(scan.depth, load=lambda i: correct(load(i)))
    unit_m = min(scan.depth_unit_m, CORRECTED_UNIT_M)
    return replace(scan, depth=depth, depth_unit_m=unit_m, notes=(*scan.notes, f"depth corrected by {path.name}"))


def _sensor(scan: Scan, group: RigThermalDoc | None, path: Path) -> ThermalSensor | None:
    """The scan's radiometry with what the rig names in its place."""
    if group is None or scan.thermal is None:
        return scan.sensor
    stated = sensor_of(group, path)
    if scan.sensor is None:
        return None if group.signal is None else stated
    named = group.model_fields_set - ({"signal"} if group.signal is None else set())
    return replace(stated, **{k: v for k, v in vars(scan.sensor).items() if k not in named})


def with_thermal(
    scan: Scan, frames: ThermalFrames, rig: str | Path, *, times_s: NDArray[np.float64] | None = None
) -> Scan:
    """A depth recording joined to thermal frames recorded apart, by a rig.json that has the thermal camera.

    times_s : (N,) of the thermal frames on the depth clock, where the files' own clock is another or is not stated.

    The stored counts and their own curve go into the scan, so the temperature stays apparent; emissivity and
    reflection are the fusion's business. Raises ScanError: the rig lacks the thermal camera or T_thermal_depth, its
    size differs from the frames', a frame has no time.
    """
    path = Path(rig)
    doc = validated(RigDoc, read_json(path), path)
    group, rows = doc.cameras.thermal, doc.extrinsics.T_thermal_depth
    if group is None or rows is None:
        raise ScanError("'cameras.thermal' and 'extrinsics.T_thermal_depth' are needed to join thermal", place=path)
    camera = camera_of(group, "cameras.thermal", path)
    if frames.images.shape[1:] != camera.shape:
        h, w = frames.images.shape[1:]
        raise ScanError(
            f"the thermal frames are {w} x {h} px, the rig says {camera.width_px} x {camera.height_px}", place=path
        )
    times = frames.times_s if times_s is None else np.asarray(times_s, np.float64)
    if not np.isfinite(times).all():
        raise ScanError("the thermal frames state no times", place=frames.places[0], hint="give times_s")
    own = sensor_of(group, path)
    sensor = ThermalSensor(frames.signal, own.band_um, own.netd_K, own.time_offset_s, own.psf_sigma_px)
    images = frames.images
    thermal = make_stream(times, lambda i: images[i], frames.places, place=frames.places[0], kind="thermal")
    T_thermal_depth = matrix_of(rows, "extrinsics.T_thermal_depth", path)
    r: Rig = scan.rig
    joined = make_rig(r.depth, r.color, r.T_color_depth, camera, T_thermal_depth, place=path)
    notes = (*scan.notes, *frames.notes, f"thermal frames joined by {path.name}")
    return replace(scan, rig=joined, thermal=thermal, sensor=sensor, notes=notes)
