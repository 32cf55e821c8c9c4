"""Depth frames of a moving subject, brought to rest: as the camera would have seen them had the subject not moved.

The surface at rest is cast from the frame's camera; at each pixel the nodes say where that surface point was at the
frame's time, and its depth is fetched there. One look-up a pixel, of the nearest pixel: depths are never mixed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.rays import RayScene, rays_from
from ..types import Bool, Camera, Float, Float32, Int
from .field import MotionField, affine
from .graph import Binding

STEP_PX = 4  # the displacement is cast on every fourth pixel: it is smooth
CARRY_PX = 4  # steps by which it is carried on beyond the surface's outline, so that what the model lacks is not lost
OFF_M = 0.06  # depth farther than this from the surface at rest is not the subject's


@dataclass(frozen=True, eq=False)
class RestSurface:
    """The surface at rest, to be cast. vertices (V, 3) m, triangles (F, 3), binding of the vertices."""

    vertices_m: Float32
    triangles: Int
    binding: Binding
    field: MotionField


def _stack_rays(u: Float, v: Float, K: Float) -> Float32:
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1).astype(np.float32)


class Warp:
    """Brings depth frames to rest."""

    def __init__(self, surface: RestSurface, camera: Camera) -> None:
        self._surface, self._camera = surface, camera
        self._scene = RayScene(surface.vertices_m, surface.triangles)
        h, w = camera.shape
        K = camera.K
        s = STEP_PX
        u, v = np.meshgrid(np.arange((s - 1) / 2, w, s), np.arange((s - 1) / 2, h, s))
        self._rays = _stack_rays(u, v, K)
        self._u, self._v = (g.astype(np.float32) for g in np.meshgrid(np.arange(w), np.arange(h)))
        vertices = surface.vertices_m
        self._low, self._high = vertices.min(0), vertices.max(0)

    def __call__(self, depth_m: Float32, T_world_depth: Float, time_s: float) -> Float32:
        """depth_m (H, W) at rest, NaN where nothing is seen; below 0 where the look goes past the subject: minus the
        depth of what stands behind. Without it fingers swell, for nothing says where they end."""
        box = self._box(T_world_depth)
        out = np.full(depth_m.shape, np.nan, np.float32)
        if box is None:
            return out
        rays = self._rays[box]
        R, eye = T_world_depth[:3, :3].astype(np.float32), T_world_depth[:3, 3].astype(np.float32)
        hits = self._scene.hits(rays_from(eye, (rays.reshape(-1, 3) @ R.T)))
        z = hits.distance.reshape(rays.shape[:2])  # rays have z = 1 in the camera: their length is depth
        seen = np.isfinite(z)
        if not seen.any():
            return out
        shift = self._shift(rays, z, seen, hits.triangle, T_world_depth, time_s)
        field = self._carried(shift, z, seen)
        s = STEP_PX
        rows = slice(box[0].start * s, min(box[0].stop * s, depth_m.shape[0]))
        columns = slice(box[1].start * s, min(box[1].stop * s, depth_m.shape[1]))
        size = (columns.stop - columns.start, rows.stop - rows.start)
        full = cv2.resize(field, (rays.shape[1] * s, rays.shape[0] * s), interpolation=cv2.INTER_LINEAR)
        full = full[: size[1], : size[0]]
        there = cv2.remap(
            depth_m,
            self._u[rows, columns] + full[..., 0],
            self._v[rows, columns] + full[..., 1],
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=float("nan"),
        )
        at_rest = there - full[..., 2]
        behind = at_rest - full[..., 3]
        near, past = np.abs(behind) < np.float32(OFF_M), behind >= np.float32(OFF_M)
        out[rows, columns] = np.where(near, at_rest, np.where(past, -there, np.float32(np.nan)))
        return out

    def _box(self, T_world_depth: Float) -> tuple[slice, slice] | None:
        """Rows and columns of the coarse rays in which the surface's box lies."""
        corners = np.array(np.meshgrid(*np.stack([self._low, self._high], 1))).reshape(3, -1).T
        p = (corners - T_world_depth[:3, 3]) @ T_world_depth[:3, :3]
        h, w = self._rays.shape[:2]
        if p[:, 2].min() < 0.1:
            return slice(0, h), slice(0, w)
        K = self._camera.K
        u, v = p[:, 0] / p[:, 2] * K[0, 0] + K[0, 2], p[:, 1] / p[:, 2] * K[1, 1] + K[1, 2]
        c0, c1 = int(u.min() // STEP_PX) - CARRY_PX, int(u.max() // STEP_PX) + CARRY_PX + 1
        r0, r1 = int(v.min() // STEP_PX) - CARRY_PX, int(v.max() // STEP_PX) + CARRY_PX + 1
        r0, r1, c0, c1 = max(r0, 0), min(r1, h), max(c0, 0), min(c1, w)
        return None if r0 >= r1 or c0 >= c1 else (slice(r0, r1), slice(c0, c1))

    def _shift(self, rays: Float32, z: Float32, seen: Bool, triangle: NDArray, T: Float, time_s: float) -> Float32:
        """(h, w, 3) how far the surface point of every ray has moved in the image, px, and in depth, m."""
        surface, field = self._surface, self._surface.field
        corner = surface.triangles[triangle[seen.ravel()], 0]
        local = rays[seen] * z[seen][:, None]
        R, eye = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
        world = local @ R.T + eye
        used, inverse = np.unique(corner, return_inverse=True)
        M = affine(field.node_m, field.at(time_s), surface.binding.take(used))[inverse]
        moved = np.einsum("pij,pj->pi", M[:, :, :3], world) + M[:, :, 3]
        now = (moved - eye) @ R
        K = self._camera.K.astype(np.float32)
        shift = np.zeros((*z.shape, 3), np.float32)
        ray = rays[seen]
        shift[seen, 0] = K[0, 0] * (now[:, 0] / now[:, 2] - ray[:, 0])
        shift[seen, 1] = K[1, 1] * (now[:, 1] / now[:, 2] - ray[:, 1])
        shift[seen, 2] = now[:, 2] - local[:, 2]
        return shift

    def _carried(self, shift: Float32, z: Float32, seen: Bool) -> Float32:
        """(h, w, 4) shift and depth at rest, carried on a little beyond the outline; depth NaN farther out."""
        off, label = cv2.distanceTransformWithLabels(
            (~seen).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        of_label = np.zeros(label.max() + 1, np.intp)
        of_label[label[seen]] = np.flatnonzero(seen)
        source = of_label[label]
        field = np.concatenate([shift, z[..., None]], axis=2).reshape(-1, 4)[source]
        field[off > CARRY_PX] = np.nan
        return field
