"""Surfaces of phantoms: bodies of revolution, a mannequin torso, and the CC0 MakeHuman body in poses and sizes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import PchipInterpolator
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from ..files.shipped import data_dir
from ..geometry.rigid import pose, transform_points
from ..types import Float, Float32, Int
from .scene import ShapeConfig

# Joints of the shipped body [m]: right-hand side of the picture (+x); the other side mirrors x.
SHOULDER = np.array([0.185, 0.005, 1.390])
ELBOW = np.array([0.360, 0.005, 1.215])
WRIST = np.array([0.488, -0.205, 1.075])
HIP = np.array([0.095, 0.010, 0.900])
NECK_Z = 1.455  # m, height of the cut below the head


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface with what its covering and its motion need.

    vertices_m : (V, 3) float32. triangles : (F, 3) int32, counter-clockwise from outside. normals : (V, 3) float32.
    extremity : (V,) 0 on the trunk to 1 at finger tips and toes. chest : (V,) 0..1, how far breathing moves it.
    """

    vertices_m: Float32
    triangles: Int
    normals: Float32
    extremity: Float32
    chest: Float32

    def __len__(self) -> int:
        return len(self.vertices_m)


def build_shape(config: ShapeConfig) -> Mesh:
    """The mesh of a scene's subject, standing `base_m` above the floor."""
    if config.kind in ("body", "head", "hand"):
        return _finish(*_body(config), config)
    h, r = config.edge_mm / 1e3, config.diameter_m / 2
    if config.kind == "cylinder":
        profile = np.array([[0, 0], [r, 0], [r, config.length_m], [0, config.length_m]])
        v, f = revolve(_resample(profile, h), h)
    elif config.kind == "sphere":
        a = np.linspace(-np.pi / 2, np.pi / 2, max(int(np.pi * r / h), 12))
        v, f = revolve(np.stack([r * np.cos(a), r + r * np.sin(a)], 1), h)
    elif config.kind == "bowl":
        v, f = _bowl(r, config.opening, h)
    else:
        v, f = _mannequin(h)
        v = _scale(v, config)
    return _finish(v, f, config)


def _finish(v: Float, f: NDArray, config: ShapeConfig) -> Mesh:
    v = v + np.array([0, 0, config.base_m - v[:, 2].min()])
    shoulder = np.array([SHOULDER[0] * config.girth_scale, SHOULDER[2]]) * config.height_scale
    is_body = config.kind == "body"
    # distance along the limbs, normalised: from the shoulder outwards, from the hip downwards
    arm = np.clip((np.abs(v[:, 0]) - 1.1 * shoulder[0]) / (0.4 * config.height_scale), 0, 1)
    leg = np.clip((HIP[2] * config.height_scale - v[:, 2]) / (HIP[2] * config.height_scale), 0, 1)
    extremity = np.maximum(arm, leg) ** 1.5 if is_body else np.zeros(len(v))
    chest = _chest(v, config) if config.kind in ("body", "torso") else np.zeros(len(v))
    triangles = f.astype(np.int32)
    return Mesh(
        v.astype(np.float32),
        triangles,
        vertex_normals(v, triangles).astype(np.float32),
        extremity.astype(np.float32),
        chest.astype(np.float32),
    )


def vertex_normals(v: NDArray, f: NDArray) -> Float:
    """Area-weighted unit normals (V, 3) of vertices v (V, 3) with triangles f (F, 3)."""
    face = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]).astype(np.float64)
    n = np.stack([np.bincount(f.ravel(), np.repeat(face[:, i], 3), len(v)) for i in range(3)], 1)
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)


# ---------------------------------------------------------------- bodies of revolution


def revolve(profile: Float, edge_m: float, section: NDArray | None = None) -> tuple[Float, NDArray]:
    """A profile (N, 2) of (radius, z), rising in z round the outside, turned about z. Radius 0 at an end = a pole.

    section : (M, 2) cross-section in place of the unit circle. Returns vertices (V, 3), triangles (F, 3).
    """
    if section is None:
        m = max(int(np.ceil(2 * np.pi * profile[:, 0].max() / edge_m)), 24)
        a = 2 * np.pi * np.arange(m) / m
        section = np.stack([np.cos(a), np.sin(a)], 1)
    m = len(section)
    rings = np.concatenate(
        [profile[:, None, :1] * section[None], np.broadcast_to(profile[:, None, 1:], (len(profile), m, 1))], axis=2
    )
    return _stitch(rings)


