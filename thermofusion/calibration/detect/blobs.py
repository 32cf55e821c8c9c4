"""Grids of patches without any calibration: holes of a heated mask, circles, lamps; bright or dark."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import Float
from ..board.board import Board
from ..board.views import BoardPoints
from .color import upright

MIN_AREA_PX, MAX_AREA_SHARE = 12, 0.01
NEIGHBOUR_TOLERANCE = 0.3  # of a step: lens distortion and perspective bend a grid less from one point to the next
WINDOWS = (0.06, 0.12)  # of the image width, over which bright and dark are told apart


def detect_blobs(image: NDArray, board: Board) -> BoardPoints | None:
    """All points of a `mask`, `circles` or `lamps` board in one picture (H, W) of any type, or None.

    A board that is cut off is refused: on an unmarked grid nobody can tell which row is missing.
    """
    grey = _to_8bit(image)
    mask = board.kind == "mask"
    shape = (board.rows // 2, board.columns // 2) if mask else (board.rows, board.columns)
    best: tuple[Float, list[Float]] | None = None
    for window in WINDOWS:
        for polarity in (grey, 255 - grey):
            patches, quads = _patches(polarity, window, square=mask)
            grid = _grid(patches, shape)
            if grid is not None and (best is None or _bend(grid) < _bend(best[0])):
                best = upright(grid), quads
    if best is None:
        return None
    grid, quads = best
    px = _hole_corners(grid, quads) if mask else grid
    return BoardPoints(np.arange(len(board)), px.reshape(-1, 2))


def _hole_corners(grid: Float, quads: list[Float]) -> Float:
    """(2·rows, 2·columns, 2) corners of the holes, NaN where a hole's corners were not found; each hole's four are told
    apart along the grid's own axes."""
    rows, columns = grid.shape[:2]
    out = np.full((2 * rows, 2 * columns, 2), np.nan)
    if not quads:
        return out
    centers = np.array([q.mean(0) for q in quads])
    x_axis, y_axis = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    for j in range(rows):
        for i in range(columns):
            k = int(np.argmin(np.linalg.norm(centers - grid[j, i], axis=1)))
            d = quads[k] - grid[j, i]
            if np.linalg.norm(d.mean(0)) > 0.2 * np.linalg.norm(x_axis[j, i]):
                continue
            axes = np.linalg.solve(np.column_stack([x_axis[j, i], y_axis[j, i]]), d.T) > 0
            if len({tuple(a) for a in axes.T}) == 4:
                out[2 * j + axes[1], 2 * i + axes[0]] = quads[k]
    return out


def _to_8bit(image: NDArray) -> NDArray[np.uint8]:
    x = image.astype(np.float32)
    lo, hi = np.percentile(x, [0.5, 99.5])
    return np.clip((x - lo) * (255 / max(hi - lo, 1e-6)), 0, 255).astype(np.uint8)


