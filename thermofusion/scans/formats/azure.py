"""Azure Kinect recordings (.mkv of k4arecorder), without the vendor's library.

Depth and IR are raw `b16g` (big-endian 16-bit grey, depth in millimetres), colour is MJPEG; `calibration.json` is
attached, with intrinsics in units of the sensor's size. Format:
https://learn.microsoft.com/azure/kinect-dk/record-file-format; the crop of each mode and the half pixel between the
corner and the centre of the first pixel follow the sensor SDK's published calibration model (MIT).
"""

from __future__ import annotations

import mmap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import ScanError, counted
from ...files.reading import decode_image, open_regular, parse_json, read_head
from ...geometry.rigid import invert, pose
from ...types import Camera, Float, Scan, Stream
from ..common import Kind, as_loaded, make_camera, make_rig, make_stream
from ..stated import NOTHING, Stated
from . import ebml

# Image size -> (size of the whole calibrated image, rows and columns cut off before the image), by camera.
DEPTH_MODES = {
    (320, 288): ((512, 512), (96, 90)),
    (640, 576): ((1024, 1024), (192, 180)),
    (512, 512): ((512, 512), (0, 0)),
    (1024, 1024): ((1024, 1024), (0, 0)),
}
COLOR_MODES = {
    (1280, 720): ((1280, 960), (0, 120)),
    (1920, 1080): ((1920, 1440), (0, 180)),
    (2560, 1440): ((2560, 1920), (0, 240)),
    (2048, 1536): ((2048, 1536), (0, 0)),
    (3840, 2160): ((3840, 2880), (0, 360)),
    (4096, 3072): ((4096, 3072), (0, 0)),
}
_LOCATIONS = {"depth": "CALIBRATION_CameraLocationD0", "color": "CALIBRATION_CameraLocationPV0"}


def recognise(path: Path) -> bool:
    """A file that begins like Matroska and is named .mkv."""
    return path.suffix.lower() == ".mkv" and read_head(path, 4) == b"\x1a\x45\xdf\xa3"


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """An Azure Kinect recording as a scan. The file stays mapped in memory; frames are decoded when asked for."""
    data = _map(path)
    recording = ebml.parse(data, path)
    depth_track = _track(recording, "DEPTH")
    if depth_track is None:
        raise ScanError("the recording has no DEPTH track", place=path)
    if depth_track.fourcc != "b16g":
        raise ScanError(f"depth is coded as '{depth_track.fourcc}', expected b16g", place=path)
    color_track = _track(recording, "COLOR")
    notes = [] if recording.complete else ["the recording is torn: the frames before the tear are used"]
    if color_track is not None and color_track.fourcc.upper() != "MJPG":
        notes.append(f"colour is coded as '{color_track.fourcc}', only MJPG is read: left out")
        color_track = None

    calibration = _calibration(recording, path)
    depth_camera, T_depth = azure_camera(calibration, "depth", depth_track.width_px, depth_track.height_px, path)
    color_camera, T_color_depth = None, None
    if color_track is not None:
        color_camera, T_color = azure_camera(calibration, "color", color_track.width_px, color_track.height_px, path)
        T_color_depth = T_color @ invert(T_depth)
    shape, unit_m = depth_camera.shape, stated.unit_m(0.001)
    depth, lost = _stream(data, recording, depth_track, "depth", path, lambda b, p: decode_b16g(b, shape, p), unit_m)
    color = None
    if color_track is not None and color_camera is not None:
        size = color_camera.shape
        color, lost_color = _stream(
            data, recording, color_track, "color", path, lambda b, p: decode_image(b, shape=size, kind="color", place=p)
        )
        lost += lost_color
    if lost:
        notes.append(f"{counted(lost, 'frame')} left out: empty, or of a time that repeats")
    serial = recording.tags.get("K4A_DEVICE_SERIAL_NUMBER")
    return Scan(
        name=path.stem,
        root=path,
        format="azure-mkv",
        rig=make_rig(depth_camera, color_camera, T_color_depth, place=f"{path}: calibration.json"),
        depth=depth,
        color=color,
        depth_unit_m=unit_m,
        notes=(*notes, *([f"device serial number {serial}"] if serial else [])),
    )


