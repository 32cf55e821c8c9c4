"""The colour camera's view of the surface: a robust mean per vertex, for people who want to see skin."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project, viewing_cosine
from ..geometry.rigid import interpolate_trajectory, invert, transform_points
from ..types import Camera, Float, Float32, Scan, SurfaceMesh, Trajectory, UInt8

MAX_VIEWS = 30  # each vertex of a walk round is then seen about ten times
MIN_COS = 0.3  # views more oblique than 72° carry no colour worth having
CELL_PX = 4  # of the coarse depth buffer
HIDDEN_M = 0.02  # a vertex this far behind the nearest surface in its cells is hidden, more where it slopes
OUTLIER_LEVELS = 20.0  # of 255: farther from the mean than this a view counts little (highlights, stray occlusion)
UNSEEN = (128, 128, 128)  # vertices that no colour frame saw


def color_vertices(scan: Scan, trajectory: Trajectory, mesh: SurfaceMesh, max_gap_s: float) -> UInt8 | None:
    """(V, 3) uint8 sRGB of a mesh's vertices from up to 30 colour frames, grey where none saw them; None without
    colour.

    Every view is projected with the camera's full distortion at the frame's own time; weight cos²θ / range². The mean
    is taken twice, the second time with views that disagree with the first mean weighted down.
    """
    vertices, normals = mesh.vertices_m, mesh.normals
    color, camera = scan.color, scan.rig.color
    if color is None or camera is None or scan.rig.T_color_depth is None:
        return None
    T, valid = interpolate_trajectory(trajectory, color.times_s, max_gap_s=max_gap_s)
    usable = np.flatnonzero(valid & color.usable)
    if len(usable) == 0:
        return None
    pick = usable[np.unique(np.linspace(0, len(usable) - 1, MAX_VIEWS).astype(int))]
    T_depth_color = invert(scan.rig.T_color_depth)

    def look(i: int) -> tuple[NDArray[np.intp], Float32, Float32]:
        return _look(camera, T[i] @ T_depth_color, color.load(int(i)), vertices, normals)

    with ThreadPoolExecutor(2) as pool:
        views = list(pool.map(look, pick))
    mean = _mean(views, len(vertices), None)
    mean = _mean(views, len(vertices), mean)
    seen = np.isfinite(mean[:, 0])
    out = np.empty((len(vertices), 3), np.uint8)
    out[:] = UNSEEN
    out[seen] = np.rint(np.clip(mean[seen], 0, 255)).astype(np.uint8)
    return out


def _look(
    camera: Camera, T_world_color: Float, image: UInt8, vertices: Float32, normals: Float32
) -> tuple[NDArray[np.intp], Float32, Float32]:
    """What one view sees: vertices (N,), their colours (N, 3), their weights (N,)."""
    facing = viewing_cosine(vertices, normals, T_world_color[:3, 3])
    near = np.flatnonzero(facing > MIN_COS)
    uv, z = project(camera, transform_points(invert(T_world_color), vertices[near]))
    h, w = camera.shape
    u, v = (np.nan_to_num(uv[:, i], nan=-1.0) for i in range(2))
    inside = (u >= 0) & (u <= w - 1) & (v >= 0) & (v <= h - 1)
    near, u, v, z = near[inside], u[inside], v[inside], z[inside]
    cos = facing[near]
    slope = np.sqrt(np.maximum(1 - cos**2, 0)) / cos * z * np.float32(1.5 * CELL_PX / camera.focal_px)
    visible = z < _nearest(u, v, z, camera) + HIDDEN_M + slope
    near, u, v, z = near[visible], u[visible], v[visible], z[visible]
    pixel = np.rint(v).astype(np.intp) * w + np.rint(u).astype(np.intp)
    rgb = image.reshape(-1, 3).take(pixel, axis=0).astype(np.float32)
    return near, rgb, (facing[near] ** 2 / z**2).astype(np.float32)


def _nearest(u: Float32, v: Float32, z: Float32, camera: Camera) -> Float32:
    """Smallest z among the vertices in the cell of each and its eight neighbours."""
    rows, cols = camera.height_px // CELL_PX + 3, camera.width_px // CELL_PX + 3
    cell = ((v / CELL_PX).astype(np.intp) + 1) * cols + (u / CELL_PX).astype(np.intp) + 1
    grid = np.full((rows, cols), np.inf, np.float32)
    np.minimum.at(grid.ravel(), cell, z)
    wide = np.minimum(np.minimum(grid[:-2], grid[1:-1]), grid[2:])
    full = np.full_like(grid, np.inf)
    full[1:-1, 1:-1] = np.minimum(np.minimum(wide[:, :-2], wide[:, 1:-1]), wide[:, 2:])
    return full.ravel().take(cell)


def _mean(views: list[tuple[NDArray[np.intp], Float32, Float32]], count: int, around: Float32 | None) -> Float32:
    """(count, 3) weighted mean colour, NaN where unseen; with `around`, Cauchy weights about that mean."""
    total, weight = np.zeros((count, 3), np.float32), np.zeros((count, 1), np.float32)
    for vertex, rgb, w in views:
        if around is not None:
            w = w / (1 + ((rgb - around[vertex]) ** 2).sum(1) / (3 * OUTLIER_LEVELS**2))
        total[vertex] += w[:, None] * rgb  # a view holds each vertex once
        weight[vertex, 0] += w
    with np.errstate(invalid="ignore"):
        return np.where(weight > 0, total / weight, np.float32(np.nan))
