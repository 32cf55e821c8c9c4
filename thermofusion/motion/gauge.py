"""What is motion of the body and what of the camera, and where rest is: two choices that no residual makes."""

from __future__ import annotations

import numpy as np

from ..geometry.rigid import invert, rigid_alignment, se3_exp, se3_log, transform_points
from ..types import Float
from .field import MotionField, rotations

ROUNDS = 6  # of the robust weights
TOGETHER_M = 1.5e-3  # nodes whose motion differs by this from the trunk's begin to count less


def common_motion(field: MotionField, area: Float) -> Float:
    """(F, 4, 4) the rigid motion that most of the body shares at every knot. area : (K,) what each node stands for."""
    out = []
    for twist in field.twist:
        there = field.node_m + twist[:, 3:]
        weight = area.copy()
        for _ in range(ROUNDS):
            T = rigid_alignment(field.node_m, there, weight)
            off = np.linalg.norm(transform_points(T, field.node_m) - there, axis=1)
            weight = area / (1 + (off / TOGETHER_M) ** 2) ** 2
        out.append(T)
    return np.array(out)


def without(field: MotionField, common: Float) -> MotionField:
    """The field with a rigid motion (F, 4, 4) of the whole body taken out of it."""
    T = invert(common)
    there = field.node_m + field.twist[:, :, 3:]
    moved = np.einsum("fij,fkj->fki", T[:, :3, :3], there) + T[:, None, :3, 3]
    R = T[:, None, :3, :3] @ rotations(field.twist[:, :, :3])
    twist = np.concatenate([_vectors(R), moved - field.node_m], axis=2)
    return field.moved(twist)


def _vectors(R: Float) -> Float:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def poses_without(field: MotionField, common: Float, times_s: Float, T_world_depth: Float) -> Float:
    """Poses T_world_depth (N, 4, 4) at times_s (N,) against the body, once a common rigid motion of it (F, 4, 4) is the
    camera's instead."""
    twist = se3_log(common)
    slots = [field.slot(float(t)) for t in times_s]
    between = np.array([(1 - s) * twist[a] + s * twist[b] for a, b, s in slots])
    return invert(se3_exp(between)) @ T_world_depth


def unsteady(field: MotionField, times_s: Float, steps: Float) -> Float:
    """Of steps (N, 6), rad and m, to the poses at times_s (N,), what is no motion linear between knots: jitter."""
    hat = np.zeros((len(times_s), len(field.knot_s)))
    for n, t in enumerate(times_s):
        a, b, s = field.slot(float(t))
        hat[n, a] += 1 - s
        hat[n, b] += s
    used = (steps != 0).any(1)
    H = hat[used]
    smooth = np.linalg.solve(H.T @ H + 1e-3 * np.eye(H.shape[1]), H.T @ steps[used])
    return np.where(used[:, None], steps - hat @ smooth, 0.0)
