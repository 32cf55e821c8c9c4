"""What views of one skin have in common: the temperature pattern, as rows of a joint solution for all poses.

Every vertex that several views see reads, in each, its own normal-equivalent radiance: the image's, brought to the
straight view by skin's emissivity, less the view's offset and a low-order field over the image. What a pose is off by
shows as a difference that goes with the image's gradient there (direct alignment; Delaunoy & Pollefeys 2014 solve the
like for colour). Vertices' own values are eliminated, so that nothing circles between a map and the poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

from ...geometry.camera import pixel_rays, project, viewing_cosine
from ...geometry.patches import patches
from ...geometry.rays import RayScene, rays_from
from ...geometry.rigid import invert, transform_points
from ...physics.emissivity import PRESETS, Fresnel
from ...robust import TUKEY, mad_sigma, tukey_weight
from ...types import Bool, Camera, Float, Float32, SurfaceMesh

MAX_VERTICES = 6000  # that enter; more say the same
MAX_ANGLE_DEG = 60.0  # beyond it emissivity falls too fast
EDGE_CLEAR_PX = 4.0  # and this much from every outline, where the point spread mixes
BORDER_PX = 6.0
CAST_ACROSS = 240  # rays across the image, for what hides what
STEP_M = 0.03  # a step of range between neighbouring rays: an outline
BLOCK_M = 0.06  # rows of one view this near share what is not modelled
REWEIGHTED = 4
BEHIND_M = 0.012  # a vertex this far behind what its ray hits is hidden
POSE, OFFSET = slice(0, 6), 6  # a view's own columns
VIEW_COLUMNS = 7
FIELD_TERMS = 5  # u, v, u², uv, v² over the image
COMMON_COLUMNS = FIELD_TERMS + 1  # and the shape of emissivity


@dataclass(frozen=True, eq=False)
class PatternRows:
    """One view's rows: n vertices seen.

    vertex : (n,) which of the sample. value : (n,) normal-equivalent radiance. own : (n, 7) its derivative by the
    view's pose (twist of the world in the camera's frame) and, as -1, offset. common : (n, 6) by field and shape.
    weight : (n,) 0..1, of the angle. point_m : (n, 3) world.
    """

    vertex: NDArray[np.intp]
    value: Float
    own: Float
    common: Float
    weight: Float
    point_m: Float


@dataclass(frozen=True, eq=False)
class PatternSampler:
    """A sample of the surface, prepared for reading views. room : radiance that skin reflects."""

    lens: Camera
    point_m: Float
    normal: Float
    room: float
    _scene: RayScene
    _rays: Float

    @classmethod
    def of(cls, mesh: SurfaceMesh, lens: Camera, room: float) -> PatternSampler:
        """Vertices drawn evenly over the mesh's list, which follows the surface."""
        every = max(1, len(mesh) // MAX_VERTICES)
        step = max(1.0, lens.width_px / CAST_ACROSS)
        u, v = np.meshgrid(np.arange(0, lens.width_px, step), np.arange(0, lens.height_px, step))
        return cls(
            lens,
            mesh.vertices_m[::every].astype(np.float64),
            mesh.normals[::every].astype(np.float64),
            room,
            RayScene.of(mesh),
            pixel_rays(lens, u, v),
        )

    def rows(self, image: Float32, T_world_thermal: Float) -> PatternRows:
        """What a view reads of the sample from T_world_thermal (4, 4).

        image : (H, W) radiance, blurred as it should be compared.
        """
        T = invert(T_world_thermal)
        cos = viewing_cosine(self.point_m, self.normal, T_world_thermal[:3, 3])
        v = np.flatnonzero(cos > np.cos(np.radians(MAX_ANGLE_DEG)))
        p = transform_points(T, self.point_m[v])
        uv, _ = project(self.lens, p)
        with np.errstate(invalid="ignore"):
            high = [self.lens.width_px - 1 - BORDER_PX, self.lens.height_px - 1 - BORDER_PX]
            inside = np.flatnonzero(((uv >= BORDER_PX) & (uv <= high)).all(axis=1))
        v, p, uv = v[inside], p[inside], uv[inside]
        seen = np.flatnonzero(self._clear(T_world_thermal, p, uv))
        v, p, uv = v[seen], p[seen], uv[seen]
        du, dv = (cv2.Scharr(image, cv2.CV_32F, *d, scale=1 / 32) for d in ((1, 0), (0, 1)))
        value, gu, gv = (_sample(x, uv) for x in (image, du, dv))
        model = Fresnel(*PRESETS["dielectric"])
        E = model.relative(cos[v])
        along = _by_point(self.lens, p, uv, gu, gv) / E[:, None]
        own = np.concatenate([np.cross(p, along), along, -np.ones((len(v), 1))], axis=1)
        a, b = (2 * uv / [self.lens.width_px, self.lens.height_px] - 1).T
        common = -np.stack([a, b, a * a, a * b, b * b, 1 / E - 1], axis=1)
        value = self.room + (value - self.room) / E
        good = np.isfinite(value) & np.isfinite(own).all(axis=1)
        return PatternRows(v[good], value[good], own[good], common[good], cos[v][good] ** 2, self.point_m[v][good])

    def _clear(self, T_world_thermal: Float, p: Float, uv: Float) -> Bool:
        """Which points (n, 3), in the camera's frame, are not hidden and lie clear of outlines."""
        h, w = self._rays.shape[:2]
        directions = (self._rays @ T_world_thermal[:3, :3].T).reshape(-1, 3)
        depth = self._scene.hits(rays_from(T_world_thermal[:3, 3], directions)).distance.reshape(h, w)
        depth = np.where(np.isfinite(depth), depth, 1e3).astype(np.float32)
        kernel = np.ones((3, 3), np.uint8)
        edge = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) > STEP_M
        step = self.lens.width_px / w
        away = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) * step
        at = np.rint(uv / step).astype(np.intp)
        at = np.minimum(at, [w - 1, h - 1])
        front = depth[at[:, 1], at[:, 0]]
        hidden = np.linalg.norm(p, axis=1) > front + BEHIND_M
        return np.asarray((away[at[:, 1], at[:, 0]] > EDGE_CLEAR_PX) & ~hidden)


