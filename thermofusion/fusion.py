"""Depth frames with poses into one surface: survey, voxel grid (TSDF), mesh, cleaning. The only user of a TSDF.

The grid is Open3D's `VoxelBlockGrid` on the CPU. How many blocks a scan needs is estimated beforehand from a sample of
frames, so memory is known and bounded before it is taken; the grid still grows if the sample missed something.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from . import meshing
from .depthfilter import DepthFrames
from .errors import ResourceError, ScanError
from .geometry import interpolate_trajectory, invert, project, transform_points
from .recipe import Recipe
from .types import Camera, Float, Float32, Int, Scan, SurfaceMesh, Trajectory
from .vertexcolor import color_vertices

BLOCK = 8  # voxels along the edge of a block
BYTES_PER_BLOCK = BLOCK**3 * (8 + 16)  # tsdf and weight, plus the table that mesh extraction builds
SURVEY_FRAMES = 16
SAME_TIME_S = 1e-3  # a pose this near in time is the frame's own
NOISE_M_AT_1M = 1.425e-3  # Kinect v1 depth noise is about this times z² (Khoshelham & Elberink 2012)
NOISE_BOUNDS = (0.4e-3, 6e-3)  # of the coefficient estimated from the data
VOXEL_PER_NOISE, VOXEL_PER_FOOTPRINT = 1.5, 0.8  # finer voxels than this hold noise, or what no thermal pixel resolves
VOXEL_BOUNDS_M = (2e-3, 10e-3)
TRUNCATION_PER_NOISE = 5.0  # wide enough that noise is averaged, not cut; wider rounds off edges
FAR_NOISE_PER_TRUNCATION = 0.5  # depth noisier than this share of the truncation would only blur
FAR_PER_MEDIAN = 1.3  # but nothing nearer than this share of the median range is given up
MIN_TRUNCATION_VOXELS = 3.0
MAX_VOXEL_M = 0.1
ESTIMATE_MARGIN = 1.1
GROWTH = 1.3  # of the block table, each time it is full
SEEN_TRUNCATIONS = 2.0  # a vertex is on a frame's surface if nearer to it than this, in truncations
FLOOR_NORMAL_WINDOW_M = 0.03
MAX_WALK_M = 100.0  # a camera path longer across than this is in another unit

Progress = Callable[[str, int, int], None]


class Frames(Protocol):
    """Where depth images come from: `DepthFrames`, or one that also masks the background."""

    camera: Camera

    def load(self, i: int) -> Float32: ...

    def read_ahead(self, frames: Any, *, workers: int = 2) -> Any: ...


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
    survey = _survey(scan, frames, poses)
    plan = _plan(scan, survey, recipe)
    grid, plan = _integrate(survey, frames, poses, plan, recipe, progress)
    vertices, triangles = grid.extract(recipe.fusion.min_weight)
    if len(triangles) == 0:
        raise ScanError(
            f"{len(poses.frame)} depth frames made no surface: nothing was seen {recipe.fusion.min_weight:g} times",
            place=scan.root,
            hint="the trajectory must be T_world_depth in metres; `thermofusion check` shows the streams",
        )
    vertices, triangles = meshing.canonical(vertices, triangles, plan.voxel_m / 1000)
    vertices, triangles, plane, removed, notes = _clean(vertices, triangles, survey, plan, recipe, floor_plane)
    if len(triangles) == 0:
        raise ScanError(
            "no surface is left after cleaning: " + ", ".join(f"{r.area_cm2:.0f} cm² {r.reason}" for r in removed),
            place=scan.root,
            hint="set subject.background = keep, or a smaller subject.min_component_cm2",
        )
    vertices = meshing.smooth_positions(vertices, triangles, recipe.fusion.smooth_iterations)
    normals = meshing.window_normals(vertices, triangles, recipe.fusion.normal_window_mm / 1e3)
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


@dataclass(frozen=True, eq=False)
class FramePoses:
    """Depth frames that have a pose. frame : (N,) position in the depth stream; T_world_depth : (N, 4, 4)."""

    frame: NDArray[np.int64]
    T_world_depth: Float


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


# ---------------------------------------------------------------- survey and plan


@dataclass(frozen=True, eq=False)
class _Survey:
    """What a sample of frames tells beforehand."""

    camera: Camera
    depth: tuple[Float32, ...]
    T_world_depth: Float
    median_range_m: float
    noise_m_at_1m: float


@dataclass(frozen=True, eq=False)
class _Plan:
    """The grid to be made."""

    voxel_m: float
    truncation_m: float
    max_range_m: float
    blocks: int
    max_blocks: int
    messages: tuple[str, ...]


def _survey(scan: Scan, frames: Frames, poses: FramePoses) -> _Survey:
    pick = np.unique(np.linspace(0, len(poses.frame) - 1, SURVEY_FRAMES).astype(int))
    depth = tuple(d for _, d in frames.read_ahead(poses.frame[pick].tolist()))
    ranges = np.concatenate([d[::4, ::4].ravel() for d in depth])
    ranges = ranges[np.isfinite(ranges)]
    if len(ranges) == 0:
        raw = scan.depth.load(int(poses.frame[pick[len(pick) // 2]]))
        seen = f"it lies at {np.nanmin(raw):.3g} to {np.nanmax(raw):.3g} m" if np.isfinite(raw).any() else "it is empty"
        raise ScanError(
            f"no depth is left within input.min_depth_m and input.max_depth_m: {seen}",
            place=scan.depth.places[int(poses.frame[pick[len(pick) // 2]])],
            hint="check depth_unit_m",
        )
    return _Survey(frames.camera, depth, poses.T_world_depth[pick], float(np.median(ranges)), depth_noise(depth))


def depth_noise(images: tuple[Float32, ...] | list[Float32]) -> float:
    """Depth noise, one sigma in metres at 1 m, growing with range² as a triangulating camera's does.

    From second differences over 4 px, which a smooth surface hardly has and in which noise of a few pixels'
    correlation is whole: z(u-4) - 2 z(u) + z(u+4) has variance 6 σ². Median absolute deviation, so edges do not count.
    """
    r = []
    for d in images:
        with np.errstate(invalid="ignore"):
            q = (d[::2, 8:] - 2 * d[::2, 4:-4] + d[::2, :-8]) / d[::2, 4:-4] ** 2
        r.append(q[np.isfinite(q)])
    values = np.concatenate(r)
    if len(values) < 1000:
        return NOISE_M_AT_1M
    return float(np.clip(1.4826 * np.median(np.abs(values)) / np.sqrt(6), *NOISE_BOUNDS))


def _plan(scan: Scan, survey: _Survey, recipe: Recipe) -> _Plan:
    """Voxel, truncation and blocks within the memory allowed: the voxel grows until it fits."""
    wanted = voxel = _voxel(scan, survey, recipe)
    max_blocks = int(recipe.fusion.max_memory_gib * 2**30 / BYTES_PER_BLOCK)
    while True:
        plan = _grid_plan(voxel, survey, recipe, max_blocks)
        blocks = _estimate_blocks(survey, plan)
        if blocks <= max_blocks:
            break
        if voxel > MAX_VOXEL_M:
            raise ResourceError(
                f"even voxels of {1e3 * voxel:.0f} mm need more than {recipe.fusion.max_memory_gib:g} GiB",
                place="fusion.max_memory_gib",
                hint="allow more memory, or check that poses and depth are in metres",
            )
        voxel *= 1.1
    messages = () if voxel == wanted else (_coarsened(wanted, voxel, recipe),)
    return replace(plan, blocks=blocks, messages=messages)


def _coarsened(wanted_m: float, voxel_m: float, recipe: Recipe) -> str:
    return (
        f"voxels of {1e3 * wanted_m:.1f} mm would need more than fusion.max_memory_gib = "
        f"{recipe.fusion.max_memory_gib:g}; {1e3 * voxel_m:.1f} mm were used"
    )


def _voxel(scan: Scan, survey: _Survey, recipe: Recipe) -> float:
    """Edge of a voxel [m]: the recipe's, or no finer than depth noise and the thermal camera's footprint support."""
    if recipe.fusion.voxel_mm != "auto":
        return recipe.fusion.voxel_mm / 1e3
    z = survey.median_range_m
    footprint = 0.0 if scan.rig.thermal is None else z / scan.rig.thermal.focal_px
    return float(
        np.clip(max(VOXEL_PER_NOISE * survey.noise_m_at_1m * z**2, VOXEL_PER_FOOTPRINT * footprint), *VOXEL_BOUNDS_M)
    )


def _grid_plan(voxel: float, survey: _Survey, recipe: Recipe, max_blocks: int) -> _Plan:
    """Truncation and far limit that go with a voxel and the noise at the subject's distance."""
    z, noise = survey.median_range_m, survey.noise_m_at_1m
    if recipe.fusion.truncation_voxels == "auto":
        truncation = max(MIN_TRUNCATION_VOXELS * voxel, TRUNCATION_PER_NOISE * noise * z**2)
    else:
        truncation = recipe.fusion.truncation_voxels * voxel
    far = max(float(np.sqrt(FAR_NOISE_PER_TRUNCATION * truncation / noise)), FAR_PER_MEDIAN * z)
    return _Plan(voxel, truncation, min(far, recipe.input.max_depth_m), 0, max_blocks, ())


