"""Rigid motions and trajectories: NumPy, SciPy's rotations, and OpenCV where points are many.

`T_a_b` (4x4) takes a point from frame b to frame a, p_a = T_a_b p_b.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..types import Bool, Float, Trajectory


def invert(T: Float) -> Float:
    """Inverse of rigid transforms (..., 4, 4): T_b_a from T_a_b."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R
    out[..., :3, 3] = -(R @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform_points(T_b_a: Float, points_a: NDArray) -> NDArray:
    """points_a (N, 3) m of frame a in frame b by T_b_a (4, 4); keeps the points' float type."""
    if not len(points_a):
        return points_a
    # NumPy's product of many rows by a 3 x 3 matrix takes twenty times as long
    return np.asarray(cv2.transform(points_a[:, None], T_b_a[:3])[:, 0])


def pose(R: NDArray, t: NDArray) -> Float:
    """(4, 4) from a rotation matrix R (3, 3) and a translation t (3,) in metres."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def se3_exp(xi: NDArray) -> Float:
    """Motion (..., 6) = rotation vector [rad], translation part [m] of the twist -> (..., 4, 4)."""
    xi = np.asarray(xi, np.float64)
    w, v = xi[..., :3], xi[..., 3:]
    theta = np.linalg.norm(w, axis=-1)[..., None, None]
    W = _skew(w)
    t2 = np.maximum(theta, 1e-9) ** 2
    small = theta < 1e-4
    a = np.where(small, 0.5 - theta**2 / 24, (1 - np.cos(theta)) / t2)
    b = np.where(small, 1 / 6 - theta**2 / 120, (theta - np.sin(theta)) / (t2 * np.maximum(theta, 1e-9)))
    V = np.eye(3) + a * W + b * (W @ W)
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*xi.shape[:-1], 3, 3)
    T[..., :3, 3] = (V @ v[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def se3_log(T: Float) -> Float:
    """Inverse of `se3_exp`: T (..., 4, 4) -> (..., 6), rotation vector [rad] and translation part [m]."""
    T = np.asarray(T, np.float64)
    w = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*T.shape[:-2], 3)
    theta = np.linalg.norm(w, axis=-1)[..., None, None]
    W = _skew(w)
    half = theta / 2
    small = theta < 1e-4
    safe = np.maximum(theta, 1e-9)
    c = np.where(small, 1 / 12 + theta**2 / 720, (1 - half / np.tan(np.maximum(half, 1e-9))) / safe**2)
    V_inv = np.eye(3) - 0.5 * W + c * (W @ W)
    return np.concatenate([w, (V_inv @ T[..., :3, 3:])[..., 0]], axis=-1)


def _skew(w: Float) -> Float:
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return W - np.swapaxes(W, -1, -2)


def rotation_angle_deg(T: Float) -> Float:
    """Angle of the rotation part of (..., 4, 4), degrees."""
    trace = np.trace(T[..., :3, :3], axis1=-2, axis2=-1)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def interpolate_trajectory(trajectory: Trajectory, times_s: Float, *, max_gap_s: float = np.inf) -> tuple[Float, Bool]:
    """Poses at other times, along the geodesic of SE(3) between neighbours.

    Returns ((N, 4, 4) T_world_depth, (N,) valid). Not valid: before the first or after the last pose by more than
    half a median step (within that the last motion is continued), or inside a gap longer than `max_gap_s`.
    """
    t, T = trajectory.times_s, trajectory.T_world_depth
    times_s = np.atleast_1d(np.asarray(times_s, np.float64))
    if len(t) == 1:
        return np.repeat(T, len(times_s), 0), np.abs(times_s - t[0]) < 1e-3
    i = np.clip(np.searchsorted(t, times_s, side="right") - 1, 0, len(t) - 2)
    step = t[i + 1] - t[i]
    s = (times_s - t[i]) / step
    slack = 0.5 * float(np.median(np.diff(t)))
    inside = (times_s >= t[0] - slack) & (times_s <= t[-1] + slack)
    on_pose = (np.abs(s) < 1e-6) | (np.abs(s - 1) < 1e-6)
    valid = inside & ((step <= max_gap_s) | on_pose)
    twist = se3_log(invert(T[i]) @ T[i + 1])
    return T[i] @ se3_exp(twist * s[:, None]), valid


def rigid_alignment(source: Float, target: Float, weight: Float | None = None) -> Float:
    """T_target_source minimising Σ w |T p - q|² over paired points p of source and q of target, (N, 3) m each.

    Kabsch's and Umeyama's solution, without scale. weight : (N,), None = alike.
    """
    if weight is None:
        cs, ct = source.mean(0), target.mean(0)
        pulled = target - ct
    else:
        w = weight / weight.sum()
        cs, ct = w @ source, w @ target
        pulled = w[:, None] * (target - ct)
    U, _, Vt = np.linalg.svd((source - cs).T @ pulled)
    d = np.sign(np.linalg.det(Vt.T @ U.T))
    R = Vt.T @ np.diag([1.0, 1.0, d]) @ U.T
    return pose(R, ct - R @ cs)
