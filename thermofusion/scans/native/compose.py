"""Putting together what was recorded apart: a calibrated rig, and thermal frames from a camera of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError
from ...files.reading import read_json
from ...files.strict import validated
from ...types import Camera, Environment, Float, FrameConditions, Scan, ThermalCamera, ThermalStream
from ..common import as_thermal, make_rig, make_stream
from ..thermal.frames import ThermalFrames
from .schema import CameraDoc, DepthCorrectionDoc, RigDoc, camera_of, matrix_of, plausible, thermal_camera_of

CORRECTED_UNIT_M = 0.00025  # rounding to a millimetre would undo a correction of that size; 16 bits reach 16 m


def with_rig(scan: Scan, path: str | Path) -> Scan:
    """`scan` with the cameras and extrinsics of a rig.json (the `cameras` and `extrinsics` groups of a scan.json).

    Its depth correction is applied to every depth image: give a rig to a recording once, on import. What the file does
    not name stays. Raises ScanError if the file is faulty or a camera's size is not its images'.
    """
    path = Path(path)
    doc = validated(RigDoc, read_json(path), path)
    depth, color, T_color_depth = scan.rig.depth, scan.rig.color, scan.rig.T_color_depth
    if doc.cameras.depth is not None:
        depth = _stated(doc.cameras.depth, "depth", depth, path)
    if doc.cameras.color is not None and color is not None:
        color = _stated(doc.cameras.color, "color", color, path)
    if doc.extrinsics.T_color_depth is not None and color is not None:
        T_color_depth = matrix_of(doc.extrinsics.T_color_depth, "extrinsics.T_color_depth", path)
    scan = replace(
        scan,
        rig=make_rig(depth, color, T_color_depth, place=path),
        thermal=None if scan.thermal is None else _thermal_with(scan.thermal, doc, path),
        notes=(*scan.notes, f"cameras and extrinsics from {path.name}"),
    )
    return scan if doc.depth_correction is None else _depth_corrected(scan, doc.depth_correction, path)


def _stated(doc: CameraDoc, name: str, old: Camera, path: Path) -> Camera:
    """A camera of the rig file; its size must be that of the scan's images."""
    camera = camera_of(doc, f"cameras.{name}", path)
    if camera.shape != old.shape:
        raise ScanError(
            f"key 'cameras.{name}': {camera.width_px} x {camera.height_px} px, but the scan's images have "
            f"{old.width_px} x {old.height_px}",
            place=path,
        )
    return camera


def _thermal_with(stream: ThermalStream, doc: RigDoc, path: Path) -> ThermalStream:
    """The thermal stream with what the rig file names of its camera in place of its own."""
    group, rows, own = doc.cameras.thermal, doc.extrinsics.T_thermal_depth, stream.camera
    if rows is None:
        rows = own.T_thermal_depth.tolist()
    if group is None:
        T = matrix_of(rows, "extrinsics.T_thermal_depth", path)
        try:
            return replace(stream, camera=replace(own, T_thermal_depth=T))
        except ValueError as e:
            raise ScanError(str(e), place=path) from None
    _stated(group, "thermal", own.lens, path)
    stated = thermal_camera_of(group, doc.extrinsics.model_copy(update={"T_thermal_depth": rows}), path)
    named = (group.model_fields_set | {"lens", "T_thermal_depth"}) - ({"signal"} if group.signal is None else set())
    return replace(stream, camera=replace(stated, **{k: v for k, v in vars(own).items() if k not in named}))


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


def thermal_camera(rig: str | Path, *, free: bool = False) -> ThermalCamera:
    """The thermal camera of a rig.json; free : it hangs on no rig. Raises ScanError if it lacks one, or its place."""
    return _thermal_camera(Path(rig), free)[0]


def _thermal_camera(path: Path, free: bool) -> tuple[ThermalCamera, bool]:
    """The thermal camera of a rig.json, and whether the file tells its signal."""
    doc = validated(RigDoc, read_json(path), path)
    group = doc.cameras.thermal
    if group is not None and free:
        group = group.model_copy(update={"mount": "free"})
    if group is None or (group.mount == "rig" and doc.extrinsics.T_thermal_depth is None):
        text = "'cameras.thermal' and 'extrinsics.T_thermal_depth' are needed to join thermal"
        hint = "--free joins a thermal camera that is not on the rig: it needs 'cameras.thermal' alone"
        raise ScanError(text, place=path, hint=hint)
    return thermal_camera_of(group, doc.extrinsics, path), group.signal is not None