def _sample(image: NDArray, uv: Float) -> Float:
    at = uv.astype(np.float32)
    return cv2.remap(image, at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[:, 0].astype(np.float64)


def _by_point(camera: Camera, p: Float, uv: Float, gu: Float, gv: Float) -> Float:
    """(n, 3): how the value changes when the point moves in the camera's frame; distortion included."""
    h = 1e-5
    by_x, by_y = ((project(camera, p + d)[0] - uv) / h for d in (np.array([h, 0, 0]), np.array([0, h, 0])))
    by_z = -(p[:, 0:1] * by_x + p[:, 1:2] * by_y) / p[:, 2:3]
    return np.stack([gu * b[:, 0] + gv * b[:, 1] for b in (by_x, by_y, by_z)], axis=1)


@dataclass(frozen=True, eq=False)
class PatternNormal:
    """Normal equations of all views' rows, vertices' own values eliminated: matrix (P, P) and right side (P,) over the
    N views' columns, then the common ones.

    sigma : robust scale of a residual, radiance; of_view (N,) each view's own, NaN where nothing compares. effect : how
    many rows count as one, for what neighbours share.
    """

    matrix: Float
    right: Float
    sigma: float
    of_view: Float
    effect: float


@dataclass(frozen=True, eq=False)
class _Stacked:
    """The rows of all views: view, vertex, group (n,); value (n,); A (n, P), S (V, n): sparse; base weights (n,)."""

    vertex: NDArray[np.intp]
    group: NDArray[np.intp]
    value: Float
    A: csr_array
    S: csr_array
    base: Float

    @classmethod
    def of(cls, views: Sequence[PatternRows], n_vertices: int) -> _Stacked:
        n, sizes = len(views), [len(v.vertex) for v in views]
        view, rows = np.repeat(np.arange(n), sizes), np.arange(sum(sizes))
        vertex = np.concatenate([v.vertex for v in views])
        entries = np.concatenate([np.concatenate([v.own, v.common], axis=1) for v in views])
        own = view[:, None] * VIEW_COLUMNS + np.arange(VIEW_COLUMNS)
        shared = np.tile(n * VIEW_COLUMNS + np.arange(COMMON_COLUMNS), (len(rows), 1))
        columns = np.concatenate([own, shared], axis=1)
        A = csr_array(
            (entries.ravel(), (np.repeat(rows, entries.shape[1]), columns.ravel())),
            shape=(len(rows), n * VIEW_COLUMNS + COMMON_COLUMNS),
        )
        S = csr_array((np.ones(len(rows)), (vertex, rows)), shape=(n_vertices, len(rows)))
        block, _ = patches(np.concatenate([v.point_m for v in views]), BLOCK_M)
        group = np.unique(block * n + view, return_inverse=True)[1]
        value, base = (np.concatenate([getattr(v, k) for v in views]) for k in ("value", "weight"))
        return cls(vertex, group, value, A, S, base)

    def normal(self, weight: Float, columns: NDArray[np.intp]) -> tuple[Float, Float]:
        """Matrix and right side of some columns."""
        A, W = self.A[:, columns], diags_array(weight)
        inverse = diags_array(1 / np.maximum(self.S @ weight, 1e-12))
        by_vertex = (self.S @ W @ A).tocsr()
        H = (A.T @ W @ A - by_vertex.T @ inverse @ by_vertex).toarray()
        b = by_vertex.T @ (inverse @ (self.S @ (weight * self.value))) - A.T @ (weight * self.value)
        return np.asarray(H), np.asarray(b)

    def residual(self, x: Float, weight: Float) -> Float:
        """(n,) about the vertices' means, as large as if these were known; NaN where one view alone sees a vertex."""
        fitted = self.value + self.A @ x
        mean = (self.S @ (weight * fitted)) / np.maximum(self.S @ weight, 1e-12)
        count = (self.S @ (weight > 0).astype(np.float64))[self.vertex]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray((fitted - mean[self.vertex]) * np.where(count > 1, np.sqrt(count / (count - 1)), np.nan))


def of_poses(n_views: int, columns: int) -> Bool:
    """(P,) which of the columns, the views' first, are unknowns of poses."""
    out = np.zeros(columns, bool)
    out[: n_views * VIEW_COLUMNS] = np.tile(np.arange(VIEW_COLUMNS) < OFFSET, n_views)
    return out


def pattern_normal(views: Sequence[PatternRows], n_vertices: int, floor: float) -> PatternNormal:
    """The normal equations for a step from the poses where the views were read, robustly weighted.

    floor : least scale of a residual, radiance.
    """
    rows = _Stacked.of(views, n_vertices)
    P = rows.A.shape[1]
    nuisance = np.flatnonzero(~of_poses(len(views), P))
    weight, x = rows.base.copy(), np.zeros(P)
    for _ in range(REWEIGHTED):
        H, b = rows.normal(weight, nuisance)
        x[nuisance] = np.linalg.solve(H + np.diag(1e-6 * np.diag(H) + 1e-12), b)
        r = rows.residual(x, weight)
        known = np.isfinite(r)
        sigma = max(floor, mad_sigma(r[known])) if known.any() else floor
        weight = rows.base * np.where(known, tukey_weight(np.nan_to_num(r) / (TUKEY * sigma)), 0)
    H, b = rows.normal(weight, np.arange(P))
    effect = _effect(rows, weight * np.nan_to_num(r), len(views))
    ends = np.cumsum([len(v.vertex) for v in views])[:-1]
    of_view = np.array([mad_sigma(part[np.isfinite(part)]) for part in np.split(r, ends)])
    return PatternNormal(H / sigma**2, b / sigma**2, sigma, of_view, effect)


def _effect(rows: _Stacked, weighted: Float, n_views: int) -> float:
    """How many rows count as one: the spread of scores of one place in one view, over that of independent rows."""
    score = np.concatenate([rows.A[:, k::VIEW_COLUMNS][:, :n_views].sum(axis=1)[:, None] for k in range(OFFSET)], 1)
    score = np.asarray(score) * weighted[:, None]
    grouped = np.zeros((rows.group.max() + 1, OFFSET))
    np.add.at(grouped, rows.group, score)
    alone = np.maximum((score**2).sum(axis=0), 1e-300)
    return max(1.0, float(np.mean((grouped**2).sum(axis=0) / alone)))
