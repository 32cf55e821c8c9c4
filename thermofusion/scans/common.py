"""What all readers share: streams of image files, trajectories as text, cameras that coincide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..files.reading import MAX_PIXELS, claimed_size, decode_image, depth_from_raw, read_bytes
from ..files.tum import MAX_TIME_S
from ..types import Camera, Float, FrameConditions, Rig, Stream, ThermalCamera, ThermalStream

Kind = Literal["depth", "color", "thermal"]
FOCAL_LENGTHS = (0.05, 100.0)  # in image sizes: from 170° across to half a degree
MAX_CENTRE = 10.0  # of the principal point, in image sizes: cut-outs of a larger image have it far off
MAX_DISTORTION = 1000.0  # of a term: rational models of wide lenses reach some tens
ASSUMED_RATE_HZ = 30.0  # of recordings that carry no times
# A Kinect v1 / PrimeSense camera whose calibration nobody recorded (Open3D's and OpenNI's default).
NOMINAL_K = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])


# ---------------------------------------------------------------- images


def make_stream(
    times_s: Sequence[float] | NDArray,
    load: Callable[[int], NDArray],
    places: Sequence[object],
    *,
    place: object,
    kind: Kind,
    index: Sequence[int] | NDArray | None = None,
    usable: Sequence[bool] | NDArray | None = None,
) -> Stream:
    """A stream whose times were checked: finite and strictly rising, at least one.

    times_s : (N,) s. load : i -> image (H, W) or (H, W, 3), as `Stream.load`. index : (N,) the recording's own numbers;
    None = 0, 1, 2 ... usable : (N,) mask; None = all. Raises ScanError.
    """
    t = np.asarray(times_s, np.float64)
    if len(t) and np.abs(t[np.isfinite(t)]).max(initial=0) > MAX_TIME_S:
        text = f"the {kind} stream has a time beyond ±{MAX_TIME_S:g} s"
        raise ScanError(text, place=place, hint="times are in seconds")
    numbers = np.arange(len(t)) if index is None else np.asarray(index, np.int64)
    if len(t) == 0:
        raise ScanError(f"there are no {kind} frames", place=place)
    if not np.isfinite(t).all():
        raise ScanError(f"the {kind} stream has a time that is not finite", place=place)
    fault = np.flatnonzero(~(np.diff(t) > 0))
    if len(fault):
        word = "repeat" if t[fault[0] + 1] == t[fault[0]] else "run backwards"
        raise ScanError(f"the times of the {kind} stream {word} at frame {numbers[fault[0] + 1]}", place=place)
    flags = np.ones(len(t), bool) if usable is None else np.asarray(usable, bool)
    return Stream(t, load, tuple(map(str, places)), numbers, flags)


@dataclass(frozen=True, eq=False)
class ImageFiles:
    """The image files of one camera, in time order.

    paths, times_s : (N,). place : the file that lists them, or their folder, for messages. index : (N,) the recording's
    own numbers; None = 0, 1, 2 ... usable : (N,) mask; None = all.
    """

    kind: Kind
    paths: Sequence[Path | str]
    times_s: Sequence[float] | NDArray
    place: object
    index: Sequence[int] | NDArray | None = None
    usable: Sequence[bool] | NDArray | None = None


def image_stream(
    files: ImageFiles,
    camera: Camera,
    *,
    unit_m: float = 0.001,
    invalid: tuple[int, ...] = (0,),
    decode: Callable[[bytes, object], NDArray] | None = None,
) -> Stream:
    """A stream of image files, decoded when asked for.

    unit_m, invalid : of depth. decode : (bytes, place) -> raw image (H, W) or (H, W, 3) as stored, for files that are
    no ordinary images.
    """
    kind, paths = files.kind, files.paths

    def load(i: int) -> NDArray:
        data = read_bytes(paths[i], kind)
        if decode is None:
            raw = decode_image(data, shape=camera.shape, kind=kind, place=paths[i])
        else:
            raw = decode(data, paths[i])
        if raw.shape[:2] != camera.shape:
            raise ScanError(
                f"the {kind} is {raw.shape[1]} x {raw.shape[0]} px, expected {camera.width_px} x {camera.height_px}",
                place=paths[i],
            )
        return as_loaded(kind, raw, paths[i], unit_m, invalid)

    return make_stream(files.times_s, load, paths, place=files.place, kind=kind, index=files.index, usable=files.usable)


def as_loaded(kind: Kind, raw: NDArray, place: object, unit_m: float, invalid: tuple[int, ...] = (0,)) -> NDArray:
    """A decoded image in the form that `Stream.load` promises for its kind; raw : (H, W), or (H, W, 3) B, G, R uint8.

    unit_m, invalid : of 16-bit depth. Raises ScanError for pixels of another type.
    """
    if kind == "depth":
        return depth_from_raw(raw, unit_m, place=place, invalid=invalid)
    if kind == "thermal":
        if raw.ndim != 2 or raw.dtype not in (np.uint16, np.float32):
            raise ScanError(
                f"thermal is {raw.dtype} with {raw.ndim} axes, expected 16-bit counts or float32, one channel",
                place=place,
                hint="8-bit pictures have lost their temperatures: export radiometric frames",
            )
        return raw
    if raw.dtype != np.uint8:
        raise ScanError(f"colour is {raw.dtype}, expected 8-bit", place=place)
    if raw.ndim == 2:
        return cv2.cvtColor(raw, cv2.COLOR_GRAY2RGB)
    return cv2.cvtColor(raw, cv2.COLOR_BGRA2RGB if raw.shape[2] == 4 else cv2.COLOR_BGR2RGB)


def image_size(path: Path, kind: str) -> tuple[int, int]:
    """(width, height) that an image file claims, for recordings that do not state it elsewhere."""
    size = claimed_size(read_bytes(path, kind), path)
    if size is None:
        raise ScanError(f"the {kind} file is no image of a known kind", place=path)
    return size


# ---------------------------------------------------------------- cameras


def make_camera(
    width_px: int, height_px: int, K: NDArray, distortion: NDArray | None = None, *, place: object
) -> Camera:
    """A `Camera` of K (3, 3) px and distortion (5,) or (8,), None = none; its faults as ScanError with the place."""
    try:
        camera = Camera(width_px, height_px, K, np.zeros(5) if distortion is None else distortion)
    except (ValueError, TypeError, OverflowError) as e:
        raise ScanError(str(e), place=place) from None
    if width_px * height_px > MAX_PIXELS:
        raise ScanError(f"a camera of {width_px} x {height_px} px, at most {MAX_PIXELS} pixels are read", place=place)
    size, K = max(width_px, height_px), camera.K
    low, high = (round(f * size, 1) for f in FOCAL_LENGTHS)
    if not (low <= K[0, 0] <= high and low <= K[1, 1] <= high):
        text = f"K has focal lengths of {K[0, 0]:.4g} and {K[1, 1]:.4g} px, expected {low:g} to {high:g} px"
        raise ScanError(text, place=place)
    if np.abs(K[:2, 2]).max() > MAX_CENTRE * size:
        text = f"K has its centre at {K[0, 2]:.4g}, {K[1, 2]:.4g} px, expected at most {MAX_CENTRE * size:g} px"
        raise ScanError(text, place=place)
    if np.abs(camera.distortion).max() > MAX_DISTORTION:
        raise ScanError(f"distortion has a term beyond ±{MAX_DISTORTION:g}", place=place)
    return camera


def make_rig(depth: Camera, color: Camera | None = None, T_color_depth: NDArray | None = None, *, place: object) -> Rig:
    """A `Rig`, its faults as ScanError with the place; a colour camera without an extrinsic coincides with depth.

    T_color_depth : (4, 4), rigid.
    """
    if color is not None and T_color_depth is None:
        T_color_depth = np.eye(4)
    try:
        return Rig(depth, color, T_color_depth)
    except ValueError as e:
        raise ScanError(str(e), place=place) from None


def as_thermal(stream: Stream, camera: ThermalCamera, conditions: FrameConditions | None = None) -> ThermalStream:
    """A stream of thermal images with the camera that took them, and what was measured beside each."""
    return ThermalStream(stream.times_s, stream.load, stream.places, stream.index, stream.usable, camera, conditions)


# ---------------------------------------------------------------- poses


NO_TIMES = f"the recording carries no times: {ASSUMED_RATE_HZ:.0f} frames a second by number are assumed"


def frame_times(numbers: Sequence[int]) -> Float:
    """Times (N,) in s of frames that carry only numbers, at the assumed rate."""
    return np.asarray(numbers, np.float64) / ASSUMED_RATE_HZ
