"""The frame that a result is handed out in: upright, facing front, whatever way the first camera was held."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..export.axes import axes_of, axes_rotation, axes_text, view_axes
from ..geometry.rigid import pose
from ..recipe import OutputSection
from ..report.summary import Steps
from ..types import Float, Scan, ThermalMesh, Trajectory

UPRIGHT = "upright: y up, z toward who looks at the front, metres"
WORLD = "world: the recording's, or the first tracked depth camera's, metres"
MIN_STATURE_M = 1.2  # lower bodies show no feet, or no ankles above them
FOOT_SHARE, ANKLE_SHARE = 0.05, 0.12  # of the stature: below the first lie the feet, between both the ankles
MIN_TOE_M = 0.025  # feet reach this much farther forward than ankles


@dataclass(frozen=True, eq=False)
class Frame:
    """T_result_world (4, 4), a rotation about the world's origin; front_from : what said where the front is."""

    T_result_world: Float
    name: str
    front_from: str
    axes: dict[str, str]  # up and front in the world

    def mesh(self, mesh: ThermalMesh) -> ThermalMesh:
        """A mesh of the world, turned into this frame; its metadata say so."""
        R, surface = self.T_result_world[:3, :3], mesh.surface
        turned = replace(
            surface,
            vertices_m=(surface.vertices_m.astype(np.float64) @ R.T).astype(np.float32),
            normals=(surface.normals.astype(np.float64) @ R.T).astype(np.float32),
        )
        up, front = (R @ v for v in axes_of(self.axes)[1:])
        told = {"frame": self.name, "up": axes_text(up), "front": axes_text(front)}
        return replace(mesh, surface=turned, metadata={**mesh.metadata, **told})

    def trajectory(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory of the world, in this frame."""
        return Trajectory(trajectory.times_s, self.T_result_world @ trajectory.T_world_depth)


def frame_of(scan: Scan, steps: Steps, output: OutputSection) -> Frame:
    """The frame that the recipe asks for. Needs a surface."""
    assert steps.surface is not None
    vertices, poses = steps.surface.mesh.vertices_m, steps.tracking.trajectory.T_world_depth
    floor = steps.surface.floor_plane if steps.surface.floor_plane is not None else steps.tracking.floor_plane
    axes = view_axes(poses, vertices.mean(0), None if floor is None else floor[:3], scan.depth_up)
    up, front = axes_of(axes)[1:]
    front_from = "first camera"
    if output.front != "auto":
        # right of who looks at the front is the person's left: where the camera stood that saw the left side
        seen = {"front": front, "back": -front, "left": np.cross(front, up), "right": np.cross(up, front)}
        front, front_from = seen[output.front], "recipe"
    else:
        toes = _toward_the_toes(vertices.astype(np.float64), up)
        if toes is not None:
            front, front_from = toes, "feet"
    R = axes_rotation(up, front)
    axes = {"up": axes_text(R[1]), "front": axes_text(R[2])}
    if output.frame == "world":
        return Frame(np.eye(4), WORLD, front_from, axes)
    return Frame(pose(R, np.zeros(3)), UPRIGHT, front_from, axes)


def _toward_the_toes(vertices_m: Float, up: Float) -> Float | None:
    """The level direction in which the feet reach beyond the ankles, (3,); None where no feet are seen standing."""
    height = vertices_m @ up
    height -= height.min()
    stature = height.max()
    foot, ankle = height < FOOT_SHARE * stature, (height >= FOOT_SHARE * stature) & (height < ANKLE_SHARE * stature)
    if stature < MIN_STATURE_M or not foot.any() or not ankle.any():
        return None
    reach = vertices_m[foot].mean(0) - vertices_m[ankle].mean(0)
    reach -= (reach @ up) * up
    return reach if np.linalg.norm(reach) > MIN_TOE_M else None
