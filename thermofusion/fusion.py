"""Depth frames with poses into the subject's surface: fuse, clean, normals, colour.

The TSDF itself is `tsdf`, used only here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import meshing
from .depthfilter import DepthFrames
from .errors import ScanError
from .geometry import interpolate_trajectory, invert, project, transform_points
from .recipe import Recipe
from .tsdf import (
    BYTES_PER_BLOCK,
    FramePoses,
    Frames,
    GridPlan,
    Progress,
    Survey,
    integrate_frames,
    plan_grid,
    survey_depth,
)
from .types import Float, Float32, Int, Scan, SurfaceMesh, Trajectory
from .vertexcolor import color_vertices

SAME_TIME_S = 1e-3  # a pose this near in time is the frame's own
PLANE_PER_WINDOW = 0.4  # radius of a plane fit, of the normal window: see window_normals
MAX_NEIGHBOURS = 100  # in a plane fit
PLANE_AGREES_COS = 0.8  # 37°: a plane fit farther from the mesh's own normal caught another part of the body
SEEN_TRUNCATIONS = 2.0  # a vertex is on a frame's surface if nearer to it than this, in truncations
VOTE_SHARE = 0.05  # of what a frame sees; less is a hand in front or a chair's leg
MAX_PLANES = 3  # a floor and two walls
PINHOLE_VOXELS = 14.0  # round a hole of two voxels' radius
MAX_WALK_M = 100.0  # a camera path longer across than this is in another unit


@dataclass(frozen=True)
class RemovedPart:
    """Surface that was taken away: why, and how much."""

    reason: str
    area_cm2: float
    pieces: int


@dataclass(frozen=True, eq=False)
class FusionResult:
    """A fused surface and how it came about.

    mesh : in world metres. voxel_m, truncation_m : of the grid. max_range_m : depth beyond it was not used.
    noise_m_at_1m : depth noise estimated from the data, grows with range². blocks_estimated, blocks_used, memory_gib :
    of the grid. floor_plane : (4,) `[n, d]`, n·p + d = height above the floor in metres; None = none found.
    """

    mesh: SurfaceMesh
    voxel_m: float
    truncation_m: float
    max_range_m: float
    noise_m_at_1m: float
    blocks_estimated: int
    blocks_used: int
    memory_gib: float
    frames_used: int
    floor_plane: Float | None
    removed: tuple[RemovedPart, ...]
    messages: tuple[str, ...]


def fuse_surface(
    scan: Scan,
    trajectory: Trajectory,
    recipe: Recipe,
    *,
    progress: Progress | None = None,
    floor_plane: Float | None = None,
    frames: Frames | None = None,
) -> FusionResult:
    """Fuse a scan's depth frames into the surface of its subject.

    Parameters
    ----------
    progress : called with ("surface", frames done, frames in all).
    floor_plane : (4,) of an earlier stage, refined on the surface; None: looked for, as the recipe says.
    frames : depth images, if not simply the scan's (e.g. with the background masked out).

    Raises ScanError if no frame has a pose or no surface results, ResourceError if the grid cannot fit into memory.
    """
    frames = frames if frames is not None else DepthFrames(scan, recipe.input)
    poses = depth_poses(scan, trajectory, recipe.input.max_pose_gap_ms / 1e3)
    survey = survey_depth(scan, frames, poses)
    plan = plan_grid(scan, survey, recipe)
    grid, plan = integrate_frames(survey, frames, poses, plan, recipe, progress)
    # A handful of views cannot see everything three times: a third of them is enough.
    min_weight = min(recipe.fusion.min_weight, max(1, len(poses.frame) // 3))
    vertices, triangles = grid.extract(min_weight)
    if len(triangles) == 0:
        raise ScanError(
            f"{len(poses.frame)} depth frames made no surface: nothing was seen {min_weight:g} times",
            place=scan.root,
            hint="the trajectory must be T_world_depth in metres; `thermofusion check` shows the streams",
        )
    vertices, triangles = meshing.canonical(vertices, triangles)
    vertices, triangles, plane, removed, notes = _clean(vertices, triangles, survey, plan, recipe, floor_plane)
    if len(triangles) == 0:
        raise ScanError(
            "no surface is left after cleaning: " + ", ".join(f"{r.area_cm2:.0f} cm² {r.reason}" for r in removed),
            place=scan.root,
            hint="set subject.background = keep, or a smaller subject.min_component_cm2",
        )
    triangles = meshing.close_pinholes(vertices, triangles, PINHOLE_VOXELS * plan.voxel_m)
    vertices = meshing.smooth_positions(vertices, triangles, recipe.fusion.smooth_iterations)
    normals = window_normals(vertices, triangles, recipe.fusion.normal_window_mm / 1e3)
    color = None
    if recipe.fusion.color and scan.color is not None:
        color = color_vertices(scan, trajectory, vertices, normals, recipe.input.max_pose_gap_ms / 1e3)
    return FusionResult(
        mesh=SurfaceMesh(vertices, triangles, normals, color),
        voxel_m=plan.voxel_m,
        truncation_m=plan.truncation_m,
        max_range_m=plan.max_range_m,
        noise_m_at_1m=survey.noise_m_at_1m,
        blocks_estimated=plan.blocks,
        blocks_used=grid.blocks,
        memory_gib=grid.blocks * BYTES_PER_BLOCK / 2**30,
        frames_used=len(poses.frame),
        floor_plane=plane,
        removed=removed,
        messages=(*plan.messages, *notes),
    )


# ---------------------------------------------------------------- poses


def depth_poses(scan: Scan, trajectory: Trajectory, max_gap_s: float) -> FramePoses:
    """The depth frames a trajectory places.

    A trajectory made from the depth frames holds their own times: then only frames with their own pose count, for one
    without was lost by tracking. Any other trajectory (motion capture, robot arm) is interpolated.

    Raises ScanError if no frame is placed, or the camera path is too long to be in metres.
    """
    times = scan.depth.times_s
    near = np.clip(np.searchsorted(trajectory.times_s, times - SAME_TIME_S), 0, len(trajectory) - 1)
    own = np.abs(trajectory.times_s[near] - times) <= SAME_TIME_S
    if own.sum() >= 0.5 * len(trajectory):
        T, valid = trajectory.T_world_depth[near], own
    else:
        T, valid = interpolate_trajectory(trajectory, times, max_gap_s=max_gap_s)
        T[own] = trajectory.T_world_depth[near[own]]
        valid = valid | own
    valid = valid & scan.depth.usable
    if not valid.any():
        raise ScanError(
            f"none of {len(times)} depth frames has a pose: depth runs {times[0]:.3f} to {times[-1]:.3f} s, "
            f"the trajectory {trajectory.times_s[0]:.3f} to {trajectory.times_s[-1]:.3f} s",
            place=scan.root,
            hint="both must use the depth camera's clock",
        )
    walk = np.ptp(T[valid][:, :3, 3], axis=0).max()
    if walk > MAX_WALK_M:
        raise ScanError(
            f"the camera path is {walk:.0f} m across", place=scan.root, hint="the trajectory must be in metres"
        )
    return FramePoses(np.flatnonzero(valid), T[valid])


# ---------------------------------------------------------------- normals


def window_normals(vertices: Float32, triangles: Int, window_m: float) -> Float32:
    """Unit outward normals (V, 3), averaged over a window of the given diameter.

    Normals of planes fitted to the vertices within 0.4 of the diameter: a window with a hard rim rounds off curves as
    much as a tapered one of 1.2 times its size. On torso-dev, window 25 mm, the mean error is 1.2°, against 1.5° of
    triangle normals spread over the mesh until as wide. A ball in space may catch a neighbouring finger, too: where the
    plane disagrees with the mesh's own normal, that one is kept.
    """
    from ._open3d import o3d

    own = meshing.mesh_normals(vertices, triangles)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(vertices)))
    cloud.estimate_normals(max_nn=MAX_NEIGHBOURS, radius=PLANE_PER_WINDOW * window_m)
    n: Float32 = cloud.point.normals.numpy()
    cos = np.einsum("ij,ij->i", n, own)
    return np.where((np.abs(cos) > PLANE_AGREES_COS)[:, None], n * np.sign(cos)[:, None], own)


# ---------------------------------------------------------------- cleaning


def _clean(
    vertices: Float32, triangles: Int, survey: Survey, plan: GridPlan, recipe: Recipe, floor_plane: Float | None
) -> tuple[Float32, Int, Float | None, tuple[RemovedPart, ...], tuple[str, ...]]:
    """The subject's surface alone: without floor, background and specks."""
    subject, removed, messages = recipe.subject, [], []
    floor: Float | None = None
    walls: list[Float] = []
    if subject.floor != "keep":
        floor, walls = _planes(vertices, triangles, survey, subject.floor_clearance_mm / 1e3, floor_plane)
        if floor is None and subject.floor == "remove":
            messages.append("no floor plane was found, none was removed")
    planes = [("floor", floor)] if floor is not None else []
    planes += [("wall", w) for w in walls] if subject.background == "remove" else []
    for reason, plane in planes:
        stays = _height(plane, vertices) >= subject.floor_clearance_mm / 1e3
        removed.append(RemovedPart(reason, 1e4 * float(meshing.vertex_areas(vertices, triangles)[~stays].sum()), 1))
        vertices, triangles = meshing.keep_vertices(vertices, triangles, stays)
    vertices, triangles, others = _pieces(vertices, triangles, survey, plan, recipe)
    return vertices, triangles, floor, (*removed, *others), tuple(messages)


