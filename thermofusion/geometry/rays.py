"""Rays against a triangle mesh: what they hit first, whether anything is in the way, what lies nearest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ..types import Bool, Float32, Int, SurfaceMesh


@dataclass(frozen=True, eq=False)
class Hits:
    """What N rays hit first, or what lies nearest to N points.

    distance : (N,) in lengths of the ray's direction [m for unit directions], inf = nothing hit; of points: m.
    triangle : (N,) index, -1 = nothing hit. uv : (N, 2) barycentric place in the triangle. normal : (N, 3) of the
    triangle, unit. point_m : (N, 3), of nearest points only.
    """

    distance: Float32
    triangle: NDArray[np.int64]
    uv: Float32
    normal: Float32
    point_m: Float32 | None = None

    @property
    def weights(self) -> Float32:
        """(N, 3) barycentric weights of the triangle's corners."""
        return barycentric(self.uv)


def barycentric(uv: Float32) -> Float32:
    """Weights (N, 3) of a triangle's corners at places uv (N, 2), dimensionless shares that sum to 1."""
    u, v = uv[:, 0], uv[:, 1]
    return np.stack([1 - u - v, u, v], axis=1)


class RayScene:
    """A mesh prepared for rays; Open3D is loaded when the first scene is made.

    Rays are cast on the caller's thread: views are worked on side by side, and idle helpers of a cast would only turn.
    """

    def __init__(self, vertices_m: NDArray, triangles: Int | NDArray) -> None:
        """vertices_m : (V, 3) m. triangles : (F, 3) indices."""
        from ._open3d import o3d

        self._tensor: Any = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices_m, np.float32)),
            self._tensor(np.ascontiguousarray(triangles, np.uint32)),
        )

    @classmethod
    def of(cls, mesh: SurfaceMesh) -> RayScene:
        """Of a surface, prepared once for all who ask while the surface is there: that takes as long as a million rays
        do."""
        scene = _SCENES.get(mesh)
        if scene is None:
            scene = _SCENES[mesh] = cls(mesh.vertices_m, mesh.triangles)
        return scene

    def hits(self, rays: Float32) -> Hits:
        """First hits of rays (N, 6): origin [m] and direction, as `rays_from` makes them."""
        answer = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays, np.float32)), nthreads=1)
        distance = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy().astype(np.int64)
        triangle[~np.isfinite(distance)] = -1
        return Hits(distance, triangle, answer["primitive_uvs"].numpy(), answer["primitive_normals"].numpy())

    def occluded(self, rays: Float32, near: float, far: float) -> Bool:
        """(N,) mask: something lies on a ray (N, 6) between `near` and `far`, in lengths of its direction."""
        return np.asarray(self._scene.test_occlusions(self._tensor(rays), tnear=near, tfar=far, nthreads=1).numpy())

    def closest(self, points_m: NDArray) -> Hits:
        """The mesh's nearest points to points (N, 3) m."""
        points_m = np.ascontiguousarray(points_m, np.float32)
        answer = self._scene.compute_closest_points(self._tensor(points_m))
        nearest, triangle = answer["points"].numpy(), answer["primitive_ids"].numpy().astype(np.int64)
        distance = np.linalg.norm(points_m - nearest, axis=1)
        uv, normal = answer["primitive_uvs"].numpy(), answer["primitive_normals"].numpy()
        return Hits(distance, triangle, uv, normal, nearest)


_SCENES: WeakKeyDictionary[SurfaceMesh, RayScene] = WeakKeyDictionary()  # go with their surfaces


def rays_from(origin_m: NDArray, direction: NDArray) -> Float32:
    """Rays (N, 6) from origin_m, one (3,) m or one each (N, 3), along direction (N, 3); float32."""
    return np.concatenate([np.broadcast_to(origin_m, direction.shape), direction], axis=1, dtype=np.float32)
