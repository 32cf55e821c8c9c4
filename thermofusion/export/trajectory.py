"""trajectory.txt: poses of the depth camera as TUM rows, for evo and every SLAM tool."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..scans.native import read_tum_trajectory as read_trajectory
from ..types import Trajectory
from .files import write_whole

__all__ = ["read_trajectory", "write_trajectory"]


def write_trajectory(path: str | Path, trajectory: Trajectory) -> Path:
    """Rows `time_s tx ty tz qx qy qz qw` of T_world_depth: microseconds, nanometres, unit quaternions with qw >= 0.

    Raises ResourceError.
    """
    T = trajectory.T_world_depth
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([trajectory.times_s, T[:, :3, 3], q])
    lines = ["# time_s tx ty tz qx qy qz qw: T_world_depth, metres"]
    lines += [f"{row[0]:.6f} " + " ".join(f"{x:.9f}" for x in row[1:]) for row in rows.tolist()]
    return write_whole(path, ["\n".join(lines).encode() + b"\n"])
