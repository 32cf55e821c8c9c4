"""Rays into a phantom: what depth, thermal and colour cameras would see without their own errors."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..geometry.rigid import invert
from ..types import Bool, Camera, Float, Float32
from .scene import RoomConfig
from .shapes import Mesh
from .skin import Covering
from .surround import Surround

RAY_START_M = 2e-4  # a ray that leaves a surface starts this far from it
MARGIN_PX = 12  # around the subject's outline, for lens distortion and breathing
FLOOR_EPSILON = 0.95  # emissivity of the floor, at every angle
UNDISTORT_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-9)  # pixels


class Caster:
    """Rays against one triangle mesh (Embree through Open3D)."""

    def __init__(self, vertices_m: NDArray, triangles: NDArray) -> None:
        from ..geometry._open3d import o3d

        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices_m, np.float32)),
            self._tensor(np.ascontiguousarray(triangles, np.uint32)),
        )

    def hits(self, origins: NDArray, directions: NDArray) -> tuple[Float32, NDArray[np.int64], Float32]:
        """First hits of rays from origins, (3,) or (N, 3) m, along directions (N, 3).

        Returns distance (N,) in lengths of the direction (inf = none), triangle index (N,), barycentric u, v (N, 2).
        """
        origins = np.broadcast_to(origins, directions.shape)
        rays = np.concatenate([origins, directions], 1).astype(np.float32)
        answer = self._scene.cast_rays(self._tensor(rays))
        return (
            answer["t_hit"].numpy(),
            answer["primitive_ids"].numpy().astype(np.int64),
            answer["primitive_uvs"].numpy(),
        )

    def blocked(self, origins: NDArray, targets: NDArray) -> Bool:
        """Mask (N,): something stands between origins (N, 3) m and targets, (3,) or (N, 3) m."""
        targets = np.broadcast_to(targets, origins.shape)
        rays = np.concatenate([origins, targets - origins], 1).astype(np.float32)
        return self._scene.test_occlusions(self._tensor(rays), 0.0, 1.0).numpy()


def corner_weights(uv: Float32) -> Float32:
    """Barycentric (N, 2) of Embree to the weights of the triangle's three corners (N, 3)."""
    return np.concatenate([1 - uv.sum(1, keepdims=True), uv], 1)


# ---------------------------------------------------------------- radiation between parts of the body


@dataclass(frozen=True, eq=False)
class Exchange:
    """What every vertex receives and how much of its hemisphere the body fills.

    incoming : (V,) float32 mean radiance over the cosine-weighted hemisphere. body_fraction : (V,) float32, F.
    """

    incoming: Float32
    body_fraction: Float32


def exchange(mesh: Mesh, covering: Covering, surround: Surround, rng: np.random.Generator) -> Exchange:
    """Diffuse reflections between parts of the body, the floor and the room, by rays over every vertex' hemisphere.

    A ray that hits the body brings ε(θ) L + (1 - ε(θ)) H of that point, H what *it* receives: `reflections` bounces.
    """
    room, band = surround.room, surround.band
    n, k = len(mesh), room.rays
    caster = Caster(mesh.vertices_m, mesh.triangles)
    emitted = band.emit(covering.degC).astype(np.float32)
    room_L, floor_L = (float(band.emit(np.array(t))) for t in (room.reflected_degC, room.floor_degC))
    floor_L = FLOOR_EPSILON * floor_L + (1 - FLOOR_EPSILON) * room_L
    outside, share, fraction = np.zeros(n), np.zeros(n), np.zeros(n)
    blocks: list[sparse.csr_matrix] = []
    chunk = max(2_000_000 // k, 1)
    for start in range(0, n, chunk):
        stop = min(start + chunk, n)
        rows = np.arange(start, stop)
        d = hemisphere(mesh.normals[rows], k, rng).reshape(-1, 3)
        o = np.repeat(mesh.vertices_m[rows] + RAY_START_M * mesh.normals[rows], k, 0)
        t, prim, uv = caster.hits(o, d)
        hit = np.isfinite(t)
        floor = ~hit & (d[:, 2] < 0) if room.floor else np.zeros(len(d), bool)
        background = np.where(floor, floor_L, room_L if surround.even else surround.walls(o, d))
        outside[rows] = np.where(hit, 0, background).reshape(-1, k).mean(1)
        fraction[rows] = hit.reshape(-1, k).mean(1)
        corners, weights = mesh.triangles[prim[hit]], corner_weights(uv[hit])
        cos_angle = -np.einsum("ij,ij->i", interpolate(mesh.normals, corners, weights), d[hit])
        eps = covering.emissivity(dominant(covering.material, corners, weights), cos_angle)
        own = np.repeat(rows, k)[hit]
        share += np.bincount(own, eps * (interpolate(emitted, corners, weights)) / k, n)
        reflect = weights * ((1 - eps) / k)[:, None]
        index = (np.repeat(own - start, 3), corners.ravel())
        blocks.append(sparse.coo_matrix((reflect.ravel(), index), shape=(stop - start, n)).tocsr())
    transfer = sparse.vstack(blocks, format="csr") if blocks else sparse.csr_matrix((n, n))
    if room.things:
        raised = mesh.vertices_m + RAY_START_M * mesh.normals
        outside += surround.things_on(raised, mesh.normals, lambda points, place: ~caster.blocked(points, place))
    incoming = outside + share + transfer @ np.full(n, room_L)
    for _ in range(room.reflections):
        incoming = outside + share + transfer @ incoming
    return Exchange(incoming.astype(np.float32), fraction.astype(np.float32))


def hemisphere(normals: NDArray, k: int, rng: np.random.Generator) -> Float32:
    """`k` cosine-weighted directions about each normal (N, 3): a sunflower disc, turned at random. (N, k, 3)."""
    r = np.sqrt((np.arange(k) + 0.5) / k)
    golden = np.pi * (3 - np.sqrt(5)) * np.arange(k)
    angle = golden[None] + rng.uniform(0, 2 * np.pi, (len(normals), 1))
    n = normals.astype(np.float64)
    helper = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    a = np.cross(n, helper)
    a /= np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-12)
    b = np.cross(n, a)
    x, y, z = r * np.cos(angle), r * np.sin(angle), np.sqrt(1 - r * r)
    return (
        x[..., None] * a[:, None] + y[..., None] * b[:, None] + np.broadcast_to(z, x.shape)[..., None] * n[:, None]
    ).astype(np.float32)