def decode_b16g(data: bytes, shape: tuple[int, int], place: object) -> NDArray[np.uint16]:
    """Big-endian 16-bit grey (H, W) without header. Raises ScanError for another length."""
    h, w = shape
    if len(data) != 2 * h * w:
        raise ScanError(f"a frame has {len(data)} bytes, expected {2 * h * w} of {w} x {h} b16g", place=place)
    return np.frombuffer(data, ">u2").reshape(h, w).astype(np.uint16)


def azure_camera(calibration: Any, which: str, width_px: int, height_px: int, place: object) -> tuple[Camera, Float]:
    """A camera for images of that size, and its pose T_camera_reference (4, 4) m, from the device's calibration.

    Intrinsics are stored in units of the whole image with the origin at the first pixel's *corner*. Distortion order
    there: k1..k6, codx, cody, p2, p1 (Brown-Conrady rational model, as OpenCV's).
    """
    modes = DEPTH_MODES if which == "depth" else COLOR_MODES
    if (width_px, height_px) not in modes:
        raise ScanError(f"{which} images of {width_px} x {height_px} px are no mode of an Azure Kinect", place=place)
    (full_w, full_h), (cut_x, cut_y) = modes[width_px, height_px]
    try:
        cameras = calibration["CalibrationInformation"]["Cameras"]
        entry = next(c for c in cameras if c["Location"] == _LOCATIONS[which])
        p = [float(x) for x in entry["Intrinsics"]["ModelParameters"]]
        cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = p[:14]
        R = np.array(entry["Rt"]["Rotation"], np.float64).reshape(3, 3)
        t = np.array(entry["Rt"]["Translation"], np.float64).reshape(3)
        wide = which == "color" and entry["SensorWidth"] * 9 == entry["SensorHeight"] * 16
    except (KeyError, TypeError, ValueError, StopIteration, IndexError):
        raise ScanError(
            f"the calibration of the {which} camera is incomplete", place=f"{place}: calibration.json"
        ) from None
    if wide:  # early devices calibrated the 16:9 image: the same numbers in units of the 4:3 image
        cy, fy = (cy * 2304 + 384) / 3072, fy * 2304 / 3072
    K = np.array([[fx * full_w, 0, cx * full_w - cut_x - 0.5], [0, fy * full_h, cy * full_h - cut_y - 0.5], [0, 0, 1]])
    camera = make_camera(width_px, height_px, K, np.array([k1, k2, p1, p2, k3, k4, k5, k6]), place=place)
    return camera, pose(R, t)


def _map(path: Path) -> memoryview:
    try:
        with open_regular(path, "recording", limit_bytes=None) as f:
            return memoryview(mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ))
    except (OSError, ValueError) as e:  # ValueError: an empty file
        raise ScanError(f"the recording cannot be read ({e})", place=path) from None


def _track(recording: ebml.Matroska, name: str) -> ebml.Track | None:
    return next((t for t in recording.tracks.values() if t.name.upper() == name), None)


def _calibration(recording: ebml.Matroska, path: Path) -> Any:
    name = recording.tags.get("K4A_CALIBRATION_FILE", "calibration.json")
    blob = recording.attachments.get(name) or recording.attachments.get("calibration.json")
    if blob is None:
        raise ScanError("the recording has no calibration.json attached", place=path)
    return parse_json(blob.rstrip(b"\0").decode("utf-8", "replace"), f"{path}: calibration.json")


def _stream(
    data: memoryview,
    recording: ebml.Matroska,
    track: ebml.Track,
    kind: Kind,
    path: Path,
    decode: Callable[[bytes, object], NDArray],
    unit_m: float = 0.001,
) -> tuple[Stream, int]:
    """The track's frames in time order, and how many were left out."""
    all_frames = sorted((f for f in recording.frames if f.track == track.number), key=lambda f: f.time_ns)
    frames = [f for i, f in enumerate(all_frames) if f.length and (i == 0 or f.time_ns > all_frames[i - 1].time_ns)]
    if not frames:
        raise ScanError(f"the {track.name} track has no frames", place=path)
    places = [f"{path}, {track.name} frame {i}" for i in range(len(frames))]

    def load(i: int) -> NDArray:
        f = frames[i]
        return as_loaded(kind, decode(bytes(data[f.offset : f.offset + f.length]), places[i]), places[i], unit_m)

    times_s = [f.time_ns * 1e-9 for f in frames]
    return make_stream(times_s, load, places, place=path, kind=kind), len(all_frames) - len(frames)
