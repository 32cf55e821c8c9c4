"""Which skin a region covers: vertices with weights, cut exactly at the border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Bool, Float, Int
from .body import Body
from .region import Brush, Lasso, Slab

MIN_FACING = 0.2  # cosine between the skin and a stroke's own normal: 78°, so that no other limb is taken


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of the surface.

    vertex : (N,) indices with weight. weight : (N,) m², what the surface's linear interpolation gives each vertex: the
    integral of a quantity is weight @ values[vertex]. inside : (N,) mask, the vertex itself lies inside (else only a
    triangle that the border cuts). area_m2 : of the skin, measured or not; the weights' sum is the measured area.
    """

    vertex: Int
    weight: Float
    inside: Bool
    area_m2: float

    def mean(self, values: NDArray) -> NDArray:
        """Mean over the measured area of values (V,) or (V, R) of any unit."""
        return np.asarray(self.weight @ values[self.vertex] / self.weight.sum())


def patch_of(region: Brush | Lasso | Slab, body: Body, measured: Bool) -> Patch:
    """The patch that a region covers.

    measured : (V,) mask of vertices with a temperature; a triangle with a corner without counts for the area only.
    """
    border_m = border_of(region, body)
    corners, share, centre = cut(body.triangles, border_m)
    a, b, c = (body.vertices_m[corners[:, k]] for k in range(3))
    area = share * np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    known = measured[corners].all(axis=1)
    shares = (area[known, None] * centre[known]).ravel()
    weight: Float = np.bincount(corners[known].ravel(), shares, len(border_m)).astype(np.float64)
    vertex = np.flatnonzero(weight > 0)
    return Patch(vertex.astype(np.int32), weight[vertex], border_m[vertex] < 0, float(area.sum()))


def border_of(region: Brush | Lasso | Slab, body: Body) -> Float:
    """(V,) m, a region's signed distance at every vertex: negative inside; NaN where the region cannot reach."""
    if isinstance(region, Brush):
        return _within_stroke(region, body)
    return _within_outline(region, body) if isinstance(region, Lasso) else _between_planes(region, body)


def cut(triangles: Int, border_m: Float) -> tuple[Int, Float, Float]:
    """Pieces of triangles (F, 3) where border_m (V,) m, linear on each, is negative.

    Their corners (N, 3), the share of the triangle (N,), and the piece's mean barycentric weights (N, 3). A triangle
    with two corners inside is the whole less its third corner's piece.
    """
    f = border_m[triangles]
    ok = np.isfinite(f).all(axis=1)
    inside = (f < 0).sum(axis=1)
    whole, one, two = (np.flatnonzero(ok & (inside == k)) for k in (3, 1, 2))
    third = np.full((len(whole), 3), 1 / 3)
    pieces = [(triangles[whole], np.ones(len(whole)), third)]
    for rows, lone_sign in ((one, -1), (two, 1)):
        values = f[rows]
        lone = ((values < 0) if lone_sign < 0 else (values >= 0)).argmax(axis=1)
        turn = (lone[:, None] + np.arange(3)) % 3
        corners = np.take_along_axis(triangles[rows], turn, axis=1)
        g = np.take_along_axis(values, turn, axis=1)
        s, t = g[:, 0] / (g[:, 0] - g[:, 1]), g[:, 0] / (g[:, 0] - g[:, 2])
        share, centre = s * t, np.stack([3 - s - t, s, t], axis=1) / 3
        if lone_sign > 0:
            left = np.maximum(1 - share, 1e-12)
            centre, share = (1 / 3 - share[:, None] * centre) / left[:, None], 1 - share
        pieces.append((corners, share, centre))
    corners, share, centre = (np.concatenate(column) for column in zip(*pieces, strict=True))
    return corners, share, centre


def _within_stroke(region: Brush, body: Body) -> Float:
    points, normals = np.array(region.points_m), np.array(region.normals)
    reach = region.radius_m + 0.02  # beyond the border's triangles nothing is asked
    near = np.unique(np.concatenate([np.asarray(x, np.int64) for x in body.tree.query_ball_point(points, reach)]))
    border = np.full(len(body.vertices_m), np.nan)
    if not len(near):
        return border
    v, n = body.vertices_m[near], body.normals[near]
    best = np.full(len(near), np.inf)
    for p, q in zip(points, normals, strict=True):
        facing = n @ (q / max(float(np.linalg.norm(q)), 1e-12)) > MIN_FACING
        best = np.where(facing, np.minimum(best, np.linalg.norm(v - p, axis=1) - region.radius_m), best)
    border[near] = np.where(np.isfinite(best), best, np.nan)
    seeds = body.tree.query(points)[1]
    return _joined(body, border, np.atleast_1d(seeds))


def _joined(body: Body, border_m: Float, seeds: NDArray) -> Float:
    """The border's function without the pieces inside it that hang together with no seed."""
    inside = border_m < 0
    kept = body.together(inside, seeds)
    return np.where(inside & ~kept, np.nan, border_m)


def _within_outline(region: Lasso, body: Body) -> Float:
    toward = np.array(region.toward_viewer)
    toward = toward / max(float(np.linalg.norm(toward)), 1e-12)
    across = np.cross([0.0, 1.0, 0.0] if abs(toward[1]) < 0.9 else [0.0, 0.0, 1.0], toward)
    across /= np.linalg.norm(across)
    plane = np.stack([across, np.cross(toward, across)])
    outline = np.array(region.outline_m) @ plane.T
    flat = body.vertices_m @ plane.T
    border = np.full(len(flat), np.nan)
    lo, hi = outline.min(axis=0) - 0.02, outline.max(axis=0) + 0.02
    near = np.flatnonzero(((flat > lo) & (flat < hi)).all(axis=1) & (body.normals @ toward > 0))
    if len(near):
        seen = near[~body.hidden(near, toward)]
        border[seen] = polygon_distance(flat[seen], outline)
    return border


def polygon_distance(points: Float, outline: Float) -> Float:
    """Signed distance (N,), negative inside, of points (N, 2) to a closed polygon outline (M, 2), in their unit (m)."""
    best, inside = np.full(len(points), np.inf), np.zeros(len(points), bool)
    x, y = points.T
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        d = b - a
        t = np.clip(((points - a) @ d) / max(float(d @ d), 1e-18), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - a - t[:, None] * d, axis=1))
        if a[1] != b[1]:
            inside ^= ((a[1] > y) != (b[1] > y)) & (x < a[0] + (y - a[1]) * d[0] / d[1])
    return np.where(inside, -best, best)


def _between_planes(region: Slab, body: Body) -> Float:
    axis, start = np.array(region.axis), np.array(region.point_m)
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    along = (body.vertices_m - start) @ axis
    border = np.maximum(-along, along - region.length_m)
    seed = body.tree.query(start + axis * region.length_m / 2)[1]
    return _joined(body, border, np.atleast_1d(seed))