def interpolate(values: NDArray, corners: NDArray, weights: NDArray) -> NDArray:
    """Per-vertex values (V,) or (V, C) at points given by corners and weights (N, 3)."""
    if values.ndim == 1:
        return (values[corners] * weights).sum(1)
    return np.einsum("nkc,nk->nc", values[corners], weights)


def dominant(labels: NDArray, corners: NDArray, weights: NDArray) -> NDArray:
    """(N,) of labels (V,), the nearest corner's: corners (N, 3) vertex indices, weights (N, 3) barycentric."""
    if not labels.any():
        return np.zeros(len(corners), labels.dtype)
    return labels[corners[np.arange(len(corners)), weights.argmax(1)]]


# ---------------------------------------------------------------- images


@dataclass(frozen=True, eq=False)
class Subject:
    """A covered mesh ready for rays, at one moment of its breath."""

    mesh: Mesh
    covering: Covering
    exchange: Exchange
    caster: Caster
    emitted: Float32  # (V,) black-body radiance of the true temperature


@dataclass(frozen=True, eq=False)
class Hits:
    """Pixels of an image that see the subject: `where` (P,) flat index; ray direction in the camera's frame scaled to
    z = 1 and in the body's frame; z_m, corners, weights, cosθ of the smooth normal; origin in the body's frame."""

    where: NDArray[np.int64]
    direction: NDArray
    z_m: NDArray
    corners: NDArray
    weights: Float32
    cos_angle: Float32
    eye: Float


def image_rays(camera: Camera, supersample: int = 1) -> Float:
    """Directions (S·H, S·W, 3) with z = 1, through S x S samples a pixel, by OpenCV's own undistortion."""
    s = supersample
    h, w = camera.shape
    at = lambda n: (np.arange(n * s) + 0.5) / s - 0.5  # noqa: E731
    u, v = np.meshgrid(at(w), at(h))
    points: NDArray = np.stack([u, v], -1).reshape(-1, 1, 2)
    if camera.is_distorted:
        points = cv2.undistortImagePoints(points, camera.K, camera.distortion, arg1=UNDISTORT_STOP)
    xy = (points.reshape(h * s, w * s, 2) - camera.K[:2, 2]) / [camera.K[0, 0], camera.K[1, 1]]
    return np.concatenate([xy, np.ones((h * s, w * s, 1))], -1)


def subject_hits(subject: Subject, camera: Camera, rays: Float, T_body_camera: Float) -> Hits:
    """The pixels that see the subject: rays (S·H, S·W, 3) with z = 1, T_body_camera (4, 4) m."""
    where = _candidates(subject.mesh, camera, rays.shape[:2], T_body_camera)
    R, eye = T_body_camera[:3, :3], T_body_camera[:3, 3]
    direction = rays.reshape(-1, 3)[where] @ R.T
    t, prim, uv = subject.caster.hits(eye, direction)
    hit = np.isfinite(t)
    where, direction, t = where[hit], direction[hit], t[hit].astype(np.float64)
    corners, weights = subject.mesh.triangles[prim[hit]], corner_weights(uv[hit])
    normal = interpolate(subject.mesh.normals, corners, weights)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    cos_angle = -np.einsum("ij,ij->i", normal, direction) / np.linalg.norm(direction, axis=1)
    return Hits(where, direction, t, corners, weights, np.clip(cos_angle, 1e-3, 1).astype(np.float32), eye)