def _patches(grey: NDArray[np.uint8], window: float, *, square: bool) -> tuple[Float, list[Float]]:
    """(N, 3) centres [px] and areas of compact bright patches; of squares also their (4, 2) corners."""
    block = int(window * grey.shape[1]) | 1
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.uint8)
    binary = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, block, -6)
    binary = cv2.morphologyEx(binary, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    contours, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    out, quads = [], []
    for c in contours:
        area = cv2.contourArea(c)
        if not _is_patch(c, area, grey.shape, square):
            continue
        m = cv2.moments(c)
        out.append([m["m10"] / m["m00"], m["m01"] / m["m00"], area])
        quad = _quad(smooth, c, area) if square else None
        if quad is not None:
            quads.append(quad)
    return np.array(out).reshape(-1, 3), quads


def _is_patch(contour: NDArray, area: float, shape: tuple[int, ...], square: bool) -> bool:
    """Whole in the picture, neither tiny nor huge, compact."""
    h, w = shape
    x, y, bw, bh = cv2.boundingRect(contour)
    if not MIN_AREA_PX < area < MAX_AREA_SHARE * h * w or min(x, y) <= 1 or x + bw >= w - 1 or y + bh >= h - 1:
        return False
    a, b = cv2.minAreaRect(contour)[1]
    hull = cv2.contourArea(cv2.convexHull(contour))
    return max(a, b) <= 3 * min(a, b) and area >= 0.8 * hull and area >= (0.72 if square else 0.6) * a * b


def _quad(smooth: NDArray[np.uint8], contour: NDArray, area: float) -> Float | None:
    """(4, 2) sub-pixel corners of a square hole, or None. Blur rounds all four alike, so that their errors cancel."""
    quad = cv2.approxPolyDP(contour, 0.12 * cv2.arcLength(contour, True), True)
    if len(quad) != 4:
        return None
    r = int(np.clip(0.2 * np.sqrt(area), 2, 6))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    p = cv2.cornerSubPix(smooth, quad.astype(np.float32), (r, r), (-1, -1), criteria).reshape(4, 2).astype(np.float64)
    return p if np.abs(p - quad.reshape(4, 2)).max() <= r + 1 else None


def _grid(patches: Float, want: tuple[int, int]) -> Float | None:
    """(rows, columns, 2) = `want` if the patches hold the whole board as one connected grid, and nothing more on it."""
    n = want[0] * want[1]
    if len(patches) < n:
        return None
    for start in np.argsort(np.linalg.norm(patches[:, :2] - np.median(patches[:, :2], axis=0), axis=1))[:6]:
        cells = _grow(patches, int(start))
        if len(cells) < n:
            continue
        ij = np.array(list(cells))
        lo, hi = ij.min(0), ij.max(0)
        shape = tuple(int(k) for k in (hi - lo + 1)[::-1])
        if len(cells) == n and shape in (want, want[::-1]):
            grid = np.zeros((*shape, 2))
            for (i, j), k in cells.items():
                grid[j - lo[1], i - lo[0]] = patches[k, :2]
            return grid if shape == want else np.swapaxes(grid, 0, 1)
    return None


def _grow(patches: Float, start: int) -> dict[tuple[int, int], int]:
    """Cells (i, j) -> patch, from one outwards: a neighbour stands where the last step points and is of like size."""
    p, area = patches[:, :2], patches[:, 2]
    d = np.linalg.norm(p - p[start], axis=1)
    near = [k for k in np.argsort(d)[1:9] if 0.5 < area[k] / area[start] < 2.0]
    if not near:
        return {}
    a = p[near[0]] - p[start]
    side = [k for k in near[1:] if abs(_angle(a, p[k] - p[start])) > 60 and abs(_angle(a, p[k] - p[start])) < 120]
    if not side:
        return {}
    b = p[side[0]] - p[start]
    cells, steps, queue = {(0, 0): start}, {(0, 0): (a, b)}, [(0, 0)]
    used = {start}
    while queue:
        cell = queue.pop(0)
        here = cells[cell]
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            target = (cell[0] + di, cell[1] + dj)
            if target in cells:
                continue
            a, b = steps[cell]
            step = di * a + dj * b
            distance = np.linalg.norm(p - (p[here] + step), axis=1)
            k = int(np.argmin(distance))
            fits = distance[k] < NEIGHBOUR_TOLERANCE * np.linalg.norm(step) and 0.55 < area[k] / area[here] < 1.8
            if not fits or k in used:
                continue
            new = (p[k] - p[here]) * (di + dj)
            steps[target] = (new, b) if di else (a, new)
            cells[target] = k
            used.add(k)
            queue.append(target)
    return cells


def _angle(a: Float, b: Float) -> float:
    return float(np.degrees(np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)))


def _bend(grid: Float) -> float:
    """How unevenly a grid steps: mean second difference over mean step."""
    bend = np.abs(np.diff(grid, 2, axis=0)).mean() + np.abs(np.diff(grid, 2, axis=1)).mean()
    return float(bend / np.abs(np.diff(grid, axis=1)).mean())
