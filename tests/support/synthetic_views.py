"""Observations of an egg-shaped body by cameras walking round it, made from the measurement equation alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thermofusion.physics.band import ZERO_DEGC_K, Band
from thermofusion.physics.emissivity import EmissivityModel, Fresnel
from thermofusion.physics.equation import apparent_radiance
from thermofusion.types import Float, Observations

BAND = Band()
WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
REFLECTED_K = 22.5 + ZERO_DEGC_K
L_ROOM = float(BAND.radiance(REFLECTED_K))


@dataclass(frozen=True, eq=False)
class World:
    """Truth and what the cameras report of it."""

    observations: Observations
    T_K: Float
    offsets_K: Float
    n_views: int
    points_m: Float
    slope_L: float

    @property
    def n_vertices(self) -> int:
        return len(self.T_K)

    @property
    def image_size(self) -> tuple[int, int]:
        return WIDTH, HEIGHT


def vignetting_K(u_px, v_px):
    """A field with the faults of real cameras: dark corners, a warm spot beside the middle, a slight tilt."""
    x, y = (u_px - WIDTH / 2) / (WIDTH / 2), (v_px - HEIGHT / 2) / (WIDTH / 2)
    return -0.25 * (x * x + y * y) + 0.08 * np.exp(-((x - 0.1) ** 2 + y**2) / 0.35) + 0.05 * x


def make_world(
    seed: int = 0,
    *,
    n_vertices: int = 4000,
    n_views: int = 24,
    model: EmissivityModel | None = None,
    netd_K: float = 0.05,
    drift_K: float = 0.5,
    field: bool = True,
    outliers: float = 0.0,
    turn_deg: float = 360.0,
    normal_error_deg: float = 0.0,
    temperature=None,
) -> World:
    """Skin of 30-35 °C in a 22.5 °C room seen by `n_views` cameras at 1 m; offsets drift by about `drift_K`."""
    rng, model = np.random.default_rng(seed), model or Fresnel(1.33)
    normals = fibonacci_sphere(n_vertices)
    radii = np.array([0.18, 0.12, 0.30])
    points = normals * radii
    normals = normals / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if temperature is None:
        T = 32.5 + 1.5 * np.sin(9 * points[:, 2] + 1) + np.cos(3 * np.arctan2(points[:, 1], points[:, 0]))
    else:
        T = temperature(points)
    T_K = T + ZERO_DEGC_K
    believed = normals
    if normal_error_deg:
        believed = normals + np.radians(normal_error_deg) * rng.normal(size=normals.shape)
        believed /= np.linalg.norm(believed, axis=1, keepdims=True)
    drift = np.cumsum(rng.normal(size=n_views)) * drift_K / np.sqrt(n_views / 3)
    jump = np.where(np.arange(n_views) >= n_views // 2, 0.8 * drift_K, 0.0)
    offsets = drift + jump
    slope = float(BAND.d_radiance_dT(32 + ZERO_DEGC_K))
    L_skin = BAND.radiance(T_K)
    columns: dict[str, list] = {name: [] for name in Observations.__dataclass_fields__}
    for view in range(n_views):
        a = np.radians(turn_deg) * view / n_views
        eye = np.array([np.cos(a), np.sin(a), 0.25 * np.sin(2.7 * view)]) * 1.0
        forward = -eye / np.linalg.norm(eye) + 0.05 * rng.normal(size=3)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        p = (points - eye) @ R.T
        d = eye - points
        distance = np.linalg.norm(d, axis=1)
        cos_true = np.einsum("ij,ij->i", d, normals) / distance
        cos = np.einsum("ij,ij->i", d, believed) / distance
        u = FOCAL * p[:, 0] / p[:, 2] + (WIDTH - 1) / 2
        v = FOCAL * p[:, 1] / p[:, 2] + (HEIGHT - 1) / 2
        seen = (cos_true > 0.2) & (cos > 0.2) & (u > 2) & (v > 2) & (u < WIDTH - 3) & (v < HEIGHT - 3)
        i = np.flatnonzero(seen)
        L = apparent_radiance(L_skin[i], model(cos_true[i]), L_ROOM)
        L = L + slope * (offsets[view] + rng.normal(0, netd_K, len(i)))
        if field:
            L = L + slope * vignetting_K(u[i], v[i])
        if outliers:
            wrong = rng.random(len(i)) < outliers
            L = L - slope * wrong * rng.uniform(1, 6, len(i))
        values = {
            "vertex": i.astype(np.int32),
            "view": np.full(len(i), view, np.int32),
            "radiance": L.astype(np.float32),
            "cos_angle": cos[i].astype(np.float32),
            "range_m": distance[i].astype(np.float32),
            "footprint_m2": (distance[i] ** 2 / (FOCAL**2 * cos[i])).astype(np.float32),
            "u_px": u[i].astype(np.float32),
            "v_px": v[i].astype(np.float32),
            "edge_px": np.full(len(i), 32.0, np.float32),
        }
        for name, column in values.items():
            columns[name].append(column)
    observations = Observations(**{name: np.concatenate(parts) for name, parts in columns.items()})
    return World(observations, T_K, offsets, n_views, points, slope)


def fibonacci_sphere(n: int) -> Float:
    """Evenly spread unit vectors (n, 3)."""
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    a = np.pi * (1 + np.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(a), r * np.sin(a), z], axis=1)


def with_view_order(observations: Observations, order: np.ndarray) -> Observations:
    """The same observations with views renumbered: old view order[k] becomes view k; sorted by (view, vertex)."""
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    renumbered = replace(observations, view=rank[observations.view])
    return renumbered.select(np.lexsort((renumbered.vertex, renumbered.view)))
