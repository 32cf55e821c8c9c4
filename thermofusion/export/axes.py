"""Which way is up and where the front is: a result's world frame may lie anyhow (a first depth camera's, say).

`ThermalMesh.metadata` carries `up` and `front` as "x y z" in the world frame: against gravity, and from the subject
toward the first camera. Files keep world coordinates; GLB's root node and the pictures turn them by these axes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ..types import Float

CAMERA_UP = (0.0, -1.0, 0.0)  # of a world that is the first depth camera's frame, held level: y down
CAMERA_FRONT = (0.0, 0.0, -1.0)  # toward that camera: it looks along +z
MIN_TURN = 0.02  # second eigenvalue of the cameras' right axes: sin²(8°), below which they span no plane


def view_axes(
    T_world_depth: Float,
    centre_m: ArrayLike,
    floor_normal: ArrayLike | None = None,
    depth_up: ArrayLike = CAMERA_UP,
) -> dict[str, str]:
    """The metadata entries `up` and `front` from T_world_depth (N, 4, 4) and the subject's centre_m (3,).

    floor_normal : (3,) unit, in the world; None = no floor found.
    depth_up : which way was up for the camera as it was held: (0, -1, 0), or (-1, 0, 0) turned by a quarter.
    up : the floor's normal where one was found. Else hand-held cameras are pitched at will but hardly rolled, so their
    right axes are level: up is what is perpendicular to all of them (smallest eigenvector of Σ r rᵀ), if they turn
    enough to span a plane, or else the mean of their own up axes. front : level, toward the first camera.
    """
    held = np.asarray(depth_up, np.float64)
    R = T_world_depth[:, :3, :3]
    right, own_up = R @ np.cross(CAMERA_FRONT, held), (R @ held).mean(axis=0)
    if floor_normal is not None:
        up = np.asarray(floor_normal, np.float64)
    else:
        share, axes = np.linalg.eigh(right.T @ right / len(right))
        up = axes[:, 0] if share[1] > MIN_TURN else own_up
    up = up * (1.0 if up @ own_up >= 0 else -1.0)
    R = axes_rotation(up, T_world_depth[0, :3, 3] - np.asarray(centre_m, np.float64))
    return {"up": axes_text(R[1]), "front": axes_text(R[2])}


def axes_of(metadata: Mapping[str, str | float]) -> Float:
    """(3, 3) rotation from world to (right, up, toward the viewer of the front), from `up` and `front`.

    Without them the world is taken for the first depth camera's frame. glTF's axes are the same three (y up, +z front).
    """
    up, front = (_vector(metadata.get(key)) for key in ("up", "front"))
    return axes_rotation(CAMERA_UP if up is None else up, CAMERA_FRONT if front is None else front)


def axes_rotation(up: ArrayLike, front: ArrayLike) -> Float:
    """Rotation (3, 3) with rows (right, up, front), unit vectors, from directions up and front (3,) of any length.

    `up` is kept, `front` made perpendicular to it.
    """
    u = np.asarray(up, np.float64)
    u = u / np.linalg.norm(u)
    candidates = (np.asarray(front, np.float64), np.array(CAMERA_FRONT), *np.eye(3))
    level = [c - (c @ u) * u for c in candidates]
    f = next(v for v in level if np.linalg.norm(v) > 1e-6)  # a front along up says nothing: take the next
    f = f / np.linalg.norm(f)
    return np.stack([np.cross(u, f), u, f])


def _vector(text: object) -> Float | None:
    """The vector of "x y z", or None where it is absent or unusable."""
    try:
        v = np.array([float(word) for word in str(text).split()])
    except ValueError:
        return None
    return v if v.shape == (3,) and np.isfinite(v).all() and np.linalg.norm(v) > 1e-9 else None


def axes_text(v: Float) -> str:
    """A direction (3,), unit, as metadata hold it."""
    return " ".join(f"{x:.9f}" for x in np.round(v, 9) + 0.0)