def _estimate_blocks(survey: _Survey, plan: _Plan) -> int:
    """Blocks the whole scan will touch, from those that the sampled frames touch.

    If doubling the sample from half to whole added g blocks, doubling it again and again adds g/2 + g/4 + ... = g.
    """
    grid = _Grid(survey.camera, plan, 1)
    touched = [grid.touch(d, T) for d, T in zip(survey.depth, survey.T_world_depth, strict=True)]
    half, whole = _count_unique(touched[::2]), _count_unique(touched)
    return int(ESTIMATE_MARGIN * (2 * whole - half))


def _count_unique(blocks: list[NDArray[np.int32]]) -> int:
    xyz = np.concatenate(blocks).astype(np.int64) + 2**20
    return len(np.unique((xyz[:, 0] << 42) | (xyz[:, 1] << 21) | xyz[:, 2]))


# ---------------------------------------------------------------- the grid


class _Grid:
    """A truncated signed distance field in blocks of 8³ voxels, each holding distance and weight as float32."""

    def __init__(self, camera: Camera, plan: _Plan, capacity: int) -> None:
        from ._open3d import o3d

        self._o3d, self._plan = o3d, plan
        one = ((1,), (1,))
        float32 = (o3d.core.float32, o3d.core.float32)
        cpu = o3d.core.Device("CPU:0")
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), float32, one, plan.voxel_m, BLOCK, max(capacity, 1), cpu
        )
        # Open3D takes the pixel whose index is floor(u), which puts the first pixel's centre at (0.5, 0.5). Ours is at
        # (0, 0). Without the shift surfaces lie half a pixel aside: 0.43 instead of 0.23 mm mean error at 1.1 m.
        K = camera.K.copy()
        K[:2, 2] += 0.5
        self._K = o3d.core.Tensor(K)
        self._multiplier = plan.truncation_m / plan.voxel_m

    @property
    def blocks(self) -> int:
        """Blocks in use."""
        return int(self._grid.hashmap().size())

    def touch(self, depth_m: Float32, T_world_depth: Float) -> NDArray[np.int32]:
        """(N, 3) coordinates of the blocks within the truncation of a frame's surface."""
        image, extrinsic = self._arguments(depth_m, T_world_depth)
        if image is None:
            return np.zeros((0, 3), np.int32)
        return self._blocks(image, extrinsic).numpy()

    def integrate(self, depth_m: Float32, T_world_depth: Float) -> bool:
        """Average a frame into the field. False, with the field unchanged, if that needs more blocks than allowed.

        The table is enlarged before the blocks go in: one that overflows while they do loses blocks, and the surface
        gets holes.
        """
        image, extrinsic = self._arguments(depth_m, T_world_depth)
        if image is None:
            return True
        blocks, table = self._blocks(image, extrinsic), self._grid.hashmap()
        if table.size() + len(blocks) > table.capacity():
            needed = table.size() + int((~table.find(blocks)[1].numpy()).sum())
            if needed > self._plan.max_blocks:
                return False
            if needed > 0.95 * table.capacity():
                table.reserve(int(max(needed, table.capacity()) * GROWTH) + 8)
        self._grid.integrate(blocks, image, self._K, extrinsic, 1.0, self._plan.max_range_m, self._multiplier)
        return True

    def extract(self, min_weight: float) -> tuple[Float32, NDArray[np.int32]]:
        """Vertices (V, 3) and triangles (F, 3) of the zero level where it was seen at least `min_weight` times."""
        if self.blocks == 0:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
        mesh = self._grid.extract_triangle_mesh(weight_threshold=float(min_weight))
        if "indices" not in mesh.triangle or "positions" not in mesh.vertex:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
        return mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()

    def _arguments(self, depth_m: Float32, T_world_depth: Float) -> tuple[Any, Any]:
        tensor = self._o3d.core.Tensor
        depth = np.where(depth_m <= self._plan.max_range_m, depth_m, np.float32(0))  # Open3D's "none" is 0
        if not depth.any():
            return None, None
        return self._o3d.t.geometry.Image(tensor(depth)), tensor(invert(T_world_depth))

    def _blocks(self, image: Any, extrinsic: Any) -> Any:
        return self._grid.compute_unique_block_coordinates(
            image, self._K, extrinsic, 1.0, self._plan.max_range_m, self._multiplier
        )


