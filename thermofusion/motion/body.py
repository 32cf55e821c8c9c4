"""The motion that a surface is stored with: for whoever looks at the subject at a moment of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..types import Bool, Float, Float32, SurfaceMesh, Trajectory, brief
from .field import MotionField, affine
from .graph import Binding


@dataclass(frozen=True)
class PartMotion:
    """How much a part of the body moved against the trunk. rms_mm, peak_mm : about its mean, and farthest from it."""

    name: str
    rms_mm: float
    peak_mm: float


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """How the subject moved against its trunk while it was recorded; the surface is at rest, the mean over time.

    field : of nodes along the surface. binding : of the surface's vertices. trajectory : of the depth camera against
    the trunk. moved_mm : (V,) rms of each vertex. unsettled : (V,) its motion was not followed to the noise.
    parts : by place.
    left_out_before, _after : rms, in sigmas, of depth frames that were left out,
    without and with motion. too_much : (start, stop) s in which the subject moved more than can be followed.
    """

    field: MotionField
    binding: Binding
    trajectory: Trajectory
    moved_mm: Float32
    unsettled: Bool
    parts: tuple[PartMotion, ...]
    left_out_before: float
    left_out_after: float
    too_much: tuple[tuple[float, float], ...] = ()

    __repr__ = brief

    def affine_at(self, time_s: float) -> Float32:
        """(V, 3, 4) what takes each vertex from rest, m, to where it is at a time on the depth clock: p -> A p + b."""
        return affine(self.field.node_m, self.field.at(time_s), self.binding)

    def posed(self, mesh: SurfaceMesh, time_s: float) -> SurfaceMesh:
        """The surface as it stands at a time on the depth clock."""
        return moved_by(mesh, self.affine_at(time_s))


def moved_by(mesh: SurfaceMesh, M: Float32) -> SurfaceMesh:
    """A mesh whose vertices are moved by affine motions (V, 3, 4), near to rigid ones."""
    at = np.einsum("vij,vj->vi", M[:, :, :3], mesh.vertices_m) + M[:, :, 3]
    normal = np.einsum("vij,vj->vi", M[:, :, :3], mesh.normals)
    normal /= np.maximum(np.sqrt(np.einsum("vi,vi->v", normal, normal)), np.float32(1e-9))[:, None]
    return replace(mesh, vertices_m=at, normals=normal)


@dataclass(frozen=True, eq=False)
class Standing:
    """Row -> the surface as it stands at times_s[row] (N,) on the depth clock; always `rest` for a subject at rest."""

    rest: SurfaceMesh
    motion: BodyMotion | None
    times_s: Float

    def __call__(self, row: int) -> SurfaceMesh:
        """At the time of a row."""
        return self.rest if self.motion is None else self.motion.posed(self.rest, float(self.times_s[row]))


def parted(path: Trajectory | BodyMotion) -> tuple[Trajectory, BodyMotion | None]:
    """The depth camera's trajectory against the subject, and the subject's own motion, if it moved."""
    return (path, None) if isinstance(path, Trajectory) else (path.trajectory, path)
