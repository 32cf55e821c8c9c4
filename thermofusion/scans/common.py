"""What all readers share: streams of image files, trajectories as text, cameras that coincide."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import ScanError
from ..types import Camera, Float, Rig, Stream, Trajectory, check_rigid
from .files import claimed_size, decode_image, depth_from_raw, read_bytes, read_numbers

Kind = Literal["depth", "color", "thermal"]
ASSUMED_RATE_HZ = 30.0  # of recordings that carry no times
MAX_POSITION_M = 1000.0  # a pose farther from the origin is in other units than metres
POSE_TOLERANCE = 1e-2  # deviation of RᵀR from identity in a recorded pose
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
    """A stream whose times were checked: finite and strictly rising, at least one."""
    t = np.asarray(times_s, np.float64)
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
    return Stream(t, load, tuple(str(p) for p in places), numbers, flags)


def image_stream(
    kind: Kind,
    files: Sequence[Path],
    times_s: Sequence[float] | NDArray,
    camera: Camera,
    *,
    place: object,
    unit_m: float = 0.001,
    invalid: tuple[int, ...] = (0,),
    decode: Callable[[bytes, object], NDArray] | None = None,
    index: Sequence[int] | NDArray | None = None,
    usable: Sequence[bool] | NDArray | None = None,
) -> Stream:
    """A stream of image files, decoded when asked for.

    unit_m, invalid : of depth. decode : (bytes, place) -> raw image, for files that are no ordinary images.
    """

    def load(i: int) -> NDArray:
        data = read_bytes(files[i], kind)
        if decode is None:
            raw = decode_image(data, shape=camera.shape, kind=kind, place=files[i])
        else:
            raw = decode(data, files[i])
        if raw.shape[:2] != camera.shape:
            raise ScanError(
                f"the {kind} is {raw.shape[1]} x {raw.shape[0]} px, expected {camera.width_px} x {camera.height_px}",
                place=files[i],
            )
        return as_loaded(kind, raw, files[i], unit_m, invalid)

    return make_stream(times_s, load, files, place=place, kind=kind, index=index, usable=usable)


def as_loaded(kind: Kind, raw: NDArray, place: object, unit_m: float, invalid: tuple[int, ...] = (0,)) -> NDArray:
    """A decoded image in the form that `Stream.load` promises for its kind."""
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


def numbered(files: Sequence[Path]) -> list[tuple[int, Path]]:
    """Files with the last number in their names (`depth_12.png` -> 12), in its order; without one: by name."""
    numbers = [re.findall(r"\d+", f.stem) for f in files]
    if all(numbers):
        pairs = sorted((int(n[-1][-18:]), f) for n, f in zip(numbers, files, strict=True))
        if len({n for n, _ in pairs}) == len(pairs):
            return pairs
    return list(enumerate(sorted(files)))


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
    """A `Camera`, its faults as ScanError with the place."""
    try:
        return Camera(width_px, height_px, K, np.zeros(5) if distortion is None else distortion)
    except (ValueError, TypeError) as e:
        raise ScanError(str(e), place=place) from None


def make_rig(
    depth: Camera,
    color: Camera | None = None,
    T_color_depth: NDArray | None = None,
    thermal: Camera | None = None,
    T_thermal_depth: NDArray | None = None,
    *,
    place: object,
) -> Rig:
    """A `Rig`, its faults as ScanError with the place; a colour camera without an extrinsic coincides with depth."""
    if color is not None and T_color_depth is None:
        T_color_depth = np.eye(4)
    try:
        return Rig(depth, thermal, T_thermal_depth, color, T_color_depth)
    except ValueError as e:
        raise ScanError(str(e), place=place) from None


# ---------------------------------------------------------------- poses


def poses_to_trajectory(times_s: NDArray, poses: NDArray, *, place: object) -> Trajectory:
    """(N, 4, 4) T_world_depth in metres with their times; rotations are made exactly orthonormal.

    Raises ScanError for a pose that is no rigid transform to `POSE_TOLERANCE`.
    """
    try:
        T = np.stack([_nearest_rigid(M, f"pose {i}") for i, M in enumerate(poses)])
        trajectory = Trajectory(times_s, T)
    except ValueError as e:
        raise ScanError(str(e), place=place) from None
    if np.abs(T[:, :3, 3]).max() > MAX_POSITION_M:
        raise ScanError(f"a pose lies more than {MAX_POSITION_M:.0f} m from the origin, expected metres", place=place)
    return trajectory


def _nearest_rigid(M: NDArray, name: str) -> Float:
    """The rigid transform nearest to a rounded one: published poses are off by up to a few 1e-3."""
    R = M[:3, :3]
    if np.isfinite(R).all() and np.abs(R.T @ R - np.eye(3)).max() <= POSE_TOLERANCE and np.linalg.det(R) > 0:
        U, _, Vt = np.linalg.svd(R)
        M = np.block([[U @ Vt, M[:3, 3:]], [M[3:]]])
    return check_rigid(M, name)


def read_tum_trajectory(path: Path) -> Trajectory:
    """Rows `time_s tx ty tz qx qy qz qw`, the pose T_world_depth; `#` starts a comment."""
    rows = read_numbers(path, columns=8)
    if len(rows) == 0:
        raise ScanError("the trajectory has no poses", place=path, hint="delete the file to have poses estimated")
    for number, row in enumerate(rows, 1):
        if not np.isfinite(row).all():
            raise ScanError(
                "expected eight finite numbers `time_s tx ty tz qx qy qz qw`", place=f"{path}, pose {number}"
            )
        if abs(math.hypot(*row[4:]) - 1) > 0.02:
            raise ScanError("the quaternion's length is not 1", place=f"{path}, pose {number}")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    T[:, :3, 3] = rows[:, 1:4]
    return poses_to_trajectory(rows[:, 0], T, place=path)


def tum_rows(trajectory: Trajectory) -> str:
    """A trajectory as TUM text, digits enough to read the same numbers back."""
    q = Rotation.from_matrix(trajectory.T_world_depth[:, :3, :3]).as_quat()
    rows = np.column_stack([trajectory.times_s, trajectory.T_world_depth[:, :3, 3], q])
    lines = [" ".join(repr(float(x)) for x in row) for row in rows]
    return "\n".join(["# time_s tx ty tz qx qy qz qw: pose T_world_depth", *lines, ""])


def frame_times(numbers: Sequence[int]) -> Float:
    """Times of frames that carry only numbers, at the assumed rate."""
    return np.asarray(numbers, np.float64) / ASSUMED_RATE_HZ
