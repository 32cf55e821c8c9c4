"""Triangle meshes as plain arrays: order, pieces, floor, smoothing, normals. NumPy and SciPy, no Open3D, no files."""

from __future__ import annotations

import numpy as np

from ..types import Float, Float32

FLOOR_BAND_M = 0.012  # a vertex this near to a plane belongs to it: depth noise plus a floor's own unevenness
FLOOR_NORMAL_COS = 0.94  # and its normal lies within 20° of the plane's
FLOOR_BELOW_FRACTION = 0.02  # of the surface may lie under the floor (reflections in it, noise)
FLOOR_MIN_AREA_M2 = 0.06  # less is no floor, rather the sole of a foot or a flat back
FLOOR_MIN_SPREAD_M = 0.06  # standard deviation along the floor patch's narrow side
FLOOR_HYPOTHESES = 400


# ---------------------------------------------------------------- the floor


def find_floor(vertices: Float32, normals: Float32, areas: Float, eyes: Float, *, seed: int = 0) -> Float | None:
    """The plane (4,) `[n, d]` that the subject stands (or lies) on, or None; n·p + d is the height above it [m].

    A floor is a large flat patch with all of the surface, and every camera, on the side its normals point to: on a
    body, which is convex nearly everywhere, the rest lies on the *other* side of a flat patch. RANSAC over single
    vertices with their normals, then least squares over the inliers.

    vertices, normals : (V, 3); areas : (V,) m²; eyes : (N, 3) camera centres.
    """
    if len(vertices) < 100:
        return None
    rng = np.random.default_rng(seed)
    p = areas / areas.sum()
    sample = rng.choice(len(vertices), min(6000, len(vertices)), p=p)  # area-uniform
    X, N = vertices[sample].astype(np.float64), normals[sample].astype(np.float64)
    best, best_share = None, 0.0
    for i in rng.choice(len(sample), min(FLOOR_HYPOTHESES, len(sample)), replace=False):
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
    """Least-squares plane through the vertices near `plane` (4,), or None if they make no floor (see `find_floor`)."""
    X = vertices.astype(np.float64)
    for band in (2 * FLOOR_BAND_M, FLOOR_BAND_M, FLOOR_BAND_M):
        height = X @ plane[:3] + plane[3]
        on = (np.abs(height) < band) & (normals @ plane[:3].astype(np.float32) > FLOOR_NORMAL_COS)
        if on.sum() < 50:
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
