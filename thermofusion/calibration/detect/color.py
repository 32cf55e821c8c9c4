"""Boards in colour pictures, by OpenCV."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import Float
from ..board.board import ARUCO_DICTIONARY, Board
from ..board.views import BoardPoints
from .corners import refine_corners

SB_FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
QUICK_PX = 480  # shorter side of the picture in which a board is looked for first


def detect_color(image: NDArray, board: Board) -> BoardPoints | None:
    """Board points in an 8-bit picture (H, W) or (H, W, 3), or None if the board is not found.

    Checkerboards are seen by their inner corners; of a pin board's rim the printed squares show no crossing, so that
    its inner (columns - 2) x (rows - 2) points are found.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if board.kind == "charuco":
        return _charuco(grey, board)
    if board.kind in ("circles", "asymmetric-circles", "lamps", "mask"):
        return _circles(grey, board)
    rim = 1 if board.kind == "pins" else 0
    size = (board.columns - 2 * rim, board.rows - 2 * rim)
    corners = _corners(grey, size)
    if corners is None:
        return None
    px = corners.reshape(size[1], size[0], 2).astype(np.float64)
    index = np.arange(len(board)).reshape(board.rows, board.columns)
    index = index[rim : board.rows - rim, rim : board.columns - rim]
    return BoardPoints(index.ravel(), refine_corners(grey, upright(px)).reshape(-1, 2))


def _corners(grey: NDArray, size: tuple[int, int]) -> NDArray | None:
    """(N, 2) inner corners, or None. A quick look at a smaller picture says where; searching that part saves 4/5."""
    if min(grey.shape) >= 2 * QUICK_PX:
        factor = min(grey.shape) // QUICK_PX
        small = cv2.resize(grey, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
        found, rough = cv2.findChessboardCornersSB(small, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if found:
            places = factor * rough.reshape(-1, 2)
            lo, hi = places.min(0), places.max(0)
            margin = 2.0 * (hi - lo).max() / (min(size) - 1) + factor
            u0, v0 = np.maximum(lo - margin, 0).astype(int)
            u1, v1 = (hi + margin).astype(int) + 1
            part = np.ascontiguousarray(grey[v0:v1, u0:u1])
            found, corners = cv2.findChessboardCornersSB(part, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
            if found:
                return corners.reshape(-1, 2) + np.array([u0, v0], np.float32)
    found, corners = cv2.findChessboardCornersSB(grey, size, flags=SB_FLAGS)
    return corners.reshape(-1, 2) if found else None


def upright(grid: Float) -> Float:
    """A detected grid (R, C, 2), px, renumbered so that it runs as seen from the front, rows rightwards.

    An unmarked board looks the same after half a turn (a square one after a quarter). All cameras of a rig hold their
    pictures upright, so the numbering nearest to upright is the same in all of them, unless the board was turned by
    more than 90 (45) degrees.
    """
    options = []
    for flipped in (grid, grid[:, ::-1]):
        for turns in range(4):
            g = np.rot90(flipped, turns)
            if g.shape != grid.shape:
                continue
            x, y = (g[:, -1] - g[:, 0]).mean(0), (g[-1] - g[0]).mean(0)
            if x[0] * y[1] - x[1] * y[0] > 0:
                options.append((x[0] / np.linalg.norm(x) + y[1] / np.linalg.norm(y), g))
    return max(options, key=lambda o: o[0])[1]


def _circles(grey: NDArray, board: Board) -> BoardPoints | None:
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "asymmetric-circles" else cv2.CALIB_CB_SYMMETRIC_GRID
    make: Any = cv2  # its stubs leave the blob detector out
    p = make.SimpleBlobDetector_Params()
    p.minArea, p.maxArea = 20, grey.size / 50
    p.minDistBetweenBlobs = 4
    for image in (grey, 255 - grey):  # dark on bright, bright on dark
        found, centers = cv2.findCirclesGrid(
            image,
            (board.columns, board.rows),
            flags=kind | cv2.CALIB_CB_CLUSTERING,
            blobDetector=make.SimpleBlobDetector_create(p),
        )
        if found:
            grid = centers.reshape(board.rows, board.columns, 2).astype(np.float64)
            if kind == cv2.CALIB_CB_SYMMETRIC_GRID:
                grid = upright(grid)
            return BoardPoints(np.arange(len(board)), grid.reshape(-1, 2))
    return None


def charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """OpenCV's board: `columns` x `rows` inner corners, so one square more each way."""
    dictionary = cv2.aruco.getPredefinedDictionary(ARUCO_DICTIONARY)
    size = (board.columns + 1, board.rows + 1)
    return cv2.aruco.CharucoBoard(size, board.spacing_m, board.spacing_m * board.mark_ratio, dictionary)


def _charuco(grey: NDArray, board: Board) -> BoardPoints | None:
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board(board)).detectBoard(grey)
    if ids is None or len(ids) < 6:
        return None
    return BoardPoints(np.ravel(ids), np.asarray(corners, np.float64).reshape(-1, 2))