def _stitch(rings: Float) -> tuple[Float, NDArray]:
    """Triangles between rings (N, M, 3); a ring that is one point becomes a pole. Seen from outside if rings rise
    and run counter-clockwise."""
    n, m, _ = rings.shape
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m), indexing="ij")
    a, b = i * m + j, i * m + (j + 1) % m
    f = np.concatenate([np.stack([a, b, b + m], -1).reshape(-1, 3), np.stack([a, b + m, a + m], -1).reshape(-1, 3)])
    v = rings.reshape(-1, 3).copy()
    alias = np.arange(n * m)
    for ring in (0, n - 1):
        if np.ptp(rings[ring], axis=0).max() < 1e-9:
            alias[ring * m : (ring + 1) * m] = ring * m
    f = alias[f]
    f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 0] != f[:, 2])]
    return compact(v, f)


def compact(v: NDArray, f: NDArray) -> tuple[Float, NDArray]:
    """Vertices v (V, 3) m without those that no triangle uses, and triangles f (F, 3) with their new indices."""
    used, inverse = np.unique(f, return_inverse=True)
    return np.asarray(v[used], np.float64), inverse.reshape(-1, 3)


def _resample(profile: Float, step_m: float) -> Float:
    """Points on a polyline at most `step_m` apart, corners kept."""
    parts = []
    for a, b in pairwise(profile):
        n = max(int(np.ceil(np.linalg.norm(b - a) / step_m)), 1)
        parts.append(a + (b - a) * np.arange(n)[:, None] / n)
    return np.concatenate([*parts, profile[-1:]])


def _bowl(r: float, opening: float, edge_m: float) -> tuple[Float, NDArray]:
    """A thick spherical bowl that opens to -y. Every point inside sees the bowl in the share F = 1 - opening."""
    # area of a cap of half-angle a is the share (1 - cos a)/2 of the sphere
    rim = np.pi - np.arccos(1 - 2 * opening)
    wall = 0.05 * r
    a = np.linspace(0, rim, max(int(rim * r / edge_m), 12))
    outside = np.stack([(r + wall) * np.sin(a), -(r + wall) * np.cos(a)], 1)
    inside = np.stack([r * np.sin(a), -r * np.cos(a)], 1)[::-1]
    v, f = revolve(np.concatenate([outside, inside]), edge_m)
    return v @ Rotation.from_euler("x", 90, degrees=True).as_matrix().T, f


