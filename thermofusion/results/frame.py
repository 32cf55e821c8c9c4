"""The frame that a result is handed out in: upright, facing front, whatever way the first camera was held."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import label

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
MIN_FOOT_M = 0.17  # along that direction: a cut leg is round, and shorter
FLOOR_CELL_M = 0.02  # of the grid on which feet that stand apart are told apart


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
    """The level direction in which the feet reach beyond their ankles, (3,); None where no foot is seen standing.

    Whatever stands on the floor must be as long as a foot: legs that the image cuts off have no front.
    """
    height = vertices_m @ up
    height -= height.min()
    stature = height.max()
    if stature < MIN_STATURE_M:
        return None
    across = np.linalg.svd(up[None])[2][1:]  # (2, 3): two level directions
    level = vertices_m @ across.T
    low, foot = height < ANKLE_SHARE * stature, height < FOOT_SHARE * stature
    cell = ((level[low] - level[low].min(0)) / FLOOR_CELL_M).astype(np.intp) + 1
    ground = np.zeros(cell.max(0) + 2, bool)
    ground[tuple(cell.T)] = True
    legs, _ = label(ground, np.ones((3, 3)))
    leg, foot, level = legs[tuple(cell.T)], foot[low], level[low]
    reach = np.zeros(2)
    for number in np.unique(leg[foot]):
        toes, ankle = level[foot & (leg == number)], level[~foot & (leg == number)]
        if not len(ankle):
            continue
        ahead = toes.mean(0) - ankle.mean(0)
        length = np.ptp(toes @ ahead) / max(float(np.linalg.norm(ahead)), 1e-9)
        if np.linalg.norm(ahead) > MIN_TOE_M and length > MIN_FOOT_M:
            reach += ahead
    return reach @ across if np.linalg.norm(reach) > MIN_TOE_M else None
