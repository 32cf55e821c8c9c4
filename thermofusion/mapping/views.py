"""Streams meet in time: the nearest colour frame for a depth frame, the pose at a thermal frame's own time. Pure."""

from __future__ import annotations

import numpy as np

from ..errors import ScanError
from ..geometry.rigid import interpolate_trajectory, invert
from ..types import Float, Scan, ThermalCamera, ThermalViews, Trajectory

# Why a thermal frame did not enter the result: the keys of `thermal_views`' counts.
SHUTTER = "shutter"  # taken during, or just after, a shutter correction, or rejected by the reader
OUTSIDE = "outside the trajectory"  # earlier than its first, or later than its last pose
NO_POSE = "no pose"  # inside a gap of the trajectory longer than allowed: tracking was lost there


def thermal_views(
    scan: Scan,
    trajectory: Trajectory,
    max_pose_gap_s: float,
    camera: ThermalCamera | None = None,
    frame_dt_s: Float | None = None,
    motion: Float | None = None,
) -> tuple[ThermalViews, dict[str, int]]:
    """The thermal frames that have a pose, and how many were left out, by reason.

    A thermal frame's time on the depth clock is its own time + `time_offset_s`; there the trajectory is interpolated
    on SE(3), and T_world_thermal = T_world_depth @ T_depth_thermal, (M, 4, 4).

    camera : the refined one, in place of the scan's own. frame_dt_s : (F,) what times of single frames lack.
    motion : (F, 4, 4) of the thermal camera on the rig, from the left of T_thermal_depth.
    Raises ScanError if the scan has no thermal stream, or if not
    one thermal frame is left.
    """
    stream = scan.thermal
    if stream is None or len(stream) == 0:
        raise ScanError("the scan has no thermal frames", place=scan.root)
    camera = stream.camera if camera is None else camera
    times_s = stream.times_s + camera.time_offset_s + (0.0 if frame_dt_s is None else frame_dt_s)
    T_world_depth, valid = interpolate_trajectory(trajectory, times_s, max_gap_s=max_pose_gap_s)
    slack_s = 0.5 * float(np.median(np.diff(trajectory.times_s))) if len(trajectory) > 1 else 1e-3
    t = trajectory.times_s
    outside = (times_s < t[0] - slack_s) | (times_s > t[-1] + slack_s)
    good = stream.usable & valid
    left_out = {
        SHUTTER: int((~stream.usable).sum()),
        OUTSIDE: int((stream.usable & ~valid & outside).sum()),
        NO_POSE: int((stream.usable & ~valid & ~outside).sum()),
    }
    if not good.any():
        raise ScanError(
            f"none of {len(stream)} thermal frames can be placed: "
            + ", ".join(f"{n} {reason}" for reason, n in left_out.items() if n),
            place=scan.root,
            hint=f"thermal runs {times_s[0]:.3f} to {times_s[-1]:.3f} s, the trajectory {t[0]:.3f} to {t[-1]:.3f} s",
        )
    T_depth_thermal = invert(camera.T_thermal_depth if motion is None else motion[good] @ camera.T_thermal_depth)
    frame = np.flatnonzero(good).astype(np.int32)
    return ThermalViews(frame, times_s[good], T_world_depth[good] @ T_depth_thermal), left_out
