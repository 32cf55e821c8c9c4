"""Mirrored pictures: a board seen in one has the wrong handedness, which no camera can make up for."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...errors import ScanError
from ...types import Float
from ..board.views import BoardPoints, CalibrationSet

MIRROR = np.diag([-1.0, 1.0, 1.0])
CLEARLY = 3.0  # times tighter a reflected relation must fit
MIN_COMMON_VIEWS = 4  # boards of two cameras: fewer fit a reflection by chance
AGREE_RAD = 0.1  # median angle of board normals, 6 deg; a reflection turns tilted boards by several times that


def handedness(points: BoardPoints, board_m: np.ndarray) -> float:
    """Sign of the area [px²] that the axes of board_m (N, 3) span in the picture: +1 seen from the front, -1 mirrored
    or from behind."""
    X = board_m[points.index][:, :2]
    A = np.linalg.lstsq(np.column_stack([X - X.mean(0), np.ones(len(X))]), points.px, rcond=None)[0]
    return float(np.sign(np.linalg.det(A[:2])))


def mirrored_cameras(data: CalibrationSet) -> dict[str, list[str]]:
    """Camera -> views whose points run round the wrong way."""
    board = data.board.points_m
    return {c: [v.name for v in data.seen_by(c) if handedness(v.points[c], board) < 0] for c in data.cameras}


def refuse_mirrored(data: CalibrationSet) -> None:
    """Raises ScanError if pictures are mirrored: all of a camera, or a few views numbered from the wrong corner."""
    for camera, views in mirrored_cameras(data).items():
        seen = len(data.seen_by(camera))
        if views and len(views) > 0.8 * seen:
            raise ScanError(
                f"the {camera} pictures are mirrored: the board's points run the wrong way round in {len(views)} of "
                f"{seen} views",
                hint=f'switch the driver\'s mirroring off, or write `"mirrored": ["{camera}"]` in calibration.json',
            )
        if views:
            raise ScanError(
                f"the {camera} points of {len(views)} views run the wrong way round ({', '.join(views[:5])})",
                hint="number them row by row from the same corner in every view, as seen from the front",
            )


def refuse_mirrored_pair(first: str, poses_a: Mapping[str, Float], second: str, poses_b: Mapping[str, Float]) -> None:
    """Raises ScanError if two cameras' board poses fit together only when one is mirrored.

    poses_a, poses_b : T_camera_board (4, 4), m, by view.

    Detected boards without marks are numbered as if seen from the front, so that a mirrored picture gives boards
    tilted the wrong way: the rotation between the cameras then changes from view to view.
    """
    both = [n for n in poses_a if n in poses_b]
    if len(both) < MIN_COMMON_VIEWS:
        return
    A, B = (np.stack([p[n][:3, :3] for n in both]) for p in (poses_a, poses_b))
    plain, flipped = _spread(B @ A.transpose(0, 2, 1)), _spread(MIRROR @ B @ MIRROR @ A.transpose(0, 2, 1))
    if flipped * CLEARLY < plain:
        raise ScanError(
            f"the {first} and the {second} pictures are mirrored against each other: boards turned to the left in one "
            "are turned to the right in the other",
            hint=f"switch the driver's mirroring off, or name {second} or {first} under `mirrored` in calibration.json",
        )


def fits_unmirrored(plain: tuple[Float, Float]) -> bool:
    """True if board normals (N, 3) of pictures and depth images agree up to one rotation."""
    return len(plain[0]) >= MIN_COMMON_VIEWS and _normal_misfit(*plain) < AGREE_RAD


def refuse_mirrored_depth(plain: tuple[Float, Float], flipped: tuple[Float, Float]) -> None:
    """Raises ScanError if depth images fit the pictures only when flipped left to right.

    plain, flipped : board normals (N, 3), unit length, as the hub sees them and as the depth images have them, as they
    are, flipped.
    """
    if len(flipped[0]) < MIN_COMMON_VIEWS:
        return
    misfit = _normal_misfit(*plain) if len(plain[0]) >= MIN_COMMON_VIEWS else np.inf
    if _normal_misfit(*flipped) * CLEARLY < misfit:
        raise ScanError(
            "the depth images are mirrored against the pictures: flipped left to right they fit",
            hint="switch the driver's mirroring off, or name `depth` under `mirrored` in calibration.json",
        )


def _spread(R: Float) -> float:
    """Median angle [rad] of rotations (N, 3, 3) from the one that agrees best."""
    trace = np.einsum("aij,bij->ab", R, R)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return float(np.median(angle, axis=1).min()) + 1e-3


def _normal_misfit(a: Float, b: Float) -> float:
    """Median angle [rad] between normals after the best proper rotation."""
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.median(np.arccos(np.clip(np.einsum("ni,ni->n", a, b @ R.T), -1, 1)))) + 1e-3
