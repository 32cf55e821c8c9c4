"""Poses as rows of TUM text, for evo and every SLAM tool: `time_s tx ty tz qx qy qz qw` of T_world_depth, metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import ScanError
from ..types import Float, Trajectory, check_rigid
from .reading import read_numbers
from .whole import write_whole

HEAD = "# time_s tx ty tz qx qy qz qw: T_world_depth, metres"
MAX_TIME_S = 1e10  # seconds since 1970 are 1.8e9; more are other units than seconds
MAX_POSITION_M = 1000.0  # a pose farther from the origin is in other units than metres
POSE_TOLERANCE = 1e-2  # deviation of RᵀR from identity in a recorded pose
UNIT_TOLERANCE = 0.02  # of a quaternion's length: rows with four digits are still unit quaternions


def read_trajectory(path: Path) -> Trajectory:
    """The trajectory of a file; `#` starts a comment.

    Raises ScanError naming the pose that cannot be used.
    """
    rows = read_numbers(path, columns=8)
    if len(rows) == 0:
        raise ScanError("the trajectory has no poses", place=path, hint="delete the file to have poses estimated")
    bad = np.flatnonzero(~(np.abs(rows) <= MAX_TIME_S).all(axis=1))  # NaN is none, either
    if len(bad):
        text = f"expected eight finite numbers `time_s tx ty tz qx qy qz qw`, none beyond ±{MAX_TIME_S:g}"
        raise ScanError(text, place=f"{path}, pose {bad[0] + 1}")
    bad = np.flatnonzero(np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) > UNIT_TOLERANCE)
    if len(bad):
        raise ScanError("the quaternion's length is not 1", place=f"{path}, pose {bad[0] + 1}")
    return poses_to_trajectory(rows[:, 0], poses_of(rows[:, 1:]), place=path)


def poses_of(rows: Float) -> Float:
    """Poses (N, 4, 4) [m] of rows (N, 7) `tx ty tz qx qy qz qw`. Raises ValueError for a quaternion of length 0."""
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3]
    return T


def rows_of(T: Float) -> Float:
    """Inverse of `poses_of`, with qw >= 0: rows (N, 7) of poses (N, 4, 4) [m]."""
    return np.column_stack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)])


def write_trajectory(path: str | Path, trajectory: Trajectory, *, exact: bool = False, note: str = "") -> Path:
    """Write a trajectory; returns the path. Quaternions have qw >= 0.

    exact : digits enough to read the same numbers back; else microseconds and nanometres. note : a line of comment.
    Raises ResourceError.
    """
    rows = np.column_stack([trajectory.times_s, rows_of(trajectory.T_world_depth)]).tolist()
    if exact:
        lines = [" ".join(map(repr, row)) for row in rows]
    else:
        lines = [f"{row[0]:.6f} " + " ".join(f"{x:.9f}" for x in row[1:]) for row in rows]
    told = [f"# {note}"] if note else []
    return write_whole(path, ["\n".join([HEAD, *told, *lines, ""]).encode()])


def poses_to_trajectory(times_s: NDArray, poses: NDArray, *, place: object) -> Trajectory:
    """The poses (N, 4, 4) T_world_depth in metres with their times_s (N,); rotations are made exactly orthonormal.

    Raises ScanError for a pose that is no rigid transform to `POSE_TOLERANCE`.
    """
    if len(poses) == 0:
        raise ScanError("the trajectory has no poses", place=place)
    try:
        trajectory = Trajectory(times_s, _nearest_rigid(np.asarray(poses, np.float64)))
    except ValueError as e:
        raise ScanError(str(e), place=place) from None
    T = trajectory.T_world_depth
    if np.abs(trajectory.times_s).max() > MAX_TIME_S:
        raise ScanError(f"a pose has a time beyond ±{MAX_TIME_S:g} s, expected seconds", place=place)
    if np.abs(T[:, :3, 3]).max() > MAX_POSITION_M:
        raise ScanError(f"a pose lies more than {MAX_POSITION_M:.0f} m from the origin, expected metres", place=place)
    return trajectory


def _nearest_rigid(poses: Float) -> Float:
    """The rigid transforms (N, 4, 4) nearest to rounded ones: published poses are off by up to a few 1e-3.

    Raises ValueError for the first that is none.
    """
    R = poses[:, :3, :3]
    near = np.all(np.abs(R) <= 2, axis=(1, 2)) & np.all(np.abs(poses[:, 3] - [0, 0, 0, 1]) <= 1e-9, axis=1)
    error = np.abs(R[near].transpose(0, 2, 1) @ R[near] - np.eye(3)).max(axis=(1, 2))
    near[near] = (error <= POSE_TOLERANCE) & (np.linalg.det(R[near]) > 0)
    near &= np.all(np.isfinite(poses), axis=(1, 2))
    for i in np.flatnonzero(~near)[:1]:
        check_rigid(poses[i], f"pose {i}")
        raise ValueError(f"pose {i} is no rigid transform")
    T = poses.copy()
    T[:, 3] = [0, 0, 0, 1]
    for _ in range(2):  # the first makes rounded rotations near, the second exact
        U, _, Vt = np.linalg.svd(T[:, :3, :3])
        T[:, :3, :3] = U @ Vt
    return T
