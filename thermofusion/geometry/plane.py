"""Floors: the plane (4,) `[n, d]` with n·p + d the height above it in metres, in a surface and in a single view.

Both are RANSAC with a fixed seed, then least squares. They share no more than the draw: a surface has normals, areas
and an outside, so a vertex alone is a candidate; a view has points only, so three make one, and up is the camera's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import Float, Float32

FLOOR_BAND_M = 0.012  # a vertex this near to a plane belongs to it: depth noise plus a floor's own unevenness
FLOOR_NORMAL_COS = 0.94  # and its normal lies within 20° of the plane's
FLOOR_BELOW_FRACTION = 0.02  # of the surface may lie under the floor (reflections in it, noise)
FLOOR_MIN_AREA_M2 = 0.06  # less is no floor, rather the sole of a foot or a flat back
FLOOR_MIN_SPREAD_M = 0.06  # standard deviation along the floor patch's narrow side
FLOOR_HYPOTHESES = 400  # single vertices: a floor of a tenth of the surface is missed once in 10¹⁸ times
MIN_VERTICES = 100  # fewer are a speck
SURFACE_SAMPLE = 6000  # vertices that judge them: shares to a per cent

VIEW_HYPOTHESES = 200  # triples of points: a floor that fills a fifth of the view is missed once in five times
MAX_TILT_DEG = 45.0  # of the floor's normal against the camera's up: how far a walking person pitches a camera
VIEW_BAND_M = 0.012  # at 1 m, grows with range² beyond and shrinks with range before
MIN_POINTS, MIN_ON_PLANE = 200, 50  # of some 4800 looked at: fewer tell nothing
MIN_VIEW_SHARE = 0.04  # of the valid pixels
MAX_BELOW_SHARE = 0.02  # nothing lies below a floor
MIN_EXTENT_M = 0.11  # rms extent of the floor's narrower direction, at 1 m and beyond: less is a lap or a shoulder
MIN_HEIGHT = 0.15  # of the camera above the floor, as a share of the floor's distance: nobody films along a floor
SEED = 0  # same input, same floor


def floor_in_surface(vertices: Float32, normals: Float32, areas: Float, eyes: Float) -> Float | None:
    """The plane (4,) that the subject stands (or lies) on, or None.

    A floor is a large flat patch with all of the surface, and every camera, on the side its normals point to: on a
    body, which is convex nearly everywhere, the rest lies on the *other* side of a flat patch.

    vertices : (V, 3) m, with unit normals (V, 3) and areas (V,) m². eyes : (N, 3) camera centres, m.
    """
    if len(vertices) < MIN_VERTICES:
        return None
    sample, candidates = _drawn(len(vertices), FLOOR_HYPOTHESES, areas / areas.sum())
    X, N = vertices[sample].astype(np.float64), normals[sample].astype(np.float64)
    best, best_share = None, 0.0
    for i in candidates:
        height = (X - X[i]) @ N[i]
        if (height < -3 * FLOOR_BAND_M).mean() > 3 * FLOOR_BELOW_FRACTION:
            continue
        share = float(((np.abs(height) < 2 * FLOOR_BAND_M) & (N @ N[i] > FLOOR_NORMAL_COS)).mean())
        if share > best_share:
            best, best_share = np.append(N[i], -N[i] @ X[i]), share
    if best is None:
        return None
    return refine_floor(vertices, normals, areas, eyes, best)


def refine_floor(vertices: Float32, normals: Float32, areas: Float, eyes: Float, plane: Float) -> Float | None:
    """Least-squares plane (4,) through the vertices (V, 3) m near `plane` (4,), or None if they make no floor.

    normals, areas, eyes as in `floor_in_surface`.
    """
    X = vertices.astype(np.float64)
    for band in (2 * FLOOR_BAND_M, FLOOR_BAND_M, FLOOR_BAND_M):
        height = X @ plane[:3] + plane[3]
        on = (np.abs(height) < band) & (normals @ plane[:3].astype(np.float32) > FLOOR_NORMAL_COS)
        if on.sum() < MIN_ON_PLANE:
            return None
        w = areas[on] / areas[on].sum()
        centre = w @ X[on]
        spread, axes = np.linalg.eigh((X[on] - centre).T @ ((X[on] - centre) * w[:, None]))
        n = axes[:, 0] * np.sign(axes[:, 0] @ plane[:3])
        plane = np.append(n, -n @ centre)
    height = X @ plane[:3] + plane[3]
    below = areas[height < -2 * FLOOR_BAND_M].sum() / areas.sum()
    large = areas[on].sum() > FLOOR_MIN_AREA_M2 and np.sqrt(max(spread[1], 0)) > FLOOR_MIN_SPREAD_M
    cameras_above = (eyes @ plane[:3] + plane[3] > 0.1).all()
    return plane if large and cameras_above and below < FLOOR_BELOW_FRACTION else None


def floor_in_view(points: Float32) -> Float | None:
    """The plane (4,) of the floor among the points (N, 3) m of one view, in its camera's frame, or None.

    It is the lowest large plane, roughly level to the camera, with nothing below it.
    """
    p = points
    if len(p) < MIN_POINTS:
        return None
    _, (i, j, k) = _drawn(len(p), VIEW_HYPOTHESES)
    a, b, c = p[i], p[j], p[k]
    n = np.cross(b - a, c - a)
    length = np.linalg.norm(n, axis=1)
    n *= np.where(n[:, 1] > 0, -1, 1)[:, None]  # up is -y
    level = (length > 1e-6) & (-n[:, 1] > np.cos(np.radians(MAX_TILT_DEG)) * length)
    if not level.any():
        return None
    n, a = n[level] / length[level, None], a[level]
    tolerance = np.float32(VIEW_BAND_M) * np.maximum(p[:, 2], p[:, 2] ** 2)
    height = p @ n.T - np.einsum("ij,ij->i", n, a)
    on = (np.abs(height) < tolerance[:, None]).sum(0)
    below = (height < -2 * tolerance[:, None]).sum(0)
    best = int(np.argmax(on - 5 * below))
    if on[best] < MIN_VIEW_SHARE * len(p) or below[best] > MAX_BELOW_SHARE * len(p):
        return None
    return _refined_in_view(p, tolerance, np.append(n[best], -(n[best] @ a[best])).astype(np.float64))


def _refined_in_view(p: Float32, tolerance: Float32, plane: Float) -> Float | None:
    """Least-squares plane through the points (N, 3) near `plane`, or None if they are no floor's."""
    extent, inliers = 0.0, np.zeros(len(p), bool)
    for _ in range(3):
        inliers = np.abs(p @ plane[:3] + plane[3]) < tolerance
        if inliers.sum() < MIN_ON_PLANE:
            return None
        centre = p[inliers].mean(0)
        _, s, axes = np.linalg.svd(p[inliers] - centre, full_matrices=False)
        normal = axes[2] * (-1 if axes[2, 1] > 0 else 1)
        plane, extent = np.append(normal, -(normal @ centre)).astype(np.float64), float(s[1] / np.sqrt(inliers.sum()))
    distance = float(np.median(p[inliers, 2]))
    if plane[3] < MIN_HEIGHT * distance:
        return None
    return plane if extent > MIN_EXTENT_M * min(1.0, distance) else None


def _drawn(count: int, hypotheses: int, weights: Float | None = None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Random positions for either floor: points (M,) among `count`, and candidates among these points.

    With weights (count,) up to 6000 points are drawn by them, and a candidate is one of these, none twice: (H,).
    Without, all points are kept, and a candidate is three: (3, H).
    """
    rng = np.random.default_rng(SEED)
    if weights is None:
        return np.arange(count), rng.integers(0, count, (3, hypotheses))
    points = rng.choice(count, min(SURFACE_SAMPLE, count), p=weights)
    return points, rng.choice(len(points), min(hypotheses, len(points)), replace=False)