def _integrate(
    survey: _Survey, frames: Frames, poses: FramePoses, plan: _Plan, recipe: Recipe, progress: Progress | None
) -> tuple[_Grid, _Plan]:
    """All frames into a grid. Should the estimate have been far too low, once more with coarser voxels."""
    while True:
        grid, full = _Grid(survey.camera, plan, min(plan.blocks, plan.max_blocks)), False
        for n, (_, depth) in enumerate(frames.read_ahead(poses.frame.tolist())):
            if not grid.integrate(depth, poses.T_world_depth[n]):
                full = True
                break
            if progress is not None:
                progress("surface", n + 1, len(poses.frame))
        if not full:
            return grid, plan
        coarser = _grid_plan(1.25 * plan.voxel_m, survey, recipe, plan.max_blocks)
        message = _coarsened(plan.voxel_m, coarser.voxel_m, recipe)
        plan = replace(coarser, blocks=plan.max_blocks, messages=(*plan.messages, message))


# ---------------------------------------------------------------- cleaning


def _clean(
    vertices: Float32, triangles: Int, survey: _Survey, plan: _Plan, recipe: Recipe, floor_plane: Float | None
) -> tuple[Float32, Int, Float | None, tuple[RemovedPart, ...], tuple[str, ...]]:
    """The subject's surface alone: without floor, background and specks."""
    subject, removed, messages = recipe.subject, [], []
    plane = None
    if subject.floor != "keep":
        areas = meshing.vertex_areas(vertices, triangles)
        normals = meshing.window_normals(vertices, triangles, FLOOR_NORMAL_WINDOW_M)
        eyes = survey.T_world_depth[:, :3, 3]
        if floor_plane is not None:
            plane = meshing.refine_floor(vertices, normals, areas, eyes, np.asarray(floor_plane, np.float64))
        if plane is None:
            plane = meshing.find_floor(vertices, normals, areas, eyes)
        if plane is None and subject.floor == "remove":
            messages.append("no floor plane was found, none was removed")
    if plane is not None:
        height = vertices @ plane[:3].astype(np.float32) + np.float32(plane[3])
        stays = height >= subject.floor_clearance_mm / 1e3
        removed.append(RemovedPart("floor", 1e4 * float(areas[~stays].sum()), 1))
        vertices, triangles = meshing.keep_vertices(vertices, triangles, stays)
    vertices, triangles, others = _pieces(vertices, triangles, survey, plan, recipe)
    return vertices, triangles, plane, (*removed, *others), tuple(messages)


