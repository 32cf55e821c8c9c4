"""What the figures are made of: each scan simulated or opened, fused and given its truth, once for all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ScanError
from ..files.npz import read_npz
from ..files.reading import read_numbers
from ..geometry.rays import RayScene
from ..geometry.rigid import rigid_alignment, transform_points
from ..phantom import SceneConfig, load_scene, simulate
from ..pipeline import Result, fuse
from ..recipe import Recipe, load_recipe
from ..scans import open_scan
from ..types import Float, Scan, ThermalMesh, Trajectory
from .laboratory import open_face

MAX_ANGLE_DEG, MIN_VIEWS, NEAR_M = 60.0, 2, 0.02  # which vertices are judged; farther off there is no true skin
SAME_TIME_S = 1e-3  # poses nearer in time are of one frame: files round times, frames are tens of milliseconds apart


@dataclass(frozen=True, eq=False)
class Prepared:
    """The scans of all figures, each made when a figure first asks for it.

    data : folder with the recordings, or None. work : where phantom scans and results go; may be deleted.
    """

    data: Path | None
    work: Path

    def recording(self, name: str) -> Path:
        """A folder of the recordings. Raises ScanError where none were given."""
        if self.data is None:
            raise ScanError("the recordings are not here", hint="give their folder with --data")
        return self.data / name

    @cached_property
    def cylinder(self) -> Case:
        """The phantom cylinder in 3D, through an even lens."""
        recipe = load_recipe("phantom-cylinder", ["temperature.crosscal.vignetting=false"])
        return self._simulated("cylinder", cylinder_scene(), "cylinder", recipe)

    @cached_property
    def head(self) -> Case:
        """A phantom head (CC0), half way round."""
        return self._simulated("head", head_scene(), "head-half-turn", load_recipe("head"))

    @cached_property
    def head_once(self) -> Case:
        """The same head in one view, by the paper's method."""
        return self._simulated("head", one_view_scene(), "head-one-view", load_recipe("paper/face"))

    @cached_property
    def torso(self) -> Case:
        """A recorded or simulated scan with `truth/`; its result is kept in `work`, and taken from there next time."""
        folder = self.recording("torso-dev")
        scan, recipe = open_scan(folder), load_recipe("torso")
        return Case(folder.name, scan, recipe, fuse(scan, recipe, out=self.work / folder.name))

    @cached_property
    def face(self) -> Case:
        """The paper's own face. Raises ScanError where the recording is unusable."""
        scan, shift_K = open_face(self.recording("jhu/face"), self.recording("jhu/radiometry"))
        recipe = load_recipe("paper/face")
        return Case("face", scan, recipe, fuse(scan, recipe), shift_K)

    def _simulated(self, name: str, scene: SceneConfig, folder: str, recipe: Recipe) -> Case:
        scan = open_scan(simulate(scene, self.work / folder, seed=0, overwrite=True))
        return Case(name, scan, recipe, fuse(scan, recipe))


@dataclass(frozen=True, eq=False)
class Case:
    """A scan, fused. shift_K : what was added to its thermal picture beforehand."""

    name: str
    scan: Scan
    recipe: Recipe
    result: Result
    shift_K: float = 0.0

    @cached_property
    def truth(self) -> Truth:
        """Of a phantom."""
        return Truth.read(self.scan.root)


# ---------------------------------------------------------------- scenes


def cylinder_scene() -> SceneConfig:
    """The shipped cylinder with fewer and smaller frames, through an even lens."""
    scene = load_scene("cylinder")
    assert scene.thermal.blackbody is not None
    blackbody = replace(scene.thermal.blackbody, frames=(0, 5, 10))
    return replace(
        scene,
        walk=replace(scene.walk, depth_frames=36, depth_hz=6.0),
        depth=replace(scene.depth, scale=0.5),
        thermal=replace(scene.thermal, scale=0.5, every=3, vignetting_K=0.0, blackbody=blackbody),
    )


def head_scene() -> SceneConfig:
    """The shipped head, from its front past one side to the back, with drift."""
    scene = load_scene("head")
    assert scene.thermal.blackbody is not None
    return replace(
        scene,
        shape=replace(scene.shape, subdivisions=1),
        walk=replace(scene.walk, turns=0.45, depth_frames=33, depth_hz=5.0),
        depth=replace(scene.depth, scale=0.5),
        thermal=replace(scene.thermal, every=3, blackbody=replace(scene.thermal.blackbody, frames=(0, 5, 10))),
        color=None,
    )


def one_view_scene() -> SceneConfig:
    """The shipped head, seen once from the front: no walk, no drift."""
    scene = load_scene("head")
    walk = replace(scene.walk, turns=0.0, depth_frames=4, tremor_mm=0.5, height_wobble_m=0.0)
    drift = replace(scene.thermal.drift, level_K=0.0, wander_K=0.0)
    thermal = replace(scene.thermal, every=4, vignetting_K=0.0, drift=drift, blackbody=None)
    return replace(scene, walk=walk, thermal=thermal, color=None)


# ---------------------------------------------------------------- truth


@dataclass(frozen=True)
class TruthError:
    """Of a mesh against a scan's truth, K, over vertices that at least two views saw at less than 60°.

    level : median. rms, p95 : of what is left without it.
    """

    vertices: int
    level_K: float
    rms_K: float
    p95_K: float


@dataclass(frozen=True, eq=False)
class Truth:
    """A phantom's `truth/`: surface with triangles (F, 3) and degC (V,); poses: times_s (T,), positions_m (T, 3)."""

    surface: RayScene
    triangles: NDArray
    degC: Float
    times_s: Float
    positions_m: Float

    @classmethod
    def read(cls, scan: Path) -> Truth:
        """From a scan folder."""
        v, f, T = read_npz(scan / "truth" / "surface.npz", "truth", ["vertices_m", "triangles", "temperature_degC"])
        path = read_numbers(scan / "truth" / "trajectory.txt", columns=8)
        return cls(RayScene(v, f), f, np.asarray(T, np.float64), path[:, 0], path[:, 1:4])

    def error(self, mesh: ThermalMesh, trajectory: Trajectory) -> TruthError:
        """Compare at the nearest true points, after moving the trajectory onto the true one."""
        near = np.abs(trajectory.times_s[:, None] - self.times_s).argmin(axis=1)
        same = np.abs(trajectory.times_s - self.times_s[near]) < SAME_TIME_S
        T_true_world = rigid_alignment(trajectory.T_world_depth[same, :3, 3], self.positions_m[near[same]])
        judged = np.flatnonzero(
            mesh.measured & (mesh.view_angle_deg < MAX_ANGLE_DEG) & (mesh.observations >= MIN_VIEWS)
        )
        points = transform_points(T_true_world, mesh.surface.vertices_m[judged].astype(np.float64)).astype(np.float32)
        nearest = self.surface.closest(points)
        expected = (self.degC[self.triangles[nearest.triangle]] * nearest.weights).sum(1)
        error = (mesh.temperature_degC[judged] - expected)[nearest.distance < NEAR_M]
        level = float(np.median(error))
        left = error - level
        return TruthError(len(error), level, float(np.sqrt((left**2).mean())), float(np.percentile(np.abs(left), 95)))
