"""A first guess: every camera alone (Zhang), then how the cameras sit to each other."""

from __future__ import annotations

import cv2
import numpy as np

from ...errors import ScanError, counted
from ...geometry.rigid import invert
from ...types import Float
from ..board.views import BoardPoints, CalibrationSet
from .cameras import DISTORTION, TURN, matrix, to_rt

MIN_BOARD_VIEWS = 3  # of one camera: fewer leave focal length and principal point open (Zhang 2000)


def zhang(data: CalibrationSet, camera: str) -> tuple[Float, dict[str, Float]]:
    """Intrinsics (9,) with two radial terms and T_camera_board (4, 4), m, by view, by OpenCV.

    Raises ScanError if fewer than three views show the board.
    """
    views = data.seen_by(camera)
    if len(views) < MIN_BOARD_VIEWS:
        raise ScanError(
            f"the {camera} camera sees the board in {counted(len(views), 'view')}, {MIN_BOARD_VIEWS} are the least",
            hint="record 15 to 30 views, tilted to all sides, all over the picture",
        )
    board = data.board.points_m.astype(np.float32)
    size = data.image_size[camera]
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
    K = np.array([[1.2 * size[0], 0, (size[0] - 1) / 2], [0, 1.2 * size[0], (size[1] - 1) / 2], [0, 0, 1.0]])
    _, K, d, rv, tv = cv2.calibrateCamera(
        [board[v.points[camera].index] for v in views],
        [v.points[camera].px.astype(np.float32) for v in views],
        size,
        K,
        np.zeros(5),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT,
    )[:5]
    intrinsics = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.ravel(d)[:5]])
    poses = {}
    for view, r, t in zip(views, rv, tv, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(r)[0], np.ravel(t)
        poses[view.name] = T
    return intrinsics, poses


def board_pose(points: BoardPoints, board_m: Float, intrinsics: Float) -> Float:
    """T_camera_board (4, 4), m, from points seen of board_m (N, 3) and known intrinsics (9,): planar PnP, refined."""
    K = matrix(intrinsics)
    X, d = board_m[points.index], intrinsics[DISTORTION]
    _, rv, tv = cv2.solvePnP(X, points.px, K, d, flags=cv2.SOLVEPNP_IPPE)
    rv, tv = cv2.solvePnPRefineLM(X, points.px, K, d, rv, tv)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rv)[0], np.ravel(tv)
    return T


def common_transform(T: Float) -> Float:
    """The one of (N, 4, 4) transforms that agrees best with the others (medoid of angle + distance in units of 1 m)."""
    relative = invert(T)[:, None] @ T[None]
    angle = np.linalg.norm(to_rt(relative)[..., TURN], axis=-1)
    shift = np.linalg.norm(relative[..., :3, 3], axis=-1)
    return T[np.argmin(np.sum(np.minimum(angle + shift, 1.0), axis=1))]
