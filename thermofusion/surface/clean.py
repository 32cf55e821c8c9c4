"""The subject's surface alone: floor, walls, what stands beside, and specks are taken away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.camera import project
from ..geometry.manifold import manifold
from ..geometry.mesh import components, keep_vertices, mesh_normals, vertex_areas
from ..geometry.plane import (
    FLOOR_BELOW_FRACTION,
    FLOOR_MIN_AREA_M2,
    FLOOR_NORMAL_COS,
    floor_in_surface,
    refine_floor,
)
from ..geometry.rigid import invert, transform_points
from ..recipe import SubjectSection
from ..robust import weighted_quantile
from ..types import Float, Float32, Int
from .tsdf import GridPlan, Survey

SEEN_TRUNCATIONS = 2.0  # a vertex is on a frame's surface if nearer to it than this, in truncations
VOTE_SHARE = 0.05  # of what a frame sees; less is a hand in front or a chair's leg
MAX_PLANES = 3  # a floor and two walls
SMEAR_M, SMEARED_BELOW = 0.1, 0.98  # poses are against the body: under one that sways the floor is fused as layers


@dataclass(frozen=True)
class RemovedPart:
    """Surface that was taken away: why, and how much."""

    reason: str
    area_cm2: float
    pieces: int


@dataclass(frozen=True, eq=False)
class Cleaned:
    """What is left: vertices_m (V, 3), triangles (F, 3). floor_plane : (4,) `[n, d]` of the floor found, or None.
    floor_top_m : up to where it was taken away: more than the clearance where it was smeared into layers."""

    vertices_m: Float32
    triangles: Int
    floor_plane: Float | None
    removed: tuple[RemovedPart, ...]
    messages: tuple[str, ...]
    floor_top_m: float = 0.0


def subject_only(
    vertices: Float32,
    triangles: Int,
    survey: Survey,
    plan: GridPlan,
    *,
    subject: SubjectSection,
    floor_plane: Float | None,
) -> Cleaned:
    """The surface without floor, background and specks.

    vertices : (V, 3) m. triangles : (F, 3). floor_plane : (4,) `[n, d]` of an earlier stage [m], refined on the
    surface; None: looked for, as the recipe says.
    """
    removed, messages = [], []
    floor: Float | None = None
    walls: list[Float] = []
    clearance_m = floor_top_m = subject.floor_clearance_mm / 1e3
    if subject.floor != "keep":
        if floor_plane is not None:
            floor, thick_m = _given_floor(vertices, triangles, survey, np.asarray(floor_plane, np.float64))
            floor_top_m += thick_m
        floor, walls = _planes(vertices, triangles, survey, (clearance_m, floor_top_m), floor)
        if floor is None and subject.floor == "remove":
            messages.append("no floor plane was found, none was removed")
    planes = [("floor", floor, floor_top_m)] if floor is not None else []
    planes += [("wall", w, clearance_m) for w in walls] if subject.background == "remove" else []
    for reason, plane, top_m in planes:
        stays = _height(plane, vertices) >= top_m
        removed.append(RemovedPart(reason, 1e4 * float(vertex_areas(vertices, triangles)[~stays].sum()), 1))
        vertices, triangles = keep_vertices(vertices, triangles, stays)
    vertices, triangles, others = _pieces(vertices, triangles, survey, plan, subject)
    return Cleaned(vertices, triangles, floor, (*removed, *others), tuple(messages), floor_top_m)


def _height(plane: Float, points: Float32) -> Float32:
    return points @ plane[:3].astype(np.float32) + np.float32(plane[3])


def _given_floor(vertices: Float32, triangles: Int, survey: Survey, plane: Float) -> tuple[Float | None, float]:
    """The floor that tracking saw, refined on the surface, and how far above it m its layers reach; None: it is none.

    Frame by frame it is flat; fused at poses that hold a swaying body still, it is smeared over centimetres.
    """
    areas, normals = vertex_areas(vertices, triangles), mesh_normals(vertices, triangles)
    eyes = survey.T_world_depth[:, :3, 3]
    refined = refine_floor(vertices, normals, areas, eyes, plane)
    if refined is not None:
        return refined, 0.0
    height = _height(plane, vertices)
    on = (np.abs(height) < SMEAR_M) & (normals @ plane[:3].astype(np.float32) > FLOOR_NORMAL_COS)
    below = areas[height < -SMEAR_M].sum() > FLOOR_BELOW_FRACTION * areas.sum()
    if below or areas[on].sum() < FLOOR_MIN_AREA_M2:
        return None, 0.0
    middle, top = (weighted_quantile(height[on], areas[on], q) for q in (0.5, SMEARED_BELOW))
    return np.append(plane[:3], plane[3] - middle), top - middle


def _planes(
    vertices: Float32, triangles: Int, survey: Survey, tops_m: tuple[float, float], floor: Float | None
) -> tuple[Float | None, list[Float]]:
    """The floor (given or found), and other planes that bound the scene: walls.

    Of several planes the floor is the one that faces up as the cameras were held. tops_m : up to where a plane and the
    floor given reach.
    """
    areas, normals = vertex_areas(vertices, triangles), mesh_normals(vertices, triangles)
    eyes, up = survey.T_world_depth[:, :3, 3], -survey.T_world_depth[:, :3, 1].mean(0)
    found: list[Float] = []
    plane = floor
    for _ in range(MAX_PLANES):
        if plane is None:
            plane = floor_in_surface(vertices, normals, areas, eyes)
        if plane is None:
            break
        found.append(plane)
        rest = _height(plane, vertices) >= tops_m[plane is floor]
        vertices, normals, areas, plane = vertices[rest], normals[rest], areas[rest], None
    if floor is None and found:
        floor = max(found, key=lambda p: float(p[:3] @ up))
    return floor, [p for p in found if p is not floor]


def _pieces(
    vertices: Float32, triangles: Int, survey: Survey, plan: GridPlan, subject: SubjectSection
) -> tuple[Float32, Int, tuple[RemovedPart, ...]]:
    """The connected pieces that are the subject.

    The subject is what the camera walked round: in most frames the nearest thing of some size. A wall may be larger and
    fill more of the images, but stands behind. Where the background is kept, only specks go.
    """
    if len(triangles) == 0:
        return vertices, triangles, ()
    vertices, triangles = manifold(vertices, triangles)  # what only touches in a point is a piece of its own
    areas = vertex_areas(vertices, triangles)
    label = components(triangles, len(vertices))
    area_cm2 = 1e4 * np.bincount(label, areas)
    large = area_cm2 >= subject.min_component_cm2
    keep = large.copy()
    if subject.background == "remove" and 0 < subject.keep_components < large.sum():
        votes = _votes(vertices, areas, label, survey, plan)
        ranked = np.flatnonzero(large)[np.argsort(-votes[large], kind="stable")]
        keep[ranked[subject.keep_components :]] = False
    removed = []
    for reason, gone in (("beside the subject", large & ~keep), ("specks", ~large)):
        if gone.any():
            removed.append(RemovedPart(reason, float(area_cm2[gone].sum()), int(gone.sum())))
    vertices, triangles = keep_vertices(vertices, triangles, keep[label])
    return vertices, triangles, tuple(removed)


def _votes(vertices: Float32, areas: Float, label: Int, survey: Survey, plan: GridPlan) -> Float:
    """(pieces,) sampled frames in which a piece is the nearest that fills 5 % of what is seen; plus its mean share."""
    (h, w), pieces = survey.camera.shape, int(label.max()) + 1
    votes = np.zeros(pieces)
    for depth, T in zip(survey.depth, survey.T_world_depth, strict=True):
        uv, z = project(survey.camera, transform_points(invert(T), vertices))
        u, v = (np.nan_to_num(np.rint(uv[:, i]), nan=-1.0) for i in range(2))
        i = np.flatnonzero((u >= 0) & (u < w) & (v >= 0) & (v < h))
        there = depth[v[i].astype(np.intp), u[i].astype(np.intp)]
        i = i[np.abs(there - z[i]) < SEEN_TRUNCATIONS * plan.truncation_m]
        angle = areas[i] / z[i] ** 2  # about the solid angle
        share = np.bincount(label[i], angle, pieces) / max(angle.sum(), 1e-12)
        if len(i):
            z_mean = np.bincount(label[i], angle * z[i], pieces) / np.maximum(share * angle.sum(), 1e-12)
            votes[np.where(share > VOTE_SHARE, z_mean, np.inf).argmin()] += 1
        votes += share / (len(survey.depth) + 1)
    return votes
