"""Orthographic views of a surface by ray casting: what each picture shows where. No OpenGL, no display.

A view is cast once and drawn as often as there are maps to show. Four rays per pixel where an edge crosses it, so that
edges are smooth; one where the surface is even: its colour there is that of the middle.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.rays import Hits, RayScene, barycentric
from ..types import Bool, Float, Float32, Int, SurfaceMesh

VIEWS = ("front", "back", "left", "right")
DOUBTS = ("uncertainty", "residual", "motion")  # maps that are drawn beside the temperature's, on one page each
RAYS = 2  # per pixel that an edge crosses, along each side
EVEN_PX = 4.0  # a step in depth of so many pixels from one to the next makes an edge: a slope of 76°
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
    """The surface as one orthographic view sees it.

    distance_m : (RAYS H, RAYS W) float32 from a plane before the surface, inf = background, row 0 on top. For the N
    rays that hit: pixel (N,) of the flattened (H, W) picture, share (N,) float32 of that pixel, corners (N, 3) int32
    vertices, weights (N, 3) float32 barycentric, facing (N,) float32 cosine between the triangle's outward normal and
    the direction to the viewer (negative: the surface from inside). px_per_m : scale.
    """

    name: str
    distance_m: Float32
    pixel: Int
    share: Float32
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
        """(H, W): sum over each pixel's rays of (N,) values times the ray's share."""
        h, w = self.shape
        return np.bincount(self.pixel, of_rays * self.share, h * w).astype(np.float32).reshape(h, w)


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


@dataclass(frozen=True, eq=False)
class _Look:
    """One view's picture, (h, w) px about the middle of the box, and its directions (3,) in the world."""

    middle_m: Float
    right: Float
    up: Float
    front: Float
    scale: float
    h: int
    w: int

    def hits(self, scene: RayScene, down_px: NDArray, across_px: NDArray) -> Hits:
        """Of rays through places (N,) px below and right of the picture's middle."""
        rays = np.empty((len(down_px), 6), np.float32)
        right, up = self.right.astype(np.float32), self.up.astype(np.float32)
        for k in range(3):
            rays[:, k] = self.middle_m[k] + across_px * (right[k] / self.scale) - down_px * (up[k] / self.scale)
        rays[:, 3:] = -self.front
        return scene.hits(rays)


def _cast(surface: SurfaceMesh, box: _Box, name: str, scale: float, h: int) -> Cast:
    (axis, sign), (depth_axis, depth_sign) = _DIRECTIONS[name]
    half = box.half
    w = int(np.ceil(2 * half[axis] * scale + 2 * MARGIN * h))
    front = depth_sign * box.axes[depth_axis]
    eye = box.middle @ box.axes + (half[depth_axis] + 0.1) * front
    look, scene = _Look(eye, sign * box.axes[axis], box.axes[1], front, scale, h, w), RayScene.of(surface)
    across, down = np.arange(w, dtype=np.float32) + 0.5 - w / 2, np.arange(h, dtype=np.float32) + 0.5 - h / 2
    # Only the surface's own rectangle is cast.
    columns = np.flatnonzero(np.abs(across) <= half[axis] * scale + 1)
    rows = np.flatnonzero(np.abs(down) <= half[1] * scale + 1)
    block = np.ix_(rows, columns)
    once = look.hits(scene, np.repeat(down[rows], len(columns)), np.tile(across[columns], len(rows)))
    middle, facing = np.full((h, w), np.inf, np.float32), np.zeros((h, w), np.float32)
    middle[block] = once.distance.reshape(len(rows), len(columns))
    facing[block] = (once.normal @ front.astype(np.float32)).reshape(len(rows), len(columns))
    edge = _edges(middle, facing < 0, EVEN_PX / scale)
    row, column = np.nonzero(edge)
    part = (np.arange(RAYS, dtype=np.float32) + 0.5) / RAYS - 0.5
    shape = (len(row), RAYS, RAYS)
    finer = look.hits(
        scene,
        np.broadcast_to(down[row, None, None] + part[:, None], shape).ravel(),
        np.broadcast_to(across[column, None, None] + part, shape).ravel(),
    )
    distance = np.repeat(np.repeat(middle, RAYS, axis=0), RAYS, axis=1)
    distance.reshape(h, RAYS, w, RAYS)[row, :, column] = finer.distance.reshape(shape)
    pixel = (rows[:, None] * w + columns).ravel(), np.repeat(row * w + column, RAYS**2)
    kept = np.flatnonzero((once.triangle >= 0) & ~edge[block].ravel()), np.flatnonzero(finer.triangle >= 0)
    found = list(zip((once, finer), kept, strict=True))
    return Cast(
        name,
        distance,
        np.concatenate([p[k] for p, k in zip(pixel, kept, strict=True)]).astype(np.int32),
        np.repeat(np.array([1, 1 / RAYS**2], np.float32), [len(k) for k in kept]),
        surface.triangles.take(np.concatenate([f.triangle[k] for f, k in found]), axis=0),
        barycentric(np.concatenate([f.uv.take(k, axis=0) for f, k in found])),
        np.concatenate([f.normal.take(k, axis=0) for f, k in found]) @ front.astype(np.float32),
        scale,
    )


def _edges(distance_m: Float32, inside: Bool, step_m: float) -> Bool:
    """(H, W) pixels next to, or one from, a step in depth, or where the surface's inside begins or ends."""
    near, edge = np.minimum(distance_m, np.float32(1e6)), np.zeros(distance_m.shape, bool)
    across = (np.abs(np.diff(near, axis=1)) > step_m) | (inside[:, 1:] != inside[:, :-1])
    down = (np.abs(np.diff(near, axis=0)) > step_m) | (inside[1:] != inside[:-1])
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    wide = edge.copy()
    wide[1:] |= edge[:-1]
    wide[:-1] |= edge[1:]
    edge = wide.copy()
    edge[:, 1:] |= wide[:, :-1]
    edge[:, :-1] |= wide[:, 1:]
    return edge