def _mannequin(edge_m: float) -> tuple[Float, NDArray]:
    """A smooth torso from hip to neck: superelliptic sections, half-axes interpolated over the height."""
    z = np.array([0.0, 0.005, 0.02, 0.12, 0.25, 0.36, 0.44, 0.50, 0.54, 0.57, 0.60, 0.64, 0.645])
    wide = np.array([0.0, 0.155, 0.168, 0.172, 0.145, 0.160, 0.178, 0.170, 0.130, 0.080, 0.060, 0.058, 0.0])
    deep = np.array([0.0, 0.100, 0.112, 0.118, 0.100, 0.112, 0.118, 0.108, 0.085, 0.066, 0.058, 0.056, 0.0])
    n = int(0.645 / edge_m) + 1
    # even along the outline, so that the flat ends get triangles of the same size
    s = np.concatenate([[0], np.cumsum(np.hypot(np.diff(wide), np.diff(z)))])
    at = np.linspace(0, s[-1], int(s[-1] / edge_m) + n // 8)
    z_i, a_i, b_i = (PchipInterpolator(s, q)(at) for q in (z, wide, deep))
    t = np.linspace(0, 2 * np.pi, max(int(1.0 / edge_m), 48), endpoint=False)
    power = 0.8  # between ellipse (1) and box (0)
    x = np.sign(np.cos(t)) * np.abs(np.cos(t)) ** power
    y = np.sign(np.sin(t)) * np.abs(np.sin(t)) ** power
    rings = np.stack([a_i[:, None] * x, b_i[:, None] * y, np.broadcast_to(z_i[:, None], (len(z_i), len(t)))], axis=2)
    v, f = _stitch(rings)
    return v, f


# ---------------------------------------------------------------- the body


def _body(config: ShapeConfig) -> tuple[Float, NDArray]:
    with np.load(data_dir() / "body" / "body.npz") as data:
        v, quads = data["vertices_m"].astype(np.float64), data["quads"].astype(np.int64)
    f = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    v = _posed(v, f, config)
    if config.belly_m:
        d2 = ((v[:, [0, 2]] - [0, 1.02]) / [0.13, 0.13]) ** 2
        v[:, 1] -= config.belly_m * np.exp(-d2.sum(1) / 2) * np.clip(-v[:, 1] / 0.08, 0, 1)
    if config.kind == "head":
        v, f = cut(v, f, np.array([0, 0, NECK_Z]), np.array([0, 0, 1.0]), near=np.array([0, 0, 1.7]))
    elif config.kind == "hand":
        v, f = cut(v, f, WRIST + 0.45 * (ELBOW - WRIST), WRIST - ELBOW, near=WRIST)
        v = v - v.mean(0)
        up, _ = Rotation.align_vectors(np.array([[0, 0, 1.0]]), (WRIST - ELBOW)[None])
        v = up.apply(v)
    for _ in range(config.subdivisions):
        v, f = subdivide(v, f)
    return _scale(v, config), f


def _scale(v: Float, config: ShapeConfig) -> Float:
    return v * config.height_scale * np.array([config.girth_scale, config.girth_scale, 1.0])


def _chest(v: Float, config: ShapeConfig) -> Float:
    """How far breathing moves a point, 0..1: the front of chest and belly, fading to nothing at sides and limbs."""
    h = config.height_scale
    center, size = np.array([0, 1.20 * h]), np.array([0.13 * config.girth_scale * h, 0.16 * h])
    bump = np.exp(-0.5 * (((v[:, [0, 2]] - center) / size) ** 2).sum(1))
    return bump * np.clip(-v[:, 1] / (0.06 * h), 0, 1)


def _posed(v: Float, f: NDArray, config: ShapeConfig) -> Float:
    """Linear blend skinning of arms, elbows and legs about their joints; weights are harmonic on the surface."""
    laplacian = graph_laplacian(len(v), f)
    out = v.copy()
    for side in (1.0, -1.0):
        mirror = np.array([side, 1, 1])
        p = v * mirror  # as if on the +x side; rotations are mirrored back with it
        moved = out * mirror
        if config.legs_deg:
            weight = _harmonic(laplacian, (p[:, 0] > 0.02) & (p[:, 2] < 0.70), (p[:, 0] < -0.02) | (p[:, 2] > 0.98))
            # a leg keeps the sole on the floor well enough at these small angles
            moved = _turn(moved, weight, HIP, Rotation.from_euler("y", -config.legs_deg, degrees=True))
        lift = Rotation.from_euler("y", -config.arms_deg, degrees=True)
        forward = Rotation.from_euler("x", config.arms_forward_deg, degrees=True)
        if config.elbows_deg:
            weight = limb_weight(laplacian, p, ELBOW, WRIST - ELBOW, (-0.03, 0.04), 0.12)
            axis = np.cross(ELBOW - SHOULDER, WRIST - ELBOW)
            bend = Rotation.from_rotvec(np.radians(config.elbows_deg) * axis / np.linalg.norm(axis))
            moved = _turn(moved, weight, ELBOW, bend)
        if config.arms_deg or config.arms_forward_deg:
            weight = limb_weight(laplacian, p, SHOULDER, ELBOW - SHOULDER, (-0.04, 0.10), 0.11)
            moved = _turn(moved, weight, SHOULDER, forward * lift)
        out = moved * mirror
    return out


def limb_weight(
    laplacian: sparse.csr_matrix, p: Float, joint: Float, axis: Float, band_m: tuple[float, float], girth_m: float
) -> Float:
    """1 on the limb beyond a joint, 0 before it, harmonic between (along `axis`, over the band)."""
    axis = axis / np.linalg.norm(axis)
    along = (p - joint) @ axis
    off_axis = np.linalg.norm(p - joint - along[:, None] * axis, axis=1)
    outer = np.abs(p[:, 0]) > 0.30  # forearms and hands leave the upper arm's axis, but nothing else is out there
    limb = (p[:, 0] > 0) & (along > band_m[1]) & ((off_axis < girth_m) | outer)
    rest = (along < band_m[0]) | (p[:, 0] <= 0) | ((off_axis >= girth_m) & ~outer)
    return _harmonic(laplacian, limb, rest)


def _harmonic(laplacian: sparse.csr_matrix, one: NDArray, zero: NDArray) -> Float:
    """Weights with given 1s and 0s, each other vertex the mean of its neighbours."""
    weight = one.astype(np.float64)
    free = np.flatnonzero(~(one | zero))
    if len(free):
        rows = laplacian[free]
        weight[free] = spsolve(rows[:, free].tocsc(), -(rows @ weight))
    return weight


def graph_laplacian(n: int, f: NDArray) -> sparse.csr_matrix:
    """(n, n) of the mesh's edges, dimensionless: degree minus adjacency. f : (F, 3) triangles."""
    i, j = f[:, [0, 1, 2]].ravel(), f[:, [1, 2, 0]].ravel()
    adjacency = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    adjacency = ((adjacency + adjacency.T) > 0).astype(np.float64).tocsr()
    return (sparse.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency).tocsr()


def _turn(v: Float, weight: Float, joint: Float, rotation: Rotation) -> Float:
    turned = transform_points(pose(rotation.as_matrix(), joint - rotation.apply(joint)), v)
    return v + weight[:, None] * (turned - v)


def cut(v: Float, f: NDArray, point: Float, normal: Float, *, near: Float) -> tuple[Float, NDArray]:
    """Keep the surface on the side `normal` of a plane, the connected part at `near`, closed with a flat cap.

    point : (3,) m, on the plane. normal : (3,). near : (3,) m. v, f and the result: vertices (V, 3) m, triangles (F,
    3).
    """
    normal = normal / np.linalg.norm(normal)
    side = (v - point) @ normal
    f = f[(side[f] > 0).all(1)]
    f = f[_part_near(v, f, near)]
    v, f = compact(v, f)
    edges = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    key = np.sort(edges, 1)
    _, inverse, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    rim = edges[count[inverse.ravel()] == 1]
    on_rim = np.unique(rim)
    v[on_rim] -= ((v[on_rim] - point) @ normal)[:, None] * normal
    center = len(v)
    v = np.concatenate([v, v[on_rim].mean(0, keepdims=True)])
    return v, np.concatenate([f, np.stack([rim[:, 1], rim[:, 0], np.full(len(rim), center)], 1)])


def _part_near(v: Float, f: NDArray, near: Float) -> NDArray[np.bool_]:
    graph = sparse.coo_matrix((np.ones(2 * len(f)), (f[:, [0, 1]].ravel(), f[:, [1, 2]].ravel())), shape=(len(v),) * 2)
    _, label = connected_components(graph, directed=False)
    part = label[f[:, 0]]
    return part == part[np.linalg.norm(v[f[:, 0]] - near, axis=1).argmin()]


def subdivide(v: Float, f: NDArray) -> tuple[Float, NDArray]:
    """One step of Loop's smooth subdivision of a closed mesh (Loop 1987): every triangle becomes four.

    v : (V, 3) m, f : (F, 3); returned as v and edges' middles (V + E, 3) m and (4 F, 3).
    """
    n = len(v)
    edges = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    opposite = np.concatenate([f[:, 2], f[:, 0], f[:, 1]])
    unique, inverse = np.unique(np.sort(edges, 1), axis=0, return_inverse=True)
    inverse = inverse.ravel()
    wings = np.stack([np.bincount(inverse, v[opposite, i], len(unique)) for i in range(3)], 1)
    middle = 3 / 8 * (v[unique[:, 0]] + v[unique[:, 1]]) + 1 / 8 * wings
    ones = np.ones(2 * len(unique))
    both = np.concatenate([unique, unique[:, ::-1]])
    adjacency = sparse.coo_matrix((ones, (both[:, 0], both[:, 1])), shape=(n, n)).tocsr()
    valence = np.asarray(adjacency.sum(1)).ravel()
    beta = np.where(valence == 3, 3 / 16, 3 / (8 * np.maximum(valence, 1)))
    corner = (1 - valence * beta)[:, None] * v + beta[:, None] * (adjacency @ v)
    m = n + inverse.reshape(3, -1).T  # midpoints of edges 01, 12, 20
    quarters = [
        np.stack([f[:, 0], m[:, 0], m[:, 2]], 1),
        np.stack([f[:, 1], m[:, 1], m[:, 0]], 1),
        np.stack([f[:, 2], m[:, 2], m[:, 1]], 1),
        m,
    ]
    return np.concatenate([corner, middle]), np.concatenate(quarters)