def _candidates(mesh: Mesh, camera: Camera, shape: tuple[int, int], T_body_camera: Float) -> NDArray[np.int64]:
    """Flat indices of the rectangle of samples round the subject's outline."""
    T = invert(T_body_camera)
    p = mesh.vertices_m[:: max(len(mesh) // 20_000, 1)].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    h, w = shape
    if (p[:, 2] < 0.1).any():
        return np.arange(h * w)
    # points far outside the field of view would fold back through the distortion polynomial: bring them to its rim
    rim = 1.3 * np.hypot(camera.width_px / camera.K[0, 0], camera.height_px / camera.K[1, 1]) / 2
    xy = p[:, :2] / p[:, 2:]
    xy *= np.minimum(1, rim / np.maximum(np.linalg.norm(xy, axis=1), 1e-9))[:, None]
    points = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    uv, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
    uv = (uv.reshape(-1, 2) + 0.5) * (w / camera.width_px)
    lo = np.clip(np.floor(uv.min(0)).astype(int) - MARGIN_PX, 0, [w, h])
    hi = np.clip(np.ceil(uv.max(0)).astype(int) + MARGIN_PX, 0, [w, h])
    return (np.arange(lo[1], hi[1])[:, None] * w + np.arange(lo[0], hi[0])[None]).ravel()


def room_distance(room: RoomConfig, rays: Float, T_world_camera: Float) -> tuple[Float32, Bool]:
    """Depth z (S·H, S·W) m of floor and round wall, inf = open space; and a mask (S·H, S·W) of what sees the floor.

    rays : (S·H, S·W, 3) with z = 1. T_world_camera : (4, 4).
    """
    z, floor = np.full(rays.shape[:2], np.inf), np.zeros(rays.shape[:2], bool)
    if room.wall_radius_m is None and not room.floor:
        return z.astype(np.float32), floor
    d = rays @ T_world_camera[:3, :3].T
    eye = T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        if room.wall_radius_m is not None:
            a, b = (d[..., :2] ** 2).sum(-1), (d[..., :2] * eye[:2]).sum(-1)
            inside = eye[0] ** 2 + eye[1] ** 2 - room.wall_radius_m**2
            z = (-b + np.sqrt(np.maximum(b * b - a * inside, 0))) / a
        floor_z = np.where(d[..., 2] < 0, -eye[2] / d[..., 2], np.inf)
        radius = np.linalg.norm(eye[:2] + floor_z[..., None] * d[..., :2], axis=-1)
    if room.floor:
        floor = np.isfinite(floor_z) & (floor_z < z) & (radius < room.floor_radius_m)
        z = np.where(floor, floor_z, z)
    return z.astype(np.float32), floor


def render_depth(
    subject: Subject, camera: Camera, rays: Float, room: RoomConfig, T_body: Float, T_world: Float, baseline_m: float
) -> tuple[Float32, Float32, Bool]:
    """(H, W): true z in metres (NaN = nothing), angle to the normal in rad, and whether the projector's light misses.

    rays : (H, W, 3) with z = 1. T_body, T_world : (4, 4) T_body_depth and T_world_depth. The projector stands
    `baseline_m` to the camera's right.
    """
    z, floor = room_distance(room, rays, T_world)
    cos_floor = np.abs(rays @ T_world[2, :3]) / np.linalg.norm(rays, axis=-1)
    theta = np.where(floor, np.arccos(np.clip(cos_floor, 0, 1)), 0).astype(np.float32)
    shadow = np.zeros(z.shape, bool)
    hits = subject_hits(subject, camera, rays, T_body)
    nearer = hits.z_m < z.ravel()[hits.where]
    where = hits.where[nearer]
    z.ravel()[where], theta.ravel()[where] = hits.z_m[nearer], np.arccos(hits.cos_angle[nearer])
    if baseline_m:
        points = hits.eye + hits.z_m[nearer, None] * hits.direction[nearer]
        off = points - 2e-3 * hits.direction[nearer]  # start before the surface, towards the camera
        shadow.ravel()[where] = subject.caster.blocked(off, hits.eye + baseline_m * T_body[:3, 0])
    return np.where(np.isfinite(z), z, np.nan).astype(np.float32), theta, shadow


def render_thermal(
    subject: Subject, camera: Camera, rays: Float, surround: Surround, T_body: Float, T_world: Float
) -> Float32:
    """Radiance (S·H, S·W) at the lens on the supersampled grid, W m-2 sr-1.

    rays : (S·H, S·W, 3) with z = 1. T_body, T_world : (4, 4) T_body_thermal and T_world_thermal.
    L = τ [ε(θ) L(T) + (1 - ε(θ)) H] + (1 - τ) L(T_air), θ between the sample's own ray and the smooth normal, H the
    mean radiance the point receives.
    """
    room, emit = surround.room, surround.emit
    wall_L = emit(room.reflected_degC if room.background_degC is None else room.background_degC)
    z, floor = room_distance(room, rays, T_world)
    if surround.even:
        wall: NDArray | float = wall_L
    else:
        wall = surround.seen(T_world[:3, 3], rays.reshape(-1, 3) @ T_world[:3, :3].T).reshape(z.shape)
    floor_L = FLOOR_EPSILON * emit(room.floor_degC) + (1 - FLOOR_EPSILON) * emit(room.reflected_degC)
    image = np.where(floor, floor_L, wall)
    hits = subject_hits(subject, camera, rays, T_body)
    eps = subject.covering.emissivity(dominant(subject.covering.material, hits.corners, hits.weights), hits.cos_angle)
    emitted = interpolate(subject.emitted, hits.corners, hits.weights)
    incoming = interpolate(subject.exchange.incoming, hits.corners, hits.weights)
    if room.operator is not None:
        T_world_body = T_world @ invert(T_body)
        points = (hits.eye + hits.z_m[:, None] * hits.direction) @ T_world_body[:3, :3].T + T_world_body[:3, 3]
        normals = interpolate(subject.mesh.normals, hits.corners, hits.weights) @ T_world_body[:3, :3].T
        incoming = incoming + surround.operator_on(points, normals, T_world[:3, 3])
    image.ravel()[hits.where] = eps * emitted + (1 - eps) * incoming
    z.ravel()[hits.where] = hits.z_m
    if room.transmission_per_m < 1:
        length = np.where(np.isfinite(z), z, 0) * np.linalg.norm(rays, axis=-1)
        tau = room.transmission_per_m**length
        image = tau * image + (1 - tau) * emit(room.air_degC)
    return image.astype(np.float32)


def render_color(
    subject: Subject, camera: Camera, rays: Float, room: RoomConfig, T_body: Float, T_world: Float, texture: Texture
) -> NDArray[np.uint8]:
    """A shaded picture (H, W, 3) sRGB in R, G, B order: Lambert under two lamps, skin with freckles and blotches.

    rays : (H, W, 3) with z = 1. T_body, T_world : (4, 4) T_body_color and T_world_color.
    """
    z, floor = room_distance(room, rays, T_world)
    image = np.full((*z.shape, 3), 0.18)
    image[floor] = [0.22, 0.20, 0.18]
    hits = subject_hits(subject, camera, rays, T_body)
    normal = interpolate(subject.mesh.normals, hits.corners, hits.weights)
    light = 0.35 + 0.45 * np.clip(normal @ LAMPS[0], 0, None) + 0.35 * np.clip(normal @ LAMPS[1], 0, None)
    points = interpolate(subject.mesh.vertices_m, hits.corners, hits.weights)
    albedo = texture.at(points) * interpolate(subject.covering.albedo, hits.corners, hits.weights)[:, None]
    image.reshape(-1, 3)[hits.where] = albedo * light[:, None]
    srgb = np.clip(image, 0, 1) ** (1 / 2.2)
    return np.rint(255 * srgb).astype(np.uint8)


LAMPS = np.array([[0.45, -0.60, 0.66], [-0.60, 0.50, 0.62]])
SKIN_RGB = np.array([0.68, 0.44, 0.33])  # linear reflectance of light skin


@dataclass(frozen=True, eq=False)
class Texture:
    """A procedural skin: blotches and freckles as sums of plane waves, fixed to the body."""

    wave: Float  # (3, W) rad/m
    phase: Float  # (W,)

    @classmethod
    def random(cls, rng: np.random.Generator) -> Texture:
        direction = rng.standard_normal((3, 24))
        direction /= np.linalg.norm(direction, axis=0)
        length_m = np.geomspace(0.25, 0.015, 24)
        return cls(direction * 2 * np.pi / length_m, rng.uniform(0, 2 * np.pi, 24))

    def at(self, points_m: NDArray) -> Float:
        """Reflectance (N, 3) in linear R, G, B."""
        waves = np.cos(points_m @ self.wave + self.phase)
        blotch, freckle = waves[:, :12].sum(1) / np.sqrt(6), waves[:, 12:].sum(1) / np.sqrt(6)
        shade = 1 + 0.05 * blotch + 0.04 * freckle - 0.12 * np.clip(freckle - 1.2, 0, 1.0)
        redness = 1 + np.stack([0.02 * blotch, -0.02 * blotch, -0.02 * blotch], 1)
        return SKIN_RGB * np.clip(shade, 0.3, 1.4)[:, None] * redness
