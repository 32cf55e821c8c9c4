"""Where the model's outline should stand in a thermal image, and where the image shows it.

Only outlines against the empty background are used: rays of a coarse pixel grid find where the surface ends, bisection
finds the end to a fraction of a pixel. A true occluding contour is seen edge-on, and away from the mesh's open borders;
the rim of a hole or of the cut at the waist is dropped (the body goes on where the mesh does not). The image's edge is
the steepest step along the outline's normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .geometry import pixel_rays, project, transform_points
from .types import Camera, Float, Float32, SurfaceMesh

GRID_STEPS_ACROSS = 160  # coarse pixel grid: an image is this many steps wide
BISECTIONS = 6  # of one grid step: below a tenth of a pixel
EDGE_ON_COS = 0.5  # an occluding contour is seen edge-on; noisy, window-averaged normals are up to 30° off
BORDER_M = 0.015  # outline this near to an open border of the mesh is not believed
PROFILE_STEP_PX = 0.5
BLUR_SIGMA_PX = 1.0  # of the image before its steepest step is looked for: noise of the derivative
CLIMB = 4  # steps from a preferred place on an edge to its top
FLANK_PX = 4.0  # the step's height is taken this far on both sides


@dataclass(frozen=True, eq=False)
class Contour:
    """Points of the outline as one view sees it. point_m, normal : (N, 3) world frame, normals outward, unit."""

    point_m: Float
    normal: Float

    def __len__(self) -> int:
        return len(self.point_m)


@dataclass(frozen=True, eq=False)
class Edges:
    """Image edges found along the normals of N projected contour points.

    offset_px : (N,) signed distance from the prediction to the edge, positive outward; NaN = none within reach.
    step : (N,) inside minus outside, in the image's unit.
    """

    offset_px: Float
    step: Float


class OutlineCaster:
    """A mesh prepared for casting its outline into any view."""

    def __init__(self, mesh: SurfaceMesh, camera: Camera) -> None:
        from ._open3d import o3d  # Open3D loads in a second; only this step needs it

        self._tensor: Any = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(mesh.vertices_m, np.float32)),
            self._tensor(np.ascontiguousarray(mesh.triangles, np.uint32)),
        )
        self._mesh = mesh
        self._border = _border_tree(mesh)
        self._step = max(1, round(camera.width_px / GRID_STEPS_ACROSS))
        u, v = np.meshgrid(
            np.arange(self._step / 2, camera.width_px, self._step),
            np.arange(self._step / 2, camera.height_px, self._step),
        )
        self._rays = pixel_rays(camera, u, v).astype(np.float32)

    def contour(self, T_world_thermal: Float) -> Contour:
        """The outline against the background, as seen from a pose of the thermal camera."""
        rays = self._rays @ T_world_thermal[:3, :3].T.astype(np.float32)
        eye = T_world_thermal[:3, 3].astype(np.float32)
        hit = self._cast(eye, rays.reshape(-1, 3))["t_hit"].numpy().reshape(rays.shape[:2])
        body = np.isfinite(hit)
        on, off = [], []
        for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            out, into = body[a] & ~body[b], ~body[a] & body[b]
            on += [rays[a][out], rays[b][into]]
            off += [rays[b][out], rays[a][into]]
        inner, outer = np.concatenate(on), np.concatenate(off)
        for _ in range(BISECTIONS if len(inner) else 0):
            middle = (inner + outer) / 2
            is_body = np.isfinite(self._cast(eye, middle)["t_hit"].numpy())[:, None]
            inner, outer = np.where(is_body, middle, inner), np.where(is_body, outer, middle)
        return self._edge_on(eye, inner)

    def _cast(self, eye: Float32, directions: Float32) -> dict[str, Any]:
        rays = np.concatenate([np.broadcast_to(eye, directions.shape), directions], 1, dtype=np.float32)
        return self._scene.cast_rays(self._tensor(rays))

    def _edge_on(self, eye: Float32, directions: Float32) -> Contour:
        """The points hit, where the surface shows its outside, and nearly edge-on."""
        if not len(directions):
            return Contour(np.zeros((0, 3)), np.zeros((0, 3)))
        answer = self._cast(eye, directions)
        t, triangle = answer["t_hit"].numpy(), answer["primitive_ids"].numpy().astype(np.int64)
        front = (answer["primitive_normals"].numpy() * directions).sum(1) < 0
        keep = np.isfinite(t) & front
        uv, corner = answer["primitive_uvs"].numpy()[keep], self._mesh.triangles[triangle[keep]]
        weight = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)
        normal = np.einsum("nc,ncx->nx", weight, self._mesh.normals[corner].astype(np.float64))
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        point = (eye + t[keep, None] * directions[keep]).astype(np.float64)
        cos = (normal * directions[keep]).sum(1) / np.linalg.norm(directions[keep], axis=1)
        edge_on = np.abs(cos) < EDGE_ON_COS
        point, normal = point[edge_on], normal[edge_on]
        if self._border is not None and len(point):
            inside = ~np.isfinite(self._border.query(point, distance_upper_bound=BORDER_M)[0])
            point, normal = point[inside], normal[inside]
        return Contour(point, normal)


def _border_tree(mesh: SurfaceMesh) -> cKDTree | None:
    """Search tree of the vertices on open borders: on edges with one triangle only. None for a closed mesh."""
    t = mesh.triangles.astype(np.int64)
    a, b = np.concatenate([t[:, 0], t[:, 1], t[:, 2]]), np.concatenate([t[:, 1], t[:, 2], t[:, 0]])
    code, count = np.unique(np.minimum(a, b) << 32 | np.maximum(a, b), return_counts=True)
    single = code[count == 1]
    ends = np.unique(np.concatenate([single >> 32, single & 0xFFFFFFFF]))
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
    """A contour in the image of a camera, distortion included; NaN where a point lies outside the camera's model."""
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


