"""A subject that moved: its motion is solved on the rigid fusion, and every frame is fused again as if it had not."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.mesh import canonical, keep_vertices, mesh_normals
from ..geometry.plane import FLOOR_NORMAL_COS
from ..motion.body import BodyMotion
from ..motion.coarse import Remembering
from ..motion.estimate import Solution, estimate
from ..motion.graph import bind
from ..motion.told import described
from ..motion.warp import RestSurface, Warp
from ..recipe import InputSection, SubjectSection, SurfaceSection
from ..types import Float, Float32, Int, SurfaceMesh, Trajectory
from .clean import Cleaned, subject_only
from .tsdf import FramePoses, Frames, GridPlan, Survey, integrate_frames

WARPERS = 2  # threads that bring frames to rest ahead
SOME, COARSER = 4, 1.5  # every so many frames make the surface in between, with voxels larger by so much


@dataclass(frozen=True, eq=False)
class Moved:
    """The solution, the camera's poses against the trunk, and the frames as they would be had nothing moved."""

    solution: Solution
    poses: FramePoses
    frames: Frames

    def of(self, mesh: SurfaceMesh, times_s: Float, up: Float) -> BodyMotion:
        """The motion of the surface at rest that these frames made. times_s : of the depth stream. up : (3,) unit."""
        s = self.solution
        binding = bind(mesh.vertices_m, mesh.triangles, s.field.node_m)
        trajectory = Trajectory(times_s[self.poses.frame], self.poses.T_world_depth)
        return described(mesh, s, binding, trajectory, up)


class FramesAtRest:
    """Depth frames of a moving subject, brought to rest."""

    def __init__(self, frames: Frames, warp: Warp, poses: FramePoses, times_s: Float) -> None:
        self._frames, self._warp, self.camera = frames, warp, frames.camera
        self._T: dict[int, Float] = dict(zip(poses.frame.tolist(), poses.T_world_depth, strict=True))
        self._times_s = times_s

    def read_ahead(self, frames: Sequence[int]) -> Iterator[tuple[int, Float32]]:
        """(i, depth (H, W) m of frame i) in the order given."""

        def rest(i: int, depth: Float32) -> Float32:
            return self._warp(depth, self._T[i], float(self._times_s[i]))

        waiting: deque[tuple[int, Future[Float32]]] = deque()
        with ThreadPoolExecutor(WARPERS) as pool:
            for i, depth in self._frames.read_ahead(frames):
                waiting.append((i, pool.submit(rest, i, depth)))
                if len(waiting) > 2 * WARPERS:
                    number, done = waiting.popleft()
                    yield number, done.result()
            while waiting:
                number, done = waiting.popleft()
                yield number, done.result()


@dataclass(frozen=True, eq=False)
class RigidFusion:
    """A fusion that took the subject for rigid: what went in and what came out. times_s : of the depth stream.
    frames : as they were remembered on their way in."""

    frames: Remembering
    times_s: Float
    poses: FramePoses
    survey: Survey
    plan: GridPlan
    clean: Cleaned
    mesh: SurfaceMesh

    def moved(self, *, input: InputSection, subject: SubjectSection, surface: SurfaceSection) -> Moved | None:
        """The subject's motion, if it moved; and what is needed to fuse the frames again."""

        def fused(solution: Solution) -> SurfaceMesh:
            plan = replace(self.plan, voxel_m=COARSER * self.plan.voxel_m)
            moved = self._applied(solution, remembered.times_s)
            few = FramePoses(moved.poses.frame[::SOME], moved.poses.T_world_depth[::SOME])
            grid, plan = integrate_frames(self.survey, moved.frames, few, plan, input=input, surface=surface)
            found = canonical(*grid.extract(min(surface.min_weight, max(1, len(few.frame) // 3))))
            clean = at_rest(found, self.clean, self.survey, plan, subject=subject)
            normals = mesh_normals(clean.vertices_m, clean.triangles)
            return SurfaceMesh(clean.vertices_m, clean.triangles, normals)

        T_of_frame = dict(zip(self.poses.frame.tolist(), self.poses.T_world_depth, strict=True))
        remembered = self.frames.frames(self.times_s, T_of_frame)
        solution = estimate(self.mesh, remembered, self.survey.noise_m_at_1m, fused)
        return None if solution is None else self._applied(solution, remembered.times_s)

    def _applied(self, solution: Solution, kept_s: Float) -> Moved:
        """A motion of the remembered frames, at kept_s (M,), applied to all frames."""
        T = solution.poses(kept_s, self.times_s[self.poses.frame], self.poses.T_world_depth)
        poses = replace(self.poses, T_world_depth=T)
        rest = RestSurface(solution.surface.vertices_m, solution.surface.triangles, solution.binding, solution.field)
        warp = Warp(rest, self.frames.camera)
        return Moved(solution, poses, FramesAtRest(self.frames.source, warp, poses, self.times_s))


def at_rest(
    found: tuple[Float32, Int], first: Cleaned, survey: Survey, plan: GridPlan, *, subject: SubjectSection
) -> Cleaned:
    """The subject's part of the surface that frames at rest made: what of it lies on the floor `first` found goes too.

    found : vertices (V, 3) m and triangles (F, 3).
    Floor and walls are gone already: frames at rest hold the subject alone.
    """
    vertices, triangles = found
    if first.floor_plane is not None:
        plane = first.floor_plane.astype(np.float32)
        height = vertices @ plane[:3] + plane[3]
        level = mesh_normals(vertices, triangles) @ plane[:3] > FLOOR_NORMAL_COS
        layer = level & (height < first.floor_top_m)  # of a floor smeared into layers: feet stay, floor goes
        stays = (height >= subject.floor_clearance_mm / 1e3) & ~layer
        vertices, triangles = keep_vertices(vertices, triangles, stays)
    alone = subject.model_copy(update={"floor": "keep"})
    return subject_only(vertices, triangles, survey, plan, subject=alone, floor_plane=None)