def with_thermal(
    scan: Scan,
    frames: ThermalFrames,
    rig: str | Path,
    *,
    times_s: NDArray[np.float64] | None = None,
    band_um: tuple[float, float] | None = None,
    free: bool = False,
) -> Scan:
    """A depth recording joined to thermal frames recorded apart, by a rig.json that has the thermal camera.

    times_s : (N,) of the thermal frames on the depth clock, where the files' own clock is another or is not stated.
    band_um : of the camera, where it is not the rig's. free : the camera is not on the rig; clocks do not matter then.

    The stored values go into the scan with their own curve, or the rig's where the files have none, so the temperature
    stays apparent; emissivity and reflection are the fusion's business. What the camera was told of the room fills what
    the scan does not state of it. Raises ScanError: the rig lacks the thermal camera or T_thermal_depth, its size
    differs from the frames', a frame has no time, or none within the depth recording's time.
    """
    path = Path(rig)
    camera, tells_signal = _thermal_camera(path, free)
    free = camera.mount == "free"
    if scan.times_assumed and not free:
        text = "depth carries no times, so thermal frames have no place among them"
        hint = "give them: `thermofusion import DEPTH --times LIST -o SCAN`, then join thermal to SCAN"
        raise ScanError(text, place=scan.root, hint=hint)
    if frames.signal is None and not tells_signal:
        hint = "give --gain and --offset-degC, --curve, or a rig.json with cameras.thermal.signal"
        raise ScanError(
            "the thermal frames hold counts, and nobody says their curve", place=frames.places[0], hint=hint
        )
    camera = replace(camera, signal=frames.signal or camera.signal, band_um=band_um or camera.band_um)
    if frames.shape != camera.lens.shape:
        (h, w), lens = frames.shape, camera.lens
        raise ScanError(
            f"the thermal frames are {w} x {h} px, the rig says {lens.width_px} x {lens.height_px}", place=path
        )
    times = frames.times_s if times_s is None else np.asarray(times_s, np.float64)
    if free and not np.isfinite(times).all():  # their order is all that counts
        times = np.arange(len(times), dtype=np.float64)
    if not np.isfinite(times).all():
        text, hint = "the thermal frames state no times", "give --times or --fps, and --clock-offset"
        raise ScanError(text, place=frames.places[0], hint=hint)
    if times_s is not None:
        camera = replace(camera, time_offset_s=0.0)
    stream = make_stream(times, frames.load, frames.places, place=frames.places[0], kind="thermal")
    if not free:
        _check_common_time(scan, times + camera.time_offset_s, frames.places[0])
    own, told = scan.environment, frames.environment
    room = {k: getattr(told, k) for k, v in vars(own).items() if v is None and getattr(told, k) is not None}
    notes = [*scan.notes, *frames.notes, f"thermal frames joined by {path.name}"]
    if room:
        said = ", ".join(f"{k} {v:g}" for k, v in room.items())
        notes.append(f"environment as the thermal camera was told, set it if you know better: {said}")
    told_each = _changing(frames.conditions, own)
    thermal = as_thermal(stream, camera, told_each)
    if told_each is not None:
        notes.append(f"changes from frame to frame, as the thermal files say: {', '.join(told_each.stated)}")
    return replace(scan, thermal=thermal, environment=replace(own, **room), notes=tuple(notes))


def _changing(conditions: FrameConditions | None, stated: Environment) -> FrameConditions | None:
    """What differs from frame to frame and the scan does not state for all: what stands still is the environment's."""
    if conditions is None:
        return None
    known = {name: c for name, c in conditions.stated.items() if getattr(stated, name, None) is None}
    inside = {name: plausible(name, column) for name, column in known.items()}
    changing = {name: c for name, c in inside.items() if len(np.unique(c[np.isfinite(c)])) > 1}
    return FrameConditions.of(len(conditions.air_degC), changing)


def _check_common_time(scan: Scan, times_s: Float, place: object) -> None:
    """ScanError where no thermal frame lies within the depth recording's time: two clocks."""
    t = scan.depth.times_s
    if times_s[-1] < t[0] or times_s[0] > t[-1]:
        text = (
            f"thermal ({times_s[0]:.3f} to {times_s[-1]:.3f} s) and depth ({t[0]:.3f} to {t[-1]:.3f} s) have no time in"
        )
        hint = (
            "give --clock-offset SECONDS (added to thermal's times), or --clock-offset auto to find it from the motion"
        )
        raise ScanError(f"{text} common: two clocks", place=place, hint=hint)
