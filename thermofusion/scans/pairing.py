"""Streams meet in time: the nearest colour frame for a depth frame, the pose at a thermal frame's own time. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..geometry import interpolate_trajectory, invert
from ..types import Float, Int, Scan, ThermalViews, Trajectory, check_rigid

# Why a thermal frame did not enter the result: the keys of `thermal_views`' counts.
SHUTTER = "shutter"  # taken during, or just after, a shutter correction, or rejected by the reader
OUTSIDE = "outside the trajectory"  # earlier than its first, or later than its last pose
NO_POSE = "no pose"  # inside a gap of the trajectory longer than allowed: tracking was lost there


@dataclass(frozen=True, eq=False)
class ColorPairs:
    """Which colour frame belongs to which depth frame.

    color_index : (N_depth,) int32, position in the colour stream; -1 = none near enough in time.
    offset_s : (N_depth,) colour time minus depth time; NaN where there is none.
    unpaired_depth, unpaired_color : how many frames of either stream found no partner.
    """

    color_index: Int
    offset_s: Float
    unpaired_depth: int
    unpaired_color: int


def nearest_in_time(times_s: NDArray, to_s: NDArray) -> tuple[NDArray[np.int64], Float]:
    """For each of `times_s` (N,) the position of the nearest in the rising `to_s` (M > 0,), and to_s - times_s.

    At equal distance the earlier one wins.
    """
    right = np.clip(np.searchsorted(to_s, times_s), 0, len(to_s) - 1)
    left = np.maximum(right - 1, 0)
    i = np.where(np.abs(to_s[left] - times_s) <= np.abs(to_s[right] - times_s), left, right)
    return i, to_s[i] - times_s


def pair_color(scan: Scan, tolerance_ms: float) -> ColorPairs:
    """The nearest usable colour frame of every depth frame, none if farther in time than the tolerance.

    A slower colour camera may serve two depth frames; that is what the tolerance bounds.
    """
    n = len(scan.depth)
    index, offset = np.full(n, -1, np.int32), np.full(n, np.nan)
    if scan.color is None or not scan.color.usable.any():
        return ColorPairs(index, offset, n, 0 if scan.color is None else len(scan.color))
    usable = np.flatnonzero(scan.color.usable)
    nearest, dt = nearest_in_time(scan.depth.times_s, scan.color.times_s[usable])
    near = np.abs(dt) <= tolerance_ms / 1e3 + 1e-9
    index[near], offset[near] = usable[nearest[near]], dt[near]
    used = len(np.unique(index[near]))
    return ColorPairs(index, offset, int(n - near.sum()), len(scan.color) - used)


def thermal_views(
    scan: Scan,
    trajectory: Trajectory,
    max_pose_gap_s: float,
    T_thermal_depth: Float | None = None,
    time_offset_s: float | None = None,
) -> tuple[ThermalViews, dict[str, int]]:
    """The thermal frames that have a pose, and how many were left out, by reason.

    A thermal frame's time on the depth clock is its own time + `time_offset_s` (the sensor's by default); there the
    trajectory is interpolated on SE(3), and T_world_thermal = T_world_depth @ T_depth_thermal.

    T_thermal_depth, time_offset_s : replace the scan's own (refined ones of the cross-calibration).
    Raises ScanError if the scan has no thermal stream, or if not one thermal frame is left.
    """
    stream, rig = scan.thermal, scan.rig
    extrinsic = rig.T_thermal_depth if T_thermal_depth is None else T_thermal_depth
    if stream is None or extrinsic is None or len(stream) == 0:
        raise ScanError("the scan has no thermal frames", place=scan.root)
    if time_offset_s is None:
        time_offset_s = 0.0 if scan.sensor is None else scan.sensor.time_offset_s

    times_s = stream.times_s + time_offset_s
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
    T_depth_thermal = invert(check_rigid(extrinsic, "T_thermal_depth"))
    frame = np.flatnonzero(good).astype(np.int32)
    return ThermalViews(frame, times_s[good], T_world_depth[good] @ T_depth_thermal), left_out
