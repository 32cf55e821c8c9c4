"""One surface onto another: iterative closest points, point to plane, from many starts (Chen and Medioni 1992).

For finished meshes of one subject. Rigid: breathing and posture stay in the residual, which is reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..export.axes import axes_of
from ..geometry.rigid import pose, se3_exp, transform_points
from ..types import Bool, Float, SurfaceMesh, ThermalMesh

STARTS_DEG = 30.0  # steps of turning about the vertical, where frames differ
COARSE_POINTS, FINE_POINTS = 500, 6000
COARSE_STEPS, FINE_STEPS = 25, 40
TRIM = 0.7  # share of the points, the nearest ones, that guide coarse steps: the rest may have no counterpart
FACING = 0.5  # cosine between normals of partners
CONVERGED = 1e-6  # rad and m
GOOD_ENOUGH_M = 0.010  # a median distance above this is no registration


@dataclass(frozen=True, eq=False)
class Registration:
    """T_b_a moves surface a onto b. residual_mm : median distance along the normals of partners. overlap : share of a's
    points with a partner on b within 1 cm. converged : the steps came to rest, near enough to trust.
    """

    T_b_a: Float
    residual_mm: float
    overlap: float
    converged: bool


def register(a: ThermalMesh, b: ThermalMesh) -> Registration:
    """The rigid motion that lays a on b, from any relative pose."""
    target = _Target(b.surface)
    points, normals = _sample(a.surface, COARSE_POINTS)
    best, best_cost = np.eye(4), np.inf
    for start in _starts(a, b):
        T = start
        for _ in range(COARSE_STEPS):
            T = target.step(T, points, normals, TRIM)[0]
        cost = target.distance(T, points)
        if cost < best_cost:
            best, best_cost = T, cost
    points, normals = _sample(a.surface, FINE_POINTS)
    T, change = best, np.inf
    for _ in range(FINE_STEPS):
        T, change = target.step(T, points, normals, None)
        if change < CONVERGED:
            break
    residual, overlap = target.quality(T, points, normals)
    return Registration(T, 1e3 * residual, overlap, bool(change < 100 * CONVERGED and residual < GOOD_ENOUGH_M))


def as_they_are(a: ThermalMesh, b: ThermalMesh) -> Registration:
    """No motion: both surfaces are in one frame already."""
    residual, overlap = _Target(b.surface).quality(np.eye(4), *_sample(a.surface, FINE_POINTS))
    return Registration(np.eye(4), 1e3 * residual, overlap, True)


def mirrored(mesh: ThermalMesh) -> ThermalMesh:
    """Left for right: reflected through the plane through the middle that `up` and `front` span."""
    across = axes_of(mesh.metadata)[0].astype(np.float32)
    flip = np.eye(3, dtype=np.float32) - 2 * np.outer(across, across)
    s = mesh.surface
    centre = s.vertices_m.mean(0)
    surface = SurfaceMesh(
        (s.vertices_m - centre) @ flip + centre,
        np.ascontiguousarray(s.triangles[:, ::-1]),
        s.normals @ flip,
        s.color_rgb,
    )
    return replace(mesh, surface=surface)


class _Target:
    """The surface that stands still."""

    def __init__(self, surface: SurfaceMesh) -> None:
        self._vertices = surface.vertices_m.astype(np.float64)
        self._normals = surface.normals.astype(np.float64)
        self._tree = cKDTree(self._vertices)

    def step(self, T: Float, points: Float, normals: Float, trim: float | None) -> tuple[Float, float]:
        """One Gauss-Newton step, and its size (rad, m). trim : share of the nearest points, or None: within reach."""
        p, n, q = self._partners(T, points, normals)
        distance = np.linalg.norm(p - q, axis=1)
        if trim is None:
            keep = distance < max(3 * float(np.median(distance)), 1e-6)
        else:
            keep = distance <= np.quantile(distance, trim)
        residual = ((p - q) * n).sum(1)[keep]
        centre = p[keep].mean(0)
        J = np.concatenate([np.cross(p[keep] - centre, n[keep]), n[keep]], axis=1)
        normal = J.T @ J
        normal += 1e-9 * np.trace(normal) * np.eye(6)  # a sphere turns freely about its centre
        xi = np.linalg.solve(normal, -J.T @ residual)
        there, back = pose(np.eye(3), centre), pose(np.eye(3), -centre)
        return there @ se3_exp(xi) @ back @ T, float(np.abs(xi).max())

    def distance(self, T: Float, points: Float) -> float:
        """Mean distance of all points, none of which is let off: a wrong start must not win by trimming."""
        d, _ = self._tree.query(transform_points(T, points))
        return float(np.mean(np.minimum(d, 0.05)))

    def quality(self, T: Float, points: Float, normals: Float) -> tuple[float, float]:
        """Median distance along the normal [m] of the points that have a partner within 1 cm, and their share."""
        p, n, q = self._partners(T, points, normals)
        near = np.linalg.norm(p - q, axis=1) < 0.01
        if not near.any():
            return float("inf"), 0.0
        return float(np.median(np.abs(((p - q) * n).sum(1)[near]))), float(near.sum() / len(points))

    def _partners(self, T: Float, points: Float, normals: Float) -> tuple[Float, Float, Float]:
        """Moved points with their partner's normal and place, those that face the same way (or all, if few do)."""
        p, facing = transform_points(T, points), normals @ T[:3, :3].T
        _, i = self._tree.query(p)
        good: Bool = (facing * self._normals[i]).sum(1) > FACING
        good = good if good.sum() >= 12 else np.ones(len(p), bool)
        return p[good], self._normals[i[good]], self._vertices[i[good]]


def _sample(surface: SurfaceMesh, size: int) -> tuple[Float, Float]:
    pick = slice(None, None, max(1, len(surface) // size))
    return surface.vertices_m[pick].astype(np.float64), surface.normals[pick].astype(np.float64)


def _starts(a: ThermalMesh, b: ThermalMesh) -> list[Float]:
    """The frames as they are; upright with every turn about the vertical; principal axes with every sign."""
    ca, cb = (m.surface.vertices_m.astype(np.float64).mean(0) for m in (a, b))
    about = [np.eye(3)]
    if all({"up", "front"} <= set(m.metadata) for m in (a, b)):
        A, B = axes_of(a.metadata), axes_of(b.metadata)
        turns = np.arange(0, 360, STARTS_DEG)
        about += [B.T @ Rotation.from_rotvec([0, np.radians(t), 0]).as_matrix() @ A for t in turns]
    else:
        axes_a, axes_b = _principal(a.surface.vertices_m - ca), _principal(b.surface.vertices_m - cb)
        signs = [np.diag(s) for s in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
        about += [axes_b @ s @ axes_a.T for s in signs]
    return [np.eye(4), *(pose(R, cb - R @ ca) for R in about)]


def _principal(centred: NDArray) -> Float:
    """(3, 3) right-handed principal axes as columns."""
    _, axes = np.linalg.eigh(centred.T.astype(np.float64) @ centred)
    return axes * np.array([1.0, 1.0, np.sign(np.linalg.det(axes))])