def _pieces(
    vertices: Float32, triangles: Int, survey: _Survey, plan: _Plan, recipe: Recipe
) -> tuple[Float32, Int, tuple[RemovedPart, ...]]:
    """The connected pieces that are the subject.

    The subject is what the camera looked at all the time: pieces are ranked by area x the share of frames that saw it,
    so a large wall, seen in passing, comes after a small subject. Where the background is kept, only specks go.
    """
    subject = recipe.subject
    if len(triangles) == 0:
        return vertices, triangles, ()
    areas = meshing.vertex_areas(vertices, triangles)
    label = meshing.components(triangles, len(vertices))
    area_cm2 = 1e4 * np.bincount(label, areas)
    attention = np.bincount(label, areas * _seen_share(vertices, survey, plan))
    large = area_cm2 >= subject.min_component_cm2
    keep = large.copy()
    if subject.background == "remove" and subject.keep_components > 0:
        ranked = np.flatnonzero(large)[np.argsort(-attention[large], kind="stable")]
        keep[ranked[subject.keep_components :]] = False
    removed = []
    for reason, gone in (("beside the subject", large & ~keep), ("specks", ~large)):
        if gone.any():
            removed.append(RemovedPart(reason, float(area_cm2[gone].sum()), int(gone.sum())))
    vertices, triangles = meshing.keep_vertices(vertices, triangles, keep[label])
    return vertices, triangles, tuple(removed)


def _seen_share(vertices: Float32, survey: _Survey, plan: _Plan) -> Float:
    """(V,) share of the sampled frames on whose own surface a vertex lies."""
    count, (h, w) = np.zeros(len(vertices)), survey.camera.shape
    for depth, T in zip(survey.depth, survey.T_world_depth, strict=True):
        uv, z = project(survey.camera, transform_points(invert(T), vertices))
        u, v = (np.nan_to_num(np.rint(uv[:, i]), nan=-1.0) for i in range(2))
        inside = np.flatnonzero((u >= 0) & (u < w) & (v >= 0) & (v < h))
        there = depth[v[inside].astype(np.intp), u[inside].astype(np.intp)]
        count[inside] += np.abs(there - z[inside]) < SEEN_TRUNCATIONS * plan.truncation_m
    return count / len(survey.depth)
