"""Every method on every scan whose truth is known: the table of the results page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.rays import RayScene
from ..geometry.rigid import rigid_alignment, transform_points
from ..phantom import simulate
from ..pipeline import Result, fuse
from ..recipe import Recipe, load_recipe
from ..scans import open_scan
from ..temperature.solve import METHODS, measure
from ..types import Float, Scan, ThermalMesh, Trajectory
from .report import FigureReport, Number, Writer
from .scan_figures import cylinder_scene, head_scene

MAX_ANGLE_DEG, MIN_VIEWS, NEAR_M = 60.0, 2, 0.02  # which vertices are judged


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
    """A phantom's `truth/`: surface, temperature, poses."""

    surface: RayScene
    triangles: np.ndarray
    degC: Float
    times_s: Float
    positions_m: Float

    @classmethod
    def read(cls, scan: Path) -> Truth:
        """From a scan folder."""
        with np.load(scan / "truth" / "surface.npz") as z:
            v, f, T = z["vertices_m"], z["triangles"], z["temperature_degC"]
        path = np.loadtxt(scan / "truth" / "trajectory.txt", ndmin=2)
        return cls(RayScene(v, f), f, np.asarray(T, np.float64), path[:, 0], path[:, 1:4])

    def error(self, mesh: ThermalMesh, trajectory: Trajectory) -> TruthError:
        """Compare at the nearest true points, after moving the trajectory onto the true one."""
        near = np.abs(trajectory.times_s[:, None] - self.times_s).argmin(axis=1)
        same = np.abs(trajectory.times_s - self.times_s[near]) < 1e-3
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


def methods_on_phantoms(out: Path, work: Path) -> FigureReport:
    """The cylinder and the head, simulated here."""
    cases = []
    for name, scene, recipe in (
        ("cylinder", cylinder_scene(), load_recipe("phantom-cylinder", ["crosscal.vignetting=false"])),
        ("head", head_scene(), load_recipe("head")),
    ):
        folder = simulate(scene, work / f"methods-{name}", seed=0, overwrite=True)
        scan = open_scan(folder)
        cases.append((name, folder, scan, recipe, fuse(scan, recipe)))
    return _report(out, "methods-phantoms", cases)


def methods_on_scan(out: Path, work: Path, folder: Path) -> FigureReport:
    """A recorded or simulated scan with `truth/`; its result is kept in `work`."""
    scan, recipe = open_scan(folder), load_recipe("torso")
    result = fuse(scan, recipe, out=work / folder.name)
    return _report(out, f"methods-{folder.name}", [(folder.name, folder, scan, recipe, result)])


def _report(out: Path, stem: str, cases: Sequence[tuple[str, Path, Scan, Recipe, Result]]) -> FigureReport:
    rows: dict[str, list[Any]] = {k: [] for k in ("scan", "method", "vertices", "level_K", "rms_K", "p95_K")}
    numbers = []
    for name, folder, scan, recipe, result in cases:
        truth = Truth.read(folder)
        for method in METHODS:
            e = truth.error(_by_method(scan, recipe, result, method), result.trajectory)
            for key, value in zip(rows, (name, method, e.vertices, e.level_K, e.rms_K, e.p95_K), strict=True):
                rows[key].append(value)
            numbers.append(Number(f"{name}, {method}: rms error, level removed", e.rms_K, "K"))
    writer = Writer(out, stem)
    writer.csv(rows)
    note = "Against the phantom's truth, vertices seen by at least two views at less than 60°; the median is removed."
    return writer.report("Every method against the truth", numbers, [note])


def _by_method(scan: Scan, recipe: Recipe, result: Result, method: str) -> ThermalMesh:
    """The same surface and observations, blended by another method."""
    assert result.seen is not None
    if method == recipe.radiometry.method:
        return result.mesh
    other = recipe.model_copy(update={"radiometry": recipe.radiometry.model_copy(update={"method": method})})
    return measure(scan, result.mesh.surface, result.seen, other).mesh
