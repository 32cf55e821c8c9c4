"""Depth frames with poses into the subject's surface: fuse, clean, normals, colour."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..depth.filter import DepthFrames
from ..depth.subject import SubjectFrames
from ..errors import ScanError
from ..geometry.mesh import canonical, close_pinholes, smooth_positions
from ..geometry.normals import window_normals
from ..geometry.rigid import interpolate_trajectory
from ..motion.body import BodyMotion
from ..motion.coarse import Remembering
from ..progress import Progress, silent
from ..recipe import InputSection, SubjectSection, SurfaceSection
from ..types import Float, Float32, Int, Scan, SurfaceMesh, Trajectory, brief
from .clean import Cleaned, RemovedPart, subject_only
from .color import color_vertices
from .moving import RigidFusion, at_rest
from .tsdf import BYTES_PER_BLOCK, FramePoses, Frames, GridPlan, VoxelGrid, integrate_frames, plan_grid, survey_depth

SAME_TIME_S = 1e-3  # a pose this near in time is the frame's own
PINHOLE_VOXELS = 14.0  # round a hole of two voxels' radius
MAX_WALK_M = 100.0  # a camera path longer across than this is in another unit


@dataclass(frozen=True, eq=False)
class SurfaceResult:
    """A fused surface and how it came about.

    mesh : in world metres. voxel_m, truncation_m : of the grid. max_range_m : depth beyond it was not used.
    noise_m_at_1m : depth noise estimated from the data, grows with range². blocks_estimated, blocks_used, memory_gib :
    of the grid. normal_window_m : diameter over which normals were averaged. floor_plane : (4,)
    `[n, d]`, n·p + d = height above the floor in metres; None = none found. motion : how the subject moved; None = it
    stood as still as can be told.
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
    normal_window_m: float
    floor_plane: Float | None
    removed: tuple[RemovedPart, ...]
    messages: tuple[str, ...]
    motion: BodyMotion | None = None

    __repr__ = brief

    def path(self, tracked: Trajectory) -> Trajectory | BodyMotion:
        """Of the depth camera against the subject's trunk, with its motion, if it moved; else `tracked`."""
        return tracked if self.motion is None else self.motion


class Tracked(Protocol):
    """What tracking found out (see `tracking.track.TrackingResult`)."""

    @property
    def trajectory(self) -> Trajectory:
        """Poses of the depth camera."""

    @property
    def floor_plane(self) -> Float | None:
        """(4,) `[n, d]` in the world, n·p + d = height in m; None = none was seen."""


def fuse_surface(
    scan: Scan,
    tracked: Tracked,
    *,
    input: InputSection,
    subject: SubjectSection,
    surface: SurfaceSection,
    depth: DepthFrames | None = None,
    progress: Progress = silent,
) -> SurfaceResult:
    """Fuse a scan's depth frames into the surface of its subject.

    A floor that tracking saw is refined on the surface, else one is looked for, as the recipe says. Before a standing
    camera the room is masked out as in tracking. depth : the scan's frames, if they are at hand.
    progress : called with ("surface", frames done, frames in all).

    Raises ScanError if no frame has a pose or no surface results, ResourceError if the grid cannot fit into memory.
    """
    turning = subject.motion == "subject"
    depth = DepthFrames(scan, input) if depth is None else depth
    frames: Frames = SubjectFrames(scan, input=input, subject=subject, depth=depth) if turning else depth
    max_gap_s = input.max_pose_gap_ms / 1e3
    poses = depth_poses(scan, tracked.trajectory, max_gap_s)
    survey = survey_depth(scan, frames, poses)
    plan = plan_grid(scan, survey, input=input, surface=surface)
    seen = Remembering(frames, len(poses.frame)) if surface.motion else frames
    grid, plan = integrate_frames(survey, seen, poses, plan, input=input, surface=surface, progress=progress)
    found = _extracted(grid, len(poses.frame), surface.min_weight, scan)
    clean = subject_only(*found, survey, plan, subject=subject, floor_plane=tracked.floor_plane)
    mesh, trajectory, motion, moved = _finished(clean, plan, surface, scan), tracked.trajectory, None, None
    if isinstance(seen, Remembering):
        rigid = RigidFusion(seen, scan.depth.times_s, poses, survey, plan, clean, mesh)
        moved = rigid.moved(input=input, subject=subject, surface=surface)
    if moved is not None:
        plan = replace(plan, blocks=max(grid.blocks, 1))
        again = survey, moved.frames, moved.poses, plan
        grid, plan = integrate_frames(*again, input=input, surface=surface, progress=progress)
        found = _extracted(grid, len(poses.frame), surface.min_weight, scan)
        mesh = _finished(at_rest(found, clean, survey, plan, subject=subject), plan, surface, scan)
        up = clean.floor_plane[:3] if clean.floor_plane is not None else -poses.T_world_depth[:, :3, 1].mean(0)
        motion = moved.of(mesh, scan.depth.times_s, up)
        trajectory = motion.trajectory
    if surface.color:
        mesh = replace(mesh, color_rgb=color_vertices(scan, trajectory, mesh, max_gap_s))
    return SurfaceResult(
        mesh=mesh,
        voxel_m=plan.voxel_m,
        truncation_m=plan.truncation_m,
        max_range_m=plan.max_range_m,
        noise_m_at_1m=survey.noise_m_at_1m,
        blocks_estimated=plan.blocks,
        blocks_used=grid.blocks,
        memory_gib=grid.blocks * BYTES_PER_BLOCK / 2**30,
        frames_used=len(poses.frame),
        normal_window_m=surface.normal_window_mm / 1e3,
        floor_plane=clean.floor_plane,
        removed=clean.removed,
        messages=(*plan.messages, *clean.messages),
        motion=motion,
    )


def _finished(clean: Cleaned, plan: GridPlan, surface: SurfaceSection, scan: Scan) -> SurfaceMesh:
    """The subject's surface with its pinholes closed, smoothed as the recipe says, with normals; no colour yet."""
    if len(clean.triangles) == 0:
        gone = ", ".join(f"{r.area_cm2:.0f} cm² {r.reason}" for r in clean.removed)
        raise ScanError(
            f"no surface is left after cleaning: {gone}",
            place=scan.root,
            hint="set subject.background = keep, or a smaller subject.min_component_cm2",
        )
    triangles = close_pinholes(clean.vertices_m, clean.triangles, PINHOLE_VOXELS * plan.voxel_m)
    vertices = smooth_positions(clean.vertices_m, triangles, surface.smooth_iterations)
    return SurfaceMesh(vertices, triangles, window_normals(vertices, triangles, surface.normal_window_mm / 1e3))


def _extracted(grid: VoxelGrid, frames: int, min_weight: float, scan: Scan) -> tuple[Float32, Int]:
    """Vertices (V, 3) m and triangles (F, 3) of what enough of the frames saw, in an order of their own."""
    min_weight = min(min_weight, max(1, frames // 3))  # a handful of views cannot see everything three times
    vertices, triangles = grid.extract(min_weight)
    if len(triangles) == 0:
        raise ScanError(
            f"{frames} depth frames made no surface: nothing was seen {min_weight:g} times",
            place=scan.root,
            hint="the trajectory must be T_world_depth in metres; `thermofusion check SCAN` shows the streams",
        )
    return canonical(vertices, triangles)


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
