"""The paper's laboratory layout: NAME.pgm Kinect depth (mm), NAME_0000.raw thermal counts, NAME.jpg colour if any.

Thermal: 632 x 476 big-endian uint16 without header. Nobody recorded a rig; the numbers here are ours, refitted from
the authors' hand-picked corners of 31 checkerboard views (76.2 mm squares): colour 0.86 px rms, thermal 0.59 px,
colour to thermal 3.4 px rms (the rig was moved between groups of views).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...errors import ScanError
from ...geometry.rigid import pose
from ...types import Camera, Float, Scan, SignalCurve, Stream, ThermalCamera, ThermalStream, Trajectory
from ..common import ImageFiles, as_thermal, frame_times, image_stream, make_camera, make_rig
from ..naming import in_order, real_files
from ..stated import NOTHING, Stated

THERMAL_SHAPE = (476, 632)  # (height, width), px: files have no header
FAR_CLIP_MM = 3975  # the recorder's far clip: no measurement
DEPTH_FOCAL_PX = 580.0  # nominal for a Kinect v1's depth camera; board planes say 576 ± 2
# The face was recorded with the rig as it stood on another day. Fitted to that picture's own outline (shoulders and
# jaw against the thermal silhouette, 659 contour points): 0.9 px median, 8 px at the 90th percentile, where the
# refitted board rig is 30 px off. The hairline, which the fit did not use, falls into place too.
FACE_FOCAL_PX = 545.6
FACE_TURN_RAD = (0.03543, -0.00745, -0.07562)  # rotation vector, applied behind T_THERMAL_COLOR
COLOR_K = np.array([[1056.99, 0, 617.26], [0, 1056.96, 479.39], [0, 0, 1]])
COLOR_DISTORTION = np.array([0.0943, -0.2083, -0.0060, -0.0047, 0])
THERMAL_K = np.array([[977.02, 0, 306.26], [0, 971.89, 132.63], [0, 0, 1]])
THERMAL_DISTORTION = np.array([-0.0911, 0.4364, 0.0017, -0.0060, 0])
T_THERMAL_COLOR = pose(
    np.array(
        [
            [0.9994967833715853, 0.031653532730401404, 0.002057643200265192],
            [-0.031685120276956164, 0.9993402487097458, 0.017751632651060435],
            [-0.0014943837823704997, -0.01780789640661638, 0.9998403100709043],
        ]
    ),
    np.array([0.00640230, -0.09499936, -0.01095760]),
)
# Eq. 1 with its missing digits, from the authors' calibration file.
COEFFICIENTS_DEGC = (
    -3.459387438171146e05,
    56.540702500396690,
    -0.003469484795606,
    9.470542369512357e-08,
    -9.699380162015556e-13,
)


def recognise(path: Path) -> bool:
    """A .pgm with its _0000.raw, as a folder or as the path of one .pgm."""
    return bool(_depth_files(path))


def read(path: Path, stated: Stated = NOTHING, *, depth_to_color_x_m: float = -0.025) -> Scan:
    """Such a folder as a scan; one frame stands at the origin, several have no poses.

    Frames without colour are taken as of the face's session (its own rig), with colour as of the boards'.

    depth_to_color_x_m : where depth's origin lies along the colour camera's x. The authors' mirroring left its sign
    unsettled: board planes prefer +22 mm if depth and colour are taken as parallel, but -25 ± 3 mm once the small
    rotation between them is fitted too, which is also the Kinect's mechanical baseline.
    """
    files = _depth_files(path)
    if not files:
        raise ScanError("there is no NAME.pgm with NAME_0000.raw", place=path)
    root = path if path.is_dir() else path.parent
    frames, unit_m = in_order(files), stated.unit_m(0.001)
    numbers, depth_files = list(frames.index), list(frames.files)
    times = frame_times(numbers)
    face = not any(f.with_suffix(".jpg").is_file() for f in depth_files)
    f = FACE_FOCAL_PX if face else DEPTH_FOCAL_PX
    depth_camera = make_camera(640, 480, np.array([[f, 0, 319.5], [0, f, 239.5], [0, 0, 1]]), place=path)
    color_camera = None if face else make_camera(1280, 960, COLOR_K, COLOR_DISTORTION, place=path)
    T_color_depth = pose(np.eye(3), np.array([depth_to_color_x_m, 0, 0]))
    return Scan(
        name=path.resolve().stem,
        root=root,
        format="jhu",
        rig=make_rig(depth_camera, color_camera, None if face else T_color_depth, place=path),
        depth=image_stream(
            ImageFiles("depth", depth_files, times, path, numbers),
            depth_camera,
            unit_m=unit_m,
            invalid=(0, FAR_CLIP_MM),
        ),
        color=None if color_camera is None else _color(depth_files, times, numbers, color_camera, path),
        thermal=_thermal(depth_files, times, numbers, T_color_depth, path),
        trajectory=Trajectory(times, np.eye(4)[None]) if len(files) == 1 else None,
        depth_unit_m=unit_m,
        times_assumed=True,
        notes=(
            "cameras refitted from the authors' picks (colour to thermal 3.4 px rms: the rig was moved between groups)",
            f"depth f = {f:.0f} px, its origin {depth_to_color_x_m * 1e3:+.0f} mm along colour's x: not calibrated",
            *(["no colour: the face session's rig, fitted to that picture's outline"] if face else []),
            "band 7.5-13.5 um and NETD 31.5 mK assumed",
            "no times: 30 frames a second by number are assumed",
        ),
    )


def _color(depth_files: list[Path], times_s: Float, numbers: list[int], camera: Camera, path: Path) -> Stream:
    """The pictures beside the depth frames, where there are some."""
    rows = [i for i, f in enumerate(depth_files) if f.with_suffix(".jpg").is_file()]
    files, index = [depth_files[i].with_suffix(".jpg") for i in rows], [numbers[i] for i in rows]
    return image_stream(ImageFiles("color", files, times_s[rows], path, index), camera)


def _thermal(
    depth_files: list[Path], times_s: Float, numbers: list[int], T_color_depth: Float, path: Path
) -> ThermalStream:
    """The thermal frames beside the depth frames; without colour pictures they are of the face's session."""
    face = not any(f.with_suffix(".jpg").is_file() for f in depth_files)
    turn = Rotation.from_rotvec(FACE_TURN_RAD).as_matrix() if face else np.eye(3)
    camera = ThermalCamera(
        make_camera(*THERMAL_SHAPE[::-1], THERMAL_K, THERMAL_DISTORTION, place=path),
        pose(turn, np.zeros(3)) @ T_THERMAL_COLOR @ T_color_depth,
        SignalCurve("counts", "polynomial", {"coefficients_degC": COEFFICIENTS_DEGC}),
        (7.5, 13.5),
        0.0315,
    )
    files = [f.with_name(f"{f.stem}_0000.raw") for f in depth_files]
    stream = image_stream(ImageFiles("thermal", files, times_s, path, numbers), camera.lens, decode=decode_counts)
    return as_thermal(stream, camera)


def decode_counts(data: bytes, place: object) -> NDArray[np.uint16]:
    """A headerless frame (H, W) of big-endian counts. Raises ScanError for another length."""
    h, w = THERMAL_SHAPE
    if len(data) != 2 * h * w:
        raise ScanError(f"expected {2 * h * w} bytes of {w} x {h} counts, got {len(data)}", place=place)
    return np.frombuffer(data, ">u2").reshape(h, w).astype(np.uint16)


def _depth_files(path: Path) -> list[Path]:
    candidates = sorted(real_files(path.glob("*.pgm"))) if path.is_dir() else [path] if path.suffix == ".pgm" else []
    return [f for f in candidates if f.with_name(f"{f.stem}_0000.raw").is_file()]
