"""Where the model's outline should stand in a thermal image.

Only outlines against the empty background are used: rays of a coarse pixel grid find where the surface ends, bisection
finds the end to a fraction of a pixel. A true occluding contour is seen edge-on, and away from the mesh's open borders;
the rim of a hole or of the cut at the waist is dropped (the body goes on where the mesh does not).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..types import Camera, Float, Float32, SurfaceMesh
from .camera import pixel_rays, project
from .mesh import undirected_edges
from .rays import RayScene, rays_from
from .rigid import transform_points

GRID_STEPS_ACROSS = 160  # coarse pixel grid: an image is this many steps wide
BISECTIONS = 6  # of one grid step: below a tenth of a pixel
EDGE_ON_COS = 0.5  # an occluding contour is seen edge-on; noisy, window-averaged normals are up to 30° off
BORDER_M = 0.015  # outline this near to an open border of the mesh is not believed


@dataclass(frozen=True, eq=False)
class Contour:
    """Points of the outline as one view sees it. point_m, normal : (N, 3) world frame, normals outward, unit."""

    point_m: Float
    normal: Float

    def __len__(self) -> int:
        return len(self.point_m)


class OutlineCaster:
    """A mesh prepared for casting its outline into any view."""

    def __init__(self, mesh: SurfaceMesh, camera: Camera, steps_across: int = GRID_STEPS_ACROSS) -> None:
        self._scene = RayScene.of(mesh)
        self._mesh = self._now = mesh  # as it is cast; as it stands
        self._border = border_tree(mesh)
        self._step = max(1, round(camera.width_px / steps_across))
        u, v = np.meshgrid(
            np.arange(self._step / 2, camera.width_px, self._step),
            np.arange(self._step / 2, camera.height_px, self._step),
        )
        self._camera = camera
        self._rays = pixel_rays(camera, u, v).astype(np.float32)

    def posed(self, mesh: SurfaceMesh) -> OutlineCaster:
        """The same for the same mesh with its vertices moved a little; itself where it is the very same.

        Outlines are cast at rest and carried along: what a part that turns by an angle δ and is round with radius R
        shows of itself then is wrong by R δ²/2, 0.06 mm of an arm that swings by 3°. Preparing each pose for rays
        takes a seventh of a second.
        """
        if mesh is self._mesh:
            return self
        other = copy(self)
        other._now = mesh
        return other

    def contour(self, T_world_thermal: Float) -> Contour:
        """The outline against the background, as seen from T_world_thermal (4, 4)."""
        rays = self._rays @ T_world_thermal[:3, :3].T.astype(np.float32)
        eye = T_world_thermal[:3, 3].astype(np.float32)
        hit = self._scene.hits(rays_from(eye, rays.reshape(-1, 3))).distance.reshape(rays.shape[:2])
        body = np.isfinite(hit)
        on, off = [], []
        for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            out, into = body[a] & ~body[b], ~body[a] & body[b]
            on += [rays[a][out], rays[b][into]]
            off += [rays[b][out], rays[a][into]]
        inner, outer = np.concatenate(on), np.concatenate(off)
        for _ in range(BISECTIONS if len(inner) else 0):
            middle = (inner + outer) / 2
            is_body = np.isfinite(self._scene.hits(rays_from(eye, middle)).distance)[:, None]
            inner, outer = np.where(is_body, middle, inner), np.where(is_body, outer, middle)
        return self._edge_on(eye, inner)

    def cosine(self, T_world_thermal: Float, uv_px: Float) -> Float:
        """Cosine of the viewing angle where pixels' rays meet the mesh, (N,), by its smooth normals; NaN = nowhere.

        T_world_thermal : (4, 4). uv_px : (N, 2).
        """
        rays = pixel_rays(self._camera, uv_px[:, 0], uv_px[:, 1]) @ T_world_thermal[:3, :3].T
        known = np.asarray(np.isfinite(rays).all(axis=1))
        found = self._scene.hits(rays_from(T_world_thermal[:3, 3], np.where(known[:, None], rays, [0.0, 0.0, 1.0])))
        hit = known & np.isfinite(found.distance)
        normal = np.einsum("nc,ncx->nx", found.weights, self._mesh.normals[self._mesh.triangles[found.triangle]])
        cos = -(normal * rays).sum(axis=1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
        return np.where(hit, np.clip(cos, 0, 1), np.nan)

    def _edge_on(self, eye: Float32, directions: Float32) -> Contour:
        """The points hit, where the surface shows its outside, and nearly edge-on."""
        if not len(directions):
            return Contour(np.zeros((0, 3)), np.zeros((0, 3)))
        found = self._scene.hits(rays_from(eye, directions))
        t, front = found.distance, (found.normal * directions).sum(1) < 0
        keep = np.isfinite(t) & front
        weight, corner = found.weights[keep], self._mesh.triangles[found.triangle[keep]]
        normal = _blended(weight, self._mesh.normals[corner])
        point = (eye + t[keep, None] * directions[keep]).astype(np.float64)
        cos = (normal * directions[keep]).sum(1) / np.linalg.norm(directions[keep], axis=1)
        good = np.abs(cos) < EDGE_ON_COS
        if self._border is not None and good.any():
            good &= ~np.isfinite(self._border.query(point, distance_upper_bound=BORDER_M)[0])
        if self._now is self._mesh:
            return Contour(point[good], normal[good])
        weight, corner = weight[good], corner[good]
        point = np.einsum("nc,ncx->nx", weight, self._now.vertices_m[corner].astype(np.float64))
        return Contour(point, _blended(weight, self._now.normals[corner]))


def _blended(weight: Float32, normals: Float32) -> Float:
    """(N, 3) unit normals between corners' normals (N, 3, 3), by weights (N, 3)."""
    normal = np.einsum("nc,ncx->nx", weight, normals.astype(np.float64))
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9))


def border_tree(mesh: SurfaceMesh) -> cKDTree | None:
    """Search tree of the vertices on open borders; None for a closed mesh."""
    edges, border = undirected_edges(mesh.triangles)
    ends = np.unique(edges[border])  # of edges with one triangle only
    return cKDTree(mesh.vertices_m[ends]) if len(ends) else None


@dataclass(frozen=True, eq=False)
class ProjectedContour:
    """A contour of N points in an image.

    uv_px, normal_px : (N, 2) place and unit outward normal. point_m : (N, 3) in the camera's frame. px_per_m : (N, 3),
    how the place moves along its normal when the point moves in the camera's frame.
    """

    uv_px: Float
    normal_px: Float
    point_m: Float
    px_per_m: Float


def project_contour(camera: Camera, T_thermal_world: Float, contour: Contour) -> ProjectedContour:
    """A contour in px in a camera's image, distortion included; NaN where a point lies outside the camera's model.

    T_thermal_world : (4, 4).
    """
    p = transform_points(T_thermal_world, contour.point_m)
    h = 1e-6
    uv, _ = project(camera, np.concatenate([p, p + np.array([h, 0, 0]), p + np.array([0, h, 0])]))
    uv, by_x, by_y = np.split(uv, 3)
    by_x, by_y = (by_x - uv) / h, (by_y - uv) / h
    by_z = -(p[:, 0:1] * by_x + p[:, 1:2] * by_y) / p[:, 2:3]  # moving along its own ray changes nothing
    jacobian = np.stack([by_x, by_y, by_z], axis=2)
    normal = np.einsum("nij,nj->ni", jacobian, contour.normal @ T_thermal_world[:3, :3].T)
    with np.errstate(invalid="ignore"):
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return ProjectedContour(uv, normal, p, np.einsum("ni,nij->nj", normal, jacobian))
