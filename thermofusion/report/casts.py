"""Orthographic views of a surface by ray casting: what each picture shows where. No OpenGL, no display.

A view is cast once and drawn as often as there are maps to show. Four rays per pixel, so that edges are smooth.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.rays import RayScene, barycentric
from ..types import Float, Float32, Int, SurfaceMesh

VIEWS = ("front", "back", "left", "right")
DOUBTS = ("uncertainty", "residual", "motion")  # maps that are drawn beside the temperature's, on one page each
RAYS = 2  # per pixel, along each side
MARGIN = 0.02  # of the picture's height, round the surface
MAX_ASPECT = 4.2  # width over height of all views side by side: four of a ball fit, and a floor stays small
# Of each view: the picture's right and the direction to the viewer, as (axis, sign) of (right, up, front). "left" is
# the left side of somebody who faces the viewer of "front".
_DIRECTIONS = {
    "front": ((0, 1), (2, 1)),
    "back": ((0, -1), (2, -1)),
    "left": ((2, -1), (0, 1)),
    "right": ((2, 1), (0, -1)),
}


@dataclass(frozen=True, eq=False)
class Cast:
    """The surface as one orthographic view sees it; rays in a (RAYS H, RAYS W) grid, row 0 on top.

    distance_m : (RAYS H, RAYS W) float32 from a plane before the surface, inf = background. For the N rays that hit:
    pixel (N,) of the flattened (H, W) picture, corners (N, 3) int32 vertices, weights (N, 3) float32 barycentric,
    facing (N,) float32 cosine between the triangle's outward normal and the direction to the viewer (negative: the
    surface from inside). px_per_m : scale.
    """

    name: str
    distance_m: Float32
    pixel: Int
    corners: Int
    weights: Float32
    facing: Float32
    px_per_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the picture, px."""
        h, w = self.distance_m.shape
        return h // RAYS, w // RAYS

    def interpolate(self, values: NDArray) -> Float32:
        """(N,) where the rays hit, of values (V,) of any unit; NaN where a corner of the triangle has none."""
        v = np.asarray(values, np.float32)[self.corners] * self.weights
        return v[:, 0] + v[:, 1] + v[:, 2]

    def per_pixel(self, of_rays: NDArray) -> Float32:
        """(H, W): sum over each pixel's rays of (N,) values, divided by the rays of a pixel."""
        h, w = self.shape
        return (np.bincount(self.pixel, of_rays, h * w) / RAYS**2).astype(np.float32).reshape(h, w)


def cast_views(
    surface: SurfaceMesh,
    axes: Float,
    height_px: int,
    *,
    views: tuple[str, ...] = VIEWS,
) -> list[Cast]:
    """Cast views of one scale, `height_px` high and together at most MAX_ASPECT times as wide.

    axes : (3, 3), rows right, up and front in the world frame (`export.axes_of`). Raises ValueError for a surface
    without triangles.
    """
    if not len(surface.triangles):
        raise ValueError("a surface without triangles cannot be drawn")
    used = np.zeros(len(surface), bool)
    used[surface.triangles.ravel()] = True
    local = surface.vertices_m.astype(np.float64) @ axes.T
    lo, hi = local[used].min(axis=0), local[used].max(axis=0)
    half = (hi - lo) / 2
    frame_px = 2 * MARGIN * height_px
    width_m = sum(2 * half[_DIRECTIONS[name][0][0]] for name in views)
    room_px = MAX_ASPECT * height_px - len(views) * frame_px
    scale = float(min((height_px - frame_px) / max(2 * half[1], 1e-6), room_px / max(width_m, 1e-6)))
    box = _Box((lo + hi) / 2, half, axes)
    with ThreadPoolExecutor(max_workers=2) as pool:
        return list(pool.map(lambda name: _cast(surface, box, name, scale, height_px), views))


@dataclass(frozen=True, eq=False)
class _Box:
    """Middle and half sizes (3,) m of a surface along right, up and front, the rows of axes (3, 3)."""

    middle: Float
    half: Float
    axes: Float


def _cast(surface: SurfaceMesh, box: _Box, name: str, scale: float, h: int) -> Cast:
    (axis, sign), (depth_axis, depth_sign) = _DIRECTIONS[name]
    half, triangles = box.half, surface.triangles
    w = int(np.ceil(2 * half[axis] * scale + 2 * MARGIN * h))
    distance = np.full((RAYS * h, RAYS * w), np.inf, np.float32)
    across = (np.arange(RAYS * w, dtype=np.float32) + 0.5) / RAYS - w / 2  # px from the middle
    down = (np.arange(RAYS * h, dtype=np.float32) + 0.5) / RAYS - h / 2
    # Only the surface's own rectangle is cast.
    columns = np.flatnonzero(np.abs(across) <= half[axis] * scale + 1)
    rows = np.flatnonzero(np.abs(down) <= half[1] * scale + 1)
    block = np.ix_(rows, columns)
    right, up, front = sign * box.axes[axis], box.axes[1], depth_sign * box.axes[depth_axis]
    eye = box.middle @ box.axes + (half[depth_axis] + 0.1) * front
    rays = np.empty((len(rows), len(columns), 6), np.float32)
    np.add(
        (eye - np.multiply.outer(down[rows] / scale, up)).astype(np.float32)[:, None],
        np.multiply.outer(across[columns] / scale, right).astype(np.float32),
        out=rays[..., :3],
    )
    rays[..., 3:] = -front
    found = RayScene.of(surface).hits(rays.reshape(-1, 6))
    distance[block] = found.distance.reshape(len(rows), len(columns))
    hit = np.flatnonzero(found.triangle >= 0)
    row, column = rows[hit // len(columns)], columns[hit % len(columns)]
    weights, corners = barycentric(found.uv[hit]), triangles[found.triangle[hit]]
    facing = found.normal[hit] @ front.astype(np.float32)
    pixel = ((row // RAYS) * w + column // RAYS).astype(np.int32)
    return Cast(name, distance, pixel, corners, weights, facing, scale)
