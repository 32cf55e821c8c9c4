"""Dark squares that a structured-light camera loses: where the board lies *across* the depth image.

Planes say nothing about a shift of the depth camera along the board. But black squares reflect too little infrared at a
slant, and their dropouts draw the checkerboard into the depth image. The shift between that drawing and the predicted
one is a measurement in pixels, good to a fraction of one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import Camera, Float
from ..board.board import Board
from ..board.views import BoardPoints

MIN_LOST_SHARE, MAX_LOST_SHARE = 0.05, 0.5  # of the board's pixels: fewer or more draw no squares
MIN_CORRELATION = 0.25  # of lost pixels with drawn squares, -1 to 1; what agrees less may do so by chance
MIN_SQUARE_PX = 5.0  # smaller squares blur into each other over the camera's matching window
MARK_SIGMA_PX = 0.8  # one sigma of a view's shift: the squares' dropouts are ragged by the matching window


@dataclass(frozen=True, eq=False)
class Dropout:
    """shift_px : (2,) of the drawing against the prediction. correlation : signed, with the squares of even parity."""

    shift_px: Float
    correlation: float
    marks: BoardPoints  # board corners moved by the shift


def register_dropouts(image: NDArray, camera: Camera, T_depth_board: Float, board: Board) -> Dropout | None:
    """Shift [px] of a depth `image` (H, W), NaN or 0 lost, from the board at `T_depth_board` (4, 4), or None where its
    dropouts draw no board."""
    X = board.points_m
    P = camera.K @ (X @ T_depth_board[:3, :3].T + T_depth_board[:3, 3]).T
    px = (P[:2] / P[2]).T
    grid = px.reshape(board.rows, board.columns, 2)
    across, down = np.diff(grid, axis=1), np.diff(grid, axis=0)
    side = float(min(np.linalg.norm(across, axis=2).min(), np.linalg.norm(down, axis=2).min()))
    if side < MIN_SQUARE_PX:
        return None
    lo, hi = np.floor(px.min(0)).astype(int), np.ceil(px.max(0)).astype(int) + 1
    reach = int(side / 2 + 1)
    if (lo - reach < 0).any() or (hi + reach > [camera.width_px, camera.height_px]).any():
        return None
    H = np.linalg.inv(camera.K @ np.column_stack([T_depth_board[:3, :2], T_depth_board[:3, 3]]))
    u, v = np.meshgrid(np.arange(lo[0], hi[0]), np.arange(lo[1], hi[1]))
    q = np.einsum("ij,jhw->ihw", H, np.stack([u, v, np.ones_like(u)]).astype(np.float64))
    x, y = q[0] / q[2] / board.spacing_m, q[1] / q[2] / board.spacing_m
    inside = (x > 0) & (x < board.columns - 1) & (y > 0) & (y < board.rows - 1)
    lost = ~(np.isfinite(image) & (image > 0))
    region = lost[lo[1] - reach : hi[1] + reach, lo[0] - reach : hi[0] + reach].astype(np.float32)
    share = float(lost[lo[1] : hi[1], lo[0] : hi[0]][inside].mean())
    if not MIN_LOST_SHARE < share < MAX_LOST_SHARE:
        return None
    pattern = np.where(inside, (np.floor(x) + np.floor(y)) % 2, 0).astype(np.float32)
    pattern[inside] -= pattern[inside].mean()
    score: NDArray = cv2.matchTemplate(region, pattern, cv2.TM_CCORR)
    score = score / float(np.sqrt((pattern**2).sum() * inside.sum() * share * (1 - share)))
    j, i = np.unravel_index(np.argmax(np.abs(score)), score.shape)
    if abs(score[j, i]) < MIN_CORRELATION or not (0 < j < score.shape[0] - 1 and 0 < i < score.shape[1] - 1):
        return None
    a = np.abs(score)
    shift = np.array([i - reach + _peak(a[j, i - 1 : i + 2]), j - reach + _peak(a[j - 1 : j + 2, i])])
    c, r = board.columns, board.rows
    corners = np.array([0, c - 1, (r - 1) * c, r * c - 1])
    return Dropout(shift, float(score[j, i]), BoardPoints(corners, px[corners] + shift))


def agreeing(found: dict[str, Dropout]) -> dict[str, Dropout]:
    """Those whose lost squares have the parity of the majority: a board's black squares stay black."""
    if not found:
        return {}
    sign = np.sign(sum(d.correlation for d in found.values()))
    return {n: d for n, d in found.items() if d.correlation * sign > 0}


def _peak(y: NDArray) -> float:
    """Place of the top of a parabola through three neighbours, -0.5 to 0.5."""
    d = float(y[0] - 2 * y[1] + y[2])
    return 0.0 if d >= 0 else float(np.clip(0.5 * (y[0] - y[2]) / d, -0.5, 0.5))
