"""Depth on the board: which pixels, which of them belong to its plane, averaged over small cells."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...geometry.camera import project, undistort
from ...robust import mad_sigma
from ...types import Camera, Float
from ..board.views import DepthSamples

CELLS = 14  # cells across the longer side of the board
MIN_PIXELS = 200  # fewer depth pixels on a board say nothing reliable
MIN_CELLS = 8  # fewer cells leave tilt and distance of the plane to chance
FIT_PIXELS = 3000  # of a board, evenly spread: the plane's three numbers need no more
MIN_CORNER_M = 0.05  # along z: nearer to the pupil a pixel says nothing on where the corner is
NO_DISPARITY = 2047  # a Kinect's eleven bits of 1: nothing was seen
METRIC_NOISE = 1.5e-3  # m at 1 m, growing as range² (Kinect v1: Khoshelham & Elberink 2012 give 1.4e-3)
QUANTUM_DISPARITY = 0.5  # counts
CORRELATED_PIXELS = 9.0  # a structured-light camera's pixels are not independent within its matching window


def sample_board(
    image: NDArray, camera: Camera, T_depth_board: Float, outline_m: Float, *, disparity: bool = False
) -> DepthSamples | None:
    """Samples of one view, or None if the board shows too little depth.

    image : (H, W) m along z (NaN none) or raw disparity (0 or >= 2047 none). T_depth_board : (4, 4). outline_m : (4, 3)
    board corners.
    On a plane 1/z (and a disparity) is an affine function of the pixel: what departs from the robust affine fit is
    another surface, a pin or a flying pixel.
    """
    mask = _board_mask(image.shape, camera, outline_m @ T_depth_board[:3, :3].T + T_depth_board[:3, 3])
    if mask is None:
        return None
    value = image.astype(np.float64)
    valid = (value > 0) & (value < NO_DISPARITY) if disparity else np.isfinite(value) & (value > 0)
    v, u = np.nonzero(mask & valid)
    if len(u) < MIN_PIXELS:
        return None
    y = value[v, u] if disparity else 1 / value[v, u]
    fitted, kept, spread = _on_plane(u, v, y)
    u, v, fitted, raw = u[kept], v[kept], fitted[kept], value[v, u][kept]
    if len(u) < MIN_PIXELS:
        return None
    side = max(np.ptp(u), np.ptp(v)) / CELLS + 1e-9
    cell = ((v - v.min()) / side).astype(int) * (CELLS + 2) + ((u - u.min()) / side).astype(int)
    _, which, count = np.unique(cell, return_inverse=True, return_counts=True)
    full = count >= max(4, 0.25 * np.median(count))
    if full.sum() < MIN_CELLS:
        return None

    def mean(a: NDArray) -> Float:
        return (np.bincount(which, a) / count)[full]

    # averaged as reported (noise is symmetric there), relative to the plane: mean(1/z) alone would be too near
    level = mean(fitted)
    out = level + mean(raw - fitted) if disparity else (1 + mean(raw * fitted - 1)) / level
    noise: NDArray | float = max(spread, QUANTUM_DISPARITY) if disparity else max(spread, METRIC_NOISE) * out**2
    sigma = np.broadcast_to(noise, out.shape)
    px, py = _straightened(camera, mean(u), mean(v))
    return DepthSamples(px, py, out, sigma / np.sqrt(np.maximum(count[full] / CORRELATED_PIXELS, 1)))


def _board_mask(shape: tuple[int, ...], camera: Camera, corners_m: Float) -> NDArray[np.bool_] | None:
    """Pixels of an image between projected corners (4, 3), or None if one is beyond the lens."""
    if (corners_m[:, 2] <= MIN_CORNER_M).any():
        return None
    polygon = project(camera, corners_m)[0]
    if not np.isfinite(polygon).all():
        return None
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, np.round(polygon).astype(np.int32), 1)
    return mask > 0


def _straightened(camera: Camera, u: Float, v: Float) -> tuple[Float, Float]:
    """Pixels as the same lens without distortion would have them: the plane's depth is taken along straight rays."""
    if not np.any(camera.distortion):
        return u, v
    K = camera.K
    x, y = undistort((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], camera.distortion)
    return x * K[0, 0] + K[0, 2], y * K[1, 1] + K[1, 2]


def _on_plane(u: NDArray, v: NDArray, y: Float) -> tuple[Float, NDArray, float]:
    """The robust affine fit at the pixels, those within 4 sigmas of it, and that sigma [unit of y]."""
    A = np.stack([u - u.mean(), v - v.mean(), np.ones(len(u))], axis=1).astype(np.float64)
    A[:, :2] /= max(np.ptp(u), np.ptp(v), 1)
    some = slice(None, None, max(1, len(y) // FIT_PIXELS))
    a, b, weight = A[some], y[some], np.ones(len(y[some]))
    coefficients: NDArray = np.zeros(3)
    scale = 1.0
    for _ in range(20):
        AtW = a.T * weight
        coefficients = np.linalg.solve(AtW @ a + 1e-12 * np.eye(3), AtW @ b)
        r = b - a @ coefficients
        scale = mad_sigma(r) + 1e-9
        weight = 1 / (1 + (r / (2 * scale)) ** 2) ** 2
    fitted = A @ coefficients
    return fitted, np.abs(y - fitted) < 4 * scale, scale