def _height(plane: Float, points: Float32) -> Float32:
    return points @ plane[:3].astype(np.float32) + np.float32(plane[3])


def _planes(
    vertices: Float32, triangles: Int, survey: Survey, clearance_m: float, floor: Float | None
) -> tuple[Float | None, list[Float]]:
    """The floor (given or found), and other planes that bound the scene: walls.

    Of several planes the floor is the one that faces up as the cameras were held.
    """
    areas, normals = meshing.vertex_areas(vertices, triangles), meshing.mesh_normals(vertices, triangles)
    eyes, up = survey.T_world_depth[:, :3, 3], -survey.T_world_depth[:, :3, 1].mean(0)
    found: list[Float] = []
    if floor is not None:
        floor = meshing.refine_floor(vertices, normals, areas, eyes, np.asarray(floor, np.float64))
    plane = floor
    for _ in range(MAX_PLANES):
        if plane is None:
            plane = meshing.find_floor(vertices, normals, areas, eyes)
        if plane is None:
            break
        found.append(plane)
        rest = _height(plane, vertices) >= clearance_m
        vertices, normals, areas, plane = vertices[rest], normals[rest], areas[rest], None
    if floor is None and found:
        floor = max(found, key=lambda p: float(p[:3] @ up))
    return floor, [p for p in found if p is not floor]


def _pieces(
    vertices: Float32, triangles: Int, survey: Survey, plan: GridPlan, recipe: Recipe
) -> tuple[Float32, Int, tuple[RemovedPart, ...]]:
    """The connected pieces that are the subject.

    The subject is what the camera walked round: in most frames the nearest thing of some size. A wall may be larger and
    fill more of the images, but stands behind. Where the background is kept, only specks go.
    """
    subject = recipe.subject
    if len(triangles) == 0:
        return vertices, triangles, ()
    areas = meshing.vertex_areas(vertices, triangles)
    label = meshing.components(triangles, len(vertices))
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
    vertices, triangles = meshing.keep_vertices(vertices, triangles, keep[label])
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