def smooth_image(image: NDArray) -> Float32:
    """The image blurred for derivatives; NaN pixels spread as NaN over the kernel."""
    return np.asarray(cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), BLUR_SIGMA_PX), np.float32)


def find_edges(smooth: Float32, contour: ProjectedContour, reach_px: float, sign: float) -> Edges:
    """The steepest step of an image along normals, within ±reach.

    smooth : (H, W) from `smooth_image`. sign : +1 if the body is brighter than the background, -1 if darker, 0 either.
    """
    span = reach_px + FLANK_PX + PROFILE_STEP_PX
    s = np.arange(-span, span + 1e-6, PROFILE_STEP_PX)
    at = contour.uv_px[:, None, :] + s[None, :, None] * contour.normal_px[:, None, :]
    profile: Float = cv2.remap(
        smooth,
        at[..., 0].astype(np.float32),
        at[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    ).astype(np.float64)
    fall = (profile[:, :-2] - profile[:, 2:]) / (2 * PROFILE_STEP_PX)
    strength = np.abs(fall) if sign == 0 else sign * fall
    s_fall = s[1:-1]
    # A nearer edge is the likelier one, so it is preferred, gently; its place is where the image itself is steepest.
    prefer = np.where(np.abs(s_fall) <= reach_px, 1 / (1 + (s_fall / reach_px) ** 2), 0.0)
    whole = np.asarray(np.isfinite(profile).all(1))
    strength = np.where(whole[:, None], strength, 0.0)
    peak, row, last = np.argmax(strength * prefer, axis=1), np.arange(len(profile)), len(s_fall) - 1
    for _ in range(CLIMB):
        around = np.stack([np.clip(peak + d, 0, last) for d in (-1, 0, 1)])
        peak = around[np.argmax(strength[row, around], axis=0), row]
    inside_reach = np.abs(s_fall[peak]) < reach_px - PROFILE_STEP_PX
    left, mid, right = (strength[row, np.clip(peak + d, 0, last)] for d in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = np.clip(0.5 * (left - right) / (left - 2 * mid + right), -1, 1)
    offset = s_fall[peak] + np.where(np.isfinite(shift), shift, 0.0) * PROFILE_STEP_PX
    flank = round(FLANK_PX / PROFILE_STEP_PX)
    step = profile[row, peak + 1 - flank] - profile[row, np.minimum(peak + 1 + flank, profile.shape[1] - 1)]
    return Edges(np.where(whole & inside_reach, offset, np.nan), np.where(whole, step, np.nan))
